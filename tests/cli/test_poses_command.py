"""`dano poses`: the table it prints, the file it writes, and how it ends."""

import json
import math
import os
import signal
from pathlib import Path

import pytest
from vision.tabletop import camera, FOCAL, TAG_SIDE, write_pictures

from dano.cli._arguments import FindPoses
from dano.cli._learn import _ends, _known_length
from dano.vision import load_capture

pytest.importorskip("pycolmap", reason="structure from motion needs the extra `poses`")


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    write_pictures(folder, [camera(2 * math.pi * i / 9, 0.7) for i in range(9)])
    (folder / "999.png").write_bytes(b"broken")
    return folder


@pytest.mark.slow
def test_the_table_says_what_was_found_and_the_file_can_be_trained_on(photos: Path, run, tmp_path: Path):
    output = tmp_path / "transforms.json"
    choices = "--marker-size", TAG_SIDE, "--focal", FOCAL, "--features", 900
    answer = run("poses", photos, "-o", output, *choices)
    assert answer.code == 0, answer.err
    assert "registered          9 of 10 pictures" in answer.out
    assert "metres ± 0." in answer.out and "marker 3, side 50 mm" in answer.out
    assert "px, given" in answer.out and "lying flat" in answer.out
    assert "999.png: cannot be read" in answer.out
    assert "warning: 9 pictures are few" in answer.err
    assert len(load_capture(output).views) == 9
    assert [path.name for path in tmp_path.iterdir()] == ["transforms.json"]


def test_json_holds_the_same_in_numbers_and_failures_end_in_a_line(photos: Path, run, tmp_path: Path):
    output = tmp_path / "transforms.json"
    answer = run("poses", photos, "-o", output, "--json", "--features", 900, "--up", "plane", "--seed", 1)
    assert answer.code == 0, answer.err
    report = json.loads(answer.out)
    assert report["registered"] == 9 and report["pictures"] == 10 and report["models"] == [9]
    assert report["metric"] is False and report["scale_relative_error"] is None
    assert report["up_error_degrees"] < 1 and report["left_out"][0]["file"] == "999.png"
    before = output.read_bytes()
    empty = tmp_path / "empty"
    empty.mkdir()
    for arguments, message in (
        ((empty,), "there are no pictures in it"),
        ((tmp_path / "nowhere",), "must be a folder of pictures or a video"),
        ((photos, "--length", 0.1), "length and ends belong together"),
        ((photos, "--length", 0.1, "--ends", "a:1,2", "b:1,2:3,4"), "ends must look like NAME:X,Y:X,Y"),
        ((photos, "--focal", 1, 2, 3), "focal must be one number or two"),
        ((photos, "--masks", tmp_path / "nowhere"), "masks must be a folder"),
        ((photos, "--marker-family", "tag36h11"), "marker_family must be one of"),
    ):
        failed = run("poses", *arguments, "-o", output)
        assert failed.code == 2 and message in failed.err, failed.err
        assert output.read_bytes() == before
    assert run("poses", photos, "-o", tmp_path / "x.txt").code == 2


def test_ends_are_read_with_names_that_hold_colons(tmp_path: Path):
    assert _ends("12:30.jpg:1,2:3.5,4") == ("12:30.jpg", (1.0, 2.0, 3.5, 4.0))
    command = FindPoses(
        photos := tmp_path, output=tmp_path / "t.json", length=0.2, ends=("a:1,2:3,4", "b:5,6:7,8")
    )
    known = _known_length(command)
    assert known is not None and known.length == 0.2 and known.ends["b"] == (5, 6, 7, 8)
    assert _known_length(FindPoses(photos, output=tmp_path / "t.json")) is None


def test_ctrl_c_leaves_nothing(photos: Path, run, tmp_path: Path, interruptible, monkeypatch):
    from dano.vision.structure import _estimate

    def interrupted(*_: object, **__: object) -> None:
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(_estimate, "find_models", interrupted)
    answer = run("poses", photos, "-o", tmp_path / "transforms.json", "--features", 300)
    assert answer.code == 130 and "interrupted" in answer.err
    assert list(tmp_path.iterdir()) == []
