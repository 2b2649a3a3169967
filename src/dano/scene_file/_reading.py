"""Reading scene files. Their keys are described in docs/scenes.md.

Robots of scene files.
"""

import dataclasses
import functools
import inspect
import json
import math
import os
import tomllib
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, get_args, TYPE_CHECKING

from dano.archive import checked_input
from dano.building import BuildOptions, Units, Up
from dano.checks import checked_choice, checked_count, checked_number, shown
from dano.contact import AbstractContactLaw, CentroidLaw, ContactParams, DistributedLaw
from dano.engine import simulate
from dano.fields import AbstractShape, posed, PRIMITIVES
from dano.maths import is_traced, Pose
from dano.memory import memory_limit
from dano.names import did_you_mean
from dano.objects import MassModel, NeuralObject
from dano.progress import Progress
from dano.robots import close_loops, load_mjcf, load_urdf, Robot
from dano.scene import (
    Body,
    coming_from,
    Contact,
    Joint,
    JOINT_KINDS,
    JOINT_QUANTITIES,
    Loop,
    LOOP_KINDS,
    Motor,
    MOTOR_KINDS,
    say_doubts,
    Scene,
    SceneWarning,
    State,
    STATE_SIZES,
    touching_pairs,
    Trajectory,
)
from dano.scene_file._forecast import file_doubts
from dano.scene_file._objects import (
    is_shipped,
    load_asset,
    load_object,
    object_look,
    object_of_file,
)
from dano.scene_file._schedule import read_schedule, Schedule
from dano.scene_file._table import is_number, located, Table

if TYPE_CHECKING:
    from dano.vision import LearnedField, PosedCamera


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


_STATE = {**STATE_SIZES, "origin": 3, "spin_world": 3}
_GEOMETRY = ("object", "field", "asset", "shape")
_BODY = ("name", *_GEOMETRY, "mass", "mass_scale", "fixed", *_STATE, *JOINT_QUANTITIES)
_JOINT = {"axis": 3, "anchor": 3, "position": 3, "orientation": 4}
_MOTOR_NUMBERS = ("stiffness", "damping", "gear")
_LOOP = {"position": 3, "anchor": 3, "orientation": 4}
_JOINT_NUMBERS = ("damping", "friction", "armature", "stiffness", "rest", "ratio", "shift")
# The mass of a body is a key of the body.
_BUILD = tuple(field.name for field in dataclasses.fields(BuildOptions) if field.name != "mass")
_LAWS: dict[str, type[AbstractContactLaw]] = {"centroid": CentroidLaw, "distributed": DistributedLaw}
"""Laws by name."""
DEFAULT_LAW = "distributed"
"""Law of contacts that name none."""
_FLAGS = ("adhesive", "compliant")
"""Those of them that are true or false; the others are numbers."""
_BYTES_PER_STEP = 500
"""Of a body in memory: state, joined pieces, and contact forces."""
_TOP = ("timestep", "gravity", "duration", "n_steps", "camera")
_TOP += ("bodies", "joints", "loops", "robots", "contacts", "default_contact", "controls")


@functools.cache
def _law_keys(law: str) -> tuple[str, ...]:
    """The keys that belong to a law: the parameters it reads, and what it is made from."""
    return (*_LAWS[law]().reads, *inspect.signature(_LAWS[law]).parameters)


@functools.cache
def _contact_keys() -> tuple[str, ...]:
    return ("law", "edge", *dict.fromkeys(key for law in _LAWS for key in _law_keys(law)))


