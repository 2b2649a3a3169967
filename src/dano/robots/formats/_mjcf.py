"""The robot files of MuJoCo, read by its compiler: defaults, includes and angles are its business.

States that files of MuJoCo name.
Which shapes of MuJoCo's files touch which, and with what friction: its own rules.

Two geoms touch where their masks say so, unless they are parts of one body or of neighbours, or their bodies
are excluded; or where a pair names them (MuJoCo's documentation, "Collision detection", "Selection").
Actuators of MuJoCo's files as drives of joints, where a motor of dano does the same.
"""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dano.extras import optional
from dano.maths import quat_conjugate, quat_log, quat_multiply
from dano.robots.formats._description import (
    Connection,
    Description,
    displaced,
    Drive,
    GeomPair,
    held_at,
    Keyframe,
    Lacking,
    Link,
    Placed,
    Solid,
    Tie,
    without_followers,
)
from dano.robots.formats._lacking import EQUALITIES, lacking_of, notes_of, silent_of
from dano.robots.formats._tendons import length_of, shares_of, Tendons, with_loads_of_followers, within


def keyframes_of(
    model: Any, mujoco: Any, joints: Sequence[str], bodies: Sequence[str]
) -> dict[str, Keyframe]:
    """All key frames by name; those without one are "key 0" and so on.

    Args:
        model: Of MuJoCo.
        mujoco: The package.
        joints: Names of the joints.
        bodies: Names of the bodies after the world.
    """
    types, found = mujoco.mjtJoint, {}
    for k in range(model.nkey):
        frame = Keyframe({}, {}, {}, {})
        for j, name in enumerate(joints):
            kind, place, row = (int(x[j]) for x in (model.jnt_type, model.jnt_qposadr, model.jnt_dofadr))
            q, v = model.key_qpos[k, place:].copy(), model.key_qvel[k, row:].copy()
            if kind == int(types.mjJNT_FREE):
                body = bodies[int(model.jnt_bodyid[j]) - 1]
                frame.places[body] = q[:3], q[3:7] / np.linalg.norm(q[3:7])
                frame.speeds[body] = v[:3], v[3:6]
            elif kind == int(types.mjJNT_BALL):
                frame.q[name] = np.asarray(quat_log(q[:4] / np.linalg.norm(q[:4])))
                frame.v[name] = v[:3]
            else:
                frame.q[name], frame.v[name] = q[0], v[0]
        found[model.key(k).name or f"key {k}"] = frame
    return found


def meets_of(
    model: Any, mujoco: Any, links: Sequence[str]
) -> tuple[dict[frozenset[str], GeomPair], list[str]]:
    """Who touches whom, and what of that is read otherwise than MuJoCo does, one line each.

    Args:
        model: MuJoCo's model.
        mujoco: The library.
        links: The link of each geom.
    """
    disabled = int(model.opt.disableflags)
    bits = mujoco.mjtDisableBit
    if disabled & (int(bits.mjDSBL_CONTACT) | int(bits.mjDSBL_CONSTRAINT)):
        return {}, []
    may = _may_touch(model, filters_parents=not disabled & int(bits.mjDSBL_FILTERPARENT))
    friction = _mixed_friction(model)
    named = np.zeros_like(may)
    for k in range(model.npair):
        i, j = int(model.pair_geom1[k]), int(model.pair_geom2[k])
        slides = float(model.pair_friction[k][0]) if model.pair_dim[k] > 1 else 0.0
        for pair in ((i, j), (j, i)):
            may[pair] = named[pair] = True
            friction[pair] = slides
    if int(model.opt.enableflags) & int(mujoco.mjtEnableBit.mjENBL_OVERRIDE):
        friction = np.where(friction > 0, float(model.opt.o_friction[0]), 0.0)
    found: dict[frozenset[str], GeomPair] = {}
    rows = {name: np.flatnonzero(np.array(links) == name) for name in dict.fromkeys(links)}
    touching = np.asarray(may.any(axis=1))
    parted = []
    names = [name for name, geoms in rows.items() if touching[geoms].any()]
    for k, first in enumerate(names):
        for second in names[k + 1 :]:
            block = np.ix_(rows[first], rows[second])
            if not may[block].any():
                continue
            slides = tuple(np.unique(friction[block][may[block]]).tolist())
            found[frozenset((first, second))] = GeomPair(slides, bool(named[block].any()))
            both = np.ix_(rows[first][touching[rows[first]]], rows[second][touching[rows[second]]])
            if not may[both].all():
                parted.append(f"{first} and {second}")
    said = []
    if parted:
        shown = ", ".join(parted[:3]) + (f" and {len(parted) - 3} more" if len(parted) > 3 else "")
        said.append(f"that only some shapes of {shown} touch each other: in dano all of a link do")
    return found, said


