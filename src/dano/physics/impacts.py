"""Impacts of bodies with point contacts (docs/theory/contact.md, "Impacts").

An impact happens when a body has sunk into another by a stated depth δ. The samples that have sunk in are its
patch; they count with weights w(d/δ) that fade in with depth. A damper between what they do and their goals
brings them there within a step,

    p = κ w (v* − v_n)⁺,    κ = β F/(1 + (1 − β) F) m_eff / (h Σ A w).

Nothing of this depends on where in a step the bodies meet, on the number of samples, or, but for h κ, on h.
"""

import warp as wp

from dano.physics.pairs import BodyState, FIXED, spin_of_samples
from dano.physics.real import HALF, mat33, ONE, real, TWO, vec3, vec6, ZERO
from dano.physics.rotations import matrix, skew, turned
from dano.physics.twists import angular_part, joined, linear_part

_FIXED = wp.constant(FIXED)
# Least mobility along an impulse that slides, over that along the normal: what friction jams does not slide.
_JAMS = wp.constant(real(0.05))
# F of impacts of edges and faces, of which none that rests has a part.
_SHARP = wp.constant(real(1e4))
# A length beside which nothing divides by zero [N s].
_NOTHING = wp.constant(real(1e-30))
# Least share of a step after an impact.
_LATEST = wp.constant(real(1e-6))


@wp.struct
class Patch:
    """Sums over the samples of a pair that have sunk in, where its geometry is taken.

    Attributes:
        load: Σ A w [m²].
        arm: [m³, W].
        normal: [m², W].
        near_load: Σ A w of samples that have sunk in or are nearer than δ [m²].
        near_rate: Their separating speed, weighted by that load [m³/s].
    """

    load: real
    arm: vec3
    normal: vec3
    near_load: real
    near_rate: real


@wp.struct
class Turning:
    """How a point at an arm r from the first body's centre of mass accelerates because its bodies turn.

    That is Q r + q, relative to the second body, in world axes, for all that forces do not do: ω × (ω × r),
    and what gyroscopic torque does.
    """

    by_arm: mat33  # Q [1/s²]
    offset: vec3  # q [m/s²]


@wp.struct
class Impact:
    """The impact of a pair."""

    share: real  # β, share of the contact that is an impact and no lasting contact [1]
    stiffness: real  # κ [Pa s/m], zero where bodies have not sunk in far enough
    depth: real  # δ [m]
    # F, momentum that the damper passes on, by that of the common mass, for each speed that is missing [1].
    # The softer, the more samples share an impact; goals make up for it.
    factor: real
    # Depth that another part of the body may have at the end of the step, where its impact is left to the
    # next one [m].
    deepest: real
    part: real  # Share of the impact that the pair carries, ½ where samples of both bodies do [1]
    # Impulses take effect after this share of τ: β where they wait for when bodies meet, 0 where they act
    # from the start of the step.
    delays: real
    way: real  # Share of the step in which bodies go on as before, all the same
    rest: real  # Time from when impulses take effect to the end of the step [s]
    rests: real  # `share_left_out` of the pair
    after: real  # Time from when bodies meet to the middle of the step, to which velocities belong [s]
    turns: Turning  # How points accelerate after it because their body turns


@wp.func
def smooth_step(x: real) -> real:
    """From 0 at x = 0 to 1 at x = 1, with slopes of zero there."""
    y = wp.clamp(x, ZERO, ONE)
    return y * y * (real(3.0) - TWO * y)


@wp.func
def fading_in(x: real) -> real:
    """w: how much a sample counts at x times the depth of the impact. Its slope has no jumps."""
    y = wp.max(x, ZERO)
    return wp.where(y < ONE, y * y, TWO * y - ONE)


@wp.func
def no_impact(depth: real, factor: real, deepest: real, h: real) -> Impact:
    """That of contact that lasts: nothing happens within the step of length h."""
    impact = Impact()
    impact.depth = depth
    impact.factor = factor
    impact.deepest = deepest
    impact.part = ONE
    impact.rest = h
    return impact


@wp.func
def delayed(impact: Impact, delays: real, share: real, h: real) -> Impact:
    """The impact with impulses that take effect after so much of the share τ of a step of length h.

    With τ < 0 that is before its start.
    """
    found = impact
    found.delays = delays
    found.way = (ONE - delays) * wp.max(share, ZERO)
    found.rest = wp.max(ONE - delays * share, _LATEST) * h
    found.after = (HALF - share) * h
    return found


@wp.func
def is_impact(approach: real, bounce: real) -> real:
    """From 0 at a separating speed of −`bounce` [m/s] to 1 at twice that speed."""
    return smooth_step(-approach / bounce - ONE)


