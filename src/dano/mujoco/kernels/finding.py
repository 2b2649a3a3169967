"""The contacts of the objects of a model, in one launch (docs/mujoco.md).

The samples of each of two parts are asked for their distance to the other's solid. Where bodies approach so
fast that they would sink too deep into each other within the step, geometry is taken when the first sample
has sunk so deep, and what would by the end of the step is listed before it touches.
"""

import warp as wp

from dano.mujoco.kernels.merging import merge
from dano.mujoco.kernels.mixing import pair_settings
from dano.mujoco.kernels.solids import distance_with_faces, part_clearance, quick_clearance
from dano.mujoco.kernels.tables import BLOCK, Data, Known, Model, Options, Part, PartIndex, RUN, Touch, Work
from dano.mujoco.kernels.words import HULL, UNKNOWN
from dano.physics.pairs import (
    approach,
    BodyState,
    facing_direction,
    pair_pose,
    PairPose,
    rotation_after,
    way_of,
)
from dano.physics.real import HALF, INFINITY, mat33, ONE, real, vec3, vec4, ZERO
from dano.physics.rotations import turned
from dano.physics.samples import facing_area, position_in_solid, solid_normal
from dano.physics.solids.distances import solid_of
from dano.physics.solids.grids import STEEPEST
from dano.physics.solids.kinds import BOX, GRID, HALF_SPACE

_BLOCK, _GRID, _HALF_SPACE = wp.constant(BLOCK), wp.constant(GRID), wp.constant(HALF_SPACE)
_RUN, _UNKNOWN = wp.constant(RUN), wp.constant(UNKNOWN)
_BOX, _HULL = wp.constant(BOX), wp.constant(HULL)
# Share of the thinner body's half thickness by which bodies may sink into each other: normals still point
# out of the side that was hit.
_SINK = wp.constant(real(0.25))
# Samples are finer by far if their areas are so much smaller.
_FINER = wp.constant(real(0.5))
# Share of its depth with which a sample counts that is near, but does not press.
_NEAR = wp.constant(real(1e-6))
# Most steps of the search for the moment when bodies meet, and the share of the step that ends it.
_ADVANCES = wp.constant(40)
_MET = wp.constant(real(1e-9))


@wp.struct
class Side:
    """One of two parts whose samples are asked, and the other that they are asked against."""

    part: Part  # Of the samples
    index: PartIndex  # Of the samples
    other: PartIndex  # Of the solid
    a: BodyState  # State of the samples' part
    b: BodyState  # State of the solid's
    band: real  # Of the other, see `Part`
    slack: real  # The same
    coarse: wp.int32  # 1 where the other's samples are finer by far
    sign: real  # 1 if normals out of the solid point from the pair's first part to its second, else −1


@wp.func
def part_state(model: wp.ref[Model], data: wp.ref[Data], world: int, index: PartIndex, h: real) -> BodyState:
    """Where the frame of a part is, and how it moves. Its centre of mass is that of its body."""
    state = BodyState()
    rotation = data.geom_xmat[world, index.geom]
    origin = data.geom_xpos[world, index.geom]
    if index.is_object == 1:
        rotation = data.xmat[world, index.body]
        origin = data.xpos[world, index.body]
    state.position = data.xipos[world, index.body]
    state.com = wp.transpose(rotation) * (state.position - origin)
    state.orientation = wp.quat_from_matrix(rotation)
    # MuJoCo's velocities are those of the point of the body at the centre of mass of its tree.
    twist = data.cvel[world, index.body]
    state.spin = vec3(twist[0], twist[1], twist[2])
    arm = state.position - data.subtree_com[world, model.body_rootid[index.body]]
    state.velocity = vec3(twist[3], twist[4], twist[5]) + wp.cross(state.spin, arm)
    state.ahead = turned(state.orientation, wp.transpose(rotation) * state.spin, h)
    return state


@wp.func
def middle_of(part: Part, state: BodyState) -> vec3:
    """Centre of the ball around a part [m, W]."""
    return state.position + rotation_after(state, ZERO) * (part.middle - state.com)


@wp.func
def side_pose(known: wp.ref[Known], side: Side, share: real, h: real) -> PairPose:
    """Pose of the two parts after a share of the step, samples turned to the other part."""
    toward = vec3(ONE, ZERO, ZERO)
    # Only objects, whose solids are grids, are asked by samples that turn.
    if side.index.turning != 0:
        solid = solid_of(known.solids, 0, side.other.at, 1)
        toward = facing_direction(
            known.solids, 0, solid, side.a, side.b, share, h, side.index.turning, side.part.scale
        )
    return pair_pose(side.a, side.b, share, h, toward, side.index.turning, side.part.scale, ZERO)