def touching_geoms(model: Any) -> Bool[np.ndarray, " g"]:
    """Whether each geom can touch anything: by its masks, or because a pair names it."""
    touches = (np.asarray(model.geom_contype) != 0) | (np.asarray(model.geom_conaffinity) != 0)
    touches[np.asarray(model.pair_geom1, int)] = True
    touches[np.asarray(model.pair_geom2, int)] = True
    return touches


def _may_touch(model: Any, *, filters_parents: bool) -> Bool[np.ndarray, "g g"]:
    """By masks, bodies and exclusions."""
    kinds, others = np.asarray(model.geom_contype), np.asarray(model.geom_conaffinity)
    may = (kinds[:, None] & others[None, :]) | (kinds[None, :] & others[:, None])
    body = np.asarray(model.geom_bodyid)
    welded = np.asarray(model.body_weldid)
    own = welded[body]
    above = welded[np.asarray(model.body_parentid)[own]]
    may = (may != 0) & (own[:, None] != own[None, :])
    if filters_parents:
        moves = (own[:, None] != 0) & (own[None, :] != 0)
        near = (own[:, None] == above[None, :]) | (own[None, :] == above[:, None])
        may &= ~(moves & near)
    for signature in np.asarray(model.exclude_signature, int):
        first, second = signature >> 16, signature & 0xFFFF
        one, other = body == first, body == second
        may &= ~((one[:, None] & other[None, :]) | (other[:, None] & one[None, :]))
    return may


def _mixed_friction(model: Any) -> Float[np.ndarray, "g g"]:
    """Sliding friction of two geoms: that of the higher priority, of equal ones the larger."""
    sliding, priority = np.asarray(model.geom_friction, float)[:, 0], np.asarray(model.geom_priority)
    dims = np.asarray(model.geom_condim)
    above, below = priority[:, None] > priority[None, :], priority[:, None] < priority[None, :]

    def mixed(values: np.ndarray) -> np.ndarray:
        first, second = values[:, None] + 0 * values[None, :], values[None, :] + 0 * values[:, None]
        return np.where(above, first, np.where(below, second, np.maximum(first, second)))

    return np.where(mixed(dims) > 1, mixed(sliding), 0.0)


ALL, OTHER = "actuators", "other actuators"
"""Names by which all of them are left out, or those that dano has no counterpart of."""


class Pull(NamedTuple):
    """A drive of several joints: its length is the sum of their coordinates by their shares."""

    drive: Drive  # The drive
    shares: dict[int, float]  # By the indices of the joints


