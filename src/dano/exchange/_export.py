"""The verb: an object as a folder that other simulators load."""

import dataclasses
import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, get_args, Literal, NamedTuple, TYPE_CHECKING

import numpy as np

from dano import checks
from dano.contact import ContactParams
from dano.exchange import _mjcf, _urdf, _usd
from dano.exchange._triangles import (
    chosen_collision,
    Collision,
    Contents,
    convex_hull,
    decomposition,
    MESHES,
    painted,
    PLAIN,
    solid_triangles,
    SPLATS,
    SURROUNDINGS,
    Triangles,
    VISUAL,
)
from dano.exchange._wavefront import write_image, write_material, write_obj
from dano.fields import Splats
from dano.memory import check_nodes
from dano.objects import NeuralObject
from dano.progress import Progress

if TYPE_CHECKING:
    from dano.vision import LearnedField

Format = Literal["mjcf", "urdf", "usd", "obj"]

MANIFEST = "export.json"
"""The file that says what is in the folder, and that dano may replace it."""

_WRITERS: dict[str, Callable[[Path, Contents], list[str]]] = {
    "mjcf": _mjcf.write_mjcf,
    "urdf": _urdf.write_urdf,
    "usd": _usd.write_usd,
    "obj": lambda folder, contents: [],
}
_NOTES = {"mjcf": _mjcf.NOTES, "urdf": _urdf.NOTES, "usd": _usd.NOTES, "obj": ()}
_LOAD = {
    "mjcf": "MuJoCo: `python -m mujoco.viewer --mjcf=scene.xml`, or attach"
    ' `MjSpec.from_file("{name}.xml")` to a model of yours',
    "urdf": 'PyBullet: `loadURDF("{name}.urdf", flags=pybullet.URDF_USE_INERTIA_FROM_FILE)`',
    "usd": 'USD: `Usd.Stage.Open("{name}.usd")`, or a reference to it in a stage of yours; Newton:'
    ' `newton.ModelBuilder().add_usd("{name}.usd")`',
    "obj": "any program: `meshes/visual.obj`; what it weighs is in `export.json`",
}
_BYTES_PER_NODE = 400
"""What finding the surface takes at its peak, over the nodes of its lattice."""


@dataclasses.dataclass(frozen=True)
class ExportOptions:
    """How finely an object is written, and what touches.

    Attributes:
        collision: coacd: convex decomposition; hull: convex hull; auto: the first if coacd is installed.
        concavity: Of CoACD: how deep a piece may be concave, as a share of the size; in [0.01, 1].
        max_pieces: Most pieces of CoACD; default: as many as `concavity` takes.
        resolution: Nodes along the longest axis for the visible surface, from 8 to 512.
        texture_size: Texels along the picture with the colours, from 64 to 8192.
    """

    collision: Collision = "auto"
    concavity: float = 0.05
    max_pieces: int | None = None
    resolution: int = 64
    texture_size: int = 1024

    def __post_init__(self) -> None:
        """Check all numbers.

        Raises:
            ValueError: If one is out of range.
        """
        checks.checked_number("concavity", self.concavity, least=0.01, most=1)
        if self.max_pieces is not None:
            checks.checked_count("max_pieces", self.max_pieces)
        checks.checked_count("resolution", self.resolution, least=8, most=512)
        checks.checked_count("texture_size", self.texture_size, least=64, most=8192)


class Exported(NamedTuple):
    """What was written."""

    folder: Path  # Where
    files: list[str]  # Names in the folder, sorted
    collision: str  # How contact is represented, "coacd" or "hull"
    pieces: int  # Number of convex pieces
    triangles: int  # Number of visible triangles
    textured: bool  # Whether the colours were known
    notes: list[str]  # Sentences on what the formats cannot hold


