"""The speed of a row of falling dominoes against a rigid-body theory and against MuJoCo.

Theory: J. M. J. van Leeuwen, "The domino effect", Am. J. Phys. 78, 721 (2010), equations for the tilt of the
leaning train; the same assumptions as in W. J. Stronge and D. Shu, "The domino effect: successive
destabilization by cooperative neighbours", Proc. R. Soc. Lond. A 418, 155 (1988): feet do not slip, impacts
are plastic, and all that fell lean on each other. Without friction between dominoes it is a system with one
degree of freedom, integrated here. The scene has the same: friction 2 below the feet, none between dominoes.
"""

import importlib.util
from typing import Any

import numpy as np

import dano
from benchmarks._measure import Row, skipped
from benchmarks.contact._mujoco import domino_directions
from benchmarks.contact._scenes import GRAVITY, play

GROUP = "Twenty dominoes: speed of the wave"
N = 20
HEIGHT, THICKNESS, WIDTH = 0.048, 0.0075, 0.024  # [m], those of a common set
GAP = 0.02  # [m]
MASS = 0.01  # [kg]
FOOT_FRICTION = 2.0
START = 0.2
"""Tilt of the first one [rad]: beyond its edge, which is at atan(d/h) = 0.155, and short of the second."""
PASSED = 0.05
"""Tilt [rad] at which the wave has reached a domino."""
FIRST, LAST = 8, 18
"""Dominoes between which the speed is taken: it has settled, and the end is not felt."""
TIMESTEPS = (0.001, 0.002, 0.005)  # [s]
MUJOCO_TIMESTEP, MUJOCO_SOLREF = 0.0005, 0.002
"""MuJoCo's [s]: contacts with its default time constant of 20 ms are soft for a domino of 70 ms."""
SECONDS = 1.5
TARGET = 5.0  # [%]

_PITCH = GAP + THICKNESS


def rows(*, quick: bool) -> list[Row]:
    n, first, last = (6, 2, 4) if quick else (N, FIRST, LAST)
    theory = _speed(_theory_times(n), first, last)
    found = [Row(GROUP, "theory (van Leeuwen 2010, without friction between dominoes)", theory, "m/s")]
    references = {"theory": theory}
    if importlib.util.find_spec("mujoco") is None:
        found.append(skipped(GROUP, "MuJoCo", "not installed: pip install 'dano[mujoco]'"))
    else:
        references["MuJoCo"] = _speed(_mujoco_times(n), first, last)
        words = f"MuJoCo, {1000 * MUJOCO_TIMESTEP:g} ms, solref {MUJOCO_SOLREF:g} s"
        found.append(Row(GROUP, words, references["MuJoCo"], "m/s"))
    for h in TIMESTEPS[::2] if quick else TIMESTEPS:
        times, said = _dano_times(n, h)
        speed = _speed(times, first, last)
        found.append(Row(GROUP, f"dano, {1000 * h:g} ms", speed, "m/s", note=said))
        for name, reference in references.items():
            off = 100 * abs(speed / reference - 1)
            found.append(Row(GROUP, f"dano, {1000 * h:g} ms, off {name}", off, "%", TARGET))
    return found


def _speed(times: np.ndarray, first: int, last: int) -> float:
    """Of the wave between two dominoes [m/s]; not a number if it did not get there."""
    return float((last - first) * _PITCH / (times[last] - times[first]))


def _theory_times(n: int, points: int = 2000) -> np.ndarray:
    """When the tilt of each domino passes `PASSED` [s], shape (n,); the clock starts at the first impact."""
    touch = np.arcsin(GAP / HEIGHT)
    energy = _potential(np.array([START]))
    times, clock = np.full(n, np.nan), 0.0
    for head in range(n):
        if head > 0:
            # Plastic impact on an upright domino: what moves keeps its momentum along the new motion.
            tilts, rates = _train(touch, head - 1)
            squared = (rates**2).sum()
            before = 2 * (energy - _potential(tilts)) / (_inertia() * squared)
            after = np.sqrt(before) * squared / (squared + 1)
            energy = 0.5 * _inertia() * (squared + 1) * after**2 + _potential(np.append(tilts, 0.0))
        grid = np.linspace(START if head == 0 else 0.0, touch, points)
        speeds = np.array([_head_speed(angle, head, energy) for angle in grid])
        if head == 0:
            continue  # it starts from rest, before the clock
        spent = np.concatenate([[0.0], np.cumsum(np.diff(grid) * 2 / (speeds[1:] + speeds[:-1]))])
        times[head] = clock + np.interp(PASSED, grid, spent)
        clock += spent[-1]
    return times


