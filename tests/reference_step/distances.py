"""Signed distance [m] and outward unit normal of solids at points x (n, 3) in their own frame."""

import numpy as np

import dano
from dano.fields import SignedDistanceGrid


def signed_distance(solid, x):
    """Distances (n,), negative inside, and normals (n, 3).

    Raises:
        ValueError: If the reference does not know the solid.
    """
    if type(solid) not in SOLIDS:
        raise ValueError(f"solid must be one of {[kind.__name__ for kind in SOLIDS]}, got {solid!r}")
    distance, gradient = SOLIDS[type(solid)](solid, x)
    size = np.linalg.norm(gradient, axis=1, keepdims=True)
    return distance, gradient / np.maximum(size, 1e-6)


def half_space(solid, x):
    normal = np.asarray(solid.normal_direction)
    return x @ normal - float(solid.offset), np.broadcast_to(normal, x.shape)


def sphere(solid, x):
    return np.linalg.norm(x, axis=1) - float(solid.radius), x


def capsule(solid, x):
    end = float(solid.half_length)
    away = x - np.clip(x[:, 2:], -end, end) * np.array([0, 0, 1])  # from the closest point of the axis
    return np.linalg.norm(away, axis=1) - float(solid.radius), away


def box(solid, x):
    rounding = float(solid.rounding)
    distance, gradient = corner(np.abs(x) - (np.asarray(solid.half_extents) - rounding))
    return distance - rounding, np.where(x < 0, -1, 1) * gradient


def cylinder(solid, x):
    across = np.linalg.norm(x[:, :2], axis=1)
    excess = np.stack([across - float(solid.radius), np.abs(x[:, 2]) - float(solid.half_length)], axis=1)
    distance, gradient = corner(excess)
    out = x[:, :2] / np.where(across > 0, across, 1)[:, None]
    along = np.where(x[:, 2:] < 0, -1, 1) * gradient[:, 1:]
    return distance, np.concatenate([out * gradient[:, :1], along], axis=1)


def corner(excess):
    """Distance and gradient of {e ≤ 0} from how far points lie beyond each of its perpendicular faces."""
    beyond = np.maximum(excess, 0)
    length, nearest = np.linalg.norm(beyond, axis=1), excess.max(axis=1)
    faces = (excess == nearest[:, None]) / np.sum(excess == nearest[:, None], axis=1, keepdims=True)
    outside = length > 0
    gradient = np.where(outside[:, None], beyond / np.where(outside, length, 1)[:, None], faces)
    return np.where(outside, length, nearest), gradient


def ellipsoid(solid, x):
    """The closest surface point is a² x/(t + a²) with Σ (a x/(t + a²))² = 1 and t > −min a²; by halving."""
    a = np.asarray(solid.semi_axes)
    shift = np.min(a**2)
    low, high = np.zeros(len(x)), np.linalg.norm(a * x, axis=1)
    for _ in range(100):
        s = 0.5 * (low + high)  # t + min a²
        inside = np.sum((a * x / (s[:, None] + a**2 - shift)) ** 2, axis=1) < 1
        low, high = np.where(inside, low, s), np.where(inside, s, high)
    away = x / (high[:, None] + a**2 - shift)
    return (high - shift) * np.linalg.norm(away, axis=1), away


def grid(solid, x):
    """The spline within the grid; outside that of the grid's closest point, plus the way to there."""
    degree = {"linear": 1, "quadratic": 2, "cubic": 3}[solid.interpolation]
    coefficients, spacing = np.asarray(solid.coefficients), np.asarray(solid.spacing)
    border = degree + 1
    u = (x - np.asarray(solid.origin)) / spacing
    closest = np.clip(u, 0, np.array(coefficients.shape) - 2 * border - 1)
    value, gradient = spline(coefficients, closest + border, degree)
    beyond = (u - closest) * spacing
    length = np.linalg.norm(beyond, axis=1)
    away = beyond / np.where(length > 0, length, 1)[:, None]
    return value + length, np.where(u == closest, gradient / spacing, 0) + away


def spline(coefficients, u, degree):
    """Σ c[i, j, k] β(u₀ − i) β(u₁ − j) β(u₂ − k), and its gradient, at u (n, 3) in index units."""
    first = np.floor(u - (degree - 1) / 2).astype(int)
    reach = np.arange(degree + 1)
    nodes = first[:, :, None] + reach  # (n, axis, node)
    weights, slopes = basis(degree, u[:, :, None] - nodes), basis_slope(degree, u[:, :, None] - nodes)
    nodes = np.minimum(nodes, np.array(coefficients.shape)[:, None] - 1)  # beyond the last, where β is zero
    block = coefficients[nodes[:, 0, :, None, None], nodes[:, 1, None, :, None], nodes[:, 2, None, None, :]]

    def total(*axes):
        return np.einsum("nijk,ni,nj,nk->n", block, *axes, optimize=True)

    x, y, z = weights[:, 0], weights[:, 1], weights[:, 2]
    gradient = [total(slopes[:, 0], y, z), total(x, slopes[:, 1], z), total(x, y, slopes[:, 2])]
    return total(x, y, z), np.stack(gradient, axis=1)


def basis(degree, t):
    """The centred B-spline β of a degree, by the recursion of Cox and de Boor."""
    if degree == 0:
        return np.where((t >= -0.5) & (t < 0.5), 1.0, 0.0)
    half = (degree + 1) / 2
    return ((half + t) * basis(degree - 1, t + 0.5) + (half - t) * basis(degree - 1, t - 0.5)) / degree


def basis_slope(degree, t):
    return basis(degree - 1, t + 0.5) - basis(degree - 1, t - 0.5)


SOLIDS = {
    dano.HalfSpace: half_space,
    dano.Sphere: sphere,
    dano.Box: box,
    dano.Capsule: capsule,
    dano.Cylinder: cylinder,
    dano.Ellipsoid: ellipsoid,
    SignedDistanceGrid: grid,
}
