"""Grids of nodes around an object."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import ndimage


class NodeGrid(NamedTuple):
    """A regular grid of nodes around the object.

    Attributes:
        origin: Position [m, W] of node (0, 0, 0), shape (3,).
        spacing: Distance between nodes [m].
        shape: Nodes along each axis.
    """

    origin: Float[np.ndarray, "3"]
    spacing: float
    shape: tuple[int, int, int]

    @classmethod
    def around(cls, lower: np.ndarray, upper: np.ndarray, resolution: int) -> "NodeGrid":
        """`resolution` nodes along the longest side of a box [m]."""
        spacing = float((upper - lower).max()) / (resolution - 1)
        shape = np.maximum(np.ceil((upper - lower) / spacing - 1e-6).astype(int) + 1, 4)
        origin = 0.5 * (lower + upper) - 0.5 * spacing * (shape - 1)
        return cls(origin, spacing, (int(shape[0]), int(shape[1]), int(shape[2])))

    @property
    def nodes(self) -> Float[np.ndarray, "n 3"]:
        """Positions [m, W] of all nodes."""
        index = np.stack(np.meshgrid(*map(np.arange, self.shape), indexing="ij"), axis=-1)
        return self.origin + self.spacing * index.reshape(-1, 3)

    @property
    def upper(self) -> Float[np.ndarray, "3"]:
        """Position [m, W] of the last node."""
        return self.origin + self.spacing * (np.array(self.shape) - 1)


def resampled(
    values: Float[np.ndarray, "nx ny nz"], old: NodeGrid, new: NodeGrid
) -> Float[np.ndarray, "mx my mz"]:
    """Values at the nodes of another box, trilinear between the old nodes, constant beyond them."""
    index = (new.nodes - old.origin).T / old.spacing
    return ndimage.map_coordinates(values, index, order=1, mode="nearest").reshape(new.shape)