@wp.func(inline=True)
def stretch_of(side: Side) -> real:
    """Largest factor by which sample coordinates are enlarged."""
    stretch = ONE
    if side.index.turning == 2:
        stretch = wp.max(side.part.scale[0], wp.max(side.part.scale[1], side.part.scale[2]))
    return stretch


@wp.func(inline=True)
def is_ball_near(
    known: Known,
    model: Model,
    other: PartIndex,
    turn: mat33,
    origin: vec3,
    ball: vec4,
    stretch: real,
    reach: real,
) -> bool:
    """Whether samples in a ball may be nearer to the solid of a part than `reach` [m].

    Args:
        known: What is known of the model.
        model: The model.
        other: The part with the solid.
        turn: Sample coordinates → solid frame, without the origin.
        origin: Where that is [m].
        ball: Centre and radius in sample coordinates.
        stretch: Largest factor by which sample coordinates are enlarged.
        reach: The distance.
    """
    steepest = ONE
    if other.solid == _GRID:
        steepest = STEEPEST
    x = turn * vec3(ball[0], ball[1], ball[2]) + origin
    near = reach + steepest * stretch * ball[3]
    return part_clearance(known, model, other, x, near) <= near


@wp.func(inline=True)
def next_near_block(
    known: Known,
    model: Model,
    side: Side,
    turn: mat33,
    origin: vec3,
    stretch: real,
    reach: real,
    block: int,
    end: int,
) -> int:
    """The first block from one on whose samples may be near, see `is_ball_near`; `end` if there is none."""
    found = block
    searching = bool(True)
    while searching and found < end:
        place = found - side.index.first_block
        run = side.index.first_run + place // _RUN
        if place % _RUN == 0 and not is_ball_near(
            known, model, side.other, turn, origin, known.runs[run], stretch, reach
        ):
            found += _RUN
        elif is_ball_near(known, model, side.other, turn, origin, known.balls[found], stretch, reach):
            searching = False
        else:
            found += 1
    return found


@wp.func(inline=True)
def pressed_normal(pose: PairPose, solid: int, facing: vec3, normal: vec3, flat: int) -> tuple[vec3, int]:
    """Outward normal of a solid at a sample: against the face that the sample lies within, if that says more.

    What is round presses on a flat face along the normal of that. Where faces meet, each side takes that of
    the other. Planes, boxes and hulls of MuJoCo are flat themselves.

    Args:
        pose: Of the two parts.
        solid: Kind of the solid.
        facing: Normal of the face that the sample lies within, zero for none.
        normal: Of the solid.
        flat: Whether that is of a flat face of an object.

    Returns:
        The normal, and 1 if one of the two is that of a flat face of an object, 2 if only the sample's is.
    """
    found = normal
    of_face = int(flat)
    if wp.dot(facing, facing) > ZERO and flat == 0:
        against = -(pose.points * facing)
        if wp.dot(against, normal) > HALF:
            of_face = 1
            if solid != _HALF_SPACE and solid != _BOX and solid != _HULL:
                found = against
                of_face = 2
    return found, of_face


@wp.func(inline=True)
def slope_of(own: vec3, normal: vec3) -> vec3:
    """How the height of a surface over a plane grows along it [1].

    Args:
        own: Along the outward normal of the surface, towards the plane.
        normal: Of the plane.
    """
    along = wp.dot(own, normal)
    return (own - along * normal) / wp.max(-along, real(1e-30))


