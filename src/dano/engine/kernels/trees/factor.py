"""Linear systems of trees: unknowns that move a body in common are coupled, those of two branches are not.

Elimination goes from the tips to the root: what an unknown is coupled with are its ancestors, and nothing is
filled in (Featherstone 2005, Int. J. Robotics Research 24). Matrices are inertia plus dissipation: their
pivots stay away from singular. After `factor` the matrix is U L with ones on the diagonal of U;
`diagonal` holds the inverse of that of L.
"""

import warp as wp

from dano.engine.kernels.tables import Room, Scene
from dano.engine.kernels.trees.kinematics import unknown_of
from dano.engine.kernels.trees.pattern import block_at
from dano.engine.kernels.trees.tables import Node
from dano.physics.real import mat66, ONE, real, vec6, ZERO


@wp.func
def clear_entries(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Zero the matrix."""
    for k in range(scene.trees.order.shape[0]):
        u = scene.trees.order[k]
        unknown = scene.trees.unknowns[u]
        room.trees.diagonal[world, u] = ZERO
        for t in range(unknown.first, unknown.first + unknown.depth):
            room.trees.lower[world, t] = ZERO
            room.trees.upper[world, t] = ZERO


@wp.func
def add_entry(scene: wp.ref[Scene], room: wp.ref[Room], world: int, row: int, column: int, value: real):
    """Add to one of its entries."""
    if row == column:
        room.trees.diagonal[world, row] = room.trees.diagonal[world, row] + value
    elif row < column:
        t = scene.trees.unknowns[column].first + scene.trees.unknowns[row].depth
        room.trees.upper[world, t] = room.trees.upper[world, t] + value
    else:
        t = scene.trees.unknowns[row].first + scene.trees.unknowns[column].depth
        room.trees.lower[world, t] = room.trees.lower[world, t] + value


@wp.func
def in_solve(scene: wp.ref[Scene], room: wp.ref[Room], world: int, u: int) -> bool:
    """Whether an unknown of a tree is solved for here, and not with those that its tree touches."""
    return room.trees.coupled[world, scene.trees.blocks[u // 6].tree] == 0


@wp.func
def factor_mass(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Factor a symmetric matrix, of which only the diagonal and `upper` are read: as `factor` does."""
    for k in range(scene.trees.order.shape[0]):
        p = scene.trees.order[scene.trees.order.shape[0] - 1 - k]
        unknown = scene.trees.unknowns[p]
        inverse = ONE / room.trees.diagonal[world, p]
        room.trees.diagonal[world, p] = inverse
        i = int(unknown.parent)
        t = int(unknown.depth - 1)
        while t >= 0:
            above = scene.trees.unknowns[i]
            own = room.trees.upper[world, unknown.first + t]
            share = own * inverse
            room.trees.upper[world, unknown.first + t] = share
            room.trees.lower[world, unknown.first + t] = own
            room.trees.diagonal[world, i] = room.trees.diagonal[world, i] - share * own
            for s in range(t):
                at = above.first + s
                taken = share * room.trees.upper[world, unknown.first + s]
                room.trees.upper[world, at] = room.trees.upper[world, at] - taken
            i = above.parent
            t -= 1


@wp.func
def factor(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Factor the matrix of the trees that touch nothing."""
    for k in range(scene.trees.order.shape[0]):
        p = scene.trees.order[scene.trees.order.shape[0] - 1 - k]
        if in_solve(scene, room, world, p):
            unknown = scene.trees.unknowns[p]
            inverse = ONE / room.trees.diagonal[world, p]
            room.trees.diagonal[world, p] = inverse
            i = int(unknown.parent)
            t = int(unknown.depth - 1)
            while t >= 0:
                above = scene.trees.unknowns[i]
                below = room.trees.lower[world, unknown.first + t]
                share = room.trees.upper[world, unknown.first + t] * inverse
                room.trees.upper[world, unknown.first + t] = share
                room.trees.diagonal[world, i] = room.trees.diagonal[world, i] - share * below
                below = below * inverse
                for s in range(t):
                    at = above.first + s
                    taken = room.trees.upper[world, unknown.first + s] * below
                    room.trees.upper[world, at] = room.trees.upper[world, at] - taken
                    taken = share * room.trees.lower[world, unknown.first + s]
                    room.trees.lower[world, at] = room.trees.lower[world, at] - taken
                i = above.parent
                t -= 1


@wp.func
def solve_factored(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Solve for `room.step` in place, of the trees that touch nothing."""
    n = scene.trees.order.shape[0]
    for k in range(n):
        u = scene.trees.order[k]
        room.trees.column[world, u] = unknown_of(room.step, world, u)
    for k in range(n):
        p = scene.trees.order[n - 1 - k]
        if in_solve(scene, room, world, p):
            unknown = scene.trees.unknowns[p]
            own = room.trees.column[world, p]
            i = int(unknown.parent)
            t = int(unknown.depth - 1)
            while t >= 0:
                taken = room.trees.upper[world, unknown.first + t] * own
                room.trees.column[world, i] = room.trees.column[world, i] - taken
                i = scene.trees.unknowns[i].parent
                t -= 1
    for k in range(n):
        p = scene.trees.order[k]
        if in_solve(scene, room, world, p):
            unknown = scene.trees.unknowns[p]
            own = room.trees.column[world, p]
            i = int(unknown.parent)
            t = int(unknown.depth - 1)
            while t >= 0:
                own -= room.trees.lower[world, unknown.first + t] * room.trees.column[world, i]
                i = scene.trees.unknowns[i].parent
                t -= 1
            own = own * room.trees.diagonal[world, p]
            room.trees.column[world, p] = own
            room.step[world, p // 6][p % 6] = own


@wp.func
def effective_mass(scene: wp.ref[Scene], room: wp.ref[Room], world: int, u: int) -> real:
    """What an unknown weighs when all others are free: 1/(M⁻¹)_uu, from `factor_mass` [kg m² or kg]."""
    p = int(u)
    while p >= 0:
        room.trees.column[world, p] = ZERO
        p = scene.trees.unknowns[p].parent
    room.trees.column[world, u] = ONE
    total = real(0.0)
    p = u
    while p >= 0:
        unknown = scene.trees.unknowns[p]
        own = room.trees.column[world, p]
        total += own * own * room.trees.diagonal[world, p]
        i = int(unknown.parent)
        t = int(unknown.depth - 1)
        while t >= 0:
            taken = room.trees.upper[world, unknown.first + t] * own
            room.trees.column[world, i] = room.trees.column[world, i] - taken
            i = scene.trees.unknowns[i].parent
            t -= 1
        p = unknown.parent
    return ONE / total


@wp.func
def mobility(scene: wp.ref[Scene], room: wp.ref[Room], world: int, node: Node) -> mat66:
    """J M⁻¹ Jᵀ of a body that may touch something, from `factor_mass`: its twist by a unit of impulse."""
    deepest = int(-1)
    for k in range(node.first_column, node.first_column + node.columns):
        deepest = wp.max(deepest, scene.trees.columns[k])
    p = int(deepest)
    while p >= 0:
        room.trees.spread[world, p] = vec6()
        p = scene.trees.unknowns[p].parent
    for k in range(node.first_column, node.first_column + node.columns):
        u = scene.trees.columns[k]
        room.trees.spread[world, u] = room.trees.spread[world, u] + room.trees.columns[world, k]
    total = mat66()
    p = deepest
    while p >= 0:
        unknown = scene.trees.unknowns[p]
        own = room.trees.spread[world, p]
        total += room.trees.diagonal[world, p] * wp.outer(own, own)
        i = int(unknown.parent)
        t = int(unknown.depth - 1)
        while t >= 0:
            taken = room.trees.upper[world, unknown.first + t] * own
            room.trees.spread[world, i] = room.trees.spread[world, i] - taken
            i = scene.trees.unknowns[i].parent
            t -= 1
        p = unknown.parent
    return total


@wp.func
def add_to_block(room: wp.ref[Room], world: int, m: int, row: int, column: int, value: real):
    """Add to an entry of the Jacobian by blocks."""
    at = block_at(room, world, m, row // 6, column // 6)
    room.blocks[world, at][row % 6, column % 6] += value


@wp.func
def spread_over_blocks(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Add the matrix of trees that touch something to the Jacobian by blocks."""
    m = scene.n_blocks
    for k in range(scene.trees.order.shape[0]):
        u = scene.trees.order[k]
        if not in_solve(scene, room, world, u):
            unknown = scene.trees.unknowns[u]
            add_to_block(room, world, m, u, u, room.trees.diagonal[world, u])
            i = int(unknown.parent)
            t = int(unknown.depth - 1)
            while t >= 0:
                add_to_block(room, world, m, i, u, room.trees.upper[world, unknown.first + t])
                add_to_block(room, world, m, u, i, room.trees.lower[world, unknown.first + t])
                i = scene.trees.unknowns[i].parent
                t -= 1
    for b in range(m):
        index = scene.trees.blocks[b]
        at = room.used[world, b * m + b] - 1
        if at >= 0:
            for c in range(index.used, 6):
                room.blocks[world, at][c, c] = ONE


@wp.func
def entries_size(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, values: wp.array2d(dtype=vec6)
) -> real:
    """Largest sum of the terms of a row of the trees that touch nothing, in velocities [m/s]."""
    for k in range(scene.trees.order.shape[0]):
        u = scene.trees.order[k]
        if in_solve(scene, room, world, u):
            unknown = scene.trees.unknowns[u]
            y = unknown_of(values, world, u)
            own = wp.abs(room.trees.diagonal[world, u] * y)
            i = int(unknown.parent)
            t = int(unknown.depth - 1)
            while t >= 0:
                own += wp.abs(room.trees.lower[world, unknown.first + t] * unknown_of(values, world, i))
                more = wp.abs(room.trees.upper[world, unknown.first + t] * y)
                room.trees.column[world, i] = room.trees.column[world, i] + more
                i = scene.trees.unknowns[i].parent
                t -= 1
            room.trees.column[world, u] = own
    size = real(0.0)
    for k in range(scene.trees.order.shape[0]):
        u = scene.trees.order[k]
        if in_solve(scene, room, world, u):
            size = wp.max(size, unknown_of(room.scale, world, u) * room.trees.column[world, u])
    return size
