"""The distributed law at a point (docs/theory/contact.md, "Pressure and friction at a sample").

    F = A p (n − b(p)/p u / max(|u|, v_s)),   b(p) = μ (1 − φ p/(p + p₀)) p,
    p = (1 − β) k max(0, d − θ h v_n) (1 − l) + κ w max(0, v* − v_n) + κ max(0, v_δ − v_n)

Friction and hysteresis are set-valued maps u/max(|u|, v_s) of a tiny v_s. A solver that knows them by their
values only has to search for where bodies stick. So the law is also written without a quotient, with the
friction λ and the direction s of the hysteresis as unknowns of their own, the *duals*,

    max(|u|, v_s) λ + b(p) u = 0,  |λ| ≤ b(p)        max(|v_n|, v_s) s − v_n = 0,  |s| ≤ 1

(Chan, Golub, Mulet 1999; Andersen et al. 2000, for sums of norms). `linearized` is the derivative of this
form.

A file of functions may stand in place of some of these: see `DistributedLaw.functions`.
"""

import warp as wp

from dano.physics.features import LAW
from dano.physics.friction import following_friction, Friction, friction, friction_with_dual, Slip
from dano.physics.impacts import (
    fading_in,
    gains_of,
    Impact,
    impact_goal,
    impact_limit,
    is_hit,
    is_impact,
    may_rest,
    share_that_rebounds,
)
from dano.physics.real import INFINITY, ONE, real, vec3, ZERO
from dano.physics.samples import Point


@wp.struct
class Material:
    """What the traction at a point depends on besides geometry and velocity.

    Attributes:
        stiffness: k [Pa/m].
        restitution: e [1].
        restitution_velocity: v_e [m/s].
        hysteresis: σ [1].
        friction: μ [1].
        friction_fading: φ [1].
        friction_pressure: p₀ [Pa].
        stiction: v_s [m/s].
        ahead: θ h, how far ahead the depth is taken [s].
        timestep: h [s].
        instant: 1 where impacts end within the step, 0 where they are left to the spring.
        bounce: Slowest rebound of an impact, and slowest approach that is one [m/s].
        uplift: An overlap of depth d separates at most at √(uplift · d), if that exceeds v_e [m/s²].
        gradual: v_g, slip below which friction grows with it in derivatives [m/s]; 0: as it is.
        numbers: Of a law of one's own; only where there is one.
    """

    stiffness: real
    restitution: real
    restitution_velocity: real
    hysteresis: real
    friction: real
    friction_fading: real
    friction_pressure: real
    stiction: real
    ahead: real
    timestep: real
    instant: real
    bounce: real
    uplift: real
    gradual: real
    if LAW:
        numbers: vec3


@wp.struct
class PointLaw:
    """What of the law does not change within a step."""

    stiffness: real  # k [Pa/m]
    depth: real  # d [m]
    damped: real  # ρ − σ [1]; times d⁺ [m] where impacts are left to the spring
    lost: real  # σ [1]; times d⁺ [m] where impacts are left to the spring
    ahead: real  # θ h [s]
    restitution_velocity: real  # v_e, or the speed at which a deep overlap may separate, if larger [m/s]
    friction: real  # μ [1]
    fading: real  # φ [1]
    friction_pressure: real  # p₀ [Pa]
    stiction: real  # v_s [m/s]
    gradual: real  # v_g [m/s], zero where motion is looked for and no derivative
    # 1 where the damping has its full size from v_e on, so that bodies are pushed apart no faster.
    sharp: real
    blow: real  # κ w, pressure of an impact by the speed that is missing to its goal [Pa s/m]
    goal: real  # v*, separating speed that an impact aims at [m/s]
    guard: real  # κ [Pa s/m]
    limit: real  # Separating speed below which the point would get deeper than the impact [m/s]
    extra_slip: vec3  # What is added to the slip [m/s]
    if LAW:
        numbers: vec3  # Of a law of one's own; only where there is one


@wp.struct
class Gate:
    """Whether a point stays apart, in few numbers: of the points that are listed few press."""

    normal: vec3  # Of the point
    moment: vec3  # Of a unit pressure at it [m]
    rate: real  # Separating speed from which on the point stays out [m/s], infinite where it is in


