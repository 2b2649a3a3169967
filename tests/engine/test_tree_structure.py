"""Whole numbers of trees for kernels: places of unknowns, and an elimination that fills nothing in."""

import numpy as np
import pytest

import dano
from dano.engine._joints import tree_structure

BODY, PARENT, KIND, PLACE, WIDTH, FIRST_COLUMN, COLUMNS, ALONE, TREE = 0, 1, 3, 6, 7, 10, 11, 12, 13
ROOT = 5

NAMES = ("alone", "base", "wall", "arm", "rod", "copy", "hand", "tip", "cart", "door", "bolt", "latch")
JOINTS = (
    # Children before their parents, and one that mimics a joint further out.
    ("arm", "rod", "slide", None),
    ("base", "arm", "hinge", None),
    ("arm", "copy", "hinge", "rod"),
    ("copy", "hand", "ball", None),
    ("hand", "tip", "weld", None),
    ("base", "cart", "planar", None),
    ("wall", "door", "hinge", None),
    ("door", "bolt", "slide", None),
    (None, "latch", "hinge", "door"),
)


@pytest.fixture(scope="module")
def layout():
    bodies = [dano.Body(name, dano.Sphere(0.1), mass=1.0, fixed=name == "wall") for name in NAMES]
    joints = [dano.Joint(parent, child, kind, mimics=mimics) for parent, child, kind, mimics in JOINTS]
    return dano.Scene.create(bodies, contacts=(), joints=joints).layout


@pytest.fixture(scope="module")
def structure(layout):
    touching = frozenset(NAMES.index(name) for name in ("alone", "tip", "bolt"))
    loops = ((NAMES.index("cart"), NAMES.index("rod"), True), (len(NAMES), NAMES.index("tip"), False))
    return tree_structure(layout, (), (0, 2), touching, loops)


def test_unknowns_fill_blocks(layout, structure):
    """Every velocity has its own place: roots begin a block, coordinates follow, loops come last."""
    taken = []
    for node in structure.nodes:
        if node[KIND] == ROOT:
            assert node[PLACE] % 6 == 0
            taken += range(node[PLACE], node[PLACE] + 6)
    taken += structure.coordinates[:, 0].tolist()
    assert len(set(taken)) == len(taken) == layout.n_velocities
    trees = structure.blocks[:, 0]
    assert sorted(structure.order) == sorted(u for u in taken if trees[u // 6] >= 0)
    alone = structure.nodes[structure.nodes[:, ALONE] == 1]
    assert [NAMES[node[BODY]] for node in alone] == ["alone"]
    # 6 forces of the weld and 3 of the point.
    is_loop = structure.blocks[:, 1] == 1
    assert is_loop.tolist() == [False] * (structure.n_blocks - 2) + [True] * 2
    assert structure.blocks[is_loop, 2].tolist() == [6, 3]
    # A joint on the world mimics the door's: one tree.
    tree = {NAMES[node[BODY]]: node[TREE] for node in structure.nodes}
    assert tree["latch"] == tree["door"] != tree["arm"] == tree["base"]
    assert structure.closed.tolist() == [int(t == tree["base"]) for t in range(len(structure.closed))]


def test_columns_move_what_touches(structure):
    """Bodies that may touch something know what moves them: all joints below, and the root."""
    for node in structure.nodes:
        own = structure.columns[node[FIRST_COLUMN] : node[FIRST_COLUMN] + node[COLUMNS]]
        name = NAMES[node[BODY]]
        if name == "tip":
            # Ball, mimicking hinge, hinge and root; the weld adds none.
            assert len(own) == 3 + 1 + 1 + 6
        elif name == "bolt":
            assert len(own) == 2
        else:
            assert len(own) == 0


def test_elimination_fills_nothing_in(structure):
    """A matrix with entries where two unknowns move a body in common, factored from the last to the first."""
    parent, depth = structure.unknowns[:, 0], structure.unknowns[:, 1]

    def ancestors(u):
        found = []
        while parent[u] >= 0:
            u = parent[u]
            found.append(u)
        return found

    rng = np.random.default_rng(0)
    size = 6 * structure.n_blocks
    matrix, moved = np.zeros((size, size)), {}
    for n, node in enumerate(structure.nodes):
        own = set(range(node[PLACE], node[PLACE] + node[WIDTH]))
        moved[n] = own | (moved[node[PARENT]] if node[PARENT] >= 0 else set())
        if node[ALONE] == 0:
            chain = sorted(moved[n])
            column = rng.normal(size=(len(chain), 6))
            matrix[np.ix_(chain, chain)] += column @ column.T + np.eye(len(chain))
    for u in sorted(structure.order, reverse=True):
        entries = np.flatnonzero(matrix[u, :u])
        assert set(entries) <= set(ancestors(u))
        assert depth[u] == len(ancestors(u))
        matrix[:u, :u] -= np.outer(matrix[:u, u], matrix[u, :u]) / matrix[u, u]
    assert structure.entries == depth[structure.order].sum()
