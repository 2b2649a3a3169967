"""A pair of bodies within a step: where the second's solid sees the first's samples (docs/theory/contact.md).

Geometry is taken where the old velocities take the bodies by a share τ of the step: x̂ = x + τ h v.
"""

import warp as wp

from dano.physics.features import TREES
from dano.physics.real import HALF, mat33, ONE, quat, real, vec3, vec6, ZERO
from dano.physics.rotations import direction, interpolated, matrix, rotation_from_z
from dano.physics.solids.distances import Solid, solid_distance
from dano.physics.solids.leaves import Distance, Solids
from dano.physics.twists import angular_part, joined, linear_part

FIXED, AXIS, BALL = 0, 1, 2
"""How samples turn with their body: with it; about its z axis they keep facing the other body; altogether."""

_FIXED = wp.constant(FIXED)
_AXIS = wp.constant(AXIS)
_BALL = wp.constant(BALL)
# Turn in a step [rad] from which arms are those of the predicted configuration for samples that keep facing.
_FASTEST = wp.constant(real(0.5))
# Search for where a growing ellipsoid touches first: share of the largest step that converges, steps, and how
# close two of them end the search, over the shortest semi-axis. For semi-axes 1 : 3 the error falls to 2 % in
# 12 steps.
_PULL = wp.constant(real(0.7))
_SEARCHES = wp.constant(12)
_FOUND = wp.constant(real(1e-6))


@wp.struct
class BodyState:
    """Where a body is at the start of a step, and how the old velocities move it."""

    position: vec3  # Of the centre of mass [m, W]
    orientation: quat  # Body → world
    ahead: quat  # Orientation at the end of the step at the old velocities
    velocity: vec3  # Of the centre of mass [m/s, W]
    spin: vec3  # [rad/s, W]
    gain: vec3  # What gravity adds to the velocity within the step [m/s, W], zero for a body on a joint
    spin_gain: vec3  # What gyroscopic torque adds to the spin within the step [rad/s, W]; the same
    falls: vec3  # `gain` without what supports the body [m/s, W]
    ahead_falling: quat  # Orientation at the end of the step with that gain; unused where there are joints
    # Half of what the spin gains turns it by in a step [rad, W]: after a share τ it has turned by τ (1 − τ)
    # of this less than the way to `ahead` says.
    lag: vec3
    com: vec3  # Centre of mass in the field frame [m, F]
    inverse_mass: real  # Effective inverse mass [1/kg], zero for a fixed body
    inverse_inertia: mat33  # Effective inverse inertia [1/(kg m²), W], zero for a fixed body
    # Share of the step after which the body meets another one in an impact, and impulses on it take effect; 0
    # where they act from the start. Its angular momentum is balanced then.
    met: real
    # With which the balance sees the spin, see `angular_momentum`: 1 for that of the step, 0 for that at the
    # moment of the balance, in an impact.
    lead: real
    held: real  # 1 where others hold the body until then, 0 where it falls
    # Impulse on the body within the step besides gravity, as its way until then feels it [N s, N m s, W].
    support: vec6


@wp.struct
class PairPose:
    """A pair of bodies at a moment within a step; in the axes of the second body's solid unless said."""

    points: mat33  # Sample coordinates → solid frame, without the origin
    origin: vec3  # Where the samples' origin is [m]
    vectors: mat33  # Turns vector areas
    rotation: mat33  # Solid axes → world
    com: vec3  # First body's centre of mass [m]
    velocity: vec3  # Of the first body's centre of mass relative to the second body [m/s]
    spin: vec3  # Of the first body relative to the second [rad/s]
    gained: vec3  # What gravity has added to the velocity by then [m/s]
    gained_on_way: vec3  # The same, in the mean over the way
    spin_gained: vec3  # What gyroscopic torques have added to the spin [rad/s]
    spin_gained_on_way: vec3  # The same, in the mean over the way
    gains_after: vec3  # What the velocity of the end of the step gains from then on [m/s]
    com_difference: vec3  # See `FoundPair`, which says it: a place for derivatives by it [m, W]
    # Sample coordinates → arms from the first body's centre of mass, without their offset. Those of samples
    # that keep facing the solid are those of the start of the step.
    arms: mat33
    arm_offset: vec3  # Their offset [m]
    # The arm of a ball's or an ellipsoid's densest samples [m]; shorter by the turn where that is above 1 rad
    # a step, because the lowest point then rises and sinks by less than the arm says.
    lowest: vec3
    axis: vec3  # The first body's z axis, when the arms are taken


@wp.struct
class FacingMap:
    """How sample coordinates and vector areas of a surface that keeps facing a direction map to a frame."""

    points: mat33
    vectors: mat33


