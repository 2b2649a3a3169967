"""Rays through solids: where they meet one, and what light arrives there. Kernels, a ray a thread.

Solids are those of contact (`dano.physics.solids`), so that what is drawn is what touches.
"""

import warp as wp

from dano.physics.real import HALF, INFINITY, mat33, ONE, real, TWO, vec3, vec4, ZERO
from dano.physics.solids.distances import solid_clearance, solid_distance, solid_of, Solids

# Most steps along a ray, and on the way to the lamp.
_MOST = wp.constant(96)
# Share of the distance to the surface that a ray advances; interpolated distances are not quite 1-Lipschitz.
_CAUTION = wp.constant(real(0.95))
_SHADOW_CAUTION = wp.constant(real(0.7))
# A ray has hit within this share of a pixel, by which silhouettes grow …
_NEAR = wp.constant(real(0.1))
# … or of the solid's size, which 32 bits of its distances resolve.
_FINE = wp.constant(real(1e-5))
# Bounds on distances do for steps that are longer than this share of the size.
_COARSE = wp.constant(real(0.004))
# Heights above a point, as shares of a reach, at which its surroundings are probed, and their weights.
_HEIGHTS = wp.constant(vec4(real(0.12), real(0.3), real(0.6), real(1.0)))
_WEIGHTS = wp.constant(vec4(real(0.4), real(0.3), real(0.2), real(0.1)))
# How far around a solid it darkens what is near, as a share of its radius, and the least that it leaves.
_REACH = wp.constant(real(0.35))
_DARKEST = wp.constant(real(0.12))
# Shares of that reach by which light starts above a surface, and of a floor's darkness below a solid.
_ABOVE = wp.constant(real(0.02))
_FLOOR_SHADE = wp.constant(real(0.65))
_SLOWEST = wp.constant(real(0.1))
_FULL = wp.constant(real(1.3))


@wp.struct
class Thing:
    """A solid somewhere.

    Attributes:
        first: Its first leaf in `Solids`.
        count: Number of leaves.
        own_shadows: Whether it already shows the light that it takes from itself.
        rotation: F → W.
        position: Of the field frame [m, W].
        centre: Of a ball around it [m, W].
        radius: Of that ball [m].
        low: Lower corner of a box around it [m, F].
        high: Upper corner [m, F].
    """

    first: int
    count: int
    own_shadows: int
    rotation: mat33
    position: vec3
    centre: vec3
    radius: real
    low: vec3
    high: vec3


@wp.struct
class View:
    """What is seen, and in which light.

    Attributes:
        solids: Leaves of all things.
        things: Solids.
        planes: Unit normal and offset [m] of each half-space.
        origin: Of the rays [m, W].
        light: Unit direction towards the lamp.
        spread: Half the lamp's angular width [rad].
        pixel: Angle of a pixel [rad].
        focus: The point looked at [m, W].
        far: Distance from there [m] beyond which nothing casts a shadow.
        floor_reach: Height above a plane up to which that darkens what is above [m].
        shaded: Whether things take light from each other and from themselves.
    """

    solids: Solids
    things: wp.array(dtype=Thing)
    planes: wp.array(dtype=vec4)
    origin: vec3
    light: vec3
    spread: real
    pixel: real
    focus: vec3
    far: real
    floor_reach: real
    shaded: int


@wp.struct
class Way:
    """Where along a ray it is in a box: from `enter` to `leave` [m]; never if it leaves before it enters."""

    enter: real
    leave: real


@wp.func
def way_through(low: vec3, high: vec3, o: vec3, d: vec3) -> Way:
    """The part of a ray in a box, from its origin on."""
    way = Way()
    way.enter = ZERO
    way.leave = real(INFINITY)
    for k in range(3):
        if wp.abs(d[k]) > real(1e-12):
            a = (low[k] - o[k]) / d[k]
            b = (high[k] - o[k]) / d[k]
            way.enter = wp.max(way.enter, wp.min(a, b))
            way.leave = wp.min(way.leave, wp.max(a, b))
        elif o[k] < low[k] or o[k] > high[k]:
            way.leave = real(-1.0)
    return way


@wp.func
def meets_ball(thing: Thing, o: vec3, d: vec3) -> bool:
    """Whether a ray meets the ball around a thing."""
    away = thing.centre - o
    along = wp.dot(away, d)
    beside = wp.dot(away, away) - thing.radius * thing.radius
    return beside <= ZERO or (along > ZERO and along * along > beside)


@wp.func
def distance_to(view: View, thing: Thing, origin: vec3, direction: vec3, limit: real) -> real:
    """How far along a ray [m, W] a thing is met; `limit` or more if it is not before."""
    o = wp.transpose(thing.rotation) * (origin - thing.position)
    d = wp.transpose(thing.rotation) * direction
    solid = solid_of(view.solids, 0, thing.first, thing.count)
    size = wp.max(thing.high - thing.low)
    way = way_through(thing.low, thing.high, o, d)
    leave = wp.min(way.leave, limit)
    t = way.enter
    found = real(INFINITY)
    i = int(0)
    while i < _MOST and t < leave:
        s = solid_clearance(view.solids, 0, solid, o + t * d, _COARSE * size)
        t += _CAUTION * s
        if s < wp.max(_NEAR * view.pixel * t, _FINE * size):
            found = t
            leave = ZERO
        i += 1
    return found


@wp.func
def normal_of(view: View, thing: Thing, x: vec3) -> vec3:
    """Unit normal [W] of a thing at a point [m, W] of its surface."""
    solid = solid_of(view.solids, 0, thing.first, thing.count)
    place = wp.transpose(thing.rotation) * (x - thing.position)
    return wp.normalize(thing.rotation * solid_distance(view.solids, 0, solid, place).gradient)


