"""Finding contact: `dano.contact.find` in machine code, for solids of the kinds of `_solids`."""

import math

import numba
import numpy as np

from dano.native import HALF_SPACE, RUN
from dano.native._compiling import fingerprint, kernel
from dano.native._ffi import (
    cube,
    doubles,
    inputs,
    outputs,
    register,
    SIGNATURE,
    table,
    tells_version,
    vector,
)
from dano.native._solids import distance, KIND

# Columns of the table of bodies: position, orientation (wxyz), orientation at the end of the step, velocity,
# spin, centre of mass [F], 1 / mass, inverse of the inertia [W]; then scale, and the ball around the body.
_POSITION, _ORIENTATION, _AHEAD, _VELOCITY, _SPIN, _COM, _LIGHTNESS, _MOBILITY = 0, 3, 7, 11, 14, 17, 20, 21
_SCALE, _MIDDLE, _RADIUS = 30, 33, 36
# Of their whole numbers: first block, blocks, first probe, probes, how samples turn.
_START, _BLOCKS, _PROBE_START, _PROBES, _TURNING = range(5)
_AXIS, _BALL = 1, 2
# Columns of the table of pairs: share of the stiffness, whether points follow the second body, depth up to
# which predicted geometry is taken, margin. Of their whole numbers: bodies, solid, contact, kind of solid as
# `dano.contact.Kind` counts them, number within the kind.
_SHARE, _FOLLOWS, _SINK, _MARGIN = range(4)
_FIRST, _SECOND, _SOLID, _CONTACT, _GROUP, _PLACE = range(6)
# Settings: h, what `dano.contact` calls IMPACT, SHARES and ADVANCES, its pole, its rotation from z, and what
# it calls TURNED, FASTEST, PULL, SEARCHES and FOUND.
_H, _IMPACT, _SHARES, _ADVANCES, _POLE, _FROM_Z, _TURNED, _FASTEST = 0, 1, 2, 3, 4, 7, 16, 17
_PULL, _SEARCHES, _FOUND = 18, 19, 20
# A pair at a moment, see `dano.contact.Placed`: samples to solid frame and origin, vector areas, solid axes
# to world, centre of mass, velocity, spin, lowest, axis, stretch, samples to arms and their offset,
# direction to the solid.
_POINTS, _ORIGIN, _VECTORS, _WORLD, _CENTRE, _MOVES, _TURNS = 0, 9, 12, 21, 30, 33, 36
_LOWEST, _AXIS_AT, _STRETCH, _ARMS, _ARM_ORIGIN, _FACING, _PLACED = 39, 42, 45, 46, 55, 58, 61
# Sampled distances may grow faster than true ones: near the shipped objects a hundredth of the space has
# gradients above 1.2, a thousandth above 1.45.
STEEPEST = 1.5


