"""Rigid impacts at one point, in a plane: what laws of two constants say in closed form.

x goes along the floor, z up, and θ turns z into x: clockwise in a picture with x to the right.
"""

import numpy as np


def arms(theta: np.ndarray, semi_axes: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Where an ellipse touches a floor, from its centre: along the floor and below [m].

    Args:
        theta: Angles [rad] of the first semi-axis to the floor.
        semi_axes: [m].
    """
    a, b = semi_axes
    sine, cosine = np.sin(theta), np.cos(theta)
    below = np.hypot(a * sine, b * cosine)
    return (a * a - b * b) * sine * cosine / below, below


def newton(
    velocity: np.ndarray, arm: tuple[np.ndarray, np.ndarray], gyration: float, e: float, friction: float
) -> np.ndarray:
    """Velocities after an impact with Newton's restitution and Coulomb's friction.

    Args:
        velocity: Along x and z, and spin, before [m/s, rad/s], shape (n, 3).
        arm: As `arms` gives it [m].
        gyration: Radius of gyration [m].
        e: Coefficient of restitution.
        friction: Coefficient of friction.
    """
    along, below = arm
    masses = _inverse_masses(arm, gyration)
    normal, tangent, cross = masses
    v_n, v_t = _at_contact(velocity, arm)
    stuck = (-(1 + e) * v_n * tangent + cross * v_t) / (normal * tangent - cross**2)
    held = (-v_t - cross * stuck) / tangent
    side = np.sign(held)
    slipping = -(1 + e) * v_n / (normal + cross * side * friction)
    slips = np.abs(held) > friction * stuck
    pressed = np.where(slips, slipping, stuck)
    rubbed = np.where(slips, side * friction * slipping, held)
    return _after(velocity, arm, gyration, pressed, rubbed)


def poisson(
    velocity: np.ndarray, arm: tuple[np.ndarray, np.ndarray], gyration: float, e: float, friction: float
) -> np.ndarray:
    """The same with Poisson's restitution, by Routh's way through the impulses.

    The normal impulse grows in small parts; friction takes part in each as the slip of that moment says.
    """
    normal, tangent, cross = _inverse_masses(arm, gyration)
    v_n, v_t = (x.copy() for x in _at_contact(velocity, arm))
    part = np.abs(v_n) / normal / _PARTS
    pressed, rubbed, most = np.zeros_like(v_n), np.zeros_like(v_n), np.full_like(v_n, np.inf)
    for _ in range(20 * _PARTS):
        # The impulse of friction that ends the slip within this part, if friction is large enough.
        wanted = -(v_t + cross * part) / tangent
        given = np.clip(wanted, -friction * part, friction * part)
        going = pressed < most
        if not going.any():
            break
        pressed, rubbed = pressed + going * part, rubbed + going * given
        v_n = v_n + going * (normal * part + cross * given)
        v_t = v_t + going * (cross * part + tangent * given)
        most = np.where(np.isinf(most) & (v_n >= 0), (1 + e) * pressed, most)
    return _after(velocity, arm, gyration, pressed, rubbed)


_PARTS = 400
"""Parts of the impulse that would stop the body without friction: errors of a four-hundredth."""


def moment_left(before: np.ndarray, after: np.ndarray, arm, gyration: float) -> np.ndarray:
    """What a force at the point leaves of the change of spin, over the impulse along the normal [m].

    It is how far from the point the impulse must have passed.
    """
    along, below = arm
    change = after - before
    moment = gyration**2 * change[:, 2] + along * change[:, 1] + below * change[:, 0]
    return moment / change[:, 1]


def _at_contact(velocity, arm):
    along, below = arm
    return velocity[:, 1] - along * velocity[:, 2], velocity[:, 0] - below * velocity[:, 2]


def _inverse_masses(arm, gyration):
    along, below = arm
    return 1 + (along / gyration) ** 2, 1 + (below / gyration) ** 2, along * below / gyration**2


def _after(velocity, arm, gyration, pressed, rubbed):
    along, below = arm
    turned = -(along * pressed + below * rubbed) / gyration**2
    return velocity + np.stack([rubbed, pressed, turned], axis=-1)
