"""Tables of the documentation are those of the stored results."""

import json

import pytest

pytest.importorskip("benchmarks.figures", reason="benchmarks are not part of an installed dano")
from benchmarks import figures


@pytest.mark.parametrize("page", figures.pages(), ids=lambda page: page.name)
def test_tables_are_those_of_the_stored_results(page):
    text = page.read_text(encoding="utf-8")
    assert text == figures.updated(text), "run python -m benchmarks.figures"


def test_a_table_follows_its_file(tmp_path, monkeypatch):
    row = {
        "group": "Speed",
        "name": "a step",
        "value": 12.345,
        "unit": "µs",
        "target": 10.0,
        "at_least": False,
    }
    rest = {"quartiles": [12.0, 13.0], "note": "", "verdict": "pass"}
    result = {
        "date": "2026-01-02",
        "machine": "a machine",
        "versions": {"jax": "1.2"},
        "load": {"before": 1, "after": 2},
    }
    (tmp_path / "run.json").write_text(json.dumps({**result, "rows": [{**row, **rest}]}))
    monkeypatch.setattr(figures, "RESULTS", tmp_path)
    text = figures.updated("a\n<!-- figures: run.json | Speed -->\nold\n<!-- end of figures -->\nb\n")
    assert "| a step | 12.3 µs | ≤ 10 µs | misses target |" in text
    assert "2026-01-02, a machine, jax 1.2; load average 1 to 2" in text
    assert "old" not in text
    assert text == figures.updated(text)
    for wrong in ("none.json", "run.json | Size"):
        with pytest.raises(ValueError, match=r"must name a file|has the groups"):
            figures.updated(f"<!-- figures: {wrong} -->\n<!-- end of figures -->")


def stored(folder, name: str, values: dict[tuple[str, str], float]) -> None:
    rows = [
        {"group": group, "name": row, "value": value, "unit": "m", "target": None, "at_least": False}
        for (group, row), value in values.items()
    ]
    (folder / name).write_text(json.dumps({"rows": rows}))


def test_headlines_follow_their_files(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "RESULTS", tmp_path)
    cell = figures.Cell("{:.1f} to {:.0f} m", "run", (("A", "low"), ("A", "high")))
    monkeypatch.setattr(figures, "HEADLINES", (figures.Headline("ways", cell, figures.Cell("theirs: 3")),))
    text = "<!-- figures: headlines -->\nold\n<!-- end of figures -->"
    stored(tmp_path, "run.json", {("A", "low"): 0.5, ("A", "high"): 9.0})
    assert "| ways | 0.5 to 9 m | theirs: 3 |" in figures.updated(text)
    stored(tmp_path, "run.json", {("A", "low"): 0.5})
    with pytest.raises(ValueError, match="must hold a value of"):
        figures.updated(text)


def test_cases_are_rows(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "RESULTS", tmp_path)
    stored(tmp_path, "a.json", {("mug", "way"): 2.0, ("mug", "time"): 3.0})
    stored(tmp_path, "b.json", {("cup", "way"): 4.0})
    text = "<!-- figures: cases {} | way -->\n<!-- end of figures -->"
    table = figures.updated(text.format("a.json b.json"))
    assert "| | way |\n|---|---|\n| mug | 2 m |\n| cup | 4 m |" in table
    with pytest.raises(ValueError, match=r"b.json must have rows \['way', 'time'\] for 'cup', 'time' is not"):
        figures.updated(text.format("b.json").replace("| way", "| way | time"))
    table = figures.updated(text.format("a.json b.json").replace("| way", "| way | time?"))
    assert "| | way | time |\n|---|---|---|\n| mug | 2 m | 3 m |\n| cup | 4 m | – |" in table
