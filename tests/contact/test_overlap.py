"""Overlap ψ, χ, n and its derivatives, against closed forms, brute force and differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.contact import SampleSet, Support
from dano.fields import PosedShape
from dano.maths import quat_from_axis_angle, quat_multiply


def cube_samples(n=24, half=0.5):
    """Midpoint quadrature of a uniform cube: exact for what is linear in a cell."""
    axis = (np.arange(n) + 0.5) / n * 2 * half - half
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    return SampleSet.create(points, np.ones(len(points)))


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


def collider(field, samples=None, *, pose=None, support=True, **options):
    given = SampleSet.create(*samples) if samples is not None else None
    culling = Support.create(field) if support and isinstance(field, dano.GridField) else None
    return dano.Collider(field, given, support=culling, pose=pose, **options)


def test_cube_in_half_space():
    """A unit cube sunk by a quarter, face down: ψ = m/4 and χ at half that depth."""
    cube = dano.Collider(None, cube_samples(), mass=2.0, pose=dano.Pose((0.1, -0.2, 0.25)))
    patch = dano.overlap(cube, dano.Collider(dano.HalfSpace(edge=0.02)))
    assert patch.overlap == pytest.approx(2.0 * 0.25, rel=1e-9)
    np.testing.assert_allclose(patch.centroid, [0.1, -0.2, -0.125], atol=1e-9)
    np.testing.assert_allclose(patch.normal, [0, 0, 1])


def test_cube_in_sphere_and_box():
    """A cube that swallows a small shape overlaps it by the shape's volume, centred on it."""
    cube = dano.Collider(None, cube_samples(48), mass=1.0)
    place = dano.Pose((0.1, 0.05, -0.1), (1.0, 0.3, 0.2, 0.1))
    lying = dano.Pose((0.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0))
    shapes = [
        (dano.Sphere(0.2), 4 / 3 * np.pi * 0.2**3),
        (dano.Box((0.2, 0.15, 0.1)), 8 * 0.2 * 0.15 * 0.1),
        (dano.posed(dano.Cylinder(0.15, 0.2), lying), np.pi * 0.15**2 * 0.4),
    ]
    for shape, volume in shapes:
        patch = dano.overlap(cube, dano.Collider(shape, pose=place))
        assert patch.overlap == pytest.approx(volume, rel=0.02)
        np.testing.assert_allclose(patch.centroid, place.position, atol=2e-3)


def test_tilted_half_space_and_pose_agree():
    """A half-space tilted by its normal, by its body's pose, and by `posed` are the same plane."""
    rng = np.random.default_rng(3)
    samples = SampleSet.create(rng.uniform(-0.5, 0.5, (500, 3)), rng.uniform(0.1, 1, 500))
    cube = dano.Collider(None, samples, pose=dano.Pose((0.2, 0.1, 0.3), (1.0, 0.2, -0.4, 0.3)))
    turn = quat_from_axis_angle((0.0, 1.0, 0.0), 0.5)
    normal = (np.sin(0.5), 0.0, np.cos(0.5))
    planes = [
        dano.Collider(dano.HalfSpace(normal, 0.1, edge=0.05)),
        dano.Collider(dano.HalfSpace(edge=0.05), pose=dano.Pose(0.1 * np.array(normal), turn)),
        dano.Collider(dano.posed(dano.HalfSpace(edge=0.05), dano.Pose(0.1 * np.array(normal), turn))),
    ]
    first, *others = [dano.overlap(cube, plane) for plane in planes]
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
    ball = dano.Collider(dano.Sphere(radius), mass=3.0, pose=dano.Pose((1.0, 2.0, height)))
    floor = dano.Collider(dano.HalfSpace())
    patch, flipped = dano.overlap(ball, floor), dano.overlap(floor, ball)
    assert patch.overlap == pytest.approx(3.0 * share, rel=1e-4)
    np.testing.assert_allclose(patch.centroid, [1.0, 2.0, height + middle], atol=1e-4)
    np.testing.assert_allclose(patch.normal, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(flipped.normal, [0, 0, -1], atol=1e-12)


def brute_force(pair, pose_a, pose_b, mass_a, mass_b):
    """The union sum written out over all samples with plain loops over the two sides."""
    a, b, samples_a, samples_b = pair
    psi, first, normal = 0.0, np.zeros(3), np.zeros(3)
    for (x, phi), own, other, field, mass, sign in (
        (samples_a, pose_a, pose_b, b, mass_a, 1),
        (samples_b, pose_b, pose_a, a, mass_b, -1),
    ):
        weight = mass * phi / phi.sum()
        world = np.asarray(own.apply(jnp.asarray(x)))
        local = other.inverse().apply(jnp.asarray(world))
        density, gradient = (np.asarray(g) for g in jax.vmap(jax.value_and_grad(field.density))(local))
        psi += (weight * density).sum()
        first += ((weight * density)[:, None] * world).sum(0)
        normal -= sign * np.asarray(other.matrix) @ ((weight * density)[:, None] * gradient).sum(0)
    return psi, first / psi, normal / np.linalg.norm(normal)


@pytest.fixture(scope="module")
def pair():
    a, b = blob(seed=0), blob(seed=5)
    return a, b, random_samples(a), random_samples(b, seed=2)


def posed_pair(pair, pose_a, pose_b, support=True):
    a, b, samples_a, samples_b = pair
    return (
        collider(a, samples_a, pose=pose_a, mass=2.0, support=support),
        collider(b, samples_b, pose=pose_b, mass=3.0, support=support),
    )


POSES = [((0.0, 0.0, 0.0), (0.35, 0.1, 0.05)), ((0.1, 0.2, 0.0), (-0.1, 0.1, 0.3))]


@pytest.mark.parametrize("centers", POSES)
def test_neural_pair_against_brute_force(pair, centers):
    pose_a = dano.Pose(centers[0], (1.0, 0.1, 0.2, 0.3))
    pose_b = dano.Pose(centers[1], (0.5, -0.3, 0.2, 0.6))
    a, b = posed_pair(pair, pose_a, pose_b)
    patch = dano.overlap(a, b)
    psi, centroid, normal = brute_force(pair, pose_a, pose_b, 2.0, 3.0)
    assert patch.overlap == pytest.approx(psi, rel=1e-10)
    np.testing.assert_allclose(patch.centroid, centroid, atol=1e-10)
    np.testing.assert_allclose(patch.normal, normal, atol=1e-9)

    swapped = dano.overlap(b, a)
    np.testing.assert_allclose(swapped.overlap, patch.overlap, rtol=1e-12)
    np.testing.assert_allclose(swapped.centroid, patch.centroid, atol=1e-12)
    np.testing.assert_allclose(swapped.normal, -patch.normal, atol=1e-12)

    dense = dano.overlap(*posed_pair(pair, pose_a, pose_b, support=False))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-10), patch, dense)