@dataclass(frozen=True)
class SceneFile:
    """What a scene file says."""

    scene: Scene  # The scene
    state: State  # Its initial state
    n_steps: int  # Number of steps to simulate
    controls: Schedule | None  # Forces and torques over time, or None
    path: Path  # Where the file is, or would be: names in it are relative to its folder
    text: str  # The file's text
    # Files of neural objects, or names of shipped ones, by the names of their bodies.
    objects: dict[str, Path | str]
    default_law: str = DEFAULT_LAW  # Law of the contacts that name none

    def simulate(self, **options: Any) -> Trajectory:
        """`dano.simulate` of what the file says, which films then show with what bodies look like.

        Args:
            **options: Of `dano.simulate`; `n_steps` or `duration`, `state` and `controls` replace the file's.

        Raises:
            ValueError: As `dano.simulate`.
        """
        given = {"state": self.state, "controls": self.controls, **options}
        if "duration" not in given:
            given = {"n_steps": self.n_steps, **given}
        run = simulate(self.scene, **given)
        return run if is_traced(run) else coming_from(run, run.origin._replace(looks=self.looks))

    def inputs(self) -> list[Path]:
        """Files that the scene is made of."""
        data = tomllib.loads(self.text)
        rows = data.get("bodies", [])
        named = [row[kind] for row in rows for kind in ("object", "field") if kind in row]
        folder = self.path.parent
        files = [path for name in named if isinstance(path := _source(folder, name), Path)]
        return [self.path, *files, *robot_files(data, folder)]

    def looks(self) -> dict[str, "LearnedField"]:
        """What bodies look like whose objects' files say so, by name: for pictures.

        Raises:
            ValueError: If a file cannot be read any more.
        """
        read = {source: object_look(source) for source in set(self.objects.values())}
        return {name: look for name, source in self.objects.items() if (look := read[source]) is not None}

    def camera(self) -> "PosedCamera":
        """The camera that the file names: for pictures.

        Raises:
            ValueError: If it names none, or that cannot be read.
        """
        from dano.vision import load_camera

        named = Table(str(self.path), tomllib.loads(self.text), None).word("camera")
        return load_camera(self.path.parent / named)


def load_scene(
    path: str | os.PathLike[str],
    *,
    timestep: float | None = None,
    n_steps: int | None = None,
    progress: Progress | None = None,
) -> SceneFile:
    """Read a scene file (TOML; its keys are described in docs/scenes.md).

    Args:
        path: The file. Names of other files in it are relative to its folder.
        timestep: Replaces the file's [s]; a `duration` in the file stays.
        n_steps: Replaces the file's `n_steps` or `duration`.
        progress: Called with a description and the share done while fields become objects.

    Raises:
        ValueError: If the file, or one that it names, is missing or broken, a key is unknown or of the wrong
            type, or the scene is not valid; the message names the file and the table.
    """
    source = checked_input(path)
    try:
        # Some editors on Windows begin files with a mark, which TOML does not know.
        text = source.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{source} must be a TOML scene file, got one that is not text") from error
    return parse_scene(text, source, timestep=timestep, n_steps=n_steps, progress=progress)


def parse_scene(
    text: str,
    path: Path,
    *,
    timestep: float | None = None,
    n_steps: int | None = None,
    progress: Progress | None = None,
    default_law: str = DEFAULT_LAW,
) -> SceneFile:
    """Read the text of a scene file.

    Args:
        text: The text.
        path: Where the file would be; it need not exist.
        timestep: See `load_scene`.
        n_steps: See `load_scene`.
        progress: See `load_scene`.
        default_law: Law of contacts that name none.

    Raises:
        ValueError: As `load_scene`.
    """
    checked_choice("default_law", default_law, list(_LAWS))
    if not isinstance(text, str):
        raise ValueError(f"text must be that of a TOML scene file, got {shown(text)}")
    if n_steps is not None:
        n_steps = checked_count("n_steps", n_steps)
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path} must be a TOML scene file: {error}") from error
    top = Table(str(path), data, _TOP)
    h, steps = _time(top, path, timestep, n_steps)
    if "camera" in top:
        top.word("camera")
    tables = top.tables("bodies")
    robots = read_robots(top, path.parent)
    usual = None
    if "gravity" not in top:
        usual = common_gravity(str(path), [robot for robot, _ in robots])
    gravity = top.vector("gravity", 3, usual or (0.0, 0.0, -9.81))
    if not tables and not robots:
        raise ValueError(f"{path}: needs at least one [[bodies]] table")
    n_bodies = len(tables) + sum(len(robot.bodies) for robot, _ in robots)
    most = 2 * memory_limit() // (_BYTES_PER_STEP * n_bodies)
    if steps > most:
        raise ValueError(
            f"{path}: duration and n_steps must make at most {most} steps of {n_bodies} bodies,"
            f" got {steps:.6g} of {h:.6g} s"
        )

    built: dict[object, NeuralObject] = {}
    rows = [Table(f"{path}: [[bodies]] {i + 1}", table, None) for i, table in enumerate(tables)]
    bodies = [_body(row, path.parent, built, progress) for row in rows]
    bodies += [body for robot, _ in robots for body in robot.bodies]
    joints = [joint for robot, _ in robots for joint in robot.joints]
    joints += _joints(top, [body.name for body in bodies])
    loops = [loop for robot, _ in robots for loop in robot.loops]
    loops += _loops(top, [body.name for body in bodies])
    contacts = _contacts(top, bodies, [*joints, *loops], default_law, [robot for robot, _ in robots])
    with located(str(path)), warnings.catch_warnings():
        # Said together, below.
        warnings.simplefilter("ignore", SceneWarning)
        scene = Scene.create(bodies, contacts, joints=joints, loops=loops, timestep=h, gravity=gravity)
        given = (*_STATE, *JOINT_QUANTITIES)
        start = {row["name"]: {key: row[key] for key in given if key in row} for row in tables}
        for robot, q in robots:
            start |= robot.start(q)
        state = scene.initial_state(**start)
        if loops:
            # Coordinates that the file gives stay as they are.
            state = close_loops(scene, state, [name for name, given in start.items() if "q" in given])
    schedule = read_schedule(top, scene)
    made = SceneFile(scene, state, int(steps), schedule, path, text, _objects(tables, path), default_law)
    asked = top.number("duration") if n_steps is None and "duration" in top else None
    say_doubts(
        [*scene.doubts(state, start), *file_doubts(scene, state, schedule, int(steps), asked)], stacklevel=3
    )
    return made


