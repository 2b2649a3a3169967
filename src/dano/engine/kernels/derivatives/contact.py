"""Derivatives of contact: by the states of two bodies that touch, from a virtual work (docs/gradients.md)."""

import warp as wp

from dano.engine.kernels.assembly import presses
from dano.engine.kernels.impacts import apart_at_start, support_before, support_on_way
from dano.engine.kernels.lanes import total, total_of
from dano.engine.kernels.near import as_they_meet, facing, left_out, near_pair, NearPair, solid_of_body
from dano.engine.kernels.search import impact_of
from dano.engine.kernels.tables import FoundPair, Room, SamplePair, Scene
from dano.physics.features import KINDS, LANES, TREES, UNIONS
from dano.physics.friction import friction_near, Slip
from dano.physics.impacts import (
    depth_beside,
    fall_of,
    Impact,
    Patch,
    patch_of_sample,
    Rest,
    rest_of_sample,
    share_left_out,
    support_of,
    supported,
)
from dano.physics.pairs import (
    AXIS,
    BALL,
    BodyState,
    centres_apart,
    falling,
    falling_bar,
    first_touch,
    FIXED,
    pair_pose,
    PairPose,
    shrunk,
)
from dano.physics.point_law import (
    friction_bound,
    Material,
    point_law,
    point_motion,
    slip_at,
    slip_of,
    traction,
)
from dano.physics.real import mat33, ONE, real, vec3, vec6, ZERO
from dano.physics.rotations import direction
from dano.physics.samples import facing_area, point_contact, position_in_solid, Sample, solid_normal
from dano.physics.solids.distances import leaf_distance, nearest_leaf, Solid
from dano.physics.solids.grids import distance_change
from dano.physics.solids.kinds import GRID
from dano.physics.solids.leaves import Distance, Leaf, Solids
from dano.physics.structures import (
    adding_of,
    addition_of,
    after_adjoints,
    need_adjoints,
    product_of,
    scaled_of,
    vjp_of,
)
from dano.physics.twists import joined, relative_twist, wrench_at

PRESSES, MEETS, RESTS = wp.constant(0), wp.constant(1), wp.constant(2)
"""What is asked of samples: the work of those that press; the patch of an impact; what a pair rests on."""

_AXIS, _BALL, _FIXED = map(wp.constant, (AXIS, BALL, FIXED))
_GRID, _LANES = wp.constant(GRID), wp.constant(LANES)


@wp.struct
class Virtual:
    """Twists of the bodies of a pair [W]: at the end of the step, and virtual ones."""

    first: vec6
    second: vec6
    first_virtual: vec6
    second_virtual: vec6


@wp.struct
class Waiting:
    """A pair's part of derivatives by what its bodies wait for: see `BodyState`."""

    met: real
    lead: real
    first_support: vec6
    second_support: vec6


@wp.struct
class MetPair:
    """The bodies of a pair, and when and how they meet."""

    first: BodyState  # The sampled body
    second: BodyState  # The other
    scale: vec3  # Semi-axes of the first [m]
    share: real  # τ
    timestep: real  # h [s]
    toward: vec3  # Direction that samples which turn face [F]
    follows: real  # 1 where points follow the second body
    turning: int  # How samples of the first turn


@wp.struct
class Touching:
    """What the samples of a pair depend on besides themselves and solids."""

    pose: PairPose  # Where geometry is taken
    share: real  # τ
    timestep: real  # h [s]
    numbers: SamplePair
    fall: real  # See `fall_of` [m]
    rests: real  # See `share_left_out`
    material: Material  # With the share of the restitution that counts
    impact: Impact
    turning: int  # How samples turn


@wp.struct
class Asked:
    """By what samples give: derivatives."""

    patch: Patch
    rest: Rest


patch_product, rest_product = product_of(Patch), product_of(Rest)
body_product = product_of(BodyState)
distance_work, impact_work = vjp_of(leaf_distance), vjp_of(impact_of)


