"""Writes the tables of the documentation from the stored results, so that text and file cannot disagree.

A table stands between two comments,

    <!-- figures: FILE.json | GROUP | GROUP … -->
    <!-- end of figures -->

with the groups of rows to show, all without any. Two other forms:

    <!-- figures: cases FILE.json FILE.json | NAME | NAME … -->
    <!-- figures: headlines -->

The first has a row for each group of its files that has such names, and a column for each name; of a name
that ends in "?" a group may have no row. The second has the rows that `benchmarks/_headlines.py` lists.
`python -m benchmarks.figures` rewrites all tables; with `--check` it changes nothing and fails where one is
out of date.
"""

import argparse
import json
import re
import sys
from pathlib import Path

from benchmarks._headlines import Cell, Headline as Headline, HEADLINES
from benchmarks._measure import REPOSITORY, Row

RESULTS = REPOSITORY / "benchmarks" / "results"
_BLOCK = re.compile(
    r"(?P<begin><!-- figures: (?P<what>[^\n]*?) -->\n)(?P<table>.*?)(?P<end><!-- end of figures -->)",
    re.DOTALL,
)


def pages() -> list[Path]:
    """The files that may hold tables."""
    return [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]


def updated(text: str) -> str:
    """The text with every table as the stored results have it.

    Raises:
        ValueError: If a table names a file or a group of rows that is not there.
    """
    return _BLOCK.sub(lambda block: block["begin"] + _table(block["what"]) + block["end"], text)


def _table(what: str) -> str:
    if what == "headlines":
        return _headlines()
    return _cases(what.removeprefix("cases ")) if what.startswith("cases ") else _stored(what)


def _cases(what: str) -> str:
    files, *names = (word.strip() for word in what.split("|"))
    optional = {name.removesuffix("?") for name in names if name.endswith("?")}
    names = [name.removesuffix("?") for name in names]
    lines = ["| | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    for file in files.split():
        rows = _result(file)["rows"]
        for group in dict.fromkeys(row["group"] for row in rows):
            found = {row["name"]: stored_row(row) for row in rows if row["group"] == group}
            missing = [name for name in names if name not in found and name not in optional]
            if not found.keys() & set(names):
                continue  # A group of other things.
            if missing:
                raise ValueError(f"{file} must have rows {names} for {group!r}, {missing[0]!r} is not there")
            cells = [_measured(found[name]) if name in found else "–" for name in names]
            lines.append(f"| {group} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n\n"


def _measured(row: Row) -> str:
    return "–" if row.value is None else f"{row.value:.3g} {row.unit}".strip()


def _headlines() -> str:
    lines = ["| | dano | beside it |", "|---|---|---|"]
    lines += [f"| {row.what} | {_cell(row.figure)} | {_cell(row.beside)} |" for row in HEADLINES]
    return "\n".join(lines) + "\n\n"


def _cell(cell: Cell) -> str:
    if not cell.rows:
        return cell.words
    stored = {(row["group"], row["name"]): row["value"] for row in _result(f"{cell.file}.json")["rows"]}
    missing = [row for row in cell.rows if stored.get(row) is None]
    if missing:
        raise ValueError(f"{cell.file}.json must hold a value of {missing[0]}")
    return cell.words.format(*(stored[row] for row in cell.rows))


def _stored(what: str) -> str:
    name, *groups = (word.strip() for word in what.split("|"))
    result = _result(name)
    there = list(dict.fromkeys(row["group"] for row in result["rows"]))
    missing = [group for group in groups if group not in there]
    if missing:
        raise ValueError(f"{name} has the groups {there}, got {missing[0]!r}")
    lines = [_source(result), "", "| | measured | target | |", "|---|---|---|---|"]
    for group in groups or there:
        lines.append(f"| **{group}** | | | |")
        lines += [_line(row) for row in result["rows"] if row["group"] == group]
    return "\n".join(lines) + "\n\n"


def _result(name: str) -> dict:
    file = RESULTS / name
    if not file.is_file():
        raise ValueError(f"a table must name a file in {RESULTS}, got {name!r}")
    return json.loads(file.read_text())


def _source(result: dict) -> str:
    """When and where it was measured."""
    names = {"jax": "jax", "mujoco": "MuJoCo"}
    versions = [
        f"{words} {result['versions'][key]}" for key, words in names.items() if key in result["versions"]
    ]
    load = result["load"]
    where = ", ".join([result["date"], result["machine"], *versions])
    return f"{where}; load average {load['before']:g} to {load['after']:g} on a shared machine."


def stored_row(row: dict) -> Row:
    """A row of a results file; its verdict follows from value and target."""
    values = {key: value for key, value in row.items() if key != "verdict"}
    if values.get("quartiles") is not None:
        values["quartiles"] = tuple(values["quartiles"])
    return Row(**values)


def _line(row: dict) -> str:
    stored = stored_row(row)
    if stored.value is None:
        return f"| {stored.name} | | | {stored.verdict}: {stored.note} |"
    target = (
        "" if stored.target is None else f"{'≥' if stored.at_least else '≤'} {stored.target:g} {stored.unit}"
    )
    return f"| {stored.name} | {stored.value:.3g} {stored.unit} | {target.strip()} | {stored.verdict} |"


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Write the tables of the documentation from stored results.")
    parser.add_argument(
        "--check", action="store_true", help="change nothing; fail where a table is out of date"
    )
    arguments = parser.parse_args()
    stale = [page for page in pages() if page.read_text() != updated(page.read_text())]
    for page in stale:
        print(page.relative_to(REPOSITORY))
        if not arguments.check:
            page.write_text(updated(page.read_text()))
    if arguments.check and stale:
        sys.exit("out of date: run python -m benchmarks.figures")


if __name__ == "__main__":
    main()
