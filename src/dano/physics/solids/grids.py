"""Sampled signed distances: splines of degree 1 to 3, and beyond their border the way to it besides."""

from typing import Any

import warp as wp

from dano.physics.features import DEGREES
from dano.physics.real import HALF, ONE, real, TWO, vec3, vec4, ZERO
from dano.physics.solids.kinds import CELL
from dano.physics.solids.leaves import Distance, inverse_or_zero, Leaf, LeafKind, Solids

vec2 = wp.types.vector(length=2, dtype=real)
_CELL = wp.constant(CELL)
STEEPEST = wp.constant(real(1.5))
"""Sampled distances may grow faster than true ones: near the shipped objects a hundredth of the space has
gradients above 1.2, a thousandth above 1.45."""
# Worked out here: quotients of literals in a kernel have 32 bits.
_TWO_THIRDS = wp.constant(real(2.0 / 3.0))


@wp.func
def linear_weights(f: real) -> vec2:
    """Weights of the nodes on both sides of a place f in [0, 1]."""
    return vec2(ONE - f, f)


@wp.func
def linear_slopes(f: real) -> vec2:
    """Derivatives of `linear_weights`."""
    return vec2(-ONE, ONE)


@wp.func
def quadratic_weights(f: real) -> vec3:
    """Weights of three nodes for a place f in [−½, ½] from the middle one (B-spline of degree 2)."""
    return vec3(HALF * (HALF - f) * (HALF - f), real(0.75) - f * f, HALF * (HALF + f) * (HALF + f))


@wp.func
def quadratic_slopes(f: real) -> vec3:
    """Derivatives of `quadratic_weights`."""
    return vec3(f - HALF, -TWO * f, f + HALF)


@wp.func
def cubic_weights(f: real) -> vec4:
    """Weights of four nodes for a place f in [0, 1] from the second one (B-spline of degree 3)."""
    g = ONE - f
    return vec4(
        g * g * g / real(6.0),
        _TWO_THIRDS - f * f * (ONE - HALF * f),
        _TWO_THIRDS - g * g * (ONE - HALF * g),
        f * f * f / real(6.0),
    )


@wp.func
def cubic_slopes(f: real) -> vec4:
    """Derivatives of `cubic_weights`."""
    g = ONE - f
    return vec4(-HALF * g * g, f * (real(1.5) * f - TWO), g * (TWO - real(1.5) * g), HALF * f * f)


@wp.func
def tensor_product(
    coefficients: wp.array2d(dtype=real),
    world: int,
    base: int,
    stride_x: int,
    stride_y: int,
    wx: Any,
    wy: Any,
    wz: Any,
    dx: Any,
    dy: Any,
    dz: Any,
) -> Distance:
    """Σ c_ijk w_i w_j w_k and its gradient per cell; `tensor_value` is its first part."""
    d = Distance()
    for i in range(len(wx)):
        plane = ZERO
        plane_y = ZERO
        plane_z = ZERO
        for j in range(len(wx)):
            at = base + i * stride_x + j * stride_y
            line = ZERO
            line_z = ZERO
            for k in range(len(wx)):
                c = coefficients[world, at + k]
                line += c * wz[k]
                line_z += c * dz[k]
            plane += wy[j] * line
            plane_y += dy[j] * line
            plane_z += wy[j] * line_z
        d.value += wx[i] * plane
        d.gradient += vec3(dx[i] * plane, wx[i] * plane_y, wx[i] * plane_z)
    return d


@wp.func
def tensor_value(
    coefficients: wp.array2d(dtype=real),
    world: int,
    base: int,
    stride_x: int,
    stride_y: int,
    wx: Any,
    wy: Any,
    wz: Any,
) -> real:
    """Σ c_ijk w_i w_j w_k."""
    value = ZERO
    for i in range(len(wx)):
        plane = ZERO
        for j in range(len(wx)):
            at = base + i * stride_x + j * stride_y
            line = ZERO
            for k in range(len(wx)):
                line += coefficients[world, at + k] * wz[k]
            plane += wy[j] * line
        value += wx[i] * plane
    return value


