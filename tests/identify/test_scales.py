"""Motions in other units than metres and seconds, and fits that say nothing."""

import warnings

import numpy as np
import pytest

import dano
from dano.identification import Errors
from dano.identification._identify import _missed, check_scales
from dano.identification._uncertainty import _width
from dano.maths import quat_exp, quat_multiply, quat_rotate

SCENE = dano.Scene.create([dano.Body("ball", dano.Sphere(0.05), mass=1.0)], timestep=0.005)


def pushed(unit: float = 1.0, second: float = 1.0, n: int = 12) -> dano.Motion:
    """A ball that is pushed along at 5 cm/s and filmed at 30 Hz, with a frame in which it was not seen."""
    times = np.arange(n) / 30
    position = unit * np.stack([0.05 * times, 0 * times, 0.05 + 0 * times], axis=1)
    position[4] = np.nan
    return dano.Motion.create(second * times, ("ball",), position=position)


def test_metres_and_seconds_pass():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_scales(
            SCENE, [pushed(), dano.Motion.create([0.0, 3.0], ("ball",), position=np.eye(3)[:2])], None
        )


def test_slow_motions_in_other_units_are_doubted():
    with pytest.warns(
        UserWarning, match="'ball' is 0.101 m long .* 2.5 of its sizes a step; if .* millimetres"
    ):
        check_scales(SCENE, [pushed(unit=1000)], None)
    # Short windows: not too many steps, but a camera of a frame in half a minute.
    with pytest.warns(UserWarning, match="times of the motion are 33.33 s apart; if they are milliseconds"):
        check_scales(SCENE, [pushed(second=1000)], 2)


@pytest.mark.parametrize(
    ("height", "text"),
    [(0.05, None), (0.045, None), (0.02, "lie 30 mm inside 'floor'"), (0.09, "lie 40 mm above 'floor'")],
)
@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_bodies_beside_the_plane_that_carries_them_are_said(height, text, tilt):
    """As after a wrong focal length: the object seems to be nearer or further than it is."""
    box = dano.Body("box", dano.Box((0.05, 0.05, 0.05)), mass=1.0)
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    scene = dano.Scene.create([box, floor], [dano.Contact("box", "floor")], timestep=0.005)
    turn = quat_exp(np.array([tilt, 0.0, 0.0]))
    state = scene.initial_state(floor={"position": (0.0, 0.1, 0.2), "orientation": turn})
    times = np.arange(12) / 30
    local = np.stack([0.05 * times, 0 * times, height + 0 * times], axis=1)
    position = np.asarray(quat_rotate(turn, local)) + np.array([0.0, 0.1, 0.2])
    motion = dano.Motion.create(times, ("box",), position=position, orientation=np.tile(turn, (12, 1)))
    falling = motion.position - 4.9 * times[:, None, None] ** 2 * np.array([0.0, 0.0, -1.0])
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        check_scales(scene, [motion], None, state)
        assert [text is not None and text in str(w.message) for w in said] == [True] * (text is not None)
    with warnings.catch_warnings():
        # What falls may be anywhere above.
        warnings.simplefilter("error")
        thrown = dano.Motion.create(
            times, ("box",), position=falling + 0.05, orientation=np.tile(turn, (12, 1))
        )
        check_scales(scene, [thrown], None, state)


def slid(n: int = 30, roll: float = 0.0, height: float = 0.02) -> dano.Motion:
    """A box of three heights that slides, and turns a little, on the floor; on its side if it is rolled."""
    times = np.arange(n) / 30
    position = np.stack([0.3 * times, 0.1 * times, height + 0 * times], axis=1)
    turns = quat_exp(np.stack([0 * times, 0 * times, 0.4 * times], axis=1))
    turns = np.asarray(quat_multiply(turns, np.array([np.cos(roll / 2), np.sin(roll / 2), 0, 0])))
    return dano.Motion.create(times, ("box",), position=position, orientation=turns)


FRAMES = {
    "with y as the axis that is up": (np.array([np.sqrt(0.5), -np.sqrt(0.5), 0, 0]), 0),
    "upside down": (np.array([0.0, 1, 0, 0]), 0),
    "with quaternions read as xyzw": (np.array([1.0, 0, 0, 0]), -1),
}


