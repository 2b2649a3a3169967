"""Rigid impacts at one point, in a plane: what laws of two constants say in closed form.

x goes along the floor, z up, and θ turns z into x: clockwise in a picture with x to the right.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

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
    masses, start = _inverse_masses(arm, gyration), at_contact(velocity, arm)
    return _after(velocity, arm, gyration, *_whole(masses, start, e, friction))


def whittaker(
    velocity: np.ndarray, arm: tuple[np.ndarray, np.ndarray], gyration: float, e: float, friction: float
) -> np.ndarray:
    """As `newton`, but friction that cannot hold opposes the first slip, also where that turns round."""
    masses, start = _inverse_masses(arm, gyration), at_contact(velocity, arm)
    return _after(velocity, arm, gyration, *_whole(masses, start, e, friction, -np.sign(start[1])))


def in_two_parts(
    velocity: np.ndarray, arm: tuple[np.ndarray, np.ndarray], gyration: float, e: float, friction: float
) -> np.ndarray:
    """Anitescu and Potra's, with Poisson's restitution: `newton` with e = 0, then e times its impulse again.

    Friction is found anew for the second part.
    """
    masses, start = _inverse_masses(arm, gyration), at_contact(velocity, arm)
    normal, tangent, cross = masses
    pressed, rubbed = _whole(masses, start, 0.0, friction)
    slip = start[1] + cross * pressed * (1 + e) + tangent * rubbed
    more = np.clip(-slip / tangent, -friction * e * pressed, friction * e * pressed)
    return _after(velocity, arm, gyration, pressed * (1 + e), rubbed + more)


def least_energy(
    velocity: np.ndarray, arm: tuple[np.ndarray, np.ndarray], gyration: float, e: float, friction: float
) -> np.ndarray:
    """Drumwright and Shell's law: the impulse that leaves the least energy, then e times its normal part."""
    masses, (v_n, v_t) = _inverse_masses(arm, gyration), at_contact(velocity, arm)
    normal, tangent, cross = masses
    pressed, rubbed = _sticking(masses, (v_n, v_t), 0.0)
    held = np.abs(rubbed) <= friction * pressed
    least = np.where(held, -np.inf, np.inf)
    # Else it is on an edge of the cone, as large as leaves the least energy and nothing that goes in.
    for ratio in (-friction, friction):
        part = -(v_n + ratio * v_t) / (normal + 2 * cross * ratio + tangent * ratio**2)
        part = np.maximum(part, -v_n / (normal + cross * ratio))
        energy = part * (v_n + ratio * v_t)
        energy = energy + part**2 * (normal + 2 * cross * ratio + tangent * ratio**2) / 2
        better = energy < least
        least = np.where(better, energy, least)
        pressed, rubbed = np.where(better, part, pressed), np.where(better, ratio * part, rubbed)
    return _after(velocity, arm, gyration, pressed * (1 + e), rubbed)


def _sticking(masses: tuple, start: tuple, e: float) -> tuple[np.ndarray, np.ndarray]:
    """Impulses after which the point leaves at e times its approach and does not slip."""
    normal, tangent, cross = masses
    v_n, v_t = start
    pressed = (-(1 + e) * v_n * tangent + cross * v_t) / (normal * tangent - cross**2)
    return pressed, (-v_t - cross * pressed) / tangent


