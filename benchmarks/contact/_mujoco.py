"""MuJoCo's side of what both engines can do, at its default options: rows without a target, to compare.

It has no coefficient of restitution, so that part has no counterpart.
"""

import importlib.util
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

import dano
from benchmarks._measure import Row, skipped
from benchmarks._mujoco import at_defaults, World
from benchmarks.contact._scenes import Geometry, GRAVITY


def installed() -> bool:
    """Whether MuJoCo can be imported."""
    return importlib.util.find_spec("mujoco") is not None


def missing(group: str) -> list[Row]:
    """The row that says that it cannot."""
    return [skipped(group, "MuJoCo", "not installed: pip install 'dano[mujoco]'")]


def world_of(
    geometries: Sequence[Geometry],
    timestep: float,
    *,
    mass: float = 1.0,
    friction: float = 0.2,
    fixed: dano.AbstractShape | None = None,
    gravity: tuple[float, float, float] = (0.0, 0.0, -GRAVITY),
) -> World:
    """Bodies b0, b1, … above a plane unless something else is fixed; all of them may touch."""
    bodies = [dano.Body(f"b{i}", shape, mass=mass) for i, shape in enumerate(geometries)]
    bodies.append(dano.Body("fixed", dano.HalfSpace() if fixed is None else fixed, fixed=True))
    material = dano.ContactParams(sliding_friction=friction)
    with warnings.catch_warnings():
        # That these steps are long for dano's contact is not MuJoCo's business.
        warnings.simplefilter("ignore")
        scene = dano.Scene.create(bodies, others=material, timestep=timestep, gravity=gravity)
    return World(scene, options=at_defaults())


def rolling_rows(group: str, rates: Sequence[float], steps: Sequence[float]) -> list[Row]:
    """Largest change of a ball's speed in a second, of all timesteps."""
    if not installed():
        return missing(group)
    found, radius = [], 0.03
    worlds = {h: world_of([dano.Sphere(radius)], h, friction=0.5) for h in steps}
    for rate in rates:
        kept = {}
        start = {"position": (0, 0, radius), "velocity": (rate * radius, 0, 0), "omega": (0, rate, 0)}
        for h, world in worlds.items():
            x = world.play(1.0, b0=start)[:, 0, 0]
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
    worlds = {h: world_of([dano.Sphere(radius)], h) for h in steps}
    for speed in speeds:
        depths = []
        for h, world in worlds.items():
            start = {"position": (0, 0, radius + 1.3 * h * speed), "velocity": (0, 0, -speed)}
            z = world.play(max(0.1, 50 * h), b0=start)[:, 0, 2]
            depths.append(100 * (radius - z.min()) / (2 * radius))
        note = ", ".join(f"{1000 * h:g} ms {depth:.2g}" for h, depth in zip(steps, depths, strict=True))
        found.append(Row(group, f"MuJoCo: ball at {speed:g} m/s", max(depths), "% of size", note=note))
    return found


def wall_row(group: str, timestep: float, phases: int) -> Row:
    """How many balls of 4 cm at 10 m/s get through a wall of 2 mm."""
    speed, radius, half = 10.0, 0.02, 0.001
    if not installed():
        return missing(group)[0]
    wall = dano.Box((half, 0.5, 0.5))
    world = world_of([dano.Sphere(radius)], timestep, mass=0.03, fixed=wall, gravity=(0.0, 0.0, 0.0))
    through = 0
    for phase in np.arange(phases) / phases:
        x = -(half + radius + (1 + phase) * speed * timestep)
        start = {"position": (x, 0.013, 0.007), "velocity": (speed, 0, 0)}
        through += bool(world.play(0.3, b0=start)[-1, 0, 0] > 0)
    name = f"MuJoCo: balls that get through, {1000 * timestep:g} ms"
    return Row(group, name, float(through), "", note=f"of {phases} throws")


def creep_row(group: str, friction: float, angle: float, timestep: float) -> Row:
    """Speed of a box on a slope [m/s]."""
    if not installed():
        return missing(group)[0]
    gravity = (GRAVITY * float(np.sin(angle)), 0.0, -GRAVITY * float(np.cos(angle)))
    world = world_of([dano.Box((0.05, 0.04, 0.03))], timestep, friction=friction, gravity=gravity)
    places = world.play(4.0, b0={"position": (0, 0, 0.03)})[:, 0, :3]
    first = round(3.0 / timestep)
    speed = np.linalg.norm(places[-1] - places[first]) / ((len(places) - 1 - first) * timestep)
    return Row(group, f"MuJoCo: box, {1000 * timestep:.3g} ms", float(speed), "m/s")


def stack_row(group: str, places: Sequence[Sequence[float]], half: float, seconds: float) -> Row:
    """Way of the box in a stack that moved most [mm]."""
    if not installed():
        return missing(group)[0]
    world = world_of([dano.Box((half,) * 3)] * len(places), 0.005, friction=0.5)
    starts = {f"b{i}": {"position": place} for i, place in enumerate(places)}
    moved = world.play(seconds, **starts)[:, :, :3]
    way = 1000 * np.linalg.norm(moved[-1] - moved[0], axis=1).max()
    name = f"MuJoCo: {len(places)} boxes, {seconds:g} s: way of the box that moved most"
    return Row(group, name, float(way), "mm")


def domino_directions(
    scene: dano.Scene, starts: dict[str, dict[str, Any]], solref: float, seconds: float
) -> np.ndarray:
    """Z components of the bodies' own z axes after each step, shape (t, n): stiff contacts, elliptic cones.

    Args:
        scene: Bodies, the fixed ones last.
        starts: Their states.
        solref: Time constant of contacts [s].
        seconds: To play.
    """
    import mujoco

    world = World(scene, options=at_defaults(cone=mujoco.mjtCone.mjCONE_ELLIPTIC))
    model, data = world.engine.model, world.data(**starts)
    model.pair_solref[:] = solref, 1.0
    # Without friction there is one direction of force, not three.
    model.pair_dim[model.pair_friction[:, 0] < 1e-4] = 1
    n, upward = len(starts), []
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
        upward.append(data.xmat[1 : n + 1, 8].copy())
    return np.array(upward)
