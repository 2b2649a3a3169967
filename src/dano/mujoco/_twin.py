"""A scene as a MuJoCo model, on the host: same bodies, same pairs, MuJoCo's contact."""

import threading
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from dano.fields import AbstractShape, Box, Capsule, Cylinder, Ellipsoid, HalfSpace, PosedShape, Sphere
from dano.maths import quat_multiply, quat_to_matrix
from dano.mujoco._bridge import Bridge
from dano.mujoco._model import library
from dano.mujoco._settings import LEAST_FRICTION, Settings
from dano.scene import Body, Scene

_SOLREF = np.array([0.02, 1.0])
_SOLIMP = np.array([0.9, 0.95, 0.001, 0.5, 2.0])
"""MuJoCo's defaults, as is `_SOLREF`."""


class Motion(NamedTuple):
    """States as MuJoCo takes them: arrays over the bodies of a scene, see `dano.State`."""

    position: Float[np.ndarray, "n 3"]
    orientation: Float[np.ndarray, "n 4"]
    velocity: Float[np.ndarray, "n 3"]
    omega: Float[np.ndarray, "n 3"]


class Constants(NamedTuple):
    """What else a step depends on.

    Attributes:
        force: On the bodies, at their centres of mass [N, W], shape (n, 3).
        torque: [N m, W], shape (n, 3).
        mass: [kg], shape (n,).
        inertia: [kg m², B], shape (n, 3, 3).
        friction: Sliding friction of each pair of the scene, shape (p,).
        gravity: [m/s²], shape (3,).
        timestep: [s], shape ().
    """

    force: Float[np.ndarray, "n 3"]
    torque: Float[np.ndarray, "n 3"]
    mass: Float[np.ndarray, " n"]
    inertia: Float[np.ndarray, "n 3 3"]
    friction: Float[np.ndarray, " p"]
    gravity: Float[np.ndarray, "3"]
    timestep: Float[np.ndarray, ""]


