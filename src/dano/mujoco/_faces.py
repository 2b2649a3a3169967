"""Flat faces of an object as planes: near their edges its sampled distance is rounded, a plane is exact."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dano.fields import SignedDistanceGrid
from dano.objects import flat_faces, NeuralObject

_CONVEX = 1.1
"""Area of the convex hull of a face over that of its samples, at most: others have holes or bays, or are two
faces on one plane, and are left to the grid."""
_CORNER = 0.02
"""How far corners of a face may be from a straight edge that takes their place, in cells."""
_BAND, _THIN = 2.0, 0.5
"""How far from its plane a face says the distance: in cells, and of half the thickness at most."""
_SLACK = 0.1
"""How much further than the plane the sampled distance may be, in cells: what flat regions scatter by."""
_ALONG = np.cos(np.radians(5.0))
"""Least cosine between the vector area of a sample within a face and its normal."""
_EXACT = 2e-3
"""How far from its plane a sample of a face is, in cells."""


class Face(NamedTuple):
    """A convex flat face."""

    plane: Float[np.ndarray, "4"]  # Unit outward normal, and minus the offset [m]
    edges: Float[np.ndarray, "k 4"]  # The same of planes through its edges, normal to the face


class Faces(NamedTuple):
    """Flat faces of an object, in a frame."""

    faces: list[Face]
    planes: Float[np.ndarray, "f 4"]  # Of all flat faces, those that are not convex, too
    cell: float  # Of the object's grid [m]

    def band(self, thickness: float) -> float:
        """Distance from a plane within which its face counts [m], for an object of a half thickness [m]."""
        return min(_BAND * self.cell, _THIN * thickness) if self.faces else 0.0

    @property
    def slack(self) -> float:
        """How much less than the sampled distance that of a face may be [m]."""
        return _SLACK * self.cell if self.faces else 0.0

    def moved(self, rotation: Float[np.ndarray, "3 3"], origin: Float[np.ndarray, "3"]) -> "Faces":
        """The same in another frame."""
        return self._replace(
            faces=[
                Face(_moved(f.plane, rotation, origin), _moved(f.edges, rotation, origin)) for f in self.faces
            ],
            planes=_moved(self.planes, rotation, origin),
        )

    def around(
        self, points: Float[np.ndarray, "n 3"], vectors: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
        """Normal of the face that each sample lies within, zero for others, and which lie on edges of faces.

        Args:
            points: Samples [m].
            vectors: Their vector areas [m²].
        """
        found = np.zeros((len(points), 3))
        areas = np.linalg.norm(vectors, axis=1)
        on = np.abs(points @ self.planes[:, :3].T + self.planes[:, 3]) < _EXACT * self.cell
        along = vectors @ self.planes[:, :3].T > _ALONG * areas[:, None]
        within = on & along & (on.sum(axis=1, keepdims=True) == 1) & (areas[:, None] > 0)
        rows, columns = np.nonzero(within)
        found[rows] = self.planes[columns, :3]
        return found, on.any(axis=1) & ~within.any(axis=1)


def faces_of(obj: NeuralObject) -> Faces:
    """The flat faces of an object, in its field frame."""
    solid = obj.solid
    if not isinstance(solid, SignedDistanceGrid):
        return Faces([], np.zeros((0, 4)), 0.0)
    cell = float(np.max(np.asarray(solid.spacing)))
    points, areas = np.asarray(obj.surface.points, np.float64), np.asarray(obj.surface.areas, np.float64)
    vectors = np.asarray(obj.surface.vectors, np.float64)
    found, planes = [], []
    for normal, offset, members in flat_faces(obj.surface, solid.spacing):
        plane = np.append(normal, -offset)
        planes.append(plane)
        # What edges and corners stand for looks elsewhere in part.
        facing = np.clip(vectors[members] @ normal, 0.0, areas[members]).sum()
        edges = _edges(points[members], normal, float(facing), _CORNER * cell)
        if edges is not None:
            found.append(Face(plane, edges))
    return Faces(found, np.array(planes).reshape(-1, 4), cell)


def _edges(
    points: Float[np.ndarray, "m 3"], normal: Float[np.ndarray, "3"], area: float, corner: float
) -> Float[np.ndarray, "k 4"] | None:
    """Planes through the edges of the hull of points on a plane; None where they do not fill it."""
    # Here, not above: `import dano` would take a fifth of a second longer.
    from scipy.spatial import ConvexHull, QhullError

    axes = np.linalg.svd(normal[None])[2][1:]
    flat = points @ axes.T
    try:
        hull = ConvexHull(flat)
    except QhullError:
        return None
    if hull.volume > _CONVEX * area:
        return None
    ring = _simplified(flat[hull.vertices], corner)
    along = np.roll(ring, -1, axis=0) - ring
    # Corners go around against the clock.
    outward = np.stack([along[:, 1], -along[:, 0]], axis=1)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    offsets = np.einsum("ij,ij->i", outward, ring)
    return np.column_stack([outward @ axes, -offsets])


def _simplified(ring: Float[np.ndarray, "c 2"], near: float) -> Float[np.ndarray, "k 2"]:
    """A convex ring without the corners that lie near the line between their neighbours."""
    while len(ring) > 3:
        before, after = np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0)
        along = after - before
        arm = ring - before
        away = np.abs(along[:, 0] * arm[:, 1] - along[:, 1] * arm[:, 0]) / np.linalg.norm(along, axis=1)
        least = int(np.argmin(away))
        if away[least] > near:
            return ring
        ring = np.delete(ring, least, axis=0)
    return ring


def _moved(
    planes: Float[np.ndarray, "*k 4"], rotation: Float[np.ndarray, "3 3"], origin: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "*k 4"]:
    """Planes in another frame."""
    normals = planes[..., :3] @ rotation.T
    return np.concatenate([normals, planes[..., 3:] - (normals @ origin)[..., None]], axis=-1)
