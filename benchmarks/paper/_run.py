"""Collects all comparisons and reports."""

from benchmarks import _subjects
from benchmarks._measure import load_average, NO_DATA, parse_arguments, reference_folder, report, Row, skipped
from benchmarks.paper import _contact, _gradients, _mass, _reference


def run() -> None:
    arguments = parse_arguments("Compare dano with stored rollouts, large differences and closed forms.")
    load = load_average()
    rows = _rows(quick=arguments.quick)
    report("paper", rows, {"dtype": "float64", "quick": arguments.quick}, load, arguments.json)


def _rows(*, quick: bool) -> list[Row]:
    folder = reference_folder()
    authors = _subjects.authors_bunny()
    rows = []
    if folder is None or authors is None:
        rows.append(skipped(_reference.GROUP, "all of them", NO_DATA))
        rows.append(skipped("Derivatives", "authors' bunny", NO_DATA))
    else:
        rows += _reference.reference_rows(folder, quick=quick)
        rows += _gradients.gradient_rows(authors, quick=quick)
    rows += _gradients.gradient_rows(_subjects.shipped_bunny(), quick=quick)
    rows += _mass.mass_rows(quick=quick)
    rows += _contact.contact_rows(quick=quick)
    return rows
