"""`dano build` and `dano inspect`.

`dano export`.
`dano import`.
"""

import dataclasses
import math
import re
import textwrap
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from dano import exchange, fields, objects, robots, scene_file
from dano.building import BuildOptions
from dano.cli._arguments import BuildObject, Export, Import, Inspect
from dano.cli._console import numbers, ProgressLine, put, put_json
from dano.cli._outputs import check_output, picture_of
from dano.contact import ContactParams
from dano.maths import Pose


def export(arguments: Export) -> None:
    """See `dano export --help`."""
    exchange.check_folder(arguments.output)
    given = {"sliding_friction": arguments.friction, "restitution": arguments.restitution}
    parameters = ContactParams(**{key: value for key, value in given.items() if value is not None})
    made = scene_file.load_object(arguments.object)
    name = arguments.name
    if name is None:
        word = re.sub(r"\W", "_", arguments.object.stem, flags=re.ASCII)
        name = word if re.match(r"[A-Za-z]", word) else f"object_{word}"
    progress = ProgressLine()
    written = exchange.export_object(
        made,
        arguments.output,
        name=name,
        look=scene_file.object_look(arguments.object),
        contact=parameters,
        progress=progress,
        to=arguments.to,
        **vars(arguments.options),
    )
    progress.close()
    if arguments.json:
        put_json({**written._asdict(), "folder": str(written.folder)})
        return
    put(f"wrote {_what(written)}")
    put(f"  {', '.join(file for file in written.files if '/' not in file)}")
    for note in written.notes:
        put(f"- {note}")


def _what(written: exchange.Exported) -> str:
    pieces = (
        "its convex hull" if written.collision == "hull" else f"{written.pieces} convex piece(s) by CoACD"
    )
    colours = "with its learned colours" if written.textured else "in one colour: none were learned"
    return f"{written.folder}: {written.triangles} triangles {colours}, and {pieces} for contact"


_WATER = 1000.0
"""Density [kg/m³] of what nobody weighed."""
_USUAL = (1e-3, 20.0)
"""Widths [m] of a field beyond which its file is rather in other units than so small or large."""


def import_field(command: Import) -> None:
    """See `dano import --help`."""
    file, output, resolution = command.file, command.output, command.resolution
    splats = _kind(file) == "splats"
    _check_folder_options(command, splats)
    if not command.to:
        check_output(output, Path(file), suffix=".npz")
    if resolution is not None and not 4 <= resolution <= 1024:
        raise ValueError(f"resolution must lie between 4 and 1024 nodes, got {resolution}")
    moved = np.any(command.position) or command.orientation != (1.0, 0.0, 0.0, 0.0)
    pose = Pose(command.position, command.orientation) if moved else None
    progress = ProgressLine()
    progress("reading the field", 0.0)
    box = None if command.crop is None else np.reshape(command.crop, (2, 3))
    sampled = {}
    nodes = 128 if resolution is None else resolution
    if _kind(file) == "mesh":
        sampled = {} if resolution is None else {"resolution": resolution}
    elif splats:
        # Gaussians thinner than the distance between nodes would fall between them: a shell full of pores.
        with warnings.catch_warnings():
            # Said when it is read below.
            warnings.simplefilter("ignore", UserWarning)
            lower, upper = np.asarray(fields.load_field(file, crop=box, **_of_format(command)).bounds)
        sampled = {"min_width": 0.5 * float(np.max(upper - lower)) / (nodes - 1)}
    unit = {"scale": command.scale, "units": command.units}
    field = fields.load_field(file, crop=box, **unit, pose=pose, **sampled, **_of_format(command))
    kind, error = type(field).__name__, None
    if not isinstance(field, (fields.GridField, fields.SignedDistanceGrid)):
        interpolation = command.interpolation or "quadratic"
        field, error = fields.bake(field, nodes, interpolation=interpolation, progress=progress)
    filled = 0.0
    if splats and not command.hollow and isinstance(field, fields.GridField):
        cut = command.box is not None or command.sphere is not None
        field, before = objects.fill_hollows(field, stood=cut)
        filled = float(before.cavity)
    progress.close()
    if command.to:
        assert isinstance(field, fields.GridField)
        _write_folder(command, field, pose)
        return
    fields.save_field(field, output)
    report = _described(field, output, file, kind) | {"filled": filled}
    report["bake_error"] = None if error is None else error.rms
    longest = float(np.max(np.ptp(np.asarray(field.bounds), axis=0)))
    stated = command.units is not None or command.scale not in (None, 1.0)
    if not stated and not _USUAL[0] <= longest <= _USUAL[1]:
        warnings.warn(
            f"the field is {longest:.3g} m wide; if the file is not in metres, give --units (mm, in, …) or"
            " --scale, the length of its unit [m]",
            stacklevel=2,
        )
    put_json(report) if command.json else _print(report)


def _check_folder_options(command: Import, splats: bool) -> None:
    """Raises: ValueError: If options of splats, or of the folder, are given for something else."""
    if not command.to:
        if command.mass is not None:
            raise ValueError(f"--mass goes with --to; `dano build` weighs a grid, got {command.mass}")
        return
    if not splats:
        raise ValueError(
            f"--to writes Gaussian splats (.ply) as a folder; for {command.file} take `dano import`,"
            " `dano build` and `dano export`"
        )
    exchange.check_folder(command.output)


