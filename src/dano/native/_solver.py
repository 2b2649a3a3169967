"""Velocities of free bodies that press on each other at points.

The method is that of `dano.engine`, primal–dual Newton, with the same passes but for rounding.
XLA runs a pass of that method as some hundred operations on small arrays, each with a cost of its own; here a
pass is a loop over the points that press.
"""

import math

import numba
import numpy as np

from dano.native._assembling import (
    assemble,
    ENOUGH,
    EPSILON,
    FIT,
    GIVE_UP,
    GROWS,
    H,
    INERTIA,
    LEAST,
    MASS,
    MIX,
    motion,
    pattern,
    RELATIVE,
    relative,
    RENEWED,
    SHRINKS,
    SIZE,
    SOFT_TOLERANCE,
    tabulate,
    WHOLE,
)
from dano.native._blocks import elimination, solve_blocks
from dano.native._compiling import fingerprint, kernel, lean
from dano.native._ffi import (
    cube,
    doubles,
    inputs,
    outputs,
    register,
    shape_of,
    SIGNATURE,
    table,
    tells_version,
    vector,
)
from dano.native._law import DRIFT, fit_duals, follow
from dano.native._line_search import accepts, begin_search, LENGTH, narrow


@lean
def _copy(source, target):
    for i in range(source.shape[0]):
        for k in range(source.shape[1]):
            target[i, k] = source[i, k]


@kernel
def _follow_all(points, groups, apart, step):
    """Accept the duals tried last; find their change along a step."""
    twist = np.empty(6)
    for g in range(groups.shape[0]):
        relative(step, groups[g, 2], groups[g, 3], apart[g], twist)
        for p in range(groups[g, 0], groups[g, 1]):
            rate, x, y, z = motion(points[p], twist)
            follow(points[p], rate, x, y, z)


@kernel
def _fit_all(points, groups, apart, velocities):
    twist = np.empty(6)
    for g in range(groups.shape[0]):
        relative(velocities, groups[g, 2], groups[g, 3], apart[g], twist)
        for p in range(groups[g, 0], groups[g, 1]):
            row = points[p]
            rate, x, y, z = motion(row, twist)
            fit_duals(row, rate, x + row[DRIFT], y + row[DRIFT + 1], z + row[DRIFT + 2])


@lean
def _measure(matrix, residual, step, velocities, scale, used):
    """Work of the residual along the step, largest residual [m/s], and the size of its terms [m/s]."""
    error = rounding = 0.0
    m = residual.shape[0]
    for i in range(m):
        for r in range(6):
            missed = abs(scale[i, r] * residual[i, r])
            error = missed if missed > error or math.isnan(missed) else error
            size = 0.0
            for j in range(m):
                if used[i, j]:
                    for c in range(6):
                        size += abs(matrix[i, j, r, c] * velocities[j, c])
            rounding = max(rounding, scale[i, r] * size)
    return _work(step, residual), error, rounding


@lean
def _work(step, residual):
    work = 0.0
    for i in range(step.shape[0]):
        for k in range(6):
            work += step[i, k] * residual[i, k]
    return work


@kernel
def _find_step(matrix, spare, residual, step, used, part, order, count, later):
    """A share of the Newton step; `spare` is used up."""
    m = residual.shape[0]
    for i in range(m):
        for k in range(6):
            step[i, k] = -residual[i, k]
        for j in range(m):
            if used[i, j]:
                _copy(matrix[i, j], spare[i, j])
    solve_blocks(spare, step, order, count, later)
    for i in range(m):
        for k in range(6):
            step[i, k] *= part


@lean
def _spread(matrix, used, whole):
    """Blocks as one matrix."""
    m = matrix.shape[0]
    for i in range(m):
        for j in range(m):
            for r in range(6):
                for c in range(6):
                    whole[6 * i + r, 6 * j + c] = matrix[i, j, r, c] if used[i, j] else 0.0


@lean
def _scales(bodies, scale):
    """Factors that turn momenta into velocities, shape (m, 6): 1/m, and 3/tr J."""
    for i in range(bodies.shape[0]):
        trace = bodies[i, INERTIA] + bodies[i, INERTIA + 4] + bodies[i, INERTIA + 8]
        for k in range(6):
            scale[i, k] = 1.0 / bodies[i, MASS] if k < 3 else 3.0 / trace


