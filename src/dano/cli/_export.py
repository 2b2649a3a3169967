"""`dano export`."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, TYPE_CHECKING

from tyro.conf import arg, Positional

if TYPE_CHECKING:
    from dano.exchange import Exported


def export(
    object: Positional[Path],
    /,
    output: Annotated[Path, arg(aliases=["-o"])],
    to: tuple[Literal["mjcf", "urdf", "usd", "obj"], ...] = ("mjcf",),
    name: str | None = None,
    collision: Literal["auto", "coacd", "hull"] = "auto",
    concavity: float = 0.05,
    max_pieces: int | None = None,
    friction: float = 0.2,
    restitution: float | None = None,
    resolution: int = 64,
    texture_size: int = 1024,
    json: bool = False,
) -> Callable[[], None]:
    """Write an object as a folder that other simulators load.

    Mass, centre of mass and inertia are the object's; what is seen has the learned colours; what touches are
    convex pieces. README.md in the folder says what the format cannot hold.

    Args:
        object: A neural object (.dano).
        output: The folder; new, empty, or of an earlier export, which is replaced.
        to: Formats, one or several: mjcf (MuJoCo), urdf (PyBullet, ROS), usd (Isaac), obj (meshes only).
        name: Of the body and the files; default: the object's file's.
        collision: coacd: convex decomposition; hull: convex hull; auto: the first if coacd is installed.
        concavity: How deep a convex piece may cut across, as a share of the size.
        max_pieces: Most convex pieces; default: as many as it takes.
        friction: Sliding friction.
        restitution: Coefficient of restitution, where the format has one.
        resolution: Nodes along the longest axis for the visible surface.
        texture_size: Texels along the picture with the colours.
        json: Print one JSON object instead of text.
    """
    options = {
        "to": to,
        "collision": collision,
        "concavity": concavity,
        "max_pieces": max_pieces,
        "resolution": resolution,
        "texture_size": texture_size,
    }
    contact = {"sliding_friction": friction, "restitution": restitution}
    return functools.partial(_run, object, output, name, contact, options, json)


def _run(
    path: Path,
    output: Path,
    name: str | None,
    contact: dict[str, float | None],
    options: dict[str, Any],
    as_json: bool,
) -> None:
    # Here, so that `dano --help` answers at once.
    import re

    from dano.cli._console import Progress, put, put_json
    from dano.contact import ContactParams
    from dano.exchange import check_folder, export_object
    from dano.objects import NeuralObject
    from dano.vision import LearnedField

    check_folder(output)
    parameters = ContactParams(**{key: value for key, value in contact.items() if value is not None})
    made = NeuralObject.load(path)
    if name is None:
        word = re.sub(r"\W", "_", path.stem, flags=re.ASCII)
        name = word if re.match(r"[A-Za-z]", word) else f"object_{word}"
    progress = Progress()
    written = export_object(
        made,
        output,
        name=name,
        look=LearnedField.of_object(path),
        contact=parameters,
        progress=progress,
        **options,
    )
    progress.close()
    if as_json:
        put_json({**written._asdict(), "folder": str(written.folder)})
        return
    put(f"wrote {_what(written)}")
    put(f"  {', '.join(file for file in written.files if '/' not in file)}")
    for note in written.notes:
        put(f"- {note}")


def _what(written: "Exported") -> str:
    pieces = (
        "its convex hull" if written.collision == "hull" else f"{written.pieces} convex piece(s) by CoACD"
    )
    colours = "with its learned colours" if written.textured else "in one colour: none were learned"
    return f"{written.folder}: {written.triangles} triangles {colours}, and {pieces} for contact"
