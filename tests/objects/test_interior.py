"""The mass model and the level of the surface, on fields whose solid is known: solid, foggy, hollow,
porous."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

import dano
from dano.objects import fill_hollows

N = 60
AXIS = np.linspace(-1, 1, N)
CELL = AXIS[1] - AXIS[0]
X = np.stack(np.meshgrid(AXIS, AXIS, AXIS, indexing="ij"), axis=-1).reshape(-1, 3)


def box(x):
    return np.asarray(dano.Box((0.5, 0.4, 0.35), rounding=0.05).sdf_jet(jnp.asarray(x.T), 0))


def lump(x):
    """A box with a stub on one side, so that no centre or axis is known by symmetry."""
    along = np.clip((x[:, 2] - 0.1) / 0.55, 0, 1)
    axis = np.array([0.2, 0.1, 0.1]) + along[:, None] * np.array([0.2, 0.05, 0.55])
    return np.minimum(box(x - [-0.1, 0.0, -0.25]), np.linalg.norm(x - axis, axis=1) - 0.19)


def properties(sdf):
    """Centre of mass and principal inertias per mass of {sdf < 0}, from two million random points: to 0.3
    %."""
    x = np.random.default_rng(0).uniform(-1, 1, (2_000_000, 3))
    inside = x[sdf(x) < 0]
    centre = inside.mean(axis=0)
    second = (inside - centre).T @ (inside - centre) / len(inside)
    return centre, np.linalg.eigvalsh(np.trace(second) * np.eye(3) - second)


def noise(amount, seed):
    """Log-normal, correlated over about a cell."""
    white = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(N, N, N)), 1.0)
    return np.exp(amount * white / white.std())


def field(values):
    return dano.GridField.interpolating(np.where(values < 1e-6, 0, values), (-1.0,) * 3, CELL)


def profiles(sdf):
    """Densities around the same solid: wall one cell soft, depth in cells."""
    depth = -sdf(X).reshape(N, N, N) / CELL
    wall = 1 / (1 + np.exp(-np.clip(3 * depth, -60, 60)))
    inner = np.maximum(depth, 0)
    floater = 1 / (1 + np.exp(np.clip(3 * (np.linalg.norm(X - 0.8, axis=1) - 0.09) / CELL, -60, 60)))
    floater = floater.reshape(N, N, N)
    haze = 0.01 * noise(1.0, 1)
    return {
        "occupancy": wall,
        "foggy": 80 * (wall * (0.5 + 0.5 * np.exp(-inner / 2)) * noise(0.3, 2) + haze + floater),
        "hollow": 80 * (wall * (0.01 + np.exp(-(np.maximum(inner - 1, 0) ** 2) / 2)) + haze),
        "porous shell": 80
        * (wall * (0.01 + np.exp(-(np.maximum(inner - 1, 0) ** 2) / 4)) * noise(0.6, 3) + haze),
        "uneven": 80 * (wall * noise(1.2, 4) + haze),
        "dense core": 30 * wall * (1 + 0.8 * np.clip(inner / 6, 0, 1)),
    }


@pytest.fixture(scope="module")
def truth():
    return properties(lump)


@pytest.fixture(scope="module")
def half_a_cell(truth):
    """What moving the surface by half a cell does to the inertias: the error of a good level on this
    lattice."""
    return np.abs(properties(lambda x: lump(x) - 0.5 * CELL)[1] / truth[1] - 1).max()


def errors(made, truth):
    """Centre of mass relative to the size, inertias relative to the true ones."""
    found = np.linalg.eigvalsh(made.mass.inertia) / float(made.mass.mass)
    return np.linalg.norm(made.mass.com - truth[0]) / 1.6, np.abs(found / truth[1] - 1).max()


# Model expected, words of its reason, error of the surface in half cells, least error of reading density as
# mass.
CASES = {
    "occupancy": ("density", "occupancy of a solid", 1, 0.0),
    "foggy": ("solid", "foggy", 1, 0.5),
    "hollow": ("solid", "hollow: deep inside", 1, 0.5),
    "porous shell": ("solid", "pores", 2, 0.5),
    "uneven": ("solid", "pores", 2, 0.3),
    "dense core": ("solid", "deep inside it has", 1, 0.0),
}


@pytest.mark.parametrize("name", CASES)
def test_model_chosen_reason_and_error(name, truth, half_a_cell):
    model, words, cells, other = CASES[name]
    grid = field(profiles(lump)[name])
    made = dano.NeuralObject.from_field(grid, mass=1.0, n_samples=200, resolution=60)
    assert made.mass_model == model, made.mass_reason
    assert words in made.mass_reason
    com, inertia = errors(made, truth)
    assert com < 0.01
    assert inertia < cells * half_a_cell
    asked = dano.MassProperties.from_field(grid, mass=1.0)
    wrong = np.abs(np.linalg.eigvalsh(asked.inertia) / truth[1] - 1).max()
    assert wrong >= other, "the density itself must be a bad model here, or the case tests nothing"


def test_what_was_asked_for_is_done_and_questioned():
    grid = field(profiles(lump)["hollow"])
    made = dano.NeuralObject.from_field(grid, mass=1.0, mass_model="density", n_samples=50, resolution=40)
    assert made.mass_model == "density"
    assert made.mass_reason.startswith("as asked; auto would take solid: densities of")
    np.testing.assert_allclose(
        made.mass.inertia, dano.MassProperties.from_field(grid, mass=1.0).inertia, rtol=1e-9
    )


def test_shapes_weigh_as_they_are():
    """A bowl keeps its hollow, and a shape's mass is its own."""
    made = dano.NeuralObject.from_field(
        dano.Box((0.1, 0.2, 0.3)), mass_scale=500.0, n_samples=50, resolution=32
    )
    assert (made.mass_model, made.mass_reason) == ("density", "a shape's occupancy is exact")
    assert float(made.mass.mass) == pytest.approx(500 * 8 * 0.1 * 0.2 * 0.3, rel=5e-3)


def test_hollows_are_filled_and_reported(truth, half_a_cell):
    values = profiles(lump)["hollow"]
    hollow = field(np.maximum(values - 0.8 * noise(1.0, 1), 0))  # without haze, so that ∫φ is the solid's
    filled, interior = fill_hollows(hollow)
    assert float(interior.deep) < 0.1
    assert 0.2 < float(interior.cavity) < 0.8
    again = dano.MassProperties.from_field(filled, mass=1.0)
    assert np.abs(np.linalg.eigvalsh(again.inertia) / truth[1] - 1).max() < 2 * half_a_cell
    deep = filled.density(jnp.array([-0.1, 0.0, -0.25]))
    assert float(deep) == pytest.approx(max(float(interior.wall), 2 * float(interior.level)), rel=0.05)


def test_interior_survives_a_file(tmp_path):
    made = dano.NeuralObject.from_field(field(profiles(lump)["foggy"]), mass=1.0, n_samples=50, resolution=40)
    made.save(tmp_path / "a.dano")
    loaded = dano.NeuralObject.load(tmp_path / "a.dano")
    assert loaded.mass_reason == made.mass_reason
    assert vars(loaded.interior) == vars(made.interior)
