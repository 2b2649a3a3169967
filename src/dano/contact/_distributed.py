"""The distributed law: pressure and friction at every surface sample."""

import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from dano.contact._laws import (
    AbstractContactLaw,
    ContactParams,
    non_negative,
    positive,
    Setting,
    STANDARD_GRAVITY,
)
from dano.maths import AnyArray, by_numpy, checked_array, is_traced, library, Numbers, Q

CHUNK = 16
"""Points that `VariationalEngine.capacity` counts as one."""
# Share of its size by which a body sinks under the heaviest load of the scene in a typical orientation, at
# default stiffness.
SINKING = 0.005
IMPACT_DEPTH = 0.005
"""Depth of an impact over the size of the smaller body, at default."""
# Where edges and faces of both bodies are known: share by which a body sinks, and depth of an impact over
# that of others. A face that closes over a cushion lands row by row: many small impacts lose less. What an
# impact leaves deep is pushed out after it. Samples of neural objects scatter, and stacks are solved in fewer
# passes the softer they are: the least share is for shapes on what is fixed.
_SHARP_SINKING, _FIXED_SINKING, _SHARP_DEPTH = 1e-4, 1e-5, 2e-4
# Velocities within which restitution ends at default: so many times √(g · depth of the heaviest load).
_SLOW = 0.2


class Materials(NamedTuple):
    """What the traction at a point depends on besides geometry and velocity; arrays over contacts."""

    stiffness: Float[Array, " *n"]  # k [Pa/m]
    restitution: Float[Array, " *n"]  # e [1]
    restitution_velocity: Float[Array, " *n"]  # v_e [m/s]
    hysteresis: Float[Array, " *n"]  # σ [1]
    friction: Float[Array, " *n"]  # μ [1]
    friction_fading: Float[Array, " *n"]  # φ [1]
    friction_pressure: Float[Array, " *n"]  # p₀ [Pa]
    stiction: Float[Array, " *n"]  # v_s [m/s]
    ahead: Float[Array, " *n"]  # θ h, how far ahead the depth is taken [s]
    timestep: Float[Array, " *n"]  # h [s]
    instant: Float[Array, " *n"]  # 1 where impacts end within the step, 0 where they are left to the spring
    bounce: Float[Array, " *n"]  # Slowest rebound of an impact [m/s]
    # An overlap of depth d separates at most at √(uplift · d), if that exceeds v_e [m/s²].
    uplift: Float[Array, " *n"]
    gradual: Float[Array, " *n"]  # v_g [m/s]


class DistributedLaw(AbstractContactLaw):
    """Every surface sample is a compliant contact with its own depth, velocity and friction.

    A sample of area A at depth d below the other body's surface, with outward normal n there, separating at
    v_n and slipping at u, feels

        F = A p (n − μ(p) c(u/v_s)),   p = k max(0, d − θ h v_n) (1 − (1 − σ) x − σ c(v_n/v_s))

    with x = v_n/v_e up to its limits ±1, c(x) = x/max(|x|, 1), v_e not below √(g d)/5, and
    μ(p) = μ (1 − φ p/(p + p₀)) (with `compliant` p is another); A is the part of the
    sample's area that faces the other body (see `ContactParams` for the parameters). Velocities are those at
    the end of the step.
    Torsional and rolling resistance come out of the geometry. Where both bodies have samples, each set
    carries half.

    Impacts, approaches faster than `restitution_velocity` + g h, happen when bodies have sunk in by
    `impact_depth`, and end within the step, whatever its length: a patch leaves with e times the speed at
    which it came. With `compliant=True` they are left to the
    spring, which needs some twenty steps an impact: right for a measured stiffness and a small timestep.

    Default stiffness: set down on a rigid floor in a typical (the median) orientation, so on a corner, an
    edge or a bulge, under the weight of the heaviest body of the scene, a body sinks by 0.5 % of its size; on
    a flat side by much less; where edges and faces of both are known, by 0.01 %. Default restitution
    velocity: √(g · 0.5 % size)/5, small against impacts, large against what is left of motion at rest.

    Attributes:
        stiction_velocity: v_s, slip up to which friction counts as sticking [m/s].
        implicitness: θ from 1/2 to 1: where in a step the depth is taken. 1, its end, is quietest.
        compliant: Whether impacts are left to the spring (static).
        gradual_stiction: v_g, slip up to which friction grows with it in derivatives, −b/v_g du [m/s]; 0 for
            that of Coulomb friction, in which what sticks does not move however one pushes. The motion is
            the same.
        functions: A file of functions that stand in place of some of those of a point, see
            `docs/theory/contact.md`; none for this law as it is (static).
        numbers: Three numbers for them.
    """

    stiction_velocity: Float[Array, ""]
    implicitness: Float[Array, ""]
    gradual_stiction: Float[Array, ""]
    compliant: bool = eqx.field(static=True)
    functions: str | None = eqx.field(static=True)
    numbers: Float[Array, "3"]

    def __init__(
        self,
        *,
        stiction_velocity: Numbers = 1e-7,
        implicitness: Numbers = 1.0,
        gradual_stiction: Numbers = 0.0,
        compliant: bool = False,
        functions: str | os.PathLike[str] | None = None,
        numbers: Numbers = (0.0, 0.0, 0.0),
    ):
        """See the class.

        Raises:
            ValueError: If `stiction_velocity` is not a positive number, `implicitness` not in [1/2, 1],
                `gradual_stiction` negative, `functions` no file, or `numbers` not three.
        """
        self.stiction_velocity = positive("stiction_velocity", stiction_velocity)
        self.implicitness = non_negative("implicitness", implicitness)
        if not is_traced(self.implicitness) and not 0.5 <= float(self.implicitness) <= 1:
            raise ValueError(f"implicitness must lie in [1/2, 1], got {float(self.implicitness)}")
        self.gradual_stiction = non_negative("gradual_stiction", gradual_stiction)
        self.compliant = bool(compliant)
        self.functions = None if functions is None else os.path.abspath(functions)
        if self.functions is not None and not os.path.isfile(self.functions):
            raise ValueError(f"functions must be a file, got {os.fspath(functions or '')!r}")
        self.numbers = checked_array("numbers", numbers, (3,))

    @property
    def reads(self) -> tuple[str, ...]:
        """See `AbstractContactLaw.reads`."""
        return (
            "sliding_friction",
            "stiffness",
            "restitution",
            "restitution_velocity",
            "impact_depth",
            "hysteresis",
            "friction_fading",
            "friction_pressure",
        )

    @property
    def presses(self) -> bool:
        """See `AbstractContactLaw.presses`."""
        return True

    def complete(self, params: ContactParams, setting: Setting) -> ContactParams:
        """See `AbstractContactLaw.complete`."""
        return params.filled(**self.defaults(params, setting))

    def defaults(self, params: ContactParams, setting: Setting) -> dict[str, Any]:
        """What `complete` fills in; arrays over bodies where `setting` has an array of sizes.

        Args:
            params: Parameters that are given: a stiffness is not asked for where there is one.
            setting: What the defaults are derived from.
        """
        # What is left to the spring needs one.
        sharp = setting.sharp and not self.compliant
        depth = (_SHARP_DEPTH if sharp else 1.0) * IMPACT_DEPTH * setting.size
        found = {
            "restitution": 0.0,
            "restitution_velocity": _slow(setting.gravity, setting.size),
            "impact_depth": depth,
            "hysteresis": 0.35,
            "friction_fading": 0.0,
            "friction_pressure": 1000.0,
        }
        if params.stiffness is None:
            of_sharp = _FIXED_SINKING if setting.on_fixed else _SHARP_SINKING
            found["stiffness"] = setting.stiffness(of_sharp if sharp else SINKING)
        return found


