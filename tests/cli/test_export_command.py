"""`dano export`."""

import json

import numpy as np
import pytest

import dano

QUICK = ("--resolution", 16, "--collision", "hull")


def test_export_writes_a_folder(run, egg, tmp_path):
    mujoco = pytest.importorskip("mujoco")
    answer = run(
        "export", egg, "-o", tmp_path / "out", "--to", "mjcf", "urdf", "--friction", 0.4, *QUICK, "--json"
    )
    assert answer.code == 0 and answer.err == ""
    report = json.loads(answer.out)
    assert "egg.xml" in report["files"] and "egg.urdf" in report["files"]
    assert report["collision"] == "hull" and not report["textured"]
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "egg.xml"))
    made = dano.NeuralObject.load(egg)
    np.testing.assert_allclose(
        np.sort(model.body_inertia[1]), np.linalg.eigvalsh(made.mass.inertia), rtol=1e-6
    )
    answer = run("export", egg, "-o", tmp_path / "out", *QUICK)
    assert answer.code == 0
    assert "in one colour: none were learned, and its convex hull for contact" in answer.out
    assert not (tmp_path / "out" / "egg.urdf").exists()


def test_bad_exports_end_with_one_line(run, egg, tmp_path):
    for arguments, message in (
        ((egg, "-o", tmp_path / "x", "--friction", -1), "sliding_friction must be finite and ≥ 0"),
        ((egg, "-o", tmp_path / "x", "--resolution", 2), "resolution must lie between 8 and 512"),
        ((egg, "-o", tmp_path / "x", "--name", "9"), "name must be a letter"),
        ((egg, "-o", tmp_path / "a" / "b"), "output folder must be in an existing one"),
        ((tmp_path / "none.dano", "-o", tmp_path / "x"), "must be an existing file"),
    ):
        answer = run("export", *arguments)
        assert answer.code == 2
        assert message in answer.err and answer.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
