"""Bodies that start deep inside each other: they must separate, and not fly.

Users place bodies carelessly. How fast those leave each other is reported beside the speed that a fall from
the size of the body would give, which is what one would forgive.
"""

from typing import Any

import numpy as np

import dano
from benchmarks._measure import Row
from benchmarks.contact._scenes import Geometry, GRAVITY, Motion, on_floor, play, scene_of
from benchmarks.robust._draw import Piece
from benchmarks.robust._judge import floor_depth, pair_depth
from benchmarks.robust._shapes import geometry, Probe, probe

GROUP = "Bodies that start deep inside each other, default parameters"
TIMESTEP = 0.005  # [s]
SECONDS = 1.5
LEFT = 0.5
"""Overlap that may be left [% of size]: that of rest."""

BALL = Piece("a", "sphere", (0.05,))
BOX = Piece("a", "box", (0.05, 0.04, 0.03))
BUNNY = Piece("a", "bunny", ())


def rows(*, quick: bool) -> list[Row]:
    found = [*_in_floor("ball, half in a floor", BALL, 0.0), *_in_floor("box, half in a floor", BOX, 0.0)]
    found += _in_each_other("two balls, a quarter of the size apart", BALL, 0.025)
    if quick:
        return found
    found += _in_floor("bunny, a third in a floor", BUNNY, 0.0)
    found += _in_each_other("two boxes, a quarter of the size apart", BOX, 0.025)
    return found + _in_each_other("two bunnies, a quarter of the size apart", BUNNY, 0.03)


def _in_floor(name: str, piece: Piece, height: float) -> list[Row]:
    """The centre of mass so high above the floor [m]."""
    motion = play(on_floor(geometry(piece), TIMESTEP), SECONDS, body={"position": (0, 0, height)})
    body = probe(piece)
    depth = floor_depth(body, motion.position[-1:, 0], motion.rotation[-1:, 0])[0]
    speed = float(motion.velocity[:, 0, 2].max())
    return _two(name, depth / body.size, speed, body.size, motion)


def _in_each_other(name: str, piece: Piece, distance: float) -> list[Row]:
    """Without gravity, the centres of mass so far apart [m]."""
    shape: Geometry = geometry(piece)
    bodies = [dano.Body(name, shape, mass=1.0) for name in "ab"]
    scene = scene_of(bodies, [("a", "b")], TIMESTEP, gravity=(0, 0, 0))
    starts: dict[str, dict[str, Any]] = {
        "a": {"position": (0, 0, 0)},
        "b": {"position": (distance, 0.2 * distance, 0.1 * distance)},
    }
    motion = play(scene, SECONDS, **starts)
    body = probe(piece)
    apart = np.linalg.norm(motion.velocity[:, 1] - motion.velocity[:, 0], axis=1).max()
    return _two(name, _depth(body, motion) / body.size, float(apart), body.size, motion)


def _depth(body: Probe, motion: Motion) -> float:
    """Overlap of both at the end [m]."""
    poses = [(motion.position[-1:, i], motion.rotation[-1:, i]) for i in range(2)]
    return max(float(pair_depth(body, body, *pair)[0]) for pair in (poses, poses[::-1]))


def _two(name: str, depth: float, speed: float, size: float, motion: Motion) -> list[Row]:
    fall = float(np.sqrt(2 * GRAVITY * size))
    note = motion.said if np.isfinite(motion.position).all() else "states are NOT finite"
    return [
        Row(
            GROUP, f"{name}: overlap left", float(np.maximum(100 * depth, 0.0)), "% of size", LEFT, note=note
        ),
        Row(GROUP, f"{name}: largest separating speed", speed, "m/s", fall),
    ]