@wp.func
def first_node(u: real, nodes: int, degree: int) -> int:
    """First node of the stencil of a place in index units, counted from the border's first node."""
    shift = wp.where(degree == 1, 0, 1)
    node = wp.floor(u)
    if degree == 2:
        node = wp.floor(u + HALF)
    highest = nodes - 2 * (degree + 1) + shift  # last node inside the border whose stencil ends there
    inner = int(wp.min(node, real(highest)))
    return inner + degree + 1 - shift


@wp.struct
class Stencil:
    """The coefficients that a place has to do with."""

    base: int  # The first of them
    stride_x: int  # From one to the next along x
    stride_y: int  # The same along y; along z they lie side by side
    shares: vec3  # The place, in cells from the node from which weights count


@wp.func
def stencil_at(kind: LeafKind, place: vec3) -> Stencil:
    """The stencil of a place in cells from the first node in a grid's border."""
    degree = kind.degree
    border = degree + 1
    first_x = first_node(place[0], kind.nodes_x, degree)
    first_y = first_node(place[1], kind.nodes_y, degree)
    first_z = first_node(place[2], kind.nodes_z, degree)
    stencil = Stencil()
    stencil.stride_y = kind.nodes_z
    stencil.stride_x = kind.nodes_y * kind.nodes_z
    stencil.base = kind.first + first_x * stencil.stride_x + first_y * stencil.stride_y + first_z
    # The node from which a place in the stencil is measured: the first, or the second of more than two.
    origin = wp.where(degree == 1, 0, 1) - border
    stencil.shares = vec3(
        place[0] - real(first_x + origin),
        place[1] - real(first_y + origin),
        place[2] - real(first_z + origin),
    )
    return stencil


@wp.func
def grid_spline(solids: Solids, world: int, kind: LeafKind, place: vec3) -> Distance:
    """The spline of a grid and its gradient per cell, at a place in cells from the first node in its border.

    The place is no further beyond the outermost nodes than these reach.
    """
    degree = kind.degree
    at = stencil_at(kind, place)
    f = at.shares
    d = Distance()
    if wp.static(1 in DEGREES):
        if degree == 1:
            d = tensor_product(
                solids.coefficients, world, at.base, at.stride_x, at.stride_y,
                linear_weights(f[0]), linear_weights(f[1]), linear_weights(f[2]),
                linear_slopes(f[0]), linear_slopes(f[1]), linear_slopes(f[2]),
            )  # fmt: skip
    if wp.static(2 in DEGREES):
        if degree == 2:
            d = tensor_product(
                solids.coefficients, world, at.base, at.stride_x, at.stride_y,
                quadratic_weights(f[0]), quadratic_weights(f[1]), quadratic_weights(f[2]),
                quadratic_slopes(f[0]), quadratic_slopes(f[1]), quadratic_slopes(f[2]),
            )  # fmt: skip
    if wp.static(3 in DEGREES):
        if degree == 3:
            d = tensor_product(
                solids.coefficients, world, at.base, at.stride_x, at.stride_y,
                cubic_weights(f[0]), cubic_weights(f[1]), cubic_weights(f[2]),
                cubic_slopes(f[0]), cubic_slopes(f[1]), cubic_slopes(f[2]),
            )  # fmt: skip
    return d


@wp.func
def grid_value(solids: Solids, world: int, kind: LeafKind, place: vec3) -> real:
    """The value of `grid_spline` alone, for less than half of the work."""
    degree = kind.degree
    at = stencil_at(kind, place)
    f = at.shares
    value = ZERO
    if wp.static(1 in DEGREES):
        if degree == 1:
            value = tensor_value(
                solids.coefficients, world, at.base, at.stride_x, at.stride_y,
                linear_weights(f[0]), linear_weights(f[1]), linear_weights(f[2]),
            )  # fmt: skip
    if wp.static(2 in DEGREES):
        if degree == 2:
            value = tensor_value(
                solids.coefficients, world, at.base, at.stride_x, at.stride_y,
                quadratic_weights(f[0]), quadratic_weights(f[1]), quadratic_weights(f[2]),
            )  # fmt: skip
    if wp.static(3 in DEGREES):
        if degree == 3:
            value = tensor_value(
                solids.coefficients, world, at.base, at.stride_x, at.stride_y,
                cubic_weights(f[0]), cubic_weights(f[1]), cubic_weights(f[2]),
            )  # fmt: skip
    return value