def drives_of(model: Any, mujoco: Any) -> tuple[dict[int, Drive], list[Pull], list[Lacking]]:
    """The drives by the index of their joint, those of fixed tendons, and what no motor does.

    MuJoCo's force is gain · u + bias, with constant, place and speed in the bias (its documentation,
    "Force generation"); `dano.Motor` has those of a motor, and of servos that hold a place or a speed.
    """
    found: dict[int, Drive] = {}
    pulls: list[Pull] = []
    lacking: list[Lacking] = []
    if _disabled(model, mujoco, "mjDSBL_ACTUATION"):
        return found, pulls, lacking
    for i in range(model.nactuator if hasattr(model, "nactuator") else model.nu):
        name = model.actuator(i).name or f"actuator {i}"
        if int(model.opt.disableactuator) >> int(model.actuator_group[i]) & 1:
            continue
        joint = int(model.actuator_trnid[i][0])
        shares = _shares(model, mujoco, i)
        why = _unlike(model, mujoco, i)
        if why is None and shares is None and joint in found:
            why = f"drives joint {model.joint(joint).name!r}, which {found[joint].name!r} drives already"
        if why is not None:
            lacking.append(Lacking(OTHER, f"actuator {name!r} {why}, which dano has no motor for"))
            continue
        drive = _drive(model, mujoco, i, name)
        if isinstance(drive, str):
            lacking.append(Lacking(OTHER, f"actuator {name!r} {drive}, which dano has no motor for"))
        elif drive is not None and shares is not None:
            pulls.append(Pull(drive, shares))
        elif drive is not None:
            found[joint] = drive
    return found, pulls, lacking


def _shares(model: Any, mujoco: Any, i: int) -> dict[int, float] | None:
    """Shares of joints in the length of a fixed tendon that an actuator pulls; None for none."""
    if int(model.actuator_trntype[i]) != int(mujoco.mjtTrn.mjTRN_TENDON):
        return None
    return shares_of(model, mujoco, int(model.actuator_trnid[i][0]))


def _disabled(model: Any, mujoco: Any, flag: str) -> bool:
    return bool(int(model.opt.disableflags) & int(getattr(mujoco.mjtDisableBit, flag)))


