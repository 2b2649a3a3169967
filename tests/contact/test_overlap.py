"""Overlap ψ, χ, n of two bodies, against closed forms and sums over all samples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kernels.overlaps import overlaps, pairs_of, Side, summed

import dano
from dano.engine.launching._patch_tables import patch_tables
from dano.maths import quat_from_axis_angle


def cube_samples(n=24, half=0.5):
    """Midpoint quadrature of a uniform cube: exact for what is linear in a cell."""
    axis = (np.arange(n) + 0.5) / n * 2 * half - half
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    return points, np.ones(len(points))


def blob(center=(0.0, 0.0, 0.0), width=0.12, n=24, half=0.5, seed=0):
    """A lumpy density on a grid, zero near the grid's border."""
    axis = np.linspace(-half, half, n)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1) - np.asarray(center)
    bumps = np.random.default_rng(seed).uniform(-0.15, 0.15, (4, 3))
    values = sum(np.exp(-((x - c) ** 2).sum(-1) / (2 * width**2)) for c in bumps)
    return dano.GridField(np.maximum(values - 0.05, 0), (-half,) * 3, axis[1] - axis[0])


def random_samples(field, n=700, seed=1):
    x = np.random.default_rng(seed).uniform(-0.4, 0.4, (n, 3))
    phi = np.asarray(jax.vmap(field.density)(jnp.asarray(x)))
    return x[phi > 0], phi[phi > 0]


def test_cube_in_half_space():
    """A unit cube sunk by a quarter, face down: ψ = m/4 and χ at half that depth."""
    cube = Side(None, cube_samples(), dano.Pose((0.1, -0.2, 0.25)), mass=2.0)
    (patch,) = overlaps((cube, Side(dano.HalfSpace(edge=0.02))))
    assert patch.overlap == pytest.approx(2.0 * 0.25, rel=1e-9)
    np.testing.assert_allclose(patch.centroid, [0.1, -0.2, -0.125], atol=1e-9)
    np.testing.assert_allclose(patch.normal, [0, 0, 1])


def test_cube_in_sphere_and_box():
    """A cube that swallows a small shape overlaps it by the shape's volume, centred on it."""
    cube = Side(None, cube_samples(48))
    place = dano.Pose((0.1, 0.05, -0.1), (1.0, 0.3, 0.2, 0.1))
    lying = dano.Pose((0.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0))
    shapes = [
        (dano.Sphere(0.2), 4 / 3 * np.pi * 0.2**3),
        (dano.Box((0.2, 0.15, 0.1)), 8 * 0.2 * 0.15 * 0.1),
        (dano.posed(dano.Cylinder(0.15, 0.2), lying), np.pi * 0.15**2 * 0.4),
    ]
    found = overlaps(*((cube, Side(shape, pose=place)) for shape, _ in shapes))
    for patch, (_, volume) in zip(found, shapes, strict=True):
        assert patch.overlap == pytest.approx(volume, rel=0.02)
        np.testing.assert_allclose(patch.centroid, place.position, atol=2e-3)


def test_tilted_half_space_and_pose_agree():
    """A half-space tilted by its normal, by its body's pose, and by `posed` are the same plane."""
    rng = np.random.default_rng(3)
    samples = rng.uniform(-0.5, 0.5, (500, 3)), rng.uniform(0.1, 1, 500)
    cube = Side(None, samples, dano.Pose((0.2, 0.1, 0.3), (1.0, 0.2, -0.4, 0.3)))
    turn = quat_from_axis_angle((0.0, 1.0, 0.0), 0.5)
    normal = (np.sin(0.5), 0.0, np.cos(0.5))
    moved = dano.Pose(0.1 * np.array(normal), turn)
    planes = [
        Side(dano.HalfSpace(normal, 0.1, edge=0.05)),
        Side(dano.HalfSpace(edge=0.05), pose=moved),
        Side(dano.posed(dano.HalfSpace(edge=0.05), moved)),
    ]
    first, *others = overlaps(*((cube, plane) for plane in planes))
    assert first.overlap > 0.05
    for other in others:
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), first, other)


