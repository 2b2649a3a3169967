"""`dano compare`."""

import json

import dano.comparison
from dano.comparison import Comparison, Row


def test_compare_writes_a_page(run, egg, tmp_path, monkeypatch):
    given = {}

    def measured(made, **options):
        given.update(options, mass=float(made.mass.mass))
        row = Row("neural object", "dano", tilt=0.1, gap=0.0)
        return Comparison([row], [], "the neural object", 0.1, [50.0], 50.0, 1, ["PyBullet is left out."])

    # What it measures is tested where it is measured.
    monkeypatch.setattr(dano.comparison, "compare", measured)
    page = tmp_path / "egg.html"
    answer = run("compare", egg, "-o", page, "--levels", 50, 20, "--drops", 1, "--json")
    assert answer.code == 0
    assert given["levels"] == (50.0, 20.0) and given["drops"] == 1 and given["truth"] is None
    report = json.loads(answer.out)
    assert report["rows"][0]["route"] == "neural object" and report["rows"][0]["motion_error"] is None
    assert page.read_text(encoding="utf-8").startswith("<!doctype html>")
    answer = run("compare", egg, "-o", page)
    assert "lies as it should" in answer.out and "PyBullet is left out." in answer.out


def test_bad_comparisons_end_with_one_line(run, egg, field, tmp_path):
    for arguments, message in (
        (("-o", tmp_path / "x.txt"), "must end in .html"),
        (("-o", tmp_path / "x.html", "--truth", field), "truth must be a closed mesh or a signed distance"),
        (("-o", tmp_path / "x.html", "--drops", 0), "drops must lie between 1 and 100, got 0"),
        (("-o", tmp_path / "x.html", "--levels", 1e9), "levels must lie between 0 and the largest density"),
    ):
        answer = run("compare", egg, *arguments)
        assert answer.code == 2
        assert message in answer.err and answer.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