@wp.func
def light_left(view: View, thing: Thing, x: vec3, bias: real) -> real:
    """Share of the lamp's light that a thing leaves to a point [m, W], a little above its own surface.

    At distance t the disc of the lamp has the radius spread · t, and the ray is at the height s above the
    thing. The least s / (spread · t), between −1 (dark) and 1 (clear), says how much of the disc is seen.
    """
    o = wp.transpose(thing.rotation) * (x - thing.position)
    d = wp.transpose(thing.rotation) * view.light
    solid = solid_of(view.solids, 0, thing.first, thing.count)
    # Grown by what the cone's width reaches beyond the box.
    ahead = wp.max(wp.dot(HALF * (thing.low + thing.high) - o, d), ZERO)
    grow = view.spread * ahead + TWO * bias
    margin = vec3(grow, grow, grow)
    way = way_through(thing.low - margin, thing.high + margin, o, d)
    t = wp.max(way.enter, bias)
    seen = real(1.0)
    i = int(0)
    while i < _MOST and t < way.leave and seen > -ONE:
        s = solid_clearance(view.solids, 0, solid, o + t * d, view.spread * t)
        seen = wp.min(seen, s / (view.spread * t))
        t += wp.max(_SHADOW_CAUTION * wp.abs(s), bias + _SLOWEST * view.spread * t)
        i += 1
    seen = wp.max(seen, -ONE)
    # Share of the lamp's disc above a straight edge, nearly: the cubic with zero slope at both ends.
    return real(0.25) * (ONE + seen) * (ONE + seen) * (TWO - seen)


@wp.func
def sky_left(view: View, thing: Thing, x: vec3, normal: vec3, reach: real) -> real:
    """Share of the light from all around that a thing leaves to a point [m, W] of a surface."""
    solid = solid_of(view.solids, 0, thing.first, thing.count)
    covered = real(0.0)
    for k in range(4):
        height = reach * _HEIGHTS[k]
        place = wp.transpose(thing.rotation) * (x + height * normal - thing.position)
        s = solid_clearance(view.solids, 0, solid, place, height)
        covered += _WEIGHTS[k] * wp.clamp(ONE - s / height, ZERO, _FULL)
    return wp.clamp(ONE - covered, _DARKEST, ONE)


@wp.kernel(enable_backward=False)
def trace(
    view: View,
    directions: wp.array(dtype=wp.vec3f),
    depths: wp.array(dtype=wp.float32),
    which: wp.array(dtype=wp.int32),
    normals: wp.array(dtype=wp.vec3f),
    lamp: wp.array(dtype=wp.float32),
    ambient: wp.array(dtype=wp.float32),
):
    """What rays meet first.

    Args:
        view: What there is.
        directions: Unit directions [W].
        depths: Written: distance [m]; infinite where nothing is met.
        which: Written: number of the plane, or of the thing after all planes; −1 for none.
        normals: Written: unit normals [W].
        lamp: Written: shares of the lamp's light that arrive.
        ambient: Written: shares of light from all around.
    """
    r = wp.tid()
    d = wp.normalize(vec3(real(directions[r][0]), real(directions[r][1]), real(directions[r][2])))
    planes = view.planes.shape[0]
    things = view.things.shape[0]
    nearest = real(INFINITY)
    met = int(0)  # one more than its number
    normal = vec3()
    for j in range(planes):
        plane = view.planes[j]
        up = vec3(plane[0], plane[1], plane[2])
        height = wp.dot(up, view.origin) - plane[3]
        fall = -wp.dot(up, d)
        # From below, a floor would hide everything.
        if height > ZERO and fall > real(1e-6):
            if height / fall < nearest:
                nearest = height / fall
                met = j + 1
                normal = up
    for k in range(things):
        thing = view.things[k]
        if meets_ball(thing, view.origin, d):
            t = distance_to(view, thing, view.origin, d, nearest)
            if t < nearest:
                nearest = t
                met = planes + k + 1
    reached = real(1.0)
    around = real(1.0)
    if met > 0:
        x = view.origin + nearest * d
        if met > planes:
            normal = normal_of(view, view.things[met - planes - 1], x)
        away = x - view.focus
        if view.shaded == 1 and wp.dot(away, away) < view.far * view.far:
            for k in range(things):
                thing = view.things[k]
                reach = _REACH * thing.radius
                bias = _ABOVE * reach
                to_centre = thing.centre - x
                ahead = wp.dot(view.light, to_centre)
                square = wp.dot(to_centre, to_centre)
                wide = thing.radius + view.spread * wp.max(ahead, ZERO)
                if met != planes + k + 1 or thing.own_shadows == 0:
                    lit = wp.dot(view.light, normal) > ZERO
                    if lit and ahead > -thing.radius and square - ahead * ahead < wide * wide:
                        # From a little above the surface, or it would shadow itself by rounding.
                        reached *= light_left(view, thing, x + bias * normal, bias)
                    if square < (thing.radius + reach) * (thing.radius + reach):
                        around *= sky_left(view, thing, x, normal, reach)
        if met > planes:
            for j in range(planes):
                plane = view.planes[j]
                up = vec3(plane[0], plane[1], plane[2])
                share = wp.clamp(ONE - (wp.dot(up, x) - plane[3]) / view.floor_reach, ZERO, ONE)
                downwards = HALF - HALF * wp.dot(up, normal)
                around *= ONE - _FLOOR_SHADE * downwards * share * share
    depths[r] = wp.float32(nearest)
    if met == 0:
        depths[r] = wp.float32(wp.inf)
    which[r] = met - 1
    normals[r] = wp.vec3f(wp.float32(normal[0]), wp.float32(normal[1]), wp.float32(normal[2]))
    lamp[r] = wp.float32(reached)
    ambient[r] = wp.float32(around)