@wp.func
def facing_map(turn: mat33, toward: vec3, turning: int, scale: vec3) -> FacingMap:
    """Samples that face a direction of their body, in the axes that a rotation takes the body's to.

    A ball looks the same from all sides, a cylinder from all around: samples that keep facing the other body
    let it roll smoothly. Directions d on a unit ball become points S Q d of an ellipsoid with semi-axes
    S, and areas a become det(S) S⁻¹ Q a, with Q such that the densest samples lie where the ellipsoid
    comes closest.

    Args:
        turn: Body → the frame.
        toward: The direction [F].
        turning: How the samples turn.
        scale: S [m].
    """
    found = FacingMap()
    found.points = turn
    found.vectors = turn
    squared = toward[0] * toward[0] + toward[1] * toward[1]
    # A cylinder that stands on its end faces no way more than another.
    if turning == _AXIS and squared > real(1e-12):
        across = wp.sqrt(squared)
        x = toward[0] / across
        y = toward[1] / across
        about = mat33(x, -y, ZERO, y, x, ZERO, ZERO, ZERO, ONE)
        found.points = turn * about
        found.vectors = turn * about
    if turning == _BALL:
        facing = rotation_from_z(-direction(wp.cw_mul(scale, toward)))
        volume = scale[0] * scale[1] * scale[2]
        found.points = turn * wp.diag(scale) * facing
        found.vectors = turn * wp.diag(vec3(volume / scale[0], volume / scale[1], volume / scale[2])) * facing
    return found


@wp.func
def falling(body: BodyState, falls: int) -> BodyState:
    """A body that falls freely, or one that others hold, whose velocities gain nothing."""
    found = body
    if falls == 0:
        found.gain = vec3()
        found.falls = vec3()
        found.spin_gain = vec3()
        found.lag = vec3()
    elif wp.static(not TREES):
        found.ahead = body.ahead_falling
    return found


@wp.func
def is_with_fixed(first: BodyState, second: BodyState) -> bool:
    """Whether one body of a pair is fixed: their impulses may wait until they meet; on joints none do."""
    fixed = bool(False)
    if wp.static(not TREES):
        fixed = first.inverse_mass == ZERO or second.inverse_mass == ZERO
    return fixed


@wp.func
def falling_bar(bar: BodyState, falls: int) -> BodyState:
    """Derivatives by a body from those by what `falling` makes of it."""
    found = bar
    if falls == 0:
        found.gain = vec3()
        found.falls = vec3()
        found.spin_gain = vec3()
        found.lag = vec3()
    elif wp.static(not TREES):
        found.ahead_falling = bar.ahead_falling + bar.ahead
        found.ahead = quat()
    return found


@wp.func
def rotation_after(body: BodyState, share: real) -> mat33:
    """Rotation of a body after a share of the step.

    A spin is that of the middle of the step before: the body has turned by τ h (ω + (1 + τ)/2 γ).
    """
    q = interpolated(body.orientation, body.ahead, share)
    if wp.static(not TREES):
        if wp.length_sq(body.lag) > ZERO:
            half = (-HALF * share * (ONE - share)) * body.lag
            q = wp.normalize(quat(half[0], half[1], half[2], ONE)) * q
    return matrix(q)


@wp.func
def rotation_met(body: BodyState) -> mat33:
    """Rotation of a body when its angular momentum is balanced: its spin at the end is seen from there."""
    if body.met != ZERO:
        return matrix(interpolated(body.orientation, body.ahead_falling, body.met))
    return matrix(body.orientation)


@wp.func
def position_after(body: BodyState, share: real, h: real) -> vec3:
    """Centre of mass after a share of the step [m, W].

    A velocity is that of the middle of the step before: x(τ) = x + τ h (v + (1 + τ)/2 Δ) is the parabola of
    free fall that goes on to x + h (v + Δ).
    """
    return body.position + (share * h) * (body.velocity + (HALF * (ONE + share)) * body.gain)


@wp.func
def centres_apart(first: BodyState, second: BodyState, h: real) -> vec3:
    """From the second body's centre of mass to the first's, each where impulses on it take effect [m, W]."""
    return position_after(first, first.met, h) - position_after(second, second.met, h)


@wp.func
def moved_in_impact(body: BodyState, velocity: vec6) -> vec6:
    """Velocity and spin by which a body moves in a step with an impact after the share τ [W].

    (1 − τ) V⁺ + τ (V⁻ + Δ), with what gravity, gyroscopic torque and supports add to V⁻: the parabola of free
    fall until then, and from then on.

    Args:
        body: When the step begins.
        velocity: V⁺ of the balance [W].
    """
    falls = ONE - body.held
    v = body.velocity + falls * body.gain + body.inverse_mass * linear_part(body.support)
    gains = falls * (ONE - body.lead) * (HALF + body.met)
    spin = body.spin + gains * body.spin_gain + body.inverse_inertia * angular_part(body.support)
    return (ONE - body.met) * velocity + body.met * joined(v, spin)