@wp.func
def meeting(known: wp.ref[Known], model: wp.ref[Model], side: Side, sink: real, way: real, h: real) -> real:
    """Share of the step after which the first sample has sunk in by `sink`; 1 if none does within the step.

    The root of the depth of the deepest sample, by Newton's method, from the start of the step on.
    """
    share = real(0.0)
    stretch = stretch_of(side)
    k = int(0)
    while k < _ADVANCES:
        pose = side_pose(known, side, share, h)
        further = real(INFINITY)
        reach = (ONE - share) * way - sink
        block = int(side.index.first_block)
        end = block + side.index.blocks
        while block < end:
            block = next_near_block(
                known, model, side, pose.points, pose.origin, stretch, reach + side.slack, block, end
            )
            if block < end:
                for s in range(_BLOCK * block, _BLOCK * block + _BLOCK):
                    x = position_in_solid(pose, known.samples[s].point)
                    value, gradient, flat = distance_with_faces(known, model, side.other, side.band, x)
                    if value <= reach:
                        normal, flat = pressed_normal(
                            pose, side.other.solid, known.facing[s], solid_normal(gradient), flat
                        )
                        near = h * approach(pose, side.index.turning, x, normal)
                        left = value + sink
                        # What begins deeper is no matter of this step.
                        if near > ZERO and (share > ZERO or left > ZERO):
                            if facing_area(pose, known.samples[s], normal) > ZERO:
                                further = wp.min(further, wp.max(left, ZERO) / near)
                block += 1
        share += further
        k += 1
        if share >= ONE:
            share = ONE
            k = _ADVANCES
        elif further <= _MET:
            k = _ADVANCES
    return share


@wp.struct
class AtStart:
    """Where points of the solid's frame after a share of the step are when it begins [m, W].

    Attributes:
        turn: Of the solid's body.
        origin: Of its frame.
        samples_turn: Of the samples' body, for the same point of that.
        samples_origin: The same.
    """

    turn: mat33
    origin: vec3
    samples_turn: mat33
    samples_origin: vec3


@wp.func
def at_start(side: Side, share: real, h: real) -> AtStart:
    """Both bodies at the start of the step, as seen after a share of it."""
    found = AtStart()
    found.turn = rotation_after(side.b, ZERO)
    found.origin = side.b.position - found.turn * side.b.com
    found.samples_turn = found.turn
    found.samples_origin = found.origin
    if share > ZERO:
        back = rotation_after(side.a, ZERO) * wp.transpose(rotation_after(side.a, share))
        found.samples_turn = back * rotation_after(side.b, share)
        apart = side.b.position - side.a.position + (share * h) * (side.b.velocity - side.a.velocity)
        found.samples_origin = side.a.position + back * apart - found.samples_turn * side.b.com
    return found


@wp.func(inline=True)
def side_touch(side: Side, pose: PairPose, start: AtStart, x: vec3, normal: vec3, distance: real) -> Touch:
    """A sample at x of the solid's frame, as both bodies see it at the start of the step."""
    touch = Touch()
    below = start.origin + start.turn * (x - distance * normal)
    above = start.samples_origin + start.samples_turn * x
    n = start.turn * normal
    touch.position = HALF * (above + below)
    touch.gap = wp.dot(n, above - below)
    touch.normal = side.sign * n
    touch.nearing = approach(pose, side.index.turning, x, normal)
    return touch


@wp.struct
class Asking:
    """How the samples of a side are asked."""

    pose: PairPose
    start: AtStart
    fast: bool  # Whether bodies would sink too deep into each other within the step
    reach: real  # What is further away is not listed [m]
    margin: real  # Distance within which samples touch [m]
    gap: real  # What is nearer than the margin by less is only near [m]
    sink: real  # Depth by which bodies may sink into each other [m]
    h: real  # Timestep [s]


@wp.func
def asking_of(
    known: wp.ref[Known],
    model: wp.ref[Model],
    side: Side,
    margin: real,
    gap: real,
    sink: real,
    way: real,
    h: real,
) -> Asking:
    """How the samples of a side are asked; bodies move by a way within the step [m]."""
    asking = Asking()
    asking.margin = margin
    asking.gap = gap
    asking.sink = sink
    asking.h = h
    share = ZERO
    asking.fast = way > sink
    if asking.fast:
        share = meeting(known, model, side, sink, way, h)
        # Nothing sinks too deep.
        if share >= ONE:
            share = ZERO
            asking.fast = False
    asking.pose = side_pose(known, side, share, h)
    asking.start = at_start(side, share, h)
    asking.reach = margin
    if asking.fast:
        asking.reach = margin + way
    return asking


@wp.struct
class LastSample:
    """What the samples before say of the next."""

    at: vec3  # Where the distance was asked for last [m, frame of the solid]
    distance: real  # What it was [m]: a bound for samples beside it


