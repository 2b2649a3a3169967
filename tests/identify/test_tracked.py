"""Motions as a tracker gives them: what all poses are off by alike, and hops nobody sees."""

import numpy as np
import pytest

import dano
from dano.identification import Motion
from dano.maths import quat_exp, quat_multiply

SIDES = (0.09, 0.06, 0.04)
"""Full lengths [m]."""
FRICTION = 0.25
RATE = 30.0
FRAMES = 20


def scene(mu: float = 0.5) -> dano.Scene:
    """A box on a table."""
    return dano.Scene.create(
        bodies=[
            dano.Body("box", dano.Box(tuple(0.5 * side for side in SIDES)), mass=0.2),
            dano.Body("table", dano.HalfSpace(), fixed=True),
        ],
        contacts=[dano.Contact("box", "table", dano.ContactParams(sliding_friction=mu))],
        timestep=1 / 240,
    )


def friction(start: float) -> dano.Parameter:
    """The unknown."""
    return dano.Parameter("mu", lambda s: s.contact("box", "table").sliding_friction, 0.02, 1.0, start=start)


@pytest.fixture(scope="module")
def slide() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, positions and orientations of a box that stops after .46 s: a closed form."""
    times = np.arange(FRAMES) / RATE
    speed, g = 1.13, 9.81
    moving = np.minimum(times, speed / (FRICTION * g))
    way = speed * moving - 0.5 * FRICTION * g * moving**2
    position = np.stack([way, 0.3 * way, np.full(FRAMES, 0.5 * SIDES[2])], axis=1)
    position[:, :2] /= np.hypot(1.0, 0.3)
    return times, position, np.tile([1.0, 0.0, 0.0, 0.0], (FRAMES, 1))


def tracked(times, position, orientation, deviation=1e-3, turned=3e-3) -> Motion:
    """A motion whose poses have these standard deviations [m], [rad]."""
    covariance = np.diag(np.repeat([deviation**2, turned**2], 3))
    covariance = np.tile(covariance, (len(times), 1, 1))
    return Motion.create(
        times,
        "box",
        position=position,
        orientation=orientation,
        covariance=covariance,
        alike=(0.01, 6e-3, 2.5e-3),
    )


@pytest.mark.parametrize("start", [0.05, 0.3, 0.8])
def test_what_all_poses_are_off_by_alike_does_not_move_friction(slide, start):
    times, position, orientation = slide
    turn = np.asarray(quat_exp(np.array([0.004, -0.003, 0.002])))
    off = tracked(
        times,
        position + [0.0005, 0.0008, 0.0014],
        np.asarray(quat_multiply(orientation, np.tile(turn, (FRAMES, 1)))),
        deviation=5e-4,
    )
    fit = dano.identify(scene(), off, [friction(start)], initial="states")
    assert fit.stop.converged and not fit.messages
    assert fit.values["mu"] == pytest.approx(FRICTION, abs=5e-4)
    # No hop before the first frames: nobody has seen any.
    assert np.abs(fit.initial_states.velocity[0, 0, 2]) < 0.05


def test_a_small_scatter_does_not_make_covariances_smaller(slide):
    errors = []
    for deviation in (1e-3, 2e-3):
        motion = tracked(*slide, deviation=deviation, turned=3 * deviation)
        fit = dano.identify(scene(), motion, [friction(0.3)], initial="states")
        errors.append(float(fit.standard_errors["mu"]))
    # Poses are exact, and known as well as is said.
    assert errors[1] == pytest.approx(2 * errors[0], rel=0.2)


def test_friction_is_no_better_known_than_the_size(slide):
    motion = tracked(*slide, deviation=2e-5, turned=2e-4)
    fit = dano.identify(scene(), motion, [friction(0.3)], initial="states")
    # With a way that is too long by a share speeds are, too, and so is the friction that stops them.
    assert float(fit.standard_errors["mu"]) == pytest.approx(2.5e-3 * FRICTION, rel=0.05)


def test_velocities_from_poses_are_as_uncertain_as_their_scatter():
    times = np.arange(9) / RATE
    position = np.stack([times, 0 * times, 0 * times], axis=1)
    motion = tracked(times, position, np.tile([1.0, 0.0, 0.0, 0.0], (9, 1)), deviation=1e-3, turned=2e-3)
    found = motion.velocity_deviations(4)
    # A slope through seven places k dt has variance σ² / (dt² Σ k²).
    assert found["velocity"] == pytest.approx(1e-3 * RATE / np.sqrt(28), rel=1e-9)
    assert found["omega"] == pytest.approx(2e-3 * RATE / np.sqrt(28), rel=1e-9)
    assert motion.velocity_deviations(0)["velocity"] > 3 * found["velocity"]
    # A blow in between is no parabola.
    position[5:, 0] = position[4, 0] - (position[5:, 0] - position[4, 0])
    blow = tracked(times, position, motion.orientation[:, 0], deviation=1e-3)
    assert blow.velocity_deviations(4)["velocity"] > 5 * found["velocity"]
    assert np.isnan(Motion.create(times, "box", position=position).velocity_deviations(4)["velocity"]).all()


def test_alike_is_kept_in_files_and_checked(slide, tmp_path):
    motion = tracked(*slide)
    dano.save_motion(tmp_path / "slide.npz", motion)
    assert dano.load_motion(tmp_path / "slide.npz").alike == motion.alike == motion.part(2, 9).alike
    times, position, _ = slide
    with pytest.raises(ValueError, match="alike needs the covariance"):
        Motion.create(times, "box", position=position, alike=(0.01, 0.0, 0.0))
    whole = np.tile(1e-6 * np.eye(6), (FRAMES, 1, 1))
    with pytest.raises(ValueError, match="alike must be three standard deviations"):
        Motion.create(times, "box", position=position, covariance=whole, alike=(0.01, -1.0, 0.0))
