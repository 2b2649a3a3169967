"""Where a pair of bodies is within a step, see `dano.contact`: in machine code, for solids of `_solids`."""

import math

from dano.native import HALF_SPACE
from dano.native._compiling import lean
from dano.native._solids import distance, KIND

# Columns of the table of bodies: position, orientation (wxyz), orientation at the end of the step, velocity,
# spin, centre of mass [F], 1 / mass, inverse of the inertia [W]; then scale, and the ball around the body.
POSITION, ORIENTATION, AHEAD, VELOCITY, SPIN, COM, LIGHTNESS, MOBILITY = 0, 3, 7, 11, 14, 17, 20, 21
SCALE, MIDDLE, RADIUS = 30, 33, 36
# Of their whole numbers: first block, blocks, first probe, probes, how samples turn.
START, BLOCKS, PROBE_START, PROBES, TURNING = range(5)
AXIS, BALL = 1, 2
# Columns of the table of pairs: share of the stiffness, whether points follow the second body, depth up to
# which predicted geometry is taken, margin. Of their whole numbers: bodies, solid, contact, kind of solid as
# `dano.contact.Kind` counts them, number within the kind.
SHARE, FOLLOWS, SINK, MARGIN = range(4)
FIRST, SECOND, SOLID, CONTACT, GROUP, PLACE = range(6)
# Settings: h, what `dano.contact` calls IMPACT, SHARES and ADVANCES, its pole, its rotation from z, and what
# it calls TURNED, FASTEST, PULL, SEARCHES and FOUND.
H, IMPACT, SHARES, ADVANCES, POLE, FROM_Z, TURNED, FASTEST = 0, 1, 2, 3, 4, 7, 16, 17
PULL, SEARCHES, FOUND = 18, 19, 20
# A pair at a moment, see `dano.contact.Placed`: samples to solid frame and origin, vector areas, solid axes
# to world, centre of mass, velocity, spin, lowest, axis, stretch, samples to arms and their offset,
# direction to the solid.
POINTS, ORIGIN, VECTORS, WORLD, CENTRE, MOVES, TURNS = 0, 9, 12, 21, 30, 33, 36
LOWEST, AXIS_AT, STRETCH, ARMS, ARM_ORIGIN, FACING, PLACED = 39, 42, 45, 46, 55, 58, 61


