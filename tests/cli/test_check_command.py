"""`dano check`: wrong scenes are found wrong, right ones are not, and what is foretold happens."""

import dataclasses
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.scene_file import check_scene, parse_scene, SceneFile
from dano.scene_file._forecast import bounds, forecast

# What is odd about these scenes is said when they are read, too: here it is foretold.
pytestmark = pytest.mark.filterwarnings("ignore::dano.scene.SceneWarning")

BALL_ON_FLOOR = """
timestep = {h}
n_steps = 40
[default_contact]
law = "{law}"
sliding_friction = 0.3
{more}
[[bodies]]
name = "ball"
shape = "sphere"
radius = 0.05
mass = 1.0
position = [0.0, 0.0, {z}]
velocity = [0.0, 0.0, {speed}]
omega = [0.0, 0.0, {spin}]
[[bodies]]
name = "floor"
shape = "half_space"
fixed = true
"""
USUAL = {"h": 0.002, "law": "distributed", "more": "", "z": 0.2, "speed": 0.0, "spin": 0.0}


def scene_of(**changes: object) -> SceneFile:
    return parse_scene(BALL_ON_FLOOR.format(**{**USUAL, **changes}), Path("scene.toml"))


def foretold(loaded: SceneFile) -> dict[str, str]:
    scene, state = loaded.scene, loaded.scene.filled(loaded.state)
    limits = bounds(scene, state, float(scene.timestep) * loaded.n_steps)
    return {finding.subject: finding.text for finding in forecast(scene, state, limits)}


def test_speed_is_that_of_the_fall():
    loaded = scene_of(z=0.55, speed=-1.0)
    ball = bounds(loaded.scene, loaded.state, 1.0)[0]
    # From its centre to the floor; the ball touches a radius earlier, so this bounds it from above.
    assert ball.speed == pytest.approx(np.sqrt(1 + 2 * 9.81 * 0.55))
    assert not ball.falls
    above = dataclasses.replace(loaded.state, position=-loaded.state.position)
    assert bounds(loaded.scene, above, 1.0)[0].falls


@pytest.mark.parametrize(
    ("changes", "subject", "words"),
    [
        ({}, None, ""),
        ({"spin": 600.0}, "spin", "69° in a step"),
        ({"more": "restitution = 0.5\nrestitution_velocity = 3.0"}, "impacts", "bounce less"),
        ({"more": "restitution = 0.5"}, None, ""),
        ({"law": "centroid"}, "impacts", "more than the edge"),
    ],
)
def test_what_steps_do_not_resolve(changes, subject, words):
    found = foretold(scene_of(**changes))
    if subject is None:
        assert found == {}
    else:
        assert words in found[subject]


def test_a_compliant_impact_needs_as_many_steps_as_it_lasts():
    scene = scene_of().scene
    h = 0.002
    contact = dano.Contact("ball", "floor", law=dano.DistributedLaw(compliant=True))
    scene = dano.Scene.create(scene.bodies, [contact], timestep=h)
    state = scene.initial_state(ball=dict(position=(0, 0, 0.2)))
    text = {f.subject: f.text for f in forecast(scene, state, bounds(scene, state, 1.0))}["impacts"]
    lasts = float(text.split("lasts ")[1].split(" s")[0])
    # Until it is turned round, in a run of steps that resolve it.
    fine = dano.Scene.create(scene.bodies, [contact], timestep=lasts / 100)
    speed = -((2 * 9.81 * 0.2) ** 0.5)
    start = fine.initial_state(ball=dict(position=(0, 0, 0.05), velocity=(0, 0, speed)))
    rising = np.asarray(dano.simulate(fine, start, n_steps=200).states.velocity[:, 0, 2])
    measured = float(np.argmax(rising >= 0.99 * rising.max())) * lasts / 100
    # The spring stiffens with the depth: the time of a linear one holds to a factor of two.
    assert 0.5 < measured / lasts < 2.0
    assert lasts < 20 * h


def test_walls_of_either_law_are_foretold_where_balls_may_pass_through():
    def wall(half: float, speed: float, law) -> tuple[bool, bool]:
        bodies = [
            dano.Body("ball", dano.Sphere(0.03), mass=0.2),
            dano.Body("wall", dano.Box((half, 0.3, 0.3)), fixed=True),
        ]
        scene = dano.Scene.create(
            bodies, [dano.Contact("ball", "wall", law=law)], timestep=0.005, gravity=(0, 0, 0)
        )
        state = scene.initial_state(ball=dict(position=(-0.5, 0, 0), velocity=(speed, 0, 0)))
        found = {f.subject for f in forecast(scene, state, bounds(scene, state, 1.0))}
        after = dano.simulate(scene, state, n_steps=40).states.position[int(1.0 / speed / 0.005) + 2, 0, 0]
        return "walls" in found, bool(after > 0)

    centroid, distributed = dano.CentroidLaw(), dano.DistributedLaw()
    assert wall(0.01, 2.0, centroid) == (False, False)
    assert wall(0.01, 20.0, centroid) == (True, True)
    assert wall(0.01, 20.0, distributed) == (False, False)
    # Foretold is what a step cannot be sure to resolve; this wall holds all the same.
    assert wall(0.0001, 160.0, distributed) == (True, False)


