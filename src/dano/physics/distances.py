"""Signed distances of solids, with gradients (docs/theory/contact.md, "Which side is sampled").

A solid is a run of *leaves*: one for a shape, several for a union, whose distance is the least of theirs.
Each leaf has a kind, a size s, and a pose: x = s R y + p for y in the axes of its own.

To add a kind: a number below, its function from y to a `Distance`, two lines in `leaf_distance`, and a row in
`dano.contact`'s table of solids, which says which class of `dano.fields` it is.
"""

from typing import Any

import warp as wp

from dano.physics.features import DEGREES, KINDS, UNIONS
from dano.physics.real import HALF, INFINITY, mat33, ONE, real, TWO, vec3, vec4, ZERO

HALF_SPACE, SPHERE, BOX, CAPSULE, CYLINDER, ELLIPSOID, GRID = range(7)
"""Kinds of leaves."""

_HALF_SPACE = wp.constant(HALF_SPACE)
_SPHERE = wp.constant(SPHERE)
_BOX = wp.constant(BOX)
_CAPSULE = wp.constant(CAPSULE)
_CYLINDER = wp.constant(CYLINDER)
_ELLIPSOID = wp.constant(ELLIPSOID)
_GRID = wp.constant(GRID)

vec2 = wp.types.vector(length=2, dtype=real)
# Of the search for the closest point of an ellipsoid: halvings of its bracket, then steps of Newton's method.
_BISECTIONS, _STEPS = wp.constant(5), wp.constant(7)
# Worked out here: quotients of literals in a kernel have 32 bits.
_TWO_THIRDS = wp.constant(real(2.0 / 3.0))
# Points closer to a symmetry plane than this share of a semi-axis count as there: 4 times the rounding.
_OFF_PLANE = wp.constant(real(9e-16))


@wp.struct
class Leaf:
    """One part of a solid.

    Attributes:
        factor: Size s [1].
        position: p [m, F].
        rotation: R, leaf → F.
        sizes: Unit normal of a half-space; half extents of a box; radius and half length of a capsule or
            cylinder; radius of a sphere; semi-axes of an ellipsoid; first node of a grid [m].
        length: Offset of a half-space's plane; rounding of a box [m].
        spacing: Between nodes of a grid [m].
    """

    factor: real
    position: vec3
    rotation: mat33
    sizes: vec3
    length: real
    spacing: vec3


@wp.struct
class LeafKind:
    """Whole numbers of a leaf.

    Attributes:
        kind: Which of the kinds above.
        first: Place of a grid's first spline coefficient.
        nodes_x: Number of coefficients along x, border included.
        nodes_y: Along y.
        nodes_z: Along z.
        degree: Of the spline.
    """

    kind: wp.int32
    first: wp.int32
    nodes_x: wp.int32
    nodes_y: wp.int32
    nodes_z: wp.int32
    degree: wp.int32


@wp.struct
class Solids:
    """All solids of a scene.

    Attributes:
        leaves: Shape (worlds, leaves).
        kinds: Shape (leaves,).
        coefficients: Spline coefficients of all grids [m], shape (worlds, coefficients).
        changes: Of the coefficients, one direction after the other; only for forward derivatives.
    """

    leaves: wp.array2d(dtype=Leaf)
    kinds: wp.array(dtype=LeafKind)
    coefficients: wp.array2d(dtype=real)
    changes: wp.array2d(dtype=real)


@wp.struct
class Solid:
    """A solid: a run of leaves, and the first of them.

    Attributes:
        first: Index of the first leaf.
        count: Number of leaves.
        leaf: The first leaf.
        kind: Its whole numbers.
    """

    first: int
    count: int
    leaf: Leaf
    kind: LeafKind


@wp.struct
class Distance:
    """Signed distance [m], negative inside, and its gradient [1]."""

    value: real
    gradient: vec3


@wp.func
def sign(x: real) -> real:
    """1 for x ≥ 0, else −1."""
    return wp.where(x >= ZERO, ONE, -ONE)


