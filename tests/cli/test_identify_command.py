"""`dano identify`: a slide in a file, and arguments that are wrong."""

import json
import signal
import subprocess
import sys

import numpy as np
import pytest

import dano
from dano.cli.identifying.run import _errors_text
from dano.identification import Errors
from dano.identification._problem import Problem
from dano.solvers import bounded_least_squares

SCENE = """
timestep = 0.005
n_steps = 10

[[bodies]]
name = "ball"
shape = "sphere"
radius = 0.05
mass = 0.5

[[bodies]]
name = "floor"
shape = "half_space"
fixed = true

[[contacts]]
a = "ball"
b = "floor"
sliding_friction = 0.5
"""


@pytest.fixture
def files(tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE)
    loaded = dano.load_scene(tmp_path / "scene.toml")
    scene = loaded.scene.replace_contact("ball", "floor", sliding_friction=0.25)
    start = scene.initial_state(ball={"position": (0, 0, 0.05), "velocity": (1.5, 0.3, 0)})
    run = dano.simulate(scene, start, 40)
    motion = dano.Motion.from_trajectory(run, bodies=["ball"], every=2)
    for name in ("slide.npz", "slide.csv"):
        dano.save_motion(tmp_path / name, motion)
    return tmp_path


def test_finds_the_friction(files, run):
    answer = run(
        "identify", files / "scene.toml", files / "slide.npz", "-p", "ball,floor.sliding_friction:0:1:0.6",
        "--held-out", files / "slide.csv", "-o", files / "fit.json",
    )  # fmt: skip
    assert answer.code == 0, answer.err
    assert "ball,floor.sliding_friction" in answer.out and "held out" in answer.out
    result = json.loads((files / "fit.json").read_text())
    # A .csv does not say that its velocities are those of half a step before: 3 % too much friction.
    assert result["values"]["ball,floor.sliding_friction"] == pytest.approx(0.25, rel=1e-6)
    assert result["converged"] and np.isfinite(result["standard_errors"]["ball,floor.sliding_friction"])


def test_errors_of_what_was_not_observed_are_not_said():
    seen = Errors(1.2e-3, 2e-3, np.radians(0.5), np.radians(0.25), 1.0)
    assert _errors_text(seen) == "position 1.2 mm (last frame 2), rotation 0.5° (last frame 0.25)"
    places = seen._replace(mean_rotation=float("nan"), final_rotation=float("nan"))
    assert _errors_text(places) == "position 1.2 mm (last frame 2)"
    rates = places._replace(mean_position=float("nan"), final_position=float("nan"))
    assert _errors_text(rates) == "1 standard deviations of the noise"


@pytest.mark.slow
def test_writes_a_page(files, run):
    answer = run(
        "identify", files / "scene.toml", files / "slide.npz", "-p", "ball,floor.sliding_friction:0:1:0.6",
        "--report", files / "fit.html",
    )  # fmt: skip
    assert answer.code == 0, answer.err
    page = (files / "fit.html").read_text()
    assert "data:video/mp4" in page and "data:image/png" in page and "http" not in page


@pytest.mark.parametrize(
    ("parameter", "match"),
    [
        ("ball,floor.sliding_friction:0", "BODY.PROPERTY:LOWER:UPPER"),
        ("ball,floor.sliding_friction:a:b", "BODY.PROPERTY:LOWER:UPPER"),
        ("sliding_friction:0:1", "BODY.PROPERTY:LOWER:UPPER"),
        ("ball,wall.sliding_friction:0:1", "must name bodies of the scene ['ball', 'floor'], got 'wall'"),
        ("ball,flor.sliding_friction:0:1", "got 'flor'; did you mean 'floor'?"),
        ("ball,floor.slidng_friction:0:1", "got 'slidng_friction'; did you mean 'sliding_friction'?"),
        ("ball,floor.spring:1e3:1e5", "must be one of sliding_friction, stiffness, restitution"),
        ("ball,ball.sliding_friction:0:1", "contact must be one of"),
        ("ball.colour:0:1", "must be one of mass_scale"),
        ("ball,floor.sliding_friction:1:0", "lower of parameter"),
    ],
)
def test_wrong_parameters(files, run, parameter, match):
    answer = run("identify", files / "scene.toml", files / "slide.csv", "-p", parameter)
    assert answer.code == 2 and match in answer.err


def test_wrong_files(files, run):
    scene, slide, given = files / "scene.toml", files / "slide.csv", ("-p", "ball.mass_scale:0.5:2")
    assert "existing file" in run("identify", scene, files / "none.csv", *given).err
    assert ".html file" in run("identify", scene, slide, *given, "--report", files / "fit.txt").err
    assert ".json file" in run("identify", scene, slide, *given, "-o", files / "fit.txt").err
    assert not (files / "fit.txt").exists()
    (files / "empty.csv").write_text("time,x,y,z\n")
    assert "at least one row" in run("identify", scene, files / "empty.csv", *given).err


def test_motions_that_cannot_be_used(files, run):
    scene, given = files / "scene.toml", ("-p", "ball,floor.sliding_friction:0:1")
    table = (files / "slide.csv").read_text().splitlines()
    names = table[0].split(",")
    rows = [line.split(",") for line in table[1:]]

    def refused(change, match):
        (files / "bad.csv").write_text("\n".join(",".join(row) for row in change) + "\n")
        answer = run("identify", scene, files / "bad.csv", *given, "-o", files / "none.json")
        assert answer.code == 2 and match in answer.err, answer.err
        assert not (files / "none.json").exists()

    blank = [[row[0], *([""] * (len(row) - 1))] for row in rows]
    refused([names, *blank], "at least one observed frame")
    refused([names, rows[0]], "at least two frames")
    place = [names.index(name) for name in ("qw", "qx", "qy", "qz")]
    spin = [names.index(name) for name in ("wx", "wy", "wz")]
    turned = []
    for i, row in enumerate(rows):
        # A turn about z, with its scalar last although the columns say first.
        changed, angle = list(row), 0.02 * i
        for column, value in zip(place, (0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)), strict=True):
            changed[column] = repr(float(value))
        for column, value in zip(spin, (0.0, 0.0, 0.02 / 0.01), strict=True):
            changed[column] = repr(float(value))
        turned.append(changed)
    refused([names, *turned], "(x, y, z, w)")


