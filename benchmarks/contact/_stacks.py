"""Stacks: ten boxes that stand, and a house of two cards that stands or falls by its friction."""

import numpy as np

import dano
from benchmarks._measure import Row
from benchmarks.contact import _mujoco
from benchmarks.contact._scenes import Motion, play, scene_of

GROUP = "Stacks"
TIMESTEP = 0.005  # [s]
BOX = 0.05
"""Half side length of a box [m]."""
DRIFT_TARGET = 1.0
"""Of a box in a standing stack, sideways or down [mm]."""
STILL_TARGET = 1e-4
"""Speed in a standing stack [m/s]: 6 mm in the minute that it stands."""
STANDING, FALLEN = 0.95, 0.5
"""Height of a card's middle over that at the start, at least if it stands, at most if it fell."""

CARD = (0.002, 0.03, 0.05)
"""Half extents [m]: 4 mm thick with round edges, so that where two edges meet has one normal."""
ROUNDING = 0.0019  # [m]
LEAN = np.radians(30.0)
"""From the vertical.

The cards push each other with a horizontal force H at the top, and the floor returns m g and H at each foot.
Moments about a foot give H = m g tan(lean)/2, so the house stands if μ ≥ tan(lean)/2 = 0.29.
"""


def rows(*, quick: bool) -> list[Row]:
    n, seconds = (3, 2.0) if quick else (10, 60.0)
    return [*_boxes(n, seconds), *_cards(0.6, stands=True), *_cards(0.2, stands=False)]


def _boxes(n: int, seconds: float) -> list[Row]:
    bodies = [dano.Body(f"b{i}", dano.Box((BOX,) * 3), mass=1.0) for i in range(n)]
    bodies.append(dano.Body("floor", dano.HalfSpace(), fixed=True))
    pairs = [("b0", "floor"), *((f"b{i + 1}", f"b{i}") for i in range(n - 1))]
    scene = scene_of(bodies, pairs, TIMESTEP, sliding_friction=0.5)
    # Set down askew by up to 2 mm, as a hand would.
    random = np.random.default_rng(0)
    places = [(*random.uniform(-0.002, 0.002, 2), BOX * (2 * i + 1)) for i in range(n)]
    motion = play(scene, seconds, **{f"b{i}": {"position": place} for i, place in enumerate(places)})
    moved = 1000 * np.linalg.norm(motion.position[-1, :n] - motion.position[0, :n], axis=1)
    still = np.linalg.norm(motion.velocity[-1, :n], axis=1).max()
    name = f"{n} boxes, {seconds:g} s"
    return [
        Row(
            GROUP,
            f"{name}: way of the box that moved most",
            moved.max(),
            "mm",
            DRIFT_TARGET,
            note=motion.said,
        ),
        Row(GROUP, f"{name}: fastest box at the end", float(still), "m/s", STILL_TARGET),
        _mujoco.stack_row(GROUP, places, BOX, seconds),
    ]


def _cards(friction: float, *, stands: bool) -> list[Row]:
    shape = dano.Box(CARD, ROUNDING)
    bodies = [dano.Body(name, shape, mass=0.02) for name in ("left", "right")]
    bodies.append(dano.Body("floor", dano.HalfSpace(), fixed=True))
    pairs = [("left", "right"), ("left", "floor"), ("right", "floor")]
    scene = scene_of(bodies, pairs, TIMESTEP, sliding_friction=friction)
    # Centres of the round edges lie on a rectangle; the outermost and the lowest point lie a radius beyond.
    across, along = CARD[0] - ROUNDING, CARD[2] - ROUNDING
    out = along * np.sin(LEAN) + across * np.cos(LEAN) + ROUNDING
    up = along * np.cos(LEAN) + across * np.sin(LEAN) + ROUNDING
    half = 0.5 * LEAN
    motion = play(
        scene,
        3.0,
        left={"position": (-out, 0, up), "orientation": (np.cos(half), 0, np.sin(half), 0)},
        right={"position": (out, 0, up), "orientation": (np.cos(half), 0, -np.sin(half), 0)},
    )
    height = _height(motion)
    name = f"card house at 30°, μ = {friction:g}: height left of it, {'stands' if stands else 'falls'}"
    return [Row(GROUP, name, height, "×", STANDING if stands else FALLEN, at_least=stands, note=motion.said)]


def _height(motion: Motion) -> float:
    """Of the lower card's middle after over before."""
    return float((motion.position[-1, :2, 2] / motion.position[0, :2, 2]).min())
