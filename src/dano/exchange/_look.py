"""What an object looks like, as other programs know it: one picture that is laid on the triangles."""

from typing import NamedTuple, TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from dano.exchange._triangles import Triangles

if TYPE_CHECKING:
    from dano.vision import LearnedField

PLAIN = (0.85, 0.73, 0.61)
"""sRGB of an object of which only its density is known."""

_TILT = 0.7
"""Angle [rad] of the lamps to the normal: what is seen under them is neither glare nor shadow."""
_N_LAMPS = 3
"""The fewest that leave no side in shadow."""
_AT_ONCE = 1 << 15
"""Points per call: some MB of intermediates."""
_LEAST_CELL = 6
"""Texels along the square that two triangles share."""


class Texture(NamedTuple):
    """A picture and where on it the triangles are."""

    image: UInt8[np.ndarray, "n n 3"]  # sRGB, first row at the top, shape (n, n, 3)
    # Coordinates (u, v) of the corners of each face, from the lower left, shape (f, 3, 2).
    corners: Float[np.ndarray, "f 3 2"]


def colours_at(
    look: "LearnedField", points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Colours of places on the surface, without highlights as far as a look can be asked for that.

    The mean over lamps around the normal, seen along the normal. A look that was learned from photographs
    under unknown light has that light in it.

    Args:
        look: What photographs have taught.
        points: [m, F].
        normals: Unit outward normals.

    Returns:
        sRGB in [0, 1].
    """
    appearance = look.model.appearance
    size = min(_AT_ONCE, len(points))
    found = []
    # Lamps that were places stood some sizes away.
    reach = 3 * float(jnp.max(look.bounds[1] - look.bounds[0])) if appearance.near_light else 0.0
    for start in range(0, len(points), max(size, 1)):
        n = len(points[start : start + size])
        at, outward = (_filled(array[start : start + size], size) for array in (points, normals))
        found.append(np.asarray(_seen(appearance, at, outward, reach))[:n])
    return np.concatenate(found).astype(np.float64) if found else np.zeros((0, 3))


def _filled(rows: np.ndarray, size: int) -> Float[Array, "n 3"]:
    """Rows as one call takes them: single precision, the last one repeated."""
    padding = np.broadcast_to(rows[-1:], (size - len(rows), 3))
    return jnp.asarray(np.concatenate([rows, padding]), jnp.float32)


@eqx.filter_jit
def _seen(appearance, points, normals, reach):
    if not appearance.lit:
        return appearance(points, normals, -normals, normals, 0.0)
    aside = jnp.where(jnp.abs(normals[:, :1]) < 0.7, jnp.eye(3)[None, 0], jnp.eye(3)[None, 1])
    first = jnp.cross(normals, aside.astype(normals.dtype))
    first = first / jnp.linalg.norm(first, axis=1, keepdims=True)
    second = jnp.cross(normals, first)
    total = jnp.zeros_like(points)
    for angle in 2 * np.pi * np.arange(_N_LAMPS) / _N_LAMPS:
        around = float(np.cos(angle)) * first + float(np.sin(angle)) * second
        lamp = float(np.cos(_TILT)) * normals + float(np.sin(_TILT)) * around
        lamp = jnp.where(reach > 0, points + reach * lamp, lamp)
        total = total + appearance(points, normals, -normals, lamp, 0.0)
    return total / _N_LAMPS


def painted(look: "LearnedField", mesh: Triangles, normals: Float[np.ndarray, "v 3"], side: int) -> Texture:
    """Lay the colours of a look on a mesh: two triangles share a square of the picture.

    Args:
        look: What photographs have taught.
        mesh: At least one face.
        normals: At the vertices.
        side: Texels along the picture; more if triangles would get too few.
    """
    pairs = -(-len(mesh.faces) // 2)
    columns = int(np.ceil(np.sqrt(pairs)))
    cell = max(_LEAST_CELL, side // columns)
    leg = cell - 3  # a texel's width between the two triangles, for programs that interpolate
    face = np.arange(len(mesh.faces))
    left, bottom = cell * (face // 2 % columns), cell * (face // 2 // columns)
    upper = face % 2 == 1
    row, column = np.mgrid[0:cell, 0:cell].reshape(2, -1)
    size = columns * cell
    image = np.zeros((size, size, 3), np.uint8)
    for second in (False, True):
        mine = upper == second
        # The second triangle is the first turned by half a turn.
        x, y = (cell - 1 - column, cell - 1 - row) if second else (column, row)
        own = x + y <= cell - 2 + second
        u, v = x[own] / leg, y[own] / leg
        weights = np.stack([1 - u - v, u, v], axis=1)
        corners, at = mesh.corners[mine], normals[mesh.faces[mine]]
        points = np.einsum("tk,fkd->ftd", weights, corners).reshape(-1, 3)
        across = np.einsum("tk,fkd->ftd", weights, at).reshape(-1, 3)
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        colour = np.rint(255 * np.clip(colours_at(look, points, across), 0, 1)).astype(np.uint8)
        i = (bottom[mine][:, None] + row[own][None]).ravel()
        j = (left[mine][:, None] + column[own][None]).ravel()
        image[size - 1 - i, j] = colour
    ends = np.array([[0, 0], [leg, 0], [0, leg]], np.float64)
    inner = np.where(upper[:, None, None], cell - 1 - ends[None], ends[None])
    corners = (np.stack([left, bottom], axis=1)[:, None] + inner + 0.5) / size
    return Texture(image, corners)
