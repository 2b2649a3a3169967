"""Where films are taken from: all in view, and as large as that allows."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dano.fields import AbstractShape, Ellipsoid, Sphere
from dano.maths import quat_to_matrix
from dano.report._stage import Stage
from dano.scene import Body, Scene, Trajectory
from dano.vision import Camera

CAMERAS = ("auto", "fixed", "follow")
"""What a film's camera does: it stands still, follows what moves, or whichever shows bodies large enough."""
LEAST = 1 / 3
"""Share of a picture's height that moving bodies fill, together, wherever a camera can do that."""
# Seen a little from above; margin around what is framed.
_DOWN, _MARGIN = -0.36, 0.08
# Points that stand for a round body or an object.
_POINTS = 100
# Seconds before and after a frame that a following camera keeps in view, too: the longer, the calmer.
_CALM = (0.5, 0.35, 0.25, 0.17, 0.12, 0.08, 0.05, 0.03)


class Seen(NamedTuple):
    """What cameras keep in view.

    Attributes:
        moving: Points on bodies that may move [m, W] in each frame.
        still: Points on fixed bodies [m, W].
        paths: Centres of mass [m, W] of each body that may move.
    """

    moving: Float[np.ndarray, "frames n 3"]
    still: Float[np.ndarray, "m 3"]
    paths: list[Float[np.ndarray, "frames 3"]]

    @property
    def points(self) -> Float[np.ndarray, "k 3"]:
        """All points of all frames."""
        return np.concatenate([self.moving.reshape(-1, 3), self.still])


def seen_of(
    scene: Scene,
    drawn: Stage,
    position: Float[np.ndarray, "frames bodies 3"],
    orientation: Float[np.ndarray, "frames bodies 4"],
) -> Seen:
    """What a film of a run shall show: its bounded bodies.

    Args:
        scene: The scene.
        drawn: What of it is drawn.
        position: Of the centres of mass in each frame [m, W].
        orientation: Of the bodies.
    """
    moving, still, paths = [np.zeros((len(position), 0, 3))], [np.zeros((0, 3))], []
    for item, row, com in zip(drawn.items, drawn.rows, drawn.offsets, strict=True):
        if item.plane is not None:
            continue
        if not scene.bodies[row].fixed:
            paths.append(position[:, row])
        if item.shape is None:
            continue
        outline = _outline(scene.bodies[row], item.shape) - com
        turns = quat_to_matrix(orientation[:, row])
        placed = position[:, None, row] + np.einsum("tij,nj->tni", turns, outline)
        if scene.bodies[row].fixed:
            still.append(placed[0])
        else:
            moving.append(placed)
    return Seen(np.concatenate(moving, axis=1), np.concatenate(still), paths)


def together(runs: Sequence[Seen]) -> Seen:
    """What is seen of several runs, as if all of it were in one place."""
    return Seen(
        np.concatenate([run.moving for run in runs], axis=1),
        np.concatenate([run.still for run in runs]),
        [path for run in runs for path in run.paths],
    )


def camera_for(scene: Scene, drawn: Stage, trajectory: Trajectory, width: int, height: int) -> Camera:
    """A camera that sees every bounded body all the time, from across the main direction of motion."""
    position = np.asarray(trajectory.states.position, dtype=np.float64)
    orientation = np.asarray(trajectory.states.orientation, dtype=np.float64)
    steps = np.unique(np.linspace(0, len(position) - 1, 60).astype(int))
    return _fixed(seen_of(scene, drawn, position[steps], orientation[steps]), width, height)


def cameras_for(seen: Seen, step: float, size: tuple[int, int], how: str = "auto") -> list[Camera]:
    """Cameras of the frames of a film.

    Args:
        seen: What they keep in view.
        step: Simulated time between two frames [s].
        size: Width and height [pixels].
        how: One of `CAMERAS`. A following camera keeps its direction and shifts; "auto" follows if bodies
            would otherwise fill less than a third of the height.
    """
    moving = seen.moving
    fixed = _fixed(seen, *size)
    if how == "fixed" or not moving.shape[1]:
        return [fixed] * len(moving)
    if how == "auto" and _least_fill([fixed] * len(moving), moving) >= LEAST:
        return [fixed] * len(moving)
    direction = view_direction(seen)
    nearest = _following(moving, direction, 0, size)
    # Bodies far apart cannot fill it: then nearly what can be had.
    wanted = min(LEAST, 0.9 * _least_fill(nearest, moving))
    for calm in _CALM:
        cameras = _following(moving, direction, round(calm / step), size)
        if _least_fill(cameras, moving) >= wanted:
            return cameras
    return nearest


