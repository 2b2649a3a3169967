"""Bodies on joints as tables for kernels: kinematic trees and loops in integers, then rows of real numbers.

The unknowns of a step stand in blocks of six. A body that moves freely has a block. The joint coordinates of
its tree follow in blocks of their own, parents before children; places that are left over are padding. Last
come the forces in loops.
Rows are those that `dano.engine.kernels.trees.tables` reads.
"""

import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from dano.maths import AnyArray, library
from dano.scene import JointLaws, Scene, StateLayout

_SIX = 6
_WELD = 6


@dataclass(frozen=True, eq=False)
class TreeStructure:
    """Tables of whole numbers, rows in the order of the structures that `dano.engine.kernels` reads."""

    n_blocks: int  # Blocks of six unknowns
    moving: Int[np.ndarray, " m"]  # Body of each node
    rows: Int[np.ndarray, " n"]  # Node of each body, −1 for a fixed one, shape (n,)
    nodes: Int[np.ndarray, "m 14"]  # Shape (m, 14)
    coordinates: Int[np.ndarray, "c 4"]  # Shape (c, 4)
    unknowns: Int[np.ndarray, "u 4"]  # Shape (6 · blocks, 4)
    order: Int[np.ndarray, " o"]  # Unknowns of trees, from roots to tips
    columns: Int[np.ndarray, " k"]  # Unknowns that move the bodies that may touch something
    blocks: Int[np.ndarray, "b 3"]  # Shape (blocks, 3)
    closed: Int[np.ndarray, " t"]  # Whether loops close each tree, shape (trees,)
    loops: Int[np.ndarray, "l 6"]  # Shape (loops, 6)
    motions: int  # How many twists of motions there are
    entries: int  # How many entries of a triangle of the matrix of trees


@functools.lru_cache(maxsize=256)
def tree_structure(
    layout: StateLayout,
    constant: tuple[bool, ...] = (),
    nonsmooth: tuple[int, ...] = (),
    touching: frozenset[int] = frozenset(),
    loops: tuple[tuple[int, int, bool], ...] = (),
) -> TreeStructure:
    """The structure of a scene.

    Args:
        layout: Of its bodies and joints.
        constant: Of each coordinate whether its motor does what it is told to.
        nonsmooth: Coordinates whose law has kinks.
        touching: Bodies that may touch something.
        loops: Of each its first body, the number of bodies for the world; its second; whether it is a weld.
    """
    nodes = _Nodes(layout, {body for a, b, _ in loops for body in (a, b)})
    places, blocks = nodes.packed()
    of_loops, n_blocks = _loops(nodes, loops, len(blocks))
    rows, columns, motions = nodes.table(places, touching)
    unknowns, order, entries = _elimination(nodes, places, _SIX * n_blocks)
    widths = [3 + 3 * weld for _, _, weld in loops]
    left = sum(widths)
    loop_blocks = [(-1, 1, min(_SIX, left - _SIX * k)) for k in range(n_blocks - len(blocks))]
    closed = np.zeros(1 + max((tree for tree, *_ in blocks), default=-1), np.int32)
    for first, second, *_ in of_loops:
        for n in (first, second):
            if n >= 0:
                closed[nodes.tree[n]] = 1
    balls = {c for j, _, c in layout.dofs if layout.kinds[j] == "ball"}
    coordinates = [
        (places[c], c < len(constant) and constant[c], c in nonsmooth, c in balls)
        for c in range(layout.n_joints)
    ]
    bodies = nodes.rows[:, 0]
    of_body = np.full(layout.bodies, -1, np.int32)
    of_body[bodies] = np.arange(len(bodies))
    return TreeStructure(
        n_blocks,
        bodies.astype(np.int32),
        of_body,
        _table(rows, 14),
        _table(coordinates, 4),
        unknowns,
        order,
        np.array(columns, np.int32),
        _table([*blocks, *loop_blocks], 3),
        closed,
        _table(of_loops, _WELD),
        motions,
        entries,
    )


