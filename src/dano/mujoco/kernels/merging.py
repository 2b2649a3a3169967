"""A few contacts in the place of many samples: with the same wrench, and without jumps.

Where more samples touch than there may be contacts, some of them are *heads*, each of one contact. A sample
scores by its load w = area · depth times its precedence, which spreads heads over the surface. With θ the
first score that is too low, a sample with score s keeps the share f = max(0, 1 − θ/s) of its load. Heads are
those with f > 0. What is not kept goes to the heads, in proportion to

    f_k ((1 + n_i · n_k) / (ε² + |x_i − x_k|²))²

with ε about half of the distance between heads. So all that MuJoCo is told is a continuous function of the
state: loads begin at zero, heads at f = 0, and with as many samples as contacts each keeps all of its load.
Pressures are as depths: a contact has the force Σ w n of its share, where its moment is that of the share,
but for the part along the force.
"""

import warp as wp

from dano.mujoco.kernels.mixing import held_back, in_parallel, softened
from dano.mujoco.kernels.tables import (
    ContactIndex,
    ContactRow,
    Heads,
    Options,
    PartIndex,
    Settings,
    Touch,
    vec2,
    vec8,
    vec9,
    Work,
)
from dano.physics.real import HALF, ONE, real, vec3, ZERO

# ε² is so much of the mean square of the distance of loads to their centre, over the number of contacts:
# heads in a disc are √(2π / most) of its root apart.
_SPREAD = wp.constant(real(1.5))
# Least of the factor of normals, so that a sample against which all heads are turned goes somewhere.
_AGAINST = wp.constant(real(1e-3))
# Length of the sum of what faces one direction over the sum of lengths, at least.
_PARALLEL = wp.constant(real(0.9999))
# Curvature times mean square over mean depth from which on a direction begins to count as round; from twice
# as much on it does. It is 1 for a cap and for a line.
_ROUND = wp.constant(real(0.35))
# Determinant of the squares of places over the square of their trace: below, samples lie on a line.
_SINGULAR = wp.constant(real(1e-6))
# Share of what touches that is round, where it counts as round.
_MOSTLY = wp.constant(real(0.9))
# Share of the mean depth from which on samples on flat faces count by their areas alone.
_SHALLOW = wp.constant(real(0.25))


@wp.func
def flatness(touches: wp.array(dtype=Touch), begin: int, end: int) -> int:
    """1 where most of what touches is flat, in one direction; 2 where what is round lies on a flat face."""
    area = ZERO
    flat = ZERO
    round = ZERO
    along = vec3()
    for i in range(begin, end):
        area += touches[i].area
        along += touches[i].area * touches[i].normal
        if touches[i].flat >= 1:
            flat += touches[i].area
        if touches[i].flat == 2:
            round += touches[i].area
    found = int(0)
    if flat > HALF * area and wp.length(along) > _PARALLEL * area:
        found = 1
        if round > _MOSTLY * area:
            found = 2
    return found


@wp.func
def set_scores(work: wp.ref[Work], begin: int, end: int, flat: bool):
    """Say how samples score before their precedence: by their loads, and on a flat face by their areas.

    There all are about as deep, and by loads heads would change places at each tremble. A sample that hardly
    touches has a load that is less than its share, and that counts.
    """
    weight = ZERO
    area = ZERO
    for i in range(begin, end):
        weight += work.touches[i].weight
        area += work.touches[i].area
    enough = _SHALLOW * weight / area
    for i in range(begin, end):
        score = work.touches[i].weight
        if flat:
            score = wp.min(score, enough * work.touches[i].area)
        work.touches[i].score = score * work.touches[i].precedence


@wp.struct
class Bulge:
    """What is round above a flat face, by its two principal directions along the face."""

    middle: vec3  # Of the samples that touch [m, W]
    first: vec3  # Direction [W]
    second: vec3  # The other
    at: vec2  # Where along them it is lowest, from the middle on [m]
    bend: vec2  # Its curvature along them [1/m]
    share: vec2  # 1 where it is round, 0 where it is flat


@wp.func
def roundness(bend: real, spread: real, depth: real) -> real:
    """1 along a direction in which depths are those of an arc, 0 where they do not differ.

    Args:
        bend: Curvature [1/m].
        spread: Mean square of places [m²].
        depth: Mean [m].
    """
    return wp.clamp((bend * spread / depth - _ROUND) / _ROUND, ZERO, ONE)


