"""How far two solids are apart, or how deep they overlap, where, and in which direction.

With signed distances φ_A and φ_B in world coordinates, negative inside,

    d = min_x φ_A(x) + φ_B(x).

Apart, the minimum is attained on the segment between the nearest points and is its length. Where a face or
something smooth overlaps, it is minus the depth by which one has to be moved along the common normal until
they only touch. The formula asks for nothing but signed distances, so it holds for shapes, hulls, meshes and
fields alike. Only where an edge has crossed an edge is the minimum a kink, less deep than the shortest way
out; for shapes with edges that is searched among directions instead: d = max_n min_A n·p − max_B n·q.

Minima are searched from points of both surfaces: for solids that are not convex, those of a lattice decide
which parts are found. Derivatives do not go through the search. That of d is the envelope theorem: a surface
moves the distance by how fast it moves along the normal. Those of points and normal follow from the implicit
function theorem at the minimum, where it is unique; between parallel faces it is not, and the points stay.
Of edges that have crossed only d has derivatives.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.checks import checked_count, checked_kind
from dano.fields import AbstractField, AbstractShape, posed
from dano.maths import even_directions, is_traced, Pose, safe_normalize
from dano.objects import NeuralObject

Solid = AbstractShape | NeuralObject

# Starts on each surface from which minima are searched.
_BEST = 4
# Rounds of the search: each halves the reach of its star of points if none is better.
_ROUNDS = 60
# Directions of that star, turned from round to round so that no kink hides between them.
_STAR = 24
# Projections of a point on a surface; the first is exact where distances are.
_PROJECTIONS = 4
# Where derivatives are taken: this share of the smaller size outside of the surfaces, where an edge or a
# corner is smooth.
_OUTSIDE = 1e-3
# Shapes with edges that are kinks also from inside, and a sum of two gradients that is that of a kink.
_EDGED, _UNEVEN = ("box", "cylinder"), 1e-2
# Curvatures of the sum below this, per size, are those of parallel faces.
_FLAT = 1e-3


class Distance(NamedTuple):
    """Between two solids; see `distance`."""

    value: Float[Array, ""]  # Signed distance [m]; negative: by how much they overlap
    # The point of a's surface that is nearest to b, or deepest in it [m, W], shape (3,).
    point_a: Float[Array, "3"]
    point_b: Float[Array, "3"]  # That of b
    normal: Float[Array, "3"]  # Unit vector from b to a [W]: moving a along it by δ raises the distance by δ


def distance(
    a: Solid, b: Solid, *, pose_a: Pose | None = None, pose_b: Pose | None = None, starts: int = 10
) -> Distance:
    """Signed distance of two solids, with nearest points and normal.

    Differentiable in forward and reverse mode by poses and by all numbers of shapes, under `jax.jit` and
    `jax.vmap`. Exact for shapes; of a mesh or an object as exact as its grid of distances, which is a part
    of a cell. Bodies of a scene: `Scene.distance`.

    Args:
        a: A shape (`mesh_field` makes one of a mesh), or a neural object.
        b: Another one.
        pose_a: Maps the field frame of a to W; default: the identity.
        pose_b: That of b.
        starts: Points an axis of the lattice over each solid from which the search starts. More find
            narrower parts of solids that are not convex.

    Raises:
        ValueError: If one is no solid, both are unbounded, or `starts` is not in 2 … 64.
    """
    starts = checked_count("starts", starts, most=64)
    first, second = _solid("a", a, pose_a), _solid("b", b, pose_b)
    bounded = _is_bounded(first), _is_bounded(second)
    if not any(bounded):
        raise ValueError("one of a and b must be bounded, got two half-spaces")
    return _distance(first, second, bounded, starts)


def _solid(name: str, given: Any, pose: Pose | None) -> AbstractShape:
    """What has a signed distance, in W.

    Raises:
        ValueError: If it has none.
    """
    if isinstance(given, NeuralObject):
        if given.solid is None:
            raise ValueError(
                f"{name} must have a surface, got an object made of samples: from_samples(field=…) has one"
            )
        given = given.solid
    if isinstance(given, AbstractField) and not isinstance(given, AbstractShape):
        raise ValueError(
            f"{name} must be a shape or an object, got the density {type(given).__name__}, which has no"
            " surface: NeuralObject.from_field makes an object of it"
        )
    shape = checked_kind(name, given, AbstractShape, hint=" or NeuralObject")
    if pose is None:
        return shape
    return posed(shape, checked_kind(f"pose_{name}", pose, Pose))


def _is_bounded(solid: AbstractShape) -> bool:
    bounds = solid.bounds
    if is_traced(bounds):
        return _kind(solid) != "half_space"
    return not bool(np.any(np.isinf(np.asarray(bounds))))


def _kind(solid: AbstractShape) -> str:
    """Of a shape, wherever it is put; empty of what is no primitive."""
    while isinstance(inner := getattr(solid, "shape", None), AbstractShape):
        solid = inner
    return str(getattr(solid, "kind", ""))


@eqx.filter_jit
def _distance(a: AbstractShape, b: AbstractShape, bounded: tuple[bool, bool], starts: int) -> Distance:
    still_a, still_b = jax.lax.stop_gradient((a, b))
    x, size = _minimum(still_a, still_b, bounded, starts)
    return _differentiable(a, b, still_a, still_b, x, size)


def _minimum(
    a: AbstractShape, b: AbstractShape, bounded: tuple[bool, bool], starts: int
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """A point where φ_A + φ_B is least, and the size of the smaller solid [m]."""

    def total(x: Float[Array, "3 n"]) -> Float[Array, " n"]:
        return a.sdf_jet(x, 0) + b.sdf_jet(x, 0)

    found, sizes = [], []
    for solid, has_size in zip((a, b), bounded, strict=True):
        if not has_size:
            continue
        lower, upper = solid.bounds
        lattice = np.stack(np.meshgrid(*[np.linspace(0, 1, starts)] * 3, indexing="ij")).reshape(3, -1)
        x = lower[:, None] + (upper - lower)[:, None] * jnp.asarray(lattice, lower.dtype)
        x = _projected(solid, x)
        heights = total(x)
        _, best = jax.lax.top_k(-heights, min(_BEST, x.shape[1]))
        found.append(x[:, best])
        sizes.append(jnp.max(upper - lower))
    x = jnp.concatenate(found, axis=1)
    size = jnp.min(jnp.stack(sizes))
    star = jnp.asarray(even_directions(_STAR).T, x.dtype)

    def round_of(k, state):
        x, height, reach = state
        stepped = x + _newton(a, b, x, size)
        around = x[:, :, None] + reach[None, :, None] * _turned(star, k)[:, None, :]
        tried = jnp.concatenate([stepped[:, :, None], around], axis=2)
        heights = total(tried.reshape(3, -1)).reshape(tried.shape[1:])
        heights = jnp.where(jnp.isfinite(heights), heights, jnp.inf)
        best = jnp.argmin(heights, axis=1)
        lowest = jnp.take_along_axis(heights, best[:, None], axis=1)[:, 0]
        place = jnp.take_along_axis(tried, best[None, :, None], axis=2)[:, :, 0]
        better = lowest < height
        reach = jnp.where(better & (best > 0), reach, 0.5 * reach)
        return jnp.where(better, place, x), jnp.where(better, lowest, height), reach

    first = x, total(x), jnp.full(x.shape[1], 1.0, x.dtype) * size / starts
    x, height, _ = jax.lax.fori_loop(0, _ROUNDS, round_of, first)
    return _centred(a, b, x[:, jnp.argmin(height)], size), size


def _newton(
    a: AbstractShape, b: AbstractShape, x: Float[Array, "3 n"], size: Float[Array, ""]
) -> Float[Array, "3 n"]:
    """Steps to where the gradient of the sum vanishes, at most of a size; along flat directions none."""
    (_, slope_a, curved_a), (_, slope_b, curved_b) = a.sdf_jet(x, 2), b.sdf_jet(x, 2)
    step = _solved(curved_a + curved_b, -(slope_a + slope_b), size)
    length = jnp.linalg.norm(step, axis=0, keepdims=True)
    step = step * jnp.minimum(1, size / jnp.where(length > 0, length, 1))
    return jnp.where(jnp.isfinite(step), step, 0)


def _solved(
    curvature: Float[Array, "3 3 n"], right: Float[Array, "3 n"], size: Float[Array, ""]
) -> Float[Array, "3 n"]:
    """What the curvature makes the right side of, without directions in which it is flat."""
    finite = jnp.where(jnp.isfinite(curvature), curvature, 0)
    values, axes = jnp.linalg.eigh(jnp.moveaxis(finite, 2, 0))
    steep = values > _FLAT / size
    shares = jnp.where(steep, 1 / jnp.where(steep, values, 1), 0)
    along = jnp.sum(axes * right.T[:, :, None], axis=1) * shares
    return jnp.sum(axes * along[:, None, :], axis=2).T


def _projected(
    solid: AbstractShape, x: Float[Array, "3 n"], times: int = _PROJECTIONS
) -> Float[Array, "3 n"]:
    """Points on the surface, along the gradient of the distance."""

    def once(_, x):
        value, slope = solid.sdf_jet(x, 1)
        steep = jnp.sum(slope * slope, axis=0)
        return x - jnp.where(steep > 1e-6, value / jnp.where(steep > 1e-6, steep, 1), 0)[None] * slope

    return jax.lax.fori_loop(0, times, once, x)


def _centred(
    a: AbstractShape, b: AbstractShape, x: Float[Array, "3"], size: Float[Array, ""]
) -> Float[Array, "3"]:
    """Of all points at which the sum is as small, one where both distances are smooth.

    That is the middle between the surfaces, or a little further along a normal: there the corner of a body
    that lies in a face of another is no kink.
    """
    column = x[:, None]
    p, q = _projected(a, column)[:, 0], _projected(b, column)[:, 0]
    slope_a, slope_b = (solid.sdf_jet(column, 1)[1][:, 0] for solid in (a, b))
    small = _OUTSIDE * size
    tried = [
        0.5 * (p + q),
        x,
        x + small * slope_a,
        x + small * slope_b,
        x - small * slope_a,
        x - small * slope_b,
    ]
    tried += [p - small * slope_b, q - small * slope_a]
    points = jnp.stack(tried, axis=1)
    (value_a, slopes_a), (value_b, slopes_b) = a.sdf_jet(points, 1), b.sdf_jet(points, 1)
    heights = value_a + value_b
    uneven = jnp.linalg.norm(slopes_a + slopes_b, axis=0)
    # Heights count only beyond what rounding makes of them.
    resolution = 100 * jnp.finfo(x.dtype).eps * size
    lowest = jnp.min(heights)
    return points[:, jnp.argmin(uneven + jnp.where(heights <= lowest + resolution, 0, 10.0))]


def _crossed(
    a: AbstractShape,
    b: AbstractShape,
    x: Float[Array, "3"],
    normal: Float[Array, "3"],
    size: Float[Array, ""],
) -> tuple[Float[Array, "3"], Float[Array, "3"], Float[Array, "3"]]:
    """Points and normal of the shortest way out of two convex shapes whose edges have crossed.

    The furthest point of a convex shape in a direction is the one that is nearest to a point far away there.
    """
    far = size * jnp.finfo(x.dtype).eps ** (-1 / 3)
    star = jnp.asarray(even_directions(_STAR).T, x.dtype)

    def ends(normals: Float[Array, "3 n"]) -> tuple[Array, Array, Array]:
        p = _projected(a, x[:, None] - far * normals, 1)
        q = _projected(b, x[:, None] + far * normals, 1)
        return p, q, jnp.sum(normals * (p - q), axis=0)

    def round_of(k, state):
        normal, value, reach = state
        tried = safe_normalize(normal[:, None] + reach * _turned(star, k), axis=0)
        values = ends(tried)[2]
        best = jnp.argmax(values)
        better = values[best] > value
        return (
            jnp.where(better, tried[:, best], normal),
            jnp.where(better, values[best], value),
            jnp.where(better, reach, 0.5 * reach),
        )

    first = normal, ends(normal[:, None])[2][0], jnp.ones((), x.dtype)
    normal = jax.lax.fori_loop(0, 2 * _ROUNDS, round_of, first)[0]
    p, q, _ = ends(normal[:, None])
    return p[:, 0], q[:, 0], normal


def _turned(star: Float[Array, "3 n"], k: Array) -> Float[Array, "3 n"]:
    """A star of directions, in each round another one: by an angle that does not repeat."""
    angle = 2.399963 * k
    turned = star + jnp.sin(angle) * jnp.roll(star, 1, axis=0) + jnp.cos(angle) * jnp.roll(star, 2, axis=0)
    return turned / jnp.linalg.norm(turned, axis=0, keepdims=True)


def _differentiable(
    a: AbstractShape,
    b: AbstractShape,
    still_a: AbstractShape,
    still_b: AbstractShape,
    x: Float[Array, "3"],
    size: Float[Array, ""],
) -> Distance:
    """The result at a minimum x, with its derivatives by all numbers of a and b."""

    def slopes(a: AbstractShape, b: AbstractShape, x: Float[Array, "3"]) -> tuple[Array, Array, Array, Array]:
        (value_a, slope_a), (value_b, slope_b) = (s.sdf_jet(x[:, None], 1) for s in (a, b))
        return value_a[0], slope_a[:, 0], value_b[0], slope_b[:, 0]

    def ends(a: AbstractShape, b: AbstractShape, x: Float[Array, "3"]) -> tuple[Array, Array, Array]:
        _, slope_a, _, slope_b = slopes(a, b, x)
        p, q = _projected(a, x[:, None])[:, 0], _projected(b, x[:, None])[:, 0]
        return p, q, safe_normalize(slope_b - slope_a)

    curvature = still_a.sdf_jet(x[:, None], 2)[2] + still_b.sdf_jet(x[:, None], 2)[2]
    _, slope_a, _, slope_b = slopes(a, b, x)
    right = slope_a + slope_b
    moved = x - _solved(curvature, (right - jax.lax.stop_gradient(right))[:, None], size)[:, 0]
    p, q, normal = ends(a, b, moved)
    if all(_kind(solid) in _EDGED for solid in (a, b)):
        crossed = (jnp.linalg.norm(right) > _UNEVEN) & (jnp.dot(p - q, normal) < 0)
        found = _crossed(still_a, still_b, x, jax.lax.stop_gradient(normal), size)
        p, q, normal = (jnp.where(crossed, y, z) for y, z in zip(found, (p, q, normal), strict=True))
    value = jax.lax.stop_gradient(jnp.dot(p - q, normal))
    outside = _OUTSIDE * size
    for solid, place in ((a, p - outside * normal), (b, q + outside * normal)):
        height, slope = solid.sdf_jet(jax.lax.stop_gradient(place)[:, None], 1)
        height = height[0] / jax.lax.stop_gradient(jnp.linalg.norm(slope[:, 0]))
        value = value + height - jax.lax.stop_gradient(height)
    return Distance(value, p, q, normal)
