"""Shapes from sampled distances and from meshes, against closed forms."""

import contextlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.fields import Box, mesh_field, SignedDistanceGrid, Sphere

N = 2000
distance_of = eqx.filter_jit(lambda shape, x: shape.sdf_jet(x, 1))
density_of = eqx.filter_jit(lambda shape, x: shape.jet(x, 0))


@eqx.filter_jit
def compiled(shape, x):
    return {
        "sdf": [shape.sdf_jet(x, order) for order in (1, 2)],
        "jet": [shape.jet(x, order) for order in (1, 2)],
        "one": (jax.vmap(shape.sdf, in_axes=1)(x), jax.vmap(jax.grad(shape.sdf), in_axes=1, out_axes=1)(x)),
    }


def evaluate(shape, x):
    return jax.tree.map(np.asarray, compiled(shape, jnp.asarray(x)))


def ball_samples(n=24, half=0.3, radius=0.2):
    axis = np.linspace(-half, half, n)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return np.linalg.norm(nodes, axis=-1) - radius, (-half,) * 3, axis[1] - axis[0]


@pytest.mark.parametrize("kind, tolerance", [("linear", 3e-3), ("quadratic", 3e-4), ("cubic", 3e-4)])
def test_sampled_ball_is_the_ball(kind, tolerance):
    ball = SignedDistanceGrid(*ball_samples(), kind)
    rng = np.random.default_rng(0)
    x = rng.normal(size=(3, N))
    x *= rng.uniform(0.1, 0.29, N) / np.linalg.norm(x, axis=0)
    distance, direction = distance_of(ball, jnp.asarray(x))
    radius = np.linalg.norm(x, axis=0)
    np.testing.assert_allclose(distance, radius - 0.2, atol=tolerance)
    np.testing.assert_allclose(direction, x / radius, atol=60 * tolerance)
    assert ball.solid_moments() is None


@pytest.mark.parametrize("kind", ["linear", "quadratic", "cubic"])
def test_distances_are_those_given(kind):
    samples = np.random.default_rng(0).uniform(0.2, 0.4, size=(5, 6, 7))
    samples[2, 3, 3] = -0.2
    shape = SignedDistanceGrid(samples, (0.0, 1.0, 2.0), 0.1, kind)
    np.testing.assert_allclose(shape.distances, samples, atol=1e-12)


def test_distance_grows_outside_of_the_grid_and_derivatives_are_consistent():
    ball = SignedDistanceGrid(*ball_samples(), edge=0.05)
    x = np.random.default_rng(1).uniform(-0.8, 0.8, (3, N))
    result = evaluate(ball, x)
    radius = np.linalg.norm(x, axis=0)
    outside = np.max(np.abs(x), axis=0) > 0.3
    sdf = result["sdf"][0][0]
    assert np.all(sdf[outside] > radius[outside] - 0.2 - 1e-3)  # never below the true distance
    assert np.all(sdf[outside] < 1.5 * radius[outside])
    for kind in ("sdf", "jet"):
        (_, gradient), (_, gradient_2, hessian) = result[kind]
        np.testing.assert_allclose(gradient, gradient_2, atol=1e-12)
        for i in range(3):
            shift = 1e-6 * np.eye(3)[:, [i]]
            plus, minus = evaluate(ball, x + shift)[kind][0], evaluate(ball, x - shift)[kind][0]
            difference = [(p - m) / 2e-6 for p, m in zip(plus, minus, strict=True)]
            np.testing.assert_allclose(difference[0], gradient[i], atol=1e-4)
            # The gradient kinks on the border of the grid and the second derivative jumps between cells.
            assert np.mean(np.abs(difference[1] - hessian[i]) > 1e-2) < 2e-3
    np.testing.assert_allclose(result["one"][0], sdf, atol=1e-14)
    np.testing.assert_allclose(result["one"][1], result["sdf"][0][1], atol=1e-12)


def test_bounds_enclose_the_solid_to_a_cell():
    distances, origin, spacing = ball_samples()
    ball = SignedDistanceGrid(distances, origin, spacing, edge=0.05)
    lower, upper = np.asarray(ball.bounds)
    assert np.all(np.abs(lower + 0.225) < 2 * spacing) and np.all(lower < -0.224)
    assert np.all(np.abs(upper - 0.225) < 2 * spacing) and np.all(upper > 0.224)
    x = jnp.asarray(np.random.default_rng(2).uniform(-0.8, 0.8, (3, N)))
    outside = np.any((x < lower[:, None]) | (x > upper[:, None]), axis=0)
    assert not np.any(np.asarray(density_of(ball, x))[np.asarray(outside)])