class _Nodes:
    """The nodes of a layout, their trees, and which of them stand alone.

    Attributes:
        rows: See `StateLayout.nodes`.
        tree: Number of the tree of each node, −1 of one that is alone.
        root: First node of each tree, in the order of nodes.
    """

    def __init__(self, layout: StateLayout, closing: Iterable[int]):
        self.layout = layout
        self.rows = layout.nodes.reshape(-1, 8)
        self.n_free = 6 * len(layout.free)
        parents = self.rows[:, 1]
        top = np.arange(len(parents))
        for n, up in enumerate(parents):
            if up >= 0:
                top[n] = top[up]
        # Joints that mimic another move with its tree.
        for group in self._moved_together():
            least = min(top[n] for n in group)
            for n in group:
                top[top == top[n]] = least
        carries = {int(top[n]) for n in range(len(top)) if n != top[n]}
        closing = {int(row[0]) for row in self.rows} & set(closing)
        hanging = {int(top[n]) for n, row in enumerate(self.rows) if row[4] >= 0 or int(row[0]) in closing}
        self.root = [n for n in range(len(top)) if top[n] == n]
        trees = [n for n in self.root if n in carries | hanging]
        self.top = top
        self.tree = [trees.index(int(t)) if t in trees else -1 for t in top]

    def _moved_together(self) -> list[list[int]]:
        groups: dict[int, list[int]] = {}
        for n, row in enumerate(self.rows):
            if row[4] >= 0 and row[6] > 0:
                groups.setdefault(int(row[5]), []).append(n)
        return [group for group in groups.values() if len(group) > 1]

    def packed(self) -> tuple[dict[int, int], list[tuple[int, int, int]]]:
        """Unknown of each joint coordinate and of each free body (as −1 − node), and rows of the blocks."""
        places: dict[int, int] = {}
        blocks: list[tuple[int, int, int]] = []
        for first in self.root:
            members = [n for n in range(len(self.rows)) if self.top[n] == first]
            tree = self.tree[first]
            for n in members:
                if self.rows[n, 4] < 0:
                    places[-1 - n] = _SIX * len(blocks)
                    blocks.append((tree, 0, _SIX))
            free = _SIX * len(blocks)
            count = 0
            for n in members:
                for part in range(self.rows[n, 6] if self.rows[n, 4] >= 0 else 0):
                    c = int(self.rows[n, 5]) - self.n_free + part
                    if c not in places:
                        places[c] = free + count
                        count += 1
            blocks += [(tree, 0, min(_SIX, count - k)) for k in range(0, count, _SIX)]
        return places, blocks

    def place(self, places: dict[int, int], n: int) -> int:
        """First unknown of a node; 0 of one that has none."""
        row = self.rows[n]
        if row[4] < 0:
            return places[-1 - n]
        return places[int(row[5]) - self.n_free] if row[6] else 0

    def chain(self, places: dict[int, int], n: int) -> list[int]:
        """Unknowns that move a node's body, its own first."""
        found = []
        while n >= 0:
            found += [self.place(places, n) + part for part in range(self.rows[n, 6])]
            n = int(self.rows[n, 1])
        return found

    def table(self, places: dict[int, int], touching: frozenset[int]):
        """Rows of the nodes, columns of the bodies that may touch something, and the number of motions."""
        rows, columns, motions = [], [], 0
        for n, (body, up, carrier, kind, joint, first, width, origin) in enumerate(self.rows):
            alone = self.tree[n] < 0
            chain = self.chain(places, n) if body in touching and not alone else []
            carrier = carrier if joint >= 0 and carrier < self.layout.bodies else -1
            coordinate = max(int(first) - self.n_free, 0) if joint >= 0 else 0
            at = (body, up, carrier, kind, joint, coordinate, self.place(places, n), width)
            rows.append((*at, motions, origin, len(columns), len(chain), alone, self.tree[n]))
            columns += chain
            motions += 0 if alone else int(width)
        return rows, columns, motions


