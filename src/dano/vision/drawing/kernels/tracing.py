"""Rays through solids: where they meet one, and what light arrives there. Kernels, a block of rays a thread.

Solids are those of contact (`dano.physics.solids`), so that what is drawn is what touches.

Rays of a block share what they can. A cone around them all goes first, so that each begins close to the
surface, or misses it untried. Light is asked for at the corners of a block and one ray more, and interpolated
between them where it varies little.
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
# Rays of a block: 4 × 4 pixels in Morton order, so that x is bits 0 and 2 of a ray's number, y bits 1 and 3.
BLOCK = 16
_BLOCK = wp.constant(BLOCK)
# The numbers of its corners are 0, 5, 10, 15; light is compared at one ray more, at (2, 2).
_TO_CORNER, _INNER = wp.constant(5), wp.constant(12)
# A cone ends where what is free around it is less than this share of its radius.
_NARROW = wp.constant(real(0.5))
# Light is shared by a block, or a pixel, if normals agree to this cosine, corners to this share of all light,
# and the inner ray to that one: a step of grey or two.
_SAME_SIDE, _EVEN, _EXACT = wp.constant(real(0.9)), wp.constant(real(0.15)), wp.constant(real(0.015))
# … and if a shadow changes by less than this share of a lamp's disc from one ray to the others.
_GENTLE = wp.constant(real(1.2))
# Surfaces that are seen at a smaller cosine are taken for this.
_GRAZING = wp.constant(real(0.05))


@wp.struct
class Thing:
    """A solid somewhere."""

    first: int  # Its first leaf in `Solids`
    count: int  # Number of leaves
    own_shadows: int  # Whether it already shows the light that it takes from itself
    rotation: mat33  # F → W
    position: vec3  # Of the field frame [m, W]
    centre: vec3  # Of a ball around it [m, W]
    radius: real  # Of that ball [m]
    low: vec3  # Lower corner of a box around it [m, F]
    high: vec3  # Upper corner [m, F]


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


@wp.struct
class Cone:
    """Some rays from one point together."""

    axis: vec3  # Their mean direction, a unit vector [W]
    width: real  # Greatest distance of a unit direction from it


@wp.func
def may_meet(view: View, thing: Thing, cone: Cone) -> bool:
    """Whether a ray of a cone may meet the ball around a thing."""
    away = thing.centre - view.origin
    square = wp.dot(away, away)
    # A ray that meets the ball does so before it has gone this far, and is no further from the axis there.
    radius = thing.radius + cone.width * (wp.sqrt(square) + thing.radius)
    along = wp.dot(away, cone.axis)
    beside = square - radius * radius
    return beside <= ZERO or (along > ZERO and along * along > beside)


@wp.func
def cone_around(directions: wp.array(dtype=wp.vec3f), first: int, end: int) -> Cone:
    """The cone around rays of some numbers."""
    cone = Cone()
    for r in range(first, end):
        cone.axis += direction_of(directions, r)
    cone.axis = wp.normalize(cone.axis)
    square = real(0.0)
    for r in range(first, end):
        beside = direction_of(directions, r) - cone.axis
        square = wp.max(square, wp.dot(beside, beside))
    cone.width = wp.sqrt(square)
    return cone


@wp.func
def direction_of(directions: wp.array(dtype=wp.vec3f), r: int) -> vec3:
    """Unit direction of a ray [W], to the rounding of 32 bits."""
    return vec3(real(directions[r][0]), real(directions[r][1]), real(directions[r][2]))


@wp.func
def free_along(view: View, thing: Thing, cone: Cone, limit: real) -> real:
    """How far all rays of a cone go [m] before one of them may meet a thing; infinite if none does."""
    o = wp.transpose(thing.rotation) * (view.origin - thing.position)
    d = wp.transpose(thing.rotation) * cone.axis
    solid = solid_of(view.solids, 0, thing.first, thing.count)
    size = wp.max(thing.high - thing.low)
    grow = cone.width * (wp.length(thing.centre - view.origin) + thing.radius)
    margin = vec3(grow, grow, grow)
    way = way_through(thing.low - margin, thing.high + margin, o, d)
    leave = wp.min(way.leave, limit)
    t = way.enter
    found = real(INFINITY)
    i = int(0)
    while i < _MOST and t < leave:
        # At equal distances along them, rays are no further apart than this.
        beside = cone.width * t
        s = solid_clearance(view.solids, 0, solid, o + t * d, _COARSE * size + beside) - beside
        if s < _NARROW * beside + _FINE * size:
            found = t
            leave = ZERO
        t += _CAUTION * s
        i += 1
    # What takes longer than that goes on by single rays.
    if i == _MOST:
        found = t
    return found


@wp.func
def distance_to(view: View, thing: Thing, direction: vec3, begin: real, limit: real) -> real:
    """How far along a ray [m] a thing is met from `begin` on; `limit` or more if it is not before."""
    o = wp.transpose(thing.rotation) * (view.origin - thing.position)
    d = wp.transpose(thing.rotation) * direction
    solid = solid_of(view.solids, 0, thing.first, thing.count)
    size = wp.max(thing.high - thing.low)
    way = way_through(thing.low, thing.high, o, d)
    leave = wp.min(way.leave, limit)
    t = wp.max(way.enter, begin)
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


@wp.struct
class Shadow:
    """What a thing takes from a light at a point."""

    left: real  # Share of the light that it leaves
    steep: real  # How much more of it at most it may hide, or show, a metre beside [1/m]


@wp.func
def light_left(view: View, thing: Thing, x: vec3, bias: real, beside: real) -> Shadow:
    """Share of the lamp's light that a thing leaves to a point [m, W], a little above its own surface.

    At distance t the disc of the lamp has the radius spread · t, and the ray is at the height s above the
    thing. The least s / (spread · t), between −1 (dark) and 1 (clear), says how much of the disc is seen.
    Where it is above 1 for all points up to `beside` [m] from x, the shadow is not steep at all.
    """
    o = wp.transpose(thing.rotation) * (x - thing.position)
    d = wp.transpose(thing.rotation) * view.light
    solid = solid_of(view.solids, 0, thing.first, thing.count)
    # Grown by what the cone's width reaches beyond the box.
    ahead = wp.max(wp.dot(HALF * (thing.low + thing.high) - o, d), ZERO)
    grow = view.spread * ahead + TWO * bias + beside
    margin = vec3(grow, grow, grow)
    way = way_through(thing.low - margin, thing.high + margin, o, d)
    t = wp.max(way.enter, bias)
    seen = real(1.0)
    shadow = Shadow()
    i = int(0)
    while i < _MOST and t < way.leave and seen > -ONE:
        wide = view.spread * t
        s = solid_clearance(view.solids, 0, solid, o + t * d, wide + beside)
        seen = wp.min(seen, s / wide)
        if s < wide + beside:
            shadow.steep = wp.max(shadow.steep, ONE / wide)
        t += wp.max(_SHADOW_CAUTION * wp.abs(s), bias + _SLOWEST * wide)
        i += 1
    seen = wp.max(seen, -ONE)
    # Share of the lamp's disc above a straight edge, nearly: the cubic with zero slope at both ends.
    shadow.left = real(0.25) * (ONE + seen) * (ONE + seen) * (TWO - seen)
    return shadow


@wp.func
def sky_left(view: View, thing: Thing, x: vec3, normal: vec3, reach: real, beside: real) -> Shadow:
    """Share of the light from all around that a thing leaves to a point [m, W] of a surface."""
    solid = solid_of(view.solids, 0, thing.first, thing.count)
    covered = real(0.0)
    shadow = Shadow()
    for k in range(4):
        height = reach * _HEIGHTS[k]
        place = wp.transpose(thing.rotation) * (x + height * normal - thing.position)
        s = solid_clearance(view.solids, 0, solid, place, height + beside)
        covered += _WEIGHTS[k] * wp.clamp(ONE - s / height, ZERO, _FULL)
        if s < height + beside:
            shadow.steep += _WEIGHTS[k] / height
    shadow.left = wp.clamp(ONE - covered, _DARKEST, ONE)
    return shadow


@wp.struct
class Light:
    """What arrives at a point of a surface.

    Attributes:
        lamp: Share of the lamp's light.
        ambient: Share of the light from all around.
        steep: See `Shadow`; the lamp's, of things that the point is not on.
        whole: Whether all light arrives here, and as far beside as was asked for.
    """

    lamp: real
    ambient: real
    steep: real
    whole: bool


@wp.func
def light_at(view: View, met: int, x: vec3, normal: vec3, beside: real) -> Light:
    """What arrives at a point [m, W] of the thing or plane `met`; `beside` [m]: see `light_left`."""
    light = Light()
    light.lamp = ONE
    light.ambient = ONE
    planes = view.planes.shape[0]
    light.whole = met < planes
    away = x - view.focus
    if view.shaded == 1 and wp.dot(away, away) < view.far * view.far:
        for k in range(view.things.shape[0]):
            thing = view.things[k]
            reach = _REACH * thing.radius
            bias = _ABOVE * reach
            to_centre = thing.centre - x
            ahead = wp.dot(view.light, to_centre)
            square = wp.dot(to_centre, to_centre)
            wide = thing.radius + beside + view.spread * wp.max(ahead, ZERO)
            if met != planes + k or thing.own_shadows == 0:
                lit = wp.dot(view.light, normal) > ZERO
                if lit and ahead > -thing.radius and square - ahead * ahead < wide * wide:
                    # From a little above the surface, or it would shadow itself by rounding.
                    shadow = light_left(view, thing, x + bias * normal, bias, beside)
                    light.lamp *= shadow.left
                    light.whole = light.whole and shadow.steep == ZERO
                    if met != planes + k:
                        light.steep = wp.max(light.steep, shadow.steep)
                near = thing.radius + reach + beside
                if square < near * near:
                    shadow = sky_left(view, thing, x, normal, reach, beside)
                    light.ambient *= shadow.left
                    light.whole = light.whole and shadow.steep == ZERO
    if met >= planes:
        for j in range(planes):
            plane = view.planes[j]
            up = vec3(plane[0], plane[1], plane[2])
            share = wp.clamp(ONE - (wp.dot(up, x) - plane[3]) / view.floor_reach, ZERO, ONE)
            downwards = HALF - HALF * wp.dot(up, normal)
            light.ambient *= ONE - _FLOOR_SHADE * downwards * share * share
    return light


@wp.struct
class Rays:
    """Rays, and what they meet.

    Attributes:
        directions: Unit directions [W].
        depths: Written: distance [m]; infinite where nothing is met.
        which: Written: number of the plane, or of the thing after all planes; −1 for none.
        normals: Written: unit normals [W].
        lamp: Written: shares of the lamp's light that arrive.
        ambient: Written: shares of light from all around.
        regular: How many of them, from the first on, come in blocks of 4 × 4 pixels.
        together: How many in a row go around one pixel.
    """

    directions: wp.array(dtype=wp.vec3f)
    depths: wp.array(dtype=wp.float32)
    which: wp.array(dtype=wp.int32)
    normals: wp.array(dtype=wp.vec3f)
    lamp: wp.array(dtype=wp.float32)
    ambient: wp.array(dtype=wp.float32)
    regular: int
    together: int


@wp.func
def normal_met(rays: Rays, r: int) -> vec3:
    """Unit normal [W] where a ray ends."""
    return vec3(real(rays.normals[r][0]), real(rays.normals[r][1]), real(rays.normals[r][2]))


@wp.func
def meet_planes(view: View, rays: Rays, r: int):
    """Where a ray meets the first plane, if no thing stands before it."""
    d = direction_of(rays.directions, r)
    nearest = real(INFINITY)
    met = int(-1)
    normal = vec3()
    for j in range(view.planes.shape[0]):
        plane = view.planes[j]
        up = vec3(plane[0], plane[1], plane[2])
        height = wp.dot(up, view.origin) - plane[3]
        fall = -wp.dot(up, d)
        # From below, a floor would hide everything.
        if height > ZERO and fall > real(1e-6):
            if height / fall < nearest:
                nearest = height / fall
                met = j
                normal = up
    rays.depths[r] = wp.float32(wp.inf)
    if met >= 0:
        rays.depths[r] = wp.float32(nearest)
    rays.which[r] = met
    rays.normals[r] = wp.vec3f(wp.float32(normal[0]), wp.float32(normal[1]), wp.float32(normal[2]))
    rays.lamp[r] = wp.float32(ONE)
    rays.ambient[r] = wp.float32(ONE)


@wp.func
def meet_thing(view: View, rays: Rays, k: int, first: int, end: int, cone: Cone):
    """Where rays of a block meet a thing, if nothing stands before it."""
    thing = view.things[k]
    if not may_meet(view, thing, cone):
        return
    limit = real(0.0)
    for r in range(first, end):
        limit = wp.max(limit, wp.min(real(rays.depths[r]), real(INFINITY)))
    begin = free_along(view, thing, cone, limit)
    if begin < limit:
        for r in range(first, end):
            d = direction_of(rays.directions, r)
            before = wp.min(real(rays.depths[r]), real(INFINITY))
            t = distance_to(view, thing, d, begin, before)
            if t < before:
                rays.depths[r] = wp.float32(t)
                rays.which[r] = view.planes.shape[0] + k


@wp.func
def is_one_side(rays: Rays, first: int, end: int) -> bool:
    """Whether some rays end on one thing, or plane, and on one side of it."""
    met = rays.which[first]
    same = met >= 0
    for r in range(first + 1, end):
        if same and rays.which[r] != met:
            same = False
    if same:
        normal = normal_met(rays, first)
        for r in range(first + 1, end):
            if wp.dot(normal, normal_met(rays, r)) < _SAME_SIDE:
                same = False
    return same


@wp.func
def between(a: wp.array(dtype=wp.float32), first: int, i: int) -> real:
    """What a ray of a block has between the corners of the block."""
    across = real(i % 2 + 2 * ((i // 4) % 2)) / real(3.0)
    down = real((i // 2) % 2 + 2 * (i // 8)) / real(3.0)
    top = real(a[first]) + across * (real(a[first + 5]) - real(a[first]))
    bottom = real(a[first + 10]) + across * (real(a[first + 15]) - real(a[first + 10]))
    return top + down * (bottom - top)


@wp.func
def spread_at_corners(a: wp.array(dtype=wp.float32), first: int) -> real:
    """By how much the corners of a block differ."""
    low = real(a[first])
    high = real(a[first])
    for i in range(1, 4):
        low = wp.min(low, real(a[first + i * _TO_CORNER]))
        high = wp.max(high, real(a[first + i * _TO_CORNER]))
    return high - low


@wp.func
def lighten(view: View, rays: Rays, r: int, beside: real) -> Light:
    """What light arrives where a ray ends."""
    x = view.origin + real(rays.depths[r]) * direction_of(rays.directions, r)
    light = light_at(view, rays.which[r], x, normal_met(rays, r), beside)
    rays.lamp[r] = wp.float32(light.lamp)
    rays.ambient[r] = wp.float32(light.ambient)
    return light


@wp.func
def reach_beside(view: View, rays: Rays, r: int, width: real) -> real:
    """How far beside a ray's end others end [m] that differ by `width`: further at a slant."""
    slant = -wp.dot(normal_met(rays, r), direction_of(rays.directions, r))
    return width * real(rays.depths[r]) / wp.max(slant, _GRAZING)


