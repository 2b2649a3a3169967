# pyright: reportInvalidTypeForm=false
"""Kernels of a step: distances, derivatives, worlds, and what they refuse."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import warp as wp

import dano
from dano.contact import AbstractContactLaw
from dano.engine.launching import scene_tables
from dano.fields import SignedDistanceGrid
from dano.maths import Pose
from dano.native import instance

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


ENOUGH = 0.02
"""Distance [m] beyond which only that is asked."""


@pytest.fixture(scope="module")
def every_solid():
    """A scene of all solids, its tables, and a kernel that asks their distances."""
    bodies = [dano.Body(name.replace(" ", "_"), solid, fixed=True) for name, solid in SOLIDS.items()]
    ball = dano.Body("ball", dano.Sphere(0.03), mass=1.0)
    contacts = [dano.Contact("ball", body.name) for body in bodies]
    scene = dano.Scene.create([ball, *bodies], contacts, timestep=H)
    tables = scene_tables(scene)
    distances = instance(tables.features, "dano.physics.solids.distances")
    reals = instance(tables.features, "dano.physics.real")
    vec3, vec4, real, INFINITY = reals.vec3, reals.vec4, reals.real, reals.INFINITY
    solid_distance, solid_clearance, solid_of = (
        distances.solid_distance,
        distances.solid_clearance,
        distances.solid_of,
    )

    @wp.kernel(enable_backward=False, module="unique")
    def asked(
        solids: distances.Solids,
        first: int,
        count: int,
        points: wp.array(dtype=vec3),
        found: wp.array(dtype=vec4),
        least: wp.array(dtype=real),
        quick: wp.array(dtype=real),
    ):
        i = wp.tid()
        solid = solid_of(solids, 0, first, count)
        d = solid_distance(solids, 0, solid, points[i])
        found[i] = vec4(d.value, d.gradient[0], d.gradient[1], d.gradient[2])
        least[i] = solid_clearance(solids, 0, solid, points[i], INFINITY)
        quick[i] = solid_clearance(solids, 0, solid, points[i], real(ENOUGH))

    solids = distances.Solids()
    names = ("leaves", "coefficients", "bounds")
    rows = {name: np.asarray(tables.rows[f"scene.solids.{name}"]) for name in names}
    solids.leaves = wp.array(
        rows["leaves"].view(distances.Leaf.numpy_dtype()), dtype=distances.Leaf, device="cpu"
    ).reshape((1, -1))
    solids.coefficients = wp.array(rows["coefficients"].reshape(1, -1), dtype=real, device="cpu")
    solids.bounds = wp.array(rows["bounds"].reshape(1, -1), dtype=real, device="cpu")
    kinds = tables.whole.arrays["scene.solids.kinds"]
    solids.kinds = wp.array(
        kinds.view(distances.LeafKind.numpy_dtype()).ravel(), dtype=distances.LeafKind, device="cpu"
    )
    index = tables.whole.arrays["scene.body_index"]

    def distance(name, points):
        k = 1 + list(SOLIDS).index(name)
        found = wp.zeros(len(points), vec4, device="cpu")
        least, quick = (wp.zeros(len(points), real, device="cpu") for _ in range(2))
        given = wp.array(points, dtype=vec3, device="cpu")
        wp.launch(
            asked,
            len(points),
            [solids, int(index[k, 4]), int(index[k, 5]), given, found, least, quick],
            device="cpu",
        )
        return found.numpy(), least.numpy(), quick.numpy()

    return distance


@pytest.mark.parametrize("name", SOLIDS)
def test_distances_are_those_of_shapes(name, every_solid):
    """Distance and gradient at random points, inside and far outside; and a lower bound on the distance."""
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (400, 3))
    value, gradient = SOLIDS[name].sdf_jet(jnp.asarray(points.T), 1)
    found, least, quick = every_solid(name, points)
    # Where it matters the quick bound is the bound; elsewhere it says as well that the solid is not near.
    assert np.array_equal(quick[least <= ENOUGH], least[least <= ENOUGH])
    assert np.all(quick[least > ENOUGH] > ENOUGH)
    np.testing.assert_allclose(found[:, 0], value, atol=1e-14)
    np.testing.assert_allclose(found[:, 1:], np.asarray(gradient).T, atol=1e-10)
    if "grid" in name:
        outside = np.abs(points).max(axis=1) > 0.06
        # Outside of the grid the bound is no more than the true distance of the ball that was sampled.
        assert np.all(least[outside] <= np.linalg.norm(points[outside], axis=1) - 0.04 + 5e-4)
        np.testing.assert_allclose(least[~outside], found[~outside, 0], atol=1e-15)
    else:
        np.testing.assert_allclose(least, found[:, 0], atol=1e-15)


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


def test_directions_and_worlds(heap):
    """Forward mode is reverse mode, over one and over many worlds; `vmap` is a loop."""
    scene, states = heap
    state = states[-2]
    weights = np.random.default_rng(3).normal(size=(len(scene.bodies), 3))

    def end(friction, speed):
        moved = eqx.tree_at(lambda s: s.velocity, state, state.velocity + speed)
        rubs = scene.replace_material("box", sliding_friction=friction)
        return jnp.sum(dano.simulate(rubs, moved, 3).states.position[-1] * weights)

    frictions = jnp.array([0.3, 0.4, 0.5])
    reverse = jax.jit(jax.vmap(jax.grad(end, (0, 1)), (0, None)))(frictions, 0.01)
    forward = jax.jit(jax.vmap(jax.jacfwd(end, (0, 1)), (0, None)))(frictions, 0.01)
    # Where points stick, the equations of a step are some 1e8 times as stiff as inertia.
    np.testing.assert_allclose(forward, reverse, rtol=1e-7, atol=1e-12)
    alone = jnp.stack([jax.grad(end)(friction, 0.01) for friction in frictions])
    np.testing.assert_allclose(reverse[0], alone, rtol=1e-12, atol=1e-15)


def test_derivatives_on_a_grid():
    """A ball that rolls on a sampled one: forward mode, reverse mode and differences."""
    bodies = [
        dano.Body("ball", dano.Sphere(0.02), mass=0.3),
        dano.Body("grid", grid("quadratic"), fixed=True),
        # Beside it, so that kernels are those of most scenes with sampled bodies.
        dano.Body("box", dano.Box((0.01, 0.01, 0.01)), fixed=True),
    ]
    contacts = [dano.Contact("ball", "grid"), dano.Contact("ball", "box")]
    scene = dano.Scene.create(bodies, contacts, timestep=H)
    state = scene.initial_state(
        ball=dict(position=(0.003, 0.002, 0.0598), velocity=(0.1, 0, 0)), box=dict(position=(0.2, 0, 0))
    )

    def end(speed):
        moved = eqx.tree_at(lambda s: s.velocity, state, state.velocity.at[0].add(speed))
        return dano.simulate(scene, moved, 3).states.velocity[-1, 0]

    forward, reverse = jax.jit(jax.jacfwd(end))(jnp.zeros(3)), jax.jit(jax.jacrev(end))(jnp.zeros(3))
    np.testing.assert_allclose(forward, reverse, rtol=1e-8, atol=1e-10)
    differences = [(end(1e-6 * unit) - end(-1e-6 * unit)) / 2e-6 for unit in jnp.eye(3)]
    np.testing.assert_allclose(forward, jnp.stack(differences, axis=1), rtol=1e-5, atol=1e-6)


def test_second_derivatives_are_refused(heap):
    """By one error that says what to do instead."""
    scene, states = heap

    def end(speed):
        moved = eqx.tree_at(lambda s: s.velocity, states[-2], states[-2].velocity + speed)
        return jnp.sum(dano.simulate(scene, moved, 1).states.position[-1])

    with pytest.raises(NotImplementedError, match="second derivatives"):
        jax.hessian(end)(0.0)


def test_same_numbers_again(heap):
    """A rollout is bit by bit the same from run to run, alone and among many."""
    scene, states = heap
    runs = [dano.simulate(scene, states[0], 5).states.position for _ in range(2)]
    many = jax.vmap(lambda _: dano.simulate(scene, states[0], 5).states.position)(jnp.arange(5.0))
    np.testing.assert_array_equal(runs[0], runs[1])
    np.testing.assert_array_equal(many, jnp.broadcast_to(runs[0], many.shape))


def test_single_precision(heap):
    """Numbers of 32 bits go in and come out; a step is that of the same numbers with 64."""
    scene, states = heap

    def cast(tree, dtype):
        return jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, tree)

    short = cast((scene, states[2]), jnp.float32)
    step, exact = dano.step(*short), dano.step(*cast(short, jnp.float64))
    assert step.velocity.dtype == jnp.float32
    np.testing.assert_allclose(step.velocity, exact.velocity, atol=1e-5)
    np.testing.assert_allclose(step.position, exact.position, atol=1e-6)


def test_unions():
    """A body of two parts stands on the lower one."""
    two = dano.union(dano.Box((0.05, 0.05, 0.03)), dano.posed(dano.Sphere(0.03), Pose((0.0, 0.0, 0.04))))
    bodies = [dano.Body("two", two, mass=1.0), dano.Body("floor", dano.HalfSpace(), fixed=True)]
    scene = dano.Scene.create(bodies, [dano.Contact("two", "floor")], timestep=H)
    run = dano.simulate(scene, scene.initial_state(two=dict(position=(0, 0, 0.05))), 100)
    assert bool(jnp.all(run.converged))
    assert float(jnp.abs(run.states.velocity[-1, 0]).max()) < 1e-6


class _Viscous(AbstractContactLaw):
    """A law of one's own that no kernel knows."""

    @property
    def reads(self):
        return ("sliding_friction", "stiffness")

    @property
    def presses(self):
        return True


