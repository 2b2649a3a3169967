"""Where bodies are near each other: parts of the samples of one beside the solid of the other."""

import warp as wp

from dano.engine.kernels.tables import (
    BLOCK,
    Body,
    BodyIndex,
    FoundPair,
    LEVELS,
    numbers_of,
    Room,
    RUN,
    SamplePair,
    Scene,
)
from dano.physics.features import LANES, TREES
from dano.physics.impacts import share_left_out, supported
from dano.physics.pairs import (
    BodyState,
    facing_direction,
    falling,
    pair_pose,
    PairPose,
    speed_in_ball,
    way_of,
)
from dano.physics.real import INFINITY, ONE, real, TWO, vec3, vec4, ZERO
from dano.physics.rotations import matrix
from dano.physics.samples import solid_normal
from dano.physics.solids.bounds import bound_at, bound_in_ball, GridView, QUICK, view_of_grid
from dano.physics.solids.distances import Solid, solid_clearance, solid_distance, solid_of
from dano.physics.solids.grids import STEEPEST
from dano.physics.solids.kinds import HALF_SPACE
from dano.physics.twists import wrench_at

_LANES, _BLOCK, _RUN = wp.constant(LANES), wp.constant(BLOCK), wp.constant(RUN)
# A run has four times as many blocks as the next smaller one.
_TWICE = wp.constant(2)
_LEVELS, _LARGEST = wp.constant(LEVELS), wp.constant(RUN**LEVELS)
_HALF_SPACE = wp.constant(HALF_SPACE)
# From so many blocks on it is asked first whether a body is near another.
_MANY = wp.constant(RUN**2)


@wp.struct
class NearPair:
    """A pair as a step looks at it."""

    first: int  # Its bodies
    second: int
    contact: int  # Of `Scene.materials`
    turning: int  # How samples of the first body turn
    h: real  # Timestep [s]
    numbers: SamplePair
    some: int  # How many blocks `room.some` has for it, −1 for all


@wp.func
def near_pair(scene: wp.ref[Scene], world: int, place: int) -> NearPair:
    """The pair at a place."""
    index = scene.pair_index[place]
    pair = NearPair()
    pair.first = index.first
    pair.second = index.second
    pair.contact = index.contact
    pair.turning = scene.body_index[index.first].turning
    pair.h = scene.timestep[world, 0]
    pair.numbers = numbers_of(scene, world, place)
    pair.some = -1
    return pair


@wp.func
def stretch_of(body: Body, turning: int) -> real:
    """Largest factor by which sample coordinates are enlarged."""
    if turning == 2:
        return wp.max(body.scale[0], wp.max(body.scale[1], body.scale[2]))
    return ONE


@wp.struct
class Plane:
    """What a body nears, if it is a plane."""

    is_one: bool  # Whether it is one, and samples are fixed to the body
    normal: vec3  # Unit normal in the axes of the solid


@wp.func
def plane_of(scene: wp.ref[Scene], world: int, solid: Solid, turning: int, x: vec3) -> Plane:
    """The plane that samples near, from any point x of the solid's frame."""
    plane = Plane()
    plane.is_one = solid.kind.kind == _HALF_SPACE and solid.count == 1 and turning == 0
    if plane.is_one:
        plane.normal = solid_normal(solid_distance(scene.solids, world, solid, x).gradient)
    return plane


@wp.func
def reach_of_block(
    scene: wp.ref[Scene], world: int, pose: PairPose, plane: Plane, block: int, stretch: real
) -> real:
    """By how much samples of a block are nearer to a solid than its middle at most [m].

    A plane sees how thick a block is, where it sees it from above.
    """
    radius = scene.balls[world, block][3] * stretch
    if plane.is_one:
        slab = scene.slabs[world, block]
        along = wp.dot(plane.normal, pose.points * vec3(slab[0], slab[1], slab[2]))
        across = wp.sqrt(wp.max(ONE - along * along, ZERO))
        return wp.min(radius, slab[3] * wp.abs(along) + radius * across)
    return radius


@wp.func
def view_of(solid: Solid, pose: PairPose, turning: int) -> GridView:
    """A solid as the samples of a pair see it."""
    return view_of_grid(solid, pose.points, pose.origin, turning)


@wp.func
def is_run_far(
    scene: wp.ref[Scene],
    world: int,
    solid: Solid,
    view: GridView,
    pose: PairPose,
    run: vec4,
    radius: real,
    way: real,
) -> bool:
    """Whether all blocks of a run, in a ball with a radius, are further from a solid than a way [m]."""
    middle = vec3(run[0], run[1], run[2])
    if wp.static(QUICK):
        if view.known:
            return bound_in_ball(scene.solids, world, view, middle, radius, way) > way
    far = way + STEEPEST * radius
    return solid_clearance(scene.solids, world, solid, pose.points * middle + pose.origin, far) > far


