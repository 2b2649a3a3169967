"""`dano demo soap`: what it starts from, and that stages are not done twice."""

import json

import numpy as np
import pytest

from dano.cli import main
from dano.cli.tracking import soap
from dano.vision import load_camera, load_capture, read_film


def test_the_case_holds_photographs_a_film_and_the_truth(tmp_path):
    soap.unpack(tmp_path)
    assert len(load_capture(tmp_path / "photographs").split("train")) == 64
    film = read_film(tmp_path / "film.mp4")
    truth = json.loads((tmp_path / "truth.json").read_text(encoding="utf-8"))
    assert len(film.times) == len(truth["position"]) == 24
    camera = load_camera(tmp_path / "camera.json", *film.size)
    # The soap is in the picture all the time.
    assert all(0 < x < 400 and 0 < y < 300 for x, y, _ in camera.project(np.array(truth["position"])))


def test_stages_are_kept_and_json_is_one_object(tmp_path, capsys):
    kept = {"friction": 0.3, "standard_error": 0.01, "from_poses": 0.4, "from_poses_standard_error": 0.1}
    for name in ("soap.dano", "soap_motion.npz"):
        (tmp_path / name).touch()
    (tmp_path / "soap_friction.json").write_text(json.dumps({**kept, "truth": 0.35}), encoding="utf-8")
    main(["demo", "soap", "--output", str(tmp_path), "--json"])
    assert json.loads(capsys.readouterr().out)["friction"] == 0.3
    main(["demo", "soap", "--output", str(tmp_path)])
    said = capsys.readouterr().out
    assert said.count("is there") == 4
    assert "0.4000 ± 0.1000 from the poses alone" in said


def test_what_a_stage_prints_is_no_part_of_the_object(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(soap, "_make", lambda folder, page, result, tell: (print("training"), page.touch()))
    (tmp_path / "soap_friction.json").write_text(json.dumps({"friction": 0.3}), encoding="utf-8")
    main(["demo", "soap", "--output", str(tmp_path), "--json"])
    printed = capsys.readouterr()
    assert json.loads(printed.out)["friction"] == 0.3
    assert "training" in printed.err


@pytest.mark.slow
def test_friction_from_photographs_and_a_film(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(soap, "RESOLUTION", 48)
    monkeypatch.setattr(soap, "ITERATIONS", 200)
    main(["demo", "soap", "--output", str(tmp_path), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["friction"] == pytest.approx(found["truth"], rel=0.05)
    assert found["frames_used"] == found["frames"] == 24
    page = (tmp_path / "soap_story.html").read_text(encoding="utf-8")
    assert "<video" in page
    (tmp_path / "soap_friction.json").unlink()
    made = (tmp_path / "soap.dano").stat().st_mtime_ns
    main(["demo", "soap", "--output", str(tmp_path)])
    assert (tmp_path / "soap.dano").stat().st_mtime_ns == made
    assert "soap.dano is there" in capsys.readouterr().out
