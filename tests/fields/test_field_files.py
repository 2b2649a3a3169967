"""Files: what is written is read back, and what cannot be read says why."""

import io
import os
import pickle
import zipfile
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from dano import archive as archive_module
from dano.building import BuildOptions
from dano.fields import GridField, load_field, save_field, SignedDistanceGrid, Sphere
from dano.scene_file import object_of_file

VALUES = np.random.default_rng(0).random((6, 5, 7))


def load_grid(path, **options) -> GridField:
    grid = load_field(path, **options)
    assert isinstance(grid, GridField)
    return grid


def field(kind="quadratic"):
    return GridField(VALUES, (0.1, -0.2, 0.3), (0.1, 0.2, 0.15), kind)


@pytest.mark.parametrize("kind", ["linear", "quadratic", "cubic"])
def test_grids_round_trip(kind, tmp_path):
    path = tmp_path / "grid.npz"
    save_field(field(kind), path)
    again = load_grid(path)
    assert again.interpolation == kind
    np.testing.assert_array_equal(again.values, VALUES)
    np.testing.assert_array_equal(again.bounds, field(kind).bounds)
    assert load_grid(str(path), interpolation="linear").interpolation == "linear"
    assert os.listdir(tmp_path) == ["grid.npz"]


def test_extra_members_are_ignored(tmp_path):
    np.savez(tmp_path / "grid.npz", values=VALUES, origin=np.zeros(3), spacing=0.1, note="anything")
    np.testing.assert_array_equal(load_grid(tmp_path / "grid.npz").spacing, [0.1] * 3)


def test_the_grid_of_an_object_is_read(tmp_path):
    path = tmp_path / "object.dano"
    with open(path, "wb") as file:
        np.savez(file, grid_values=VALUES, grid_origin=np.zeros(3), grid_spacing=0.1, mass=1.0)
    np.testing.assert_array_equal(load_grid(path).values, VALUES)
    with open(path, "wb") as file:
        np.savez(file, mass=1.0)
    with pytest.raises(
        ValueError, match=r"object.dano: expected a neural object with a stored grid.*no grid_values"
    ):
        load_field(path)


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.float32])
def test_voxels_are_centred_with_unit_size_unless_told(dtype, tmp_path):
    path = tmp_path / "voxels.npy"
    voxels = (VALUES > 0.5).astype(dtype)
    np.save(path, voxels)
    with pytest.warns(UserWarning, match="no spacing was given"):
        loaded = load_grid(path)
    np.testing.assert_allclose(loaded.spacing, 1 / 7)
    np.testing.assert_allclose(loaded.origin, -(np.array(VALUES.shape) - 1) / 14)
    np.testing.assert_array_equal(loaded.values, voxels.astype(float))
    assert jnp.issubdtype(loaded.values.dtype, jnp.floating)
    placed = load_grid(path, spacing=0.1, origin=(1.0, 2.0, 3.0), interpolation="linear")
    np.testing.assert_allclose(placed.origin, [1, 2, 3])
    np.testing.assert_allclose(placed.spacing, 0.1)


