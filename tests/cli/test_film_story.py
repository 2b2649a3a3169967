"""`dano film` from the first photograph to the motion in the film, on pictures drawn in closed form."""

import json
from pathlib import Path

import numpy as np
import pytest
from vision import sliding_box
from vision.tabletop import TAG_SIDE

import dano
from dano.cli.film import STAGES
from dano.identification import load_motion
from dano.scene_file import load_run


@pytest.mark.slow
def test_photographs_and_a_film_become_an_object_that_moves_as_filmed(run, tmp_path: Path):
    pytest.importorskip("pycolmap", reason="structure from motion needs the extra `poses`")
    walk, film, empty = sliding_box.write_story(tmp_path)
    words = (
        "film",
        walk,
        film,
        "--marker-size",
        TAG_SIDE,
        "-o",
        tmp_path / "box.dano",
        "--background",
        empty,
    )
    words += ("--resolution", 40, "--iterations", 150, "--json")
    answer = run(*words)
    assert answer.code == 0, answer.err
    assert json.loads(answer.out)["made"] == list(STAGES)
    # It stands on the table, whose height the marker says.
    points = np.asarray(dano.NeuralObject.load(tmp_path / "box.dano").surface.points)
    assert abs(points[:, 2].min()) < 0.002
    motion = load_motion(tmp_path / "box_film" / "motion.npz")
    way = motion.position[-1, 0] - motion.position[0, 0]
    filmed = sliding_box.place(9.0) - sliding_box.place(0.0)
    # So coarse an object, cut by the edge of the first frame, is 3 % off.
    assert np.linalg.norm(way - filmed) < 0.06 * np.linalg.norm(filmed)
    friction = json.loads((tmp_path / "box_film" / "friction.json").read_text())
    assert friction["values"]["box,table.sliding_friction"] == pytest.approx(sliding_box.FRICTION, rel=0.05)
    # The scene moves as the film does, and nothing is pressed into the table at its start.
    run_found = load_run(tmp_path / "box_film" / "run.npz").trajectory
    slid = np.asarray(run_found.states.position[-1, 0] - run_found.states.position[0, 0])
    assert np.linalg.norm(slid - filmed) < 0.1 * np.linalg.norm(filmed)
    assert np.linalg.norm(run_found.states.velocity[0, 0]) < 1.2 * sliding_box.SPEED
    again = run(*words)
    assert json.loads(again.out)["made"] == [] and again.err.count("taken up again") == len(STAGES)
