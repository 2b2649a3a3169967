"""What a step's equations depend on, as numbers whose gradients are derivatives (docs/gradients.md).

At the root of R(V; θ) = 0 the implicit function theorem gives θ̄ = −(∂R/∂θ)ᵀ λ with (∂R/∂V)ᵀ λ = V̄. So
with λ as *virtual velocities* of the bodies, −λ · R is the work of impulses along them: a sum over bodies
and points. Each term is one of the functions below, made of the formulas of the step itself, and
`wp.grad` differentiates it.

What a function reads of an array whose `grad` points somewhere, Warp adds the derivative to by itself: by
`Room.given` to `Room.bars`, by `Room.bodies` to `Room.body_bars`. That is for what few lanes do; what many
samples depend on is a structure by value, whose derivatives are summed before they are added.
"""

import warp as wp

from dano.engine.kernels.impacts import end_of_step, support_before, support_on_way
from dano.engine.kernels.tables import Body, FoundPair, Given, StateRow
from dano.physics.features import TREES
from dano.physics.friction import friction_near, Slip
from dano.physics.impacts import (
    delayed,
    depth_beside,
    fall_of,
    Impact,
    no_impact,
    Patch,
    patch_of_sample,
    Rest,
    rest_of_sample,
    share_left_out,
    share_of_impact,
    stiffness_of_impact,
    support_of,
    supported,
    turning_after,
)
from dano.physics.momentum import angular_momentum, gyroscopic_gain, turned_inertia
from dano.physics.pairs import (
    BodyState,
    centres_apart,
    closer,
    pair_pose,
    PairPose,
    position_after,
    rotation_after,
    rotation_met,
    seen_from,
    shrunk,
)
from dano.physics.point_law import friction_bound, Material, point_law, point_motion, traction
from dano.physics.real import HALF, mat33, ONE, real, vec3, vec6, ZERO
from dano.physics.rotations import from_wxyz, matrix, turned
from dano.physics.samples import point_contact, position_in_solid, Sample
from dano.physics.solids.distances import leaf_distance, Solid
from dano.physics.solids.leaves import Distance, Solids
from dano.physics.structures import need_adjoints, product_of, vjp_of
from dano.physics.twists import angular_part, joined, linear_part, relative_twist, wrench_at

PRESSES, MEETS, RESTS = 0, 1, 2
"""What is asked of samples: the work of those that press; the patch of an impact; what a pair rests on."""

_PRESSES, _MEETS = wp.constant(PRESSES), wp.constant(MEETS)


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


@wp.struct
class Touching:
    """What the samples of a pair depend on besides themselves and solids."""

    pose: PairPose  # Where geometry is taken
    share: real  # τ
    timestep: real  # h [s]
    stiffness_share: real  # Share of the contact's stiffness that the pair carries [1]
    depth: real  # δ [m]
    fall: real  # See `fall_of` [m]
    rests: real  # See `share_left_out`
    material: Material  # With the share of the restitution that counts
    impact: Impact


@wp.struct
class Asked:
    """By what samples give: derivatives."""

    patch: Patch
    rest: Rest


patch_product, rest_product = product_of(Patch), product_of(Rest)
impact_product, body_product = product_of(Impact), product_of(BodyState)
row_product = product_of(StateRow)
distance_work = vjp_of(leaf_distance)


@wp.func
def sample_work(
    what: int,
    at: Touching,
    twists: Virtual,
    sample: Sample,
    d: Distance,
    turning: int,
    presses_back: bool,
    slip: Slip,
    asked: Asked,
) -> real:
    """Work of a point's impulse along the virtual velocities of its bodies; or ⟨bars, what a sample adds⟩."""
    h = at.timestep
    if what == _PRESSES:
        point = point_contact(at.pose, sample, d, turning, presses_back, at.stiffness_share, at.share * h)
        law = point_law(at.material, point, at.impact)
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
    if what == _MEETS:
        met = point_contact(at.pose, sample, d, turning, False, at.stiffness_share, at.share * h)
        of_patch = patch_of_sample(
            met.area, met.sunk, at.depth, met.approach, bounce, at.rests, met.arm, met.normal
        )
        return patch_product(asked.patch, of_patch)
    still = point_contact(at.pose, sample, d, turning, False, ONE, ZERO)
    of_rest = rest_of_sample(still.depth, at.fall, still.approach, bounce, still.arm, still.normal)
    return rest_product(asked.rest, of_rest)


