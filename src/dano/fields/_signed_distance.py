"""Shapes from a sampled signed distance.

Signed distances at the nodes of a grid, from a level set or from the points of a surface.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from dano.compiling import one_program
from dano.fields._base import check_order, Jet
from dano.fields._grid import (
    border,
    checked_spacing,
    degree_of,
    interpolating_coefficients,
    node_values,
    scaled_jet,
    spline_jet,
)
from dano.fields._shapes import AbstractShape, checked_edge, scaled_moments, SolidMoments
from dano.maths import AnyArray, checked_array, checked_floating, column_norm, is_traced, library, Numbers, Q

_NEAR = 3
"""Cells within which a node's distance is that to its own nearest point of the surface."""


def redistanced(
    level: Float[np.ndarray, "nx ny nz"], spacing: Float[np.ndarray, "3"] | float
) -> Float[np.ndarray, "nx ny nz"]:
    """Signed distances [m] to the zero level of values at nodes, negative where these are.

    Where the level crosses an edge of the grid lies a point of the surface, with a tangent plane. Nodes
    within three cells get the distance to the plane of the nearest of them, or to the point if they are not
    above it; those further away the distance to the point nearest to the nearest such node.

    Args:
        level: Values at the nodes, of both signs.
        spacing: Distance [m] between nodes, along each axis or along all of them.
    """
    from scipy import ndimage
    from scipy.spatial import cKDTree

    step = np.broadcast_to(np.asarray(spacing, np.float64), (3,))
    # In units of the longest side of a cell.
    size, sides = float(step.max()), step / step.max()
    cloud, normal = _crossings(level, sides)
    positive = level > 0
    touched = ndimage.binary_dilation(positive) & ~ndimage.binary_erosion(positive, border_value=1)
    near = np.asarray(ndimage.distance_transform_edt(~touched, sampling=sides)) <= _NEAR
    nodes = sides * np.argwhere(near)
    distance, nearest = cKDTree(cloud).query(nodes)
    distances, _ = spread_distances(near, cloud[nearest], np.zeros(3), sides)
    planar = np.abs(np.einsum("ij,ij->i", nodes - cloud[nearest], normal[nearest]))
    # Crossings lie up to a cell apart: near the surface the plane through one is closer than the point.
    blend = np.clip(distance - 1, 0, 1)
    distances[near] = (1 - blend) * np.minimum(planar, distance) + blend * distance
    return np.where(positive, distances, -distances) * size


