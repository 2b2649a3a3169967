"""`python -m benchmarks.speed.piles [FILE.json] [FILE.png]`: cost of a step and box by number of boxes.

From what `python -m benchmarks.speed --only pile rest --largest 1000 --json FILE.json` has written.
"""

import json
import re
import sys
from pathlib import Path
from typing import Any

from benchmarks._measure import REPOSITORY

FIGURES = REPOSITORY / "benchmarks" / "results" / "speed-piles-cpu.json"
PICTURE = REPOSITORY / "docs" / "images" / "piles.png"


def lines_of(rows: list[dict[str, Any]]) -> dict[str, list[tuple[int, float]]]:
    """Number of boxes and µs a step and box, of each engine and kind of scene."""
    found: dict[str, list[tuple[int, float]]] = {}
    for row in rows:
        match = re.match(r"(MuJoCo: )?(\d+) boxes", row["name"])
        if match and row["unit"] == "µs":
            what = "at rest" if "rest" in row["group"] else "dropped"
            engine = "MuJoCo" if match[1] else "dano"
            found.setdefault(f"{engine}, {what}", []).append((int(match[2]), row["value"]))
    return found


def main() -> None:
    from matplotlib.figure import Figure

    given = [Path(x) for x in sys.argv[1:]]
    rows = json.loads((given[0] if given else FIGURES).read_text())["rows"]
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.subplots()
    for name, points in lines_of(rows).items():
        style = "o-" if name.startswith("dano") else "s--"
        colour = "C0" if "dropped" in name else "C1"
        axes.loglog(*zip(*sorted(points), strict=True), style, color=colour, label=name, markersize=5)
    axes.set_xlabel("boxes")
    axes.set_ylabel("time of a step and box [µs]")
    axes.grid(True, which="both", alpha=0.25)
    axes.set_ylim(0.5, 200)
    axes.legend(loc="center right", bbox_to_anchor=(1.0, 0.63), frameon=False)
    figure.savefig(given[1] if len(given) > 1 else PICTURE, dpi=110)


if __name__ == "__main__":
    main()
