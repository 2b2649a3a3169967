"""Lists of point contacts: the engine against the reference, sample by sample, and the moment of meeting."""

import numpy as np
import pytest
from reference_step import scenes
from reference_step.collision import find, first_touch, meetings, Pair, sides_of
from reference_step.kinematics import Kinematics
from scipy.optimize import minimize
from scipy.spatial import cKDTree

import dano

# Scenes here are odd on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::dano.scene.SceneWarning")

CASES = [
    *((name, what) for name in scenes.PAIRS for what in ("sliding", "tilted", "hitting", "deep")),
    *((name, f"spinning at {spin:.0f} rad/s") for name in scenes.PAIRS for spin in scenes.SPINS[1::2]),
    *(
        (name, what)
        for name in ("box on table", "ball on table", "ellipsoid on table")
        for what in ("at the edge", "inside")
    ),
    ("cylinder on floor", "on its end"),
]


@pytest.mark.parametrize("name, what", CASES)
def test_listed_points(engine, name, what):
    """The same samples with the same geometry to rounding, where the engine's τ is taken."""
    scene, state = scenes.pair(name), scenes.states(name)[what]
    found = engine.find(scene, state)
    assert_same_points(scene, state, found)
    assert found


def test_listed_points_of_many_bodies(engine):
    """Also of pairs that are made of other bodies' materials, and of two objects in each other's grids."""
    for scene, state in (scenes.piled(), scenes.met()):
        found = engine.find(scene, state)
        assert_same_points(scene, state, found)
        assert len(found) >= 4


def assert_same_points(scene, state, found):
    kinematics = Kinematics(scene, state)
    expected = find(
        kinematics.scene, kinematics.bodies, {side: each["share"] for side, each in found.items()}
    )
    assert [(points.first, points.second) for points in expected] != []
    assert {(points.first, points.second) for points in expected} == set(found)
    for points in expected:
        same = found[points.first, points.second]
        _, order = cKDTree(same["arm"]).query(points.arm)
        assert sorted(order) == list(range(len(same["arm"])))
        speed = 1 + np.abs(kinematics.start).max()
        for quantity in ("arm", "normal", "moment", "depth", "area", "rate", "drift", "impact"):
            scale = {"rate": speed, "drift": speed, "impact": 1e-3 + points.impact.max()}.get(quantity, 1)
            np.testing.assert_allclose(
                same[quantity][order], getattr(points, quantity), atol=1e-12 * scale, err_msg=quantity
            )


@pytest.mark.parametrize("name, what", CASES)
def test_moment_of_meeting(engine, name, what):
    """τ is what bisection finds, but for what the engine rounds it down by."""
    scene, state = scenes.pair(name), scenes.states(name)[what]
    kinematics, found = Kinematics(scene, state), engine.find(scene, state)
    for points in find(kinematics.scene, kinematics.bodies):
        if (points.first, points.second) in found:
            share = found[points.first, points.second]["share"]
            assert points.share - engine.meeting_error <= share <= points.share + 1e-6


def test_meeting_in_closed_form():
    """A ball that falls on a floor reaches the depth of an impact after (gap + depth)/(h v)."""
    scene = dano.Scene.create(
        [dano.Body("a", dano.Sphere(0.05), mass=1.0), scenes.FLOOR],
        [dano.Contact("a", "floor")],
        timestep=scenes.H,
    )
    for speed, exact in ((1.0, 1.0), (2.0, 0.621), (100.0, 0.0125)):
        state = scene.initial_state(
            a=dict(position=(0, 0, 0.052), velocity=(0.3, 0, -speed), omega=(10, 20, 30))
        )
        kinematics = Kinematics(scene, state)
        sides = sides_of(kinematics.scene)
        # The extent of a shape has half of its edge on each side, 0.5 %.
        # It falls: way = h (v τ + g h (τ + τ²)/2), g h the gain of a step.
        way, gain = (0.002 + 0.005 * 0.1 * 1.005) / scenes.H, 9.81 * scenes.H
        along = speed + 0.5 * gain
        expected = min(1.0, (np.sqrt(along**2 + 2 * gain * way) - along) / gain)
        hitting, _ = meetings(kinematics.scene, kinematics.bodies, sides[0])
        assert hitting.share == pytest.approx(expected, abs=1e-9)
        assert expected == pytest.approx(exact, abs=2e-3)


def test_a_fast_body_does_not_pass_a_thin_wall_unseen():
    """A box at 300 m/s meets a plate of .2 mm that it crosses within 1/3000 of a step."""
    plate = dano.Body("plate", dano.Box((0.2, 0.2, 1e-4)), fixed=True)
    box = dano.Body("a", dano.Box((0.05, 0.04, 0.03)), mass=1.0)
    deep = dano.ContactParams(impact_depth=1e-3)
    scene = dano.Scene.create([box, plate], [dano.Contact("a", "plate", deep)], timestep=scenes.H)
    state = scene.initial_state(
        a=dict(position=(0, 0, 0.2), velocity=(0, 0, -300.0), orientation=scenes.TILTED)
    )
    kinematics = Kinematics(scene, state)
    side = sides_of(kinematics.scene)[0]
    (share, *_), _ = meetings(kinematics.scene, kinematics.bodies, side)
    pair = Pair(kinematics.scene, kinematics.bodies, side, share)
    assert 0 < share < 0.3
    assert pair.distance(pair.places)[0].min() == pytest.approx(-0.25e-4, rel=0.01)


def test_an_ellipsoid_faces_where_it_would_touch_first():
    """Twelve steps find the least |S⁻¹ x| over a box to 2 % of its size, beside an edge, too."""
    S, half = np.array([0.05, 0.04, 0.03]), np.array([0.2, 0.2, 0.03])
    box = dano.Box(half)
    for middle in ([0.21, 0.0, 0.045], [0.05, 0.1, 0.055], [0.22, 0.215, 0.04]):
        middle = np.array(middle)

        def look(point, middle=middle):
            from reference_step.distances import signed_distance

            distance, normal = signed_distance(box, (middle + point)[None])
            return distance[0], -normal[0]

        bounds = list(zip(-half - middle, half - middle, strict=True))
        best = minimize(lambda x: np.sum((x / S) ** 2), np.clip(-middle, *np.array(bounds).T), bounds=bounds)
        # What the ellipsoid faces: the normal of the grown ellipsoid at the first touch.
        expected = best.x / S**2 / np.linalg.norm(best.x / S**2)
        assert first_touch(look, S) @ expected > 0.98
