"""The robot files of MuJoCo, read by its compiler: defaults, includes and angles are its business."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np

from dano.extras import optional
from dano.maths import quat_conjugate, quat_multiply
from dano.robots.formats._actuators import drives_of, OTHER, Pull
from dano.robots.formats._description import (
    Connection,
    Description,
    displaced,
    held_at,
    Lacking,
    Link,
    Placed,
    Solid,
    Tie,
    without_followers,
)
from dano.robots.formats._keyframes import keyframes_of
from dano.robots.formats._lacking import EQUALITIES, lacking_of, notes_of, silent_of
from dano.robots.formats._tendons import length_of, Tendons, with_loads_of_followers, within
from dano.robots.formats._touching import meets_of, touching_geoms

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
    return _Reader(path, model, mujoco).description()


class _Reader:
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
