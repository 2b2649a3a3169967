"""From a coefficient of restitution to the spring and damper of MuJoCo's contacts.

With a constant impedance d, MuJoCo's contact accelerates by −d (b v + k r) at depth r and speed v, whatever
the masses: a damped oscillator that may push but not pull. It lets go when its force has fallen to zero,
before it is stretched back.
"""

import math

import numpy as np
from jaxtyping import Float

SOLREF = (0.02, 1.0)
SOLIMP = (0.9, 0.95, 0.001, 0.5, 2.0)
"""MuJoCo's defaults, as is `SOLREF`."""

LEAST = math.exp(-2)
"""Rebound of the critically damped spring, which is MuJoCo's default."""

_IMPEDANCE = 0.95
"""Constant, at the top of MuJoCo's default range."""
_ANGLE = 0.25
"""Most that the spring turns in a timestep [rad]: a rebound takes 12 steps or more."""


def rebound(ratio: float) -> float:
    """Separating over approaching speed of a spring with a damping ratio from 0 to 1.

    exp(−2 a cot a) with cos a = ratio (Schwager and Pöschel, *Coefficient of restitution and linear-dashpot
    model revisited*, 2007, there for β = ratio · ω₀).
    """
    if ratio >= 1:
        return LEAST
    angle = math.acos(ratio)
    return math.exp(-2 * angle * ratio / math.sin(angle))


def damping_ratio(restitution: float) -> float:
    """The damping ratio with which a spring rebounds so; 1 for less than a critically damped one can do."""
    low, high = 0.0, 1.0
    if restitution <= LEAST:
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
