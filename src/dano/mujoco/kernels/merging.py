"""A few contacts in the place of many samples: with the same wrench, and the same from step to step.

Samples lie in a tree of halves of their surface. The finest level of the tree at which few enough of its
heavy cells touch says which samples go together; light cells go with others. So it stays from step to step.
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
# Share of the mean load of a contact below which a cell goes with the one before it. What just begins to
# touch then changes little, and not which samples go together.
_LIGHT = wp.constant(real(0.16))


@wp.func
def cell_end(touches: wp.array(dtype=Touch), begin: int, end: int, level: int) -> tuple[int, real]:
    """The end of the cell that begins at a touch, and its weight [m³]; `level`: bits of codes left out."""
    cell = touches[begin].code >> level
    weight = ZERO
    i = int(begin)
    inside = bool(True)
    while inside:
        weight += touches[i].weight
        i += 1
        inside = i < end
        if inside:
            inside = touches[i].code >> level == cell
    return i, weight


@wp.func
def heavy_cells(touches: wp.array(dtype=Touch), begin: int, end: int, level: int, least: real) -> int:
    """How many cells of a level weigh at least so much [m³]."""
    cells = int(0)
    i = int(begin)
    while i < end:
        i, weight = cell_end(touches, i, end, level)
        if weight >= least:
            cells += 1
    return cells


@wp.func
def level_of(touches: wp.array(dtype=Touch), begin: int, end: int, most: int, least: real) -> int:
    """The finest level before there are more heavy cells than so many."""
    level = int(_BITS)
    searching = bool(True)
    while searching and level > 0:
        if heavy_cells(touches, begin, end, level - 1, least) > most:
            searching = False
        else:
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
def write_cell(
    work: Work,
    at: int,
    begin: int,
    end: int,
    settings: Settings,
    a: PartIndex,
    b: PartIndex,
    sink: real,
    h: real,
):
    """Touches as one contact of MuJoCo, as compliant as all of them: their number is (Σw)²/Σw²."""
    presses = bool(False)
    weight = ZERO
    squared = ZERO
    for i in range(begin, end):
        w = work.touches[i].weight
        weight += w
        squared += w * w
        if work.touches[i].presses == 1:
            presses = True
    stiff = in_parallel(settings, weight * weight / squared)
    write(work, at, cell_touch(work.touches, begin, end), presses, stiff, a, b, sink, h)


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
    total = ZERO
    for k in range(begin, end):
        total += work.touches[k].weight
    least = _LIGHT * total / real(most)
    level = level_of(work.touches, begin, end, most, least)
    first = int(begin)
    heavy = bool(False)
    i = int(begin)
    while i < end:
        following, weight = cell_end(work.touches, i, end, level)
        if weight >= least:
            if heavy:
                write_cell(work, at, first, i, settings, a, b, sink, h)
                at += 1
                first = i
            heavy = True
        i = following
    write_cell(work, at, first, end, settings, a, b, sink, h)
    return at + 1
