"""How deep bodies get into each other, at rest and at impact, over the size of the smaller one.

Depths come from the shapes alone (`benchmarks.robust._shapes`), not from the engine.
"""

from typing import Any

import numpy as np

import dano
from benchmarks._measure import Row
from benchmarks.contact import _mujoco
from benchmarks.contact._scenes import Motion, on_floor, play, scene_of, STEPS
from benchmarks.robust._draw import Piece
from benchmarks.robust._judge import floor_depth, pair_depth
from benchmarks.robust._shapes import geometry, Probe, probe

REST = "Depth at rest, default parameters"
IMPACT = "Depth at impact, default parameters"
WALL = "A fixed wall of 2 mm and a ball of 4 cm at 10 m/s"
REST_TARGET, IMPACT_TARGET = 0.5, 5.0  # [% of the size of the smaller body]
TIMESTEP = 0.005  # [s], for rest
SETTLE = 2.0  # [s]
SPEEDS = (1.0, 10.0)  # [m/s]
HEAVY = 1000.0
"""Mass of the upper body over that of the lower one."""
PILE = 20

PIECES = {
    "ball": Piece("a", "sphere", (0.05,)),
    "box": Piece("a", "box", (0.05, 0.04, 0.03)),
    "plate": Piece("a", "plate", (0.05, 0.05, 0.002)),
    "capsule": Piece("a", "capsule", (0.02, 0.04)),
    "cylinder": Piece("a", "cylinder", (0.03, 0.04)),
    "ellipsoid": Piece("a", "ellipsoid", (0.05, 0.04, 0.03)),
    "bunny": Piece("a", "bunny", ()),
    "soap": Piece("a", "soap", ()),
}
_QUICK = ("ball", "box")


def rows(*, quick: bool) -> list[Row]:
    names = _QUICK if quick else tuple(PIECES)
    steps = STEPS[::2] if quick else STEPS
    found = [_rest(name) for name in names]
    found += [_under_heavy(name) for name in ("box",)]
    found += [_impact(name, speed, steps) for name in names for speed in SPEEDS]
    found += _mujoco.impact_rows(IMPACT, SPEEDS, steps)
    phases = 2 if quick else 16
    found += [_wall(h, phases) for h in steps]
    return found + [_mujoco.wall_row(WALL, h, phases) for h in steps]


