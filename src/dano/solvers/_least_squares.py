"""Levenberg–Marquardt with bounds, for a few shared unknowns and many small blocks of private ones.

Minimises f(x, z) = ½ Σ r² over x in a box and blocks z₁ … z_m without bounds, where every residual depends on
x and one block at most. With Gauss–Newton matrices the step solves

    [ H + λD   C₁ᵀ …       ] [ dx  ]     [ g  ]
    [ C₁       B₁ + λD₁    ] [ dz₁ ] = − [ b₁ ]      with  lower ≤ x + dx ≤ upper.
    [ ⋮                 ⋱  ] [ ⋮   ]     [ ⋮  ]

The blocks are eliminated (Schur complement), which leaves a quadratic programme in dx with simple bounds.
That one is solved exactly by an active set, so that x may start on a bound, run along it, and leave it.

Where a step fails because of some blocks only, these alone try shorter ones, for the same dx. So a problem
with many blocks, of which now one and then another bends, does not crawl at the pace of the worst.

A quadratic programme with bounds, for a handful of unknowns, inside compiled code.
"""

import enum
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

# Limits that end a search of which rounding is left: projected Newton steps, halvings of one (to 1/4096).
_MOST_STEPS = 25
_HALVINGS = 12
# Of the gradient's entries, by the size of its terms: smaller is rounding.
_ZERO = 1e-12


class BoxMinimum(NamedTuple):
    """The minimiser of gᵀk + ½ kᵀHk in a box."""

    k: Float[Array, " m"]  # The minimiser, shape (m,)
    inside: Bool[Array, " m"]  # Which unknowns are free to move, shape (m,)
    # Cholesky factor of H with rows and columns of the others replaced by those of the identity, shape (m,
    # m).
    factor: Float[Array, "m m"]


class _BoxSearch(NamedTuple):
    k: Float[Array, " m"]
    steps: Array
    moving: Array


def box_minimum(
    hessian: Float[Array, "m m"],
    gradient: Float[Array, " m"],
    lower: Float[Array, " m"],
    upper: Float[Array, " m"],
    start: Float[Array, " m"],
) -> BoxMinimum:
    """Minimise a quadratic function in a box by projected Newton steps (Bertsekas 1982; Tassa 2014).

    Unknowns at a bound towards which the function falls are held, the others take Newton's step, and the
    step is shortened until it brings enough after projection.

    Args:
        hessian: H, positive definite.
        gradient: g.
        lower: Bounds, may be −∞.
        upper: Bounds, may be ∞.
        start: First guess; moved into the box.
    """
    floor = _ZERO * (jnp.abs(gradient) + jnp.abs(hessian) @ jnp.abs(start) + jnp.finfo(hessian.dtype).tiny)

    def value(k):
        return gradient @ k + 0.5 * k @ (hessian @ k)

    def free(k, slope):
        return ~(((k <= lower) & (slope > 0)) | ((k >= upper) & (slope < 0)))

    def step(search: _BoxSearch) -> _BoxSearch:
        k = search.k
        slope = gradient + hessian @ k
        inside = free(k, slope)
        direction = -_solve(_factor(hessian, inside), jnp.where(inside, slope, 0))
        now = value(k)

        def shorten(state):
            scale, _, n = state
            scale = 0.5 * scale
            return scale, jnp.clip(k + scale * direction, lower, upper), n + 1

        def poor(state):
            _, trial, n = state
            return (value(trial) > now + 0.1 * slope @ (trial - k)) & (n < _HALVINGS)

        one = jnp.ones((), k.dtype)
        _, best, _ = jax.lax.while_loop(poor, shorten, (one, jnp.clip(k + direction, lower, upper), 0))
        better = value(best) < now
        moved = jnp.where(better, best, k)
        after = gradient + hessian @ moved
        moving = better & jnp.any(jnp.where(free(moved, after), jnp.abs(after), 0) > floor)
        return _BoxSearch(moved, search.steps + 1, moving)

    first = _BoxSearch(jnp.clip(start, lower, upper), jnp.asarray(0), jnp.asarray(True))
    k = jax.lax.while_loop(lambda s: s.moving & (s.steps < _MOST_STEPS), step, first).k
    inside = free(k, gradient + hessian @ k)
    return BoxMinimum(k, inside, _factor(hessian, inside))


def _factor(hessian: Array, inside: Array) -> Array:
    both = inside[:, None] & inside[None]
    return jnp.linalg.cholesky(jnp.where(both, hessian, jnp.eye(inside.size, dtype=hessian.dtype)))


def _solve(factor: Array, right: Array) -> Array:
    return jax.scipy.linalg.cho_solve((factor, True), right)


