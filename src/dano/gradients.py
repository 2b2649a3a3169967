"""What a derivative is worth: beside it the slopes of the function itself, at steps that one can see.

A derivative is a limit. Where bodies hit each other it can be exact and of no use: it is that of a ripple,
and the function goes elsewhere. `check` evaluates the function along a line and says which of the two it is.
"""

import enum
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from dano.checks import checked_choice, checked_count, checked_function, checked_number

MODES = ("reverse", "forward")
"""How derivatives are computed."""
# Share of the function's range over the largest step that a ripple may have.
_RIPPLE = 0.01
# Share from which a derivative is no longer called true, even if it equals the slope: next to it it will not.
_RAGGED = 0.05
# Within this factor a derivative with the right sign has the right size, roughly.
_FACTOR = 2.0
# One-sided slopes that differ by more than this share of the larger one make a kink.
_KINK = 0.25
# Relative difference to the slope that counts as none.
_TOLERANCE = 0.1
# Roundings of a value that are no change.
_ROUNDINGS = 16.0


class Verdict(enum.Enum):
    """What a derivative along one direction is worth."""

    TRUE = "true: the slope that one sees"
    CURVED = "true at the point, but the function bends within the largest step: take shorter ones"
    FLAT = "zero, and nothing changes: no derivative leads away from here"
    COARSE = "of the right sign, but its size is not sure: the function is rough"
    KINK = "that of one side of a kink"
    ROUGH = "that of a ripple or beside a jump: over steps that one sees the function goes elsewhere"
    WRONG = "not that of the function, which is smooth: look for a derivative rule that is wrong or stopped"
    LOST = "not finite"

    @property
    def trusted(self) -> bool:
        """Whether the derivative says what the function does."""
        return self in (Verdict.TRUE, Verdict.CURVED, Verdict.FLAT)


class Line(NamedTuple):
    """The function along one direction, and the derivative beside it.

    Slopes are changes of the function by changes of the coordinate along the direction; for a coordinate by
    itself in its own unit.
    """

    label: str  # Which direction
    at: np.ndarray  # Distances from the point, in units of the scale, shape (n,)
    values: np.ndarray  # Of the function there
    derivative: float  # At the point
    slopes: tuple[float, ...]  # Central differences over each of the steps, largest step first
    roughness: float  # Root of the mean square by which the values miss a cubic
    range: float  # Largest value less the smallest one
    verdict: Verdict  # What the derivative is worth


class Check(NamedTuple):
    """What derivatives at a point are worth; printed, it is a table."""

    value: float  # Of the function at the point
    steps: tuple[float, ...]  # In units of the scale, largest first
    lines: tuple[Line, ...]  # One for each direction

    @property
    def trusted(self) -> bool:
        """Whether all derivatives say what the function does."""
        return all(line.verdict.trusted for line in self.lines)

    @property
    def verdict(self) -> Verdict:
        """The worst of all directions; FLAT only if nothing changes along any."""
        order = list(Verdict)
        found = [line.verdict for line in self.lines]
        moving = [verdict for verdict in found if verdict is not Verdict.FLAT]
        return max(moving, key=order.index) if moving else Verdict.FLAT

    @property
    def summary(self) -> str:
        """One sentence, about the worst."""
        worst = [line for line in self.lines if line.verdict is self.verdict]
        count = "" if len(self.lines) == 1 else f" along {len(worst)} of {len(self.lines)} directions"
        line = max(worst, key=lambda each: abs(each.derivative - each.slopes[0]))
        said = f"the derivative{count} is {self.verdict.value}"
        if self.verdict in (Verdict.TRUE, Verdict.FLAT, Verdict.LOST):
            return said
        share = 100 * line.roughness / line.range if line.range > 0 else 0.0
        return (
            f"{said}; along {line.label} it is {line.derivative:.3g}, the slope over ±{self.steps[0]:g} of"
            f" the scale {line.slopes[0]:.3g}, the ripple {share:.2g} % of the range"
        )

    def __str__(self) -> str:
        """A table of all directions under the summary."""
        heads = ["along", "derivative", *(f"slope ±{step:g}" for step in self.steps), "ripple/range"]
        rows = [heads]
        for line in self.lines:
            numbers = [f"{number:.4g}" for number in (line.derivative, *line.slopes)]
            rows.append([line.label, *numbers, f"{line.roughness:.1e}/{line.range:.1e}"])
        widths = [max(len(row[i]) for row in rows) for i in range(len(heads))]
        words = ["", *(line.verdict.name.lower() for line in self.lines)]
        table = [
            "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:]), word]).rstrip()
            for row, word in zip(rows, words, strict=True)
        ]
        return "\n".join([self.summary, *table])


