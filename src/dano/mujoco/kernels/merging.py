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
    Options,
    PartIndex,
    Settings,
    Touch,
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
# Share of the mean depth from which on samples of flat faces score by their area alone.
_SHALLOW = wp.constant(real(0.25))


@wp.func
def set_scores(work: wp.ref[Work], begin: int, end: int):
    """Say of each sample how it scores as a head: by its load, and where flat faces meet by its area.

    There all samples are about as deep, and loads would change places at each tremble.
    """
    weight = ZERO
    area = ZERO
    flat = ZERO
    along = vec3()
    for i in range(begin, end):
        touch = work.touches[i]
        weight += touch.weight
        area += touch.area
        along += touch.area * touch.normal
        if touch.flat == 1:
            flat += touch.area
    # Most of what touches is flat, and all of it faces one direction.
    are_flat = flat > HALF * area and wp.length(along) > _PARALLEL * area
    for i in range(begin, end):
        load = work.touches[i].weight
        if are_flat:
            load = wp.min(load, _SHALLOW * work.touches[i].area * weight / area)
        work.touches[i].score = load * work.touches[i].precedence


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


@wp.func(inline=True)
def pull(head: Touch, touch: Touch, near: real) -> real:
    """How much of a sample a head draws, beside others; `near`: ε² [m²]."""
    arm = touch.position - head.position
    facing = wp.max(ONE + wp.dot(touch.normal, head.normal), _AGAINST)
    closeness = facing / (near + wp.dot(arm, arm))
    return head.kept * closeness * closeness


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
def pull_on(work: wp.ref[Work], touch: Touch, heads: int, near: real) -> real:
    """How much all heads draw a sample."""
    total = ZERO
    for k in range(heads):
        total += pull(work.touches[work.heads[k]], touch, near)
    return total


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
def led_touch(work: wp.ref[Work], head: int, begin: int, end: int, near: real) -> tuple[Touch, real]:
    """One touch for the share of a head, and the number of samples that it stands for, (Σw)²/Σw².

    Its weight times its normal is their force. It presses if one of them does.
    """
    merged = work.touches[head]
    weight = ZERO
    squares = ZERO
    force = vec3()
    moment = vec3()
    place = vec3()
    gap = ZERO
    nearing = ZERO
    for i in range(begin, end):
        touch = work.touches[i]
        w = (ONE - touch.kept) * pull(merged, touch, near) / touch.drawn
        if i == head:
            w += touch.kept
        squares += w * touch.weight * touch.weight
        w = w * touch.weight
        arm = touch.position - merged.position
        weight += w
        force += w * touch.normal
        moment += w * wp.cross(arm, touch.normal)
        place += w * arm
        gap += w * touch.gap
        nearing += w * touch.nearing
        merged.presses = wp.max(merged.presses, touch.presses)
    squared = wp.dot(force, force)
    # Where normals oppose each other, no one contact does what they do, and the head stands for itself.
    if squared > HALF * HALF * weight * weight:
        place = place / weight
        moment -= wp.cross(place, force)
        merged.weight = wp.sqrt(squared)
        merged.position += place + wp.cross(force, moment) / squared
        merged.normal = force / merged.weight
        merged.gap = gap / weight
        merged.nearing = nearing / weight
    return merged, weight * weight / squares


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
    options: Options,
    settings: Settings,
    a: PartIndex,
    b: PartIndex,
    sink: real,
) -> int:
    """Write touches as contacts, from a row on; the row beyond the last."""
    most = int(options.most)
    if end - begin <= most:
        for i in range(begin, end):
            touch = work.touches[i]
            write(work, at, touch, touch.presses == 1, settings, a, b, sink, options)
            at += 1
        return at
    set_scores(work, begin, end)
    heads = find_heads(work, begin, end, most)
    near = _SPREAD * spread_of(work.touches, begin, end) / real(most)
    for i in range(begin, end):
        work.touches[i].drawn = pull_on(work, work.touches[i], heads, near)
    for k in range(heads):
        touch, samples = led_touch(work, work.heads[k], begin, end, near)
        write(work, at, touch, touch.presses == 1, in_parallel(settings, samples), a, b, sink, options)
        at += 1
    return at
