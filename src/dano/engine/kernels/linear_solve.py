"""Linear systems of 6 × 6 blocks, most of which are empty: bodies that touch few others.

Bodies that touch each other, or through others, are an *island*. On a CPU, islands of free bodies are solved
one after the other: where one takes many passes, the others are not looked at.

Elimination without exchanges between blocks. The next body is always one that is coupled with the fewest
others, so that little is filled in (minimum degree). Matrices of a step are inertia plus dissipation: their
pivots stay away from singular.
"""

import warp as wp

from dano.engine.kernels.lanes import wait
from dano.engine.kernels.tables import Room, Scene
from dano.engine.kernels.trees.pattern import couple, couple_pair, couple_trees, mark_tree, mark_trees
from dano.physics.features import LANES, PATCHES, TREES
from dano.physics.real import mat33, mat66, real, vec6
from dano.physics.twists import joined_blocks

_LANES = wp.constant(LANES)
ISLANDS = LANES == 1 and not TREES and not PATCHES
"""Whether islands are solved one after the other. Lanes of a GPU look at all pairs at once."""
EVERYWHERE = wp.constant(-1)
"""Stands for all islands."""


@wp.func
def is_in(room: wp.ref[Room], world: int, row: int, island: int) -> bool:
    """Whether a block belongs to an island."""
    return island == EVERYWHERE or room.islands[world, row] == island


@wp.func
def touches(scene: wp.ref[Scene], room: wp.ref[Room], world: int, f: int, island: int) -> bool:
    """Whether a pair that is near belongs to an island: of its bodies at least one moves."""
    if island == EVERYWHERE:
        return True
    index = scene.pair_index[room.found[world, f].pair]
    a = scene.body_index[index.first].row
    if a < 0:
        a = scene.body_index[index.second].row
    return room.islands[world, a] == island


@wp.func
def join(room: wp.ref[Room], world: int, m: int, a: int, b: int):
    """Make one island of those of two blocks, with the number of its first block."""
    first = wp.min(room.islands[world, a], room.islands[world, b])
    last = wp.max(room.islands[world, a], room.islands[world, b])
    if first < last:
        for i in range(last, m):
            if room.islands[world, i] == last:
                room.islands[world, i] = first


@wp.func
def find_pattern(scene: wp.ref[Scene], room: wp.ref[Room], world: int, n_found: int):
    """Which blocks are coupled, with what elimination fills in; its order, and later neighbours.

    Trees that touch nothing are not in it: see `dano.engine.kernels.trees.factor`.
    """
    m = scene.n_blocks
    for k in range(m * m):
        room.used[world, k] = 0
    for i in range(m):
        room.used[world, i * m + i] = 1
        room.islands[world, i] = i
    if wp.static(TREES):
        mark_trees(scene, room, world)
    for f in range(n_found):
        index = scene.pair_index[room.found[world, f * _LANES].pair]
        a = scene.body_index[index.first].row
        b = scene.body_index[index.second].row
        if wp.static(TREES):
            couple_pair(scene, room, world, a, b)
            mark_tree(scene, room, world, a)
            mark_tree(scene, room, world, b)
        elif a >= 0 and b >= 0:
            couple(room, world, m, a, b)
            join(room, world, m, a, b)
    for i in range(m):
        room.counts[world, i] = -1
        room.order[world, i] = -1
    if wp.static(TREES):
        couple_trees(scene, room, world)
    begin_degrees(scene, room, world, m)
    for step in range(m):
        best = int(-1)
        fewest = 2 * m + 1
        for i in range(m):
            if room.counts[world, i] < 0 and room.degrees[world, i] < fewest:
                fewest = room.degrees[world, i]
                best = i
        if best >= 0:
            room.order[world, step] = best
            eliminate(room, world, m, best)
    list_blocks(room, world, m)


@wp.func
def begin_degrees(scene: wp.ref[Scene], room: wp.ref[Room], world: int, m: int):
    """With how many others that are to be eliminated each block is coupled."""
    for i in range(m):
        degree = int(0)
        if wp.static(TREES):
            # Forces in loops have nothing on the diagonal before all that they push is eliminated.
            degree = m * scene.trees.blocks[i].is_loop
        for j in range(m):
            if room.counts[world, j] < 0 and j != i:
                degree += room.used[world, i * m + j]
        room.degrees[world, i] = degree


@wp.func
def eliminate(room: wp.ref[Room], world: int, m: int, best: int):
    """List the later neighbours of a block, which its elimination couples with each other."""
    n = int(0)
    for j in range(m):
        if j != best and room.counts[world, j] < 0 and room.used[world, best * m + j] > 0:
            room.later[world, best * m + n] = j
            room.degrees[world, j] = room.degrees[world, j] - 1
            n += 1
    room.counts[world, best] = n
    for a in range(n):
        i = room.later[world, best * m + a]
        for b in range(a + 1, n):
            j = room.later[world, best * m + b]
            if room.used[world, i * m + j] == 0:
                couple(room, world, m, i, j)
                room.degrees[world, i] = room.degrees[world, i] + 1
                room.degrees[world, j] = room.degrees[world, j] + 1