@wp.func
def bulge_of(work: wp.ref[Work], begin: int, end: int) -> Bulge:
    """What is round in the samples that touch a flat face: slopes grow along it by the curvature.

    The curvature is the slope's regression on places. An arc's depth is half of curvature times the square
    of a place: then curvature times mean square is the mean depth, of a cap and of a line.
    """
    found = Bulge()
    area = ZERO
    load = ZERO
    slope = vec3()
    along = vec3()
    for i in range(begin, end):
        touch = work.touches[i]
        area += touch.area
        load += touch.weight
        found.middle += touch.area * touch.position
        slope += touch.area * touch.slope
        along += touch.area * touch.normal
    found.middle = found.middle / area
    slope = slope / area
    frame = tangents(wp.normalize(along))
    u = vec3(frame[3], frame[4], frame[5])
    v = vec3(frame[6], frame[7], frame[8])
    xx = ZERO
    xy = ZERO
    yy = ZERO
    sxx = ZERO
    sxy = ZERO
    syx = ZERO
    syy = ZERO
    for i in range(begin, end):
        touch = work.touches[i]
        arm = touch.position - found.middle
        tilt = touch.slope - slope
        x = wp.dot(arm, u)
        y = wp.dot(arm, v)
        xx += touch.area * x * x
        xy += touch.area * x * y
        yy += touch.area * y * y
        sxx += touch.area * wp.dot(tilt, u) * x
        sxy += touch.area * wp.dot(tilt, u) * y
        syx += touch.area * wp.dot(tilt, v) * x
        syy += touch.area * wp.dot(tilt, v) * y
    determinant = xx * yy - xy * xy
    if determinant > _SINGULAR * (xx + yy) * (xx + yy):
        kxx = (sxx * yy - sxy * xy) / determinant
        kxy = HALF * (sxy * xx - sxx * xy + syx * yy - syy * xy) / determinant
        kyy = (syy * xx - syx * xy) / determinant
        turn = HALF * wp.atan2(kxy + kxy, kxx - kyy)
        c = wp.cos(turn)
        s = wp.sin(turn)
        found.first = c * u + s * v
        found.second = c * v - s * u
        bend = vec2(
            c * c * kxx + real(2.0) * c * s * kxy + s * s * kyy,
            s * s * kxx - real(2.0) * c * s * kxy + c * c * kyy,
        )
        spread = (
            vec2(
                c * c * xx + real(2.0) * c * s * xy + s * s * yy,
                s * s * xx - real(2.0) * c * s * xy + c * c * yy,
            )
            / area
        )
        found.bend = bend
        depth = load / area
        found.share = vec2(roundness(bend[0], spread[0], depth), roundness(bend[1], spread[1], depth))
        if found.share[0] > ZERO:
            found.at[0] = -wp.dot(slope, found.first) / bend[0]
        if found.share[1] > ZERO:
            found.at[1] = -wp.dot(slope, found.second) / bend[1]
    return found


@wp.func
def lowest(touch: Touch, bulge: Bulge) -> Touch:
    """A touch moved to where what is round is lowest."""
    found = touch
    arm = touch.position - bulge.middle
    way = wp.dot(arm, bulge.first) - bulge.at[0]
    found.position -= (bulge.share[0] * way) * bulge.first
    found.gap -= HALF * bulge.share[0] * bulge.bend[0] * way * way
    way = wp.dot(arm, bulge.second) - bulge.at[1]
    found.position -= (bulge.share[1] * way) * bulge.second
    found.gap -= HALF * bulge.share[1] * bulge.bend[1] * way * way
    return found


@wp.func
def too_low(work: wp.ref[Work], begin: int, end: int, most: int) -> real:
    """θ, the first score after so many others [m³]."""
    for k in range(most + 1):
        work.scores[k] = ZERO
    for i in range(begin, end):
        score = work.touches[i].score
        k = int(most)
        if score > work.scores[k]:
            while k > 0 and score > work.scores[wp.max(k - 1, 0)]:
                work.scores[k] = work.scores[k - 1]
                k -= 1
            work.scores[k] = score
    return work.scores[most]


@wp.func
def spread_of(touches: wp.array(dtype=Touch), begin: int, end: int) -> real:
    """Mean square of the distance of loads to their centre [m²]."""
    weight = ZERO
    first = vec3()
    for i in range(begin, end):
        weight += touches[i].weight
        first += touches[i].weight * touches[i].position
    centre = first / weight
    second = ZERO
    for i in range(begin, end):
        arm = touches[i].position - centre
        second += touches[i].weight * wp.dot(arm, arm)
    return second / weight


