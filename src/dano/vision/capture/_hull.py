"""The visual hull: what all silhouettes leave of space (Laurentini 1994), as a signed distance on a grid."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from dano.fields import large_parts, redistanced
from dano.vision.capture._camera import distorted, PosedCamera
from dano.vision.capture._capture import View
from dano.vision.capture._node_grid import NodeGrid

LOST = 0.02
"""Share of the views that may miss a point of the object: one bad mask does not cut a hole into it."""

_SOME = 8
"""Photographs from which one can be spared."""

# Points per call, and the multiple to which the last call is filled, so that few sizes are compiled.
_CHUNK = 1 << 18
_GRANULE = 1 << 14


def silhouettes(
    points: Float[np.ndarray, "n 3"], views: Sequence[View], lost: float = LOST, spare: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """How many views see points [m, W], and how well the silhouettes of those views cover them.

    Returns:
        Number of views that have each point in their image, (n,), and the value that all of these masks but
        the share `lost` of them, or `spare` if that is more, reach at it, (n,): above ½ for points of the
        hull, 1 where no view looks.
    """
    masked = [(view, view.possible) for view in views if view.possible is not None]
    size = max(max(possible.shape) for _, possible in masked)
    n_spare = min(max(int(lost * len(masked)), spare), len(masked) - 1)
    seen, least = [], []
    for start in range(0, len(points), _CHUNK):
        part = points[start : start + _CHUNK]
        # Whole chunks, or the last would be compiled anew for each number of points.
        padded = np.pad(part, ((0, -len(part) % _GRANULE), (0, 0))).T.astype(np.float32)
        n_seen = jnp.zeros(padded.shape[1], jnp.int32)
        lowest = jnp.ones((n_spare + 1, padded.shape[1]), jnp.float32)
        for view, possible in masked:
            mask = np.zeros((size, size), np.float32)
            mask[: view.camera.height, : view.camera.width] = possible
            n_seen, lowest = _carve(mask, _numbers(view.camera), padded, n_seen, lowest)
        seen.append(np.asarray(n_seen)[: len(part)])
        least.append(np.asarray(lowest[n_spare])[: len(part)])
    return np.concatenate(seen), np.concatenate(least)


def _numbers(camera: PosedCamera) -> tuple[np.ndarray, ...]:
    parts = camera.position, camera.axes, camera.focal, camera.centre, camera.distortion
    return *(part.astype(np.float32) for part in parts), np.array([camera.width, camera.height], np.float32)


@jax.jit
def _carve(mask, camera, points, seen, lowest):
    """Take one view into account: `lowest` holds the lowest mask values so far, ascending."""
    inside, cover = sampled(mask[..., None], camera, points)
    cover = jnp.where(inside, cover[0], 1)
    rows = []
    for row in lowest:
        rows.append(jnp.minimum(row, cover))
        cover = jnp.maximum(row, cover)
    return seen + inside.astype(seen.dtype), jnp.stack(rows)


def sampled(
    picture: Float[Array, "height width k"], camera: tuple[Array, ...], points: Float[Array, "3 n"]
) -> tuple[Bool[Array, " n"], Float[Array, "k n"]]:
    """Whether points [m, W] are in an image, and the picture's values there, linear between pixel centres.

    Args:
        picture: Values of the pixels, which may be padded at the end of both axes.
        camera: What `_numbers` makes of one.
        points: One a column.
    """
    position, axes, focal, centre, distortion, size = camera
    local = axes @ (points - position[:, None])
    ahead = local[2] > 1e-9
    right, up = (local[i] / jnp.where(ahead, local[2], 1) for i in (0, 1))
    x, y = distorted(right, -up, distortion)
    x, y = x * focal[0] + centre[0], y * focal[1] + centre[1]
    inside = ahead & (x >= 0) & (x <= size[0]) & (y >= 0) & (y <= size[1])
    x, y = jnp.clip(x - 0.5, 0, size[0] - 1), jnp.clip(y - 0.5, 0, size[1] - 1)
    # A far-off point has a far-off image, which an integer cannot hold.
    x, y = (jnp.where(inside, a, 0) for a in (x, y))
    left, top = (jnp.floor(a).astype(jnp.int32) for a in (x, y))
    right = jnp.minimum(left + 1, size[0].astype(jnp.int32) - 1)
    bottom = jnp.minimum(top + 1, size[1].astype(jnp.int32) - 1)
    u, v = (x - left.astype(x.dtype))[:, None], (y - top.astype(y.dtype))[:, None]
    flat = picture.reshape(-1, picture.shape[2])

    def at(row: Array, column: Array) -> Array:
        return flat.at[row * np.int32(picture.shape[1]) + column].get(mode="promise_in_bounds")

    upper = (1 - u) * at(top, left) + u * at(top, right)
    lower = (1 - u) * at(bottom, left) + u * at(bottom, right)
    return inside, ((1 - v) * upper + v * lower).T


def object_box(views: Sequence[View]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner [m, W] of a box around the hull of the silhouettes, with a margin.

    Starts from the ball around the point that the optical axes come closest to, out to the cameras, and
    shrinks to what the silhouettes leave, until it no longer changes.

    Raises:
        ValueError: If the silhouettes have no point in common.
    """
    centre, radius = viewed_ball(views)
    lower, upper = centre - radius, centre + radius
    for _ in range(6):
        box = NodeGrid.around(lower, upper, 64)
        seen, cover = silhouettes(box.nodes, views)
        # Half a cell may hide a thin part: anything near a silhouette counts.
        inside = ((cover > 0.5) & (seen >= 0.5 * len(views))).reshape(box.shape)
        if not inside.any():
            raise ValueError(
                "the silhouettes of the views must have a point in common, but no point near"
                f" {np.round(centre, 4).tolist()} lies in all masks: the poses, the focal length or the masks"
                " do not fit together"
            )
        index = np.argwhere(inside)
        new_lower = np.maximum(box.origin + box.spacing * (index.min(0) - 1.5), lower)
        new_upper = np.minimum(box.origin + box.spacing * (index.max(0) + 1.5), upper)
        shrunk = float(np.max(new_upper - new_lower) / np.max(upper - lower))
        lower, upper = new_lower, new_upper
        if shrunk > 0.9:
            break
    return lower, upper