@wp.func
def is_hit(approach: real, bounce: real, rests: real) -> real:
    """Share of a sample that has part in an impact: where a pair rests on something, slow ones have none.

    Args:
        approach: Its separating speed with which the step begins [m/s].
        bounce: Slowest approach that is an impact [m/s].
        rests: `share_left_out` of the pair.
    """
    return ONE - (ONE - is_impact(approach, bounce)) * rests


@wp.func
def patch_of_sample(
    area: real,
    sunk: real,
    depth: real,
    approach: real,
    bounce: real,
    rests: real,
    arm: vec3,
    normal: vec3,
) -> Patch:
    """What a sample adds to a patch.

    Args:
        area: Of the sample [m²].
        sunk: Its depth where geometry is taken [m].
        depth: δ [m].
        approach: Its separating speed with which the step begins [m/s].
        bounce: Slowest approach that is an impact [m/s].
        rests: `share_left_out` of the pair.
        arm: From the first body's centre of mass [m, W].
        normal: Unit normal [W].
    """
    own = Patch()
    hit = area * is_hit(approach, bounce, rests)
    own.load = hit * fading_in(sunk / depth)
    own.arm = own.load * arm
    own.normal = own.load * normal
    own.near_load = hit * fading_in(sunk / depth + ONE)
    own.near_rate = own.near_load * approach
    return own


@wp.func
def effective_inverse_mass(state: BodyState, arm: vec3, normal: vec3) -> real:
    """1/m + (r × n) · J⁻¹ (r × n): how fast a unit impulse along n makes a body's point at r [1/kg]."""
    moment = wp.cross(arm, normal)
    return state.inverse_mass + wp.dot(moment, state.inverse_inertia * moment)


@wp.func
def share_of_impact(patch: Patch, bounce: real) -> real:
    """β: share of a patch's contact that is an impact.

    A patch approaches at the mean over its load: ahead of a rolling contact single samples always do.
    """
    return is_impact(patch.near_rate / patch.near_load, bounce)


@wp.func
def stiffness_of_impact(
    first: BodyState, second: BodyState, patch: Patch, bounce: real, factor: real, h: real
) -> real:
    """κ [Pa s/m] of a patch whose bodies have met, such that β is its share of how velocities change."""
    arm = patch.arm / patch.load
    normal = patch.normal / patch.load
    inverse_mass = effective_inverse_mass(first, arm, normal)
    inverse_mass += effective_inverse_mass(second, arm + first.position - second.position, normal)
    share = share_of_impact(patch, bounce)
    return share * factor / ((ONE + (ONE - share) * factor) * h * inverse_mass * patch.load)


@wp.func
def stopping_impulse(velocity: vec3, mobility: mat33, normal: vec3, friction: real) -> vec3:
    """Impulse that stops a point, as far as friction can, else one that stops it along the normal [N s].

    Args:
        velocity: Of the point [m/s].
        mobility: Velocity of the point by impulse at it [1/kg].
        normal: Unit normal.
        friction: Coefficient of friction.
    """
    stops = -(wp.inverse(mobility) * velocity)
    presses = wp.dot(normal, stops)
    across = stops - presses * normal
    rubs = wp.length(across)
    if rubs <= friction * presses:
        return stops
    along = normal + (friction / wp.max(rubs, _NOTHING)) * across
    slows = wp.dot(normal, mobility * along)
    slows = wp.max(slows, _JAMS * wp.dot(normal, mobility * normal))
    return (wp.max(-wp.dot(normal, velocity), ZERO) / slows) * along


@wp.struct
class Lever:
    """A point of contact, as the body of a pair that moves sees it."""

    body: BodyState
    sign: real  # 1 where it is the first body, −1 where it is the second
    arm: vec3  # From its centre of mass [m, W]
    normal: vec3  # Unit normal, out of the other body [W]
    mobility: mat33  # Velocity of the point by impulse at it [1/kg]


@wp.func
def lever_of(first: BodyState, second: BodyState, arm: vec3, normal: vec3) -> Lever:
    """Of a point at an arm from the first body's centre of mass, with a normal of any length."""
    at = Lever()
    at.body = first
    at.sign = ONE
    at.arm = arm
    if first.inverse_mass == ZERO:
        at.body = second
        at.sign = -ONE
        at.arm = arm + first.position - second.position
    at.normal = (at.sign / wp.max(wp.length(normal), _NOTHING)) * normal
    across = skew(at.arm)
    at.mobility = wp.diag(vec3(at.body.inverse_mass)) - across * at.body.inverse_inertia * across
    return at