def check(
    function: Callable[[Any], Any],
    x: Any,
    *,
    steps: Sequence[float] = (1e-2, 1e-3),
    scale: Any = None,
    labels: Sequence[str] | None = None,
    points: int = 21,
    directions: int = 8,
    gradient: Any = "reverse",
) -> Check:
    """Say what the derivatives of a function are worth at a point.

    The function is evaluated at `points` places along each direction, between plus and minus the largest
    step, and at the other steps. The derivative is compared with the slopes; what is left of the values
    beside a cubic is how rough the function is. Many places are evaluated by one call under `jax.vmap` where
    the function allows that, else one by one.

    Args:
        function: From something like `x` to one number.
        x: The point: a number, an array, or a tree of arrays; what is not a real array stays as it is.
        steps: Visible steps, as multiples of `scale`.
        scale: What is one of each coordinate, of the structure of `x` or one number; default: the largest
            magnitude in its array, or 1 for an array of zeros.
        labels: Names of the coordinates, in the order of the leaves; default: their paths.
        points: Places along a line, an odd number.
        directions: Largest number of lines. Up to so many coordinates have one each. More coordinates are
            looked at along so many random directions, in which each moves by plus or minus its scale.
        gradient: What is looked at: "reverse" (`jax.grad`), "forward" (`jax.jvp`), or, where `function` is
            not one of JAX, the derivative itself, of the structure of `x`.

    Raises:
        ValueError: If an argument is out of range, or `x` holds no real number.
    """
    checked_function("function", function)
    steps = _checked_steps(steps)
    points = checked_count("points", points, least=7)
    if points % 2 == 0:
        raise ValueError(f"points must be odd, so that x is one of them, got {points}")
    checked_count("directions", directions)
    if isinstance(gradient, str):
        checked_choice("gradient", gradient, MODES)
    flat = _Flat.of(function, x)
    unit = _scales(flat.parts, scale)
    ways, names = _ways(flat, labels, directions)
    at = np.unique(np.concatenate([np.linspace(-1, 1, points) * steps[0], *([-s, s] for s in steps[1:])]))
    moves = ways * unit
    values = _evaluated(flat.call, flat.start, moves, at)
    derivatives = _derivatives(flat, moves, gradient)
    # In the unit of a coordinate by itself; along a random direction in units of the scale.
    lengths = np.where(np.sum(ways != 0, axis=1) == 1, np.sum(np.abs(moves), axis=1), 1.0)
    spacing = float(jnp.finfo(flat.start.dtype).eps)
    lines = [
        _line(name, at, row, slope, float(length), steps, spacing)
        for name, row, slope, length in zip(names, values, derivatives, lengths, strict=True)
    ]
    return Check(float(values[0][np.argmin(np.abs(at))]), steps, tuple(lines))


class _Flat(NamedTuple):
    """A function of a vector instead of a tree, and the vector."""

    call: Callable[[Array], Any]
    start: Float[Array, " n"]
    parts: Any
    labels: list[str]

    @classmethod
    def of(cls, function: Callable[[Any], Any], x: Any) -> "_Flat":
        real, rest = eqx.partition(x, lambda leaf: eqx.is_inexact_array_like(leaf))
        real = jax.tree.map(jnp.asarray, real)
        leaves = jax.tree_util.tree_leaves_with_path(real)
        if not leaves or any(jnp.iscomplexobj(leaf) for _, leaf in leaves):
            raise ValueError(f"x must hold real numbers with a fraction, got {_kinds(x)}")
        start, back = ravel_pytree(real)
        labels = []
        for path, leaf in leaves:
            name = jax.tree_util.keystr(path).lstrip(".")
            places = [f"[{', '.join(map(str, i))}]" for i in np.ndindex(leaf.shape)] if leaf.ndim else [""]
            labels += [f"{name}{place}" or "x" for place in places]
        return cls(lambda vector: function(eqx.combine(back(vector), rest)), start, real, labels)


