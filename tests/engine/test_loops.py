"""Loops: a four-bar against its own equation, chains closed by loops against trees, momentum, derivatives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from engine.trees import coordinates, value_and_forward
from scipy.integrate import solve_ivp

import dano
from dano.mujoco import MuJoCoEngine

CRANK, COUPLER, ROCKER, GROUND, G = 0.2, 0.5, 0.4, 0.45, 9.81
MASSES = (0.5, 0.8, 0.6)
SECTION = 0.01


def bar(name, length, mass):
    return dano.Body(name, dano.Box((length / 2, SECTION, SECTION)), mass=mass)


def four_bar(timestep=1e-3, **crank):
    """Three rods that turn about y; the coupler's far end is the rocker's."""
    lengths = (CRANK, COUPLER, ROCKER)
    bodies = [bar(*row) for row in zip(("crank", "coupler", "rocker"), lengths, MASSES, strict=True)]
    near = [(-length / 2, 0, 0) for length in lengths]
    joints = [
        dano.Joint(None, "crank", axis=(0, 1, 0), anchor=near[0], position=(CRANK / 2, 0, 0), **crank),
        dano.Joint(
            "crank", "coupler", axis=(0, 1, 0), anchor=near[1], position=((CRANK + COUPLER) / 2, 0, 0)
        ),
        dano.Joint(None, "rocker", axis=(0, 1, 0), anchor=near[2], position=(GROUND + ROCKER / 2, 0, 0)),
    ]
    loop = dano.Loop("coupler", "rocker", position=(COUPLER / 2, 0, 0), anchor=(ROCKER / 2, 0, 0))
    return dano.Scene.create(bodies, contacts=(), joints=joints, loops=[loop], timestep=timestep)


def directions(crank):
    """Angles of coupler and rocker in the plane from the crank's; a turn about y is negative there."""
    end = CRANK * jnp.stack([jnp.cos(crank), jnp.sin(crank)])
    across = jnp.array([GROUND, 0.0]) - end
    length = jnp.sqrt(across @ across)
    apart = jnp.arccos((COUPLER**2 + length**2 - ROCKER**2) / (2 * COUPLER * length))
    coupler = jnp.arctan2(across[1], across[0]) + apart
    top = end + COUPLER * jnp.stack([jnp.cos(coupler), jnp.sin(coupler)]) - jnp.array([GROUND, 0.0])
    return coupler, jnp.arctan2(top[1], top[0])


def lagrangian(crank, speed):
    """Kinetic and potential energy with the crank's angle as the only coordinate."""

    def places(angle):
        coupler, rocker = directions(angle)
        turns = jnp.stack([angle, coupler, rocker])
        along = jnp.stack([jnp.cos(turns), jnp.sin(turns)], axis=1)
        halves = along * jnp.array([[CRANK], [COUPLER], [ROCKER]]) / 2
        roots = jnp.stack([jnp.zeros(2), CRANK * along[0], jnp.array([GROUND, 0.0])])
        return roots + halves, turns

    mass = jnp.array(MASSES)
    inertia = mass * (jnp.array([CRANK, COUPLER, ROCKER]) ** 2 / 12 + (2 * SECTION) ** 2 / 12)
    (centres, _), (moving, turning) = jax.jvp(places, (crank,), (speed,))
    kinetic = 0.5 * jnp.sum(mass * jnp.sum(moving**2, axis=1) + inertia * turning**2)
    return kinetic, G * jnp.sum(mass * centres[:, 1])


@jax.jit
def reduced(_, z):
    """Lagrange's equation of the crank's angle."""
    angle, speed = z

    def momentum(angle, speed):
        return jax.grad(lambda w: lagrangian(angle, w)[0])(speed)

    pull = jax.grad(lambda a: lagrangian(a, speed)[0] - lagrangian(a, speed)[1])(angle)
    by_angle, by_speed = jax.grad(momentum, (0, 1))(angle, speed)
    return jnp.stack([speed, (pull - by_angle * speed) / by_speed])