def test_masses_and_lost_bodies():
    bodies = [
        dano.Body("anvil", dano.Box((0.05, 0.05, 0.05)), mass=5000.0),
        dano.Body("crumb", dano.Box((0.05, 0.05, 0.05)), mass=1.0),
        dano.Body("moon", dano.Sphere(0.05), mass=1.0),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    contacts = [dano.Contact("anvil", "crumb"), dano.Contact("crumb", "floor")]
    scene = dano.Scene.create(bodies, contacts, timestep=0.005)
    state = scene.initial_state(anvil=dict(position=(0, 0, 0.2)), crumb=dict(position=(0, 0, 0.06)))
    found = {f.subject: f.text for f in forecast(scene, state, bounds(scene, state, 1.0))}
    assert "'anvil' has 5e+03 times the mass of 'crumb'" in found["masses"]
    assert found["support"].startswith("'moon' touches nothing: no contact names it; see docs/troubles.md#")


def test_samples_too_few(egg):
    whole = dano.NeuralObject.load(egg)
    assert whole.solid is not None
    few = dano.NeuralObject.from_field(whole.solid, mass=0.5, n_samples=60, resolution=20)
    scenes = [
        dano.Scene.create(
            [dano.Body("egg", made), dano.Body("floor", dano.HalfSpace(), fixed=True)],
            [dano.Contact("egg", "floor")],
        )
        for made in (whole, few)
    ]
    subjects = [
        {f.subject for f in forecast(s, state, bounds(s, state, 1.0))}
        for s in scenes
        for state in [s.initial_state(egg=dict(position=(0, 0, 0.2)))]
    ]
    assert "samples" not in subjects[0] and "samples" in subjects[1]


def test_a_start_inside_the_floor_is_said_and_cost_is_measured():
    found = check_scene(scene_of(z=0.03), seconds=0.5)
    assert "'ball' and 'floor' start inside" in {f.subject: f.text for f in found.findings}["start"]
    assert found.cost.steps in (20, 40) and found.cost.unsolved == 0
    assert 0 < found.cost.step_seconds <= found.cost.slowest_seconds
    assert found.total_seconds[0] == pytest.approx(40 * found.cost.step_seconds)
    [line] = found.contacts
    assert line.law == "distributed" and line.pairs == [("ball", "floor")]
    assert line.parameters["sliding_friction"] == pytest.approx(0.3)
    with pytest.raises(ValueError, match="seconds must be finite and > 0, got 0"):
        check_scene(scene_of(), seconds=0.0)


def test_the_command(run, scene):
    answer = run("check", scene, "--seconds", 0.2)
    assert answer.code == 0 and answer.err == ""
    assert "0.002 s, 400 of them" in answer.out and "distributed: egg – floor" in answer.out
    assert "nothing found that the steps would not resolve" in answer.out
    assert max(map(len, answer.out.splitlines())) <= 110
    report = json.loads(run("check", scene, "--seconds", 0.2, "--timestep", 0.1, "--json").out)
    # The scene itself warns of steps in which bodies fall by a good part of their size.
    assert any("is long" in finding["text"] for finding in report["findings"])
    assert report["bodies"][0]["samples"] == 800
    assert run("check", scene, "--seconds", -1).code == 2
    assert jnp.isfinite(report["cost"]["total_seconds"])


def test_a_ball_that_starts_in_the_floor_is_above_it():
    found = foretold(scene_of(z=-0.01))
    assert "support" not in found
    deep = foretold(scene_of(z=-0.5))
    assert "nothing fixed that 'ball' may touch is below it" in deep["support"]


@pytest.mark.parametrize(
    ("radius", "mass", "said"), [(30.0, 0.1, "less than air"), (0.001, 1.0, "than any metal")]
)
def test_sizes_and_masses_in_other_units_are_odd(radius, mass, said):
    text = BALL_ON_FLOOR.format(**{**USUAL, "z": 2 * radius})
    text = text.replace("radius = 0.05", f"radius = {radius}").replace("mass = 1.0", f"mass = {mass}")
    assert said in foretold(parse_scene(text, Path("scene.toml")))["sizes"]
    assert "sizes" not in foretold(scene_of())


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("[[bodies]]", "[[body]]"), "did you mean 'bodies'"),
        (('shape = "half_space"', 'shape = "plane"'), "did you mean 'half_space'"),
        (("sliding_friction", "friction"), "did you mean 'sliding_friction'"),
        (("n_steps = 40", "n_steps = 40\nduration = 1.0"), "say the same, got 1.0 and 40: keep one"),
        (("n_steps = 40", ""), "needs either duration .s. or n_steps, got neither"),
        (("n_steps = 40", "[[bodies]]\nn_steps = 40"), "'n_steps' stands within bodies 1: write it above"),
        (("radius = 0.05", "radius = 0.05\nfriction = 0.3"), "of all pairs in .default_contact."),
        (
            ('shape = "sphere"\nradius = 0.05', 'shape = "box"\nsize = [1, 1, 1]'),
            "did you mean 'half_extents'",
        ),
    ],
)
def test_words_of_other_programs(change, said):
    text = BALL_ON_FLOOR.format(**USUAL).replace(*change)
    with pytest.raises(ValueError, match=said):
        parse_scene(text, Path("scene.toml"))