def test_meshes_become_signed_distances(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("igl")
    for suffix in ("obj", "ply", "off", "glb"):
        path = tmp_path / f"box.{suffix}"
        trimesh.creation.box((0.2, 0.3, 0.4)).export(path)
        options: dict[str, Any] = {"up": "z"} if suffix == "glb" else {}
        loaded = load_field(path, resolution=16, edge=0.02, **options)
        assert isinstance(loaded, SignedDistanceGrid)
        moments = loaded.solid_moments()
        assert moments is not None
        np.testing.assert_allclose(moments.volume, 0.024, rtol=1e-5)


def corrupt(path, kind):
    """Write a bad file of each kind under `path`."""
    if kind == "truncated":
        np.savez(path, values=VALUES, origin=np.zeros(3), spacing=0.1)
        path.write_bytes(path.read_bytes()[:500])
    elif kind == "damaged":
        np.savez_compressed(path, values=VALUES, origin=np.zeros(3), spacing=0.1)
        data = bytearray(path.read_bytes())
        data[200:260] = bytes(60)
        path.write_bytes(data)
    elif kind == "text":
        path.write_text("values: 1, 2, 3\n")
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "pickle":
        path.write_bytes(pickle.dumps({"values": VALUES}))
    elif kind == "pickled member":
        np.savez(path, values=np.array([{"a": 1}], dtype=object), origin=np.zeros(3), spacing=0.1)
    elif kind == "single array":
        with open(path, "wb") as file:
            np.save(file, VALUES)
    elif kind == "text member":
        np.savez(path, values=np.full((4, 4, 4), "1.0"), origin=np.zeros(3), spacing=0.1)
    elif kind == "missing member":
        np.savez(path, values=VALUES, spacing=0.1)
    elif kind == "negative":
        np.savez(path, values=-VALUES, origin=np.zeros(3), spacing=0.1)
    elif kind == "bad origin":
        np.savez(path, values=VALUES, origin=np.zeros(2), spacing=0.1)


@pytest.mark.parametrize(
    "kind, message",
    {
        "truncated": "expected a grid: values",
        "damaged": "expected a grid: values",
        "text": "expected a grid: values .* it is not an archive of arrays",
        "text member": r"values must hold numbers, got text of shape \(4, 4, 4\)",
        "empty": "expected a grid: values",
        "pickle": "pickled objects, which are never loaded",
        "pickled member": "pickled objects, which are never loaded",
        "single array": "single array, not a zip",
        "missing member": r"no origin, only \['values', 'spacing'\]",
        "negative": "values must be densities ≥ 0",
        "bad origin": r"origin must have shape \(3,\)",
        "absent": "no such file",
    }.items(),
)
def test_bad_grids_name_the_file_and_what_was_expected(kind, message, tmp_path):
    path = tmp_path / "grid.npz"
    corrupt(path, kind)
    with pytest.raises(ValueError, match=rf"grid.npz: .*{message}"):
        load_field(path)


@pytest.mark.parametrize("kind", ["truncated", "text", "pickle", "flat", "objects", "complex"])
def test_bad_voxels(kind, tmp_path):
    path = tmp_path / "voxels.npy"
    arrays = {"flat": VALUES[0], "objects": np.array([[[{}]]], dtype=object), "complex": VALUES + 1j}
    if kind in arrays:
        np.save(path, arrays[kind])
    elif kind == "truncated":
        np.save(path, VALUES)
        path.write_bytes(path.read_bytes()[:-40])
    else:
        corrupt(path, kind)
    with pytest.raises(ValueError, match=r"voxels.npy: expected voxels"):
        load_field(path)


def test_unknown_kinds_options_and_folders(tmp_path):
    with pytest.raises(ValueError, match=r"field.txt: unknown kind of field '.txt'; expected one of .npz"):
        load_field(tmp_path / "field.txt")
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(ValueError, match="folder.npz: is a folder"):
        load_field(tmp_path / "folder.npz")
    save_field(field(), tmp_path / "grid.npz")
    with pytest.raises(ValueError, match=r"unknown options \['resolution'\] .* it takes \['interpolation'\]"):
        load_field(tmp_path / "grid.npz", resolution=3)


def test_saving_refuses_bad_places_and_never_destroys(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="must end in .npz"):
        save_field(field(), tmp_path / "grid.npy")
    with pytest.raises(ValueError, match="existing directory"):
        save_field(field(), tmp_path / "none" / "grid.npz")
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(ValueError, match="must be a file, got the directory"):
        save_field(field(), tmp_path / "folder.npz")
    path = tmp_path / "grid.npz"
    save_field(field(), path)
    before = path.read_bytes()

    def full_disk(file, **arrays):
        file.write(b"half")
        raise OSError("no space left")

    monkeypatch.setattr(np, "savez_compressed", full_disk)
    with pytest.raises(OSError, match="no space"):
        save_field(field("linear"), path)
    assert path.read_bytes() == before
    assert sorted(os.listdir(tmp_path)) == ["folder.npz", "grid.npz"]


def test_shipped_grids_have_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert load_grid("bunny").shape == (96, 78, 95)
    # 9 × 6 × 3 cm of soap, and air for floaters on all sides.
    assert np.all(np.ptp(load_grid("soap").bounds, axis=0) > (0.1, 0.07, 0.04))
    (tmp_path / "soap").mkdir()
    with pytest.raises(ValueError, match="unknown kind of field"):
        load_field("soap")
    with pytest.raises(ValueError, match="no such file, .* did you mean 'bunny'"):
        load_field("bunni")


def test_grids_say_what_they_are(tmp_path):
    save_field(field(), tmp_path / "grid.npz")
    with np.load(tmp_path / "grid.npz") as data:
        members: dict[str, Any] = dict(data)
    assert (str(members["format"]), int(members["version"])) == archive_module.FIELD
    for changed, message in (
        ({"version": 99}, r"newer.npz: expected a grid: .* it has version 99, and this dano reads up to"),
        ({"format": "dano-motion"}, r"newer.npz: .* it must be a dano-field file, got a dano-motion file"),
        ({"version": 1.5}, "must state its version as a whole number, got 1.5"),
    ):
        np.savez(tmp_path / "newer.npz", **{**members, **changed})
        with pytest.raises(ValueError, match=message):
            load_field(tmp_path / "newer.npz")
    # Another program's words are not dano's business, and files from before had none.
    np.savez(tmp_path / "foreign.npz", **{**members, "format": "voxels", "version": "a"})
    np.testing.assert_array_equal(load_grid(tmp_path / "foreign.npz").values, VALUES)


def test_shapes_are_not_saved_as_grids(tmp_path):
    with pytest.raises((ValueError, TypeError), match="(bake it first|GridField)"):
        save_field(Sphere(0.1), tmp_path / "ball.npz")  # pyright: ignore[reportArgumentType]


def header(shape: tuple[int, ...]) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return stream.getvalue()


def test_sizes_are_checked_before_memory_is_taken(tmp_path, monkeypatch):
    """A header that claims more than the file has; zeros that a small zip unfolds into more than fits."""
    (tmp_path / "claims.npy").write_bytes(header((2**14, 2**14, 2**15)) + bytes(64))
    with zipfile.ZipFile(tmp_path / "claims.npz", "w") as zipped:
        for name in ("values", "origin", "spacing"):
            zipped.writestr(f"{name}.npy", header((2**14, 2**14, 2**15)) + bytes(64))
    for name in ("claims.npy", "claims.npz"):
        with pytest.raises(
            ValueError, match=r"is cut off: by its shape .* it takes 64 TiB, the file has 192 B"
        ):
            load_field(tmp_path / name)
    np.savez_compressed(
        tmp_path / "zeros.npz", values=np.zeros((64, 64, 64)), origin=np.zeros(3), spacing=0.1
    )
    np.save(tmp_path / "zeros.npy", np.zeros((64, 64, 64)))
    assert (tmp_path / "zeros.npz").stat().st_size < 5000
    monkeypatch.setattr(archive_module, "memory_limit", lambda: 1 << 20)
    for name in ("zeros.npy", "zeros.npz"):
        with pytest.raises(ValueError, match=r"takes 2 MiB; the arrays of a file may take 1 MiB"):
            load_field(tmp_path / name)


def test_all_arrays_of_a_file_count(tmp_path, monkeypatch):
    path = tmp_path / "run.npz"
    archive_module.write_archive(path, {f"a{i}": np.zeros(1000) for i in range(10)})
    monkeypatch.setattr(archive_module, "memory_limit", lambda: 50_000)
    with open(path, "rb") as file:
        arrays = archive_module.Arrays(file)
        with pytest.raises(ValueError, match="a6 of shape"):
            for name in arrays.names:
                assert arrays[name].shape == (1000,)


def test_voxels_without_spacing_are_said(tmp_path):
    """Their longest side is a metre: whoever gives a spacing, or the object's length, is told nothing."""
    path = tmp_path / "voxels.npy"
    values = np.zeros((12, 12, 12), bool)
    values[3:9, 3:9, 3:9] = True
    np.save(path, values)
    with pytest.warns(UserWarning, match="the longest side of the grid is taken as 1 m; give spacing"):
        assert np.ptp(np.asarray(load_field(path).bounds), axis=0).max() == pytest.approx(1, rel=0.2)
    assert load_field(path, spacing=0.01).bounds is not None
    options = BuildOptions(samples=200, resolution=24, length=0.1, mass=1.0)
    assert object_of_file(path, options).size == pytest.approx(0.1, rel=0.02)
