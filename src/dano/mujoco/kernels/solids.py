"""Solids of MuJoCo's geoms: those of `dano.physics.solids.distances`, and the two that only MuJoCo has."""

import warp as wp

from dano.mujoco.kernels.tables import Known, Model, PartIndex
from dano.mujoco.kernels.words import HEIGHTS, HULL
from dano.physics.real import INFINITY, ONE, real, vec3, vec4, ZERO
from dano.physics.solids.distances import leaf_clearance, leaf_distance
from dano.physics.solids.grids import closest_in_grid, coarse_bound, grid_value, place_in_grid
from dano.physics.solids.kinds import BOX, ELLIPSOID, GRID, HALF_SPACE
from dano.physics.solids.leaves import Distance

_HULL, _HEIGHTS = wp.constant(HULL), wp.constant(HEIGHTS)
_BOX, _ELLIPSOID = wp.constant(BOX), wp.constant(ELLIPSOID)
_GRID, _HALF_SPACE = wp.constant(GRID), wp.constant(HALF_SPACE)


@wp.func(inline=True)
def hull_distance(known: Known, part: PartIndex, x: vec3) -> Distance:
    """Of the farthest face's plane: outside a lower bound on the distance."""
    d = Distance()
    farthest = int(part.at)
    height = real(-INFINITY)
    for i in range(part.at, part.at + part.count):
        p = known.planes[i]
        h = p[0] * x[0] + p[1] * x[1] + p[2] * x[2] + p[3]
        if h > height:
            height = h
            farthest = i
    p = known.planes[farthest]
    d.value = height
    d.gradient = vec3(p[0], p[1], p[2])
    return d


@wp.func(inline=True)
def height_distance(model: Model, field: int, x: vec3) -> Distance:
    """Height above a height field along its normal; two triangles in each cell, infinite beside it.

    The diagonal of a cell goes from (+x, −y) to (−x, +y); rows begin at −y.
    """
    d = Distance()
    size = model.hfield_size[field]
    columns = model.hfield_ncol[field]
    dx = real(2.0) * size[0] / real(columns - 1)
    dy = real(2.0) * size[1] / real(model.hfield_nrow[field] - 1)
    u = (x[0] + size[0]) / dx
    v = (x[1] + size[1]) / dy
    i = wp.clamp(int(u), 0, columns - 2)
    j = wp.clamp(int(v), 0, model.hfield_nrow[field] - 2)
    u = u - real(i)
    v = v - real(j)
    at = model.hfield_adr[field] + j * columns + i
    z00 = real(model.hfield_data[at])
    z10 = real(model.hfield_data[at + 1])
    z01 = real(model.hfield_data[at + columns])
    z11 = real(model.hfield_data[at + columns + 1])
    along_x = z11 - z01
    along_y = z11 - z10
    start = z01 + z10 - z11
    if u + v <= ONE:
        along_x = z10 - z00
        along_y = z01 - z00
        start = z00
    d.gradient = wp.normalize(vec3(-size[2] * along_x / dx, -size[2] * along_y / dy, ONE))
    d.value = real(INFINITY)
    if wp.abs(x[0]) <= size[0] and wp.abs(x[1]) <= size[1]:
        d.value = (x[2] - size[2] * (start + along_x * u + along_y * v)) * d.gradient[2]
    return d


@wp.func
def part_distance(known: wp.ref[Known], model: wp.ref[Model], part: PartIndex, x: vec3) -> Distance:
    """Signed distance of a part's solid, and its gradient, at a point of its frame [m]."""
    if part.solid == _HULL:
        return hull_distance(known, part, x)
    if part.solid == _HEIGHTS:
        return height_distance(model, part.at, x)
    return leaf_distance(known.solids, 0, known.solids.kinds[part.at], known.solids.leaves[0, part.at], x)


@wp.func(inline=True)
def beyond(plane: vec4, x: vec3) -> real:
    """Height above a plane [m]."""
    return plane[0] * x[0] + plane[1] * x[1] + plane[2] * x[2] + plane[3]