@wp.func
def way_of(a: BodyState, b: BodyState, middle: vec3, radius: real, h: real) -> real:
    """Most that a point of a ball moves relative to another body within the step [m].

    Seen from b, a point at r from the first body's centre of mass, which is at d from b's, has the speed
    |(v_a − v_b − ω_b × d) + (ω_a − ω_b) × r|, and d grows by t (v_a − v_b).

    Args:
        a: The body that the ball turns with.
        b: The other body.
        middle: Centre of the ball at the start of the step [m, W].
        radius: Of the ball [m].
        h: Timestep [s].
    """
    moves = a.velocity - b.velocity
    speed = wp.length(moves - wp.cross(b.spin, a.position - b.position))
    speed += HALF * h * wp.length(b.spin) * wp.length(moves)
    return h * (speed + wp.length(a.spin - b.spin) * (wp.length(middle - a.position) + radius))


@wp.func
def speed_within(pose: PairPose, x: vec3, radius: real) -> real:
    """Most speed of points of the first body in a ball relative to the second body [m/s].

    Args:
        pose: The pair.
        x: Centre of the ball [m].
        radius: Its radius [m].
    """
    return speed_in_ball(pose, x, radius) + gained_within(pose, x, radius)


@wp.func
def speed_in_ball(pose: PairPose, x: vec3, radius: real) -> real:
    """The same at the old velocities [m/s]."""
    return wp.length(pose.velocity + wp.cross(pose.spin, x - pose.com)) + wp.length(pose.spin) * radius


@wp.func
def gained_within(pose: PairPose, x: vec3, radius: real) -> real:
    """Most that velocities of points of the first body in a ball have gained on their way [m/s].

    Args:
        pose: The pair.
        x: Centre of the ball [m].
        radius: Its radius [m].
    """
    of_spin = wp.length(pose.spin_gained_on_way) * (wp.length(x - pose.com) + radius)
    return wp.length(pose.gained_on_way) + of_spin


@wp.func
def pair_pose(
    first: BodyState,
    second: BodyState,
    share: real,
    h: real,
    toward: vec3,
    turning: int,
    scale: vec3,
    follows: real,
) -> PairPose:
    """The pair after a share of a step of length h at the old velocities.

    Args:
        first: The sampled body.
        second: The body whose solid is asked.
        share: τ.
        h: Timestep [s].
        toward: Direction that samples of the first body face [F], see `facing_direction`; unused if they do
            not turn.
        turning: How samples turn.
        scale: Semi-axes of a ball or an ellipsoid [m].
        follows: 1 where points follow the second body, which rolls on the first, else 0.
    """
    pose = PairPose()
    pose.rotation = rotation_after(second, share)
    inverse = wp.transpose(pose.rotation)
    turn = inverse * rotation_after(first, share)
    pose.com = inverse * (position_after(first, share, h) - position_after(second, share, h)) + second.com
    pose.origin = pose.com - turn * first.com
    apart = first.position - second.position
    moves = first.velocity - second.velocity
    pose.velocity = inverse * (moves - wp.cross(second.spin, apart))
    pose.spin = inverse * (first.spin - second.spin)
    gain = inverse * (first.gain - second.gain - wp.cross(second.spin_gain, apart))
    spin_gain = inverse * (first.spin_gain - second.spin_gain)
    pose.spin_gained = (HALF + share) * spin_gain
    pose.spin_gained_on_way = spin_gain
    pose.gained = (HALF + share) * gain
    pose.gained_on_way = (HALF * (ONE + share)) * gain
    pose.gains_after = (HALF - share) * (inverse * (first.falls - second.falls))
    seen = facing_map(turn, toward, turning, scale)
    pose.points = seen.points
    pose.vectors = seen.vectors
    pose.arms = turn
    pose.arm_offset = pose.origin - pose.com + inverse * ((follows * share * h) * moves)
    if turning != _FIXED:
        # What touches a plane with the same normal at the start: forces act there, and depths are
        # those of the end. Together they are SHAKE's way with a constraint, which neither damps nor
        # drives rolling. The faster a body spins, the nearer to the end: arms far from where depths
        # are would miss impacts.
        turn_squared = wp.dot(first.spin, first.spin) * h * h
        fast = wp.min(turn_squared / (_FASTEST * _FASTEST), ONE)
        before = inverse * rotation_after(first, fast * share)
        stands = facing_map(before, wp.transpose(before) * (turn * toward), turning, scale)
        pose.arms = stands.points
        pose.arm_offset = -(before * first.com)
        pose.axis = before * vec3(ZERO, ZERO, ONE)
        lowest = pose.arm_offset - stands.points * vec3(ZERO, ZERO, ONE)
        pose.lowest = lowest / wp.sqrt(wp.max(ONE, turn_squared))
    return pose


