"""Contacts with the paper's law between bodies of trees: see `dano.contact.CentroidLaw`.

Such a contact knows the bodies by the twist of the first relative to the second at the patch. To contact they
move by J y + c, see `dano.engine._trees`. Each contact has two sides, a body each; what a side's body moves
by counts negative at the second, so that the twist is the sum over both.
"""

import math
from collections import namedtuple

import numpy as np

from dano.native._assembling import RESOLVED, root
from dano.native._compiling import kernel, lean
from dano.native.trees._balance import H
from dano.native.trees._frames import (
    add,
    BODY,
    cross,
    dot,
    minus,
    ORIGIN,
    PARENT,
    PLACE,
    put,
    SHIFT,
    slopes_of_turn,
    three,
    times,
    WIDTH,
)

# Columns of the table of patches: overlap, centroid and normal [W].
OVERLAP, CENTROID, NORMAL = 0, 1, 4
# Columns of the table of contacts: parameters and numbers of the law. No stiction velocity is 0.
SPRING, DAMPER, _SLIDING, _TORSION, _ROLLING = 0, 1, 2, 4, 6
_SMOOTHING, _REGULARIZER, STICTION = 8, 9, 10
# Columns of the table of pairs: nodes of both bodies, −1 for one that does not move, and whether it pulls.
_ADHESIVE = 2
HARD = (1.0, 1.0)
"""Softness of friction as it is: how much of it is held, and its scale."""
# Squared speeds up to here are none: what a small imaginary part leaves of 0.
_NONE = 1e-45

Touch = namedtuple("Touch", "width places reach offset parts slope")
"""Of the sides of contacts, two for each: number of velocities that move it, their places, by what they move
it (velocity at the patch, spin), c, and the twist; of contacts the derivative of the wrench by the twist."""


@lean
def columns_of(nodes, pairs):
    """Most velocities that move a side of a contact."""
    most = 0
    for c in range(pairs.shape[0]):
        for side in range(2):
            n, width = pairs[c, side], 0
            while n >= 0:
                width += nodes[n, WIDTH]
                n = nodes[n, PARENT]
            most = max(most, width)
    return most


@kernel
def touch_for(nodes, pairs, kind):
    """Room for the contacts of a step, for numbers of a type."""
    most, sides = columns_of(nodes, pairs), 2 * pairs.shape[0]
    return Touch(
        np.zeros(sides, np.int64),
        np.zeros((sides, most), np.int64),
        np.zeros((sides, most, 6), kind),
        np.zeros((sides, 6), kind),
        np.zeros((sides, 6), kind),
        np.zeros((pairs.shape[0], 6, 6)),
    )


@lean
def touches(patches, c):
    """Whether the bodies of a contact share mass."""
    return patches[c, OVERLAP].real > 0.0


@lean
def any_touches(patches):
    """Whether those of any contact do."""
    for c in range(patches.shape[0]):
        if touches(patches, c):
            return True
    return False


@lean
def place_sides(given, room, y):
    """How velocities move the sides of contacts that touch; `twists` are those at the old velocities y."""
    nodes, pairs, patches, touch = given.nodes, given.pairs, given.patches, room.touch
    for s in range(2 * pairs.shape[0]):
        c, n = s // 2, pairs[s // 2, s % 2]
        touch.width[s] = 0
        touch.offset[s, :] = 0.0
        touch.parts[s, :] = 0.0
        if n < 0 or not touches(patches, c):
            continue
        sign, at = (1.0 if s % 2 == 0 else -1.0), three(patches, c, CENTROID)
        arm = minus(at, three(room.poses, nodes[n, BODY], 0))
        velocity, spin = three(room.twists, n, 0), three(room.twists, n, 3)
        put(touch.offset, s, 0, times(sign, add(velocity, cross(spin, arm))))
        put(touch.offset, s, 3, times(sign, spin))
        lever, up, width = minus(at, three(room.poses, nodes[n, ORIGIN], 0)), n, 0
        while up >= 0:
            for i in range(nodes[up, WIDTH]):
                spin, velocity = three(room.first[up], i, 0), three(room.first[up], i, 3)
                touch.places[s, width] = nodes[up, PLACE] + i
                put(touch.reach[s], width, 0, times(sign, add(velocity, cross(spin, lever))))
                put(touch.reach[s], width, 3, times(sign, spin))
                for k in range(6):
                    touch.offset[s, k] -= touch.reach[s, width, k] * y[nodes[up, PLACE] + i]
                width += 1
            up = nodes[up, PARENT]
        touch.width[s] = width


