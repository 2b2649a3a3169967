"""Rolling: round bodies that roll without slipping on a plane keep their speed.

Nothing but the contact's own losses may slow them. Started at the speed of rolling, with restitution 1 and
hysteresis 0, they must keep it; with the default parameters they lose something, the same at every timestep.
A spheroid that rolls end over end goes faster and slower: there the way after a second is compared with the
equation of rolling, from the conservation of energy, integrated to high order.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

import dano
from benchmarks._measure import Row
from benchmarks.contact import _mujoco
from benchmarks.contact._scenes import Geometry, GRAVITY, LOSSLESS, Motion, on_floor, play, STEPS

GROUP = "Rolling for 1 s without loss (restitution 1, hysteresis 0)"
DEFAULTS = "Rolling for 1 s with default parameters"
SECONDS = 1.0
FRICTION = 0.5
FINE = 0.1
"""Turn in a step [rad] up to which a step should show a round body as round."""
TARGETS = (1.0, 5.0)
"""Change of speed [%] that is allowed up to that turn, and beyond it."""
SPREAD = 1.0
"""Largest difference between timesteps of the loss at default parameters [% of the speed at the start]."""
RATES = (10.0, 50.0)
"""Spin [rad/s]."""
SIDEWAYS = (0.5**0.5, -(0.5**0.5), 0.0, 0.0)
"""Orientation wxyz that turns the z axis of a body into the y axis of the world."""


class Roller(NamedTuple):
    """A body of revolution whose axis lies level.

    Attributes:
        name: For the table.
        geometry: Its axis is z.
        radius: Of the circle it rolls on [m].
    """

    name: str
    geometry: Geometry
    radius: float


ROLLERS = (
    Roller("ball", dano.Sphere(0.03), 0.03),
    Roller("cylinder", dano.Cylinder(0.03, 0.03), 0.03),
    Roller("long spheroid about its axis", dano.Ellipsoid((0.03, 0.03, 0.045)), 0.03),
)
SPHEROID = (0.03, 0.03, 0.036)
"""Semi-axes [m] of what rolls end over end."""


def rows(*, quick: bool) -> list[Row]:
    steps = STEPS[::2] if quick else STEPS
    rollers = ROLLERS[:2] if quick else ROLLERS
    found = [row for roller in rollers for rate in RATES for row in _lossless(roller, rate, steps)]
    found += [] if quick else _end_over_end(steps)
    found += _mujoco.rolling_rows(GROUP, RATES, steps)
    return found + [_default(roller, rate, steps) for roller in rollers for rate in RATES]


def _lossless(roller: Roller, rate: float, steps: tuple[float, ...]) -> list[Row]:
    kept = {h: _kept(roller, rate, h, LOSSLESS) for h in steps}
    name = f"{roller.name}, {rate:g} rad/s, largest change of speed"
    return _by_turn(name, kept, rate, {h: 100 * abs(share - 1) for h, share in kept.items()})


def _by_turn(name: str, kept: dict[float, float], rate: float, change: dict[float, float]) -> list[Row]:
    """Two rows: up to `FINE` radians a step, and beyond."""
    # A turn of exactly 0.1 rad in a step is still fine.
    fine = [h for h in change if rate * h <= FINE * (1 + 1e-9)]
    found = []
    for words, chosen, target in (
        (f"≤ {FINE:g} rad a step", fine, TARGETS[0]),
        ("beyond", [h for h in change if h not in fine], TARGETS[1]),
    ):
        if chosen:
            note = "kept: " + ", ".join(f"{1000 * h:g} ms {kept[h]:.3f}" for h in chosen)
            worst = float(np.max([change[h] for h in chosen]))
            found.append(Row(GROUP, f"{name}, {words}", worst, "%", target, note=note))
    return found


def _default(roller: Roller, rate: float, steps: tuple[float, ...]) -> Row:
    kept = {h: _kept(roller, rate, h, {}) for h in steps}
    spread = 100 * float(np.ptp(list(kept.values())))
    note = "kept: " + ", ".join(f"{1000 * h:g} ms {share:.3f}" for h, share in kept.items())
    name = f"{roller.name}, {rate:g} rad/s, difference between timesteps"
    return Row(DEFAULTS, name, spread, "%", SPREAD, note=note)


def _kept(roller: Roller, rate: float, timestep: float, params: dict[str, Any]) -> float:
    """Share of the speed after a second, as the mean over its last tenth."""
    scene = on_floor(roller.geometry, timestep, sliding_friction=FRICTION, **params)
    start = {
        "position": (0, 0, roller.radius),
        "orientation": SIDEWAYS,
        "velocity": (rate * roller.radius, 0, 0),
        "omega": (0, 0, rate),  # about the axis of the body, which points along y
    }
    motion = play(scene, SECONDS, body=start)
    return _speed(motion) / (rate * roller.radius)


def _speed(motion: Motion) -> float:
    """Along x over the last tenth [m/s]."""
    first = int(0.9 * len(motion.times))
    way = motion.position[-1, 0, 0] - motion.position[first, 0, 0]
    return float(way / (motion.times[-1] - motion.times[first]))


def _end_over_end(steps: tuple[float, ...]) -> list[Row]:
    rate = 10.0
    truth = _rolling_way(rate)
    kept = {h: _tumbled_way(rate, h) / truth for h in steps}
    change = {h: 100 * abs(share - 1) for h, share in kept.items()}
    return _by_turn("spheroid end over end, 10 rad/s, error of the way", kept, rate, change)


def _tumbled_way(rate: float, timestep: float) -> float:
    """Way after a second [m] of a spheroid that starts on its equator, its axis level along x."""
    short, long = SPHEROID[0], SPHEROID[2]
    scene = on_floor(dano.Ellipsoid(SPHEROID), timestep, sliding_friction=FRICTION, **LOSSLESS)
    start = {
        "position": (0, 0, short),
        "orientation": (0.5**0.5, 0, 0.5**0.5, 0),  # z axis of the body along x
        "velocity": (rate * short, 0, 0),
        "omega": (0, rate, 0),
    }
    assert long > short
    return float(play(scene, SECONDS, body=start).position[-1, 0, 0])


def _rolling_way(rate: float) -> float:
    """The same by the equation of rolling.

    With the angle α that it has turned, the centre is h(α) = √(a² cos² α + b² sin² α) above the plane (a the
    semi-axis that is upright at the start, b the level one), the contact lies h′(α) beside it, and without
    slip the centre moves along by dx = h dα and up by dh = h′ dα. So with the squared arm s² = h² + h′²

        (I + m s²) α̇²/2 + m g h = const,    (I + m s²) α̈ + m s s′ α̇² + m g h′ = 0.
    """
    a, b = SPHEROID[0], SPHEROID[2]
    inertia = (a**2 + b**2) / 5  # of the solid, per mass, about the level short axis

    def slopes(_: float, y: np.ndarray) -> list[float]:
        angle, speed, _ = y
        k = b**2 - a**2
        h = np.sqrt(a**2 + k * np.sin(angle) ** 2)
        dh = k * np.sin(2 * angle) / (2 * h)
        ddh = k * np.cos(2 * angle) / h - dh**2 / h
        pull = (h * dh + dh * ddh) * speed**2 + GRAVITY * dh
        return [speed, -pull / (inertia + h**2 + dh**2), h * speed]

    solution = solve_ivp(slopes, (0, SECONDS), [0.0, rate, 0.0], method="DOP853", rtol=1e-10, atol=1e-12)
    return float(solution.y[2, -1])