class NormalEquations(NamedTuple):
    """Gauss–Newton model of the loss at a point."""

    loss: float  # f = ½ Σ r²
    gradient: np.ndarray  # g = ∂f/∂x, shape (p,)
    hessian: np.ndarray  # H ≈ ∂²f/∂x², shape (p, p)
    block_gradient: np.ndarray  # b = ∂f/∂z, shape (m, k)
    block_hessian: np.ndarray  # B, shape (m, k, k)
    coupling: np.ndarray  # C ≈ ∂²f/∂z∂x, shape (m, k, p)
    block_losses: np.ndarray  # Parts of the loss that belong to the blocks, shape (m,)


class Stop(enum.Enum):
    """Why a minimisation ended."""

    LOSS = "converged: predicted decrease below tolerance"
    STEP = "converged: negligible steps"
    PERFECT = "converged: the residuals are zero up to rounding"
    STUCK = "no step reduces the loss, although its gradient is not zero"
    ITERATIONS = "the limit of iterations was reached"
    INTERRUPTED = "interrupted: this is the best point so far"

    @property
    def converged(self) -> bool:
        """Whether this is a minimum as far as can be told."""
        return self in (Stop.LOSS, Stop.STEP, Stop.PERFECT)


class Solution(NamedTuple):
    """Where a minimisation ended, and why."""

    x: np.ndarray  # Shared unknowns, shape (p,)
    blocks: Any  # Private unknowns, as `start_blocks` was given
    normal: NormalEquations  # The model there
    stop: Stop  # Why it ended
    losses: np.ndarray  # Loss at the start and after each accepted step
    evaluations: int  # How often `linearize` was called


class Iterate(NamedTuple):
    """Where a minimisation is between two steps, and all that the next one depends on."""

    x: np.ndarray  # Shared unknowns
    blocks: Any  # Private unknowns
    losses: tuple[float, ...]  # Loss at the start and after each accepted step
    damping: float  # Of the next step
    growth: float  # By what the damping grows if that one fails
    slow: int  # Steps in a row that brought next to nothing
    spread: tuple[np.ndarray, np.ndarray]  # Scales of the shared and of the private unknowns
    evaluations: int  # How often `linearize` was called


# At the start, and its limits: shares of the diagonal of the normal equations, from rounding to "no step".
_DAMPING = 1e-4
_LEAST_DAMPING, _MOST_DAMPING = 1e-15, 1e12
# Relative change of x that counts as no change.
_NEGLIGIBLE = 1e-10
# If the loss should fall by so many tolerances and does not, the search is stuck.
_ROUGH = 100
# Curvature over a parameter's range, as a share of the largest there is, that may be rounding: a parameter
# with less stays about where it is instead of running off.
_FLAT = 1e-10
# Lower bound on a block's curvature scaling, as a share of the largest: a tenth of the scale.
_ALIKE = 1e-2
# A step is accepted if it reduces the loss by at least this share of the model's prediction.
_SUFFICIENT = 1e-4
# A step that brings less than this share is poor: blocks whose loss grew try again, damped more and more.
_POOR = 0.25
_AGAIN = (0.1, 1.0, 10.0)
# So many poor steps in a row that reduce the loss by less than the tolerance end the search: what the model
# still promises lies in blocks that bend too much to get there.
_SLOW = 3


class LeastSquaresOptions(NamedTuple):
    """When a minimisation ends."""

    max_iterations: int = 50  # Accepted steps after which to give up
    tolerance: float = 1e-10  # Stop when the model promises to reduce the loss by less than this share of it
    perfect: float = 0.0  # Stop when the loss is no larger: what is left is rounding


_USUAL = LeastSquaresOptions()