def _unlike(model: Any, mujoco: Any, i: int) -> str | None:
    """Why an actuator is not a motor of one joint; None if it is."""
    joints = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT
    shares = _shares(model, mujoco, i)
    if shares is None and int(model.actuator_trntype[i]) not in map(int, joints):
        return "acts on no joint, but on a tendon of sites, a site or a body"
    kinds = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
    moved = [int(model.actuator_trnid[i][0])] if shares is None else list(shares)
    if any(int(model.jnt_type[j]) not in map(int, kinds) for j in moved):
        return "acts on a ball or a free joint"
    if int(model.actuator_dyntype[i]) != int(mujoco.mjtDyn.mjDYN_NONE):
        return "has a state of its own (a filter, an integrator, a muscle)"
    for name in ("actuator_armature", "actuator_damping", "actuator_delay"):
        if np.any(getattr(model, name, np.zeros((i + 1, 1)))[i]):
            return f"has {name.removeprefix('actuator_')}"
    if int(getattr(model, "actuator_plugin", np.full(i + 1, -1))[i]) >= 0:
        return "is a plugin"
    plain = int(model.actuator_gaintype[i]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    biases = mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE
    if not plain or int(model.actuator_biastype[i]) not in map(int, biases):
        return "has a gain or a bias that depends on more than place and speed"
    return None


def _drive(model: Any, mujoco: Any, i: int, name: str) -> Drive | str | None:
    """The drive, None for one without effect, or what is special about it."""
    gain, gear = float(model.actuator_gainprm[i][0]), float(model.actuator_gear[i][0])
    affine = int(model.actuator_biastype[i]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
    constant, place, speed = (float(x) for x in model.actuator_biasprm[i][:3]) if affine else (0.0,) * 3
    forces = _range(model.actuator_forcerange[i], model.actuator_forcelimited[i])
    clamped = not _disabled(model, mujoco, "mjDSBL_CLAMPCTRL")
    commands = _range(model.actuator_ctrlrange[i], clamped and model.actuator_ctrllimited[i])
    if gear == 0 or gain == constant == place == speed == 0:
        return None
    if constant == place == speed == 0:
        # f = gain · u within limits: that of a motor whose gear has the gain, within theirs by the gain.
        bounds = np.sort(np.array(forces) / gain)
        least, most = max(bounds[0], commands[0]), min(bounds[1], commands[1])
        if least > most:
            return "has limits of force and command that exclude each other"
        return Drive(name, "effort", gear=gear * gain, limits=(float(least), float(most)), commands=commands)
    if constant == 0 and gain > 0 and place == -gain and speed <= 0:
        return Drive(name, "position", gain, -speed, gear, forces, commands)
    if constant == place == 0 and gain > 0 and speed == -gain:
        return Drive(name, "velocity", 0.0, gain, gear, forces, commands)
    return f"has the force {gain:g} u + {constant:g} + {place:g} l + {speed:g} dl/dt"


def _range(values: np.ndarray, limited: Any) -> tuple[float, float]:
    return (float(values[0]), float(values[1])) if limited else (-np.inf, np.inf)


_WORLD = "world"
_SHIFTED = 1e-9
"""Shift of a coordinate that a servo would pull to another place by [rad or m]."""
_CONSTRAINTS = ("EQUALITY", "FRICTIONLOSS", "LIMIT", "CONTACT")


def read_mjcf(path: Path, *, balance_inertia: bool = False) -> Description:
    """Read a file of MuJoCo.

    Coordinates are MuJoCo's own: those of a joint with `ref` are `ref` in the pose of the file. A body with
    several joints becomes a chain of links, of which the last has the body's mass and shapes.

    Args:
        path: The file.
        balance_inertia: Whether the compiler makes impossible inertias possible (its `balanceinertia`).

    Raises:
        ImportError: If mujoco is missing.
        ValueError: If MuJoCo refuses the file.
    """
    mujoco = optional("mujoco", "reading files of MuJoCo needs mujoco", "robots")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        spec.compiler.balanceinertia = spec.compiler.balanceinertia or balance_inertia
        # Links that fixed joints hold keep their names, and what is only seen is drawn.
        spec.compiler.fusestatic = spec.compiler.discardvisual = False
        model = spec.compile()
    except (ValueError, RuntimeError) as error:
        hint = ": balance_inertia=True does that" if "balanceinertia" in str(error) else ""
        said = " ".join(str(error).split())
        raise ValueError(f"{path} must be a file that MuJoCo reads: {said}{hint}") from error
    return _MjcfReader(path, model, mujoco).description()


class _MjcfReader:
    """Reads rows of MuJoCo's model."""

    def __init__(self, path: Path, model: Any, mujoco: Any):
        self.path, self.model, self.mujoco = path, model, mujoco
        self.drives, self.pulls, self.undriven = drives_of(model, mujoco)
        self.bodies = self.unique([model.body(i).name or f"body {i}" for i in range(1, model.nbody)])
        self.joints = self.unique([self.joint_name(j) for j in range(model.njnt)])
        self.lacking = [*lacking_of(model, mujoco), *self.undriven]
        self.held: dict[str, float] = {}
        self.touching = touching_geoms(model)
        self.owners = [self.name(int(body)) for body in model.geom_bodyid]

    def description(self) -> Description:
        model = self.model
        links, joints = [Link(_WORLD)], []
        taken = {_WORLD, *self.bodies}
        for g in range(model.body_geomnum[0]):
            # What stands in the world: each shape is a thing of its own.
            solid, touches = self.solid(g)
            if solid is None:
                continue
            name = model.geom(g).name or f"world geom {g}"
            while name in taken:
                name += " geom"
            taken.add(name)
            links.append(self.shaped(Link(name), [(solid, touches)]))
            self.owners[g] = name
            joints.append(Connection(f"{name} (fixed)", "weld", _WORLD, name))
        for i in range(1, model.nbody):
            chain = self.chain(i)
            links += [Link(joint.child) for joint in chain[:-1]]
            links.append(self.link(i))
            joints += chain
        joints = self.driven(self.tied(joints))
        meets, parted = meets_of(model, self.mujoco, self.owners)
        x, y, z = (0.0, 0.0, 0.0) if self.off("GRAVITY") else map(float, model.opt.gravity)
        ties = () if self.off("EQUALITY") else tuple(self.ties())
        return Description(
            self.path.stem,
            self.path,
            tuple(links),
            tuple(joints),
            ties,
            world=_WORLD,
            gravity=(x, y, z),
            lacking=tuple(self.lacking),
            notes=tuple(notes_of(model)),
            keyframes=keyframes_of(model, self.mujoco, self.joints, self.bodies),
            meets=meets,
            silent=(*silent_of(model, self.mujoco, self.touching), *parted),
        ).checked()

    def off(self, flag: str) -> bool:
        """Whether the file switches something off."""
        # All constraints go with one flag.
        flags = [flag, *(["CONSTRAINT"] if flag in _CONSTRAINTS else [])]
        bits = [int(getattr(self.mujoco.mjtDisableBit, f"mjDSBL_{name}")) for name in flags]
        return any(int(self.model.opt.disableflags) & bit for bit in bits)

    def unique(self, names: list[str]) -> list[str]:
        """Names given by us must not be those of the file."""
        return [name if names.count(name) == 1 else f"{name} ({i})" for i, name in enumerate(names)]

    def name(self, body: int) -> str:
        return _WORLD if body == 0 else self.bodies[body - 1]

    def joint_name(self, j: int) -> str:
        model = self.model
        own = int(model.jnt_bodyid[j])
        body = model.body(own).name or f"body {own}"
        alone = int(model.body_jntnum[own]) == 1
        return model.joint(j).name or (f"joint of {body}" if alone else f"joint {j} of {body}")

    def link(self, i: int) -> Link:
        model = self.model
        turn = np.zeros(9)
        self.mujoco.mju_quat2Mat(turn, model.body_iquat[i])
        turn = turn.reshape(3, 3)
        inertia = turn @ np.diag(model.body_inertia[i]) @ turn.T
        first = model.body_geomadr[i]
        found = [self.solid(g) for g in range(first, first + model.body_geomnum[i])]
        mass = float(model.body_mass[i])
        held = 0.0 if self.off("GRAVITY") else float(model.body_gravcomp[i])
        link = Link(self.name(i), mass, model.body_ipos[i].copy(), inertia, gravcomp=held)
        return self.shaped(link, found)

    @staticmethod
    def shaped(link: Link, found: list[tuple[Solid | None, bool]]) -> Link:
        solids = tuple(solid for solid, touches in found if solid is not None and touches)
        visuals = tuple(solid for solid, touches in found if solid is not None and not touches)
        return dataclasses.replace(link, solids=solids, visuals=visuals)

    def solid(self, g: int) -> tuple[Solid | None, bool]:
        """A geom, and whether it touches; fields of heights have no counterpart and are None."""
        model, types = self.model, self.mujoco.mjtGeom
        place = Placed(tuple(map(float, model.geom_pos[g])), tuple(map(float, model.geom_quat[g])))
        size, kind = tuple(map(float, model.geom_size[g])), int(model.geom_type[g])
        touches = bool(self.touching[g]) and not self.off("CONTACT")
        if kind == int(types.mjGEOM_MESH):
            return Solid(
                "mesh", (1.0,) * 3, place, triangles=self.triangles(int(model.geom_dataid[g]))
            ), touches
        kinds = {
            int(types.mjGEOM_PLANE): ("plane", ()),
            int(types.mjGEOM_BOX): ("box", size),
            int(types.mjGEOM_SPHERE): ("sphere", size[:1]),
            int(types.mjGEOM_CYLINDER): ("cylinder", size[:2]),
            int(types.mjGEOM_CAPSULE): ("capsule", size[:2]),
            int(types.mjGEOM_ELLIPSOID): ("ellipsoid", size),
        }
        found = kinds.get(kind)
        return (None if found is None else Solid(found[0], found[1], place)), touches

    def triangles(self, mesh: int) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and faces as the compiler has placed and scaled them."""
        model = self.model
        vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
        faces = model.mesh_face[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]]
        return np.array(vertices, np.float64), np.array(faces)

    def chain(self, i: int) -> list[Connection]:
        """The joints of a body one after the other; a weld if it has none."""
        model = self.model
        place = Placed(tuple(map(float, model.body_pos[i])), tuple(map(float, model.body_quat[i])))
        parent, child = self.name(int(model.body_parentid[i])), self.name(i)
        first, count = int(model.body_jntadr[i]), int(model.body_jntnum[i])
        if count == 0:
            return [Connection(f"{child} (fixed)", "weld", parent, child, place)]
        found = []
        for j in range(first, first + count):
            last = j == first + count - 1
            on = child if last else f"{child} after {self.joints[j]}"
            found.append(self.joint(j, parent, on, place))
            # MuJoCo turns the body by one joint after the other, each in the frame that the others left.
            parent, place = on, Placed()
        return found

    def joint(self, j: int, parent: str, child: str, place: Placed) -> Connection:
        model, types = self.model, self.mujoco.mjtJoint
        kinds = {
            int(types.mjJNT_FREE): "floating",
            int(types.mjJNT_BALL): "ball",
            int(types.mjJNT_SLIDE): "slide",
            int(types.mjJNT_HINGE): "hinge",
        }
        kind, dof = kinds[int(model.jnt_type[j])], int(model.jnt_dofadr[j])
        laws: dict[str, Any] = {
            "damping": 0.0 if self.off("DAMPER") else float(model.dof_damping[dof]),
            "friction": 0.0 if self.off("FRICTIONLOSS") else float(model.dof_frictionloss[dof]),
            "armature": float(model.dof_armature[dof]),
            "stiffness": 0.0 if self.off("SPRING") else float(np.ravel(model.jnt_stiffness[j])[0]),
        }
        if kind == "floating":
            return Connection(self.joints[j], kind, parent, child, place, **laws)
        single = kind in ("hinge", "slide")
        limited = single and bool(model.jnt_limited[j]) and not self.off("LIMIT")
        least, most = map(float, model.jnt_actfrcrange[j])
        efforts = (least, most) if model.jnt_actfrclimited[j] else (-math.inf, math.inf)
        address = int(model.jnt_qposadr[j])
        found = Connection(
            self.joints[j],
            kind,
            parent,
            child,
            place,
            tuple(map(float, model.jnt_axis[j])),
            tuple(map(float, model.jnt_pos[j])),
            limits=(float(model.jnt_range[j][0]), float(model.jnt_range[j][1])) if limited else None,
            efforts=efforts,
            **laws,
            rest=float(model.qpos_spring[address]) if single else 0.0,
            home=float(model.qpos0[address]) if single else 0.0,
            drive=self.drives.get(j),
        )
        if not found.home:
            return found
        # The file shows the pose at q = ref; a joint says where its child is at q = 0.
        return dataclasses.replace(found, place=displaced(found, -found.home))

    def tied(self, joints: list[Connection]) -> list[Connection]:
        """The joints with what equalities and fixed tendons do to them."""
        tendons = Tendons(self.model, self.mujoco, self.joints, self.off)
        joints = tendons.coupled(self.followed(joints), self.held)
        joints, crossed = with_loads_of_followers(joints)
        joints = tendons.acting(joints, self.held)
        self.lacking += [*tendons.lacking, *crossed]
        return joints

    def followed(self, joints: list[Connection]) -> list[Connection]:
        """The joints with what equalities say of them: they follow others, or stay where they are."""
        model = self.model
        if self.off("EQUALITY"):
            return joints
        rows = {joint.name: row for row, joint in enumerate(joints)}
        homes = {joint.name: joint.home for joint in joints}
        joints, done = list(joints), set()
        for e in range(model.neq):
            if int(model.eq_type[e]) != int(self.mujoco.mjtEq.mjEQ_JOINT) or not model.eq_active0[e]:
                continue
            j, leader = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
            name, row = self.joints[j], rows[self.joints[j]]
            shift, ratio, *rest = (float(x) for x in model.eq_data[e][:5])
            if any(rest) or joints[row].kind not in ("hinge", "slide") or name in done:
                kind = f"the polynomial {[shift, ratio, *rest]}" if any(rest) else "more than one equality"
                text = f"joint {name!r} follows {kind}: dano has linear ones"
                self.lacking.append(Lacking(EQUALITIES, text))
                continue
            done.add(name)
            # Polynomials are of the distances from the pose of the file.
            if leader < 0:
                self.held[name] = homes[name] + shift
                joints[row] = held_at(joints[row], self.held[name])
                continue
            shift += homes[name] - ratio * homes[self.joints[leader]]
            joints[row] = dataclasses.replace(joints[row], mimics=(self.joints[leader], ratio, shift))
        return without_followers(joints, self.held)

    def driven(self, joints: list[Connection]) -> list[Connection]:
        """The joints with the drives of tendons, and of those that follow, on the joint that leads them."""
        rows = {joint.name: row for row, joint in enumerate(joints)}
        joints, pulls = list(joints), list(self.pulls)
        for row, joint in enumerate(joints):
            if joint.drive is not None and joint.mimics is not None:
                # What the joint lets through of it stays with the drive.
                ends = sorted(effort / joint.drive.gear for effort in joint.efforts)
                limits = within(joint.drive.limits, (ends[0], ends[1]))
                drive = joint.drive if limits is None else dataclasses.replace(joint.drive, limits=limits)
                pulls.append(Pull(drive, {self.joints.index(joint.name): 1.0}))
                joints[row] = dataclasses.replace(joint, drive=None)
        for drive, shares in pulls:
            ratios, shift = length_of({self.joints[j]: x for j, x in shares.items()}, joints, self.held)
            name, ratio = next(iter(ratios.items()), ("", 0.0))
            leader = joints[rows[name]] if len(ratios) == 1 else None
            why = None
            if leader is None:
                several = "several joints, of which none leads the others"
                why = several if ratios else "joints that do not move"
            elif leader.kind not in ("hinge", "slide"):
                why = "joints that do not move"
            elif leader.drive is not None:
                why = f"joint {leader.name!r}, which {leader.drive.name!r} drives already"
            elif drive.kind == "position" and abs(shift) > _SHIFTED:
                why = "a joint that follows another with a shift"
            if why is not None or leader is None:
                text = f"actuator {drive.name!r} drives {why} (tendon or equality)"
                self.lacking.append(Lacking(OTHER, text))
                continue
            moved = dataclasses.replace(drive, gear=drive.gear * ratio)
            joints[rows[leader.name]] = dataclasses.replace(leader, drive=moved)
        return joints

    def ties(self) -> list[Tie]:
        """What `connect` and `weld` hold together."""
        model, types = self.model, self.mujoco.mjtEq
        kinds = {int(types.mjEQ_CONNECT): "point", int(types.mjEQ_WELD): "weld"}
        scalar = {int(types.mjEQ_JOINT), int(types.mjEQ_TENDON)}
        found = []
        for e in range(model.neq):
            if not model.eq_active0[e] or int(model.eq_type[e]) in scalar:
                continue
            kind = kinds.get(int(model.eq_type[e]))
            if kind is None:
                name = model.equality(e).name or f"equality {e}"
                text = f"{name!r} ties soft bodies: dano ties joints and bodies"
                self.lacking.append(Lacking(EQUALITIES, text))
                continue
            ends = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
            data = model.eq_data[e]
            if int(model.eq_objtype[e]) == int(self.mujoco.mjtObj.mjOBJ_SITE):
                place = [model.site_pos[s] for s in ends]
                turn = quat_multiply(model.site_quat[ends[0]], quat_conjugate(model.site_quat[ends[1]]))
                ends = tuple(int(model.site_bodyid[s]) for s in ends)
            elif kind == "point":
                place, turn = [data[:3], data[3:6]], np.eye(4)[0]
            else:
                place, turn = [data[3:6], data[:3]], data[6:10]
            turn = np.asarray(turn, float) if kind == "weld" else np.eye(4)[0]
            position, anchor, turned = (tuple(map(float, x)) for x in (*place, turn))
            first, second = (self.name(i) for i in ends)
            found.append(Tie(kind, first, second, position, anchor, turned))
        return found
