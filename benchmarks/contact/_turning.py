"""A top on its tip, a coin that rolls or whirls on its rim, and a rattleback, against rolling without slip.

The contact loses nothing (restitution 1, hysteresis 0) and friction is 1, so that nothing slips. Coin and
rattleback are rigid: their contact is stiffer than by default, because one of some width resists turning.
"""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

import dano
from benchmarks._measure import Row
from benchmarks.contact._no_slip import ball_contact, ellipsoid_contact, GRAVITY, rim_contact, Roller
from benchmarks.contact._scenes import Geometry, LOSSLESS, milliseconds, on_floor, play

GROUP = "Turning bodies against the equations of rolling without slip"
FRICTION = 1.0
RIGID = 1e6
"""Stiffness over the default one."""
TIMESTEPS = (0.001, 0.002, 0.005)  # [s]
TARGET = 5.0
"""Error of what is compared [%]."""

TIP, ARM = 0.005, 0.04
"""A top: radius of its tip, and height of its centre of mass above the centre of the tip [m]."""
TOP_MASS, TOP_INERTIA = 0.1, np.diag([6e-5, 6e-5, 1e-4])
"""[kg], [kg m²]: a disc of some 4.5 cm on a pin."""
TOP_TILT, TOP_SPIN = 0.3, 100.0  # [rad], [rad/s]: it stands up against gravity above 59 rad/s

COIN_RADIUS, COIN_HALF = 0.03, 0.002  # [m]
COIN_MASS = 0.05  # [kg]

RATTLEBACK = (0.08, 0.02, 0.012)  # semi-axes [m]
RATTLEBACK_MASS = 0.1  # [kg]
SKEW = np.radians(8.0)
"""Between the principal axes of the inertia and those of the surface, about the vertical."""
RATTLEBACK_SPIN, RATTLEBACK_SECONDS = -5.0, 2.0
"""About the vertical [rad/s], the way that it does not like: after 0.6 s it turns the other way round."""


def rows(*, quick: bool) -> list[Row]:
    steps = TIMESTEPS[:1] if quick else TIMESTEPS
    return [*_top(steps), *_rolling_coin(steps), *_whirling_coin(steps), *_rattleback(steps)]


def _measured(
    name: str,
    steps: tuple[float, ...],
    roller: Roller,
    geometry: Geometry,
    com: np.ndarray,
    start: tuple[np.ndarray, np.ndarray],
    seconds: float,
    error: Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], float],
    stiffer: float = RIGID,
) -> list[Row]:
    """One row for each timestep.

    Args:
        name: For the table.
        steps: Timesteps [s].
        roller: For the equations.
        geometry: For the scene.
        com: Its centre of mass [m, F].
        start: Rotation B → W and ω [rad/s, B].
        seconds: How long.
        error: From positions and rotations over time, by the equations and in the scene, to per cent.
        stiffer: Stiffness over the default one.
    """
    found = []
    for h in steps:
        properties = {"inertia": roller.inertia, "com": com}
        params = {"sliding_friction": FRICTION, **LOSSLESS}
        scene = on_floor(geometry, h, mass=roller.mass, properties=properties, **params)
        stiffness = stiffer * float(scene.contacts[0].params.stiffness)
        scene = on_floor(geometry, h, mass=roller.mass, properties=properties, stiffness=stiffness, **params)
        motion = play(scene, seconds, body=roller.start(*start))
        position, rotation, _ = roller.roll(*start, motion.times)
        value = error(position, rotation, motion.position[:, 0], motion.rotation[:, 0])
        found.append(Row(GROUP, f"{name}, {milliseconds(h)}", value, "%", TARGET, note=motion.said))
    return found


def _top(steps: tuple[float, ...]) -> list[Row]:
    centre = np.array([0.0, 0.0, -ARM])
    roller = Roller(TOP_MASS, TOP_INERTIA, ball_contact(TIP, centre))
    start = (_tilted(TOP_TILT), np.array([0.0, 0.0, TOP_SPIN]))
    name = "top on its tip, 1 s: error of the precession"
    return _measured(name, steps, roller, dano.Sphere(TIP), -centre, start, 1.0, _precession_error, 1.0)


