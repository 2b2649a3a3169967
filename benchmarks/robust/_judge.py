"""What went wrong in a motion, from its states alone: the same for every engine."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.robust._draw import Material, Structure, WALL_HEIGHT, WALL_WIDTH
from benchmarks.robust._shapes import Probe

GRAVITY = 9.81
SLOW = 0.02
"""A body rests whose fastest point has moved slower than this [m/s] …"""
SLOW_STEPS = 20
"""… for so many steps."""
ROUNDING = 1e-9
"""Share of the energy that 400 steps in float64 may gain by rounding."""


@dataclass(frozen=True)
class Motion:
    """States over time, of the bodies that move.

    Attributes:
        position: Of the centres of mass [m, W], shape (t, n, 3).
        orientation: wxyz, body → world, shape (t, n, 4).
        velocity: [m/s, W], shape (t, n, 3).
        omega: [rad/s, B], shape (t, n, 3).
        inertia: About the centres of mass [kg m², B], shape (n, 3, 3).
    """

    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    omega: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True)
class Findings:
    """What went wrong.

    Attributes:
        broken: Whether a state is not finite.
        fallen: Names of bodies whose centre of mass passed the floor or a wall.
        growth: Energy above what is allowed, over that of the start; ≤ 0 if all is well.
        rest_depth: Deepest overlap of bodies that rest, over the size of the smaller one.
        impact_depth: Deepest overlap of others.
    """

    broken: bool
    fallen: tuple[str, ...]
    growth: float
    rest_depth: float
    impact_depth: float


def judge(
    structure: Structure, material: Material, motion: Motion, probes: Sequence[Probe], walls: Sequence[Probe]
) -> Findings:
    """Look at a motion; depths are skipped where `probes` is empty."""
    finite = np.isfinite(motion.position).all() and np.isfinite(motion.velocity).all()
    finite = finite and np.isfinite(motion.orientation).all() and np.isfinite(motion.omega).all()
    if not finite:
        return Findings(True, (), 0.0, 0.0, 0.0)
    fallen = _fallen(structure, material, motion)
    rest, impact = _depths(structure, motion, probes, walls, fallen) if probes else (0.0, 0.0)
    return Findings(False, fallen, energy_growth(material, motion), rest, impact)


def energy_growth(material: Material, motion: Motion) -> float:
    """Largest energy above what is allowed, over that of the start (kinetic, and potential above the floor).

    A contact with restitution ≤ 1 and friction only takes, and what it stores is not counted here. But a
    position belongs to the end of a step and a velocity to its middle: in free fall m(v²/2 + g z) is short
    by m g h v_z/2 of what it will be later, with either sign, and an impact within a step happens where the
    body was at one of the step's ends. Together that is at most the work of gravity over the way of one
    step, m g h |v|, for each body, with |v| its largest speed so far. Beyond it there is rounding.
    """
    speed = np.linalg.norm(motion.velocity, axis=2)
    spinning = 0.5 * np.einsum("tni,nij,tnj->tn", motion.omega, motion.inertia, motion.omega)
    energy = 0.5 * material.masses * speed**2 + spinning + material.masses * GRAVITY * motion.position[..., 2]
    total = energy.sum(axis=1)
    step = GRAVITY * material.timestep
    allowed = (material.masses * step * (np.maximum.accumulate(speed, axis=0) + step)).sum(axis=1)
    excess = total - total[0] - allowed - ROUNDING * abs(total[0])
    return float(excess.max() / abs(total[0]))


def _fallen(structure: Structure, material: Material, motion: Motion) -> tuple[str, ...]:
    """Bodies whose centre passed something thicker than half their way in a step, however far they got.

    A floor has no other side: there, what counts is a body wholly below it, or a centre below it at the end,
    for the centre of a thin plate lies no higher than an impact is deep.
    """
    names = []
    for i, piece in enumerate(structure.pieces):
        position, velocity = motion.position[:, i], motion.velocity[:, i]
        if position[-1, 2] < 0 or position[:, 2].min() < -piece.radius:
            names.append(piece.name)
            continue
        for wall in structure.walls:
            beyond = wall.side * position[:, wall.axis] > wall.distance + wall.thickness
            if not beyond.any():
                continue
            first = int(np.argmax(beyond))
            way = material.timestep * np.abs(velocity[max(first - 1, 0) : first + 1, wall.axis]).max()
            # What flies over a wall, or is about to, or passes beside it, did not pass through it.
            over = position[first, 2] >= WALL_HEIGHT - piece.radius
            beside = abs(position[first, 1 - wall.axis]) >= 0.5 * WALL_WIDTH - piece.radius
            if not over and not beside and wall.thickness >= 0.5 * way:
                names.append(piece.name)
                break
    return tuple(names)


def _depths(
    structure: Structure,
    motion: Motion,
    probes: Sequence[Probe],
    walls: Sequence[Probe],
    fallen: tuple[str, ...],
) -> tuple[float, float]:
    """Deepest overlap at rest and otherwise, over the size of the smaller body; fallen ones are left out."""
    rest = impact = 0.0
    rotation = [matrices(motion.orientation[:, i]) for i in range(len(probes))]
    slow = [_resting(motion, i, probe) for i, probe in enumerate(probes)]

    def note(depth: np.ndarray, resting: np.ndarray, size: float) -> None:
        nonlocal rest, impact
        rest = max(rest, float(depth[resting].max(initial=0.0)) / size)
        impact = max(impact, float(depth[~resting].max(initial=0.0)) / size)

    for i, a in enumerate(probes):
        if structure.pieces[i].name in fallen:
            continue
        note(floor_depth(a, motion.position[:, i], rotation[i]), slow[i], a.size)
        here = (motion.position[:, i], rotation[i])
        for j, b in enumerate(probes):
            if j != i and structure.pieces[j].name not in fallen:
                depth = pair_depth(a, b, here, (motion.position[:, j], rotation[j]))
                note(depth, slow[i] & slow[j], min(a.size, b.size))
        for wall, b in zip(structure.walls, walls, strict=True):
            steps = len(motion.position)
            there = (np.broadcast_to(wall.centre, (steps, 3)), np.broadcast_to(np.eye(3), (steps, 3, 3)))
            note(pair_depth(a, b, here, there), slow[i], a.size)
    return rest, impact


def matrices(orientation: np.ndarray) -> np.ndarray:
    """Body → world, shape (t, 3, 3)."""
    return Rotation.from_quat(orientation, scalar_first=True).as_matrix()


def _resting(motion: Motion, i: int, probe: Probe) -> np.ndarray:
    """In which states a body has rested for a while, shape (t,)."""
    speed = np.linalg.norm(motion.velocity[:, i], axis=1)
    speed = speed + probe.reach * np.linalg.norm(motion.omega[:, i], axis=1)
    slow = (speed < SLOW).astype(int)
    count = np.convolve(slow, np.ones(SLOW_STEPS, int))[: len(slow)]
    return count == SLOW_STEPS


def floor_depth(a: Probe, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """How far the lowest point lies below the floor [m], negative above, shape (t,)."""
    low = position[:, 2] < a.reach
    depth = np.full(len(position), -np.inf)
    depth[low] = a.ball - position[low, 2] - (rotation[low, 2] @ a.points.T).min(axis=1)
    return depth


def pair_depth(
    a: Probe, b: Probe, here: tuple[np.ndarray, np.ndarray], there: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """How deep the balls of `a` lie in `b` [m], negative apart, shape (t,)."""
    offset = here[0] - there[0]
    depth = np.full(len(offset), -np.inf)
    near = np.flatnonzero(np.linalg.norm(offset, axis=1) < a.reach + b.reach)
    centre = np.einsum("tji,tj->ti", there[1][near], offset[near])
    # A distance changes by no more than the way: what is far at the centre is far everywhere.
    near = near[b.distance(centre) < a.reach]
    if len(near) == 0:
        return depth
    turn = np.einsum("tji,tjk->tik", there[1][near], here[1][near])
    centre = np.einsum("tji,tj->ti", there[1][near], offset[near])
    points = np.einsum("tij,kj->tki", turn, a.points) + centre[:, None]
    found = b.distance(points.reshape(-1, 3)).reshape(len(near), -1)
    depth[near] = a.ball - found.min(axis=1)
    return depth