@wp.func
def clearance_of_block(
    scene: wp.ref[Scene], world: int, solid: Solid, view: GridView, pose: PairPose, ball: vec4, far: real
) -> real:
    """A lower bound on the clearance of the middle of a block [m]; where it exceeds `far`, any that does."""
    middle = vec3(ball[0], ball[1], ball[2])
    if wp.static(QUICK):
        if view.known:
            return bound_at(scene.solids, world, view, middle, far)
    return solid_clearance(scene.solids, world, solid, pose.points * middle + pose.origin, far)


@wp.func
def far_until(
    scene: wp.ref[Scene],
    world: int,
    solid: Solid,
    view: GridView,
    pose: PairPose,
    index: BodyIndex,
    i: int,
    way: real,
    stretch: real,
) -> int:
    """The end of the largest run of blocks from a body's i-th on that is further from a solid than a way [m].

    Returns:
        Number of the block behind it in the body, i where there is none.
    """
    size = int(_LARGEST)
    beside = int(_LEVELS)
    while beside > 0:
        beside -= 1
        if i & (size - 1) == 0 and i + (size >> _TWICE) < index.blocks:
            run = scene.runs[world, index.first_block + i + beside]
            if is_run_far(scene, world, solid, view, pose, run, run[3] * stretch, way):
                return i + size
        size = size >> _TWICE
    return i


@wp.func
def middle_of(body: Body, state: BodyState) -> vec3:
    """Centre of the ball around a body at the start of the step [m, W]."""
    return state.position + matrix(state.orientation) * (body.middle - body.com)


@wp.func
def solid_of_body(scene: wp.ref[Scene], world: int, body: int) -> Solid:
    """What the samples of others press on."""
    index = scene.body_index[body]
    return solid_of(scene.solids, world, index.first_leaf, index.leaves)


@wp.func
def gain_of(a: BodyState, b: BodyState, lever: real) -> real:
    """Most that a velocity of a point gains relative to another body within a step [m/s].

    Args:
        a: The body of the point.
        b: The other body.
        lever: Largest distance of the point from the first body's centre of mass [m].
    """
    of_spins = wp.length(a.spin_gain) * lever
    of_spins += wp.length(b.spin_gain) * (lever + wp.length(a.position - b.position))
    return wp.length(a.gain - b.gain) + of_spins


@wp.func
def is_near(
    scene: wp.ref[Scene],
    world: int,
    a: BodyState,
    b: BodyState,
    first: int,
    second: int,
    margin: real,
    h: real,
) -> bool:
    """Whether two bodies may meet within the step, by the balls around them."""
    body = scene.bodies[world, first]
    other = scene.bodies[world, second]
    x = middle_of(body, a)
    reach = (
        body.radius
        + margin
        + h * (wp.length(a.velocity - b.velocity) + wp.length(a.spin) * wp.length(body.middle - body.com))
        + h * gain_of(a, b, wp.length(body.middle - body.com))
    )
    solid = solid_of_body(scene, world, second)
    if solid.kind.kind == _HALF_SPACE:
        in_solid = wp.transpose(matrix(b.orientation)) * (x - b.position) + b.com
        return solid_clearance(scene.solids, world, solid, in_solid, reach) <= reach
    reach += other.radius + h * wp.length(b.spin) * wp.length(other.middle - other.com)
    apart = x - middle_of(other, b)
    return wp.dot(apart, apart) <= reach * reach


@wp.func
def left_out(found: FoundPair, factor: real) -> real:
    """`share_left_out` of a pair, none where it rests on nothing while it nears an impact."""
    if wp.length_sq(found.support) > ZERO:
        return share_left_out(found.rest, factor)
    return ZERO


@wp.func
def as_they_meet(a: BodyState, b: BodyState, found: FoundPair, h: real) -> tuple[BodyState, BodyState]:
    """Bodies of a pair with what their velocities gain until they meet: by gravity, and what they rest on."""
    first = falling(a, found.falls)
    second = falling(b, found.falls)
    if wp.static(not TREES):
        if wp.length_sq(found.support) > ZERO:
            first = supported(first, found.support, h)
            second = supported(second, -wrench_at(found.support, a.position - b.position), h)
    return first, second


@wp.func
def facing(scene: wp.ref[Scene], world: int, pair: NearPair, a: BodyState, b: BodyState, share: real) -> vec3:
    """Direction that samples of the first body face after a share of the step [F]."""
    solid = solid_of_body(scene, world, pair.second)
    scale = scene.bodies[world, pair.first].scale
    return facing_direction(scene.solids, world, solid, a, b, share, pair.h, pair.turning, scale)


@wp.func
def posed(
    scene: wp.ref[Scene], world: int, pair: NearPair, a: BodyState, b: BodyState, share: real
) -> PairPose:
    """Pose of a pair after a share of the step."""
    toward = facing(scene, world, pair, a, b, share)
    scale = scene.bodies[world, pair.first].scale
    return pair_pose(a, b, share, pair.h, toward, pair.turning, scale, pair.numbers.follows)


