"""A few contacts in the place of many samples: with the same wrench, and the same from step to step.

Samples lie in a tree of halves of their surface. The finest level of the tree at which few enough of its
cells touch says which samples go together. So it depends on which samples touch, and on nothing else.
Pressures are as depths: a cell has the force Σ w n with w = area · depth, where its moment is that of
its samples, but for the part along the force.
"""

import warp as wp

from dano.mujoco.kernels.mixing import in_parallel, softened
from dano.mujoco.kernels.tables import ContactIndex, ContactRow, PartIndex, Settings, Touch, vec9, Work
from dano.physics.real import HALF, ONE, real, vec3, ZERO

BITS = 24
"""Depth of the tree."""

_BITS = wp.constant(BITS)
levels = wp.types.vector(length=BITS + 1, dtype=wp.int32)


@wp.func
def highest_bit(x: int) -> int:
    """Place of the highest bit of a number > 0, from 1."""
    place = int(0)
    while x > 0:
        x = x >> 1
        place += 1
    return place


@wp.func
def level_of(touches: wp.array(dtype=Touch), begin: int, end: int, most: int) -> int:
    """Low bits to leave out of codes such that at most so many different ones are left; codes ascend."""
    parted = levels()
    for i in range(begin + 1, end):
        place = highest_bit(touches[i - 1].code ^ touches[i].code)
        parted[place] = parted[place] + 1
    cells = int(1)
    level = int(_BITS)
    while level > 0 and cells + parted[level] <= most:
        cells += parted[level]
        level -= 1
    return level


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
def cell_touch(touches: wp.array(dtype=Touch), begin: int, end: int) -> Touch:
    """One touch for several: its weight times its normal is their force."""
    weight = ZERO
    force = vec3()
    moment = vec3()
    place = vec3()
    gap = ZERO
    nearing = ZERO
    heaviest = int(begin)
    for i in range(begin, end):
        touch = touches[i]
        w = touch.weight
        weight += w
        force += w * touch.normal
        moment += w * wp.cross(touch.position, touch.normal)
        place += w * touch.position
        gap += w * touch.gap
        nearing += w * touch.nearing
        if w > touches[heaviest].weight:
            heaviest = i
    merged = touches[heaviest]
    squared = wp.dot(force, force)
    # Where normals oppose each other, no one contact does what they do.
    if squared > HALF * HALF * weight * weight and end - begin > 1:
        place = place / weight
        moment -= wp.cross(place, force)
        merged.weight = wp.sqrt(squared)
        merged.position = place + wp.cross(force, moment) / squared
        merged.normal = force / merged.weight
        merged.gap = gap / weight
        merged.nearing = nearing / weight
    return merged


@wp.func
def write(
    work: Work,
    at: int,
    touch: Touch,
    presses: bool,
    settings: Settings,
    a: PartIndex,
    b: PartIndex,
    sink: real,
    h: real,
):
    """A touch as a contact of MuJoCo."""
    row = ContactRow()
    row.dist = touch.gap
    row.pos = touch.position
    row.frame = tangents(touch.normal)
    row.includemargin = settings.margin - settings.gap
    fitted = settings
    if presses:
        fitted = softened(settings, touch.gap - row.includemargin, touch.nearing, sink, h)
    row.friction = fitted.friction
    row.solref = fitted.solref
    row.solimp = fitted.solimp
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
    work: Work,
    at: int,
    begin: int,
    end: int,
    most: int,
    settings: Settings,
    a: PartIndex,
    b: PartIndex,
    sink: real,
    h: real,
) -> int:
    """Write the touches of one surface as contacts, from a row on; the row beyond the last."""
    level = level_of(work.touches, begin, end, most)
    i = int(begin)
    while i < end:
        cell = work.touches[i].code >> level
        first = int(i)
        presses = bool(False)
        while i < end and work.touches[i].code >> level == cell:
            if work.touches[i].presses == 1:
                presses = True
            i += 1
        stiff = in_parallel(settings, i - first)
        write(work, at, cell_touch(work.touches, first, i), presses, stiff, a, b, sink, h)
        at += 1
    return at