@wp.func
def turning_of(first: BodyState, second: BodyState, velocity: vec3, spin: vec3, turning: int) -> Turning:
    """How points accelerate by turning, of a body with one that is fixed.

    Args:
        first: The sampled body.
        second: The other.
        velocity: Of the one that moves [m/s, W].
        spin: Its spin [rad/s, W].
        turning: How samples turn with their body. Those that keep facing the other body feel nothing of it.
    """
    found = Turning()
    if first.inverse_mass > ZERO:
        inverse = first.inverse_inertia
        if turning == _FIXED:
            found.by_arm = skew(-(inverse * wp.cross(spin, wp.inverse(inverse) * spin)))
        axis = matrix(first.orientation) * vec3(ZERO, ZERO, ONE)
        follows = skew(spin_of_samples(spin, axis, turning))
        found.by_arm += follows * follows
    else:
        # A point of the first body is at rest, and its arm from the second one's centre changes by −v.
        inverse = second.inverse_inertia
        turns = skew(-(inverse * wp.cross(spin, wp.inverse(inverse) * spin)))
        found.by_arm = skew(spin) * skew(spin) - turns
        found.offset = found.by_arm * (first.position - second.position) + TWO * wp.cross(spin, velocity)
    return found


@wp.func
def turning_after(
    first: BodyState, second: BodyState, patch: Patch, friction: real, share: real, turning: int
) -> Turning:
    """How points accelerate by turning after an impact of a body with one that is fixed.

    The spin after it is that of an impulse at the middle of the patch.

    Args:
        first: The sampled body.
        second: The other.
        patch: Samples that have sunk in.
        friction: Coefficient of friction.
        share: τ.
        turning: How samples turn with their body.
    """
    at = lever_of(first, second, patch.arm / patch.load, patch.normal)
    body = at.body
    lead = HALF + share
    v = body.velocity + lead * body.gain
    spin = body.spin + lead * body.spin_gain
    impulse = stopping_impulse(v + wp.cross(spin, at.arm), at.mobility, at.normal, friction)
    after = spin + body.inverse_inertia * wp.cross(at.arm, impulse)
    return turning_of(first, second, v + body.inverse_mass * impulse, after, turning)


@wp.struct
class Rest:
    """Sums over the samples of a pair that it rests on when a step begins, by how near they are.

    Attributes:
        load: Σ w [1].
        near: How near they are, over the depth to which bodies fall in a step [1].
        depth: [m].
        arm: [m, W].
        normal: [W].
    """

    load: real
    near: real
    depth: real
    arm: vec3
    normal: vec3


@wp.func
def fall_of(first: BodyState, second: BodyState, depth: real, h: real) -> real:
    """How far bodies fall towards each other in a step, and δ more [m]: what is nearer is held by contact."""
    return depth + HALF * h * wp.length(first.falls - second.falls)


@wp.func
def rest_of_sample(depth: real, fall: real, approach: real, bounce: real, arm: vec3, normal: vec3) -> Rest:
    """What a sample adds to what a pair rests on.

    Args:
        depth: When the step begins [m].
        fall: What is further away than this does not count [m].
        approach: Its separating speed then [m/s].
        bounce: Slowest approach that is an impact, and slowest rebound [m/s].
        arm: From the first body's centre of mass [m, W].
        normal: Unit normal [W].
    """
    own = Rest()
    near = wp.clamp(ONE + depth / fall, ZERO, TWO)
    slow = (ONE - is_impact(approach, bounce)) * (ONE - smooth_step(approach / bounce))
    own.load = near * near * near * slow
    own.near = own.load * near
    own.depth = own.load * wp.max(depth, ZERO)
    own.arm = own.load * arm
    own.normal = own.load * normal
    return own


@wp.func
def share_of_rest(rest: Rest) -> real:
    """From 0 for a pair that is too far apart to rest to 1 for one that touches."""
    return smooth_step(rest.near / rest.load)


@wp.func
def share_left_out(rest: Rest, factor: real) -> real:
    """Share of slow samples of a pair that have no part in an impact, because it rests on them.

    Where an impact is deep next to what bodies sink in at rest, F is small, and they count.

    Args:
        rest: Of the pair.
        factor: F [1].
    """
    return share_of_rest(rest) * wp.min(factor / _SHARP, ONE)


@wp.func
def depth_beside(rest: Rest, depth: real) -> real:
    """Depth at which another part of a pair meets that rests on something [m]: it is the deepest then."""
    return depth + TWO * rest.depth / rest.load


