"""Files of Gaussian splats in other layouts, against the plain one that holds the same Gaussians."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from dano.fields import load_field

plyfile = pytest.importorskip("plyfile")
RNG = np.random.default_rng(0)
N = 300
MEANS = RNG.uniform(-0.1, 0.1, (N, 3))
SCALES = np.log(RNG.uniform(0.004, 0.02, (N, 3)))
QUATS = RNG.normal(size=(N, 4))
QUATS /= np.linalg.norm(QUATS, axis=1, keepdims=True)
OPACITY = RNG.uniform(-2, 3, N)
POINTS = jnp.asarray(RNG.uniform(-0.1, 0.1, (3, 2000)))


def write(path: Path, columns: dict[str, np.ndarray], *elements) -> Path:
    kinds = [(name, values.dtype.str) for name, values in columns.items()]
    table = np.empty(len(next(iter(columns.values()))), dtype=kinds)
    for name, values in columns.items():
        table[name] = values
    plyfile.PlyData([*elements, plyfile.PlyElement.describe(table, "vertex")]).write(str(path))
    return path


def plain(scales=SCALES, count=3) -> dict[str, np.ndarray]:
    columns = {axis: MEANS[:, i] for i, axis in enumerate("xyz")} | {"opacity": OPACITY}
    columns |= {f"scale_{i}": scales[:, i] for i in range(count)}
    columns |= {f"rot_{i}": QUATS[:, i] for i in range(4)}
    return {name: values.astype(np.float32) for name, values in columns.items()}


def density(path: Path, **options) -> np.ndarray:
    return np.asarray(load_field(path, **options).jet(POINTS, 0))


def packed(path: Path) -> Path:
    """PlayCanvas' layout, written bit by bit from its description."""
    chunk = np.arange(N) // 256
    ranges: dict[str, np.ndarray] = {}

    def quantised(values: np.ndarray, name: str) -> np.ndarray:
        word = np.zeros(N, np.uint64)
        for axis, (first, bits) in zip(range(3), ((21, 11), (11, 10), (0, 11)), strict=True):
            low = np.array([values[chunk == c, axis].min() for c in range(2)])
            high = np.array([values[chunk == c, axis].max() for c in range(2)])
            ranges[f"min_{name}{'xyz'[axis]}"], ranges[f"max_{name}{'xyz'[axis]}"] = low, high
            share = (values[:, axis] - low[chunk]) / (high - low)[chunk]
            word |= np.rint(share * (2**bits - 1)).astype(np.uint64) << np.uint64(first)
        return word.astype(np.uint32)

    words = {"packed_position": quantised(MEANS, "")}
    largest = np.abs(QUATS).argmax(axis=1)
    turned = QUATS * np.sign(QUATS[np.arange(N), largest])[:, None]
    rotation = largest.astype(np.uint64)
    for k in range(4):
        part = np.rint((turned[:, k] / np.sqrt(2) + 0.5) * 1023).astype(np.uint64)
        rotation = np.where(largest == k, rotation, (rotation << np.uint64(10)) | part)
    words["packed_rotation"] = rotation.astype(np.uint32)
    words["packed_scale"] = quantised(SCALES, "scale_")
    words["packed_color"] = np.rint(255 / (1 + np.exp(-OPACITY))).astype(np.uint32)
    kinds = [(name, "<f4") for name in ranges]
    table = np.array(list(zip(*ranges.values(), strict=True)), dtype=kinds)
    return write(path, words, plyfile.PlyElement.describe(table, "chunk"))


def test_packed_files(tmp_path: Path):
    expected = density(write(tmp_path / "plain.ply", plain()))
    found = density(packed(tmp_path / "a.compressed.ply"))
    assert expected.max() > 0.5
    np.testing.assert_allclose(found, expected, atol=0.03)


def test_flat_gaussians_get_a_thickness(tmp_path: Path):
    flat = write(tmp_path / "flat.ply", plain(count=2))
    thick = SCALES.copy()
    thick[:, 2] = np.log(0.1) + SCALES[:, :2].min(axis=1)
    np.testing.assert_allclose(density(flat), density(write(tmp_path / "thick.ply", plain(thick))), atol=1e-6)


def test_gaussians_that_are_not_finite_are_counted_and_left_out_on_request(tmp_path: Path):
    columns = plain()
    columns["x"][[3, 7]], columns["scale_1"][9] = np.nan, np.inf
    path = write(tmp_path / "nan.ply", columns)
    with pytest.raises(ValueError, match=r"3 of 300 Gaussians .* skip_nan=True"):
        load_field(path)
    good = np.setdiff1d(np.arange(N), [3, 7, 9])
    rest = write(tmp_path / "rest.ply", {name: values[good] for name, values in columns.items()})
    with pytest.warns(UserWarning, match="left out 3 of 300 Gaussians"):
        found = density(path, skip_nan=True)
    np.testing.assert_allclose(found, density(rest), atol=1e-6)
