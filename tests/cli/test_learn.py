"""`dano data` and `dano train` on a few photographs of an ellipsoid."""

import json
import os
from pathlib import Path

import jax.numpy as jnp
import pytest
from PIL import Image
from vision.photographs import capture, CENTRE, write_transforms

from dano import learning, load_field, NeuralObject
from dano.vision import LearnedField


@pytest.fixture(scope="module")
def images(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("images")
    write_transforms(folder, capture(n_train=14, n_test=2, pixels=24))
    return folder


def test_photographs_are_checked_and_drawn(images: Path, run, tmp_path: Path):
    answer = run("data", images, "--png", tmp_path / "cameras.png", "--json")
    assert answer.code == 0, answer.err
    report = json.loads(answer.out)
    assert report["views"] == {"train": 14, "test": 2, "relight": 0}
    assert report["lights"] == 3 and report["residual"] < 0.04
    assert (tmp_path / "cameras.png").read_bytes().startswith(b"\x89PNG")
    missing = run("data", tmp_path / "nowhere")
    assert missing.code == 2 and "no such folder" in missing.err


@pytest.mark.slow
def test_training_leaves_object_grid_field_report_and_figures(images: Path, run, tmp_path: Path):
    output, figures = tmp_path / "egg.dano", tmp_path / "egg.json"
    previews = "--previews", tmp_path / "previews"
    sizes = ("--resolution", 24, "--iterations", 12, "--batch", 256)
    answer = run("train", images, "-o", output, "--mass", 0.3, "--json", figures, *previews, *sizes)
    assert answer.code == 0, answer.err
    with Image.open(tmp_path / "previews" / "000012.png") as sheet:
        assert sheet.height > 2 * 90
    assert LearnedField.of_object(output) is not None
    made = NeuralObject.load(output)
    assert float(made.mass.mass) == pytest.approx(0.3)
    assert abs(made.mass.com - CENTRE).max() < 0.002
    grid = load_field(tmp_path / "egg.grid.npz")
    # An occupancy probability: one inside. (The grid's coefficients are not its values.)
    assert float(grid.density(jnp.asarray(CENTRE))) == pytest.approx(1, abs=0.02)
    assert {"psnr", "mask_iou", "seconds", "mass", "com", "inertia"} <= set(json.loads(figures.read_text()))
    assert "data:image/png;base64" in (tmp_path / "egg.html").read_text(encoding="utf-8")
    assert not (tmp_path / "egg.checkpoint.npz").exists()
    refused = run("train", images, "-o", tmp_path / "egg.npz")
    assert refused.code == 2 and "must end in .dano" in refused.err


@pytest.mark.parametrize("when", ["before", "after"])
def test_an_interrupted_training_promises_only_a_checkpoint_that_it_wrote(when, run, tmp_path, monkeypatch):
    """Also beside a checkpoint that an earlier training left."""
    output, checkpoint = tmp_path / "egg.dano", tmp_path / "egg.checkpoint.npz"

    def learn(capture, options, *, checkpoint, **_):
        if when == "after":
            checkpoint.write_bytes(b"what was learned so far")
        raise KeyboardInterrupt

    monkeypatch.setattr(learning, "load_capture", lambda *_, **__: capture(n_train=4, n_test=1, pixels=8))
    monkeypatch.setattr(learning, "train", learn)
    for old in (False, True):
        if old:
            checkpoint.write_bytes(b"old")
            os.utime(checkpoint, (1, 1))
        answer = run("train", tmp_path, "-o", output)
        assert answer.code == 130 and answer.err.count("\n") == 1
        assert ("--resume" in answer.err) == (when == "after"), answer.err
        checkpoint.unlink(missing_ok=True)
