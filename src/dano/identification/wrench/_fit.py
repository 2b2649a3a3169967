"""Mass, centre and inertia of what a wrist holds, by least squares.

What an arm holds, from the torques of its joints.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dano.checks import checked_kind, checked_text
from dano.identification.wrench import _estimate
from dano.identification.wrench._log import surroundings, Twists, twists, WristLog
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
    """Coordinates and torques of an arm's joints. What was not measured is NaN."""

    times: np.ndarray  # [s], increasing, shape (T,)
    q: np.ndarray  # Of the joints [rad, m], in the order of the scene's, shape (T, k)
    torque: np.ndarray  # That drives them [N m, N], shape (T, k)

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


def identify_load_on_arm(
    log: JointLog, scene: Scene, body: str, *, shape: Numbers | None = None
) -> _estimate.Load:
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
    points = None if shape is None else _estimate.point_masses(checked_numbers("shape", shape))
    arm = _moved(log, scene, index)
    table = np.einsum(
        "nik,nip->nkp", arm.jacobian, _estimate.wrench_table(arm.twists, np.asarray(scene.gravity))
    )
    each = np.broadcast_to(np.eye(count), (len(table), count, count))
    # Coulomb's friction of a joint that hardly moves has no sign: a smooth one.
    columns = [each, np.tanh(arm.v / _SLOW)[:, :, None] * each, arm.v[:, :, None] * each]
    rows = _estimate.Rows(
        _estimate.shares(log.times, arm.twists.rows),
        log.torque[arm.twists.rows] - arm.torque,
        np.concatenate([table, *columns], axis=2),
        np.arange(count),
    )
    rows, fit, change = _estimate.drifting(rows, _estimate.fitted(rows))
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
        _estimate.check_slip(rows, fit, log.times)
    drift = np.zeros(count) if change is None else change
    return _estimate.load_of(fit, messages, points, lambda theta: _of_joints(fit, theta, drift))


def _of_joints(fit: _estimate.LoadFit, theta: np.ndarray, drift: np.ndarray) -> dict[str, Any]:
    """Bias, friction, drift and noise of joints, as fields of a load; a wrist's are not known."""
    nothing, count = np.full(3, np.nan), len(drift)
    joints = theta[10 : 10 + 3 * count].reshape(3, count)
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


_FAR = 2.0
"""Distance of a centre of mass from the sensor [m] beyond which torques are in other units than N m."""

_UNLIKE = 5.0
"""Ratio of distances of the centre of mass, by torques and by forces, from which their units differ."""

_BETTER = 0.7
"""Noise in the other axes, as a share, from which the log is in these."""


def identify_load(
    log: WristLog, *, gravity: Numbers = (0.0, 0.0, -9.81), shape: Numbers | None = None
) -> _estimate.Load:
    """Mass, centre of mass and inertia of a rigid load from what a wrist's sensor felt while it moved it.

    The sensor holds the load at its origin with the force f and the torque τ, in its axes,

        f = m (a − g) + α × h + ω × (ω × h),   τ = h × (a − g) + I α + ω × I ω,   h = m c,

    which are linear in m, h and the inertia I about the origin. These, a bias of each of the six readings and
    the noise of forces and of torques are estimated by weighted least squares. Whether the log holds what the
    sensor exerts or what it feels is seen from the sign of the mass. Inertias that no body can have are moved
    to the likeliest that one can (second moments and mass as the log-Cholesky factor of a 4 × 4 matrix).

    With `shape` the load is one whose mass lies in the convex hull of some points: a sum of masses ≥ 0 at
    points of the hull, which says far more of a long thin tool than that it is a body (Nadeau, Giamou and
    Kelly, Fast object inertial parameter identification for collaborative robots, 2022).

    Args:
        log: The log.
        gravity: [m/s², W].
        shape: Points of the load's surface [m, S], shape (n, 3); None: its shape is not known.

    Returns:
        Values with standard errors; what the log cannot decide is NaN and named in `unobserved`.

    Raises:
        ValueError: If the log is in world axes, in other units, or the load slips in the gripper; if the
            shape is flat, or does not hold the centre of mass that the log shows.
    """
    checked_kind("log", log, WristLog)
    pull = checked_numbers("gravity", gravity)
    if pull.shape != (3,) or not np.isfinite(pull).all():
        raise ValueError(f"gravity must be three numbers [m/s²], got {gravity}")
    moved = twists(log)
    bodies = None if shape is None else _estimate.point_masses(checked_numbers("shape", shape))
    rows = _rows(log, moved, pull)
    fit = _estimate.fitted(rows)
    messages: list[str] = []
    if _turns(moved):
        other = _estimate.fitted(_rows(log.of_sensor(), moved, pull))
        if other.noise[0] < _BETTER * fit.noise[0]:
            raise ValueError(
                "force and torque must be in the sensor's axes: those of this log fit in world axes, with"
                f" a noise of {other.noise[0]:.2g} N in place of {fit.noise[0]:.2g} N; frame='world' reads"
                " them so"
            )
    rows, fit, change = _estimate.drifting(rows, fit)
    if change is not None:
        messages.append(
            f"the bias drifts, by {np.linalg.norm(change[:3]):.2g} N and {np.linalg.norm(change[3:]):.2g} N m"
            " over the log: estimated along with the rest"
        )
    if fit.theta[0] < 0:
        messages.append("the log holds what the load does to the sensor: signs are turned")
        rows = dataclasses.replace(rows, readings=-rows.readings)
        fit = dataclasses.replace(fit, theta=-fit.theta)
    _check(log, rows, fit)
    drift = np.zeros(6) if change is None else change
    return _estimate.load_of(fit, messages, bodies, lambda theta: _sensor(fit, theta, drift))


