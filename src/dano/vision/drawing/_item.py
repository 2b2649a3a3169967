"""What a picture shows: fields made ready to be drawn, once, and then moved about."""

from typing import TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from scipy import ndimage

from dano import fields, maths
from dano.checks import checked_number, checked_optional
from dano.native import is_known
from dano.vision import radiance

PALETTE = ("#e07a3f", "#3d7ea6", "#5f9e6e", "#c9a227", "#8d6cab", "#c8553d", "#4aa3a2", "#7a8450")
"""Colours for objects that state none, matte and different from each other in lightness too."""

# Nodes along the longest side of the signed distance of a density: finer than a pixel needs at usual image
# sizes.
_MOST_NODES = 112
_BAKE_NODES = 96


M = TypeVar("M", bound=eqx.Module)


class Item(eqx.Module):
    """A field, where it is, and how it looks."""

    # What is drawn of a solid, in float32: the field itself if it is a shape, else the signed distance of its
    # level surface; None if it is translucent.
    shape: fields.AbstractShape | None
    # The density that is drawn as a translucent medium of one colour, in float32, else None.
    medium: fields.GridField | None
    model: radiance.AbstractModel | None  # The look that photographs taught, else None
    sharpness: float  # Of the model's surface [1/m], if it has one
    pose: maths.Pose  # Field frame → world
    colour: Float[np.ndarray, "3"]  # sRGB in [0, 1], shape (3,)
    density_scale: float  # Extinction [1/m] of a medium per unit of its density
    centre: Float[np.ndarray, "3"]  # Middle of a ball around the item [m, F]; zero for a half-space
    radius: float  # Radius of that ball [m]; infinite for a half-space

    def __init__(
        self,
        field: fields.AbstractField | radiance.AbstractModel,
        pose: maths.Pose | None = None,
        colour: str | maths.Numbers | None = None,
        *,
        level: int | float | None = None,
        density_scale: int | float | None = None,
        sharpness: int | float | None = None,
    ):
        """Make a field ready for drawing; what takes time happens here and not per picture.

        Args:
            field: A shape, which is drawn as it is, a density, or what was learned from photographs: a
                `LearnedField` or a model, which keep their look unless a colour is given.
            pose: Field frame → world; default the identity.
            colour: "#rrggbb" or three numbers in [0, 1]; default: the first of `PALETTE`, white for a
                half-space.
            level: Density at which the surface of a solid lies; default: half the median of what the field
                holds.
            density_scale: If given, the field is not a solid but a medium with extinction density_scale · φ
                [1/m].
            sharpness: Of the surface of a `SurfaceModel` [1/m]; default: its opacity rises over half a cell.

        Raises:
            ValueError: If the field is unbounded and no half-space, it nowhere reaches `level`, both
                `level` and `density_scale` are given, or a number is out of range.
        """
        if not isinstance(field, fields.AbstractField | radiance.AbstractModel):
            raise ValueError(f"field must be a dano field (an AbstractField), got {type(field).__name__}")
        if isinstance(field, radiance.AbstractModel) and (level is not None or density_scale is not None):
            raise ValueError("level and density_scale apply to fields, got one for a model")
        if level is not None and density_scale is not None:
            raise ValueError(
                f"level (a solid) excludes density_scale (a medium), got {level} and {density_scale}"
            )
        for name, value in (
            ("level", level),
            ("density_scale", density_scale),
            ("sharpness", sharpness),
        ):
            if value is not None:
                checked_number(name, value, above=0)
        self.pose = checked_optional("pose", pose, maths.Pose) or maths.Pose()
        self.density_scale = 0.0 if density_scale is None else float(density_scale)
        self.shape = self.medium = self.model = None
        self.sharpness = 0.0
        model, solid = _learned(field)
        if model is not None and level is None and density_scale is None and colour is None:
            self.model = _single(model)
            self.sharpness = _drawn_sharpness(field) if sharpness is None else float(sharpness)
        if isinstance(field, radiance.AbstractModel):
            if solid is None and colour is not None:
                raise ValueError(
                    f"colour applies to solids and fields, got {colour!r} for a {type(field).__name__}"
                )
            self.shape = solid if solid is None else _single(solid)
            drawn = field if solid is None else solid
        elif density_scale is not None:
            self.medium = drawn = _single(_grid(field))
        elif solid is not None and level is None:
            self.shape = drawn = _single(solid)
        elif isinstance(field, fields.AbstractShape):
            self.shape = drawn = _single(_without_moments(_traceable(field)))
        else:
            self.shape = drawn = _single(level_surface(_grid(field), level))
        lower, upper = np.asarray(drawn.bounds, dtype=np.float64)
        bounded = bool(np.all(np.isfinite([lower, upper])))
        self.centre = 0.5 * (lower + upper) if bounded else np.zeros(3)
        self.radius = 0.5 * float(np.linalg.norm(upper - lower)) if bounded else float("inf")
        if colour is None:
            colour = PALETTE[0] if self.plane is None else "#ffffff"
        self.colour = checked_colour(colour)
        if not bounded and self.plane is None:
            raise ValueError(f"field must have finite bounds or be a half-space, got {type(field).__name__}")

    def at(self, pose: maths.Pose) -> "Item":
        """The same item elsewhere."""
        return eqx.tree_at(lambda item: item.pose, self, pose)

    @property
    def plane(self) -> Float[np.ndarray, "4"] | None:
        """Unit normal and offset [m] of a half-space in the world; None for anything else."""
        shape, pose = self.shape, self.pose
        while isinstance(shape, fields.PosedShape):
            shape, pose = shape.shape, pose.compose(_as(shape.pose, pose.position.dtype))
        if not isinstance(shape, fields.HalfSpace):
            return None
        rotation, position = placement(pose)
        normal = rotation @ np.asarray(shape.normal_direction, dtype=np.float64)
        return np.append(normal, float(shape.offset) + normal @ position)

    @property
    def placed_ball(self) -> tuple[np.ndarray, float]:
        """Centre [m, W] and radius [m] of a ball around the item."""
        rotation, position = placement(self.pose)
        return rotation @ self.centre + position, self.radius