def _following(
    moving: Float[np.ndarray, "frames n 3"], direction: np.ndarray, reach: int, size: tuple[int, int]
) -> list[Camera]:
    """Cameras of one direction that keep in view what moves within some frames before and after.

    Each is the mean of those that the frames around it would have alone. All of these see what moves in the
    frame between them, and so does their mean: what a camera of one direction sees is a convex cone
    from where it stands.
    """
    n = len(moving)
    near = [slice(max(0, i - reach), min(n, i + reach + 1)) for i in range(n)]
    single = [framed(moving[part].reshape(-1, 3), direction, *size) for part in near]
    places = np.array([camera.position for camera in single])
    ahead = single[0].axes[2]
    cameras = []
    for part in near:
        place = places[part].mean(axis=0)
        middle = moving[part].reshape(-1, 3).mean(axis=0)
        away = max(float((middle - place) @ ahead), 1e-6)
        cameras.append(Camera(place, place + away * ahead, width=size[0], height=size[1]))
    return cameras


def framed(points: Float[np.ndarray, "n 3"], direction: np.ndarray, width: int, height: int) -> Camera:
    """The nearest camera of a direction that sees all points; some camera where there are none."""
    if not len(points):
        return Camera((3.0, -8.0, 4.0), width=width, height=height)
    none = np.zeros(len(points))
    return Camera.framing(points, none, direction=direction, width=width, height=height, margin=_MARGIN)


def _fixed(seen: Seen, width: int, height: int) -> Camera:
    return framed(seen.points, view_direction(seen), width, height)


def _least_fill(cameras: Sequence[Camera], moving: Float[np.ndarray, "frames n 3"]) -> float:
    """Share of the height that the moving bodies fill, together, in the frame where they fill least."""
    heights = (np.ptp(c.project(points)[:, 1]) / c.height for c, points in zip(cameras, moving, strict=True))
    return float(min(heights))


def _outline(body: Body, shape: AbstractShape) -> Float[np.ndarray, "n 3"]:
    """Points on a body [m, F] between which it lies, or nearly."""
    if body.object is not None:
        points = np.asarray(body.object.surface.points, dtype=np.float64)
        return points[:: max(1, len(points) // _POINTS)]
    lower, upper = np.asarray(shape.bounds, dtype=np.float64)
    corners = np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1
    if isinstance(shape, (Sphere, Ellipsoid)):
        k = np.arange(_POINTS) + 0.5
        z, angle = 1 - 2 * k / _POINTS, np.pi * (1 + np.sqrt(5)) * k
        round_off = np.sqrt(1 - z * z)
        corners = np.stack([round_off * np.cos(angle), round_off * np.sin(angle), z], axis=1)
    return 0.5 * (lower + upper) + 0.5 * (upper - lower) * corners


def view_direction(seen: Seen) -> np.ndarray:
    """Where cameras look: across the main direction of motion, a little from the side and from above."""
    if not len(seen.points):
        return np.array([0.34, 0.94, _DOWN])
    right = _main_direction(seen.points, [path[:, :2] for path in seen.paths])
    # Seen a little from the side, motion along the screen still shows depth.
    ahead = np.array([-right[1], right[0]])
    ahead = 0.94 * ahead + 0.34 * right
    return np.array([*(ahead / np.linalg.norm(ahead)), _DOWN])


def _main_direction(centres: np.ndarray, moving: list[np.ndarray]) -> np.ndarray:
    """Horizontal unit vector that shall run to the right of the picture."""
    flat = np.concatenate([path - path.mean(axis=0) for path in moving]) if moving else np.zeros((1, 2))
    if np.abs(flat).max() < 0.2 * np.ptp(centres[:, :2], axis=0).max(initial=0.0):
        flat = centres[:, :2] - centres[:, :2].mean(axis=0)
    if np.abs(flat).max() < 1e-9:
        return np.array([1.0, 0.0])
    _, _, axes = np.linalg.svd(flat, full_matrices=False)
    right = axes[0]
    travel = sum((path[-1] - path[0] for path in moving), np.zeros(2)) @ right
    if abs(travel) > 1e-6 * np.abs(flat).max():
        return right if travel > 0 else -right
    return right if right[0] >= 0 else -right
