"""`dano track`: what is refused before any work starts."""

import pytest

from dano.cli import main


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ([], "give either --camera FILE, or --focal with --eye"),
        (["--eye", "0", "-1", "1"], "give either --camera FILE, or --focal with --eye"),
        (["--camera", "none.json", "--focal", "300", "--eye", "0", "-1", "1"], "give either --camera"),
        (["--camera", "none.json"], "film.mp4, which does not exist"),
        (["--camera", "none.json", "--slow-motion", "0"], "slow_motion must be finite and > 0"),
        (["--camera", "none.json", "--rays", "7"], "rays must be ≥ 256"),
    ],
)
def test_wrong_arguments_are_said_in_one_line(tmp_path, monkeypatch, capsys, options, match):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(["track", "film.mp4", "trained_soap", "-o", "motion.npz", *options])
    assert stop.value.code == 2
    assert match in capsys.readouterr().err
    assert not (tmp_path / "motion.npz").exists()


def test_objects_without_a_look_are_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        main(["track", "film.mp4", "bunny", "-o", "m.npz", "--camera", "c.json"])
    assert "must have a learned look" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "match"),
    [
        (["--video", "film.mp4"], "video needs --look"),
        (["--look", "trained_soap"], "give --video, too"),
        (
            ["--video", "film.mp4", "--look", "trained_soap"],
            "give either --camera FILE, or --focal with --eye",
        ),
        (["--video", "film.mp4", "--look", "bunny", "--camera", "c.json"], "look must have a learned look"),
        (["b.npz", "--video", "film.mp4", "--look", "trained_soap"], "that of the one motion, got 2 motions"),
    ],
)
def test_films_to_identify_from_need_a_look_and_a_camera(tmp_path, monkeypatch, capsys, options, match):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(["identify", "scene.toml", "a.npz", *options, "-p", "soap.mass:0:1"])
    assert stop.value.code == 2
    assert match in capsys.readouterr().err
