"""What `dano check` prints."""

import textwrap
import warnings

from dano import scene_file
from dano.cli._console import ProgressLine, put, put_json
from dano.cli._scenes import load
from dano.cli.checking._arguments import CheckScene

_INDENT = " " * 12
_UNITS = {
    "stiffness": " Pa/m",
    "restitution_velocity": " m/s",
    "friction_pressure": " Pa",
    "edge": " m",
    "spring": " N/kg",
    "damper": " N s/(m kg)",
}


def check(command: CheckScene) -> None:
    """See `dano check --help`."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        loaded = load(command.scene, command.steps, command.timestep)
    doubts = tuple(dict.fromkeys(str(warning.message) for warning in heard))
    progress = ProgressLine()
    found = scene_file.check_scene(loaded, seconds=command.seconds, doubts=doubts, progress=progress)
    progress.close()
    if command.json:
        put_json({"scene": str(command.scene), **_numbers(found)})
    else:
        _print(found)


def _numbers(found: scene_file.SceneCheck) -> dict:
    mean, slowest = found.total_seconds
    return {
        "timestep": found.timestep,
        "steps": found.n_steps,
        "contacts": [line._asdict() for line in found.contacts],
        "bodies": [line._asdict() for line in found.bodies],
        "findings": [finding._asdict() for finding in found.findings],
        "runs_on": found.runs_on,
        "cost": {**found.cost._asdict(), "total_seconds": mean, "total_seconds_slowest": slowest},
    }


def _print(found: scene_file.SceneCheck) -> None:
    duration = found.timestep * found.n_steps
    put(f"step        {found.timestep:.4g} s, {found.n_steps} of them: {duration:.4g} s simulated")
    for line in found.contacts:
        pairs = ", ".join(f"{a} – {b}" for a, b in line.pairs[:6])
        more = f" and {len(line.pairs) - 6} more" if len(line.pairs) > 6 else ""
        put(f"contact     {line.law}: {pairs}{more}")
        values = (f"{name} {value:.4g}{_UNITS.get(name, '')}" for name, value in line.parameters.items())
        put(textwrap.fill(", ".join(values), 100, initial_indent=_INDENT, subsequent_indent=_INDENT))
    if not found.contacts:
        put("contact     none: bodies pass through each other")
    put()
    put("body              mass [kg]   samples   touch a floor   speed up to [m/s]   spin [rad/s]")
    for line in found.bodies:
        mass = "fixed" if line.mass is None else f"{line.mass:.4g}"
        touching = "–" if line.touching is None else str(line.touching)
        put(
            f"{line.name:<16.16} {mass:>10} {line.samples:9d} {touching:>15} {line.speed:19.3g}"
            f" {line.spin:14.3g}"
        )
    put()
    if found.findings:
        put("not resolved, or odd")
        for finding in found.findings:
            put(f"  {finding.subject:<9} {finding.text}")
    else:
        put("nothing found that the steps would not resolve: impacts, spins, walls, masses, samples")
    put()
    put(textwrap.fill(found.runs_on, 100, initial_indent="runs on     ", subsequent_indent=_INDENT))
    cost, (mean, slowest) = found.cost, found.total_seconds
    if cost.room is not None:
        put(f"points      room for {cost.room} point contacts in a step; room for more is made when needed")
    put(f"compile     {cost.compile_seconds:.1f} s; less when this scene was compiled before")
    measured = f"the first {cost.steps} of" if cost.steps < found.n_steps else "all"
    put(
        f"a step      {1e6 * cost.step_seconds:.0f} µs, {1e6 * cost.slowest_seconds:.0f} µs in the slowest"
        f" twenty: measured on {measured} {found.n_steps}"
    )
    put(f"the run     {mean:.2g} s to {slowest:.2g} s predicted, without compiling and pictures")
