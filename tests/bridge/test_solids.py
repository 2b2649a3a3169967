"""Distances to MuJoCo's geoms, against our shapes and against MuJoCo's rays."""

import jax
import mujoco
import numpy as np
import pytest
from bridge.kernels import distances, geom_part
from bridge.supports import SUPPORTS, TYPES

from dano import Box, Capsule, Cylinder, Sphere
from dano.fields import Ellipsoid
from dano.mujoco._things import surface_of

HALF = np.array([0.3, 0.2, 0.1])
CASES = {
    "sphere": (TYPES.mjGEOM_SPHERE, [0.2, 0, 0], Sphere(0.2)),
    "capsule": (TYPES.mjGEOM_CAPSULE, [0.1, 0.2, 0], Capsule(0.1, 0.2)),
    "cylinder": (TYPES.mjGEOM_CYLINDER, [0.2, 0.1, 0], Cylinder(0.2, 0.1)),
    "box": (TYPES.mjGEOM_BOX, HALF, Box(HALF)),
    "ellipsoid": (TYPES.mjGEOM_ELLIPSOID, HALF, Ellipsoid(HALF)),
}
POINTS = np.random.default_rng(3).uniform(-0.5, 0.5, (400, 3))


def model_with(**geom):
    spec = geom.pop("spec", None) or mujoco.MjSpec()
    spec.worldbody.add_geom(**geom)
    return spec.compile()


def asked(name: str, points):
    kind, size, _ = CASES[name]
    model = model_with(type=kind, size=size)
    return distances(model, geom_part(model), points)


@pytest.mark.parametrize("name", CASES)
def test_distances_and_normals_are_those_of_our_shapes(name: str):
    shape = CASES[name][2]
    found, normals, bounds = asked(name, POINTS)
    expected = np.asarray(jax.vmap(shape.sdf)(POINTS))
    # Our ellipsoid is exact near its surface only.
    near = np.abs(expected) < 0.02 if name == "ellipsoid" else np.ones(len(POINTS), bool)
    np.testing.assert_allclose(found[near], expected[near], atol=1e-4 if name == "ellipsoid" else 1e-12)
    outside = found > 0
    assert np.all(bounds[outside] <= found[outside] + 1e-12)
    assert np.all(bounds[~outside] <= 0)
    # A step of 10 µm along the normal changes the distance by as much.
    further = asked(name, POINTS + 1e-5 * normals)[0]
    np.testing.assert_allclose(further - found, 1e-5, rtol=1e-6, atol=1e-9)


def test_an_ellipsoids_closest_point_is_closest():
    found, _, _ = asked("ellipsoid", POINTS)
    directions = np.random.default_rng(0).normal(size=(40000, 3))
    surface = HALF * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    brute = [np.linalg.norm(surface - x, axis=1).min() for x in POINTS[:40]]
    np.testing.assert_allclose(np.abs(found[:40]), brute, atol=1e-3)


def test_the_hull_of_a_boxs_corners_is_the_box():
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * HALF
    spec = mujoco.MjSpec()
    spec.add_mesh(name="block", uservert=corners.ravel().tolist())
    model = model_with(spec=spec, type=TYPES.mjGEOM_MESH, meshname="block")
    part = geom_part(model)
    assert part.surface is not None
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[0])
    inside = np.random.default_rng(1).uniform(-1, 1, (200, 3)) * HALF
    own = (inside - model.geom_pos[0]) @ turn.reshape(3, 3)
    np.testing.assert_allclose(distances(model, part, own)[0], asked("box", inside)[0], atol=1e-7)
    # Its samples carry the areas of its faces, and lie on them.
    areas = np.abs(part.surface.vectors @ turn.reshape(3, 3).T).sum(axis=0)
    np.testing.assert_allclose(areas, 8 * HALF[[1, 2, 0]] * HALF[[2, 0, 1]], rtol=1e-5)
    np.testing.assert_allclose(distances(model, part, part.surface.points)[0], 0, atol=1e-7)
    np.testing.assert_allclose(part.solid.thickness, HALF.min(), rtol=1e-6)


def test_heights_are_where_mujocos_rays_meet_the_field():
    spec = mujoco.MjSpec()
    model = model_with(spec=spec, **SUPPORTS["height field"](spec))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    part, geom = geom_part(model), np.zeros(1, np.int32)
    for x, y in np.random.default_rng(2).uniform(-0.25, 0.25, (50, 2)):
        start = np.array([x, y, 1.0])
        height = 1.0 - mujoco.mj_ray(model, data, start, np.array([0, 0, -1.0]), None, 1, -1, geom)
        found, normal, _ = distances(model, part, np.array([[x, y, height], [x, y, height - 0.01]]))
        # Rays cut the cells along the other diagonal than contact does.
        assert abs(found[0]) < 3e-4
        assert found[1] == pytest.approx(-0.01 * normal[1, 2], abs=3e-4)
    assert distances(model, part, np.array([[0.4, 0.0, 0.0]]))[0][0] > 1e100


def test_samples_are_ordered_compactly_and_preceded_evenly():
    random = np.random.default_rng(5)
    points = random.normal(size=(1000, 3))
    surface = surface_of(points, points)

    def farthest(chosen):
        """How far samples are from the nearest that is chosen, on average."""
        way = np.linalg.norm(surface.points[:, None] - surface.points[chosen], axis=2)
        return way.min(axis=1).mean()

    order = np.argsort(-surface.precedence)
    ranks = len(order) / surface.precedence[order] ** 2
    np.testing.assert_allclose(ranks, 1 + np.arange(len(order)))
    for n in (8, 16, 32, 64, 128):
        others = [farthest(random.choice(len(order), n, replace=False)) for _ in range(20)]
        assert farthest(order[:n]) < np.mean(others)
    # Runs of samples are compact.
    parts = [surface.points[k : k + 128] for k in range(0, len(order), 128)]
    assert np.mean([np.var(part, axis=0).sum() for part in parts]) < 0.5 * np.var(points, axis=0).sum()
    for k, (x, y, z, radius) in enumerate(surface.balls):
        own = surface.points[16 * k : 16 * k + 16]
        assert np.linalg.norm(own - [x, y, z], axis=1).max() <= radius + 1e-12
    for k, (x, y, z, radius) in enumerate(surface.runs):
        own = surface.points[128 * k : 128 * k + 128]
        assert np.linalg.norm(own - [x, y, z], axis=1).max() <= radius + 1e-12
