"""The short table of the README: which stored figures it shows, and what stands beside them.

Every number comes from a file of `results/`; words and figures of other people stand here with their source.
"""

from typing import NamedTuple


class Cell(NamedTuple):
    """Stored figures in words.

    Attributes:
        words: Text with a place for each figure, as `str.format` has them.
        file: Of the results, without its suffix.
        rows: Group and name of each figure.
    """

    words: str
    file: str = ""
    rows: tuple[tuple[str, str], ...] = ()


class Headline(NamedTuple):
    """A row: what was measured, the figure, and what to compare it with."""

    what: str
    figure: Cell
    beside: Cell = Cell("")


_BOXES = "10 boxes, 60 s: way of the box that moved most"
_SLOPE = "Creep on a slope of 0.9 times the friction angle"
_SOAP = "Soap in real units"
_STORED = "Stored rollouts of the authors"
_MASS = "Mass properties of a density field, default settings"
_ONE = "One body on a floor, per step"

HEADLINES = (
    Headline(
        "real tosses of a cube: mean error of position and rotation",
        Cell(
            "{:.1f} % of its width, {:.1f}°",
            "tosses-cpu",
            (("dano", "fine step, position"), ("dano", "fine step, rotation")),
        ),
        Cell(
            "MuJoCo, tuned: {:.1f} %, {:.1f}°",
            "tosses-cpu",
            (("MuJoCo", "fine step, position"), ("MuJoCo", "fine step, rotation")),
        ),
    ),
    Headline(
        "friction of a filmed bar of soap",
        Cell("{:.3f} ± {:.3f}", "soap-cpu", ((_SOAP, "friction"), (_SOAP, "its standard error"))),
        Cell("the paper: 0.61"),
    ),
    Headline(
        "box on a slope of 0.9 times the friction angle, steps of 10 ms: creep",
        Cell("{:.0e} m/s", "contact-cpu", ((_SLOPE, "box, 10 ms"),)),
        Cell("MuJoCo: {:.0e} m/s", "contact-cpu", ((_SLOPE, "MuJoCo: box, 10 ms"),)),
    ),
    Headline(
        "stack of ten boxes, 60 s: way of the box that moved most",
        Cell("{:.0e} mm", "contact-cpu", (("Stacks", _BOXES),)),
        Cell("MuJoCo: {:.0f} mm", "contact-cpu", (("Stacks", f"MuJoCo: {_BOXES}"),)),
    ),
    Headline(
        "the authors' stored rollouts: 100 steps in contact, paper's law",
        Cell("within {:.0e} m", "paper-cpu", ((_STORED, "free-running, after 100 steps of contact"),)),
    ),
    Headline(
        "mass, centre of mass, inertia of a solid: largest error, 40 seeds",
        Cell("{:.2f} %", "paper-cpu", ((_MASS, "capsule: largest error, 40 seeds"),)),
        Cell("closed form"),
    ),
    Headline(
        "learning a bunny from 80 renders: held-out views, inertia, time",
        Cell(
            "{:.1f} dB, {:.1f} % off, {:.0f} s",
            "learn-cpu",
            (
                ("bunny", "PSNR, held out"),
                ("bunny", "principal inertias, off"),
                ("bunny", "training, compiling included"),
            ),
        ),
        Cell(
            "visual hull: inertia {:.1f} % off",
            "learn-cpu",
            (("bunny", "principal inertias of the hull, off"),),
        ),
    ),
    Headline(
        "a step of a bunny on a floor, paper's law: slides, rests",
        Cell("{:.0f} µs, {:.0f} µs", "speed-cpu", ((_ONE, "bunny slides"), (_ONE, "bunny rests"))),
        Cell(
            "MuJoCo, its convex hull: {:.1f} µs",
            "speed-cpu",
            ((_ONE, "MuJoCo: bunny's hull slides, h = 2 ms"),),
        ),
    ),
    Headline(
        "a step of eight boxes that fall, default law",
        Cell("{:.0f} µs", "speed-cpu", (("8 boxes dropped, 100 steps of 5 ms, per step", "8 boxes"),)),
        Cell(
            "MuJoCo: {:.0f} µs",
            "speed-cpu",
            (("8 boxes dropped, 100 steps of 5 ms, per step", "MuJoCo: 8 boxes"),),
        ),
    ),
    Headline(
        "gradient of a rollout of 200 steps by 38 parameters, paper's law",
        Cell(
            "{:.1f} × the rollout",
            "speed-cpu",
            (
                (
                    "Derivatives of a rollout of 200 steps, per step",
                    "bunny: reverse, 38 parameters / rollout",
                ),
            ),
        ),
    ),
)
