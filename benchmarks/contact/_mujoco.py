"""MuJoCo's side of what both engines can do, at its default options: rows without a target, to compare.

It has no coefficient of restitution, so that part has no counterpart.
"""

import importlib.util
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from benchmarks._measure import Row, skipped
from benchmarks.contact._scenes import GRAVITY


class Geom(NamedTuple):
    """A body of one geom.

    Attributes:
        kind: MuJoCo's type.
        size: Half lengths [m].
        mass: [kg].
        position: [m, W].
        orientation: wxyz, body → world.
        velocity: [m/s, W].
        omega: [rad/s, B].
    """

    kind: str
    size: Sequence[float]
    mass: float
    position: Sequence[float]
    orientation: Sequence[float] = (1.0, 0.0, 0.0, 0.0)
    velocity: Sequence[float] = (0.0, 0.0, 0.0)
    omega: Sequence[float] = (0.0, 0.0, 0.0)


def installed() -> bool:
    """Whether MuJoCo can be imported."""
    return importlib.util.find_spec("mujoco") is not None


def missing(group: str) -> list[Row]:
    """The row that says that it cannot."""
    return [skipped(group, "MuJoCo", "not installed: pip install 'dano[mujoco]'")]


def play(
    bodies: Sequence[Geom],
    timestep: float,
    seconds: float,
    *,
    friction: float = 0.2,
    fixed: str = '<geom type="plane" size="50 50 1" friction="0"/>',
    gravity: Sequence[float] = (0.0, 0.0, -GRAVITY),
) -> np.ndarray:
    """Positions over time [m, W], shape (t, n, 3), above a plane unless something else is fixed.

    The larger friction coefficient of a pair counts.
    """
    import mujoco

    words = "".join(
        f'<body pos="{_words(b.position)}" quat="{_words(b.orientation)}"><freejoint/>'
        f'<geom type="{b.kind}" size="{_words(b.size)}" mass="{b.mass}" friction="{friction}"/></body>'
        for b in bodies
    )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{timestep}" gravity="{_words(gravity)}"/>'
        f"<worldbody>{fixed}{words}</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    data.qvel[:] = np.concatenate([[*b.velocity, *b.omega] for b in bodies])
    places = [data.qpos.copy()]
    for _ in range(round(seconds / timestep)):
        mujoco.mj_step(model, data)
        places.append(data.qpos.copy())
    return np.array(places).reshape(len(places), -1, 7)[:, :, :3]


def rolling_rows(group: str, rates: Sequence[float], steps: Sequence[float]) -> list[Row]:
    """Largest change of a ball's speed in a second, of all timesteps."""
    if not installed():
        return missing(group)
    found, radius = [], 0.03
    for rate in rates:
        kept = {}
        for h in steps:
            start = Geom(
                "sphere",
                [radius],
                1.0,
                (0, 0, radius),
                velocity=(rate * radius, 0, 0),
                omega=(0, rate, 0),
            )
            x = play([start], h, 1.0, friction=0.5)[:, 0, 0]
            first = int(0.9 * len(x))
            kept[h] = (x[-1] - x[first]) / ((len(x) - 1 - first) * h) / (rate * radius)
        note = "kept: " + ", ".join(f"{1000 * h:g} ms {share:.3f}" for h, share in kept.items())
        worst = 100 * max(abs(share - 1) for share in kept.values())
        found.append(
            Row(group, f"MuJoCo: ball, {rate:g} rad/s, largest change of speed", worst, "%", note=note)
        )
    return found


def impact_rows(group: str, speeds: Sequence[float], steps: Sequence[float]) -> list[Row]:
    """Depth of a ball of 10 cm thrown at a floor, over its size."""
    if not installed():
        return missing(group)
    found, radius = [], 0.05
    for speed in speeds:
        depths = []
        for h in steps:
            start = Geom("sphere", [radius], 1.0, (0, 0, radius + 1.3 * h * speed), velocity=(0, 0, -speed))
            z = play([start], h, max(0.1, 50 * h))[:, 0, 2]
            depths.append(100 * (radius - z.min()) / (2 * radius))
        note = ", ".join(f"{1000 * h:g} ms {depth:.2g}" for h, depth in zip(steps, depths, strict=True))
        found.append(Row(group, f"MuJoCo: ball at {speed:g} m/s", max(depths), "% of size", note=note))
    return found


def wall_row(group: str, timestep: float, phases: int) -> Row:
    """How many balls of 4 cm at 10 m/s get through a wall of 2 mm."""
    speed, radius, half = 10.0, 0.02, 0.001
    if not installed():
        return missing(group)[0]
    wall = f'<geom type="box" size="{half} 0.5 0.5" friction="0"/>'
    through = 0
    for phase in np.arange(phases) / phases:
        x = -(half + radius + (1 + phase) * speed * timestep)
        start = Geom("sphere", [radius], 0.03, (x, 0.013, 0.007), velocity=(speed, 0, 0))
        through += bool(play([start], timestep, 0.3, fixed=wall, gravity=(0, 0, 0))[-1, 0, 0] > 0)
    name = f"MuJoCo: balls that get through, {1000 * timestep:g} ms"
    return Row(group, name, float(through), "", note=f"of {phases} throws")


def creep_row(group: str, friction: float, angle: float, timestep: float) -> Row:
    """Speed of a box on a slope [m/s]."""
    if not installed():
        return missing(group)[0]
    gravity = (GRAVITY * np.sin(angle), 0.0, -GRAVITY * np.cos(angle))
    box = Geom("box", (0.05, 0.04, 0.03), 1.0, (0, 0, 0.03))
    places = play([box], timestep, 4.0, friction=friction, gravity=gravity)[:, 0]
    first = round(3.0 / timestep)
    speed = np.linalg.norm(places[-1] - places[first]) / ((len(places) - 1 - first) * timestep)
    return Row(group, f"MuJoCo: box, {1000 * timestep:.3g} ms", float(speed), "m/s")


def stack_row(group: str, places: Sequence[Sequence[float]], half: float, seconds: float) -> Row:
    """Way of the box in a stack that moved most [mm]."""
    if not installed():
        return missing(group)[0]
    boxes = [Geom("box", [half] * 3, 1.0, place) for place in places]
    moved = play(boxes, 0.005, seconds, friction=0.5)
    way = 1000 * np.linalg.norm(moved[-1] - moved[0], axis=1).max()
    name = f"MuJoCo: {len(boxes)} boxes, {seconds:g} s: way of the box that moved most"
    return Row(group, name, float(way), "mm")


def _words(numbers) -> str:
    return " ".join(f"{x:.9g}" for x in numbers)