@wp.func
def list_blocks(room: wp.ref[Room], world: int, m: int):
    """List the blocks in use, row by row."""
    n = int(0)
    for i in range(m):
        for j in range(m):
            if room.used[world, i * m + j] > 0:
                room.listed[world, n] = i * m + j
                n += 1
        room.ends[world, i] = n


@wp.func
def n_listed(room: wp.ref[Room], world: int, row: int) -> int:
    """Number of blocks in use in the rows before one: where those of a row begin in the list."""
    if row == 0:
        return 0
    return room.ends[world, row - 1]


@wp.func
def quarter(a: mat66, row: int, column: int) -> mat33:
    """The 3 × 3 part of a block that begins at a row and a column."""
    return mat33(
        a[row, column], a[row, column + 1], a[row, column + 2],
        a[row + 1, column], a[row + 1, column + 1], a[row + 1, column + 2],
        a[row + 2, column], a[row + 2, column + 1], a[row + 2, column + 2],
    )  # fmt: skip


@wp.func
def inverse(m: mat66) -> mat66:
    """Inverse by the Schur complement of its first 3 × 3 part: mass plus dissipation, away from singular."""
    a = wp.inverse(quarter(m, 0, 0))
    b = quarter(m, 0, 3)
    c = quarter(m, 3, 0)
    left = c * a
    s = wp.inverse(quarter(m, 3, 3) - left * b)
    right = a * b * s
    return joined_blocks(a + right * left, -right, -(s * left), s)


@wp.func
def solve_blocks(room: wp.ref[Room], world: int, lane: int, m: int, island: int):
    """Solve `spare` x = x in place, x in `room.step`, for an island; `spare` is used up.

    Both have to be known to all lanes; the solution is known to the first.
    """
    for s in range(m):
        k = room.order[world, s]
        if k >= 0 and is_in(room, world, k, island):
            n = room.counts[world, k]
            if lane == 0:
                room.spare[world, k * m + k] = inverse(room.spare[world, k * m + k])
            wait()
            for a in range(lane, n, _LANES):
                i = room.later[world, k * m + a]
                below = room.spare[world, i * m + k] * room.spare[world, k * m + k]
                room.spare[world, i * m + k] = below
                room.step[world, i] = room.step[world, i] - below * room.step[world, k]
            wait()
            for e in range(lane, n * n, _LANES):
                i = room.later[world, k * m + e // n]
                j = room.later[world, k * m + e % n]
                taken = room.spare[world, i * m + k] * room.spare[world, k * m + j]
                room.spare[world, i * m + j] = room.spare[world, i * m + j] - taken
            wait()
    if lane == 0:
        for t in range(m):
            k = room.order[world, m - 1 - t]
            if k >= 0 and is_in(room, world, k, island):
                x = room.step[world, k]
                for a in range(room.counts[world, k]):
                    i = room.later[world, k * m + a]
                    x -= room.spare[world, k * m + i] * room.step[world, i]
                room.step[world, k] = room.spare[world, k * m + k] * x


@wp.func
def worse_of(error: real, room: wp.ref[Room], world: int, row: int) -> real:
    """The larger one of an error and a block's residual over mass or inertia [m/s, rad/s]; it may be NaN."""
    residual = room.residual[world, row]
    scale = room.scale[world, row]
    worse = real(error)
    for c in range(6):
        missed = wp.abs(scale[c] * residual[c])
        if not (missed <= worse) and not wp.isnan(worse):
            worse = missed
    return worse


@wp.func
def absolute_product(room: wp.ref[Room], world: int, block: int, v: vec6) -> vec6:
    """Σ |a_rc v_c| of each row of a block."""
    a = room.blocks[world, block]
    found = vec6()
    for r in range(6):
        for c in range(6):
            found[r] = found[r] + wp.abs(a[r, c] * v[c])
    return found


@wp.func
def copy_rows(
    room: wp.ref[Room],
    world: int,
    m: int,
    island: int,
    values: wp.array2d(dtype=vec6),
    into: wp.array2d(dtype=vec6),
):
    """Copy numbers of an island."""
    for i in range(m):
        if is_in(room, world, i, island):
            into[world, i] = values[world, i]


@wp.func
def copy_blocks(room: wp.ref[Room], world: int, lane: int, m: int, island: int):
    """Copy the Jacobian of an island into `spare`, each lane a part."""
    for e in range(lane, n_listed(room, world, m), _LANES):
        k = room.listed[world, e]
        if is_in(room, world, k // m, island):
            room.spare[world, k] = room.blocks[world, k]


@wp.func
def copy_transposed_blocks(room: wp.ref[Room], world: int, lane: int, m: int):
    """Copy the transpose of the Jacobian into `spare`, each lane a part."""
    for e in range(lane, n_listed(room, world, m), _LANES):
        k = room.listed[world, e]
        room.spare[world, (k % m) * m + k // m] = wp.transpose(room.blocks[world, k])