def _write_folder(command: Import, field: fields.GridField, pose: Pose | None) -> None:
    """An object of splats for other simulators, with the splats themselves."""
    options = BuildOptions(
        mass_model="solid", mass=command.mass, mass_scale=_WATER if command.mass is None else None
    )
    progress = ProgressLine()
    made = scene_file.build_object(field, options, weighed=True, dashes="--", progress=progress)
    splats = fields.read_splats(command.file, skip_nan=command.skip_nan)
    inside = splats.inside(command.box, command.sphere)
    unit = (command.scale or 1.0) if command.units is None else fields.UNITS[command.units]
    moved = splats.moved(pose, unit)
    written = exchange.export_object(
        made,
        command.output,
        to=command.to,
        look=moved.chosen(inside),
        surroundings=None if inside.all() else moved.chosen(~inside),
        progress=progress,
    )
    progress.close()
    if command.json:
        put_json({**written._asdict(), "folder": str(written.folder), "mass": float(made.mass.mass)})
        return
    put(f"wrote {written.folder}: {inside.sum()} of {len(splats)} Gaussians")
    put(f"  {', '.join(file for file in written.files if '/' not in file)}")
    water = ", as dense as water (--mass says better)" if command.mass is None else ""
    put(f"mass        {float(made.mass.mass):.4g} kg{water}")
    for note in written.notes:
        put(f"- {note}")


def _of_format(command: Import) -> dict[str, Any]:
    """Options of single formats that were given; `load_field` says which ones the file's format has."""
    options = {
        "interpolation": command.interpolation,
        "spacing": command.spacing,
        "origin": command.origin,
        "signed_distance": command.signed_distance or None,
        "grid": command.grid,
        "cascade": command.cascade,
        "up": command.up,
        "module": command.module,
        "skip_nan": command.skip_nan or None,
        "box": command.box,
        "sphere": command.sphere,
        "undo_transform": False if command.keep_transform else None,
    }
    return {name: value for name, value in options.items() if value is not None}


def _kind(file: str) -> str:
    """What is treated specially: "mesh", "splats", or "" for everything else."""
    suffix = Path(file).suffix.lower()
    if suffix == ".ply" and Path(file).is_file():
        return "splats" if fields.is_splats(Path(file)) else "mesh"
    return "mesh" if suffix in fields.MESH_SUFFIXES else ""


def _described(
    field: fields.GridField | fields.SignedDistanceGrid, output: Path, file: str, kind: str
) -> dict[str, Any]:
    values = (
        np.asarray(field.distances)
        if isinstance(field, fields.SignedDistanceGrid)
        else objects.node_values(field)
    )
    return {
        "file": str(output),
        "source": file,
        "kind": kind,
        "quantity": "density" if isinstance(field, fields.GridField) else "signed distance",
        "nodes": list(values.shape),
        "spacing": np.asarray(field.spacing).tolist(),
        "bounds": np.asarray(field.bounds).tolist(),
        "range": [float(values.min()), float(values.max())],
    }


def _print(report: dict[str, Any]) -> None:
    put(f"field       {report['file']}, from {report['source']}")
    low, high = report["range"]
    put(f"{report['quantity']:<11} {low:.4g} to {high:.4g}")
    put(f"nodes       {' × '.join(map(str, report['nodes']))}, {report['spacing'][0]:.4g} m apart")
    put(f"bounds      {numbers(report['bounds'][0])} to {numbers(report['bounds'][1])} m")
    if report["bake_error"] is not None:
        put(f"sampling    {100 * report['bake_error']:.2g} % of the largest density (rms)")
    if report["filled"]:
        put(f"filled      {100 * report['filled']:.0f} % of the solid was hollow")
    put()
    put(f"`dano build {report['file']} -o OBJ.dano` makes an object of it")


# Names of files that hold robots end so.
_ROBOTS = (".urdf", ".xml", ".mjcf")


def build(command: BuildObject) -> None:
    """See `dano build --help`."""
    output, options = command.output, command.options
    if options.mass is not None and options.mass_scale is not None:
        # Before a large field is read.
        raise ValueError(f"give either --mass or --mass-scale, got {options.mass} and {options.mass_scale}")
    sources = (command.field, *command.further)
    parts = scene_file.parts_of(sources)
    for source in [Path(part.name) for part in parts] or sources:
        check_output(output, source)
    progress = ProgressLine()
    progress("reading the field", 0.0)
    if parts:
        made = scene_file.build_parts(parts, options, dashes="--", progress=progress)
    else:
        made = scene_file.object_of_file(command.field, options, dashes="--", progress=progress)
        if made.mass_model != "given" and (doubt := scene_file.materials_doubt(command.field)):
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
    picture = picture_of(command, path.with_suffix(".png"), path)
    progress = ProgressLine()
    made = scene_file.load_object(path, progress=progress)
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


def describe(made: objects.NeuralObject, path: Path) -> dict[str, Any]:
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


def _interior(interior: objects.Interior) -> dict[str, float]:
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
    robot = robots.read_robot(path)
    doubts, mass = robots.robot_doubts(robot), sum(link.mass for link in robot.links)
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
    for line in robots.robot_tree(robot):
        put(line)
    put()
    put("nothing odd" if not doubts else "odd:")
    for doubt in doubts:
        put(f"  {doubt}")