@wp.func
def distance_beside(
    known: wp.ref[Known], model: wp.ref[Model], side: Side, reach: real, x: vec3, seen: wp.ref[LastSample]
) -> tuple[real, vec3, int]:
    """`distance_with_faces` at a point; only a bound, and no gradient, where that is beyond reach."""
    # Most samples of a near block are not near.
    value = real(-INFINITY)
    gradient = vec3()
    flat = int(0)
    if side.other.solid == _GRID:
        value = seen.distance - STEEPEST * wp.length(x - seen.at)
    if value <= reach + side.slack:
        # Beside what is near, most are: their values are not asked without gradients. Nor are those beside
        # flat faces, where they are less exact than planes.
        enough = real(-INFINITY)
        if side.other.faces == 0 and seen.distance > reach:
            enough = reach
        value = quick_clearance(known, side.other, x, enough)
        seen.distance = value
        seen.at = x
    if value <= reach + side.slack:
        value, gradient, flat = distance_with_faces(known, model, side.other, side.band, x)
        seen.distance = value
    return value, gradient, flat


@wp.func
def touch_of_sample(
    known: wp.ref[Known],
    side: Side,
    asking: Asking,
    s: int,
    x: vec3,
    value: real,
    gradient: vec3,
    of_face: int,
) -> Touch:
    """A sample that is near, at x of the solid's frame; its weight is zero if it does not touch."""
    touch = Touch()
    pose = asking.pose
    sample = known.samples[s]
    normal, flat = pressed_normal(pose, side.other.solid, known.facing[s], solid_normal(gradient), of_face)
    area = facing_area(pose, sample, normal)
    # Finer samples say better where what is round presses on a face.
    if side.coarse == 1 and flat == 2:
        area = ZERO
    # Samples on the far side of a thin body do not press.
    if area > ZERO:
        touch = side_touch(side, pose, asking.start, x, normal, value)
        over = touch.gap - asking.margin + asking.gap
        end = over - asking.h * touch.nearing
        early = asking.fast and end < -asking.sink
        depth = asking.margin - touch.gap
        # What is only near must not lead what presses.
        if asking.gap > ZERO:
            depth = wp.max(-over, _NEAR * depth)
        if early:
            depth = wp.max(depth, -end)
        if depth > ZERO:
            touch.weight = area * depth
            touch.area = area
            touch.flat = wp.min(flat, 1)
            on_face = wp.dot(known.facing[s], known.facing[s]) > ZERO
            # What is round on what is flat, either of which may be that of the sample.
            if flat == 2 or (flat == 1 and known.rim[s] == 0 and not on_face):
                own = pose.points * sample.area
                if flat == 2:
                    own = -solid_normal(gradient)
                if side.index.turning == 0 or flat == 2:
                    touch.flat = 2
                    touch.slope = asking.start.turn * slope_of(own, normal)
            touch.precedence = known.precedence[s]
            touch.presses = wp.where(early or over < ZERO, 1, 0)
    return touch


@wp.func
def list_side(
    known: wp.ref[Known],
    model: wp.ref[Model],
    work: wp.ref[Work],
    side: Side,
    margin: real,
    gap: real,
    sink: real,
    way: real,
    h: real,
    begin: int,
) -> int:
    """List the samples of a side that touch, from a place on; the place beyond the last."""
    asking = asking_of(known, model, side, margin, gap, sink, way, h)
    points = asking.pose.points
    origin = asking.pose.origin
    reach = asking.reach
    stretch = stretch_of(side)
    seen = LastSample()
    seen.distance = -INFINITY
    at = int(begin)
    block = int(side.index.first_block)
    last = block + side.index.blocks
    while block < last:
        block = next_near_block(known, model, side, points, origin, stretch, reach + side.slack, block, last)
        if block < last:
            for s in range(_BLOCK * block, _BLOCK * block + _BLOCK):
                x = points * known.samples[s].point + origin
                value, gradient, flat = distance_beside(known, model, side, reach, x, seen)
                if value <= reach:
                    touch = touch_of_sample(known, side, asking, s, x, value, gradient, flat)
                    if touch.weight > ZERO:
                        work.touches[at] = touch
                        at += 1
            block += 1
    return at


@wp.func
def are_apart(a: Part, b: Part, turn: mat33, other: mat33, way: vec3, reach: real) -> bool:
    """Whether the boxes around two parts are further apart than `reach` [m] along one of their axes.

    Args:
        a: A part.
        b: The other.
        turn: Rotation of the first.
        other: Of the second.
        way: From the middle of the first to that of the second [m, W].
        reach: The distance.
    """
    relative = wp.transpose(turn) * other
    seen = wp.transpose(turn) * way
    seen_back = wp.transpose(other) * way
    apart = bool(False)
    for i in range(3):
        size = a.half[i] + reach
        size_back = b.half[i] + reach
        for j in range(3):
            size += wp.abs(relative[i, j]) * b.half[j]
            size_back += wp.abs(relative[j, i]) * a.half[j]
        if wp.abs(seen[i]) > size or wp.abs(seen_back[i]) > size_back:
            apart = True
    return apart


