"""Planning by sampling: the cross-entropy method and path integrals, on rollouts of the same problem.

Both draw what is added to the first controls, N(mean, deviation²) at a few knots with straight lines between
them, roll all sequences out, and move the mean, which begins at zero: to that of the best (CEM; Rubinstein
1999), or to the average with weights exp(−cost/temperature) (MPPI; Williams et al. 2017). Constraints are
priced: the cost is J + ½ p Σ violation², with a price p that grows from pass to pass.
"""

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.checks import checked_choice, checked_count, checked_number
from dano.solvers import TrajectoryProblem

FIRST_DRAWS = "normal", "even"
"""How the first pass may draw."""


@dataclasses.dataclass(frozen=True)
class SamplingOptions:
    """How to sample.

    Attributes:
        passes: How often to draw.
        samples: Sequences in a pass.
        best: Share of them that CEM keeps.
        knots: Moments at which numbers are drawn, with straight lines between them; with one, controls are
            the first ones moved by as much at all times.
        deviation: First standard deviation, as a share of the bounds.
        least: Deviation that is always left.
        first: How the first pass draws: "normal", by `deviation` around the first controls; or "even", a
            Latin hypercube over all moves that keep the first controls within their bounds, for tasks whose
            cost says nothing until a sequence is nearly right.
        temperature: Of MPPI, as a share of the spread of costs.
        price: First price of violations, and `last_price` the last.
        last_price: See `price`.
        max_seconds: Time after which to stop [s]; None: no limit.
    """

    passes: int = 30
    samples: int = 64
    best: float = 0.15
    knots: int = 8
    deviation: float = 0.4
    least: float = 0.01
    first: str = "normal"
    temperature: float = 0.1
    price: float = 10.0
    last_price: float = 1e3
    max_seconds: float | None = None

    def __post_init__(self) -> None:
        """Check all numbers.

        Raises:
            ValueError: If one is out of range.
        """
        checked_choice("first", self.first, FIRST_DRAWS)
        for name in ("passes", "samples", "knots"):
            checked_count(name, getattr(self, name))
        checked_number("best", self.best, above=0, most=1)
        for name in ("deviation", "least", "temperature", "price", "last_price"):
            checked_number(name, getattr(self, name), above=0)
        if self.max_seconds is not None:
            checked_number("max_seconds", self.max_seconds, above=0)


class Sampled(NamedTuple):
    """The best sequence of a search."""

    controls: Float[Array, "T m"]  # w, shape (T, m)
    cost: float  # Its priced cost
    history: np.ndarray  # Best priced cost after each pass
    seconds: float  # [s]
    interrupted: bool  # Whether Ctrl-C or the time limit ended it


def sampled(
    problem: TrajectoryProblem,
    start: Any,
    controls: Float[Array, "T m"],
    *,
    method: str,
    options: SamplingOptions,
    key: Array,
    progress: Callable[[int, float], object] | None = None,
    compiler_options: dict[str, bool] | None = None,
) -> Sampled:
    """Search by sampling around first controls.

    Args:
        problem: The problem.
        start: x_0.
        controls: What the search adds to.
        method: "cem" or "mppi".
        options: See `SamplingOptions`.
        key: Of the random numbers.
        progress: Called with the pass and the best cost so far; if it returns True, the search stops.
        compiler_options: For `jax.jit`.
    """
    began = time.perf_counter()
    n_steps, m = controls.shape
    lift = straight_lines(n_steps, min(options.knots, n_steps))
    assert problem.lower is not None and problem.upper is not None
    least, most = problem.lower, problem.upper
    mean = jnp.zeros((lift.shape[1], m), controls.dtype)
    spread = jnp.full_like(mean, options.deviation)
    prices = np.geomspace(options.price, options.last_price, options.passes)
    best, best_terms, history, interrupted = controls, None, [], False
    try:
        for turn, price in enumerate(prices):
            key, draw = jax.random.split(key)
            if turn == 0 and options.first == "even":
                knots = _even(controls, least, most, options.samples, len(mean), draw)
            else:
                shape = (options.samples, *mean.shape)
                knots = mean[None] + spread[None] * jax.random.normal(draw, shape, mean.dtype)
            knots = knots.at[0].set(mean)
            sequences = controls[None] + jnp.einsum("tk,skm->stm", jnp.asarray(lift), knots)
            sequences = jnp.clip(sequences, *(jnp.broadcast_to(b, sequences.shape) for b in (least, most)))
            sequences = sequences.at[1].set(best)
            cost, violation = (np.asarray(x) for x in rated(problem, start, sequences, compiler_options))
            priced = np.nan_to_num(cost + 0.5 * price * violation, nan=np.inf)
            top = int(np.argmin(priced))
            best, best_terms = sequences[top], (float(cost[top]), float(violation[top]))
            history.append(priced[top])
            mean, spread = _moved(knots, jnp.asarray(priced), mean, method, options)
            if progress is not None and progress(turn, float(priced[top])):
                interrupted = True
                break
            if options.max_seconds is not None and time.perf_counter() - began > options.max_seconds:
                interrupted = turn + 1 < options.passes
                break
    except KeyboardInterrupt:
        interrupted = True
    final = np.inf if best_terms is None else best_terms[0] + 0.5 * options.last_price * best_terms[1]
    return Sampled(best, final, np.array(history), time.perf_counter() - began, interrupted)


