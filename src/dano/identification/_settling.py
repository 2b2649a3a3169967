"""Where a search settles if the loss is rough: at the minimum of its trend, whatever the start.

After a search, planes through draws of the unknowns say how far the answer is from that minimum and how far
ripples scatter it. Where both are small beside the standard errors, derivatives were worth having and nothing
happens. Else the search begins again, by Gauss–Newton steps with slopes over visible steps: first for the
beginning of the motions, so that an impact is met about when it happened before what comes after it counts.
Before each longer beginning the loss is looked at all over the bounds.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np

from dano.gradients import Check, check
from dano.identification._residuals import Linearized, Smoothing
from dano.solvers import eliminated, gauss_newton, NormalEquations, Solution, Stop

# Widest draws of a parameter: a share of its range, or of its value without bounds.
_WIDEST = 0.05
# Draws, in standard errors, and least as shares of the widest.
_LAST, _LEAST = 0.5, 1e-3
# Distance to the minimum of the trend, and scatter by ripples, that do not matter [standard errors].
_STEADY = 0.5
# Share of the widest draws that counts as a standard error where that is less: 5e-4 of a parameter's range.
_FINE = 0.01
# Derivatives are blind to a parameter if their curvature is so small a share of that of planes.
_LITTLE = 1e-2
# Shares of the frames that count, one after the other, and most steps at each.
_BEGINNINGS, _STEPS = (0.25, 0.4, 0.55, 0.7, 0.85), 12
# So many steps in a row that leave more than this share of the loss end them.
_SLOW, _BETTER = 2, 0.9
# Steps about the minimum, of which those count whose loss is no more than so many times the least.
_LIKE = 2.0
_LAST_STEPS = 8
# Drift of these below which they rest, in standard errors, and most steps until then.
_STILL, _MOST_STEPS = 0.1, 40
# Drift of these that counts as no drift, in its own standard errors.
_DRIFT = 3.0
# Longest step, in widest draws; and by what a loss may grow that is accepted.
_LONGEST, _WORSE = 4.0, 1.5
# Halvings of a step.
_HALVINGS = 3
# χ² of residuals beyond so many deviations is not that of the stated noise; then so many walks begin again.
_UNLIKELY, _AGAIN = 5.0, 2
# Sets of independent directions: so many pairs of draws for each unknown.
_BLOCKS = 2
# Places at which the loss is looked at: along a line, and within all bounds.
_PLACES, _LOOKS = 11, 64


@runtime_checkable
class SmoothedLoss(Protocol):
    """A least squares problem whose slopes may be those of planes through draws."""

    smoothing: Smoothing | None
    roughness: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    freedom: int
    least_variance: float
    seed: int

    def linearize(self, x: np.ndarray, start: Any, /) -> NormalEquations:
        """The model at coordinates and initial states."""
        ...

    def loss(self, x: np.ndarray, start: Any, /) -> float:
        """Of the model at coordinates and initial states, `smoothing` or not."""
        ...

    def simulate(self, x: np.ndarray, start: Any, /) -> Linearized:
        """All windows at coordinates and initial states."""
        ...

    def assembled(self, found: Linearized, /) -> NormalEquations:
        """Normal equations of all windows."""
        ...

    def retract(self, start: Any, change: np.ndarray, /) -> Any:
        """Initial states moved by the change of all blocks."""
        ...

    def count(self, share: float, /) -> None:
        """Let a share of the frames of each window count, the first ones."""
        ...

    def start_widths(self) -> np.ndarray:
        """By how much initial states are uncertain, of their unknowns."""
        ...


class _Sight(NamedTuple):
    """What planes say of a point."""

    found: Linearized  # The planes
    normal: NormalEquations  # Normal equations
    errors: np.ndarray  # Standard errors of the parameters, ripples not counted; ∞ where they are flat
    away: float  # Distance to the minimum of the trend, in standard errors, largest of all parameters
    scatter: float  # By which ripples move the answer, in the same way


class _Point(NamedTuple):
    """Parameters and initial states."""

    x: np.ndarray
    blocks: Any


def settled(
    problem: SmoothedLoss, solution: Solution, first: tuple[np.ndarray, Any], *, rough: bool = False
) -> Solution:
    """The solution, or that of the trend if the loss is rough there; `problem.smoothing` says which.

    Args:
        problem: The problem; its `smoothing` is that of the answer afterwards, or None.
        solution: Where a search by derivatives ended.
        first: Parameters and initial states at which it began.
        rough: Whether the loss is known to be rough, from another start.
    """
    if solution.stop is Stop.PERFECT:
        return solution
    try:
        return _settled(problem, solution, _Point(*first), rough)
    except KeyboardInterrupt:
        problem.count(1.0)
        problem.smoothing = None
        return solution._replace(stop=Stop.INTERRUPTED)


def _settled(problem: SmoothedLoss, solution: Solution, first: _Point, rough: bool) -> Solution:
    widest = np.concatenate([_ranges(problem, solution.x), problem.start_widths()])
    rows = _directions(len(widest), problem.seed)
    here = _Point(solution.x, solution.blocks)
    problem.smoothing = _evenly(problem, rows, widest, here)
    problem.smoothing = _drawn(rows, widest, _seen(problem, here), problem)
    sight = _seen(problem, here)
    if sight.away > _STEADY and sight.scatter <= _STEADY and sight.normal.loss <= _most(problem):
        # What fits as well as can be is a minimum: the widest draws bend, so that these were too wide.
        problem.smoothing = _drawn(rows, widest, sight, problem)
        sight = _seen(problem, here)
    steady = sight.away <= _STEADY and sight.scatter <= _STEADY
    ended = solution.stop.converged or solution.stop is Stop.STUCK
    if not rough and ended and steady and not _blind(solution, sight):
        problem.smoothing = None
        # Where derivatives find no step, but planes say that none is needed, it is a minimum.
        return solution if solution.stop.converged else solution._replace(stop=Stop.LOSS)
    grown = _grown(problem, first, widest)
    begin = grown if _loss(problem, grown) < _loss(problem, here) else here
    end = _fitting(problem, _averaged(problem, begin, widest), first, widest)
    problem.roughness = end.scatter
    losses = np.array([*solution.losses, end.sight.normal.loss])
    stop = Stop.LOSS if end.steady else Stop.STUCK
    return Solution(*end.point, end.sight.normal, stop, losses, solution.evaluations)


def _blind(solution: Solution, sight: _Sight) -> bool:
    """Whether derivatives say far less of a parameter than planes do.

    So it is with a restitution that became too small for any rebound: a little more makes no difference, but
    what one sees does.
    """
    curved, seen = (np.diag(eliminated(normal)[1]) for normal in (solution.normal, sight.normal))
    return bool(np.any(curved < _LITTLE * seen))


def _loss(problem: SmoothedLoss, point: _Point) -> float:
    return _seen(problem, point).normal.loss


def _grown(problem: SmoothedLoss, point: _Point, widest: np.ndarray) -> _Point:
    """A point from which the beginning of motions is right, and more and more of them."""
    for share in _BEGINNINGS:
        problem.count(share)
        point = _looked(problem, point)
        point = _descended(_walk(problem, point, widest), point)
    problem.count(1.0)
    return point


def _looked(problem: SmoothedLoss, point: _Point) -> _Point:
    """The point with the values of bounded parameters that fit best, of many all over their bounds.

    A walk that meets an impact with a wrong restitution finds other motions that fit a little.
    """
    from scipy.stats import qmc

    bounded = np.flatnonzero(np.isfinite(problem.upper - problem.lower))
    if not bounded.size:
        return point
    lower, upper = problem.lower[bounded], problem.upper[bounded]
    least = problem.loss(point.x, point.blocks)
    shares = qmc.Sobol(len(bounded), seed=problem.seed).random(_LOOKS)
    tried = lower + shares * (upper - lower)
    for sweep in range(1 + len(bounded)):
        if sweep > 0:
            k = sweep - 1
            tried = np.tile(point.x[bounded], (_PLACES, 1))
            tried[:, k] = np.linspace(lower[k], upper[k], _PLACES)
        for values in tried:
            x = point.x.copy()
            x[bounded] = values
            if (loss := problem.loss(x, point.blocks)) < least:
                point, least = point._replace(x=x), loss
    return point


def _descended(walk: Iterator[tuple[_Point, _Sight]], point: _Point) -> _Point:
    """The best point of a walk that goes on while it finds better ones."""
    least, slow = np.inf, 0
    for _ in range(_STEPS):
        here, sight = next(walk)
        slow = slow + 1 if sight.normal.loss > _BETTER * least else 0
        if sight.normal.loss < least:
            point, least = here, sight.normal.loss
        if slow == _SLOW:
            break
    return point


class _End(NamedTuple):
    """Where a walk ended: the mean of its last points."""

    point: _Point  # The mean, with initial states for it
    sight: _Sight  # What is seen there
    scatter: np.ndarray  # Covariance of the points, shape (p, p)
    steady: bool  # Whether the walk had come to rest but for that scatter


def _averaged(problem: SmoothedLoss, point: _Point, widest: np.ndarray) -> _End:
    """Walk to the minimum of the trend and about it, and take the middle of the points that fit."""
    point = _descended(_walk(problem, point, widest), point)
    seen = _last_of(_walk(problem, point, widest))
    losses = np.array([sight.normal.loss for _, sight in seen])
    fits = losses <= _LIKE * losses.min()
    last = np.array([here.x for here, _ in seen])[fits]
    middle = last.mean(axis=0)
    scatter = np.atleast_2d(np.cov(last.T)) if len(last) > 1 else np.zeros((len(middle), len(middle)))
    held = _Point(middle, seen[int(np.argmin(losses))][0].blocks)
    sight = _seen(problem, held)
    for _ in range(_SLOW):
        still = np.zeros_like(middle)
        _, change = gauss_newton(sight.normal, still, still)
        for halving in range(_HALVINGS):
            other = _Point(middle, problem.retract(held.blocks, 0.5**halving * change))
            after = _seen(problem, other)
            if after.normal.loss < sight.normal.loss:
                held, sight = other, after
                break
    unsure = np.sqrt(np.diag(scatter) * 4 / len(last))
    steady = bool(np.all(_drift(last) <= _DRIFT * unsure + _STEADY * sight.errors))
    return _End(held, sight, scatter, steady)


def _fitting(problem: SmoothedLoss, end: _End, first: _Point, widest: np.ndarray) -> _End:
    """The end, or that of a walk with other draws where its residuals are not those of the stated noise.

    Which motion a walk follows through the first impacts is up to its draws.
    """
    seed, smoothing = problem.seed, problem.smoothing
    for k in range(_AGAIN):
        if end.sight.normal.loss > _most(problem):
            problem.seed = seed + (k + 1) * _MOST_STEPS * len(_BEGINNINGS)
            begin = _grown(problem, first, widest)
            if _loss(problem, begin) < end.sight.normal.loss:
                other = _averaged(problem, begin, widest)
                if other.sight.normal.loss < end.sight.normal.loss:
                    end, smoothing = other, problem.smoothing
    problem.seed, problem.smoothing = seed, smoothing
    return end


def _most(problem: SmoothedLoss) -> float:
    """Loss beyond which residuals are not those of the stated noise."""
    return 0.5 * (problem.freedom + _UNLIKELY * np.sqrt(2 * problem.freedom))


def _last_of(walk: Iterator[tuple[_Point, _Sight]]) -> list[tuple[_Point, _Sight]]:
    """The last steps of a walk that has come to rest; the second half of all where it does not."""
    seen = []
    for _ in range(_MOST_STEPS):
        seen.append(next(walk))
        last = seen[-_LAST_STEPS:]
        drift = _drift(np.array([here.x for here, _ in last]))
        if len(last) == _LAST_STEPS and np.all(drift <= _STILL * last[-1][1].errors):
            return last
    return seen[len(seen) // 2 :]


def _drift(points: np.ndarray) -> np.ndarray:
    """How far the middles of both halves of some points are apart."""
    half = len(points) // 2
    if not half:
        return np.zeros(points.shape[1])
    return np.abs(points[:half].mean(axis=0) - points[half:].mean(axis=0))


def _walk(problem: SmoothedLoss, point: _Point, widest: np.ndarray) -> Iterator[tuple[_Point, _Sight]]:
    """Points of Gauss–Newton steps by slopes over visible steps, each with draws of its own."""
    seed = problem.seed
    problem.smoothing = _evenly(problem, _directions(len(widest), seed), widest, point)
    sight = _seen(problem, point)
    while True:
        seed += 1
        problem.smoothing = _drawn(_directions(len(widest), seed), widest, sight, problem)
        for following in _shorter(problem, point, sight.normal, widest):
            after = _seen(problem, following)
            if after.normal.loss <= _WORSE * sight.normal.loss:
                point, sight = following, after
                break
        else:
            # The step came from draws that mislead: others may not.
            sight = _seen(problem, point)
        yield point, sight


def _shorter(
    problem: SmoothedLoss, point: _Point, normal: NormalEquations, widest: np.ndarray
) -> Iterator[_Point]:
    """Where the step to the minimum of the model leads, then halves of it."""
    longest = _LONGEST * widest[: len(point.x)]
    lower = np.maximum(problem.lower - point.x, -longest)
    upper = np.minimum(problem.upper - point.x, longest)
    change, block_change = gauss_newton(normal, lower, upper)
    for halving in range(_HALVINGS):
        share = 0.5**halving
        x = np.clip(point.x + share * change, problem.lower, problem.upper)
        yield _Point(x, problem.retract(point.blocks, share * block_change))


def ripple_covariance(problem: SmoothedLoss, x: np.ndarray, blocks: Any) -> np.ndarray:
    """Covariance that ripples of the residuals give the parameters, shape (p, p); zero without smoothing.

    What was observed has ripples of its own: it is as uncertain as where a walk about the minimum is.
    """
    p = len(x)
    if problem.smoothing is None:
        return np.zeros((p, p))
    found = problem.simulate(x, blocks)
    moves = _displacements(problem, found)
    return moves.T @ moves / len(moves) + problem.roughness


def worth_of(problem: SmoothedLoss, solution: Solution) -> Check:
    """What derivatives of the loss are worth where a search ended.

    Looked at is the way to the minimum of the model that derivatives make, initial states included, over one
    standard error of the parameter that moves most and a tenth of it.
    """
    smoothing = problem.smoothing
    if smoothing is None:
        widest = np.concatenate([_ranges(problem, solution.x), problem.start_widths()])
        point = _Point(solution.x, solution.blocks)
        problem.smoothing = _evenly(problem, _directions(len(widest), problem.seed), widest, point)
    errors = _seen(problem, _Point(solution.x, solution.blocks)).errors
    problem.smoothing = None
    normal = problem.linearize(solution.x, solution.blocks)
    gradient, hessian = eliminated(normal)
    step = -np.linalg.pinv(hessian, rcond=1e-10, hermitian=True) @ gradient
    longest = float(np.max(np.abs(step) / errors, initial=0))
    step = step / longest if longest > 0 else step
    follow, slope = np.zeros_like(normal.block_gradient), float(normal.gradient @ step)
    if follow.size:
        pull = normal.block_gradient / max(longest, 1e-300) + normal.coupling @ step
        inverse = np.linalg.pinv(normal.block_hessian, rcond=1e-10, hermitian=True)
        follow = -np.einsum("mij,mj->mi", inverse, pull)
        slope += float(np.sum(normal.block_gradient * follow))

    def loss(share: Any) -> float:
        x = np.clip(solution.x + float(share) * step, problem.lower, problem.upper)
        return problem.loss(x, problem.retract(solution.blocks, float(share) * follow))

    found = check(
        loss, 0.0, gradient=slope, scale=1.0, steps=(1.0, 0.1), points=_PLACES, labels=["the next step"]
    )
    problem.smoothing = smoothing
    return found


def _displacements(problem: SmoothedLoss, found: Linearized) -> np.ndarray:
    """By how much each ripple alone moves the parameters, initial states following, shape (draws, p)."""
    _, hessian = eliminated(problem.assembled(found))
    inverse = np.linalg.pinv(hessian, rcond=1e-10, hermitian=True)
    moves = []
    for k in range(found.ripple.shape[1]):
        alone = found._replace(gradient=found.ripple[:, k], jump=found.jump_ripple[:, k])
        moves.append(-inverse @ eliminated(problem.assembled(alone))[0])
    return np.array(moves)


def _seen(problem: SmoothedLoss, point: _Point) -> _Sight:
    found = problem.simulate(point.x, point.blocks)
    normal = problem.assembled(found)
    gradient, hessian = eliminated(normal)
    inverse = np.linalg.pinv(hessian, rcond=1e-10, hermitian=True)
    errors = np.sqrt(np.maximum(np.diag(inverse) * _variance(problem, normal), 0))
    errors = np.where(errors > 0, errors, np.inf)
    to = np.clip(point.x - inverse @ gradient, problem.lower, problem.upper)
    scatter = np.sqrt(np.mean(_displacements(problem, found) ** 2, axis=0))
    # Of data without noise standard errors are nothing; what moves a value by less than this matters to none.
    scale = np.maximum(errors, _FINE * _ranges(problem, point.x))
    away = float(np.max(np.abs(to - point.x) / scale, initial=0))
    return _Sight(found, normal, errors, away, float(np.max(scatter / scale, initial=0)))


def _variance(problem: SmoothedLoss, normal: NormalEquations) -> float:
    """Of the residuals; what is far below the noise that was stated makes no difference."""
    return max(2 * normal.loss / max(problem.freedom, 1), problem.least_variance)


def _evenly(problem: SmoothedLoss, rows: np.ndarray, widest: np.ndarray, point: _Point) -> Smoothing:
    """The widest draws."""
    windows, unknowns = len(point.blocks.position), len(widest)
    return _smoothing(problem, rows, widest, np.tile(np.eye(unknowns), (windows, 1, 1)))


def _drawn(rows: np.ndarray, widest: np.ndarray, sight: _Sight, problem: SmoothedLoss) -> Smoothing:
    """Draws as likely as the data say, of parameters and a window's initial state together."""
    hessian, p = np.asarray(sight.found.hessian, float), len(sight.errors)
    own = hessian[:, :p, :p]
    if hessian.shape[1] > p:
        inverse = np.linalg.pinv(hessian[:, p:, p:], rcond=1e-10, hermitian=True)
        own = own - np.einsum("wxi,wij,wjy->wxy", hessian[:, :p, p:], inverse, hessian[:, p:, :p])
    variance = _variance(problem, sight.normal)
    # What other windows say of the parameters, and no wider than the widest.
    whole = hessian.copy()
    whole[:, :p, :p] += np.sum(own, axis=0) - own
    one = np.eye(len(widest))
    unit = whole * widest[:, None] * widest[None] + variance * one
    covariance = _LAST**2 * variance * np.linalg.inv(unit) + _LEAST**2 * one
    return _smoothing(problem, rows, widest, np.linalg.cholesky(covariance))


def _smoothing(problem: SmoothedLoss, rows: np.ndarray, widest: np.ndarray, unit: np.ndarray) -> Smoothing:
    """Draws by spreads in units of the widest; what has no width stays where it is and has no slope."""
    free = widest > 0
    back = np.where(free, 1 / np.where(free, widest, 1), 0)
    parts = rows, widest[:, None] * unit, np.linalg.inv(unit) * back, problem.lower, problem.upper
    return Smoothing(*(jnp.asarray(part) for part in parts))


def _ranges(problem: SmoothedLoss, x: np.ndarray) -> np.ndarray:
    width = problem.upper - problem.lower
    return _WIDEST * np.where(np.isfinite(width), width, np.maximum(np.abs(x), 1e-3))


def _directions(unknowns: int, seed: int) -> np.ndarray:
    """Draws of `Smoothing`: rows of random orthogonal matrices, as long as normal ones are."""
    random = np.random.default_rng(seed)
    blocks = [np.linalg.qr(random.standard_normal((unknowns, unknowns)))[0] for _ in range(_BLOCKS)]
    return np.sqrt(unknowns) * np.concatenate(blocks)
