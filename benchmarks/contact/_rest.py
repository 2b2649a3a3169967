"""Rest: how fast things creep on a slope that friction holds, and how still they lie on a level floor."""

import numpy as np

import dano
from benchmarks._measure import Row
from benchmarks.contact import _mujoco
from benchmarks.contact._scenes import Geometry, GRAVITY, milliseconds, Motion, on_floor, play
from dano.scene_file import load_asset

SLOPE = "Creep on a slope of 0.9 times the friction angle"
STILL = "Rest on a level floor"
FRICTION = 0.3
STEEP = 0.9
"""Angle of the slope over the friction angle atan μ."""
TIMESTEPS = (1 / 60, 0.01, 0.001)  # [s]
SETTLE, WATCHED = 3.0, 1.0  # [s]
CREEP_TARGET = 1e-7  # [m/s]
STILL_TARGET = 1e-6
"""Fastest point of a body that lies still [m/s]: a tenth of a millimetre in a minute and a half."""


def rows(*, quick: bool) -> list[Row]:
    things: dict[str, tuple[Geometry, float]] = {"box": (dano.Box((0.05, 0.04, 0.03)), 0.03)}
    if not quick:
        bunny, soap = load_asset("bunny"), load_asset("soap")
        things["bunny"] = (bunny, _upright(bunny))
        things["soap"] = (soap, _upright(soap))
    steps = TIMESTEPS[1:2] if quick else TIMESTEPS
    found = [_creep(name, *thing, h) for name, thing in things.items() for h in steps]
    angle = STEEP * float(np.arctan(FRICTION))
    found += [_mujoco.creep_row(SLOPE, FRICTION, angle, h) for h in steps]
    return found + [_still(name, *thing, h) for name, thing in things.items() for h in steps]


def _upright(thing: dano.NeuralObject) -> float:
    """Height of the centre of mass above the lowest point [m]."""
    return float(thing.mass.com[2] - np.asarray(thing.surface.points)[:, 2].min())


def _creep(name: str, geometry: Geometry, height: float, timestep: float) -> Row:
    """The floor stays level and gravity leans."""
    angle = np.arctan(FRICTION) * STEEP
    gravity = (GRAVITY * float(np.sin(angle)), 0.0, -GRAVITY * float(np.cos(angle)))
    scene = on_floor(geometry, timestep, gravity=gravity, sliding_friction=FRICTION)
    motion = play(scene, SETTLE + WATCHED, body={"position": (0, 0, height)})
    first = round(SETTLE / timestep)
    way = motion.position[-1, 0] - motion.position[first, 0]
    speed = float(np.linalg.norm(way) / (motion.times[-1] - motion.times[first]))
    return Row(SLOPE, f"{name}, {milliseconds(timestep)}", speed, "m/s", CREEP_TARGET, note=motion.said)


def _still(name: str, geometry: Geometry, height: float, timestep: float) -> Row:
    """Set down from 5 mm, slightly tilted."""
    start = {"position": (0, 0, height + 0.005), "orientation": (1, 0.02, 0.01, 0)}
    scene = on_floor(geometry, timestep, sliding_friction=FRICTION)
    motion = play(scene, SETTLE + WATCHED, body=start)
    speed = _fastest(motion, round(SETTLE / timestep), height)
    return Row(STILL, f"{name}, {milliseconds(timestep)}", speed, "m/s", STILL_TARGET, note=motion.said)


def _fastest(motion: Motion, first: int, reach: float) -> float:
    """Of any point of the body since a step [m/s], from the speeds of its centre and of its turning."""
    speed = np.linalg.norm(motion.velocity[first:, 0], axis=1)
    return float((speed + reach * np.linalg.norm(motion.omega[first:, 0], axis=1)).max())
