"""Contact samples: where an object feels contact, drawn evenly between two densities."""

import math

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from dano.checks import checked_count, checked_kind
from dano.fields import AbstractField, AbstractShape, GridField, normal_at
from dano.maths import checked_array, checked_key, checked_points, floating, Numbers
from dano.objects._mass import cells, checked_density, Density, evaluate, host_random
from dano.objects._surface import farthest_points

# Candidates per sample that the even selection chooses from, and random draws per candidate before giving up.
CANDIDATES = 4
DRAWS = 400
# Cells across the thinnest side of a field's bounds with which its inside is found wherever the lattice lies.
_CELLS_ACROSS = 4
# Along the longest side of a shape, half of what objects have by default: only its edge is looked for.
_SHAPE_CELLS = 48
# Of a cell, to find where the density crosses a level: to a thousandth of it.
_HALVINGS = 10


class ContactSamples(eqx.Module):
    """Points that feel contact, in the field frame.

    Attributes:
        points: Positions [m, F], shape (n, 3).
        density: φ at each [scale of the field], shape (n,).
        normals: Unit outward normals −∇φ/|∇φ| [F], shape (n, 3).
    """

    points: Float[Array, "n 3"]
    density: Float[Array, " n"]
    normals: Float[Array, "n 3"]

    def __init__(self, points: Numbers, density: Numbers, normals: Numbers):
        """Contact samples; see the attributes.

        Raises:
            ValueError: If shapes differ or a number is not finite.
        """
        self.points = checked_points("points", points)
        n = len(self.points)
        self.density = checked_array("density", density, (n,))
        self.normals = checked_array("normals", normals, (n, 3))


class Lattice(eqx.Module):
    """Density on the corners of a grid of cells (host arrays)."""

    values: np.ndarray  # φ at the corners, shape (nx + 1, ny + 1, nz + 1)
    origin: np.ndarray  # First corner [m, F], shape (3,)
    side: np.ndarray  # Sides of a cell [m], shape (3,)

    @classmethod
    def create(
        cls, density: Density, bounds: Float[Array, "2 3"], resolution: int, *, least: int = 1
    ) -> "Lattice":
        """Evaluate a density on a lattice over its bounds.

        Args:
            density: Densities at points.
            bounds: [m, F].
            resolution: Cells along the longest axis.
            least: Cells along each axis; with more than one the cells of thin fields are flat.

        Raises:
            ValueError: If it is negative, not finite, or zero everywhere.
        """
        count, side = cells(bounds, resolution, least)
        origin = np.asarray(bounds)[0].astype(np.float64)
        corners = np.stack(np.meshgrid(*(np.arange(n + 1) for n in count), indexing="ij"), axis=-1).reshape(
            -1, 3
        )
        values = evaluate(density, origin + corners * side).reshape(tuple(count + 1))
        if values.max() <= 0:
            raise ValueError(
                f"field must have a positive density somewhere, got none at {values.size} points"
                + _finer(side * count, resolution)
            )
        return cls(values, origin, side)

    @property
    def extent(self) -> np.ndarray:
        """Sides [m] of the box that it fills, shape (3,)."""
        return self.side * (np.array(self.values.shape) - 1)

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, ...]:
        """Index of the lattice point nearest to each point (n, 3) [m, F]."""
        index = np.rint((points - self.origin) / self.side).astype(int)
        return tuple(np.clip(index, 0, np.array(self.values.shape) - 1).T)


def _finer(extent: np.ndarray, resolution: int) -> str:
    """Which resolution to try for a field whose bounds [m] are thin; nothing where it is fine enough."""
    wanted = math.ceil(_CELLS_ACROSS * float(extent.max() / extent.min()))
    if wanted <= resolution:
        return ""
    return f"; it is {float(extent.min()):.3g} m thin: try resolution={wanted}, got {resolution}"