@wp.func
def sample_work(
    what: int,
    at: Touching,
    twists: Virtual,
    sample: Sample,
    d: Distance,
    presses_back: bool,
    slip: Slip,
    asked: Asked,
) -> real:
    """Work of a point's impulse along the virtual velocities of its bodies; or ⟨bars, what a sample adds⟩."""
    h = at.timestep
    point = point_contact(at.pose, sample, d, at.turning, presses_back, at.numbers.share, at.share * h)
    if what == PRESSES:
        law = point_law(at.material, point, at.impact, at.numbers.damper)
        apart = at.pose.com_difference
        twist = relative_twist(twists.first, twists.second, apart)
        virtual = relative_twist(twists.first_virtual, twists.second_virtual, apart)
        motion = point_motion(point, twist.velocity, twist.spin)
        found = traction(law, motion.rate, motion.slip + law.extra_slip)
        if slip.is_gradual:
            bound = friction_bound(law, found.pressure)
            found.friction = friction_near(motion.slip + law.extra_slip, bound.value, slip)
        by_pressure = wp.dot(point.normal, virtual.velocity) + wp.dot(point.moment, virtual.spin)
        by_friction = wp.dot(found.friction, virtual.velocity + wp.cross(virtual.spin, point.arm))
        return h * point.area * (found.pressure * by_pressure + by_friction)
    bounce = at.material.bounce
    if what == MEETS:
        depth = at.numbers.impact_depth
        of_patch = patch_of_sample(
            point.area, point.sunk, depth, point.approach, bounce, at.rests, point.arm, point.normal
        )
        return patch_product(asked.patch, of_patch)
    of_rest = rest_of_sample(point.depth, at.fall, point.approach, bounce, point.arm, point.normal)
    return rest_product(asked.rest, of_rest)


@wp.func
def pose_of(at: MetPair, turning: int) -> PairPose:
    """Pose of a pair when geometry is taken, with samples that turn in a way."""
    return pair_pose(at.first, at.second, at.share, at.timestep, at.toward, turning, at.scale, at.follows)


pose_work, apart_work = vjp_of(pose_of), vjp_of(centres_apart)


@wp.func
def critical_work(at: MetPair, sample: vec3, gradient: vec3) -> real:
    """Distance of a sample from a solid when geometry is taken, as it changes with where the sample is."""
    return wp.dot(gradient, position_in_solid(pose_of(at, at.turning), sample))


@wp.func
def facing_work(at: MetPair, start: vec3, d: Distance, by_x: vec3, by_toward: vec3, by_next: vec3) -> real:
    """⟨bars, where a search asks a solid, which way samples face, where the next step of the search starts⟩.

    A step starts where the solid is asked, in axes of the body; `d` is its distance there.
    """
    pose = pose_of(at, _FIXED)
    toward = direction(-(wp.transpose(pose.points) * d.gradient))
    following = shrunk(at.scale, wp.min(at.scale), start + wp.max(d.value, ZERO) * toward)
    work = wp.dot(by_x, position_in_solid(pose, start)) + wp.dot(by_toward, toward)
    return work + wp.dot(by_next, following)


@wp.func
def waiting_work(found: FoundPair, apart: vec3, twists: Virtual, waiting: Waiting) -> real:
    """What an impulse that waits until its bodies meet makes of the equations besides its own work.

    That is the work of what they rest on until then, ⟨bars, their way meanwhile⟩ and ⟨bars, when angular
    momentum is balanced⟩; `apart` is from the second centre of mass to the first when the step begins [m, W].
    """
    virtual = relative_twist(twists.first_virtual, twists.second_virtual, apart)
    carried = relative_twist(waiting.first_support, waiting.second_support, apart)
    work = wp.dot(support_before(found), joined(virtual.velocity, virtual.spin))
    work += wp.dot(support_on_way(found), joined(carried.velocity, carried.spin))
    return work + found.impact.delays * (waiting.met * found.share - waiting.lead)


@wp.func
def support_work(
    at: MetPair,
    rest: Rest,
    numbers: SamplePair,
    material: Material,
    bar: vec6,
    met_bar: MetPair,
    depth_bar: real,
    rests_bar: real,
) -> real:
    """⟨bars, what a pair rests on while it nears an impact, its bodies as they meet, and their depth⟩."""
    h = at.timestep
    impulse = support_of(at.first, at.second, rest, material.friction, h, at.turning)
    back = wrench_at(impulse, at.first.position - at.second.position)
    total = wp.dot(bar, impulse) + depth_bar * depth_beside(rest, numbers.impact_depth)
    total += rests_bar * share_left_out(rest, numbers.factor)
    total += body_product(met_bar.first, supported(at.first, impulse, h))
    return total + body_product(met_bar.second, supported(at.second, -back, h))


