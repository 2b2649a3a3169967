"""The centroid law: one wrench at the centroid of an overlap (docs/theory/contact.md, "The law").

    F_n = ψ max(k − d v_n, 0),    F_t = F_n (μ_s c(v_t) − δ_s v_t),
    τ   = F_n (μ_t c(w_n n) − δ_t w_n n + μ_r c(w_t) − δ_r w_t)

act on the first body at χ, with v and w the velocity of the first body relative to the second there and its
relative spin. The direction of friction is smooth, c(u) = −(2/π) atan(s|u|) u/(ε + |u|), or Coulomb's,
c(u) = −u/max(|u|, v_s): then sliding, torsional and rolling friction have a dual each, see `friction`.
"""

import math

import warp as wp

from dano.physics.friction import following_friction, Friction, friction, friction_with_dual
from dano.physics.overlap import Patch
from dano.physics.real import mat33, ONE, real, vec3, ZERO

_TWO_OVER_PI = wp.constant(real(2.0 / math.pi))


@wp.struct
class PatchMaterial:
    """Numbers of a contact with the centroid law, as `CentroidLaw.numbers` lists them."""

    spring: real  # k [N/kg]
    damper: real  # d [N s/(m kg)]
    sliding_friction: real  # μ_s [1]
    sliding_drag: real  # δ_s [s/m]
    torsional_friction: real  # μ_t [m]
    torsional_drag: real  # δ_t [m s]
    rolling_friction: real  # μ_r [m]
    rolling_drag: real  # δ_r [m s]
    smoothing: real  # s [s/m; s/rad for the moments]
    regularizer: real  # ε [m/s; rad/s]
    stiction: real  # v_s [m/s; rad/s], 0 where friction is smooth


@wp.struct
class PatchMotion:
    """Motion of the first body relative to the second at a patch."""

    rate: real  # Separating speed v_n [m/s]
    slip: vec3  # v_t [m/s]
    drill: vec3  # w_n n [rad/s]
    roll: vec3  # w_t [rad/s]


@wp.struct
class PatchDuals:
    """Unknowns of friction that sticks besides the velocities."""

    slide: vec3  # Sliding friction [N]
    drill: vec3  # Torsional friction [N m]
    roll: vec3  # Rolling friction [N m]


@wp.struct
class NormalForce:
    """Normal force."""

    size: real  # F_n ≥ 0 [N]
    damping: real  # −∂F_n/∂v_n [N s/m]
    sign: real  # 1 where it pushes the bodies apart, −1 where an adhesive contact pulls


@wp.struct
class PatchLinear:
    """The law at given velocities, and its derivatives at given duals."""

    normal: NormalForce  # Normal force
    slide: Friction  # Sliding friction [N], without drag
    drill: Friction  # Torsional friction [N m], without drag
    roll: Friction  # Rolling friction [N m], without drag
    drag: real  # F_n that drag is in proportion to [N]
    drag_damping: real  # −∂/∂v_n of it [N s/m]


@wp.struct
class PatchWrench:
    """Force [N] and moment [N m] on the first body at χ."""

    force: vec3
    moment: vec3


@wp.struct
class PatchJacobian:
    """Derivative of the wrench by the relative twist at χ; the force does not depend on the spin."""

    force: mat33  # Of the force by the velocity [N s/m]
    moment: mat33  # Of the moment by the velocity [N s]
    turning: mat33  # Of the moment by the spin [N m s]


@wp.func
def patch_motion(normal: vec3, velocity: vec3, spin: vec3) -> PatchMotion:
    """Motion at a patch, from the relative velocity there and the relative spin."""
    motion = PatchMotion()
    motion.rate = wp.dot(normal, velocity)
    motion.slip = velocity - motion.rate * normal
    motion.drill = wp.dot(normal, spin) * normal
    motion.roll = spin - motion.drill
    return motion


