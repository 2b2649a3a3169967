"""The least squares from which mass, centre and inertia of a load come, whatever was read.

Mass properties as ten numbers: those that a body can have, and those of one within a given shape.

The ten numbers are the mass, the first moments and the inertia about the origin (xx, yy, zz, xy, xz, yz).
They are linear in where mass is, so bodies within a shape are a convex cone.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from dano.identification.wrench._log import Twists
from dano.maths import quat_conjugate, quat_rotate, skew
from dano.objects import MassProperties

_FILLING = 400
"""Points in the hull of a shape at which there may be mass."""

_DRAWS = 100
"""Draws of the least squares estimate, for the errors of the estimate within the shape."""


def point_masses(shape: np.ndarray) -> np.ndarray:
    """The ten numbers of one kilogram at points of a convex hull, shape (10, m).

    Args:
        shape: Points [m], shape (n, 3).

    Raises:
        ValueError: If there are fewer than four, or they lie in a plane.
    """
    if shape.ndim != 2 or shape.shape[1] != 3 or not np.isfinite(shape).all():
        raise ValueError(f"shape must be points [m], shape (n, 3), got an array of shape {shape.shape}")
    from scipy.spatial import ConvexHull, QhullError

    try:
        corners = shape[ConvexHull(shape).vertices]
    except (QhullError, ValueError) as error:
        raise ValueError(
            f"shape must have points that do not lie in one plane, got {len(shape)} points"
        ) from error
    random = np.random.default_rng(0)
    # Means of two corners, of three and more: what lies deep inside is as likely as what lies near an edge.
    weights = random.dirichlet(np.full(len(corners), min(1.0, 4.0 / len(corners))), _FILLING)
    points = np.concatenate([corners[:: 1 + len(corners) // _FILLING], weights @ corners])
    squares = np.einsum("ni,nj->nij", points, points)
    inertias = np.trace(squares, axis1=1, axis2=2)[:, None, None] * np.eye(3) - squares
    return np.concatenate([np.ones((1, len(points))), points.T, np.array([six_of(i) for i in inertias]).T])


def within_shape(
    theta: np.ndarray, covariance: np.ndarray, bodies: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The likeliest ten numbers of a body within a shape, and the errors of what they are about its centre.

    Args:
        theta: Least squares estimate of the ten numbers.
        covariance: Its covariance, shape (10, 10).
        bodies: The ten numbers of point masses, shape (10, m).

    Returns:
        The ten numbers, and standard errors of mass, centre and inertia about it: how far estimates of
        logs from such a body scatter about it.
    """
    from scipy.optimize import nnls

    scale, root = _root(covariance)
    whitened = np.linalg.solve(root, bodies / scale[:, None])

    def likeliest(values: np.ndarray) -> np.ndarray:
        masses, _ = nnls(whitened, np.linalg.solve(root, values / scale))
        return bodies @ masses

    best = likeliest(theta)
    drawn = np.random.default_rng(0).standard_normal((_DRAWS, 10)) @ root.T * scale
    off = np.array([about_centre(likeliest(best + each)) for each in drawn]) - about_centre(best)
    return best, np.sqrt(np.mean(off**2, axis=0))


def of_a_body(theta: np.ndarray, covariance: np.ndarray) -> np.ndarray | None:
    """The likeliest ten numbers that a body can have; None if `theta` are those of one.

    Args:
        theta: Least squares estimate of the ten numbers.
        covariance: Its covariance, shape (10, 10).
    """
    if np.linalg.eigvalsh(_pseudo(theta)).min() > 0:
        return None
    from scipy.optimize import least_squares

    scale, root = _root(covariance)

    def off(x: np.ndarray) -> np.ndarray:
        return np.linalg.solve(root, (_of_factor(x) - theta) / scale)

    values, vectors = np.linalg.eigh(_pseudo(theta))
    near = (vectors * np.maximum(values, 1e-6 * values.max())) @ vectors.T
    factor = np.linalg.cholesky(near)
    start = np.concatenate([np.log(np.diagonal(factor)), factor[np.tril_indices(4, -1)]])
    return _of_factor(least_squares(off, start, x_scale="jac").x)


