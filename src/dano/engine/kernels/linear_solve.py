"""Linear systems of 6 × 6 blocks, most of which are empty: bodies that touch few others.

Elimination without exchanges between blocks. The next body is always one that is coupled with the fewest
others, so that little is filled in (minimum degree). Matrices of a step are inertia plus dissipation: their
pivots stay away from singular.
"""

import warp as wp

from dano.engine.kernels.tables import Room, Scene
from dano.physics.features import LANES
from dano.physics.real import mat66, ONE, real, vec6, ZERO

_LANES = wp.constant(LANES)


@wp.func
def couple(room: Room, world: int, m: int, i: int, j: int):
    """Say that two bodies share a block."""
    room.used[world, i * m + j] = 1
    room.used[world, j * m + i] = 1


@wp.func
def find_pattern(scene: Scene, room: Room, world: int, n_found: int):
    """Which bodies share a block, with what elimination fills in; its order, and later neighbours."""
    m = scene.moving.shape[0]
    for k in range(m * m):
        room.used[world, k] = 0
    for i in range(m):
        room.used[world, i * m + i] = 1
    for f in range(n_found):
        index = scene.pair_index[room.found[world, f * _LANES].pair]
        a = scene.body_index[index.first].row
        b = scene.body_index[index.second].row
        if a >= 0 and b >= 0:
            couple(room, world, m, a, b)
    for i in range(m):
        room.counts[world, i] = -1
    for step in range(m):
        best = int(-1)
        fewest = m + 1
        for i in range(m):
            if room.counts[world, i] < 0:
                degree = int(0)
                for j in range(m):
                    if room.counts[world, j] < 0 and j != i:
                        degree += room.used[world, i * m + j]
                if degree < fewest:
                    fewest = degree
                    best = i
        room.order[world, step] = best
        n = int(0)
        for j in range(m):
            if j != best and room.counts[world, j] < 0 and room.used[world, best * m + j] > 0:
                room.later[world, best * m + n] = j
                n += 1
        room.counts[world, best] = n
        for a in range(n):
            for b in range(a + 1, n):
                couple(room, world, m, room.later[world, best * m + a], room.later[world, best * m + b])


@wp.func
def inverse(a: mat66) -> mat66:
    """Inverse by Gauss–Jordan elimination with row exchanges."""
    inverted = wp.identity(n=6, dtype=real)
    for k in range(6):
        best = k
        for r in range(k + 1, 6):
            if wp.abs(a[r, k]) > wp.abs(a[best, k]):
                best = r
        pivot = a[best]
        own = inverted[best]
        if best != k:
            a[best] = a[k]
            inverted[best] = inverted[k]
        scale = ONE / pivot[k]
        pivot = pivot * scale
        own = own * scale
        a[k] = pivot
        inverted[k] = own
        for r in range(6):
            if r != k:
                factor = a[r, k]
                a[r] = a[r] - factor * pivot
                inverted[r] = inverted[r] - factor * own
    return inverted


@wp.func
def solve_blocks(room: Room, world: int, m: int):
    """Solve `spare` x = x in place, x in `room.step`; `spare` is used up."""
    for s in range(m):
        k = room.order[world, s]
        pivot = inverse(room.spare[world, k * m + k])
        room.spare[world, k * m + k] = pivot
        n = room.counts[world, k]
        for a in range(n):
            i = room.later[world, k * m + a]
            below = room.spare[world, i * m + k] * pivot
            room.step[world, i] -= below * room.step[world, k]
            for b in range(n):
                j = room.later[world, k * m + b]
                room.spare[world, i * m + j] -= below * room.spare[world, k * m + j]
    for t in range(m):
        k = room.order[world, m - 1 - t]
        x = room.step[world, k]
        for a in range(room.counts[world, k]):
            i = room.later[world, k * m + a]
            x -= room.spare[world, k * m + i] * room.step[world, i]
        room.step[world, k] = room.spare[world, k * m + k] * x


@wp.func
def copy_blocks(room: Room, world: int, m: int):
    """Copy the Jacobian into `spare`."""
    for k in range(m * m):
        if room.used[world, k] > 0:
            room.spare[world, k] = room.blocks[world, k]


@wp.func
def copy_transposed_blocks(room: Room, world: int, m: int):
    """Copy the transpose of the Jacobian into `spare`."""
    for i in range(m):
        for j in range(m):
            if room.used[world, i * m + j] > 0:
                room.spare[world, j * m + i] = wp.transpose(room.blocks[world, i * m + j])