@wp.func
def distance_with_faces(
    known: wp.ref[Known], model: wp.ref[Model], part: PartIndex, band: real, x: vec3
) -> tuple[real, vec3, int]:
    """`part_distance`, by the flat faces of an object where one of them is nearest; 1 if one is.

    Below or above a face, and nearer to its plane than to its edges, the distance is that of the plane. Where
    edges are nearer, what the grid rounds does not make it deeper than the plane.
    """
    d = Distance()
    d.value = real(INFINITY)
    deepest = real(-INFINITY)
    of_deepest = vec3()
    for f in range(part.first_face, part.first_face + part.faces):
        face = known.faces[f]
        height = beyond(face.plane, x)
        if wp.abs(height) < band:
            aside = real(-INFINITY)
            for k in range(face.first, face.first + face.count):
                aside = wp.max(aside, beyond(known.edges[k], x))
            if aside <= wp.min(height, ZERO):
                if height < d.value:
                    d.value = height
                    d.gradient = vec3(face.plane[0], face.plane[1], face.plane[2])
            elif aside < band and height <= ZERO and height > deepest:
                deepest = height
                of_deepest = vec3(face.plane[0], face.plane[1], face.plane[2])
    flat = int(1)
    if d.value == real(INFINITY):
        flat = 0
        d = part_distance(known, model, part, x)
        if d.value < deepest:
            d.value = deepest
            d.gradient = of_deepest
            flat = 1
    return d.value, d.gradient, flat


@wp.func(inline=True)
def grid_bound(known: Known, part: PartIndex, x: vec3, enough: real) -> real:
    """`part_distance` of an object [m], or a lower bound beyond `enough`: of a few cells, and the way."""
    leaf = known.solids.leaves[0, part.at]
    kind = known.solids.kinds[part.at]
    u = place_in_grid(leaf, (ONE / leaf.factor) * (wp.transpose(leaf.rotation) * (x - leaf.position)))
    closest = closest_in_grid(kind, u)
    away = wp.length(wp.cw_mul(u - closest, leaf.spacing))
    bound = leaf.factor * (coarse_bound(known.solids, 0, kind, closest) + away)
    if bound <= enough:
        bound = leaf.factor * (grid_value(known.solids, 0, kind, closest) + away)
    return bound


@wp.func(inline=True)
def quick_clearance(known: Known, part: PartIndex, x: vec3, enough: real) -> real:
    """A lower bound on the distance of a part's solid [m] where that takes far less than with its gradient.

    Any that exceeds `enough` will do.
    """
    bound = real(-INFINITY)
    if part.solid == _HALF_SPACE:
        # MuJoCo's planes are normal to their z axis.
        bound = x[2]
    elif part.solid == _ELLIPSOID:
        # |y / a| grows by no more than 1 / min a along any way, and no root has to be found for it.
        a = known.solids.leaves[0, part.at].sizes
        bound = wp.min(a[0], wp.min(a[1], a[2])) * (wp.length(wp.cw_div(x, a)) - ONE)
    elif part.solid == _BOX:
        # Beyond the farthest face.
        half = known.solids.leaves[0, part.at].sizes
        bound = wp.max(wp.abs(x[0]) - half[0], wp.max(wp.abs(x[1]) - half[1], wp.abs(x[2]) - half[2]))
    elif part.solid == _GRID:
        bound = grid_bound(known, part, x, enough)
    return bound


@wp.func(inline=True)
def part_clearance(known: Known, model: Model, part: PartIndex, x: vec3, enough: real) -> real:
    """A lower bound on the distance of a part's solid [m]; where it exceeds `enough`, any that does."""
    bound = ZERO
    if part.solid == _HULL:
        bound = hull_distance(known, part, x).value
    elif part.solid == _HEIGHTS:
        # Heights are at most 1 of their scale.
        bound = x[2] - model.hfield_size[part.at][2]
    elif part.solid == _ELLIPSOID:
        bound = quick_clearance(known, part, x, enough)
    elif part.solid == _BOX:
        bound = quick_clearance(known, part, x, enough)
        if bound > ZERO and bound <= enough:
            half = known.solids.leaves[0, part.at].sizes
            bound = wp.length(wp.max(vec3(wp.abs(x[0]), wp.abs(x[1]), wp.abs(x[2])) - half, vec3()))
    else:
        bound = leaf_clearance(
            known.solids, 0, known.solids.kinds[part.at], known.solids.leaves[0, part.at], x, enough
        )
    return bound
