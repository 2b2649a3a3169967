"""Bodies on joints: free motion, contact, controls and derivatives, against closed forms and MuJoCo."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from engine.trees import coordinates, mujoco_chain, robot, value_and_forward
from scipy.integrate import solve_ivp

import dano
from dano.maths import quat_rotate

HALF = 0.25
STEPS = 400


@pytest.fixture(scope="module")
def tumbling():
    """Two seconds of a floating robot without gravity."""
    scene, state = robot()
    return scene, dano.simulate(scene, state, 2000)


def test_momentum_and_energy_of_a_floating_tree(tumbling):
    """Both momenta stay to rounding, joints or not; energy to the order of the scheme."""
    scene, run = tumbling
    assert bool(run.converged.all())
    states, h = run.states, float(scene.timestep)
    mass = np.array([float(body.mass) for body in scene.bodies])[:, None]
    inertia = jnp.stack([body.inertia for body in scene.bodies])
    momentum = np.sum(mass * np.asarray(states.velocity), axis=1)
    assert np.abs(momentum - momentum[0]).max() <= 1e-9
    s = jnp.sqrt(4 / h**2 - jnp.sum(states.omega**2, axis=-1, keepdims=True))
    spin = jnp.einsum("nij,tnj->tni", inertia, states.omega)
    own = quat_rotate(states.orientation, 0.5 * h * (s * spin - jnp.cross(states.omega, spin)))
    angular = np.sum(np.cross(states.position, mass * np.asarray(states.velocity)) + np.asarray(own), axis=1)
    assert np.abs(angular - angular[0]).max() <= 1e-9
    energy = 0.5 * np.sum(mass[:, 0] * np.sum(np.square(states.velocity), axis=-1), axis=1) + 0.5 * np.sum(
        np.asarray(spin * states.omega), axis=(1, 2)
    )
    assert np.ptp(energy) <= 3e-6 * energy[0]


def test_free_motion_equals_that_of_mujoco(tumbling):
    """Half a second of the tree; MuJoCo integrates with Runge–Kutta steps of 0.1 ms.

    Velocities of a state are those of half a step before, so MuJoCo starts with what ours are there.
    """
    mujoco = pytest.importorskip("mujoco")
    scene, run = tumbling
    at = 20
    state = jax.tree.map(lambda x: x[at], run.states)
    following = jax.tree.map(lambda x: x[at + 1], run.states)
    middle = {
        key: 0.5 * (getattr(state, key) + getattr(following, key)) for key in ("velocity", "omega", "v")
    }
    _, data = mujoco_chain(mujoco, scene, dataclasses.replace(state, **middle))
    for _ in range(5000):
        mujoco.mj_step(data.model, data)
    reached = jax.tree.map(lambda x: x[at + 500], run.states)
    np.testing.assert_allclose(data.qpos[7:], reached.q, atol=2e-5)
    np.testing.assert_allclose(data.qpos[:3], reached.position[0], atol=1e-5)
    np.testing.assert_allclose(data.qpos[3:7], reached.orientation[0], atol=2e-5)


@pytest.fixture(scope="module")
def pendulum():
    """A rod that hangs from one end; its hinge has an axis along y."""
    rod = dano.Body("rod", dano.Box((0.02, 0.02, HALF)), mass=1.0)
    joint = dano.Joint(None, "rod", axis=(0, 1, 0), anchor=(0, 0, HALF), position=(0, 0, -HALF))

    def scene(timestep, damping=0.0, gravity=(0, 0, -9.81)):
        joints = [dataclasses.replace(joint, damping=jnp.asarray(damping))]
        return dano.Scene.create([rod], joints=joints, timestep=timestep, gravity=gravity)

    return scene, float(rod.inertia[1, 1]) + HALF**2


def test_pendulum_against_its_equation(pendulum):
    """Large swings: the error falls with h², and the energy has no trend."""
    scene, inertia = pendulum

    def rates(_, y):
        return [y[1], -9.81 * HALF * np.sin(y[0]) / inertia]

    errors = []
    for h in (4e-3, 2e-3):
        # The joint's velocity is that of half a step before.
        before = solve_ivp(rates, (0, -0.5 * h), [2.0, 0.0], rtol=1e-12, atol=1e-12).y[1, -1]
        made = scene(h)
        run = dano.simulate(made, made.initial_state(rod=dict(q=2.0, v=before)), STEPS)
        assert bool(run.converged.all())
        exact = solve_ivp(rates, (0, STEPS * h), [2.0, 0.0], rtol=1e-12, atol=1e-12, dense_output=True)
        # Over the same time.
        n = round(0.8 / h)
        errors.append(np.abs(coordinates(run.states)[0][:n, 0] - exact.sol(run.times[:n])[0]).max())
    assert errors[0] <= 1e-3
    assert errors[1] <= errors[0] / 3.5


def test_reverse_mode_equals_forward_mode(pendulum):
    """End of a swing by its start, the damping and the place of the hinge."""
    scene, _ = pendulum
    made = scene(2e-3, 0.2)
    start = made.initial_state(rod=dict(q=1.0))

    def reached(numbers):
        angle, damping, shift = numbers
        place = made.joints[0].anchor.at[2].add(shift)
        moved = made.replace_joint("rod", damping=damping, anchor=place)
        return coordinates_of(dano.simulate(moved, _turned(start, angle), 100).states)[-1, 0]

    at = jnp.array([1.0, 0.2, 0.0])
    run = value_and_forward(reached)
    forward = np.asarray(run(at)[1])
    np.testing.assert_allclose(np.asarray(jax.jit(jax.grad(reached))(at)), forward, rtol=1e-8)
    for step, tolerance in ((1e-2, 1e-3), (1e-5, 1e-6)):
        numeric = [float(run(at + step * u)[0] - run(at - step * u)[0]) / (2 * step) for u in jnp.eye(3)]
        np.testing.assert_allclose(forward, numeric, rtol=tolerance, atol=tolerance)


def _turned(state, angle):
    return dataclasses.replace(state, q=jnp.atleast_1d(angle))


def coordinates_of(states):
    assert states.q is not None
    return states.q


def test_damping_and_effort(pendulum):
    """Without gravity: ω falls by 1 + h d/I each step, and an effort adds h τ/I."""
    scene, inertia = pendulum
    h, damping, effort = 2e-3, 0.3, 0.7
    made = scene(h, damping, (0, 0, 0))
    start = made.initial_state(rod=dict(v=3.0))
    once = made.control(rod=dict(effort=effort))
    controls = jax.tree.map(lambda x: jnp.broadcast_to(x[None], (STEPS, *x.shape)), once)
    for given, drive in ((None, 0.0), (controls, effort)):
        run = dano.simulate(made, start, STEPS, controls=given)
        expected = [3.0]
        for _ in range(STEPS):
            # The pendulum's momentum is (I/h) sin-like in the step's angle; at these speeds I ω to 1e-6.
            expected.append((expected[-1] + h * drive / inertia) / (1 + h * damping / inertia))
        np.testing.assert_allclose(coordinates(run.states)[1][:, 0], expected, rtol=1e-4)


def door_scene(timestep=2e-3, restitution=0.5):
    """A door on a hinge that swings into a ball."""
    door = dano.Body("door", dano.Box((0.4, 0.02, 0.5)), mass=8.0)
    ball = dano.Body("ball", dano.Sphere(0.1), mass=2.0)
    params = dano.ContactParams(sliding_friction=0.0, restitution=restitution)
    hinge = dano.Joint(None, "door", anchor=(-0.4, 0, 0), position=(0.4, 0, 0.6))
    scene = dano.Scene.create(
        [door, ball],
        [dano.Contact("door", "ball", params)],
        joints=[hinge],
        timestep=timestep,
        gravity=(0, 0, 0),
    )
    return scene, scene.initial_state(door=dict(q=-0.3, v=2.0), ball=dict(position=(0.6, 0.13, 0.6)))


@pytest.fixture(scope="module")
def swung():
    scene, state = door_scene()
    return scene, dano.simulate(scene, state, 150)


def test_door_hits_a_ball(swung):
    """A hit by restitution: closed form for both velocities; momentum about the hinge stays."""
    scene, run = swung
    assert bool(run.converged.all())
    states = run.states
    inertia = float(scene.body("door").inertia[2, 2]) + 8.0 * 0.4**2
    spin, position, velocity = (
        np.asarray(x) for x in (coordinates(states)[1][:, 0], states.position[:, 1], states.velocity[:, 1])
    )
    momentum = inertia * spin + 2.0 * (position[:, 0] * velocity[:, 1] - position[:, 1] * velocity[:, 0])
    assert np.abs(momentum - momentum[0]).max() <= 1e-4 * momentum[0]
    impulse = 1.5 * 2.0 * 0.6 / (1 / 2.0 + 0.6**2 / inertia)
    np.testing.assert_allclose(velocity[-1, 1], impulse / 2.0, rtol=2e-2)
    np.testing.assert_allclose(spin[-1], 2.0 - 0.6 * impulse / inertia, rtol=2e-2)
    energy = 0.5 * inertia * spin**2 + 0.5 * 2.0 * np.sum(velocity**2, axis=1)
    assert energy.max() <= energy[0] * (1 + 1e-9)
    wrenches = np.asarray(dano.contact_wrenches(scene, states))[:, 0]
    given = -float(scene.timestep) * wrenches[:, 1].sum()
    np.testing.assert_allclose(given, 2.0 * velocity[-1, 1], rtol=1e-2)


@pytest.mark.slow
def test_derivatives_of_a_push():
    """A door that a torque turns pushes a ball: end of the ball by torque and by the hinge's place."""
    scene, _ = door_scene(timestep=5e-3, restitution=0.0)
    start = scene.initial_state(ball=dict(position=(0.6, 0.12, 0.6)))

    def reached(numbers):
        torque, place = numbers
        made = scene.replace_joint("door", position=scene.joints[0].position.at[0].add(place))
        once = made.control()
        drive = dataclasses.replace(once, effort=jnp.atleast_1d(torque))
        controls = jax.tree.map(lambda x: jnp.broadcast_to(x[None], (60, *x.shape)), drive)
        return dano.simulate(made, start, controls=controls).states.position[-1, 1, 1]

    at = jnp.array([4.0, 0.0])
    run = value_and_forward(reached)
    end, slope = (np.asarray(x) for x in run(at))
    for step, tolerance in ((1e-2, 1e-2), (1e-5, 1e-3)):
        numeric = [float(run(at + step * u)[0] - run(at - step * u)[0]) / (2 * step) for u in jnp.eye(2)]
        np.testing.assert_allclose(slope, numeric, rtol=tolerance, atol=tolerance * abs(slope[0]))
    # Pushed without rest, door and ball are one: τ = (I + m r²) α.
    inertia = float(scene.body("door").inertia[2, 2]) + 8.0 * 0.4**2 + 2.0 * 0.6**2
    np.testing.assert_allclose(end - 0.12, 0.6 * 0.5 * 4.0 / inertia * 0.3**2, rtol=0.05)


