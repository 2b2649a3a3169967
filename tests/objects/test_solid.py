"""The solid of an object: its signed distance against closed forms, filled, without floaters, stored."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.archive import read_archive, write_archive
from dano.fields import SignedDistanceGrid
from dano.objects import draw_surface

N = 64
AXIS = np.linspace(-0.6, 0.6, N)
CELL = AXIS[1] - AXIS[0]
X = np.stack(np.meshgrid(AXIS, AXIS, AXIS, indexing="ij"), -1)
BOX = dano.Box((0.4, 0.3, 0.25), rounding=0.08)


def density(distance):
    """Rises from 0 to 100 over four cells, 50 at distance 0; passes through the samples."""
    values = 100 / (1 + np.exp(np.clip(distance / CELL, -40, 40)))
    return dano.GridField.interpolating(np.where(values < 1e-6, 0, values), (-0.6,) * 3, CELL)


def radius(center=(0.0, 0.0, 0.0)):
    return np.linalg.norm(X - np.asarray(center), axis=-1)


def ball(x):
    return np.linalg.norm(x, axis=-1) - 0.4


def box(x):
    return np.asarray(BOX.sdf_jet(jnp.asarray(x.reshape(-1, 3).T), 0)).reshape(x.shape[:-1])


SHELL = np.maximum(radius() - 0.4, 0.25 - radius())
CASES = {
    "ball": (density(ball(X)), ball),
    "box": (density(box(X)), box),
    "hollow with core and floater": (
        density(np.minimum(np.minimum(SHELL, radius() - 0.1), radius((0.5, 0.5, 0.5)) - 0.06)),
        ball,
    ),
}


def solid_of(made):
    assert made.solid is not None
    return made.solid


def build(field, **options):
    return dano.NeuralObject.from_field(field, **{"n_samples": 400, "resolution": 64, "mass": 1.0, **options})


@pytest.fixture(scope="module")
def built():
    return {name: build(grid) for name, (grid, _) in CASES.items()}


def level_offset(made):
    """Distance at which the density is the level of the object, half of its plateau."""
    level = float(made.density_range[0])
    assert 35 < level < 55
    return CELL * np.log(100 / level - 1)


@pytest.mark.parametrize("name", CASES)
def test_solid_is_the_true_signed_distance(name, built):
    grid, truth = CASES[name]
    solid = solid_of(built[name])
    random = np.random.default_rng(0)
    way = random.normal(size=(4000, 3))
    start = np.asarray(built[name].surface.points)[random.integers(400, size=4000)]
    near = start + way / np.linalg.norm(way, axis=1, keepdims=True) * 2 * CELL * random.random((4000, 1))
    value, gradient = (np.asarray(a) for a in solid.sdf_jet(jnp.asarray(near.T), 1))
    offset = level_offset(built[name])
    error = (value - truth(near) + offset) / CELL
    assert np.sqrt(np.mean(error**2)) < 0.02
    assert np.abs(error).max() < 0.08
    slope = np.linalg.norm(gradient, axis=0)
    assert np.percentile(slope, 1) > 0.97
    assert np.percentile(slope, 99) < 1.03
    far = random.uniform(-0.55, 0.55, size=(4000, 3))
    value, want = np.asarray(solid.sdf_jet(jnp.asarray(far.T), 0)), truth(far) - offset
    assert np.all((np.sign(value) == np.sign(want)) | (np.abs(want) < 0.05 * CELL))
    last = np.asarray(solid.origin) + np.asarray(solid.spacing) * (np.array(solid.distances.shape) - 1)
    on_grid = np.all((far > np.asarray(solid.origin)) & (far < last), axis=1)
    np.testing.assert_allclose(value[on_grid], want[on_grid], atol=0.5 * CELL)
    # Beyond the grid, as for any sampled distance: no less.
    assert np.all((value > want - 0.05 * CELL) | (want < 0))
    # Zero of the distance is the level set of the interpolated density.
    on_zero = draw_surface(solid, 400).points
    phi, slope = (np.asarray(a) for a in grid.jet(on_zero.T, 1))
    level = float(built[name].density_range[0])
    assert np.abs((phi - level) / np.linalg.norm(slope, axis=0)).max() < 0.02 * CELL


@pytest.mark.parametrize("name", CASES)
def test_surface_lies_on_the_solid(name, built):
    made, truth = built[name], CASES[name][1]
    points, normals = np.asarray(made.surface.points), np.asarray(made.surface.normals)
    assert points.shape == (400, 3)
    distance = np.abs(np.asarray(solid_of(made).sdf_jet(made.surface.points.T, 0)))
    offset = level_offset(made)
    error = np.abs(truth(points) - offset)
    if truth is ball:
        np.testing.assert_allclose(distance, 0, atol=1e-6 * CELL)
        assert error.max() < 0.05 * CELL
    else:
        # Samples of faces lie on their planes, and those of rims, which the grid rounds, with them.
        assert np.median(distance) < 0.01 * CELL
        assert distance.max() < 0.36 * CELL
        assert np.percentile(error, 80) < 0.05 * CELL
    gradient = np.asarray(solid_of(made).sdf_jet(made.surface.points.T, 1)[1]).T
    assert np.min(np.sum(normals * gradient, axis=1)) > 0.9
    if truth is ball:
        inflated = 0.4 + offset + 0.0025 * solid_of(made).size
        np.testing.assert_allclose(made.surface.areas.sum(), 4 * np.pi * inflated**2, rtol=5e-3)


def test_floaters_are_kept_on_request():
    made = build(CASES["hollow with core and floater"][0], floaters=True)
    assert solid_of(made).sdf(jnp.full(3, 0.5)) < 0
    assert np.linalg.norm(made.surface.points, axis=1).max() > 0.7


def test_a_body_at_the_end_of_its_grid_is_closed():
    grid = dano.GridField(np.full((9, 9, 9), 3.0), (0.0, 0.0, 0.0), 0.1)
    made = build(grid, density_range=(1.0, 2.9))
    lower, upper = np.asarray(made.surface.points).min(axis=0), np.asarray(made.surface.points).max(axis=0)
    # The spline falls to zero over three cells around half a cell beyond the last node.
    np.testing.assert_allclose(lower, -0.05, atol=0.02)
    np.testing.assert_allclose(upper, 0.85, atol=0.02)


def test_a_shape_keeps_its_own_distance():
    made = build(BOX, resolution=48)
    spacing = float(solid_of(made).spacing[0])
    x = np.random.default_rng(0).uniform(-0.45, 0.45, size=(3000, 3))
    error = np.asarray(solid_of(made).sdf_jet(jnp.asarray(x.T), 0)) - box(x)
    near = np.abs(box(x)) < 2 * spacing
    assert np.abs(error[near]).max() < 0.1 * spacing
    assert np.sqrt(np.mean(error[near] ** 2)) < 0.02 * spacing


def test_a_sampled_shape_is_taken_as_it_is():
    sampled = SignedDistanceGrid(ball(X), (-0.6,) * 3, CELL, "cubic")
    made = build(sampled, resolution=32)
    assert solid_of(made).interpolation == "cubic"
    np.testing.assert_allclose(solid_of(made).distances, sampled.distances, atol=1e-12)


def test_parts_of_a_shape_that_are_dropped_leave_its_solid():
    far = dano.posed(dano.Sphere(0.1), dano.Pose((0.7, 0.0, 0.0)))
    pair = dano.union(dano.Sphere(0.3), far)
    for floaters in (True, False):
        made = build(pair, floaters=floaters, resolution=32)
        assert (solid_of(made).sdf(jnp.array([0.7, 0.0, 0.0])) < 0) == floaters
        assert (np.asarray(made.surface.points)[:, 0].max() > 0.5) == floaters


def test_solid_and_surface_survive_the_file(built, tmp_path):
    made = built["hollow with core and floater"]
    made.save(tmp_path / "a.dano")
    loaded = dano.NeuralObject.load(tmp_path / "a.dano")
    assert jax.tree.structure(loaded) == jax.tree.structure(made)
    for name in ("points", "normals", "areas"):
        np.testing.assert_array_equal(getattr(loaded.surface, name), getattr(made.surface, name))
    np.testing.assert_array_equal(solid_of(loaded).coefficients, solid_of(made).coefficients)


def as_version_1(path):
    data = read_archive(path, "dano-object", 2)
    old = {name: value for name, value in data.items() if not name.startswith(("solid_", "surface_"))}
    write_archive(path, old | {"version": np.array(1)})


def test_files_of_version_1_get_a_solid_and_a_surface(built, tmp_path):
    made, path = built["hollow with core and floater"], tmp_path / "old.dano"
    made.save(path)
    as_version_1(path)
    loaded = dano.NeuralObject.load(path)
    np.testing.assert_array_equal(loaded.samples.points, made.samples.points)
    assert loaded.surface.points.shape == (400, 3)
    np.testing.assert_allclose(loaded.surface.areas.sum(), made.surface.areas.sum(), rtol=0.02)
    x = jnp.asarray(np.random.default_rng(0).uniform(-0.5, 0.5, size=(3, 1000)))
    np.testing.assert_allclose(solid_of(loaded).sdf_jet(x, 0), solid_of(made).sdf_jet(x, 0), atol=0.2 * CELL)


def test_files_of_version_1_without_grid(tmp_path):
    path = tmp_path / "old.dano"
    made = given(np.random.default_rng(0).normal(size=(30, 3)))
    made.save(path)
    as_version_1(path)
    loaded = dano.NeuralObject.load(path)
    assert loaded.solid is None
    np.testing.assert_allclose(loaded.surface.areas, made.surface.areas)


def given(points, **options):
    known = {"density": np.ones(len(points)), "mass": 2.0, "com": (0.0, 0.0, 0.0), "inertia": np.eye(3)}
    return dano.NeuralObject.from_samples(points=points, **known, **options)


CUBE = np.stack(np.meshgrid(*([-0.5, 0.5],) * 3), axis=-1).reshape(-1, 3)
SHARED = {
    "cube": (CUBE, 6.0),
    "points inside change nothing": (np.concatenate([CUBE, 0.3 * CUBE]), 6.0),
    "in a plane": (CUBE * np.array([1.0, 2.0, 0.0]), 4.0),
    "three": (np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]), 4.0),
    # A ball of 2 kg and J = 1 kg m² has r² = 5/4 m².
    "on a line": (CUBE * np.array([1.0, 0.0, 0.0]), 5 * np.pi),
    "one": (np.array([[0.1, 0.2, 0.3]]), 5 * np.pi),
}


@pytest.mark.parametrize("name", SHARED)
def test_given_points_share_an_area(name):
    points, area = SHARED[name]
    made = given(points)
    np.testing.assert_array_equal(made.surface.points, points)
    np.testing.assert_allclose(made.surface.areas, np.full(len(points), area / len(points)), rtol=1e-9)
    assert made.solid is None


def test_given_areas_and_field():
    made = given(CUBE, areas=np.arange(8.0), normals=CUBE / np.sqrt(0.75), field=CASES["ball"][0])
    np.testing.assert_array_equal(made.surface.areas, np.arange(8.0))
    np.testing.assert_array_equal(made.surface.normals, made.samples.normals)
    assert solid_of(made).sdf(jnp.zeros(3)) == pytest.approx(-0.4, abs=CELL)


@pytest.mark.parametrize("areas", [np.ones(7), np.zeros(8), -np.ones(8), np.full(8, np.nan)])
def test_bad_areas(areas):
    with pytest.raises(ValueError, match="areas must"):
        given(CUBE, areas=areas)
