"""What MuJoCo's solver is told about a contact besides where it is, and what restitution comes to there.

With a constant impedance d, MuJoCo's contact accelerates by −d (b v + k r) at depth r and speed v, whatever
the masses: a damped oscillator that may push but not pull. It lets go when its force has fallen to zero,
before it is stretched back.
"""

import ctypes
import functools
import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from dano.mujoco.kernels.words import REALS, WHOLES

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


@functools.cache
def is_gap_beyond(mujoco: Any) -> bool:
    """Whether contacts are listed from margin plus gap on, as newer versions of MuJoCo have it.

    In others they are listed from the margin on, and press a gap later. Not to be asked in a callback.
    """
    geom = '<geom size="0.1" margin="0.01" gap="0.004"/>'
    body = f'<body pos="0 0 0.1"><freejoint/>{geom}</body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geom}{body}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    return bool(data.contact[0].includemargin > 0.018)


class Writer:
    """Adds contacts to an `mjData`, by one `mjContact` whose memory is written over and over."""

    def __init__(self, mujoco: Any):
        """Make it.

        Raises:
            RuntimeError: If this version of MuJoCo has another `mjContact`.
        """
        self._add = mujoco.mj_addContact
        self._contact = contact = mujoco.MjContact()
        begin, whole = contact.pos.ctypes.data - 8, contact.geom.ctypes.data - 12
        self._reals = np.ctypeslib.as_array((ctypes.c_double * REALS).from_address(begin))
        self._wholes = np.ctypeslib.as_array((ctypes.c_int32 * WHOLES).from_address(whole))
        self._reals[:], self._wholes[:] = np.arange(REALS) + 0.5, np.arange(WHOLES) + 40
        read = [contact.dist, *contact.pos, *contact.frame, contact.includemargin, *contact.friction]
        read += [*contact.solref, *contact.solreffriction, *contact.solimp]
        counted = [contact.dim, contact.geom1, contact.geom2, *contact.geom, *contact.flex, *contact.elem]
        counted += [*contact.vert, contact.exclude, contact.efc_address]
        if not np.array_equal(read, self._reals) or not np.array_equal(counted, self._wholes):
            raise RuntimeError(f"mjContact of MuJoCo {mujoco.__version__} is not laid out as dano knows it")

    def places(self) -> tuple[int, int]:
        """Addresses of its real and its whole numbers; they are there as long as this is."""
        return self._reals.ctypes.data, self._wholes.ctypes.data

    def add(self, model: Any, data: Any, reals, wholes) -> bool:
        """Add one by the numbers of `dano.mujoco.kernels.tables`; False: full."""
        self._reals[:] = reals
        self._wholes[:] = wholes
        return self._add(model, data, self._contact) == 0


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