@wp.func
def fall_work(at: MetPair, numbers: SamplePair, bar: real) -> real:
    """⟨bar, how far bodies fall in a step⟩."""
    return bar * fall_of(at.first, at.second, numbers.impact_depth, at.timestep)


for _function in (
    sample_work, distance_work, pose_work, apart_work, critical_work, facing_work, impact_work, waiting_work,
    support_work, fall_work,
):  # fmt: skip
    need_adjoints(_function)


add_to_met, total_met = adding_of(MetPair), total_of(MetPair)
scaled_met, add_to_state = scaled_of(MetPair), adding_of(BodyState)
add_to_touching, total_touching = adding_of(Touching), total_of(Touching)
add_to_twists, total_twists = adding_of(Virtual), total_of(Virtual)
add_to_leaf, add_to_material, add_to_pair = map(addition_of, (Leaf, Material, SamplePair))
add_material = adding_of(Material)
distance_product, scaled_distance, add_to_distance = (f(Distance) for f in (product_of, scaled_of, adding_of))


@wp.func
def leaf_at(scene: wp.ref[Scene], world: int, body: int, x: vec3) -> Solid:
    """The leaf of a body's solid that counts at a point."""
    solid = solid_of_body(scene, world, body)
    if wp.static(UNIONS):
        solid = nearest_leaf(scene.solids, world, solid, x)
    return solid


@wp.func
def add_part(room: wp.ref[Room], world: int, lane: int, direction: int, change: real):
    """Add to a lane's part of what changes in a direction make of a number."""
    at = direction * _LANES + lane
    room.lane_sums[world, at] = room.lane_sums[world, at] + change


