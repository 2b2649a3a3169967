"""How well the data determine the parameters: covariance, and what they leave open, in words.

There are two covariances. One takes every observed number for independent. The other takes groups of numbers
(motions, windows) for independent of each other, whatever the errors within a group are: Liang and Zeger,
Longitudinal data analysis using generalized linear models, 1986.

What `identify` found.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from dano.gradients import Check
from dano.identification._settings import Selection, Space, with_values
from dano.identification.motions import Motion
from dano.notebook import card, curves, numbers, plain
from dano.scene import Scene, State, state_arrays
from dano.solvers import eliminated, NormalEquations, Stop


class Errors(NamedTuple):
    """How far the fitted motion is from the observed one, over all frames that count."""

    mean_position: float  # [m]; NaN if positions were not observed
    final_position: float  # Mean over motions of the last frame's [m]
    mean_rotation: float  # [rad]
    final_rotation: float  # Mean over motions of the last frame's [rad]
    rms: float  # Of all residuals, in standard deviations of the noise [1]


class Minimum(NamedTuple):
    """Where one of several starts ended: values by name, loss, and why there."""

    values: dict[str, Any]
    loss: float
    stop: Stop


@dataclasses.dataclass(frozen=True, eq=False)
class Identification:
    """Identified parameters."""

    values: dict[str, Any]  # By name of the parameter
    standard_errors: dict[str, Any]  # By name; ∞ where the data say nothing, NaN for a value on a bound
    covariance: np.ndarray  # Of the coordinates `labels`, shape (p, p)
    labels: tuple[str, ...]  # Names of the coordinates: those of the parameters, with indices for arrays
    stop: Stop  # Why the search ended
    # Half the sum of squared residuals, in standard deviations, at the start and after each step.
    loss_history: np.ndarray
    # Sentences about parameters on a bound or not determined, and about failed steps.
    messages: tuple[str, ...]
    errors: Errors  # Of the fit
    held_out_errors: Errors | None  # Of the motions held out, or None
    minima: tuple[Minimum, ...]  # Where each start ended, best first
    scene: Scene  # The scene with the values
    controls: Any  # The controls with the values, as they were given
    initial: tuple[str, ...]  # Quantities that were estimated of the state in which each window begins
    initial_states: State  # State in which each window begins, of centres of mass, whatever the motions say
    motions: tuple[Motion, ...]  # What was observed
    fitted: tuple[Motion, ...]  # What the simulation says at the frames of each motion, with the values found
    guessed: tuple[Motion, ...]  # The same at the start of the search
    # Whether the loss is rough and the values are where its trend is least; standard errors then hold its
    # ripples.
    smoothed: bool
    # What derivatives of the loss are worth there, if it is rough or no step reduces it; else None.
    worth: Check | None
    # Observed numbers less estimated ones; of windows or motions that are independent
    # (`IdentifyOptions.independent`) their number less one.
    freedom: int
    evaluations: int  # How often all windows were simulated, with derivatives
    seconds: float  # Time it took [s], compilation included
    # Mass [kg] and its standard error of bodies whose `mass_scale` was found, by name.
    masses: dict[str, tuple[float, float]] = dataclasses.field(default_factory=dict)

    def __str__(self) -> str:
        """What notebooks show, as text."""
        return plain("Identification", self._summary())

    def _repr_html_(self) -> str:
        """What notebooks show: values with errors beside the loss."""
        rows = self._summary()
        loss = np.log10(np.maximum(np.asarray(self.loss_history, np.float64), 1e-300))
        steps = np.arange(len(loss), dtype=np.float64)
        return card("Identification", rows, curves(steps, {"loss": loss}, "log₁₀ of the loss"))

    def _summary(self) -> list[tuple[str, str]]:
        """Values with errors, and how the search ended."""
        rows = [
            (name, f"{numbers(np.ravel(value))} ± {numbers(np.ravel(self.standard_errors[name]))}")
            for name, value in self.values.items()
        ]
        rows += [
            (f"mass of {body} [kg]", f"{m:.4g} ± {error:.2g}") for body, (m, error) in self.masses.items()
        ]
        rows += [("worth of derivatives", self.worth.summary)] if self.worth is not None else []
        return [*rows, ("stopped", self.stop.value), *(("", message) for message in self.messages)]

    @property
    def converged(self) -> bool:
        """Whether the search ended in a minimum."""
        return self.stop.converged

    def interval(self, name: str, level: float = 0.95) -> tuple[Any, Any]:
        """Lower and upper end of the interval that holds a parameter at this rate.

        Raises:
            ValueError: If there is no such parameter or the level is not between 0 and 1.
        """
        if name not in self.values:
            raise ValueError(f"name must be one of {list(self.values)}, got {name!r}")
        if not 0 < level < 1:
            raise ValueError(f"level must lie between 0 and 1, got {level}")
        half = quantile(level, self.freedom) * np.asarray(self.standard_errors[name])
        low, high = self.values[name] - half, self.values[name] + half
        return (float(low), float(high)) if np.ndim(half) == 0 else (low, high)

    def to_dict(self) -> dict[str, Any]:
        """Numbers and words, as JSON takes them; what is not finite is None."""
        return {
            "values": _plain(self.values),
            "standard_errors": _plain(self.standard_errors),
            "masses": {body: _plain(list(both)) for body, both in self.masses.items()},
            "intervals_95": {name: _plain(list(self.interval(name))) for name in self.values},
            "stop": self.stop.value,
            "converged": self.converged,
            "smoothed": self.smoothed,
            "worth": None if self.worth is None else self.worth.summary,
            "messages": list(self.messages),
            "errors": _plain(self.errors._asdict()),
            "held_out_errors": None
            if self.held_out_errors is None
            else _plain(self.held_out_errors._asdict()),
            "loss_history": _plain(self.loss_history),
            "labels": list(self.labels),
            "bodies": list(self.scene.names),
            "initial_state": {
                name: _plain(np.asarray(states)[0])
                for name, states in state_arrays(self.initial_states).items()
            },
            "covariance": _plain(self.covariance),
            "minima": [
                {"values": _plain(m.values), "loss": m.loss, "stop": m.stop.value} for m in self.minima
            ],
            "freedom": self.freedom,
            "evaluations": self.evaluations,
            "seconds": self.seconds,
        }


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray, Array)) and np.ndim(value) > 0:
        return [_plain(item) for item in value]
    number = float(np.asarray(value))
    return number if np.isfinite(number) else None


# Curvature of the loss, relative to the largest, below which a combination changes nothing that is observed.
_FLAT = 1e-10
# Share of the bounds, or of the value, that may be uncertain.
_OPEN = 0.5
# Standard error, in what the bounds allow or else in values, from which a parameter was not observed at all.
_UNSEEN = 10.0
# Share of a combination that a parameter must have to be named.
_TAKES_PART = 0.25
_MASSES = (".mass", ".mass_scale", ".inertia")
# Least share of the data on a combination of parameters that lies outside of a group: what one group alone
# decides is almost infinitely uncertain.
_OUTSIDE = 1e-3
# Motions from which their scatter is compared with the standard errors, how many times these it must be to be
# reported, and the probability at which chance alone does that.
_ENOUGH_MOTIONS, _SCATTERED, _BY_CHANCE = 8, 2.0, 1e-4


class Groups(NamedTuple):
    """What each group of residuals says of the coordinates alone, initial states eliminated.

    The groups are independent of each other.
    """

    gradients: np.ndarray  # Of the loss of each group, where that of all is least, shape (m, p)
    hessians: np.ndarray  # Shape (m, p, p); their sum is that of all

    def of(self, coordinates: np.ndarray) -> "Groups":
        """Of some of the coordinates; the others are held."""
        return Groups(self.gradients[:, coordinates], self.hessians[:, coordinates[:, None], coordinates])


class Uncertainty(NamedTuple):
    """What the data say of the coordinates."""

    # Of the coordinates, shape (p, p); ∞ on the diagonal where the data say nothing, NaN for what lies on a
    # bound.
    covariance: np.ndarray
    freedom: int  # Observed numbers less estimated ones; of groups their number less one
    messages: tuple[str, ...]  # Sentences about what is not determined


class Fitted(NamedTuple):
    """Where the loss is least, and what is left of it there."""

    space: Space  # The parameters
    x: np.ndarray  # Their coordinates
    normal: NormalEquations  # Normal equations there
    lengths: np.ndarray  # Of the residuals in standard deviations, without those that were not observed
    n_data: int  # How many numbers were observed
    scene: Scene  # The scene at the start, for the words


def uncertainty(
    fitted: Fitted,
    huber: float | None,
    ripple: np.ndarray | None = None,
    least: float = 0.0,
    groups: Groups | None = None,
) -> Uncertainty:
    """Covariance s² (JᵀWJ)⁻¹ of the coordinates, initial states eliminated.

    s² is the variance of the residuals per degree of freedom, so that only the ratios of the standard
    deviations given as noise matter, but not less than `least`. With Huber's loss s² is that of Huber (Robust
    Statistics, 1981, 7.6).

    Args:
        fitted: Where the loss is least.
        huber: Length from which residuals count linearly, or None.
        ripple: Covariance of the coordinates that a rough loss adds, shape (p, p); default none.
        least: Least s²; 1 where residuals are smaller because frames share what they are off by.
        groups: Groups of residuals that are independent of each other; None: every number is. With groups the
            covariance is `between_groups`.
    """
    space, x, normal, lengths, n_data, _ = fitted
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
    if groups is not None:
        freedom = len(groups.gradients) - 1
    covariance = np.full((p, p), np.nan)
    free = np.flatnonzero(~on_bound)
    messages = [
        f"{space.labels[i]} lies on its {'lower' if x[i] <= space.lower[i] else 'upper'} bound: the data "
        "pull it further, and its standard error means nothing"
        for i in np.flatnonzero(on_bound)
    ]
    if len(free):
        rough = np.zeros((len(free), len(free))) if ripple is None else ripple[np.ix_(free, free)]
        mine = None if groups is None else groups.of(free)
        curvature = hessian[np.ix_(free, free)]
        found, more = _inverse(fitted, free, curvature, variance, freedom, rough, mine)
        covariance[np.ix_(free, free)] = found
        messages += more
    return Uncertainty(covariance, freedom, tuple(messages))


def between_groups(hessian: np.ndarray, groups: Groups) -> np.ndarray:
    """Covariance of the least squares estimate from how far groups of residuals pull it apart, shape (p, p).

    H⁻¹ (Σ g̃ g̃ᵀ) H⁻¹ (m − 1)/m with g̃ = (I − H_c H⁻¹)⁻¹ g of each group c. That is the jackknife by groups of
    the linearised problem: H⁻¹ g̃ is how far the estimate moves when the group is left out (Bell and
    McCaffrey, Bias reduction in standard errors for linear regression with multi-stage samples, 2002).
    Directions without data have no variance here.

    Args:
        hessian: Of the loss of all groups, positive semidefinite, in units in which its numbers compare.
        groups: The groups, in the same units.
    """
    values, vectors = np.linalg.eigh(hessian)
    known = values > _FLAT * max(float(values[-1]), np.finfo(float).tiny)
    root = vectors[:, known] / np.sqrt(values[known])
    moves = []
    for gradient, own in zip(groups.gradients @ root, root.T @ groups.hessians @ root, strict=True):
        outside, axes = np.linalg.eigh(np.eye(len(own)) - own)
        moves.append(root @ (axes @ ((axes.T @ gradient) / np.maximum(outside, _OUTSIDE))))
    found = np.array(moves)
    return found.T @ found * (len(found) - 1) / len(found)


def scattered(
    labels: Sequence[str], found: np.ndarray, between: np.ndarray, n_motions: int
) -> tuple[str, ...]:
    """Sentences about coordinates that motions pull apart further than their standard errors say.

    Args:
        labels: Names of the coordinates.
        found: Their covariance, if every observed number is independent.
        between: The same, if only motions are.
        n_motions: How many there are; few say nothing.
    """
    from scipy.stats import chi2

    if n_motions < _ENOUGH_MOTIONS:
        return ()
    with np.errstate(invalid="ignore", divide="ignore"):
        times = np.sqrt(np.diag(between) / np.diag(found))
    least = np.sqrt(chi2.isf(_BY_CHANCE, n_motions - 1) / (n_motions - 1))
    # NaN, of what lies on a bound or is not observed, compares as false.
    return tuple(
        f"{label}: motions pull it apart by {each:.2g} times its standard error, which takes errors of frames"
        " for independent; independent='motions' of IdentifyOptions takes motions for that"
        for label, each in zip(labels, times, strict=True)
        if np.isfinite(each) and each > max(least, _SCATTERED)
    )


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


def _inverse(
    fitted: Fitted,
    free: np.ndarray,
    hessian: np.ndarray,
    variance: float,
    freedom: int,
    rough: np.ndarray,
    groups: Groups | None,
) -> tuple[np.ndarray, list[str]]:
    """Covariance of the coordinates that are free, and sentences about what is not determined."""
    space, x = fitted.space, fitted.x
    width = space.upper[free] - space.lower[free]
    span = np.where(np.isfinite(width), width, np.maximum(np.abs(x[free]), 1e-3))
    # In shares of each parameter's range, so that units do not decide what is flat.
    squares = span[:, None] * span[None]
    values, vectors = np.linalg.eigh(hessian * squares)
    flat = values <= _FLAT * max(float(values[-1]), np.finfo(float).tiny)
    if groups is None:
        inverse = np.where(flat, 0.0, variance / np.where(flat, 1.0, values))
        covariance = (vectors * inverse) @ vectors.T
    else:
        scaled = Groups(groups.gradients * span, groups.hessians * squares)
        covariance = between_groups(hessian * squares, scaled)
    covariance = covariance + rough / squares
    messages = []
    for k in np.flatnonzero(flat):
        messages.append(_words(space, free, vectors[:, k], fitted.scene))
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
    return covariance * squares, messages


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