@wp.func
def inverse_or_zero(x: real) -> real:
    """1 / x, or 0 at 0."""
    return wp.where(x > ZERO, ONE / wp.where(x > ZERO, x, ONE), ZERO)


@wp.func
def half_space_distance(leaf: Leaf, y: vec3) -> Distance:
    """Distance n · y − offset."""
    d = Distance()
    d.value = wp.dot(leaf.sizes, y) - leaf.length
    d.gradient = leaf.sizes
    return d


@wp.func
def ball_distance(radius: real, y: vec3) -> Distance:
    """|y| − r."""
    d = Distance()
    length = wp.sqrt(wp.dot(y, y))
    d.value = length - radius
    d.gradient = inverse_or_zero(length) * y
    return d


@wp.func
def capsule_distance(leaf: Leaf, y: vec3) -> Distance:
    """Distance to a segment along z, less the radius."""
    half_length = leaf.sizes[1]
    return ball_distance(leaf.sizes[0], vec3(y[0], y[1], y[2] - wp.clamp(y[2], -half_length, half_length)))


@wp.func
def box_distance(leaf: Leaf, y: vec3) -> Distance:
    """Of a box whose edges and corners are rounded; where faces tie inside, the mean of their normals."""
    d = Distance()
    rounding = leaf.length
    e = vec3(
        wp.abs(y[0]) - (leaf.sizes[0] - rounding),
        wp.abs(y[1]) - (leaf.sizes[1] - rounding),
        wp.abs(y[2]) - (leaf.sizes[2] - rounding),
    )
    signs = vec3(sign(y[0]), sign(y[1]), sign(y[2]))
    largest = wp.max(e[0], wp.max(e[1], e[2]))
    if largest <= ZERO:
        face = vec3(
            wp.where(e[0] == largest, ONE, ZERO),
            wp.where(e[1] == largest, ONE, ZERO),
            wp.where(e[2] == largest, ONE, ZERO),
        )
        d.value = largest - rounding
        d.gradient = wp.cw_mul(signs, face) / (face[0] + face[1] + face[2])
    else:
        beyond = vec3(wp.max(e[0], ZERO), wp.max(e[1], ZERO), wp.max(e[2], ZERO))
        length = wp.sqrt(wp.dot(beyond, beyond))
        d.value = length - rounding
        d.gradient = wp.cw_mul(signs, beyond) / length
    return d


@wp.func
def cylinder_distance(leaf: Leaf, y: vec3) -> Distance:
    """Of a cylinder along z with flat ends."""
    d = Distance()
    radius = wp.sqrt(y[0] * y[0] + y[1] * y[1])
    across = radius - leaf.sizes[0]
    along = wp.abs(y[2]) - leaf.sizes[1]
    by_across = ZERO
    by_along = ZERO
    if wp.max(across, along) <= ZERO:
        d.value = wp.max(across, along)
        by_across = wp.where(across > along, ONE, ZERO)
        by_along = ONE - by_across
    else:
        across = wp.max(across, ZERO)
        along = wp.max(along, ZERO)
        d.value = wp.sqrt(across * across + along * along)
        by_across = across / d.value
        by_along = along / d.value
    share = by_across * inverse_or_zero(radius)
    d.gradient = vec3(share * y[0], share * y[1], by_along * wp.where(y[2] == ZERO, ZERO, sign(y[2])))
    return d


@wp.func
def ellipsoid_gap(semi_axes: vec3) -> vec3:
    """aᵢ² − min a²."""
    a = wp.cw_mul(semi_axes, semi_axes)
    shift = wp.min(a[0], wp.min(a[1], a[2]))
    return vec3(a[0] - shift, a[1] - shift, a[2] - shift)


