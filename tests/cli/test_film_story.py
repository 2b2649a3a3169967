"""`dano film` from the first photograph to the motion in the film, on pictures drawn in closed form."""

import json
from pathlib import Path

import numpy as np
import pytest
from vision import sliding_box
from vision.tabletop import TAG_SIDE

import dano
from dano.cli.film import STAGES
from dano.identify import load_motion


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
    words += ("--resolution", 40, "--iterations", 150, "--to", "motion", "--json")
    answer = run(*words)
    assert answer.code == 0, answer.err
    done = STAGES[: STAGES.index("motion") + 1]
    assert json.loads(answer.out)["made"] == list(done)
    # It stands on the table, whose height the marker says.
    points = np.asarray(dano.NeuralObject.load(tmp_path / "box.dano").surface.points)
    assert abs(points[:, 2].min()) < 0.002
    motion = load_motion(tmp_path / "box_film" / "motion.npz")
    way = motion.position[-1, 0] - motion.position[0, 0]
    filmed = sliding_box.place(9.0) - sliding_box.place(0.0)
    # So coarse an object, cut by the edge of the first frame, is 3 % off.
    assert np.linalg.norm(way - filmed) < 0.06 * np.linalg.norm(filmed)
    again = run(*words)
    assert json.loads(again.out)["made"] == [] and again.err.count("taken up again") == len(done)
