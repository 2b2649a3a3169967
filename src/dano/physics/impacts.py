"""Impacts of bodies with point contacts (docs/theory/contact.md, "Impacts").

An impact happens when a body has sunk into another by a stated depth δ. The samples that have sunk in are its
patch; they count with weights w(d/δ) that fade in with depth. A damper between what they do and their goals
brings them there within a step,

    p = κ w (v* − v_n)⁺,    κ = β F/(1 + (1 − β) F) m_eff / (h Σ A w).

Nothing of this depends on where in a step the bodies meet, on the number of samples, or, but for h κ, on h.
"""

import warp as wp

from dano.physics.pairs import BodyState
from dano.physics.real import ONE, real, TWO, vec3, ZERO

# F: momentum that the damper passes on, by that of the common mass, for each speed that is missing. The
# softer, the more samples share an impact; goals make up for it.
_FACTOR = wp.constant(real(100.0))
# Least share of a step after an impact.
_LATEST = wp.constant(real(1e-6))


@wp.struct
class Patch:
    """Sums over the samples of a pair that have sunk in, where its geometry is taken.

    Attributes:
        load: Σ A w [m²].
        arm: [m³, W].
        normal: [m², W].
        near_load: Σ A w of samples that have sunk in or nearly have [m²].
        near_rate: Their separating speed, weighted by that load [m³/s].
    """

    load: real
    arm: vec3
    normal: vec3
    near_load: real
    near_rate: real


@wp.struct
class Impact:
    """The impact of a pair.

    Attributes:
        share: β, share of the contact that is an impact and no lasting contact [1].
        stiffness: κ [Pa s/m], zero where bodies have not sunk in far enough.
        depth: δ [m].
        part: Share of the impact that the pair carries, ½ where samples of both bodies do [1].
        delays: Impulses take effect after this share of τ: β where they wait for when bodies meet, 0 where
            they act from the start of the step.
        way: Share of the step in which bodies go on as before, all the same.
        rest: Time from when impulses take effect to the end of the step [s].
    """

    share: real
    stiffness: real
    depth: real
    part: real
    delays: real
    way: real
    rest: real


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
def layer_of(depth: real, share: real) -> real:
    """Distance [m] within which samples nearly have sunk in: where geometry is taken early, others follow.

    Args:
        depth: δ [m].
        share: τ. Towards the end of the step the layer fades out.
    """
    return depth * smooth_step(real(4.0) * (ONE - share))


@wp.func
def no_impact(depth: real, h: real) -> Impact:
    """That of contact that lasts: nothing happens within the step of length h."""
    impact = Impact()
    impact.depth = depth
    impact.part = ONE
    impact.rest = h
    return impact


@wp.func
def delayed(impact: Impact, delays: real, share: real, h: real) -> Impact:
    """The impact with impulses that take effect after so much of the share τ of a step of length h."""
    found = impact
    found.delays = delays
    found.way = (ONE - delays) * share
    found.rest = wp.max(ONE - delays * share, _LATEST) * h
    return found


@wp.func
def with_sample(
    patch: Patch,
    area: real,
    sunk: real,
    depth: real,
    layer: real,
    approach: real,
    arm: vec3,
    normal: vec3,
) -> Patch:
    """A patch with one more sample.

    Args:
        patch: The patch.
        area: Of the sample [m²].
        sunk: Its depth where geometry is taken [m].
        depth: δ [m].
        layer: Within so much of the surface samples nearly have sunk in [m].
        approach: Its separating speed with which the step begins [m/s].
        arm: From the first body's centre of mass [m, W].
        normal: Unit normal [W].
    """
    found = patch
    weight = area * fading_in(sunk / depth)
    found.load += weight
    found.arm += weight * arm
    found.normal += weight * normal
    near = area * fading_in((sunk + layer) / depth)
    found.near_load += near
    found.near_rate += near * approach
    return found


@wp.func
def effective_inverse_mass(state: BodyState, arm: vec3, normal: vec3) -> real:
    """1/m + (r × n) · J⁻¹ (r × n): how fast a unit impulse along n makes a body's point at r [1/kg]."""
    moment = wp.cross(arm, normal)
    return state.inverse_mass + wp.dot(moment, state.inverse_inertia * moment)


@wp.func
def is_impact(approach: real, bounce: real) -> real:
    """From 0 at a separating speed of −`bounce` [m/s] to 1 at twice that speed."""
    return smooth_step(-approach / bounce - ONE)


@wp.func
def share_of_impact(patch: Patch, bounce: real) -> real:
    """β: share of a patch's contact that is an impact.

    A patch approaches at the mean over its load: ahead of a rolling contact single samples always do.
    """
    return is_impact(patch.near_rate / patch.near_load, bounce)


@wp.func
def stiffness_of_impact(first: BodyState, second: BodyState, patch: Patch, bounce: real, h: real) -> real:
    """κ [Pa s/m] of a patch whose bodies have met, such that β is its share of how velocities change."""
    arm = patch.arm / patch.load
    normal = patch.normal / patch.load
    inverse_mass = effective_inverse_mass(first, arm, normal)
    inverse_mass += effective_inverse_mass(second, arm + first.position - second.position, normal)
    share = share_of_impact(patch, bounce)
    return share * _FACTOR / ((ONE + (ONE - share) * _FACTOR) * h * inverse_mass * patch.load)


@wp.func
def impact_goal(
    impact: Impact, restitution: real, bounce: real, approach: real, meets: real, gains: real
) -> real:
    """v*: separating speed that a sample aims at [m/s], so high that the damper leaves it at Newton's e |v⁻|.

    Rebounds slower than `bounce` fade out. Where impulses take effect at the start of the step, what does not
    rebound goes on for the rest of its way.

    Args:
        impact: Of the pair.
        restitution: e [1].
        bounce: Slowest rebound [m/s].
        approach: Separating speed with which the step begins [m/s].
        meets: v⁻, separating speed when bodies meet [m/s].
        gains: What gravity adds to it from then on [m/s].
    """
    rebound = -restitution * meets
    rebounds = smooth_step(TWO * rebound / bounce - ONE)
    after = rebounds * (rebound + gains) + (ONE - rebounds) * impact.way * wp.min(approach, ZERO)
    return after + wp.max(after - approach, ZERO) / _FACTOR


@wp.func
def impact_limit(impact: Impact, depth: real, sunk: real) -> real:
    """Separating speed below which a sample would be deeper than the impact at the end of the step [m/s].

    Args:
        impact: Of the pair.
        depth: Of the sample at the end of the step, without what the end-of-step velocity takes off [m].
        sunk: Where geometry is taken [m].
    """
    before = impact.delays * sunk + (ONE - impact.delays) * depth
    return wp.min(before - impact.depth, ZERO) / impact.rest
