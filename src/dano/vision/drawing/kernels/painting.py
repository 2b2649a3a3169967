"""From light and material to colour: lamp, sky, floor, backdrop, transfer curve. Kernels, a ray a thread."""

import warp as wp

from dano.physics.real import HALF, ONE, real, vec3, ZERO

_DARKER_TILE = wp.constant(real(0.90))
# Of the floor: what it shows of its own grey, and of the tint that is asked for.
_GREY, _TINTED = wp.constant(real(0.4)), wp.constant(real(0.6))
_SKY_POWER_LAW = wp.constant(real(0.7))
_DEEPER = wp.constant(vec3(real(0.42), real(0.34), real(0.24)))
# Highlights of a solid: of the lamp, and of the sky at grazing angles.
_GLINT, _RIM, _SHARP = wp.constant(real(0.16)), wp.constant(real(0.16)), wp.constant(real(48.0))


@wp.struct
class Scenery:
    """Light and surroundings; see `dano.vision.drawing._shade.Surroundings`.

    Attributes:
        origin: Of the rays [m, W].
        light: Unit direction towards the lamp [W].
        lamp: Its linear colour times its power.
        sky: That of the light from above.
        ground: That of the light from below.
        floor: Albedo of floors.
        horizon: Linear colour where floor and sky meet.
        focus: The point looked at [m, W].
        fade_start: Distance from it [m] at which the floor starts to fade into the horizon.
        fade_end: Distance from it [m] at which it has faded.
        tile: Side of the floor's tiles [m].
        pixel: Angle of a pixel [rad].
        gamma: Exponent from pictures to linear light.
        albedos: Of planes, whose colour is a tint of the floor's, and of things after them; linear.
        n_planes: Number of planes.
    """

    origin: vec3
    light: vec3
    lamp: vec3
    sky: vec3
    ground: vec3
    floor: vec3
    horizon: vec3
    focus: vec3
    fade_start: real
    fade_end: real
    tile: real
    pixel: real
    gamma: real
    albedos: wp.array(dtype=vec3)
    n_planes: int


@wp.func
def backdrop(scenery: Scenery, d: vec3) -> vec3:
    """Linear colour of the empty surroundings: the horizon, slightly deeper upwards."""
    height = wp.pow(wp.clamp(d[2], ZERO, ONE), _SKY_POWER_LAW)
    return wp.cw_mul(scenery.horizon, vec3(ONE, ONE, ONE) - height * _DEEPER)


@wp.func
def triangle(x: real) -> real:
    """Distance of x from the nearest whole number and a half."""
    return wp.abs(x - wp.floor(x) - HALF)


@wp.func
def tile_pattern(u: real, width: real) -> real:
    """Mean of a square wave of period 2 and values ±1 over a footprint around u."""
    low = triangle(HALF * (u - HALF * width))
    high = triangle(HALF * (u + HALF * width))
    return wp.clamp(real(2.0) * (low - high) / width, -ONE, ONE)


@wp.func
def floor_albedo(scenery: Scenery, tint: vec3, normal: vec3, x: vec3, d: vec3, t: real) -> vec3:
    """Albedo of a checkered plane, averaged over the footprint of a pixel."""
    aside = vec3(ONE, ZERO, ZERO)
    if wp.abs(normal[1]) < real(0.9):
        aside = vec3(ZERO, ONE, ZERO)
    first = wp.normalize(wp.cross(normal, aside))
    second = wp.cross(normal, first)
    cosine = wp.max(-wp.dot(normal, d), real(1e-3))
    # The footprint of a pixel is stretched along the line of sight.
    size = scenery.pixel / scenery.tile * t
    pattern = tile_pattern(
        wp.dot(first, x) / scenery.tile, size * (wp.abs(wp.dot(first, d)) / cosine + ONE) + real(1e-6)
    )
    pattern *= tile_pattern(
        wp.dot(second, x) / scenery.tile, size * (wp.abs(wp.dot(second, d)) / cosine + ONE) + real(1e-6)
    )
    base = wp.cw_mul(scenery.floor, _GREY * vec3(ONE, ONE, ONE) + _TINTED * tint)
    return (ONE - (ONE - _DARKER_TILE) * HALF * (ONE + pattern)) * base


