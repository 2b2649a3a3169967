"""Where everything of a story is: what the user gives, and the folder of the results."""

import json
import re
from pathlib import Path
from typing import Any, NamedTuple

from dano.cli._outputs import check_output, missing_for_pictures
from dano.cli.film._arguments import Film
from dano.cli.tracking import Filming
from dano.extras import COLMAP, OPENCV
from dano.vision import is_video, mask_folder, picture_files, PoseOptions

TABLE = "table"
"""Name of the table in scenes."""


class Place(NamedTuple):
    """Where everything of one story is.

    Attributes:
        command: What was asked for.
        folder: Of all results but the object.
        photographs: The photographs of the walk, or the film that it is.
        given: Masks of the photographs that are there; empty if there are none.
        body: Name of the object in motions and scenes.
    """

    command: Film
    folder: Path
    photographs: tuple[Path, ...]
    given: tuple[Path, ...]
    body: str

    @property
    def walk(self) -> Path:
        """Folder of the photographs, which may be frames of a film."""
        return self.folder / "walk" if is_video(self.command.walk) else self.command.walk

    @staticmethod
    def optional(path: Path | None) -> list[Path]:
        """A file that need not be given, in a list."""
        return [] if path is None else [path]

    @property
    def options(self) -> PoseOptions:
        """How cameras are found."""
        asked = self.command
        return PoseOptions(
            marker_size=asked.marker_size, marker_family=asked.marker_family, frames=asked.frames, up="marker"
        )

    def filming(self, since: float | None = None, until: float | None = None) -> Filming:
        """How the film was taken, and which part of it counts [s]."""
        asked = self.command
        return Filming(
            camera=self.folder / "camera.json",
            background=asked.background,
            slow_motion=asked.slow_motion,
            shutter=asked.shutter,
            readout=asked.readout,
            table=0.0,
            since=since,
            until=until,
            seed=asked.seed,
        )


def place_of(command: Film) -> Place:
    """Where everything is, after checks that need no work.

    Raises:
        ValueError: If an input is missing or of the wrong kind, or the output cannot be written.
        ImportError: If a package is missing.
    """
    check_output(command.output, suffix=".dano")
    if not is_video(command.slide) or not command.slide.is_file():
        raise ValueError(
            f"slide must be a film (.mp4, .mov, …) of the object that slides, got {command.slide}"
            + ("" if command.slide.exists() else ", which does not exist")
        )
    for name in ("masks", "network", "background"):
        path = getattr(command, name)
        if path is not None and not path.exists():
            raise ValueError(f"{name} must be there, got {path}, which does not exist")
    if missing := missing_for_pictures(video=True):
        raise ImportError(missing)
    COLMAP.check()
    OPENCV.check()
    filmed = is_video(command.walk) and command.walk.is_file()
    photographs = [command.walk] if filmed else picture_files(command.walk)
    body = re.sub(r"\W+", "_", command.output.name.split(".")[0]).strip("_")
    masks = command.masks if filmed else mask_folder(photographs[0], command.masks)
    given = () if masks is None else tuple(picture_files(masks))
    return Place(
        command,
        command.output.with_name(f"{command.output.stem}_film"),
        tuple(photographs),
        given,
        "object" if body in ("", TABLE) else body,
    )


def read_json(file: Path) -> dict[str, Any]:
    """What a stage left."""
    return json.loads(file.read_text(encoding="utf-8"))