def test_patch_moves_with_the_world(pair):
    """Moving both bodies rigidly moves the patch with them."""
    pose_a, pose_b = dano.Pose((0.0, 0.0, 0.0)), dano.Pose((0.3, 0.1, 0.0), (1.0, 0.0, 0.5, 0.0))
    move = dano.Pose((3.0, -1.0, 2.0), (0.3, 0.5, -0.7, 0.2))
    patch = dano.overlap(*posed_pair(pair, pose_a, pose_b))
    moved = dano.overlap(*posed_pair(pair, move @ pose_a, move @ pose_b))
    np.testing.assert_allclose(moved.overlap, patch.overlap, rtol=1e-10)
    np.testing.assert_allclose(moved.centroid, move.apply(patch.centroid), atol=1e-10)
    np.testing.assert_allclose(moved.normal, move.matrix @ patch.normal, atol=1e-10)


def apart_cases(pair):
    a, b, samples_a, samples_b = pair
    return {
        "half-space": dano.Collider(dano.HalfSpace(edge=0.05)),
        "sphere": dano.Collider(dano.Sphere(0.3, edge=0.05)),
        "rounded box": dano.Collider(dano.Box((0.3, 0.2, 0.2), rounding=0.05, edge=0.05)),
        "grid, culled": collider(b, samples_b, mass=3.0),
        "grid, every sample": collider(b, samples_b, mass=3.0, support=False),
    }


# One shape and one grid say whether a change broke derivatives; the others compile as long again.
KINDS = [
    "half-space",
    pytest.param("sphere", marks=pytest.mark.slow),
    pytest.param("rounded box", marks=pytest.mark.slow),
    "grid, culled",
    pytest.param("grid, every sample", marks=pytest.mark.slow),
]


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_with_respect_to_both_poses(pair, kind):
    """Forward = reverse = central differences for ψ, χ and n, moving either body."""
    other = apart_cases(pair)[kind]
    samples, support = SampleSet.create(*pair[2]), Support.create(pair[0])
    weights = jnp.asarray(np.random.default_rng(7).normal(size=7))

    def value(change):
        turn = [
            jnp.concatenate([jnp.ones(1), 0.5 * change[3:6]]),
            jnp.concatenate([jnp.ones(1), 0.5 * change[9:]]),
        ]
        pose_a = dano.Pose(jnp.array([0.1, 0.05, 0.28]) + change[:3], turn[0])
        pose_b = dano.Pose(change[6:9], quat_multiply(jnp.array([0.9, 0.1, 0.3, 0.1]), turn[1]))
        a = dano.Collider(pair[0], samples, support=support, mass=2.0, pose=pose_a)
        b = dano.Collider(other.field, other.samples, support=other.support, mass=other.mass, pose=pose_b)
        patch = dano.overlap(a, b)
        return jnp.dot(weights, jnp.concatenate([patch.overlap[None], patch.centroid, patch.normal]))

    zero = jnp.zeros(12)
    forward, reverse = jax.jit(jax.jacfwd(value))(zero), jax.jit(jax.grad(value))(zero)
    np.testing.assert_allclose(forward, reverse, atol=1e-10)
    compiled = jax.jit(value)
    step = 1e-6
    differences = [(compiled(zero + step * e) - compiled(zero - step * e)) / (2 * step) for e in np.eye(12)]
    np.testing.assert_allclose(forward, differences, rtol=1e-5, atol=1e-6)
    assert np.abs(forward).max() > 0.1