@kernel
def solve(bodies, points, groups, apart, start, settings, tiers, rules, max_iterations, whole):
    """The loop of `dano.engine._primal_dual.primal_dual`.

    Args:
        bodies: Table of bodies that move, shape (m, 25).
        points: Table of points.
        groups: Their groups.
        apart: Vectors between the bodies of groups.
        start: Velocities to start from [W], shape (m, 6); they become the solution.
        settings: h, tolerance over (1 + size), size and rounding.
        tiers: Rows of `TIERS`.
        rules: Constants.
        max_iterations: Passes.
        whole: The Jacobian there, shape (6 m, 6 m), written to; or of size 0.

    Returns:
        Residual, passes, whether it converged.
    """
    m, h, epsilon = bodies.shape[0], settings[H], settings[EPSILON]
    used = pattern(groups, m)
    order, count, later = elimination(used)
    matrix, spare = np.empty((m, m, 6, 6)), np.empty((m, m, 6, 6))
    residual, step, best = np.empty((m, 6)), np.zeros((m, 6)), np.empty((m, 6))
    accepted, tried, scale = np.empty((m, 6)), np.empty((m, 6)), np.empty((m, 6))
    search, pass_ = np.zeros(6), np.zeros(4)
    _copy(start, accepted)
    _copy(start, best)
    _scales(bodies, scale)
    _fit_all(points, groups, apart, start)
    begin_search(0.0, search)
    level, budget, iteration, mix = 0, tiers[0, 3], 0, 0.0
    share, solved, before, best_error = 1.0, False, np.inf, np.inf
    while not solved and iteration < max_iterations and level < tiers.shape[0]:
        softness, searches, holds = tiers[level, 0], tiers[level, 2] > 0.0, tiers[level, 4] > 0.0
        pass_[0], pass_[1], pass_[2], pass_[3] = search[LENGTH], softness, tiers[level, 4], mix
        for i in range(m):
            for k in range(6):
                tried[i, k] = accepted[i, k] + search[LENGTH] * step[i, k]
        unfit, push, renewed = assemble(
            bodies, tried, points, groups, apart, h, rules, pass_, residual, matrix, used
        )
        work, error, rounding = _measure(matrix, residual, step, tried, scale, used)
        tolerance = max(settings[RELATIVE] * (1.0 + settings[SIZE]), 16.0 * epsilon * rounding)
        hard = softness == 1.0
        enough = tolerance if hard else max(tolerance, rules[SOFT_TOLERANCE] * 1e-7 * softness)
        small = error <= enough
        accept = small or not searches or accepts(work, rules[ENOUGH], rules[GIVE_UP], search)
        solved = small and hard and (unfit <= epsilon ** rules[FIT] * push or before <= enough)
        if hard and error < best_error:
            best_error = error
            _copy(tried, best)
        share = min(max(share * (rules[GROWS] if error < before else rules[SHRINKS]), rules[LEAST]), 1.0)
        if level > 0 or iteration < rules[WHOLE]:
            share = 1.0
        part = 1.0 if error < 0.5 * before else tiers[level, 1] * share
        spent = budget <= 0
        settled = not holds or spent or (0.0 < mix < 1.0 and renewed <= rules[RENEWED] * push)
        harder = accept and ((small and not hard and settled) or (not small and spent))
        budget -= 1
        if harder:
            level += 1
            budget = tiers[min(level, tiers.shape[0] - 1), 3]
        begins = harder and level < tiers.shape[0] and tiers[level, 4] > 0.0
        mix = 1.0 if begins else rules[MIX] if accept and small and holds else 0.0
        if not accept:
            narrow(work, search)
        else:
            _copy(tried, accepted)
            if not solved:
                _find_step(matrix, spare, residual, step, used, part, order, count, later)
                _follow_all(points, groups, apart, step)
                # The next pass is no longer of the same function where bounds are renewed: it is accepted.
                begin_search(0.0 if mix > 0.0 else _work(step, residual), search)
            before = error
        iteration += 1
    _copy(accepted if solved else best, start)
    if whole.size > 0:
        _spread(matrix, used, whole)
    return before if solved else best_error, iteration, solved


@kernel
def _answer(frame, dtype):
    """Solve what a call frame holds; see `dano.engine` for the order of its buffers."""
    given, found = inputs(frame), outputs(frame)
    start, settings = doubles(given[1], dtype), doubles(given[6], dtype)[0]
    chunks, limits = table(given[9], numba.int32), vector(given[11], numba.int32)
    rows, material = cube(given[2], dtype), table(given[3], dtype)
    points, groups, apart = tabulate(
        rows,
        chunks,
        min(limits[0], chunks.shape[1]),
        vector(given[10], numba.int32),
        material,
        vector(given[4], dtype),
        table(given[5], dtype),
        settings[H],
    )
    n = shape_of(found[1])[0]
    whole = np.empty((n, n))
    residual, iterations, solved = solve(
        doubles(given[0], dtype),
        points,
        groups,
        apart,
        start,
        settings,
        doubles(given[7], dtype),
        doubles(given[8], dtype)[0],
        limits[1],
        whole,
    )
    _copy(start, table(found[0], dtype))
    _copy(whole, table(found[1], dtype))
    report = vector(found[2], dtype)
    report[0], report[1], report[2] = residual, iterations, solved
    return 0


def define(dtype: str) -> str:
    """Compile or load the solver for "float64" or "float32", make it known to JAX and return its name."""
    sources, real = fingerprint(), numba.from_dtype(np.dtype(dtype))

    @numba.cfunc(SIGNATURE, cache=True)
    def handler(frame):
        _ = sources  # makes it part of the key on disk
        return 0 if tells_version(frame) else _answer(frame, real)

    return register(f"dano_solve_{dtype}", handler)
