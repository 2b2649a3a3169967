"""What MuJoCo's solver is told about a contact besides where it is, and what restitution comes to there.

With a constant impedance d, MuJoCo's contact accelerates by −d (b v + k r) at depth r and speed v, whatever
the masses: a damped oscillator that may push but not pull. It lets go when its force has fallen to zero,
before it is stretched back.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

LEAST_FRICTION = 1e-5
"""MuJoCo's mjMINMU."""

SOLREF = (0.02, 1.0)
SOLIMP = (0.9, 0.95, 0.001, 0.5, 2.0)
"""MuJoCo's defaults, as is `SOLREF`."""

LEAST_REBOUND = math.exp(-2)
"""Rebound of the critically damped spring, which is MuJoCo's default."""

_IMPEDANCE = 0.95
"""Constant, at the top of MuJoCo's default range."""
_ANGLE = 0.25
"""Most that the spring turns in a timestep [rad]: a rebound takes 12 steps or more."""


class ContactSettings(NamedTuple):
    """Parameters of the contacts of two geoms, as in `mjContact`."""

    dim: int  # Directions of force: 1, 3, 4 or 6
    # Two sliding [1], one torsional [m], two rolling coefficients [m], shape (5,).
    friction: Float[np.ndarray, "5"]
    solref: Float[np.ndarray, "2"]  # Time constant [s] and damping ratio, or, negative, stiffness and damping
    solimp: Float[np.ndarray, "5"]  # Impedance, shape (5,)
    margin: float = 0.0  # Distance from which contacts are listed [m]
    gap: float = 0.0  # By how much nearer they are when they begin to press [m]

    def numbers(self) -> Float[np.ndarray, "15"]:
        """As `dano.mujoco.kernels.tables.Settings` has them."""
        parts = [self.margin, self.gap], self.friction, self.solref, self.solimp, [self.dim]
        return np.concatenate([np.asarray(part, np.float64) for part in parts])


def overriding(model: Any) -> ContactSettings:
    """The model's global contact parameters; of its directions and gap nothing is said."""
    option = model.opt
    return ContactSettings(0, option.o_friction, option.o_solref, option.o_solimp, float(option.o_margin))


def rebound(ratio: float) -> float:
    """Separating over approaching speed of a spring with a damping ratio from 0 to 1.

    exp(−2 a cot a) with cos a = ratio (Schwager and Pöschel, *Coefficient of restitution and linear-dashpot
    model revisited*, 2007, there for β = ratio · ω₀).
    """
    if ratio >= 1:
        return LEAST_REBOUND
    angle = math.acos(ratio)
    return math.exp(-2 * angle * ratio / math.sin(angle))


def damping_ratio(restitution: float) -> float:
    """The damping ratio with which a spring rebounds so; 1 for less than a critically damped one can do."""
    low, high = 0.0, 1.0
    if restitution <= LEAST_REBOUND:
        return high
    # The rebound falls with the ratio; 60 halvings leave nothing.
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if rebound(middle) > restitution else (low, middle)
    return 0.5 * (low + high)


def spring_of(restitution: float, timestep: float) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "5"]]:
    """Solref and solimp of contacts that rebound so.

    MuJoCo's defaults where those rebound as much. Above, the damping ratio falls while the damping stays, as
    long as the timestep resolves the spring.

    Args:
        restitution: From 0 to 1.
        timestep: [s].
    """
    ratio = damping_ratio(restitution)
    if ratio >= 1:
        return np.array(SOLREF), np.array(SOLIMP)
    rate = min(1 / (SOLREF[0] * max(ratio, 1e-9)), _ANGLE / timestep)
    # Negative numbers are d k and d b themselves.
    stiffness, damping = rate**2, 2 * ratio * rate
    solimp = np.array([_IMPEDANCE, _IMPEDANCE, *SOLIMP[2:]])
    return np.array([-stiffness, -max(damping, 1e-9)]), solimp