def test_linearized_pendulum(pendulum):
    """A and B of a hinge against differences of a step."""
    scene, _ = pendulum
    made = scene(5e-3, 0.2)
    state, small = made.initial_state(rod=dict(q=0.7, v=1.0)), 1e-5
    a, b = dano.linearize(made, state)
    assert a.shape == (2, 2)

    def difference(change):
        ends = [dano.step(made, *change(sign * small)) for sign in (1, -1)]
        q, v = (np.asarray(x) for x in zip(*(coordinates(end) for end in ends), strict=True))
        return np.concatenate([q[0] - q[1], v[0] - v[1]]) / (2 * small)

    none = made.control()
    by_q = difference(lambda s: (dataclasses.replace(state, q=state.q + s), none))
    by_v = difference(lambda s: (dataclasses.replace(state, v=state.v + s), none))
    by_effort = difference(lambda s: (state, made.control(rod=dict(effort=s))))
    np.testing.assert_allclose(a, np.stack([by_q, by_v], axis=1), atol=1e-7)
    np.testing.assert_allclose(np.asarray(b)[:, -1], by_effort, atol=1e-7)


@pytest.mark.slow
def test_linearize_with_joints():
    """A and B against differences of a step, for q, v, efforts and the floating base."""
    scene, state = robot(timestep=5e-3, gravity=(0, 0, -9.81))
    a, b = dano.linearize(scene, state)
    assert a.shape == (16, 16)
    assert b.shape == (16, 8)
    small, none = 1e-5, scene.control()

    def following(**changes):
        end = dano.step(scene, dataclasses.replace(state, **changes), none)
        return np.concatenate([end.position[0], end.velocity[0], end.omega[0], *coordinates(end)])

    rows = [0, 1, 2, *range(6, 16)]
    for column, name, i in ((12, "q", 0), (13, "q", 1), (14, "v", 0), (15, "v", 1)):
        value = getattr(state, name)
        numeric = following(**{name: value.at[i].add(small)}) - following(**{name: value.at[i].add(-small)})
        np.testing.assert_allclose(np.asarray(a)[rows, column], numeric / (2 * small), atol=1e-7)
    for first, name in ((0, "position"), (6, "velocity"), (9, "omega")):
        value = getattr(state, name)
        numeric = following(**{name: value.at[0, 1].add(small)}) - following(
            **{name: value.at[0, 1].add(-small)}
        )
        np.testing.assert_allclose(np.asarray(a)[rows, first + 1], numeric / (2 * small), atol=1e-7)
    ends = [dano.step(scene, state, scene.control(rod=dict(effort=s))) for s in (small, -small)]
    pushed = [coordinates(end)[1] for end in ends]
    np.testing.assert_allclose(np.asarray(b)[14:, 7], (pushed[0] - pushed[1]) / (2 * small), atol=1e-7)


