"""What acts on joint coordinates in a step: springs, armature and motors, and what has kinks.

Friction that sticks, limits, and motors within theirs are *ramps*: forces g(y) = clip(s (y − c), a, b)
against the velocity y at the end of the step, some very steep. A limit is one that is infinite on one side.
The sum g of the ramps of a coordinate grows with y and is linear between kinks. Newton's method on y would
jump between the kinks for ever. So each such coordinate has a dual λ = g(y) as a second unknown, and the
equation

    y = (ρ + g)⁻¹(λ + ρ y),        ρ: effective mass of the coordinate over h,

which is right for any ρ > 0: the inverse of a growing function, in closed form from the kinks. With this ρ,
one iteration finds the mode (stick, slip, limit) of each joint as if the joints were decoupled.
"""

import warp as wp

from dano.physics.real import INFINITY, real, ZERO
from dano.physics.trees.sizes import CLOSES, STICKS, STOPS

_STICKS, _STOPS, _CLOSES = wp.constant(real(STICKS)), wp.constant(real(STOPS)), wp.constant(real(CLOSES))


@wp.struct
class JointLaw:
    """What acts on a coordinate q: see `dano.scene.JointLaws`. What no joint has is 0, or endless."""

    damping: real  # [N m s/rad or N s/m]
    armature: real  # [kg m² or kg]
    stiffness: real  # Of a spring [N m/rad or N/m]
    rest: real  # Where it is slack [rad or m]
    friction: real  # [N m or N]
    least: real  # Smallest q [rad or m]
    most: real  # Largest q
    gear: real  # Of a motor, 0 where there is none
    motor_stiffness: real  # [N m/rad or N/m]
    motor_damping: real  # [N m s/rad or N s/m]
    least_effort: real  # Smallest effort of the motor [N m or N]
    most_effort: real  # Largest one


@wp.struct
class JointDrive:
    """What drives a coordinate in a step."""

    q: real  # At the start [rad or m]
    v: real  # Velocity of the step before [rad/s or m/s]
    effort: real  # [N m or N]
    command: real  # Of its motor
    constant: bool  # Whether the motor gives what it is told to, whatever the joint does


@wp.struct
class Ramp:
    """A force clip(slope (y − centre), least, most) against a speed y; slope 0 where there is none."""

    slope: real
    centre: real
    least: real
    most: real


@wp.struct
class Ramps:
    """What has kinks in the law of a coordinate."""

    friction: Ramp
    lower: Ramp
    upper: Ramp
    motor: Ramp


@wp.struct
class Resolved:
    """The speed y with ρ y + g(y) = w [rad/s or m/s], and the slope of g there."""

    speed: real
    slope: real


@wp.func
def joint_momentum(law: JointLaw, drive: JointDrive, h: real, y: real) -> real:
    """Momentum that springs, damping, armature and efforts take in a step, kinks aside.

    A spring has the mean force of the three places around the step, (q⁻ + 2 q + q⁺)/4: it swings without
    loss at any stiffness (Newmark's average acceleration).
    """
    momentum = h * (law.damping * y - drive.effort) + law.armature * (y - drive.v)
    momentum += h * law.stiffness * (drive.q + real(0.25) * h * (y - drive.v) - law.rest)
    if drive.constant:
        momentum -= h * law.gear * wp.clamp(drive.command, law.least_effort, law.most_effort)
    return momentum


@wp.func
def joint_momentum_slope(law: JointLaw, h: real) -> real:
    """Its derivative by y."""
    return h * law.damping + law.armature + real(0.25) * h * h * law.stiffness


@wp.func
def joint_ramps(law: JointLaw, drive: JointDrive, h: real, mass: real) -> Ramps:
    """What has kinks.

    Args:
        law: Of the coordinate.
        drive: What drives it.
        h: Timestep [s].
        mass: Effective mass of the coordinate [kg m² or kg], for how stiff limits are.
    """
    ramps = Ramps()
    ramps.friction.slope = law.friction / _STICKS
    ramps.friction.least = -law.friction
    ramps.friction.most = law.friction
    stiff = _STOPS * mass / h
    if wp.abs(law.least) < INFINITY:
        ramps.lower.slope = stiff
        ramps.lower.centre = wp.min((law.least - drive.q) / h, _CLOSES)
    ramps.lower.least = -INFINITY
    if wp.abs(law.most) < INFINITY:
        ramps.upper.slope = stiff
        ramps.upper.centre = wp.max((law.most - drive.q) / h, -_CLOSES)
    ramps.upper.most = INFINITY
    if not drive.constant:
        ramps.motor = motor_ramp(law, drive, h)
    return ramps


@wp.func
def motor_ramp(law: JointLaw, drive: JointDrive, h: real) -> Ramp:
    """A motor that heeds its joint: it pulls to its command, or without stiffness drives at it."""
    ramp = Ramp()
    slope = law.gear * law.gear * (law.motor_damping + h * law.motor_stiffness)
    if slope > ZERO:
        asked = law.motor_damping * drive.command
        if law.motor_stiffness > ZERO:
            asked = law.motor_stiffness * (drive.command - law.gear * drive.q)
        ramp.slope = slope
        ramp.centre = law.gear * asked / slope
        ramp.least = wp.min(-law.gear * law.most_effort, -law.gear * law.least_effort)
        ramp.most = wp.max(-law.gear * law.most_effort, -law.gear * law.least_effort)
    return ramp


