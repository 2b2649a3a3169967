"""Linear systems of 6 × 6 blocks, most of which are empty: bodies that touch few others.

Bodies that touch each other, or through others, are an *island*. On a CPU, islands of free bodies are solved
one after the other: where one takes many passes, the others are not looked at.

Elimination without exchanges between blocks. The next body is always one that is coupled with the fewest
others, so that little is filled in (minimum degree). Matrices of a step are inertia plus dissipation: their
pivots stay away from singular.
"""

import warp as wp

from dano.engine.kernels.lanes import wait
from dano.engine.kernels.tables import Island, Room, Scene
from dano.engine.kernels.trees.pattern import (
    block_at,
    couple,
    couple_pair,
    couple_trees,
    mark_tree,
    mark_trees,
)
from dano.physics.features import LANES, PATCHES, TREES
from dano.physics.real import mat33, mat66, real, vec6
from dano.physics.twists import joined_blocks

_LANES = wp.constant(LANES)
ISLANDS = LANES == 1 and not TREES and not PATCHES
"""Whether islands are solved one after the other. Lanes of a GPU look at all pairs at once."""
EVERYWHERE = wp.constant(-1)
"""Stands for all islands."""


@wp.func
def part_of(scene: wp.ref[Scene], room: wp.ref[Room], world: int, n_found: int, island: int) -> Island:
    """Places of what belongs to an island, or of all: see `member` and `pair_at`."""
    part = Island()
    if island == EVERYWHERE:
        part.end = scene.n_blocks
        part.end_pair = n_found
        part.end_block = room.lasting[world, 0].blocks
    else:
        part = room.of_islands[world, island]
    return part


@wp.func
def member(room: wp.ref[Room], world: int, island: int, place: int) -> int:
    """The block of unknowns at a place."""
    if wp.static(ISLANDS):
        if island != EVERYWHERE:
            return room.members[world, place]
    return place


@wp.func
def pair_at(room: wp.ref[Room], world: int, island: int, place: int) -> int:
    """The pair with points at a place."""
    if wp.static(ISLANDS):
        if island != EVERYWHERE:
            return room.sorted_pairs[world, place]
    return place


@wp.func
def forget_blocks(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int):
    """Have all blocks found anew: nothing is known of what the room holds."""
    if lane == 0:
        for k in range(scene.n_blocks * scene.n_blocks):
            room.used[world, k] = 0
        room.lasting[world, 0].blocks = 0


@wp.func
def find_islands(scene: wp.ref[Scene], room: wp.ref[Room], world: int, n_found: int):
    """Which blocks and pairs belong to which island, in their order; its number is its first one's."""
    m = scene.n_blocks
    for i in range(m):
        room.islands[world, i] = -1
    for i in range(m):
        if room.islands[world, i] < 0:
            room.islands[world, i] = i
            room.of_islands[world, i] = Island()
            room.members[world, 0] = i
            waiting = int(1)
            while waiting > 0:
                waiting -= 1
                k = room.members[world, waiting]
                room.of_islands[world, i].end = room.of_islands[world, i].end + 1
                for e in range(room.neighbours[world, k]):
                    j = room.beside[world, k * m + e]
                    if room.islands[world, j] < 0:
                        room.islands[world, j] = i
                        room.members[world, waiting] = j
                        waiting += 1
    for f in range(n_found):
        island = island_of(scene, room, world, f)
        room.of_islands[world, island].end_pair = room.of_islands[world, island].end_pair + 1
    first = int(0)
    first_pair = int(0)
    for i in range(m):
        if room.islands[world, i] == i:
            part = room.of_islands[world, i]
            room.of_islands[world, i].first = first
            room.of_islands[world, i].first_pair = first_pair
            room.of_islands[world, i].end = first
            room.of_islands[world, i].end_pair = first_pair
            first += part.end
            first_pair += part.end_pair
    for i in range(m):
        island = room.islands[world, i]
        at = room.of_islands[world, island].end
        room.members[world, at] = i
        room.of_islands[world, island].end = at + 1
    for f in range(n_found):
        island = island_of(scene, room, world, f)
        at = room.of_islands[world, island].end_pair
        room.sorted_pairs[world, at] = f
        room.of_islands[world, island].end_pair = at + 1


@wp.func
def island_of(scene: wp.ref[Scene], room: wp.ref[Room], world: int, f: int) -> int:
    """The island of a pair that is near: of its bodies at least one moves."""
    index = scene.pair_index[room.found[world, f * _LANES].pair]
    a = scene.body_index[index.first].row
    if a < 0:
        a = scene.body_index[index.second].row
    return room.islands[world, a]


@wp.func
def find_pattern(scene: wp.ref[Scene], room: wp.ref[Room], world: int, n_found: int):
    """Which blocks are coupled, with what elimination fills in; its order, and later neighbours.

    Trees that touch nothing are not in it: see `dano.engine.kernels.trees.factor`.
    """
    m = scene.n_blocks
    for e in range(room.lasting[world, 0].blocks):
        room.used[world, room.listed[world, e]] = 0
    for i in range(m):
        room.used[world, i * m + i] = 1
        room.neighbours[world, i] = 0
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
    for i in range(m):
        room.counts[world, i] = -1
        room.order[world, i] = -1
    room.lasting[world, 0].blocks = 0
    if wp.static(TREES):
        couple_trees(scene, room, world)
    begin_degrees(scene, room, world, m)
    if wp.static(ISLANDS):
        find_islands(scene, room, world, n_found)
        for i in range(m):
            if room.islands[world, i] == i:
                part = room.of_islands[world, i]
                room.of_islands[world, i].first_block = room.lasting[world, 0].blocks
                order_blocks(room, world, m, part.first, part.end, i)
                list_blocks(room, world, m, part.first, part.end, i)
                room.of_islands[world, i].end_block = room.lasting[world, 0].blocks
    else:
        order_blocks(room, world, m, 0, m, EVERYWHERE)
        list_blocks(room, world, m, 0, m, EVERYWHERE)


