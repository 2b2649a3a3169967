"""Signed distances of solids and their gradients at a point, as the classes in `dano.fields` have them."""

import math

import numba

from dano.native import BOX, CAPSULE, CYLINDER, ELLIPSOID, GRID, HALF_SPACE
from dano.native._compiling import lean

# Columns of the table of solids: size, position and rotation of the solid in its field's frame (x = s R y + p
# for y in the solid's own), then what the kind has: normal and offset; radius; half extents and rounding;
# radius and half length; semi-axes; origin and spacing.
FACTOR, POSITION, ROTATION, OWN = 0, 1, 4, 13
# Columns of the table of their whole numbers: kind, first coefficient, nodes along each axis, degree.
KIND, FIRST, NODES, DEGREE = 0, 1, 2, 5

_BISECTIONS, _STEPS = 5, 7  # of the search for the closest point of an ellipsoid, see `Ellipsoid`
_EPSILON = 2.220446049250313e-16


@lean
def distance(solid, whole, atlas, x, y, z, out, slopes):
    """Signed distance [m] of a point in the field frame, and its gradient; or a lower bound on the distance.

    Args:
        solid: Row of the table of solids.
        whole: Row of the table of their whole numbers.
        atlas: Spline coefficients of all grids, in a row.
        x: Coordinates of the point [m, F], as are the next two.
        y: …
        z: …
        out: Written to; the first three numbers are the gradient, those after it are scratch (≥ 30).
        slopes: Whether the gradient is wanted. Without it a point outside of a grid gets a lower bound, in
            half the time: the solid lies in the grid, so d² is no less than the square of the way to the
            grid plus that of the distance there. (What counts is their sum: more than the true distance.)
    """
    factor = solid[FACTOR]
    x, y, z = x - solid[POSITION], y - solid[POSITION + 1], z - solid[POSITION + 2]
    a = (solid[ROTATION] * x + solid[ROTATION + 3] * y + solid[ROTATION + 6] * z) / factor
    b = (solid[ROTATION + 1] * x + solid[ROTATION + 4] * y + solid[ROTATION + 7] * z) / factor
    c = (solid[ROTATION + 2] * x + solid[ROTATION + 5] * y + solid[ROTATION + 8] * z) / factor
    kind = whole[KIND]
    if kind == GRID:
        d = _grid(solid, whole, atlas, a, b, c, out, slopes)
    elif kind == BOX:
        d = _box(solid, a, b, c, out)
    elif kind == CYLINDER:
        d = _cylinder(solid, a, b, c, out)
    elif kind == ELLIPSOID:
        d = _ellipsoid(solid, a, b, c, out)
    elif kind == HALF_SPACE:
        out[0], out[1], out[2] = solid[OWN], solid[OWN + 1], solid[OWN + 2]
        d = out[0] * a + out[1] * b + out[2] * c - solid[OWN + 3]
    else:
        if kind == CAPSULE:
            c -= min(max(c, -solid[OWN + 1]), solid[OWN + 1])
        length = math.sqrt(a * a + b * b + c * c)
        inverse = 1.0 / length if length > 0.0 else 0.0
        out[0], out[1], out[2] = a * inverse, b * inverse, c * inverse
        d = length - solid[OWN]
    if not slopes:
        return factor * d
    a, b, c = out[0], out[1], out[2]
    for k in range(3):
        row = ROTATION + 3 * k
        out[k] = solid[row] * a + solid[row + 1] * b + solid[row + 2] * c
    return factor * d


@lean
def _box(solid, a, b, c, out):
    rounding = solid[OWN + 3]
    out[0] = abs(a) - (solid[OWN] - rounding)
    out[1] = abs(b) - (solid[OWN + 1] - rounding)
    out[2] = abs(c) - (solid[OWN + 2] - rounding)
    largest = max(out[0], max(out[1], out[2]))
    if largest <= 0.0:
        # Where faces tie inside, the mean of theirs.
        ties = 0.0
        for k in range(3):
            out[k] = 1.0 if out[k] == largest else 0.0
            ties += out[k]
        length, value = ties, largest
    else:
        squared = 0.0
        for k in range(3):
            out[k] = max(out[k], 0.0)
            squared += out[k] * out[k]
        length = value = math.sqrt(squared)
    out[0] *= (1.0 if a >= 0.0 else -1.0) / length
    out[1] *= (1.0 if b >= 0.0 else -1.0) / length
    out[2] *= (1.0 if c >= 0.0 else -1.0) / length
    return value - rounding


@lean
def _cylinder(solid, a, b, c, out):
    radius = math.sqrt(a * a + b * b)
    across, along = radius - solid[OWN], abs(c) - solid[OWN + 1]
    largest = max(across, along)
    if largest <= 0.0:
        value = largest
        by_across = 1.0 if across > along else 0.0
        by_along = 1.0 - by_across
    else:
        across, along = max(across, 0.0), max(along, 0.0)
        value = math.sqrt(across * across + along * along)
        by_across, by_along = across / value, along / value
    inverse = 1.0 / radius if radius > 0.0 else 0.0
    out[0], out[1] = by_across * a * inverse, by_across * b * inverse
    out[2] = by_along * (1.0 if c > 0.0 else -1.0 if c < 0.0 else 0.0)
    return value


