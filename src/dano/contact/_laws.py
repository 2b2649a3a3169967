"""Contact laws: from the geometry of a contact and the relative motion of two bodies to a wrench.

A law is a class (what is fixed), its parameters are `ContactParams` (what can be identified). Its formulas
are those of `dano.physics`, which kernels evaluate.
"""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from dano.maths import AnyArray, checked_floating, is_traced, Numbers
from dano.names import did_you_mean

# A scalar, or None until a scene fills it in; written so that type checkers let users read it from a scene.
Filled = Float[Array, ""] | Any


class ContactParams(eqx.Module):
    """Parameters of a contact: leaves, scalars ≥ 0. Each law reads its own; others must stay None.

    "Distributed law" means `DistributedLaw`, the default of a `Contact`; "centroid law" means `CentroidLaw`,
    the paper's.

    What is None is chosen by the law of the contact when a scene is created (`AbstractContactLaw.complete`).

    Attributes:
        sliding_friction: Coulomb coefficient μ [1]; both laws.
        stiffness: Distributed law: pressure per depth [Pa/m].
        restitution: Distributed law: separating over approaching speed in an impact e ≤ 1 [1].
        restitution_velocity: Distributed law: speed [m/s] below which impacts lose more than `restitution`
            says, until at rest the contact is a damped spring.
        impact_depth: Distributed law: depth δ [m] at which an impact happens, and over which its samples
            share it.
        hysteresis: Distributed law: share σ of the pressure that is lost between going in and coming out
            however slowly (at most what `restitution` leaves): rolling and rocking come to rest [1].
        friction_fading: Distributed law: share φ ≤ 1 of the friction coefficient that is lost under high
            pressure [1].
        friction_pressure: Distributed law: pressure p₀ at which half of that is lost [Pa].
        spring: Centroid law (paper: Table I): k, normal force per overlapping mass [N/kg].
        damper: Centroid law: d, its decrease with the separating speed [N s/(m kg)].
        sliding_drag: Centroid law: viscous sliding friction per normal force [s/m].
        torsional_friction: Centroid law: friction moment about the normal per normal force μ_t [m].
        torsional_drag: Centroid law: viscous moment about the normal per normal force [m s].
        rolling_friction: Centroid law: friction moment in the tangent plane per normal force μ_r [m].
        rolling_drag: Centroid law: viscous moment in the tangent plane per normal force [m s].
    """

    sliding_friction: Float[Array, ""]
    stiffness: Filled
    restitution: Filled
    restitution_velocity: Filled
    impact_depth: Filled
    hysteresis: Filled
    friction_fading: Filled
    friction_pressure: Filled
    spring: Filled
    damper: Filled
    sliding_drag: Filled
    torsional_friction: Filled
    torsional_drag: Filled
    rolling_friction: Filled
    rolling_drag: Filled

    def __init__(
        self,
        *,
        sliding_friction: Numbers = 0.2,
        stiffness: Numbers | None = None,
        restitution: Numbers | None = None,
        restitution_velocity: Numbers | None = None,
        impact_depth: Numbers | None = None,
        hysteresis: Numbers | None = None,
        friction_fading: Numbers | None = None,
        friction_pressure: Numbers | None = None,
        spring: Numbers | None = None,
        damper: Numbers | None = None,
        sliding_drag: Numbers | None = None,
        torsional_friction: Numbers | None = None,
        torsional_drag: Numbers | None = None,
        rolling_friction: Numbers | None = None,
        rolling_drag: Numbers | None = None,
        **unknown: Any,
    ):
        """See the class.

        Raises:
            ValueError: If there is no such parameter, or one is negative, not finite or not a scalar,
                `restitution`, `hysteresis` or `friction_fading` exceeds 1, or one that is divided by is zero.
        """
        given = locals()
        for name, value in unknown.items():
            checked_parameter(name, value)
        for name in self.__dataclass_fields__:
            value = given[name]
            setattr(self, name, None if value is None else checked_parameter(name, value))

    def filled(self, **defaults: Numbers) -> "ContactParams":
        """These parameters with defaults where they are None."""
        mine = {name: getattr(self, name) for name in self.__dataclass_fields__}
        missing = {name: value for name, value in defaults.items() if mine[name] is None}
        return ContactParams(**{**mine, **missing}) if missing else self