def placement(pose: maths.Pose) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Rotation matrix and translation of a pose on the host, where one picture needs them many times."""
    rotation = maths.quat_to_matrix(np.asarray(pose.orientation, dtype=np.float64))
    return rotation, np.asarray(pose.position, dtype=np.float64)


def checked_colour(colour: str | maths.Numbers, name: str = "colour") -> Float[np.ndarray, "3"]:
    """A colour as sRGB in [0, 1].

    Raises:
        ValueError: If it is neither "#rrggbb" nor three numbers in [0, 1].
    """
    if isinstance(colour, str):
        digits = colour.removeprefix("#")
        try:
            value = np.array([int(digits[i : i + 2], 16) for i in (0, 2, 4)]) / 255
        except ValueError:
            value = None
        if value is None or len(digits) != 6:
            raise ValueError(f"{name} must be '#rrggbb' or three numbers in [0, 1], got {colour!r}")
        return value
    value = np.asarray(maths.checked_array(name, colour, (3,)), dtype=np.float64)
    if value.min() < 0 or value.max() > 1:
        raise ValueError(f"{name} must have numbers in [0, 1], got {value.tolist()}")
    return value


def level_surface(field: fields.GridField, level: int | float | None = None) -> fields.SignedDistanceGrid:
    """The solid {φ ≥ level} of a grid as a signed distance, smooth enough to be shaded.

    The density φ/(φ + level), which is ½ on the surface and blind to how dense the inside is, is blurred
    by less than a cell; where it crosses ½ along the edges of the grid lie points of the surface, with
    normals. A node's distance is that to the tangent plane of the nearest of them if it is near, else that
    to the point.

    Args:
        field: The density.
        level: Default: `usual_level`.

    Raises:
        ValueError: If the density nowhere reaches `level`.
    """
    values = np.asarray(field.values, dtype=np.float64)
    spacing = np.asarray(field.spacing, dtype=np.float64)
    level = usual_level(values) if level is None else level
    inside = np.argwhere(values >= level)
    if len(inside) == 0:
        raise ValueError(f"level must be at most the largest density {values.max():.6g}, got {level:.6g}")
    low, high = np.maximum(inside.min(0) - 4, 0), inside.max(0) + 5
    before = np.maximum(4 - inside.min(0), 0)
    after = np.maximum(inside.max(0) + 5 - np.array(values.shape), 0)
    values = values[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    values = np.pad(values, list(zip(before, after, strict=True)))
    origin = np.asarray(field.origin, dtype=np.float64) + spacing * (low - before)
    share = values / (values + level)
    if max(share.shape) > _MOST_NODES:
        factor = _MOST_NODES / max(share.shape)
        target = np.maximum(np.ceil(np.array(share.shape) * factor).astype(int), 8)
        step = (np.array(share.shape) - 1) / (target - 1)
        share = ndimage.zoom(
            ndimage.gaussian_filter(share, 0.4 * step), target / np.array(share.shape), order=1
        )
        spacing = spacing * step
    share = ndimage.gaussian_filter(share, 0.8)
    # A thin wall may not survive the blur; the surface then moves to where half of the peak is left.
    peak = float(share.max())
    middle = 0.5 if peak > 0.5 else 0.5 * peak
    distance = fields.redistanced(middle - share, spacing)
    return fields.SignedDistanceGrid(
        distance.astype(np.float32), origin.astype(np.float32), spacing.astype(np.float32), edge=0.0
    )


def usual_level(values: Float[np.ndarray, "nx ny nz"]) -> float:
    """Where a surface is drawn if nobody says it: half the median of densities above 5 % of the largest."""
    return 0.5 * float(np.median(values[values > 0.05 * values.max()]))


def _learned(
    field: fields.AbstractField | radiance.AbstractModel,
) -> tuple[radiance.AbstractModel | None, fields.AbstractShape | None]:
    """The look of what was learned from photographs, and its solid if it has one."""
    if isinstance(field, radiance.LearnedField):
        return field.model, field.solid
    if isinstance(field, radiance.SurfaceModel):
        box = field.box
        return field, fields.SignedDistanceGrid(field.distances, box.origin, box.spacing)
    return (field, None) if isinstance(field, radiance.AbstractModel) else (None, None)


def _drawn_sharpness(field: fields.AbstractField | radiance.AbstractModel) -> float:
    if isinstance(field, radiance.LearnedField):
        return float(field.drawn_sharpness)
    return 4 / float(field.spacing) if isinstance(field, radiance.SurfaceModel) else 0.0


def _grid(field: fields.AbstractField) -> fields.GridField:
    if isinstance(field, fields.GridField):
        return field
    if not np.all(np.isfinite(np.asarray(field.bounds))):
        raise ValueError(f"field must have finite bounds to be drawn, got {type(field).__name__}")
    return fields.bake(field, _BAKE_NODES).grid


def _traceable(shape: fields.AbstractShape) -> fields.AbstractShape:
    """The shape, or its distances on a grid where kernels do not know it."""
    if is_known(shape) or not np.all(np.isfinite(np.asarray(shape.bounds))):
        return shape
    lower, upper = np.asarray(shape.bounds, np.float64)
    spacing = float((upper - lower).max()) / (_MOST_NODES - 1)
    lower = lower - 2 * spacing
    counts = np.ceil((upper - lower) / spacing).astype(int) + 3
    nodes = lower[:, None] + spacing * np.indices(counts).reshape(3, -1)
    distances = np.asarray(jax.jit(lambda x: shape.sdf_jet(x, 0))(nodes)).reshape(counts)
    return fields.SignedDistanceGrid(distances, lower, spacing, edge=0.0)


def _without_moments(shape: fields.AbstractShape) -> fields.AbstractShape:
    if isinstance(shape, fields.SignedDistanceGrid) and shape.moments is not None:
        return eqx.tree_at(lambda s: s.moments, shape, None)
    return shape


def _single(module: M) -> M:
    return _as(module, np.dtype(np.float32))


def _as(module: M, dtype: np.dtype) -> M:
    return jax.tree.map(lambda x: maths.on_device(np.asarray(x, dtype)), module)