@lean
def drift_slopes(given, room, s, slopes):
    """Derivative of a side's c by its velocities, shape (width, 6); ways are those at the old velocities."""
    nodes, touch, h = given.nodes, room.touch, given.settings[H]
    n = given.pairs[s // 2, s % 2]
    sign, at = (1.0 if s % 2 == 0 else -1.0), three(given.patches, s // 2, CENTROID)
    x, origin = three(room.poses, nodes[n, BODY], 0), three(room.poses, nodes[n, ORIGIN], 0)
    after, arm = add(minus(x, origin), three(room.ways, n, SHIFT)), minus(at, x)
    spin = three(room.twists, n, 3)
    alpha, beta = slopes_of_turn(spin, h, given.rules[RESOLVED])
    up, column = n, 0
    while up >= 0:
        for i in range(nodes[up, WIDTH]):
            turn = times(h, three(room.last[up], i, 0))
            moved = add(three(room.last[up], i, 3), cross(three(room.last[up], i, 0), after))
            turning = add(times(alpha, turn), times(beta * dot(spin, turn), spin))
            turning = minus(turning, times(0.5, cross(spin, turn)))
            put(slopes, column, 0, times(sign, add(moved, cross(turning, arm))))
            put(slopes, column, 3, times(sign, turning))
            for k in range(6):
                slopes[column, k] -= touch.reach[s, column, k]
            column += 1
        up = nodes[up, PARENT]


@lean
def twist_of(touch, s, y):
    """Set a side's part of the twist."""
    for k in range(6):
        total = touch.offset[s, k]
        for i in range(touch.width[s]):
            total += touch.reach[s, i, k] * y[touch.places[s, i]]
        touch.parts[s, k] = total


@lean
def relative_twist(touch, c):
    """Relative velocity at the patch, and spin."""
    a, b = 2 * c, 2 * c + 1
    return add(three(touch.parts, a, 0), three(touch.parts, b, 0)), add(
        three(touch.parts, a, 3), three(touch.parts, b, 3)
    )


@lean
def push_patches(given, room, y, softness):
    """Take what contacts give from the residual; `softness` are how much is held, and the scale."""
    touch, h = room.touch, given.settings[H]
    for c in range(given.pairs.shape[0]):
        if not touches(given.patches, c):
            continue
        twist_of(touch, 2 * c, y)
        twist_of(touch, 2 * c + 1, y)
        velocity, spin = relative_twist(touch, c)
        force, moment = wrench(given.patches, given.contacts, given.pairs, c, velocity, spin, softness)
        give(touch, c, times(-h, force), times(-h, moment), room.residual)


@lean
def give(touch, c, force, moment, generalised):
    """Add the generalised momenta that a force and a moment at a patch give."""
    for s in range(2 * c, 2 * c + 2):
        for i in range(touch.width[s]):
            given_by = dot(three(touch.reach[s], i, 0), force) + dot(three(touch.reach[s], i, 3), moment)
            generalised[touch.places[s, i]] += given_by


@lean
def _give_by_twist(touch, c, velocity, spin, h, generalised):
    """Add what a change of the twist makes of them."""
    slope = touch.slope[c]
    force = (
        dot(three(slope, 0, 0), velocity),
        dot(three(slope, 1, 0), velocity),
        dot(three(slope, 2, 0), velocity),
    )
    moment = (
        dot(three(slope, 3, 0), velocity) + dot(three(slope, 3, 3), spin),
        dot(three(slope, 4, 0), velocity) + dot(three(slope, 4, 3), spin),
        dot(three(slope, 5, 0), velocity) + dot(three(slope, 5, 3), spin),
    )
    give(touch, c, times(h, force), times(h, moment), generalised)


@lean
def drift(room, drifts, place, weight, generalised):
    """Add h times what a velocity of the step before changes by c, from `drift_slopes` of all sides."""
    for s in range(drifts.shape[0]):
        for i in range(room.touch.width[s]):
            if room.touch.places[s, i] == place:
                velocity, spin = three(drifts[s], i, 0), three(drifts[s], i, 3)
                _give_by_twist(room.touch, s // 2, velocity, spin, weight, generalised)


@lean
def shift_patch(given, room, c, way, shares, generalised):
    """Add what a shift of the patch changes; the sides see shares of it."""
    if not touches(given.patches, c):
        return
    touch, h, velocity = room.touch, given.settings[H].real, (0.0, 0.0, 0.0)
    for k in range(2):
        velocity = add(velocity, times(shares[k], cross(three(touch.parts, 2 * c + k, 3), way)))
    _give_by_twist(touch, c, velocity, (0.0, 0.0, 0.0), h, generalised)
    patches, (twist, spin) = given.patches, relative_twist(touch, c)
    force, _ = wrench(patches, given.contacts, given.pairs, c, twist, spin, HARD)
    force = (force[0].real, force[1].real, force[2].real)
    for k in range(2):
        s = 2 * c + k
        for i in range(touch.width[s]):
            moved = cross(three(touch.reach[s], i, 3), way)
            generalised[touch.places[s, i]] += h * shares[k] * dot(moved, force)


@lean
def add_patch_slopes(given, room, softness):
    """Add the derivative of this to `matrix`."""
    touch, h, nothing = room.touch, given.settings[H], (0.0, 0.0, 0.0)
    for c in range(given.pairs.shape[0]):
        if not touches(given.patches, c):
            continue
        velocity, spin = relative_twist(touch, c)
        slope = touch.slope[c]
        set_slope(given.patches, given.contacts, given.pairs, c, velocity, spin, softness, slope)
        for s in range(2 * c, 2 * c + 2):
            for i in range(touch.width[s]):
                by_velocity, by_spin = nothing, nothing
                for j in range(6):
                    share = h * touch.reach[s, i, j]
                    by_velocity = add(by_velocity, times(share, three(slope, j, 0)))
                    by_spin = add(by_spin, times(share, three(slope, j, 3)))
                for t in range(2 * c, 2 * c + 2):
                    for j in range(touch.width[t]):
                        moved = dot(by_velocity, three(touch.reach[t], j, 0))
                        moved += dot(by_spin, three(touch.reach[t], j, 3))
                        room.matrix[touch.places[s, i], touch.places[t, j]] -= moved


@lean
def _arctan(x):
    # of complex numbers with a small imaginary part, too
    return math.atan(x.real) + (x - x.real) / (1.0 + x.real * x.real)


@lean
def _resistance(u, law, c, friction, softness):
    """Minus the ratio of resistance and velocity u, and its derivative by speed over the speed."""
    squared = dot(u, u)
    speed = root(squared) if squared.real > _NONE else 0.0 * squared
    if law[c, STICTION].real > 0.0:
        held = law[c, STICTION] * softness[0]
        slides = speed.real > held.real
        gain = 1.0 / speed if slides else 1.0 / (law[c, STICTION] * softness[1])
        gain_slope = -gain * gain if slides else 0.0 * gain
    else:
        share = 2.0 / math.pi
        reach = law[c, _REGULARIZER] + speed
        scaled = law[c, _SMOOTHING] * speed
        gain = share * _arctan(scaled) / reach
        gain_slope = (share * law[c, _SMOOTHING] / (1.0 + scaled * scaled) - gain) / reach
    along = law[c, friction] * gain_slope / (speed if speed.real > 0.0 else 1.0)
    return law[c, friction] * gain + law[c, friction + 1], along


@lean
def _normal_force(patches, law, pairs, c, rate):
    """Magnitude of the normal force at a separating speed, its slope, and its sign along the normal."""
    overlap, push = patches[c, OVERLAP], law[c, SPRING] - law[c, DAMPER] * rate
    if push.real > 0.0:
        return overlap * push, -overlap * law[c, DAMPER], 1.0
    if pairs[c, _ADHESIVE] and push.real < 0.0:
        return -overlap * push, overlap * law[c, DAMPER], -1.0
    return 0.0 * push, 0.0 * push, 0.0


@lean
def _divided(normal, velocity):
    """A vector's part along the normal, and the rest."""
    along = dot(normal, velocity)
    return along, minus(velocity, times(along, normal))


@lean
def _resisted(patches, law, pairs, c, velocity, spin, softness):
    """Normal; slip, drilling and rolling; normal force, see `_normal_force`; resistances to the three."""
    n = three(patches, c, NORMAL)
    rate, slip = _divided(n, velocity)
    turn, roll = _divided(n, spin)
    drill = times(turn, n)
    resistances = (
        _resistance(slip, law, c, _SLIDING, softness),
        _resistance(drill, law, c, _TORSION, softness),
        _resistance(roll, law, c, _ROLLING, softness),
    )
    return n, (slip, drill, roll), _normal_force(patches, law, pairs, c, rate), resistances


@lean
def wrench(patches, law, pairs, c, velocity, spin, softness):
    """Force and moment on the first body: see `CentroidLaw.wrench`."""
    n, (slip, drill, roll), (size, _, sign), ((slides, _), (drills, _), (rolls, _)) = _resisted(
        patches, law, pairs, c, velocity, spin, softness
    )
    force = times(size, minus(times(sign, n), times(slides, slip)))
    return force, times(-size, add(times(drills, drill), times(rolls, roll)))


@lean
def set_slope(patches, law, pairs, c, velocity, spin, softness, slope):
    """The derivative of the wrench by the twist, shape (6, 6)."""
    n, (slip, drill, roll), (size, fall, sign), (sliding, drilling, rolling) = _resisted(
        patches, law, pairs, c, velocity, spin, softness
    )
    (slides, slide_along), (drills, drill_along), (rolls, roll_along) = sliding, drilling, rolling
    force = minus(times(sign, n), times(slides, slip))
    moment = times(-1.0, add(times(drills, drill), times(rolls, roll)))
    for i in range(3):
        for j in range(3):
            along, one = n[i] * n[j], 1.0 if i == j else 0.0
            across = one - along
            slope[i, j] = fall * force[i] * n[j] - size * (slides * across + slide_along * slip[i] * slip[j])
            slope[i, 3 + j] = 0.0
            slope[3 + i, j] = fall * moment[i] * n[j]
            turning = drills * along + drill_along * drill[i] * drill[j]
            slope[3 + i, 3 + j] = -size * (turning + rolls * across + roll_along * roll[i] * roll[j])
