"""Robots' files of packages, judged by MuJoCo and, where it is installed, by Pinocchio."""

import importlib
import importlib.util
import re
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import mujoco
import numpy as np

import dano
from benchmarks.intake._verdict import Outcome
from dano.maths import quat_multiply, quat_rotate, quat_to_matrix
from dano.robots import Robot

GROUPS = ("frax", "gymnasium", "mujoco", "pybullet_data", "example-robot-data", "dm_control")
"""Packages whose files are read; those that are not installed have none."""
TOLERANCE = 1e-7
"""Largest difference of a frame [m], or of the mass matrix by its largest entry: a link without mass that
carries others gets a billionth of what it carries."""
_HASTY = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
_EXAMPLES = "cmeel.prefix/share/example-robot-data"
_OPTION = re.compile(r"ignore=(\[[^\]]*\])|(balance_inertia=True)")


class _Posed(NamedTuple):
    """A robot within its limits.

    Attributes:
        robot: The robot.
        angles: Coordinates of those joints that have one.
        position: Of the centres of mass of all bodies [m, W].
        orientation: Theirs, wxyz.
        mass: Generalised mass of those joints.
    """

    robot: Robot
    angles: dict[str, float]
    position: np.ndarray
    orientation: np.ndarray
    mass: np.ndarray

    def apart(self, link: str, position: np.ndarray, turn: np.ndarray) -> float:
        """By how much a link's frame differs."""
        body, own, orientation = self.robot.frames[link]
        if body is not None:
            names = [each.name for each in self.robot.bodies]
            i = names.index(body)
            arm = quat_rotate(self.orientation[i], own - np.asarray(self.robot.bodies[i].com))
            own, orientation = self.position[i] + arm, quat_multiply(self.orientation[i], orientation)
        differences = np.asarray(own) - position, np.asarray(quat_to_matrix(jnp.asarray(orientation))) - turn
        return float(max(np.abs(each).max() for each in differences))

    def masses_apart(self, expected: np.ndarray) -> float:
        """By how much the mass matrix differs, as a share of its largest entry."""
        return float(np.abs(self.mass - expected).max() / np.abs(expected).max())


_Posing = Callable[[tuple[str, ...]], _Posed]
"""A robot with some joints turned."""


def robot_files(group: str) -> list[Path]:
    """Robots' files of a package, in order."""
    # Packages of cmeel lie beside the others under a folder of their own.
    name = "cmeel" if group == "example-robot-data" else group
    spec = importlib.util.find_spec(name)
    if spec is None or not spec.submodule_search_locations:
        return []
    root = Path(next(iter(spec.submodule_search_locations)))
    root = root.parent / _EXAMPLES if group == "example-robot-data" else root
    files = sorted([*root.rglob("*.urdf"), *root.rglob("*.xml")])
    return [path for path in files if path.suffix == ".urdf" or b"<mujoco" in path.read_bytes()]


def judged(path: Path) -> tuple[Outcome, str]:
    """What becomes of a file, and why.

    Refused rightly is what no reference reads either, and what one line says an option for that helps.
    """
    references = _references(path)
    options: dict[str, Any] = {}
    first = ""
    # Each option may bring the next complaint.
    for _ in range(4):
        try:
            robot = _loaded(path, options)
        except ValueError as error:
            said = str(error)
            found = _helpful(said)
            if "\n" not in said and found.items() - options.items():
                options = {key: _both(options.get(key), value) for key, value in found.items()} | {
                    key: value for key, value in options.items() if key not in found
                }
                first = first or said
                continue
            wrongly = bool(references)
            return (Outcome.REFUSED_WRONGLY if wrongly else Outcome.REFUSED_RIGHTLY), said
        # Others have no balanced inertias to compare with.
        compared = [] if "balance_inertia" in options else references
        posing = lru_cache(partial(_posed, robot))
        worst = max((reference(robot, posing) for reference in compared), default=0.0)
        if worst > TOLERANCE:
            return Outcome.WRONG, f"differs by {worst:.2g}"
        return (Outcome.REFUSED_RIGHTLY, first) if options else (Outcome.LOADS, "")
    return Outcome.REFUSED_WRONGLY, "options without end"


def _loaded(path: Path, options: dict[str, Any]) -> Robot:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        load = dano.load_urdf if path.suffix == ".urdf" else dano.load_mjcf
        return load(path, collision=False, **options)


def _helpful(said: str) -> dict[str, Any]:
    """Options that a message names."""
    found: dict[str, Any] = {}
    for names, balance in _OPTION.findall(said):
        if balance:
            found["balance_inertia"] = True
        else:
            found["ignore"] = tuple(re.findall(r"'([^']*)'", names))
    return found


def _both(old: Any, new: Any) -> Any:
    return tuple(dict.fromkeys((*old, *new))) if isinstance(old, tuple) else new


def _references(path: Path) -> list[Callable[[Robot, _Posing], float]]:
    """By how much a robot differs from what others read; of those that read the file."""
    found: list[Callable[[Robot, _Posing], float]] = []
    try:
        model = _compiled(path)
    except (ValueError, ET.ParseError):
        model = None
    # Of a file with soft bodies only, it reads nothing.
    if model is not None and model.nbody > 1:
        found.append(lambda robot, posed: _from_mujoco(robot, posed, model))
    if path.suffix == ".urdf" and importlib.util.find_spec("pinocchio") is not None:
        pinocchio = importlib.import_module("pinocchio")
        try:
            built = pinocchio.buildModelFromXML(_bare(path), mimic=True)
        except (ValueError, RuntimeError, ET.ParseError):
            return found
        if built.njoints > 1:
            found.append(lambda robot, posed: _from_pinocchio(robot, posed, built))
    return found