@wp.func
def pose_of(at: MetPair, turning: int, follows: real) -> PairPose:
    """Pose of a pair when geometry is taken."""
    return pair_pose(at.first, at.second, at.share, at.timestep, at.toward, turning, at.scale, follows)


pose_work = vjp_of(pose_of)


@wp.func
def apart_of(at: MetPair) -> vec3:
    """Way between the centres of mass, each where impulses on it take effect [m, W]."""
    return centres_apart(at.first, at.second, at.timestep)


apart_work = vjp_of(apart_of)


@wp.func
def critical_work(at: MetPair, turning: int, sample: vec3, gradient: vec3) -> real:
    """Distance of a sample from a solid when geometry is taken, as it changes with where the sample is."""
    return wp.dot(gradient, position_in_solid(pose_of(at, turning, ZERO), sample))


@wp.func
def facing_work(
    solids: Solids,
    world: int,
    solid: Solid,
    at: MetPair,
    turning: int,
    point: vec3,
    by_toward: vec3,
    bar: vec3,
) -> real:
    """⟨bars, direction that samples face, and where one step of the search for it leads from a point⟩."""
    origin, turn = origin_in_solid(at)
    if turning == 1:
        return wp.dot(by_toward, seen_from(solids, world, solid, turn, origin).gradient)
    found = closer(solids, world, solid, turn, origin, at.scale, point)
    least = wp.min(at.scale[0], wp.min(at.scale[1], at.scale[2]))
    touched = shrunk(at.scale, least, point) + wp.max(found.value, ZERO) * found.gradient
    return wp.dot(by_toward, found.gradient) + wp.dot(bar, touched)


@wp.func
def origin_in_solid(at: MetPair) -> tuple[vec3, mat33]:
    """Origin of the first body's frame [m], and its turn, as the second body's solid sees them."""
    inverse = wp.transpose(rotation_after(at.second, at.share))
    turn = inverse * rotation_after(at.first, at.share)
    h = at.timestep
    apart = position_after(at.first, at.share, h) - position_after(at.second, at.share, h)
    return inverse * apart + at.second.com - turn * at.first.com, turn


@wp.func
def gain_of_row(body: Body, row: StateRow, h: real) -> vec3:
    """`BodyState.spin_gain` of a body's row at the start of a step [rad/s, B]."""
    return gyroscopic_gain(row.omega, body.inertia, wp.inverse(body.inertia), h)


@wp.func
def momentum_gained(
    given: Given, world: int, i: int, row: StateRow, balanced: mat33, lead: real, velocity: vec6
) -> vec6:
    """What a body's momentum gains in a step beyond gravity and control, times −1 [kg m/s; kg m²/s, W].

    `balanced` is the rotation of the body when its angular momentum is balanced.
    """
    body = given.bodies[world, i]
    push = given.pushes[world, i]
    h = given.timestep[world, 0]
    rotation = matrix(from_wxyz(row.orientation))
    comes = row.velocity + h * given.gravity[world, 0]
    linear = body.mass * (comes - linear_part(velocity)) + h * push.force
    before = angular_momentum(rotation * row.omega, turned_inertia(rotation, body.inertia), h, -ONE)
    after = angular_momentum(angular_part(velocity), turned_inertia(balanced, body.inertia), h, lead)
    return joined(linear, before + h * push.torque - after)


@wp.func
def momentum_work(given: Given, world: int, i: int, velocity: vec6, virtual: vec6) -> real:
    """Work of what a body's momentum gains beyond gravity and control, along minus its virtual velocity."""
    state = given.seen[world, i]
    row = given.state[world, i]
    balanced = matrix(from_wxyz(row.orientation))
    if state.met != ZERO:
        balanced = rotation_met(state)
    return wp.dot(momentum_gained(given, world, i, row, balanced, state.lead, velocity), virtual)


