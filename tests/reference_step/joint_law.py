"""What acts on joint coordinates, g(y) of docs/theory/integrator.md, "Bodies on joints"."""

from typing import NamedTuple

import numpy as np
from reference_step.kinematics import factor_of

STICKING = 1e-7
"""Speed at which the friction of a joint has its full size [rad/s or m/s]."""
STOP = 1e4
"""Stiffness of a limit, times h² and over what the coordinate weighs."""

CLOSING = 1.0
"""Largest speed at which a limit takes a joint back [rad/s or m/s]."""


class Term(NamedTuple):
    """A force clip(slope (y − centre), least, most) on the coordinate in a row of y."""

    kind: str
    row: int
    slope: float
    centre: float
    least: float = -np.inf
    most: float = np.inf


class JointLaw:
    """Forces [N m or N] on the coordinates of the joints of a step."""

    def __init__(self, kinematics, control):
        k, h = len(kinematics.start), kinematics.h
        weights = 1 / np.diag(np.linalg.inv(kinematics.mass_matrix)) if k else np.zeros(0)
        self.effort, commands = (spread(control, name, k) for name in ("effort", "command"))
        self.terms = []
        for joint in kinematics.scene.joints:
            factor = factor_of(joint)
            for row in kinematics.joint_rows[joint.child]:
                old, q = kinematics.start[row], kinematics.q[row]
                self.terms += smooth_terms(joint, factor, row, q, old, h)
                self.terms += kinked_terms(joint, factor, row, q, weights[row], h)
                if joint.motor is not None and joint.motor.kind == "effort":
                    motor = joint.motor
                    self.effort[row] += float(motor.gear) * np.clip(commands[row], *motor.limits)
                elif joint.motor is not None:
                    self.terms.append(motor_term(joint.motor, row, q, commands[row], h))

    def forces(self, y, softness=1.0):
        """g(y) and its derivatives, shapes (k,) and (k,)."""
        g, slopes = -self.effort, np.zeros_like(y)
        for term in self.terms:
            slope = term.slope / softness if term.kind == "friction" else term.slope
            value = slope * (y[term.row] - term.centre)
            g[term.row] += np.clip(value, term.least, term.most)
            slopes[term.row] += slope * (term.least < value < term.most)
        return g, slopes

    def smooth(self, y):
        """g(y) without what has kinks: friction, limits and motors that heed the joint."""
        g = -self.effort
        for term in self.terms:
            if term.kind == "smooth":
                g[term.row] += term.slope * (y[term.row] - term.centre)
        return g


def spread(control, name, k):
    """Numbers of a control on joints, at their places among y."""
    given = None if control is None else getattr(control, name)
    return np.zeros(k) if given is None else np.r_[np.zeros(k - len(given)), np.asarray(given)]


def smooth_terms(joint, factor, row, q, old, h):
    """d y of damping, a (y − v)/h of armature, and k (q + h (y − v)/4 − rest) of a spring."""
    terms = [Term("smooth", row, factor**2 * float(joint.damping), 0.0)]
    if joint.armature is not None:
        terms.append(Term("smooth", row, factor**2 * float(joint.armature) / h, old))
    if joint.stiffness is not None and joint.stiffness > 0:
        centre = old - 4 * (q - float(joint.rest)) / h
        terms.append(Term("smooth", row, float(joint.stiffness) * h / 4, centre))
    return terms


def kinked_terms(joint, factor, row, q, weight, h):
    """Friction that sticks up to `STICKING`, and limits as springs of `STOP` times weight over h².

    A limit that was passed is closed at `CLOSING`.
    """
    terms = []
    if joint.friction is not None:
        most = abs(factor) * float(joint.friction)
        terms.append(Term("friction", row, most / STICKING, 0.0, -most, most))
    if joint.limits is not None:
        (least, most), slope = joint.limits, STOP * weight / h
        if np.isfinite(least):
            terms.append(Term("limit", row, slope, min((least - q) / h, CLOSING), most=0.0))
        if np.isfinite(most):
            terms.append(Term("limit", row, slope, max((most - q) / h, -CLOSING), least=0.0))
    return terms


def motor_term(motor, row, q, u, h):
    """−r f of a motor, f = stiffness (u − r q⁺) − damping r y or damping (u − r y), within its limits."""
    r, damping = float(motor.gear), float(motor.damping)
    stiffness = float(motor.stiffness) if motor.kind == "position" else 0.0
    at_rest = stiffness * (u - r * q) if motor.kind == "position" else damping * u
    slope = damping + h * stiffness
    least, most = sorted(-r * np.asarray(motor.limits))
    return Term("motor", row, r * r * slope, at_rest / (r * slope), least, most)
