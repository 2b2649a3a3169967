"""Robots of scene files."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dano.maths import Pose
from dano.robots import load_mjcf, load_urdf, Robot
from dano.scene_file._table import is_number, located, Table

_FORMATS = {"urdf": load_urdf, "mjcf": load_mjcf}
_KEYS = (*_FORMATS, "base", "prefix", "collision", "ignore", "balance_inertia", "joints")


def read_robots(top: Table, folder: Path) -> list[tuple[Robot, dict[str, float]]]:
    """The robots of a scene file, and where their joints start.

    Raises:
        ValueError: If a table is wrong, or a robot's file is.
    """
    return [
        _robot(Table(f"{top.where}: [[robots]] {i + 1}", row, _KEYS), folder)
        for i, row in enumerate(top.tables("robots"))
    ]


def robot_files(data: dict[str, Any], folder: Path) -> list[Path]:
    """The files of the robots of a scene file."""
    return [
        folder / Path(row[kind]).expanduser()
        for row in data.get("robots", [])
        for kind in _FORMATS
        if kind in row
    ]


def common_gravity(where: str, robots: Sequence[Robot]) -> tuple[float, float, float] | None:
    """Gravity of the robots' files [m/s²]; None if they have none.

    Raises:
        ValueError: If two have different ones.
    """
    given = {robot.gravity: robot.name for robot in robots if robot.gravity is not None}
    if len(given) > 1:
        (a, first), (b, second) = list(given.items())[:2]
        raise ValueError(
            f"{where}: gravity must be given where robots have different ones, got {a} of {first!r} and"
            f" {b} of {second!r}"
        )
    return next(iter(given), None)


def _words(table: Table, key: str) -> list[str]:
    words = table.data.get(key, [])
    words = [words] if isinstance(words, str) else words
    if not isinstance(words, list) or not all(isinstance(word, str) for word in words):
        raise ValueError(f"{table.where}: {key} must be a list of strings, got {words!r}")
    return words


def _robot(table: Table, folder: Path) -> tuple[Robot, dict[str, float]]:
    kinds = [kind for kind in _FORMATS if kind in table]
    if len(kinds) != 1:
        raise ValueError(f"{table.where}: needs exactly one of {', '.join(_FORMATS)}, got {kinds or 'none'}")
    path = folder / Path(table.word(kinds[0])).expanduser()
    base: Pose | str | None = None
    if isinstance(table.data.get("base"), str):
        base = table.word("base", ("floating",))
    elif "base" in table:
        place = table.table("base", ("position", "orientation"))
        base = Pose(
            place.vector("position", 3, (0.0,) * 3), place.vector("orientation", 4, (1.0, 0.0, 0.0, 0.0))
        )
    prefix = table.word("prefix") if "prefix" in table else ""
    with located(table.where):
        robot = _FORMATS[kinds[0]](
            path,
            base=base,
            prefix=prefix,
            # Words and tables of them are checked where they are read.
            collision=table.data.get("collision", True),
            ignore=_words(table, "ignore"),
            balance_inertia=table.boolean("balance_inertia", False),
        )
        robot.check_simulated()
        joints = table.table("joints", list(robot.joint_names)).data
        for name, value in joints.items():
            if not is_number(value):
                raise ValueError(f"joints: {name} must be a finite number [rad or m], got {value!r}")
    return robot, {name: float(value) for name, value in joints.items()}