def _objects(tables: Sequence[dict[str, Any]], path: Path) -> dict[str, str | Path]:
    """What neural objects are made of, by the names of their bodies."""
    return {
        row["name"]: row["asset"] if "asset" in row else _source(path.parent, row["object"])
        for row in tables
        if "asset" in row or "object" in row
    }


def _time(top: Table, path: Path, timestep: float | None, n_steps: int | None) -> tuple[float, int | float]:
    """The step [s], and how many there are.

    Raises:
        ValueError: If one is out of range.
    """
    asked = None if timestep is None else checked_number("timestep", timestep, above=0, unit="s")
    h = top.number("timestep", 0.01) if asked is None else asked
    if not (math.isfinite(h) and h > 0):
        raise ValueError(f"{path}: timestep must be finite and > 0 s, got {h}")
    steps = _steps(top, h) if n_steps is None else n_steps
    if steps < 1:
        raise ValueError(f"{path}: n_steps must be ≥ 1, got {steps}")
    return h, steps


def _steps(top: Table, timestep: float) -> int | float:
    if "duration" in top and "n_steps" in top:
        raise ValueError(
            f"{top.where}: duration [s] and n_steps say the same, got {top.data['duration']!r} and"
            f" {top.data['n_steps']!r}: keep one"
        )
    if "duration" not in top and "n_steps" not in top:
        hint = _inside(top, ("duration", "n_steps"))
        raise ValueError(f"{top.where}: needs either duration [s] or n_steps, got neither{hint}")
    if "n_steps" in top:
        return top.integer("n_steps", 0)
    duration = top.number("duration")
    if duration <= 0:
        raise top.wrong("duration", "> 0 s")
    count = duration / timestep
    if count > 2**62:
        return count
    return max(1, round(count))


def _inside(top: Table, keys: Sequence[str]) -> str:
    """In which table a key stands that belongs to the whole file; in TOML all below a table is part of it."""
    for name, tables in top.data.items():
        rows = tables if isinstance(tables, list) else [tables]
        for i, row in enumerate(rows):
            for key in keys:
                if isinstance(row, Mapping) and key in row:
                    return f"; {key!r} stands within {name} {i + 1}: write it above all tables"
    return ""


def _body(row: Table, folder: Path, built: dict[object, NeuralObject], progress: Progress | None) -> Body:
    name = row.word("name")
    row.where += f" ({name!r})"
    kinds = [key for key in _GEOMETRY if key in row]
    if len(kinds) != 1:
        row.only((*_BODY, "build", "pose", "edge", *_shape_keys()))
        raise ValueError(f"{row.where}: needs exactly one of {', '.join(_GEOMETRY)}, got {kinds or 'none'}")
    options: dict[str, Any] = {"fixed": row.boolean("fixed", False)}
    for key in ("mass", "mass_scale"):
        if key in row:
            options[key] = row.number(key)
    for key, n in _STATE.items():
        if key in row:
            row.vector(key, n)
    for key in JOINT_QUANTITIES:
        if key in row:
            row.number(key)
    with located(row.where):
        if kinds == ["shape"]:
            return Body(name, _shape(row), **options)
        row.only((*_BODY, "build") if kinds in (["field"], ["object"]) else _BODY)
        return Body(name, _object(row, kinds[0], folder, built, progress), **options)


