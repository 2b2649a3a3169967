"""Makes the trained objects that dano ships, from the photographs beside this file.

Each is what `dano train` learns with its default options, without what no picture and no contact needs:
features far from the surface, distances beyond a few cells, digits below what photographs tell.

Usage: python assets/train_objects.py [--out src/dano/assets] [--fields DIR] [--only NAME]

`--fields DIR` takes NAME.field.npz from there, as `dano train` writes it, instead of training.
"""

import argparse
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from dano.vision import LearnedField, load_capture, score, train, with_masks

HERE = Path(__file__).resolve().parent
NAMES = ("bunny", "soap")
REACH = 5.0  # cells from the surface up to which distances are kept
FEATURE_REACH = 2.0  # cells of the coarser grid of features, of which interpolation needs √3
DISTANCE_STEP = 2.0**-9  # cells
FEATURE_BITS = 6  # of a mantissa


def main() -> None:
    """Train, or read, then shrink, check and write."""
    parser = argparse.ArgumentParser(description="Make the trained objects that dano ships.")
    parser.add_argument("--out", type=Path, default=HERE.parent / "src" / "dano" / "assets")
    parser.add_argument("--fields", type=Path, help="folder with NAME.field.npz; default: train now")
    parser.add_argument("--only", choices=NAMES)
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for name in (arguments.only,) if arguments.only else NAMES:
        capture = load_capture(HERE / "images" / name)
        capture = capture if capture.has_masks else with_masks(capture)
        if arguments.fields is None:
            field = train(capture).field
        else:
            field = LearnedField.load(arguments.fields / f"{name}.field.npz")
        small = shrunk(field)
        path = arguments.out / f"trained_{name}.npz"
        small.save(path)
        for what, one in (("trained", field), ("shipped", LearnedField.load(path))):
            found = score(one, capture.split("test"))
            print(f"{name} {what}: {found.psnr:.2f} dB, mask IoU {found.mask_iou:.4f}")
        print(f"{path}: {path.stat().st_size / 1024:.0f} KiB")


def shrunk(field: LearnedField) -> LearnedField:
    """The same field in fewer digits, and without what lies far from its surface."""
    model, look = field.model, field.model.appearance
    cell = float(model.spacing)
    limit = REACH * cell
    step = DISTANCE_STEP * cell
    distances = np.round(np.clip(model.distances, -limit, limit) / step) * step
    shape = look.features.shape[:3]
    nodes = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)
    places = np.asarray(look.origin) + float(look.spacing) * nodes
    at = ndimage.map_coordinates(
        model.distances, ((places - np.asarray(model.origin)) / cell).T, order=1, mode="nearest"
    ).reshape(shape)
    near = np.abs(at) < FEATURE_REACH * float(look.spacing)
    features = np.where(near[..., None], rounded(np.asarray(look.features, np.float32)), 0)
    return eqx.tree_at(
        lambda f: (f.model.distance, f.model.appearance.features),
        field,
        (
            jnp.asarray(distances / float(model.scale), jnp.float32),
            jnp.asarray(features, jnp.float32),
        ),
    )


def rounded(values: np.ndarray) -> np.ndarray:
    """Values with `FEATURE_BITS` bits of mantissa."""
    fraction, exponent = np.frexp(values)
    return np.ldexp(np.round(fraction * 2**FEATURE_BITS) / 2**FEATURE_BITS, exponent).astype(np.float32)


if __name__ == "__main__":
    main()