@pytest.mark.parametrize("name", FRAMES)
def test_motions_in_another_frame_are_said_with_the_turn_that_fits(name: str):
    """Each is the motion above, turned into the frame that the words are about."""
    box = dano.Body("box", dano.Box((0.05, 0.04, 0.02)), mass=1.0)
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    scene = dano.Scene.create([box, floor], timestep=0.005)
    motion, (turn, roll) = slid(roll=np.pi / 2, height=0.04), FRAMES[name]
    turns = np.roll(np.asarray(quat_multiply(turn, motion.orientation[:, 0])), roll, axis=-1)
    places = np.asarray(quat_rotate(turn, motion.position[:, 0]))
    other = dano.Motion.create(motion.times, ("box",), position=places, orientation=turns)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert check_scales(scene, [motion], None)
    with pytest.warns(UserWarning, match=f"but does {name}.*: is the motion in another frame"):
        assert not check_scales(scene, [other], None)


def test_a_fit_in_another_frame_does_not_search_long():
    """Y is up: the misfit is said, after tens of evaluations and not after a thousand."""
    box = dano.Body("box", dano.Box((0.05, 0.04, 0.02)), mass=0.5)
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    friction = dano.ContactParams(sliding_friction=0.5)
    scene = dano.Scene.create([box, floor], [dano.Contact("box", "floor", friction)], timestep=0.01)
    motion, turn = slid(12), FRAMES["with y as the axis that is up"][0]
    turns = quat_multiply(turn, motion.orientation[:, 0])
    places = np.asarray(quat_rotate(turn, motion.position[:, 0]))
    other = dano.Motion.create(motion.times, ("box",), position=places, orientation=np.asarray(turns))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        fit = dano.identify(scene, other, ["box,floor.sliding_friction:0:1"], initial="states")
    texts = [str(each.message) for each in said]
    assert any("is the motion in another frame" in text for text in texts)
    assert any("the fit misses the observed positions" in text for text in texts)
    assert fit.evaluations < 100


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="position of 'ball' must be in metres .* got a speed of 500 m/s"):
        check_scales(SCENE, [pushed(unit=10000)], None)
    with pytest.raises(ValueError, match="span at most 20000 steps of 0.005 s .* got 366.7 s"):
        check_scales(SCENE, [pushed(second=1000)], None)


def test_a_fit_that_is_off_by_more_than_the_bodies_is_said():
    assert _missed(SCENE, [pushed()], Errors(1e-4, 1e-4, 0.0, 0.0, 1.0)) is None
    said = _missed(SCENE, [pushed()], Errors(0.09, 0.1, 0.0, 0.0, 1.0))
    assert said is not None and "misses the observed positions by 90 mm on average, and they scatter" in said
    said = _missed(SCENE, [pushed()], Errors(39.0, 60.0, 0.0, 0.0, 1.0))
    assert said is not None and "misses the observed positions by 39 m on average" in said


@pytest.mark.parametrize(
    ("x", "error", "lower", "upper", "logarithm", "text"),
    [
        (1.74, 1.39, 0.2, 5.0, False, "its 95 % interval, 0.2 to 4.46, holds 89 % of what its bounds allow"),
        (1.74, 1.39, 0.01, 100.0, False, "its standard error is 0.8 times its value"),
        (1.0, 0.02, 0.2, 5.0, False, None),
        # Little friction, known to be little.
        (0.01, 0.01, 0.0, 1.0, False, None),
        (0.0, 0.4, -1.0, 1.0, False, "its 95 % interval, -0.784 to 0.784, holds 78 %"),
        (np.log(1.7), 0.8, np.log(0.01), np.log(100.0), True, "its standard error is 0.8 times its value"),
        (np.log(1.7), 0.8, np.log(0.5), np.log(5.0), True, "its 95 % interval, 0.5 to 5, holds 100 %"),
        (3.0, 0.1, -np.inf, np.inf, False, None),
        (3.0, 4.0, -np.inf, np.inf, False, "its standard error is 1.33 times its value"),
    ],
)
def test_words_for_errors_that_leave_a_value_open(x, error, lower, upper, logarithm, text):
    said = _width(float(x), error, float(lower), float(upper), logarithm, 100_000)
    assert said is None if text is None else said is not None and text in said
