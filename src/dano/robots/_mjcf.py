"""The robot files of MuJoCo, read by its compiler: defaults, includes and angles are its business."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from dano.maths import quat_conjugate, quat_multiply
from dano.robots._description import Connection, Description, Link, Placed, Solid, Tie

_WORLD = "world"


def read_mjcf(path: Path) -> Description:
    """Read a file of MuJoCo.

    Raises:
        ImportError: If mujoco is missing.
        ValueError: If MuJoCo refuses the file, or it holds what dano has no counterpart of.
    """
    try:
        import mujoco
    except ImportError as error:
        raise ImportError(
            'reading files of MuJoCo needs mujoco: install it with pip install "dano[mujoco]"'
        ) from error
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ValueError(
            f"{path} must be a file that MuJoCo reads: {' '.join(str(error).split())}"
        ) from error
    if model.ntendon:
        raise ValueError(f"{path}: tendons must be left out, dano has none, got {model.ntendon}")
    reader = _Reader(path, model, mujoco)
    links = (Link(_WORLD), *(reader.link(i) for i in range(1, model.nbody)))
    joints = tuple(reader.joint(i) for i in range(1, model.nbody))
    return Description(path.stem, path, links, joints, tuple(reader.ties())).checked()


class _Reader:
    """Reads rows of MuJoCo's model."""

    def __init__(self, path: Path, model: Any, mujoco: Any):
        self.path, self.model, self.mujoco = path, model, mujoco

    def name(self, body: int) -> str:
        return self.model.body(body).name or (_WORLD if body == 0 else f"body {body}")

    def link(self, i: int) -> Link:
        model = self.model
        turn = np.zeros(9)
        self.mujoco.mju_quat2Mat(turn, model.body_iquat[i])
        turn = turn.reshape(3, 3)
        inertia = turn @ np.diag(model.body_inertia[i]) @ turn.T
        first = model.body_geomadr[i]
        found = [self.solid(g) for g in range(first, first + model.body_geomnum[i])]
        solids = tuple(solid for solid, touches in found if solid is not None and touches)
        visuals = tuple(solid for solid, touches in found if solid is not None and not touches)
        mass = float(model.body_mass[i])
        return Link(self.name(i), mass, model.body_ipos[i].copy(), inertia, solids, visuals)

    def solid(self, g: int) -> tuple[Solid | None, bool]:
        """A geom, and whether it touches; meshes and fields of heights have no counterpart and are None."""
        model, types = self.model, self.mujoco.mjtGeom
        place = Placed(tuple(map(float, model.geom_pos[g])), tuple(map(float, model.geom_quat[g])))
        size = tuple(map(float, model.geom_size[g]))
        kinds = {
            int(types.mjGEOM_BOX): ("box", size),
            int(types.mjGEOM_SPHERE): ("sphere", size[:1]),
            int(types.mjGEOM_CYLINDER): ("cylinder", size[:2]),
            int(types.mjGEOM_CAPSULE): ("capsule", size[:2]),
            int(types.mjGEOM_ELLIPSOID): ("ellipsoid", size),
        }
        found = kinds.get(int(model.geom_type[g]))
        touches = bool(model.geom_contype[g] or model.geom_conaffinity[g])
        return (None if found is None else Solid(found[0], found[1], place)), touches

    def joint(self, i: int) -> Connection:
        model = self.model
        count, j = int(model.body_jntnum[i]), int(model.body_jntadr[i])
        place = Placed(tuple(map(float, model.body_pos[i])), tuple(map(float, model.body_quat[i])))
        parent, child = self.name(int(model.body_parentid[i])), self.name(i)
        if count == 0:
            return Connection(f"{child} (fixed)", "weld", parent, child, place)
        if count > 1:
            raise ValueError(
                f"{self.path}: body {child!r} must have one joint, got {count}: give each a body of its own"
            )
        types = self.mujoco.mjtJoint
        kinds = {
            int(types.mjJNT_FREE): "floating",
            int(types.mjJNT_BALL): "ball",
            int(types.mjJNT_SLIDE): "slide",
            int(types.mjJNT_HINGE): "hinge",
        }
        kind, dof = kinds[int(model.jnt_type[j])], int(model.jnt_dofadr[j])
        single = kind in ("hinge", "slide")
        limited = single and bool(model.jnt_limited[j])
        effort = float(model.jnt_actfrcrange[j][1]) if model.jnt_actfrclimited[j] else math.inf
        moved = kind != "floating"
        stiffness = float(np.ravel(model.jnt_stiffness)[j * (np.size(model.jnt_stiffness) // model.njnt)])
        return Connection(
            model.joint(j).name or f"joint of {child}",
            kind,
            parent,
            child,
            place,
            tuple(map(float, model.jnt_axis[j])),
            tuple(map(float, model.jnt_pos[j])) if moved else (0.0, 0.0, 0.0),
            limits=(float(model.jnt_range[j][0]), float(model.jnt_range[j][1])) if limited else None,
            effort=effort,
            damping=float(np.ravel(model.dof_damping[dof])[0]) if moved else 0.0,
            friction=float(model.dof_frictionloss[dof]) if moved else 0.0,
            armature=float(model.dof_armature[dof]) if moved else 0.0,
            stiffness=stiffness if single else 0.0,
            rest=float(model.qpos_spring[model.jnt_qposadr[j]]) if single else 0.0,
            mimics=self.leader(j),
        )

    def ties(self) -> list[Tie]:
        """What `connect` and `weld` hold together."""
        model, types = self.model, self.mujoco.mjtEq
        kinds = {int(types.mjEQ_CONNECT): "point", int(types.mjEQ_WELD): "weld"}
        found = []
        for e in range(model.neq):
            kind = kinds.get(int(model.eq_type[e]))
            if kind is None or not model.eq_active0[e]:
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

    def leader(self, j: int) -> tuple[str, float, float] | None:
        """What an equality of joints says that a joint follows, if it is linear."""
        model = self.model
        for e in range(model.neq):
            same = int(model.eq_type[e]) == int(self.mujoco.mjtEq.mjEQ_JOINT)
            if not same or int(model.eq_obj1id[e]) != j or int(model.eq_obj2id[e]) < 0:
                continue
            shift, ratio, *rest = (float(x) for x in model.eq_data[e][:5])
            if any(rest):
                raise ValueError(
                    f"{self.path}: joint {model.joint(j).name!r} must follow another linearly, got polynomial"
                    f" {[shift, ratio, *rest]}"
                )
            return model.joint(int(model.eq_obj2id[e])).name, ratio, shift
        return None
