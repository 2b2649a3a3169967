"""`dano plan` and task files."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from dano.planning import load_controls
from dano.scene_file import load_scene, load_task

SCENE = """
timestep = 0.05
duration = 1.0
gravity = [0.0, 0.0, 0.0]

[[bodies]]
name = "puck"
shape = "sphere"
radius = 0.1
mass = 2.0
"""
TASK = """
duration = 0.5

[[actuators]]
body = "puck"
limit = 20.0
axes = "xy"
start = [1.0, 0.0]

[[goals]]
body = "puck"
position = [0.3, 0.1, 0.0]
axes = "xy"
within = 1e-4

[[limits]]
body = "puck"
quantity = "velocity"
lower = -inf
upper = 5.0

[search]
max_seconds = 600.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("plan")
    (path / "scene.toml").write_text(SCENE)
    (path / "task.toml").write_text(TASK)
    return path


def test_a_plan_is_found_written_and_drawn(folder, run):
    paths = {name: folder / name for name in ("plan.npz", "plan.png", "controls.png")}
    answer = run(
        *("plan", folder / "scene.toml", folder / "task.toml", "-o", paths["plan.npz"], "--json"),
        *("--strip", paths["plan.png"], "--controls", paths["controls.png"]),
    )
    assert answer.code == 0, answer.err
    result = json.loads(answer.out)
    assert result["reached"] and result["steps"] == 10 and result["unsolved_steps"] == 0
    assert result["goals"][0]["name"] == "position of puck" and result["goals"][0]["error"] < 2e-4
    for picture in ("plan.png", "controls.png"):
        assert paths[picture].read_bytes().startswith(b"\x89PNG")
    assert load_controls(paths["plan.npz"]).force.shape == (10, 1, 3)


def test_a_task_file_says_what_the_task_is(folder):
    given = load_task(folder / "task.toml", load_scene(folder / "scene.toml").scene)
    assert given.task.n_steps == 10 and given.method == "ilqr"
    assert given.options.ilqr.max_seconds == given.options.sampling.max_seconds == 600
    assert given.options.explore is None and given.options.sampling.passes == 30
    np.testing.assert_array_equal(given.controls, np.tile([1.0, 0.0], (10, 1)))
    assert given.task.goals[0].axes == "xy" and given.task.limits[0].name == "limit of velocity of puck"


MOTOR = """
timestep = 0.1
n_steps = 3
gravity = [0.0, 0.0, 0.0]
[[bodies]]
name = "jaw"
shape = "box"
half_extents = [0.1, 0.1, 0.1]
mass = 1.0
[[joints]]
child = "jaw"
kind = "slide"
axis = [1.0, 0.0, 0.0]
motor = { kind = "position", stiffness = 400.0, damping = 40.0, limits = [-50.0, 50.0] }
"""


def test_commands_of_motors_are_controls_of_a_task(tmp_path):
    """A motor in a scene file, and first guesses with straight lines between moments."""
    (tmp_path / "scene.toml").write_text(MOTOR)
    (tmp_path / "task.toml").write_text(
        'n_steps = 5\n[[actuators]]\nbody = "jaw"\nkind = "command"\nlower = -1.0\nupper = 1.0\n'
        'start = [[0.0, 0.0], [0.1, 0.0], [0.3, 0.4]]\n[[goals]]\nbody = "jaw"\nq = 0.4\n'
    )
    scene = load_scene(tmp_path / "scene.toml").scene
    given = load_task(tmp_path / "task.toml", scene)
    np.testing.assert_allclose(given.controls[:, 0], [0, 0, 0.2, 0.4, 0.4], atol=1e-12)
    controls = given.task.controls(scene, jnp.asarray(given.controls))
    assert controls.command is not None
    np.testing.assert_allclose(controls.command, given.controls)
    with pytest.raises(ValueError, match=r"\[\[joints\]\] 1 .*unknown key 'stifness'"):
        (tmp_path / "wrong.toml").write_text(MOTOR.replace("stiffness", "stifness"))
        load_scene(tmp_path / "wrong.toml")
    with pytest.raises(ValueError, match="command of 'jaw' must be that of a joint with a motor"):
        (tmp_path / "plain.toml").write_text(MOTOR[: MOTOR.index("motor =")])
        load_task(tmp_path / "task.toml", load_scene(tmp_path / "plain.toml").scene)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("duration = 0.5", "", "needs either duration [s] or n_steps"),
        ("duration = 0.5", "duraton = 0.5", "unknown key 'duraton'; .*; did you mean 'duration'"),
        ("duration = 0.5", "n_steps = 0", "n_steps must be ≥ 1, got 0"),
        ('body = "puck"\nlimit', 'body = "pukc"\nlimit', "got 'pukc'; did you mean 'puck'"),
        ("limit = 20.0", "limt = 20.0", "unknown key 'limt'; .*; did you mean 'limit'"),
        ("limit = 20.0", "lower = 3.0\nupper = 2.0", "no control lies between them"),
        ("limit = 20.0", "limit = 'much'", "limit must be a number or a list of numbers, got 'much'"),
        ("start = [1.0, 0.0]", "start = [1.0]", "start must be a number, a list of 2, or rows of a time"),
        ("start = [1.0, 0.0]", "start = [[0.0, 1.0]]", "start must be rows of a growing time and 2 numbers"),
        ("start = [1.0, 0.0]", "start = [[1, 0, 0], [0, 0, 0]]", "rows of a growing time and 2 numbers"),
        ("limit = 20.0", 'kind = "forc"\nlimit = 1.0', "kind must be one of .*; did you mean 'force'"),
        ("position = [0.3, 0.1, 0.0]", "", "needs exactly one of position, orientation"),
        ("position = [0.3, 0.1, 0.0]", "positoin = [0, 0, 0]", "did you mean 'position'"),
        ("within = 1e-4", "within = 0.0", "within of the goal of 'puck' must be > 0"),
        ('quantity = "velocity"', 'quantity = "speed"', "must be one of position, velocity"),
        ("max_seconds = 600.0", "max_seconds = 0.0", r"max_seconds must be finite and > 0, got 0.0"),
        ("max_seconds = 600.0", 'method = "lqr"', "method must be one of .*; did you mean 'ilqr'"),
        ("max_seconds = 600.0", "softening = [2.0]", r"softening must hold factors between 0 and 1, got 2.0"),
        ("max_seconds = 600.0", 'first = "evn"', "first must be one of .*; did you mean 'even'"),
        ("[search]", "[search", "must be a TOML task file"),
    ],
)
def test_what_is_wrong_in_a_task_file_is_said(folder, old, new, message):
    assert old in TASK
    scene = load_scene(folder / "scene.toml").scene
    (folder / "wrong.toml").write_text(TASK.replace(old, new, 1))
    with pytest.raises(ValueError, match=message.replace("[s]", r"\[s\]")) as error:
        load_task(folder / "wrong.toml", scene)
    assert "wrong.toml" in str(error.value)


def test_wrong_outputs_and_files_are_said(folder, run):
    scene, task = folder / "scene.toml", folder / "task.toml"
    assert "must end in .npz" in run("plan", scene, task, "-o", folder / "plan.txt").err
    answer = run("plan", scene, task, "-o", folder / "p.npz", "--video", folder / "film.gif")
    assert answer.code == 2 and "must end in .mp4" in answer.err
    assert run("plan", scene, folder / "none.toml", "-o", folder / "p.npz").code == 2
    assert not (folder / "p.npz").exists()