def bounded_least_squares(
    linearize: Callable[[np.ndarray, Any], NormalEquations],
    start: np.ndarray | Iterate,
    *,
    lower: np.ndarray,
    upper: np.ndarray,
    start_blocks: Any = None,
    retract: Callable[[Any, np.ndarray], Any] = lambda blocks, change: blocks,
    options: LeastSquaresOptions = _USUAL,
    callback: Callable[[Iterate], None] | None = None,
) -> Solution:
    """Minimise a sum of squares within bounds.

    Args:
        linearize: The normal equations at (x, blocks); a step to where it or its
            derivatives are not finite is rejected.
            After a poor step it is called with the same x again, and other values of some blocks.
        start: First x, shape (p,), or what `callback` was called with: the minimisation goes on there as if
            it had never stopped.
        lower: Bounds, shape (p,); may be −∞.
        upper: Bounds, shape (p,); may be ∞.
        start_blocks: First private unknowns, of any kind; `linearize` and `retract` understand it.
        retract: Blocks moved by dz, shape (m, k).
        options: When it ends.
        callback: Called before each step with what that depends on. An interrupt (Ctrl-C) ends the
            minimisation with the best point so far.

    Raises:
        ValueError: If shapes differ, a bound is NaN or crossed, the start lies outside, or the loss or its
            derivatives are not finite there.
    """
    x, lower, upper = _checked(start.x if isinstance(start, Iterate) else start, lower, upper)
    max_iterations, tolerance, perfect = options
    span = _span(x, lower, upper)
    now, normal = _begun(linearize, start, start_blocks)
    try:
        for iteration in range(len(now.losses) - 1, max_iterations + 1):
            if callback is not None:
                callback(now)
            loss = now.losses[-1]
            if loss <= max(perfect, np.finfo(float).tiny):
                return _solution(now, normal, Stop.PERFECT)
            box = lower - now.x, upper - now.x
            floor = _FLAT * np.max(np.diag(normal.hessian) * span**2, initial=0) / span**2
            change, _, hoped = _step(normal, 0.0, floor, now.spread, *box)
            if hoped <= tolerance * loss:
                return _solution(now, normal, Stop.LOSS)
            if normal.block_gradient.size == 0 and _negligible(change, now.x):
                return _solution(now, normal, Stop.STEP)
            if iteration == max_iterations:
                break
            step = functools.partial(
                _step, normal, floor=floor, spread=now.spread, lower=box[0], upper=box[1]
            )
            trial = functools.partial(_tried, linearize, retract, normal, (lower, upper), now)
            now, following = _followed(now, normal, step, trial, tolerance * loss)
            if following is None:
                return _solution(now, normal, _without_step(hoped, tolerance * loss))
            normal = following
            if now.slow == _SLOW:
                return _solution(now, normal, Stop.LOSS)
    except KeyboardInterrupt:
        return _solution(now, normal, Stop.INTERRUPTED)
    return _solution(now, normal, Stop.ITERATIONS)


def _begun(linearize, start: Iterate | np.ndarray, blocks: Any) -> tuple[Iterate, NormalEquations]:
    """Where the first step begins, and the model there.

    Raises:
        ValueError: If the loss or its derivatives are not finite there.
    """
    if isinstance(start, Iterate):
        return start, linearize(start.x, start.blocks)
    x = np.array(start, dtype=float)
    normal = linearize(x, blocks)
    if not np.isfinite(normal.loss):
        raise ValueError(f"loss must be finite at the start {x.tolist()}, got {normal.loss}")
    if not _is_finite(normal):
        raise ValueError(f"derivatives of the loss must be finite at the start {x.tolist()}, got others")
    return Iterate(x, blocks, (float(normal.loss),), _DAMPING, 2.0, 0, _scales(normal), 1), normal


def _followed(
    now: Iterate,
    normal: NormalEquations,
    step: Callable[..., tuple[np.ndarray, np.ndarray, float]],
    tried: Callable[..., "_Trial"],
    negligible: float,
) -> tuple[Iterate, NormalEquations | None]:
    """The next point, whose loss is less, and the model there; the same and None if no step reduces it."""
    damping, growth, evaluations = now.damping, now.growth, now.evaluations
    while True:
        change, block_change, promised = step(damping)
        if promised <= negligible or damping > _MOST_DAMPING:
            return now._replace(evaluations=evaluations), None
        trial = functools.partial(tried, change)
        first = trial(block_change, promised)
        best, again = _shortened(trial, first, normal, change, block_change, damping, now.spread)
        evaluations += 1 + again
        if best.gain > _SUFFICIENT:
            break
        damping, growth = damping * growth, 2 * growth
    slow = 0
    if best is first:
        damping, growth = _relaxed(damping, best.gain), 2.0
    else:
        damping, growth = damping * growth, 2 * growth
        slow = now.slow + 1 if normal.loss - best.normal.loss <= negligible else 0
    larger = [np.maximum(new, old) for new, old in zip(_scales(best.normal), now.spread, strict=True)]
    losses = (*now.losses, float(best.normal.loss))
    following = Iterate(
        best.x, best.blocks, losses, damping, growth, slow, (larger[0], larger[1]), evaluations
    )
    return following, best.normal