@wp.func
def ellipsoid_root(x: vec3, semi_axes: vec3) -> real:
    """Root s > 0 of Σ (aᵢ xᵢ / (s + aᵢ² − m))² = 1 for xᵢ > 0, with m = min aᵢ².

    The sum falls and is convex. Newton's method climbs from the left without overshooting; five halvings of
    log s bring it near first.
    """
    ax = wp.cw_mul(semi_axes, x)
    gap = ellipsoid_gap(semi_axes)
    lowest = wp.max(ax[0] - gap[0], wp.max(ax[1] - gap[1], ax[2] - gap[2]))
    low = lowest
    high = wp.length(ax)
    for _ in range(_BISECTIONS):
        s = wp.sqrt(low * high)
        r = vec3(ax[0] / (s + gap[0]), ax[1] / (s + gap[1]), ax[2] / (s + gap[2]))
        if wp.dot(r, r) >= ONE:
            low = s
        else:
            high = s
    s = low
    for _ in range(_STEPS):
        inverse = vec3(ONE / (s + gap[0]), ONE / (s + gap[1]), ONE / (s + gap[2]))
        r = wp.cw_mul(ax, inverse)
        half_slope = r[0] * r[0] * inverse[0] + r[1] * r[1] * inverse[1] + r[2] * r[2] * inverse[2]
        s = wp.max(s + (wp.dot(r, r) - ONE) / (TWO * half_slope), lowest)
    return s


@wp.func_grad(ellipsoid_root)
def adj_ellipsoid_root(x: vec3, semi_axes: vec3, adj_ret: real):
    """By the implicit function theorem; semi-axes move the root by themselves and through their gaps."""
    s = ellipsoid_root(x, semi_axes)
    a = semi_axes
    gap = ellipsoid_gap(a)
    inverse = vec3(ONE / (s + gap[0]), ONE / (s + gap[1]), ONE / (s + gap[2]))
    r = wp.cw_mul(wp.cw_mul(a, x), inverse)
    squared = wp.cw_mul(r, r)
    steep = wp.cw_mul(squared, inverse)  # halves of −∂F/∂gap
    share = adj_ret / (steep[0] + steep[1] + steep[2])
    by_x = share * vec3(squared[0] / x[0], squared[1] / x[1], squared[2] / x[2])
    # gapᵢ = aᵢ² − m; the least semi-axis moves all of them through m.
    by_a = share * vec3(squared[0] / a[0], squared[1] / a[1], squared[2] / a[2])
    by_a -= share * TWO * wp.cw_mul(steep, a)
    least = wp.min(a[0], wp.min(a[1], a[2]))
    back = TWO * least * adj_ret
    if a[0] == least:
        by_a += vec3(back, ZERO, ZERO)
    elif a[1] == least:
        by_a += vec3(ZERO, back, ZERO)
    else:
        by_a += vec3(ZERO, ZERO, back)
    wp.adjoint[x] += by_x
    wp.adjoint[semi_axes] += by_a


@wp.func
def ellipsoid_distance(leaf: Leaf, y: vec3) -> Distance:
    """Distance t |y/(t + a²)|, with a² y/(t + a²) on the surface (Eberly, *Distance to an ellipsoid*)."""
    d = Distance()
    a = leaf.sizes
    # Off the symmetry planes, on which the closest point of an inner point is not unique.
    x = vec3(
        wp.max(wp.abs(y[0]), _OFF_PLANE * a[0]),
        wp.max(wp.abs(y[1]), _OFF_PLANE * a[1]),
        wp.max(wp.abs(y[2]), _OFF_PLANE * a[2]),
    )
    least = wp.min(a[0], wp.min(a[1], a[2]))
    s = ellipsoid_root(x, a)
    gap = ellipsoid_gap(a)
    r = vec3(x[0] / (s + gap[0]), x[1] / (s + gap[1]), x[2] / (s + gap[2]))
    length = wp.sqrt(wp.dot(r, r))
    d.value = (s - least * least) * length
    d.gradient = wp.cw_mul(vec3(sign(y[0]), sign(y[1]), sign(y[2])), r) / length
    return d


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
    """Σ c_ijk w_i w_j w_k and its gradient per cell."""
    d = Distance()
    for i in range(len(wx)):
        for j in range(len(wx)):
            at = base + i * stride_x + j * stride_y
            line = ZERO
            line_z = ZERO
            for k in range(len(wx)):
                c = coefficients[world, at + k]
                line += c * wz[k]
                line_z += c * dz[k]
            d.value += wx[i] * wy[j] * line
            d.gradient += vec3(dx[i] * wy[j] * line, wx[i] * dy[j] * line, wx[i] * wy[j] * line_z)
    return d


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


