"""From a field to an object: samples, thresholds, mass models, floaters and hollow cores, files."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

import dano
from dano.objects import draw_contact_samples, field_size

N = 48
AXIS = np.linspace(-0.6, 0.6, N)
X = np.stack(np.meshgrid(AXIS, AXIS, AXIS, indexing="ij"), -1)


def soft_wall(distance, width=0.05):
    """Density that rises from 0 to 100 over a wall."""
    return 100 / (1 + np.exp(np.clip(distance / width * 6, -40, 40)))


def ball(center=(0.0, 0.0, 0.0), radius=0.4):
    return np.linalg.norm(X - np.asarray(center), axis=-1) - radius


def grid(values):
    return dano.GridField(np.where(values < 1e-3, 0, values), (-0.6,) * 3, AXIS[1] - AXIS[0])


@pytest.fixture(scope="module")
def solid_ball():
    return dano.NeuralObject.from_field(grid(soft_wall(ball())), n_samples=1500, resolution=48)


@pytest.fixture(scope="module")
def messy_ball():
    """The same ball as a NeRF would have it: hollow core, and a floater in a corner."""
    hollow = soft_wall(ball()) * (1 - soft_wall(ball(radius=0.2)) / 100)
    floater = soft_wall(ball((0.5, 0.5, 0.5), 0.05))
    return grid(hollow + floater)


def test_samples_lie_between_the_thresholds_on_the_surface(solid_ball):
    low, high = np.asarray(solid_ball.density_range)
    phi = np.asarray(solid_ball.samples.density)
    assert phi.min() >= low
    assert phi.max() <= high
    radius = np.linalg.norm(solid_ball.samples.points, axis=1)
    assert np.all(np.abs(radius - 0.4) < 0.05)
    assert len(np.unique(np.asarray(solid_ball.samples.points), axis=0)) == 1500


def test_size_of_a_field_is_that_of_its_object(solid_ball, messy_ball):
    assert field_size(grid(soft_wall(ball()))) == pytest.approx(0.8, rel=2e-3)
    assert solid_ball.size == pytest.approx(0.8, rel=0.02)
    # Without its floater, as the object; with it, out to the corner.
    surface = (50.0, 90.0)
    assert field_size(messy_ball, density_range=surface) == pytest.approx(0.8, rel=2e-3)
    assert field_size(messy_ball, density_range=surface, floaters=True) == pytest.approx(0.95, rel=5e-3)
    # A shape whose axes are turned against the lattice.
    half, angle = np.array([0.06, 0.04, 0.03]), 0.4
    pose = dano.Pose(jnp.zeros(3), jnp.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)]))
    turned = dano.posed(dano.Ellipsoid(half), pose)
    expected = 2 * np.hypot(half[0] * np.cos(angle), half[1] * np.sin(angle))
    assert field_size(turned) == pytest.approx(expected, rel=2e-3)
    # A higher density lies further inside, where the interpolated density says.
    line = np.linspace(0, 0.5, 2001)
    along = jax.vmap(grid(soft_wall(ball())).density)(jnp.zeros((2001, 3)).at[:, 0].set(line))
    inner = field_size(grid(soft_wall(ball())), density_range=(90.0, 95.0))
    assert inner == pytest.approx(2 * line[np.asarray(along) >= 90].max(), rel=2e-3)


def test_samples_cover_evenly(solid_ball):
    """Every octant gets its share, and gaps between neighbours are alike: no clumps, no holes."""
    points = np.asarray(solid_ball.samples.points)
    octant = (points > 0) @ np.array([1, 2, 4])
    counts = np.bincount(octant, minlength=8)
    assert counts.min() > 0.8 * 1500 / 8
    nearest = cKDTree(points).query(points, k=2)[0][:, 1]
    assert nearest.std() < 0.25 * nearest.mean()
    directions = np.random.default_rng(0).normal(size=(2000, 3))
    on_surface = 0.4 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    holes = cKDTree(points).query(on_surface)[0]
    assert holes.max() < 3 * nearest.mean()


def test_normals_point_outward(solid_ball):
    points, normals = np.asarray(solid_ball.samples.points), np.asarray(solid_ball.samples.normals)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)
    outward = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert np.min(np.sum(normals * outward, axis=1)) > 0.95


def test_solid_fills_the_core_and_drops_the_floater(messy_ball):
    options = {"n_samples": 800, "resolution": 48, "mass": 2.0}
    solid = dano.NeuralObject.from_field(messy_ball, mass_model="solid", **options)
    inertia = 0.4 * 2.0 * 0.4**2
    np.testing.assert_allclose(solid.mass.inertia, inertia * np.eye(3), atol=0.02 * inertia)
    np.testing.assert_allclose(solid.mass.com, 0, atol=2e-3)
    paper = dano.NeuralObject.from_field(messy_ball, mass_model="density", **options)
    assert float(paper.mass.inertia[0, 0]) > 1.1 * inertia, "a shell with a floater has more inertia"
    assert float(jnp.abs(paper.mass.com).max()) > 1e-3

    radius = np.linalg.norm(solid.samples.points, axis=1)
    assert radius.max() < 0.5, "the floater must not feel contact"
    assert radius.min() > 0.3, "nor the inside of the core"
    assert solid.grid is not None
    assert float(solid.grid.density(jnp.array([0.5, 0.5, 0.5]))) == 0.0
    kept = dano.NeuralObject.from_field(messy_ball, floaters=True, **options)
    assert np.linalg.norm(kept.samples.points, axis=1).max() > 0.7


def test_a_shape_becomes_an_object_by_baking():
    box = dano.Box((0.1, 0.07, 0.05), rounding=0.01)
    built = dano.NeuralObject.from_field(box, n_samples=600, mass=1.5, resolution=48)
    assert 0 < float(built.bake_error) < 0.2
    sdf = jax.vmap(box.sdf)(built.samples.points)
    assert float(jnp.abs(sdf).max()) < float(box.edge_width)
    corners = np.abs(np.asarray(built.samples.points)).max(axis=0)
    np.testing.assert_allclose(corners, [0.1, 0.07, 0.05], atol=2e-3)


@pytest.mark.parametrize("half", [0.0015, 0.0005])
def test_thin_plates_are_sampled_on_both_sides(half):
    """A plate a thousandth as thick as it is wide has flat cells, and samples wherever it has an edge."""
    plate = dano.Box((0.5, 0.5, half), edge=0.0004)
    points = np.asarray(draw_contact_samples(plate, 400).points)
    assert np.all(np.abs(points[:, 2]) < half + 0.0002)
    for side in (points[:, 2] > 0.5 * half, points[:, 2] < -0.5 * half):
        assert np.mean(side) > 0.25
        assert np.all(np.ptp(points[side][:, :2], axis=0) > 0.9)


def test_same_key_same_object(messy_ball):
    build = lambda seed: dano.NeuralObject.from_field(  # noqa: E731
        messy_ball, n_samples=200, resolution=32, key=jax.random.key(seed)
    )
    np.testing.assert_array_equal(build(1).samples.points, build(1).samples.points)
    assert np.any(np.asarray(build(1).samples.points) != np.asarray(build(2).samples.points))


def test_save_and_load(solid_ball, tmp_path):
    path = tmp_path / "ball.dano"
    solid_ball.save(path)
    loaded = dano.NeuralObject.load(path)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), solid_ball, loaded)
    np.testing.assert_array_equal(loaded.samples.points, solid_ball.samples.points)
    assert loaded.mass_model == solid_ball.mass_model
    assert [p.name for p in tmp_path.iterdir()] == ["ball.dano"]


def test_a_centre_of_mass_far_beside_the_samples_is_refused():
    """Where a body's samples lie, there is its mass; samples of one side alone may be beside it."""
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (50, 3))
    known: dict[str, Any] = dict(points=points, density=np.ones(50), mass=1.0, inertia=1e-3 * np.eye(3))
    assert dano.NeuralObject.from_samples(com=(0.0, 0.0, 0.2), **known).mass.com[2] == 0.2
    with pytest.raises(ValueError, match="com must lie within the body .*, 9.9 m beside points that span"):
        dano.NeuralObject.from_samples(com=(10.0, 0.0, 0.0), **known)


