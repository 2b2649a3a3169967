"""A scene as a MuJoCo model, on the host: same bodies, joints, motors and pairs, MuJoCo's contact."""

import contextlib
import threading
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dano.maths import quat_exp, quat_log
from dano.mujoco._bridge import Bridge
from dano.mujoco._settings import ContactSettings, LEAST_FRICTION, spring_of
from dano.mujoco._spec import add_mesh, AS_SAMPLES, joint_names, motor_name, spec_of, weigh_later
from dano.mujoco._things import library
from dano.scene import Scene

_ENDLESS = 1e9
"""What MuJoCo is told for infinite limits, in SI units: it wants finite ones."""


class Motion(NamedTuple):
    """States as MuJoCo takes them: arrays over the bodies and joints of a scene, see `dano.State`.

    Rows of bodies that hang on joints do not count.
    """

    position: Float[np.ndarray, "n 3"]
    orientation: Float[np.ndarray, "n 4"]
    velocity: Float[np.ndarray, "n 3"]
    omega: Float[np.ndarray, "n 3"]
    q: Float[np.ndarray, " k"]
    v: Float[np.ndarray, " k"]


class Constants(NamedTuple):
    """What else a step depends on."""

    force: Float[np.ndarray, "n 3"]  # On the bodies, at their centres of mass [N, W], shape (n, 3)
    torque: Float[np.ndarray, "n 3"]  # [N m, W], shape (n, 3)
    effort: Float[np.ndarray, " k"]  # On the joint coordinates [N m or N], shape (k,)
    command: Float[np.ndarray, " k"]  # Of motors, shape (k,)
    mass: Float[np.ndarray, " n"]  # [kg], shape (n,)
    inertia: Float[np.ndarray, "n 3 3"]  # [kg m², B], shape (n, 3, 3)
    friction: Float[np.ndarray, " p"]  # Sliding friction of each pair of the scene, shape (p,)
    restitution: Float[np.ndarray, " p"]  # Coefficient of restitution of each pair, shape (p,)
    gravity: Float[np.ndarray, "3"]  # [m/s²], shape (3,)
    timestep: Float[np.ndarray, ""]  # [s], shape ()
    # Of the joint coordinates, as all that follows; see `JointLaws`. Shape (k,).
    damping: Float[np.ndarray, " k"]
    armature: Float[np.ndarray, " k"]  # Shape (k,)
    stiffness: Float[np.ndarray, " k"]  # Shape (k,)
    rest: Float[np.ndarray, " k"]  # Shape (k,)
    stiction: Float[np.ndarray, " k"]  # Friction of the joints, shape (k,)
    limits: Float[np.ndarray, "k 2"]  # Shape (k, 2)
    motor: Float[np.ndarray, "k 5"]  # Shape (k, 5)


class _Single(NamedTuple):
    """A joint of MuJoCo's with one coordinate."""

    joint: int  # Its index
    place: int  # Coordinate of ours
    ratio: float  # 1, but of one that mimics another, see `dano.Joint`
    shift: float  # 0, the same
    leads: bool  # Whether the coordinate is its own


class _Places(NamedTuple):
    """Where things of a scene stand in MuJoCo's arrays. Joints are MuJoCo's, in the order of ours."""

    bodies: Int[np.ndarray, " n"]  # Index of each body
    fixed: Int[np.ndarray, " f"]  # Rows of the bodies that never move
    moving: Int[np.ndarray, " m"]  # Of the others
    free: Int[np.ndarray, " r"]  # Of those that hang on no joint
    free_q: Int[np.ndarray, "r 7"]  # Their seven places in qpos
    free_v: Int[np.ndarray, "r 6"]  # Their six places in qvel
    singles: list[_Single]  # Hinges and slides, those of planar joints among them
    balls: list[tuple[int, int]]  # Joint and first coordinate of balls
    dofs: Int[np.ndarray, " k"]  # Place in qvel of each coordinate of ours
    motors: list[tuple[int, int]]  # Actuator and coordinate of each motor