def _whole(
    masses: tuple, start: tuple, e: float, friction: float, side: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Impulses with friction of the impulse as a whole: where it slips, on the side that would hold."""
    normal, _, cross = masses
    pressed, held = _sticking(masses, start, e)
    slips = np.abs(held) > friction * pressed
    side = np.sign(held) if side is None else side
    slipping = -(1 + e) * start[0] / (normal + cross * side * friction)
    return np.where(slips, slipping, pressed), np.where(slips, side * friction * slipping, held)


def following_slip(
    velocity: np.ndarray,
    arm: tuple[np.ndarray, np.ndarray],
    gyration: float,
    e: float | np.ndarray,
    friction: float,
    *,
    ends: str = "poisson",
    rebound: float = 0.0,
) -> np.ndarray:
    """The same with friction that follows the slip while the impulse grows (Routh 1905), in closed form.

    In `newton` friction belongs to the impulse as a whole and opposes the slip that is left. Here it opposes
    the slip of each moment; where that stops, the point sticks, or slips back if friction cannot hold it.

    Args:
        velocity: As in `newton`.
        arm: As in `newton`.
        gyration: As in `newton`.
        e: Coefficient of restitution, of all or of each.
        friction: As in `newton`.
        ends: When the impact ends: at e times the approaching speed ("newton"), when the impulse since the
            deepest moment is e times that before it ("poisson"), or its work e² times ("stronge").
        rebound: Where the slip has stopped it leaves with so many times the first slip, turned round, as far
            as friction allows.

    Raises:
        ValueError: If `ends` is another word.
    """
    if ends not in ("newton", "poisson", "stronge"):
        raise ValueError(f"ends must be 'newton', 'poisson' or 'stronge', got {ends!r}")
    masses = _inverse_masses(arm, gyration)
    v_n, v_t = at_contact(velocity, arm)
    nothing = np.zeros_like(v_n)
    deepest = _grown(
        _Impulse(nothing, nothing, v_n, v_t, nothing), masses, friction, lambda now, by_n: -now.v_n / by_n
    )

    def left(now: _Impulse, by_n: np.ndarray) -> np.ndarray:
        if ends == "newton":
            return (-e * v_n - now.v_n) / by_n
        if ends == "poisson":
            return (1 + e) * deepest.pressed - now.pressed
        work = -(e**2) * deepest.work - (now.work - deepest.work)
        return (np.sqrt(now.v_n**2 + 2 * by_n * work) - now.v_n) / by_n

    end = _grown(deepest, masses, friction, left)
    _, tangent, _ = masses
    wanted = end.rubbed + np.where(end.v_t == 0, -rebound * v_t / tangent, 0.0)
    rubbed = np.clip(wanted, -friction * end.pressed, friction * end.pressed)
    return _after(velocity, arm, gyration, end.pressed, rubbed)


class _Impulse(NamedTuple):
    """An impulse so far.

    Attributes:
        pressed: Along the normal, over the mass [m/s].
        rubbed: Along the floor [m/s].
        v_n: Velocity of the point of contact along the normal [m/s].
        v_t: Along the floor [m/s].
        work: Of the normal impulse, over the mass [m²/s²].
    """

    pressed: np.ndarray
    rubbed: np.ndarray
    v_n: np.ndarray
    v_t: np.ndarray
    work: np.ndarray


def _grown(
    now: _Impulse, masses: tuple, friction: float, left: Callable[[_Impulse, np.ndarray], np.ndarray]
) -> _Impulse:
    """The impulse when `left(impulse, growth of v_n by it)` is zero; velocities are linear in two parts."""
    normal, tangent, cross = masses
    for _ in range(2):
        slides = now.v_t != 0
        held = np.where(np.abs(cross) <= friction * tangent, -cross / tangent, -friction * np.sign(cross))
        ratio = np.where(slides, -friction * np.sign(now.v_t), held)
        by_n, by_t = normal + cross * ratio, cross + tangent * ratio
        # Beside friction that holds, rounding would let the point creep.
        by_t = np.where(~slides & (np.abs(cross) <= friction * tangent), 0.0, by_t)
        stops = np.where(slides & (now.v_t * by_t < 0), -now.v_t / np.where(by_t == 0, np.inf, by_t), np.inf)
        part = np.minimum(stops, left(now, by_n))
        v_n = now.v_n + by_n * part
        now = _Impulse(
            now.pressed + part,
            now.rubbed + ratio * part,
            v_n,
            np.where(part == stops, 0.0, now.v_t + by_t * part),
            now.work + part * (now.v_n + v_n) / 2,
        )
    return now


SIX_LAWS: dict[str, Callable[..., np.ndarray]] = {
    "Drumwright and Shell": least_energy,
    "AP Poisson": in_two_parts,
    "AP Newton": newton,
    "Mirtich": functools.partial(following_slip, ends="stronge"),
    "Wang and Mason": functools.partial(following_slip, ends="poisson"),
    "Whittaker": whittaker,
}
"""As their authors describe them; AP: Anitescu and Potra."""


def moment_left(before: np.ndarray, after: np.ndarray, arm, gyration: float) -> np.ndarray:
    """What a force at the point leaves of the change of spin, over the impulse along the normal [m].

    It is how far from the point the impulse must have passed.
    """
    along, below = arm
    change = after - before
    moment = gyration**2 * change[:, 2] + along * change[:, 1] + below * change[:, 0]
    return moment / change[:, 1]


def at_contact(velocity: np.ndarray, arm: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Velocities of the point of contact along the normal and along the floor [m/s]."""
    along, below = arm
    return velocity[:, 1] - along * velocity[:, 2], velocity[:, 0] - below * velocity[:, 2]


def _inverse_masses(arm, gyration):
    along, below = arm
    return 1 + (along / gyration) ** 2, 1 + (below / gyration) ** 2, along * below / gyration**2


def _after(velocity, arm, gyration, pressed, rubbed):
    along, below = arm
    turned = -(along * pressed + below * rubbed) / gyration**2
    return velocity + np.stack([rubbed, pressed, turned], axis=-1)
