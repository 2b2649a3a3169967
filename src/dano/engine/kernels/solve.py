"""A primal–dual Newton method for the velocities of bodies that touch (docs/theory/integrator.md).

Unknowns are the end-of-step velocities V of all bodies that move, in world axes, and for every point the
friction λ and the direction s of its hysteresis. A pass linearises the momentum balance and the equations
of λ and s, eliminates these point by point, solves for dV, takes the whole step, and projects λ and s
onto |λ| ≤ b(p), |s| ≤ 1. What is left after the elimination is the law's own residual, whatever λ and s
are; the Jacobian uses the current λ instead of its limit, so it is right before directions of slip have
settled. A solve ends when the residual is small and λ and s fit the velocities, so that the Jacobian is
that of the law, too.

Full steps can cycle. A solve that has not converged within a few passes takes shares of steps, smaller after
each step that made the residual larger. Where that cycles, too, friction mostly presses a point in, which
raises its friction. Then the solve begins again, from rest and almost without friction: the equations are
nearly those of a convex function, and a line search finds their root. Friction grows to what it is in levels,
each from the root of the one before. What does not converge ends where its residual was smallest.
"""

import warp as wp

from dano.engine.kernels.assembly import assemble, fit_duals, follow_duals, Trial
from dano.engine.kernels.lanes import greatest, total, wait
from dano.engine.kernels.linear_solve import (
    absolute_product,
    copy_blocks,
    copy_rows,
    EVERYWHERE,
    ISLANDS,
    member,
    part_of,
    solve_blocks,
    worse_of,
)
from dano.engine.kernels.patches import add_patches, any_sticks, fit_patch_duals, follow_patch_duals
from dano.engine.kernels.sleep import sleeps
from dano.engine.kernels.tables import Room, Scene
from dano.engine.kernels.trees.balance import (
    add_tree_slopes,
    eliminate_joint_duals,
    finish_joint_duals,
    fit_joint_duals,
    follow_joint_duals,
    measure_joints,
    resolve_joints,
    same_mode,
    solve_trees,
)
from dano.physics.features import LANES, PATCHES, TREES
from dano.physics.real import HALF, INFINITY, ONE, real, TWO, vec6, ZERO

LEVELS = 9
"""Number of levels of a solve."""
_LEVELS, _LANES = wp.constant(LEVELS), wp.constant(LANES)
# In the first level steps are whole for so many passes, then shares that grow and shrink by these factors and
# are no less than the last: on recorded piles of 8 to 64 bodies half the passes of fixed shares, or as many.
_WHOLE = wp.constant(4)
_GROWS, _SHRINKS, _LEAST = wp.constant(real(1.1)), wp.constant(real(0.8)), wp.constant(real(0.2))
# Residual to which levels with less friction are solved [m/s].
_ROUGH = wp.constant(real(1e-4))
# A step is accepted when what the residual does along it fell to this share; when the bracket around the zero
# of that is narrower than this share of the step, it is accepted as it is.
_ENOUGH, _GIVE_UP = wp.constant(real(0.5)), wp.constant(real(0.01))
# Residual over the rounding of velocities beside which nothing is left to take.
_EXACT = wp.constant(real(4.0))


@wp.struct
class Options:
    """When a solve stops."""

    tolerance: real  # Residual over (1 + size) that counts as solved
    rounding: real  # Of the numbers
    # What duals may miss, in shares of all pressure, and a residual by rounding, over (1 + size)
    fit: real
    max_passes: int  # Passes after which a solve gives up


@wp.struct
class Level:
    """How a level of a solve is solved."""

    friction: real  # Share of the friction that there is
    share: real  # Of a step that is taken
    searches: bool  # Whether a line search runs
    begins: bool  # Whether it begins from rest
    budget: int  # Passes


@wp.struct
class Search:
    """A line search along Newton's step, for a zero of the work of the residual along it."""

    begun: real  # Work at the accepted point
    length: real  # Share of the step to try
    low: real  # Largest share known to be too short, and the work there
    low_work: real  # …
    high: real  # Smallest share known to be too long, 0 if none, and the work there
    high_work: real  # …


@wp.struct
class Measured:
    """What a pass finds."""

    work: real  # Of the residual along the step
    error: real  # Largest residual over mass or inertia [m/s, rad/s]
    size: real  # Largest sum of the terms of a row of the Jacobian [m/s]


