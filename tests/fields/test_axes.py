"""Which way is up in files of meshes."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.fields import SignedDistanceGrid

trimesh = pytest.importorskip("trimesh")


def can(along: str):
    mesh = trimesh.creation.cylinder(0.03, 0.2)
    if along == "y":
        mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    return mesh


def bell(along: str):
    """A thing that stands on one flat side: half a ball."""
    mesh = trimesh.creation.icosphere(3, 0.1)
    mesh.vertices = np.maximum(mesh.vertices, [-1.0, -1.0, 0.0])
    if along == "y":
        mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    return mesh


def sizes(field: SignedDistanceGrid) -> np.ndarray:
    return np.ptp(np.asarray(field.bounds), axis=0)


def test_gltf_has_y_up_and_is_turned(tmp_path):
    path = tmp_path / "can.glb"
    can("y").export(path)
    with pytest.warns(UserWarning, match="y is up in glTF"):
        field = dano.mesh_field(path, 32)
    np.testing.assert_allclose(sizes(field), [0.06, 0.06, 0.2], atol=1e-2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_allclose(sizes(dano.mesh_field(path, 32, up="z")), [0.06, 0.2, 0.06], atol=1e-2)
        turned = dano.load_field(path, up="y", resolution=32)
        assert isinstance(turned, SignedDistanceGrid)
        np.testing.assert_allclose(sizes(turned), [0.06, 0.06, 0.2], atol=1e-2)


def test_what_is_up_stays_above(tmp_path):
    """The round side of half a ball that stands along y is above after it is turned."""
    path = tmp_path / "bell.glb"
    bell("y").export(path)
    with pytest.warns(UserWarning, match="y is up"):
        field = dano.mesh_field(path, 32)
    assert float(field.sdf(jnp.array([0.0, 0.0, 0.09]))) < 0 < float(field.sdf(jnp.array([0.0, 0.0, -0.05])))


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".ply"])
def test_files_without_axes_are_asked_for_where_they_stand_along_y(tmp_path, suffix: str):
    bell("y").export(tmp_path / f"lies{suffix}")
    bell("z").export(tmp_path / f"stands{suffix}")
    can("z").export(tmp_path / f"can{suffix}")
    with pytest.warns(UserWarning, match=r"up='y' \(--up y\)"):
        dano.mesh_field(tmp_path / f"lies{suffix}", 32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name, up in (("lies", "y"), ("lies", "z"), ("stands", None), ("can", None)):
            dano.mesh_field(tmp_path / f"{name}{suffix}", 32, up=up)


def test_unknown_axes_are_refused(tmp_path):
    with pytest.raises(ValueError, match="up must be one of"):
        dano.mesh_field(can("z"), 32, up="sideways")