def pile_rows(*, quick: bool) -> list[Row]:
    """A pile of mixed shapes at rest, all pairs of which may touch."""
    n = 6 if quick else PILE
    kinds = [PIECES[name] for name in ("ball", "box", "capsule", "cylinder", "ellipsoid")]
    pieces = [kinds[i % len(kinds)] for i in range(n)]
    bodies = [dano.Body(f"b{i}", geometry(piece), mass=1.0) for i, piece in enumerate(pieces)]
    bodies.append(dano.Body("floor", dano.HalfSpace(), fixed=True))
    material = dano.ContactParams(sliding_friction=0.3)
    scene = dano.Scene.create(bodies, others=material, timestep=TIMESTEP)
    # Layers of two, each turned at random and with room for every rotation.
    random = np.random.default_rng(0)
    room = 1.05 * max(piece.radius for piece in pieces)
    starts: dict[str, dict[str, Any]] = {
        f"b{i}": {
            "position": (room * (-1) ** i, 0.3 * room * random.uniform(-1, 1), room * (1 + 2 * (i // 2))),
            "orientation": random.normal(size=4),
        }
        for i in range(n)
    }
    motion = play(scene, 1.5 if quick else 4.0, **starts)
    probes = [probe(piece) for piece in pieces]
    name = f"{n} mixed shapes in a pile"
    speed = np.linalg.norm(motion.velocity[-1, :n], axis=1).max()
    note = "; ".join(filter(None, (f"fastest {speed:.1e} m/s", motion.said)))
    at_end = 100 * _deepest(motion, probes, slice(-1, None))
    over_all = 100 * _deepest(motion, probes, slice(None))
    return [
        Row(REST, name, at_end, "% of size", REST_TARGET, note=note),
        Row(IMPACT, f"{name}, while it falls", over_all, "% of size", IMPACT_TARGET),
    ]


def _rest(name: str) -> Row:
    """Set down slightly tilted on a floor, left to come to rest."""
    piece = PIECES[name]
    scene = on_floor(geometry(piece), TIMESTEP, sliding_friction=0.3)
    start = {"position": (0, 0, piece.radius), "orientation": (1, 0.05, 0.03, 0)}
    motion = play(scene, SETTLE, body=start)
    depth = 100 * _deepest(motion, [probe(piece)], slice(-1, None))
    return Row(REST, f"{name} on a floor", depth, "% of size", REST_TARGET, note=motion.said)


def _under_heavy(name: str) -> Row:
    """On a floor, under a body of the same shape and `HEAVY` times its mass."""
    piece = PIECES[name]
    shape = geometry(piece)
    bodies = [
        dano.Body("light", shape, mass=1.0),
        dano.Body("heavy", shape, mass=HEAVY),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    scene = scene_of(bodies, [("light", "floor"), ("heavy", "light"), ("heavy", "floor")], TIMESTEP)
    half = piece.lengths[2]
    motion = play(
        scene, SETTLE, light={"position": (0, 0, half)}, heavy={"position": (0.003, 0.002, 3 * half + 0.001)}
    )
    depth = 100 * _deepest(motion, [probe(piece)] * 2, slice(-1, None))
    upper = motion.position[-1, 1, 2] - motion.position[-1, 0, 2]
    note = motion.said if abs(upper / (2 * half) - 1) < 0.2 else "the upper one fell off or in"
    words = f"{name} under one {HEAVY:g} times as heavy"
    return Row(REST, words, depth, "% of size", REST_TARGET, note=note)


def _impact(name: str, speed: float, steps: tuple[float, ...]) -> Row:
    """Thrown at a floor, level and turned; the deepest of all timesteps."""
    piece, found = PIECES[name], []
    body = probe(piece)
    for h in steps:
        scene = on_floor(geometry(piece), h)
        deepest = 0.0
        for turn in ((1.0, 0.0, 0.0, 0.0), (0.85, 0.35, 0.3, 0.1)):
            start = {
                "position": (0, 0, piece.radius + 1.3 * h * speed),
                "orientation": turn,
                "velocity": (0, 0, -speed),
            }
            motion = play(scene, max(0.1, 50 * h), body=start)
            deepest = float(np.maximum(deepest, _deepest(motion, [body], slice(None))))
        found.append(100 * deepest)
    note = ", ".join(f"{1000 * h:g} ms {depth:.2g}" for h, depth in zip(steps, found, strict=True))
    words = f"{name} at {speed:g} m/s, to a step of {1000 * max(steps):g} ms"
    return Row(IMPACT, words, float(np.max(found)), "% of size", IMPACT_TARGET, note=note)


def _wall(timestep: float, phases: int) -> Row:
    """How often the ball gets through, from starts that differ by shares of a step."""
    speed, radius, half = 10.0, 0.02, 0.001
    bodies = [
        dano.Body("ball", dano.Sphere(radius), mass=0.03),
        dano.Body("wall", dano.Box((half, 0.5, 0.5)), fixed=True),
    ]
    scene = scene_of(bodies, [("ball", "wall")], timestep, gravity=(0, 0, 0))
    through, deepest = 0, 0.0
    for phase in np.arange(phases) / phases:
        x = -(half + radius + (1 + phase) * speed * timestep)
        motion = play(scene, 0.3, ball={"position": (x, 0.013, 0.007), "velocity": (speed, 0, 0)})
        # What is not a number did not come back either.
        through += not bool(motion.position[-1, 0, 0] < 0)
        deepest = max(deepest, float(motion.position[:, 0, 0].max()) + radius + half)
    note = f"of {phases} throws; foremost point at most {1000 * deepest:.3g} mm past its face"
    return Row(WALL, f"balls that get through, {1000 * timestep:g} ms", float(through), "", 0.0, note=note)


def _deepest(motion: Motion, probes: list[Probe], when: slice) -> float:
    """Deepest overlap with the floor or each other in some states, over the size of the smaller body."""
    deepest = 0.0
    poses = [(motion.position[when, i], motion.rotation[when, i]) for i in range(len(probes))]
    for i, a in enumerate(probes):
        if not np.isfinite(poses[i][0]).all():
            return float("nan")
        deepest = max(deepest, float(floor_depth(a, *poses[i]).max()) / a.size)
        for j, b in enumerate(probes):
            if j != i:
                depth = pair_depth(a, b, poses[i], poses[j])
                deepest = max(deepest, float(depth.max()) / min(a.size, b.size))
    return deepest
