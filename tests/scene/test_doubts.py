"""What is odd about scenes and files is said once, in one line each; what is usual is not."""

import warnings
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest

import dano
from dano.scene import SceneWarning
from dano.scene_file import load_asset, parse_scene

BOX = "[0.045, 0.03, 0.02]"
ABOVE = "position = [0, 0, 0.05]"
TOP = "timestep = 0.005\nduration = 0.3"


def toml(
    top: str = TOP, body: str = ABOVE, floor: str = "", half: str = BOX, mass: float = 0.15, more: str = ""
):
    thing = f'[[bodies]]\nname = "box"\nshape = "box"\nhalf_extents = {half}\nmass = {mass}\n{body}\n'
    return f'{top}\n{thing}[[bodies]]\nname = "floor"\nshape = "half_space"\nfixed = true\n{floor}\n{more}\n'


HINGE = '[[joints]]\nchild = "box"\nposition = [0, 0, 0.3]\n'
LATE = '[[controls]]\nbody = "box"\nforce = [1, 0, 0]\nfrom = 2.0'
ODD = {
    "millimetres": (toml(half="[45, 30, 20]", body="position = [0, 0, 50]"), "less than air has"),
    "grams": (toml(mass=150), "more than any metal has"),
    "degrees a second": (toml(body=ABOVE + "\nomega = [720, 0, 0]"), "or is omega in rad/s"),
    "millimetres a second": (toml(body=ABOVE + "\nvelocity = [1200, 0, 0]"), "is its velocity in m/s"),
    "gravity upwards": (toml(top=TOP + "\ngravity = [0, 0, 9.81]"), "gravity points up"),
    "xyzw": (toml(body=ABOVE + "\norientation = [0, 0, 0, 1]"), "quaternions are wxyz"),
    "limits in degrees": (toml(body="", more=HINGE + "limits = [-90, 90]"), "are they in degrees"),
    "anchor in the world": (toml(body="", more=HINGE + "anchor = [0, 0, 0.3]"), "body's own frame"),
    "floor upside down": (toml(floor="normal = [0, 0, -1]"), "begins 0.07 m inside 'floor'"),
    "half inside": (toml(body="position = [0, 0, 0]"), "begins 0.02 m inside 'floor'"),
    "below the floor": (toml(body="position = [0, 0, -0.5]"), "begins 0.52 m inside"),
    "a sheet": (toml(half="[0.045, 0.03, 1e-6]", mass=1e-5), "too thin for its samples"),
    "shorter than a step": (toml(top="timestep = 0.005\nduration = 0.001"), "0.005 s are run"),
    "rounded": (toml(top="timestep = 0.01\nduration = 0.0333"), "0.03 s are run"),
    "a joint's angle in degrees": (toml(body="q = 90", more=HINGE), "q of 'box' is 90 rad, 14.3 turns"),
    "a force in millinewtons": (
        toml(more=LATE.replace("[1, 0, 0]\nfrom = 2.0", "[3e4, 0, 0]")),
        "in newtons?",
    ),
    "far away": (toml(body="position = [0, 0, 1e13]"), "where numbers are 0.002 m apart: is its position"),
    "a timestep in nanoseconds": (toml(top="timestep = 5e-9\nn_steps = 60"), "a second takes 2e+08 steps"),
    "controls too late": (toml(more=LATE), "1 never acts: it begins at 2 s, and 0.3 s are run"),
    "nothing touches": (toml(top=TOP + "\ncontacts = []"), "touches nothing"),
    "an angle of friction": (toml(more="[default_contact]\nsliding_friction = 30"), "not an angle"),
    "soft": (toml(more="[default_contact]\nstiffness = 1.0"), "sinks by more than 10 %"),
    "nothing moves": (toml(body="fixed = true"), "nothing moves"),
}


def said_of(make) -> list[str]:
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        make()
    return [str(each.message) for each in heard if issubclass(each.category, SceneWarning)]


@pytest.mark.parametrize("name", ODD)
def test_what_is_odd_is_said(name: str):
    text, message = ODD[name]
    assert any(message in line for line in said_of(lambda: parse_scene(text, Path("odd.toml"))))


def test_what_is_usual_is_not_said():
    assert said_of(lambda: parse_scene(toml(), Path("usual.toml"))) == []
    for name in ("bunny", "soap"):
        body = dano.Body(name, load_asset(name))
        assert said_of(lambda body=body: dano.Scene.create([body]).initial_state()) == []