def _shape_keys() -> list[str]:
    return sorted({key for shape in PRIMITIVES.values() for key in shape.takes})


def _shape(row: Table) -> AbstractShape:
    kind = row.word("shape", list(PRIMITIVES))
    make: Any = PRIMITIVES[kind]
    row.only((*_BODY, *make.takes, "edge", "pose"))
    usual = {key: each.default for key, each in inspect.signature(make).parameters.items()}
    if missing := [key for key in make.takes if usual[key] is inspect.Parameter.empty and key not in row]:
        raise ValueError(f"a {kind} needs {', '.join(missing)} [m]")
    given: dict[str, Any] = {
        key: row.number(key) if n == 1 else row.vector(key, n) for key, n in make.takes.items() if key in row
    }
    if "edge" in row:
        given["edge"] = row.number("edge")
    shape = make(**given)
    if "pose" not in row:
        return shape
    pose = row.table("pose", ("position", "orientation"))
    where = Pose(pose.vector("position", 3, (0.0,) * 3), pose.vector("orientation", 4, (1.0, 0.0, 0.0, 0.0)))
    return cast(AbstractShape, posed(shape, where))


def _object(
    row: Table, kind: str, folder: Path, built: dict[object, NeuralObject], progress: Progress | None
) -> NeuralObject:
    """The neural object of a body; bodies that say the same share one."""
    name = row.word(kind)
    if kind == "asset":
        return load_asset(name)
    source = _source(folder, name)
    build = row.table("build", _BUILD)
    is_object = kind == "object"
    if is_object and "build" in row and (is_shipped(source) or Path(source).suffix.lower() == ".dano"):
        raise ValueError(f"build goes with a mesh or a field, got the object {name!r}, which is built")
    key = (kind, source, json.dumps(build.data, sort_keys=True))
    if key not in built:
        weighed = "mass" in row or "mass_scale" in row
        if is_object:
            options = _build_options(build) if "build" in row else None
            built[key] = load_object(source, options, weighed=weighed, progress=progress)
        else:
            options = _build_options(build)
            built[key] = object_of_file(source, options, weighed=weighed, progress=progress)
    return built[key]


def _source(folder: Path, name: str) -> Path | str:
    """A file by its name relative to a folder, or the name of a shipped object if there is no such file."""
    path = folder / Path(name).expanduser()
    return name if is_shipped(name) and not path.exists() else path


def _build_options(build: Table) -> BuildOptions:
    usual = BuildOptions()
    return BuildOptions(
        samples=build.integer("samples", usual.samples),
        density_range=cast(tuple[float, float], build.vector("density_range", 2))
        if "density_range" in build
        else None,
        mass_model=cast(MassModel, build.word("mass_model", get_args(MassModel), usual.mass_model)),
        mass_scale=build.number("mass_scale") if "mass_scale" in build else None,
        resolution=build.integer("resolution", usual.resolution),
        units=cast(Units, build.word("units", get_args(Units))) if "units" in build else None,
        up=cast(Up, build.word("up", get_args(Up))) if "up" in build else None,
        length=build.number("length") if "length" in build else None,
        floaters=build.boolean("floaters", usual.floaters),
        seed=build.integer("seed", usual.seed),
    )


def _joints(top: Table, names: Sequence[str]) -> list[Joint]:
    joints = []
    for i, row in enumerate(top.tables("joints")):
        table = Table(
            f"{top.where}: [[joints]] {i + 1}",
            row,
            ("parent", "child", "kind", *_JOINT, "limits", *_JOINT_NUMBERS, "mimics", "motor"),
        )
        child = table.word("child", names)
        table.where += f" ({child!r})"
        parent = table.word("parent", names) if "parent" in table else None
        options: dict[str, Any] = {key: table.vector(key, n) for key, n in _JOINT.items() if key in table}
        with located(table.where):
            kind = table.word("kind", JOINT_KINDS, "hinge")
            options |= {key: table.number(key) for key in _JOINT_NUMBERS if key in table}
            if "limits" in table:
                options["limits"] = table.vector("limits", 2)
            if "mimics" in table:
                options["mimics"] = table.word("mimics", names)
            if "motor" in table:
                options["motor"] = _motor(table.table("motor", ("kind", *_MOTOR_NUMBERS, "limits")))
            joints.append(Joint(parent, child, kind, **options))
    return joints


