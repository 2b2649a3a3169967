"""Islands that rest on what is fixed are not solved again until something moves near them, or pushes differ.

At rest the root of a step is no motion but for rounding. Then velocities are set to zero and poses kept: what
a step is given is what it leaves, to the last bit, and so is the step after it. As long as nothing else is
near that moves and the pushes are the same, all later steps are known: the island *sleeps*. When it wakes, it
is where it would be without.

Only on a CPU, between bodies that move freely: where islands are solved one after the other. Derivatives look
at each step anew, whether bodies sleep or not.
"""

import warp as wp

from dano.engine.kernels.linear_solve import ISLANDS
from dano.engine.kernels.near import is_near
from dano.engine.kernels.sweep import may_be_near
from dano.engine.kernels.tables import Room, Scene
from dano.physics.real import real, vec6, ZERO

# Velocities up to which a body at rest moves by rounding only [m/s, rad/s]; in resting piles by 1e-13.
_STILL = wp.constant(real(1e-12))


@wp.func
def wake_all(scene: wp.ref[Scene], room: wp.ref[Room], world: int):
    """Have nothing asleep: a launch begins."""
    if wp.static(ISLANDS):
        for i in range(scene.n_blocks):
            room.asleep[world, i] = -1
        room.lasting[world, 0].asleep = 0


@wp.func
def sleeps(room: wp.ref[Room], world: int, row: int) -> bool:
    """Whether a body sleeps, by its row; −1 for one that does not move."""
    if wp.static(ISLANDS):
        return row >= 0 and room.asleep[world, wp.max(row, 0)] >= 0
    return False


@wp.func
def all_sleep(scene: wp.ref[Scene], room: wp.ref[Room], world: int) -> bool:
    """Whether every body that moves sleeps: then nothing is near anything that it was not near before."""
    if wp.static(ISLANDS):
        return scene.n_blocks > 0 and room.lasting[world, 0].asleep == scene.n_blocks
    return False


@wp.func
def wake(scene: wp.ref[Scene], room: wp.ref[Room], world: int, row: int):
    """Wake the island of a body. What the room holds of it is what a step would begin with."""
    island = room.asleep[world, row]
    for i in range(scene.n_blocks):
        if room.asleep[world, i] == island:
            room.asleep[world, i] = -1
            room.lasting[world, 0].asleep = room.lasting[world, 0].asleep - 1


@wp.func
def is_idle(scene: wp.ref[Scene], room: wp.ref[Room], world: int, pair: int) -> bool:
    """Whether both bodies of a pair sleep, or one of them, and the other does not move."""
    if wp.static(ISLANDS):
        if room.lasting[world, 0].asleep > 0:
            index = scene.pair_index[pair]
            a = scene.body_index[index.first].row
            b = scene.body_index[index.second].row
            return (a < 0 or sleeps(room, world, a)) and (b < 0 or sleeps(room, world, b))
    return False


@wp.func
def sleeper_of(scene: wp.ref[Scene], room: wp.ref[Room], world: int, pair: int) -> int:
    """Row of the body of a pair that sleeps while the other moves; −1 where there is none."""
    index = scene.pair_index[pair]
    a = scene.body_index[index.first].row
    b = scene.body_index[index.second].row
    found = int(-1)
    if a >= 0 and b >= 0:
        if sleeps(room, world, a) and not sleeps(room, world, b):
            found = a
        if sleeps(room, world, b) and not sleeps(room, world, a):
            found = b
    return found


@wp.func
def wake_near(scene: wp.ref[Scene], room: wp.ref[Room], world: int, candidates: int):
    """Wake what something that moves is near, and what that is near, and so on."""
    if wp.static(ISLANDS):
        h = scene.timestep[world, 0]
        again = room.lasting[world, 0].asleep > 0 and room.lasting[world, 0].asleep < scene.n_blocks
        while again:
            woken = int(0)
            for c in range(wp.where(candidates < 0, scene.n_pressing, candidates)):
                p = c
                if candidates >= 0:
                    p = room.candidates[world, c]
                row = sleeper_of(scene, room, world, p)
                if row >= 0:
                    near = bool(True)
                    if candidates >= 0:
                        near = may_be_near(scene, room, world, p)
                    if near:
                        index = scene.pair_index[p]
                        margin = scene.pairs[world, index.row].margin
                        a = room.bodies[world, index.first]
                        b = room.bodies[world, index.second]
                        if is_near(scene, world, a, b, index.first, index.second, margin, h):
                            wake(scene, room, world, row)
                            woken += 1
            again = woken > 0


@wp.func
def is_still(scene: wp.ref[Scene], room: wp.ref[Room], world: int, island: int) -> bool:
    """Whether an island that was solved rests on something fixed, and moves by rounding only."""
    part = room.of_islands[world, island]
    on_fixed = bool(False)
    for e in range(part.first_pair, part.end_pair):
        index = scene.pair_index[room.found[world, room.sorted_pairs[world, e]].pair]
        fixed = scene.body_index[index.first].row < 0 or scene.body_index[index.second].row < 0
        on_fixed = on_fixed or fixed
    still = bool(on_fixed)
    for e in range(part.first, part.end):
        i = room.members[world, e]
        for c in range(6):
            still = still and wp.abs(room.velocity[world, i][c]) <= _STILL
    return still


@wp.func
def began_at_rest(scene: wp.ref[Scene], room: wp.ref[Room], world: int, island: int) -> bool:
    """Whether all bodies of an island had no velocity at all when the step began."""
    part = room.of_islands[world, island]
    rested = bool(True)
    for e in range(part.first, part.end):
        state = room.bodies[world, scene.moving[room.members[world, e]]]
        rested = rested and wp.length_sq(state.velocity) == ZERO and wp.length_sq(state.spin) == ZERO
    return rested


@wp.func
def fall_asleep(scene: wp.ref[Scene], room: wp.ref[Room], world: int, converged: bool):
    """After a solve: note which bodies rest, in `room.rests`, and which of them sleep from now on."""
    if wp.static(ISLANDS):
        for i in range(scene.n_blocks):
            if room.islands[world, i] == i and not sleeps(room, world, i):
                rests = converged and is_still(scene, room, world, i)
                stays = rests and began_at_rest(scene, room, world, i)
                part = room.of_islands[world, i]
                for e in range(part.first, part.end):
                    k = room.members[world, e]
                    room.rests[world, k] = wp.where(rests, 1, 0)
                    if stays:
                        room.velocity[world, k] = vec6()
                        room.asleep[world, k] = i
                        room.lasting[world, 0].asleep = room.lasting[world, 0].asleep + 1


@wp.func
def is_at_rest(room: wp.ref[Room], world: int, row: int) -> bool:
    """Whether a body rests at the end of a step, by its row; see `fall_asleep`."""
    if wp.static(ISLANDS):
        return row >= 0 and room.rests[world, wp.max(row, 0)] > 0
    return False