@by_numpy
def _slow(gravity: Float[Q, ""], size: Any) -> AnyArray:
    """Speed [m/s] of an impact that counts as slow for bodies of a size [m]."""
    return _SLOW * library(gravity).sqrt(gravity * SINKING * size)


def combined(a: ContactParams, b: ContactParams) -> ContactParams:
    """Complete parameters of pairs from those of their bodies, arrays over the pairs.

    The sliding friction is √(μ_a μ_b). Of restitution, stiffness, hysteresis and fading the larger counts, of
    `restitution_velocity`, `impact_depth` and `friction_pressure` the smaller.
    """

    def of(name: str) -> AnyArray:
        x, y = getattr(a, name), getattr(b, name)
        xp = library(x, y)
        if name == "sliding_friction":
            product = x * y
            slips = product > 0
            return xp.where(slips, xp.sqrt(xp.where(slips, product, 1)), 0)
        smaller = name in ("restitution_velocity", "impact_depth", "friction_pressure")
        return (xp.minimum if smaller else xp.maximum)(x, y)

    names = [name for name in a.__dataclass_fields__ if getattr(a, name) is not None]
    return eqx.tree_at(lambda p: [getattr(p, name) for name in names], a, [of(name) for name in names])


def materials(
    groups: Sequence[tuple[DistributedLaw, ContactParams]],
    timestep: Float[AnyArray, ""],
    gravity: Float[AnyArray, ""],
) -> Materials:
    """What points of contacts feel, as arrays over all contacts.

    Args:
        groups: Laws, and complete parameters of one contact, or arrays over several.
        timestep: h [s].
        gravity: Its magnitude [m/s²].
    """
    sizes = [params.sliding_friction.size for _, params in groups]
    xp = library(timestep, gravity, *jax.tree.leaves(groups))

    def column(values: Sequence[AnyArray]) -> Float[AnyArray, " n"]:
        every = [xp.broadcast_to(x, (n,)) for x, n in zip(values, sizes, strict=True)]
        return xp.concatenate(every).astype(timestep.dtype)

    stacked: ContactParams = jax.tree.map(lambda *x: column(x), *(params for _, params in groups))
    laws = [law for law, _ in groups]
    n = sum(sizes)
    strength = xp.where(gravity > 0, gravity, STANDARD_GRAVITY)
    # Sinking from rest by half the depth of an impact makes no impact.
    settling = xp.where(gravity > 0, xp.sqrt(strength * stacked.impact_depth), 0)
    return Materials(
        stacked.stiffness,
        stacked.restitution,
        stacked.restitution_velocity,
        stacked.hysteresis,
        stacked.sliding_friction,
        stacked.friction_fading,
        stacked.friction_pressure,
        column([law.stiction_velocity for law in laws]),
        column([law.implicitness for law in laws]) * timestep,
        xp.broadcast_to(timestep, (n,)),
        xp.asarray(np.repeat([0.0 if law.compliant else 1.0 for law in laws], sizes), timestep.dtype),
        xp.maximum(stacked.restitution_velocity + gravity * timestep, settling),
        xp.broadcast_to(_SLOW**2 * strength, (n,)).astype(timestep.dtype),
        column([law.gradual_stiction for law in laws]),
    )