@wp.func
def find_heads(work: wp.ref[Work], begin: int, end: int, most: int) -> int:
    """Say of each sample what it keeps, and list heads; how many."""
    low = too_low(work, begin, end, most)
    heads = int(0)
    for i in range(begin, end):
        score = work.touches[i].score
        kept = ZERO
        if score > low:
            kept = ONE - low / score
            work.heads[heads] = i
            heads += 1
        work.touches[i].kept = kept
    return heads


@wp.func
def group_heads(work: wp.ref[Work], heads: int) -> int:
    """Write heads in groups, and how many groups."""
    groups = (heads + 7) // 8
    for g in range(groups):
        work.groups[g] = Heads()
    for k in range(heads):
        head = work.heads[k]
        g = k // 8
        j = k - 8 * g
        work.groups[g].x[j] = work.touches[head].position[0]
        work.groups[g].y[j] = work.touches[head].position[1]
        work.groups[g].z[j] = work.touches[head].position[2]
        work.groups[g].normal_x[j] = work.touches[head].normal[0]
        work.groups[g].normal_y[j] = work.touches[head].normal[1]
        work.groups[g].normal_z[j] = work.touches[head].normal[2]
        work.groups[g].kept[j] = work.touches[head].kept
    return groups


@wp.func
def set_pulls(work: wp.ref[Work], groups: int, touch: Touch, near: real) -> real:
    """Say how much each head draws a sample, beside others; and all of them together. `near`: ε² [m²]."""
    one = vec8(ONE)
    total = ZERO
    for g in range(groups):
        x = vec8(touch.position[0]) - work.groups[g].x
        y = vec8(touch.position[1]) - work.groups[g].y
        z = vec8(touch.position[2]) - work.groups[g].z
        cosine = (
            touch.normal[0] * work.groups[g].normal_x
            + touch.normal[1] * work.groups[g].normal_y
            + touch.normal[2] * work.groups[g].normal_z
        )
        facing = wp.max(one + cosine, vec8(_AGAINST))
        apart = vec8(near) + wp.cw_mul(x, x) + wp.cw_mul(y, y) + wp.cw_mul(z, z)
        closeness = wp.cw_div(facing, apart)
        pulls = wp.cw_mul(work.groups[g].kept, wp.cw_mul(closeness, closeness))
        work.groups[g].pulls = pulls
        total += wp.dot(pulls, one)
    return total


@wp.func
def give(work: wp.ref[Work], group: int, touch: Touch, shares: vec8):
    """Add shares of a sample to what heads stand for."""
    n = touch.normal
    x = vec8(touch.position[0]) - work.groups[group].x
    y = vec8(touch.position[1]) - work.groups[group].y
    z = vec8(touch.position[2]) - work.groups[group].z
    w = touch.weight * shares
    work.groups[group].weight += w
    work.groups[group].squares += touch.weight * w
    work.groups[group].force_x += n[0] * w
    work.groups[group].force_y += n[1] * w
    work.groups[group].force_z += n[2] * w
    work.groups[group].moment_x += wp.cw_mul(w, n[2] * y - n[1] * z)
    work.groups[group].moment_y += wp.cw_mul(w, n[0] * z - n[2] * x)
    work.groups[group].moment_z += wp.cw_mul(w, n[1] * x - n[0] * y)
    work.groups[group].place_x += wp.cw_mul(w, x)
    work.groups[group].place_y += wp.cw_mul(w, y)
    work.groups[group].place_z += wp.cw_mul(w, z)
    work.groups[group].gap += touch.gap * w
    work.groups[group].nearing += touch.nearing * w


@wp.func
def gather(work: wp.ref[Work], begin: int, end: int, heads: int, near: real) -> int:
    """Give all that samples do not keep to the heads; 1 if one of them presses."""
    groups = group_heads(work, heads)
    presses = int(0)
    own = int(0)
    for i in range(begin, end):
        touch = work.touches[i]
        presses = wp.max(presses, touch.presses)
        left = (ONE - touch.kept) / set_pulls(work, groups, touch, near)
        # Heads are in the order of samples.
        is_head = own < heads and work.heads[wp.min(own, heads - 1)] == i
        for g in range(groups):
            shares = left * work.groups[g].pulls
            if is_head and own // 8 == g:
                shares[own - 8 * g] += touch.kept
            give(work, g, touch, shares)
        if is_head:
            own += 1
    return presses