@wp.func
def place_in_grid(leaf: Leaf, y: vec3) -> vec3:
    """A point in axes of a grid, in cells from the first node inside its border."""
    return vec3(
        (y[0] - leaf.sizes[0]) / leaf.spacing[0],
        (y[1] - leaf.sizes[1]) / leaf.spacing[1],
        (y[2] - leaf.sizes[2]) / leaf.spacing[2],
    )


@wp.func
def closest_in_grid(kind: LeafKind, u: vec3) -> vec3:
    """The place between a grid's outermost nodes that is closest to a place."""
    ends = 2 * kind.degree + 3
    last = vec3(real(kind.nodes_x - ends), real(kind.nodes_y - ends), real(kind.nodes_z - ends))
    return vec3(
        wp.min(wp.max(u[0], ZERO), last[0]),
        wp.min(wp.max(u[1], ZERO), last[1]),
        wp.min(wp.max(u[2], ZERO), last[2]),
    )


@wp.func
def coarse_bound(solids: Solids, world: int, kind: LeafKind, u: vec3) -> real:
    """A lower bound on the spline at a place between a grid's outermost nodes [m]: that of a few cells."""
    inner = 2 * kind.degree + 3
    along_y = (kind.nodes_y - inner) // _CELL + 1
    along_z = (kind.nodes_z - inner) // _CELL + 1
    cell = (int(u[0]) // _CELL * along_y + int(u[1]) // _CELL) * along_z + int(u[2]) // _CELL
    return solids.bounds[world, kind.first_bound + cell]


@wp.func
def spline_distance(
    solids: Solids, world: int, kind: LeafKind, leaf: Leaf, u: vec3, closest: vec3
) -> Distance:
    """The spline of a grid at the place closest to u, and its gradient by u: linear in the coefficients."""
    d = Distance()
    found = grid_spline(solids, world, kind, closest)
    g = found.gradient
    d.value = found.value
    # Moving along an axis on which the point lies outside leaves the closest point where it is.
    d.gradient = vec3(
        wp.where(closest[0] == u[0], g[0] / leaf.spacing[0], ZERO),
        wp.where(closest[1] == u[1], g[1] / leaf.spacing[1], ZERO),
        wp.where(closest[2] == u[2], g[2] / leaf.spacing[2], ZERO),
    )
    return d


@wp.func
def grid_distance(solids: Solids, world: int, kind: LeafKind, leaf: Leaf, y: vec3) -> Distance:
    """The spline of a grid, and beyond its border the way to it besides."""
    u = place_in_grid(leaf, y)
    closest = closest_in_grid(kind, u)
    away = wp.cw_mul(u - closest, leaf.spacing)
    squared = wp.dot(away, away)
    beyond = ZERO
    # A root has no derivative at zero.
    if squared > ZERO:
        beyond = wp.sqrt(squared)
    d = spline_distance(solids, world, kind, leaf, u, closest)
    d.gradient = d.gradient + inverse_or_zero(beyond) * away
    d.value += beyond
    return d


@wp.func
def moved_kind(solids: Solids, kind: LeafKind, direction: int) -> LeafKind:
    """A grid whose coefficients are their changes in a direction, among those of `moved_solids`."""
    kind.first = kind.first + direction * solids.coefficients.shape[1]
    return kind


@wp.func
def moved_solids(solids: Solids) -> Solids:
    """Solids whose coefficients are the changes of these."""
    moved = solids
    moved.coefficients = solids.changes
    return moved


@wp.func
def distance_change(
    solids: Solids, world: int, kind: LeafKind, leaf: Leaf, x: vec3, direction: int
) -> Distance:
    """Change of a sampled distance with its coefficients, at a point [m, F]."""
    u = place_in_grid(leaf, (ONE / leaf.factor) * (wp.transpose(leaf.rotation) * (x - leaf.position)))
    moved = moved_kind(solids, kind, direction)
    d = spline_distance(moved_solids(solids), world, moved, leaf, u, closest_in_grid(kind, u))
    d.value = leaf.factor * d.value
    d.gradient = leaf.rotation * d.gradient
    return d