@pytest.mark.filterwarnings("ignore::dano.scene.SceneWarning")
def test_laws_that_no_step_would_ask():
    """They are refused before the first step, by name."""
    bodies = [
        dano.Body("ball", dano.Sphere(0.03), mass=1.0),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    params = dano.ContactParams(stiffness=1e5)
    scene = dano.Scene.create(bodies, [dano.Contact("ball", "floor", params, law=_Viscous())], timestep=H)
    with pytest.raises(ValueError, match="_Viscous"):
        dano.simulate(scene, scene.initial_state(ball=dict(position=(0, 0, 0.1))), 3)


@pytest.mark.parametrize("height", [0.2, 0.55, 1.2])
def test_fast_small_bodies_rebound(height):
    """A ball of 1 cm that falls by several of its radii in a step rises to e² of its height."""
    scene = dano.Scene.create(
        [dano.Body("ball", dano.Sphere(0.01), mass=0.01), dano.Body("floor", dano.HalfSpace(), fixed=True)],
        [dano.Contact("ball", "floor", dano.ContactParams(restitution=0.8))],
        timestep=0.01,
    )
    run = dano.simulate(scene, scene.initial_state(ball=dict(position=(0, 0, 0.01 + height))), 60)
    z, speed = (np.asarray(x[:, 0, 2]) for x in (run.states.position, run.states.velocity))
    # A velocity is that of half a step before: of the parabola through these places the vertex is at …
    h, g = 0.01, 9.81
    vertex = z + (speed - 0.5 * h * g) ** 2 / (2 * g)
    before = speed.argmin()
    # The impact happens where the ball has sunk in by .5 % of its size, and half of its edge.
    met = 0.01 - 0.005 * 0.02 * 1.005
    np.testing.assert_allclose(vertex[before + 2] - met, 0.8**2 * (vertex[before] - met), rtol=5e-3)


@pytest.mark.parametrize("height", [0.3, 0.45, 0.7])
def test_thin_tables_hold(height):
    """A plate does not pass a table of .1 mm."""
    scene = dano.Scene.create(
        [
            dano.Body("plate", dano.Box((0.06, 0.01, 0.004)), mass=0.08),
            dano.Body("table", dano.Box((0.5, 0.5, 5e-5)), fixed=True),
        ],
        [dano.Contact("plate", "table")],
        timestep=0.001,
    )
    start = scene.initial_state(
        plate=dict(position=(0.05, 0.02, 0.15 + height)), table=dict(position=(0, 0, 0.15))
    )
    run = dano.simulate(scene, start, 700)
    np.testing.assert_allclose(float(run.states.position[-1, 0, 2]), 0.15405, atol=1e-4)