def export_object(
    obj: NeuralObject,
    folder: str | os.PathLike[str],
    *,
    to: str | Sequence[str] = "mjcf",
    name: str | None = None,
    look: "LearnedField | Splats | None" = None,
    surroundings: Splats | None = None,
    contact: ContactParams | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> Exported:
    """Write an object as a folder of files that other simulators load.

    The frame of the files is the object's field frame. Mass, centre of mass and inertia are the object's own,
    not those of a mesh. What is seen is the surface of `obj.solid`; what touches are convex pieces of it. An
    object without a field, made of samples, becomes the convex hull of its surface samples.

    Args:
        obj: The object.
        folder: Where to; made new, whole or not at all. One that an export has written is replaced.
        to: Formats: "mjcf" (MuJoCo), "urdf" (ROS, PyBullet, Drake, …), "usd" (Isaac, Newton), "obj" (meshes
            only). Meshes are written whatever the format.
        name: Of the body and the files; default: the folder's.
        look: What photographs have taught, for colours; or Gaussian splats in the object's frame, which are
            written beside the meshes, with the object itself, `NAME.dano`.
        surroundings: Gaussians of what does not move with the object, in the same frame.
        contact: Parameters of its contacts; default `ContactParams()`. Friction goes into every format but
            OBJ, restitution into USD, stiffness into USD for Newton, the rest nowhere.
        progress: Called with a description and the share done.
        **options: Of `ExportOptions`.

    Returns:
        What was written.

    Raises:
        ValueError: If an option is out of range, the folder cannot be written, or holds files that no export
            wrote.
        ImportError: If libigl is missing, pillow for colours, coacd for "coacd", usd-core for "usd".
    """
    checks.checked_kind("obj", obj, NeuralObject)
    target = checks.checked_path("folder", folder)
    formats = _checked_formats(to)
    name = _checked_name(_default_name(target) if name is None else name)
    contact = checks.checked_optional("contact", contact, ContactParams) or ContactParams()
    splats, learned = _checked_look(look, surroundings)
    say = checks.checked_progress(progress)
    chosen = ExportOptions(**options)
    how = chosen_collision(chosen.collision, solid=obj.solid is not None)
    check_folder(target)
    say("surface", 0.0)
    mesh, normals, coarse = _surfaces(obj, chosen.resolution)
    say("convex pieces", 0.1)
    if how == "hull":
        pieces = [convex_hull(mesh.vertices)]
    else:
        pieces = decomposition(coarse, chosen.concavity, chosen.max_pieces)
    say("colours", 0.6)
    com, inertia = (np.asarray(each, np.float64) for each in (obj.mass.com, obj.mass.inertia))
    contents = Contents(
        *(name, float(obj.mass.mass), com, inertia),
        mesh=mesh,
        resolution=chosen.resolution,
        normals=normals,
        texture=None if learned is None else painted(learned, mesh, normals, chosen.texture_size),
        pieces=pieces,
        contact=contact,
        splats=splats,
        surroundings=surroundings,
    )
    say("files", 0.9)
    exported = _written(target, obj, contents, formats, how)
    say("done", 1.0)
    return exported


def _checked_look(look: Any, surroundings: Any) -> tuple[Splats | None, "LearnedField | None"]:
    """Splats, or what photographs have taught."""
    checks.checked_optional("surroundings", surroundings, Splats)
    if isinstance(look, Splats):
        return look, None
    if look is not None and not hasattr(look, "model"):
        raise ValueError(
            f"look must be a dano.vision.LearnedField or dano.fields.Splats, got {type(look).__name__}"
        )
    return None, look


def _surfaces(obj: NeuralObject, resolution: int) -> tuple[Triangles, np.ndarray, Triangles]:
    """What is seen, its normals at the vertices, and the same coarser, for what takes long."""
    if obj.solid is None:
        mesh = convex_hull(np.asarray(obj.surface.points, np.float64))
        middle = mesh.vertices.mean(axis=0)
        normals = mesh.vertices - middle
        return mesh, normals / np.linalg.norm(normals, axis=1, keepdims=True), mesh
    check_nodes(np.ptp(np.asarray(obj.solid.bounds), axis=0), resolution, _BYTES_PER_NODE)
    mesh, normals = solid_triangles(obj.solid, resolution)
    coarse = mesh if resolution <= 48 else solid_triangles(obj.solid, 48)[0]
    return mesh, normals, coarse


def _checked_formats(to: str | Sequence[str]) -> list[str]:
    formats = [to] if isinstance(to, str) else list(checks.checked_items("to", to, str))
    for form in formats:
        checks.checked_choice("to", form, get_args(Format))
    if not formats:
        raise ValueError(f"to must name at least one of {list(get_args(Format))}, got none")
    if "usd" in formats:
        _usd.check_usd()
    return list(dict.fromkeys(formats))


def _default_name(folder: Path) -> str:
    word = re.sub(r"\W", "_", folder.resolve().name, flags=re.ASCII)
    return word if re.match(r"[A-Za-z]", word) else f"object_{word}".rstrip("_")


def _checked_name(name: str) -> str:
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise ValueError(f"name must be a letter, then letters, digits and underscores, got {name!r}")
    if name in ("scene", SURROUNDINGS, MESHES):
        raise ValueError(f"name must not be {name!r}, which other files of the folder are called")
    return name


def check_folder(folder: Path) -> None:
    """Check that a folder can be written: new, empty, or of an export with nothing else in it.

    Raises:
        ValueError: If it is a file, its parent is missing, or it holds files that no export wrote.
    """
    if not folder.resolve().parent.is_dir():
        raise ValueError(
            f"output folder must be in an existing one, got {folder} in missing {folder.resolve().parent}"
        )
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"output must be a folder, got the file {folder}")
    if not folder.is_dir():
        return
    held = {str(path.relative_to(folder)) for path in folder.rglob("*") if not path.is_dir()}
    if not held:
        return
    foreign = sorted(held - _listed(folder))
    if foreign:
        more = f" and {len(foreign) - 1} more" if len(foreign) > 1 else ""
        raise ValueError(
            f"output folder must be new, empty, or hold nothing but an earlier export, got {folder} with"
            f" {foreign[0]}{more}"
        )


