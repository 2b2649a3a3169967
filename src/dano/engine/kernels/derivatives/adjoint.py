"""What a step's equations depend on, as numbers whose gradients are derivatives (docs/gradients.md).

At the root of R(V; θ) = 0 the implicit function theorem gives θ̄ = −(∂R/∂θ)ᵀ λ with (∂R/∂V)ᵀ λ = V̄. So
with λ as *virtual velocities* of the bodies, −λ · R is the work of impulses along them: a sum over bodies
and points. Each term is one of the functions below, made of the formulas of the step itself, and
`wp.grad` differentiates it.
"""

from types import CodeType
from typing import Any

import warp as wp

from dano.engine.kernels.tables import Body, Moment, Push, StateRow
from dano.physics.features import TREES
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
    share_of_impact,
    stiffness_of_impact,
    support_of,
    supported,
    turning_after,
)
from dano.physics.momentum import angular_momentum, end_of_impact, gyroscopic_gain, turned_inertia
from dano.physics.pairs import (
    BodyState,
    centres_apart,
    closer,
    pair_pose,
    PairPose,
    position_after,
    rotation_after,
    seen_from,
    shrunk,
)
from dano.physics.point_law import friction_bound, Material, point_law, point_motion, traction
from dano.physics.real import HALF, mat33, ONE, real, vec3, vec6, ZERO
from dano.physics.rotations import from_wxyz, interpolated, matrix, to_wxyz, turned
from dano.physics.samples import point_contact, position_in_solid, Sample
from dano.physics.solids.distances import leaf_distance, Solid
from dano.physics.solids.leaves import Distance, Solids
from dano.physics.structures import product_of
from dano.physics.twists import angular_part, joined, linear_part, relative_twist, wrench_at


@wp.struct
class Virtual:
    """Twists of the bodies of a pair [W]: at the end of the step, and virtual ones.

    The last two are those of impulses that take effect after the share τ of the step: τ times them is taken
    off.
    """

    first: vec6
    second: vec6
    first_virtual: vec6
    second_virtual: vec6
    first_late: vec6
    second_late: vec6


@wp.func
def point_work(
    pose: PairPose,
    sample: Sample,
    d: Distance,
    turning: int,
    presses_back: bool,
    stiffness_share: real,
    share: real,
    h: real,
    material: Material,
    rebound: real,
    impact: Impact,
    twists: Virtual,
    at: Slip,
) -> real:
    """Work of a point's impulse along the virtual velocities of its bodies."""
    point = point_contact(pose, sample, d, turning, presses_back, stiffness_share, share * h)
    if material.instant > ZERO:
        material.restitution = rebound * material.restitution
    law = point_law(material, point, impact)
    twist = relative_twist(twists.first, twists.second, pose.com_difference)
    virtual = relative_twist(twists.first_virtual, twists.second_virtual, pose.com_difference)
    late = relative_twist(twists.first_late, twists.second_late, pose.com_difference)
    along = virtual.velocity - (impact.delays * share) * late.velocity
    turn = virtual.spin - (impact.delays * share) * late.spin
    motion = point_motion(point, twist.velocity, twist.spin)
    found = traction(law, motion.rate, motion.slip + law.extra_slip)
    if at.is_gradual:
        bound = friction_bound(law, found.pressure)
        found.friction = friction_near(motion.slip + law.extra_slip, bound.value, at)
    by_pressure = wp.dot(point.normal, along) + wp.dot(point.moment, turn)
    by_friction = wp.dot(found.friction, along + wp.cross(turn, point.arm))
    return h * point.area * (found.pressure * by_pressure + by_friction)


@wp.func
def distance_work(solids: Solids, world: int, solid: Solid, x: vec3, bar: Distance) -> real:
    """⟨bar, distance and gradient of a leaf at x⟩."""
    d = leaf_distance(solids, world, solid.kind, solid.leaf, x)
    return bar.value * d.value + wp.dot(bar.gradient, d.gradient)


@wp.func
def sample_distance(
    solids: Solids,
    world: int,
    solid: Solid,
    first: BodyState,
    second: BodyState,
    share: real,
    h: real,
    toward: vec3,
    turning: int,
    scale: vec3,
    sample: vec3,
) -> real:
    """Distance of a sample from a leaf after a share of the step: −sink at the moment when bodies meet."""
    pose = pair_pose(first, second, share, h, toward, turning, scale, ZERO)
    return leaf_distance(solids, world, solid.kind, solid.leaf, position_in_solid(pose, sample)).value


pose_product = product_of(PairPose)


@wp.func
def pair_work(
    first: BodyState,
    second: BodyState,
    share: real,
    h: real,
    toward: vec3,
    turning: int,
    scale: vec3,
    follows: real,
    bar: PairPose,
) -> real:
    """⟨bar, pose of a pair⟩."""
    return pose_product(bar, pair_pose(first, second, share, h, toward, turning, scale, follows))


