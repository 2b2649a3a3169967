"""Scenes as pictures see them: drawable items, their poses, a camera that keeps all in view, forces.

From simulation times to picture times.
Contact points and forces drawn over pictures.
Where films are taken from: all in view, and as large as that allows.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int, UInt8

from dano.checks import checked_kind, checked_number
from dano.engine import contact_history
from dano.fields import AbstractShape, Ellipsoid, Sphere
from dano.maths import Pose, quat_slerp, quat_to_matrix
from dano.scene import Body, Scene, Trajectory
from dano.vision import AbstractCamera, Camera, Item, LearnedField, PALETTE

MOST_FRAMES = 100_000
"""An hour of video at 28 frames a second (convention)."""


def frame_times(
    trajectory: Trajectory, fps: int | float, slow_motion: int | float
) -> Float[np.ndarray, " frames"]:
    """Simulation time [s] of each frame of a video that plays `slow_motion` times slower than life.

    Raises:
        ValueError: See `frame_count`.
    """
    times = np.asarray(trajectory.times, dtype=np.float64)
    count = _counted(float(times[-1] - times[0]), slow_motion, fps, "options.slow_motion")
    return times[0] + np.arange(count) / (fps * slow_motion)


def frame_count(duration: float, slow_motion: int | float, fps: int | float = 30) -> int:
    """Number of frames of a video, asked before anything is drawn.

    Args:
        duration: Simulated time [s].
        slow_motion: How many times slower than life the video plays.
        fps: Frames per second of the video.

    Raises:
        ValueError: If a rate is not positive, or there are more than a hundred thousand frames: drawing them
            would take hours.
    """
    for name, value in (("duration", duration), ("fps", fps), ("slow_motion", slow_motion)):
        checked_number(name, value, above=0)
    return _counted(duration, slow_motion, fps, "slow_motion")


def _counted(duration: float, slow_motion: int | float, fps: int | float, name: str) -> int:
    """Number of frames; `name`: of the argument, for errors."""
    count = duration * fps * slow_motion
    if not count < MOST_FRAMES:
        raise ValueError(
            f"{name} must be at most {MOST_FRAMES / (duration * fps):.3g}, so that a video of"
            f" {duration:.4g} s has at most {MOST_FRAMES} frames, got {slow_motion:g} with fps {fps:g}"
        )
    return int(np.floor(count + 1e-6)) + 1


def poses_at(
    trajectory: Trajectory, times: Float[np.ndarray, " frames"]
) -> tuple[Float[np.ndarray, "frames bodies 3"], Float[np.ndarray, "frames bodies 4"]]:
    """Positions [m, W] of the centres of mass and orientations at given times, between steps interpolated."""
    known = np.asarray(trajectory.times, dtype=np.float64)
    position = np.asarray(trajectory.states.position, dtype=np.float64)
    orientation = np.asarray(trajectory.states.orientation, dtype=np.float64)
    first = np.clip(np.searchsorted(known, times, side="right") - 1, 0, len(known) - 2)
    share = np.clip((times - known[first]) / (known[first + 1] - known[first]), 0, 1)[:, None, None]
    moved = (1 - share) * position[first] + share * position[first + 1]
    return moved, quat_slerp(orientation[first], orientation[first + 1], share[..., 0])


def moments_of(position: Float[np.ndarray, "frames bodies 3"], n: int) -> Int[np.ndarray, " moments"]:
    """Frames from the first to the last, closer together where much moves."""
    travel = np.linalg.norm(np.diff(position, axis=0), axis=-1).sum(axis=1)
    # A third of the way is time: a strip should say where everything rests, but not in half of its pictures.
    pace = travel / max(float(travel.sum()) / max(len(travel), 1), 1e-12) + 0.5
    way = np.concatenate([[0.0], np.cumsum(pace)])
    return np.unique(np.interp(np.linspace(0, way[-1], n), way, np.arange(len(way))).round().astype(int))


_MOST_SHARE = 2.5
"""Longest arrow of a force, in those of the usual one (chosen by eye)."""


def check_run(scene: Scene, trajectory: Trajectory, name: str = "trajectory") -> None:
    """Check that a trajectory is one of a scene, with at least one step, and finite.

    Args:
        scene: The scene.
        trajectory: What may have happened in it.
        name: Of the argument, for errors.

    Raises:
        ValueError: If it is not.
    """
    checked_kind("scene", scene, Scene)
    checked_kind(name, trajectory, Trajectory)
    if tuple(trajectory.names) != tuple(scene.names):
        raise ValueError(
            f"{name} must be of this scene with bodies {list(scene.names)}, got {list(trajectory.names)}"
        )
    if len(trajectory.times) < 2:
        raise ValueError(f"{name} must have at least one step, got {len(trajectory.times)} states")
    if not np.all(np.isfinite(np.asarray(trajectory.states.position))):
        raise ValueError(f"{name} must be finite, got positions that are NaN or infinite")


class PictureStage(NamedTuple):
    """What of a scene is drawn."""

    items: list[Item]  # One per drawable body, at the identity
    rows: list[int]  # Index of the body of each item
    offsets: list[np.ndarray]  # Centre of mass in the field frame [m, F] of each item

    def posed(
        self, position: Float[np.ndarray, "bodies 3"], orientation: Float[np.ndarray, "bodies 4"]
    ) -> list[Item]:
        """The items where the bodies are."""
        placed = []
        for item, row, com in zip(self.items, self.rows, self.offsets, strict=True):
            rotation = quat_to_matrix(orientation[row])
            pose = eqx.tree_at(
                lambda p: (p.position, p.orientation),
                item.pose,
                (position[row] - rotation @ com, orientation[row]),
            )
            placed.append(item.at(pose))
        return placed


def stage(
    scene: Scene, colours: Mapping[str, str] | None = None, looks: Mapping[str, LearnedField] | None = None
) -> PictureStage:
    """Make the bodies of a scene ready for drawing; bodies without a field or shape are left out.

    Raises:
        ValueError: If a colour is not "#rrggbb", a colour or look names no body, or nothing can be drawn.
    """
    colours = checked_kind("colours", {} if colours is None else colours, Mapping)
    looks = checked_kind("looks", {} if looks is None else looks, Mapping)
    for name in (*colours, *looks):
        scene.index(name)
    for name, look in looks.items():
        checked_kind(f"looks of {name!r}", look, LearnedField)
    items, rows, offsets, used = [], [], [], 0
    for row, body in enumerate(scene.bodies):
        if body.field is None:
            continue
        plane = body.shape is not None and not np.isfinite(body.size)
        colour = colours.get(body.name, None if plane else PALETTE[used % len(PALETTE)])
        if body.name in looks and body.name not in colours:
            items.append(Item(looks[body.name]))
        else:
            items.append(Item(body.field, Pose(), colour, level=level_of(body)))
        rows.append(row)
        offsets.append(np.asarray(body.centre_of_mass, np.float64))
        used += not plane
    if not items:
        raise ValueError(
            f"scene must hold a body with a field or a shape, got {list(scene.names)} without any"
        )
    return PictureStage(items, rows, offsets)


def level_of(body: Body) -> float | None:
    """Density at which the surface of a neural object is drawn; None for a shape."""
    return (
        None if body.object is None else object_level(np.asarray(body.object.density_range, dtype=np.float64))
    )


def object_level(density_range: np.ndarray) -> float:
    """Where in a range of densities the eye sees the surface: low in it, for that is where contact begins."""
    low, high = float(density_range[0]), float(density_range[1])
    return low**0.75 * high**0.25 if low > 0 else 0.1 * high


class Touches(NamedTuple):
    """Contact forces at the times of frames."""

    points: Float[np.ndarray, "frames contacts 3"]  # Centroids of the overlaps [m, W], (frames, contacts, 3)
    # On the first body of each contact [N, W], (frames, contacts, 3).
    forces: Float[np.ndarray, "frames contacts 3"]
    # Force over the usual one, (frames, contacts); zero where nothing touches.
    shares: Float[np.ndarray, "frames contacts"]
    usual: float  # Usual force [N], for arrows; zero if nothing touches at all

    def beside(self, usual: float) -> "Touches":
        """The same with another usual force, so that arrows can be compared with those of other runs."""
        shares = np.clip(np.linalg.norm(self.forces, axis=-1) / usual, 0, _MOST_SHARE)
        return self._replace(shares=np.where(self.shares > 0, shares, 0.0), usual=usual)


def touches(scene: Scene, trajectory: Trajectory, times: Float[np.ndarray, " frames"]) -> Touches | None:
    """Contact points and forces of the steps that the times fall into; None without contacts in the scene."""
    if not scene.pairs:
        return None
    history = contact_history(scene, trajectory.states)
    known = np.asarray(trajectory.times, dtype=np.float64)
    step = np.clip(np.searchsorted(known, times, side="right") - 1, 0, len(known) - 2)
    points, overlap, forces = (array[step] for array in history)
    size = np.linalg.norm(forces, axis=-1)
    # A landing is a hundred times the weight; what matters to the eye is the usual force, so the rest is
    # clipped.
    usual = float(np.quantile(size[size > 1e-9], 0.8)) if np.any(size > 1e-9) else 0.0
    shares = np.clip(size / (usual or 1.0), 0, _MOST_SHARE)
    shares = np.where((overlap > 0) & np.isfinite(points).all(axis=-1), shares, 0.0)
    return Touches(points, forces, shares, usual)


# Colours, chosen by eye.
_DOT = (24, 26, 30)
_ARROW = (214, 40, 57)
# Drawn this many times larger and then reduced: Pillow's lines are not smooth.
_FINE = 3


def draw_touches(
    picture: UInt8[np.ndarray, "height width 3"],
    camera: AbstractCamera,
    touched: Touches,
    frame: int,
    length: float,
) -> UInt8[np.ndarray, "height width 3"]:
    """The picture with a dot and a force arrow at every contact of one frame.

    Args:
        picture: sRGB.
        camera: From where it was taken.
        touched: Contacts of all frames.
        frame: Which frame.
        length: Length [m] of the arrow of a usual force.
    """
    from PIL import Image, ImageDraw

    rows = np.flatnonzero(touched.shares[frame] > 0.02)
    if len(rows) == 0:
        return picture
    force = touched.forces[frame, rows]
    direction = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-12)
    tails = touched.points[frame, rows]
    # Towards the upper side, so that the arrow is not under the floor.
    direction = np.where(direction[:, 2:] < -0.05, -direction, direction)
    heads = tails + length * touched.shares[frame, rows, None] * direction
    ends = [camera.project(tails)[:, :2], camera.project(heads)[:, :2]]
    layer = Image.new("L", (camera.width * _FINE, camera.height * _FINE), 0)
    dots = Image.new("L", layer.size, 0)
    for tail, head in zip(*ends, strict=True):
        if np.all(np.isfinite([tail, head])):
            _arrow(ImageDraw.Draw(layer), tail * _FINE, head * _FINE, camera.height * _FINE / 400)
            radius = 2.6 * camera.height * _FINE / 400
            box = [*(tail * _FINE - radius), *(tail * _FINE + radius)]
            ImageDraw.Draw(dots).ellipse(box, fill=255)
    result = Image.fromarray(picture)
    for mask, colour in ((layer, _ARROW), (dots, _DOT)):
        result.paste(colour, mask=mask.resize(result.size, Image.Resampling.BOX))
    return np.asarray(result)


def draw_clock(
    picture: UInt8[np.ndarray, "height width 3"], camera: AbstractCamera, time: float, distance: float
) -> UInt8[np.ndarray, "height width 3"]:
    """The picture with the time and a bar that says how long things are, in its lower corners.

    Args:
        picture: sRGB.
        camera: From where it was taken.
        time: Of the frame [s].
        distance: From the camera at which the bar has its length [m].
    """
    from PIL import Image, ImageDraw, ImageFont

    result = Image.fromarray(picture)
    draw = ImageDraw.Draw(result)
    height = camera.height
    font, margin = ImageFont.load_default(size=_letters(height)), height / 30
    base = height - margin
    draw.text((margin, base), f"{time:.2f} s", font=font, fill=_DOT, anchor="ls")
    metre = 1 / (camera.pixel_angle * distance)
    length = round_below(camera.width / 5 / metre)
    right, left = camera.width - margin, camera.width - margin - length * metre
    draw.line([left, base, right, base], fill=_DOT, width=max(2, height // 200))
    draw.text((right, base - height / 60), length_text(length), font=font, fill=_DOT, anchor="rs")
    return np.asarray(result)


def draw_label(
    picture: UInt8[np.ndarray, "height width 3"], text: str
) -> UInt8[np.ndarray, "height width 3"]:
    """The picture with a text in its upper left corner, without its beginning if it is too long."""
    from PIL import Image, ImageDraw, ImageFont

    result = Image.fromarray(picture)
    height, width, _ = picture.shape
    font, margin = ImageFont.load_default(size=_letters(height)), height / 30
    shown = text = " ".join(text.split())
    while text and font.getlength(shown) > width - 2 * margin:
        text = text[1:]
        shown = f"…{text}"
    ImageDraw.Draw(result).text((margin, margin), shown, font=font, fill=_DOT, anchor="la")
    return np.asarray(result)


def _letters(height: int) -> float:
    """Size of letters [pixels] in a picture of a height."""
    return max(10.0, height / 24)


def round_below(x: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above x > 0."""
    power = 10.0 ** np.floor(np.log10(x))
    return float(max(k * power for k in (1, 2, 5) if k * power <= x * (1 + 1e-12)))