def _kinds(x: Any) -> str:
    return ", ".join(sorted({type(leaf).__name__ for leaf in jax.tree.leaves(x)})) or "nothing"


def _checked_steps(steps: Sequence[float]) -> tuple[float, ...]:
    if isinstance(steps, (str, bytes)) or not isinstance(steps, (Sequence, np.ndarray)) or not len(steps):
        raise ValueError(f"steps must be a list of numbers > 0, got {steps!r}")
    found = sorted((checked_number("each of steps", step, above=0) for step in steps), reverse=True)
    if len(set(found)) < len(found):
        raise ValueError(f"steps must differ, got {list(steps)}")
    return tuple(found)


def _scales(parts: Any, scale: Any) -> np.ndarray:
    """One of each coordinate."""
    if scale is None:
        largest = jax.tree.map(lambda leaf: jnp.max(jnp.abs(leaf)) if leaf.size else jnp.ones(()), parts)
        scale = jax.tree.map(lambda size: jnp.where(size > 0, size, 1), largest)
    elif np.ndim(scale) == 0 and not isinstance(scale, (dict, list, tuple)):
        number = checked_number("scale", scale, above=0)
        scale = jax.tree.map(lambda _: number, parts)
    elif jax.tree.structure(scale) != jax.tree.structure(parts):
        raise ValueError(
            f"scale must be one number or of the structure of x, {jax.tree.structure(parts)}, got"
            f" {jax.tree.structure(scale)}"
        )
    spread = jax.tree.map(lambda leaf, size: jnp.broadcast_to(jnp.asarray(size), leaf.shape), parts, scale)
    found = np.asarray(ravel_pytree(spread)[0], float)
    if not np.all(np.isfinite(found) & (found > 0)):
        raise ValueError(f"scale must be finite and > 0, got {found[~(found > 0) | ~np.isfinite(found)][0]}")
    return found


def _ways(flat: _Flat, labels: Sequence[str] | None, most: int) -> tuple[np.ndarray, list[str]]:
    """Directions, in units of the scale, and what they are called."""
    n = flat.start.size
    names = flat.labels if labels is None else [str(label) for label in labels]
    if len(names) != n:
        raise ValueError(f"labels must be {n}, one for each number of x, got {len(names)}")
    if n <= most:
        return np.eye(n), names
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (most, n))
    return signs, [f"random direction {i + 1}" for i in range(most)]


