"""`python -m benchmarks.paper [--json FILE] [--quick]`."""

from benchmarks._measure import (
    load_average,
    NO_DATA,
    parse_arguments,
    reference_folder,
    report,
    Row,
    skipped,
    use_float64,
)


def main() -> None:
    arguments = parse_arguments("Compare dano with stored rollouts, large differences and closed forms.")
    load = load_average()
    use_float64()
    rows = _rows(quick=arguments.quick)
    report("paper", rows, {"dtype": "float64", "quick": arguments.quick}, load, arguments.json)


def _rows(*, quick: bool) -> list[Row]:
    # These compile on import, which has to wait for float64.
    from benchmarks import _subjects
    from benchmarks.paper import _gradients, _mass, _reference

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
    return rows


if __name__ == "__main__":
    main()
