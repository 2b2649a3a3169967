"""Mass, centre and inertia of what a wrist holds, by least squares."""

import dataclasses

import numpy as np

from dano.checks import checked_kind
from dano.identification.wrench._log import Twists, twists, WristLog
from dano.identification.wrench._shape import about_centre, matrix_of, point_masses, six_of, within_shape
from dano.maths import checked_numbers, Numbers, quat_conjugate, quat_rotate
from dano.objects import MassProperties

_PASSES = 4
"""Passes of weighted least squares: noise of forces and of torques from the residuals of the pass before."""

_NULL = 1e-9
"""Share of the largest curvature below which a direction is not determined at all."""

_UNSURE = 0.25
"""Standard error, as a share of the value, from which a value is not observed."""

_SURE = 1.96
"""Standard errors of a 95 % interval."""

_STRONG = 40.0
"""Fall of χ² from which a drift or a slip is believed: 6 numbers without meaning fall it by 6 ± 3.5."""

_SLIP, _SLIPS = 5e-4, 11
"""Least way of a centre of mass that counts as a slip [m]; moments at which one is looked for."""

_FAR = 2.0
"""Distance of a centre of mass from the sensor [m] beyond which torques are in other units than N m."""

_UNLIKE = 5.0
"""Ratio of distances of the centre of mass, by torques and by forces, from which their units differ."""

_BETTER = 0.7
"""Noise in the other axes, as a share, from which the log is in these."""

_OUTSIDE = 4.0
"""Standard errors by which a centre of mass may lie outside of a given shape."""

_NAMES = ("mass", "centre", "inertia")