@wp.func
def apart_work(
    first: BodyState, second: BodyState, first_until: real, second_until: real, h: real, bar: vec3
) -> real:
    """⟨bar, way between the centres of mass of a pair when impulses take effect⟩."""
    return wp.dot(bar, centres_apart(first, second, first_until, second_until, h))


@wp.func
def facing_work(
    solids: Solids,
    world: int,
    solid: Solid,
    first: BodyState,
    second: BodyState,
    share: real,
    h: real,
    turning: int,
    scale: vec3,
    point: vec3,
    toward_bar: vec3,
    touched_bar: vec3,
) -> real:
    """⟨bars, direction that samples face, and where one step of the search for it leads from a point⟩."""
    inverse = wp.transpose(rotation_after(second, share))
    turn = inverse * rotation_after(first, share)
    com = inverse * (position_after(first, share, h) - position_after(second, share, h)) + second.com
    origin = com - turn * first.com
    if turning == 1:
        return wp.dot(toward_bar, seen_from(solids, world, solid, turn, origin).gradient)
    found = closer(solids, world, solid, turn, origin, scale, point)
    least = wp.min(scale[0], wp.min(scale[1], scale[2]))
    touched = shrunk(scale, least, point) + wp.max(found.value, ZERO) * found.gradient
    return wp.dot(toward_bar, found.gradient) + wp.dot(touched_bar, touched)


@wp.func
def gain_of_row(body: Body, row: StateRow, h: real) -> vec3:
    """`BodyState.spin_gain` of a body's row at the start of a step [rad/s, B]."""
    return gyroscopic_gain(row.omega, body.inertia, wp.inverse(body.inertia), h)


@wp.func
def rotation_of(body: Body, row: StateRow, met: real, h: real) -> mat33:
    """`rotation_met` of a body's row at the start of a step."""
    q = from_wxyz(row.orientation)
    if met != ZERO:
        return matrix(interpolated(q, turned(q, row.omega + gain_of_row(body, row, h), h), met))
    return matrix(q)


@wp.func
def momentum_work(
    body: Body, row: StateRow, push: Push, gravity: vec3, h: real, at: Moment, velocity: vec6, virtual: vec6
) -> real:
    """Work of what a body's momentum gains beyond gravity and control, along minus its virtual velocity."""
    rotation = matrix(from_wxyz(row.orientation))
    linear = body.mass * (row.velocity + h * gravity - linear_part(velocity)) + h * push.force
    inertia = turned_inertia(rotation, body.inertia)
    before = angular_momentum(rotation * row.omega, inertia, h, -ONE) + h * push.torque
    inertia_met = turned_inertia(rotation_of(body, row, at.met, h), body.inertia)
    after = angular_momentum(angular_part(velocity), inertia_met, h, at.lead)
    return wp.dot(joined(linear, before - after), virtual)


@wp.func
def state_work(body: Body, row: StateRow, gravity: vec3, h: real, moves: bool, bar: BodyState) -> real:
    """⟨bar, what contact sees of a body at the start of a step⟩; quaternions as (x, y, z, w)."""
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
            total += h * wp.dot(bar.gain + bar.falls, gravity) + wp.dot(
                bar.spin_gain + (HALF * h) * bar.lag, matrix(q) * gain
            )
            total += bar.inverse_mass / body.mass + wp.ddot(bar.inverse_inertia, wp.inverse(inertia))
    return total + wp.dot(bar.ahead, ahead) + wp.dot(bar.ahead_falling, ahead_falling)


@wp.func
def advance_work(
    body: Body, row: StateRow, velocity: vec6, moved: vec6, h: real, at: Moment, bar: StateRow
) -> real:
    """⟨bar, state of a body at the end of a step⟩; `moved` is the twist by which its pose changes."""
    q = from_wxyz(row.orientation)
    v = linear_part(velocity)
    back = wp.transpose(matrix(q))
    turn = angular_part(moved)
    omega = back * angular_part(velocity)
    if at.lead < ONE:
        gain = matrix(q) * gain_of_row(body, row, h)
        met = rotation_of(body, row, at.met, h)
        end = end_of_impact(angular_part(velocity), body.inertia, met, gain, h, at.met, at.lead)
        omega = end.omega
        turn = turn + end.turn
    return (
        wp.dot(bar.position, row.position + h * linear_part(moved))
        + wp.dot(bar.orientation, to_wxyz(turned(q, back * turn, h)))
        + wp.dot(bar.velocity, v)
        + wp.dot(bar.omega, omega)
    )