def _compiled(path: Path) -> mujoco.MjModel:
    if path.suffix == ".urdf":
        return mujoco.MjModel.from_xml_string(_bare(path))
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.fusestatic = spec.compiler.discardvisual = False
    return spec.compile()


def _bare(path: Path) -> str:
    """A URDF without shapes, and without the inertia of links without mass, which not all leave out."""
    root = ET.fromstring(path.read_bytes().lstrip())
    for link in root.findall("link"):
        mass = link.find("inertial/mass")
        empty = mass is not None and float(mass.get("value", "0")) == 0
        for part in list(link):
            if part.tag in ("visual", "collision") or (part.tag == "inertial" and empty):
                link.remove(part)
    return ET.tostring(root).decode()


def _posed(robot: Robot, names: tuple[str, ...]) -> _Posed:
    scene = robot.scene()
    angles: dict[str, float] = {}
    for name, angle in zip(names, np.linspace(-0.4, 0.5, len(names)), strict=True):
        limits = scene.joint(robot.joint_names[name]).limits
        bounded = angle if limits is None else np.clip(angle, *np.asarray(limits))
        angles[name] = float(bounded)

    # Run once: what is quick to compile is quick.
    def measured(scene: dano.Scene):
        state = robot.state(scene, angles)
        frames = scene.frames(state)
        return dano.mass_matrix(scene, state), frames.position, frames.orientation

    # Operations one after the other would be compiled one by one.
    hasty: Callable = eqx.filter_jit
    mass, position, orientation = hasty(measured, compiler_options=_HASTY)(scene)
    children = [joint.child for joint in scene.joints]
    base = 6 * len(scene.layout.free)
    order = [base + scene.layout.coordinates[children.index(robot.joint_names[name])] for name in names]
    return _Posed(
        robot, angles, np.asarray(position), np.asarray(orientation), np.asarray(mass)[np.ix_(order, order)]
    )


def _single(robot: Robot, name: str) -> bool:
    """Whether a joint of the file has one coordinate of its own."""
    kinds = {joint.name: joint.kind for joint in robot.description.joints}
    return name in robot.joint_names and kinds[name] in ("hinge", "slide")


def _from_mujoco(robot: Robot, posing: _Posing, model: mujoco.MjModel) -> float:
    every = [model.joint(j).name for j in range(model.njnt)]
    names = tuple(sorted(name for name in every if name and _single(robot, name)))
    if not names or not robot.bodies:
        return 0.0
    posed = posing(names)
    angles = posed.angles
    data = mujoco.MjData(model)
    for name, angle in angles.items():
        data.joint(name).qpos = angle
    # Joints that follow others are free in a URDF that MuJoCo reads: theirs follow by hand.
    followers = [joint for joint in robot.description.joints if joint.mimics and joint.name in every]
    for joint in followers:
        leader, ratio, shift = joint.mimics or ("", 0.0, 0.0)
        data.joint(joint.name).qpos = ratio * data.joint(leader).qpos + shift
    mujoco.mj_forward(model, data)
    worst = 0.0
    for link in robot.frames:
        if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, link) > 0:
            place = data.body(link).xpos, data.body(link).xmat.reshape(3, 3)
            worst = max(worst, posed.apart(link, *place))
    if followers or model.neq:
        return worst
    mass = np.zeros((model.nv, model.nv))
    for row, unit in zip(mass, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    rows = [int(model.joint(name).dofadr[0]) for name in names]
    return max(worst, posed.masses_apart(mass[np.ix_(rows, rows)]))


def _from_pinocchio(robot: Robot, posing: _Posing, model: Any) -> float:
    pinocchio = importlib.import_module("pinocchio")
    data = model.createData()
    names = tuple(sorted(name for name in list(model.names)[1:] if _single(robot, name)))
    if not names:
        return 0.0
    posed = posing(names)
    angles = posed.angles
    q = pinocchio.neutral(model)
    for name, angle in angles.items():
        k = model.getJointId(name)
        alone = model.nqs[k] == 1
        q[model.idx_qs[k] :][: model.nqs[k]] = angle if alone else [np.cos(angle), np.sin(angle)]
    pinocchio.forwardKinematics(model, data, q)
    pinocchio.updateFramePlacements(model, data)
    mass = pinocchio.crba(model, data, q)
    mass = np.triu(mass) + np.triu(mass, 1).T
    worst = 0.0
    for link in robot.frames:
        # A joint may have the name of a link.
        if model.existFrame(link, pinocchio.FrameType.BODY):
            place = data.oMf[model.getFrameId(link, pinocchio.FrameType.BODY)]
            worst = max(worst, posed.apart(link, place.translation, place.rotation))
    if any(joint.mimics for joint in robot.description.joints):
        return worst
    rows = [model.idx_vs[model.getJointId(name)] for name in names]
    return max(worst, posed.masses_apart(mass[np.ix_(rows, rows)]))
