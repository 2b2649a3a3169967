"""Says which stored accuracy misses its target, and fails if one does.

Times are left out: they depend on the machine, and `benchmarks.speed` prints them beside their targets.
"""

import json
import sys

from benchmarks._measure import Row
from benchmarks.figures import RESULTS, stored_row

TIMES = ("ns", "µs", "ms", "s", "s/set", "×", "rays/s", "1/s")


def missed() -> list[tuple[str, Row]]:
    """File and row of each stored accuracy that misses its target."""
    found = []
    for file in sorted(RESULTS.glob("*.json")):
        rows = [stored_row(row) for row in json.loads(file.read_text()).get("rows", [])]
        found += [(file.name, r) for r in rows if r.unit not in TIMES and r.verdict == "misses target"]
    return found


def main() -> None:
    """The command."""
    for name, row in missed():
        sign = "≥" if row.at_least else "≤"
        print(f"{name}: {row.group}: {row.name}: {row.value:.3g} {row.unit}, target {sign} {row.target:g}")
    sys.exit(1 if missed() else 0)


if __name__ == "__main__":
    main()
