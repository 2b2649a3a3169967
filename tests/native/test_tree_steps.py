"""Steps of bodies on joints in machine code against XLA's: the same states and the same derivatives."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.engine import _variational
from dano.engine._newton import SolverOptions
from dano.engine._problem import prepare
from dano.scene import Control, filled, State

H = 2e-3
# What steps are differentiated by, besides parameters of contacts.
MOVING = (
    *("position", "orientation", "velocity", "omega", "q", "v", "force", "torque", "effort", "command"),
    *("mass", "mass_scale", "com", "com_offset", "axis", "anchor", "ratio", "shift", "timestep", "gravity"),
    *("damping", "armature", "stiffness", "rest", "friction", "limits", "motor"),
    *("smoothing", "regularizer", "stiction_velocity"),
)


def scene_of(joints, *, bodies=(), gravity=(0, 0, -9.81)):
    """Boxes of random sizes on joints, given as (parent, name, kind, laws), and other bodies."""
    rng = np.random.default_rng(5)
    boxes, made = list(bodies), []
    for parent, name, kind, laws in joints:
        box = dano.Box(tuple(rng.uniform(0.03, 0.2, 3)))
        boxes.append(dano.Body(name, box, mass=rng.uniform(0.3, 2), com=rng.uniform(-0.05, 0.05, 3)))
        where = {key: rng.uniform(-0.2, 0.2, 3) for key in ("anchor", "position")}
        turn = rng.normal(size=4)
        made.append(
            dano.Joint(parent, name, kind, axis=rng.normal(size=3), orientation=turn, **where, **laws)
        )
    return dano.Scene.create(boxes, joints=made, timestep=H, gravity=gravity)


@pytest.fixture(scope="module")
def all_kinds():
    """A branching tree on a body that floats, another on a fixed one, a body alone; all kinds and laws."""
    position = dano.Motor("position", stiffness=200.0, damping=5.0, gear=-1.5, limits=(-3, 2))
    velocity = dano.Motor("velocity", damping=5.0, limits=(-1, 2))
    joints = [
        ("base", "arm", "hinge", dict(limits=(-0.1, 0.3), damping=0.1, armature=0.05, motor=position)),
        ("arm", "rod", "slide", dict(friction=2.0, stiffness=30.0, rest=0.1)),
        ("arm", "copy", "hinge", dict(mimics="arm", ratio=-1.7, shift=0.2, friction=0.4)),
        ("copy", "hand", "ball", dict(damping=0.1, friction=0.2, stiffness=3.0)),
        ("hand", "tip", "weld", {}),
        ("base", "cart", "planar", dict(friction=1.0, damping=0.2)),
        ("wall", "door", "hinge", dict(limits=(-np.inf, 0.2), motor=velocity)),
        ("door", "bolt", "slide", dict(limits=(-0.2, 0.2), motor=dano.Motor(gear=2.0, limits=(-1, 2)))),
    ]
    others = [
        dano.Body("base", dano.Box((0.2, 0.1, 0.05)), mass=2.0),
        dano.Body("wall", dano.Box((0.2, 0.1, 0.05)), fixed=True),
        dano.Body("alone", dano.Box((0.1, 0.05, 0.02)), mass=0.5),
    ]
    # Parents after children, too.
    return scene_of(joints, bodies=[others[2], *others[:2]])


def random_states(scene, speeds, spin=1.0):
    """One state and control for each speed, stacked; bodies spin so many times as fast as joints move."""
    rng, n, k = np.random.default_rng(7), len(scene.bodies), scene.layout.n_joints
    moves = np.array([[not body.fixed] for body in scene.bodies], float)
    states, controls = [], []
    for speed in speeds:
        turn = rng.normal(size=(n, 4))
        state = State(
            jnp.asarray(rng.uniform(-1, 1, (n, 3))),
            jnp.asarray(turn / np.linalg.norm(turn, axis=1, keepdims=True)),
            jnp.asarray(moves * rng.normal(size=(n, 3))),
            jnp.asarray(spin * speed * moves * rng.normal(size=(n, 3))),
            jnp.asarray(rng.uniform(-0.4, 0.4, k)),
            jnp.asarray(speed * rng.normal(size=k)),
        )
        states.append(scene.filled(state))
        pushes = [jnp.asarray(x * rng.normal(size=(n, 3))) for x in (1.0, 0.1)]
        controls.append(Control(*pushes, *(jnp.asarray(x * rng.normal(size=k)) for x in (1.0, 3.0))))
    return jax.tree.map(lambda *x: jnp.stack(x), *states), jax.tree.map(lambda *x: jnp.stack(x), *controls)


def stepped(scene, state, control, native=True):
    """A step in machine code, or by XLA."""
    prepared = prepare(scene, None)
    assert prepared.trees is not None
    if not native:
        prepared = dataclasses.replace(prepared, trees=None)
    return _variational.step(scene, prepared, state, control, SolverOptions())


def test_steps_alike(all_kinds):
    """At all speeds: joints that stick, slip and stop, full motors, spins that a step does not resolve."""
    usual = random_states(all_kinds, [0.0, 0.01, 0.1, 1.0, 1.0, 5.0, 5.0, 20.0, 100.0, 400.0])
    fast = random_states(all_kinds, [0.1, 1.0], spin=500.0)
    states, controls = jax.tree.map(lambda *x: jnp.concatenate(x), usual, fast)

    @jax.jit
    def both(states, controls):
        native = jax.vmap(lambda *x: stepped(all_kinds, *x))(states, controls)
        # One by one, which compiles faster.
        return native, jax.lax.map(lambda x: stepped(all_kinds, *x, native=False), (states, controls))

    (found, report), (expected, slow) = both(states, controls)
    solved = np.asarray(slow.converged)
    assert solved[:9].all()
    np.testing.assert_array_equal(report.converged, solved)
    passes = [np.asarray(x.iterations)[solved] for x in (report, slow)]
    assert np.abs(passes[0] - passes[1]).max() <= 2
    for name in ("position", "orientation", "velocity", "omega", "q", "v"):
        for a, b in zip(getattr(found, name)[solved], getattr(expected, name)[solved], strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-9 * (1 + float(jnp.abs(b).max())), err_msg=name)
    # Without a control it is that of zeros.
    state, none = jax.tree.map(lambda x: x[3], states), all_kinds.control()
    a, b = (dano.step(all_kinds, state, control) for control in (None, none))
    np.testing.assert_array_equal(a.velocity, b.velocity)


def test_derivatives_alike():
    """By all numbers of scene, state and control; limits and friction take part. Both modes agree.

    Bodies on joints stay where their joints put them, inertias symmetric, quaternions of length 1.
    """
    joints = [
        ("base", "arm", "hinge", dict(limits=(-0.1, 0.1), damping=0.1, armature=0.05)),
        ("arm", "copy", "slide", dict(mimics="arm", ratio=-0.7, shift=0.2, friction=0.4)),
        ("arm", "hand", "ball", dict(damping=0.1, friction=0.2, stiffness=3.0)),
    ]
    scene = scene_of(joints, bodies=[dano.Body("base", dano.Box((0.2, 0.1, 0.05)), mass=2.0)])
    states, controls = random_states(scene, [2.0])
    assert_derivatives_agree(scene, *jax.tree.map(lambda x: x[0], (states, controls)))


def random_way(numbers, rng, moves):
    """A random change of all that steps are differentiated by.

    Inertias stay symmetric, quaternions of length 1; what is fixed has no velocity.
    """

    def allowed(path, number):
        way, name = jnp.asarray(rng.normal(size=number.shape)), jax.tree_util.keystr(path)
        if name.endswith(".orientation"):
            along = jnp.sum(way * number, axis=-1, keepdims=True)
            return way - number * along / jnp.sum(number**2, axis=-1, keepdims=True)
        if name.endswith(".inertia"):
            return 0.5 * (way + way.T)
        if name.endswith((".velocity", ".omega")):
            return way * jnp.broadcast_to(moves, way.shape)
        # Samples and shapes of bodies say where they touch; that is not a matter of this code.
        return way if name.split(".")[-1] in MOVING or ".params." in name else jnp.zeros_like(way)

    return jax.tree_util.tree_map_with_path(allowed, numbers)


def assert_derivatives_agree(scene, *given):
    """The derivative of a step along a random way, in machine code, by XLA, and in reverse mode."""
    numbers, rest = eqx.partition((scene, *given), eqx.is_inexact_array)
    rng, moves = np.random.default_rng(0), np.array([[not body.fixed] for body in scene.bodies], float)
    way = random_way(numbers, rng, moves)

    def end(numbers, native):
        moved, state, control = eqx.combine(numbers, rest)
        following, _ = stepped(moved, moved.filled(state), control, native=native)
        return jnp.concatenate([x.ravel() for x in jax.tree.leaves(following)])

    weights = jnp.asarray(rng.normal(size=jax.eval_shape(lambda x: end(x, True), numbers).shape))

    @jax.jit
    def derivatives(numbers):
        forward = [jax.jvp(lambda x, n=n: end(x, n), (numbers,), (way,))[1] for n in (True, False)]
        return *forward, jax.grad(lambda x: weights @ end(x, True))(numbers)

    found, expected, gradient = derivatives(numbers)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * float(jnp.abs(expected).max()))
    slope = sum(jnp.vdot(a, b) for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(way), strict=True))
    np.testing.assert_allclose(slope, weights @ found, rtol=1e-9)


def touching(law, joints=None):
    """A floating tree whose last body and root touch a floor, a ball and each other, with the paper's law."""
    ball = dano.Body("ball", dano.Sphere(0.15), mass=0.7)
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    base = dano.Body("base", dano.Box((0.4, 0.3, 0.2)), mass=2.0)
    tip = dano.Body("tip", dano.Box((0.3, 0.2, 0.2)), mass=0.8, com=(0.02, -0.03, 0.01))
    arm = dano.Body("arm", dano.Capsule(0.05, 0.2), mass=0.5)
    joints = [
        dano.Joint("base", "arm", axis=(0, 1, 0), position=(0.2, 0, 0), damping=0.1),
        dano.Joint("arm", "tip", "ball", position=(0.1, 0.05, 0), friction=0.1),
    ]
    pairs = [("base", "floor"), ("floor", "tip"), ("tip", "ball"), ("base", "tip"), ("ball", "floor")]
    contacts = [dano.Contact(*pair, dano.ContactParams(sliding_friction=0.4), law) for pair in pairs]
    return dano.Scene.create([ball, base, arm, tip, floor], contacts, joints=joints, timestep=H)