def test_ball_on_plane_against_quadrature():
    """Closed-form cap: share and centroid of the part of a ball below a plane."""
    radius, height = 0.4, 0.1
    z = np.linspace(-radius, radius, 40001)
    disc = np.pi * (radius**2 - z**2)
    below = z < -height
    share = disc[below].sum() / disc.sum()
    middle = (z[below] * disc[below]).sum() / disc[below].sum()
    ball, floor = Side(dano.Sphere(radius), None, dano.Pose((1.0, 2.0, height)), 3.0), Side(dano.HalfSpace())
    patch, flipped = overlaps((ball, floor), (floor, ball))
    assert patch.overlap == pytest.approx(3.0 * share, rel=1e-4)
    np.testing.assert_allclose(patch.centroid, [1.0, 2.0, height + middle], atol=1e-4)
    np.testing.assert_allclose(patch.normal, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(flipped.normal, [0, 0, -1], atol=1e-12)


@pytest.fixture(scope="module")
def pair():
    a, b = blob(seed=0), blob(seed=5)
    return [Side(a, random_samples(a), mass=2.0), Side(b, random_samples(b, seed=2), mass=3.0)]


def posed_pair(pair, *poses):
    return tuple(side._replace(pose=pose) for side, pose in zip(pair, poses, strict=True))


POSES = [((0.0, 0.0, 0.0), (0.35, 0.1, 0.05)), ((0.1, 0.2, 0.0), (-0.1, 0.1, 0.3))]


@pytest.mark.parametrize("centers", POSES)
def test_neural_pair_against_all_samples(pair, centers):
    pose_a = dano.Pose(centers[0], (1.0, 0.1, 0.2, 0.3))
    pose_b = dano.Pose(centers[1], (0.5, -0.3, 0.2, 0.6))
    a, b = posed_pair(pair, pose_a, pose_b)
    patch, swapped = overlaps((a, b), (b, a))
    expected = summed(a, b)
    assert patch.overlap == pytest.approx(float(expected.overlap), rel=1e-10)
    np.testing.assert_allclose(patch.centroid, expected.centroid, atol=1e-10)
    np.testing.assert_allclose(patch.normal, expected.normal, atol=1e-9)
    np.testing.assert_allclose(swapped.overlap, patch.overlap, rtol=1e-12)
    np.testing.assert_allclose(swapped.centroid, patch.centroid, atol=1e-12)
    np.testing.assert_allclose(swapped.normal, -patch.normal, atol=1e-12)


def test_patch_moves_with_the_world(pair):
    """Moving both bodies rigidly moves the patch with them."""
    pose_a, pose_b = dano.Pose((0.0, 0.0, 0.0)), dano.Pose((0.3, 0.1, 0.0), (1.0, 0.0, 0.5, 0.0))
    move = dano.Pose((3.0, -1.0, 2.0), (0.3, 0.5, -0.7, 0.2))
    patch, moved = overlaps(posed_pair(pair, pose_a, pose_b), posed_pair(pair, move @ pose_a, move @ pose_b))
    np.testing.assert_allclose(moved.overlap, patch.overlap, rtol=1e-10)
    np.testing.assert_allclose(moved.centroid, move.apply(patch.centroid), atol=1e-10)
    np.testing.assert_allclose(moved.normal, move.matrix @ patch.normal, atol=1e-10)


@pytest.mark.parametrize(
    "shape",
    [
        dano.Sphere(0.2, edge=0.0),
        dano.Box((0.25, 0.1, 0.15), edge=0.1),
        dano.Capsule(0.1, 0.2),
        dano.Cylinder(0.15, 0.1, edge=0.02),
        dano.posed(dano.Box((0.3, 0.05, 0.1)), dano.Pose((0.1, 0.0, 0.0), (0.9, 0.2, 0.1, 0.3))),
    ],
    ids=lambda shape: type(shape).__name__,
)
def test_no_sample_that_a_shape_reaches_is_skipped(shape):
    """Sums over some blocks are those over all samples, wherever the shape is."""
    points = np.random.default_rng(3).uniform(-0.5, 0.5, (4000, 3))
    density = np.random.default_rng(4).uniform(0.1, 1.0, 4000)
    weights = density / density.sum()
    own = Side(None, (points, density), mass=2.0)
    places = np.random.default_rng(5).uniform(-0.7, 0.7, (12, 3))
    poses = [dano.Pose(place, (0.3, 0.5, -0.7, 0.2)) for place in places]
    found = overlaps(*((own, Side(shape, pose=pose)) for pose in poses))
    for place, pose, patch in zip(places, poses, found, strict=True):
        local = (points - place) @ np.asarray(pose.matrix)
        mass = 2.0 * weights * np.asarray(jax.vmap(shape.density)(jnp.asarray(local)))
        assert float(patch.overlap) == pytest.approx(mass.sum(), rel=1e-12, abs=1e-15)
        if mass.sum() > 0:
            np.testing.assert_allclose(patch.centroid, mass @ points / mass.sum(), atol=1e-12)


def test_nothing_when_apart(pair):
    """Far apart: a patch of zeros."""
    own = pair[0]._replace(pose=dano.Pose((0.0, 0.0, 5.0)))
    others = [
        dano.HalfSpace(edge=0.05),
        dano.Sphere(0.3, edge=0.05),
        dano.Box((0.3, 0.2, 0.2), rounding=0.05),
    ]
    for patch in overlaps(*((own, other) for other in (*map(Side, others), pair[1]))):
        assert not np.any([patch.overlap, *patch.centroid, *patch.normal])


def test_nothing_to_test_is_an_error():
    with pytest.raises(ValueError, match="samples on one side"):
        patch_tables(pairs_of([(Side(dano.Sphere(1.0)), Side(dano.Sphere(1.0)))]), float)