@wp.func
def normal_force(material: PatchMaterial, overlap: real, rate: real, adhesive: bool) -> NormalForce:
    """ψ max(k − d v_n, 0); of an adhesive contact ψ (k − d v_n), of either sign."""
    found = NormalForce()
    push = material.spring - material.damper * rate
    if push > ZERO:
        found.size = overlap * push
        found.damping = overlap * material.damper
        found.sign = ONE
    elif adhesive and push < ZERO:
        found.size = -overlap * push
        found.damping = -overlap * material.damper
        found.sign = -ONE
    return found


@wp.func
def smooth_gain(material: PatchMaterial, speed: real) -> real:
    """(2/π) atan(s|u|)/(ε + |u|), so that c(u) = −gain u."""
    return _TWO_OVER_PI * wp.atan(material.smoothing * speed) / (material.regularizer + speed)


@wp.func
def smooth_friction(material: PatchMaterial, u: vec3, bound: real, bound_damping: real) -> Friction:
    """B c(u) of the smooth direction of friction, and its derivative."""
    found = Friction()
    speed = wp.length(u)
    gain = smooth_gain(material, speed)
    scaled = material.smoothing * speed
    slope = (_TWO_OVER_PI * material.smoothing / (ONE + scaled * scaled) - gain) / (
        material.regularizer + speed
    )
    found.value = (-bound * gain) * u
    found.by_rate = (bound_damping * gain) * u
    found.grip = bound * gain
    if speed > ZERO:
        found.turning = (bound * slope) * u
        found.direction = u / speed
    return found


@wp.func
def friction_of(material: PatchMaterial, u: vec3, bound: real) -> vec3:
    """B c(u), of whichever kind the material has."""
    found = vec3()
    if material.stiction > ZERO:
        found = friction(u, bound, material.stiction)
    else:
        found = (-bound * smooth_gain(material, wp.length(u))) * u
    return found


@wp.func
def resistance(material: PatchMaterial, u: vec3, dual: vec3, bound: real, bound_damping: real) -> Friction:
    """Friction of at most b against a velocity u, of whichever kind the material has."""
    found = Friction()
    if material.stiction > ZERO:
        found = friction_with_dual(u, dual, bound, bound_damping, material.stiction, ZERO)
    else:
        found = smooth_friction(material, u, bound, bound_damping)
    return found


@wp.func
def linearized_patch(
    material: PatchMaterial,
    overlap: real,
    adhesive: bool,
    motion: PatchMotion,
    duals: PatchDuals,
    share: real,
) -> PatchLinear:
    """One linearisation of the law with its duals.

    Args:
        material: Of the contact.
        overlap: ψ [kg].
        adhesive: Whether the normal force may pull.
        motion: At the patch.
        duals: The duals; unused where friction is smooth.
        share: Of its friction.
    """
    found = PatchLinear()
    found.normal = normal_force(material, overlap, motion.rate, adhesive)
    pressing = share * found.normal.size
    damping = share * found.normal.damping
    found.drag = pressing
    found.drag_damping = damping
    mu = material.sliding_friction
    found.slide = resistance(material, motion.slip, duals.slide, mu * pressing, mu * damping)
    mu = material.torsional_friction
    found.drill = resistance(material, motion.drill, duals.drill, mu * pressing, mu * damping)
    mu = material.rolling_friction
    found.roll = resistance(material, motion.roll, duals.roll, mu * pressing, mu * damping)
    return found


@wp.func
def patch_wrench(
    material: PatchMaterial, normal: vec3, motion: PatchMotion, linear: PatchLinear
) -> PatchWrench:
    """The wrench of a linearised law: the law's own, whatever the duals."""
    found = PatchWrench()
    slide = linear.slide.value + linear.slide.change - (linear.drag * material.sliding_drag) * motion.slip
    drill = linear.drill.value + linear.drill.change - (linear.drag * material.torsional_drag) * motion.drill
    roll = linear.roll.value + linear.roll.change - (linear.drag * material.rolling_drag) * motion.roll
    found.force = (linear.normal.sign * linear.normal.size) * normal + slide
    found.moment = drill + roll
    return found


