"""A scene as an `MjSpec`: bodies in their trees, joints, loops, motors and shapes."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from dano.exchange import solid_triangles
from dano.fields import AbstractShape, Box, Capsule, Cylinder, Ellipsoid, HalfSpace, PosedShape, Sphere
from dano.maths import quat_multiply, quat_to_matrix
from dano.objects import NeuralObject
from dano.scene import Body, Joint, plane_axes, Scene

AS_SAMPLES, AS_HULL, AS_DISTANCE = "samples", "hull", "distance"
TOUCHES = (AS_SAMPLES, AS_HULL, AS_DISTANCE)
"""As what neural objects touch."""
FOLLOWS = (0.999, 0.999, 0.001, 0.5, 2.0)
"""Impedance of what ties a joint to the one that it mimics, and closes loops: nearly rigid (MuJoCo's largest
is 0.9999)."""
_MESH_NODES = 40
"""Along the longest side of the mesh of an object (chosen: a hull of some hundred faces)."""


def spec_of(mujoco: Any, scene: Scene) -> Any:
    """The scene, without what neural objects touch with; see `Twin` for what is written later.

    Body frames are ours: axes of the field frame at the centre of mass.

    Raises:
        ValueError: If a shape is not a geom of MuJoCo's.
    """
    spec = mujoco.MjSpec()
    # With the default integrator bodies that tumble gain energy without limit.
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICIT
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10.0
    spec.option.timestep = float(scene.timestep)
    # Which pairs touch is said by the scene, also of neighbours in a tree.
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)
    added: dict[str | None, Any] = {None: spec.worldbody}
    for body, joint in _outwards(scene):
        if joint is None:
            made = spec.worldbody.add_body(name=body.name)
            if not body.fixed:
                made.add_freejoint()
        else:
            made = _hung(mujoco, scene, body, joint, added)
        added[body.name] = made
        if body.shape is not None:
            kind, size, place, turn = _geom(mujoco, body.shape, body.name)
            made.add_geom(
                name=body.name,
                type=kind,
                size=size,
                pos=place - _middle(body),
                quat=turn,
                contype=0,
                conaffinity=0,
            )
    _add_motors(mujoco, spec, scene)
    _add_loops(mujoco, spec, scene, added)
    return spec


def add_mesh(mujoco: Any, spec: Any, body: Body, obj: NeuralObject, touch: str) -> None:
    """Give a neural object's body a mesh of its solid, which MuJoCo takes as hull or as signed distance.

    Raises:
        ValueError: If the object has no solid.
    """
    if obj.solid is None:
        raise ValueError(f"body {body.name!r} must have a solid to touch as its {touch}, it has none")
    mesh, _ = solid_triangles(obj.solid, _MESH_NODES)
    spec.add_mesh(
        name=body.name,
        uservert=mesh.vertices.ravel().tolist(),
        userface=mesh.faces.ravel().tolist(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    kind = mujoco.mjtGeom.mjGEOM_MESH if touch == AS_HULL else mujoco.mjtGeom.mjGEOM_SDF
    made = next(each for each in spec.bodies if each.name == body.name)
    made.add_geom(
        name=body.name,
        type=kind,
        meshname=body.name,
        pos=-_middle(body),
        contype=0,
        conaffinity=0,
    )


def weigh_later(spec: Any) -> None:
    """Give all bodies a mass from which MuJoCo's compiler concludes nothing: true ones come with a state."""
    for body in spec.bodies[1:]:
        body.mass, body.ipos, body.explicitinertial = 1.0, np.zeros(3), True
        body.fullinertia = [2, 3, 4, 0.1, 0.2, 0.3]


def joint_names(joint: Joint) -> tuple[str, ...]:
    """Names of the joints of MuJoCo's that stand for a joint: none for a weld, three for a planar one."""
    count = {"weld": 0, "planar": 3}.get(joint.kind, 1)
    return tuple(f"{joint.child}:{k}" for k in range(count))


def motor_name(joint: Joint) -> str:
    """Name of the actuator of a joint's motor."""
    return f"{joint.child}:motor"


def _outwards(scene: Scene) -> Iterator[tuple[Body, Joint | None]]:
    """Bodies and the joints they hang on, each after the one that carries it."""
    hangs = {joint.child: joint for joint in scene.joints}
    known: set[str | None] = {None}
    waiting = list(scene.bodies)
    while waiting:
        ready = [body for body in waiting if body.name not in hangs or hangs[body.name].parent in known]
        for body in ready:
            yield body, hangs.get(body.name)
        known |= {body.name for body in ready}
        waiting = [body for body in waiting if body.name not in known]