def on_its_way(scene, crank, speed=0.0):
    state = scene.initial_state(
        crank=dict(q=-crank, v=-speed), coupler=dict(q=crank - 1.4), rocker=dict(q=-1.9)
    )
    return dano.close_loops(scene, state, hold=["crank"])


@pytest.fixture(scope="module")
def swung():
    """Two seconds of the falling four-bar."""
    scene = four_bar()
    before = solve_ivp(reduced, (0, -0.5e-3), [0.9, 0.0], rtol=1e-12, atol=1e-12).y[1, -1]
    state = on_its_way(scene, 0.9, before)
    return scene, state, dano.simulate(scene, state, 2000)


def gaps_of(scene, states):
    return np.asarray(jax.vmap(scene.closing.gaps)(states.position, states.orientation))


@pytest.mark.parametrize("kind", ["point", pytest.param("weld", marks=pytest.mark.slow)])
def test_loops_swing_in_mujoco_as_here(swung, kind):
    pytest.importorskip("mujoco")
    scene, state, run = swung
    if kind == "weld":
        # Two rods in line swing as one.
        bodies = [bar("one", 0.2, 0.3), bar("two", 0.2, 0.3)]
        near = (-0.1, 0, 0)
        joints = [
            dano.Joint(None, "one", axis=(0, 1, 0), anchor=near, position=(0.1, 0, 0)),
            dano.Joint("one", "two", "ball", anchor=near, position=(0.2, 0, 0)),
        ]
        loop = dano.Loop("one", "two", "weld", position=(0.1, 0, 0), anchor=near)
        scene = dano.Scene.create(bodies, contacts=(), joints=joints, loops=[loop], timestep=1e-3)
        state = scene.initial_state()
        run = dano.simulate(scene, state, 400)
    theirs = dano.simulate(scene, state, 400, engine=MuJoCoEngine(scene))
    n = len(scene.bodies)
    ours = np.asarray(run.states.position)[:401, :n]
    # MuJoCo's equalities give way; both engines are of first order in the timestep.
    assert np.abs(np.asarray(theirs.states.position) - ours).max() < 0.01
    assert np.abs(gaps_of(scene, theirs.states)).max() < 2e-3
    assert np.linalg.norm(ours[-1] - ours[0], axis=1).max() > 0.1


def test_loops_are_closed_at_the_start(swung):
    _, state, _ = swung
    q, _ = coordinates(state)
    coupler, rocker = directions(0.9)
    np.testing.assert_allclose(-q[0], 0.9)
    np.testing.assert_allclose(-q[0] - q[1], coupler, atol=1e-9)
    np.testing.assert_allclose(-q[2], rocker, atol=1e-9)


def test_four_bar_against_its_equation(swung):
    """Gaps stay at rounding, the angles follow Lagrange's equation, and energy has no trend."""
    scene, _, run = swung
    assert bool(run.converged.all())
    assert np.abs(gaps_of(scene, run.states)).max() <= 1e-12
    exact = solve_ivp(reduced, (0, 1), [0.9, 0.0], method="DOP853", rtol=1e-11, atol=1e-11).y[0, -1]
    assert abs(-coordinates(run.states)[0][1000, 0] - exact) < 2e-4
    mass = np.array(MASSES)
    inertia = np.stack([np.asarray(body.inertia) for body in scene.bodies])
    velocity, omega = np.asarray(run.states.velocity), np.asarray(run.states.omega)
    kinetic = 0.5 * np.einsum("n,tna->t", mass, velocity**2)
    kinetic += 0.5 * np.einsum("tna,nab,tnb->t", omega, inertia, omega)
    potential = G * np.asarray(run.states.position)[:, :, 2] @ mass
    energy = 0.5 * (kinetic[:-1] + kinetic[1:]) + potential[:-1]
    assert np.ptp(energy) < 1e-4 * np.ptp(potential)
    trend = np.polyfit(np.linspace(0, 1, len(energy)), energy, 1)[0]
    assert abs(trend) < 1e-4 * np.ptp(potential)


