"""Where a search settles if the loss is rough: at the minimum of its trend, whatever the start.

After a search, two planes through draws of the unknowns say how far the answer is from that minimum and how
far ripples scatter it. Where both are small beside the standard errors, derivatives were worth having and
nothing happens. Else the search goes on with slopes over visible steps, wide ones first.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax.numpy as jnp
import numpy as np

from dano.gradients import Check, check
from dano.identify._residuals import Linearized, Smoothing
from dano.solvers import eliminated, NormalEquations, Solution, Stop

# Widest draws of a parameter: a share of its range, or of its value without bounds.
_WIDEST = 0.05
# Draws as shares of the widest, stage by stage; and, in standard errors, in the last one.
_STAGES, _LAST = (1.0, 0.25), 0.5
# Distance to the minimum of the trend, and scatter by ripples, that do not matter [standard errors].
_STEADY = 0.5
# Sets of independent directions: so many pairs of draws for each unknown.
_BLOCKS = 2
# Places at which the loss is looked at.
_PLACES = 11


class Smoothed(Protocol):
    """A least squares problem whose slopes may be those of planes through draws."""

    smoothing: Smoothing | None
    lower: np.ndarray
    upper: np.ndarray
    freedom: int
    seed: int

    def linearize(self, x: np.ndarray, start: Any, /) -> NormalEquations:
        """The model at coordinates and initial states."""
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

    def start_widths(self) -> np.ndarray:
        """By how much initial states are uncertain, of their unknowns."""
        ...


class _Sight(NamedTuple):
    """What a plane says of a point.

    Attributes:
        errors: Standard errors of the parameters, ripples not counted; ∞ where they are flat.
        away: Distance to the minimum of the trend, in standard errors, largest of all parameters.
        scatter: By which ripples move the answer, in the same way.
        start_errors: Standard errors of the unknowns of initial states, largest of all windows.
    """

    errors: np.ndarray
    away: float
    scatter: float
    start_errors: np.ndarray


def settled(problem: Smoothed, solution: Solution, minimise: Callable[..., Solution]) -> Solution:
    """The solution, or that of the trend if the loss is rough there; `problem.smoothing` says which.

    Args:
        problem: The problem; its `smoothing` is that of the answer afterwards, or None.
        solution: Where a search by derivatives ended.
        minimise: Searches from parameters and initial states.
    """
    widest = np.concatenate([_ranges(problem, solution.x), problem.start_widths()])
    rows = _directions(len(widest), problem.seed)
    problem.smoothing = _drawn(rows, widest)
    widths = _finer(_seen(problem, solution), widest)
    problem.smoothing = _drawn(rows, widths)
    sight = _seen(problem, solution)
    if solution.stop.converged and sight.away <= _STEADY and sight.scatter <= _STEADY:
        problem.smoothing = None
        return solution
    for share in (*_STAGES, None):
        problem.smoothing = _drawn(rows, widths if share is None else share * widest)
        solution = minimise(solution.x, solution.blocks)
        if solution.stop is Stop.INTERRUPTED:
            break
        widths = _finer(_seen(problem, solution), widest)
    return solution


def ripple_covariance(problem: Smoothed, x: np.ndarray, blocks: Any) -> np.ndarray:
    """Covariance that ripples of the residuals give the parameters, shape (p, p); zero without smoothing."""
    p = len(x)
    if problem.smoothing is None:
        return np.zeros((p, p))
    found = problem.simulate(x, blocks)
    moves = _displacements(problem, found)
    return moves.T @ moves / len(moves)


def worth_of(problem: Smoothed, solution: Solution) -> Check:
    """What derivatives of the loss are worth where a search ended.

    Looked at is the way to the minimum of the model that derivatives make, initial states included, over one
    standard error of the parameter that moves most and a tenth of it.
    """
    smoothing = problem.smoothing
    errors = _seen(problem, solution).errors
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
        return problem.linearize(x, problem.retract(solution.blocks, float(share) * follow)).loss

    found = check(
        loss, 0.0, gradient=slope, scale=1.0, steps=(1.0, 0.1), points=_PLACES, labels=["the next step"]
    )
    problem.smoothing = smoothing
    return found


def _displacements(problem: Smoothed, found: Linearized) -> np.ndarray:
    """By how much each ripple alone moves the parameters, initial states following, shape (draws, p)."""
    _, hessian = eliminated(problem.assembled(found))
    inverse = np.linalg.pinv(hessian, rcond=1e-10, hermitian=True)
    moves = []
    for k in range(found.ripple.shape[1]):
        alone = found._replace(gradient=found.ripple[:, k], jump=found.jump_ripple[:, k])
        moves.append(-inverse @ eliminated(problem.assembled(alone))[0])
    return np.array(moves)


def _seen(problem: Smoothed, solution: Solution) -> _Sight:
    found = problem.simulate(solution.x, solution.blocks)
    normal = problem.assembled(found)
    gradient, hessian = eliminated(normal)
    variance = 2 * normal.loss / max(problem.freedom, 1)
    inverse = np.linalg.pinv(hessian, rcond=1e-10, hermitian=True)
    errors = np.sqrt(np.maximum(np.diag(inverse) * variance, 0))
    errors = np.where(errors > 0, errors, np.inf)
    to = np.clip(solution.x - inverse @ gradient, problem.lower, problem.upper)
    scatter = np.sqrt(np.mean(_displacements(problem, found) ** 2, axis=0))
    start = np.zeros(0)
    if normal.block_hessian.size:
        k = len(problem.start_widths())
        each = np.asarray(found.hessian)[:, -k:, -k:]
        start = np.sqrt(np.max([np.diag(np.linalg.pinv(b, rcond=1e-10)) for b in each], axis=0) * variance)
    return _Sight(
        errors,
        float(np.max(np.abs(to - solution.x) / errors, initial=0)),
        float(np.max(scatter / errors, initial=0)),
        np.where(start > 0, start, np.inf),
    )


def _finer(sight: _Sight, widest: np.ndarray) -> np.ndarray:
    """Widths of the last draws."""
    return np.minimum(widest, _LAST * np.concatenate([sight.errors, sight.start_errors]))


def _ranges(problem: Smoothed, x: np.ndarray) -> np.ndarray:
    width = problem.upper - problem.lower
    return _WIDEST * np.where(np.isfinite(width), width, np.maximum(np.abs(x), 1e-3))


def _drawn(rows: np.ndarray, scale: np.ndarray) -> Smoothing:
    return Smoothing(jnp.asarray(rows), jnp.asarray(scale))


def _directions(unknowns: int, seed: int) -> np.ndarray:
    """Draws of `Smoothing`: rows of random orthogonal matrices, as long as normal ones are."""
    random = np.random.default_rng(seed)
    blocks = [np.linalg.qr(random.standard_normal((unknowns, unknowns)))[0] for _ in range(_BLOCKS)]
    return np.sqrt(unknowns) * np.concatenate(blocks)