def _motor(table: Table) -> Motor:
    given: dict[str, Any] = {key: table.number(key) for key in _MOTOR_NUMBERS if key in table}
    if "limits" in table:
        given["limits"] = table.vector("limits", 2)
    return Motor(table.word("kind", MOTOR_KINDS, "effort"), **given)


def _loops(top: Table, names: Sequence[str]) -> list[Loop]:
    loops = []
    for i, row in enumerate(top.tables("loops")):
        table = Table(f"{top.where}: [[loops]] {i + 1}", row, ("first", "second", "kind", *_LOOP))
        second = table.word("second", names)
        first = table.word("first", names) if "first" in table else None
        with located(table.where):
            kind = table.word("kind", LOOP_KINDS, "point")
            given: dict[str, Any] = {key: table.vector(key, n) for key, n in _LOOP.items() if key in table}
            loops.append(Loop(first, second, kind, **given))
    return loops


def _contacts(
    top: Table,
    bodies: Sequence[Body],
    joints: Sequence[Joint | Loop],
    default_law: str,
    robots: Sequence[Robot],
) -> list[Contact]:
    default = top.table("default_contact", _contact_keys())
    default.where = f"{top.where}: [default_contact]"
    usual = _law_name(default, default_law)
    if top.data.get("contacts", "all") == "all":
        return [
            _contact(_rubbing(default, usual, a, b, robots), usual, a, b)
            for a, b in touching_pairs(bodies, joints, presses=_LAWS[usual]().presses)
            if all(robot.may_meet(a, b) for robot in robots)
        ]
    if isinstance(top.data["contacts"], str):
        raise top.wrong("contacts", "'all' or written as [[contacts]] tables")
    names, contacts = [body.name for body in bodies], []
    for i, row in enumerate(top.tables("contacts")):
        table = Table(f"{top.where}: [[contacts]] {i + 1}", row, ("a", "b", *_contact_keys()))
        a, b = table.word("a"), table.word("b")
        table.where += f" ({a!r}, {b!r})"
        for name in (a, b):
            if name not in names:
                raise ValueError(
                    f"{table.where}: a contact must name bodies of the scene {names}, got {name!r}"
                    + did_you_mean(name, names)
                )
        law = _law_name(table, usual)
        # What the default says for another law does not concern this contact.
        inherited = {key: value for key, value in default.data.items() if key in ("edge", *_law_keys(law))}
        table.data = {**inherited, **row}
        contacts.append(_contact(table, law, a, b))
    return contacts


def _rubbing(default: Table, law: str, a: str, b: str, robots: Sequence[Robot]) -> Table:
    """What all contacts have by default, with the friction of the file of a robot whose bodies these are."""
    if "sliding_friction" in default or "sliding_friction" not in _LAWS[law]().reads:
        return default
    found = [x for robot in robots if (x := robot.friction_between(a, b)) is not None]
    return Table(default.where, {**default.data, "sliding_friction": found[0]}, None) if found else default


def _law_name(table: Table, default: str) -> str:
    """The law that a table chooses, whose other keys must belong to it."""
    law = table.word("law", tuple(_LAWS), default)
    for key in table.data:
        owners = [name for name in _LAWS if key in _law_keys(name)]
        if owners and law not in owners:
            hint = "" if "law" in table else f"; for the other law write law = {owners[0]!r}"
            raise ValueError(
                f"{table.where}: {key} belongs to law = {owners[0]!r}, and this is {law!r}, whose keys are "
                f"{', '.join(_law_keys(law))}{hint}"
            )
    return law


def _contact(table: Table, law: str, a: str, b: str) -> Contact:
    make, keys = _LAWS[law], _law_keys(law)
    numbers = {key: table.number(key) for key in keys if key in table and key not in _FLAGS}
    options: dict[str, Any] = {
        key: value for key, value in numbers.items() if key not in ContactParams.__dataclass_fields__
    }
    options |= {key: table.boolean(key, False) for key in keys if key in table and key in _FLAGS}
    edge = table.number("edge") if "edge" in table else None
    with located(table.where):
        params = ContactParams(
            **{key: value for key, value in numbers.items() if key in ContactParams.__dataclass_fields__}
        )
        return Contact(a, b, params, make(**options), edge=edge)
