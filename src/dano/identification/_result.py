"""What `identify` found."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array

from dano.gradients import Check
from dano.identification._uncertainty import quantile
from dano.identification.motions import Motion
from dano.notebook import card, curves, numbers, plain
from dano.scene import Scene, State, state_arrays
from dano.solvers import Stop


class Errors(NamedTuple):
    """How far the fitted motion is from the observed one, over all frames that count.

    Attributes:
        mean_position: [m]; NaN if positions were not observed.
        final_position: Mean over motions of the last frame's [m].
        mean_rotation: [rad].
        final_rotation: Mean over motions of the last frame's [rad].
        rms: Of all residuals, in standard deviations of the noise [1].
    """

    mean_position: float
    final_position: float
    mean_rotation: float
    final_rotation: float
    rms: float


class Minimum(NamedTuple):
    """Where one of several starts ended: values by name, loss, and why there."""

    values: dict[str, Any]
    loss: float
    stop: Stop


@dataclasses.dataclass(frozen=True, eq=False)
class Identification:
    """Identified parameters.

    Attributes:
        values: By name of the parameter.
        standard_errors: By name; ∞ where the data say nothing, NaN for a value on a bound.
        covariance: Of the coordinates `labels`, shape (p, p).
        labels: Names of the coordinates: those of the parameters, with indices for arrays.
        stop: Why the search ended.
        loss_history: Half the sum of squared residuals, in standard deviations, at the start and after each
            step.
        messages: Sentences about parameters on a bound or not determined, and about failed steps.
        errors: Of the fit.
        held_out_errors: Of the motions held out, or None.
        minima: Where each start ended, best first.
        scene: The scene with the values.
        controls: The controls with the values, as they were given.
        initial: Quantities that were estimated of the state in which each window begins.
        initial_states: State in which each window begins, of centres of mass, whatever the motions say.
        motions: What was observed.
        fitted: What the simulation says at the frames of each motion, with the values found.
        guessed: The same at the start of the search.
        smoothed: Whether the loss is rough and the values are where its trend is least; standard errors then
            hold its ripples.
        worth: What derivatives of the loss are worth there, if it is rough or no step reduces it; else None.
        freedom: Observed numbers less estimated ones; of windows or motions that are independent
            (`IdentifyOptions.independent`) their number less one.
        evaluations: How often all windows were simulated, with derivatives.
        seconds: Time it took [s], compilation included.
        masses: Mass [kg] and its standard error of bodies whose `mass_scale` was found, by name.
    """

    values: dict[str, Any]
    standard_errors: dict[str, Any]
    covariance: np.ndarray
    labels: tuple[str, ...]
    stop: Stop
    loss_history: np.ndarray
    messages: tuple[str, ...]
    errors: Errors
    held_out_errors: Errors | None
    minima: tuple[Minimum, ...]
    scene: Scene
    controls: Any
    initial: tuple[str, ...]
    initial_states: State
    motions: tuple[Motion, ...]
    fitted: tuple[Motion, ...]
    guessed: tuple[Motion, ...]
    smoothed: bool
    worth: Check | None
    freedom: int
    evaluations: int
    seconds: float
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
