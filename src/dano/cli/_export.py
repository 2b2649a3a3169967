"""`dano export`."""

import re

from dano.cli._arguments import Export
from dano.cli._console import Progress, put, put_json
from dano.contact import ContactParams
from dano.exchange import check_folder, export_object, Exported
from dano.scene_file import load_object, object_look


def export(arguments: Export) -> None:
    """See `dano export --help`."""
    check_folder(arguments.output)
    given = {"sliding_friction": arguments.friction, "restitution": arguments.restitution}
    parameters = ContactParams(**{key: value for key, value in given.items() if value is not None})
    made = load_object(arguments.object)
    name = arguments.name
    if name is None:
        word = re.sub(r"\W", "_", arguments.object.stem, flags=re.ASCII)
        name = word if re.match(r"[A-Za-z]", word) else f"object_{word}"
    progress = Progress()
    written = export_object(
        made,
        arguments.output,
        name=name,
        look=object_look(arguments.object),
        contact=parameters,
        progress=progress,
        to=arguments.to,
        collision=arguments.collision,
        concavity=arguments.concavity,
        max_pieces=arguments.max_pieces,
        resolution=arguments.resolution,
        texture_size=arguments.texture_size,
    )
    progress.close()
    if arguments.json:
        put_json({**written._asdict(), "folder": str(written.folder)})
        return
    put(f"wrote {_what(written)}")
    put(f"  {', '.join(file for file in written.files if '/' not in file)}")
    for note in written.notes:
        put(f"- {note}")


def _what(written: Exported) -> str:
    pieces = (
        "its convex hull" if written.collision == "hull" else f"{written.pieces} convex piece(s) by CoACD"
    )
    colours = "with its learned colours" if written.textured else "in one colour: none were learned"
    return f"{written.folder}: {written.triangles} triangles {colours}, and {pieces} for contact"