@wp.func
def support_of(
    first: BodyState, second: BodyState, rest: Rest, friction: real, h: real, turning: int
) -> vec6:
    """Impulse of what a body rests on in a step, on the first body at its centre of mass [N s, N m s, W].

    That of one point, which neither lets it sink in nor, as far as friction can, slip.

    Args:
        first: The sampled body.
        second: The other; one of them is fixed.
        rest: Samples that it rests on.
        friction: Coefficient of friction.
        h: Timestep [s].
        turning: How samples turn with their body.
    """
    arm = rest.arm / rest.load
    at = lever_of(first, second, arm, rest.normal)
    turns = turning_of(first, second, at.body.velocity, at.body.spin, turning)
    bends = at.sign * (turns.by_arm * arm + turns.offset)
    # A velocity is that of the middle of the step before: so is the arm of what slips or leaves.
    moves = at.body.velocity + wp.cross(at.body.spin, at.arm) - (HALF * h) * bends
    nears = wp.min(wp.dot(at.normal, moves), ZERO)
    moves = moves - nears * at.normal
    impulse = stopping_impulse(at.body.gain + h * bends + moves, at.mobility, at.normal, friction)
    share = at.sign * share_of_rest(rest)
    return share * joined(impulse, wp.cross(arm, impulse))


@wp.func
def supported(body: BodyState, impulse: vec6, h: real) -> BodyState:
    """A body that falls and is supported by an impulse at its centre of mass [N s, N m s, W]."""
    found = body
    if body.inverse_mass > ZERO:
        found.gain = body.gain + body.inverse_mass * linear_part(impulse)
        spins = body.inverse_inertia * angular_part(impulse)
        found.spin_gain = body.spin_gain + spins
        found.lag = body.lag + (HALF * h) * spins
        back = wp.transpose(matrix(body.orientation))
        found.ahead = turned(body.orientation, back * (body.spin + found.spin_gain), h)
    return found


@wp.struct
class Gains:
    """What the velocity of a point gains from an impact to the middle of the step [m/s, W]."""

    falls: vec3  # If it leaves
    held: vec3  # By what that differs if it stays


@wp.func
def gains_of(impact: Impact, falls: vec3, arm: vec3, normal: vec3, friction: real) -> Gains:
    """What a point gains that has stopped in an impact.

    It leaves if turning takes it away faster than gravity brings it back. Else its acceleration along the
    normal is none, nor is that across as far as friction holds it, of which turning has its part.

    Args:
        impact: Of the pair.
        falls: What it gains if it leaves [m/s, W].
        arm: From the first body's centre of mass [m, W].
        normal: Unit normal [W].
        friction: Coefficient of friction.
    """
    found = Gains()
    found.falls = falls
    differs = -impact.after * (impact.turns.by_arm * arm + impact.turns.offset) - falls
    along = wp.dot(normal, differs)
    if along * impact.after > ZERO:
        across = differs - along * normal
        most = friction * wp.abs(along)
        size = wp.length(across)
        if size > most:
            across = (most / size) * across
        found.held = along * normal + across
    return found


@wp.func
def may_rest(impact: Impact, sunk: real) -> real:
    """From 0 for a sample at a distance of δ to 1 for one that has sunk in: others have not rested before.

    What gets in only after the impact of another part has its own in the next step.
    """
    return ONE - impact.delays * (ONE - smooth_step(ONE + sunk / impact.depth))


@wp.func
def share_that_rebounds(rebound: real, bounce: real) -> real:
    """From 0 for a rebound of half of `bounce` [m/s] to 1 for `bounce`: slower ones fade out."""
    return smooth_step(TWO * rebound / bounce - ONE)


@wp.func
def impact_goal(
    impact: Impact, rebound: real, rebounds: real, approach: real, normal: vec3, gains: Gains
) -> real:
    """v*: separating speed that a sample aims at [m/s], so high that the damper leaves it at Newton's e |v⁻|.

    What does not rebound stays or leaves without a speed. Where impulses take effect at the start of the
    step, it goes on for the rest of its way instead.

    Args:
        impact: Of the pair.
        rebound: e |v⁻|, with the separating speed v⁻ when bodies meet [m/s].
        rebounds: Share of it that counts.
        approach: Separating speed with which the step begins [m/s].
        normal: Unit normal [W].
        gains: What the velocity gains from then on.
    """
    falls = wp.dot(normal, gains.falls)
    stays = impact.delays * (falls + wp.dot(normal, gains.held)) + impact.way * wp.min(approach, ZERO)
    after = rebounds * (rebound + falls) + (ONE - rebounds) * stays
    return after + wp.max(after - approach, ZERO) / impact.factor


@wp.func
def impact_limit(impact: Impact, depth: real, sunk: real) -> real:
    """Separating speed below which a sample would be too deep at the end of the step [m/s].

    Deeper than δ where impulses act from the start of the step. Where bodies wait until they meet, another
    part may get deeper: its impact is the next step's, at the moment at which it met.

    Args:
        impact: Of the pair.
        depth: Of the sample at the end of the step, without what the end-of-step velocity takes off [m].
        sunk: Where geometry is taken [m].
    """
    before = impact.delays * sunk + (ONE - impact.delays) * depth
    most = impact.depth + impact.delays * (impact.deepest - impact.depth)
    return wp.min(before - most, ZERO) / impact.rest
