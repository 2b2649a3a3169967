"""Impacts that are left to the spring: friction follows the slip, and restitution is that of the work."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano

A, B = 0.035, 0.025  # m
MASS, GYRATION = 0.036, 0.019  # kg, m
FRICTION, RESTITUTION = 0.19, 0.6
TIMESTEP, STEPS = 1e-5, 100


def plate(friction=FRICTION, restitution=RESTITUTION, law=None):
    """An ellipse in a plane, whose joint turns z into x."""
    params = dano.ContactParams(
        sliding_friction=friction, restitution=restitution, stiffness=1e11, hysteresis=1.0
    )
    return dano.Scene.create(
        [
            dano.Body(
                "plate", dano.Ellipsoid((A, 0.01, B)), mass=MASS, inertia=MASS * GYRATION**2 * np.eye(3)
            ),
            dano.Body("floor", dano.HalfSpace(), fixed=True),
        ],
        [
            dano.Contact(
                "plate", "floor", params, law=law or dano.DistributedLaw(compliant=True, implicitness=0.5)
            )
        ],
        joints=[dano.Joint(None, "plate", "planar", axis=(0, 1, 0), position=(0, 0, 1))],
        timestep=TIMESTEP,
        gravity=(0, 0, 0),
    )


def arms(theta):
    below = np.hypot(A * np.sin(theta), B * np.cos(theta))
    return (A**2 - B**2) * np.sin(theta) * np.cos(theta) / below, below


def by_parts(theta, v_x, v_z, spin, friction=FRICTION, restitution=RESTITUTION, parts=4000):
    """Velocities after: the impulse grows in small parts, friction opposes the slip of each.

    The impact ends when the normal impulse has given back e² of the work that it took (Stronge 1990).
    """
    along, below = arms(theta)
    part = abs(v_z) / parts
    taken = given = 0.0
    for _ in range(10 * parts):
        v_n, v_t = v_z - along * spin, v_x - below * spin
        by_friction = 1 + (below / GYRATION) ** 2
        stops = -(v_t + along * below / GYRATION**2 * part) / by_friction
        rubbed = np.clip(stops, -friction * part, friction * part)
        v_x, v_z = v_x + rubbed, v_z + part
        spin -= (along * part + below * rubbed) / GYRATION**2
        work = part * (v_n + v_z - along * spin) / 2
        taken, given = taken - min(work, 0.0), given + max(work, 0.0)
        if given >= restitution**2 * taken > 0 and v_n > 0:
            return np.array([v_x, v_z, spin])
    raise AssertionError("the impact does not end")


def start(scene, theta, v):
    state = scene.initial_state()
    q = jnp.array([0.0, 1 - arms(theta)[1] - 1e-6, theta])
    return scene.filled(
        eqx.tree_at(lambda s: (s.q, s.v), state, (q, jnp.asarray(v, float) * jnp.array([1.0, -1.0, 1.0])))
    )


BOUNDS = 0.01, 0.01, 0.5  # m/s, m/s, rad/s

CASES = {
    "slips on": (0.9, (1.0, -2.5, 0.0)),
    "slip ends": (1.5, (0.3, -2.5, 3.0)),
    "slip turns round": (-0.6, (0.3, -2.6, 5.0)),
    "flat": (0.05, (0.6, -2.4, -4.0)),
}


@pytest.mark.parametrize(("theta", "v"), CASES.values(), ids=CASES)
def test_an_impact_in_time_is_stronges_with_friction_that_follows_the_slip(theta, v):
    scene = plate()
    speeds = dano.simulate(scene, start(scene, theta, v), STEPS).states.v
    assert speeds is not None
    after = np.asarray(speeds[-1]) * [1, -1, 1]
    expected = by_parts(theta, *v)
    # The plate turns by half a degree while it lasts, and its patch is some tenths of a millimetre wide.
    assert (np.abs(after - expected) < BOUNDS).all(), (after, expected)
    assert np.abs(after - v).max() > 1


def test_derivatives_of_an_impact_in_time_are_those_of_the_closed_form():
    theta, v = CASES["slips on"]

    def after(x):
        scene = plate(*x)
        speeds = dano.simulate(scene, start(scene, theta, v), STEPS).states.v
        assert speeds is not None
        return speeds[-1] * jnp.array([1.0, -1.0, 1.0])

    found = np.asarray(jax.jacfwd(after)(jnp.array([FRICTION, RESTITUTION])))
    step = 0.02
    for k, unit in enumerate(np.eye(2)):
        more, less = (
            by_parts(theta, *v, *(np.array([FRICTION, RESTITUTION]) + s * step * unit)) for s in (1, -1)
        )
        expected = (more - less) / (2 * step)
        np.testing.assert_allclose(found[:, k], expected, rtol=0.05, atol=0.02 * np.abs(expected).max())


def test_impacts_last_as_long_as_is_said():
    scene = plate()
    said = scene.impact_duration("plate", "floor", 2.5)
    assert said == scene.impact_duration("floor", "plate", 2.5)
    run = dano.simulate(scene, start(scene, np.pi / 2, (0.0, -2.5, 0.0)), STEPS)
    rise = -np.asarray(run.states.v)[:, 1]
    # Until it no longer gets faster.
    lasts = TIMESTEP * float(np.argmax(rise >= rise.max() - 1e-9))
    assert 0.5 < lasts / said < 2.0
    # A spring turns round the sooner the stiffer it is.
    stiffer = scene.replace_contact("plate", "floor", stiffness=4e11)
    assert stiffer.impact_duration("plate", "floor", 2.5) < 0.8 * said


@pytest.mark.parametrize(
    ("law", "speed", "words"),
    [
        (dano.DistributedLaw(), 1.0, "'plate' and 'floor' end within a step"),
        (None, 0.0, r"speed must be a positive number \[m/s\], got 0.0"),
        (None, float("nan"), "speed must be a positive number"),
    ],
)
def test_what_has_no_duration_is_refused(law, speed, words):
    scene = plate(law=law)
    with pytest.raises(ValueError, match=words):
        scene.impact_duration("plate", "floor", speed)


def test_an_unknown_pair_is_refused():
    with pytest.raises(ValueError, match="plaet"):
        plate().impact_duration("plaet", "floor", 1.0)