@wp.struct
class Pressure:
    """Pressure, and its derivatives."""

    value: real  # p [Pa]
    damping: real  # −∂p/∂v_n, s eliminated [Pa s/m]
    direction_by_speed: real  # ∂s/∂v_n [s/m]
    direction_change: real  # Change of s that makes it fit the velocity
    change: real  # Change of the pressure that comes with it [Pa]


@wp.struct
class Traction:
    """Pressure along the normal, and friction [Pa]."""

    pressure: real
    friction: vec3


@wp.struct
class Bound:
    """Largest friction b(p) [Pa] and its derivative by p."""

    value: real
    marginal: real


@wp.struct
class Duals:
    """Unknowns besides the velocities: λ [Pa], and s, 1 where the surface comes out, −1 going in."""

    friction: vec3
    direction: real


@wp.struct
class Motion:
    """How a point moves relative to the second body: separating speed, and slip across the normal [m/s]."""

    rate: real
    slip: vec3


@wp.struct
class Linear:
    """The law at given velocities, and its derivatives at given duals, duals eliminated.

    The traction is p n + λ + friction_change, whatever the duals, and its derivative

        −f n dv_n + (b′ f dv_n) c − g du − l (û · du),    c = u / max(|u|, v_s).
    """

    pressure: Pressure  # p and its derivatives
    friction: vec3  # λ, projected onto |λ| ≤ b(p) [Pa]
    friction_change: vec3  # Change of λ that makes it fit the velocities [Pa]
    grip: real  # g [Pa s/m]
    turning: vec3  # l [Pa s/m], zero where the point sticks
    slip_direction: vec3  # û, unit slip, zero where the point sticks
    by_pressure: vec3  # b′ f c [Pa s/m]


@wp.func
def point_law(material: Material, point: Point, impact: Impact, damper: real) -> PointLaw:
    """The constants of a point.

    What is deep is pushed out at v_e: it is a damper of k A d/v_e. Of stiff bodies that are far deeper than
    they rest it would be so hard that a solver hardly finds the root, so k is less there.

    Args:
        material: Of the contact.
        point: The point.
        impact: Of the pair.
        damper: Hardest damper that a sample may be, where impacts end within the step [N s/m].
    """
    law = PointLaw()
    # Impacts that end within the step have had their restitution: what presses on gives nothing back.
    squared = material.restitution * material.restitution
    loss = wp.where(material.instant > ZERO, ONE, (ONE - squared) / (ONE + squared))
    kept = wp.min(material.hysteresis, loss)
    # What rests on goes on to press where another part of the patch has an impact.
    rests = (ONE - is_impact(point.approach, material.bounce)) * may_rest(impact, point.sunk)
    hits = impact.share * (ONE - rests)
    law.depth = point.depth
    law.ahead = material.ahead
    sunk = wp.max(point.depth, ZERO)
    law.restitution_velocity = wp.sqrt(
        wp.max(material.restitution_velocity * material.restitution_velocity, material.uplift * sunk)
    )
    stiffness = material.stiffness
    if material.instant > ZERO and stiffness * point.area * sunk > damper * law.restitution_velocity:
        stiffness = damper * law.restitution_velocity / (point.area * sunk)
    law.stiffness = (ONE - hits) * stiffness
    law.damped = loss - kept
    law.lost = kept
    if material.instant == ZERO:
        law.damped *= sunk
        law.lost *= sunk
    law.extra_slip = point.extra_slip
    if impact.stiffness > ZERO:
        hit = is_hit(point.approach, material.bounce, impact.rests)
        law.blow = impact.part * impact.stiffness * hit * fading_in(point.sunk / impact.depth)
        law.guard = impact.part * impact.stiffness
        law.limit = impact_limit(impact, point.depth, point.sunk)
        gains = gains_of(impact, point.gains_after, point.arm, point.normal, material.friction)
        rebound = -material.restitution * point.meets
        rebounds = share_that_rebounds(rebound, material.bounce)
        law.goal = impact_goal(impact, rebound, rebounds, point.approach, point.normal, gains)
        gained = gains.falls + (ONE - rebounds) * gains.held
        across = gained - wp.dot(point.normal, gained) * point.normal
        law.extra_slip -= impact.delays * across
    law.friction = material.friction
    law.fading = material.friction_fading
    law.friction_pressure = material.friction_pressure
    law.stiction = material.stiction
    law.gradual = material.gradual
    law.sharp = material.instant
    if wp.static(len(LAW) > 0):
        law.numbers = material.numbers
    return law