def pressed_states(scene, count):
    """States in which all touch: some fall, some slide, some rest; stacked, with controls."""
    rng = np.random.default_rng(3)
    states, controls = [], []
    for k in range(count):
        speed = [0.0, 0.3, 2.0][k % 3]
        turn = np.array([1, 0.02, -0.03, 0]) + 0.02 * rng.normal(size=4)
        base = dict(
            position=(0, 0, 0.085),
            orientation=turn / np.linalg.norm(turn),
            velocity=speed * rng.normal(size=3),
            omega=speed * rng.normal(size=3),
        )
        arm, tip = dict(q=0.1, v=speed * rng.normal()), dict(q=0.1 * rng.normal(size=3), v=speed * np.ones(3))
        ball = dict(position=(0.47, 0.1, 0.14), velocity=speed * rng.normal(size=3))
        states.append(scene.initial_state(base=base, arm=arm, tip=tip, ball=ball))
        push = scene.control()
        controls.append(dataclasses.replace(push, effort=jnp.asarray(rng.normal(size=4))))
    return jax.tree.map(lambda *x: jnp.stack(x), *states), jax.tree.map(lambda *x: jnp.stack(x), *controls)


LAWS = {
    "smooth": dano.CentroidLaw(),
    "adhesive": dano.CentroidLaw(adhesive=True, smoothing=10.0),
    "sticking": dano.CentroidLaw(stiction_velocity=1e-7),
}