@pytest.mark.usefixtures("interruptible")
def test_an_interrupted_search_keeps_its_best_and_says_so(files, run, monkeypatch):
    def search(self, x, *given, **options):
        calls = []

        def linearize(*state):
            if calls:
                signal.raise_signal(signal.SIGINT)
            calls.append(state)
            return Problem.linearize(self, *state)

        found = bounded_least_squares(linearize, x, lower=x - 1, upper=x + 1, start_blocks=self.plan.start,
                                      retract=self.retract)  # fmt: skip
        return found

    monkeypatch.setattr(Problem, "search", search)
    answer = run(
        "identify", files / "scene.toml", files / "slide.csv", "-p", "ball,floor.sliding_friction:0:1:0.6",
        "--starts", 1, "-o", files / "fit.json", "--report", files / "fit.html",
    )  # fmt: skip
    # What the search was replaced by keeps nothing.
    assert (answer.code, answer.err) == (130, "dano: interrupted; the values are the best so far\n")
    result = json.loads((files / "fit.json").read_text())
    assert result["values"] == {"ball,floor.sliding_friction": pytest.approx(0.6)}
    assert "interrupted" in result["stop"] and not result["converged"]
    assert not (files / "fit.html").exists()


@pytest.mark.usefixtures("interruptible")
def test_an_interrupted_search_says_how_it_goes_on(files, run, monkeypatch):
    words = (
        "identify", files / "scene.toml", files / "slide.npz", "-p", "ball,floor.sliding_friction:0:1:0.6",
        "--starts", 1,
    )  # fmt: skip
    whole, part = files / "whole.json", files / "part.json"
    assert run(*words, "-o", whole).code == 0
    with monkeypatch.context() as patched:
        patched.setattr(Problem, "linearize", failing_after(3, lambda: signal.raise_signal(signal.SIGINT)))
        answer = run(*words, "-o", part)
    said = "dano: interrupted; the values are the best so far, --resume goes on\n"
    assert (answer.code, answer.err) == (130, said)
    assert (files / "part.checkpoint.npz").exists()
    answer = run(*words, "-o", part, "--resume", "--huber", 2.0)
    assert answer.code == 2 and "part.checkpoint.npz must be of this search" in answer.err
    assert run(*words, "-o", part, "--resume").code == 0
    assert not (files / "part.checkpoint.npz").exists()
    assert_same(whole, part)
    assert "resume needs --output" in run(*words, "--resume").err
    film = ("--video", "film.mp4", "--look", "trained_soap", "--camera", "camera.json", "--resume")
    assert "leave out --resume, or --video" in run(*words, "-o", part, *film).err


KILLED = """
import os, signal, sys
from dano.archive import Pace
from dano.cli import main
from dano.identification._problem import Problem
Pace.every, Pace.share = 0.0, 0
linearize, calls = Problem.linearize, []
def until(self, x, start):
    calls.append(x)
    if len(calls) > 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return linearize(self, x, start)
Problem.linearize = until
main(sys.argv[1:])
"""


@pytest.mark.slow
def test_a_search_in_a_process_that_was_killed_goes_on(files, run):
    words = (
        "identify", files / "scene.toml", files / "slide.npz", "-p", "ball,floor.sliding_friction:0:1:0.6",
        "--starts", 1,
    )  # fmt: skip
    whole, part = files / "whole.json", files / "part.json"
    assert run(*words, "-o", whole).code == 0
    killed = subprocess.run([sys.executable, "-c", KILLED, *map(str, words), "-o", part], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert not part.exists() and (files / "part.checkpoint.npz").exists()
    assert run(*words, "-o", part, "--resume").code == 0
    assert sorted(path.name for path in files.glob("part*")) == ["part.json"]
    assert_same(whole, part)


def failing_after(count, send):
    """`linearize`, in which something happens after so many calls."""
    calls = []
    usual = Problem.linearize

    def linearize(self, *state):
        calls.append(state)
        if len(calls) > count:
            send()
        return usual(self, *state)

    return linearize


def assert_same(whole, part) -> None:
    first, second = (json.loads(path.read_text()) for path in (whole, part))
    for result in (first, second):
        del result["seconds"]
    assert first == second


def test_units_are_checked_before_the_search(files, run, monkeypatch):
    """The slide in millimetres, and in milliseconds."""
    monkeypatch.setattr(Problem, "search", lambda *_, **__: pytest.fail("searched all the same"))
    slide = dano.load_motion(files / "slide.csv", names="ball")
    for name, times, position, message in (
        ("mm", slide.times, 1000 * slide.position, "if positions are in millimetres, divide them by 1000"),
        ("ms", 1000 * slide.times, slide.position, "times must be in seconds, and span at most 20000 steps"),
    ):
        path = files / f"{name}.csv"
        motion = dano.Motion.create(times, ("ball",), position=position, orientation=slide.orientation)
        dano.save_motion(path, motion)
        answer = run("identify", files / "scene.toml", path, "-p", "ball,floor.sliding_friction:0:1")
        assert (answer.code, answer.err.count("\n")) == (2, 1)
        assert message in answer.err
