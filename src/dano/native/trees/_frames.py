"""Where the bodies of trees are, how a step moves them, and what moves them: see `dano.scene` for all three.

A tree is a table of nodes in an order in which parents come first: the bodies that move freely, then the
joints, each with the body that hangs on it. Vectors and quaternions (wxyz) are tuples.

A step is not taken as the difference of two poses, which would round velocities to the rounding of a place
over h. Each body has the turn and the shift by which it moves, found from those of its parent.

All functions take complex numbers, too, and choose by real parts: so a small imaginary part on the way in
comes out as a derivative (see `_slopes`).
"""

import math

from dano.native._assembling import root
from dano.native._compiling import lean

# Columns of the table of nodes: body, node and body on which it hangs (−1 and the number of bodies for the
# world), kind, row among the joints, place of its first velocity, number of velocities, body at which its
# tree is looked at.
BODY, PARENT, CARRIER, KIND, JOINT, PLACE, WIDTH, ORIGIN = range(8)
# Kinds of nodes, joints in the order of `dano.scene.JOINT_KINDS`.
HINGE, SLIDE, _WELD, BALL, PLANAR, ROOT = range(6)
# Columns of the table of bodies: mass; inertia [B]; centre of mass [F].
MASS, INERTIA, COM = 0, 1, 10
# Columns of the table of joints, see `Chains` of `dano.scene`.
AXIS, ANCHOR, POSITION, ORIENTATION, RATIO, OFFSET = 0, 3, 6, 9, 13, 14
# Columns of poses: centre of mass [W], orientation.
TURNED = 3
# Columns of what is known of a joint [W]: a point on its axis, and three directions. The last is the axis;
# those of a ball are the axes of its child, the first two of a planar joint span its plane.
PIVOT, FRAME = 0, 3
# Columns of the way of a body: the turn, and the shift of its centre of mass.
TURN, SHIFT = 0, 4
# Below this, of the square of half an angle [rad²], five terms of a series are exact.
_SERIES = 1e-3
# What the square of a length of 1 may miss by rounding.
_ROUNDED = 1e-15


@lean
def three(rows, i, k):
    """Three numbers of a row from column k on."""
    return rows[i, k], rows[i, k + 1], rows[i, k + 2]


@lean
def four(rows, i, k):
    """Four numbers of a row from column k on."""
    return rows[i, k], rows[i, k + 1], rows[i, k + 2], rows[i, k + 3]


@lean
def put(rows, i, k, values):
    """Set three numbers of a row."""
    rows[i, k], rows[i, k + 1], rows[i, k + 2] = values


@lean
def put_four(rows, i, k, values):
    """Set four numbers of a row."""
    rows[i, k], rows[i, k + 1], rows[i, k + 2], rows[i, k + 3] = values


@lean
def copy(source, target):
    """Copy a table."""
    for i in range(source.shape[0]):
        for k in range(source.shape[1]):
            target[i, k] = source[i, k]


@lean
def copy_row(source, target):
    """Copy a vector."""
    for k in range(source.size):
        target[k] = source[k]


@lean
def free_velocities(nodes):
    """Number of velocities of the bodies that move freely, which come first."""
    count = 0
    for n in range(nodes.shape[0]):
        count += 6 if nodes[n, KIND] == ROOT else 0
    return count


@lean
def stand(position, orientation, poses):
    """Set the poses of all bodies as they are given, and of the world."""
    world = position.shape[0]
    for i in range(world):
        put(poses, i, 0, three(position, i, 0))
        put_four(poses, i, TURNED, unit_turn(four(orientation, i, 0)))
    put(poses, world, 0, (0.0, 0.0, 0.0))
    put_four(poses, world, TURNED, (1.0, 0.0, 0.0, 0.0))


@lean
def add(a, b):
    """A + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@lean
def minus(a, b):
    """A − b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@lean