def _listed(folder: Path) -> set[str]:
    """Files that an export has written into a folder, as its manifest says."""
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        return {str(file) for file in manifest["files"]} if manifest["format"] == "dano-export" else set()
    except (OSError, ValueError, KeyError, TypeError):
        return set()


def _written(target: Path, obj: NeuralObject, contents: Contents, formats: list[str], how: str) -> Exported:
    """Write all files beside the folder, then put them in its place."""
    place = target.resolve()
    work = Path(tempfile.mkdtemp(dir=place.parent, prefix=f".{place.name}."))
    try:
        # mkdtemp makes private folders; what the user gets follows the process's mask.
        fresh = work / place.name
        fresh.mkdir()
        _write_meshes(fresh / MESHES, contents)
        _write_splats(fresh, obj, contents)
        for form in formats:
            _WRITERS[form](fresh, contents)
        notes = _notes(contents, formats, how)
        (fresh / "README.md").write_text(_readme(contents, formats, how, notes), encoding="utf-8")
        names = sorted(str(path.relative_to(fresh)) for path in fresh.rglob("*") if path.is_file())
        files = sorted([*names, MANIFEST])
        manifest = _manifest(contents, formats, how, notes, files)
        (fresh / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
        check_folder(target)  # again: much time has passed
        if place.is_dir():
            place.rename(work / "before")
        try:
            fresh.rename(place)
        except BaseException:
            if (work / "before").is_dir():
                (work / "before").rename(place)
            raise
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return Exported(
        target,
        files,
        how,
        len(contents.pieces),
        len(contents.mesh.faces),
        contents.texture is not None,
        notes,
    )


def _write_meshes(folder: Path, contents: Contents) -> None:
    folder.mkdir()
    image = None
    if contents.texture is not None:
        image = f"{VISUAL}.png"
        write_image(folder / image, contents.texture)
    write_material(folder / f"{VISUAL}.mtl", contents.name, PLAIN, image)
    write_obj(
        folder / f"{VISUAL}.obj",
        contents.mesh,
        normals=contents.normals,
        texture=contents.texture,
        material=contents.name,
    )
    for piece, hull in zip(contents.piece_names, contents.pieces, strict=True):
        write_obj(folder / f"{piece}.obj", hull)


def _write_splats(folder: Path, obj: NeuralObject, contents: Contents) -> None:
    """Gaussians as they are, and the object, whose own contact acts where its bridge is."""
    if contents.splats is not None:
        contents.splats.save(folder / f"{SPLATS}.ply")
        obj.save(folder / f"{contents.name}.dano")
    if contents.surroundings is not None:
        contents.surroundings.save(folder / f"{SURROUNDINGS}.ply")


def _notes(contents: Contents, formats: list[str], how: str) -> list[str]:
    n = len(contents.pieces)
    pieces = (
        "the convex hull of the object: what is concave is filled"
        if how == "hull"
        else f"{n} convex piece{'s' if n > 1 else ''} (CoACD), which fill{'s' if n == 1 else ''} what is"
        " less concave than was asked for"
    )
    unknown = [] if "usd" in formats else ["stiffness"]
    lost = [
        field
        for field in (
            *unknown,
            "restitution_velocity",
            "hysteresis",
            "friction_fading",
            "friction_pressure",
            "spring",
            "damper",
            "sliding_drag",
            "torsional_drag",
            "rolling_drag",
        )
        if contents.parameter(field) is not None
    ]
    notes = [
        f"Contact is with {pieces}; dano's own contact, pressure over the area of the surface, is in no"
        " format."
    ]
    if lost:
        notes.append(f"No format has a place for {', '.join(lost)}.")
    if contents.splats is not None:
        notes.append(
            f"{SPLATS}.ply holds the {len(contents.splats)} Gaussians in the frame of the files, for"
            " MuJoCo Warp (`create_render_context`) and all programs for splats; in USD they are on the body,"
            f" and Newton reads them. {contents.name}.dano is the object, for dano.mujoco.Bridge."
        )
    return [*notes, *(note for form in formats for note in _NOTES[form])]


def _readme(contents: Contents, formats: list[str], how: str, notes: list[str]) -> str:
    inertia = "\n".join("    " + " ".join(f"{x: .6e}" for x in row) for row in contents.inertia)
    com = ", ".join(f"{x:.6g}" for x in contents.com)
    load = "\n".join(f"- {_LOAD[form].format(name=contents.name)}" for form in formats)
    lines = "\n".join(f"- {note}" for note in notes)
    return f"""# {contents.name}

Written by `dano export`. Metres, kilograms, z up; all files are in the frame of the object's field.

Mass {contents.mass:.6g} kg, centre of mass ({com}) m, inertia about it [kg m²]:

{inertia}

{len(contents.mesh.faces)} visible triangles, {len(contents.pieces)} convex piece(s) ({how}),
sliding friction {contents.friction:g}.

## To load it

{load}

## What the files do not say

{lines}
"""


def _manifest(
    contents: Contents, formats: list[str], how: str, notes: list[str], files: list[str]
) -> dict[str, Any]:
    given = {name: contents.parameter(name) for name in ContactParams.__dataclass_fields__}
    return {
        "format": "dano-export",
        "version": 1,
        "name": contents.name,
        "to": formats,
        "mass": contents.mass,
        "com": contents.com.tolist(),
        "inertia": contents.inertia.tolist(),
        "contact": {name: value for name, value in given.items() if value is not None},
        "collision": how,
        "pieces": len(contents.pieces),
        "triangles": len(contents.mesh.faces),
        "textured": contents.texture is not None,
        "notes": notes,
        "files": files,
    }