def _crossings(level: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the level crosses edges of a grid with cells of some sides, and unit normals there."""
    points, normals = [], []
    slope = np.stack(list(np.gradient(level)), axis=-1) / sides
    for axis in range(3):
        low = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
        high = tuple(slice(1, None) if a == axis else slice(None) for a in range(3))
        cross = np.argwhere((level[low] > 0) != (level[high] > 0))
        ahead = cross + np.eye(3, dtype=int)[axis]
        a, b = level[tuple(cross.T)], level[tuple(ahead.T)]
        share = (a / (a - b))[:, None]
        points.append(cross + share * np.eye(3)[axis])
        normals.append((1 - share) * slope[tuple(cross.T)] + share * slope[tuple(ahead.T)])
    normal = np.concatenate(normals)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.concatenate(points) * sides, normal / np.where(length > 0, length, 1)


def spread_distances(
    near: np.ndarray, closest: np.ndarray, origin: np.ndarray, spacing: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distances of all nodes of a grid to a surface, from its points closest to the nodes near it.

    Args:
        near: Which nodes are near, shape (nx, ny, nz).
        closest: Point of the surface closest to each of these [m], in their order, shape (m, 3).
        origin: Position [m] of node (0, 0, 0), shape (3,).
        spacing: Distance [m] between nodes along each axis, shape (3,).

    Returns:
        Distance [m] of each node to the closest point of the nearest node that is near, and the row of that
        node in `closest`; both of shape (nx, ny, nz).
    """
    from scipy import ndimage

    row = np.full(near.shape, -1)
    row[near] = np.arange(len(closest))
    nearest = ndimage.distance_transform_edt(
        ~near, sampling=spacing, return_distances=False, return_indices=True
    )
    row = row[tuple(nearest)]
    nodes = origin + spacing * np.stack(np.meshgrid(*map(np.arange, near.shape), indexing="ij"), axis=-1)
    return np.linalg.norm(nodes - closest[row], axis=-1), row


_EXTENSION = 16
"""Nodes added by odd reflection, which continues a slope, to keep the spline filter's ends away."""


class SignedDistanceGrid(AbstractShape):
    """A shape whose signed distance is sampled on a regular grid.

    Inside the grid the distance is the spline through the samples. Outside it is the distance at the closest
    point of the grid plus the distance to that point: continuous, growing in every direction, never below the
    true distance.
    """

    coefficients: Float[Array, "px py pz"]  # Spline coefficients of the distance [m], with a border
    origin: Float[Array, "3"]  # Position [m, F] of node (0, 0, 0)
    spacing: Float[Array, "3"]  # Distance [m] between nodes along each axis
    solid_bounds: Float[Array, "2 3"]  # Box [m, F] around the solid, to within one cell, shape (2, 3)
    edge: Float[Array, ""] | None  # Width [m] of the smooth edge, or None
    moments: SolidMoments | None  # Moments of the solid if known, else None
    interpolation: str = eqx.field(static=True)  # "linear", "quadratic" or "cubic" (static)
    kind: ClassVar = "grid"

    def __init__(
        self,
        distances: Numbers,
        origin: Numbers,
        spacing: Numbers,
        interpolation: str = "quadratic",
        *,
        edge: ArrayLike | None = None,
        moments: SolidMoments | None = None,
    ):
        """Build a shape from signed distances at nodes (i, j, k), at origin + spacing · (i, j, k).

        Args:
            distances: Signed distances [m], negative inside, shape (nx, ny, nz); positive on the border of
                the grid.
            origin: Position [m, F] of node (0, 0, 0), shape (3,).
            spacing: Distance [m] between nodes, a number or shape (3,).
            interpolation: "linear", "quadratic" or "cubic".
            edge: Width [m] of the smooth edge; None means 0.5 % of the size.
            moments: Volume, centroid and second moment of the solid, if known in closed form.

        Raises:
            ValueError: If a shape is wrong, a value is not finite, no node is inside, a node on the border of
                the grid is, the spacing is not positive, the interpolation is not known, or `distances` is
                traced.
        """
        degree = degree_of(interpolation)
        host = _checked_distances(distances)
        self.origin = checked_array("origin", origin, (3,))
        self.spacing = checked_spacing(spacing)
        self.edge = checked_edge(edge)
        self.moments = moments
        self.interpolation = interpolation
        extended = np.pad(host, _EXTENSION, mode="reflect", reflect_type="odd")
        keep = slice(_EXTENSION - border(degree), border(degree) - _EXTENSION)
        self.coefficients = jnp.asarray(interpolating_coefficients(extended, degree)[keep, keep, keep])
        inside = np.argwhere(host <= 0)
        # The surface passes within one cell of a node that is inside.
        cells = np.stack([inside.min(0) - 1, inside.max(0) + 1])
        self.solid_bounds = _corners(self.origin, self.spacing, cells)

    @property
    def distances(self) -> Float[Array, "nx ny nz"]:
        """Signed distances [m] at the nodes."""
        return node_values(self.coefficients, degree_of(self.interpolation))

    def leaf(self) -> dict[str, AnyArray]:
        """See `AbstractPrimitive.leaf`."""
        return {"sizes": self.origin, "spacing": self.spacing}

    @property
    @one_program
    def bounds(self) -> Float[Array, "2 3"]:
        """Box [m, F] around the solid and its smooth edge."""
        reach = jnp.broadcast_to(0.5 * self.edge_width.astype(self.solid_bounds.dtype), (3,))
        return self.solid_bounds + jnp.stack([-reach, reach])

    @property
    @one_program
    def size(self) -> Float[Array, ""]:
        """Largest extent of the solid [m], to within two cells."""
        return jnp.max(self.solid_bounds[1] - self.solid_bounds[0])

    def _split(self, x: Float[Q, "3 n"]) -> tuple[Q, Q, Q]:
        """Closest points of the grid in index units, the way [m] from there to `x`, whether it is zero."""
        xp = library(x, self.origin, self.spacing)
        n_border = border(degree_of(self.interpolation))
        last = xp.asarray([size - 2 * n_border - 1 for size in self.coefficients.shape], x.dtype)
        spacing = self.spacing.astype(x.dtype)[:, None]
        u = (x - self.origin.astype(x.dtype)[:, None]) / spacing
        inside = (u >= 0) & (u <= last[:, None])
        closest = xp.clip(u, 0, xp.broadcast_to(last[:, None], u.shape))
        return closest, xp.where(inside, 0, (u - closest) * spacing), inside

    def sdf(self, x: Float[Array, "3"]) -> Float[Array, ""]:
        """Signed distance [m] at `x` [m, F], as accurate as its interpolation."""
        closest, beyond, _ = self._split(x[:, None])
        rows = spline_jet(self.coefficients, closest, degree_of(self.interpolation), 0)
        return rows[0, 0] + column_norm(beyond)[0]

    def sdf_jet(self, x: Float[Q, "3 n"], order: int) -> Jet:
        """See `AbstractShape.sdf_jet`; closed forms, as fast as a `GridField`."""
        check_order(order)
        xp = library(x, self.origin, self.spacing)
        closest, beyond, inside = self._split(x)
        coefficients: Any = self.coefficients
        rows = spline_jet(coefficients, closest, degree_of(self.interpolation), order)
        spacing: Any = self.spacing.astype(x.dtype)
        jet = scaled_jet(rows, spacing, order)
        distance = column_norm(beyond)
        if order == 0:
            return jet + distance
        value, gradient, *hessian = jet
        safe = xp.where(distance > 0, distance, 1)[None]
        away = beyond / safe
        # Moving along an axis on which the point lies outside leaves the closest point where it is.
        moves = inside.astype(x.dtype)
        first = (value + distance, moves * gradient + away)
        if order == 1:
            return first
        turning = xp.eye(3, dtype=x.dtype)[:, :, None] * (1 - moves)[None] - away[:, None] * away[None]
        return *first, moves[:, None] * moves[None] * hessian[0] + turning / safe[None]

    def solid_moments(self) -> SolidMoments | None:
        """The moments given at construction: those of the mesh for a shape made by `mesh_field`."""
        return self.moments

    def scaled(self, factor: Float[Array, ""]) -> "SignedDistanceGrid":
        """This shape enlarged about its origin."""
        lengths = (self.coefficients, self.origin, self.spacing, self.solid_bounds, self.edge)
        made = eqx.tree_at(
            lambda shape: (shape.coefficients, shape.origin, shape.spacing, shape.solid_bounds, shape.edge),
            self,
            tuple(None if x is None else x * factor.astype(x.dtype) for x in lengths),
            is_leaf=lambda x: x is None,
        )
        moments = None if self.moments is None else scaled_moments(self.moments, factor)
        return eqx.tree_at(lambda shape: shape.moments, made, moments, is_leaf=lambda x: x is None)


def extended_distances(distances: np.ndarray, spacing: np.ndarray, width: float) -> np.ndarray:
    """Signed distances that are right near the surface only, as level sets keep them, made right everywhere.

    Args:
        distances: Shape (nx, ny, nz), cut off at ± `width`.
        spacing: Distance between nodes along each axis, shape (3,).
        width: Must be wider than a cell.

    Raises:
        ValueError: If no node is more than a cell within the width.
    """
    # Only there do central differences see no value that was cut off.
    near = np.abs(distances) <= width - 1.01 * spacing.max()
    if not near.any():
        raise ValueError(f"distances must be known to more than a cell from the surface, got {width}")
    slope = np.stack([part[near] for part in np.gradient(distances, *spacing)], axis=-1)
    slope = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
    closest = spacing * np.argwhere(near) - distances[near][:, None] * slope
    far, _ = spread_distances(near, closest, np.zeros(3), spacing)
    return np.where(np.abs(distances) < (1 - 1e-6) * width, distances, np.copysign(far, distances))


@one_program
def _corners(
    origin: Float[Array, "3"], spacing: Float[Array, "3"], cells: Int[Array | np.ndarray, "2 3"]
) -> Float[Array, "2 3"]:
    """Corners [m] of a grid at some numbers of cells."""
    return origin.astype(spacing.dtype)[None] + cells.astype(spacing.dtype) * spacing[None]


def _checked_distances(distances: Numbers) -> np.ndarray:
    if is_traced(distances):
        raise ValueError("distances must be concrete: spline coefficients are found on the host")
    host = np.asarray(checked_floating("distances", distances))
    if host.ndim != 3 or min(host.shape) < 3:
        raise ValueError(
            f"distances must have shape (nx, ny, nz) with at least 3 nodes an axis, got {host.shape}"
        )
    if not np.all(np.isfinite(host)):
        raise ValueError(f"distances must be finite, got {np.sum(~np.isfinite(host))} NaN or infinite")
    if not np.any(host < 0):
        raise ValueError(
            f"distances must be negative somewhere (inside), got a least value of {host.min()} m"
        )
    outermost = min(face.min() for axis in range(3) for face in (host.take(0, axis), host.take(-1, axis)))
    if outermost <= 0:
        raise ValueError(
            f"distances must be positive on the border of the grid, got {outermost} m there: enlarge the grid"
            " until it surrounds the solid"
        )
    return host
