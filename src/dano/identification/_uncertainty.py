"""How well the data determine the parameters: covariance, and what they leave open, in words."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dano.identification._parameters import Selection, Space, with_values
from dano.scene import Scene
from dano.solvers import eliminated, NormalEquations

# Curvature of the loss, relative to the largest, below which a combination changes nothing that is observed.
_FLAT = 1e-10
# Share of the bounds, or of the value, that may be uncertain.
_OPEN = 0.5
# Standard error, in what the bounds allow or else in values, from which a parameter was not observed at all.
_UNSEEN = 10.0
# Share of a combination that a parameter must have to be named.
_TAKES_PART = 0.25
_MASSES = (".mass", ".mass_scale", ".inertia")


class Uncertainty(NamedTuple):
    """What the data say of the coordinates."""

    # Of the coordinates, shape (p, p); ∞ on the diagonal where the data say nothing, NaN for what lies on a
    # bound.
    covariance: np.ndarray
    freedom: int  # Observed numbers less estimated ones
    messages: tuple[str, ...]  # Sentences about what is not determined


def uncertainty(
    space: Space,
    x: np.ndarray,
    normal: NormalEquations,
    lengths: np.ndarray,
    huber: float | None,
    n_data: int,
    scene: Scene,
    ripple: np.ndarray | None = None,
    least: float = 0.0,
) -> Uncertainty:
    """Covariance s² (JᵀWJ)⁻¹ of the coordinates, initial states eliminated.

    s² is the variance of the residuals per degree of freedom, so that only the ratios of the standard
    deviations given as noise matter, but not less than `least`. With Huber's loss s² is that of Huber (Robust
    Statistics, 1981, 7.6).

    Args:
        space: The parameters.
        x: Coordinates where the loss is least.
        normal: Normal equations there.
        lengths: Of the residuals in standard deviations, without those that were not observed.
        huber: Length from which residuals count linearly, or None.
        n_data: How many numbers were observed.
        scene: The scene at the start, for the words.
        ripple: Covariance of the coordinates that a rough loss adds, shape (p, p); default none.
        least: Least s²; 1 where residuals are smaller because frames share what they are off by.
    """
    p = len(x)
    _, hessian = eliminated(normal)
    on_bound = (x <= space.lower) | (x >= space.upper)
    estimated = int(np.sum(~on_bound)) + _private(normal)
    freedom = n_data - estimated
    if huber is None:
        variance = float(np.sum(lengths**2)) / max(freedom, 1)
    else:
        inside = float(np.mean(lengths <= huber))
        share = 1 + estimated / n_data * (1 - inside) / max(inside, 1e-3)
        clipped = float(np.sum(np.minimum(lengths, huber) ** 2))
        # The normal equations have weights that average to about `inside`: one of its two factors.
        variance = share**2 * clipped / max(freedom, 1) / max(inside, 1e-3)
    variance = max(variance, least)
    covariance = np.full((p, p), np.nan)
    free = np.flatnonzero(~on_bound)
    messages = [
        f"{space.labels[i]} lies on its {'lower' if x[i] <= space.lower[i] else 'upper'} bound: the data "
        "pull it further, and its standard error means nothing"
        for i in np.flatnonzero(on_bound)
    ]
    if len(free):
        rough = np.zeros((len(free), len(free))) if ripple is None else ripple[np.ix_(free, free)]
        found, more = _inverse(space, x, hessian[np.ix_(free, free)], variance, free, scene, freedom, rough)
        covariance[np.ix_(free, free)] = found
        messages += more
    return Uncertainty(covariance, freedom, tuple(messages))


def quantile(level: float, freedom: int) -> float:
    """Half-width, in standard errors, of an interval that holds the truth at this rate (Student's t)."""
    from scipy.special import stdtrit

    return float(stdtrit(max(freedom, 1), 0.5 + 0.5 * level))


def _private(normal: NormalEquations) -> int:
    """How many numbers of the initial states the data determine."""
    if normal.block_gradient.size == 0:
        return 0
    diagonal = np.diagonal(normal.block_hessian, axis1=1, axis2=2)
    size = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    values = np.linalg.eigvalsh(normal.block_hessian / (size[:, :, None] * size[:, None, :]))
    return int(np.sum(values > 1e-9))


def _inverse(space: Space, x, hessian, variance: float, free, scene: Scene, freedom: int, rough):
    width = space.upper[free] - space.lower[free]
    span = np.where(np.isfinite(width), width, np.maximum(np.abs(x[free]), 1e-3))
    # In shares of each parameter's range, so that units do not decide what is flat.
    values, vectors = np.linalg.eigh(hessian * span[:, None] * span[None])
    flat = values <= _FLAT * max(float(values[-1]), np.finfo(float).tiny)
    inverse = np.where(flat, 0.0, variance / np.where(flat, 1.0, values))
    covariance = (vectors * inverse) @ vectors.T + rough / (span[:, None] * span[None])
    messages = []
    for k in np.flatnonzero(flat):
        messages.append(_words(space, free, vectors[:, k], scene))
        lost = np.abs(vectors[:, k]) > 1e-3
        covariance[lost, lost] = np.inf
    errors = np.sqrt(np.diag(covariance))
    for k in np.flatnonzero(np.isfinite(errors) & (errors > _UNSEEN)):
        messages.append(f"{space.labels[free[k]]} was not observed: nothing in the data depends on its value")
        covariance[k, k] = errors[k] = np.inf
    logarithms = [log for s in space.selections for log in [s.coordinates == "log"] * s.size]
    for k in np.flatnonzero(np.isfinite(errors)):
        i = int(free[k])
        said = _width(
            float(x[i]), float(errors[k] * span[k]), space.lower[i], space.upper[i], logarithms[i], freedom
        )
        if said is not None:
            messages.append(f"{space.labels[i]} is hardly determined: {said}")
    return covariance * span[:, None] * span[None], messages


def _width(x: float, error: float, lower: float, upper: float, logarithm: bool, freedom: int) -> str | None:
    """What to say of a coordinate whose standard error leaves it open; None if the data determine it."""
    width = upper - lower
    if not np.isfinite(width):
        # Nothing to compare with but the value, and for a logarithm one: a factor of e.
        value = 1.0 if logarithm else max(abs(x), 1e-3)
        return f"its standard error is {error / value:.3g} times its value" if error > value else None
    half = quantile(0.95, freedom) * error
    low, high = max(x - half, lower), min(x + half, upper)
    share = (high - low) / width
    if share > _OPEN:
        ends = np.exp([low, high]) if logarithm else (low, high)
        return (
            f"its 95 % interval, {ends[0]:.3g} to {ends[1]:.3g}, holds {100 * share:.0f} % of what its bounds"
            " allow"
        )
    # Bounds that exclude zero say that the order of magnitude is what counts, such as that of a mass.
    relative = error if logarithm else error / abs(x) if lower > 0 else 0.0
    return f"its standard error is {relative:.2g} times its value" if relative > _OPEN else None


def _words(space: Space, free, direction: np.ndarray, scene: Scene) -> str:
    part = np.flatnonzero(np.abs(direction) > _TAKES_PART * np.abs(direction).max())
    labels = [space.labels[free[k]] for k in part]
    if len(labels) == 1:
        text = f"{labels[0]} does not affect what was observed"
    else:
        signs = np.sign(direction[part] * direction[part[0]])
        together = " and ".join(
            f"{'raising' if sign > 0 else 'lowering'} {label}"
            for sign, label in zip(signs, labels, strict=True)
        )
        text = f"{', '.join(labels)} cannot be told apart: {together} together changes nothing observed"
    offsets = np.cumsum([0, *(s.size for s in space.selections)])
    names = [
        s
        for s, a, b in zip(space.selections, offsets[:-1], offsets[1:], strict=True)
        if np.any((free[part] >= a) & (free[part] < b))
    ]
    if any(path.endswith(_MASSES) for path in _changed_leaves(scene, names)):
        text += (
            ". Mass shows only against a force that is known, or a body of known mass: in free flight and in "
            "friction it cancels"
        )
    return text


def _changed_leaves(scene: Scene, selections: Sequence[Selection]) -> list[str]:
    """Paths of the leaves of a scene that parameters set."""
    sizes = sum(s.size for s in selections)
    before = jax.tree_util.tree_leaves_with_path(scene)
    after = jax.tree_util.tree_leaves(with_values(selections, "scene", scene, jnp.full(sizes, 0.123)))
    return [jax.tree_util.keystr(path) for (path, a), b in zip(before, after, strict=True) if a is not b]