def _root(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations, and the Cholesky factor of the correlations, which may be singular to rounding."""
    scale = np.sqrt(np.diagonal(covariance))
    return scale, np.linalg.cholesky(covariance / np.outer(scale, scale) + 1e-12 * np.eye(len(scale)))


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


def about_centre(theta: np.ndarray) -> np.ndarray:
    """Mass, centre and the six numbers of the inertia about it."""
    mass = theta[0] if abs(theta[0]) > 1e-12 else 1e-12
    centre = theta[1:4] / mass
    inertia = matrix_of(theta[4:10]) - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return np.concatenate([[theta[0]], centre, six_of(inertia)])


def matrix_of(six: Sequence[float] | np.ndarray) -> np.ndarray:
    """A symmetric matrix from its xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def six_of(matrix: np.ndarray) -> np.ndarray:
    """The xx, yy, zz, xy, xz, yz of a symmetric matrix."""
    return matrix[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


_PASSES = 4
"""Passes of weighted least squares: noise of each kind of reading from the residuals of the pass before."""

_NULL = 1e-9
"""Share of the largest curvature below which a direction is not determined at all."""

UNSURE = 0.25
"""Standard error, as a share of the value, from which a value is not observed."""

_SURE = 1.96
"""Standard errors of a 95 % interval."""

STRONG = 40.0
"""Fall of χ² from which a drift or a slip is believed: 6 numbers without meaning fall it by 6 ± 3.5."""

_DEGREES = (1, 3, 5)
"""Of a drifting bias as a polynomial of the time."""

_SLIP, _SLIPS = 5e-4, 11
"""Least way of a centre of mass that counts as a slip [m]; moments at which one is looked for."""

_OUTSIDE = 4.0
"""Standard errors by which a centre of mass may lie outside of a given shape."""

_NAMES = ("mass", "centre", "inertia")


@dataclasses.dataclass(frozen=True, eq=False)
class Load:
    """What a sensor, or the last link of an arm, holds, in its frame S. NaN: not observed."""

    mass: float  # [kg]
    centre: np.ndarray  # Of mass [m, S], shape (3,)
    inertia: np.ndarray  # About the centre of mass [kg m², axes of S], shape (3, 3)
    # Of these three, by name, in the same shapes; infinite where not observed.
    standard_errors: dict[str, np.ndarray]
    force_bias: np.ndarray  # What the sensor shows without a load [N, S], at the middle of the log
    torque_bias: np.ndarray  # The same [N m, S]
    drift: np.ndarray  # How much both change over the whole log [N, N m], shape (6,); zeros where they do not
    force_noise: float  # Standard deviation of a force [N]
    torque_noise: float  # Of a torque [N m]
    unobserved: tuple[str, ...]  # Which of mass, centre, inertia the log cannot decide
    messages: tuple[str, ...]  # What was found odd or corrected, in words
    # Constant part of the torques of an arm's joints [N m], shape (k,); None for the log of a wrist, as are
    # the other three. What belongs to a wrist is NaN for an arm.
    joint_bias: np.ndarray | None = None
    # Of each joint: Coulomb's [N m] and viscous [N m s/rad], shape (k, 2).
    joint_friction: np.ndarray | None = None
    joint_noise: np.ndarray | None = None  # Standard deviation of each joint's torque [N m], shape (k,)
    # How much the bias of each joint changes over the whole log [N m], shape (k,); zeros where it does not.
    joint_drift: np.ndarray | None = None

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


@dataclasses.dataclass(frozen=True, eq=False)
class Rows:
    """The linear model: readings (n, r) at times from −½ to ½, and their derivatives (n, r, p).

    The first ten columns are those of mass, first moments and inertia. Readings of one kind, shape (r,),
    share a noise.
    """

    times: np.ndarray
    readings: np.ndarray
    table: np.ndarray
    kinds: np.ndarray

    def beside(self, columns: np.ndarray) -> "Rows":
        """With further columns, shape (n, r, k)."""
        return dataclasses.replace(self, table=np.concatenate([self.table, columns], axis=2))


def shares(times: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Times of some rows of a log, from −½ at its beginning to ½ at its end."""
    return (times[rows] - 0.5 * (times[0] + times[-1])) / (times[-1] - times[0])


def wrench_table(moved: Twists, gravity: np.ndarray) -> np.ndarray:
    """Derivatives of force and torque by mass, first moments and inertia, in axes of S, shape (n, 6, 10)."""
    count = len(moved.rows)
    down = np.asarray(quat_rotate(quat_conjugate(moved.turn), np.broadcast_to(gravity, (count, 3))))
    felt = moved.acceleration - down
    spin, rate = skew(moved.omega), skew(moved.alpha)
    table = np.zeros((count, 6, 10))
    table[:, :3, 0] = felt
    table[:, :3, 1:4] = rate + spin @ spin
    table[:, 3:, 1:4] = -skew(felt)
    table[:, 3:, 4:10] = _inertial(moved.alpha) + spin @ _inertial(moved.omega)
    return table


@dataclasses.dataclass(frozen=True, eq=False)
class LoadFit:
    """Where weighted least squares ended: θ, its covariance, directions without data, noise, χ²."""

    theta: np.ndarray
    covariance: np.ndarray
    null: np.ndarray
    noise: np.ndarray
    chi2: float
    inflation: float


def fitted(rows: Rows, noise: np.ndarray | None = None) -> LoadFit:
    """Least squares with weights from the residuals, or from a noise that is known."""
    n, _, p = rows.table.shape
    counts = np.bincount(rows.kinds)
    sigma = np.ones(len(counts)) if noise is None else noise
    theta = covariance = null = residuals = np.zeros(0)
    for _ in range(_PASSES if noise is None else 1):
        weight = 1 / sigma[rows.kinds]
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
            free = np.maximum(n * counts - p / len(counts), 1.0)
            sums = np.bincount(rows.kinds, np.sum(residuals**2, axis=0))
            sigma = np.maximum(np.sqrt(sums / free), 1e-12)
    chi2 = float(np.sum((residuals / sigma[rows.kinds]) ** 2))
    return LoadFit(theta, covariance, null, sigma, chi2, _inflation(residuals))


def _inflation(residuals: np.ndarray) -> float:
    """By how much neighbouring rows are no news: (1 + ρ)/(1 − ρ) of their correlation, at least 1."""
    above, below = residuals[1:].ravel(), residuals[:-1].ravel()
    correlation = float(np.sum(above * below) / max(np.sum(residuals**2), 1e-300))
    correlation = min(max(correlation, 0.0), 0.98)
    return (1 + correlation) / (1 - correlation)


def drifting(rows: Rows, fit: LoadFit) -> tuple[Rows, LoadFit, np.ndarray | None]:
    """The model and its fit with a bias that changes with time, where that is seen.

    It is a polynomial of the time, of the first degree, or of the third or fifth where these fit better by
    more than chance: a sensor that warms up drifts fast at first. A drift that ends where it began is not
    looked for: friction that is not quite that of the model looks like one.

    Args:
        rows: The model.
        fit: Its fit.

    Returns:
        Both, and by how much the bias of each reading changes over the log, shape (r,). Those that came and
        None where no drift is seen.
    """
    count, plain, change = rows.readings.shape[1], rows, None
    for degree in _DEGREES:
        powers = [plain.times[:, None, None] ** k * np.eye(count) for k in range(1, degree + 1)]
        longer = plain.beside(np.concatenate(powers, axis=2))
        found = fitted(longer, fit.noise)
        added = longer.table.shape[2] - rows.table.shape[2]
        if (fit.chi2 - found.chi2) / found.inflation < STRONG + added - 6:
            break
        rows, fit = longer, fitted(longer)
        # From t = -1/2 to 1/2; what is even in t ends where it began.
        terms = fit.theta[-degree * count :].reshape(degree, count)
        change = np.sum(terms[::2] * 0.25 ** np.arange((degree + 1) // 2)[:, None], axis=0)
    return rows, fit, change


def check_slip(rows: Rows, fit: LoadFit, times: np.ndarray) -> None:
    """Refuse a load that slips.

    Args:
        rows: The model.
        fit: Its fit.
        times: Of the log [s].

    Raises:
        ValueError: If its centre of mass moves in the gripper.
    """
    best, when, shift = 0.0, 0.0, np.zeros(3)
    for moment in np.linspace(-0.4, 0.4, _SLIPS):
        later = (rows.times > moment)[:, None, None]
        split = fitted(rows.beside(later * rows.table[:, :, 1:10]), fit.noise)
        fall = (fit.chi2 - split.chi2) / split.inflation
        if fall > best:
            best, when, shift = fall, moment, split.theta[-9:-6] / fit.theta[0]
    if best > STRONG and (way := float(np.linalg.norm(shift))) > _SLIP:
        at = 0.5 * (times[0] + times[-1]) + when * (times[-1] - times[0])
        raise ValueError(
            f"the load must be held fast: its centre of mass moves by {1e3 * way:.2g} mm in the gripper"
            f" at about {at:.3g} s; take the part of the log before or after it (log.part)"
        )


def load_of(
    fit: LoadFit,
    messages: list[str],
    bodies: np.ndarray | None,
    sensor: Callable[[np.ndarray], dict[str, Any]],
) -> Load:
    """Values, errors, and what is not observed.

    Args:
        fit: The fit.
        messages: What was found so far.
        bodies: Of `point_masses`; None: the shape is not known.
        sensor: What further numbers of θ say, as fields of `Load`.
    """
    theta = fit.theta
    covariance = fit.inflation * fit.covariance
    values, jacobian = about_centre(theta[:10]), _slopes(theta[:10])
    errors = np.sqrt(np.diagonal(jacobian @ covariance[:10, :10] @ jacobian.T))
    if bodies is not None and fit.null[:4].max() < 1e-3:
        _check_within(values, errors, bodies)
        if fit.null[:10].max() < 1e-3:
            best, errors = within_shape(theta[:10], covariance[:10, :10], bodies)
            theta, values = _following(theta, covariance, best), about_centre(best)
    lost = _lost(fit, values, errors)
    if not any(lost.values()) and bodies is None:
        likely = of_a_body(theta[:10], covariance[:10, :10])
        if likely is not None:
            theta, values = _following(theta, covariance, likely), about_centre(likely)
            messages.append(
                "the least squares are those of no body: the likeliest inertia that a body can have is given"
            )
    mass, centre, inertia = values[0], values[1:4], matrix_of(values[4:])
    unobserved = tuple(name for name in _NAMES if lost[name])
    if unobserved:
        messages.append(
            f"not observed: {', '.join(unobserved)}; turn the sensor about two axes for mass and centre,"
            " and shake the load about three for its inertia"
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
        unobserved=unobserved,
        messages=tuple(messages),
        **sensor(theta),
    )


def _following(theta: np.ndarray, covariance: np.ndarray, best: np.ndarray) -> np.ndarray:
    """θ with other first ten numbers, the rest at its likeliest for these."""
    follow = covariance[10:, :10] @ np.linalg.solve(covariance[:10, :10], best - theta[:10])
    return np.concatenate([best, theta[10:] + follow])


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


def _lost(fit: LoadFit, values: np.ndarray, errors: np.ndarray) -> dict[str, bool]:
    """What is not observed: what no data depend on, and what is not known to a quarter of its size."""
    mass, centre, trace = values[0], values[1:4], abs(values[4:7].sum())
    size = max(np.linalg.norm(centre), np.sqrt(trace / 2 / max(mass, 1e-12)))
    of_mass = fit.null[0] > 1e-3 or errors[0] > UNSURE * mass
    of_centre = of_mass or fit.null[1:4].max() > 1e-3 or errors[1:4].max() > UNSURE * size
    of_inertia = of_centre or fit.null[4:10].max() > 1e-3 or np.linalg.norm(errors[4:7]) > UNSURE * trace
    return {"mass": bool(of_mass), "centre": bool(of_centre), "inertia": bool(of_inertia)}


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