@pytest.mark.parametrize("name", LAWS)
def test_steps_in_contact_alike(name):
    """Bodies of a tree on a floor, on a free body and on each other; friction that creeps or sticks."""
    scene = touching(LAWS[name])
    states, controls = pressed_states(scene, 9)
    patches = jax.vmap(lambda s: _variational.touch(scene, prepare(scene, None), s).overlap)(states)
    assert (np.asarray(patches) > 0).all(axis=0).sum() >= 4

    @jax.jit
    def both(states, controls):
        return [
            jax.lax.map(lambda x, n=n: stepped(scene, *x, native=n), (states, controls))
            for n in (True, False)
        ]

    (found, report), (expected, slow) = both(states, controls)
    assert bool(slow.converged.all()) and bool(report.converged.all())
    for key in ("position", "orientation", "velocity", "omega", "q", "v"):
        a, b = getattr(found, key), getattr(expected, key)
        np.testing.assert_allclose(a, b, rtol=0, atol=2e-8 * (1 + float(jnp.abs(b).max())), err_msg=key)


def test_derivatives_in_contact_alike():
    """By all numbers of scene, state and control, of contacts, too."""
    scene = touching(LAWS["smooth"])
    states, controls = pressed_states(scene, 3)
    assert_derivatives_agree(scene, *jax.tree.map(lambda x: x[1], (states, controls)))


