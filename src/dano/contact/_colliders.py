"""What a contact sees of a body: samples to be tested and a field to be queried; what it finds of a pair."""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, DTypeLike, Float

from dano.fields import AbstractField, GridField
from dano.maths import AnyArray, floating, Numbers

# Samples per block. Fewer make the culling finer, more make each pass over a block fatter.
BLOCK = 16


class SampleSet(eqx.Module):
    """Weighted contact samples in the field frame, in the layout that kernels want.

    Samples are ordered so that each run of `BLOCK` is compact in space; the last run is filled up with copies
    of weight zero.
    """

    # Homogeneous coordinates (x, y, z, 1) [m, F], shape (4, n); rows are contiguous.
    points: Float[Array, "4 n"]
    weights: Float[Array, " n"]  # φ_i / Σφ, shape (n,); they sum to one
    centers: Float[Array, "blocks 3"]  # Centre of each block [m, F], shape (n / BLOCK, 3)
    radii: Float[Array, " blocks"]  # Radius of each block about its centre [m], shape (n / BLOCK,)

    @classmethod
    def create(cls, points: Numbers, density: Numbers) -> "SampleSet":
        """Order the samples in space and normalise their weights, on the host.

        Args:
            points: Sample positions [m, F].
            density: Density φ ≥ 0 of each sample [arbitrary unit]; not all zero.
        """
        x, phi = np.asarray(points, dtype=np.float64), np.asarray(density, dtype=np.float64)
        return cls(*(floating(part) for part in _in_blocks(x, phi / phi.sum())))


class SurfaceSet(eqx.Module):
    """Surface samples in the field frame, in blocks that are compact in space, as in `SampleSet`."""

    points: Float[AnyArray, "4 n"]  # Homogeneous coordinates (x, y, z, 1) [m, F], shape (4, n)
    # Vector area of each [m², F], zero for what fills up the last block, shape (3, n).
    vectors: Float[AnyArray, "3 n"]
    centers: Float[AnyArray, "blocks 3"]  # Centre of each block [m, F], shape (n / BLOCK, 3)
    radii: Float[AnyArray, " blocks"]  # Radius of each block about its centre [m], shape (n / BLOCK,)
    # How samples turn with the body (static): "fixed" to it; about its z "axis" they keep facing the other
    # body; of a "ball" all do, and `points` are directions on the unit ball.
    turning: str = eqx.field(static=True, default="fixed")

    @classmethod
    def create(cls, points: Numbers, vectors: Numbers, turning: str = "fixed") -> "SurfaceSet":
        """Order the samples in space, on the host; points [m, F] and vector areas [m², F], both (n, 3)."""
        x, a = np.asarray(points, dtype=np.float64), np.asarray(vectors, dtype=np.float64)
        points, vectors, centers, radii = (floating(part) for part in _in_blocks(x, a))
        return cls(points, vectors, centers, radii, turning)

    @classmethod
    def none(cls, dtype: DTypeLike, blocks: int = 0) -> "SurfaceSet":
        """Blocks of samples without area."""
        n = blocks * BLOCK
        points, vectors = np.zeros((4, n), dtype), np.zeros((3, n), dtype)
        return cls(points, vectors, np.zeros((blocks, 3), dtype), np.zeros((blocks,), dtype))


