"""What drives joints: commands of a step become torques or forces, within limits and through a gear."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from dano.checks import checked_choice
from dano.maths import checked_array, checked_floating, is_traced, Numbers

MOTOR_KINDS = ("effort", "position", "velocity")
"""What the command of a motor is: a torque or force, a place to go to, or a speed to keep."""


class Motor(eqx.Module):
    """A motor on a joint. With gear r it turns r times as far as the joint, and its torque f acts r-fold.

    With joint coordinate q and velocity v at the end of the step, and command u:

        effort      f = u
        position    f = stiffness (u − r q) − damping r v
        velocity    f = damping (u − r v)

    f is kept within limits. Taking the end of the step keeps stiff ones stable at any timestep.

    Attributes:
        kind: "effort", "position" or "velocity".
        stiffness: Of "position" [N m/rad or N/m].
        damping: Of "position" and "velocity" [N m s/rad or N s/m].
        gear: r [1, or rad/m for a motor that turns to move a slide].
        limits: Least and largest f [N m or N].
    """

    kind: str = eqx.field(static=True)
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    gear: Float[Array, ""]
    limits: Float[Array, "2"]

    def __init__(
        self,
        kind: str = "effort",
        *,
        stiffness: Numbers = 0.0,
        damping: Numbers = 0.0,
        gear: Numbers = 1.0,
        limits: Numbers | None = None,
    ):
        """A motor; see the attributes. Without limits f is not bounded.

        Raises:
            ValueError: If the kind is unknown, a number is out of range, the gear is zero, or what the kind
                needs is missing.
        """
        checked_choice("kind of motor", kind, MOTOR_KINDS)
        self.kind = kind
        self.stiffness = checked_array("stiffness of motor", stiffness, ())
        self.damping = checked_array("damping of motor", damping, ())
        self.gear = checked_array("gear of motor", gear, ())
        self.limits = checked_limits("limits of motor", (-np.inf, np.inf) if limits is None else limits)
        for name in ("stiffness", "damping"):
            value = getattr(self, name)
            if not is_traced(value) and float(value) < 0:
                raise ValueError(f"{name} of motor must be ≥ 0, got {float(value)}")
        if not is_traced(self.gear) and float(self.gear) == 0:
            raise ValueError("gear of motor must not be 0, got 0.0")
        needed = {"effort": (), "position": ("stiffness",), "velocity": ("damping",)}[kind]
        for name in needed:
            value = getattr(self, name)
            if not is_traced(value) and not float(value) > 0:
                raise ValueError(f"{name} of a {kind} motor must be > 0, got {float(value)}")


def checked_limits(name: str, value: Numbers) -> Float[Array, "2"]:
    """Two numbers of which the first is not the larger; they may be infinite.

    Raises:
        ValueError: If they are not.
    """
    limits = checked_floating(name, value)
    if limits.shape != (2,):
        raise ValueError(f"{name} must be two numbers, got shape {limits.shape}")
    if not is_traced(limits) and not np.less_equal(*np.asarray(limits)):
        raise ValueError(f"{name} must be a least and a largest number, got {np.asarray(limits).tolist()}")
    return limits