def _rolling_coin(steps: tuple[float, ...]) -> list[Row]:
    roller = _coin()
    # Its axis 0.25 rad above the horizontal, rolling at 20 rad/s: it runs in a narrowing, wobbling circle.
    start = (_tilted(np.pi / 2 - 0.25), np.array([0.0, 0.0, 20.0]))
    name = "coin rolling on its rim, 1 s: error of the place over the way"
    return _measured(name, steps, roller, _coin_shape(), np.zeros(3), start, 1.0, _place_error)


def _whirling_coin(steps: tuple[float, ...]) -> list[Row]:
    """Euler's disk: the centre rests, and the point of contact runs round at Ω = 2 √(g/(a sin α))."""
    tilt = 0.3
    rate = 2 * np.sqrt(GRAVITY / (COIN_RADIUS * np.sin(tilt)))
    # ω lies along the diameter through the contact, which is −x for an axis tilted towards x.
    start = (_tilted(tilt), np.array([-rate * np.sin(tilt), 0.0, 0.0]))
    name = "coin whirling at 17°, 0.5 s: error of the precession"
    return _measured(name, steps, _coin(), _coin_shape(), np.zeros(3), start, 0.5, _precession_error)


def _rattleback(steps: tuple[float, ...]) -> list[Row]:
    a, b, c = RATTLEBACK
    principal = RATTLEBACK_MASS / 5 * np.diag([b**2 + c**2, a**2 + c**2, a**2 + b**2])
    turn = Rotation.from_euler("z", SKEW).as_matrix()
    roller = Roller(RATTLEBACK_MASS, turn @ principal @ turn.T, ellipsoid_contact(RATTLEBACK))
    start = (np.eye(3), np.array([0.2, 0.2, RATTLEBACK_SPIN]))
    name = f"rattleback, {RATTLEBACK_SECONDS:g} s: error of the turn about the vertical"
    shape = dano.Ellipsoid(RATTLEBACK)
    return _measured(name, steps, roller, shape, np.zeros(3), start, RATTLEBACK_SECONDS, _heading_error)


def _coin() -> Roller:
    across = COIN_MASS * (COIN_RADIUS**2 / 4 + COIN_HALF**2 / 3)
    inertia = np.diag([across, across, COIN_MASS * COIN_RADIUS**2 / 2])
    return Roller(COIN_MASS, inertia, rim_contact(COIN_RADIUS, COIN_HALF))


def _coin_shape() -> dano.Cylinder:
    return dano.Cylinder(COIN_RADIUS, COIN_HALF)


def _tilted(angle: float) -> np.ndarray:
    """Rotation B → W with the z axis tilted by an angle [rad] from the vertical towards x."""
    return Rotation.from_euler("y", angle).as_matrix()


def _precession_error(
    position: np.ndarray, rotation: np.ndarray, other: np.ndarray, turned: np.ndarray
) -> float:
    """Of the angle that the axis has gone round the vertical."""
    return _relative(_azimuth(rotation[:, :, 2]), _azimuth(turned[:, :, 2]))


def _heading_error(
    position: np.ndarray, rotation: np.ndarray, other: np.ndarray, turned: np.ndarray
) -> float:
    """Of the angle that the long axis has gone, there and back: the largest difference over the whole way."""
    truth, found = _azimuth(rotation[:, :, 0]), _azimuth(turned[:, :, 0])
    return float(100 * np.abs(found - truth).max() / np.abs(np.diff(truth)).sum())


def _place_error(position: np.ndarray, rotation: np.ndarray, other: np.ndarray, turned: np.ndarray) -> float:
    """Distance at the end over the length of the path."""
    way = np.linalg.norm(np.diff(position, axis=0), axis=1).sum()
    return float(100 * np.linalg.norm(other[-1, :2] - position[-1, :2]) / way)


def _relative(truth: np.ndarray, found: np.ndarray) -> float:
    return float(100 * abs(found[-1] / truth[-1] - 1))


def _azimuth(axes: np.ndarray) -> np.ndarray:
    """About the vertical, from that of the start [rad]."""
    angle = np.unwrap(np.arctan2(axes[:, 1], axes[:, 0]))
    return angle - angle[0]