@pytest.mark.parametrize(
    "shape",
    [
        dano.Sphere(0.2, edge=0.0),
        dano.Box((0.25, 0.1, 0.15), edge=0.1),
        dano.Capsule(0.1, 0.2),
        dano.Cylinder(0.15, 0.1, edge=0.02),
        PosedShape(dano.Box((0.3, 0.05, 0.1)), dano.Pose((0.1, 0.0, 0.0), (0.9, 0.2, 0.1, 0.3))),
    ],
    ids=lambda shape: type(shape).__name__,
)
def test_no_sample_that_a_shape_reaches_is_skipped(shape):
    """Sums over some blocks are those over all samples, wherever the shape is."""
    points = np.random.default_rng(3).uniform(-0.5, 0.5, (4000, 3))
    density = np.random.default_rng(4).uniform(0.1, 1.0, 4000)
    samples = SampleSet.create(points, density)
    weights = density / density.sum()
    for place in np.random.default_rng(5).uniform(-0.7, 0.7, (12, 3)):
        pose = dano.Pose(place, (0.3, 0.5, -0.7, 0.2))
        patch = dano.overlap(dano.Collider(None, samples, mass=2.0), dano.Collider(shape, pose=pose))
        local = (points - place) @ np.asarray(pose.matrix)
        mass = 2.0 * weights * np.asarray(jax.vmap(shape.density)(jnp.asarray(local)))
        assert float(patch.overlap) == pytest.approx(mass.sum(), rel=1e-12, abs=1e-15)
        if mass.sum() > 0:
            np.testing.assert_allclose(patch.centroid, mass @ points / mass.sum(), atol=1e-12)


def test_derivative_with_respect_to_a_radius():
    """A field's own parameters carry gradients too."""
    samples = cube_samples(12)

    def psi(radius):
        return dano.overlap(
            dano.Collider(None, samples), dano.Collider(dano.Sphere(radius, edge=0.1))
        ).overlap

    expected = (psi(0.3 + 1e-6) - psi(0.3 - 1e-6)) / 2e-6
    assert jax.jit(jax.grad(psi))(0.3) == pytest.approx(float(expected), rel=1e-6)
    assert jax.jit(jax.jacfwd(psi))(0.3) == pytest.approx(float(expected), rel=1e-6)


@pytest.mark.parametrize("kind", ["half-space", "sphere", "grid, culled"])
def test_derivative_with_respect_to_grid_and_samples(pair, kind):
    """What few perturb, a grid's values and the samples themselves, is not silently constant."""
    other, grid = apart_cases(pair)[kind], pair[1]
    given = SampleSet.create(*pair[2])
    mine = dano.Collider(None, given, pose=dano.Pose((0.1, 0.05, 0.28)), mass=2.0)

    def psi(change):
        moved = given.points.at[0].add(change[0]), given.weights * (1 + change[1])
        samples = eqx.tree_at(lambda s: (s.points, s.weights), given, moved)
        them = other
        if kind == "grid, culled":
            denser = eqx.tree_at(lambda f: f.coefficients, grid, grid.coefficients * (1 + change[2]))
            them = eqx.tree_at(lambda c: c.field, other, denser)
        return dano.overlap(eqx.tree_at(lambda c: c.samples, mine, samples), them).overlap

    zero, value = jnp.zeros(3), jax.jit(psi)
    forward, reverse = jax.jit(jax.jacfwd(psi))(zero), jax.jit(jax.grad(psi))(zero)
    differences = [(value(zero + 1e-6 * e) - value(zero - 1e-6 * e)) / 2e-6 for e in np.eye(3)]
    np.testing.assert_allclose(forward, reverse, atol=1e-10)
    np.testing.assert_allclose(forward, differences, rtol=1e-5, atol=1e-8)
    assert abs(float(forward[1])) > 1e-3


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_when_apart(pair, kind):
    """Far apart: zero patch, and derivatives that are zero rather than NaN."""
    other, samples = apart_cases(pair)[kind], SampleSet.create(*pair[2])

    def flat(height):
        a = dano.Collider(pair[0], samples, pose=dano.Pose(jnp.array([0.0, 0.0, 1.0]) * height))
        patch = dano.overlap(a, other)
        return jnp.concatenate([patch.overlap[None], patch.centroid, patch.normal])

    assert not np.any(flat(5.0))
    assert not np.any(jax.jit(jax.jacfwd(flat))(5.0))
    assert not np.any(jax.jit(jax.jacrev(flat))(5.0))


def test_nothing_to_test_is_an_error():
    with pytest.raises(ValueError, match="samples on one side"):
        dano.overlap(dano.Collider(dano.Sphere(1.0)), dano.Collider(dano.Sphere(1.0)))