@wp.func
def n_moving(scene: wp.ref[Scene], room: wp.ref[Room]) -> int:
    """In how many directions coefficients of sampled solids change."""
    return wp.where(scene.solids.changes.shape[1] == 0, 0, room.lane_sums.shape[1] // _LANES)


@wp.func
def pull_distance(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, solid: Solid, x: vec3, bar: Distance
) -> vec3:
    """Derivative by a point from one by the distance of a leaf there; adds those by the leaf."""
    _a, _b, _c, by_leaf, by_x, _d = wp.grad(distance_work)(
        scene.solids, world, solid.kind, solid.leaf, x, bar
    )
    add_to_leaf(room.bars.leaves, world, solid.first, by_leaf)
    if wp.static(GRID in KINDS):
        if solid.kind.kind == _GRID:
            for k in range(n_moving(scene, room)):
                moved = distance_change(scene.solids, world, solid.kind, solid.leaf, x, k)
                add_part(room, world, lane, k, distance_product(bar, moved))
    return by_x


@wp.func
def pull_samples(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    what: int,
    found: FoundPair,
    at: Touching,
    twists: Virtual,
    asked: Asked,
) -> tuple[Touching, Virtual]:
    """Derivatives by what the samples of a pair depend on, of all lanes; adds those by samples and solids.

    Those by twists are only there with bodies on joints. `what` is asked of samples, see `PRESSES`.
    """
    second = scene.pair_index[found.pair].second
    bar = Touching()
    twists_bar = Virtual()
    twist = relative_twist(twists.first, twists.second, at.pose.com_difference)
    for k in range(found.first, found.end):
        where = room.where[world, k]
        counts = where.presses_back == 0
        if what == PRESSES:
            counts = presses(room, world, k)
        elif what == MEETS:
            counts = counts and room.points[world, k].sunk > -at.numbers.impact_depth
        if counts:
            sample = scene.samples[world, where.sample]
            x = position_in_solid(at.pose, sample.point)
            solid = leaf_at(scene, world, second, x)
            d = leaf_distance(scene.solids, world, solid.kind, solid.leaf, x)
            slip = Slip()
            if what == PRESSES:
                law = room.laws[world, k]
                motion = slip_of(law, point_motion(room.points[world, k], twist.velocity, twist.spin))
                slip = slip_at(law, motion.slip, room.linear[world, k].grip)
            if what == RESTS:
                counts = d.value < at.fall and facing_area(at.pose, sample, solid_normal(d.gradient)) > ZERO
            if counts:
                _a, by, by_twists, by_sample, by_distance, _b, _c, _d = wp.grad(sample_work)(
                    what, at, twists, sample, d, where.presses_back > 0, slip, asked
                )
                by_x = pull_distance(scene, room, world, lane, solid, x, by_distance)
                # x = points · sample + origin
                by.pose.points = by.pose.points + wp.outer(by_x, sample.point)
                by.pose.origin = by.pose.origin + by_x
                add_to_touching(bar, by)
                if wp.static(TREES):
                    add_to_twists(twists_bar, by_twists)
                if room.bars.samples.shape[1] > 0:
                    by_point = by_sample.point + wp.transpose(at.pose.points) * by_x
                    room.bars.samples[world, where.sample].point += by_point
                    room.bars.samples[world, where.sample].area += by_sample.area
    if wp.static(TREES):
        twists_bar = total_twists(twists_bar)
    return total_touching(bar), twists_bar


@wp.func_native("solids.coefficients.grad = nullptr;")
def drop_gradients(solids: wp.ref[Solids]):
    """Have Warp add no derivatives by the coefficients of a copy of solids."""


@wp.func
def pull_search(
    solids: Solids, world: int, solid: Solid, at: MetPair, start: vec3, by_toward: vec3, by_next: vec3
) -> tuple[MetPair, vec3, Distance]:
    """Derivatives by a pair, by where a step of the search starts, and by the distance there."""
    # Those by coefficients follow from the sum of all parts: Warp would add them at each call.
    drop_gradients(solids)
    x = position_in_solid(pose_of(at, _FIXED), start)
    d = leaf_distance(solids, world, solid.kind, solid.leaf, x)
    _a, _b, by_d, _c, _d, _e = wp.grad(facing_work)(at, start, d, vec3(), by_toward, by_next)
    _f, _g, _h, _i, by_x, _j = wp.grad(distance_work)(solids, world, solid.kind, solid.leaf, x, by_d)
    by, by_start, _k, _l, _m, _n = wp.grad(facing_work)(at, start, d, by_x, by_toward, by_next)
    return by, by_start, by_d


@after_adjoints
@wp.func
def pull_facing(
    solids: Solids, world: int, solid: Solid, at: MetPair, start: vec3, bar: MetPair
) -> tuple[MetPair, Distance]:
    """Derivatives by a pair, with those through the direction that samples face; by the distance it is of.

    A ball or an ellipsoid faces where the search for its first touch ended: a fixed point x = G(x) of the
    search, differentiated by the implicit function theorem, (1 − ∂G/∂x)⁻ᵀ x̄.
    """
    if at.turning == _FIXED:
        return bar, Distance()
    by_next = vec3()
    if at.turning == _BALL:
        _a, by_end, _b = pull_search(solids, world, solid, at, start, bar.toward, by_next)
        rows = mat33()
        k = int(0)
        while k < 3:
            unit = vec3()
            unit[k] = ONE
            _c, by_start, _d = pull_search(solids, world, solid, at, start, vec3(), unit)
            rows[k] = unit - by_start
            k += 1
        by_next = wp.inverse(wp.transpose(rows)) * by_end
    faces, _e, by_distance = pull_search(solids, world, solid, at, start, bar.toward, by_next)
    add_to_met(faces, bar)
    return faces, by_distance


@wp.func
def pull_pose(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    critical: int,
    second: int,
    at: MetPair,
    by: Touching,
) -> tuple[MetPair, real]:
    """Derivatives by a pair's bodies, and by the depth at which they meet, from those by its pose, τ and h.

    One lane alone comes here. `critical` is the sample that says when they meet, −1 for none.
    """
    of_pose, _a, _b = wp.grad(pose_work)(at, at.turning, by.pose)
    of_pose.share += by.share
    of_pose.timestep += by.timestep
    pose = pose_of(at, _FIXED)
    end = vec3()
    if at.turning == _BALL:
        whole = solid_of_body(scene, world, second)
        end = first_touch(scene.solids, world, whole, pose.points, pose.origin, at.scale)
    start = shrunk(at.scale, wp.min(at.scale), end)
    place = position_in_solid(pose, start)
    seen = leaf_at(scene, world, second, place)
    bar, by_seen = pull_facing(scene.solids, world, seen, at, start, of_pose)
    depth_bar = real(0.0)
    if critical >= 0:
        # τ is the root of distance + depth = 0 at the critical sample.
        point = scene.samples[world, critical].point
        x = position_in_solid(pose_of(at, at.turning), point)
        solid = leaf_at(scene, world, second, x)
        d = leaf_distance(scene.solids, world, solid.kind, solid.leaf, x)
        of_body, of_sample, _c = wp.grad(critical_work)(at, point, d.gradient)
        of, of_seen = pull_facing(scene.solids, world, seen, at, start, of_body)
        if of.share < ZERO:
            depth_bar = -bar.share / of.share
            add_to_met(bar, scaled_met(depth_bar, of))
            add_to_distance(by_seen, scaled_distance(depth_bar, of_seen))
            of_distance = Distance()
            of_distance.value = depth_bar
            _d = pull_distance(scene, room, world, lane, solid, x, of_distance)
            if room.bars.samples.shape[1] > 0:
                room.bars.samples[world, critical].point += depth_bar * of_sample
    if at.turning != _FIXED:
        _e = pull_distance(scene, room, world, lane, seen, place, by_seen)
    return bar, depth_bar


@wp.func
def met_pair(
    scene: wp.ref[Scene], world: int, near: NearPair, a: BodyState, b: BodyState, share: real, toward: vec3
) -> MetPair:
    """Bodies of a pair after a share of the step."""
    at = MetPair()
    at.first = a
    at.second = b
    at.scale = scene.bodies[world, near.first].scale
    at.share = share
    at.timestep = near.h
    at.toward = toward
    at.follows = near.numbers.follows
    at.turning = near.turning
    return at


@wp.func
def touching_of(scene: wp.ref[Scene], world: int, found: FoundPair, near: NearPair, at: MetPair) -> Touching:
    """What the samples of a pair depend on, with all of the restitution."""
    samples = Touching()
    samples.pose = pose_of(at, at.turning)
    samples.numbers = near.numbers
    samples.share = at.share
    samples.timestep = at.timestep
    samples.material = scene.materials[world, near.contact]
    samples.turning = at.turning
    samples.pose.com_difference = found.com_difference
    samples.rests = left_out(found, near.numbers.factor)
    samples.impact = found.impact
    return samples


@after_adjoints
@wp.func
def pull_support(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    found: FoundPair,
    support_bar: vec6,
    rests_bar: real,
    depth_bar: real,
    bar: MetPair,
) -> MetPair:
    """Derivatives by bodies that fall, from those by bodies as they meet that something supports until then.

    The others are those by what supports them, by `left_out` and by the depth at which they meet.
    """
    near = near_pair(scene, world, found.pair)
    a = falling(room.bodies[world, near.first], found.falls)
    b = falling(room.bodies[world, near.second], found.falls)
    at = met_pair(scene, world, near, a, b, ZERO, facing(scene, world, near, a, b, ZERO))
    samples = touching_of(scene, world, found, near, at)
    samples.fall = fall_of(a, b, near.numbers.impact_depth, near.h)
    asked = Asked()
    whole, by_rest, by_numbers, by_material, _a, _b, _c, _d = wp.grad(support_work)(
        at,
        found.rest,
        near.numbers,
        samples.material,
        support_bar,
        total_met(bar),
        total(depth_bar),
        rests_bar,
    )
    asked.rest = by_rest
    by, _e = pull_samples(scene, room, world, lane, RESTS, found, samples, Virtual(), asked)
    if lane == 0:
        begins, _f = pull_pose(scene, room, world, lane, -1, near.second, at, by)
        falls, of_depth, _g = wp.grad(fall_work)(at, near.numbers, by.fall)
        add_to_met(whole, begins)
        add_to_met(whole, falls)
        whole.scale += bar.scale
        whole.timestep += bar.timestep
        row = scene.pair_index[found.pair].row
        add_to_pair(room.bars.pairs, world, row, by_numbers)
        add_to_pair(room.bars.pairs, world, row, of_depth)
        add_to_material(room.bars.materials, world, near.contact, by_material)
        add_to_material(room.bars.materials, world, near.contact, by.material)
    return whole


@after_adjoints
@wp.func
def pull_waiting(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    found: FoundPair,
    twists: Virtual,
    waiting: Waiting,
    takes: real,
    bar: wp.ref[MetPair],
) -> FoundPair:
    """Derivatives by when and how a pair meets whose impulses wait; adds those by its bodies.

    `bar` has those by when impulses on its bodies take effect, of its own, of which it `takes` this share.
    """
    own = waiting
    own.met += takes * (bar.first.met + bar.second.met)
    apart = apart_at_start(scene, room, world, found)
    by_found, by_apart, _a, _b = wp.grad(waiting_work)(found, apart, twists, own)
    bar.first.position += by_apart
    bar.second.position -= by_apart
    return by_found


@after_adjoints
@wp.func
def pull_pair(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    found: FoundPair,
    rebound: real,
    twists: Virtual,
    waiting: Waiting,
    takes: real,
) -> tuple[MetPair, Virtual]:
    """Derivatives by a pair's bodies, for the first lane, and by twists; adds those by all else.

    `rebound` is the share of the restitution that counts; for `takes` see `pull_waiting`.
    """
    near = near_pair(scene, world, found.pair)
    a, b = as_they_meet(room.bodies[world, near.first], room.bodies[world, near.second], found, near.h)
    at = met_pair(scene, world, near, a, b, found.share, found.toward)
    samples = touching_of(scene, world, found, near, at)
    restores = wp.where(samples.material.instant > ZERO, rebound, ONE)
    samples.material.restitution = restores * samples.material.restitution
    asked = Asked()
    by, by_twists = pull_samples(scene, room, world, lane, PRESSES, found, samples, twists, asked)
    by.material.restitution = restores * by.material.restitution
    by.rests = by.impact.rests
    by.impact.rests = ZERO
    bar = MetPair()
    by_a, by_b, by_h, _a = wp.grad(apart_work)(a, b, near.h, by.pose.com_difference)
    bar.first = by_a
    bar.second = by_b
    bar.timestep = by_h
    support_bar = vec6()
    if found.impact.share > ZERO:
        if wp.static(not TREES):
            if found.impact.stiffness > ZERO:
                by_met = pull_waiting(scene, room, world, found, twists, waiting, takes, bar)
                by.impact.delays += by_met.impact.delays
                by.share += by_met.share
                support_bar = by_met.support
        by_first, by_second, by_material, by_found, by_near, _b = wp.grad(impact_work)(
            a, b, samples.material, found, near, by.impact
        )
        asked.patch = by_found.patch
        of_patch, _d = pull_samples(scene, room, world, lane, MEETS, found, samples, twists, asked)
        add_to_touching(by, of_patch)
        # What follows from when they meet is left to where that is.
        by.share += by_found.share
        add_to_state(bar.first, by_first)
        add_to_state(bar.second, by_second)
        bar.timestep += by_near.h
        by.numbers.factor += by_near.numbers.factor
        add_material(by.material, by_material)
    depth_bar = real(0.0)
    if lane == 0:
        of_pose, depth_bar = pull_pose(scene, room, world, lane, found.critical, near.second, at, by)
        add_to_met(bar, of_pose)
        add_to_material(room.bars.materials, world, near.contact, by.material)
        by.numbers.impact_depth += by.impact.depth
        by.numbers.deepest += by.impact.deepest
        by.numbers.factor += by.impact.factor
        # How deep they meet: beside what they rest on `pull_support` says it.
        if wp.length_sq(found.support) == ZERO:
            if found.hits > 0 or near.numbers.impact_depth > near.numbers.sink:
                by.numbers.impact_depth += depth_bar
            else:
                by.numbers.sink += depth_bar
        add_to_pair(room.bars.pairs, world, scene.pair_index[found.pair].row, by.numbers)
    else:
        bar = MetPair()
    if wp.static(not TREES):
        if wp.length_sq(found.support) > ZERO:
            bar = pull_support(scene, room, world, lane, found, support_bar, by.rests, depth_bar, bar)
    bar.first = falling_bar(bar.first, found.falls)
    bar.second = falling_bar(bar.second, found.falls)
    return bar, by_twists