class Region(eqx.Module):
    """Which part of space an object occupies (host arrays on a lattice)."""

    lattice: Lattice  # The lattice that the masks live on
    # {φ ≥ level}, without what is not connected to the largest part unless floaters were kept.
    occupied: np.ndarray
    cavity: np.ndarray  # Empty lattice points enclosed by `occupied`
    level: float  # The density that bounds it

    @classmethod
    def create(cls, lattice: Lattice, level: float, *, floaters: bool) -> "Region":
        """Threshold, keep the largest connected part, find what it encloses.

        Raises:
            ValueError: If nothing reaches the level.
        """
        # Here, as below, not above: `import dano` would take a fifth of a second longer.
        from scipy import ndimage

        occupied = lattice.values >= max(level, np.finfo(float).tiny)
        labels, parts = ndimage.label(occupied, np.ones((3, 3, 3)))
        if parts == 0:
            raise ValueError(
                f"density_range must start below the field's largest density {lattice.values.max():.6g}, "
                f"got {level:.6g}"
            )
        if not floaters:
            mass = ndimage.sum_labels(lattice.values, labels, np.arange(1, parts + 1))
            occupied = labels == 1 + int(np.argmax(mass))
        cavity = ndimage.binary_fill_holes(occupied) & ~occupied
        return cls(lattice, occupied, cavity, float(level))

    def near(self, cells_away: int) -> np.ndarray:
        """Lattice points within some cells of the occupied region."""
        from scipy import ndimage

        return ndimage.binary_dilation(self.occupied, np.ones((3, 3, 3)), iterations=cells_away)

    def outer(self) -> np.ndarray:
        """Lattice points near the region and nearer to the outside than to an enclosed cavity."""
        if not self.cavity.any():
            return self.near(1)
        from scipy import ndimage

        to_cavity = ndimage.distance_transform_edt(~self.cavity, sampling=self.lattice.side)
        outside = ~(self.occupied | self.cavity)
        to_outside = ndimage.distance_transform_edt(~outside, sampling=self.lattice.side)
        return self.near(1) & (to_outside < to_cavity)

    def extents(self, density: Density) -> Float[np.ndarray, "3"]:
        """Sides [m] of the box around the region, each end where a line of the lattice crosses the level."""
        return np.array([self._end(density, axis, 1) - self._end(density, axis, -1) for axis in range(3)])

    def _end(self, density: Density, axis: int, sign: int) -> float:
        """Largest (sign 1) or smallest (−1) coordinate of the region [m, F]."""
        index = np.argwhere(self.occupied)
        last = sign * np.max(sign * index[:, axis])
        # Where the last layer is a single point, a line beside it may reach further.
        start = index[sign * (last - index[:, axis]) <= 1]
        step = np.zeros(3)
        step[axis] = sign * self.lattice.side[axis]
        inside = self.lattice.origin + start * self.lattice.side
        below, above = np.zeros(len(inside)), np.ones(len(inside))
        for _ in range(_HALVINGS):
            middle = 0.5 * (below + above)
            solid = evaluate(density, inside + middle[:, None] * step) >= self.level
            below, above = np.where(solid, middle, below), np.where(solid, above, middle)
        return float(sign * np.max(sign * (inside + below[:, None] * step)[:, axis]))

    def solid(self, density: Density) -> Density:
        """Mean occupied density inside the filled region, zero outside; sharp at the level."""
        from scipy import ndimage

        mean = float(self.lattice.values[self.occupied].mean())
        inside = ndimage.binary_erosion(self.occupied | self.cavity, np.ones((3, 3, 3)))
        near = self.near(1)

        def filled(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
            places = self.lattice.nearest(points)
            solid = inside[places]
            # Only there the density tells.
            asked = ~solid & near[places]
            solid[asked] = density(points[asked]) >= self.level
            return np.where(solid, mean, 0.0)

        return filled


def plateau(values: np.ndarray) -> float:
    """Density at which half of the mass has been counted: neither empty space nor a thin haze moves it."""
    positive = np.sort(values[values > 0].ravel())
    return float(positive[np.searchsorted(np.cumsum(positive), 0.5 * positive.sum())])


def surface_level(values: np.ndarray) -> float:
    """The density of a field's own surface, half of its plateau, from its values on a lattice."""
    return 0.5 * plateau(values)


def surface_range(values: np.ndarray) -> tuple[float, float]:
    """Two densities just inside a field's own surface: half and nine tenths of its plateau."""
    return 0.5 * plateau(values), 0.9 * plateau(values)


def draw_samples(
    density: Density,
    lattice: Lattice,
    region: Region,
    low: float,
    high: float,
    n: int,
    key: PRNGKeyArray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw `n` points with density in [low, high], spread evenly over the outer side of a region.

    Returns:
        Points (n, 3) [m, F], all different, and their densities (n,).

    Raises:
        ValueError: If no point was found between the two densities.
    """
    random = host_random(key)
    allowed = region.outer()
    corner = np.stack(
        [
            lattice.values[
                tuple(slice(o, o + m - 1) for o, m in zip(offset, lattice.values.shape, strict=True))
            ]
            for offset in np.ndindex(2, 2, 2)
        ]
    )
    usable = np.stack(
        [
            allowed[tuple(slice(o, o + m - 1) for o, m in zip(offset, allowed.shape, strict=True))]
            for offset in np.ndindex(2, 2, 2)
        ]
    ).any(axis=0)
    candidates = np.argwhere((corner.min(axis=0) <= high) & (corner.max(axis=0) >= low) & usable)
    wanted, drawn = CANDIDATES * n, 0
    points, values = np.zeros((0, 3)), np.zeros(0)
    while len(candidates) and len(points) < wanted and drawn < DRAWS * wanted:
        cell = candidates[random.integers(len(candidates), size=max(wanted, 1 << 16))]
        x = lattice.origin + (cell + random.random(cell.shape)) * lattice.side
        phi = evaluate(density, x)
        keep = (phi >= low) & (phi <= high) & allowed[lattice.nearest(x)]
        points, values = np.concatenate([points, x[keep]]), np.concatenate([values, phi[keep]])
        drawn += len(x)
    if len(points) < n:
        raise ValueError(
            f"density_range ({low:.6g}, {high:.6g}) must contain at least n_samples = {n} points of the "
            f"object, found {len(points)} in {drawn} draws; "
            f"the field's densities reach {lattice.values.max():.6g}"
            + _finer(lattice.extent, round(float(np.max(lattice.extent / lattice.side))))
        )
    chosen = farthest_points(points[:wanted], n)
    return points[chosen], values[chosen]


def draw_contact_samples(shape: AbstractShape, n: int, key: PRNGKeyArray | None = None) -> ContactSamples:
    """Even contact samples inside the smooth edge of a shape.

    Args:
        shape: Bounded shape.
        n: Number of samples.
        key: Random key; default `jax.random.key(0)`.

    Raises:
        ValueError: If the shape is not a shape or is unbounded, or n is not an integer ≥ 1.
    """
    checked_kind("shape", shape, AbstractShape)
    n = checked_count("n", n)
    density = checked_density(shape)
    lattice = Lattice.create(density, shape.bounds, _SHAPE_CELLS, least=_CELLS_ACROSS)
    low, high = surface_range(lattice.values)
    region = Region.create(lattice, low, floaters=True)
    return contact_samples(shape, density, lattice, region, low, high, n, checked_key(key))


def contact_samples(
    field: AbstractField,
    density: Density,
    lattice: Lattice,
    region: Region,
    low: float,
    high: float,
    n: int,
    key: PRNGKeyArray,
) -> ContactSamples:
    """Contact samples of a field in a region: see `draw_samples`."""
    points, values = draw_samples(density, lattice, region, low, high, n, key)
    return ContactSamples(
        floating(points), floating(values), floating(outward_normals(field, points, region))
    )


def outward_normals(field: AbstractField, points: np.ndarray, region: Region) -> np.ndarray:
    """−∇φ/|∇φ| at points (n, 3); where the density is flat, away from the region's middle."""
    normals = normal_at(field, points)
    occupied = np.argwhere(region.occupied)
    middle = region.lattice.origin + occupied.mean(axis=0) * region.lattice.side
    away = points - middle
    away = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    flat = np.linalg.norm(normals, axis=1, keepdims=True) < 0.5
    return np.where(flat, away, normals)


def baked(field: AbstractField, resolution: int) -> tuple[GridField, float]:
    """The field as a grid, and the relative error of baking it (0 for a grid)."""
    if isinstance(field, GridField):
        return field, 0.0
    from dano.fields import bake

    grid, error = bake(field, resolution)
    return grid, error.rms


def contact_grid(grid: GridField, region: Region) -> GridField:
    """The grid without floaters and haze."""
    count = np.array(grid.values.shape)
    spacing = np.broadcast_to(np.asarray(grid.spacing, dtype=np.float64), (3,))
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in count), indexing="ij"), axis=-1).reshape(-1, 3)
    # Two cells beyond the region the wall has faded; what is left there belongs to something else.
    near = region.near(2)[region.lattice.nearest(np.asarray(grid.origin) + nodes * spacing)].reshape(
        tuple(count)
    )
    # As a file keeps them, so that a loaded object equals the saved one.
    values = np.where(near, np.asarray(grid.values), 0).astype(np.float32).astype(np.float64)
    return GridField(floating(values), grid.origin, grid.spacing, interpolation="quadratic")
