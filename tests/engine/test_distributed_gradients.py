"""Gradients of distributed contact and of sticking friction: of the sums, and of rollouts through them."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from engine.scenes import last, point_cloud_box
from reference_step.scenes import lump

import dano
from dano.fields import SignedDistanceGrid

# Code that runs three times slower and compiles in three quarters of the time.
QUICKLY = {"xla_backend_optimization_level": 0}
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


def check_rollout(case, n_steps, *, irrelevant=(), step=1e-6, floor=1e-2):
    """Forward = reverse = differences at a tiny step, in a smooth neighbourhood of a trajectory."""
    zero = np.zeros(len(PARAMETERS))
    by_forward, by_reverse = jax.device_get((forward(case, zero, n_steps)[0], reverse(case, zero, n_steps)))
    # Differences of roots that are found to 1e-12 say nothing of derivatives below 1e-5 of this floor.
    scale = np.abs(by_forward).max(axis=0) + floor
    # Equal but for rounding, which stiff contact multiplies.
    np.testing.assert_allclose(by_reverse / scale, WEIGHTS @ by_forward / scale, atol=1e-7)
    columns = []
    for change in step * np.eye(len(PARAMETERS)):
        ends = [jax.device_get(forward(case, theta, n_steps)[1]) for theta in (change, -change)]
        assert all(converged for _, converged in ends)
        columns.append((ends[0][0] - ends[1][0]) / (2 * step))
    np.testing.assert_allclose(by_forward / scale, np.stack(columns, axis=1) / scale, atol=1e-5)
    for name, size in zip(PARAMETERS, scale - floor, strict=True):
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
    ball, law = dano.Body("ball", dano.Sphere(0.06), mass=3.0), dano.DistributedLaw(compliant=True)
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
        pytest.param("touch-down", 0.3, marks=pytest.mark.slow),
        pytest.param("touch-down", 0.0, marks=pytest.mark.slow),
        pytest.param("tumble", 0.0, marks=pytest.mark.slow),
        pytest.param("tumble", 0.3, marks=pytest.mark.slow),
        pytest.param("push", 0.3, marks=pytest.mark.slow),
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
    # A ball that pushes rounds more than the floor does.
    finer = {"step": 1e-5, "floor": 0.1} if name == "push" else {}
    case = Case(scene, scene.initial_state(**STARTS[name]), control)
    check_rollout(case, 50, irrelevant=irrelevant, **finer)


@pytest.mark.slow
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
    # They touch in an impact only, which ends within its step whatever the stiffness.
    check_rollout(Case(scene, scene.initial_state(a=coming)), 25, irrelevant=("stiffness",))


@pytest.mark.parametrize(
    ("shape", "height"),
    [
        (dano.Sphere(0.03), 0.0655),
        # Rounder than the search for its first touch needs to come to an end.
        (dano.Ellipsoid((0.03, 0.028, 0.026)), 0.0612),
        (dano.Cylinder(0.03, 0.02), 0.0563),
    ],
    ids=["ball", "ellipsoid", "cylinder"],
)
def test_grids_that_round_bodies_hit(shape, height):
    """By a sampled distance's coefficients, and by the start: which way samples face depends on both."""
    scene = dano.Scene.create(
        [dano.Body("ball", shape, mass=0.3), dano.Body("lump", lump())],
        [dano.Contact("ball", "lump", dano.ContactParams(restitution=0.3, sliding_friction=0.3))],
        timestep=2e-3,
        gravity=(0.0, 0.0, 0.0),
    )
    start = scene.initial_state(
        ball=dict(position=(0.005, 0.01, height), velocity=(0.02, 0.01, -0.2), omega=(0.3, 0.2, 0.1)),
        lump=dict(omega=(0.05, -0.1, 0.2)),
    )
    solid = scene.bodies[1].solid
    assert isinstance(solid, SignedDistanceGrid)
    coefficients = solid.coefficients
    rng = np.random.default_rng(3)
    bumps, weights = 1e-3 * rng.normal(size=coefficients.shape), rng.normal(size=(2, 3))

    def final(theta):
        changed = coefficients + theta[0] * bumps
        bumpy = eqx.tree_at(lambda s: s.bodies[1].solid.coefficients, scene, changed)
        moved = start.position.at[0].add(theta[1] * jnp.array([0.001, 0.002, 0.001]))
        pushed = start.velocity.at[0].add(theta[1] * jnp.array([0.3, 0.2, -0.5]))
        run = dano.simulate(bumpy, dano.State(moved, start.orientation, pushed, start.omega), 6)
        return jnp.sum(weights * last(run.states).velocity), run.converged.all()

    def derivatives(theta):
        only = lambda theta: final(theta)[0]  # noqa: E731
        return jax.grad(only)(theta), jax.jacfwd(only)(theta)

    zero = jnp.zeros(2)
    value = jax.jit(final, compiler_options=QUICKLY)
    assert bool(value(zero)[1])
    by_reverse, by_forward = jax.jit(derivatives, compiler_options=QUICKLY)(zero)
    np.testing.assert_allclose(by_reverse, by_forward, rtol=1e-5)
    for step in (1e-5, 1e-6):
        ends = [[value(sign * step * e)[0] for sign in (1, -1)] for e in np.eye(2)]
        differences = [(after - before) / (2 * step) for after, before in ends]
        np.testing.assert_allclose(by_reverse, differences, rtol=1e-4)
    assert abs(by_reverse[0]) > 1e-4, "the solid must matter"
