"""What derivatives are worth: draws functions, their tangents and their trends, for docs/gradients.md.

`python -m benchmarks.worth [FILE.png]`: the way of the shipped bunny over friction, as it slides and as it is
thrown, with the default law and with the centroid law; prints what `dano.gradients.check` says of each.
"""

import sys
from pathlib import Path
from typing import NamedTuple

from benchmarks import _environment

FILE = Path(__file__).parents[1] / "docs" / "images" / "gradients_worth.png"
FRICTION, TIMESTEP, N_STEPS = 0.3, 0.005, 160
SHARE, PLACES = 0.0333, 81  # of friction, to each side


class Panel(NamedTuple):
    """A title, and whether the bunny is thrown and by which law."""

    title: str
    thrown: bool
    centroid: bool


PANELS = (
    Panel("slides, default law", False, False),
    Panel("is thrown, default law", True, False),
    Panel("is thrown, centroid law", True, True),
)


def main() -> None:
    """Measure, print and draw."""
    from matplotlib.figure import Figure

    from dano.gradients import check

    figure = Figure(figsize=(11, 3.4), layout="constrained")
    for axis, panel in zip(figure.subplots(1, len(PANELS)), PANELS, strict=True):
        found = check(way(panel), FRICTION, steps=(SHARE, SHARE / 10), points=PLACES, labels=["friction"])
        print(f"{panel.title}: {found}\n", flush=True)
        (line,) = found.lines
        at, values = FRICTION * (1 + line.at), 1e3 * line.values
        middle = 1e3 * found.value
        axis.plot(at, values, ".-", markersize=3, linewidth=0.8, label="way of the bunny")
        for slope, style, name in (
            (line.derivative, "C3-", f"jax.grad: {line.derivative:.2g} m"),
            (line.slopes[0], "k--", f"slope over ± {SHARE * FRICTION:.2g}: {line.slopes[0]:.2g} m"),
        ):
            axis.plot(at, middle + 1e3 * slope * (at - FRICTION), style, linewidth=1.2, label=name)
        room = 0.3 * (values.max() - values.min())
        axis.set_ylim(values.min() - room, values.max() + room)
        axis.set_title(f"{panel.title}: {line.verdict.name.lower()}", fontsize=10)
        axis.set_xlabel("friction")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
        axis.set_ylabel("way along x [mm]")
    figure.savefig(sys.argv[1] if len(sys.argv) > 1 else FILE, dpi=100)


def way(panel: Panel):
    """Where the bunny is at the end, as a function of friction."""
    import dano
    from dano.scene_file import load_asset

    bodies = [dano.Body("bunny", load_asset("bunny")), dano.Body("floor", dano.HalfSpace(), fixed=True)]
    law = dano.CentroidLaw() if panel.centroid else dano.DistributedLaw()

    def scene(friction) -> dano.Scene:
        params = dano.ContactParams(sliding_friction=friction)
        return dano.Scene.create(bodies, [dano.Contact("bunny", "floor", params, law)], timestep=TIMESTEP)

    drop = {"position": (0, 0, 0.09), "orientation": (1, 1, 0, 0)}
    start = scene(0.8).initial_state(bunny=drop)
    last = dano.simulate(scene(0.8), start, 300).states
    pose = {"position": last.position[-1, 0], "orientation": last.orientation[-1, 0]}
    if panel.thrown:
        pose = {"position": (0, 0, 0.12), "orientation": (1, 0.3, 0.2, 0), "omega": (3.0, 1.0, 2.0)}
    state = scene(FRICTION).initial_state(bunny={**pose, "velocity": (0.8 if panel.thrown else 0.4, 0, 0)})
    base = scene(FRICTION)

    def gone(friction):
        slid = base.replace_contact("bunny", "floor", sliding_friction=friction)
        return dano.simulate(slid, state, N_STEPS).states.position[-1, 0, 0]

    return gone


if __name__ == "__main__":
    _environment.use_float64_on_cpu()
    main()