class Range(NamedTuple):
    """Where a parameter may lie: between two numbers, and not at zero where something is divided by it."""

    least: float
    most: float
    divides: bool


PARAMETER_RANGES = {
    name: Range(
        0.0,
        1.0 if name in ("restitution", "hysteresis", "friction_fading") else float(np.finfo(np.float32).max),
        name in ("stiffness", "restitution_velocity", "impact_depth", "friction_pressure"),
    )
    for name in ContactParams.__dataclass_fields__
}
"""Of each field of `ContactParams`."""


def checked_parameter(name: str, value: Numbers) -> Float[Array, ""]:
    """A value for a field of `ContactParams`.

    Raises:
        ValueError: If there is no such parameter, or the value is out of range.
    """
    valid = list(ContactParams.__dataclass_fields__)
    if name not in valid:
        raise ValueError(f"contact parameter must be one of {valid}, got {name!r}{did_you_mean(name, valid)}")
    array = non_negative(name, value)
    if is_traced(array):
        return array
    limits = PARAMETER_RANGES[name]
    if float(array) > limits.most:
        raise ValueError(f"{name} must lie in [0, {limits.most:.0f}], got {float(array)}")
    if limits.divides and float(array) == 0:
        raise ValueError(f"{name} must be > 0, got {float(array)}")
    return array


STANDARD_GRAVITY = 9.81
"""What contacts are chosen for where a scene has no gravity [m/s²]."""


class Setting(NamedTuple):
    """What default parameters are derived from."""

    # Largest extent of the smaller body [m]; an array of those of many bodies that are completed at once.
    size: float | Float[np.ndarray, " n"]
    gravity: Float[Array, ""]  # Its magnitude, 9.81 where there is none [m/s²]
    # Gives the stiffness [Pa/m] at which either body, set down on a rigid floor in a typical orientation,
    # sinks by at most a share of its size.
    stiffness: Callable[[float], AnyArray]
    timestep: Float[Array, ""]  # h [s]
    sharp: bool  # Whether edges and faces of both bodies are known exactly
    on_fixed: bool  # Whether both are shapes, and one is fixed


class AbstractContactLaw(eqx.Module):
    """How the contact of two bodies becomes force: at a patch (`AbstractPatchLaw`) or at points."""

    @property
    @abc.abstractmethod
    def reads(self) -> tuple[str, ...]:
        """Names of the parameters that the law reads."""

    def check(self, params: ContactParams) -> None:
        """Check that only parameters are given that the law reads.

        Raises:
            ValueError: If another one is given.
        """
        for name in params.__dataclass_fields__:
            if name not in self.reads and getattr(params, name) is not None:
                raise ValueError(
                    f"{type(self).__name__} does not read {name}; it reads {', '.join(self.reads)}"
                )

    @property
    def presses(self) -> bool:
        """Whether the law needs surface samples and solids rather than shared mass."""
        return False

    def complete(self, params: ContactParams, setting: Setting) -> ContactParams:
        """Parameters with this law's defaults in place of None."""
        return params


class AbstractPatchLaw(AbstractContactLaw):
    """One wrench for all of the overlap of two bodies."""


def non_negative(name: str, value: Numbers) -> Float[Array, ""]:
    """`value` as a scalar ≥ 0.

    Raises:
        ValueError: If it is not.
    """
    array = checked_floating(name, value)
    if array.shape != ():
        raise ValueError(f"{name} must be a scalar, got shape {array.shape}")
    if not is_traced(array) and not (np.isfinite(np.asarray(array)) and float(array) >= 0):
        raise ValueError(f"{name} must be finite and ≥ 0, got {float(array)}")
    return array


def positive(name: str, value: Numbers) -> Float[Array, ""]:
    """`value` as a scalar > 0.

    Raises:
        ValueError: If it is not.
    """
    array = non_negative(name, value)
    if not is_traced(array) and float(array) == 0.0:
        raise ValueError(f"{name} must be > 0, got 0.0")
    return array