@wp.func
def tangents(n: vec3) -> vec9:
    """A normal and two unit tangents."""
    aside = vec3(ZERO, ZERO, ONE)
    if wp.abs(n[1]) < HALF:
        aside = vec3(ZERO, ONE, ZERO)
    s = wp.normalize(aside - wp.dot(aside, n) * n)
    t = wp.cross(n, s)
    return vec9(n[0], n[1], n[2], s[0], s[1], s[2], t[0], t[1], t[2])


@wp.func
def led_touch(work: wp.ref[Work], number: int, presses: int) -> tuple[Touch, real]:
    """One touch for the share of a head, and the number of samples that it stands for, (Σw)²/Σw².

    Its weight times its normal is their force. It presses if one of them does: each has a share of all.
    """
    g = number // 8
    k = number - 8 * g
    merged = work.touches[work.heads[number]]
    merged.presses = presses
    weight = work.groups[g].weight[k]
    force = vec3(work.groups[g].force_x[k], work.groups[g].force_y[k], work.groups[g].force_z[k])
    moment = vec3(work.groups[g].moment_x[k], work.groups[g].moment_y[k], work.groups[g].moment_z[k])
    squared = wp.dot(force, force)
    # Where normals oppose each other, no one contact does what they do, and the head stands for itself.
    if squared > HALF * HALF * weight * weight:
        place = vec3(work.groups[g].place_x[k], work.groups[g].place_y[k], work.groups[g].place_z[k])
        place = place / weight
        moment -= wp.cross(place, force)
        merged.weight = wp.sqrt(squared)
        merged.position += place + wp.cross(force, moment) / squared
        merged.normal = force / merged.weight
        merged.gap = work.groups[g].gap[k] / weight
        merged.nearing = work.groups[g].nearing[k] / weight
    return merged, weight * weight / work.groups[g].squares[k]


@wp.func
def write(
    work: wp.ref[Work],
    at: int,
    touch: Touch,
    presses: bool,
    settings: Settings,
    a: PartIndex,
    b: PartIndex,
    sink: real,
    options: Options,
):
    """A touch as a contact of MuJoCo."""
    row = ContactRow()
    row.dist = touch.gap
    row.pos = touch.position
    row.frame = tangents(touch.normal)
    row.includemargin = settings.margin - settings.gap
    fitted = settings
    if presses:
        fitted = softened(settings, touch.gap - row.includemargin, touch.nearing, sink, options.timestep)
    row.friction = fitted.friction
    row.solref = fitted.solref
    row.solimp = fitted.solimp
    if presses and options.within > ZERO and row.dist >= row.includemargin:
        row = held_back(row, touch.nearing, options.timestep)
    work.rows[at] = row
    index = ContactIndex()
    index.dim = int(settings.dim)
    index.geom1 = a.geom
    index.geom2 = b.geom
    index.first = a.geom
    index.second = b.geom
    index.flex1 = -1
    index.flex2 = -1
    index.elem1 = -1
    index.elem2 = -1
    index.vert1 = -1
    index.vert2 = -1
    index.exclude = wp.where(presses, 0, 1)
    index.efc_address = -1
    work.index[at] = index


@wp.func
def merge(
    work: wp.ref[Work],
    at: int,
    begin: int,
    end: int,
    each: real,
    options: Options,
    settings: Settings,
    a: PartIndex,
    b: PartIndex,
    sink: real,
) -> int:
    """Write touches as contacts, from a row on; the row beyond the last. Each stands for so many samples."""
    most = int(options.most)
    bulge = Bulge()
    flat = flatness(work.touches, begin, end)
    if flat == 2:
        bulge = bulge_of(work, begin, end)
    if end - begin <= most:
        fitted = in_parallel(settings, each, each > ONE)
        for i in range(begin, end):
            touch = lowest(work.touches[i], bulge)
            write(work, at, touch, touch.presses == 1, fitted, a, b, sink, options)
            at += 1
        return at
    set_scores(work, begin, end, flat == 1)
    heads = find_heads(work, begin, end, most)
    near = _SPREAD * spread_of(work.touches, begin, end) / real(most)
    presses = gather(work, begin, end, heads, near)
    for k in range(heads):
        touch, samples = led_touch(work, k, presses)
        touch = lowest(touch, bulge)
        write(
            work,
            at,
            touch,
            touch.presses == 1,
            in_parallel(settings, samples * each, flat == 1 or each > ONE),
            a,
            b,
            sink,
            options,
        )
        at += 1
    return at
