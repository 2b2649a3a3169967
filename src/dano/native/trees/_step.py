"""A step of bodies on joints from state to state; contacts, if any, have the paper's law.

The equations are those of `dano.engine._trees`, solved by Newton's method with its line search, with the
unknowns of kinks that `dano.engine.joints` describes taken out of the linear systems. XLA runs such a step as
some hundred operations on small arrays, each with a cost of its own; here a pass goes once along the trees.
"""

import math

import numba
import numpy as np

from dano.native._assembling import ENOUGH, GIVE_UP
from dano.native._compiling import fingerprint, kernel, lean
from dano.native._ffi import (
    inputs,
    outputs,
    register,
    SIGNATURE,
    table,
    tells_version,
    vector,
)
from dano.native._line_search import accepts, begin_search, LENGTH, narrow
from dano.native.trees._balance import (
    H,
    room_for,
    solve_factored,
)
from dano.native.trees._equations import (
    begin,
    differentiate,
    EPSILON,
    evaluate,
    factor_with_ramps,
    given_of,
    go,
    kinks_of,
    LARGEST,
    put_end,
    RELATIVE,
    ROUGH,
    SOFT_TOLERANCE,
    state_of,
    touch,
    weigh,
)
from dano.native.trees._frames import (
    copy,
    copy_row,
    largest_turn,
)
from dano.native.trees._laws import (
    resolve,
)
from dano.native.trees._patches import (
    any_touches,
    touch_for,
)

# Columns of the table of levels, see `dano.engine._newton`: softness, what sticks when looking ahead, whether
# it is the last of its tier, first level of the next tier or −1, passes.
_SCALE, _HELD, _LAST, _RESTART, _BUDGET = range(5)
# What a pass of the solve does, see there.
_STEP, _PREDICT, _FOLLOW = range(3)


@lean
def _error(room, kinks, scale):
    """Largest residual [m/s]."""
    error = 0.0
    for k in range(scale.size):
        missed = abs(scale[k] * room.residual[k])
        error = missed if missed > error or math.isnan(missed) else error
    for r in range(kinks.gap.size):
        error = max(error, abs(kinks.gap[r]))
    return error


@lean
def _rounding(given, room, kinks, scale, y):
    """Size of the residual's terms [m/s]."""
    rounding = 0.0
    for k in range(y.size):
        size = 0.0
        for j in range(y.size):
            size += abs(room.matrix[k, j] * y[j])
        r = given.coordinates[k - given.roots, ROUGH] if k >= given.roots else -1
        if r >= 0:
            size += given.settings[H] * abs(kinks.dual[r])
            share = 1.0 / (kinks.weight[r] + kinks.slope[r])
            rounding = max(rounding, share * (kinks.slope[r] * abs(y[k]) + abs(kinks.dual[r])))
        rounding = max(rounding, scale[k] * size)
    return rounding


@lean
def _work(given, room, kinks, change):
    """Work of the residual along a step of Newton's method."""
    work = 0.0
    for k in range(change.size):
        work += change[k] * room.residual[k]
    for r in range(kinks.change.size):
        work += given.settings[H] * kinks.change[r] * kinks.gap[r]
    return work


@lean
def _find_change(given, room, kinks, change):
    """A step of Newton's method. The equation of a force λ gives its change from that of its speed.

    dλ = slope dy − (ρ + slope) gap, which leaves a system for the velocities alone.
    """
    for k in range(change.size):
        change[k] = -room.residual[k]
    for c in range(given.q.size):
        r = given.coordinates[c, ROUGH]
        if r >= 0:
            pushed = (kinks.weight[r] + kinks.slope[r]) * kinks.gap[r]
            change[given.roots + c] += given.settings[H] * pushed
    solve_factored(room.matrix, change)
    for c in range(given.q.size):
        r = given.coordinates[c, ROUGH]
        if r >= 0:
            pushed = (kinks.weight[r] + kinks.slope[r]) * kinks.gap[r]
            kinks.change[r] = kinks.slope[r] * change[given.roots + c] - pushed


@lean
def _same(a, b):
    for r in range(a.size):
        if a[r] != b[r]:
            return False
    return True


@lean
def _finish(given, room, kinks, y, change):
    """A last step, not looked at: near a root it takes what is left to rounding.

    Velocities with kinks become those that fit their forces.
    """
    for k in range(y.size):
        y[k] += change[k]
    for c in range(given.q.size):
        r, k = given.coordinates[c, ROUGH], given.roots + c
        if r >= 0:
            weight, dual = kinks.weight[r], kinks.dual[r] + kinks.change[r]
            speed, _ = resolve(kinks.ramps, r, weight, dual + weight * y[k])
            kinks.dual[r] = dual + weight * (y[k] - speed)
            y[k] = speed
    go(given, room, y)