class Twin:
    """The model of a scene, and data to step it with."""

    def __init__(
        self, scene: Scene, touch: str = AS_SAMPLES, options: Mapping[str, Any] = MappingProxyType({})
    ):
        """Build it.

        Args:
            scene: The scene.
            touch: As what neural objects touch, see `TOUCHES`.
            options: Of MuJoCo's `mjOption`.

        Raises:
            ImportError: If mujoco is missing.
            ValueError: If a shape is not a geom of MuJoCo's, or an object has no solid to make a mesh of.
        """
        self._mujoco = mujoco = library()
        self._lock = threading.Lock()
        spec = spec_of(mujoco, scene)
        for name, value in options.items():
            setattr(spec.option, name, value)
        objects = {body.name: body for body in scene.bodies if body.object is not None}
        sampled = set(objects) if touch == AS_SAMPLES else set()
        self._attached = Bridge(spec, choose=self._settings)
        for name, body in objects.items():
            assert body.object is not None
            if name in sampled:
                middle = np.asarray(body.centre_of_mass, np.float64)
                self._attached.attach(name, body.object, position=-middle, look=False)
            else:
                add_mesh(mujoco, spec, body, body.object, touch)
        weigh_later(spec)
        explicit = [(k, a, b) for k, (a, b) in enumerate(scene.pairs) if not sampled & {a, b}]
        for k, a, b in explicit:
            spec.add_pair(name=f"pair {k}", geomname1=a, geomname2=b, condim=3)
        self.model = model = self._attached.compile() if sampled else spec.compile()
        self._data = mujoco.MjData(model)
        self.bridge = self._attached if sampled else contextlib.nullcontext()
        self.joints = (
            *((joint.parent, joint.child, joint.kind) for joint in scene.joints),
            *((loop.first, loop.second, loop.kind) for loop in scene.loops),
        )
        self.places = places = _places(mujoco, model, scene)
        self._pair_of: dict[tuple[int, int], tuple[int, float]] = {}
        for k, pair in enumerate(scene.pairs):
            a, b = (int(places.bodies[scene.index(name)]) for name in pair)
            self._pair_of[b, a], self._pair_of[a, b] = (k, 1.0), (k, -1.0)
        kind = mujoco.mjtObj.mjOBJ_PAIR
        self._explicit = [(k, mujoco.mj_name2id(model, kind, f"pair {k}")) for k, _, _ in explicit]
        self._friction = np.zeros(len(scene.pairs))
        self._springs: list[tuple[np.ndarray, np.ndarray]] = []
        self._sprung: tuple[Any, ...] | None = None
        self._weights: tuple[Any, ...] | None = None

    def _settings(self, model: Any, a: int, b: int) -> ContactSettings | None:
        found = self._pair_of.get((int(model.geom_bodyid[a]), int(model.geom_bodyid[b])))
        if found is None:
            return None
        friction = max(float(self._friction[found[0]]), LEAST_FRICTION)
        five = np.array([friction, friction, LEAST_FRICTION, LEAST_FRICTION, LEAST_FRICTION])
        return ContactSettings(3, five, *self._springs[found[0]])

    def load(self, data: Any, motion: Motion, constants: Constants) -> None:
        """Write a state and its constants into the model and some data."""
        model, places = self.model, self.places
        self._mujoco.mj_resetData(model, data)
        model.opt.timestep, model.opt.gravity[:] = float(constants.timestep), constants.gravity
        self._load_contacts(constants)
        self._load_joints(constants)
        self._weigh(constants)
        rows = places.bodies[places.fixed]
        model.body_pos[rows] = motion.position[places.fixed]
        model.body_quat[rows] = motion.orientation[places.fixed]
        free = places.free
        data.qpos[places.free_q] = np.concatenate([motion.position[free], motion.orientation[free]], axis=1)
        data.qvel[places.free_v] = np.concatenate([motion.velocity[free], motion.omega[free]], axis=1)
        for joint, place, ratio, shift, _ in places.singles:
            data.qpos[model.jnt_qposadr[joint]] = ratio * motion.q[place] + shift
            data.qvel[model.jnt_dofadr[joint]] = ratio * motion.v[place]
        for joint, place in places.balls:
            first = model.jnt_qposadr[joint]
            data.qpos[first : first + 4] = quat_exp(motion.q[place : place + 3])
        data.qvel[places.dofs] = motion.v
        data.xfrc_applied[places.bodies] = np.concatenate([constants.force, constants.torque], axis=1)
        data.qfrc_applied[places.dofs] = constants.effort
        for actuator, place in places.motors:
            data.ctrl[actuator] = constants.command[place]

    def _load_contacts(self, constants: Constants) -> None:
        model, self._friction = self.model, constants.friction
        sprung = (constants.restitution, constants.timestep)
        changed = self._sprung is None or not all(map(np.array_equal, self._sprung, sprung))
        if changed:
            self._sprung = tuple(np.array(x) for x in sprung)
            self._springs = [spring_of(float(e), float(constants.timestep)) for e in constants.restitution]
        for k, pair in self._explicit:
            model.pair_friction[pair, :2] = max(float(constants.friction[k]), LEAST_FRICTION)
            model.pair_solref[pair], model.pair_solimp[pair] = self._springs[k]

    def _load_joints(self, constants: Constants) -> None:
        model, places = self.model, self.places
        # What ties joints and closes loops is as hard as the timestep allows.
        model.eq_solref[:, 0] = 2 * float(constants.timestep)
        if not places.dofs.size:
            return
        model.dof_damping[places.dofs] = constants.damping
        model.dof_frictionloss[places.dofs] = constants.stiction
        for joint, place, *_, leads in places.singles:
            if leads:
                model.jnt_stiffness[joint] = constants.stiffness[place]
                model.jnt_range[joint] = np.clip(constants.limits[place], -_ENDLESS, _ENDLESS)
                model.qpos_spring[model.jnt_qposadr[joint]] = constants.rest[place]
        for joint, place in places.balls:
            first = model.jnt_qposadr[joint]
            model.jnt_stiffness[joint] = constants.stiffness[place]
            model.qpos_spring[first : first + 4] = quat_exp(constants.rest[place : place + 3])
        for actuator, place in places.motors:
            gear, stiffness, damping, least, most = constants.motor[place]
            model.actuator_gear[actuator, 0] = gear
            gain = stiffness or damping or 1.0
            bias = damping if stiffness or damping else 0.0
            model.actuator_gainprm[actuator, 0] = gain
            model.actuator_biasprm[actuator, :3] = 0.0, -stiffness, -bias
            model.actuator_forcerange[actuator] = np.clip([least, most], -_ENDLESS, _ENDLESS)

    def _weigh(self, constants: Constants) -> None:
        weights = constants.mass, constants.inertia, constants.armature
        if self._weights is not None and all(map(np.array_equal, self._weights, weights)):
            return
        self._weights = tuple(x.copy() for x in weights)
        model, places = self.model, self.places
        for i in places.moving:
            moments, axes = np.linalg.eigh(constants.inertia[i])
            axes = axes * np.sign(np.linalg.det(axes))
            row = places.bodies[i]
            self._mujoco.mju_mat2Quat(model.body_iquat[row], axes.ravel())
            model.body_mass[row], model.body_inertia[row] = constants.mass[i], moments
        model.dof_armature[places.dofs] = constants.armature
        self._mujoco.mj_setConst(model, self._mujoco.MjData(model))

    def step(self, motion: Motion, constants: Constants) -> tuple[Motion, int]:
        """The state a timestep later, and passes of MuJoCo's solver."""
        with self._lock:
            self.load(self._data, motion, constants)
            with self.bridge:
                self._mujoco.mj_step(self.model, self._data)
            return self.read(self._data, motion), int(self._data.solver_niter[0])

    def read(self, data: Any, before: Motion) -> Motion:
        """The state that data is in; rows of bodies that do not move freely are those of `before`."""
        model, places, free = self.model, self.places, self.places.free
        after = Motion(*(np.array(x) for x in before))
        qpos, qvel = data.qpos[places.free_q], data.qvel[places.free_v]
        after.position[free], after.orientation[free] = qpos[:, :3], qpos[:, 3:]
        after.velocity[free], after.omega[free] = qvel[:, :3], qvel[:, 3:]
        for joint, place, *_, leads in places.singles:
            if leads:
                after.q[place] = data.qpos[model.jnt_qposadr[joint]]
        for joint, place in places.balls:
            first = model.jnt_qposadr[joint]
            after.q[place : place + 3] = quat_log(data.qpos[first : first + 4])
        after.v[:] = data.qvel[places.dofs]
        return after

    def wrenches(
        self, before: Motion, after: Motion, constants: Constants, about: Float[np.ndarray, "p 3"]
    ) -> Float[np.ndarray, "p 6"]:
        """Forces, and torques about points, on the first body of each pair in a step, by inverse dynamics."""
        mujoco, data, discrete = self._mujoco, self._data, int(self._mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
        with self._lock:
            # Where the step led, for its velocities.
            self.load(data, after, constants)
            faster = data.qvel.copy()
            self.load(data, before, constants)
            data.qacc[:] = (faster - data.qvel) / float(constants.timestep)
            self.model.opt.enableflags |= discrete
            with self.bridge:
                mujoco.mj_inverse(self.model, data)
            self.model.opt.enableflags &= ~discrete
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


def _places(mujoco: Any, model: Any, scene: Scene) -> _Places:
    layout, kinds = scene.layout, mujoco.mjtObj
    fixed = np.array([body.fixed for body in scene.bodies])
    bodies = np.array([mujoco.mj_name2id(model, kinds.mjOBJ_BODY, name) for name in scene.names])
    free = np.array(layout.free, int)
    first = np.array([model.body_jntadr[bodies[i]] for i in free], int)
    free_q = model.jnt_qposadr[first][:, None] + np.arange(7)
    free_v = model.jnt_dofadr[first][:, None] + np.arange(6)
    singles, balls, motors = [], [], []
    dofs = np.zeros(layout.n_joints, int)
    for j, joint in enumerate(scene.joints):
        own = [mujoco.mj_name2id(model, kinds.mjOBJ_JOINT, name) for name in joint_names(joint)]
        place = layout.coordinates[j]
        if joint.kind == "ball":
            balls.append((own[0], place))
            dofs[place : place + 3] = model.jnt_dofadr[own[0]] + np.arange(3)
            continue
        for part, index in enumerate(own):
            tied = (float(joint.ratio), float(joint.shift)) if joint.mimics else (1.0, 0.0)
            singles.append(_Single(index, place + part, *tied, not joint.mimics))
            if not joint.mimics:
                dofs[place + part] = model.jnt_dofadr[index]
        if joint.motor is not None:
            actuator = mujoco.mj_name2id(model, kinds.mjOBJ_ACTUATOR, motor_name(joint))
            motors.append((actuator, place))
    rows = np.flatnonzero(fixed), np.flatnonzero(~fixed), free
    return _Places(bodies, *rows, free_q, free_v, singles, balls, dofs, motors)
