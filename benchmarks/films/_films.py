"""Films of toys, each with its truth; what was drawn and learned is kept in a folder."""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from PIL import Image

from benchmarks.films._world import AT_REST, coded, looking, Pose, walk, World
from dano.learning import train_object
from dano.maths import quat_exp, quat_from_matrix, quat_multiply, quat_to_matrix
from dano.vision import Capture, Film, LearnedField, PosedCamera, TrainOptions, View

_SUNS = ((-0.3, -0.5, 0.8), (0.6, 0.1, 0.7), (-0.5, 0.4, 0.6), (0.2, -0.6, 0.9))

PUSH = 4
"""Frames from the first one on in which a hand may touch what slides."""

_RATE = 40.0
"""Frames a second of slides and spins."""


class Kind(NamedTuple):
    """How a toy moves."""

    toy: str  # Its name
    motion: str  # "slide", "spin" or "throw"
    number: int  # Which view and light
    friction: float | None = None  # Of slides
    held: bool = False  # Whether the camera is in a hand


KINDS = {
    "engine slides": Kind("engine", "slide", 0, 0.3),
    "engine slides far": Kind("engine", "slide", 1, 0.2),
    "engine slides shortly": Kind("engine", "slide", 2, 0.4),
    "engine slides, camera in a hand": Kind("engine", "slide", 3, 0.3, held=True),
    "wedge slides": Kind("wedge", "slide", 1, 0.25),
    "wedge slides shortly": Kind("wedge", "slide", 2, 0.35),
    "wedge slides far": Kind("wedge", "slide", 3, 0.22),
    "wedge slides, camera in a hand": Kind("wedge", "slide", 0, 0.38, held=True),
    "engine spins": Kind("engine", "spin", 1),
    "engine is thrown, most of it beside the picture": Kind("engine", "throw", 2),
}
"""Films that are drawn, by name."""


def known(field: LearnedField | None, name: str) -> LearnedField:
    """A field that was learned.

    Raises:
        ValueError: If there is none.
    """
    if field is None:
        raise ValueError(f"the object of {name} must have a learned field, got none")
    return field


class Filmed(NamedTuple):
    """A film that was drawn."""

    film: Film  # Its frames, without masks
    camera: PosedCamera  # Of the first frame
    empty: Path  # Picture of the place
    position: np.ndarray  # True positions of the learned object's frame [m], shape (T, 3)
    orientation: np.ndarray  # True orientations, shape (T, 4)


def learned(folder: Path, toy: str, *, quick: bool) -> Path:
    """The object file of a toy, from a walk around it without masks; learned if it is not there."""
    file = folder / f"{toy}.dano"
    if not file.is_file():
        views = [
            View(name=f"{i}", camera=camera, image=(image / 255).astype(np.float32))
            for i, (image, camera) in enumerate(walk(World(toy)))
        ]
        options = TrainOptions(
            resolution=40, iterations=40 if quick else 200, batch=2048, check_every=10**6, cavities=False
        )
        train_object(Capture(views), options, table=0.0).save(file)
    return file


def filmed(folder: Path, name: str, *, quick: bool) -> Filmed:
    """A film, drawn if it is not there."""
    kind, file = KINDS[name], folder / f"{name}.pickle"
    if not file.is_file():
        file.write_bytes(pickle.dumps(_drawn(kind, 6 if quick else 14)))
    times, poses, camera, frames, empty = pickle.loads(file.read_bytes())
    picture = file.with_suffix(".png")
    Image.fromarray(empty).save(picture)
    n = len(frames)
    film = Film(tuple(map(str, range(n))), times, frames, [None] * n, [None] * n, 1, ())
    turn, place = AT_REST
    turns = [rotation @ turn.T for rotation, _ in poses]
    position = np.array([p - r @ place for r, (_, p) in zip(turns, poses, strict=True)])
    return Filmed(film, camera, picture, position, np.array([quat_from_matrix(r) for r in turns]))


