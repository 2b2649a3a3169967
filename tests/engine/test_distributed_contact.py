"""Distributed contact against closed forms: weight, stiction, sliding, spinning, bouncing, rest, a stack."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from engine.scenes import angular_momentum

import dano
from dano.maths import quat_to_matrix

G = 9.81
PLATE = (0.05, 0.05, 0.02)


def on_floor(body, h=0.01, law=None, gravity=(0.0, 0.0, -G), **params):
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    contact = dano.Contact("body", "floor", dano.ContactParams(**params), law or dano.DistributedLaw())
    return dano.Scene.create([body, floor], [contact], timestep=h, gravity=gravity)


def speeds(run):
    return np.linalg.norm(run.states.velocity[:, 0], axis=1), np.linalg.norm(run.states.omega[:, 0], axis=1)


@pytest.fixture(scope="module")
def plate():
    """A plate on a floor; steps, gravity, friction change without compiling anew."""
    return on_floor(dano.Body("body", dano.Box(PLATE), mass=0.5), sliding_friction=0.4)


@jax.jit
def pressed(scene, height):
    """Force [N] on the first body at rest at a height."""
    state = scene.initial_state(body={"position": (0.0, 0.0, height)})
    still = jax.tree.map(lambda x: jnp.stack([x, x]), state)
    return dano.contact_wrenches(scene, still)[0, 0, :3]


@pytest.mark.parametrize(
    ("shape", "height", "volume", "tolerance"),
    [
        (dano.Box((0.05, 0.04, 0.03)), 0.03, lambda d: 0.1 * 0.08 * d, 0.02),
        (dano.Sphere(0.05), 0.05, lambda d: np.pi * d**2 * (0.05 - d / 3), 0.03),
        (dano.Cylinder(0.05, 0.02), 0.02, lambda d: np.pi * 0.05**2 * d, 0.02),
    ],
)
def test_force_is_stiffness_times_displaced_volume(shape, height, volume, tolerance):
    """For a body at rest, whatever its shape (hydrostatics); the skin makes it a quarter percent larger."""
    scene = on_floor(dano.Body("body", shape, mass=0.5), stiffness=1e7)
    for depth in (0.002, 0.005):
        force = pressed(scene, jnp.asarray(height - depth))
        np.testing.assert_allclose(force, [0, 0, 1e7 * volume(depth)], rtol=tolerance, atol=0.3)


def test_force_does_not_depend_on_the_number_of_samples():
    forces = []
    for n in (400, 1600):
        egg = dano.NeuralObject.from_field(
            dano.Ellipsoid((0.06, 0.05, 0.04)), n_samples=n, mass=0.5, resolution=48
        )
        forces.append(float(pressed(on_floor(dano.Body("body", egg), stiffness=1e7), jnp.asarray(0.037))[2]))
    # The cap of an ellipsoid: that of a sphere, scaled.
    exact = 1e7 * np.pi * 0.06 * 0.05 / 0.04**2 * 0.003**2 * (0.04 - 0.001)
    np.testing.assert_allclose(forces, exact, rtol=0.04)


@pytest.mark.filterwarnings("ignore::dano.scene.SceneWarning")
def test_default_stiffness_carries_the_weight_at_half_a_percent():
    for size, mass in ((0.05, 0.05), (1.0, 50.0)):
        scene = on_floor(dano.Body("body", dano.Box((size / 2,) * 3, rounding=0.05 * size), mass=mass))
        support = scene.bodies[0].typical_support(0.005 * scene.bodies[0].size)
        assert float(scene.contact("body", "floor").stiffness) * support == pytest.approx(mass * G)
        given = dano.Scene.create(
            scene.bodies,
            [dano.Contact("body", "floor", dano.ContactParams(stiffness=3e5), dano.DistributedLaw())],
        )
        assert float(given.contact("body", "floor").stiffness) == 3e5


def tilted(scene, share, friction=0.4):
    slope = np.arctan(share * friction)
    gravity = G * jnp.asarray([np.sin(slope), 0, -np.cos(slope)])
    return jax.tree.map(lambda x: x, dano.Scene(scene.bodies, scene.contacts, scene.timestep, gravity)), slope


@pytest.mark.parametrize("share", [0.9, 0.995])
def test_friction_sticks(plate, share):
    scene, _ = tilted(plate, share)
    run = dano.simulate(scene, scene.initial_state(body={"position": (0, 0, 0.02)}), 100)
    assert jnp.all(run.converged)
    assert abs(float(run.states.velocity[-1, 0, 0])) <= share * 1e-7 * 1.01
    assert abs(float(run.states.position[-1, 0, 0])) < 1e-6


def test_friction_lets_go(plate):
    scene, slope = tilted(plate, 1.01)
    run = dano.simulate(scene, scene.initial_state(body={"position": (0, 0, 0.02)}), 100)
    expected = G * (np.sin(slope) - 0.4 * np.cos(slope))
    assert float(run.states.velocity[-1, 0, 0]) == pytest.approx(expected, rel=1e-3)


def test_sticking_centroid_law():
    """The centroid law with a stiction velocity: holds below the friction angle, slides by μ g above."""
    law = dano.CentroidLaw(stiction_velocity=1e-7)
    box = dano.Body("body", dano.Box(PLATE), mass=0.5)
    scene = on_floor(box, h=0.001, law=law, sliding_friction=0.4)
    held, _ = tilted(scene, 0.9)
    start = {"position": (0, 0, 0.0199)}
    run = dano.simulate(held, held.initial_state(body=start), 500)
    assert float(jnp.linalg.norm(run.states.velocity[-1, 0])) < 1e-6
    run = dano.simulate(scene, scene.initial_state(body={**start, "velocity": (3.0, 0, 0)}), 500)
    slowing = (run.states.velocity[200, 0, 0] - run.states.velocity[-1, 0, 0]) / 0.3
    assert float(slowing) == pytest.approx(0.4 * G, rel=5e-3)


def test_sliding_and_spinning(plate):
    run = dano.simulate(
        plate, plate.initial_state(body={"position": (0, 0, 0.02), "velocity": (3.0, 4.0, 0)}), 100
    )
    speed = speeds(run)[0]
    np.testing.assert_allclose((speed[10] - speed[90]) / 0.8, 0.4 * G, rtol=5e-3)
    direction = np.asarray(run.states.velocity[90, 0]) / speed[90]
    np.testing.assert_allclose(direction, [0.6, 0.8, 0], atol=1e-4)

    slow = dano.Scene(plate.bodies, plate.contacts, jnp.asarray(0.001), plate.gravity)
    run = dano.simulate(slow, slow.initial_state(body={"position": (0, 0, 0.02), "omega": (0, 0, 20.0)}), 100)
    spin = np.asarray(run.states.omega[:, 0, 2])
    # Mean distance of a square's points from its middle.
    lever = 0.1 * (np.sqrt(2) + np.log(1 + np.sqrt(2))) / 6
    expected = 0.4 * 0.5 * G * lever / float(plate.bodies[0].inertia[2, 2])
    np.testing.assert_allclose((spin[20] - spin[90]) / 0.07, expected, rtol=0.02)


def test_bounce_returns_the_stated_restitution():
    """In weightlessness, so that nothing else takes or gives energy."""
    scene = on_floor(dano.Body("body", dano.Sphere(0.05), mass=0.5), h=1e-4, gravity=(0, 0, 0))
    state = scene.initial_state(body={"position": (0, 0, 0.0501), "velocity": (0, 0, -2.0)})

    def leaving(restitution, speed):
        given = scene.replace_contact("body", "floor", restitution=restitution)
        fast = jax.tree.map(lambda x: x * speed, state.velocity)
        start = dano.State(state.position, state.orientation, fast, state.omega)
        return dano.simulate(given, start, 300).states.velocity[:, 0, 2]

    pairs = [(0.3, 1.0), (0.5, 1.0), (0.5, 0.5), (0.8, 1.0)]
    for restitution, speed in pairs:
        velocity = np.asarray(leaving(restitution, speed))
        assert velocity[-1] / (2 * speed) == pytest.approx(restitution, rel=0.03)
        assert np.all(np.diff(velocity) > -1e-9), "contact never pulls"


def test_energy_never_grows(plate):
    h = 0.002
    scene = dano.Scene(plate.bodies, plate.contacts, jnp.asarray(h), plate.gravity)
    state = scene.initial_state(
        body={
            "position": (0, 0, 0.15),
            "orientation": (1, 0.4, 0.2, 0.1),
            "velocity": (0.5, 0.2, 0),
            "omega": (3, 1, 2),
        }
    )
    run = dano.simulate(scene, state, 600)
    assert jnp.all(run.converged)
    # Kinetic energy belongs to the middle of the step that led to a state.
    middle = np.asarray(run.states.position[1:, 0, 2] + run.states.position[:-1, 0, 2]) / 2
    omega = np.asarray(run.states.omega[1:, 0])
    rotation = 0.5 * np.einsum("ti,ij,tj->t", omega, np.asarray(scene.bodies[0].inertia), omega)
    energy = 0.25 * np.sum(np.asarray(run.states.velocity[1:, 0]) ** 2, axis=1) + rotation + 0.5 * G * middle
    assert np.max(np.diff(energy)) < 1e-3 * energy[0]
    assert np.all(energy[50:] <= energy[0])


def test_friction_that_turns_the_slip_around_adds_no_energy():
    """A rod that falls aslant with e = 0.9: Newton's restitution alone would add 7 % of energy to each.

    The second hits once, and sticks. In closed form, with a contact at one point, 0.9 e adds none (the energy
    left is 0.986) and the rod leaves at 0.259 m/s, with 0.8 e at 0.129 m/s.
    """
    rod = dano.Body("body", dano.Capsule(0.01, 0.1), mass=1.0)
    scene = on_floor(rod, h=0.002, gravity=(0, 0, 0), sliding_friction=1.0, restitution=0.9)

    @jax.vmap
    def fall(lift):
        half = 0.25 * jnp.pi - 0.5 * lift
        orientation = jnp.stack([jnp.cos(half), 0 * half, jnp.sin(half), 0 * half])
        start = scene.initial_state(
            body={
                "position": (0, 0, 0.112 * jnp.sin(lift)),
                "orientation": orientation,
                "velocity": (1, 0, -2),
            }
        )
        run = dano.simulate(scene, start, 40)
        return run.states, run.converged, dano.contact_wrenches(scene, run.states)[:, 0, :3]

    states, converged, forces = fall(jnp.array([0.64, 0.86]))
    assert jnp.all(converged)
    velocity, omega = states.velocity[:, :, 0], states.omega[:, :, 0]
    inertia = np.asarray(scene.bodies[0].inertia)
    energy = 0.5 * (np.sum(velocity**2, axis=2) + np.einsum("bti,ij,btj->bt", omega, inertia, omega))
    assert np.all(energy <= energy[:, :1] * (1 + 1e-3))
    assert velocity[0, -1, 2] > 0.3
    assert velocity[1, -1, 2] == pytest.approx(0.259, rel=0.05)
    # What is said of the forces is what acted.
    np.testing.assert_allclose(0.002 * forces, np.diff(velocity, axis=1), atol=1e-8)


@pytest.mark.parametrize(("size", "mass", "h"), [(0.05, 0.05, 1 / 60), (0.1, 1.0, 0.01), (1.0, 50.0, 1 / 60)])
def test_rest_is_quiet(size, mass, h):
    scene = on_floor(dano.Body("body", dano.Box((size / 2,) * 3), mass=mass), h=h, sliding_friction=0.5)
    pose = {"position": (0, 0, 0.3 + 0.75 * size), "orientation": (1, 0.3, 0.2, 0.1)}
    run = dano.simulate(scene, scene.initial_state(body=pose), 400)
    assert jnp.all(run.converged)
    v, w = speeds(run)
    after = np.asarray(run.times) > 3.4
    assert v[after].max() < 1e-6
    assert w[after].max() < 1e-5
    height = float(run.states.position[-1, 0, 2])
    assert height == pytest.approx(size / 2, rel=0.005)
    assert float(run.states.position[:, 0, 2].min()) > 0.45 * size


def test_stack_stands():
    boxes = [dano.Body(f"box{i}", dano.Box((0.05, 0.05, 0.05)), mass=1.0) for i in range(3)]
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    names = ["floor", "box0", "box1", "box2"]
    params = dano.ContactParams(sliding_friction=0.5)
    contacts = [
        dano.Contact(upper, lower, params, dano.DistributedLaw())
        for lower, upper in zip(names[:-1], names[1:], strict=True)
    ]
    scene = dano.Scene.create([*boxes, floor], contacts, timestep=1 / 60)
    places: dict[str, dict] = {f"box{i}": {"position": (0.004 * i, 0, 0.0502 + 0.1004 * i)} for i in range(3)}
    run = dano.simulate(scene, scene.initial_state(**places), 600)
    assert jnp.all(run.converged)
    np.testing.assert_allclose(run.states.position[-1, :3, 2], [0.05, 0.15, 0.25], atol=1e-4)
    assert float(jnp.abs(run.states.velocity[300:, :3]).max()) < 1e-6


def test_a_heap_gains_no_energy():
    """Ten bodies of five kinds fall onto each other; a step that is not solved may not shoot them away."""
    kinds = [
        dano.Sphere(0.05),
        dano.Box((0.05, 0.03, 0.02)),
        dano.Capsule(0.02, 0.06),
        dano.Cylinder(0.03, 0.04),
        dano.Ellipsoid((0.05, 0.04, 0.03)),
    ]
    bodies = [dano.Body(f"b{i}", kinds[i % 5], mass=1.0) for i in range(10)]
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    scene = dano.Scene.create(
        [*bodies, floor], others=dano.ContactParams(sliding_friction=0.3), timestep=0.005
    )
    random = np.random.default_rng(0)
    places: dict[str, dict] = {
        f"b{i}": {
            "position": (0.06 * (-1) ** i, 0.02 * random.uniform(-1, 1), 0.06 * (1 + 2 * (i // 2))),
            "orientation": random.normal(size=4),
        }
        for i in range(10)
    }
    run = dano.simulate(scene, scene.initial_state(**places), 200)
    velocity, omega = (np.asarray(x)[:, :10] for x in (run.states.velocity, run.states.omega))
    height = np.asarray(run.states.position)[:, :10, 2]
    inertia = np.stack([np.asarray(body.inertia) for body in bodies])
    spin = 0.5 * np.einsum("tbi,bij,tbj->t", omega, inertia, omega)
    energy = 0.5 * (velocity**2).sum(axis=(1, 2)) + spin + 9.81 * height.sum(axis=1)
    # Velocities are those of the ends of steps, so that free fall alone raises this sum by ½ (h g)² a body.
    assert np.diff(energy).max() < 10 * 0.5 * (0.005 * 9.81) ** 2 + 1e-3
    assert energy.max() <= energy[0] * (1 + 1e-3)
    assert height.min() > 0.015
    assert np.mean(np.asarray(run.converged)) > 0.98


@pytest.mark.parametrize(
    ("shape", "offset"),
    [
        (dano.Sphere(0.05), (0.025, 0.005, 0.0025)),
        (dano.Box((0.05, 0.04, 0.03)), (0.025, 0.005, 0.0025)),
    ],
    ids=["balls", "boxes"],
)
def test_bodies_set_deep_into_each_other_separate_slowly(shape, offset):
    """Also where all surfaces that are inside face the other way."""
    bodies = [dano.Body(name, shape, mass=1.0) for name in "ab"]
    scene = dano.Scene.create(bodies, [dano.Contact("a", "b")], timestep=0.005, gravity=(0, 0, 0))
    run = dano.simulate(scene, scene.initial_state(a={}, b={"position": offset}), 300)
    assert bool(jnp.all(run.converged))
    apart = jnp.linalg.norm(run.states.position[:, 1] - run.states.position[:, 0], axis=1)
    assert float(apart[-1]) > 0.1
    speed = jnp.linalg.norm(run.states.velocity[:, 1] - run.states.velocity[:, 0], axis=1)
    # √(g d)/5 along each normal; those that push lie up to 60° off the way.
    assert 0.01 < float(speed.max()) < 3 * 0.2 * np.sqrt(9.81 * 0.05)
    np.testing.assert_allclose(jnp.sum(run.states.velocity[-1], axis=0), 0, atol=1e-9)


def test_a_heavy_body_rests_on_a_light_one():
    """What makes deep contact softer leaves what rests alone: 30 kg on 50 g sink in by W/(k A)."""
    sizes, masses = ((0.05, 0.05, 0.01), (0.04, 0.04, 0.1)), (0.05, 30.0)
    light, heavy = (
        dano.Body(*x[:2], mass=x[2]) for x in zip("ab", map(dano.Box, sizes), masses, strict=True)
    )
    stiffness = 1e9
    params = dano.ContactParams(stiffness=stiffness, hysteresis=0.0)
    contacts = [dano.Contact("b", "a", params), dano.Contact("a", "floor", params)]
    bodies = [light, heavy, dano.Body("floor", dano.HalfSpace(), fixed=True)]
    scene = dano.Scene.create(bodies, contacts, timestep=0.005)
    run = dano.simulate(
        scene, scene.initial_state(a={"position": (0, 0, 0.01)}, b={"position": (0, 0, 0.12)}), 400
    )
    assert bool(jnp.all(run.converged))
    weight = 9.81 * sum(masses)
    sinks = 0.01 - run.states.position[-1, 0, 2]
    np.testing.assert_allclose(sinks, weight / (stiffness * 0.1**2), rtol=0.02)
    np.testing.assert_allclose(run.states.velocity[-1], 0, atol=1e-6)


def test_boxes_set_anyhow_into_each_other_never_fly_apart():
    """A step is not solved because velocities have become so large that rounding exceeds what is missing."""
    bodies = [dano.Body(name, dano.Box((0.1, 0.1, 0.1)), mass=1.0) for name in "ab"]
    scene = dano.Scene.create(bodies, [dano.Contact("a", "b")], timestep=0.005, gravity=(0, 0, 0))
    offsets = np.random.default_rng(0).uniform(-0.03, 0.03, (100, 3))

    def fastest(offset):
        start = scene.initial_state(a={"position": offset}, b={})
        run = dano.simulate(scene, start, 20, engine=dano.VariationalEngine(capacity=200))
        return jnp.abs(run.states.velocity).max(), run.converged.all()

    speeds, converged = jax.vmap(fastest)(jnp.asarray(offsets))
    # That of a fall from their size.
    assert float(speeds.max()) < np.sqrt(2 * 9.81 * 0.2)
    assert float(converged.mean()) > 0.9


@pytest.mark.parametrize(
    "turn", [(1, 1, 0, 0), (1, 0.7, 0.5, 0), (1, 0.15, 0, 0)], ids=["edge", "corner", "rim"]
)
def test_ball_falls_on_an_edge(turn):
    """A ball has samples, an edge has none: they face the edge also where it lies deep in the ball."""
    half, radius = np.array([0.06, 0.04, 0.04]), 0.05
    bodies = [
        dano.Body("box", dano.Box(tuple(half)), fixed=True),
        dano.Body("ball", dano.Sphere(radius), mass=1.0),
    ]
    scene = dano.Scene.create(bodies, [dano.Contact("box", "ball")], timestep=0.005)
    orientation = np.asarray(turn) / np.linalg.norm(turn)
    state = scene.initial_state(
        box={"orientation": orientation}, ball={"position": (0.003, 0.035, 0.11), "velocity": (0, 0, -3)}
    )
    run = dano.simulate(scene, state, 40)
    place = np.asarray(run.states.position[:, 1]) @ np.asarray(quat_to_matrix(jnp.asarray(orientation)))
    # Distance of a point outside of a box: that to the nearest point of it.
    apart = np.linalg.norm(place - np.clip(place, -half, half), axis=1)
    assert apart.min() > radius - 0.05 * 2 * radius
    assert apart.min() < radius
    assert bool(jnp.all(run.converged))


def test_collision_conserves_momentum():
    """Two boxes in free space, each with samples in the other: action is reaction, about any point."""
    bodies = [dano.Body(name, dano.Box((0.1, 0.06, 0.04)), mass=m) for name, m in (("a", 1.0), ("b", 2.0))]
    contact = dano.Contact("a", "b", dano.ContactParams(sliding_friction=0.4), dano.DistributedLaw())
    scene = dano.Scene.create(bodies, [contact], timestep=0.002, gravity=(0, 0, 0))
    state = scene.initial_state(
        a={"position": (0, 0.01, 0.16), "velocity": (0.2, 0, -1), "orientation": (1, 0.2, 0.3, 0)},
        b={"omega": (0.5, 1, 0)},
    )
    run = dano.simulate(scene, state, 200)
    assert jnp.all(run.converged)
    masses = jnp.asarray([1.0, 2.0])[:, None]
    linear = np.asarray(jnp.sum(masses[None] * run.states.velocity, axis=1))
    np.testing.assert_allclose(linear, np.broadcast_to(linear[0], linear.shape), atol=1e-10)
    touching = np.abs(np.diff(np.asarray(run.states.velocity[:, 0, 2]))) > 1e-6
    assert touching.any()
    assert float(jnp.abs(run.states.omega[-1, 0]).max()) > 0.05
    spins = sum(
        angular_momentum(jax.tree.map(lambda x, i=i: x[:, i], run.states), scene.bodies[i].inertia, 0.002)
        for i in range(2)
    )
    # Momentum before a step acts at the position at its start.
    orbital = jnp.sum(jnp.cross(run.states.position, masses[None] * run.states.velocity), axis=1)
    total = np.asarray(spins + orbital)
    np.testing.assert_allclose(total, np.broadcast_to(total[0], total.shape), atol=1e-10)


def test_a_ball_rolls_without_slipping():
    """From sliding it is left with 5/7 of its speed (2/5 m r² of inertia), then it rolls on."""
    ball = dano.Body("body", dano.Sphere(0.05), mass=0.5)
    scene = on_floor(ball, h=0.001, sliding_friction=0.5, restitution=1.0)
    state = scene.initial_state(body={"position": (0, 0, 0.05), "velocity": (1.0, 0, 0)})
    run = dano.simulate(scene, state, 200)
    assert jnp.all(run.converged)
    v, w = (x[-1] for x in speeds(run))
    assert v == pytest.approx(5 / 7, rel=0.04)
    assert w * 0.05 == pytest.approx(v, rel=0.02)


def test_a_batch_gives_what_its_members_give(plate):
    """One slides, one spins, one falls: their solves take different numbers of passes."""

    @jax.jit
    def ends(height, speed, spin):
        state = plate.initial_state(body={"position": (0, 0, 0.0199)})
        position = state.position.at[0, 2].add(height)
        velocity, omega = state.velocity.at[0, 0].set(speed), state.omega.at[0, 2].set(spin)
        run = dano.simulate(plate, dano.State(position, state.orientation, velocity, omega), 20)
        return run.states.position[-1, 0], run.iterations

    starts = jnp.array([0.0, 0.0, 0.02]), jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 9.0, 1.0])
    positions, passes = jax.jit(jax.vmap(ends))(*starts)
    alone = [ends(*start) for start in zip(*starts, strict=True)]
    np.testing.assert_allclose(positions, np.stack([position for position, _ in alone]), atol=1e-12)
    np.testing.assert_array_equal(passes, np.stack([count for _, count in alone]))


def test_parameters_of_another_law_are_an_error():
    with pytest.raises(ValueError, match="CentroidLaw does not read restitution"):
        dano.Contact("a", "b", dano.ContactParams(restitution=0.5), dano.CentroidLaw())
    with pytest.raises(ValueError, match="DistributedLaw does not read spring"):
        dano.Contact("a", "b", dano.ContactParams(spring=1e4), dano.DistributedLaw())


def test_it_is_the_default():
    assert isinstance(dano.Contact("a", "b").law, dano.DistributedLaw)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dano.DistributedLaw(stiction_velocity=0.0), "stiction_velocity must be > 0"),
        (lambda: dano.ContactParams(restitution=1.5), "restitution must lie in"),
        (lambda: dano.ContactParams(stiffness=0.0), "stiffness must be > 0"),
        (lambda: dano.ContactParams(hysteresis=2.0), "hysteresis must lie in"),
    ],
)
def test_bad_parameters(make, message):
    with pytest.raises(ValueError, match=message):
        make()
