"""Whole steps of free bodies: the engine against the root that the reference finds of the same equations."""

import warnings

import numpy as np
import pytest
from reference_step import scenes
from reference_step.kinematics import Kinematics
from reference_step.rotations import matrix, momentum
from reference_step.step import root, Step, step

# Scenes here are odd on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::dano.scene.SceneWarning")

QUANTITIES = ("position", "orientation", "velocity", "omega")
CASES = [(name, what) for name in scenes.PAIRS for what in scenes.names(name)]


def stepped(engine, scene, state, control=None):
    """The engine's step and its τ by pair; warnings of spins that no step resolves do not count."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".* turns by more than 60°")
        following = engine.step(scene, state, control)
    shares = {side: each["share"] for side, each in engine.find(scene, state).items()}
    return {name: np.asarray(getattr(following, name)) for name in QUANTITIES}, shares


def assert_close(found, expected, bound):
    speed = 1 + max(np.abs(expected[name]).max() for name in ("velocity", "omega"))
    for name in QUANTITIES:
        np.testing.assert_allclose(found[name], expected[name], atol=bound * speed, err_msg=name)


@pytest.mark.parametrize("name, what", CASES)
def test_steps(engine, name, what):
    """At rest, sliding, tilted, in impacts, deep in each other, slow and fast spins.

    A solver ends where its residual is 2e-12 of the velocities; contact only makes bodies stiffer.
    """
    scene, state = scenes.pair(name), scenes.states(name)[what]
    found, shares = stepped(engine, scene, state)
    assert_close(found, step(scene, state, shares=shares)[0], 1e-11)


@pytest.mark.parametrize("name", ["box on table", "ball on table", "ellipsoid on table"])
def test_steps_from_the_exact_moment_of_meeting(engine, name):
    """A geometry that is taken too early by a share of the step changes the velocities by as much at most."""
    scene, state = scenes.pair(name), scenes.states(name)["hitting"]
    found, shares = stepped(engine, scene, state)
    exact, equations = step(scene, state)
    assert 0 < equations.points[0].share < 1
    assert_close(found, exact, 1e-9 + engine.meeting_error)


def test_steps_of_many_bodies(engine):
    """A pile with a ball that hits it; two objects and a box that meet in flight; controls."""
    for scene, state in (scenes.piled(), scenes.met()):
        body = scene.names[0]
        push: dict = dict(force=(0.3, -0.2, 0.1), torque=(0.01, 0.02, -0.03))
        control = scene.control(**{body: push})
        found, shares = stepped(engine, scene, state, control)
        assert_close(found, step(scene, state, control, shares)[0], 1e-11)


@pytest.mark.parametrize(
    "orientation, velocity, omega",
    [
        ((-1.01, -0.21, -0.16, 0.54), (0.43, 0.71, -1.13), (-2.6, 15.7, 29.9)),
        ((-0.3, 0.9, -1.04, -0.61), (0.95, -0.19, -1.09), (-50.2, 13.4, 6.5)),
    ],
)
def test_restitution_that_would_add_energy_is_taken_back(engine, orientation, velocity, omega):
    """Elastic impacts of a corner that sticks: with all of the restitution contact gains energy."""
    scene = scenes.pair("box on table").replace_contact("a", "table", restitution=1.0, sliding_friction=1.0)
    state = scenes.placed("box on table", 0.03, dict(orientation=orientation, velocity=velocity, omega=omega))
    found, shares = stepped(engine, scene, state)
    expected, equations = step(scene, state, shares=shares)
    assert_close(found, expected, 1e-11)
    assert 0 < equations.points[0].law.e < 1
    whole = Step(scene, state, None, shares)
    assert whole.adds_energy(root(whole))


def test_collisions_conserve_momentum():
    """Σ m v and Σ x × m v + R P⁻(ω) of bodies that meet in flight, in the reference itself."""
    scene, state = scenes.met()
    following, equations = step(scene, state)
    assert any(np.any(points.impact > 0) for points in equations.points)
    bodies = Kinematics(scene, state).bodies

    def totals(position, orientation, velocity, omega):
        linear = bodies.mass[:, None] * velocity
        spins = [
            matrix(q) @ momentum(w, J, bodies.h, -1)
            for q, w, J in zip(orientation, omega, bodies.inertia, strict=True)
        ]
        return np.r_[linear.sum(axis=0), np.sum(np.cross(position, linear) + spins, axis=0)]

    before = totals(*(np.asarray(getattr(state, name)) for name in QUANTITIES))
    np.testing.assert_allclose(totals(*(following[name] for name in QUANTITIES)), before, atol=1e-13)


def test_the_engine_solves_the_equations(engine):
    """They miss no more at its velocities than its tolerance and the rounding of friction allow."""
    scene, state = scenes.piled()
    control = scene.control()
    found, shares = stepped(engine, scene, state, control)
    equations = Step(scene, state, control, shares)
    spins = [equations.kinematics.balanced(i, found["omega"][i], found["orientation"][i]) for i in range(3)]
    y = np.concatenate([np.r_[found["velocity"][i], spins[i]] for i in range(3)])
    # Velocities are read from a state: their rounding, times what edges press by speed.
    assert np.abs(equations.residual(y)).max() < 1e-8 * (1 + np.abs(y).max())