@wp.func
def list_pair(
    known: wp.ref[Known],
    model: wp.ref[Model],
    data: wp.ref[Data],
    work: wp.ref[Work],
    options: Options,
    world: int,
    pair: int,
    begin: int,
) -> int:
    """Contacts of a pair, from a row on; the row beyond the last, or −2 less the geom that may not touch."""
    h = options.timestep
    first = known.pairs[pair].first
    second = known.pairs[pair].second
    side = Side()
    side.index = known.index[second]
    side.other = known.index[first]
    # Samples for which one stands that is asked.
    each = ONE
    # Of a polyhedron nothing is deeper in a half-space than a corner.
    if side.other.solid == _HALF_SPACE and side.index.corner_blocks > 0:
        side.index.first_block = side.index.first_corner_block
        side.index.first_run = side.index.first_corner_run
        side.index.blocks = side.index.corner_blocks
        each = known.parts[second].corner_share
    settings = pair_settings(known, model, options, work.settings, world, pair)
    if settings.dim == ZERO:
        return begin
    if options.within > ZERO:
        # Such a solver does not hear of what is only near.
        settings.margin = settings.margin - settings.gap
        settings.gap = ZERO
    side.part = known.parts[second]
    part = known.parts[first]
    side.a = part_state(model, data, world, side.index, h)
    side.b = part_state(model, data, world, side.other, h)
    middle = middle_of(side.part, side.a)
    way = way_of(side.a, side.b, middle, side.part.radius, h)
    reach = side.part.radius + settings.margin + way
    if side.other.solid == _HALF_SPACE:
        axis = wp.transpose(data.geom_xmat[world, side.other.geom])[2]
        if wp.dot(axis, middle - data.geom_xpos[world, side.other.geom]) > reach:
            return begin
    else:
        around = part.radius
        if side.other.is_object == 0:
            around = model.geom_rbound[world, side.other.geom]
        apart = middle - middle_of(part, side.b)
        if wp.dot(apart, apart) > (reach + around) * (reach + around):
            return begin
        turn = rotation_after(side.a, ZERO)
        other = rotation_after(side.b, ZERO)
        if are_apart(side.part, part, turn, other, apart, settings.margin + way):
            return begin
    if side.other.solid == _UNKNOWN:
        return -2 - side.other.geom
    sink = _SINK * wp.min(part.thickness, side.part.thickness)
    side.band = part.band
    side.slack = part.slack
    side.coarse = wp.where(part.grain < _FINER * side.part.grain, 1, 0)
    n = int(0)
    if side.other.solid >= 0:
        side.sign = ONE
        n = list_side(known, model, work, side, settings.margin, settings.gap, sink, way, h, 0)
    both = int(n)
    if known.pairs[pair].both == 1 and side.other.blocks > 0 and side.index.solid >= 0:
        flipped = Side()
        flipped.part = part
        flipped.index = side.other
        flipped.other = side.index
        flipped.a = side.b
        flipped.b = side.a
        flipped.sign = -ONE
        flipped.band = side.part.band
        flipped.slack = side.part.slack
        flipped.coarse = wp.where(side.part.grain < _FINER * part.grain, 1, 0)
        both = list_side(known, model, work, flipped, settings.margin, settings.gap, sink, way, h, n)
    if both == 0:
        return begin
    return merge(work, begin, 0, both, each, options, settings, side.other, side.index, sink)


@wp.kernel(enable_backward=False)
def find(known: Known, model: Model, data: Data, work: Work):
    """All contacts of the objects at the pose of `data`."""
    stale = bool(False)
    for i in range(known.sizes.shape[0]):
        change = known.sizes[i] - model.geom_size[0, i]
        if wp.dot(change, change) > ZERO:
            stale = True
    at = int(0)
    if stale:
        at = -1
    else:
        for pair in range(known.pairs.shape[0]):
            if at >= 0:
                at = list_pair(known, model, data, work, work.options[0], 0, pair, at)
    work.found[0] = at