def _even(controls: Array, least: Array, most: Array, samples: int, knots: int, key: Array) -> Array:
    """A Latin hypercube over the moves that keep all controls within their bounds: samples, knots, m."""
    from scipy.stats import qmc  # slow to import

    seed = int(jax.random.randint(key, (), 0, np.iinfo(np.int32).max))
    m = controls.shape[1]
    shares = qmc.LatinHypercube(knots * m, rng=seed).random(samples).reshape(samples, knots, m)
    lowest = jnp.minimum(least - controls.min(axis=0), 0)[None, None]
    highest = jnp.maximum(most - controls.max(axis=0), 0)[None, None]
    return lowest + (highest - lowest) * jnp.asarray(shares, controls.dtype)


def _moved(knots: Array, priced: Array, mean: Array, method: str, options: SamplingOptions):
    """The next mean and deviation."""
    if method == "cem":
        return drawn_around(knots, priced, options.best, options.least)
    finite = jnp.isfinite(priced)
    low = jnp.min(priced)
    scale = jnp.median(jnp.where(finite, priced, low)) - low
    weight = jnp.exp(-(priced - low) / (options.temperature * jnp.maximum(scale, 1e-12)))
    weight = jnp.where(finite, weight, 0)
    mean = jnp.einsum("s,skm->km", weight / jnp.sum(weight), knots)
    return mean, jnp.full_like(mean, max(options.least, 0.5 * options.deviation))


def rated(problem: TrajectoryProblem, start: Any, sequences: Array, compiler_options: Any) -> Any:
    """J and the sum of squares of violations of every sequence, as one compiled program."""
    return program_of(costs, tuple((compiler_options or {}).items()))(problem, start, sequences)


@functools.cache
def program_of(function: Callable[..., Any], options: tuple[tuple[str, bool], ...]) -> Callable[..., Any]:
    """A function compiled with some options, once."""
    jit: Any = eqx.filter_jit  # whose signature does not list the options that it hands on
    return jit(function, compiler_options=dict(options)) if options else jit(function)


def drawn_around(knots: Array, priced: Array, best: float, least: Any) -> tuple[Array, Array]:
    """Mean and deviation of the best share of samples, the deviation at least `least`."""
    n = max(2, round(best * len(priced)))
    elite = knots[jnp.argsort(priced)[:n]]
    return jnp.mean(elite, axis=0), jnp.maximum(jnp.std(elite, axis=0), least)


def costs(problem: TrajectoryProblem, start: Any, sequences: Float[Array, "s T m"]):
    """J and the sum of squares of violations of every sequence, one after the other."""

    def one(w):
        def advance(carry, inputs):
            x, total, violation = carry
            u, t = inputs
            total = total + problem.stage_cost(x, u, t)
            for c in problem.constraints:
                if not c.final:
                    violation = violation + _squared(c, c.function(x, u, t))
            return (problem.dynamics(x, u, t), total, violation), None

        zero = jnp.zeros((), w.dtype)
        (last, total, violation), _ = jax.lax.scan(advance, (start, zero, zero), (w, jnp.arange(w.shape[0])))
        for c in problem.constraints:
            if c.final:
                violation = violation + _squared(c, c.function(last))
        return total + problem.final_cost(last), violation

    # One after the other: steps loop until they are solved, and a batch would wait for its slowest.
    return jax.lax.map(one, sequences)


def _squared(constraint, value: Array) -> Array:
    return jnp.sum((value if constraint.equality else jnp.maximum(value, 0)) ** 2)


def straight_lines(n_steps: int, knots: int) -> Float[np.ndarray, "T k"]:
    """Straight lines between knots at every step."""
    at = np.linspace(0, knots - 1, n_steps) if knots > 1 else np.zeros(n_steps)
    left = np.minimum(at.astype(int), max(knots - 2, 0))
    share = at - left
    rows = np.zeros((n_steps, knots))
    rows[np.arange(n_steps), left] = 1 - share
    if knots > 1:
        rows[np.arange(n_steps), left + 1] += share
    return rows