@lean
def _ellipsoid(solid, a, b, c, out):
    smallest = min(solid[OWN], min(solid[OWN + 1], solid[OWN + 2]))
    shift = smallest * smallest
    lowest, highest = -math.inf, 0.0
    # out: [3:6] a x, [6:9] gaps, [9:12] |x|
    for k in range(3):
        axis = solid[OWN + k]
        x = max(abs(a if k == 0 else b if k == 1 else c), 4.0 * _EPSILON * axis)
        out[3 + k], out[6 + k], out[9 + k] = axis * x, axis * axis - shift, x
        lowest = max(lowest, out[3 + k] - out[6 + k])
        highest += out[3 + k] * out[3 + k]
    low, high = lowest, math.sqrt(highest)
    for _ in range(_BISECTIONS):
        s = math.sqrt(low * high)
        total = 0.0
        for k in range(3):
            total += (out[3 + k] / (s + out[6 + k])) ** 2
        if total >= 1.0:
            low = s
        else:
            high = s
    s = low
    for _ in range(_STEPS):
        total, slope = -1.0, 0.0
        for k in range(3):
            inverse = 1.0 / (s + out[6 + k])
            term = (out[3 + k] * inverse) ** 2
            total += term
            slope += term * inverse
        s = max(s + total / (2.0 * slope), lowest)
    squared = 0.0
    for k in range(3):
        out[k] = out[9 + k] / (s + out[6 + k])
        squared += out[k] * out[k]
    length = math.sqrt(squared)
    out[0] *= (1.0 if a >= 0.0 else -1.0) / length
    out[1] *= (1.0 if b >= 0.0 else -1.0) / length
    out[2] *= (1.0 if c >= 0.0 else -1.0) / length
    return (s - shift) * length


@lean
def _weights(f, degree, out, at):
    """Weights of the nodes of a stencil and their derivatives, see `dano.fields._spline`, four of each."""
    g = 1.0 - f
    if degree == 1:
        out[at], out[at + 1] = g, f
        out[at + 4], out[at + 5] = -1.0, 1.0
    elif degree == 2:
        out[at], out[at + 1], out[at + 2] = 0.5 * (0.5 - f) ** 2, 0.75 - f * f, 0.5 * (0.5 + f) ** 2
        out[at + 4], out[at + 5], out[at + 6] = f - 0.5, -2.0 * f, f + 0.5
    else:
        out[at], out[at + 3] = g * g * g / 6.0, f * f * f / 6.0
        out[at + 1], out[at + 2] = 2.0 / 3.0 - f * f * (1.0 - 0.5 * f), 2.0 / 3.0 - g * g * (1.0 - 0.5 * g)
        out[at + 4], out[at + 5] = -0.5 * g * g, f * (1.5 * f - 2.0)
        out[at + 6], out[at + 7] = g * (2.0 - 1.5 * g), 0.5 * f * f


@lean
def _grid(solid, whole, atlas, a, b, c, out, slopes):
    """The spline of a grid, and beyond its border the way to it, see `SignedDistanceGrid`."""
    degree = whole[DEGREE]
    border, shift = degree + 1, 0 if degree == 1 else 1
    stride_x, stride_y = whole[NODES + 1] * whole[NODES + 2], whole[NODES + 2]
    base = numba.int64(whole[FIRST])
    away_x = away_y = away_z = 0.0
    inside_x = inside_y = inside_z = True
    for k in range(3):
        spacing = solid[OWN + 3 + k]
        u = ((a if k == 0 else b if k == 1 else c) - solid[OWN + k]) / spacing
        last = whole[NODES + k] - 2 * border - 1
        closest = min(max(u, 0.0), numba.float64(last))
        outside, away = closest != u, (u - closest) * spacing
        if k == 0:
            inside_x, away_x = not outside, away
        elif k == 1:
            inside_y, away_y = not outside, away
        else:
            inside_z, away_z = not outside, away
        highest = whole[NODES + k] - border - 1 - degree + shift
        node = math.floor(closest + 0.5) if degree == 2 else math.floor(closest)
        node = min(node, numba.float64(highest)) if node == node else 0.0
        first = numba.int64(node) + border - shift
        base += first * (stride_x if k == 0 else stride_y if k == 1 else 1)
        _weights(closest - node, degree, out, 6 + 8 * k)
    beyond = math.sqrt(away_x * away_x + away_y * away_y + away_z * away_z)
    value = by_x = by_y = by_z = 0.0
    if not slopes:
        for i in range(degree + 1):
            row = 0.0
            for j in range(degree + 1):
                at = base + i * stride_x + j * stride_y
                line = 0.0
                for k in range(degree + 1):
                    line += atlas[at + k] * out[22 + k]
                row += line * out[14 + j]
            value += row * out[6 + i]
        return math.sqrt(value * value + beyond * beyond) if beyond > 0.0 else value
    for i in range(degree + 1):
        row = row_y = row_z = 0.0
        for j in range(degree + 1):
            line = line_z = 0.0
            at = base + i * stride_x + j * stride_y
            for k in range(degree + 1):
                coefficient = atlas[at + k]
                line += coefficient * out[22 + k]
                line_z += coefficient * out[26 + k]
            row += line * out[14 + j]
            row_y += line * out[18 + j]
            row_z += line_z * out[14 + j]
        value += row * out[6 + i]
        by_x += row * out[10 + i]
        by_y += row_y * out[6 + i]
        by_z += row_z * out[6 + i]
    inverse = 1.0 / beyond if beyond > 0.0 else 0.0
    out[0] = (by_x / solid[OWN + 3] if inside_x else 0.0) + away_x * inverse
    out[1] = (by_y / solid[OWN + 4] if inside_y else 0.0) + away_y * inverse
    out[2] = (by_z / solid[OWN + 5] if inside_z else 0.0) + away_z * inverse
    return value + beyond