def length_text(length: float) -> str:
    """A length [m] with the unit that it is usually said in."""
    for unit, name in ((1.0, "m"), (1e-2, "cm")):
        if length >= unit * (1 - 1e-9):
            return f"{length / unit:.4g} {name}"
    return f"{length / 1e-3:.4g} mm"


def _arrow(draw, tail: np.ndarray, head: np.ndarray, scale: float) -> None:
    """A line with a filled head, in pixels of the fine layer."""
    along = head - tail
    size = float(np.linalg.norm(along))
    if size < 1e-6:
        return
    along = along / size
    across = np.array([-along[1], along[0]])
    tip = min(7.0 * scale, 0.6 * size)
    neck = head - tip * along
    draw.line([*tail, *neck], fill=255, width=max(int(round(2.0 * scale)), 1))
    draw.polygon(
        [tuple(head), tuple(neck + 0.45 * tip * across), tuple(neck - 0.45 * tip * across)], fill=255
    )


def side_by_side(images: Sequence[np.ndarray], per_row: int | None = None) -> np.ndarray:
    """Pictures from left to right with a thin white line between them; default: three a row."""
    per_row = per_row or (3 if len(images) > 3 else len(images))
    height, width, _ = images[0].shape
    n_rows = -(-len(images) // per_row)
    gap = _gap(height)
    sheet = np.full((n_rows * (height + gap) - gap, per_row * (width + gap) - gap, 3), 255, dtype=np.uint8)
    for i, image in enumerate(images):
        top, left = (i // per_row) * (height + gap), (i % per_row) * (width + gap)
        sheet[top : top + height, left : left + width] = image
    return sheet


def _gap(height: int) -> int:
    """Pixels between pictures: an even number, as codecs want the whole to be."""
    return 2 * max(1, height // 200)


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
    """What cameras keep in view."""

    moving: Float[np.ndarray, "frames n 3"]  # Points on bodies that may move [m, W] in each frame
    still: Float[np.ndarray, "m 3"]  # Points on fixed bodies [m, W]
    paths: list[Float[np.ndarray, "frames 3"]]  # Centres of mass [m, W] of each body that may move

    @property
    def points(self) -> Float[np.ndarray, "k 3"]:
        """All points of all frames."""
        return np.concatenate([self.moving.reshape(-1, 3), self.still])


def seen_of(
    scene: Scene,
    drawn: PictureStage,
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


def camera_for(scene: Scene, drawn: PictureStage, trajectory: Trajectory, width: int, height: int) -> Camera:
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