def test_welded_bodies_are_one():
    """A dumbbell of three welded pieces moves as one body with their mass properties."""
    rod = dano.Body("rod", dano.Box((0.02, 0.02, 0.2)), mass=1.0)
    ends = [dano.Body(name, dano.Sphere(0.05), mass=m) for name, m in (("left", 0.5), ("right", 2.0))]
    joints = [
        dano.Joint("rod", "left", "weld", position=(0, 0, -0.2)),
        dano.Joint("rod", "right", "weld", position=(0.05, 0, 0.2)),
    ]
    scene = dano.Scene.create([rod, *ends], contacts=(), joints=joints, timestep=2e-3)
    places = np.array([[0, 0, 0], [0, 0, -0.2], [0.05, 0, 0.2]])
    masses = np.array([1.0, 0.5, 2.0])
    com = masses @ places / masses.sum()
    arms = places - com
    inertia = sum(
        np.asarray(body.inertia) + m * (r @ r * np.eye(3) - np.outer(r, r))
        for body, m, r in zip(scene.bodies, masses, arms, strict=True)
    )
    whole = dano.Body("whole", dano.Sphere(0.1), mass=3.5, inertia=inertia, com=com)
    one = dano.Scene.create([whole], timestep=2e-3)
    spin, velocity = np.array([2.0, 1.0, -3.0]), np.array([0.3, 0.0, 1.0])
    joined = dano.simulate(scene, scene.initial_state(rod=dict(velocity=velocity, omega=spin)), 200)
    # The rod's velocity is its centre's; in a step all of the body turns about the centre of mass.
    first = one.initial_state(whole=dict(position=com, velocity=velocity, omega=spin))
    first = dataclasses.replace(first, velocity=_com_velocity(joined.states, masses)[0][None])
    single = dano.simulate(one, first, 200)
    places = np.einsum("n,tnk->tk", masses, joined.states.position) / masses.sum()
    np.testing.assert_allclose(places, single.states.position[:, 0], atol=1e-9)
    np.testing.assert_allclose(joined.states.orientation[:, 0], single.states.orientation[:, 0], atol=1e-9)