@wp.func
def is_lit_together(view: View, rays: Rays, first: int, cone: Cone) -> bool:
    """Light a block of pixels by some of its rays, if that is right: by one, or interpolated between five."""
    if not is_one_side(rays, first, first + _BLOCK):
        return False
    beside = real(0.0)
    for i in range(4):
        r = first + i * _TO_CORNER
        beside = wp.max(beside, reach_beside(view, rays, r, TWO * cone.width))
    inner = lighten(view, rays, first + _INNER, beside)
    if inner.whole:
        return True
    steep = inner.steep
    for i in range(4):
        corner = lighten(view, rays, first + i * _TO_CORNER, beside)
        steep = wp.max(steep, corner.steep)
    if steep * beside > _GENTLE:
        return False
    if spread_at_corners(rays.lamp, first) > _EVEN or spread_at_corners(rays.ambient, first) > _EVEN:
        return False
    lamp_off = wp.abs(between(rays.lamp, first, _INNER) - real(rays.lamp[first + _INNER]))
    ambient_off = wp.abs(between(rays.ambient, first, _INNER) - real(rays.ambient[first + _INNER]))
    if lamp_off > _EXACT or ambient_off > _EXACT:
        return False
    for i in range(1, _BLOCK):
        if i % _TO_CORNER != 0 and i != _INNER:
            rays.lamp[first + i] = wp.float32(between(rays.lamp, first, i))
            rays.ambient[first + i] = wp.float32(between(rays.ambient, first, i))
    return True