def _evaluated(call: Callable[[Array], Any], start: Array, moves: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values, shape (directions, places)."""
    places = jnp.asarray(np.asarray(start, float) + at[None, :, None] * moves[:, None], start.dtype)
    rows = places.reshape(-1, start.size)

    def number(row: Array) -> Array:
        value = jnp.asarray(call(row))
        if value.shape != ():
            raise ValueError(f"function must return one number, got shape {value.shape}")
        return value

    def one_by_one(rows: Array) -> Any:
        return jnp.stack([number(row) for row in rows])

    values = np.asarray(
        _first_that_works([jax.jit(jax.vmap(number)), jax.vmap(number), one_by_one], rows), float
    )
    return values.reshape(len(moves), len(at))


def _first_that_works(ways: Sequence[Callable[[Array], Any]], at: Array) -> Any:
    """What the first of some functions gives that does not look at values which are not known yet.

    Functions that are not of JAX, or build a scene, do so. The last one's errors are those of the function.
    """
    for way in ways[:-1]:
        try:
            return way(at)
        except (TypeError, IndexError, NotImplementedError, ValueError):
            continue
    return ways[-1](at)


def _derivatives(flat: _Flat, moves: np.ndarray, gradient: Any) -> np.ndarray:
    """Derivatives along the moves."""
    if not isinstance(gradient, str):
        if jax.tree.structure(gradient) != jax.tree.structure(flat.parts):
            raise ValueError(
                f"gradient must be of the structure of x, {jax.tree.structure(flat.parts)}, got"
                f" {jax.tree.structure(gradient)}"
            )
        return moves @ np.asarray(ravel_pytree(jax.tree.map(jnp.asarray, gradient))[0], float)
    if gradient == "reverse":
        slope = jax.grad(flat.call)
        return moves @ np.asarray(_first_that_works([jax.jit(slope), slope], flat.start), float)

    def along(way: Array) -> Array:
        return jax.jvp(flat.call, (flat.start,), (way,))[1]

    ways, rows = [jax.jit(along), along], jnp.asarray(moves, flat.start.dtype)
    return np.array([float(_first_that_works(ways, row)) for row in rows])


def _line(
    label: str,
    at: np.ndarray,
    values: np.ndarray,
    derivative: float,
    length: float,
    steps: tuple[float, ...],
    spacing: float,
) -> Line:
    """A line with its verdict; `derivative` is by `at`, of which one is `length` in the coordinate's unit."""
    finite = bool(np.isfinite(values).all() and np.isfinite(derivative))

    def value(place: float) -> float:
        return float(values[np.argmin(np.abs(at - place))])

    slopes = tuple((value(step) - value(-step)) / (2 * step) for step in steps)
    spread = float(np.ptp(values)) if finite else math.nan
    # Where x is one of few places, a cubic must not go through all of them.
    cubic = np.polynomial.Polynomial.fit(at, values, 3)(at) if finite else values
    roughness = float(np.sqrt(np.sum((values - cubic) ** 2) / max(1, len(at) - 4))) if finite else math.nan
    noise = _ROUNDINGS * spacing * float(np.max(np.abs(values))) if finite else math.nan
    line = Line(label, at, values, derivative, slopes, roughness, spread, Verdict.LOST)
    of = [number / length for number in (derivative, *slopes)]
    verdict = _verdict(line, steps, noise) if finite else Verdict.LOST
    return line._replace(derivative=of[0], slopes=tuple(of[1:]), verdict=verdict)


def _verdict(line: Line, steps: tuple[float, ...], noise: float) -> Verdict:
    """See `Verdict`; derivative and slopes of the line are by distances in units of the scale."""
    _, at, values, derivative, slopes, roughness, spread, _ = line
    largest, least = steps[0], steps[-1]
    steepest = spread / (2 * largest)
    if spread <= noise and abs(derivative) * largest <= max(noise, _TOLERANCE * spread):
        return Verdict.FLAT
    missed = abs(derivative - slopes[0])
    if missed <= _TOLERANCE * steepest + noise / largest:
        ragged = roughness > _RAGGED * spread + noise and derivative * slopes[0] > 0
        return Verdict.COARSE if ragged else Verdict.TRUE
    near = np.abs(at) <= least * (1 + 1e-9)
    inside = float(np.ptp(values[near])) / (2 * least)
    smooth = roughness <= _RIPPLE * spread + noise
    if smooth and abs(derivative - slopes[-1]) <= _TOLERANCE * inside + noise / least:
        return Verdict.CURVED
    if _bent(at, values, derivative, (least, largest), noise):
        return Verdict.KINK
    if smooth:
        return Verdict.WRONG
    same = derivative * slopes[0] > 0 and 1 / _FACTOR <= derivative / slopes[0] <= _FACTOR
    return Verdict.COARSE if same else Verdict.ROUGH


def _bent(at, values, derivative, steps: tuple[float, float], noise: float) -> bool:
    """Whether the function has two slopes at the point, each the same at both steps, and this is one."""

    def value(place: float) -> float:
        return float(values[np.argmin(np.abs(at - place))])

    near, far = ([(value(sign * step) - value(0.0)) / (sign * step) for sign in (-1, 1)] for step in steps)
    apart, unsure = abs(near[1] - near[0]), noise / steps[0]
    if apart <= _KINK * max(map(abs, near)) + 2 * unsure:
        return False
    steady = all(abs(a - b) <= _KINK * apart + unsure for a, b in zip(near, far, strict=True))
    nearest = min(abs(derivative - side) for side in near)
    return bool(steady and nearest <= 0.5 * _TOLERANCE * apart + unsure)
