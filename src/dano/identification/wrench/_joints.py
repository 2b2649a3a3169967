"""What an arm holds, from the torques of its joints."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dano.checks import checked_kind, checked_text
from dano.identification.wrench._estimate import (
    check_slip,
    drifting,
    fitted,
    Load,
    load_of,
    Rows,
    shares,
    wrench_table,
)
from dano.identification.wrench._log import surroundings, Twists, twists, WristLog
from dano.identification.wrench._shape import point_masses
from dano.maths import checked_numbers, Numbers, quat_to_matrix
from dano.robots import computed_torque
from dano.scene import Scene

_LEAST = 50
"""Rows: ten numbers of the load and three of each joint are estimated, and their noise as well."""

_SLOW = 0.02
"""Speed of a joint [rad/s or m/s] at which its Coulomb friction has three quarters of its size."""

_FASTEST = 2e3
"""Accelerations of joints [rad/s² or m/s²] beyond which angles are in degrees, or times in other units."""


@dataclasses.dataclass(frozen=True, eq=False)
class JointLog:
    """Coordinates and torques of an arm's joints. What was not measured is NaN.

    Attributes:
        times: [s], increasing, shape (T,).
        q: Of the joints [rad, m], in the order of the scene's, shape (T, k).
        torque: That drives them [N m, N], shape (T, k).
    """

    times: np.ndarray
    q: np.ndarray
    torque: np.ndarray

    @classmethod
    def create(cls, times: Numbers, *, q: Numbers, torque: Numbers) -> "JointLog":
        """A log from arrays.

        Raises:
            ValueError: If shapes do not fit, times do not increase, or there are fewer than 50 rows.
        """
        stamps = checked_numbers("times", times)
        if stamps.ndim != 1 or len(stamps) < _LEAST:
            raise ValueError(f"times must be a vector of at least {_LEAST} rows, got shape {stamps.shape}")
        if not np.all(np.isfinite(stamps)) or np.any(np.diff(stamps) <= 0):
            raise ValueError("times must be finite and increase")
        arrays = {"q": checked_numbers("q", q), "torque": checked_numbers("torque", torque)}
        for name, array in arrays.items():
            if array.ndim != 2 or array.shape != (len(stamps), arrays["q"].shape[-1]):
                raise ValueError(
                    f"{name} must have a row for each of {len(stamps)} times and a column for each joint, got"
                    f" shape {array.shape}"
                )
        return cls(stamps, **arrays)

    def part(self, begin: float, end: float) -> "JointLog":
        """Rows from a time up to another [s]."""
        rows = (self.times >= begin) & (self.times < end)
        return JointLog(*(getattr(self, field.name)[rows] for field in dataclasses.fields(self)))


def identify_load_on_arm(log: JointLog, scene: Scene, body: str, *, shape: Numbers | None = None) -> Load:
    """Mass, centre of mass and inertia of what an arm holds, from the torques that move its joints.

    The torques are those of the arm alone, M(q) v̇ + b(q, v) by the scene, and Jᵀ of the force and torque by
    which its link moves the load (see `identify_load`), which are linear in the load. A bias, Coulomb's and
    viscous friction and the noise of each joint are estimated, too; a bias that drifts is reported and
    estimated.

    Args:
        log: The log.
        scene: The arm without its load: a tree of joints on a fixed base.
        body: Link that holds the load; the load is given in its frame.
        shape: Points of the load's surface [m], in that frame, shape (n, 3); None: its shape is not known.

    Returns:
        Values with standard errors; what the log cannot decide is NaN and named in `unobserved`.

    Raises:
        ValueError: If the scene is no arm, the log is not of its joints or in other units, the load slips, or
            the shape does not fit.
    """
    checked_kind("log", log, JointLog)
    checked_kind("scene", scene, Scene)
    index = scene.index(checked_text("body", body))
    count = scene.layout.n_velocities
    if scene.layout.free or scene.loops or not scene.joints:
        raise ValueError(
            "scene must be an arm: joints in a tree on a fixed base, without bodies that move freely"
        )
    if log.q.shape[1] != count:
        raise ValueError(
            f"log must have a column for each of the scene's {count} joints, got {log.q.shape[1]}"
        )
    points = None if shape is None else point_masses(checked_numbers("shape", shape))
    arm = _moved(log, scene, index)
    table = np.einsum("nik,nip->nkp", arm.jacobian, wrench_table(arm.twists, np.asarray(scene.gravity)))
    each = np.broadcast_to(np.eye(count), (len(table), count, count))
    # Coulomb's friction of a joint that hardly moves has no sign: a smooth one.
    columns = [each, np.tanh(arm.v / _SLOW)[:, :, None] * each, arm.v[:, :, None] * each]
    rows = Rows(
        shares(log.times, arm.twists.rows),
        log.torque[arm.twists.rows] - arm.torque,
        np.concatenate([table, *columns], axis=2),
        np.arange(count),
    )
    rows, fit, change = drifting(rows, fitted(rows))
    messages = []
    if change is not None:
        largest = int(np.argmax(np.abs(change)))
        messages.append(
            f"the bias of the torques drifts, of joint {largest} by {change[largest]:.2g} N m over the"
            " log: estimated along with the rest"
        )
    if fit.null[:4].max() < 1e-3 and fit.theta[0] < -3 * np.sqrt(fit.inflation * fit.covariance[0, 0]):
        raise ValueError(
            f"torque must be what drives the joints, with their signs: with these the load has a mass of"
            f" {fit.theta[0]:.3g} kg"
        )
    if fit.null[:4].max() < 1e-3 and fit.theta[0] > 0:
        check_slip(rows, fit, log.times)

    drift = np.zeros(count) if change is None else change

    def sensor(theta: np.ndarray) -> dict:
        nothing, joints = np.full(3, np.nan), theta[10 : 10 + 3 * count].reshape(3, count)
        return {
            "force_bias": nothing,
            "torque_bias": nothing,
            "drift": np.full(6, np.nan),
            "force_noise": float("nan"),
            "torque_noise": float("nan"),
            "joint_bias": joints[0],
            "joint_friction": joints[1:].T,
            "joint_noise": fit.noise,
            "joint_drift": drift,
        }

    return load_of(fit, messages, points, sensor)


@dataclasses.dataclass(frozen=True, eq=False)
class _Moved:
    """How the arm moved at n rows of its log."""

    twists: Twists  # Of the link's frame
    v: np.ndarray  # Of the joints, shape (n, k)
    torque: np.ndarray  # That the arm alone needs, shape (n, k)
    jacobian: np.ndarray  # Velocity of the link's origin and spin, in its axes, shape (n, 6, k)


def _moved(log: JointLog, scene: Scene, index: int) -> _Moved:
    known = np.atleast_1d(np.isfinite(np.concatenate([log.q, log.torque], axis=1)).all(axis=1))
    around = surroundings(log.times, known)
    along = around.inverse @ log.q[around.near]
    v, gained = along[:, 1] / around.scale, 2 * along[:, 2] / around.scale**2
    if (typical := float(np.median(np.abs(gained).max(axis=1)))) > _FASTEST:
        raise ValueError(
            f"q must be in radians (or metres) and times in seconds, got accelerations of {typical:.3g} a"
            " second squared"
        )
    one, dtype = scene.initial_state(), scene.timestep.dtype

    def state(q, v):
        return eqx.tree_at(lambda s: (s.q, s.v), one, (q, v))

    def pose(q):
        frames = scene.frames(state(q, jnp.zeros_like(q)))
        return frames.position[index], frames.orientation[index], frames.jacobian[index]

    def torque(q, v, gained):
        return computed_torque(scene, state(q, v), gained)

    whole = np.nan_to_num(log.q)
    position, orientation, jacobian = (np.asarray(x, float) for x in _mapped(pose, dtype, whole))
    needed = np.asarray(_mapped(torque, dtype, log.q[around.middle], v, gained), float)
    turns = quat_to_matrix(orientation)
    arm = np.asarray(scene.bodies[index].centre_of_mass, float)
    origin = position - turns @ arm
    nothing = np.where(known[:, None], np.zeros((len(known), 3)), np.nan)
    found = twists(WristLog(log.times, origin, orientation, nothing, nothing))
    mine = jacobian[around.middle]
    linear = np.einsum("nji,njk->nik", turns[around.middle], mine[:, :3])
    # The origin moves with ω × (−c) beside the centre of mass.
    linear = linear + np.cross(arm[None, :, None], mine[:, 3:], axis=1)
    return _Moved(found, v, needed, np.concatenate([linear, mine[:, 3:]], axis=1))


def _mapped(function, dtype, *arrays: np.ndarray):
    return jax.jit(jax.vmap(function))(*(jnp.asarray(x, dtype) for x in arrays))