@wp.func
def light_pixel(view: View, rays: Rays, first: int, end: int):
    """Light the rays of a pixel: by two opposite ones, if they end on one side of a thing in gentle light.

    The mean of these is that of all where light varies linearly.
    """
    opposite = (first + end) // 2
    shared = end > first + 1 and is_one_side(rays, first, end)
    if shared:
        beside = reach_beside(view, rays, first, view.pixel)
        one = lighten(view, rays, first, beside)
        if not one.whole:
            other = lighten(view, rays, opposite, beside)
            shared = wp.max(one.steep, other.steep) * beside <= _GENTLE
            shared = shared and wp.abs(one.lamp - other.lamp) <= _EVEN
            shared = shared and wp.abs(one.ambient - other.ambient) <= _EVEN
    for r in range(first, end):
        if shared:
            half = wp.where(r < opposite, first, opposite)
            rays.lamp[r] = rays.lamp[half]
            rays.ambient[r] = rays.ambient[half]
        elif rays.which[r] >= 0:
            lighten(view, rays, r, ZERO)


@wp.kernel(enable_backward=False)
def trace(view: View, rays: Rays):
    """What rays meet first, a block of them a thread.

    Args:
        view: What there is.
        rays: Rays from `view.origin`; what they meet is written.
    """
    first = wp.tid() * _BLOCK
    end = wp.min(first + _BLOCK, rays.directions.shape[0])
    planes = view.planes.shape[0]
    for r in range(first, end):
        meet_planes(view, rays, r)
    cone = cone_around(rays.directions, first, end)
    for k in range(view.things.shape[0]):
        meet_thing(view, rays, k, first, end, cone)
    for r in range(first, end):
        if rays.which[r] >= planes:
            x = view.origin + real(rays.depths[r]) * direction_of(rays.directions, r)
            n = normal_of(view, view.things[rays.which[r] - planes], x)
            rays.normals[r] = wp.vec3f(wp.float32(n[0]), wp.float32(n[1]), wp.float32(n[2]))
    done = bool(False)
    if end == first + _BLOCK and end <= rays.regular:
        done = is_lit_together(view, rays, first, cone)
    if not done:
        for r in range(first, end, rays.together):
            light_pixel(view, rays, r, wp.min(r + rays.together, end))