def _loops(nodes: _Nodes, loops: Sequence[tuple[int, int, bool]], n_blocks: int):
    """Rows of the loops, and how many blocks there are with theirs."""
    of_body = {int(row[0]): n for n, row in enumerate(nodes.rows)}
    rows, at = [], _SIX * n_blocks
    for a, b, weld in loops:
        first = a if a < nodes.layout.bodies else -1
        width = 6 if weld else 3
        rows.append((of_body.get(a, -1), of_body.get(b, -1), first, b, at, width))
        at += width
    return rows, -(-at // _SIX)


def _elimination(nodes: _Nodes, places: dict[int, int], size: int):
    """Rows of the unknowns, those of trees in order, and the number of entries: see `Unknown`.

    Unknowns that move a body in common are coupled. Eliminated from the last to the first, each is coupled
    with some before it; the last of these, its parent, is coupled with all the others from then on.
    """
    coupled: dict[int, set[int]] = {}
    joints = set()
    for n, row in enumerate(nodes.rows):
        if nodes.tree[n] >= 0:
            chain = sorted(nodes.chain(places, n))
            for k, u in enumerate(chain):
                coupled.setdefault(u, set()).update(chain[:k])
            if row[4] >= 0:
                joints |= set(range(nodes.place(places, n), nodes.place(places, n) + row[6]))
    parents = dict.fromkeys(coupled, -1)
    for u in sorted(coupled, reverse=True):
        before = coupled[u] - {u}
        if before:
            parents[u] = max(before)
            coupled[parents[u]] |= before - {parents[u]}
    rows = np.zeros((size, 4), np.int32)
    rows[:, 0] = -1
    entries = 0
    for u in sorted(coupled):
        depth = 0 if parents[u] < 0 else rows[parents[u], 1] + 1
        rows[u] = (parents[u], depth, entries, u in joints)
        entries += int(depth)
    return rows, np.array(sorted(coupled), np.int32), entries


def _table(rows, width: int) -> Int[np.ndarray, "n k"]:
    return np.array([tuple(map(int, row)) for row in rows], np.int32).reshape(-1, width)


def structure_of_trees(scene: Scene, touching: Iterable[int]) -> TreeStructure:
    """Kinematic trees and loops of a scene.

    Args:
        scene: The scene.
        touching: Bodies that may touch something.
    """
    laws, closing = scene.chains.laws, scene.closing
    loops = ()
    if closing is not None:
        ends = zip(closing.first, closing.second, strict=True)
        loops = tuple((a, b, i in closing.welds) for i, (a, b) in enumerate(ends))
    return tree_structure(scene.layout, laws.constant, laws.rough, frozenset(touching), loops)


def tree_rows(
    scene: Scene, structure: TreeStructure
) -> tuple[dict[str, Float[AnyArray, "rows width"]], dict[str, Int[np.ndarray, "..."]]]:
    """Real and whole numbers by place in a kernel's parameters."""
    dtype, closing = scene.timestep.dtype, scene.closing
    loops = np.zeros((0, 10), dtype)
    if closing is not None:
        of_loops = (closing.position, closing.anchor, closing.orientation)
        loops = library(*of_loops).concatenate(of_loops, axis=1)
    rows = {
        "scene.trees.joints": scene.chains.table.astype(dtype),
        "scene.trees.laws": _law_rows(scene.chains.laws, dtype),
        "scene.trees.loops": loops.astype(dtype),
    }
    whole = {
        "nodes": structure.nodes,
        "coordinates": structure.coordinates,
        "unknowns": structure.unknowns,
        "order": structure.order,
        "columns": structure.columns,
        "blocks": structure.blocks,
        "closed": structure.closed,
        "loop_index": structure.loops,
    }
    return rows, {f"scene.trees.{name}": values for name, values in whole.items()}


def tree_lengths(structure: TreeStructure) -> dict[str, int]:
    """Lengths of the arrays in which a world works on its trees."""
    m, unknowns = len(structure.moving), _SIX * structure.n_blocks
    lengths = {
        **dict.fromkeys(
            ("frames", "displacements", "pivots", "twists", "offsets", "wrenches", "composites"), m
        ),
        **dict.fromkeys(("start", "end"), structure.motions),
        **dict.fromkeys(("diagonal", "column", "spread", "impulses"), unknowns),
        **dict.fromkeys(("lower", "upper"), structure.entries),
        "columns": len(structure.columns),
        **dict.fromkeys(("joints", "q", "v"), len(structure.coordinates)),
        "turned": m,
        "coupled": len(structure.closed),
        "sizes": 4,
    }
    return {f"room.trees.{name}": length for name, length in lengths.items()}


def _law_rows(laws: JointLaws, dtype) -> Float[AnyArray, "c 12"]:
    """What acts on each joint coordinate, see `JointLaws`.

    Damping, armature, stiffness, rest, friction, two limits and five numbers of a motor. What no joint has is
    0, or endless.
    """
    none = np.zeros(laws.damping.shape, laws.damping.dtype)

    def column(values: AnyArray | None) -> AnyArray:
        return (none if values is None else values)[:, None]

    endless = np.broadcast_to(np.array([-np.inf, np.inf]), (none.size, 2))
    endless = endless.astype(dtype)
    limits = endless if laws.limits is None else laws.limits
    motor = laws.motor
    if motor is None:
        motor = np.concatenate([np.zeros((none.size, 3), dtype), endless], axis=1)
    single = (laws.damping, laws.armature, laws.stiffness, laws.rest, laws.friction)
    columns = [*(column(x) for x in single), limits, motor]
    return library(*columns).concatenate(columns, axis=1)