@wp.func
def gate_of(point: Point, law: PointLaw) -> Gate:
    """When a point that is not sunk in, and has no impact, stays out: then d − θ h v_n says all."""
    gate = Gate()
    gate.normal = point.normal
    gate.moment = point.moment
    gate.rate = INFINITY
    if law.depth <= ZERO and law.blow == ZERO:
        gate.rate = law.depth / law.ahead
        if law.guard > ZERO:
            gate.rate = wp.max(gate.rate, law.limit)
    return gate


@wp.func
def is_apart(gate: Gate, velocity: vec3, spin: vec3) -> bool:
    """Whether a point stays out, at the relative twist at the first body's centre."""
    return wp.dot(gate.normal, velocity) + wp.dot(gate.moment, spin) >= gate.rate


@wp.func
def pressure(law: PointLaw, rate: real, direction: real, stiction: real) -> Pressure:
    """Pressure p at a separating speed v_n.

    Of its three parts the last two are those of an impact, see `dano.physics.impacts`.

    The first is k (d − θ h v_n) (1 − l). The depth is that at the end of the step, or in its middle, which
    makes the spring implicit. Of the loss l = (1 − σ) x + σ c(v_n / v_s), x is v_n / v_e up to its limits ±1
    and c(x) = x / max(|x|, 1): a damper, and the share σ that is lost however slow the motion, which stops
    rolling and rocking. v_e grows with the depth: nothing is pushed out faster.

    Where impacts are left to the spring it is k (d − D) with the larger of θ h v_n and
    d⁺ ((ρ − σ) s(v_n / v_e) + σ c), s(x) = x / √(1 + x²) and ρ = (1 − e²)/(1 + e²): the force going in
    exceeds that going out by 1/e² whatever the path, so an impact returns e² of its energy.

    Args:
        law: Constants of the point.
        rate: v_n [m/s].
        direction: The dual s of c(v_n / v_s), which only the derivatives depend on.
        stiction: v_s, softened or not [m/s].
    """
    found = Pressure()
    scaled = rate / law.restitution_velocity
    saturation = wp.clamp(scaled, -ONE, ONE)
    saturation_slope = wp.where(wp.abs(scaled) < ONE, ONE, ZERO)
    if law.sharp == ZERO:
        inverse = ONE / wp.sqrt(ONE + scaled * scaled)
        saturation = scaled * inverse
        saturation_slope = inverse * inverse * inverse
    inverse_slow = ONE / wp.max(wp.abs(rate), stiction)
    fitting = rate * inverse_slow
    away = wp.where(wp.abs(rate) > stiction, direction * wp.sign(rate), ZERO)
    found.direction_by_speed = (ONE - away) * inverse_slow
    found.direction_change = fitting - direction
    by_loss = law.damped * saturation + law.lost * fitting
    by_time = law.ahead * rate
    slower = law.damped / law.restitution_velocity * saturation_slope + law.lost * found.direction_by_speed
    left = law.depth - by_time
    kept = ONE - by_loss
    if law.sharp > ZERO:
        if left > ZERO:
            found.value = law.stiffness * left * kept
            found.damping = law.stiffness * (law.ahead * kept + left * slower)
            found.change = -law.stiffness * left * law.lost * found.direction_change
    else:
        lossy = wp.abs(by_loss) > wp.abs(by_time)
        if lossy:
            left = law.depth - by_loss
        if left > ZERO:
            found.value = law.stiffness * left
            found.damping = law.stiffness * wp.where(lossy, slower, law.ahead)
            if lossy:
                found.change = -law.stiffness * law.lost * found.direction_change
    if law.blow > ZERO and rate < law.goal:
        found.value += law.blow * (law.goal - rate)
        found.damping += law.blow
    if law.guard > ZERO and rate < law.limit:
        found.value += law.guard * (law.limit - rate)
        found.damping += law.guard
    return found