@wp.func
def impact_patch_work(
    pose: PairPose,
    sample: Sample,
    d: Distance,
    turning: int,
    stiffness_share: real,
    share: real,
    h: real,
    depth: real,
    bounce: real,
    rests: real,
    bar: Patch,
) -> real:
    """⟨bar, what a sample adds to the patch of an impact⟩."""
    point = point_contact(pose, sample, d, turning, False, stiffness_share, share * h)
    own = patch_of_sample(
        point.area, point.sunk, depth, point.approach, bounce, rests, point.arm, point.normal
    )
    return (
        bar.load * own.load
        + wp.dot(bar.arm, own.arm)
        + wp.dot(bar.normal, own.normal)
        + bar.near_load * own.near_load
        + bar.near_rate * own.near_rate
    )


@wp.func
def impact_work(
    first: BodyState,
    second: BodyState,
    patch: Patch,
    bounce: real,
    factor: real,
    friction: real,
    share: real,
    h: real,
    turning: int,
    hits: bool,
    alone: bool,
    bar: Impact,
) -> real:
    """⟨bar, share and stiffness of an impact, and how points accelerate after it⟩."""
    work = bar.share * share_of_impact(patch, bounce)
    if hits:
        work += bar.stiffness * stiffness_of_impact(first, second, patch, bounce, factor, h)
        if alone:
            turns = turning_after(first, second, patch, friction, share, turning)
            work += wp.ddot(bar.turns.by_arm, turns.by_arm) + wp.dot(bar.turns.offset, turns.offset)
    return work


@wp.func
def rest_work(
    first: BodyState,
    second: BodyState,
    pose: PairPose,
    sample: Sample,
    d: Distance,
    turning: int,
    depth: real,
    h: real,
    bounce: real,
    bar: Rest,
) -> real:
    """⟨bar, what a sample adds to what a pair rests on⟩."""
    point = point_contact(pose, sample, d, turning, False, ONE, ZERO)
    fall = fall_of(first, second, depth, h)
    own = rest_of_sample(point.depth, fall, point.approach, bounce, point.arm, point.normal)
    sums = bar.load * own.load + bar.near * own.near + bar.depth * own.depth
    return sums + wp.dot(bar.arm, own.arm) + wp.dot(bar.normal, own.normal)


body_product = product_of(BodyState)


@wp.func
def support_work(
    first: BodyState,
    second: BodyState,
    rest: Rest,
    depth: real,
    friction: real,
    h: real,
    turning: int,
    virtual: vec6,
    second_virtual: vec6,
    first_bar: BodyState,
    second_bar: BodyState,
    depth_bar: real,
    factor: real,
    rests_bar: real,
) -> real:
    """Work of what a pair rests on along virtual velocities, and ⟨bars, bodies as they meet, their depth⟩."""
    impulse = support_of(first, second, rest, friction, h, turning)
    back = wrench_at(impulse, first.position - second.position)
    work = wp.dot(impulse, virtual) - wp.dot(back, second_virtual) + depth_bar * depth_beside(rest, depth)
    work += rests_bar * share_left_out(rest, factor)
    return (
        work
        + body_product(first_bar, supported(first, impulse, h))
        + body_product(second_bar, supported(second, -back, h))
    )


@wp.func
def late_work(body: Body, row: StateRow, h: real, at: Moment, delayed: vec6, late: vec6) -> real:
    """Work of the momentum of a twist along another: μᵀ M D."""
    inertia = turned_inertia(rotation_of(body, row, at.met, h), body.inertia)
    along = wp.dot(linear_part(late), linear_part(delayed))
    return body.mass * along + wp.dot(angular_part(late), inertia * angular_part(delayed))


def need_adjoints(function: Any, seen: set[int] | None = None) -> None:
    """Have Warp generate the adjoint of a function and of all that it calls.

    `wp.grad` asks for it by itself where nothing called the function before in the same kernel. Formulas of a
    step have been called before, and would be left without: their derivatives would be zero without a word.
    """
    seen = set() if seen is None else seen
    if id(function) in seen:
        return
    seen.add(id(function))
    function.adj.force_adjoint_codegen = True
    for name in _names_in(function.func.__code__):
        called = function.func.__globals__.get(name)
        if isinstance(called, wp.Function):
            need_adjoints(called, seen)


def after_adjoints(function: Any) -> Any:
    """Have Warp emit a function after all adjoints, as those that call `wp.grad`: it calls one of them."""
    function.adj.uses_grad_call = True
    return function


def _names_in(code: CodeType) -> set[str]:
    """Global names that a function's code may refer to."""
    return set(code.co_names).union(*(_names_in(c) for c in code.co_consts if isinstance(c, CodeType)))


for _function in (
    point_work, distance_work, sample_distance, pair_work, apart_work, facing_work, momentum_work, state_work,
    advance_work, impact_patch_work, impact_work, rest_work, support_work, late_work,
):  # fmt: skip
    need_adjoints(_function)
