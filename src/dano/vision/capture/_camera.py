"""Pinhole cameras: one that keeps z up and looks at a point, one that a photograph was taken with."""

import abc
import math
from typing import Any, TypeVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from dano.checks import checked_count, checked_number
from dano.maths import checked_array, checked_numbers, is_traced, Numbers

Slopes = TypeVar("Slopes", np.ndarray, Array)

_NEWTON, _EXACT = 8, 1e-12
"""Steps at most, and the miss in slopes that ends them, of what undoes a distortion (convention)."""

_STEP = 1e-30
"""Imaginary step of derivatives: its square is nothing beside one (convention)."""

_ROTATION_TOLERANCE = 1e-3
"""By which the columns of a pose may fail to be orthonormal: what files with four digits round off."""


class AbstractCamera(eqx.Module):
    """A camera with a centre of projection.

    Pixel (0, 0) is the upper left one; its centre lies at image coordinates (0.5, 0.5).

    Attributes:
        position: Centre of projection [m, W], shape (3,).
        width: Image width [pixels].
        height: Image height [pixels].
        axes: Rows: unit vectors to the right, upwards and forwards [W], shape (3, 3).
    """

    position: eqx.AbstractVar[Float[np.ndarray, "3"]]
    width: eqx.AbstractVar[int]
    height: eqx.AbstractVar[int]
    axes: eqx.AbstractVar[Float[np.ndarray, "3 3"]]

    @property
    @abc.abstractmethod
    def pixel_angle(self) -> float:
        """Angle that a pixel in the middle of the image spans [rad]."""

    @abc.abstractmethod
    def directions(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """Unit directions [W] of rays through image coordinates (x to the right, y downwards) [pixels]."""

    @abc.abstractmethod
    def project(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Image coordinates x, y [pixels] and depth along the optical axis [m] of points [m, W].

        Points that are not in front of the camera have no image: NaN.
        """

    def rays(self) -> Float[np.ndarray, "height width 3"]:
        """Unit directions [W] of the rays from `position` through all pixel centres."""
        y, x = np.mgrid[: self.height, : self.width] + 0.5
        return self.directions(np.stack([x.ravel(), y.ravel()], axis=1)).reshape(self.height, self.width, 3)


class Camera(AbstractCamera):
    """A pinhole camera that keeps z up.

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
        self.vertical_fov = checked_number("vertical_fov", vertical_fov)
        self.width, self.height = checked_count("width", width), checked_count("height", height)
        if not np.linalg.norm(self.look_at - self.position) > 0:
            raise ValueError(f"look_at must differ from position, got {self.position.tolist()} twice")
        if not 0 < self.vertical_fov < math.pi:
            raise ValueError(f"vertical_fov must lie in (0, π) rad, got {vertical_fov}")

    @property
    def axes(self) -> Float[np.ndarray, "3 3"]:  # pyright: ignore[reportIncompatibleVariableOverride]
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


class PosedCamera(AbstractCamera):
    """The camera of a photograph: any orientation, measured intrinsics, lens distortion (OpenCV's model).

    A direction with slopes x, y to the right and downwards has the image coordinates

        (fₓ x_d + cₓ, f_y y_d + c_y),  r² = x² + y²,
        x_d = x (1 + k₁r² + k₂r⁴ + k₃r⁶) + 2 p₁ x y + p₂ (r² + 2x²), y_d likewise with p₁ and p₂ exchanged.

    Attributes:
        position: Centre of projection [m, W], shape (3,).
        axes: Rows: unit vectors to the right, upwards and forwards [W], shape (3, 3).
        focal: Focal lengths fₓ, f_y [pixels], shape (2,).
        centre: Principal point cₓ, c_y [pixels], shape (2,).
        distortion: k₁, k₂, k₃, p₁, p₂, shape (5,).
        width: Image width [pixels].
        height: Image height [pixels].
    """

    position: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    focal: Float[np.ndarray, "2"]
    centre: Float[np.ndarray, "2"]
    distortion: Float[np.ndarray, "5"]
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)

    def __init__(
        self,
        camera_to_world: Numbers,
        *,
        focal: Numbers,
        width: int,
        height: int,
        centre: Numbers | None = None,
        distortion: Numbers = (0.0, 0.0, 0.0, 0.0, 0.0),
    ):
        """Place a camera.

        Args:
            camera_to_world: Matrix (4, 4) or (3, 4) with OpenGL's axes, as nerfstudio, instant-ngp and
                Blender write it: columns to the right, upwards, backwards, and the position [m, W].
            focal: Focal length [pixels], a number or one per axis.
            width: Image width [pixels].
            height: Image height [pixels].
            centre: Principal point [pixels]; default the middle of the image.
            distortion: k₁, k₂, k₃, p₁, p₂.

        Raises:
            ValueError: If the pose is not a rotation and translation, a focal length is not positive, the
                image is empty, or the distortion folds the image over itself.
        """
        pose = checked_numbers("camera_to_world", camera_to_world)
        if pose.shape not in ((4, 4), (3, 4)) or not np.all(np.isfinite(pose)):
            raise ValueError(f"camera_to_world must be finite with shape (4, 4) or (3, 4), got {pose.shape}")
        rotation = pose[:3, :3]
        off = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
        if off > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
            what = "a reflection" if off <= _ROTATION_TOLERANCE else f"off by {off:.2g} from one"
            raise ValueError(f"camera_to_world must hold a rotation, got {what}: {rotation.tolist()}")
        # Files round; the closest rotation.
        u, _, vt = np.linalg.svd(rotation)
        self.axes = (u @ vt).T * np.array([1.0, 1.0, -1.0])[:, None]
        self.position = pose[:3, 3].copy()
        lengths = checked_numbers("focal", focal)
        if lengths.shape not in ((), (2,)):
            raise ValueError(f"focal must be a number or two, one per axis, got shape {lengths.shape}")
        self.focal = np.broadcast_to(lengths, (2,)).copy()
        self.width, self.height = checked_count("width", width), checked_count("height", height)
        middle = (0.5 * self.width, 0.5 * self.height)
        self.centre = np.asarray(
            checked_array("centre", middle if centre is None else centre, (2,)), dtype=np.float64
        )
        self.distortion = np.asarray(checked_array("distortion", distortion, (5,)), dtype=np.float64)
        if not (np.all(np.isfinite(self.focal)) and np.all(self.focal > 0)):
            raise ValueError(f"focal must be positive [pixels], got {self.focal.tolist()}")
        if np.any(self.distortion):
            corners = np.array([[0, 0], [self.width, 0], [0, self.height], [self.width, self.height]])
            slopes = _undistorted((corners - self.centre) / self.focal, self.distortion)
            again = _distorted(slopes, self.distortion) * self.focal + self.centre
            if not np.allclose(again, corners, atol=0.01):
                raise ValueError(
                    "distortion must be invertible over the whole image, got"
                    f" {self.distortion.tolist()} for {self.width} × {self.height} pixels"
                )

    @property
    def pixel_angle(self) -> float:
        """Angle that a pixel in the middle of the image spans [rad]."""
        return 1 / float(np.mean(self.focal))

    def slopes(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Slopes to the right and downwards of the directions of image coordinates [pixels]."""
        slopes = (np.asarray(pixels, dtype=np.float64) - self.centre) / self.focal
        return _undistorted(slopes, self.distortion) if np.any(self.distortion) else slopes

    def directions(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """See `AbstractCamera.directions`."""
        return self.towards(self.slopes(pixels))

    def towards(self, slopes: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """Unit vectors [W] with slopes to the right and downwards."""
        right, up, forward = self.axes
        towards = forward + slopes[:, :1] * right - slopes[:, 1:] * up
        return towards / np.linalg.norm(towards, axis=1, keepdims=True)

    def project(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """See `AbstractCamera.project`."""
        local = (np.asarray(points, dtype=np.float64) - self.position) @ self.axes.T
        depth = np.where(local[:, 2] > 0, local[:, 2], np.nan)
        slopes = np.stack([local[:, 0], -local[:, 1]], axis=1) / depth[:, None]
        if np.any(self.distortion):
            slopes = _distorted(slopes, self.distortion)
        return np.concatenate([slopes * self.focal + self.centre, depth[:, None]], axis=1)

    @property
    def pose(self) -> Float[np.ndarray, "3 4"]:
        """`camera_to_world` of the constructor, without its last row."""
        return np.concatenate([self.axes.T * np.array([1.0, 1.0, -1.0]), self.position[:, None]], axis=1)

    def replaced(self, **arguments: Any) -> "PosedCamera":
        """This camera with other values of some of the constructor's arguments."""
        own = {
            "camera_to_world": self.pose,
            "focal": self.focal,
            "width": self.width,
            "height": self.height,
            "centre": self.centre,
            "distortion": self.distortion,
        }
        return PosedCamera(**{**own, **arguments})


def distorted(x: Slopes, y: Slopes, coefficients: Slopes) -> tuple[Slopes, Slopes]:
    """What a lens makes of slopes, as `PosedCamera` says; for arrays of NumPy and of JAX.

    Args:
        x: Slopes to the right, of any shape.
        y: Slopes downwards, of the same shape.
        coefficients: k₁, k₂, k₃, p₁, p₂.

    Returns:
        The slopes x_d, y_d of the image.
    """
    k1, k2, k3, p1, p2 = coefficients
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    return (
        x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
        y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
    )


def _distorted(slopes: Float[np.ndarray, "n 2"], coefficients: np.ndarray) -> Float[np.ndarray, "n 2"]:
    x, y = slopes.T
    return np.stack(distorted(x, y, coefficients), axis=1)


def _undistorted(image: Float[np.ndarray, "n 2"], coefficients: np.ndarray) -> Float[np.ndarray, "n 2"]:
    """Slopes whose image is known, by Newton's method."""
    slopes = image.copy()
    for _ in range(_NEWTON):
        miss = _distorted(slopes, coefficients) - image
        if np.max(np.abs(miss), initial=0.0) < _EXACT:
            break
        across, cross, down = _slopes_of_distorted(slopes, coefficients)
        determinant = across * down - cross * cross
        # Beyond the fold of a strong distortion there is no solution; the constructor has checked.
        determinant = np.where(np.abs(determinant) < 1e-9, 1e-9, determinant)
        step = (down * miss[:, 0] - cross * miss[:, 1], across * miss[:, 1] - cross * miss[:, 0])
        slopes = slopes - np.stack(step, axis=1) / determinant[:, None]
    return slopes


def _slopes_of_distorted(
    slopes: Float[np.ndarray, "n 2"], coefficients: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """∂x_d/∂x, ∂x_d/∂y = ∂y_d/∂x, and ∂y_d/∂y of `distorted`: exact for polynomials, by an imaginary step."""
    x, y = slopes.T
    across, cross = distorted(x + 1j * _STEP, y, coefficients)
    _, down = distorted(x, y + 1j * _STEP, coefficients)
    return np.imag(across) / _STEP, np.imag(cross) / _STEP, np.imag(down) / _STEP


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
