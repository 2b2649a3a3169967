"""Checks before any work starts: where results go, and whether what draws them is installed."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from dano.archive import checked_output
from dano.cli import _arguments
from dano.cli._console import say
from dano.cli.tracking import Track
from dano.extras import is_installed

Options = TypeVar("Options")

_NAMED_AFTER: dict[type, tuple[str, str]] = {
    _arguments.Train: ("images", ".dano"),
    _arguments.BuildObject: ("field", ".dano"),
    _arguments.Import: ("file", ".grid.npz"),
    _arguments.Simulate: ("scene", "_run.npz"),
    Track: ("video", "_motion.npz"),
    _arguments.PlanTask: ("task", "_plan.npz"),
    _arguments.Export: ("object", "_export"),
    _arguments.Compare: ("object", "_meshes.html"),
}
"""Commands with the input that their output is named after, and what is appended to its name."""


def named(command: Any) -> tuple[Any, str | None]:
    """The command with a name for its output, and a line that says it once it is there, if nobody gave one.

    Outputs go to the current folder under the input's name; cameras go to their photographs, where
    `dano train` looks for them. A number is appended where there is something of this name already, unless an
    earlier training is to go on.
    """
    if getattr(command, "output", None) is not _arguments.UNNAMED:
        return command, None
    fields: Any = command
    if isinstance(command, _arguments.Simulate) and command.beside is not None:
        return dataclasses.replace(command, output=Path()), None
    if isinstance(command, _arguments.FindPoses):
        source = command.images
        folder = source.parent if source.name == "images" else source
        usual = folder / "transforms.json" if source.is_dir() else Path(f"{_stem(source)}_transforms.json")
    else:
        name, ending = _NAMED_AFTER[type(command)]
        usual = Path(_stem(getattr(fields, name)) + ending)
    output = usual if getattr(fields, "resume", False) else free_path(usual)
    line = f"wrote {output}" + ("" if output == usual else f", because {usual} was there already")
    return dataclasses.replace(fields, output=output), line


def chosen(options: type[Options], command: Any, **given: Any) -> Options:
    """Options of a part of dano, from those of a command that have the same names.

    Args:
        options: Their class.
        command: The command, or a group of its options.
        **given: Those that are called or written otherwise.
    """
    kind: Any = options
    names = {field.name for field in dataclasses.fields(kind)} & vars(command).keys()
    return options(**{name: getattr(command, name) for name in names} | given)


def run_files(folder: Path, scenes: Sequence[Path], *, resume: bool) -> list[Path]:
    """Where the runs of some scenes go in a folder: each has a name of its own.

    What is there already is kept, unless earlier runs are to go on.
    """
    paths: list[Path] = []
    for scene in scenes:
        usual = folder / (_stem(scene) + _NAMED_AFTER[_arguments.Simulate][1])
        paths.append(free_path(usual, taken=paths, keep=not resume))
    return paths


def free_path(path: Path, *, taken: Sequence[Path] = (), keep: bool = True) -> Path:
    """The path, or the first of path_2, path_3, … that is free.

    Args:
        path: The path.
        taken: Others that are not free.
        keep: Whether a path is not free if there is something.
    """
    stem, dot, ending = path.name.partition(".")
    free, number = path, 1
    while free in taken or (keep and (free.exists() or free.is_symlink())):
        number += 1
        free = path.with_name(f"{stem}_{number}{dot}{ending}")
    return free


def _stem(source: Path | str) -> str:
    """Name of an input without its folder and endings; of a function package.module:name its name."""
    head, _, tail = str(source).rpartition(":")
    # Behind a part of an object stands what it weighs, blade.ply:7850.
    path = Path(head if head and tail[:1].isdigit() else tail)
    if path.name in ("transforms.json", "anno_train.json"):
        path = path.parent
    return path.absolute().name.split(".", 1)[0] or "dano"


def check_output(path: Path, *inputs: Path, suffix: str | None = None) -> None:
    """Check that a file can be written.

    Args:
        path: Where to.
        inputs: Files that must not be overwritten.
        suffix: How the name must end, if it matters.

    Raises:
        ValueError: If the path is a directory, its parent does not exist, it is one of the inputs, or it ends
            otherwise.
    """
    checked_output(path)
    for source in inputs:
        if path.exists() and source.exists() and path.samefile(source):
            raise ValueError(f"output path must not be the input, got {path} for both")
    if suffix is not None and path.suffix.lower() != suffix:
        raise ValueError(f"output path must end in {suffix}, got {path}")


def check_distinct(**outputs: Path | None) -> None:
    """Check that no two results go to one file.

    Args:
        **outputs: Where to, by the name of the option; None where nothing is written.

    Raises:
        ValueError: If two are the same file. Devices and pipes may take several.
    """
    named: dict[Path, str] = {}
    for name, path in outputs.items():
        if path is None or (path.exists() and not path.is_file()):
            continue
        other = named.setdefault(path.resolve(), name)
        if other != name:
            raise ValueError(f"{other} and {name} must be different files, got {path} for both")


def missing_for_pictures(*, video: bool) -> str | None:
    """What to install before pictures, or videos, can be made; None if all is there."""
    packages = ["matplotlib", "PIL", *(["av"] if video else [])]
    if missing := [name for name in packages if not is_installed(name)]:
        return f"pictures need {', '.join(missing)}: pip install 'dano[view]'"
    return None


def picture_of(command: Any, usual: Path, *inputs: Path) -> Path | None:
    """Where a command with `--png` and `--no-png` draws; None if it does not, or cannot and need not.

    Raises:
        ValueError: If the picture cannot be written.
        ImportError: If it was asked for, and what draws it is not installed.
    """
    if command.no_png:
        return None
    picture = command.png or usual
    check_output(picture, *inputs, suffix=".png")
    if missing := missing_for_pictures(video=False):
        if command.png is not None:
            raise ImportError(missing)
        say(f"warning: not drawn, {missing}")
        return None
    return picture
