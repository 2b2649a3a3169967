"""Which blocks of unknowns are coupled in a step: those of bodies that touch, of their trees, of loops."""

import warp as wp

from dano.engine.kernels.tables import Room, Scene
from dano.physics.trees.joints import ROOT

_ROOT = wp.constant(ROOT)


@wp.func
def couple(room: wp.ref[Room], world: int, m: int, i: int, j: int):
    """Say that two blocks are coupled."""
    if room.used[world, i * m + j] == 0:
        room.used[world, i * m + j] = 1
        if i != j:
            room.used[world, j * m + i] = 1
            room.beside[world, i * m + room.neighbours[world, i]] = j
            room.beside[world, j * m + room.neighbours[world, j]] = i
            room.neighbours[world, i] = room.neighbours[world, i] + 1
            room.neighbours[world, j] = room.neighbours[world, j] + 1


@wp.func
def block_at(room: wp.ref[Room], world: int, m: int, row: int, column: int) -> int:
    """Where the block of a row and a column stands; beyond all that is read if it is not in use."""
    place = room.used[world, row * m + column]
    return wp.where(place > 0, place - 1, m * m)


@wp.func
def couple_block(scene: wp.ref[Scene], room: wp.ref[Room], world: int, block: int, row: int):
    """Couple a block with all that move a body."""
    m = scene.n_blocks
    node = scene.trees.nodes[row]
    if node.kind == _ROOT:
        couple(room, world, m, block, node.place // 6)
    else:
        for k in range(node.first_column, node.first_column + node.columns):
            couple(room, world, m, block, scene.trees.columns[k] // 6)


@wp.func
def couple_pair(scene: wp.ref[Scene], room: wp.ref[Room], world: int, a: int, b: int):
    """Couple what moves two bodies that touch, by their rows; −1 for one that does not move."""
    if a >= 0 and b >= 0:
        node = scene.trees.nodes[a]
        if node.kind == _ROOT:
            couple_block(scene, room, world, node.place // 6, b)
        else:
            for k in range(node.first_column, node.first_column + node.columns):
                couple_block(scene, room, world, scene.trees.columns[k] // 6, b)


@wp.func
def mark_tree(scene: wp.ref[Scene], room: wp.ref[Room], world: int, row: int):
    """Say that the tree of a body touches something."""
    if row >= 0:
        tree = scene.trees.nodes[row].tree
        if tree >= 0:
            room.trees.coupled[world, tree] = 1


@wp.func
def couple_loops(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Couple forces in loops with what moves their ends."""
    m = scene.n_blocks
    for row in range(scene.trees.loop_index.shape[0]):
        index = scene.trees.loop_index[row]
        for c in range(index.width):
            block = (index.place + c) // 6
            for side in range(2):
                up = int(index.first)
                if side == 1:
                    up = index.second
                while up >= 0:
                    above = scene.trees.nodes[up]
                    for part in range(above.width):
                        couple(room, world, m, block, (above.place + part) // 6)
                    up = above.parent


@wp.func
def couple_trees(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Couple the blocks of trees that touch something or are closed by loops, not those of the others."""
    m = scene.n_blocks
    for i in range(m):
        tree = scene.trees.blocks[i].tree
        if tree >= 0:
            if room.trees.coupled[world, tree] == 0:
                room.used[world, i * m + i] = 0
                room.counts[world, i] = 0
            else:
                for j in range(i):
                    if scene.trees.blocks[j].tree == tree:
                        couple(room, world, m, i, j)
    couple_loops(scene, room, world)


@wp.func
def mark_trees(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Say which trees are closed by loops; none touches anything yet."""
    for tree in range(scene.trees.closed.shape[0]):
        room.trees.coupled[world, tree] = scene.trees.closed[tree]