def _rows(log: WristLog, moved: Twists, gravity: np.ndarray) -> _estimate.Rows:
    """The model of a wrist's log: after the load the bias of each reading."""
    rows = moved.rows
    bias = np.broadcast_to(np.eye(6), (len(rows), 6, 6))
    table = np.concatenate([_estimate.wrench_table(moved, gravity), bias], axis=2)
    readings = np.concatenate([log.force[rows], log.torque[rows]], axis=1)
    return _estimate.Rows(_estimate.shares(log.times, rows), readings, table, np.repeat([0, 1], 3))


def _sensor(fit: _estimate.LoadFit, theta: np.ndarray, drift: np.ndarray) -> dict[str, Any]:
    """Bias, drift and noise, as fields of a load."""
    return {
        "force_bias": theta[10:13],
        "torque_bias": theta[13:16],
        "drift": drift,
        "force_noise": float(fit.noise[0]),
        "torque_noise": float(fit.noise[1]),
    }


def _turns(moved: Twists) -> bool:
    """Whether the sensor turned by more than some degrees: else all axes look alike."""
    cosine = np.abs(moved.turn @ moved.turn[0])
    return bool(2 * np.arccos(np.clip(cosine.min(), 0, 1)) > 0.2)


def _check(log: WristLog, rows: _estimate.Rows, fit: _estimate.LoadFit) -> None:
    """Refuse torques in other units, and loads that slip.

    Raises:
        ValueError: If there is one of these.
    """
    mass, arm = fit.theta[0], fit.theta[1:4]
    error = np.sqrt(fit.inflation * fit.covariance[0, 0])
    if fit.null[:4].max() > 1e-3 or mass < error / _estimate.UNSURE:
        return
    if (far := float(np.linalg.norm(arm / mass))) > _FAR:
        raise ValueError(
            f"torques must be in N m: with these the centre of mass is {far:.3g} m from the sensor;"
            " divide N mm by 1000"
        )
    _check_units(rows, fit)
    _estimate.check_slip(rows, fit, log.times)


def _check_units(rows: _estimate.Rows, fit: _estimate.LoadFit) -> None:
    """Refuse torques of a centre of mass that is much further away, or nearer, than that of the forces.

    Raises:
        ValueError: If they are.
    """
    alone = rows.table[:, :, 1:4].copy()
    alone[:, :3] = 0.0
    split = _estimate.fitted(rows.beside(alone))
    of_forces = float(np.linalg.norm(split.theta[1:4]))
    of_torques = float(np.linalg.norm(split.theta[1:4] + split.theta[-3:]))
    ratio = of_torques / max(of_forces, 1e-300)
    if split.noise[1] < _BETTER * fit.noise[1] and not 1 / _UNLIKE < ratio < _UNLIKE:
        raise ValueError(
            f"torques must be in N m, about the sensor's origin: they speak of a centre of mass"
            f" {ratio:.3g} times as far away as forces do; divide N mm by 1000"
        )
