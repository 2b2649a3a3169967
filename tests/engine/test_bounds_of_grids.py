"""Bounds on the splines of grids hold, and what they spare changes nothing, to the last bit."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.ndimage import map_coordinates

import dano
from dano.fields import SignedDistanceGrid
from dano.native import _leaves, balls_around_runs
from dano.physics.solids.kinds import CELL

NODES = (14, 11, 17)


def spline(coefficients, degree: int, places: np.ndarray) -> np.ndarray:
    """Of a grid with a border of `degree` + 1 nodes, by SciPy: at places in cells."""
    values = []
    for place in places:
        row = coefficients
        for axis in range(3):
            # Nodes stand at whole numbers, the basis function of node 0 around the border's width.
            knots = np.arange(row.shape[0] + degree + 1) - (degree + 1) / 2
            row = BSpline(knots, row, degree, extrapolate=False)(place[axis] + degree + 1)
        values.append(row)
    return np.array(values)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_bounds_of_cells_hold(degree):
    random = np.random.default_rng(degree)
    shape = tuple(n + 2 * degree + 3 for n in NODES)
    axes = np.meshgrid(*(0.004 * np.arange(n) for n in shape), indexing="ij")
    coefficients = np.linalg.norm([x - x.mean() for x in axes], axis=0) - 0.015
    coefficients[: shape[0] // 2] += 0.002 * random.normal(size=(shape[0] // 2, *shape[1:]))
    places = random.uniform(size=(100, 3)) * (np.array(NODES) - 1e-9)
    values = spline(coefficients, degree, places)
    off = np.abs(values - map_coordinates(coefficients, (places + degree + 1).T, order=1))
    cells = tuple((places // CELL).astype(int).T)
    bends = _leaves.bends(coefficients, degree)
    assert (off <= bends[cells]).all()
    # Somewhere it is as far off as a bound that holds for all of a block's cells lets expect.
    assert degree == 1 or (off > 0.1 * bends[cells]).any()
    assert (values >= _leaves.lower_bounds(coefficients, degree)[cells]).all()
    traced = jax.jit(_leaves.bends, static_argnums=1)(jnp.asarray(coefficients), degree)
    np.testing.assert_allclose(traced, bends, rtol=1e-12)


@pytest.mark.parametrize("blocks", [[1], [5], [17, 1, 3], [64, 0, 65], [313]])
def test_balls_around_runs_hold_their_blocks(blocks):
    random = np.random.default_rng(0)
    balls = np.abs(random.normal(size=(sum(blocks), 4)))
    runs = balls_around_runs(balls, blocks)
    asked = 0
    for first, n in zip(np.cumsum([0, *blocks]), blocks, strict=False):
        for beside, size in enumerate((4, 16, 64)):
            for k in range(0, n - size // 4, size):
                members = balls[first + k : first + min(k + size, n)]
                run = runs[first + k + beside]
                reach = np.linalg.norm(members[:, :3] - run[:3], axis=1) + members[:, 3]
                assert (reach <= run[3] * (1 + 1e-12)).all()
                asked += 1
    assert asked > 0 or sum(blocks) == 1


def lumpy(n: int = 33) -> dano.NeuralObject:
    """A lumpy ball as a grid of distances, some of which are steeper than true ones."""
    axis = np.linspace(-0.08, 0.08, n)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    r = np.sqrt(x * x + y * y + z * z)
    distances = r - 0.05 - 0.006 * np.sin(60 * x) * np.sin(60 * y) * np.cos(50 * z)
    distances += 0.004 * np.exp(-(((r - 0.07) / 0.01) ** 2)) * np.sin(200 * x)
    shape = SignedDistanceGrid(distances, (-0.08,) * 3, axis[1] - axis[0], "quadratic")
    key = jax.random.key(0)
    return dano.NeuralObject.from_field(shape, n_samples=800, mass=0.5, mass_model="solid", key=key)


@pytest.fixture(scope="module")
def lump() -> dano.NeuralObject:
    return lumpy()


def heap(lump) -> tuple[dano.Scene, dano.State]:
    """Three lumps that meet in the air, beside and above a floor: fast, slow and at rest."""
    bodies = [*(dano.Body(name, lump) for name in "abc"), dano.Body("floor", dano.HalfSpace(), fixed=True)]
    scene = dano.Scene.create(bodies, others=dano.ContactParams(sliding_friction=0.4), timestep=0.005)
    state = scene.initial_state(
        a={"position": (0, 0, 0.06)},
        b={"position": (0.02, 0.01, 0.19), "omega": (3, 0, 5)},
        c={"position": (0.14, 0.0, 0.08), "velocity": (-0.5, 0, 0), "omega": (0, 9, 0)},
    )
    return scene, state


def know_nothing(monkeypatch):
    """Have bounds that say nothing."""

    def nothing(known, value):
        return lambda coefficients, degree: np.full_like(known(np.asarray(coefficients), degree), value)

    monkeypatch.setattr(_leaves, "lower_bounds", nothing(_leaves.lower_bounds, -1e9))
    monkeypatch.setattr(_leaves, "bends", nothing(_leaves.bends, 1e9))


def test_what_bounds_spare_changes_no_bit(lump, monkeypatch):
    scene, state = heap(lump)
    told = dano.simulate(scene, state, 150)
    know_nothing(monkeypatch)
    scene, state = heap(lump)
    plain = dano.simulate(scene, state, 150)
    assert np.asarray(told.converged).all()
    # They meet, and come to rest.
    assert np.abs(np.asarray(told.states.velocity[-1])).max() < 0.3
    for name in ("position", "orientation", "velocity", "omega"):
        np.testing.assert_array_equal(getattr(told.states, name), getattr(plain.states, name))


def test_derivatives_are_the_same_to_the_last_bit(lump, monkeypatch):
    def slope():
        scene, state = heap(lump)

        def end(speed):
            moved = dataclasses.replace(state, velocity=state.velocity.at[2, 0].set(speed))
            return jnp.sum(dano.simulate(scene, moved, 40).states.position[-1])

        return jax.grad(end)(-0.5)

    told = slope()
    know_nothing(monkeypatch)
    assert told == slope()
