"""Makes the density grids that dano ships: a bar of soap and the Stanford bunny, as a NeRF would learn them.

Photographs show only the outside of an object, so the density of a NeRF rises over a few cells at the surface
to a large value that varies from place to place, falls off again toward the unseen interior, and has a few
floaters in the air around. Here all of this is computed from a signed distance, so that what a program makes
of the grids can be compared with the true shape.

Usage: python assets/make_objects.py [--out src/dano/assets] [--seed 0]
"""

import argparse
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from solids import BUNNY_EXTENT, SignedDistance, soap_distance, SOAP_HALF_EXTENTS

from dano.fields import mesh_field

HERE = Path(__file__).resolve().parent
NODES = 96  # along the longest axis
MARGIN = 8  # nodes of air on each side: room for floaters

BUNNY_BOUNDS = BUNNY_EXTENT * np.array(
    [[-0.5, -0.3806, 0.0], [0.5, 0.3806, 0.9748]]
)  # [m], those of bunny.obj

WALL = 2.5  # cells over which the density rises
SHELL = 4.0  # cells of full density below the surface
DECAY = 3.0  # cells over which it falls to 1/e further inside
CORE = 0.02  # part of it that is left at the core
PLATEAU = 150.0  # typical density [1/m] of the shell
VARIATION = 0.25  # by which its logarithm varies over the surface, standard deviation
N_FLOATERS = 6
MANTISSA_BITS = 10  # a NeRF is not known better than to a thousandth, and zeros compress well


def main() -> None:
    """Write both grids."""
    parser = argparse.ArgumentParser(description="Make the density grids that dano ships.")
    parser.add_argument("--out", type=Path, default=HERE.parent / "src" / "dano" / "assets")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)

    jax.config.update("jax_enable_x64", True)
    soap = sample_density(soap_distance, -SOAP_HALF_EXTENTS, SOAP_HALF_EXTENTS, seed=arguments.seed)
    save(arguments.out / "soap.npz", *soap)
    bunny = sample_density(bunny_distance, *BUNNY_BOUNDS, seed=arguments.seed + 1)
    save(arguments.out / "bunny.npz", *bunny)


def sample_density(
    distance: SignedDistance, lower: np.ndarray, upper: np.ndarray, *, seed: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Density of a NeRF-like object on a regular grid.

    Args:
        distance: Signed distance [m] of grid points (nx, ny, nz, 3), negative inside.
        lower: Lower corner [m] of the object, shape (3,).
        upper: Upper corner [m] of the object, shape (3,).
        seed: Of the variations and floaters.

    Returns:
        Densities [1/m] (nx, ny, nz), the position of the first node [m] and the spacing [m].
    """
    rng = np.random.default_rng(seed)
    spacing = float((upper - lower).max() / (NODES - 1 - 2 * MARGIN))
    shape = np.ceil((upper - lower) / spacing - 1e-9).astype(int) + 1 + 2 * MARGIN
    origin = (lower + upper) / 2 - (shape - 1) / 2 * spacing
    x = origin + spacing * np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1)

    exact = distance(x)
    d = exact / spacing + 0.15 * smooth_noise(x, 8 * spacing, rng)  # [cells], of a slightly bumpy surface
    variation = np.clip(smooth_noise(x, 0.3 * float((upper - lower).max()), rng), -2, 2)
    plateau = PLATEAU * np.exp(VARIATION * variation)
    grain = 1 + 0.05 * smooth_noise(x, 4 * spacing, rng)
    hollow = CORE + (1 - CORE) * np.exp(-np.maximum(-d - SHELL, 0) / DECAY)
    density = plateau * grain * smoothstep(0.5 - d / WALL) * hollow

    # Floaters keep away from the surface and from the sides of the grid by more than their own size.
    inner = np.zeros(shape, bool)
    inner[4:-4, 4:-4, 4:-4] = True
    for index in rng.choice(np.flatnonzero(inner & (exact > 5 * spacing)), N_FLOATERS, replace=False):
        radius = rng.uniform(2.0, 3.5)  # [cells]
        r = np.linalg.norm(x - x.reshape(-1, 3)[index], axis=-1) / spacing
        density += rng.uniform(10.0, 80.0) * smoothstep(1 - r / radius)
    return density, origin, spacing


def smoothstep(t: np.ndarray) -> np.ndarray:
    """Cubic step from 0 at t = 0 to 1 at t = 1."""
    t = np.clip(t, 0, 1)
    return t * t * (3 - 2 * t)


def smooth_noise(x: np.ndarray, wavelength: float, rng: np.random.Generator, n_waves: int = 32) -> np.ndarray:
    """Random function of variance about one: plane waves of length `wavelength` to twice that [m]."""
    directions = rng.normal(size=(n_waves, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    waves = 2 * np.pi / (wavelength * rng.uniform(1, 2, (n_waves, 1))) * directions
    total = np.zeros(x.shape[:-1])
    for wave, phase in zip(waves, rng.uniform(0, 2 * np.pi, n_waves), strict=True):
        total += np.cos(x @ wave + phase)
    return total * np.sqrt(2 / n_waves)


def bunny_distance(x: np.ndarray) -> np.ndarray:
    """Signed distance [m] of bunny.obj, whose longest extent is one, scaled to its size."""
    solid = mesh_field(HERE / "bunny.obj", NODES - 2 * MARGIN, interpolation="linear", scale=BUNNY_EXTENT)
    points = jnp.asarray(x.reshape(-1, 3))
    return np.asarray(jax.lax.map(solid.sdf, points, batch_size=65536)).reshape(x.shape[:-1])


def save(path: Path, density: np.ndarray, origin: np.ndarray, spacing: float) -> None:
    """Write a grid as float32 whose lowest bits are zero, which compresses to half and reads as any other."""
    fraction, exponent = np.frexp(np.where(density < 0.05, 0, density))
    values = np.ldexp(np.round(np.ldexp(fraction, MANTISSA_BITS)), exponent - MANTISSA_BITS).astype(
        np.float32
    )
    partial = path.with_suffix(".partial.npz")
    np.savez_compressed(partial, values=values, origin=origin, spacing=np.float64(spacing))
    os.replace(partial, path)
    print(f"{path.name}: {values.shape}, spacing {1e3 * spacing:.3f} mm, {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