def test_bad_distances():
    distances, origin, spacing = ball_samples()
    for message, values in {
        "negative somewhere": distances + 1,
        "positive on the border": distances - 0.2,
        "shape": distances[0],
        "finite": distances * np.inf,
    }.items():
        with pytest.raises(ValueError, match=f"distances must .*{message}"):
            SignedDistanceGrid(values, origin, spacing)


@pytest.fixture(scope="module")
def trimesh():
    pytest.importorskip("igl")
    return pytest.importorskip("trimesh")


def test_meshed_ball_and_box_are_the_closed_forms(trimesh):
    rng = np.random.default_rng(0)
    for mesh, shape in (
        (trimesh.creation.icosphere(4, 0.2), Sphere(0.2, edge=0.01)),
        (trimesh.creation.box((0.2, 0.3, 0.4)), Box((0.1, 0.15, 0.2), edge=0.01)),
    ):
        field = mesh_field(mesh, 48, edge=0.01)
        size = float(shape.size)
        moments = field.solid_moments()
        assert moments is not None
        for got, want in zip(moments, shape.solid_moments(), strict=True):
            np.testing.assert_allclose(got, want, rtol=5e-3, atol=1e-12)
        lower, upper = np.asarray(shape.bounds)
        x = jnp.asarray(lower[:, None] + (upper - lower)[:, None] * rng.random((3, 40_000)))
        truth = np.asarray(distance_of(shape, x)[0])
        error = np.asarray(distance_of(field, x)[0]) - truth
        surface = np.abs(truth) < 0.02 * size
        assert np.sqrt(np.mean(error[surface] ** 2)) < 1e-3 * size
        assert np.max(np.abs(error[surface])) < 5e-3 * size
        occupied = np.mean(density_of(field, x)) / np.mean(density_of(shape, x))
        assert abs(occupied - 1) < 5e-3


def test_meshes_are_read_scaled_and_repaired(trimesh, tmp_path):
    """A box in millimetres with faces turned inside out, at an offset; its volume and place in metres."""
    box = trimesh.creation.box((200, 300, 400))
    box.apply_translation((100, 0, 0))
    box.invert()
    path = tmp_path / "box.stl"
    box.export(path)
    with pytest.warns(UserWarning, match="1 shells were inside out"):
        field = mesh_field(path, 24, scale=1e-3)
    moments = field.solid_moments()
    assert moments is not None
    volume, centroid, second = moments
    np.testing.assert_allclose(volume, 0.024, rtol=1e-5)
    np.testing.assert_allclose(centroid, [0.1, 0, 0], atol=1e-7)
    np.testing.assert_allclose(np.diag(second), 0.024 * np.array([0.2, 0.3, 0.4]) ** 2 / 12, rtol=1e-5)
    assert field.sdf(jnp.asarray([0.1, 0.0, 0.0])) == pytest.approx(-0.1, abs=0.01)
    assert field.sdf(jnp.asarray([0.25, 0.0, 0.0])) == pytest.approx(0.05, abs=0.01)


def test_meshes_that_enclose_nothing_are_refused(trimesh, tmp_path):
    box = trimesh.creation.box((0.2, 0.3, 0.4))
    sheet = trimesh.Trimesh(box.vertices, box.faces[:1])
    with pytest.raises(ValueError, match="the mesh must enclose a volume, got sheets"):
        mesh_field(sheet)
    garbage = tmp_path / "garbage.obj"
    garbage.write_text("this is not a mesh\n")
    with pytest.raises(ValueError, match="garbage.obj"):
        mesh_field(garbage)
    with pytest.raises(ValueError, match="none.obj: no such file"):
        mesh_field(tmp_path / "none.obj")
    with pytest.raises(ValueError, match="resolution must lie between 8 and 512"):
        mesh_field(box, 4)
    with pytest.raises(ValueError, match="scale must be finite and > 0"):
        mesh_field(box, scale=0.0)


