"""`python -m benchmarks.paper._gradient_study [--figure FILE] [--quick]`: where derivatives can be trusted.

Prints derivatives of motion with distributed contact beside differences at a visible and at a tiny step, and
draws `docs/images/gradients_distributed.png`.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import dano
from benchmarks import _subjects
from benchmarks._measure import NO_DATA
from benchmarks.paper import _gradients

SLOPE = 20.0  # [°]
HALF = 0.05  # of the box [m]
TIMESTEP = 0.01
HORIZONS = (50, 100, 200)  # steps
LARGE, TINY = 1e-2, 1e-6  # steps of the differences, as shares of `_Panel.unit`


class _Panel(NamedTuple):
    """A family of motions of a box on a floor, one for each value of a parameter.

    Attributes:
        title: For the figure.
        label: Of the parameter, with its unit.
        values: What it takes.
        unit: A change of it that one would call large.
        horizons: Numbers of steps after which the distance is read.
        place: From a value to (friction, slope [rad], start position, velocity, spin about y).
    """

    title: str
    label: str
    values: list[float]
    unit: float
    horizons: tuple[int, ...]
    place: Callable


class _Curve(NamedTuple):
    """Distance travelled, its derivative, and its differences, for each value of a panel; one horizon."""

    steps: int
    distance: np.ndarray
    derivative: np.ndarray
    large: np.ndarray
    tiny: np.ndarray


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--figure", type=Path, metavar="FILE", help="also draw the figure into this file")
    parser.add_argument("--quick", action="store_true", help="few values: to see that it runs")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    panels = _panels(9 if arguments.quick else 81)
    curves = [_curves(panel) for panel in panels]
    for panel, found in zip(panels, curves, strict=True):
        _print(panel, found)
    if arguments.figure is not None:
        _draw(panels, curves, arguments.figure)
    _sign_rows(quick=arguments.quick)


def _panels(n: int) -> list[_Panel]:
    tangent = float(np.tan(np.radians(SLOPE)))
    lying = jnp.array([0.0, 0.0, HALF])
    still = jnp.zeros(3)

    def released(friction):
        return friction, jnp.radians(SLOPE), lying, still, 0.0

    def dropped(height):
        start = jnp.array([0.0, 0.0, HALF]) + height * jnp.array([0.0, 0.0, 1.0])
        return 0.4, 0.0, start, jnp.array([1.0, 0.0, 0.0]), 0.0

    def thrown(speed):
        forward = speed * jnp.array([1.0, 0.0, 0.0])
        return 0.4, 0.0, jnp.array([0.0, 0.0, 3 * HALF]), forward, 8.0

    return [
        _Panel(
            f"released on a slope of {SLOPE:g}°: slides or sticks",
            "friction μ (dotted: tan θ)",
            [tangent * x for x in np.linspace(0.5, 1.5, n)],
            1.0,
            HORIZONS[:1],
            released,
        ),
        _Panel(
            "thrown at 1 m/s, lands flat and slides to rest",
            "drop height [m]",
            list(np.linspace(0.01, 0.11, n)),
            0.1,
            HORIZONS[1:2],
            dropped,
        ),
        _Panel(
            "thrown with 8 rad/s: tumbles",
            "speed [m/s]",
            list(np.linspace(0.6, 1.4, n)),
            1.0,
            HORIZONS,
            thrown,
        ),
    ]


def _scene() -> dano.Scene:
    box = dano.Body("box", dano.Box((HALF,) * 3, rounding=0.2 * HALF), mass=1.0)
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    contact = dano.Contact("box", "floor", dano.ContactParams(restitution=0.3), dano.DistributedLaw())
    return dano.Scene.create([box, floor], [contact], timestep=TIMESTEP)


def _curves(panel: _Panel) -> list[_Curve]:
    scene = _scene()

    def distances(value):
        """Way along x after each of the horizons [m], and whether all steps converged."""
        friction, slope, position, velocity, spin = panel.place(value)
        changed = scene.replace_contact("box", "floor", sliding_friction=friction)
        gravity = 9.81 * jnp.stack([jnp.sin(slope), jnp.zeros_like(slope), -jnp.cos(slope)])
        changed = eqx.tree_at(lambda s: s.gravity, changed, gravity)
        rest = scene.initial_state(box={"position": (0, 0, HALF), "omega": (0, 0, 0)})
        start = dano.State(
            rest.position.at[0].set(position),
            rest.orientation,
            rest.velocity.at[0].set(velocity),
            rest.omega.at[0, 1].set(spin),
        )
        run = dano.simulate(changed, start, max(panel.horizons))
        return run.states.position[jnp.array(panel.horizons), 0, 0], run.converged.all()

    @jax.jit
    def along(values):
        def one(value):
            (ways, converged), (slopes, _) = jax.jvp(distances, (value,), (jnp.ones_like(value),))
            return ways, slopes, converged

        return jax.lax.map(one, values)

    values = jnp.asarray(panel.values)
    steps = [share * panel.unit for share in (LARGE, TINY)]
    shifted = [values, *(values + sign * step for step in steps for sign in (1, -1))]
    ways, slopes, converged = (np.asarray(x) for x in along(jnp.concatenate(shifted)))
    if not converged.all():
        print(f"{panel.title}: {np.sum(~converged)} of {len(converged)} runs had steps that did not converge")
    here, *ends = ways.reshape(5, len(values), -1)
    large, tiny = ((ends[2 * i] - ends[2 * i + 1]) / (2 * step) for i, step in enumerate(steps))
    derivative = slopes.reshape(5, len(values), -1)[0]
    return [
        _Curve(n, here[:, k], derivative[:, k], large[:, k], tiny[:, k]) for k, n in enumerate(panel.horizons)
    ]


def _print(panel: _Panel, curves: list[_Curve]) -> None:
    print(f"\n{panel.title}; derivative by {panel.label}")
    for curve in curves:
        size = np.abs(curve.derivative)
        same = np.mean(np.sign(curve.derivative) == np.sign(curve.large))
        errors = [
            np.median(np.abs(curve.derivative - difference) / (np.abs(difference) + 1e-6))
            for difference in (curve.large, curve.tiny)
        ]
        print(
            f"  after {curve.steps * TIMESTEP:g} s: size {np.median(size):.3g} (median), {size.max():.3g} "
            f"(largest); sign as at the large step {same:.0%}; median relative error to the large step "
            f"{errors[0]:.2g}, to the tiny one {errors[1]:.2g}"
        )


def _draw(panels: list[_Panel], curves: list[list[_Curve]], file: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 6.4), layout="constrained")
    axes = figure.subplots(2, len(panels), sharex="col")
    for (top, bottom), panel, found in zip(axes.T, panels, curves, strict=True):
        for k, curve in enumerate(found):
            color, first = f"C{k}", k == 0
            names = [
                "derivative",
                f"difference, step {LARGE * panel.unit:g}",
                f"difference, step {TINY * panel.unit:g}",
            ]
            names = names if first else [None] * 3
            style = {"color": color, "markersize": 4, "linewidth": 1.0}
            top.plot(panel.values, curve.distance, ".-", label=f"after {curve.steps * TIMESTEP:g} s", **style)
            bottom.plot(panel.values, curve.derivative, "-", label=names[0], **style)
            bottom.plot(panel.values, curve.large, "o", fillstyle="none", label=names[1], **style)
            bottom.plot(panel.values, curve.tiny, "k+", markersize=4, label=names[2])
        top.set_title(panel.title, fontsize=10)
        bottom.set_xlabel(panel.label)
        if len(found) > 1:
            bottom.set_yscale("symlog", linthresh=1)
        for axis in (top, bottom):
            axis.legend(fontsize=8)
            axis.grid(alpha=0.3)
    for axis in axes[:, 0]:
        axis.axvline(float(np.tan(np.radians(SLOPE))), color="gray", linewidth=0.8, linestyle=":")
    axes[0, 0].set_ylabel("distance [m]")
    axes[1, 0].set_ylabel("its derivative")
    figure.savefig(file, dpi=110)


def _sign_rows(*, quick: bool) -> None:
    laws = {
        "distributed": dano.DistributedLaw(),
        "sticking centroid": dano.CentroidLaw(stiction_velocity=1e-7),
    }
    for subject in (_subjects.shipped_bunny(), _subjects.authors_bunny()):
        if subject is None:
            print(NO_DATA)
            continue
        for name, law in laws.items():
            for row in _gradients.gradient_rows(subject, quick=quick, law=law, name=name):
                print(f"{row.group}: {row.name}: {row.value:.3g} {row.unit} {row.note}", flush=True)


if __name__ == "__main__":
    main()