def _com_velocity(states, masses):
    return jnp.einsum("n,tnk->tk", jnp.asarray(masses), states.velocity) / masses.sum()


def test_slide_rests_on_the_floor():
    """A body that a vertical slide holds upright comes to rest on the floor, which carries its weight."""
    box = dano.Body("box", dano.Box((0.05, 0.05, 0.05)), mass=2.0)
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    scene = dano.Scene.create(
        [box, floor],
        [dano.Contact("box", "floor")],
        joints=[dano.Joint(None, "box", "slide", position=(0, 0, 0.05))],
        timestep=5e-3,
    )
    run = dano.simulate(scene, scene.initial_state(box=dict(q=0.02)), 200)
    assert bool(run.converged.all())
    assert abs(coordinates(run.states)[1][-1, 0]) <= 1e-6
    assert -5e-4 <= coordinates(run.states)[0][-1, 0] <= 0
    force = np.asarray(dano.contact_wrenches(scene, jax.tree.map(lambda x: x[-2:], run.states)))[-1, 0, 2]
    np.testing.assert_allclose(force, 2.0 * 9.81, rtol=1e-3)


def test_rollouts_with_joints(pendulum):
    """Many states at once equal one by one, q and v included."""
    scene, _ = pendulum
    made = scene(2e-3)
    states = [made.initial_state(rod=dict(q=q)) for q in (0.1, 0.5, 1.0)]
    together = jax.tree.map(lambda *x: jnp.stack(x), *states)
    many = dano.rollouts(made, together, STEPS, keep="last")
    for i, state in enumerate(states):
        alone = dano.simulate(made, state, STEPS)
        np.testing.assert_allclose(
            coordinates(many.states)[0][i, -1], coordinates(alone.states)[0][-1], atol=1e-12
        )
        np.testing.assert_allclose(many.states.position[i, -1], alone.states.position[-1], atol=1e-12)
