"""Gradients of distributed contact and of sticking friction: of the sums, and of rollouts through them."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from engine.scenes import last, point_cloud_box

import dano
from dano.contact import Softening, SurfaceSet
from dano.contact._distributed import _motion
from dano.contact._pressure import _all_sums, find_near, Material, sums
from dano.fields import SignedDistanceGrid
from dano.maths import quat_to_matrix

# Code that runs three times slower and compiles in three quarters of the time.
QUICKLY = {"xla_backend_optimization_level": 0}
# A stiction velocity that differences of 1e-6 m/s resolve.
MATERIAL = Material(
    stiffness=jnp.asarray(2e6),
    restitution=jnp.asarray(0.4),
    restitution_velocity=jnp.asarray(0.05),
    hysteresis=jnp.asarray(0.2),
    friction=jnp.asarray(0.5),
    friction_fading=jnp.asarray(0.3),
    friction_pressure=jnp.asarray(2e3),
    stiction=jnp.asarray(2e-3),
    ahead=jnp.asarray(0.01),
)


def cloud(n):
    """Samples on an ellipsoid of 12 cm × 9 cm × 7 cm, of uneven areas, with normals off by some degrees."""
    k = np.arange(n) + 0.5
    z, angle = 1 - 2 * k / n, np.pi * (1 + np.sqrt(5)) * k
    radius = np.sqrt(1 - z * z)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    areas = (1 + 0.3 * points[:, :1]) * 4 * np.pi * 0.045**2 / n
    return SurfaceSet.create(points * [0.06, 0.045, 0.035] + [0.01, 0, 0], areas * points)


def ripples():
    """A lump as a grid of distances: normals that turn everywhere."""
    axis = np.linspace(-0.1, 0.1, 21)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    distance = np.sqrt(x**2 + (1.2 * y) ** 2 + z**2) - 0.06 - 0.004 * np.sin(60 * x) * np.cos(50 * y)
    return SignedDistanceGrid(distance, (-0.1,) * 3, 0.01)


TURN = np.array([0.96, 0.2, 0.12, 0.1]) / np.linalg.norm([0.96, 0.2, 0.12, 0.1])
# Each with the height of its surface above its origin.
SOLIDS = {
    "plane": (dano.HalfSpace((0.1, -0.2, 1.0)), 0.0),
    "sphere": (dano.Sphere(0.05), 0.05),
    "box": (dano.Box((0.05, 0.04, 0.03), rounding=0.01), 0.03),
    "grid": (ripples(), 0.06),
}
# Velocity at the origin of the samples, spin; the surface is about horizontal, the samples are above it.
TWISTS = {
    "sticking": (3e-4, -2e-4, 1e-4, 0, 0, 2e-3),
    "slipping": (0.8, -0.5, 0.01, 0.3, 0.2, -1),
    "approaching": (0.1, 0.05, -0.4, 0, 1, 0),
    "separating": (0.1, 0.05, 0.06, 0, 0.2, 0),
    "mixed": (1e-3, 0, 0.01, 0.6, -0.3, 0.1),
    "gone": (0, 0, 5.0, 0, 0, 0),
}


@pytest.mark.parametrize(("name", "n"), [("plane", 1600), ("sphere", 480), ("box", 1600), ("grid", 480)])
def test_sums(name, n):
    """Their derivative rule and slope = plain autodiff of the plain sums = differences of those.

    480 samples are all taken at once, 1600 are searched for near ones.
    """
    (solid, height), samples = SOLIDS[name], cloud(n)
    turn = quat_to_matrix(jnp.asarray(TURN))
    to_field = jnp.concatenate([turn, jnp.array([[0.004], [0.003], [height + 0.033]])], axis=1)

    def split(theta):
        return theta[:12].reshape(3, 4), theta[12:24].reshape(3, 4), Material(*theta[24:])

    def by_rule(theta):
        near = find_near(*jax.lax.stop_gradient((*split(theta)[:2], solid, samples, theta[-1])))
        moments, slope = sums(*split(theta), solid, samples, near, Softening())
        return moments, (moments, slope)

    def plainly(theta):
        moments = _all_sums(*split(theta), solid, samples)
        return moments, moments

    def wrench(twist):
        moments = _all_sums(to_field, _motion(to_field, twist[:3], twist[3:]), MATERIAL, solid, samples)
        torque = jnp.sum(jnp.cross(to_field[:, :3], moments[:, :3], axis=0), axis=1)
        return jnp.append(moments[:, 3], torque)

    # A centimetre, a metre per second, the parameter itself.
    unit = np.concatenate([np.full(12, 1e-2), np.ones(12), MATERIAL])

    @functools.partial(jax.jit, compiler_options=QUICKLY)
    def everything(twist):
        motion = _motion(to_field, twist[:3], twist[3:])
        theta = jnp.concatenate([to_field.ravel(), motion.ravel(), jnp.stack(MATERIAL)])
        steps = 1e-6 * jnp.asarray(unit)
        ends = jax.vmap(plainly)(theta[None] + jnp.concatenate([jnp.diag(steps), jnp.diag(-steps)]))[0]
        differences = jnp.moveaxis(ends[: len(theta)] - ends[len(theta) :], 0, -1) / (2 * steps)[None, None]
        found, expected = (jax.jacfwd(f, has_aux=True)(theta) for f in (by_rule, plainly))
        return found, expected, jax.jacfwd(wrench)(twist), differences

    pressed = {}
    for case, twist in TWISTS.items():
        found, (plain, expected), by_twist, differences = jax.device_get(everything(jnp.asarray(twist)))
        rule, (moments, slope) = found
        pressed[case] = float(np.abs(expected).max())
        np.testing.assert_allclose(moments, expected, atol=1e-11 * (1e-3 + pressed[case]))
        np.testing.assert_allclose(slope, by_twist, atol=1e-11 * (1e-3 + np.abs(by_twist).max()))
        # What does not matter in a case is compared with what does.
        size = np.abs(plain).max(axis=(0, 1)) + 1e-2 * (1e-3 + pressed[case]) / unit
        np.testing.assert_allclose(rule / size, plain / size, atol=1e-9, err_msg=case)
        np.testing.assert_allclose(plain / size, differences / size, atol=1e-5, err_msg=case)
    assert pressed.pop("gone") == 0
    assert min(pressed.values()) > 0.5


PARAMETERS = ["friction", "stiffness", "restitution", "velocity", "mass scale", "position"]


class Case(NamedTuple):
    """A scene with a first contact whose parameters and first body change, and where it starts."""

    scene: dano.Scene
    start: dano.State
    control: dano.Control | None = None


def final(case, theta, n_steps):
    """Pose and velocity of the first body after some steps, and whether all of them converged."""
    contact = case.scene.contacts[0]
    params = contact.params
    changes = {"sliding_friction": params.sliding_friction + theta[0]}
    if contact.law.presses:
        changes["stiffness"] = params.stiffness * (1 + theta[1])
        changes["restitution"] = params.restitution + theta[2]
    else:
        changes["spring"] = params.spring * (1 + theta[1])
        changes["damper"] = params.damper * (1 + theta[2])
    scene = case.scene.replace_contact(contact.a, contact.b, **changes)
    scene = scene.replace_body(contact.a, mass_scale=1 + theta[4])
    start = dano.State(
        case.start.position.at[0].add(theta[5] * jnp.array([0.02, 0.04, -0.02])),
        case.start.orientation,
        case.start.velocity.at[0].add(theta[3] * jnp.array([1.0, 0.5, -0.2])),
        case.start.omega,
    )
    controls = None
    if case.control is not None:
        controls = jax.tree.map(lambda x: jnp.broadcast_to(x, (n_steps, *x.shape)), case.control)
    run = dano.simulate(scene, start, n_steps, controls=controls)
    end = last(run.states)
    return jnp.concatenate([end.position[0], end.orientation[0]]), run.converged.all()


@functools.partial(jax.jit, static_argnums=2, compiler_options=QUICKLY)
def forward(case, theta, n_steps):
    """Derivative of the pose, and the pose, which costs no second compilation so."""

    def twice(theta):
        end, converged = final(case, theta, n_steps)
        return end, (end, converged)

    return jax.jacfwd(twice, has_aux=True)(theta)


@functools.partial(jax.jit, static_argnums=2, compiler_options=QUICKLY)
def reverse(case, theta, n_steps):
    # One row for position and one for orientation keeps the reverse pass to two sweeps.
    return jax.lax.map(lambda w: jax.grad(lambda theta: w @ final(case, theta, n_steps)[0])(theta), WEIGHTS)


WEIGHTS = np.array([(1.0, 0.5, -0.7, 0, 0, 0, 0), (0, 0, 0, 0.3, -0.8, 0.5, 1.0)])


def check_rollout(case, n_steps, *, irrelevant=(), step=1e-6):
    """Forward = reverse = differences at a tiny step, in a smooth neighbourhood of a trajectory."""
    zero = np.zeros(len(PARAMETERS))
    by_forward, by_reverse = jax.device_get((forward(case, zero, n_steps)[0], reverse(case, zero, n_steps)))
    # Differences of roots that are found to 1e-12 say nothing of derivatives below 1e-6.
    scale = np.abs(by_forward).max(axis=0) + 1e-2
    np.testing.assert_allclose(by_reverse / scale, WEIGHTS @ by_forward / scale, atol=1e-8)
    columns = []
    for change in step * np.eye(len(PARAMETERS)):
        ends = [jax.device_get(forward(case, theta, n_steps)[1]) for theta in (change, -change)]
        assert all(converged for _, converged in ends)
        columns.append((ends[0][0] - ends[1][0]) / (2 * step))
    np.testing.assert_allclose(by_forward / scale, np.stack(columns, axis=1) / scale, atol=1e-5)
    for name, size in zip(PARAMETERS, scale - 1e-2, strict=True):
        assert name in irrelevant or size > 1e-6, f"{name} must matter in this scene"


def on_floor(law, edge=None, **params):
    """A box of 728 samples on a floor: of more than 512, those near the floor are searched."""
    box = dano.Body("box", point_cloud_box(n=12))
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    contact = dano.Contact("box", "floor", dano.ContactParams(sliding_friction=0.3, **params), law, edge)
    return dano.Scene.create([box, floor], [contact], timestep=0.01)


@pytest.fixture(scope="module")
def playground():
    """A box on a floor, and a ball that flies level until it meets the box."""
    ball, law = dano.Body("ball", dano.Sphere(0.06), mass=3.0), dano.DistributedLaw()
    scene = on_floor(law, restitution=0.3)
    contacts = [*scene.contacts, dano.Contact("box", "ball", dano.ContactParams(sliding_friction=0.4), law)]
    return dano.Scene.create([*scene.bodies, ball], contacts, timestep=0.01)


AWAY = {"position": (5, 5, 5)}
# The slide ends at rest; the touch-down slips, sticks and rebounds.
STARTS = {
    "slide": {"box": {"position": (0, 0, 0.0499), "velocity": (1, 0.3, 0), "omega": (0, 0, 1)}, "ball": AWAY},
    "touch-down": {
        "box": {"position": (0, 0, 0.1), "velocity": (1, 0, -1), "orientation": (1, 0.12, 0.05, 0)},
        "ball": AWAY,
    },
    "tumble": {
        "box": {
            "position": (0, 0, 0.13),
            "velocity": (1, 0, 0),
            "omega": (0, 6, 1),
            "orientation": (1, 0, 0.4, 0),
        },
        "ball": AWAY,
    },
    "push": {
        "box": {"position": (0, 0, 0.0499)},
        "ball": {"position": (-0.25, 0.02, 0.06), "velocity": (1.5, 0, 0)},
    },
}


@pytest.mark.parametrize(
    ("name", "hysteresis"),
    [
        ("slide", 0.3),
        ("touch-down", 0.0),
        ("touch-down", 0.3),
        ("tumble", 0.0),
        ("tumble", 0.3),
        ("push", 0.3),
    ],
)
def test_rollouts_on_a_floor(playground, name, hysteresis):
    scene = playground
    for other in ("floor", "ball"):
        scene = scene.replace_contact("box", other, hysteresis=hysteresis)
    control = scene.control(ball={"force": (0, 0, 3 * 9.81)})
    # A box that lies on the floor does not rebound, and sticks before the ball comes whatever its velocity.
    irrelevant = {"slide": ["restitution", "stiffness"], "push": ["restitution", "stiffness", "velocity"]}
    irrelevant = irrelevant.get(name, [])
    check_rollout(Case(scene, scene.initial_state(**STARTS[name]), control), 50, irrelevant=irrelevant)


def test_rollout_of_the_sticking_centroid_law():
    # An edge that many of its few samples are in at once.
    scene = on_floor(dano.CentroidLaw(stiction_velocity=1e-7), edge=0.02)
    case = Case(scene, scene.initial_state(box=STARTS["slide"]["box"]))
    # Overlap is mass, so the law's forces are proportional to it; and a landing flat bends the trajectory, so
    # that differences need a smaller step.
    check_rollout(case, 50, irrelevant=["mass scale"], step=1e-7)


@pytest.mark.slow
def test_two_neural_objects_meet():
    """Samples of either in the sampled distance of the other."""
    axis = np.linspace(-0.2, 0.2, 14)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    values = np.exp(-(x**2 / np.array([0.01, 0.006, 0.004])).sum(-1)) - 0.05
    field = dano.GridField(np.maximum(values, 0), (-0.2,) * 3, axis[1] - axis[0])
    lump = dano.NeuralObject.from_field(field, n_samples=300, mass=1.0, resolution=20, key=jax.random.key(0))
    params = dano.ContactParams(sliding_friction=0.3, restitution=0.5)
    contact = dano.Contact("a", "b", params, dano.DistributedLaw())
    scene = dano.Scene.create(
        [dano.Body("a", lump), dano.Body("b", lump)], [contact], gravity=(0.0, 0.0, 0.0)
    )
    coming = {"position": (0.3, 0.02, 0.01), "velocity": (-1, 0, 0), "orientation": (1, 0.2, 0.1, 0.3)}
    check_rollout(Case(scene, scene.initial_state(a=coming)), 25)
