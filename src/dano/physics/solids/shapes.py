"""Signed distances of shapes, with gradients, each in its own axes.

To add a shape: a number in `kinds`, a function from y to a `Distance`, and two lines in `shape_distance`.
"""

import warp as wp

from dano.physics.features import KINDS
from dano.physics.real import ONE, real, TWO, vec3, ZERO
from dano.physics.solids.kinds import BOX, CAPSULE, CYLINDER, ELLIPSOID, HALF_SPACE, SPHERE
from dano.physics.solids.leaves import Distance, inverse_or_zero, Leaf, root_or_zero

_HALF_SPACE, _SPHERE, _BOX = wp.constant(HALF_SPACE), wp.constant(SPHERE), wp.constant(BOX)
_CAPSULE, _CYLINDER, _ELLIPSOID = wp.constant(CAPSULE), wp.constant(CYLINDER), wp.constant(ELLIPSOID)
# Of the search for the closest point of an ellipsoid: halvings of its bracket, then steps of Newton's method.
_BISECTIONS, _STEPS = wp.constant(5), wp.constant(7)
# Points closer to a symmetry plane than this share of a semi-axis count as there: 4 times the rounding.
_OFF_PLANE = wp.constant(real(9e-16))


@wp.func
def sign(x: real) -> real:
    """1 for x ≥ 0, else −1."""
    return wp.where(x >= ZERO, ONE, -ONE)


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
    length = root_or_zero(wp.dot(y, y))
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
    radius = root_or_zero(y[0] * y[0] + y[1] * y[1])
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


@wp.func(inline=False)
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
def shape_distance(kind: int, leaf: Leaf, y: vec3) -> Distance:
    """Of a shape of some kind, at a point in its axes [m]."""
    d = Distance()
    if wp.static(HALF_SPACE in KINDS):
        if kind == _HALF_SPACE:
            d = half_space_distance(leaf, y)
    if wp.static(BOX in KINDS):
        if kind == _BOX:
            d = box_distance(leaf, y)
    if wp.static(CAPSULE in KINDS):
        if kind == _CAPSULE:
            d = capsule_distance(leaf, y)
    if wp.static(CYLINDER in KINDS):
        if kind == _CYLINDER:
            d = cylinder_distance(leaf, y)
    if wp.static(ELLIPSOID in KINDS):
        if kind == _ELLIPSOID:
            d = ellipsoid_distance(leaf, y)
    if wp.static(SPHERE in KINDS):
        if kind == _SPHERE:
            d = ball_distance(leaf.sizes[0], y)
    return d
