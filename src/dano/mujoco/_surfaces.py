"""Samples of surfaces in blocks, and an order of them that is spread evenly: what contacts are merged by."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dano.contact import SurfaceSet

_BLOCK = 16
"""Samples of a block, see `SurfaceSet`."""
_RUN = 8
"""Blocks of a run."""
_IN_BLOCK = 4
"""Levels of the tree within a block."""
_LEVELS = 24
"""Of the tree of halves."""
_WITHIN = 0x555555
"""Which of two halves comes first, by level: in turn the first and the second, so that the first sample of a
cell lies within it, not at its corner."""
_TURNING = {"fixed": 0, "axis": 1, "ball": 2}
"""How samples turn with their body, as in `dano.physics.pairs`."""
_ALONG = 8
"""Parts of the largest extent of a hull between its samples (as many as boxes have, about)."""


class Surface(NamedTuple):
    """Samples of a surface."""

    points: Float[np.ndarray, "n 3"]  # [m], or directions on the unit ball, shape (n, 3)
    # Vector areas [m²], zero where the last block is filled up, shape (n, 3).
    vectors: Float[np.ndarray, "n 3"]
    # Root of their number over the place in an order that begins evenly spread, shape (n,).
    precedence: Float[np.ndarray, " n"]
    balls: Float[np.ndarray, "b 4"]  # Centre and radius [m] of a ball around each block, shape (n / 16, 4)
    runs: Float[np.ndarray, "r 4"]  # The same around each run of eight blocks
    turning: int = 0  # How samples turn, a number

    def moved(self, rotation: Float[np.ndarray, "3 3"], origin: Float[np.ndarray, "3"]) -> "Surface":
        """The same in another frame."""

        def moved(balls):
            return np.concatenate([balls[:, :3] @ rotation.T + origin, balls[:, 3:]], axis=1)

        return self._replace(
            points=self.points @ rotation.T + origin,
            vectors=self.vectors @ rotation.T,
            balls=moved(self.balls),
            runs=moved(self.runs),
        )


def surface_of(points, vectors, turning: str = "fixed") -> Surface:
    """A surface by samples [m] with vector areas [m²]; `turning` as in `SurfaceSet`."""
    blocks = SurfaceSet.create(points, vectors, turning)
    x, a, centers = (
        np.asarray(part, np.float64) for part in (blocks.points[:3].T, blocks.vectors.T, blocks.centers)
    )
    of_blocks, order = _tree(centers, _LEVELS - _IN_BLOCK)
    rows, codes = [], []
    for block in order:
        own = np.arange(block * _BLOCK, (block + 1) * _BLOCK)
        places, inner = _tree(x[own], _IN_BLOCK)
        rows.append(own[inner])
        codes.append((of_blocks[block] << _IN_BLOCK) + places[inner])
    row = np.concatenate(rows)
    balls = np.concatenate([centers, np.asarray(blocks.radii, np.float64)[:, None]], axis=1)
    balls = balls[order]
    runs = np.array([_around(balls[k : k + _RUN]) for k in range(0, len(balls), _RUN)])
    return Surface(x[row], a[row], _precedence(np.concatenate(codes)), balls, runs, _TURNING[turning])


def _precedence(codes: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """By codes of a tree of halves read backwards: each half has every other place, and so on within it."""
    codes = codes ^ _WITHIN
    backwards = sum(((codes >> k) & 1) << (_LEVELS - 1 - k) for k in range(_LEVELS))
    place = np.argsort(np.argsort(backwards, kind="stable"), kind="stable")
    return np.sqrt(len(codes) / (1.0 + place))


def _around(balls: Float[np.ndarray, "k 4"]) -> Float[np.ndarray, "4"]:
    """A ball around balls."""
    lower, upper = (balls[:, :3] - balls[:, 3:]).min(axis=0), (balls[:, :3] + balls[:, 3:]).max(axis=0)
    middle = 0.5 * (lower + upper)
    return np.append(middle, (np.linalg.norm(balls[:, :3] - middle, axis=1) + balls[:, 3]).max())


def _tree(x: Float[np.ndarray, "n 3"], levels: int) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Codes of points by halving the longest extent, first half first, and the order in which they ascend."""
    codes = np.zeros(len(x), np.int64)
    parts = [(np.arange(len(x)), levels)]
    while parts:
        index, level = parts.pop()
        if len(index) < 2 or level == 0:
            continue
        axis = int(np.argmax(np.ptp(x[index], axis=0)))
        index = index[np.argsort(x[index, axis], kind="stable")]
        half = (len(index) + 1) // 2
        codes[index[half:]] += 1 << (level - 1)
        parts += [(index[:half], level - 1), (index[half:], level - 1)]
    return codes, np.argsort(codes, kind="stable")


def hull_surface(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], normals: Float[np.ndarray, "f 3"]
) -> Surface:
    """Corners of a convex hull, and points on its faces; each has a third of its triangles."""
    spacing = float(np.ptp(vertices, axis=0).max()) / _ALONG
    points, vectors = [], []
    for face, normal in zip(faces, normals, strict=True):
        a, b, c = vertices[face]
        longest = max(np.linalg.norm(b - a), np.linalg.norm(c - b), np.linalg.norm(a - c))
        n = max(1, int(np.ceil(longest / spacing)))
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a)) / n**2
        u, v = (k.ravel() for k in np.mgrid[: n + 1, : n + 1])
        inside = u + v <= n
        u, v = u[inside], v[inside]
        # Corners of small triangles that meet there: six inside, three along an edge, one at a corner.
        edges = (u == 0).astype(int) + (v == 0) + (u + v == n)
        points.append(a + (u / n)[:, None] * (b - a) + (v / n)[:, None] * (c - a))
        vectors.append((area / 3 * np.array([6, 3, 1])[edges])[:, None] * normal)
    x, areas = np.concatenate(points), np.concatenate(vectors)
    _, first, same = np.unique(np.round(x / spacing, 6), axis=0, return_index=True, return_inverse=True)
    total = np.zeros((len(first), 3))
    np.add.at(total, same.ravel(), areas)
    return surface_of(x[first], total)