@dataclasses.dataclass(frozen=True, eq=False)
class Load:
    """What a sensor holds, in the sensor's frame S. NaN: not observed.

    Attributes:
        mass: [kg].
        centre: Of mass [m, S], shape (3,).
        inertia: About the centre of mass [kg m², axes of S], shape (3, 3).
        standard_errors: Of these three, by name, in the same shapes; infinite where not observed.
        force_bias: What the sensor shows without a load [N, S], at the middle of the log.
        torque_bias: The same [N m, S].
        drift: How much both change over the whole log [N, N m], shape (6,); zeros where they do not.
        force_noise: Standard deviation of a force [N].
        torque_noise: Of a torque [N m].
        unobserved: Which of mass, centre, inertia the log cannot decide.
        messages: What was found odd or corrected, in words.
    """

    mass: float
    centre: np.ndarray
    inertia: np.ndarray
    standard_errors: dict[str, np.ndarray]
    force_bias: np.ndarray
    torque_bias: np.ndarray
    drift: np.ndarray
    force_noise: float
    torque_noise: float
    unobserved: tuple[str, ...]
    messages: tuple[str, ...]

    def interval(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """95 % interval of "mass", "centre" or "inertia", number by number.

        Raises:
            ValueError: If there is no such quantity.
        """
        if name not in _NAMES:
            raise ValueError(f"name must be one of {list(_NAMES)}, got {name!r}")
        value, error = np.asarray(getattr(self, name)), np.asarray(self.standard_errors[name])
        return value - _SURE * error, value + _SURE * error

    def properties(self) -> MassProperties:
        """Mass properties in the sensor's frame, as objects have them.

        Raises:
            ValueError: If something was not observed.
        """
        if self.unobserved:
            raise ValueError(f"the log does not decide {' and '.join(self.unobserved)} of the load")
        return MassProperties(
            self.mass,
            self.centre,
            self.inertia,
            mass_error=self.standard_errors["mass"],
            com_error=self.standard_errors["centre"],
            inertia_error=self.standard_errors["inertia"],
        )


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
    rows = _Rows.of(log, moved, pull)
    fit = _fitted(rows)
    messages: list[str] = []
    if _turns(moved):
        other = _fitted(_Rows.of(log.of_sensor(), moved, pull))
        if other.noise[0] < _BETTER * fit.noise[0]:
            raise ValueError(
                "force and torque must be in the sensor's axes: those of this log fit in world axes, with"
                f" a noise of {other.noise[0]:.2g} N in place of {fit.noise[0]:.2g} N; frame='world' reads"
                " them so"
            )
    rows, fit = _drifting(rows, fit, messages)
    if fit.theta[0] < 0:
        messages.append("the log holds what the load does to the sensor: signs are turned")
        rows = dataclasses.replace(rows, readings=-rows.readings)
        fit = dataclasses.replace(fit, theta=-fit.theta)
    _check(log, rows, fit)
    return _load(rows, fit, messages, bodies)


@dataclasses.dataclass(frozen=True, eq=False)
class _Rows:
    """The linear model: readings (n, 6) of forces and torques, and their derivatives (n, 6, p)."""

    times: np.ndarray
    readings: np.ndarray
    table: np.ndarray

    @classmethod
    def of(cls, log: WristLog, moved: Twists, gravity: np.ndarray) -> "_Rows":
        rows = moved.rows
        down = np.asarray(quat_rotate(quat_conjugate(moved.turn), np.broadcast_to(gravity, (len(rows), 3))))
        felt = moved.acceleration - down
        spin, rate = _cross(moved.omega), _cross(moved.alpha)
        table = np.zeros((len(rows), 6, 16))
        table[:, :3, 0] = felt
        table[:, :3, 1:4] = rate + spin @ spin
        table[:, 3:, 1:4] = -_cross(felt)
        turned = _inertial(moved.omega)
        table[:, 3:, 4:10] = _inertial(moved.alpha) + spin @ turned
        table[:, :, 10:] = np.eye(6)
        middle = 0.5 * (log.times[0] + log.times[-1])
        times = (log.times[rows] - middle) / (log.times[-1] - log.times[0])
        return cls(times, np.concatenate([log.force[rows], log.torque[rows]], axis=1), table)

    def beside(self, columns: np.ndarray) -> "_Rows":
        """With further columns, shape (n, 6, k)."""
        return dataclasses.replace(self, table=np.concatenate([self.table, columns], axis=2))


@dataclasses.dataclass(frozen=True, eq=False)
class _Fit:
    """Where weighted least squares ended: θ, its covariance, directions without data, noise, χ²."""

    theta: np.ndarray
    covariance: np.ndarray
    null: np.ndarray
    noise: np.ndarray
    chi2: float
    inflation: float


def _fitted(rows: _Rows, noise: np.ndarray | None = None) -> _Fit:
    """Least squares with weights from the residuals, or from a noise that is known."""
    n, _, p = rows.table.shape
    sigma = np.ones(2) if noise is None else noise
    theta = covariance = null = residuals = np.zeros(0)
    for _ in range(_PASSES if noise is None else 1):
        weight = np.repeat(1 / sigma, 3)
        table = (rows.table * weight[None, :, None]).reshape(-1, p)
        target = (rows.readings * weight).ravel()
        scale = np.linalg.norm(table, axis=0)
        # What nothing depends on is a direction without data, not a division by zero.
        scale[scale < 1e-150] = 1.0
        values, vectors = np.linalg.eigh((table / scale).T @ (table / scale))
        known = values > _NULL * values.max()
        inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T
        covariance = inverse / np.outer(scale, scale)
        theta = covariance @ (table.T @ target)
        null = np.linalg.norm(vectors[:, ~known], axis=1)
        residuals = rows.readings - rows.table @ theta
        if noise is None:
            free = max(3 * n - p / 2, 1.0)
            sums = np.array([np.sum(residuals[:, :3] ** 2), np.sum(residuals[:, 3:] ** 2)])
            sigma = np.maximum(np.sqrt(sums / free), 1e-12)
    chi2 = float(np.sum((residuals / np.repeat(sigma, 3)) ** 2))
    return _Fit(theta, covariance, null, sigma, chi2, _inflation(residuals))


def _inflation(residuals: np.ndarray) -> float:
    """By how much neighbouring rows are no news: (1 + ρ)/(1 − ρ) of their correlation, at least 1."""
    above, below = residuals[1:].ravel(), residuals[:-1].ravel()
    correlation = float(np.sum(above * below) / max(np.sum(residuals**2), 1e-300))
    correlation = min(max(correlation, 0.0), 0.98)
    return (1 + correlation) / (1 - correlation)


def _turns(moved: Twists) -> bool:
    """Whether the sensor turned by more than some degrees: else all axes look alike."""
    cosine = np.abs(moved.turn @ moved.turn[0])
    return bool(2 * np.arccos(np.clip(cosine.min(), 0, 1)) > 0.2)


def _drifting(rows: _Rows, fit: _Fit, messages: list[str]) -> tuple[_Rows, _Fit]:
    """With a bias that grows with time, where that is seen."""
    longer = rows.beside(rows.times[:, None, None] * np.eye(6))
    drifting = _fitted(longer, fit.noise)
    if (fit.chi2 - drifting.chi2) / drifting.inflation < _STRONG:
        return rows, fit
    drifting = _fitted(longer)
    change = drifting.theta[16:22]
    messages.append(
        f"the bias drifts, by {np.linalg.norm(change[:3]):.2g} N and {np.linalg.norm(change[3:]):.2g} N m"
        " over the log: estimated along with the rest"
    )
    return longer, drifting


def _check(log: WristLog, rows: _Rows, fit: _Fit) -> None:
    """Refuse torques in other units, and loads that slip.

    Raises:
        ValueError: If there is one of these.
    """
    mass, arm = fit.theta[0], fit.theta[1:4]
    error = np.sqrt(fit.inflation * fit.covariance[0, 0])
    if fit.null[:4].max() > 1e-3 or mass < error / _UNSURE:
        return
    if (far := float(np.linalg.norm(arm / mass))) > _FAR:
        raise ValueError(
            f"torques must be in N m: with these the centre of mass is {far:.3g} m from the sensor;"
            " divide N mm by 1000"
        )
    _check_units(rows, fit)
    best, when, shift = 0.0, 0.0, np.zeros(3)
    for moment in np.linspace(-0.4, 0.4, _SLIPS):
        later = (rows.times > moment)[:, None, None]
        split = _fitted(rows.beside(later * rows.table[:, :, 1:10]), fit.noise)
        fall = (fit.chi2 - split.chi2) / split.inflation
        if fall > best:
            best, when, shift = fall, moment, split.theta[-9:-6] / mass
    if best > _STRONG and (way := float(np.linalg.norm(shift))) > _SLIP:
        at = 0.5 * (log.times[0] + log.times[-1]) + when * (log.times[-1] - log.times[0])
        raise ValueError(
            f"the load must be held fast: its centre of mass moves by {1e3 * way:.2g} mm in the gripper"
            f" at about {at:.3g} s; take the part of the log before or after it (WristLog.part)"
        )


def _check_units(rows: _Rows, fit: _Fit) -> None:
    """Refuse torques of a centre of mass that is much further away, or nearer, than that of the forces.

    Raises:
        ValueError: If they are.
    """
    alone = rows.table[:, :, 1:4].copy()
    alone[:, :3] = 0.0
    split = _fitted(rows.beside(alone))
    of_forces = float(np.linalg.norm(split.theta[1:4]))
    of_torques = float(np.linalg.norm(split.theta[1:4] + split.theta[-3:]))
    ratio = of_torques / max(of_forces, 1e-300)
    if split.noise[1] < _BETTER * fit.noise[1] and not 1 / _UNLIKE < ratio < _UNLIKE:
        raise ValueError(
            f"torques must be in N m, about the sensor's origin: they speak of a centre of mass"
            f" {ratio:.3g} times as far away as forces do; divide N mm by 1000"
        )


def _load(rows: _Rows, fit: _Fit, messages: list[str], bodies: np.ndarray | None) -> Load:
    """Values, errors, and what is not observed."""
    theta = fit.theta
    covariance = fit.inflation * fit.covariance
    values, jacobian = about_centre(theta[:10]), _slopes(theta[:10])
    errors = np.sqrt(np.diagonal(jacobian @ covariance[:10, :10] @ jacobian.T))
    if bodies is not None and fit.null[:4].max() < 1e-3:
        _check_within(values, errors, bodies)
        if fit.null[:10].max() < 1e-3:
            own = covariance[:10, :10]
            best, errors = within_shape(theta[:10], own, bodies)
            follow = covariance[10:, :10] @ np.linalg.solve(own, best - theta[:10])
            theta = np.concatenate([best, theta[10:] + follow])
            values = about_centre(best)
    lost = _lost(fit, values, errors)
    if not any(lost.values()) and bodies is None:
        theta = _of_a_body(fit, messages)
        values = about_centre(theta[:10])
    mass, centre, inertia = values[0], values[1:4], matrix_of(values[4:])
    unobserved = tuple(name for name in _NAMES if lost[name])
    if unobserved:
        messages.append(
            f"not observed: {', '.join(unobserved)}; turn the sensor about two axes for mass and centre,"
            f" and shake"
            " the load about three for its inertia"
        )
    found = {"mass": np.asarray(mass), "centre": centre, "inertia": inertia}
    spread = {"mass": errors[0], "centre": errors[1:4], "inertia": matrix_of(errors[4:])}
    for name in unobserved:
        found[name] = np.full_like(found[name], np.nan)
        spread[name] = np.full_like(spread[name], np.inf)
    return Load(
        mass=float(found["mass"]),
        centre=found["centre"],
        inertia=found["inertia"],
        standard_errors={name: np.asarray(value) for name, value in spread.items()},
        force_bias=theta[10:13],
        torque_bias=theta[13:16],
        drift=theta[16:22] if len(theta) > 16 else np.zeros(6),
        force_noise=float(fit.noise[0]),
        torque_noise=float(fit.noise[1]),
        unobserved=unobserved,
        messages=tuple(messages),
    )


def _check_within(values: np.ndarray, errors: np.ndarray, bodies: np.ndarray) -> None:
    """Refuse a shape that does not hold the centre of mass.

    Raises:
        ValueError: If it does not, by more than chance.
    """
    points = bodies[1:4].T
    off = values[1:4] - np.clip(values[1:4], points.min(axis=0), points.max(axis=0))
    if np.any(np.abs(off) > _OUTSIDE * errors[1:4] + 1e-3):
        raise ValueError(
            "shape must be points of the load in the sensor's frame, in metres: the log shows the centre of"
            f" mass at {np.round(values[1:4], 4)} m, the points reach from {np.round(points.min(axis=0), 4)}"
            f" to {np.round(points.max(axis=0), 4)} m"
        )


def _lost(fit: _Fit, values: np.ndarray, errors: np.ndarray) -> dict[str, bool]:
    """What is not observed: what no data depend on, and what is not known to a quarter of its size."""
    mass, centre, trace = values[0], values[1:4], abs(values[4:7].sum())
    size = max(np.linalg.norm(centre), np.sqrt(trace / 2 / max(mass, 1e-12)))
    of_mass = fit.null[0] > 1e-3 or errors[0] > _UNSURE * mass
    of_centre = of_mass or fit.null[1:4].max() > 1e-3 or errors[1:4].max() > _UNSURE * size
    of_inertia = of_centre or fit.null[4:10].max() > 1e-3 or np.linalg.norm(errors[4:7]) > _UNSURE * trace
    return {"mass": bool(of_mass), "centre": bool(of_centre), "inertia": bool(of_inertia)}


# --- inertias -----------------------------------------------------------------------------------------------


def _of_a_body(fit: _Fit, messages: list[str]) -> np.ndarray:
    """θ, or where no body has it the likeliest that one can have."""
    if np.linalg.eigvalsh(_pseudo(fit.theta[:10])).min() > 0:
        return fit.theta
    from scipy.optimize import least_squares

    wanted = np.linalg.inv(fit.covariance)
    root = np.linalg.cholesky(wanted + 1e-12 * np.trace(wanted) * np.eye(len(wanted))).T

    def off(x: np.ndarray) -> np.ndarray:
        return root @ (np.concatenate([_of_factor(x[:10]), x[10:]]) - fit.theta)

    values, vectors = np.linalg.eigh(_pseudo(fit.theta[:10]))
    near = (vectors * np.maximum(values, 1e-6 * values.max())) @ vectors.T
    factor = np.linalg.cholesky(near)
    start = np.concatenate([np.log(np.diagonal(factor)), factor[np.tril_indices(4, -1)], fit.theta[10:]])
    best = least_squares(off, start, x_scale="jac").x
    messages.append(
        "the least squares are those of no body: the likeliest inertia that a body can have is given"
    )
    return np.concatenate([_of_factor(best[:10]), best[10:]])


def _pseudo(theta: np.ndarray) -> np.ndarray:
    """Second moments, first moments and mass as one matrix: positive definite for every body, and only these.

    Wensing, Kim and Slotine, Linear matrix inequalities for physically consistent inertial parameter
    identification, 2018.
    """
    inertia = matrix_of(theta[4:10])
    found = np.zeros((4, 4))
    found[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    found[:3, 3] = found[3, :3] = theta[1:4]
    found[3, 3] = theta[0]
    return found


def _of_factor(x: np.ndarray) -> np.ndarray:
    """Mass, first moments and inertia about the origin from the logarithmic Cholesky factor of `_pseudo`."""
    factor = np.zeros((4, 4))
    factor[np.diag_indices(4)] = np.exp(np.clip(x[:4], -40, 20))
    factor[np.tril_indices(4, -1)] = x[4:]
    found = factor @ factor.T
    inertia = np.trace(found[:3, :3]) * np.eye(3) - found[:3, :3]
    return np.concatenate([[found[3, 3]], found[:3, 3], six_of(inertia)])


def _slopes(theta: np.ndarray) -> np.ndarray:
    """Derivatives of `about_centre`, by central differences."""
    found = np.empty((10, 10))
    for k in range(10):
        step = np.zeros(10)
        step[k] = 1e-6 * max(abs(theta[k]), 1e-6)
        found[:, k] = (about_centre(theta + step) - about_centre(theta - step)) / (2 * step[k])
    return found


def _inertial(vectors: np.ndarray) -> np.ndarray:
    """What takes the six numbers of an inertia to its product with vectors, shape (n, 3, 6)."""
    x, y, z = vectors.T
    none = np.zeros_like(x)
    rows = [[x, none, none, y, z, none], [none, y, none, x, none, z], [none, none, z, none, x, y]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _cross(vectors: np.ndarray) -> np.ndarray:
    """What takes a vector to its product with vectors from the left, shape (n, 3, 3)."""
    x, y, z = vectors.T
    none = np.zeros_like(x)
    rows = [[none, -z, y], [z, none, -x], [-y, x, none]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
