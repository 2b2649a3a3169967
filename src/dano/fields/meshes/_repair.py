"""Meshes as they come, with holes, flipped and doubled faces, as closed ones.

What counts is the boundary of a mesh as a chain: each edge, as often as faces run along it one way less the
other way. A mesh without a boundary winds around each point a whole number of times (Jacobson et al., 2013),
however many faces meet at an edge: parts may touch, and faces may be slivers. A boundary always consists of
closed loops, so each can be closed by a fan of faces; those are what is in doubt.
"""

from typing import Any, NamedTuple

import numpy as np

_WELD = 1e-8
"""Share of the extent below which vertices are one: rounding of files in double precision."""

_FLAT = 1e-7
"""Volume per area^1.5 (a ball has 0.094) below which a shell is a sheet without an inside."""

_SLIVER = 1e-9
"""Share of the mean area of faces below which one has no normal to speak of."""

_MOST_DOUBT = 0.4
"""Share of the surface that may have to be closed: of a hemisphere without its disc it is a third."""


class Repaired(NamedTuple):
    """A closed mesh."""

    vertices: np.ndarray  # Shape (v, 3)
    faces: np.ndarray  # Shape (f, 3)
    labels: np.ndarray  # Shell of each face, shape (f,): each is closed on its own
    doubt: float  # Share of the area that was added to close holes
    notes: list[str]  # What was repaired, in words
    is_crossed: bool  # Faces may lie within the solid: walls between parts that touch, or what was added
    is_smooth: bool  # Two faces meet at each edge, and all have normals: these tell which side is inside


def repaired(vertices: np.ndarray, faces: np.ndarray, igl: Any) -> Repaired:
    """Close a mesh, whatever its defects.

    Args:
        vertices: Shape (v, 3).
        faces: Shape (f, 3).
        igl: libigl.

    Raises:
        ValueError: If nothing of it has an inside, or too much of its surface is missing.
    """
    notes: list[str] = []
    vertices, faces = _welded(vertices, faces)
    count = len(faces)
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    faces, doubled = _single(faces)
    if not len(faces):
        raise ValueError(f"the mesh must enclose a volume, got {count} faces without an inside")
    if doubled:
        notes.append(f"{doubled} doubled faces of {count} left out")
    edges, uses = _boundary(faces)
    added, loops = np.zeros((0, 3), np.int64), []
    if len(edges):
        faces, flipped = _oriented(faces, igl)
        if flipped:
            notes.append(f"{flipped} faces of {count} turned like their neighbours")
        edges, uses = _boundary(faces)
        loops = _loops(edges, uses)
        added, vertices = _fans(loops, vertices)
        if loops:
            every = len(np.unique(np.sort(_edges(faces), axis=1), axis=0))
            notes.append(f"{len(edges)} open edges of {every} closed, around {len(loops)} holes")
    real = len(faces)
    faces = np.concatenate([faces, added])
    labels = _shells(faces)
    flat = _sheets(vertices, faces, labels)
    if np.any(flat):
        kept = ~flat[labels]
        if not np.any(kept):
            raise ValueError(
                f"the mesh must enclose a volume, got sheets ({len(edges)} open edges): give them a thickness"
            )
        if lone := int(np.sum(~kept[:real])):
            notes.append(f"{lone} faces of sheets without an inside left out")
        real = int(kept[:real].sum())
        faces, labels = faces[kept], np.unique(labels[kept], return_inverse=True)[1]
    areas = _areas(vertices, faces)
    doubt = float(areas[real:].sum() / areas.sum())
    if doubt > _MOST_DOUBT:
        raise ValueError(
            f"the mesh must enclose a volume, but closing its {len(loops)} holes would take"
            f" {100 * doubt:.0f} % of the surface: it is open; give it a thickness"
        )
    if loops:
        notes.append(f"{100 * doubt:.2g} % of the surface is in doubt")
    _, meeting = np.unique(np.sort(_edges(faces), axis=1), axis=0, return_counts=True)
    is_crossed = any(len(loop) > 4 for loop in loops) or bool(np.any(meeting > 2))
    is_smooth = not is_crossed and bool(areas.min() > _SLIVER * areas.mean())
    return Repaired(vertices, faces, labels, doubt, notes, is_crossed, is_smooth)