@wp.func
def seen_from(solids: Solids, world: int, solid: Solid, turn: mat33, x: vec3) -> Distance:
    """Distance to a solid, and the direction to it in the axes of a body that `turn` takes to the solid's."""
    d = solid_distance(solids, world, solid, x)
    d.gradient = direction(-(wp.transpose(turn) * d.gradient))
    return d


@wp.func
def closer(
    solids: Solids, world: int, solid: Solid, turn: mat33, origin: vec3, scale: vec3, point: vec3
) -> Distance:
    """One projected gradient step towards the point x of a solid with the least |S⁻¹ x|, in axes of the body.

    The solid's distance from where the step starts, and the direction to the solid there.
    """
    least = wp.min(scale[0], wp.min(scale[1], scale[2]))
    start = shrunk(scale, least, point)
    return seen_from(solids, world, solid, turn, origin + turn * start)


@wp.func
def shrunk(scale: vec3, least: real, point: vec3) -> vec3:
    """The point after a step down the gradient of |S⁻¹ x|²."""
    r = vec3(least / scale[0], least / scale[1], least / scale[2])
    return point - _PULL * wp.cw_mul(wp.cw_mul(r, r), point)


@wp.func
def first_touch(solids: Solids, world: int, solid: Solid, turn: mat33, origin: vec3, scale: vec3) -> vec3:
    """Where a step of the search for the first touch of a growing ellipsoid starts, at the end of the search.

    The ellipsoid grows from its centre; it touches the solid first at the point x with the least |S⁻¹ x|,
    found by projected gradients with momentum (Nesterov 2004, Introductory Lectures on Convex
    Optimization, section 2.2.4). An ellipsoid that has sunk in beside an edge is pressed by the edge; the
    solid's nearest side is another place. From the result, `closer` gives the direction to the solid.
    """
    least = wp.min(scale[0], wp.min(scale[1], scale[2]))
    root = wp.sqrt(_PULL) * least / wp.max(scale[0], wp.max(scale[1], scale[2]))
    momentum = (ONE - root) / (ONE + root)
    point = vec3()
    nearest = vec3()
    k = int(0)
    while k < _SEARCHES:
        found = closer(solids, world, solid, turn, origin, scale, point)
        touched = shrunk(scale, least, point) + wp.max(found.value, ZERO) * found.gradient
        way = touched - nearest
        if wp.dot(way, way) < _FOUND * _FOUND * least * least:
            k = _SEARCHES
        else:
            following = touched
            if k > 0:
                following = touched + momentum * way
            if k + 1 < _SEARCHES:
                point = following
            nearest = touched
            k += 1
    return point


@wp.func
def facing_direction(
    solids: Solids,
    world: int,
    solid: Solid,
    first: BodyState,
    second: BodyState,
    share: real,
    h: real,
    turning: int,
    scale: vec3,
) -> vec3:
    """Direction in which the samples of a body face a solid, after a share of the step [F]."""
    toward = vec3(ONE, ZERO, ZERO)
    if turning == _FIXED:
        return toward
    inverse = wp.transpose(rotation_after(second, share))
    turn = inverse * rotation_after(first, share)
    com = inverse * (position_after(first, share, h) - position_after(second, share, h)) + second.com
    origin = com - turn * first.com
    if turning == _AXIS:
        toward = seen_from(solids, world, solid, turn, origin).gradient
    if turning == _BALL:
        point = first_touch(solids, world, solid, turn, origin, scale)
        toward = closer(solids, world, solid, turn, origin, scale, point).gradient
    return toward


@wp.func
def spin_of_samples(spin: vec3, axis: vec3, turning: int) -> vec3:
    """What of a body's spin its samples follow: those that keep facing the other body do not turn with it.

    Args:
        spin: Of the body.
        axis: The body's z axis, about which samples of a cylinder do not turn.
        turning: How samples turn.
    """
    follows = spin
    if turning == _AXIS:
        follows = spin - wp.dot(spin, axis) * axis
    if turning == _BALL:
        follows = vec3()
    return follows


@wp.func
def approach(pose: PairPose, turning: int, x: vec3, normal: vec3) -> real:
    """Speed at which a point x [F] of the first body nears the solid at old velocities [m/s]."""
    axis = vec3(pose.points[0, 2], pose.points[1, 2], pose.points[2, 2])
    spin = spin_of_samples(pose.spin, axis, turning)
    return -wp.dot(normal, pose.velocity + wp.cross(spin, x - pose.com))