@wp.struct
class Solved:
    """How a solve ended."""

    residual: real  # Largest residual over mass or inertia [m/s, rad/s]
    passes: int  # How many it took
    converged: bool  # Whether it converged


@wp.func
def level_of(number: int) -> Level:
    """Friction as it is; from rest, almost none, then more and more; as it is; short steps."""
    level = Level()
    level.friction = ONE
    level.share = ONE
    level.searches = True
    level.begins = number == 1
    level.budget = 100
    if number == 0:
        level.searches = False
    elif number == 1:
        level.friction = real(0.01)
        level.budget = 80
    elif number < 7:
        level.friction = real(0.1) + real(0.2) * real(number - 2)
        level.budget = 25
    elif number == 8:
        level.share = real(0.4)
        level.searches = False
        level.budget = 75
    return level


@wp.func
def begin_search(begun: real) -> Search:
    """Try the whole step first."""
    search = Search()
    search.begun = begun
    search.length = ONE
    search.low_work = begun
    return search


@wp.func
def accepts(search: Search, work: real) -> bool:
    """Whether a share of the step is good enough."""
    bracketed = search.high > ZERO
    limit = _ENOUGH * wp.abs(search.begun)
    misses = work > limit or (bracketed and work < -limit) or wp.isnan(work)
    close = bracketed and search.high - search.low < _GIVE_UP
    return not misses or close or search.begun >= ZERO


@wp.func
def narrowed(search: Search, work: real) -> Search:
    """The next share after a miss: regula falsi with halved ends (Illinois)."""
    after = search
    if not (work < ZERO):
        after.low_work = HALF * search.low_work
        after.high = search.length
        after.high_work = work
    else:
        after.low = search.length
        after.low_work = work
        if search.high != ZERO:
            after.high_work = HALF * search.high_work
    portion = -after.low_work / (after.high_work - after.low_work)
    if wp.isnan(portion):
        portion = real(0.1)
    portion = wp.min(wp.max(portion, real(0.1)), real(0.9))
    after.length = after.low + portion * (after.high - after.low)
    return after


@wp.func
def measure(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, island: int) -> Measured:
    """Of the residual and Jacobian of an island at the velocities that were tried."""
    m = scene.n_blocks
    found = Measured()
    if wp.static(TREES):
        if lane == 0:
            of_joints = measure_joints(scene, room, world)
            found.work = of_joints.work
            found.error = of_joints.error
            found.size = wp.max(of_joints.size, room.trees.sizes[world, 1])
    part = part_of(scene, room, world, 0, island)
    for e in range(part.first + lane, part.end, _LANES):
        i = member(room, world, island, e)
        found.work += wp.dot(room.step[world, i], room.residual[world, i])
        found.error = worse_of(found.error, room, world, i)
        scale = room.scale[world, i]
        size = vec6()
        for k in range(room.begins[world, i], room.ends[world, i]):
            size += absolute_product(room, world, k, room.tried[world, room.listed[world, k] % m])
        for c in range(6):
            found.size = wp.max(found.size, scale[c] * size[c])
    found.work = total(found.work)
    found.error = greatest(found.error)
    found.size = greatest(found.size)
    return found


@wp.func
def largest_error(scene: wp.ref[Scene], room: wp.ref[Room], world: int) -> real:
    """Largest residual over mass or inertia at the velocities that were tried [m/s, rad/s]."""
    error = measure_joints(scene, room, world).error
    for i in range(scene.n_blocks):
        error = worse_of(error, room, world, i)
    return error


@wp.func(inline=True)
def newton_step(scene: Scene, room: Room, world: int, lane: int, share: real, keeps: bool, island: int):
    """A share of Newton's step from what was tried, in `room.step`.

    Args:
        scene: The scene.
        room: Room.
        world: Which world.
        lane: Which lane of it.
        share: The share.
        keeps: Whether trees have the derivative of the step before.
        island: Of which bodies.
    """
    m = scene.n_blocks
    copy_blocks(room, world, lane, m, island)
    part = part_of(scene, room, world, 0, island)
    for e in range(part.first + lane, part.end, _LANES):
        i = member(room, world, island, e)
        room.step[world, i] = -room.residual[world, i]
    wait()
    if wp.static(TREES):
        if lane == 0:
            eliminate_joint_duals(scene, room, world, keeps)
        wait()
    solve_blocks(room, world, lane, m, island)
    if lane == 0:
        if wp.static(TREES):
            solve_trees(scene, room, world, keeps)
        for e in range(part.first, part.end):
            i = member(room, world, island, e)
            room.step[world, i] = share * room.step[world, i]