@lean
def _matrix(q, at, out, to):
    """Rotation of a quaternion q[at:], row by row into out[to:]."""
    w, x, y, z = q[at], q[at + 1], q[at + 2], q[at + 3]
    out[to], out[to + 1], out[to + 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    out[to + 3], out[to + 4], out[to + 5] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[to + 6], out[to + 7], out[to + 8] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@lean
def apply(a, at, x, y, z, out, to):
    """A 3 × 3 matrix a[at:], row by row, times a vector, into out[to:]."""
    for k in range(3):
        row = at + 3 * k
        out[to + k] = a[row] * x + a[row + 1] * y + a[row + 2] * z


@lean
def _apply_transposed(a, at, x, y, z, out, to):
    for k in range(3):
        out[to + k] = a[at + k] * x + a[at + 3 + k] * y + a[at + 6 + k] * z


@lean
def _product(a, at, b, of, out, to):
    """Product of two 3 × 3 matrices; `out` is none of them."""
    for r in range(3):
        for c in range(3):
            out[to + 3 * r + c] = (
                a[at + 3 * r] * b[of + c]
                + a[at + 3 * r + 1] * b[of + 3 + c]
                + a[at + 3 * r + 2] * b[of + 6 + c]
            )


@lean
def _moved(body, share, h, out):
    """Position (0:3) and rotation (3:12) of a body after a share of the step."""
    squared = 0.0
    for k in range(4):
        out[3 + k] = body[ORIENTATION + k] + share * (body[AHEAD + k] - body[ORIENTATION + k])
        squared += out[3 + k] * out[3 + k]
    inverse = 1.0 / math.sqrt(squared)
    for k in range(4):
        out[12 + k] = out[3 + k] * inverse
    _matrix(out, 12, out, 3)
    for k in range(3):
        out[k] = body[POSITION + k] + share * h * body[VELOCITY + k]


@lean
def norm(a, at):
    """Length of the vector a[at:]."""
    return math.sqrt(a[at] * a[at] + a[at + 1] * a[at + 1] + a[at + 2] * a[at + 2])


@lean
def _face(out, solid, whole, atlas, x, y, z, scratch):
    """Direction from a point to the solid in the axes of the samples' body, into scratch[30:33]; distance."""
    apart = distance(solid, whole, atlas, x, y, z, scratch, True)
    _apply_transposed(out, POINTS, -scratch[0], -scratch[1], -scratch[2], scratch, 30)
    _direct(scratch, 30)
    return apart


@lean
def _direct(a, at):
    length = max(norm(a, at), 1e-12)
    for k in range(3):
        a[at + k] /= length


@lean
def _towards(settings, x, y, z, out, to, scratch, at):
    """A rotation that takes z to a unit vector, see `dano.contact`."""
    px, py, pz = -settings[POLE], -settings[POLE + 1], -settings[POLE + 2]
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
    _product(scratch, at, settings, FROM_Z, out, to)


@lean
def place(a, b, turning, settings, share, solid, whole, atlas, out, scratch):
    """The pair of bodies after a share of the step at the old velocities, see `dano.contact.place`."""
    h = settings[H]
    _moved(a, share, h, scratch[40:])
    _moved(b, share, h, scratch[60:])
    for k in range(9):
        out[WORLD + k] = scratch[63 + k]
    # inverse of the second rotation, and the turn between both
    for r in range(3):
        for c in range(3):
            scratch[80 + 3 * r + c] = out[WORLD + 3 * c + r]
    _product(scratch, 80, scratch, 43, out, POINTS)
    apply(
        scratch,
        80,
        scratch[40] - scratch[60],
        scratch[41] - scratch[61],
        scratch[42] - scratch[62],
        out,
        CENTRE,
    )
    apply(out, POINTS, a[COM], a[COM + 1], a[COM + 2], out, ORIGIN)
    for k in range(3):
        out[CENTRE + k] += b[COM + k]
        out[ORIGIN + k] = out[CENTRE + k] - out[ORIGIN + k]
        scratch[90 + k] = a[POSITION + k] - b[POSITION + k]
    x, y, z = scratch[90], scratch[91], scratch[92]
    sx, sy, sz = b[SPIN], b[SPIN + 1], b[SPIN + 2]
    vx = a[VELOCITY] - b[VELOCITY]
    vy = a[VELOCITY + 1] - b[VELOCITY + 1]
    vz = a[VELOCITY + 2] - b[VELOCITY + 2]
    apply(scratch, 80, vx - (sy * z - sz * y), vy - (sz * x - sx * z), vz - (sx * y - sy * x), out, MOVES)
    apply(scratch, 80, a[SPIN] - sx, a[SPIN + 1] - sy, a[SPIN + 2] - sz, out, TURNS)
    out[STRETCH] = 1.0
    for k in range(9):
        out[VECTORS + k] = out[POINTS + k]
    if turning == 0:
        return
    _face_solid(a, turning, settings, solid, whole, atlas, out, scratch)
    apply(out, POINTS, scratch[30], scratch[31], scratch[32], out, FACING)
    _align(a, turning, settings, scratch[30], scratch[31], scratch[32], out, POINTS, VECTORS, scratch)


@lean
def place_arms(a, b, turning, side, share, settings, out, scratch):
    """Arms of samples for a pair that `place` has placed, see `dano.contact.place`."""
    h = settings[H]
    if turning == 0:
        part = side[FOLLOWS] * share * h
        vx = part * (a[VELOCITY] - b[VELOCITY])
        vy = part * (a[VELOCITY + 1] - b[VELOCITY + 1])
        vz = part * (a[VELOCITY + 2] - b[VELOCITY + 2])
        _apply_transposed(out, WORLD, vx, vy, vz, out, ARM_ORIGIN)
        for k in range(9):
            out[ARMS + k] = out[POINTS + k]
        for k in range(3):
            out[ARM_ORIGIN + k] += out[ORIGIN + k] - out[CENTRE + k]
        return
    turn = h * norm(a, SPIN) / settings[FASTEST]
    _moved(a, min(turn * turn, 1.0) * share, h, scratch[40:])
    for r in range(3):
        for c in range(3):
            scratch[80 + 3 * r + c] = out[WORLD + 3 * c + r]
    _product(scratch, 80, scratch, 43, out, ARMS)
    apply(out, ARMS, -a[COM], -a[COM + 1], -a[COM + 2], out, ARM_ORIGIN)
    for k in range(3):
        out[AXIS_AT + k] = out[ARMS + 3 * k + 2]
    _apply_transposed(out, ARMS, out[FACING], out[FACING + 1], out[FACING + 2], scratch, 30)
    _align(a, turning, settings, scratch[30], scratch[31], scratch[32], out, ARMS, -1, scratch)
    slower = max(1.0, norm(a, SPIN) * h)
    for k in range(3):
        out[LOWEST + k] = (out[ARM_ORIGIN + k] - out[ARMS + 3 * k + 2]) / slower


@lean
def _face_solid(a, turning, settings, solid, whole, atlas, out, scratch):
    """Direction from where bodies touch to the solid in the axes of the samples' body, to scratch[30:33]."""
    x, y, z = out[ORIGIN], out[ORIGIN + 1], out[ORIGIN + 2]
    if turning == AXIS:
        _face(out, solid, whole, atlas, x, y, z, scratch)
        return
    # See `dano.contact`, `_first_touch`.
    p, q, r = a[SCALE], a[SCALE + 1], a[SCALE + 2]
    least, most = min(p, min(q, r)), max(p, max(q, r))
    root = math.sqrt(settings[PULL]) * least / most
    momentum, enough = (1.0 - root) / (1.0 + root), (settings[FOUND] * least) ** 2
    px = py = pz = nx = ny = nz = 0.0
    k = 0
    while k < settings[SEARCHES]:
        u = px - settings[PULL] * (least / p) ** 2 * px
        v = py - settings[PULL] * (least / q) ** 2 * py
        w = pz - settings[PULL] * (least / r) ** 2 * pz
        apply(out, POINTS, u, v, w, scratch, 33)
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


@lean
def _align(a, turning, settings, x, y, z, out, to, areas, scratch):
    """Turn samples that face a direction (x, y, z) of their body; out[to:] holds the body's rotation.

    The map of vector areas goes to out[areas:], unless that is negative.
    """
    for k in range(9):
        scratch[50 + k] = out[to + k]
    if turning == AXIS:
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
    p, q, r = a[SCALE], a[SCALE + 1], a[SCALE + 2]
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
    out[STRETCH] = max(p, max(q, r))


@lean
def is_near(a, b, margin, h, solid, whole, atlas, scratch):
    """Whether two bodies may meet within the step, by the balls around them."""
    _matrix(a, ORIENTATION, scratch, 30)
    _matrix(b, ORIENTATION, scratch, 40)
    way = 0.0
    for k in range(3):
        scratch[50 + k], scratch[53 + k] = a[MIDDLE + k] - a[COM + k], b[MIDDLE + k] - b[COM + k]
        way += (a[VELOCITY + k] - b[VELOCITY + k]) ** 2
    lever_a, lever_b = norm(scratch, 50), norm(scratch, 53)
    apply(scratch, 30, scratch[50], scratch[51], scratch[52], scratch, 56)
    reach = a[RADIUS] + h * math.sqrt(way) + h * norm(a, SPIN) * lever_a + margin
    if whole[KIND] == HALF_SPACE:
        x = a[POSITION] + scratch[56] - b[POSITION]
        y = a[POSITION + 1] + scratch[57] - b[POSITION + 1]
        z = a[POSITION + 2] + scratch[58] - b[POSITION + 2]
        _apply_transposed(scratch, 40, x, y, z, scratch, 60)
        x = scratch[60] + b[COM]
        y = scratch[61] + b[COM + 1]
        z = scratch[62] + b[COM + 2]
        return distance(solid, whole, atlas, x, y, z, scratch, False) <= reach
    apply(scratch, 40, scratch[53], scratch[54], scratch[55], scratch, 60)
    apart = 0.0
    for k in range(3):
        apart += (a[POSITION + k] + scratch[56 + k] - b[POSITION + k] - scratch[60 + k]) ** 2
    reach += b[RADIUS] + h * norm(b, SPIN) * lever_b
    return apart <= reach * reach
