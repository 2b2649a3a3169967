"""Rollouts with contacts of the centroid law: steps by the reference, derivatives by differences."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_step.step import step
from reference_step.under_test import TODAY

import dano
from dano.contact import CentroidLaw
from dano.engine.launching import knows, scene_tables

H = 0.004
STEPS = 3
CAPACITY = 100
SMOOTH = CentroidLaw(smoothing=12.0, regularizer=2e-3)
STICKS = CentroidLaw(stiction_velocity=1e-5)
PARAMS = dano.ContactParams(
    damper=3e3,
    sliding_friction=0.3,
    sliding_drag=0.05,
    torsional_friction=2e-3,
    torsional_drag=1e-3,
    rolling_friction=3e-3,
    rolling_drag=1e-3,
)
# Above their lower bounds: a difference across one is no number.
DRAGGED = dano.ContactParams(sliding_drag=1e-3, torsional_drag=1e-3, rolling_drag=1e-3)


def lump():
    """An object of a small grid with few samples."""
    axis = np.linspace(-0.06, 0.06, 12)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    values = np.exp(-(x**2 / np.array([9e-4, 6e-4, 4e-4])).sum(-1)) - 0.05
    field = dano.GridField(np.maximum(values, 0), (-0.06,) * 3, axis[1] - axis[0])
    return dano.NeuralObject.from_field(field, n_samples=160, mass=0.4, resolution=20, key=jax.random.key(0))


@functools.cache
def heap():
    """Two objects on each other and the floor, a ball on it; a box that is sampled on the floor, too."""
    made = lump()
    bodies = [
        dano.Body("a", made),
        dano.Body("b", made),
        dano.Body("ball", dano.Sphere(0.05), mass=1.0),
        dano.Body("box", dano.Box((0.05, 0.04, 0.03)), mass=0.5),
        dano.Body("floor", dano.HalfSpace(edge=0.01), fixed=True),
    ]
    contacts = [
        dano.Contact("a", "floor", PARAMS, SMOOTH),
        dano.Contact("floor", "ball", PARAMS, SMOOTH),
        dano.Contact("box", "floor"),
        dano.Contact("a", "b", DRAGGED, STICKS),
    ]
    scene = dano.Scene.create(bodies, contacts, timestep=H)
    state = scene.initial_state(
        a={"position": (0, 0, 0.031), "velocity": (0.2, 0, -0.05), "omega": (1, 2, 0.5)},
        b={"position": (0.012, 0.005, 0.082), "velocity": (0, 0.1, -0.3), "orientation": (1, 0.2, 0.1, 0)},
        ball={"position": (0, 1, 0.0495), "velocity": (0.3, 0, 0), "omega": (1, 2, 3)},
        box={"position": (1, 0, 0.0299), "velocity": (0.3, 0.1, -0.1), "omega": (1, 0, 1)},
    )
    return scene, state


@functools.cache
def reaching():
    """An arm that holds an object on the floor, another object on it, and a box beside."""
    made = lump()
    bodies = [
        dano.Body("a", made),
        dano.Body("b", made),
        dano.Body("arm", dano.Box((0.1, 0.02, 0.02)), mass=0.6),
        dano.Body("base", dano.Box((0.05, 0.05, 0.05)), fixed=True),
        dano.Body("box", dano.Box((0.05, 0.04, 0.03)), mass=0.5),
        dano.Body("floor", dano.HalfSpace(edge=0.01), fixed=True),
    ]
    contacts = [
        dano.Contact("a", "floor", PARAMS, SMOOTH),
        dano.Contact("box", "floor"),
        dano.Contact("b", "a", law=STICKS),
    ]
    joints = [
        dano.Joint("base", "arm", axis=(0, 1, 0.1), anchor=(-0.1, 0, 0), position=(0.06, 0, 0)),
        dano.Joint("arm", "a", axis=(0, 1, 0.2), position=(0.14, 0, 0), stiffness=0.3),
    ]
    scene = dano.Scene.create(bodies, contacts, joints=joints, timestep=H)
    state = scene.initial_state(
        base={"position": (-0.3, 0, 0.031)},
        arm={"q": 0.01, "v": 0.4},
        a={"q": 0.1, "v": -1.0},
        b={"position": (-0.088, 0.005, 0.08), "velocity": (0, 0.1, -0.3), "orientation": (1, 0.2, 0.1, 0)},
        box={"position": (1, 0, 0.0299), "velocity": (0.3, 0.1, -0.1), "omega": (1, 0, 1)},
    )
    return scene, state


def run(scene, state, steps=STEPS):
    """States at the ends of steps, and whether these converged."""
    made = dano.simulate(scene, state, steps, engine=dano.VariationalEngine(capacity=CAPACITY))
    return jax.tree.map(lambda x: x[1:], made.states), made.converged


def check_steps(scene, state):
    """Single steps along a rollout are those of the reference."""
    assert knows(scene)
    states, solved = run(scene, state, 30)
    assert bool(solved.all())
    for k in (0, 5, 20):
        before, found = (jax.tree.map(lambda x, k=k: x[k], states) for k in (k, k + 1))
        shares = {side: each["share"] for side, each in TODAY.find(scene, before).items()}
        expected, equations = step(scene, before, None, shares)
        assert len(equations.patches) > 0
        for name in ("position", "orientation", "velocity", "omega"):
            np.testing.assert_allclose(getattr(found, name), expected[name], atol=1e-9, err_msg=name)


def test_both_laws():
    """Steps of a scene with both laws, alone and among several worlds."""
    scene, state = heap()
    check_steps(scene, state)
    speeds = jnp.array([0.0, 0.1, 0.3])

    def faster(speed):
        return run(scene, eqx.tree_at(lambda s: s.velocity, state, state.velocity + speed))

    many, solved = jax.jit(jax.vmap(faster))(speeds)
    assert bool(solved.all())
    alone, _ = jax.jit(faster)(speeds[2])
    np.testing.assert_array_equal(many.position[2], alone.position)


def changes_of(scene, state):
    """Zeros of all by which derivatives are taken: of bodies, laws, samples, fields and the state."""
    made = scene.body("a")
    grid = {} if made.object is None else {"grid": jnp.zeros_like(made.object.grid.coefficients)}
    joints = {} if state.q is None else {"q": jnp.zeros_like(state.q), "v": jnp.zeros_like(state.v)}
    return {
        "state": jnp.zeros((4, len(scene.bodies), 3)),
        "params": {name: jnp.zeros(2) for name in NUMBERS},
        "law": jnp.zeros(3),
        "edge": jnp.zeros_like(scene.contacts[0].edge),
        "mass": jnp.zeros(()),
        "com": jnp.zeros(3),
        "scale": jnp.zeros(()),
        "weights": jnp.zeros_like(made.samples.weights),
        "points": jnp.zeros((3, made.samples.weights.size)),
        "plane": jnp.zeros(4),
        "timestep": jnp.zeros(()),
        **grid,
        **joints,
    }


NUMBERS = (
    "spring",
    "damper",
    "sliding_friction",
    "sliding_drag",
    "torsional_friction",
    "torsional_drag",
    "rolling_friction",
    "rolling_drag",
)


def changed(scene, state, by):
    """A scene whose first contact is smooth and whose last one sticks, and a state, with changes."""
    first, last = scene.contacts[0], scene.contacts[-1]
    leaves = [scene.bodies[0].mass_scale, scene.bodies[0].com_offset, scene.timestep, first.edge]
    leaves += [first.law.smoothing, first.law.regularizer, last.law.stiction_velocity]
    changes = [by["mass"], by["com"], by["timestep"], by["edge"], *by["law"]]
    for name in NUMBERS:
        leaves += [getattr(first.params, name), getattr(last.params, name)]
        changes += list(by["params"][name])
    for body in scene.bodies:
        if body.object is not None:
            leaves += [body.samples.weights, body.samples.points, body.density_scale]
            leaves += [body.object.grid.coefficients]
            points = jnp.concatenate([by["points"], jnp.zeros_like(by["points"][:1])])
            # Where there is no density, samples are not looked at.
            inner = jnp.where(body.object.grid.coefficients > 0, by["grid"], 0)
            changes += [by["weights"], points, by["scale"], inner]
        if isinstance(body.shape, dano.HalfSpace):
            leaves += [body.shape.normal_direction, body.shape.offset]
            changes += [by["plane"][:3], by["plane"][3]]
    where = {id(leaf): change for leaf, change in zip(leaves, changes, strict=True)}
    scene = jax.tree.map(lambda x: x + where[id(x)] if id(x) in where else x, scene)
    position, turn, velocity, omega = by["state"]
    turned = state.orientation.at[:, 1:].add(turn)
    state = dano.State(
        state.position + position,
        turned / jnp.linalg.norm(turned, axis=1, keepdims=True),
        state.velocity + velocity,
        state.omega + omega,
        *((state.q + by["q"], state.v + by["v"]) if "q" in by else ()),
    )
    return scene, state


SIZES = {"spring": 3e4, "damper": 3e3, "law": jnp.array([12.0, 2e-3, 1e-5])}
"""Of numbers by which derivatives are taken; of the others 0.1."""


def end_of(scene, state, by):
    """A number of the states of a rollout in which all of them count."""
    states, _ = run(*changed(scene, state, by))
    total = jnp.zeros(())
    for name, size in (("position", 10.0), ("orientation", 10.0), ("velocity", 1.0), ("omega", 0.2)):
        values = getattr(states, name)
        total += size * jnp.sum(jnp.asarray(np.random.default_rng(3).normal(size=values.shape)) * values)
    return total


def check_derivatives(scene, state):
    """Reverse mode against forward mode and against differences, a direction for each kind of number."""
    zero = changes_of(scene, state)
    end = functools.partial(end_of, scene, state)
    found = jax.jit(jax.grad(end))(zero)
    names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(zero)]
    random = np.random.default_rng(4)
    flat, tree = jax.tree.flatten(zero)
    sizes = [next((x for key, x in SIZES.items() if f"'{key}'" in name), 0.1) for name in names]
    moved = [
        jnp.stack([jnp.asarray(float(k == i) * random.normal(size=x.shape)) * size for i in range(len(flat))])
        for k, (x, size) in enumerate(zip(flat, sizes, strict=True))
    ]

    def along(direction):
        return jax.jvp(end, (zero,), (jax.tree.unflatten(tree, direction),))[1]

    forward = jax.jit(jax.vmap(along))(moved)
    own = zip(jax.tree.leaves(found), moved, strict=True)
    reverse = np.array([float(jnp.vdot(bar, x[i])) for i, (bar, x) in enumerate(own)])
    assert np.all(reverse != 0)
    # Stiction makes the systems of a step stiff: numbers of both modes part at their rounding.
    np.testing.assert_allclose(forward, reverse, rtol=1e-7, atol=1e-9 * np.abs(reverse).max())
    ends = jax.jit(jax.vmap(lambda at: end(jax.tree.unflatten(tree, at))))
    after, before = (ends([sign * 1e-6 * x for x in moved]) for sign in (1, -1))
    differences = (after - before) / 2e-6
    np.testing.assert_allclose(reverse, differences, rtol=1e-4, atol=1e-5, err_msg=str(names))


def test_derivatives():
    """Of free bodies with both laws, by all that they depend on."""
    check_derivatives(*heap())


def test_visible_differences():
    """A derivative over many steps says what a small and what a visible change of friction and speed make."""
    scene, state = heap()

    @jax.jit
    def way(by):
        rubs = scene.replace_contact("a", "floor", sliding_friction=0.3 + by[0])
        faster = eqx.tree_at(lambda s: s.velocity, state, state.velocity.at[0, 0].add(by[1]))
        return run(rubs, faster, 30)[0].position[-1, 0, 0]

    slope = jax.grad(way)(jnp.zeros(2))
    for size, tolerance in ((1e-6, 1e-4), (1e-2, 2e-2)):
        differences = [(way(size * unit) - way(-size * unit)) / (2 * size) for unit in np.eye(2)]
        np.testing.assert_allclose(slope, differences, rtol=tolerance)


def test_laws_that_kernels_do_not_know():
    """They are refused by name, and known as unknown."""
    scene, _ = heap()

    class OwnLaw(CentroidLaw):
        """A law of one's own."""

    own_law: Any = OwnLaw

    own = eqx.tree_at(lambda s: s.contacts[0].law, scene, own_law(smoothing=12.0))
    assert not knows(own)
    with pytest.raises(ValueError, match="got OwnLaw"):
        scene_tables(own)


@pytest.mark.slow
def test_joints():
    """An arm that touches by both laws: steps and their derivatives."""
    scene, state = reaching()
    check_steps(scene, state)
    check_derivatives(scene, state)