@wp.func(inline=True)
def begin(scene: Scene, room: Room, world: int, lane: int, n_found: int, island: int, rests: bool):
    """Begin from the velocities of an island as they are, or from rest, with duals that fit."""
    part = part_of(scene, room, world, n_found, island)
    if lane == 0:
        for e in range(part.first, part.end):
            i = member(room, world, island, e)
            if rests:
                room.velocity[world, i] = vec6()
            room.step[world, i] = vec6()
        if wp.static(TREES):
            fit_joint_duals(scene, room, world)
    wait()
    fit_duals(scene, room, world, lane, n_found, island)
    if wp.static(PATCHES):
        fit_patch_duals(scene, room, world, lane, n_found)


@wp.func(inline=True)
def solve_island(
    scene: Scene, room: Room, world: int, lane: int, n_found: int, size: real, options: Options, island: int
) -> Solved:
    """Velocities of an island at the end of a step, in `room.velocity`, from those that it holds.

    Args:
        scene: The scene.
        room: With points, laws, momenta and scales of the step.
        world: Which world.
        lane: Which lane of it.
        n_found: Number of pairs that are near.
        size: Magnitude of the terms in the residual [m/s], to which rounding in it is relative.
        options: When to stop.
        island: Which bodies.
    """
    places = part_of(scene, room, world, n_found, island)
    if lane == 0:
        for e in range(places.first, places.end):
            i = member(room, world, island, e)
            room.best[world, i] = room.velocity[world, i]
    begin(scene, room, world, lane, n_found, island, False)
    n_near = n_found
    if wp.static(PATCHES):
        n_near += room.patches.count[world, 0]
    found = Solved()
    search = begin_search(ZERO)
    number = int(0)
    level = level_of(0)
    budget = level.budget
    if wp.static(TREES):
        if n_near == 0:
            # Without contact nothing cycles but joints, which a line search stops.
            number = 1
            level.searches = True
            budget = options.max_passes
    if wp.static(PATCHES):
        if n_found == 0 and n_near > 0:
            if not any_sticks(scene, room, world, n_found):
                # Smooth friction is a function: whole steps know no more than a line search.
                number = 1
                level.searches = True
    share = real(1.0)
    before = real(INFINITY)
    best = real(INFINITY)
    keeps = bool(False)
    finishes = bool(False)
    needs = bool(True)
    wait()
    while not found.converged and found.passes < options.max_passes and number < _LEVELS:
        wait()
        if lane == 0:
            for e in range(places.first, places.end):
                i = member(room, world, island, e)
                room.tried[world, i] = room.velocity[world, i] + search.length * room.step[world, i]
        wait()
        trial = Trial()
        trial.length = search.length
        trial.friction = level.friction
        fit = assemble(scene, room, world, lane, n_found, trial, island)
        if wp.static(PATCHES):
            fit = add_patches(scene, room, world, lane, n_found, trial, fit)
        wait()
        if wp.static(TREES):
            # A root needs no derivative, a first step only the mass. Close to a root the derivative of the
            # pass before serves: its relative error is about twice the factor by which the last step made the
            # residual smaller. Trees that loops close are solved by blocks, which every pass has to fill.
            needs = True
            if scene.trees.loop_index.shape[0] == 0:
                if n_near == 0:
                    missed = largest_error(scene, room, world)
                    enough = options.tolerance * (ONE + size)
                    close = TWO * missed * missed <= enough * before and search.length == ONE
                    begins = found.passes == 0
                    keeps = (begins or close) and same_mode(scene, room, world, begins)
                    needs = missed > enough and not keeps
            wait()
            if lane == 0 and needs:
                add_tree_slopes(scene, room, world)
            wait()
        seen = measure(scene, room, world, lane, island)
        # Far from a root everything is large, what rounding leaves there, too.
        rounded = wp.min(real(64.0) * options.rounding * seen.size, options.fit * (ONE + size))
        tolerance = wp.max(options.tolerance * (ONE + size), rounded)
        whole = level.friction == ONE
        enough = tolerance
        if not whole:
            enough = wp.max(tolerance, _ROUGH)
        small = seen.error <= enough
        if found.passes == 0 and not (seen.error < INFINITY):
            # What is not finite at the velocities that a solve begins with is not finite anywhere.
            number = _LEVELS
        accept = small or not level.searches or accepts(search, seen.work)
        # Where rounding keeps duals from fitting, a second small residual has to do.
        found.converged = small and whole and (fit.unfit <= options.fit * fit.push or before <= enough)
        improves = whole and seen.error < best
        if improves:
            best = seen.error
        # Once the residual falls as it should, there is nothing to be damped.
        if seen.error < before:
            share = wp.min(share * _GROWS, ONE)
        else:
            share = wp.max(share * _SHRINKS, _LEAST)
        if number > 0 or found.passes < _WHOLE:
            share = ONE
        part = level.share * share
        if seen.error < HALF * before:
            part = ONE
        goes_on = accept and ((small and not whole) or (not small and budget <= 0))
        budget -= 1
        if goes_on:
            number += 1
            level = level_of(number)
            budget = level.budget
            # No step: the next pass has other friction.
            part = ZERO
        wait()
        if not accept:
            search = narrowed(search, seen.work)
        elif lane == 0:
            copy_rows(room, world, places, island, room.tried, room.velocity)
        if goes_on and level.begins:
            begin(scene, room, world, lane, n_found, island, True)
            search = begin_search(ZERO)
            before = real(INFINITY)
        elif accept:
            if wp.static(TREES):
                if n_near == 0 and found.converged and seen.error > _EXACT * options.rounding * (ONE + size):
                    # A last step, not looked at, takes what is left to rounding.
                    finishes = True
                    keeps = not needs
                    part = ONE
            if finishes or not found.converged:
                newton_step(scene, room, world, lane, part, keeps, island)
                if wp.static(TREES):
                    if lane == 0:
                        follow_joint_duals(scene, room, world, search.length, part)
                wait()
                follow_duals(scene, room, world, lane, n_found, search.length, island)
                if wp.static(PATCHES):
                    follow_patch_duals(scene, room, world, lane, n_found)
                begun = real(0.0)
                if wp.static(TREES):
                    begun = measure_joints(scene, room, world).work
                for e in range(places.first, places.end):
                    i = member(room, world, island, e)
                    begun += wp.dot(room.step[world, i], room.residual[world, i])
                search = begin_search(begun)
            before = seen.error
        if improves and lane == 0:
            copy_rows(room, world, places, island, room.tried, room.best)
        found.passes += 1
    if not found.converged and lane == 0:
        copy_rows(room, world, places, island, room.best, room.velocity)
    if wp.static(TREES):
        if found.converged and lane == 0:
            if finishes:
                for i in range(scene.n_blocks):
                    room.velocity[world, i] = room.velocity[world, i] + room.step[world, i]
                finish_joint_duals(scene, room, world)
            resolve_joints(scene, room, world)
    wait()
    found.residual = wp.where(found.converged, before, best)
    return found


@wp.func(inline=True)
def solve(
    scene: Scene, room: Room, world: int, lane: int, n_found: int, size: real, options: Options
) -> Solved:
    """Velocities at the end of a step, in `room.velocity`, from those that it holds: island by island.

    Args: those of `solve_island`.

    Returns:
        How all of them ended: the largest residual, the most passes.
    """
    whole = Solved()
    whole.converged = True
    islands = int(1)
    if wp.static(ISLANDS):
        islands = scene.n_blocks
    for i in range(islands):
        island = EVERYWHERE
        if wp.static(ISLANDS):
            island = room.islands[world, i]
        # An island has the number of its first body.
        if (island == EVERYWHERE or island == i) and not sleeps(room, world, i):
            one = solve_island(scene, room, world, lane, n_found, size, options, island)
            whole.residual = wp.max(whole.residual, one.residual)
            whole.passes = wp.max(whole.passes, one.passes)
            whole.converged = whole.converged and one.converged
    return whole
