"""Machine code against what it replaces: the same contact, the same velocities, the same derivatives."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numba
import numpy as np
import pytest

import dano
from dano.contact import find
from dano.engine import _kernels, _primal_dual
from dano.engine._kernels import native_root
from dano.engine._newton import SolverOptions
from dano.engine._problem import build_problem, links_of, prepare, structure_of
from dano.engine._roots import _root_of_bodies
from dano.fields import SignedDistanceGrid
from dano.maths import Pose
from dano.native import GRID
from dano.native._blocks import elimination as kernel_elimination, solve_blocks as kernel_solve
from dano.native._solids import distance as kernel_distance

H = 0.005


def grid(interpolation: str) -> SignedDistanceGrid:
    """A ball of 4 cm, sampled."""
    axis = np.linspace(-0.06, 0.06, 25)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"))
    distances = np.linalg.norm(x, axis=0) - 0.04
    return SignedDistanceGrid(distances, (-0.06,) * 3, axis[1] - axis[0], interpolation)


SOLIDS = {
    "half-space": dano.HalfSpace((0.2, -0.1, 1.0), 0.01),
    "sphere": dano.Sphere(0.05),
    "box": dano.Box((0.05, 0.04, 0.03)),
    "rounded box": dano.Box((0.05, 0.04, 0.03), 0.01),
    "capsule": dano.Capsule(0.03, 0.04),
    "cylinder": dano.Cylinder(0.04, 0.03),
    "ellipsoid": dano.Ellipsoid((0.06, 0.04, 0.03)),
    "linear grid": grid("linear"),
    "quadratic grid": grid("quadratic"),
    "cubic grid": grid("cubic"),
    "posed and enlarged": dano.scaled(
        dano.posed(dano.Box((0.05, 0.04, 0.03)), Pose((0.01, 0.0, 0.02), (0.9, 0.1, 0.3, 0.2))), 1.2
    ),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_distances_are_those_of_shapes(name):
    """Distance and gradient at random points, inside and far outside, through a search for contact."""
    solid = SOLIDS[name]
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (400, 3))
    value, gradient = solid.sdf_jet(jnp.asarray(points.T), 1)
    tables = tables_of_pair(solid)
    found = np.stack([through_kernel(tables, point) for point in points])
    np.testing.assert_allclose(found[:, 0], value, atol=1e-14)
    np.testing.assert_allclose(found[:, 1:], np.asarray(gradient).T, atol=1e-10)


def tables_of_pair(solid):
    bodies = [dano.Body("ball", dano.Sphere(0.03), mass=1.0), dano.Body("solid", solid, fixed=True)]
    scene = dano.Scene.create(bodies, [dano.Contact("ball", "solid")], timestep=H)
    prepared = prepare(scene, None)
    assert prepared.geometry is not None
    tables = prepared.geometry.tables
    assert tables is not None
    of_solid = int(np.asarray(tables.names)[np.asarray(tables.names)[:, 1] == 1][0, 2])
    return np.asarray(tables.solids)[of_solid], np.asarray(tables.wholes)[of_solid], np.asarray(tables.atlas)


@numba.njit
def distance_and_gradient(solid, whole, atlas, x, y, z):
    out = np.empty(30)
    value = kernel_distance(solid, whole, atlas, x, y, z, out, True)
    alone = kernel_distance(solid, whole, atlas, x, y, z, np.empty(30), False)
    return value, alone, out[0], out[1], out[2]


def through_kernel(tables, point):
    value, alone, *gradient = distance_and_gradient(*tables, *point)
    if tables[1][0] == GRID and np.abs(point).max() > 0.06:
        # Outside of the grid it is no more than the true distance of the ball that was sampled.
        assert alone <= np.linalg.norm(point) - 0.04 + 5e-4
    else:
        assert abs(alone - value) < 1e-15
    return np.array([value, *gradient])


@numba.njit
def solved(coupled, matrix, right):
    order, count, later = kernel_elimination(coupled)
    kernel_solve(matrix, right, order, count, later)


def test_systems_of_blocks():
    """Random sparse patterns against a dense solver."""
    random = np.random.default_rng(1)
    for m in (1, 2, 7, 20):
        coupled = np.eye(m, dtype=bool)
        for _ in range(2 * m):
            i, j = random.integers(m, size=2)
            coupled[i, j] = coupled[j, i] = True
        matrix = random.normal(size=(m, m, 6, 6)) * coupled[:, :, None, None]
        matrix[np.arange(m), np.arange(m)] += 30 * np.eye(6)
        right = random.normal(size=(m, 6))
        dense = matrix.transpose(0, 2, 1, 3).reshape(6 * m, 6 * m)
        expected = np.linalg.solve(dense, right.ravel()).reshape(m, 6)
        solved(coupled, matrix.copy(), right)
        np.testing.assert_allclose(right, expected, rtol=1e-10, atol=1e-13)


@pytest.fixture(scope="module")
def heap():
    """Bodies of all kinds that fall on each other, and states on the way."""
    kinds = ["box", "sphere", "cylinder", "ellipsoid", "capsule", "quadratic grid", "posed and enlarged"]
    bodies = [dano.Body(name, SOLIDS[name], mass=0.2 + 0.3 * k) for k, name in enumerate(kinds)]
    scene = dano.Scene.create(
        [*bodies, dano.Body("floor", dano.HalfSpace(), fixed=True)],
        others=dano.ContactParams(sliding_friction=0.4, restitution=0.2),
        timestep=H,
    )
    random = np.random.default_rng(2)
    starts: dict[str, dict[str, Any]] = {
        name: dict(
            position=(*random.uniform(-0.04, 0.04, 2), 0.07 + 0.08 * k),
            orientation=random.normal(size=4),
            velocity=(0, 0, -1.0 - 0.3 * k),
            omega=random.uniform(-5, 5, 3),
        )
        for k, name in enumerate(kinds)
    }
    run = dano.simulate(scene, scene.initial_state(**starts), 100)
    states = [jax.tree.map(lambda x, k=k: x[k], run.states) for k in (3, 20, 40, 60, 95)]
    # Two pairs deep in each other.
    deep = states[0].position
    deep = deep.at[1].set(deep[0] + jnp.array([0.01, 0.004, 0.006]))
    deep = deep.at[3].set(deep[2] + jnp.array([0.01, -0.004, 0.008]))
    return scene, [*states, eqx.tree_at(lambda s: s.position, states[0], deep)]


def test_finds_the_same_points(heap):
    """Native and XLA: every point once, with the same geometry, but for the order."""
    scene, states = heap
    prepared = prepare(scene, None)
    geometry, impacts = prepared.geometry, prepared.impacts
    assert geometry is not None and geometry.tables is not None and impacts is not None
    slow = eqx.tree_at(lambda g: g.tables, geometry, None)
    searches = [
        jax.jit(lambda links, g=g, i=impacts: find(g, links, i, scene.timestep, prepared.capacity))
        for g in (geometry, slow)
    ]
    n_points = 0
    for state in states:
        native, expected = (listed(*search(links_of(scene, state, scene.timestep))) for search in searches)
        assert native.keys() == expected.keys()
        n_points += len(native)
        for key, row in native.items():
            np.testing.assert_allclose(row, expected[key], rtol=1e-9, atol=1e-9)
    assert n_points > 300


def listed(points, found):
    """Numbers of each point, by its bodies and sample."""
    chunk, lane = np.nonzero(np.asarray(found.filled))
    per_chunk = [points.contact, found.share, found.stiffness, found.group, found.side]
    rows = [*np.asarray(points.rows)[:, chunk, lane], *(np.asarray(x)[chunk] for x in per_chunk)]
    names = [np.asarray(points.first)[chunk], np.asarray(points.second)[chunk]]
    names.append(np.asarray(found.sample)[chunk, lane])
    return dict(zip(zip(*names, strict=True), np.stack(rows, axis=1), strict=True))


@pytest.mark.parametrize("held", [False, True])
def test_solves_steps_alike(heap, held, monkeypatch):
    """The velocities, the Jacobian and the passes of XLA's solver; also with friction bounds held first."""
    tiers = ((100.0, 1.0, True, 150, True), *_primal_dual.TIERS[:3]) if held else _primal_dual.TIERS
    for module in (_primal_dual, _kernels):
        monkeypatch.setattr(module, "TIERS", tiers)
    scene, states = heap
    prepared, pairs, options = prepare(scene, None), structure_of(scene), SolverOptions()

    @jax.jit
    def both(state):
        problem, _ = build_problem(scene, prepared, state, None, pairs)
        start = jnp.concatenate([state.velocity, state.omega], axis=1)[: len(pairs.moving)]
        native = native_root(problem, start, pairs, options, derivatives=True)
        return native, _root_of_bodies(problem, start, pairs, options)

    for state in states:
        (velocities, jacobian, report), (expected, slopes, slow) = both(state)
        assert bool(report.converged) and bool(slow.converged)
        # Where an impact is so stiff that rounding of its terms leaves a residual, velocities differ by a
        # share of it: up to 0.004 over the heaps of twelve seeds, and not the same on every processor.
        residual = max(float(report.residual), float(slow.residual))
        np.testing.assert_allclose(velocities, expected, rtol=0, atol=1e-8 + 0.02 * residual)
        np.testing.assert_allclose(jacobian, slopes, rtol=1e-5, atol=1e-6 * float(jnp.abs(slopes).max()))
        if not held:
            assert abs(int(report.iterations) - int(slow.iterations)) <= 2 + 0.2 * int(slow.iterations)