def test_the_three_worst_are_said_and_how_many_more():
    text = toml(
        half="[45, 30, 20]",
        body="position = [0, 0, -9]\nomega = [720, 0, 0]\nvelocity = [1e6, 0, 0]\norientation = [0, 0, 0, 1]",
        more=LATE,
    )
    lines = said_of(lambda: parse_scene(text, Path("odd.toml")))
    assert len(lines) == 3
    assert "less than air" in lines[0] and "more: `dano check` lists them" in lines[2]


def test_bodies_that_nobody_placed_are_not_judged():
    """A state to be changed later begins with all bodies at the origin."""
    ball, floor = (
        dano.Body("ball", dano.Sphere(0.1), mass=1.0),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    )
    scene = dano.Scene.create([ball, floor])
    assert said_of(lambda: scene.initial_state(ball=dict(velocity=(1, 0, 0)))) == []
    assert said_of(lambda: scene.initial_state(ball=dict(position=(0, 0, 0.1)))) == []
    assert len(said_of(lambda: scene.initial_state(ball=dict(position=(0, 0, 0))))) == 1
    assert "is fixed" in said_of(lambda: scene.initial_state(floor=dict(velocity=(1, 0, 0))))[0]
    with pytest.raises(ValueError, match="got 'floor', which is fixed"):
        scene.control(floor=dict(force=(1, 0, 0)))


def test_python_says_it_when_it_is_made():
    heavy = dano.Body("soap", dano.Box((0.045, 0.03, 0.02)), mass=150.0)
    with pytest.warns(SceneWarning, match="more than any metal"):
        scene = dano.Scene.create([heavy])
    with pytest.warns(SceneWarning, match="in m/s"):
        scene.initial_state(soap=dict(velocity=(1200, 0, 0)))


def test_a_centre_of_mass_of_another_frame_is_said():
    for com, said in (((0.02, 0, 0), 0), ((1.0, 0, 0), 1)):
        body = dano.Body("ball", dano.Sphere(0.1), mass=1.0, com=com)
        found = said_of(lambda body=body: dano.Scene.create([body]))
        assert ["the centre of mass of 'ball' lies 0.899 m beside" in text for text in found] == [True] * said


def test_an_edge_through_the_whole_shape_is_said():
    for edge, said in ((0.05, 0), (0.5, 1)):
        ball = dano.Body("ball", dano.Sphere(0.1, edge=edge), mass=1.0)
        found = said_of(lambda ball=ball: dano.Scene.create([ball]))
        assert ["0.5 m wide and its shape 0.2 m thick: it has no inside" in text for text in found] == [
            True
        ] * said


def test_words_are_no_numbers_and_states_no_state():
    """NumPy reads "0.3" as a number; a state with a leading axis is many."""
    for word in ("0.3", ["0.3"]):
        with pytest.raises(ValueError, match="sliding_friction must be a number or an array"):
            dano.ContactParams(sliding_friction=word)
    scene = dano.Scene.create([dano.Body("ball", dano.Sphere(0.1), mass=1.0)])
    states = jax.tree.map(lambda x: np.stack([x, x]), scene.initial_state())
    for call in (lambda: dano.simulate(scene, states, 2), lambda: dano.step(scene, states)):
        with pytest.raises(ValueError, match=r"one state, with positions of shape \(1, 3\), got \(2, 1, 3\)"):
            call()


def test_traced_numbers_are_not_judged():
    soap = dano.Body("soap", dano.Box((0.045, 0.03, 0.02)), mass=0.15)

    def mass_of(scale):
        body = eqx.tree_at(lambda body: body.mass_scale, soap, scale)
        return dano.Scene.create([body]).bodies[0].mass_scale

    assert said_of(lambda: jax.grad(mass_of)(1e4)) == []


def test_links_with_a_mark_are_not_judged_by_it():
    """A link without a shape has a ball of a centimetre, and the mass and inertia of the file."""
    link = dano.Body("link", dano.Sphere(0.01), mass=5.0, com=(0, 0, 0.2), inertia=0.1 * np.eye(3))
    joint = dano.Joint(None, "link", anchor=(0, 0, 0.5))
    assert said_of(lambda: dano.Scene.create([link], joints=[joint])) == []
    # Heavy and small, or there only to carry others.
    for mass in (0.3, 1e-11):
        point = dano.Body("link", dano.Sphere(0.01), mass=mass)
        assert said_of(lambda point=point: dano.Scene.create([point], joints=[joint])) == []
        assert said_of(lambda point=point: dano.Scene.create([point]))


def test_an_axis_and_an_angle_are_no_quaternion():
    scene = dano.Scene.create([dano.Body("ball", dano.Sphere(0.1), mass=1.0)])
    with pytest.raises(ValueError, match="angle in degrees"):
        scene.initial_state(ball=dict(orientation=(0, 0, 1, 90)))
