"""Pinhole cameras."""

import math

import equinox as eqx
import numpy as np
from jaxtyping import Float

from dano.maths import checked_array, is_traced, Numbers


class Camera(eqx.Module):
    """A pinhole camera that keeps z up.

    Pixel (0, 0) is the upper left one; its centre lies at image coordinates (0.5, 0.5).

    Attributes:
        position: Centre of projection [m, W], shape (3,).
        look_at: Point in the middle of the image [m, W], shape (3,).
        vertical_fov: Angle between the upper and the lower edge of the image [rad].
        width: Image width [pixels].
        height: Image height [pixels].
    """

    position: Float[np.ndarray, "3"]
    look_at: Float[np.ndarray, "3"]
    vertical_fov: float
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)

    def __init__(
        self,
        position: Numbers,
        look_at: Numbers = (0.0, 0.0, 0.0),
        *,
        vertical_fov: int | float = 0.6,
        width: int = 640,
        height: int = 400,
    ):
        """Place a camera.

        Raises:
            ValueError: If it looks from where it looks at, the angle is not in (0, π), or the image is empty.
        """
        if is_traced(position, look_at):
            raise ValueError("position and look_at must be concrete: pictures are drawn on the host")
        self.position = np.asarray(checked_array("position", position, (3,)), dtype=np.float64)
        self.look_at = np.asarray(checked_array("look_at", look_at, (3,)), dtype=np.float64)
        self.vertical_fov = float(vertical_fov)
        self.width, self.height = int(width), int(height)
        if not np.linalg.norm(self.look_at - self.position) > 0:
            raise ValueError(f"look_at must differ from position, got {self.position.tolist()} twice")
        if not 0 < self.vertical_fov < math.pi:
            raise ValueError(f"vertical_fov must lie in (0, π) rad, got {vertical_fov}")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"width and height must be ≥ 1 pixel, got {width} × {height}")

    @property
    def axes(self) -> Float[np.ndarray, "3 3"]:
        """Rows: unit vectors to the right, upwards and forwards [W]."""
        return view_axes(self.look_at - self.position)

    @property
    def pixel_angle(self) -> float:
        """Angle that a pixel in the middle of the image spans [rad]."""
        return 2 * math.tan(0.5 * self.vertical_fov) / self.height

    def directions(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """Unit directions [W] of rays through image coordinates (x to the right, y downwards) [pixels]."""
        right, up, forward = self.axes
        x = (pixels[:, :1] - 0.5 * self.width) * self.pixel_angle
        y = (0.5 * self.height - pixels[:, 1:]) * self.pixel_angle
        towards = forward + x * right + y * up
        return towards / np.linalg.norm(towards, axis=1, keepdims=True)

    def rays(self) -> Float[np.ndarray, "height width 3"]:
        """Unit directions [W] of the rays from `position` through all pixel centres."""
        y, x = np.mgrid[: self.height, : self.width] + 0.5
        return self.directions(np.stack([x.ravel(), y.ravel()], axis=1)).reshape(self.height, self.width, 3)

    def project(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Image coordinates x, y [pixels] and depth along the optical axis [m] of points [m, W].

        Points that are not in front of the camera have no image: NaN.
        """
        local = (np.asarray(points, dtype=np.float64) - self.position) @ self.axes.T
        depth = np.where(local[:, 2] > 0, local[:, 2], np.nan)
        scale = 1 / (depth * self.pixel_angle)
        return np.stack(
            [0.5 * self.width + local[:, 0] * scale, 0.5 * self.height - local[:, 1] * scale, depth], axis=1
        )

    @classmethod
    def framing(
        cls,
        centres: Float[np.ndarray, "n 3"],
        radii: Float[np.ndarray, " n"],
        *,
        direction: Numbers = (0.35, 0.85, -0.38),
        vertical_fov: int | float = 0.6,
        width: int = 640,
        height: int = 400,
        margin: int | float = 0.06,
    ) -> "Camera":
        """The nearest camera of a given viewing direction that sees all of some balls.

        Args:
            centres: Their centres [m, W].
            radii: Their radii [m].
            direction: Where the camera looks [W].
            vertical_fov: See the constructor.
            width: Image width [pixels].
            height: Image height [pixels].
            margin: Share of the image kept free on each side.

        Raises:
            ValueError: If there is no ball, a number is not finite, or the direction is zero.
        """
        if len(centres) == 0 or not (np.all(np.isfinite(centres)) and np.all(np.isfinite(radii))):
            raise ValueError(f"centres and radii must be finite and at least one, got {len(centres)}")
        axes = view_axes(np.asarray(checked_array("direction", direction, (3,)), dtype=np.float64))
        x, y, z = (np.asarray(centres, dtype=np.float64) @ axes.T).T
        tangent = math.tan(0.5 * vertical_fov) * (1 - 2 * margin)
        place = []
        for along, half in ((x, math.atan(tangent * width / height)), (y, math.atan(tangent))):
            # A ball is in view if it lies on the inner side of both edge planes, which meet in the camera.
            lower = np.min(math.cos(half) * along + math.sin(half) * z - radii)
            upper = np.min(-math.cos(half) * along + math.sin(half) * z - radii)
            place.append(((lower - upper) / (2 * math.cos(half)), (lower + upper) / (2 * math.sin(half))))
        depth = min(place[0][1], place[1][1])
        position = np.array([place[0][0], place[1][0], depth]) @ axes
        distance = max(float(np.mean(z)) - depth, float(np.max(radii)), 1e-9)
        return cls(
            position, position + distance * axes[2], vertical_fov=vertical_fov, width=width, height=height
        )


def view_axes(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Rows: unit vectors to the right, upwards and forwards [W] of a view along `direction`, with z up.

    Raises:
        ValueError: If the direction is zero.
    """
    length = np.linalg.norm(direction)
    if not length > 0:
        raise ValueError("direction must not be zero")
    forward = direction / length
    right = np.cross(forward, (0.0, 0.0, 1.0))
    if np.linalg.norm(right) < 1e-6:
        # Straight up or down there is no z to keep up: y takes its place.
        right = np.cross(forward, (0.0, 1.0, 0.0))
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(right, forward), forward])
