"""Mass properties as ten numbers: those that a body can have, and those of one within a given shape.

The ten numbers are the mass, the first moments and the inertia about the origin (xx, yy, zz, xy, xz, yz).
They are linear in where mass is, so bodies within a shape are a convex cone.
"""

from collections.abc import Sequence

import numpy as np

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
