"""Mass, centre and inertia of what a wrist holds, by least squares."""

import dataclasses
from typing import Any

import numpy as np

from dano.checks import checked_kind
from dano.identification.wrench._estimate import (
    check_slip,
    drifting,
    Fit,
    fitted,
    Load,
    load_of,
    Rows,
    shares,
    UNSURE,
    wrench_table,
)
from dano.identification.wrench._log import Twists, twists, WristLog
from dano.identification.wrench._shape import point_masses
from dano.maths import checked_numbers, Numbers

_FAR = 2.0
"""Distance of a centre of mass from the sensor [m] beyond which torques are in other units than N m."""

_UNLIKE = 5.0
"""Ratio of distances of the centre of mass, by torques and by forces, from which their units differ."""

_BETTER = 0.7
"""Noise in the other axes, as a share, from which the log is in these."""


def identify_load(
    log: WristLog, *, gravity: Numbers = (0.0, 0.0, -9.81), shape: Numbers | None = None
) -> Load:
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
    bodies = None if shape is None else point_masses(checked_numbers("shape", shape))
    rows = _rows(log, moved, pull)
    fit = fitted(rows)
    messages: list[str] = []
    if _turns(moved):
        other = fitted(_rows(log.of_sensor(), moved, pull))
        if other.noise[0] < _BETTER * fit.noise[0]:
            raise ValueError(
                "force and torque must be in the sensor's axes: those of this log fit in world axes, with"
                f" a noise of {other.noise[0]:.2g} N in place of {fit.noise[0]:.2g} N; frame='world' reads"
                " them so"
            )
    rows, fit, change = drifting(rows, fit)
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
    return load_of(fit, messages, bodies, lambda theta: _sensor(fit, theta, drift))


def _rows(log: WristLog, moved: Twists, gravity: np.ndarray) -> Rows:
    """The model of a wrist's log: after the load the bias of each reading."""
    rows = moved.rows
    bias = np.broadcast_to(np.eye(6), (len(rows), 6, 6))
    table = np.concatenate([wrench_table(moved, gravity), bias], axis=2)
    readings = np.concatenate([log.force[rows], log.torque[rows]], axis=1)
    return Rows(shares(log.times, rows), readings, table, np.repeat([0, 1], 3))


def _sensor(fit: Fit, theta: np.ndarray, drift: np.ndarray) -> dict[str, Any]:
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


def _check(log: WristLog, rows: Rows, fit: Fit) -> None:
    """Refuse torques in other units, and loads that slip.

    Raises:
        ValueError: If there is one of these.
    """
    mass, arm = fit.theta[0], fit.theta[1:4]
    error = np.sqrt(fit.inflation * fit.covariance[0, 0])
    if fit.null[:4].max() > 1e-3 or mass < error / UNSURE:
        return
    if (far := float(np.linalg.norm(arm / mass))) > _FAR:
        raise ValueError(
            f"torques must be in N m: with these the centre of mass is {far:.3g} m from the sensor;"
            " divide N mm by 1000"
        )
    _check_units(rows, fit)
    check_slip(rows, fit, log.times)


def _check_units(rows: Rows, fit: Fit) -> None:
    """Refuse torques of a centre of mass that is much further away, or nearer, than that of the forces.

    Raises:
        ValueError: If they are.
    """
    alone = rows.table[:, :, 1:4].copy()
    alone[:, :3] = 0.0
    split = fitted(rows.beside(alone))
    of_forces = float(np.linalg.norm(split.theta[1:4]))
    of_torques = float(np.linalg.norm(split.theta[1:4] + split.theta[-3:]))
    ratio = of_torques / max(of_forces, 1e-300)
    if split.noise[1] < _BETTER * fit.noise[1] and not 1 / _UNLIKE < ratio < _UNLIKE:
        raise ValueError(
            f"torques must be in N m, about the sensor's origin: they speak of a centre of mass"
            f" {ratio:.3g} times as far away as forces do; divide N mm by 1000"
        )
