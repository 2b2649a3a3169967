"""Distances to MuJoCo's geoms, against our shapes and against MuJoCo's rays."""

import jax
import mujoco
import numpy as np
import pytest
from bridge.supports import SUPPORTS

from dano import Box, Capsule, Cylinder, Sphere
from dano.fields import Ellipsoid
from dano.mujoco import _solids as solids

HALF = np.array([0.3, 0.2, 0.1])
CASES = {
    "sphere": (solids.sphere(0.2), Sphere(0.2)),
    "capsule": (solids.capsule(0.1, 0.2), Capsule(0.1, 0.2)),
    "cylinder": (solids.cylinder(0.2, 0.1), Cylinder(0.2, 0.1)),
    "box": (solids.box(HALF), Box(HALF)),
    "ellipsoid": (solids.ellipsoid(HALF), Ellipsoid(HALF)),
}
POINTS = np.random.default_rng(3).uniform(-0.5, 0.5, (400, 3))


@pytest.mark.parametrize("name", CASES)
def test_distances_and_normals_are_those_of_our_shapes(name: str):
    solid, shape = CASES[name]
    distances, normals = solid.jet(POINTS)
    expected = np.asarray(jax.vmap(shape.sdf)(POINTS))
    # Our ellipsoid is exact near its surface only.
    near = np.abs(expected) < 0.02 if name == "ellipsoid" else np.ones(len(POINTS), bool)
    np.testing.assert_allclose(distances[near], expected[near], atol=1e-4 if name == "ellipsoid" else 1e-12)
    outside = distances > 0
    assert np.all(solid.bound(POINTS)[outside] <= distances[outside] + 1e-12)
    assert np.all(solid.bound(POINTS)[~outside] <= 0)
    # A step of 10 µm along the normal changes the distance by as much.
    further = solid.jet(POINTS + 1e-5 * normals)[0]
    np.testing.assert_allclose(further - distances, 1e-5, rtol=1e-6, atol=1e-9)


def test_an_ellipsoids_closest_point_is_closest():
    distances, _ = CASES["ellipsoid"][0].jet(POINTS)
    directions = np.random.default_rng(0).normal(size=(40000, 3))
    surface = HALF * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    brute = [np.linalg.norm(surface - x, axis=1).min() for x in POINTS[:40]]
    np.testing.assert_allclose(np.abs(distances[:40]), brute, atol=1e-3)


def test_the_hull_of_a_boxs_corners_is_the_box():
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * HALF
    inside = np.random.default_rng(1).uniform(-1, 1, (200, 3)) * HALF
    np.testing.assert_allclose(
        solids.hull(corners).jet(inside)[0], CASES["box"][0].jet(inside)[0], atol=1e-12
    )
    with pytest.raises(ValueError, match="lie in a plane"):
        solids.hull(corners * [1, 1, 0])


def test_heights_are_where_mujocos_rays_meet_the_field():
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(**SUPPORTS["height field"](spec))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    solid = solids.geom_solid(mujoco, model, 0)
    geom = np.zeros(1, np.int32)
    for x, y in np.random.default_rng(2).uniform(-0.25, 0.25, (50, 2)):
        start = np.array([x, y, 1.0])
        height = 1.0 - mujoco.mj_ray(model, data, start, np.array([0, 0, -1.0]), None, 1, -1, geom)
        distance, normal = solid.jet(np.array([[x, y, height], [x, y, height - 0.01]]))
        # Rays cut the cells along the other diagonal than contact does.
        assert abs(distance[0]) < 3e-4
        assert distance[1] == pytest.approx(-0.01 * normal[1, 2], abs=3e-4)
    assert np.isinf(solid.jet(np.array([[0.4, 0.0, 0.0]]))[0])


def test_a_grid_is_trilinear_and_ends():
    x = np.linspace(-1, 1, 11)
    plane = 0.3 * x[:, None, None] - 0.5 * x[None, :, None] + 0.2 * x[None, None] + np.zeros((11, 11, 11))
    solid = solids.grid(plane, np.full(3, -1.0), np.full(3, 0.2))
    distances, normals = solid.jet(2 * POINTS)
    slope = np.array([0.3, -0.5, 0.2])
    np.testing.assert_allclose(distances, 2 * POINTS @ slope, atol=1e-12)
    np.testing.assert_allclose(
        normals, np.broadcast_to(slope / np.linalg.norm(slope), normals.shape), atol=1e-12
    )
    assert np.isinf(solid.jet(np.array([[1.1, 0, 0]]))[0][0])