def _checked(start: Any, lower: Any, upper: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Start and bounds as vectors of one length.

    Raises:
        ValueError: If they are not, a bound is NaN or crossed, or the start lies outside.
    """
    x = np.array(start, dtype=float)
    lower, upper = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
    if x.ndim != 1 or lower.shape != x.shape or upper.shape != x.shape:
        raise ValueError(
            "start, lower and upper must be vectors of one length, got "
            f"{x.shape}, {lower.shape}, {upper.shape}"
        )
    if not np.all(lower <= upper):
        raise ValueError(f"lower must be ≤ upper, got {lower.tolist()} and {upper.tolist()}")
    if not np.all((lower <= x) & (x <= upper)):
        raise ValueError(f"start must lie between {lower.tolist()} and {upper.tolist()}, got {x.tolist()}")
    return x, lower, upper


def _span(x: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """The range of each unknown: between its bounds or, without bounds, its size."""
    width = upper - lower
    return np.where(np.isfinite(width) & (width > 0), width, np.maximum(np.abs(x), 1.0))


def _relaxed(damping: float, gain: float) -> float:
    """Nielsen's rule: less damping the better the model was."""
    return max(damping * max(1 / 10, 1 - (2 * gain - 1) ** 3), _LEAST_DAMPING)


def _without_step(hoped: float, negligible: float) -> Stop:
    """Why no step reduces the loss: a minimum, unless the model without damping promises much more."""
    return Stop.STUCK if hoped > _ROUGH * negligible else Stop.LOSS


class _Trial(NamedTuple):
    """A step that was tried: where it led, and the share of the promise that it kept."""

    x: np.ndarray
    blocks: Any
    normal: NormalEquations
    gain: float
    promised: float


def _tried(linearize, retract, normal, bounds, now: Iterate, change, block_change, promised: float) -> _Trial:
    at, moved = np.clip(now.x + change, *bounds), retract(now.blocks, block_change)
    following = linearize(at, moved)
    return _Trial(at, moved, following, _gain(normal, following, promised), promised)


def _shortened(
    trial: Callable[[np.ndarray, float], _Trial],
    best: _Trial,
    normal: NormalEquations,
    change: np.ndarray,
    block_change: np.ndarray,
    damping: float,
    spread,
) -> tuple[_Trial, int]:
    """The best of a poor trial and others in which blocks that lose go less far, and how many these were."""
    count = 0
    for more in (each for each in _AGAIN if each > damping):
        worse = _worse(normal, best.normal, best.promised)
        if best.gain > _POOR or not worse.any() or worse.all():
            break
        shorter = _following(normal, change, more, spread)
        block_change = np.where(worse[:, None], shorter, block_change)
        promised = _promised(normal, change, block_change)
        if promised <= 0:
            break
        again = trial(block_change, promised)
        count += 1
        if again.gain > best.gain:
            best = again
    return best, count


def _solution(now: Iterate, normal: NormalEquations, stop: Stop) -> Solution:
    return Solution(now.x, now.blocks, normal, stop, np.array(now.losses), now.evaluations)


def _scales(normal: NormalEquations) -> tuple[np.ndarray, np.ndarray]:
    """Diagonals D of the Hessians, which measure damping and slopes; 1 where there is no curvature.

    Where a block tells next to nothing of an unknown, such as the speed of a joint that sticks, what other
    blocks tell of the like measures it.
    """
    shared = np.diag(normal.hessian)
    private = np.diagonal(normal.block_hessian, axis1=1, axis2=2)
    private = np.maximum(private, _ALIKE * np.max(private, axis=0, initial=0))
    return np.where(shared > 0, shared, 1.0), np.where(private > 0, private, 1.0)


def _negligible(change: np.ndarray, x: np.ndarray) -> bool:
    return bool(np.all(np.abs(change) <= _NEGLIGIBLE * (np.abs(x) + _NEGLIGIBLE)))


def eliminated(normal: NormalEquations) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (p,) and Hessian (p, p) of the loss in x alone, minimised over the blocks."""
    gradient, hessian, _, _ = _eliminate(normal, 0.0, _scales(normal))
    return gradient, hessian


def gauss_newton(
    normal: NormalEquations, lower: np.ndarray, upper: np.ndarray, damping: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Changes of x and of the blocks to the minimum of the model, with lower ≤ dx ≤ upper."""
    scales = _scales(normal)
    floor = _FLAT * np.max(scales[0], initial=0) * np.ones(len(lower))
    return _step(normal, damping, floor, scales, lower, upper)[:2]


def _eliminate(normal: NormalEquations, damping: float, spread: tuple[np.ndarray, np.ndarray]):
    hessian = normal.hessian + damping * np.diag(spread[0])
    if normal.block_gradient.size == 0:
        return normal.gradient, hessian, normal.block_gradient, normal.coupling
    blocks = _damped_blocks(normal, damping, spread)
    right = np.concatenate([normal.block_gradient[:, :, None], normal.coupling], axis=2)
    solved = _solve_blocks(blocks, right)
    shift, follow = solved[:, :, 0], solved[:, :, 1:]
    gradient = normal.gradient - np.einsum("mkp,mk->p", normal.coupling, shift)
    hessian = hessian - np.einsum("mkp,mkq->pq", normal.coupling, follow)
    return gradient, 0.5 * (hessian + hessian.T), shift, follow


def _damped_blocks(normal: NormalEquations, damping: float, spread) -> np.ndarray:
    return normal.block_hessian + damping * spread[1][:, :, None] * np.eye(spread[1].shape[1])


def _solve_blocks(blocks: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solutions of symmetric systems, of least norm where a block is singular."""
    # Rows and columns of size one, so that units do not decide what counts as singular.
    diagonal = np.diagonal(blocks, axis1=1, axis2=2)
    size = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = blocks / (size[:, :, None] * size[:, None, :])
    values, vectors = np.linalg.eigh(scaled)
    keep = values > 1e-12 * np.maximum(values[:, -1:], 1e-300)
    inverse = np.where(keep, 1 / np.where(keep, values, 1.0), 0.0)
    rotated = np.einsum("mij,mik->mjk", vectors, right / size[:, :, None])
    return np.einsum("mij,mj,mjk->mik", vectors, inverse, rotated) / size[:, :, None]


def _step(normal: NormalEquations, damping: float, floor: np.ndarray, spread, lower, upper):
    """Step within bounds on dx, and the fall of the loss that the model promises for it."""
    gradient, hessian, shift, follow = _eliminate(normal, damping, spread)
    change = _bounded_quadratic(gradient, hessian + np.diag(floor), lower, upper)
    block_change = -shift - follow @ change
    return change, block_change, _promised(normal, change, block_change)


def _promised(normal: NormalEquations, change: np.ndarray, block_change: np.ndarray) -> float:
    """The fall of the loss that the model promises for a step."""
    return -float(
        normal.gradient @ change
        + np.sum(normal.block_gradient * block_change)
        + 0.5 * change @ normal.hessian @ change
        + np.sum((normal.coupling @ change) * block_change)
        + 0.5 * np.einsum("mi,mij,mj->", block_change, normal.block_hessian, block_change)
    )


def _gain(normal: NormalEquations, following: NormalEquations, promised: float) -> float:
    """The share of the promised fall of the loss that came true; −∞ where the model is not finite."""
    return (normal.loss - following.loss) / promised if _is_finite(following) else -np.inf


def _is_finite(normal: NormalEquations) -> bool:
    """Whether loss and derivatives are; without the latter there is no next step."""
    return all(bool(np.all(np.isfinite(part))) for part in normal)


def _worse(normal: NormalEquations, following: NormalEquations, promised: float) -> np.ndarray:
    """Which blocks lose what matters beside the promise."""
    allowed = normal.block_losses + _SUFFICIENT * promised
    # What is not a number is not less either.
    return ~(following.block_losses <= allowed)


def _following(normal: NormalEquations, change: np.ndarray, damping: float, spread) -> np.ndarray:
    """Steps of the blocks, damped, for a given step of x."""
    right = normal.block_gradient + normal.coupling @ change
    return -_solve_blocks(_damped_blocks(normal, damping, spread), right[:, :, None])[:, :, 0]


def _bounded_quadratic(gradient, hessian, lower, upper) -> np.ndarray:
    """Minimiser of gᵀd + ½ dᵀHd in a box that holds zero, H positive definite."""
    # In scaled unknowns, for the same reason as above.
    size = np.sqrt(np.maximum(np.diag(hessian), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(hessian / (size[:, None] * size[None]))
    values = np.maximum(values, 1e-15 * values[-1])
    # H = AᵀA, and gᵀd = −bᵀA d.
    root = np.sqrt(values)[:, None] * vectors.T
    target = -(vectors.T @ (gradient / size)) / np.sqrt(values)
    free = vectors @ (target / np.sqrt(values))
    scaled_lower, scaled_upper = lower * size, upper * size
    if np.all((scaled_lower <= free) & (free <= scaled_upper)):
        return free / size
    # Where the box has no width there is nothing to choose, and BVLS wants none such.
    open_ = scaled_lower < scaled_upper
    best = np.zeros_like(free)
    if np.any(open_):
        from scipy.optimize import lsq_linear

        found = lsq_linear(
            root[:, open_], target, (scaled_lower[open_], scaled_upper[open_]), method="bvls", tol=1e-14
        )
        best[open_] = found.x
    return best / size