def _hung(mujoco: Any, scene: Scene, body: Body, joint: Joint, added: dict[str | None, Any]) -> Any:
    """The body of MuJoCo's on its parent, with joints at q = 0."""
    turn = np.asarray(joint.orientation, np.float64)
    middle, place = _middle(body), np.asarray(joint.position, np.float64)
    if joint.parent is not None:
        place = place - _middle(scene.body(joint.parent))
    place = place + np.asarray(quat_to_matrix(turn), np.float64) @ middle
    made = added[joint.parent].add_body(name=body.name, pos=place, quat=turn)
    types = mujoco.mjtJoint
    axis, anchor = np.asarray(joint.axis, np.float64), np.asarray(joint.anchor, np.float64) - middle
    parts = {
        "hinge": [(types.mjJNT_HINGE, axis)],
        "slide": [(types.mjJNT_SLIDE, axis)],
        "ball": [(types.mjJNT_BALL, axis)],
        "weld": [],
    }
    if joint.kind == "planar":
        first, second = np.asarray(plane_axes(joint.axis[None]), np.float64)[0]
        parts["planar"] = [
            (types.mjJNT_SLIDE, first),
            (types.mjJNT_SLIDE, second),
            (types.mjJNT_HINGE, axis),
        ]
    for name, (kind, along) in zip(joint_names(joint), parts[joint.kind], strict=True):
        limited = (
            mujoco.mjtLimited.mjLIMITED_FALSE if joint.limits is None else mujoco.mjtLimited.mjLIMITED_TRUE
        )
        made.add_joint(name=name, type=kind, axis=along, pos=anchor, limited=limited, range=[-1.0, 1.0])
    return made


def _add_motors(mujoco: Any, spec: Any, scene: Scene) -> None:
    """Actuators, and what ties joints to those that they mimic; the numbers of motors are written later."""
    by_child = {joint.child: joint for joint in scene.joints}
    for joint in scene.joints:
        if joint.mimics:
            (own,), (lead,) = joint_names(joint), joint_names(by_child[joint.mimics])
            tie = spec.add_equality(
                type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT, name1=own, name2=lead
            )
            # The compiler reads five numbers of a polynomial; the field holds more.
            tie.data[:2] = float(joint.shift), float(joint.ratio)
            tie.solimp = FOLLOWS
        if joint.motor is not None:
            spec.add_actuator(
                name=motor_name(joint),
                target=joint_names(joint)[0],
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                gaintype=mujoco.mjtGain.mjGAIN_FIXED,
                biastype=mujoco.mjtBias.mjBIAS_AFFINE,
                forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
                forcerange=[-1.0, 1.0],
            )


def _add_loops(mujoco: Any, spec: Any, scene: Scene, added: dict[str | None, Any]) -> None:
    """Equalities of sites: those of bodies would be closed where the joints are at zero."""
    kinds = {"point": mujoco.mjtEq.mjEQ_CONNECT, "weld": mujoco.mjtEq.mjEQ_WELD}
    for k, loop in enumerate(scene.loops):
        ends = (
            (loop.first, loop.position, np.asarray(loop.orientation, np.float64)),
            (loop.second, loop.anchor, np.array([1.0, 0.0, 0.0, 0.0])),
        )
        names = (f"loop {k}:0", f"loop {k}:1")
        for name, (body, place, turn) in zip(names, ends, strict=True):
            middle = np.zeros(3) if body is None else _middle(scene.body(body))
            added[body].add_site(name=name, pos=np.asarray(place, np.float64) - middle, quat=turn)
        tie = spec.add_equality(
            type=kinds[loop.kind], objtype=mujoco.mjtObj.mjOBJ_SITE, name1=names[0], name2=names[1]
        )
        tie.solimp = FOLLOWS


def _middle(body: Body) -> Float[np.ndarray, "3"]:
    """Centre of mass [m, F]."""
    return np.asarray(body.centre_of_mass, np.float64)


def _geom(mujoco: Any, shape: AbstractShape, name: str):
    """MuJoCo's type, size, place and turn of a shape.

    Raises:
        ValueError: If MuJoCo has no such geom.
    """
    types, still, upright = mujoco.mjtGeom, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    if isinstance(shape, PosedShape):
        kind, size, place, turn = _geom(mujoco, shape.shape, name)
        pose = shape.pose
        rotation, shift = np.asarray(quat_to_matrix(pose.orientation)), np.asarray(pose.position)
        return kind, size, rotation @ place + shift, np.asarray(quat_multiply(pose.orientation, turn))
    if isinstance(shape, HalfSpace):
        normal = np.asarray(shape.normal_direction, np.float64)
        turn = np.zeros(4)
        mujoco.mju_quatZ2Vec(turn, normal)
        return types.mjGEOM_PLANE, [1, 1, 1], float(shape.offset) * normal, turn
    if isinstance(shape, Sphere):
        return types.mjGEOM_SPHERE, [float(shape.radius), 0, 0], still, upright
    if isinstance(shape, Box) and float(shape.rounding) == 0:
        return types.mjGEOM_BOX, np.asarray(shape.half_extents).tolist(), still, upright
    if isinstance(shape, Capsule):
        return types.mjGEOM_CAPSULE, [float(shape.radius), float(shape.half_length), 0], still, upright
    if isinstance(shape, Cylinder):
        return types.mjGEOM_CYLINDER, [float(shape.radius), float(shape.half_length), 0], still, upright
    if isinstance(shape, Ellipsoid):
        return types.mjGEOM_ELLIPSOID, np.asarray(shape.semi_axes).tolist(), still, upright
    raise ValueError(
        f"shape of body {name!r} must be a half-space, sphere, box without rounding, capsule, cylinder, "
        f"ellipsoid, or one of these posed, for MuJoCoEngine, got {type(shape).__name__}"
    )