@pytest.mark.parametrize("signed", [False, True])
def test_a_distance_in_place_of_a_density_is_said(signed: bool):
    """As max(d, 0), and as |d|: both make an object of what lies around a ball."""
    axis = np.linspace(-0.2, 0.2, 24)
    places = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    distance = np.linalg.norm(places, axis=-1) - 0.1
    values = np.abs(distance) if signed else np.maximum(distance, 0)
    made: dict[str, Any] = dict(n_samples=200, resolution=24)
    with pytest.warns(UserWarning, match="grows evenly to the border .* as a distance does"):
        dano.NeuralObject.from_field(dano.GridField(values, axis[[0, 0, 0]], axis[1] - axis[0]), **made)
    # Neither a ball nor a box's walls, which are dense where their grid ends, grow evenly.
    walls = (np.abs(places).max(axis=-1) > 0.17).astype(float)
    for density in ((distance < 0).astype(float), np.exp(-np.maximum(distance, 0) / 0.02), walls):
        grid = dano.GridField(density, axis[[0, 0, 0]], axis[1] - axis[0])
        assert float(dano.NeuralObject.from_field(grid, **made).mass.mass) > 0


def test_from_samples_keeps_what_is_given():
    points = np.random.default_rng(0).normal(size=(50, 3))
    given = dano.NeuralObject.from_samples(
        points=points, density=np.ones(50), mass=2.0, com=(0.1, 0, 0), inertia=np.diag([1.0, 2.0, 2.5])
    )
    np.testing.assert_array_equal(given.samples.points, points)
    assert given.grid is None
    outward = points - np.array([0.1, 0, 0])
    assert np.all(np.sum(np.asarray(given.samples.normals) * outward, axis=1) > 0)


BAD = {
    "n_samples": ({"n_samples": 0}, "n_samples must be"),
    "empty range": ({"density_range": (500.0, 600.0)}, "density_range"),
    "reversed range": ({"density_range": (5.0, 1.0)}, "density_range"),
    "mass": ({"mass": -1.0}, "mass must be"),
    "mass scale": ({"mass_scale": 0.0}, "mass_scale must be"),
    "resolution": ({"resolution": 2}, "resolution must be"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_options(case):
    options, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        dano.NeuralObject.from_field(
            grid(soft_wall(ball())), **{"n_samples": 50, "resolution": 24, **options}
        )
