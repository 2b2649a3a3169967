"""What photographs can tell: whether they fit together, and what of the object they do not show."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dano.checks import checked_count, checked_kind
from dano.maths import even_directions
from dano.vision.capture import Capture, check_masks, hull_distance, NodeGrid, object_box, View, viewed_ball
from dano.vision.radiance import Appearance, picture, Sampling, SurfaceModel
from dano.vision.training._metrics import mask_iou

BAD_RESIDUAL = 0.03
"""Share of the silhouettes that may fail to fit the hull before something must be wrong."""

_ONE_SIDE = np.radians(130)
"""Gap [rad] from which views are all from one side; photographs of something that stands on a table, from all
around and up to 40° above, leave 90° to 130° below."""

_MARGIN = 0.04
"""Kept free around the hull, as a share of its longest side."""


Corners = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]


class Survey(NamedTuple):
    """What the silhouettes tell before training."""

    box: NodeGrid  # Nodes around the object
    hull: Float[np.ndarray, "nx ny nz"]  # Signed distance [m] of the visual hull at these nodes
    # 1 − mean intersection over union of the hull's silhouettes and the masks: near 0 if poses, focal lengths
    # and masks fit together.
    residual: float
    gap: float  # Angle [rad] between the camera direction that is missing most and the nearest one there is
    gap_direction: Float[np.ndarray, "3"]  # That direction, from the object outwards [W], shape (3,)
    warnings: tuple[str, ...]  # Sentences for the user


def visual_hull(
    capture: Capture, resolution: int = 96, *, corners: Corners | None = None
) -> tuple[NodeGrid, Float[np.ndarray, "nx ny nz"]]:
    """What the silhouettes of the training views leave of space.

    Args:
        capture: Photographs with masks.
        resolution: Nodes along the longest side of the object's box.
        corners: Lower and upper corner of that box [m, W]; default: what the silhouettes leave.

    Returns:
        Nodes around the object, and the signed distance [m] of the hull at these nodes.

    Raises:
        ValueError: If masks are missing, empty or full, or the silhouettes have no point in common.
    """
    views = checked_kind("capture", capture, Capture).split("train")
    checked_count("resolution", resolution, least=4)
    if not capture.has_masks:
        names = [view.name for view in views if view.mask is None]
        raise ValueError(f"every view must have a mask, but {len(names)} have none: {', '.join(names[:4])}")
    check_masks(capture.views)
    lower, upper = object_box(views) if corners is None else corners
    margin = _MARGIN * float((upper - lower).max())
    box = NodeGrid.around(lower - margin, upper + margin, resolution)
    return box, hull_distance(views, box)


def survey(capture: Capture, resolution: int = 96, *, corners: Corners | None = None) -> Survey:
    """Check that a capture with masks fits together, and build the visual hull.

    Args:
        capture: Photographs with masks.
        resolution: Nodes along the longest side of the object's box.
        corners: Lower and upper corner of that box [m, W]; default: what the silhouettes of the training
            views leave.

    Raises:
        ValueError: If masks are missing, empty or full, or the silhouettes have no point in common.
    """
    views = checked_kind("capture", capture, Capture).split("train")
    box, hull = visual_hull(capture, resolution, corners=corners)
    residual = silhouette_residual(views, box, hull)
    gap, direction = widest_gap(views)
    warnings = []
    if residual > BAD_RESIDUAL:
        warnings.append(
            f"the silhouettes do not fit together: no shape explains {100 * residual:.1f} % of them"
            " (below 2 % is usual); check the focal length, the poses and the masks"
        )
    if gap > _ONE_SIDE:
        warnings.append(
            f"all {len(views)} views are from one side: nothing within {np.degrees(gap):.0f}° of the"
            f" direction {np.round(direction, 2).tolist()} is seen, and the shape there is a guess"
        )
    elif gap > np.pi / 3:
        warnings.append(
            f"no view within {np.degrees(gap):.0f}° of the direction {np.round(direction, 2).tolist()}:"
            " surfaces that face it are known by their outline only"
        )
    if len(views) < 8:
        warnings.append(f"only {len(views)} views to train on: expect a coarse shape")
    return Survey(box, hull, residual, gap, direction, tuple(warnings))


def silhouette_residual(views: Sequence[View], box: NodeGrid, hull: np.ndarray, most: int = 16) -> float:
    """1 − mean intersection over union of the hull's silhouettes with the masks, over up to `most` views."""
    appearance = Appearance.create(box, lit=False, n_features=1, resolution=4, width=1, key=jax.random.key(0))
    model = SurfaceModel.create(hull, box, appearance)
    chosen = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, most).round().astype(int))]
    scores = []
    for view in chosen:
        small = view.resized(max(1, min(view.image.shape[:2]) // 96))
        drawn = picture(
            model,
            small.camera,
            None,
            box,
            hull < 2 * box.spacing,
            4 / box.spacing,
            sampling=Sampling(64, 16, 1),
        )
        assert small.mask is not None
        scores.append(mask_iou(drawn.opacity, small.mask))
    return 1 - float(np.mean(scores))


def widest_gap(views: Sequence[View]) -> tuple[float, Float[np.ndarray, "3"]]:
    """Angle [rad] from the least covered direction to the nearest camera's, and that direction."""
    centre, _ = viewed_ball(views)
    towards = np.stack([view.camera.position - centre for view in views])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    sphere = even_directions(2000)
    nearest = np.arccos(np.clip((sphere @ towards.T).max(axis=1), -1, 1))
    worst = int(np.argmax(nearest))
    return float(nearest[worst]), sphere[worst]


def unseen_share(model: SurfaceModel, views: Sequence[View], n_points: int = 3000) -> float:
    """Share of the surface that fewer than two views see: facing them, in their image, and not hidden."""
    distances, box = model.distances, model.box
    near = np.argwhere(np.abs(distances) < 0.7 * box.spacing)
    if len(near) == 0:
        return 1.0
    near = near[np.random.default_rng(0).choice(len(near), min(n_points, len(near)), replace=False)]
    slope = np.stack(list(np.gradient(distances, box.spacing)), axis=-1)[tuple(near.T)]
    normal = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
    points = box.origin + box.spacing * near
    points = points - normal * distances[tuple(near.T)][:, None]
    count = np.zeros(len(points), int)
    reach = 2 * float(model.scale)
    for view in views:
        towards = view.camera.position - points
        length = np.linalg.norm(towards, axis=1, keepdims=True)
        towards = towards / length
        image = view.camera.project(points)
        with np.errstate(invalid="ignore"):
            inside = np.all((image[:, :2] > 0) & (image[:, :2] < [view.camera.width, view.camera.height]), 1)
        facing = np.einsum("ij,ij->i", towards, normal) > 0.15
        # From a little above the surface, out to where the box surely ends.
        t = box.spacing * 1.5 + reach * (np.arange(48) + 0.5) / 48
        clear = _clear(model, *(jnp.asarray(a, jnp.float32) for a in (points, towards, t)))
        count += inside & facing & (np.asarray(clear) > -0.3 * box.spacing)
    return float(np.mean(count < 2))


@jax.jit
def _clear(model, points, towards, t):
    """Least distance [m] to the surface along rays from points."""

    def lower(least, step):
        at = points + step * towards
        u = (at - model.origin[None]) / model.spacing
        inside = jnp.all(
            (u >= 0) & (u <= jnp.asarray(np.array(model.distance.shape) - 1, u.dtype)[None]), axis=1
        )
        return jnp.minimum(least, jnp.where(inside, model.distance_at(at), 1e3)), None

    return jax.lax.scan(lower, jnp.full(len(points), 1e3, jnp.float32), t)[0]