@lean
def _looks_done(given, room, kinks, passes, error, enough):
    """Whether the point is a root where the derivative of the pass before serves for the last step."""
    smooth_between = _same(kinks.slope, kinks.factored) and not any_touches(given.patches)
    return passes > 0 and error <= enough and smooth_between


@lean
def _solve(given, room, kinks, rows, search, size, levels, max_iterations):
    """The loop of `dano.engine._newton`; the first of the rows is where it begins, and becomes the solution.

    Returns:
        Residual before a last step, passes, whether it converged.
    """
    rules, enough = given.rules, given.rules[RELATIVE] * (1.0 + size)
    y, scale, change, tried, start = rows[0], rows[1], rows[2], rows[3], rows[4]
    dual, change[:] = kinks.tried, 0.0
    copy_row(y, start)
    copy_row(kinks.dual, kinks.first)
    begin_search(0.0, search)
    passes, solved, error, tolerance = -1, False, np.inf, enough
    level, action, budget = 0, _STEP, levels[0, _BUDGET]
    while passes < max_iterations and not solved:
        looks, hard = action == _PREDICT, levels[level, _LAST] > 0.0
        softness = (levels[level, _HELD] if looks else levels[level, _SCALE], levels[level, _SCALE])
        length = 0.0 if looks else search[LENGTH]
        for k in range(y.size):
            tried[k] = y[k] + length * change[k]
        for r in range(dual.size):
            dual[r] = kinks.dual[r] + length * kinks.change[r]
        evaluate(given, room, kinks, tried, dual, softness)
        passes += 1
        work = _work(given, room, kinks, change)
        if looks or action == _FOLLOW or accepts(work, rules[ENOUGH], rules[GIVE_UP], search):
            copy_row(tried, y)
            copy_row(dual, kinks.dual)
            error, tolerance, last = _error(room, kinks, scale), enough, hard and not looks
            solved = last and _looks_done(given, room, kinks, passes, error, enough)
            if not solved:
                differentiate(given, room, softness)
                tolerance = max(enough, 16.0 * rules[EPSILON] * _rounding(given, room, kinks, scale, y))
                solved = last and error <= tolerance
                factor_with_ramps(given, room, kinks)
            _find_change(given, room, kinks, change)
            begin_search(_work(given, room, kinks, change), search)
        else:
            narrow(work, search)
        action, budget = _FOLLOW if looks else _STEP, budget - 1
        needed = tolerance if hard else max(tolerance, rules[SOFT_TOLERANCE] * levels[level, _SCALE])
        spent = budget <= 0 and error > needed
        restarts = hard and spent and levels[level, _RESTART] >= 0.0
        if action == _STEP and not solved and (restarts or (not hard and (error <= needed or spent))):
            if restarts:
                copy_row(start, y)
                copy_row(kinks.first, kinks.dual)
            level = int(levels[level, _RESTART]) if restarts else level + 1
            action, budget = _PREDICT, levels[level, _BUDGET]
    if not solved:
        change[:] = 0.0
        kinks.change[:] = 0.0
    _finish(given, room, kinks, y, change)
    return error, passes, solved


@kernel
def _answer(frame, dtype):
    """Make the step that a call frame holds; see `dano.engine` for the order of its buffers."""
    buffers, found = inputs(frame), outputs(frame)
    given = given_of(buffers, dtype)
    state = state_of(buffers, dtype)
    for k in range(4):
        copy(state[k], table(found[k], dtype))
    rows, kinks = np.empty((5, given.roots + given.q.size)), kinks_of(given)
    sides = touch_for(given.nodes, given.pairs, np.float64)
    room, y = room_for(given.bodies.shape[0], given.nodes.shape[0], rows.shape[1], sides), rows[0]
    begin(given, state, table(buffers[6], dtype), table(buffers[7], dtype), room, y)
    touch(given, room, y)
    size = weigh(given, room, kinks, rows)
    levels, most = table(buffers[20], dtype), vector(buffers[21], numba.int32)[0]
    residual, passes, solved = _solve(given, room, kinks, rows, np.zeros(6), size, levels, most)
    turned = largest_turn(given.nodes, given.joints, y, given.settings[H], room.known)
    vector(found[6], dtype)[:] = y
    put_end(
        given, room, y, rows[4], state_of(found, dtype) + (vector(found[4], dtype), vector(found[5], dtype))
    )
    vector(found[7], dtype)[0] = residual
    vector(found[8], numba.int32)[0] = passes
    vector(found[9], numba.uint8)[0] = solved and turned <= given.rules[LARGEST]
    return 0


def define(dtype: str) -> str:
    """Compile or load the step for "float64" or "float32", make it known to JAX and return its name."""
    sources, real = fingerprint(), numba.from_dtype(np.dtype(dtype))

    @numba.cfunc(SIGNATURE, cache=True)
    def handler(frame):
        _ = sources  # makes it part of the key on disk
        return 0 if tells_version(frame) else _answer(frame, real)

    return register(f"dano_step_{dtype}", handler)