@wp.func
def floor_fade(scenery: Scenery, x: vec3) -> real:
    """Share of the horizon's colour at a point [m, W] of a plane."""
    away = (wp.length(x - scenery.focus) - scenery.fade_start) / (scenery.fade_end - scenery.fade_start)
    rest = ONE - wp.clamp(away, ZERO, ONE)
    return ONE - rest * rest


@wp.func
def shaded(scenery: Scenery, albedo: vec3, normal: vec3, d: vec3, lamp: real, ambient: real) -> vec3:
    """Linear colour of a matte point for the shares of light that reach it."""
    cosine = wp.max(wp.dot(scenery.light, normal), ZERO)
    sky = HALF + HALF * normal[2]
    around = ambient * (scenery.ground + sky * (scenery.sky - scenery.ground))
    return wp.cw_mul(albedo, around + (cosine * lamp) * scenery.lamp)


@wp.func
def shine(scenery: Scenery, normal: vec3, d: vec3, lamp: real, ambient: real) -> real:
    """Highlights of a solid."""
    facing = wp.clamp(-wp.dot(normal, d), ZERO, ONE)
    between = scenery.light - d
    between = between / wp.max(wp.length(between), real(1e-6))
    glint = real(0.0)
    if wp.dot(scenery.light, normal) > ZERO:
        glint = lamp * wp.pow(wp.max(wp.dot(between, normal), ZERO), _SHARP)
    edge = (ONE - facing) * (ONE - facing)
    return _GLINT * glint + _RIM * edge * edge * ambient * (HALF + HALF * normal[2])


@wp.func
def picture_value(scenery: Scenery, linear: wp.float32) -> wp.uint8:
    """A linear colour as the 8-bit value of a picture."""
    shown = wp.pow(wp.clamp(real(linear), ZERO, ONE), ONE / scenery.gamma)
    return wp.uint8(wp.rint(real(255.0) * shown))


@wp.kernel(enable_backward=False)
def paint(
    scenery: Scenery,
    directions: wp.array(dtype=wp.vec3f),
    depths: wp.array(dtype=wp.float32),
    which: wp.array(dtype=wp.int32),
    normals: wp.array(dtype=wp.vec3f),
    lamp: wp.array(dtype=wp.float32),
    ambient: wp.array(dtype=wp.float32),
    colours: wp.array(dtype=wp.vec3f),
    picture: wp.array(dtype=wp.types.vector(length=3, dtype=wp.uint8)),
):
    """Colours that arrive along rays.

    Args:
        scenery: Light and surroundings.
        directions: See `tracing.trace`, as the other arrays that are read.
        depths: See there.
        which: See there.
        normals: See there.
        lamp: See there.
        ambient: See there.
        colours: Written: linear.
        picture: Written: values of a picture.
    """
    r = wp.tid()
    d = vec3(real(directions[r][0]), real(directions[r][1]), real(directions[r][2]))
    met = which[r]
    colour = vec3()
    if met < 0:
        colour = backdrop(scenery, d)
    else:
        t = real(depths[r])
        x = scenery.origin + t * d
        normal = vec3(real(normals[r][0]), real(normals[r][1]), real(normals[r][2]))
        albedo = scenery.albedos[met]
        if met < scenery.n_planes:
            albedo = floor_albedo(scenery, albedo, normal, x, d, t)
        colour = shaded(scenery, albedo, normal, d, real(lamp[r]), real(ambient[r]))
        if met < scenery.n_planes:
            fade = floor_fade(scenery, x)
            colour = (ONE - fade) * colour + fade * scenery.horizon
        else:
            gloss = shine(scenery, normal, d, real(lamp[r]), real(ambient[r]))
            colour = colour + vec3(gloss, gloss, gloss)
    linear = wp.vec3f(wp.float32(colour[0]), wp.float32(colour[1]), wp.float32(colour[2]))
    colours[r] = linear
    shown = picture[r]
    for k in range(3):
        shown[k] = picture_value(scenery, linear[k])
    picture[r] = shown