def _train(angle: float, head: int) -> tuple[np.ndarray, np.ndarray]:
    """Tilts of the dominoes 0 to `head`, and their rates over that of the head, whose tilt is given.

    The corner of the one behind leans on the back of the next:
    h sin(θ_{i−1} − θ_i) = (s + d) cos θ_i − d, for the height h, the gap s and the thickness d.
    """
    tilts, rates = np.empty(head + 1), np.empty(head + 1)
    tilts[head], rates[head] = angle, 1.0
    for i in range(head, 0, -1):
        more = np.arcsin((_PITCH * np.cos(tilts[i]) - THICKNESS) / HEIGHT)
        tilts[i - 1] = tilts[i] + more
        rates[i - 1] = rates[i] * (1 - _PITCH * np.sin(tilts[i]) / (HEIGHT * np.cos(more)))
    return tilts, rates


def _head_speed(angle: float, head: int, energy: float) -> float:
    """Of the head's tilt [rad/s], from the conservation of energy."""
    tilts, rates = _train(angle, head)
    return float(np.sqrt(max(2 * (energy - _potential(tilts)) / (_inertia() * (rates**2).sum()), 0.0)))


def _potential(tilts: np.ndarray) -> float:
    """Of dominoes on their front edges, per mass [J/kg]; upright ones ahead do not count."""
    return float(0.5 * GRAVITY * (HEIGHT * np.cos(tilts) + THICKNESS * np.sin(tilts)).sum())


def _inertia() -> float:
    """About the front edge, per mass [m²]."""
    return (HEIGHT**2 + THICKNESS**2) / 3


def _starts(n: int) -> list[tuple[tuple[float, float, float], tuple[float, float, float, float]]]:
    """Positions and orientations of the middles; the row stands along x and falls that way."""
    upright = [((_PITCH * i, 0.0, 0.5 * HEIGHT), (1.0, 0.0, 0.0, 0.0)) for i in range(n)]
    sine, cosine = np.sin(START), np.cos(START)
    # About the front edge at x = d/2.
    x = 0.5 * THICKNESS + 0.5 * (HEIGHT * sine - THICKNESS * cosine)
    z = 0.5 * (HEIGHT * cosine + THICKNESS * sine)
    tilted = ((x, 0.0, z), (np.cos(0.5 * START), 0.0, np.sin(0.5 * START), 0.0))
    return [tilted, *upright[1:]]


def _passing(times: np.ndarray, upward: np.ndarray) -> np.ndarray:
    """When each domino's tilt passes `PASSED` [s], from the z component of its long axis, shape (t, n)."""
    tilt = np.arccos(np.clip(upward, -1, 1))
    found = np.full(tilt.shape[1], np.nan)
    for i in range(1, tilt.shape[1]):
        over = np.flatnonzero(tilt[:, i] > PASSED)
        if len(over) and over[0] > 0:
            k = over[0]
            share = (PASSED - tilt[k - 1, i]) / (tilt[k, i] - tilt[k - 1, i])
            found[i] = times[k - 1] + share * (times[k] - times[k - 1])
    return found


def _scene(n: int, timestep: float) -> dano.Scene:
    shape = dano.Box((0.5 * THICKNESS, 0.5 * WIDTH, 0.5 * HEIGHT))
    bodies = [dano.Body(f"d{i}", shape, mass=MASS) for i in range(n)]
    bodies.append(dano.Body("floor", dano.HalfSpace(), fixed=True))
    smooth = dano.ContactParams(sliding_friction=0.0)
    rough = dano.ContactParams(sliding_friction=FOOT_FRICTION)
    law = dano.DistributedLaw()
    contacts = [dano.Contact(f"d{i}", "floor", rough, law=law) for i in range(n)]
    contacts += [dano.Contact(f"d{i}", f"d{i + 1}", smooth, law=law) for i in range(n - 1)]
    return dano.Scene.create(bodies, contacts, timestep=timestep)


def _places(n: int) -> dict[str, dict[str, Any]]:
    return {f"d{i}": {"position": p, "orientation": q} for i, (p, q) in enumerate(_starts(n))}


def _dano_times(n: int, timestep: float) -> tuple[np.ndarray, str]:
    motion = play(_scene(n, timestep), SECONDS, **_places(n))
    return _passing(motion.times, motion.rotation[:, :n, 2, 2]), motion.said


def _mujoco_times(n: int) -> np.ndarray:
    scene = _scene(n, MUJOCO_TIMESTEP)
    upward = domino_directions(scene, _places(n), MUJOCO_SOLREF, SECONDS)
    return _passing(MUJOCO_TIMESTEP * np.arange(1, len(upward) + 1), upward)