@pytest.mark.slow
def test_derivatives_of_a_four_bar(swung):
    """By the crank's torque and a length of the loop, against differences at large and small steps."""
    scene, state, _ = swung

    def ends(x):
        changed = dataclasses.replace(scene, loops=(dataclasses.replace(scene.loops[0], position=x[1:]),))
        effort = jnp.zeros((60, 3)).at[:, 0].set(x[0])
        still = jnp.zeros((60, 3, 3))
        states = dano.simulate(changed, state, controls=dano.Control(still, still, effort)).states
        assert states.q is not None
        return states.q[-1]

    at = jnp.array([0.1, COUPLER / 2, 0.0, 0.0])
    _, slope = value_and_forward(ends)(at)
    run = jax.jit(ends)
    # A length changes by little here: the first step jumps to the closed loop at once.
    for place, steps in ((0, (1e-2, 1e-5)), (1, (1e-5, 1e-7))):
        for step in steps:
            unit = step * jnp.eye(4)[place]
            measured = (run(at + unit) - run(at - unit)) / (2 * step)
            np.testing.assert_allclose(slope[:, place], measured, rtol=2e-3, atol=1e-6)


def chain(closed, weld=False):
    """Two rods in a row that float; the second hangs on a joint, or moves on a plane with a loop."""
    bodies = [
        dano.Body("base", dano.Box((0.2, 0.1, 0.05)), mass=2.0),
        bar("rod", CRANK, 0.7),
        bar("end", CRANK, 0.4),
    ]
    half = CRANK / 2
    hinge = dano.Joint("base", "rod", axis=(0, 1, 0), anchor=(-half, 0, 0), position=(0.2 + half, 0, 0))
    plane = dano.Joint("base", "end", "planar", axis=(0, 1, 0))
    kind = "weld" if weld else "hinge"
    hangs = dano.Joint("rod", "end", kind, axis=(0, 1, 0), anchor=(-half, 0, 0), position=(CRANK, 0, 0))
    loop = dano.Loop("rod", "end", "weld" if weld else "point", position=(half, 0, 0), anchor=(-half, 0, 0))
    scene = dano.Scene.create(
        bodies,
        contacts=(),
        joints=[hinge, plane if closed else hangs],
        loops=[loop] if closed else [],
        timestep=2e-3,
        gravity=(0, 0, 0),
    )
    return scene


@pytest.fixture(scope="module", params=["point", pytest.param("weld", marks=pytest.mark.slow)])
def tumbling(request):
    """The same chain as a tree and by a loop, from the same two poses."""
    weld = request.param == "weld"
    tree, looped = chain(closed=False, weld=weld), chain(closed=True, weld=weld)
    start: dict[str, dict] = dict(
        base=dict(velocity=(0.1, 0.2, 0.0), omega=(1.0, 2.0, -1.0)), rod=dict(q=0.4, v=3.0)
    )
    if not weld:
        start["end"] = dict(q=-0.7, v=-1.0)
    run = dano.simulate(tree, tree.initial_state(**start), 401)
    first, second = (jax.tree.map(lambda x, t=t: x[t], run.states) for t in (0, 1))
    before, q = (looped.joint_values(state)[0] for state in (first, second))
    state = dataclasses.replace(second, q=q, v=(q - before) / looped.timestep)
    return run, looped, dano.simulate(looped, state, 400)


def test_chain_closed_by_a_loop_moves_like_a_tree(tumbling):
    """A joint and a loop are the same constraint: all poses agree to rounding."""
    tree, looped, run = tumbling
    assert bool(run.converged.all())
    assert np.abs(gaps_of(looped, run.states)).max() <= 1e-12
    np.testing.assert_allclose(run.states.position, tree.states.position[1:], atol=1e-10)
    alike = np.abs(np.sum(np.asarray(run.states.orientation * tree.states.orientation[1:]), axis=-1))
    np.testing.assert_allclose(alike, 1, atol=1e-10)