@wp.func
def state_work(given: Given, world: int, i: int, moves: bool, bar: BodyState) -> real:
    """⟨bar, what contact sees of a body at the start of a step⟩; quaternions as (x, y, z, w)."""
    body = given.bodies[world, i]
    row = given.state[world, i]
    h = given.timestep[world, 0]
    q = from_wxyz(row.orientation)
    total = wp.dot(bar.position, row.position) + wp.dot(bar.orientation, q) + wp.dot(bar.com, body.com)
    ahead = q
    ahead_falling = q
    if moves:
        ahead = turned(q, row.omega, h)
        total += wp.dot(bar.velocity, row.velocity) + wp.dot(bar.spin, matrix(q) * row.omega)
        if wp.static(not TREES):
            inertia = turned_inertia(matrix(q), body.inertia)
            gain = gain_of_row(body, row, h)
            ahead_falling = turned(q, row.omega + gain, h)
            total += h * wp.dot(bar.gain + bar.falls, given.gravity[world, 0]) + wp.dot(
                bar.spin_gain + (HALF * h) * bar.lag, matrix(q) * gain
            )
            total += bar.inverse_mass / body.mass + wp.ddot(bar.inverse_inertia, wp.inverse(inertia))
            push = given.pushes[world, i]
            total += h * wp.dot(bar.support, joined(push.force, push.torque))
    return total + wp.dot(bar.ahead, ahead) + wp.dot(bar.ahead_falling, ahead_falling)


@wp.func
def advance_work(given: Given, world: int, i: int, velocity: vec6, bar: StateRow) -> real:
    """⟨bar, state of a body at the end of a step⟩."""
    end = end_of_step(
        given.state[world, i],
        given.seen[world, i],
        given.bodies[world, i].inertia,
        velocity,
        given.timestep[world, 0],
    )
    return row_product(bar, end)


@wp.func
def impact_work(
    at: MetPair,
    patch: Patch,
    material: Material,
    factor: real,
    turning: int,
    hits: bool,
    alone: bool,
    waits: bool,
    bar: Impact,
) -> real:
    """⟨bar, impact of a pair⟩, without what it is given as it is.

    `factor` is F; `hits` says whether bodies are deep enough, `alone` whether one is fixed and the other
    moves freely, `waits` whether impulses take effect when they meet.
    """
    h = at.timestep
    impact = no_impact(ZERO, ZERO, ZERO, h)
    impact.share = share_of_impact(patch, material.bounce)
    if hits:
        impact.stiffness = stiffness_of_impact(at.first, at.second, patch, material.bounce, factor, h)
        impact = delayed(impact, wp.where(waits, impact.share, ZERO), at.share, h)
        if alone:
            impact.turns = turning_after(at.first, at.second, patch, material.friction, at.share, turning)
    return impact_product(bar, impact)


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
    depth: real,
    material: Material,
    factor: real,
    turning: int,
    bar: vec6,
    met_bar: MetPair,
    depth_bar: real,
    rests_bar: real,
) -> real:
    """⟨bars, what a pair rests on while it nears an impact, its bodies as they meet, and their depth⟩."""
    h = at.timestep
    impulse = support_of(at.first, at.second, rest, material.friction, h, turning)
    back = wrench_at(impulse, at.first.position - at.second.position)
    total = wp.dot(bar, impulse) + depth_bar * depth_beside(rest, depth)
    total += rests_bar * share_left_out(rest, factor)
    total += body_product(met_bar.first, supported(at.first, impulse, h))
    return total + body_product(met_bar.second, supported(at.second, -back, h))


@wp.func
def fall_work(at: MetPair, depth: real, bar: real) -> real:
    """⟨bar, how far bodies fall in a step⟩."""
    return bar * fall_of(at.first, at.second, depth, at.timestep)


for _function in (
    sample_work, distance_work, pose_work, apart_work, critical_work, facing_work, momentum_work, state_work,
    advance_work, impact_work, waiting_work, support_work, fall_work,
):  # fmt: skip
    need_adjoints(_function)
