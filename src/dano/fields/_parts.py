"""Connected parts of what is occupied: pixels of an image, nodes of a grid."""

import numpy as np
from jaxtyping import Bool


def largest_part(
    occupied: Bool[np.ndarray, "*shape"], *, corners: bool = False
) -> Bool[np.ndarray, "*shape"]:
    """The connected part with the most nodes; nothing if nothing is occupied.

    Args:
        occupied: Nodes.
        corners: Whether nodes that share only an edge or a corner of their cells are connected.
    """
    labels, sizes = _parts(occupied, corners)
    return labels == 1 + int(np.argmax(sizes)) if len(sizes) else np.zeros_like(occupied)


def large_parts(
    occupied: Bool[np.ndarray, "*shape"], share: float, *, corners: bool = False
) -> Bool[np.ndarray, "*shape"]:
    """The connected parts with more than a share of the largest one's nodes; see `largest_part`."""
    labels, sizes = _parts(occupied, corners)
    if not len(sizes):
        return np.zeros_like(occupied)
    return np.isin(labels, 1 + np.flatnonzero(sizes > share * sizes.max()))


def _parts(occupied: np.ndarray, corners: bool) -> tuple[np.ndarray, np.ndarray]:
    """Number of the part that each node belongs to, 0 for none, and how many nodes each part has."""
    from scipy import ndimage

    labels = np.zeros(occupied.shape, np.int32)
    ndimage.label(occupied, np.ones((3,) * occupied.ndim) if corners else None, output=labels)
    return labels, np.bincount(labels.ravel())[1:]