class Twin:
    """The model of a scene. Its body frames are ours: axes of the field frame at the centre of mass."""

    def __init__(self, scene: Scene):
        """Build it.

        Raises:
            ImportError: If mujoco is missing.
            ValueError: If the scene has joints, or a shape that is no geom of MuJoCo's.
        """
        if scene.joints:
            raise ValueError(f"scene must have no joints for MuJoCoEngine, got {len(scene.joints)}")
        self._mujoco = mujoco = library()
        self._lock = threading.Lock()
        self._spec = spec = mujoco.MjSpec()
        # With the default integrator bodies that tumble gain energy without limit.
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICIT
        spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10.0
        spec.option.timestep = float(scene.timestep)
        self._free = np.array([not body.fixed for body in scene.bodies])
        for body in scene.bodies:
            _add_body(mujoco, spec, body)
        objects = {body.name for body in scene.bodies if body.object is not None}
        self._bridge = Bridge(spec, choose=self._settings)
        for body in scene.bodies:
            if body.object is not None:
                middle = np.asarray(body.com + body.com_offset, np.float64)
                self._bridge.attach(body.name, body.object, position=-middle, look=False)
        for body in spec.bodies[1:]:
            # The true ones are written before each step. These are such that MuJoCo counts on no symmetry.
            body.mass, body.ipos, body.explicitinertial = 1.0, np.zeros(3), True
            body.fullinertia = [2, 3, 4, 0.1, 0.2, 0.3]
        for a, b in scene.pairs:
            if not objects & {a, b}:
                spec.add_pair(name=f"{a}|{b}", geomname1=a, geomname2=b, condim=3)
        self.model = model = self._bridge.compile() if objects else spec.compile()
        self._data = mujoco.MjData(model)
        self._neural = bool(objects)
        self._pair_of = self._pairs(scene)
        self._explicit = [
            (k, mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_PAIR, f"{a}|{b}"))
            for k, (a, b) in enumerate(scene.pairs)
            if not objects & {a, b}
        ]
        self._friction = np.zeros(len(scene.pairs))
        self._weights: tuple[Any, Any] | None = None

    def _pairs(self, scene: Scene) -> dict[tuple[int, int], tuple[int, float]]:
        """Pair of two bodies of the model, and 1 if the first one of the pair comes second, else −1."""
        found = {}
        for k, names in enumerate(scene.pairs):
            a, b = (scene.index(name) + 1 for name in names)
            found[b, a], found[a, b] = (k, 1.0), (k, -1.0)
        return found

    def _settings(self, model: Any, a: int, b: int) -> Settings | None:
        found = self._pair_of.get((int(model.geom_bodyid[a]), int(model.geom_bodyid[b])))
        if found is None:
            return None
        friction = max(float(self._friction[found[0]]), LEAST_FRICTION)
        five = np.array([friction, friction, LEAST_FRICTION, LEAST_FRICTION, LEAST_FRICTION])
        return Settings(3, five, _SOLREF, _SOLIMP)

    def _load(self, motion: Motion, constants: Constants) -> None:
        """Write a state and its constants into the model and its data."""
        model, data = self.model, self._data
        self._mujoco.mj_resetData(model, data)
        model.opt.timestep, model.opt.gravity[:] = float(constants.timestep), constants.gravity
        self._friction = constants.friction
        for k, pair in self._explicit:
            model.pair_friction[pair, :2] = max(float(constants.friction[k]), LEAST_FRICTION)
        free = self._free
        rows = 1 + np.flatnonzero(~free)
        model.body_pos[rows], model.body_quat[rows] = motion.position[~free], motion.orientation[~free]
        self._weigh(constants.mass, constants.inertia)
        data.qpos[:] = np.concatenate([motion.position[free], motion.orientation[free]], axis=1).ravel()
        data.qvel[:] = np.concatenate([motion.velocity[free], motion.omega[free]], axis=1).ravel()
        data.xfrc_applied[1:] = np.concatenate([constants.force, constants.torque], axis=1)

    def _weigh(self, mass: Float[np.ndarray, " n"], inertia: Float[np.ndarray, "n 3 3"]) -> None:
        if self._weights is not None and all(map(np.array_equal, self._weights, (mass, inertia))):
            return
        self._weights = mass.copy(), inertia.copy()
        model = self.model
        for i in np.flatnonzero(self._free):
            moments, axes = np.linalg.eigh(inertia[i])
            axes = axes * np.sign(np.linalg.det(axes))
            self._mujoco.mju_mat2Quat(model.body_iquat[i + 1], axes.ravel())
            model.body_mass[i + 1], model.body_inertia[i + 1] = mass[i], moments
        self._mujoco.mj_setConst(model, self._mujoco.MjData(model))

    def step(self, motion: Motion, constants: Constants) -> tuple[Motion, int]:
        """The state a timestep later, and passes of MuJoCo's solver."""
        with self._lock:
            self._load(motion, constants)
            self._run(self._mujoco.mj_step)
            data, free = self._data, self._free
            qpos, qvel = data.qpos.reshape(-1, 7), data.qvel.reshape(-1, 6)
            after = Motion(*(x.copy() for x in motion))
            after.position[free], after.orientation[free] = qpos[:, :3], qpos[:, 3:]
            after.velocity[free], after.omega[free] = qvel[:, :3], qvel[:, 3:]
            return after, int(data.solver_niter[0])

    def wrenches(
        self, before: Motion, after: Motion, constants: Constants, about: Float[np.ndarray, "p 3"]
    ) -> Float[np.ndarray, "p 6"]:
        """Forces, and torques about points, on the first body of each pair in a step, by inverse dynamics."""
        mujoco, free = self._mujoco, self._free
        with self._lock:
            self._load(before, constants)
            change = [after.velocity - before.velocity, after.omega - before.omega]
            acceleration = np.concatenate([x[free] for x in change], axis=1) / float(constants.timestep)
            self._data.qacc[:] = acceleration.ravel()
            self.model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
            self._run(mujoco.mj_inverse)
            self.model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
            return self._summed(about)

    def _summed(self, about: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 6"]:
        model, data = self.model, self._data
        total, six = np.zeros((len(about), 6)), np.zeros(6)
        for i in range(data.ncon):
            contact = data.contact[i]
            first, second = (int(model.geom_bodyid[geom]) for geom in contact.geom)
            k, sign = self._pair_of[first, second]
            self._mujoco.mj_contactForce(model, data, i, six)
            frame = contact.frame.reshape(3, 3)
            force, torque = sign * six[:3] @ frame, sign * six[3:] @ frame
            total[k, :3] += force
            total[k, 3:] += torque + np.cross(contact.pos - about[k], force)
        return total

    def _run(self, function: Any) -> None:
        if self._neural:
            with self._bridge:
                function(self.model, self._data)
        else:
            function(self.model, self._data)


def _add_body(mujoco: Any, spec: Any, body: Body) -> None:
    added = spec.worldbody.add_body(name=body.name)
    if not body.fixed:
        added.add_freejoint()
    if body.shape is None:
        return
    kind, size, place, turn = _geom(mujoco, body.shape, body.name)
    place = place - np.asarray(body.com + body.com_offset, np.float64)
    added.add_geom(name=body.name, type=kind, size=size, pos=place, quat=turn, contype=0, conaffinity=0)


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
