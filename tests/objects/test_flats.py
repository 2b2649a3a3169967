"""Flat regions of neural objects: their samples lie on a plane, and they rub as flat bodies do."""

import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano import Pose, posed, union

FRICTION, HALF = 0.3, 0.01


def built(shape, n, resolution=96):
    return dano.NeuralObject.from_field(
        shape, mass=1.0, n_samples=n, resolution=resolution, mass_model="solid"
    )


def slowing(body):
    """Deceleration [rad/s²] of a plate that spins flat on a floor."""
    params = dano.ContactParams(sliding_friction=FRICTION)
    bodies = [dano.Body("plate", body), dano.Body("floor", dano.HalfSpace(), fixed=True)]
    scene = dano.Scene.create(bodies, [dano.Contact("plate", "floor", params)], timestep=0.002)
    start = scene.initial_state(plate=dict(position=(0, 0, HALF), omega=(0, 0, 20.0)))
    run = dano.simulate(scene, start, 110)
    assert bool(run.converged.all())
    spin = np.asarray(run.states.omega[:, 0, 2])
    return (spin[20] - spin[100]) / 0.16


def expected(inside, extent):
    """μ g ∫r dA / ∫r² dA of a plate of even thickness, about its centre, on a grid of cells."""
    cells = np.linspace(-extent, extent, 1201)
    x, y = np.meshgrid(*(0.5 * (cells[1:] + cells[:-1]),) * 2, indexing="ij")
    x, y = x[inside(x, y)], y[inside(x, y)]
    r = np.hypot(x - x.mean(), y - y.mean())
    return FRICTION * 9.81 * r.mean() / (r * r).mean()


def in_l(x, y):
    return ((np.abs(x) < 0.08) & (np.abs(y) < 0.03)) | ((np.abs(x + 0.05) < 0.03) & (np.abs(y - 0.05) < 0.08))


@pytest.mark.parametrize(
    "n", [500, pytest.param(4000, marks=pytest.mark.slow), pytest.param(16000, marks=pytest.mark.slow)]
)
def test_disc_that_spins_flat(n):
    radius = 0.1
    assert slowing(built(dano.Cylinder(radius, HALF), n)) == pytest.approx(
        4 * FRICTION * 9.81 / (3 * radius), rel=0.01
    )


@pytest.mark.slow
@pytest.mark.parametrize("n", [500, 4000])
def test_plates_that_spin_flat(n):
    square = dano.Box((0.08, 0.08, HALF))
    right = expected(lambda x, y: (np.abs(x) < 0.08) & (np.abs(y) < 0.08), 0.1)
    assert slowing(built(square, n)) == pytest.approx(right, rel=0.02)
    arm = posed(dano.Box((0.03, 0.08, HALF)), Pose((-0.05, 0.05, 0)))
    shape = union(dano.Box((0.08, 0.03, HALF)), arm)
    assert slowing(built(shape, n)) == pytest.approx(expected(in_l, 0.14), rel=0.02)


def test_faces_of_a_box_askew_are_planes():
    half = np.array([0.05, 0.04, 0.03])
    turn = np.array([0.9, 0.2, -0.3, 0.25])
    turn = turn / np.linalg.norm(turn)
    surface = built(posed(dano.Box(half), Pose((0, 0, 0), turn)), 600, 48).surface
    R = np.asarray(Pose((0, 0, 0), turn).apply(jnp.eye(3))).T
    own = np.asarray(surface.points) @ R
    cell = 2 * np.abs(R @ half).max() / 48
    for axis in range(3):
        for side in (-1, 1):
            face = side * own[:, axis] > half[axis] - 0.3 * cell
            inner = np.all(np.abs(np.delete(own, axis, 1)) < np.delete(half, axis) - 2 * cell, axis=1) & face
            points = own[inner]
            middle = points.mean(axis=0)
            normal = np.linalg.svd(points - middle)[2][2]
            assert np.abs((points - middle) @ normal).max() < 1e-9
            assert abs(normal[axis]) > np.cos(np.radians(0.2))
            assert middle[axis] == pytest.approx(side * half[axis], abs=0.05 * cell)


def test_round_bodies_stay_as_they_are():
    ball = built(dano.Sphere(0.05), 800, 48).surface
    radii = np.linalg.norm(np.asarray(ball.points), axis=1)
    assert radii.std() < 1e-5