def test_momentum_of_a_floating_chain_with_a_loop(tumbling):
    """Momentum stays to rounding."""
    _, looped, run = tumbling
    mass = np.array([float(body.mass) for body in looped.bodies])[:, None]
    momentum = np.sum(mass * np.asarray(run.states.velocity), axis=1)
    assert np.abs(momentum[1:] - momentum[1]).max() <= 1e-9


@pytest.mark.slow
def test_loops_with_friction_limits_and_contact():
    """Joints stick and stop, and bodies touch, while loops stay closed."""
    scene = four_bar(friction=5.0)
    state = on_its_way(scene, 0.9)
    held = dano.simulate(scene, state, 100)
    assert bool(held.converged.all())
    np.testing.assert_allclose(coordinates(held.states)[0][-1], coordinates(state)[0], atol=1e-7)
    stop = coordinates(state)[0][0] + 0.1
    limited = dano.simulate(four_bar(limits=(-3.0, stop)), state, 600)
    q = coordinates(limited.states)[0][:, 0]
    assert bool(limited.converged.all())
    assert stop - 1e-3 < q[-1] < stop + 1e-4
    assert np.abs(gaps_of(scene, limited.states)).max() <= 1e-12
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    low = -0.12
    bodies = [*scene.bodies, floor]
    touching = dano.Scene.create(
        bodies,
        [dano.Contact("crank", "floor", dano.ContactParams(sliding_friction=0.3))],
        joints=four_bar().joints,
        loops=scene.loops,
        timestep=1e-3,
    )
    lifted = touching.initial_state(
        crank=dict(q=-0.9), coupler=dict(q=-0.5), rocker=dict(q=-1.9), floor=dict(position=(0, 0, low))
    )
    lying = dano.simulate(touching, dano.close_loops(touching, lifted, ["crank"]), 800)
    assert bool(lying.converged.all())
    assert np.abs(gaps_of(touching, lying.states)).max() <= 1e-12
    # The crank's end rests on the floor.
    lowest = CRANK * np.sin(coordinates(lying.states)[0][-1, 0]) + SECTION
    np.testing.assert_allclose(lowest, -low, atol=3e-3)


def test_open_loops_and_wrong_ones_are_said():
    scene = four_bar()
    with pytest.raises(ValueError, match=r"must close the loops .* gap of 0.15 .*close_loops"):
        dano.simulate(scene, scene.initial_state(), 3)
    far = dano.Scene.create(
        scene.bodies,
        contacts=(),
        joints=scene.joints,
        loops=[dano.Loop("coupler", "rocker", position=(5.0, 0, 0), anchor=(0, 0, 0))],
    )
    with pytest.raises(ValueError, match="loops must be closed by the joints, got a gap of .* 'coupler' and"):
        dano.close_loops(far, far.initial_state())
    with pytest.raises(ValueError, match="hold must name bodies on joints .* did you mean 'crank'"):
        dano.close_loops(scene, scene.initial_state(), ["crnk"])
    with pytest.raises(ValueError, match="scene must have loops, got none"):
        dano.close_loops(chain(closed=False), chain(closed=False).initial_state())
    with pytest.raises(ValueError, match="loop must name bodies of the scene .* did you mean 'crank'"):
        dano.Scene.create(scene.bodies, contacts=(), joints=scene.joints, loops=[dano.Loop("crnk", "rocker")])
    with pytest.raises(ValueError, match="loop must close a chain of joints, got 'crank' and 'rocker'"):
        dano.Scene.create(scene.bodies, contacts=(), loops=[dano.Loop("crank", "rocker")])
    with pytest.raises(ValueError, match="kind must be one of point, weld, got 'pin'"):
        dano.Loop("a", "b", "pin")
    with pytest.raises(ValueError, match="loop must join two different bodies, got 'a' twice"):
        dano.Loop("a", "a")
    with pytest.raises(ValueError, match="scene must have no loops, got 1"):
        dano.joint_reactions(scene, on_its_way(scene, 0.9), np.zeros(3))