def test_single_precision(heap):
    """Numbers of 32 bits go in and come out; a step agrees with one of 64 to their resolution."""
    scene, states = heap
    exact = dano.step(scene, states[2])
    short = lambda tree: jax.tree.map(  # noqa: E731
        lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, tree
    )
    step = dano.step(short(scene), short(states[2]))
    assert step.velocity.dtype == jnp.float32
    np.testing.assert_allclose(step.velocity, exact.velocity, atol=2e-2)
    np.testing.assert_allclose(step.position, exact.position, atol=1e-4)


def test_shapes_that_kernels_do_not_know():
    """They are searched by XLA, and solved alike."""
    two = dano.union(dano.Box((0.05, 0.05, 0.03)), dano.posed(dano.Sphere(0.03), Pose((0.0, 0.0, 0.04))))
    bodies = [dano.Body("two", two, mass=1.0), dano.Body("floor", dano.HalfSpace(), fixed=True)]
    scene = dano.Scene.create(bodies, [dano.Contact("two", "floor")], timestep=H)
    geometry = prepare(scene, None).geometry
    assert geometry is not None
    run = dano.simulate(scene, scene.initial_state(two=dict(position=(0, 0, 0.05))), 100)
    assert bool(jnp.all(run.converged))
    assert float(jnp.abs(run.states.velocity[-1, 0]).max()) < 1e-6
