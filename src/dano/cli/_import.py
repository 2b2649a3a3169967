"""`dano import`."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from dano.building import BuildOptions
from dano.cli._arguments import Import
from dano.cli._console import numbers, Progress, put, put_json
from dano.cli._outputs import check_output
from dano.exchange import check_folder, export_object
from dano.fields import (
    bake,
    GridField,
    is_splats,
    load_field,
    MESH_SUFFIXES,
    read_splats,
    save_field,
    SignedDistanceGrid,
    UNITS,
)
from dano.maths import Pose
from dano.objects import fill_hollows, node_values
from dano.scene_file import build_object

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
    progress = Progress()
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
            lower, upper = np.asarray(load_field(file, crop=box, **_of_format(command)).bounds)
        sampled = {"min_width": 0.5 * float(np.max(upper - lower)) / (nodes - 1)}
    unit = {"scale": command.scale, "units": command.units}
    field = load_field(file, crop=box, **unit, pose=pose, **sampled, **_of_format(command))
    kind, error = type(field).__name__, None
    if not isinstance(field, (GridField, SignedDistanceGrid)):
        interpolation = command.interpolation or "quadratic"
        field, error = bake(field, nodes, interpolation=interpolation, progress=progress)
    filled = 0.0
    if splats and not command.hollow and isinstance(field, GridField):
        cut = command.box is not None or command.sphere is not None
        field, before = fill_hollows(field, stood=cut)
        filled = float(before.cavity)
    progress.close()
    if command.to:
        assert isinstance(field, GridField)
        _write_folder(command, field, pose)
        return
    save_field(field, output)
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
    check_folder(command.output)


def _write_folder(command: Import, field: GridField, pose: Pose | None) -> None:
    """An object of splats for other simulators, with the splats themselves."""
    options = BuildOptions(
        mass_model="solid", mass=command.mass, mass_scale=_WATER if command.mass is None else None
    )
    progress = Progress()
    made = build_object(field, options, weighed=True, dashes="--", progress=progress)
    splats = read_splats(command.file, skip_nan=command.skip_nan)
    inside = splats.inside(command.box, command.sphere)
    unit = (command.scale or 1.0) if command.units is None else UNITS[command.units]
    moved = splats.moved(pose, unit)
    written = export_object(
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
        return "splats" if is_splats(Path(file)) else "mesh"
    return "mesh" if suffix in MESH_SUFFIXES else ""


def _described(field: GridField | SignedDistanceGrid, output: Path, file: str, kind: str) -> dict[str, Any]:
    values = np.asarray(field.distances) if isinstance(field, SignedDistanceGrid) else node_values(field)
    return {
        "file": str(output),
        "source": file,
        "kind": kind,
        "quantity": "density" if isinstance(field, GridField) else "signed distance",
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