@wp.func
def grid_spline(solids: Solids, world: int, kind: LeafKind, place: vec3) -> Distance:
    """The spline of a grid and its gradient per cell, at a place in cells from the first node inside its border.

    The place is no further beyond the outermost nodes than these reach.
    """
    degree = kind.degree
    border = degree + 1
    first_x = first_node(place[0], kind.nodes_x, degree)
    first_y = first_node(place[1], kind.nodes_y, degree)
    first_z = first_node(place[2], kind.nodes_z, degree)
    stride_y = kind.nodes_z
    stride_x = kind.nodes_y * stride_y
    base = kind.first + first_x * stride_x + first_y * stride_y + first_z
    # The node from which a place in the stencil is measured: the first, or the second of more than two.
    origin = wp.where(degree == 1, 0, 1) - border
    f = vec3(
        place[0] - real(first_x + origin), place[1] - real(first_y + origin), place[2] - real(first_z + origin)
    )
    d = Distance()
    if wp.static(1 in DEGREES):
        if degree == 1:
            d = tensor_product(
                solids.coefficients, world, base, stride_x, stride_y,
                linear_weights(f[0]), linear_weights(f[1]), linear_weights(f[2]),
                linear_slopes(f[0]), linear_slopes(f[1]), linear_slopes(f[2]),
            )  # fmt: skip
    if wp.static(2 in DEGREES):
        if degree == 2:
            d = tensor_product(
                solids.coefficients, world, base, stride_x, stride_y,
                quadratic_weights(f[0]), quadratic_weights(f[1]), quadratic_weights(f[2]),
                quadratic_slopes(f[0]), quadratic_slopes(f[1]), quadratic_slopes(f[2]),
            )  # fmt: skip
    if wp.static(3 in DEGREES):
        if degree == 3:
            d = tensor_product(
                solids.coefficients, world, base, stride_x, stride_y,
                cubic_weights(f[0]), cubic_weights(f[1]), cubic_weights(f[2]),
                cubic_slopes(f[0]), cubic_slopes(f[1]), cubic_slopes(f[2]),
            )  # fmt: skip
    return d


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
    border = kind.degree + 1
    last = vec3(
        real(kind.nodes_x - 2 * border - 1),
        real(kind.nodes_y - 2 * border - 1),
        real(kind.nodes_z - 2 * border - 1),
    )
    return vec3(
        wp.min(wp.max(u[0], ZERO), last[0]),
        wp.min(wp.max(u[1], ZERO), last[1]),
        wp.min(wp.max(u[2], ZERO), last[2]),
    )


@wp.func
def spline_distance(solids: Solids, world: int, kind: LeafKind, leaf: Leaf, u: vec3, closest: vec3) -> Distance:
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
    beyond = wp.sqrt(wp.dot(away, away))
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
def distance_change(solids: Solids, world: int, kind: LeafKind, leaf: Leaf, x: vec3, direction: int) -> Distance:
    """Change of a sampled distance with its coefficients, at a point [m, F]."""
    u = place_in_grid(leaf, (ONE / leaf.factor) * (wp.transpose(leaf.rotation) * (x - leaf.position)))
    moved = moved_kind(solids, kind, direction)
    d = spline_distance(moved_solids(solids), world, moved, leaf, u, closest_in_grid(kind, u))
    d.value = leaf.factor * d.value
    d.gradient = leaf.rotation * d.gradient
    return d