@wp.func
def find_candidates_of_pair(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    pair: NearPair,
    a: BodyState,
    b: BodyState,
    gain: real,
) -> int:
    """Blocks of a pair whose samples may come within the margin of the solid in the step, into `room.some`.

    Each ball has its own way: what turns does not move everywhere as fast as where it is fastest.

    Args:
        scene: The scene.
        room: Room.
        world: Which world.
        pair: The pair.
        a: Its first body.
        b: Its second body.
        gain: Most that velocities gain in the step [m/s].

    Returns:
        How many, −1 where they are not looked for.
    """
    if wp.static(LANES == 1):
        index = scene.body_index[pair.first]
        if index.blocks > _MANY and index.turning == 0:
            h = pair.h
            body = scene.bodies[world, pair.first]
            solid = solid_of_body(scene, world, pair.second)
            # What velocities gain, and how they turn, seen from the second body.
            gained = real(1.5) * h * gain
            way = way_of(a, b, middle_of(body, a), body.radius, h) + gained
            more = gained + way * h * (wp.length(a.spin - b.spin) + TWO * wp.length(b.spin))
            more = wp.max(pair.numbers.margin, pair.numbers.impact_depth) + STEEPEST * more
            pose = posed(scene, world, pair, a, b, ZERO)
            steep = STEEPEST * h
            view = view_of(solid, pose, index.turning)
            found = int(0)
            i = int(0)
            while i < index.blocks:
                after = int(i)
                size = int(_LARGEST)
                beside = int(_LEVELS)
                while after == i and beside >= 0:
                    beside -= 1
                    if i & (size - 1) == 0 and i + (size >> _TWICE) < index.blocks:
                        block = index.first_block + i
                        ball = scene.balls[world, block]
                        if beside >= 0:
                            ball = scene.runs[world, block + beside]
                        x = pose.points * vec3(ball[0], ball[1], ball[2]) + pose.origin
                        far = more + steep * speed_in_ball(pose, x, ball[3])
                        if beside >= 0:
                            if is_run_far(scene, world, solid, view, pose, ball, ball[3], far):
                                after = i + size
                        else:
                            after = i + 1
                            clear = clearance_of_block(scene, world, solid, view, pose, ball, far + ball[3])
                            if clear <= far + ball[3]:
                                room.some[world, found] = block
                                room.bound[world, found] = clear - ball[3]
                                found += 1
                    size = size >> _TWICE
                i = after
            return found
    return -1


@wp.func
def find_near_blocks(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    pair: NearPair,
    pose: PairPose,
    way: real,
) -> tuple[int, int]:
    """Blocks with samples no further from the solid than anything moves in a step, into `room.near`.

    Samples that keep facing the solid do not move with their body: then it is all of them.

    Returns:
        Number of blocks, and the one that comes closest, −1 where there is none.
    """
    index = scene.body_index[pair.first]
    solid = solid_of_body(scene, world, pair.second)
    view = view_of(solid, pose, index.turning)
    closest = INFINITY
    lowest = int(-1)
    found = int(0)
    beyond = int(0)
    at = lane * (room.near.shape[1] // _LANES)
    for i in range(lane, index.blocks, _LANES):
        b = index.first_block + i
        listed = True
        if index.turning == 0:
            if wp.static(LANES == 1):
                if i >= beyond and i % _RUN == 0:
                    beyond = far_until(scene, world, solid, view, pose, index, i, way, ONE)
                listed = i >= beyond
            if listed:
                ball = scene.balls[world, b]
                reach = way + ball[3]
                clear = clearance_of_block(scene, world, solid, view, pose, ball, reach)
                listed = clear <= reach
                if clear - ball[3] < closest:
                    closest = clear - ball[3]
                    lowest = b
        if listed:
            room.near[world, at + found] = b
            found += 1
    return found, lowest


@wp.func
def blocks_to_ask(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, pair: NearPair, pose: PairPose, way: real
) -> tuple[int, int]:
    """Blocks whose samples may meet the solid, into `room.near`: those of `room.some` if there are any."""
    if pair.some < 0:
        n, closest = find_near_blocks(scene, room, world, lane, pair, pose, way)
        return n, closest
    lowest = int(-1)
    least = real(INFINITY)
    for i in range(pair.some):
        block = room.some[world, i]
        room.near[world, i] = block
        if room.bound[world, i] < least:
            least = room.bound[world, i]
            lowest = block
    return pair.some, lowest


@wp.func
def bound_of_block(room: wp.ref[Room], world: int, pair: NearPair, i: int, k: int) -> real:
    """Beneath the clearance of samples of the i-th block that is asked when a step begins [m], if known."""
    if k == 0 and pair.some >= 0:
        return room.bound[world, i]
    return -INFINITY