@wp.func
def ramp_force(ramp: Ramp, y: real) -> real:
    """Force of a ramp against a speed."""
    if ramp.slope > ZERO:
        return wp.clamp(ramp.slope * (y - ramp.centre), ramp.least, ramp.most)
    return ZERO


@wp.func
def ramps_force(ramps: Ramps, y: real) -> real:
    """Their sum g(y) [N m or N]."""
    return (
        ramp_force(ramps.friction, y)
        + ramp_force(ramps.lower, y)
        + ramp_force(ramps.upper, y)
        + ramp_force(ramps.motor, y)
    )


@wp.func
def ramp_slope(ramp: Ramp, y: real) -> real:
    """Slope of a ramp at a speed."""
    if ramp.slope > ZERO:
        force = ramp.slope * (y - ramp.centre)
        if force > ramp.least and force < ramp.most:
            return ramp.slope
    return ZERO


@wp.func
def ramps_slope(ramps: Ramps, y: real) -> real:
    """Their slope g′(y)."""
    return (
        ramp_slope(ramps.friction, y)
        + ramp_slope(ramps.lower, y)
        + ramp_slope(ramps.upper, y)
        + ramp_slope(ramps.motor, y)
    )


@wp.struct
class Bracket:
    """Kinks between which a root lies: the largest speed known to be too low, the smallest too high."""

    low: real
    high: real


@wp.func
def narrowed_by_kink(bracket: Bracket, ramps: Ramps, rho: real, w: real, kink: real) -> Bracket:
    """The bracket with one more kink in mind."""
    if rho * kink + ramps_force(ramps, kink) <= w:
        bracket.low = wp.max(bracket.low, kink)
    else:
        bracket.high = wp.min(bracket.high, kink)
    return bracket


@wp.func
def narrowed_by_ramp(bracket: Bracket, ramps: Ramps, ramp: Ramp, rho: real, w: real) -> Bracket:
    """The bracket with the kinks of one ramp in mind."""
    if ramp.slope > ZERO:
        if ramp.least > -INFINITY:
            bracket = narrowed_by_kink(bracket, ramps, rho, w, ramp.centre + ramp.least / ramp.slope)
        if ramp.most < INFINITY:
            bracket = narrowed_by_kink(bracket, ramps, rho, w, ramp.centre + ramp.most / ramp.slope)
    return bracket


@wp.func
def slope_within(ramp: Ramp, bracket: Bracket) -> real:
    """Slope of a ramp that has no kink within a bracket."""
    if ramp.slope > ZERO:
        begins = ramp.least <= -INFINITY or ramp.centre + ramp.least / ramp.slope <= bracket.low
        ends = ramp.most >= INFINITY or ramp.centre + ramp.most / ramp.slope >= bracket.high
        if begins and ends:
            return ramp.slope
    return ZERO


@wp.func
def resolved(ramps: Ramps, rho: real, dual: real, y: real) -> Resolved:
    """The speed at which ρ y + g(y) is what a dual and a speed say: (ρ + g)⁻¹(λ + ρ y).

    Args:
        ramps: g.
        rho: ρ [kg m²/s or kg/s].
        dual: λ [N m or N].
        y: Speed [rad/s or m/s].
    """
    found = Resolved()
    if ramps_force(ramps, y) == dual:
        # The dual fits: most do.
        found.speed = y
        found.slope = ramps_slope(ramps, y)
        return found
    w = dual + rho * y
    bracket = Bracket()
    bracket.low = -INFINITY
    bracket.high = INFINITY
    bracket = narrowed_by_ramp(bracket, ramps, ramps.friction, rho, w)
    bracket = narrowed_by_ramp(bracket, ramps, ramps.lower, rho, w)
    bracket = narrowed_by_ramp(bracket, ramps, ramps.upper, rho, w)
    bracket = narrowed_by_ramp(bracket, ramps, ramps.motor, rho, w)
    slope = (
        slope_within(ramps.friction, bracket)
        + slope_within(ramps.lower, bracket)
        + slope_within(ramps.upper, bracket)
        + slope_within(ramps.motor, bracket)
    )
    start = ZERO
    if bracket.low > -INFINITY:
        start = bracket.low
    elif bracket.high < INFINITY:
        start = bracket.high
    found.speed = start + (w - rho * start - ramps_force(ramps, start)) / (rho + slope)
    found.slope = slope
    return found


@wp.func
def dual_change(found: Resolved, rho: real, y: real, change: real) -> real:
    """Change of λ when y changes, from the linearised equation: g′ dy + (ρ + g′) (y − resolved)."""
    return found.slope * change + (rho + found.slope) * (y - found.speed)


@wp.func
def dual_rounding(found: Resolved, rho: real, dual: real, y: real) -> real:
    """Size of the terms in the equation of a dual [rad/s or m/s], to which rounding in it is relative."""
    return (found.slope * wp.abs(y) + wp.abs(dual)) / (rho + found.slope)
