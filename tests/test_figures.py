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