@wp.func
def resistance_jacobian(found: Friction, drag: real, projection: mat33) -> mat33:
    """Derivative of friction and drag by a velocity u, of which a projection is resisted."""
    return -(found.grip + drag) * projection - wp.outer(found.turning, found.direction)


@wp.func
def patch_jacobian(
    material: PatchMaterial, normal: vec3, motion: PatchMotion, linear: PatchLinear
) -> PatchJacobian:
    """Derivative of the wrench by the relative twist at χ, duals eliminated."""
    found = PatchJacobian()
    along = wp.outer(normal, normal)
    across = wp.identity(n=3, dtype=real) - along
    d = linear.drag_damping
    by_rate = (
        linear.slide.by_rate
        + (d * material.sliding_drag) * motion.slip
        - (linear.normal.sign * linear.normal.damping) * normal
    )
    found.force = wp.outer(by_rate, normal) + resistance_jacobian(
        linear.slide, linear.drag * material.sliding_drag, across
    )
    by_rate = linear.drill.by_rate + linear.roll.by_rate
    by_rate += (d * material.torsional_drag) * motion.drill + (d * material.rolling_drag) * motion.roll
    found.moment = wp.outer(by_rate, normal)
    found.turning = resistance_jacobian(linear.drill, linear.drag * material.torsional_drag, along)
    found.turning += resistance_jacobian(linear.roll, linear.drag * material.rolling_drag, across)
    return found


@wp.func
def patch_law(
    material: PatchMaterial, patch: Patch, adhesive: bool, velocity: vec3, spin: vec3
) -> PatchWrench:
    """The law: the wrench on the first body at χ, from the relative velocity there and the relative spin."""
    found = PatchWrench()
    motion = patch_motion(patch.normal, velocity, spin)
    normal = normal_force(material, patch.overlap, motion.rate, adhesive)
    f = normal.size
    slide = friction_of(material, motion.slip, material.sliding_friction * f)
    drill = friction_of(material, motion.drill, material.torsional_friction * f)
    roll = friction_of(material, motion.roll, material.rolling_friction * f)
    found.force = (normal.sign * f) * patch.normal + slide - (material.sliding_drag * f) * motion.slip
    found.moment = drill - (material.torsional_drag * f) * motion.drill
    found.moment += roll - (material.rolling_drag * f) * motion.roll
    return found


@wp.func
def fitting_patch_duals(
    material: PatchMaterial, overlap: real, adhesive: bool, motion: PatchMotion
) -> PatchDuals:
    """Duals that fit given velocities; zero where friction is smooth."""
    duals = PatchDuals()
    if material.stiction > ZERO:
        pressing = normal_force(material, overlap, motion.rate, adhesive).size
        duals.slide = friction(motion.slip, material.sliding_friction * pressing, material.stiction)
        duals.drill = friction(motion.drill, material.torsional_friction * pressing, material.stiction)
        duals.roll = friction(motion.roll, material.rolling_friction * pressing, material.stiction)
    return duals


@wp.func
def following_patch_duals(linear: PatchLinear, change: PatchMotion) -> PatchDuals:
    """The duals after the motion changed, from the linearisation before."""
    duals = PatchDuals()
    duals.slide = following_friction(linear.slide, change.rate, change.slip)
    duals.drill = following_friction(linear.drill, change.rate, change.drill)
    duals.roll = following_friction(linear.roll, change.rate, change.roll)
    return duals


@wp.func
def missed(change: vec3, friction: real) -> real:
    """By how much a dual misses its friction, as a normal force [N]: a moment over its coefficient [m]."""
    size = wp.abs(change[0]) + wp.abs(change[1]) + wp.abs(change[2])
    return wp.where(friction > ZERO, size / wp.where(friction > ZERO, friction, ONE), ZERO)


@wp.func
def patch_misfit(material: PatchMaterial, linear: PatchLinear) -> real:
    """By how much the duals of a patch miss what fits, in sum [N]."""
    return (
        missed(linear.slide.change, ONE)
        + missed(linear.drill.change, material.torsional_friction)
        + missed(linear.roll.change, material.rolling_friction)
    )
