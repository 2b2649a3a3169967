"""`dano build` and `dano inspect`."""

import dataclasses
import math
import textwrap
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from dano.cli._arguments import Build, Inspect
from dano.cli._console import numbers, Progress, put, put_json, say
from dano.cli._outputs import check_output, missing_for_pictures
from dano.objects import Interior, NeuralObject
from dano.robots import read_robot, robot_doubts, robot_tree
from dano.scene_file import build_parts, load_object, materials_doubt, object_of_file, parts_of

# Names of files that hold robots end so.
_ROBOTS = (".urdf", ".xml", ".mjcf")


def build(command: Build) -> None:
    """See `dano build --help`."""
    output, options = command.output, command.options
    if options.mass is not None and options.mass_scale is not None:
        # Before a large field is read.
        raise ValueError(f"give either --mass or --mass-scale, got {options.mass} and {options.mass_scale}")
    sources = (command.field, *command.further)
    parts = parts_of(sources)
    for source in [Path(part.name) for part in parts] or sources:
        check_output(output, source)
    progress = Progress()
    progress("reading the field", 0.0)
    if parts:
        made = build_parts(parts, options, dashes="--", progress=progress)
    else:
        made = object_of_file(command.field, options, dashes="--", progress=progress)
        if made.mass_model != "given" and (doubt := materials_doubt(command.field)):
            warnings.warn(doubt, stacklevel=2)
    progress.close()
    made.save(output)
    report = describe(made, output)
    if command.json:
        put_json(report)
        return
    print_object(report)
    put()
    put(f"wrote {output}; `dano inspect {output}` draws it, `dano simulate {output} -o RUN.npz` drops it")


def inspect(command: Inspect) -> None:
    """See `dano inspect --help`."""
    path, png = command.object, command.png
    if path.suffix.lower() in _ROBOTS:
        if png is not None:
            raise ValueError(f"--png draws neural objects only, got the robot {path}")
        return _inspect_robot(path, as_json=command.json)
    picture = None if command.no_png else png or path.with_suffix(".png")
    if picture is not None:
        check_output(picture, path, suffix=".png")
        if missing := missing_for_pictures(video=False):
            if png is not None:
                raise ImportError(missing)
            say(f"warning: not drawn, {missing}")
            picture = None
    progress = Progress()
    made = load_object(path, progress=progress)
    progress.close()
    report = describe(made, path)
    if picture is not None:
        from dano.report import draw_object

        draw_object(made, picture, title=path.stem)
        report["picture"] = str(picture)
    if command.json:
        put_json(report)
        return
    print_object(report)
    if picture is not None:
        put()
        put(f"drawn in {picture}")


def describe(made: NeuralObject, path: Path) -> dict[str, Any]:
    """An object in numbers and lists, in SI units."""
    mass = made.mass
    moments, axes = np.linalg.eigh(np.asarray(mass.inertia))
    points = np.asarray(made.samples.points)
    return {
        "file": str(path),
        "mass": float(mass.mass),
        "mass_error": float(mass.mass_error),
        "com": np.asarray(mass.com).tolist(),
        "com_error": np.asarray(mass.com_error).tolist(),
        "inertia": np.asarray(mass.inertia).tolist(),
        "inertia_error": np.asarray(mass.inertia_error).tolist(),
        "principal_inertias": moments.tolist(),
        "principal_axes": axes.T.tolist(),
        "size": made.size,
        "extents": np.ptp(points, axis=0).tolist(),
        "samples": len(points),
        "density_range": np.asarray(made.density_range).tolist(),
        "surface_samples": len(made.surface.areas),
        "surface_area": float(np.sum(np.asarray(made.surface.areas))),
        "mass_model": made.mass_model,
        "mass_reason": made.mass_reason,
        "interior": None if made.interior is None else _interior(made.interior),
        "grid": None if made.grid is None else list(made.grid.shape),
        "bake_error": float(made.bake_error),
    }


def _interior(interior: Interior) -> dict[str, float]:
    return {field.name: float(getattr(interior, field.name)) for field in dataclasses.fields(interior)}


def print_object(report: dict[str, Any]) -> None:
    """Print what `describe` found."""
    grid = report["grid"]
    put(f"object              {report['file']}")
    error = f" ± {report['mass_error']:.1g}" if report["mass_error"] > 1e-9 * report["mass"] else ""
    put(f"mass                {report['mass']:.6g}{error} kg")
    for i, line in enumerate(textwrap.wrap(f"{report['mass_model']}: {report['mass_reason']}", 90)):
        put(f"{'mass model' if i == 0 else '':<19} {line}")
    if report["interior"] is not None:
        _print_interior(report["interior"])
    put(f"centre of mass      {numbers(report['com'])} ± {max(report['com_error']):.1g} m")
    for i, row in enumerate(report["inertia"]):
        label = "inertia about it" if i == 0 else ""
        error = f" ± {max(map(max, report['inertia_error'])):.1g} kg m²" if i == 0 else ""
        put(f"{label:<19} {numbers(row)}{error}")
    put(f"principal inertias  {numbers(report['principal_inertias'])} kg m²")
    for i, axis in enumerate(report["principal_axes"]):
        put(f"{'about the axes' if i == 0 else '':<19} {numbers(axis)}")
    put(f"extents             {numbers(report['extents'])} m")
    low, high = report["density_range"]
    put(f"contact samples     {report['samples']}, density {low:.4g} to {high:.4g}")
    put(f"surface samples     {report['surface_samples']}, area {report['surface_area']:.4g} m²")
    if grid is None:
        put("density grid        none: meets shapes only")
    else:
        size = " × ".join(map(str, grid))
        put(f"density grid        {size} nodes, baking error {100 * report['bake_error']:.2g} %")


def _print_interior(interior: dict[str, float]) -> None:
    deep = interior["deep"]
    inside = "too thin to tell" if math.isnan(deep) else f"{100 * deep:.0f} % of the density near the surface"
    put(f"deep inside         {inside}, uneven by {100 * interior['spread']:.0f} %")
    put(
        f"surface level       {interior['level']:.4g} of at most {interior['largest']:.4g};"
        f" half of it: volume +{100 * interior['growth']:.0f} %"
    )


def _inspect_robot(path: Path, *, as_json: bool) -> None:
    """Print the tree of a robot's file, and what is odd about it.

    Raises:
        ValueError: If the file is missing or broken.
    """
    robot = read_robot(path)
    doubts, mass = robot_doubts(robot), sum(link.mass for link in robot.links)
    moving = [joint for joint in robot.joints if joint.kind != "weld"]
    if as_json:
        put_json(
            {
                "file": str(path),
                "name": robot.name,
                "mass": mass,
                "links": [link.name for link in robot.links],
                "joints": {joint.name: joint.kind for joint in robot.joints},
                "odd": doubts,
            }
        )
        return
    put(f"robot   {robot.name}, {len(robot.links)} links, {len(moving)} joints that move, {mass:.6g} kg")
    put()
    for line in robot_tree(robot):
        put(line)
    put()
    put("nothing odd" if not doubts else "odd:")
    for doubt in doubts:
        put(f"  {doubt}")