def times(s, a):
    """S a."""
    return s * a[0], s * a[1], s * a[2]


@lean
def dot(a, b):
    """A · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@lean
def cross(a, b):
    """A × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@lean
def _quaternion(w, v):
    return w, v[0], v[1], v[2]


@lean
def multiply(p, q):
    """The rotation q followed by p."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


@lean
def swing(q, v):
    """By how much a rotation changes a vector."""
    u = (q[1], q[2], q[3])
    t = times(2.0, cross(u, v))
    return add(times(q[0], t), cross(u, t))


@lean
def rotate(q, v):
    """The vector after a rotation."""
    return add(v, swing(q, v))


@lean
def rotate_back(q, v):
    """The vector before a rotation."""
    return rotate((q[0], -q[1], -q[2], -q[3]), v)


@lean
def _angle(sine, cosine):
    """Angle whose sine and cosine are in this ratio."""
    across = sine * cosine.real - cosine * sine.real
    along = cosine * cosine.real + sine * sine.real
    # The second term is 0 for real numbers; of complex ones it is the imaginary part, which is small.
    return math.atan2(sine.real, cosine.real) + across / along


@lean
def _sine_cosine(x):
    """Both of an angle; of a complex one to first order in its small imaginary part."""
    sine, cosine, rest = math.sin(x.real), math.cos(x.real), x - x.real
    return sine + cosine * rest, cosine - sine * rest


@lean
def exponential(v):
    """Quaternion of a rotation vector."""
    squared = 0.25 * dot(v, v)
    if squared.real < _SERIES:
        return _quaternion(_cosine_near_0(squared), times(0.5 * _sine_near_0(squared), v))
    half = root(squared)
    sine, cosine = _sine_cosine(half)
    return _quaternion(cosine, times(0.5 * sine / half, v))


@lean
def _sine_near_0(s):
    """Sin x / x at s = x²."""
    return 1.0 - s / 6.0 * (1.0 - s / 20.0 * (1.0 - s / 42.0 * (1.0 - s / 72.0)))


@lean
def _cosine_near_0(s):
    """Cos x at s = x²."""
    return 1.0 - s / 2.0 * (1.0 - s / 12.0 * (1.0 - s / 30.0 * (1.0 - s / 56.0)))


@lean
def logarithm(q):
    """Shortest rotation vector of a quaternion."""
    sign = -1.0 if q[0].real < 0.0 else 1.0
    u, cosine = (q[1], q[2], q[3]), sign * q[0]
    squared = dot(u, u)
    if squared.real < _SERIES * cosine.real * cosine.real:
        s = squared / (cosine * cosine)
        ratio = (1.0 - s / 3.0 + s * s / 5.0 - s * s * s / 7.0 + s * s * s * s / 9.0) / cosine
        return times(2.0 * sign * ratio, u)
    sine = root(squared)
    return times(2.0 * sign * _angle(sine, cosine) / sine, u)


@lean
def ball_after(q, turn):
    """Coordinates of a ball joint after a turn, seen from the child."""
    return logarithm(multiply(exponential(q), turn))


@lean
def _turn_about(axis, half):
    """The turn about a unit axis by twice an angle."""
    s = half * half
    if s.real < _SERIES:
        return _quaternion(_cosine_near_0(s), times(half * _sine_near_0(s), axis))
    sine, cosine = _sine_cosine(half)
    return _quaternion(cosine, times(sine, axis))


@lean
def _shape_of_turn(omega, h, resolved):
    """Cos a, sin a / x and x² of a step, see `dano.engine._rigid`."""
    squared = 0.25 * h * h * dot(omega, omega)
    if squared.real <= resolved * resolved:
        return root(1.0 - squared), 1.0, squared
    x = root(squared)
    sine, cosine = _sine_cosine(x + math.asin(resolved) - resolved)
    return cosine, sine / x, squared


@lean
def turn_of(omega, h, resolved):
    """The turn of a step with a spin, of unit length; both in the same frame."""
    cosine, sine, _ = _shape_of_turn(omega, h, resolved)
    x, y, z = times(0.5 * h * sine, omega)
    return cosine, x, y, z


@lean
def slopes_of_turn(omega, h, resolved):
    """α and β of α 1 + β ω ωᵀ − ½ [ω]×: see `turn_slopes` of `dano.engine`."""
    cosine, sine, squared = _shape_of_turn(omega, h, resolved)
    across = cosine / sine
    along = (1.0 - across) / squared if squared.real > resolved * resolved else 0.0
    return across / h, 0.25 * h * along


@lean
def spin_of(turn, h, resolved):
    """Spin [W] of a step that turns a body, by 180° at most: see `step_twists` of `dano.scene`."""
    sign = -1.0 if turn[0].real < 0.0 else 1.0
    sine = times(sign, (turn[1], turn[2], turn[3]))
    squared = dot(sine, sine)
    if squared.real <= resolved * resolved:
        return times(2.0 / h, sine)
    size = root(squared)
    angle = _angle(size, sign * turn[0])
    return times(2.0 / h * (resolved - math.asin(resolved) + angle) / size, sine)


@lean
def _turned_back(omega, v, h, resolved):
    """Inverse of the matrix of `slopes_of_turn` times a vector, by cofactors."""
    alpha, beta = slopes_of_turn(omega, h, resolved)
    x, y, z = omega
    a = alpha + beta * x * x, beta * x * y + 0.5 * z, beta * x * z - 0.5 * y
    b = beta * y * x - 0.5 * z, alpha + beta * y * y, beta * y * z + 0.5 * x
    c = beta * z * x + 0.5 * y, beta * z * y - 0.5 * x, alpha + beta * z * z
    whole = add(add(times(v[0], cross(b, c)), times(v[1], cross(c, a))), times(v[2], cross(a, b)))
    return times(1.0 / dot(a, cross(b, c)), whole)


@lean
def _plane_axes(axis):
    """See `plane_axes` of `dano.scene`."""
    start = (1.0, 0.0, 0.0) if abs(axis[0].real) < 0.99 else (0.0, 1.0, 0.0)
    first = minus(start, times(dot(start, axis), axis))
    first = times(1.0 / root(dot(first, first)), first)
    return first, cross(axis, first)


@lean
def _unit(rows, i, k):
    """Make a vector of a row one of length 1; returns what its length was."""
    v = three(rows, i, k)
    squared = dot(v, v)
    if squared == 0.0 or (squared.imag == 0.0 and abs(squared.real - 1.0) < _ROUNDED):
        return 1.0
    length = root(squared)
    put(rows, i, k, times(1.0 / length, v))
    return length


@lean
def unit_turn(q):
    """The quaternion of length 1 along one of about that length."""
    squared = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    if squared.imag == 0.0 and abs(squared.real - 1.0) < _ROUNDED:
        return q
    size = 1.0 / root(squared)
    return size * q[0], size * q[1], size * q[2], size * q[3]


@lean
def tidy(nodes, joints):
    """Directions of joints to the rounding of 64 bits; a longer axis makes more of a coordinate."""
    for n in range(nodes.shape[0]):
        j = nodes[n, JOINT]
        if j >= 0:
            length = _unit(joints, j, AXIS)
            joints[j, RATIO] *= length
            joints[j, OFFSET] *= length
            put_four(joints, j, ORIENTATION, unit_turn(four(joints, j, ORIENTATION)))


@lean
def place(nodes, joints, bodies, q, roots, poses, known):
    """Poses of the bodies on joints from those of the others.

    Args:
        nodes: Table of nodes.
        joints: Table of joints.
        bodies: Table of bodies, and a row of zeros for the world.
        q: Joint coordinates.
        roots: Number of velocities of the bodies that move freely.
        poses: Of all bodies, and of the world last; those of bodies on joints are written to.
        known: Pivot and directions of each node's joint, written to.
    """
    for n in range(nodes.shape[0]):
        kind, j = nodes[n, KIND], nodes[n, JOINT]
        if kind == ROOT:
            continue
        parent, child, at = nodes[n, CARRIER], nodes[n, BODY], nodes[n, PLACE] - roots
        stands = four(poses, parent, TURNED)
        rest = multiply(stands, four(joints, j, ORIENTATION))
        axis, path, turn = three(joints, j, AXIS), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
        if kind == HINGE:
            turn = exponential(times(joints[j, RATIO] * q[at] + joints[j, OFFSET], axis))
        elif kind == SLIDE:
            path = times(joints[j, RATIO] * q[at] + joints[j, OFFSET], axis)
        elif kind == BALL:
            turn = exponential((q[at], q[at + 1], q[at + 2]))
        elif kind == PLANAR:
            first, second = _plane_axes(axis)
            put(known, n, FRAME, rotate(rest, first))
            put(known, n, FRAME + 3, rotate(rest, second))
            path = add(times(q[at], first), times(q[at + 1], second))
            turn = exponential(times(q[at + 2], axis))
        hangs = multiply(rest, turn)
        put(known, n, FRAME + 6, rotate(rest, axis))
        if kind == BALL:
            put(known, n, FRAME, rotate(hangs, (1.0, 0.0, 0.0)))
            put(known, n, FRAME + 3, rotate(hangs, (0.0, 1.0, 0.0)))
            put(known, n, FRAME + 6, rotate(hangs, (0.0, 0.0, 1.0)))
        anchor = three(joints, j, ANCHOR)
        point = add(three(poses, parent, 0), rotate(rest, add(anchor, path)))
        point = add(point, rotate(stands, minus(three(joints, j, POSITION), three(bodies, parent, COM))))
        put(known, n, PIVOT, point)
        put(poses, child, 0, add(point, rotate(hangs, minus(three(bodies, child, COM), anchor))))
        put_four(poses, child, TURNED, hangs)


@lean
def turns(kind, part):
    """Whether a motion of a node is a turn."""
    last = part == 2 if kind == PLANAR else part >= 3
    return kind == HINGE or kind == BALL or ((kind == PLANAR or kind == ROOT) and last)


@lean
def direction(known, n, kind, part):
    """Direction of a motion at the start of a step [W]."""
    if kind == HINGE or kind == SLIDE:
        return three(known, n, FRAME + 6)
    if kind == ROOT:
        k = part % 3
        return 1.0 if k == 0 else 0.0, 1.0 if k == 1 else 0.0, 1.0 if k == 2 else 0.0
    return three(known, n, FRAME + 3 * part)


@lean
def _put_motion(motions, n, part, turning, along, lever):
    """A motion as spin, and velocity of what is at the origin of the tree, from which the lever leads."""
    if turning:
        put(motions[n], part, 0, along)
        put(motions[n], part, 3, cross(lever, along))
    else:
        put(motions[n], part, 0, (0.0, 0.0, 0.0))
        put(motions[n], part, 3, along)


@lean
def motions_at_start(nodes, joints, poses, known, motions):
    """What each velocity of a node does at the start of a step, shape (nodes, 6, 6)."""
    for n in range(nodes.shape[0]):
        kind = nodes[n, KIND]
        share = joints[nodes[n, JOINT], RATIO] if kind == HINGE or kind == SLIDE else 1.0
        lever = (0.0, 0.0, 0.0)
        if kind != ROOT:
            lever = minus(three(known, n, PIVOT), three(poses, nodes[n, ORIGIN], 0))
        for part in range(nodes[n, WIDTH]):
            along = times(share, direction(known, n, kind, part))
            _put_motion(motions, n, part, turns(kind, part), along, lever)


@lean
def move(nodes, joints, poses, known, y, h, resolved, ways, motions):
    """The way of each node's body in a step with velocities y, and what these do at its end, over h.

    Args:
        nodes: Table of nodes.
        joints: Table of joints.
        poses: At the start.
        known: Pivots and directions at the start.
        y: Generalised velocities.
        h: Timestep [s].
        resolved: See `RESOLVED` of `dano.scene`.
        ways: Turn and shift of each node's body, written to.
        motions: See `motions_at_start`; written to.
    """
    for n in range(nodes.shape[0]):
        kind, at, up = nodes[n, KIND], nodes[n, PLACE], nodes[n, PARENT]
        x, origin = three(poses, nodes[n, BODY], 0), three(poses, nodes[n, ORIGIN], 0)
        if kind == ROOT:
            spin = (y[at + 3], y[at + 4], y[at + 5])
            shift = times(h, (y[at], y[at + 1], y[at + 2]))
            put_four(ways, n, TURN, turn_of(spin, h, resolved))
            put(ways, n, SHIFT, shift)
            for part in range(6):
                along = direction(known, n, kind, part)
                if part >= 3:
                    along = times(1.0 / h, _turned_back(spin, along, h, resolved))
                _put_motion(motions, n, part, part >= 3, along, shift)
            continue
        share = joints[nodes[n, JOINT], RATIO] if kind == HINGE or kind == SLIDE else 1.0
        pivot, axis = three(known, n, PIVOT), three(known, n, FRAME + 6)
        before, moved = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        if up >= 0:
            before = four(ways, up, TURN)
            arm = minus(pivot, three(poses, nodes[n, CARRIER], 0))
            moved = add(three(ways, up, SHIFT), swing(before, arm))
        own, spin = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        if kind == HINGE:
            own = _turn_about(axis, 0.5 * h * share * y[at])
        elif kind == SLIDE:
            moved = add(moved, rotate(before, times(h * share * y[at], axis)))
        elif kind == BALL:
            spin = add(times(y[at], three(known, n, FRAME)), times(y[at + 1], three(known, n, FRAME + 3)))
            spin = add(spin, times(y[at + 2], axis))
            own = turn_of(spin, h, resolved)
        elif kind == PLANAR:
            path = add(times(y[at], three(known, n, FRAME)), times(y[at + 1], three(known, n, FRAME + 3)))
            moved = add(moved, rotate(before, times(h, path)))
            own = _turn_about(axis, 0.5 * h * y[at + 2])
        turn = multiply(before, own)
        put_four(ways, n, TURN, turn)
        put(ways, n, SHIFT, add(moved, swing(turn, minus(x, pivot))))
        lever = minus(add(pivot, moved), origin)
        for part in range(nodes[n, WIDTH]):
            along = times(share, direction(known, n, kind, part))
            if kind == BALL:
                along = times(1.0 / h, _turned_back(spin, along, h, resolved))
            _put_motion(motions, n, part, turns(kind, part), rotate(before, along), lever)


@lean
def largest_turn(nodes, joints, y, h, sums):
    """Largest sum of the angles by which joints turn a body in a step [rad], see `turns_too_far`.

    The first column of `sums` is used up.
    """
    largest = 0.0
    for n in range(nodes.shape[0]):
        kind, at = nodes[n, KIND], nodes[n, PLACE]
        angle = 0.0
        if kind == HINGE:
            angle = abs(h * joints[nodes[n, JOINT], RATIO] * y[at])
        elif kind == PLANAR:
            angle = abs(h * y[at + 2])
        elif kind == BALL:
            angle = h * math.sqrt(y[at] ** 2 + y[at + 1] ** 2 + y[at + 2] ** 2)
        sums[n, 0] = angle + (sums[nodes[n, PARENT], 0] if nodes[n, PARENT] >= 0 else 0.0)
        largest = max(largest, sums[n, 0])
    return largest