@wp.func
def friction_bound(law: PointLaw, p: real) -> Bound:
    """b(p) = μ (1 − φ p/(p + p₀)) p."""
    found = Bound()
    lightness = law.friction_pressure / (law.friction_pressure + p)
    found.value = law.friction * (ONE - law.fading * (ONE - lightness)) * p
    found.marginal = law.friction * (ONE - law.fading * (ONE - lightness * lightness))
    return found


@wp.func
def point_motion(point: Point, velocity: vec3, spin: vec3) -> Motion:
    """Motion of a point, less its extra slip, from the relative twist at the first body's centre."""
    motion = Motion()
    u = velocity + wp.cross(spin, point.arm)
    motion.rate = wp.dot(point.normal, velocity) + wp.dot(point.moment, spin)
    motion.slip = u - wp.dot(point.normal, u) * point.normal
    return motion


@wp.func
def slip_of(law: PointLaw, motion: Motion) -> Motion:
    """Motion with the extra slip of a point."""
    motion.slip = motion.slip + law.extra_slip
    return motion


@wp.func
def traction(law: PointLaw, rate: real, slip: vec3) -> Traction:
    """The law: what presses at a separating speed v_n and a slip u [m/s]."""
    found = Traction()
    found.pressure = pressure(law, rate, ZERO, law.stiction).value
    found.friction = friction(slip, friction_bound(law, found.pressure).value, law.stiction)
    return found


@wp.func
def slip_at(law: PointLaw, slip: vec3, grip: real) -> Slip:
    """A slip as derivatives take it, with the grip that `linearized` has there."""
    at = Slip()
    speed = wp.length(slip)
    at.slip = slip
    at.direction = (-ONE / wp.max(speed, law.stiction)) * slip
    at.grip = grip
    at.is_gradual = speed < law.gradual
    return at


@wp.func
def fitting_direction(law: PointLaw, rate: real) -> real:
    """The dual s that fits a separating speed."""
    return rate / wp.max(wp.abs(rate), law.stiction)


@wp.func
def fitting_duals(law: PointLaw, motion: Motion) -> Duals:
    """Duals that fit given velocities."""
    duals = Duals()
    duals.direction = fitting_direction(law, motion.rate)
    duals.friction = traction(law, motion.rate, motion.slip).friction
    return duals


@wp.func
def linearized(law: PointLaw, motion: Motion, duals: Duals, share: real) -> Linear:
    """One linearisation of the law with its duals.

    Args:
        law: Constants of the point.
        motion: Of the point.
        duals: The duals.
        share: Of its friction.
    """
    found = Linear()
    found.pressure = pressure(law, motion.rate, duals.direction, law.stiction)
    bound = friction_bound(law, found.pressure.value)
    limit = share * bound.value
    damping = share * bound.marginal * found.pressure.damping
    own = friction_with_dual(motion.slip, duals.friction, limit, damping, law.stiction, law.gradual)
    found.friction = own.value
    found.friction_change = own.change
    found.grip = own.grip
    found.turning = own.turning
    found.slip_direction = own.direction
    found.by_pressure = own.by_rate
    return found


@wp.func
def following_duals(found: Linear, duals: Duals, change: Motion) -> Duals:
    """The duals after the motion changed, from the linearisation before."""
    after = Duals()
    own = Friction()
    own.value = found.friction
    own.change = found.friction_change
    own.by_rate = found.by_pressure
    own.grip = found.grip
    own.turning = found.turning
    own.direction = found.slip_direction
    after.friction = following_friction(own, change.rate, change.slip)
    s = duals.direction + found.pressure.direction_change + found.pressure.direction_by_speed * change.rate
    after.direction = wp.clamp(s, -ONE, ONE)
    return after