def _drawn(kind: Kind, count: int):
    world, k = World(kind.toy), kind.number
    times, poses = _MOTIONS[kind.motion](count, kind)
    base = looking(-1.3 + 0.5 * k, 0.6 + 0.05 * (k % 3), 0.36, 280, 260.0)
    rng, turned, frames = np.random.default_rng(k), np.zeros(3), []
    sun, sky = _SUNS[k % 4], 0.4 + 0.1 * (k % 3)
    for i, pose in enumerate(poses):
        camera = base
        if kind.held and i:
            turned = 0.8 * turned + 0.002 * rng.normal(size=3)
            matrix = base.pose.copy()
            matrix[:3, :3] = matrix[:3, :3] @ cv2.Rodrigues(turned)[0]
            camera = base.replaced(camera_to_world=matrix)
        frames.append(coded(world.light(camera, pose, sun, sky), rng))
    empty = coded(world.light(base, None, sun, sky), rng, noise=0.004)
    return times, poses, base, frames, empty


def slide(
    count: int,
    rate: float,
    friction: float,
    *,
    pushed: int,
    speed: float,
    start: tuple[float, float],
    heading: float,
    turn: float = 0.5,
) -> tuple[np.ndarray, list[Pose]]:
    """At rest for two frames, pushed for some, then slowed down by friction.

    Args:
        count: Frames.
        rate: Frames a second.
        friction: Of the table.
        pushed: Frames of the push.
        speed: At its end [m/s].
        start: Where it begins [m].
        heading: Where it slides to [rad].
        turn: How it is turned [rad].
    """
    step = 1 / rate
    force, slowing = speed / (pushed * step), 9.81 * friction
    along, rows = np.array([np.cos(heading), np.sin(heading), 0]), []
    for i in range(count):
        t = (i - 2) * step
        way = 0.5 * force * min(max(t, 0), pushed * step) ** 2
        later = min(max(t - pushed * step, 0), speed / slowing)
        way += speed * later - 0.5 * slowing * later**2
        rows.append((quat_to_matrix(quat_exp(np.array([0, 0, turn]))), np.array([*start, 0.0]) + way * along))
    return np.arange(count) * step, rows


def _slide(count: int, kind: Kind) -> tuple[np.ndarray, list[Pose]]:
    assert kind.friction is not None
    turn, start = 0.5 + 0.1 * kind.number, (-0.08, -0.02)
    return slide(count, _RATE, kind.friction, pushed=2, speed=0.6, start=start, heading=0.3, turn=turn)


def _spin(count: int, kind: Kind) -> tuple[np.ndarray, list[Pose]]:
    """Slides and spins, both ever slower."""
    times, rows = np.arange(count) / _RATE, []
    for t in times:
        way = 0.5 * t - 1.1 * t * t if t < 0.227 else 0.0568
        angle = 4 * t - 6 * t * t if t < 0.333 else 0.667
        turn = quat_to_matrix(quat_exp(np.array([0, 0, angle - 0.3])))
        rows.append((turn, np.array([way - 0.06, 0.2 * way - 0.02, 0.0])))
    return times, rows


def _throw(count: int, kind: Kind) -> tuple[np.ndarray, list[Pose]]:
    """Flies up and out of the picture, and comes back."""
    rng = np.random.default_rng(2)
    times, rows = np.arange(count) / 60.0, []
    spin = np.array([3.0, -5.0, 2.0]) * (1 + 0.3 * rng.normal(size=3))
    begun, middle = quat_exp(np.array([0.1, 0.2, 0.6])), np.array([0, 0, 0.025])
    for t in times:
        turn = quat_to_matrix(quat_multiply(begun, quat_exp(spin * t)))
        centre = np.array([-0.06, -0.01, 0.105]) + np.array([0.35, 0.1, 0.9]) * t
        rows.append((turn, centre - [0, 0, 0.5 * 9.81 * t * t] - turn @ middle))
    return times, rows


_MOTIONS: dict[str, Callable[[int, Kind], tuple[np.ndarray, list[Pose]]]] = {
    "slide": _slide,
    "spin": _spin,
    "throw": _throw,
}