def test_filled_states_alike(all_kinds, monkeypatch):
    """Poses and velocities of bodies on joints, and their derivatives, in machine code and by XLA."""
    states, _ = random_states(all_kinds, [0.0, 1.0, 20.0])
    numbers, rest = eqx.partition((all_kinds.chains, states), eqx.is_inexact_array)
    moves = np.array([[not body.fixed] for body in all_kinds.bodies], float)
    way = random_way(numbers, np.random.default_rng(2), moves)
    # The axis of a planar joint has length 1.
    axis, change = numbers[0].axis, way[0].axis
    change = change - axis * jnp.sum(axis * change, axis=1, keepdims=True)
    way = eqx.tree_at(lambda w: w[0].axis, way, change)

    def fill(numbers):
        chains, given = eqx.combine(numbers, rest)
        return jax.vmap(lambda state: filled(chains, state, jnp.asarray(H)))(given)

    found = jax.jit(lambda: jax.jvp(fill, (numbers,), (way,)))()
    monkeypatch.setattr("dano.scene._frames.fills_natively", lambda: False)
    expected = jax.jit(lambda: jax.jvp(fill, (numbers,), (way,)))()
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        # XLA's velocities are differences of poses, which rounds to 1e-16 / h.
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-9 * (1 + float(jnp.abs(b).max())))


def test_single_precision(all_kinds):
    """Numbers of 32 bits go in and come out; a step agrees with one of 64 to their resolution."""
    states, controls = random_states(all_kinds, [1.0])
    state, control = jax.tree.map(lambda x: x[0], (states, controls))
    short = lambda tree: jax.tree.map(  # noqa: E731
        lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, tree
    )
    exact, step = dano.step(all_kinds, state, control), dano.step(*short((all_kinds, state, control)))
    for name in ("position", "orientation", "velocity", "omega", "q", "v"):
        assert getattr(step, name).dtype == jnp.float32
        np.testing.assert_allclose(getattr(step, name), getattr(exact, name), atol=1e-3, err_msg=name)
    mixed = dano.step(all_kinds, state, short(control))
    np.testing.assert_allclose(mixed.velocity, exact.velocity, rtol=0, atol=1e-4)


def test_momenta_of_a_chain_stay_to_rounding():
    """Four seconds of a floating chain of seven hinges: momentum, and the way of the centre of mass."""
    joints = [(f"link {i}", f"link {i + 1}", "hinge", {}) for i in range(7)]
    first = dano.Body("link 0", dano.Capsule(0.03, 0.1), mass=0.5)
    scene = scene_of(joints, bodies=[first], gravity=(0, 0, 0))
    given: dict[str, dict] = {f"link {i + 1}": dict(q=0.2, v=(-1) ** i * 1.5) for i in range(7)}
    given["link 0"] = dict(velocity=(0.2, 0, 0.1), omega=(1, 0.5, -1))
    run = dano.simulate(scene, scene.initial_state(**given), 2000)
    assert bool(run.converged.all())
    mass = np.array([float(body.mass) for body in scene.bodies])
    momentum = np.einsum("n,tnk->tk", mass, run.states.velocity)[1:]
    assert np.abs(momentum - momentum[0]).max() < 1e-11
    centre = np.einsum("n,tnk->tk", mass, run.states.position)[1:]
    np.testing.assert_allclose(centre - centre[0], np.outer(H * np.arange(2000), momentum[0]), atol=1e-11)


def test_which_steps_are_native(all_kinds):
    """Those of trees without loops whose contacts have the paper's law; others go the way of all scenes."""
    assert prepare(all_kinds, None).trees is not None
    assert prepare(touching(LAWS["smooth"]), None).trees is not None

    class Other(dano.CentroidLaw):
        def __init__(self):
            super().__init__()

    assert prepare(touching(Other()), None).trees is None
    bodies = [dano.Body("a", dano.Sphere(0.1), mass=1.0), dano.Body("b", dano.Sphere(0.1), mass=1.0)]
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    hinges = [dano.Joint(None, name, position=(x, 0, 1)) for name, x in (("a", 0.0), ("b", 1.0))]
    loop = dano.Loop("a", "b", position=(1, 0, 0))
    contact = dano.Contact("a", "floor")
    apart = dano.Scene.create(bodies, timestep=H)
    closed = dano.Scene.create(bodies, joints=hinges, loops=[loop], timestep=H)
    points = dano.Scene.create([*bodies, floor], [contact], joints=hinges, timestep=H)
    for scene in (apart, closed, points):
        assert prepare(scene, None).trees is None