def block(trimesh, sides, middle, *, inside_out=False):
    made = trimesh.creation.box(sides)
    made.apply_translation(middle)
    if inside_out:
        made.invert()
    return made


def occupied_volume(field) -> float:
    """Of a signed distance at nodes: each cell counts by how far it is inside."""
    spacing = np.asarray(field.spacing)
    return float(np.clip(0.5 - np.asarray(field.distances) / spacing[0], 0, 1).sum() * spacing.prod())


def test_parts_of_a_mesh_make_their_union(trimesh):
    """Overlapping, nested, hollow with something inside, and turned inside out beside the others."""
    cube = block(trimesh, (0.1, 0.1, 0.1), (0, 0, 0))
    arm = block(trimesh, (0.1, 0.06, 0.06), (0.08, 0, 0))
    small, hollow = ((0.02, 0.02, 0.02), (0, 0, 0)), ((0.06, 0.06, 0.06), (0, 0, 0))
    cavity = block(trimesh, *hollow, inside_out=True)
    apart = block(trimesh, (0.02, 0.02, 0.02), (0.1, 0, 0), inside_out=True)
    cases = {
        "overlap": ([cube, arm], 1e-3 + 3.6e-4 - 7.2e-5, False),
        "nested": ([cube, block(trimesh, *small)], 1e-3, False),
        "hollow": ([cube, cavity, block(trimesh, *small)], 1e-3 - 2.16e-4 + 8e-6, True),
        "inside out": ([cube, apart], 1e-3 + 8e-6, True),
    }
    for name, (meshes, volume, closed_form) in cases.items():
        turned = name == "inside out"
        with pytest.warns(UserWarning, match="1 shells") if turned else contextlib.nullcontext():
            field = mesh_field(trimesh.util.concatenate(meshes), 64)
        assert occupied_volume(field) == pytest.approx(volume, rel=5e-3), name
        moments = field.solid_moments()
        assert (moments is not None) == closed_form, name
        if moments is not None:
            assert float(moments.volume) == pytest.approx(volume, rel=1e-6), name
    field = mesh_field(trimesh.util.concatenate([cube, arm]), 64)
    # Near the concave edge of the union; and where one part ends inside the other, to the wall of that one.
    x = jnp.asarray([[0.06, 0.0, 0.04], [0.03, 0.0, 0.0]]).T
    np.testing.assert_allclose(distance_of(field, x)[0], [0.01, -0.02], atol=1e-3)


def test_overlapping_parts_weigh_once(trimesh):
    """Inertia of two crossed bars against the sum over their three disjoint pieces."""
    bars = [block(trimesh, (0.2, 0.04, 0.04), (0, 0, 0)), block(trimesh, (0.04, 0.2, 0.04), (0, 0, 0))]
    made = dano.MassProperties.from_field(mesh_field(trimesh.util.concatenate(bars)), mass=1.0)
    pieces = [((0.2, 0.04, 0.04), 0.0), ((0.04, 0.08, 0.04), 0.06), ((0.04, 0.08, 0.04), -0.06)]
    volumes = np.array([np.prod(sides) for sides, _ in pieces])
    about_z = sum(
        m * ((a**2 + b**2) / 12 + y**2)
        for m, ((a, b, _), y) in zip(volumes / volumes.sum(), pieces, strict=True)
    )
    assert float(made.inertia[2, 2]) == pytest.approx(about_z, rel=0.01)


@pytest.mark.slow
def test_thin_walls_choose_the_resolution_or_say_what_would_do(trimesh):
    plate = trimesh.creation.box((0.1, 0.1, 0.0007))
    field = mesh_field(plate)
    assert 216 <= max(field.distances.shape) <= 230
    assert occupied_volume(field) == pytest.approx(7e-6, rel=0.02)
    with pytest.raises(
        ValueError, match="got 64, all outside: walls thinner than .* resolution 216 keeps them"
    ):
        mesh_field(plate, 64)
    with pytest.warns(UserWarning, match="mesh: walls thinner than 0.0015 m.* resolution 144 keeps them"):
        mesh_field(trimesh.creation.box((0.1, 0.1, 0.0012)), 101)
    with pytest.raises(ValueError, match="thicken them in the mesh"):
        mesh_field(trimesh.creation.box((0.1, 0.1, 0.00002)))