def viewed_ball(views: Sequence[View]) -> tuple[np.ndarray, float]:
    """The point [m, W] closest to all optical axes, and the distance [m] of the nearest camera to it."""
    positions = np.stack([view.camera.position for view in views])
    forward = np.stack([view.camera.axes[2] for view in views])
    across = np.eye(3)[None] - forward[:, :, None] * forward[:, None, :]
    # Parallel axes leave the depth open; a weak pull to one camera distance keeps the system regular.
    matrix = across.sum(0)
    centre = np.linalg.lstsq(matrix, np.einsum("nij,nj->i", across, positions), rcond=1e-6)[0]
    return centre, float(np.linalg.norm(positions - centre, axis=1).min())


def spare_of(n_views: int, lost: float = LOST) -> int:
    """How many photographs may be wrong about a point where masks are doubted: at least one of some."""
    return max(int(lost * n_views), int(n_views >= _SOME))


def hull_distance(
    views: Sequence[View], box: NodeGrid, lost: float = LOST, *, spare: int = 0
) -> Float[np.ndarray, "nx ny nz"]:
    """Signed distance [m] of the visual hull at the nodes of a grid, accurate to a fraction of a cell.

    Of all masks but the share `lost`, or `spare` if that is more, which may be wrong. The least value of the
    others crosses ½ on the hull; where it does along the grid's edges lie points of the surface, and a node's
    distance is that to the nearest of them.

    Raises:
        ValueError: If no node is inside.
    """
    _, cover = silhouettes(box.nodes, views, lost, spare)
    value = cover.reshape(box.shape) - 0.5
    # Outside on the border, so that the hull is closed where no view looks.
    border = np.ones(box.shape, dtype=bool)
    border[1:-1, 1:-1, 1:-1] = False
    value[border] = np.minimum(value[border], -0.5)
    inside = value > 0
    if not inside.any():
        raise ValueError("the silhouettes leave nothing of the box: the object is thinner than a cell")
    # Crumbs of few views' silhouettes are not objects; parts of some size stay.
    crumbs = inside & ~large_parts(inside, 0.02)
    return redistanced(np.where(crumbs, 1e-3, -value), box.spacing)