@kernel
def _matrix(q, at, out, to):
    """Rotation of a quaternion q[at:], row by row into out[to:]."""
    w, x, y, z = q[at], q[at + 1], q[at + 2], q[at + 3]
    out[to], out[to + 1], out[to + 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    out[to + 3], out[to + 4], out[to + 5] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[to + 6], out[to + 7], out[to + 8] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@kernel
def _apply(a, at, x, y, z, out, to):
    for k in range(3):
        row = at + 3 * k
        out[to + k] = a[row] * x + a[row + 1] * y + a[row + 2] * z


@kernel
def _apply_transposed(a, at, x, y, z, out, to):
    for k in range(3):
        out[to + k] = a[at + k] * x + a[at + 3 + k] * y + a[at + 6 + k] * z


@kernel
def _product(a, at, b, of, out, to):
    """Product of two 3 × 3 matrices; `out` is none of them."""
    for r in range(3):
        for c in range(3):
            out[to + 3 * r + c] = (
                a[at + 3 * r] * b[of + c]
                + a[at + 3 * r + 1] * b[of + 3 + c]
                + a[at + 3 * r + 2] * b[of + 6 + c]
            )


@kernel
def _moved(body, share, h, out):
    """Position (0:3) and rotation (3:12) of a body after a share of the step."""
    squared = 0.0
    for k in range(4):
        out[3 + k] = body[_ORIENTATION + k] + share * (body[_AHEAD + k] - body[_ORIENTATION + k])
        squared += out[3 + k] * out[3 + k]
    inverse = 1.0 / math.sqrt(squared)
    for k in range(4):
        out[12 + k] = out[3 + k] * inverse
    _matrix(out, 12, out, 3)
    for k in range(3):
        out[k] = body[_POSITION + k] + share * h * body[_VELOCITY + k]


@kernel
def _length(a, at):
    return math.sqrt(a[at] * a[at] + a[at + 1] * a[at + 1] + a[at + 2] * a[at + 2])


@kernel
def _face(out, solid, whole, atlas, x, y, z, scratch):
    """Direction from a point to the solid in the axes of the samples' body, into scratch[30:33]; distance."""
    apart = distance(solid, whole, atlas, x, y, z, scratch, True)
    _apply_transposed(out, _POINTS, -scratch[0], -scratch[1], -scratch[2], scratch, 30)
    _direct(scratch, 30)
    return apart


@kernel
def _direct(a, at):
    length = max(_length(a, at), 1e-12)
    for k in range(3):
        a[at + k] /= length


@kernel
def _towards(settings, x, y, z, out, to, scratch, at):
    """A rotation that takes z to a unit vector, see `dano.contact`."""
    px, py, pz = -settings[_POLE], -settings[_POLE + 1], -settings[_POLE + 2]
    ax, ay, az = py * z - pz * y, pz * x - px * z, px * y - py * x
    squared = ax * ax + ay * ay + az * az
    beyond = max(1.0 + px * x + py * y + pz * z, 1e-12)
    scratch[at], scratch[at + 1], scratch[at + 2] = (
        1.0 + (ax * ax - squared) / beyond,
        -az + ax * ay / beyond,
        ay + ax * az / beyond,
    )
    scratch[at + 3], scratch[at + 4], scratch[at + 5] = (
        az + ay * ax / beyond,
        1.0 + (ay * ay - squared) / beyond,
        -ax + ay * az / beyond,
    )
    scratch[at + 6], scratch[at + 7], scratch[at + 8] = (
        -ay + az * ax / beyond,
        ax + az * ay / beyond,
        1.0 + (az * az - squared) / beyond,
    )
    _product(scratch, at, settings, _FROM_Z, out, to)


@kernel
def _place(a, b, turning, settings, share, solid, whole, atlas, out, scratch):
    """The pair of bodies after a share of the step at the old velocities, see `dano.contact.place`."""
    h = settings[_H]
    _moved(a, share, h, scratch[40:])
    _moved(b, share, h, scratch[60:])
    for k in range(9):
        out[_WORLD + k] = scratch[63 + k]
    # inverse of the second rotation, and the turn between both
    for r in range(3):
        for c in range(3):
            scratch[80 + 3 * r + c] = out[_WORLD + 3 * c + r]
    _product(scratch, 80, scratch, 43, out, _POINTS)
    _apply(
        scratch,
        80,
        scratch[40] - scratch[60],
        scratch[41] - scratch[61],
        scratch[42] - scratch[62],
        out,
        _CENTRE,
    )
    _apply(out, _POINTS, a[_COM], a[_COM + 1], a[_COM + 2], out, _ORIGIN)
    for k in range(3):
        out[_CENTRE + k] += b[_COM + k]
        out[_ORIGIN + k] = out[_CENTRE + k] - out[_ORIGIN + k]
        scratch[90 + k] = a[_POSITION + k] - b[_POSITION + k]
    x, y, z = scratch[90], scratch[91], scratch[92]
    sx, sy, sz = b[_SPIN], b[_SPIN + 1], b[_SPIN + 2]
    vx = a[_VELOCITY] - b[_VELOCITY]
    vy = a[_VELOCITY + 1] - b[_VELOCITY + 1]
    vz = a[_VELOCITY + 2] - b[_VELOCITY + 2]
    _apply(scratch, 80, vx - (sy * z - sz * y), vy - (sz * x - sx * z), vz - (sx * y - sy * x), out, _MOVES)
    _apply(scratch, 80, a[_SPIN] - sx, a[_SPIN + 1] - sy, a[_SPIN + 2] - sz, out, _TURNS)
    out[_STRETCH] = 1.0
    for k in range(9):
        out[_VECTORS + k] = out[_POINTS + k]
    if turning == 0:
        return
    _face_solid(a, turning, settings, solid, whole, atlas, out, scratch)
    _apply(out, _POINTS, scratch[30], scratch[31], scratch[32], out, _FACING)
    _align(a, turning, settings, scratch[30], scratch[31], scratch[32], out, _POINTS, _VECTORS, scratch)


@kernel
def _place_arms(a, b, turning, side, share, settings, out, scratch):
    """Arms of samples for a pair that `_place` has placed, see `dano.contact.place`."""
    h = settings[_H]
    if turning == 0:
        part = side[_FOLLOWS] * share * h
        vx = part * (a[_VELOCITY] - b[_VELOCITY])
        vy = part * (a[_VELOCITY + 1] - b[_VELOCITY + 1])
        vz = part * (a[_VELOCITY + 2] - b[_VELOCITY + 2])
        _apply_transposed(out, _WORLD, vx, vy, vz, out, _ARM_ORIGIN)
        for k in range(9):
            out[_ARMS + k] = out[_POINTS + k]
        for k in range(3):
            out[_ARM_ORIGIN + k] += out[_ORIGIN + k] - out[_CENTRE + k]
        return
    turn = h * _length(a, _SPIN) / settings[_FASTEST]
    _moved(a, min(turn * turn, 1.0) * share, h, scratch[40:])
    for r in range(3):
        for c in range(3):
            scratch[80 + 3 * r + c] = out[_WORLD + 3 * c + r]
    _product(scratch, 80, scratch, 43, out, _ARMS)
    _apply(out, _ARMS, -a[_COM], -a[_COM + 1], -a[_COM + 2], out, _ARM_ORIGIN)
    for k in range(3):
        out[_AXIS_AT + k] = out[_ARMS + 3 * k + 2]
    _apply_transposed(out, _ARMS, out[_FACING], out[_FACING + 1], out[_FACING + 2], scratch, 30)
    _align(a, turning, settings, scratch[30], scratch[31], scratch[32], out, _ARMS, -1, scratch)
    for k in range(3):
        out[_LOWEST + k] = out[_ARM_ORIGIN + k] - out[_ARMS + 3 * k + 2]


@kernel
def _face_solid(a, turning, settings, solid, whole, atlas, out, scratch):
    """Direction from where bodies touch to the solid in the axes of the samples' body, to scratch[30:33]."""
    x, y, z = out[_ORIGIN], out[_ORIGIN + 1], out[_ORIGIN + 2]
    if turning == _AXIS:
        _face(out, solid, whole, atlas, x, y, z, scratch)
        return
    # See `dano.contact`, `_first_touch`.
    p, q, r = a[_SCALE], a[_SCALE + 1], a[_SCALE + 2]
    least, most = min(p, min(q, r)), max(p, max(q, r))
    root = math.sqrt(settings[_PULL]) * least / most
    momentum, enough = (1.0 - root) / (1.0 + root), (settings[_FOUND] * least) ** 2
    px = py = pz = nx = ny = nz = 0.0
    k = 0
    while k < settings[_SEARCHES]:
        u = px - settings[_PULL] * (least / p) ** 2 * px
        v = py - settings[_PULL] * (least / q) ** 2 * py
        w = pz - settings[_PULL] * (least / r) ** 2 * pz
        _apply(out, _POINTS, u, v, w, scratch, 33)
        apart = _face(out, solid, whole, atlas, x + scratch[33], y + scratch[34], z + scratch[35], scratch)
        apart = max(apart, 0.0)
        u, v, w = u + apart * scratch[30], v + apart * scratch[31], w + apart * scratch[32]
        dx, dy, dz = u - nx, v - ny, w - nz
        share = momentum if k > 0 else 0.0
        px, py, pz = u + share * dx, v + share * dy, w + share * dz
        nx, ny, nz = u, v, w
        if dx * dx + dy * dy + dz * dz < enough:
            return
        k += 1


@kernel
def _align(a, turning, settings, x, y, z, out, to, areas, scratch):
    """Turn samples that face a direction (x, y, z) of their body; out[to:] holds the body's rotation.

    The map of vector areas goes to out[areas:], unless that is negative.
    """
    for k in range(9):
        scratch[50 + k] = out[to + k]
    if turning == _AXIS:
        if x * x + y * y > 1e-12:
            across = math.sqrt(x * x + y * y)
            for r in range(3):
                p, q = scratch[50 + 3 * r], scratch[50 + 3 * r + 1]
                out[to + 3 * r] = (p * x + q * y) / across
                out[to + 3 * r + 1] = (q * x - p * y) / across
        if areas >= 0:
            for k in range(9):
                out[areas + k] = out[to + k]
        return
    p, q, r = a[_SCALE], a[_SCALE + 1], a[_SCALE + 2]
    scratch[30], scratch[31], scratch[32] = p * x, q * y, r * z
    _direct(scratch, 30)
    _towards(settings, -scratch[30], -scratch[31], -scratch[32], scratch, 40, scratch, 60)
    volume = p * q * r
    for k in range(9):
        scale = p if k % 3 == 0 else q if k % 3 == 1 else r
        scratch[60 + k] = scratch[50 + k] * scale
        scratch[70 + k] = scratch[50 + k] * (volume / scale)
    _product(scratch, 60, scratch, 40, out, to)
    if areas >= 0:
        _product(scratch, 70, scratch, 40, out, areas)
    out[_STRETCH] = max(p, max(q, r))


@kernel
def _is_near(a, b, margin, h, solid, whole, atlas, scratch):
    """Whether two bodies may meet within the step, by the balls around them."""
    _matrix(a, _ORIENTATION, scratch, 30)
    _matrix(b, _ORIENTATION, scratch, 40)
    way = 0.0
    for k in range(3):
        scratch[50 + k], scratch[53 + k] = a[_MIDDLE + k] - a[_COM + k], b[_MIDDLE + k] - b[_COM + k]
        way += (a[_VELOCITY + k] - b[_VELOCITY + k]) ** 2
    lever_a, lever_b = _length(scratch, 50), _length(scratch, 53)
    _apply(scratch, 30, scratch[50], scratch[51], scratch[52], scratch, 56)
    reach = a[_RADIUS] + h * math.sqrt(way) + h * _length(a, _SPIN) * lever_a + margin
    if whole[KIND] == HALF_SPACE:
        x = a[_POSITION] + scratch[56] - b[_POSITION]
        y = a[_POSITION + 1] + scratch[57] - b[_POSITION + 1]
        z = a[_POSITION + 2] + scratch[58] - b[_POSITION + 2]
        _apply_transposed(scratch, 40, x, y, z, scratch, 60)
        x = scratch[60] + b[_COM]
        y = scratch[61] + b[_COM + 1]
        z = scratch[62] + b[_COM + 2]
        return distance(solid, whole, atlas, x, y, z, scratch, False) <= reach
    _apply(scratch, 40, scratch[53], scratch[54], scratch[55], scratch, 60)
    apart = 0.0
    for k in range(3):
        apart += (a[_POSITION + k] + scratch[56 + k] - b[_POSITION + k] - scratch[60 + k]) ** 2
    reach += b[_RADIUS] + h * _length(b, _SPIN) * lever_b
    return apart <= reach * reach


@kernel
def _meeting(a, b, counts, side, settings, solid, whole, atlas, probes, runs, left, placed, scratch):
    """Share of the step after which geometry is taken, see `dano.contact.meeting`."""
    h, sink = settings[_H], side[_SINK]
    between = speed = 0.0
    for k in range(3):
        between += (a[_POSITION + k] - b[_POSITION + k]) ** 2
        speed += (a[_VELOCITY + k] - b[_VELOCITY + k]) ** 2
    turn = _length(a, _SPIN) * a[_RADIUS] + _length(b, _SPIN) * (a[_RADIUS] + math.sqrt(between))
    way = h * (math.sqrt(speed) + turn)
    if way <= sink:
        return 1.0
    share, last, k, n = 0.0, 1.0, 0, -1
    while share < 1.0 and last > 0.01 and k < settings[_ADVANCES]:
        _place(a, b, counts[_TURNING], settings, share, solid, whole, atlas, placed, scratch)
        if n < 0:
            n = _may_meet(counts, way - sink, solid, whole, atlas, probes, runs, left, placed, scratch)
        turns = 1.0 if counts[_TURNING] == 0 else 0.0
        sx, sy, sz = turns * placed[_TURNS], turns * placed[_TURNS + 1], turns * placed[_TURNS + 2]
        last = math.inf
        for i in range(n):
            p = left[i]
            _apply(placed, _POINTS, probes[0, p], probes[1, p], probes[2, p], scratch, 30)
            x = scratch[30] + placed[_ORIGIN]
            y = scratch[31] + placed[_ORIGIN + 1]
            z = scratch[32] + placed[_ORIGIN + 2]
            room = distance(solid, whole, atlas, x, y, z, scratch, True) + sink
            length = math.sqrt(max(scratch[0] ** 2 + scratch[1] ** 2 + scratch[2] ** 2, 1e-12))
            x, y, z = x - placed[_CENTRE], y - placed[_CENTRE + 1], z - placed[_CENTRE + 2]
            approach = scratch[0] * (placed[_MOVES] + sy * z - sz * y)
            approach += scratch[1] * (placed[_MOVES + 1] + sz * x - sx * z)
            approach += scratch[2] * (placed[_MOVES + 2] + sx * y - sy * x)
            approach *= -h / length
            if approach > 0.0 and room - (1.0 - share) * approach < 0.0:
                last = min(last, room / approach)
        last = max(last, 0.0)
        share = min(share + last, 1.0)
        k += 1
    return math.floor(share * settings[_SHARES]) / settings[_SHARES]


@kernel
def _may_meet(counts, way, solid, whole, atlas, probes, runs, left, placed, scratch):
    """Probes that lie no further from the solid than anything moves in a step, into `left`; their number.

    Samples that keep facing the solid do not move with their body: then it is all of them.
    """
    first, n, found = counts[_PROBE_START], counts[_PROBES], 0
    of_blocks = n == counts[_BLOCKS] and n > 0
    beyond = 0
    for i in range(n):
        if counts[_TURNING] == 0:
            if i < beyond:
                continue
            if of_blocks and i % RUN == 0:
                ball = counts[_START] + i
                d = _distance_of(
                    placed, runs[ball, 0], runs[ball, 1], runs[ball, 2], solid, whole, atlas, scratch
                )
                if d - STEEPEST * runs[ball, 3] > way:
                    beyond = i + RUN
                    continue
            p = first + i
            if (
                _distance_of(placed, probes[0, p], probes[1, p], probes[2, p], solid, whole, atlas, scratch)
                > way
            ):
                continue
        left[found] = first + i
        found += 1
    return found


@kernel
def _distance_of(placed, x, y, z, solid, whole, atlas, scratch):
    """Signed distance [m] of a point of the first body [F]."""
    _apply(placed, _POINTS, x, y, z, scratch, 30)
    x = scratch[30] + placed[_ORIGIN]
    y = scratch[31] + placed[_ORIGIN + 1]
    z = scratch[32] + placed[_ORIGIN + 2]
    return distance(solid, whole, atlas, x, y, z, scratch, False)


@kernel
def _sample(turning, solid, whole, atlas, placed, block, lane, half, lead, same_way, turned, found, scratch):
    """Arm, normal, moment [W], depth, rate, area and drift of a sample into `found`; whether it may press.

    Returns:
        1 if it faces the solid, or with `turned` if it lies in it and faces the other way; else 0, or -1 if
        it is one that `turned` would take, with nothing but depth and area found. See `dano.contact.find`.
    """
    _apply(placed, _POINTS, block[0, lane], block[1, lane], block[2, lane], scratch, 30)
    x = scratch[30] + placed[_ORIGIN]
    y = scratch[31] + placed[_ORIGIN + 1]
    z = scratch[32] + placed[_ORIGIN + 2]
    d = distance(solid, whole, atlas, x, y, z, scratch, True)
    length = math.sqrt(max(scratch[0] ** 2 + scratch[1] ** 2 + scratch[2] ** 2, 1e-12))
    nx, ny, nz = scratch[0] / length, scratch[1] / length, scratch[2] / length
    _apply(placed, _VECTORS, block[3, lane], block[4, lane], block[5, lane], scratch, 33)
    area = -(scratch[33] * nx + scratch[34] * ny + scratch[35] * nz)
    if turned or not area > 0.0:
        whole_area = _length(scratch, 33)
        if not (d < 0.0 and -area > same_way * whole_area):
            return 0
        if not turned:
            found[9], found[11] = -d, half * whole_area
            return -1
        area = whole_area
        nx, ny, nz = -scratch[33] / area, -scratch[34] / area, -scratch[35] / area
    _apply(placed, _ARMS, block[0, lane], block[1, lane], block[2, lane], scratch, 36)
    rx = scratch[36] + placed[_ARM_ORIGIN]
    ry = scratch[37] + placed[_ARM_ORIGIN + 1]
    rz = scratch[38] + placed[_ARM_ORIGIN + 2]
    lx, ly, lz = rx, ry, rz
    if turning == _BALL:
        lx, ly, lz = placed[_LOWEST], placed[_LOWEST + 1], placed[_LOWEST + 2]
    mx, my, mz = ly * nz - lz * ny, lz * nx - lx * nz, lx * ny - ly * nx
    if turning == _AXIS:
        ax, ay, az = placed[_AXIS_AT], placed[_AXIS_AT + 1], placed[_AXIS_AT + 2]
        along = ax * mx + ay * my + az * mz
        mx, my, mz = mx - along * ax, my - along * ay, mz - along * az
    rate = placed[_MOVES] * nx + placed[_MOVES + 1] * ny + placed[_MOVES + 2] * nz
    rate += placed[_TURNS] * mx + placed[_TURNS + 1] * my + placed[_TURNS + 2] * mz
    _apply(placed, _WORLD, rx, ry, rz, found, 0)
    _apply(placed, _WORLD, nx, ny, nz, found, 3)
    _apply(placed, _WORLD, mx, my, mz, found, 6)
    found[9], found[10], found[11] = lead * rate - d, rate, half * area
    found[12] = found[13] = found[14] = 0.0
    if turning > 0:
        _find_drift(
            placed,
            x - placed[_CENTRE],
            y - placed[_CENTRE + 1],
            z - placed[_CENTRE + 2],
            rx,
            ry,
            rz,
            nx,
            ny,
            nz,
            found,
            scratch,
        )
    return 1


@kernel
def _find_drift(placed, x, y, z, rx, ry, rz, nx, ny, nz, found, scratch):
    """Half of what the velocity changes by until the predicted place, see `dano.contact.Points.drift`."""
    sx, sy, sz = placed[_TURNS], placed[_TURNS + 1], placed[_TURNS + 2]
    dx, dy, dz = 0.5 * (x - rx), 0.5 * (y - ry), 0.5 * (z - rz)
    wx, wy, wz = sy * dz - sz * dy, sz * dx - sx * dz, sx * dy - sy * dx
    nearing = wx * nx + wy * ny + wz * nz
    wx, wy, wz = wx - nearing * nx, wy - nearing * ny, wz - nearing * nz
    ux = placed[_MOVES] + sy * z - sz * y
    uy = placed[_MOVES + 1] + sz * x - sx * z
    uz = placed[_MOVES + 2] + sx * y - sy * x
    along = ux * nx + uy * ny + uz * nz
    ux, uy, uz = ux - along * nx, uy - along * ny, uz - along * nz
    squared, most = wx * wx + wy * wy + wz * wz, ux * ux + uy * uy + uz * uz
    part = math.sqrt(most / squared) if squared > most else 1.0
    wx, wy, wz = part * wx + nearing * nx, part * wy + nearing * ny, part * wz + nearing * nz
    _apply(placed, _WORLD, wx, wy, wz, found, 12)


@kernel
def _list_block(turning, target, placed, blocks, n, how, lists, used, filled, sums, scratch):
    """List the samples of a block that may press; returns the full chunks and the places of the next one.

    Added to `sums`, over samples that sink in: area; then load, and rate, arm and normal weighted by it; then
    the load of those that lie in the solid and face the other way.

    Args:
        turning: How samples turn with their body.
        target: The solid, its whole numbers, and spline coefficients.
        placed: From `_place`.
        blocks: Points and vector areas of samples.
        n: Which block.
        how: Row of the table of pairs, share of the step, settings, whether to list what faces the other way.
        lists: Numbers of points, and their samples, written to.
        used: Full chunks before.
        filled: Places of the next one.
        sums: See above.
        scratch: Room.
    """
    (solid, whole, atlas), (side, share, settings, turned), (numbers, samples) = target, how, lists
    h, room, width = settings[_H], numbers.shape[1], numbers.shape[2]
    found = scratch[80:95]
    # Where geometry is taken early, what is about to touch has sunk in by no more than this, or nearly does.
    layer = side[_SINK] if share < 1.0 else 0.0
    for lane in range(blocks.shape[2]):
        facing = _sample(
            turning,
            solid,
            whole,
            atlas,
            placed,
            blocks[n],
            lane,
            side[_SHARE],
            share * h,
            settings[_TURNED],
            turned,
            found,
            scratch,
        )
        if facing < 0:
            sums[9] += found[11] * found[9]
        if facing <= 0 or not found[9] - h * found[10] > -side[_MARGIN]:
            continue
        depth = found[9] - share * h * found[10] + layer
        if depth > 0.0 and not turned:
            weight = found[11] * depth
            sums[0] += found[11]
            sums[1] += weight
            nearing = found[3] * found[12] + found[4] * found[13] + found[5] * found[14]
            sums[2] += weight * (found[10] - nearing)
            for k in range(6):
                sums[3 + k] += weight * found[k]
        if used < room:
            for k in range(15):
                numbers[k, used, filled] = found[k]
            samples[used, filled] = n * blocks.shape[2] + lane
        filled += 1
        if filled == width:
            used, filled = used + 1, 0
    return used, filled


@kernel
def _list_pair(count, target, placed, reach, surfaces, how, lists, used, sums, scratch):
    """List the samples of a body that may press, see `_list_block`; returns the chunks in use."""
    (blocks, balls, runs), (solid, whole, atlas) = surfaces, target
    lane, beyond = 0, count[_START]
    for n in range(count[_START], count[_START] + count[_BLOCKS]):
        if n < beyond:
            continue
        # Where a run of blocks is out of reach, all of them are.
        if (n - count[_START]) % RUN == 0:
            d = _distance_of(placed, runs[n, 0], runs[n, 1], runs[n, 2], solid, whole, atlas, scratch)
            if d - STEEPEST * runs[n, 3] * placed[_STRETCH] > reach:
                beyond = n + RUN
                continue
        d = _distance_of(placed, balls[n, 0], balls[n, 1], balls[n, 2], solid, whole, atlas, scratch)
        if d - balls[n, 3] * placed[_STRETCH] > reach:
            continue
        used, lane = _list_block(
            count[_TURNING], target, placed, blocks, n, how, lists, used, lane, sums, scratch
        )
    return used + 1 if lane > 0 else used


@kernel
def _impact(a, b, sums, hit_speed, instant, settings):
    """Stiffness [Pa/m] with which an impact ends within the step, 0 if there is none."""
    area, load = sums[0], sums[1]
    if not (instant > 0.0 and load > 0.0 and -sums[2] / load > hit_speed):
        return 0.0
    mobility = a[_LIGHTNESS] + b[_LIGHTNESS]
    nx, ny, nz = sums[6] / load, sums[7] / load, sums[8] / load
    for second in range(2):
        body = b if second else a
        lx = sums[3] / load + (a[_POSITION] - b[_POSITION] if second else 0.0)
        ly = sums[3 + 1] / load + (a[_POSITION + 1] - b[_POSITION + 1] if second else 0.0)
        lz = sums[3 + 2] / load + (a[_POSITION + 2] - b[_POSITION + 2] if second else 0.0)
        mx, my, mz = ly * nz - lz * ny, lz * nx - lx * nz, lx * ny - ly * nx
        for r in range(3):
            row = _MOBILITY + 3 * r
            turned = body[row] * mx + body[row + 1] * my + body[row + 2] * mz
            mobility += turned * (mx if r == 0 else my if r == 1 else mz)
    h = settings[_H]
    stiffness = settings[_IMPACT] / (h * h * (mobility * area))
    return 2.0 ** np.rint(math.log2(stiffness))


@kernel
def _label(name, share, stiffness, first, end, of_chunk, labels):
    """What the chunks of a pair have in common."""
    for c in range(first, end):
        of_chunk[0, c], of_chunk[1, c] = share, stiffness
        labels[0, c], labels[1, c], labels[2, c] = name[_FIRST], name[_SECOND], name[_CONTACT]
        labels[3, c], labels[4, c] = name[_GROUP], name[_PLACE]


@kernel
def _find(
    bodies,
    counts,
    blocks,
    balls,
    runs,
    probes,
    sides,
    names,
    solids,
    wholes,
    atlas,
    impacts,
    settings,
    points,
    where,
):
    """Write all points that may press within a step; returns how many chunks they need.

    Args:
        bodies: Table of bodies.
        counts: Of their whole numbers.
        blocks: Points and vector areas of samples, shape (b, 6, w).
        balls: Around blocks, shape (b, 4).
        runs: Balls around each block and those after it, `RUN` in all, shape (b, 4).
        probes: Shape (3, k).
        sides: Table of pairs.
        names: Of their whole numbers.
        solids: Table of solids.
        wholes: Of their whole numbers.
        atlas: Spline coefficients.
        impacts: Whether contacts end impacts within the step, and from which speed, shape (k, 2).
        settings: h, then what `dano.contact` states, see `_H` and those beside it.
        points: Arm, normal, moment, depth, rate, area, drift, shape (15, c, p); share and stiffness (2, c).
        where: First body, second body, contact, group and place, shape (5, c); samples, shape (c, p).
    """
    numbers, of_chunk = points
    labels, samples = where
    surfaces, points_of, room = (blocks, balls, runs), (numbers, samples), numbers.shape[1]
    left = np.empty(max(1, counts[:, _PROBES].max()), np.int64)
    placed, scratch, sums = np.empty(_PLACED), np.empty(100), np.empty(10)
    used = 0
    for s in range(sides.shape[0]):
        name, side = names[s], sides[s]
        a, b, count = bodies[name[_FIRST]], bodies[name[_SECOND]], counts[name[_FIRST]]
        solid, whole, h = solids[name[_SOLID]], wholes[name[_SOLID]], settings[_H]
        if not _is_near(a, b, side[_MARGIN], h, solid, whole, atlas, scratch):
            continue
        share = _meeting(
            a, b, count, side, settings, solid, whole, atlas, probes, runs, left, placed, scratch
        )
        turning = count[_TURNING]
        _place(a, b, turning, settings, share, solid, whole, atlas, placed, scratch)
        _place_arms(a, b, turning, side, share, settings, placed, scratch)
        reach = _length(placed, _MOVES) + _length(placed, _TURNS) * 2.0 * a[_RADIUS]
        reach = side[_MARGIN] + (1.0 - share) * h * reach
        for k in range(10):
            sums[k] = 0.0
        first = used
        for turned in (False, True):
            # What faces the other way presses where its load is the larger one.
            if turned and not sums[9] > sums[1]:
                continue
            how = side, share, settings, turned
            used = _list_pair(
                count, (solid, whole, atlas), placed, reach, surfaces, how, points_of, used, sums, scratch
            )
        contact = name[_CONTACT]
        stiffness = _impact(a, b, sums, impacts[contact, 1], impacts[contact, 0], settings)
        _label(name, share, stiffness, first, min(used, room), of_chunk, labels)
    return used


@kernel
def _clear(rows, value):
    for i in range(rows.shape[0]):
        for k in range(rows.shape[1]):
            rows[i, k] = value


@kernel
def _answer(frame, dtype):
    """Find what a call frame asks for; see `dano.contact` for the order of its buffers."""
    given, to = inputs(frame), outputs(frame)
    numbers, of_chunk = cube(to[0], dtype), table(to[1], dtype)
    labels, samples = table(to[2], numba.int32), table(to[3], numba.int32)
    for k in range(numbers.shape[0]):
        _clear(numbers[k], 0.0)
    _clear(of_chunk, 0.0)
    _clear(labels, 0)
    _clear(samples, 0)
    for c in range(of_chunk.shape[1]):
        of_chunk[0, c] = 1.0
    used = _find(
        doubles(given[0], dtype),
        table(given[1], numba.int32),
        cube(given[2], dtype),
        table(given[3], dtype),
        table(given[4], dtype),
        table(given[5], dtype),
        table(given[6], dtype),
        table(given[7], numba.int32),
        doubles(given[8], dtype),
        table(given[9], numba.int32),
        vector(given[10], dtype),
        table(given[11], dtype),
        doubles(given[12], dtype)[0],
        (numbers, of_chunk),
        (labels, samples),
    )
    vector(to[4], numba.int32)[0] = used
    return 0


def define(dtype: str) -> str:
    """Compile or load the search for "float64" or "float32", make it known to JAX and return its name."""
    sources, real = fingerprint(), numba.from_dtype(np.dtype(dtype))

    @numba.cfunc(SIGNATURE, cache=True)
    def handler(frame):
        _ = sources  # makes it part of the key on disk
        return 0 if tells_version(frame) else _answer(frame, real)

    return register(f"dano_find_{dtype}", handler)
