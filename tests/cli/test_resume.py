"""Runs that are interrupted or killed go on, and end with the same numbers to the last bit."""

import json
import signal

import numpy as np
import pytest

from dano.archive import Pace
from dano.cli import _console
from dano.cli.running import _rollout, Clock


def arrays(path) -> dict[str, np.ndarray]:
    with np.load(path) as file:
        return {name: file[name] for name in file.files}


def interrupting(after: int, send):
    """`run_piece`, which is interrupted after so many pieces."""
    count = 0

    def run_piece(*given):
        nonlocal count
        count += 1
        if count > after:
            send()
        return _pieces(*given)

    _pieces = _rollout.run_piece
    return run_piece


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_goes_on_with_the_same_bits(number, run, scene, tmp_path, monkeypatch):
    whole, part, kept = (tmp_path / name for name in ("whole.npz", "part.npz", "part.checkpoint.npz"))
    assert run("simulate", scene, "-o", whole).code == 0
    monkeypatch.setattr(_rollout, "WORTH", 0.0)
    with monkeypatch.context() as patched:
        patched.setattr(_rollout, "run_piece", interrupting(5, lambda: signal.raise_signal(number)))
        answer = run("simulate", scene, "-o", part)
    assert answer.code == 130
    assert answer.err == "dano: interrupted; 100 of 400 steps are kept, --resume goes on\n"
    assert not part.exists() and kept.exists()
    pieces = []
    monkeypatch.setattr(_rollout, "run_piece", interrupting(99, None))
    piece = _rollout.run_piece
    monkeypatch.setattr(_rollout, "run_piece", lambda *given: pieces.append(given) or piece(*given))
    assert run("simulate", scene, "-o", part, "--resume").code == 0
    assert len(pieces) == 15
    assert sorted(path.name for path in tmp_path.iterdir()) == ["part.npz", "scene.toml", "whole.npz"]
    first, second = arrays(whole), arrays(part)
    assert first.keys() == second.keys()
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name], err_msg=name)


def test_a_run_that_was_killed_has_left_its_pieces(run, scene, tmp_path, monkeypatch):
    monkeypatch.setattr(Pace, "every", 0.0)
    monkeypatch.setattr(Pace, "share", 0)

    def kill():
        raise MemoryError  # stands for an end without any clearing up

    with monkeypatch.context() as patched:
        patched.setattr(_rollout, "run_piece", interrupting(3, kill))
        assert run("simulate", scene, "-o", tmp_path / "run.npz").code == 2
    kept = tmp_path / "run.checkpoint.npz"
    assert int(arrays(kept)["pieces"]) == 3
    # Of another run: said, and kept.
    answer = run("simulate", scene, "-o", tmp_path / "run.npz", "--steps", 200, "--resume")
    assert answer.code == 2 and "run.checkpoint.npz must be of this scene" in answer.err
    assert run("simulate", scene, "-o", tmp_path / "run.npz", "--resume").code == 0
    assert not kept.exists()


def test_a_full_disk_does_not_end_a_run(run, scene, tmp_path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Pace, "every", 0.0)
    monkeypatch.setattr(Pace, "share", 0)
    monkeypatch.setattr("dano.archive.write_archive", full)
    answer = run("simulate", scene, "-o", tmp_path / "run.npz")
    assert answer.code == 0 and "run.checkpoint.npz could not be written" in answer.err
    assert (tmp_path / "run.npz").exists()


@pytest.mark.usefixtures("interruptible")
def test_the_second_of_two_runs_goes_on_without_the_first(run, scene, tmp_path, monkeypatch):
    monkeypatch.setattr(Pace, "every", 0.0)
    monkeypatch.setattr(Pace, "share", 0)
    monkeypatch.setattr(_rollout, "WORTH", 0.0)
    words = ("simulate", scene, scene, "-o", tmp_path / "both")
    with monkeypatch.context() as patched:
        patched.setattr(_rollout, "run_piece", interrupting(25, lambda: signal.raise_signal(signal.SIGINT)))
        assert run(*words).code == 130
    pieces, piece = [], _rollout.run_piece
    monkeypatch.setattr(_rollout, "run_piece", lambda *given: pieces.append(given) or piece(*given))
    assert run(*words, "--resume").code == 0
    # The last piece of a run is not kept; a single piece is run once more to tell compiling from running.
    assert len(pieces) == 2 + 15
    names = ["scene_run.npz", "scene_run_2.npz"]
    assert sorted(path.name for path in (tmp_path / "both").iterdir()) == names
    first, second = (arrays(tmp_path / "both" / name) for name in names)
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name], err_msg=name)


def test_progress_is_told_in_files_too(monkeypatch, capsys):
    monkeypatch.setattr(_console, "QUIET", 10.0)
    now = iter([0.0, 1.0, 11.0, 12.0, 31.0])
    monkeypatch.setattr(_console.time, "monotonic", lambda: next(now))
    progress = _console.ProgressLine()
    for share in (0.0, 0.25, 0.3, 0.75):
        progress("simulating", share)
    assert capsys.readouterr().err == ("dano: simulating 25 %, 30 s left\ndano: simulating 75 %, 10 s left\n")


def test_the_parts_of_the_time_add_up(run, scene, tmp_path):
    answer = run("simulate", scene, "-o", tmp_path / "run.npz", "--json")
    parts = json.loads(answer.out)["seconds"]
    assert {"reading the scene", "compiling", "simulating", "writing", "contact forces"} <= parts.keys()
    assert min(parts.values()) >= 0
    clock = Clock("one")
    clock("two")
    clock.move(5.0, "two", "three")
    assert sum(clock.parts().values()) == pytest.approx(0, abs=0.1)
    assert clock.parts()["three"] == 5.0