class Support(eqx.Module):
    """Distance to where a grid's density is not zero, rounded down: says which blocks of samples to skip."""

    # Lower bound on the distance [m] from each node to the support, shape (nx, ny, nz).
    distance: Float[Array, "nx ny nz"]
    origin: Float[Array, "3"]  # First node [m, F], shape (3,)
    spacing: Float[Array, "3"]  # Distance between nodes [m], shape (3,)

    @classmethod
    def create(cls, field: GridField) -> "Support":
        """Build the map on the host from the grid's non-zero values."""
        spacing = np.broadcast_to(np.asarray(field.spacing, dtype=np.float64), (3,))
        reach = _REACH[field.interpolation]
        dilation = int(reach)
        # A border makes room for the reach of the outermost nodes, so that the map's edge is outside the
        # support.
        border = dilation + 2
        occupied = np.pad(np.asarray(field.values) > 0, border)
        # Here, not above: `import dano` would take a fifth of a second longer.
        from scipy import ndimage

        grown = ndimage.binary_dilation(occupied, np.ones((3, 3, 3), bool), iterations=dilation)
        distance = np.asarray(ndimage.distance_transform_edt(~grown, sampling=spacing))
        # What the reach exceeds whole cells by.
        slack = (reach - dilation) * np.linalg.norm(spacing)
        origin = np.asarray(field.origin, dtype=np.float64) - border * spacing
        return cls(floating(np.maximum(distance - slack, 0.0)), floating(origin), floating(spacing))


# How many cells a node's B-spline reaches to each side.
_REACH = {"linear": 1.0, "quadratic": 1.5, "cubic": 2.0}


class Collider(NamedTuple):
    """One side of a contact of shared mass, in the frame of its field."""

    field: AbstractField | None  # Density that the other side's samples ask for; None if there is none
    samples: SampleSet | None  # Tested against the other side's field; None of a primitive
    support: Support | None  # What skips samples far from the field; None: made where a grid needs it
    density_scale: Float[Array, ""]  # Makes the field's density dimensionless (1 for a shape's occupancy)


class Patch(eqx.Module):
    """Overlap of two bodies."""

    overlap: Float[Array, ""]  # ψ, the sampled mass inside the other body [kg], shape ()
    centroid: Float[Array, "3"]  # χ, its centroid [m, W], shape (3,)
    normal: Float[Array, "3"]  # n, unit vector from the second body (B) to the first (A) [W], shape (3,)

    @property
    def point(self) -> Float[Array, "3"]:
        """What twists and wrenches refer to [m, W]: the centroid."""
        return self.centroid

    @property
    def touching(self) -> Bool[Array, ""]:
        """Whether the bodies overlap, so that there is a centroid."""
        return self.overlap > 0


def _in_blocks(points: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, ...]:
    """Points (n, 3) and what each counts, (n,) or (n, k), in compact blocks that zeros fill up.

    Returns:
        Homogeneous coordinates (4, m) and values (m,) or (k, m), then centres (m / BLOCK, 3) and radii
        (m / BLOCK,) of balls around the blocks.
    """
    order = _spatial_order(points)
    missing = -len(order) % BLOCK
    x = np.concatenate([points[order], np.repeat(points[order[-1:]], missing, axis=0)])
    counted = np.concatenate([values[order], np.zeros((missing, *values.shape[1:]))])
    blocks = x.reshape(-1, BLOCK, 3)
    centers = 0.5 * (blocks.min(axis=1) + blocks.max(axis=1))
    radii = np.linalg.norm(blocks - centers[:, None], axis=-1).max(axis=1)
    return np.concatenate([x.T, np.ones((1, len(x)))]), counted.T, centers, radii


def _spatial_order(points: np.ndarray) -> np.ndarray:
    """Permutation that makes each run of `BLOCK` points compact: recursive splits of the longest extent.

    The first part of a split has a power of two blocks, so that 4, 16, 64, … blocks from a multiple on are
    compact, too.
    """

    def split(index: np.ndarray) -> list[np.ndarray]:
        if len(index) <= BLOCK:
            return [index]
        x = points[index]
        axis = int(np.argmax(x.max(axis=0) - x.min(axis=0)))
        blocks = -(-len(index) // BLOCK)
        left = BLOCK << ((blocks - 1).bit_length() - 1)
        part = np.argsort(x[:, axis], kind="stable")
        return split(index[part[:left]]) + split(index[part[left:]])

    return np.concatenate(split(np.arange(len(points))))