def _welded(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One vertex for all at one place: files of triangles, texture seams and normals repeat them."""
    used, inverse = np.unique(faces, return_inverse=True)
    points = vertices[used]
    step = _WELD * max(float(np.ptp(points, axis=0).max()), 1e-300)
    _, first, same = np.unique(
        np.rint(points / step).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    return points[first], same.reshape(-1)[inverse.reshape(-1)].reshape(-1, 3)


def _edges(faces: np.ndarray) -> np.ndarray:
    """Directed edges, those of each face in a block of rows by corner, shape (3 f, 2)."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def _single(faces: np.ndarray) -> tuple[np.ndarray, int]:
    """Faces of which none lies on another, and how many were left out.

    Of equal ones the first stays. Of two that face each other none does, as the wall between parts that
    touch; unless the faces around need one.
    """
    ordered = np.sort(faces, axis=1)
    _, first, inverse, counts = np.unique(
        ordered, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    if np.all(counts == 1):
        return faces, 0
    inverse = inverse.reshape(-1)
    # The parity of the permutation that sorts its corners is how a face is turned.
    turned = ((faces[:, 0] < faces[:, 1]) ^ (faces[:, 1] < faces[:, 2]) ^ (faces[:, 2] < faces[:, 0])).astype(
        int
    )
    net = np.abs(np.bincount(inverse, 1 - 2 * turned))
    facing = (counts > 1) & (net == 0)
    keep = np.zeros(len(faces), bool)
    keep[first[~facing]] = True
    pairs = first[facing]
    if len(pairs):
        others, uses = np.unique(np.sort(_edges(faces[keep]), axis=1), axis=0, return_counts=True)
        odd = {tuple(edge) for edge in others[uses % 2 == 1].tolist()}
        for face in pairs:
            a, b, c = ordered[face].tolist()
            if all(edge in odd for edge in ((a, b), (b, c), (a, c))):
                keep[face] = True
    # A wall between two parts is not a defect.
    walls = 2 * int(np.sum(~keep[pairs]))
    return faces[keep], int(np.sum(~keep)) - walls


def _boundary(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directed edges along which more faces run one way than the other, and how many more."""
    edges = _edges(faces)
    forward = edges[:, 0] < edges[:, 1]
    unique, inverse = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    net = np.bincount(inverse.reshape(-1), np.where(forward, 1, -1), len(unique)).astype(int)
    left = net != 0
    found = np.where(net[left, None] > 0, unique[left], unique[left][:, ::-1])
    return found, np.abs(net[left])


def _oriented(faces: np.ndarray, igl: Any) -> tuple[np.ndarray, int]:
    """Faces turned like their neighbours, each patch as most of its faces were; and how many were turned."""
    turned, patch = igl.bfs_orient(np.ascontiguousarray(faces, np.int64))
    turned, patch = np.asarray(turned, np.int64), np.asarray(patch).reshape(-1)
    same = np.any(np.stack([np.all(turned == np.roll(faces, k, axis=1), axis=1) for k in range(3)]), axis=0)
    size = int(patch.max()) + 1
    against = np.bincount(patch, ~same, size) > 0.5 * np.bincount(patch, minlength=size)
    back = against[patch]
    turned[back] = turned[back][:, ::-1]
    return turned, int(np.sum(same == back))


def _loops(edges: np.ndarray, uses: np.ndarray) -> list[list[int]]:
    """Closed loops that run against a boundary, none through a vertex twice."""
    onward: dict[int, list[int]] = {}
    for (a, b), n in zip(edges.tolist(), uses.tolist(), strict=True):
        onward.setdefault(b, []).extend([a] * n)
    found = []
    for start in list(onward):
        while onward[start]:
            path, place = [start], {start: 0}
            while onward[path[-1]]:
                following = onward[path[-1]].pop()
                if following in place:
                    k = place[following]
                    found.append(path[k:])
                    for gone in path[k + 1 :]:
                        del place[gone]
                    path = path[: k + 1]
                else:
                    place[following] = len(path)
                    path.append(following)
    return found


def _fans(loops: list[list[int]], vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces that close loops, and the vertices with the middles of those that have more than three."""
    faces, middles = [], []
    for loop in loops:
        if len(loop) == 3:
            faces.append(loop)
            continue
        middle = len(vertices) + len(middles)
        middles.append(vertices[loop].mean(axis=0))
        faces += [[loop[i - 1], loop[i], middle] for i in range(len(loop))]
    if not faces:
        return np.zeros((0, 3), np.int64), vertices
    return np.array(faces, np.int64), np.concatenate([vertices, *([np.array(middles)] if middles else [])])


def _shells(faces: np.ndarray) -> np.ndarray:
    """Which closed shell each face belongs to.

    Faces that share an edge with one other belong together. If the shells so found are not closed, since
    walls inside are single, faces that share any edge do.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = np.sort(_edges(faces), axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    _, inverse, counts = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    inverse = inverse.reshape(-1)
    order = np.argsort(inverse, kind="stable")
    # Rows of one edge lie side by side.
    a, b = order[:-1], order[1:]
    together = inverse[a] == inverse[b]

    def components(pairs: np.ndarray) -> np.ndarray:
        links = coo_matrix(
            (np.ones(int(pairs.sum())), (owner[a[pairs]], owner[b[pairs]])), shape=(len(faces), len(faces))
        )
        return connected_components(links, directed=False)[1]

    labels = components(together & (counts[inverse[a]] == 2))
    forward = np.where(_edges(faces)[:, 0] == edges[:, 0], 1, -1)
    _, groups = np.unique(np.stack([inverse, labels[owner]], axis=1), axis=0, return_inverse=True)
    is_closed = not np.any(np.bincount(groups.reshape(-1), forward))
    return labels if is_closed else components(together)


def _areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _sheets(vertices: np.ndarray, faces: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Which shells enclose no volume."""
    centred = vertices - vertices[faces].mean(axis=(0, 1))
    a, b, c = (centred[faces[:, k]] for k in range(3))
    volume = np.bincount(labels, np.einsum("ij,ij->i", a, np.cross(b, c)) / 6)
    area = np.bincount(labels, _areas(vertices, faces))
    return np.abs(volume) <= _FLAT * np.maximum(area, 1e-300) ** 1.5