@wp.func
def order_blocks(room: wp.ref[Room], world: int, m: int, first: int, end: int, island: int):
    """Eliminate the blocks of an island: always one that is coupled with the fewest others."""
    for step in range(first, end):
        best = int(-1)
        fewest = 2 * m + 1
        for e in range(first, end):
            i = member(room, world, island, e)
            if room.counts[world, i] < 0 and room.degrees[world, i] < fewest:
                fewest = room.degrees[world, i]
                best = i
        if best >= 0:
            room.order[world, step] = best
            eliminate(room, world, m, best)


@wp.func
def begin_degrees(scene: wp.ref[Scene], room: wp.ref[Room], world: int, m: int):
    """With how many others that are to be eliminated each block is coupled."""
    for i in range(m):
        degree = int(0)
        if wp.static(TREES):
            # Forces in loops have nothing on the diagonal before all that they push is eliminated.
            degree = m * scene.trees.blocks[i].is_loop
        for e in range(room.neighbours[world, i]):
            if room.counts[world, room.beside[world, i * m + e]] < 0:
                degree += 1
        room.degrees[world, i] = degree


@wp.func
def put_sorted(list: wp.array2d(dtype=wp.int32), world: int, first: int, n: int, value: int):
    """Put a number into a list that is sorted, of n others."""
    at = int(n)
    while at > 0 and list[world, first + wp.max(at - 1, 0)] > value:
        list[world, first + at] = list[world, first + at - 1]
        at -= 1
    list[world, first + at] = value


@wp.func
def eliminate(room: wp.ref[Room], world: int, m: int, best: int):
    """List the later neighbours of a block, which its elimination couples with each other."""
    n = int(0)
    for e in range(room.neighbours[world, best]):
        j = room.beside[world, best * m + e]
        if room.counts[world, j] < 0:
            put_sorted(room.later, world, best * m, n, j)
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
def list_blocks(room: wp.ref[Room], world: int, m: int, first: int, end: int, island: int):
    """Give the blocks of an island that are in use their places, row by row."""
    n = room.lasting[world, 0].blocks
    for e in range(first, end):
        i = member(room, world, island, e)
        room.begins[world, i] = n
        count = int(0)
        if room.used[world, i * m + i] > 0:
            room.listed[world, n] = i * m + i
            count = 1
        for k in range(room.neighbours[world, i]):
            put_sorted(room.listed, world, n, count, i * m + room.beside[world, i * m + k])
            count += 1
        for k in range(n, n + count):
            room.used[world, room.listed[world, k]] = k + 1
        n += count
        room.ends[world, i] = n
    room.lasting[world, 0].blocks = n


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
    first = int(0)
    end = int(m)
    if wp.static(ISLANDS):
        if island != EVERYWHERE:
            first = room.of_islands[world, island].first
            end = room.of_islands[world, island].end
    for s in range(first, end):
        k = room.order[world, s]
        if k >= 0:
            n = room.counts[world, k]
            own = block_at(room, world, m, k, k)
            if lane == 0:
                room.spare[world, own] = inverse(room.spare[world, own])
            wait()
            for a in range(lane, n, _LANES):
                i = room.later[world, k * m + a]
                at = block_at(room, world, m, i, k)
                below = room.spare[world, at] * room.spare[world, own]
                room.spare[world, at] = below
                room.step[world, i] = room.step[world, i] - below * room.step[world, k]
            wait()
            for e in range(lane, n * n, _LANES):
                i = room.later[world, k * m + e // n]
                j = room.later[world, k * m + e % n]
                left = block_at(room, world, m, i, k)
                right = block_at(room, world, m, k, j)
                at = block_at(room, world, m, i, j)
                taken = room.spare[world, left] * room.spare[world, right]
                room.spare[world, at] = room.spare[world, at] - taken
            wait()
    if lane == 0:
        for t in range(first, end):
            k = room.order[world, end - 1 - t + first]
            if k >= 0:
                x = room.step[world, k]
                for a in range(room.counts[world, k]):
                    i = room.later[world, k * m + a]
                    x -= room.spare[world, block_at(room, world, m, k, i)] * room.step[world, i]
                room.step[world, k] = room.spare[world, block_at(room, world, m, k, k)] * x


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
    part: Island,
    island: int,
    values: wp.array2d(dtype=vec6),
    into: wp.array2d(dtype=vec6),
):
    """Copy numbers of an island."""
    for e in range(part.first, part.end):
        i = member(room, world, island, e)
        into[world, i] = values[world, i]


@wp.func
def copy_blocks(room: wp.ref[Room], world: int, lane: int, m: int, island: int):
    """Copy the Jacobian of an island into `spare`, each lane a part."""
    first = int(0)
    end = room.lasting[world, 0].blocks
    if wp.static(ISLANDS):
        if island != EVERYWHERE:
            first = room.of_islands[world, island].first_block
            end = room.of_islands[world, island].end_block
    for k in range(first + lane, end, _LANES):
        room.spare[world, k] = room.blocks[world, k]


@wp.func
def copy_transposed_blocks(room: wp.ref[Room], world: int, lane: int, m: int):
    """Copy the transpose of the Jacobian into `spare`, each lane a part."""
    for k in range(lane, room.lasting[world, 0].blocks, _LANES):
        place = room.listed[world, k]
        at = block_at(room, world, m, place % m, place // m)
        room.spare[world, at] = wp.transpose(room.blocks[world, k])