@wp.func
def leaf_distance(solids: Solids, world: int, kind: LeafKind, leaf: Leaf, x: vec3) -> Distance:
    """Of one leaf, at a point [m, F]."""
    y = (ONE / leaf.factor) * (wp.transpose(leaf.rotation) * (x - leaf.position))
    d = Distance()
    if wp.static(GRID in KINDS):
        if kind.kind == _GRID:
            d = grid_distance(solids, world, kind, leaf, y)
    if wp.static(HALF_SPACE in KINDS):
        if kind.kind == _HALF_SPACE:
            d = half_space_distance(leaf, y)
    if wp.static(BOX in KINDS):
        if kind.kind == _BOX:
            d = box_distance(leaf, y)
    if wp.static(CAPSULE in KINDS):
        if kind.kind == _CAPSULE:
            d = capsule_distance(leaf, y)
    if wp.static(CYLINDER in KINDS):
        if kind.kind == _CYLINDER:
            d = cylinder_distance(leaf, y)
    if wp.static(ELLIPSOID in KINDS):
        if kind.kind == _ELLIPSOID:
            d = ellipsoid_distance(leaf, y)
    if wp.static(SPHERE in KINDS):
        if kind.kind == _SPHERE:
            d = ball_distance(leaf.sizes[0], y)
    d.value = leaf.factor * d.value
    d.gradient = leaf.rotation * d.gradient
    return d


@wp.func
def beyond_range(x: real, last: real) -> real:
    """By how much x lies beyond [0, last]."""
    return x - wp.min(wp.max(x, ZERO), last)


@wp.func
def leaf_clearance(solids: Solids, world: int, kind: LeafKind, leaf: Leaf, x: vec3) -> real:
    """A lower bound on the distance to one leaf.

    Beyond a grid's border its distance d adds the way b to the border, which is more than the true distance:
    the solid lies in the grid, so √(d² + b²) bounds that from below.
    """
    d = leaf_distance(solids, world, kind, leaf, x).value
    if wp.static(GRID in KINDS):
        if kind.kind == _GRID:
            border = kind.degree + 1
            y = (ONE / leaf.factor) * (wp.transpose(leaf.rotation) * (x - leaf.position)) - leaf.sizes
            away = vec3(
                beyond_range(y[0], real(kind.nodes_x - 2 * border - 1) * leaf.spacing[0]),
                beyond_range(y[1], real(kind.nodes_y - 2 * border - 1) * leaf.spacing[1]),
                beyond_range(y[2], real(kind.nodes_z - 2 * border - 1) * leaf.spacing[2]),
            )
            squared = wp.dot(away, away)
            if squared > ZERO:
                inner = d - leaf.factor * wp.sqrt(squared)
                d = wp.sqrt(inner * inner + leaf.factor * leaf.factor * squared)
    return d


@wp.func
def solid_of(solids: Solids, world: int, first: int, count: int) -> Solid:
    """A solid by its leaves."""
    solid = Solid()
    solid.first = first
    solid.count = count
    solid.leaf = solids.leaves[world, first]
    solid.kind = solids.kinds[first]
    return solid


@wp.func
def nearest_leaf(solids: Solids, world: int, solid: Solid, x: vec3) -> Solid:
    """The leaf with the least distance, as a solid of its own."""
    nearest = solid.first
    least = real(INFINITY)
    for i in range(solid.first, solid.first + solid.count):
        d = leaf_distance(solids, world, solids.kinds[i], solids.leaves[world, i], x)
        if d.value < least:
            least = d.value
            nearest = i
    return solid_of(solids, world, nearest, 1)


@wp.func
def solid_clearance(solids: Solids, world: int, solid: Solid, x: vec3) -> real:
    """Lower bound on the distance [m] from a point [m, F] to a solid."""
    least = leaf_clearance(solids, world, solid.kind, solid.leaf, x)
    if wp.static(UNIONS):
        for i in range(solid.first + 1, solid.first + solid.count):
            other = leaf_clearance(solids, world, solids.kinds[i], solids.leaves[world, i], x)
            least = wp.min(least, other)
    return least


@wp.func
def solid_distance(solids: Solids, world: int, solid: Solid, x: vec3) -> Distance:
    """Signed distance of a solid and its gradient at a point [m, F]; of a union, of its nearest leaf."""
    if wp.static(UNIONS):
        solid = nearest_leaf(solids, world, solid, x)
    return leaf_distance(solids, world, solid.kind, solid.leaf, x)
