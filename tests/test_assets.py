"""The shipped density grids are as described, soft, hollow, with floaters; the trained objects are right."""

from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from dano.scene_file import asset_look, build_asset, load_asset
from dano.vision import load_capture, score

MODEL = Path(__file__).resolve().parents[1] / "assets" / "bunny.obj"


def load(name: str) -> tuple[np.ndarray, np.ndarray, float]:
    with (files("dano") / "assets" / f"{name}.npz").open("rb") as file, np.load(file) as data:
        return data["values"], data["origin"], float(data["spacing"])


def bunny_volume() -> float:
    """Volume [m³] inside the mesh scaled to 12 cm, by the divergence theorem."""
    rows = [line.split() for line in MODEL.read_text(encoding="utf-8").splitlines()]
    vertices = np.array([row[1:] for row in rows if row[0] == "v"], float)
    faces = np.array([row[1:] for row in rows if row[0] == "f"], int) - 1
    a, b, c = np.moveaxis(vertices[faces] * (0.12 / np.ptp(vertices, axis=0).max()), 1, 0)
    return float(np.sum(a * np.cross(b, c)) / 6)


def soap_volume() -> float:
    """Volume [m³] of the rounded bar (Steiner's formula), less about 18 cm of engraved stroke."""
    a, b, c = 0.090 - 0.016, 0.060 - 0.016, 0.030 - 0.016
    r = 0.008
    bar = a * b * c + 2 * r * (a * b + b * c + c * a) + np.pi * r**2 * (a + b + c) + 4 / 3 * np.pi * r**3
    return bar - 0.18 * 0.0038 * 0.003


@pytest.mark.parametrize(
    ("name", "extents", "volume"),
    [("soap", (0.090, 0.060, 0.030), soap_volume()), ("bunny", (0.120, 0.0913, 0.117), bunny_volume())],
)
def test_grid_describes_the_object(name: str, extents: tuple[float, float, float], volume: float):
    values, _, spacing = load(name)
    assert values.dtype == np.float32
    assert max(values.shape) == 96
    assert values.min() == 0
    assert 50 < np.median(values[values > 30]) < 300

    labels, n_components = ndimage.label(values > 1)
    sizes = ndimage.sum_labels(np.ones_like(values), labels, np.arange(1, n_components + 1))
    assert 3 <= n_components - 1 <= 6, "floaters"
    body = labels == 1 + np.argmax(sizes)

    # Half of the typical plateau: the true surface, give or take the plateau's own variation.
    solid = ndimage.binary_fill_holes(body & (values > 75))
    np.testing.assert_allclose(solid.sum() * spacing**3, volume, rtol=0.03)
    occupied = np.argwhere(solid)
    # The tips of the ears are thinner than the wall is soft.
    np.testing.assert_allclose(np.ptp(occupied, axis=0) * spacing, extents, atol=3 * spacing)

    depth = ndimage.distance_transform_edt(solid)
    shell, core = values[(depth > 2) & (depth < 4)], values[depth > 0.9 * depth.max()]
    assert np.median(shell) > 5 * np.median(core), "hollow"


def test_soap_is_engraved():
    values, origin, spacing = load("soap")
    layer = values[:, :, round((0.014 - origin[2]) / spacing)]  # 1 mm below the top face
    # The left bowl of the "d" crosses y = -1 mm: its stroke, then its middle.
    x_middle = -1.5 * 0.0188
    row = round((-0.0012 - origin[1]) / spacing)
    stroke, middle = (layer[round((x - origin[0]) / spacing), row] for x in (x_middle - 0.006, x_middle))
    assert stroke < 0.3 * middle


def test_bunny_stands_on_the_plane():
    values, origin, spacing = load("bunny")
    lowest = np.argwhere(values > 75)[:, 2].min()
    assert abs(origin[2] + lowest * spacing) < 2 * spacing


@pytest.mark.parametrize(("name", "volume"), [("soap", soap_volume()), ("bunny", bunny_volume())])
def test_trained_objects_are_the_solids_and_look_like_the_photographs(name: str, volume: float):
    assert len((files("dano") / "assets" / f"trained_{name}.npz").read_bytes()) < 1_000_000
    look = asset_look(f"trained_{name}")
    assert look is not None
    distances = np.asarray(look.solid.distances)
    cell = float(look.solid.spacing[0])
    found = np.clip(0.5 - distances / cell, 0, 1).sum() * cell**3
    np.testing.assert_allclose(found, volume, rtol=0.03)
    view = load_capture(MODEL.parent / "images" / name).split("test")[0]
    quality = score(look, (view,))
    assert quality.psnr > 29 and quality.mask_iou > 0.985
    assert asset_look(name) is None


@pytest.mark.xfail(
    strict=True,
    reason="shipped before nodes near meshes were marked by ray crossings: 2 % of them have other distances,"
    " by up to .3 mm; the soap that is built now rocks in MuJoCo",
)
def test_shipped_objects_are_what_is_built_of_their_fields():
    shipped, built = load_asset("soap"), build_asset("soap")
    for name in ("mass", "com", "inertia"):
        np.testing.assert_allclose(
            getattr(shipped.mass, name), getattr(built.mass, name), rtol=1e-9, atol=1e-15
        )
    for name in ("grid", "solid"):
        mine, theirs = getattr(shipped, name), getattr(built, name)
        np.testing.assert_allclose(mine.coefficients, theirs.coefficients, rtol=1e-5, atol=1e-6)
    # Rounding may choose another of two candidates that lie equally far from all others.
    assert shipped.surface.points.shape == built.surface.points.shape
    np.testing.assert_allclose(shipped.surface.areas.sum(), built.surface.areas.sum(), rtol=1e-6)
    same = np.all(np.isclose(shipped.surface.points, built.surface.points, atol=1e-9), axis=1)
    assert np.mean(same) > 0.5
