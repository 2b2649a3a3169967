"""Changes of what a rollout is given, and their products with derivatives by it, number by number; sums."""

import warp as wp

from dano.engine.kernels.lanes import total, total3, total33
from dano.engine.kernels.rollout import Launch
from dano.engine.kernels.tables import Body, Changes, Push, SamplePair, StateRow
from dano.physics.features import LANES
from dano.physics.overlap import WeightedSample
from dano.physics.pairs import BodyState, PairPose
from dano.physics.patch_law import PatchMaterial
from dano.physics.point_law import Material
from dano.physics.real import ONE, real, vec6
from dano.physics.samples import Sample
from dano.physics.solids.leaves import Leaf
from dano.physics.trees.joint_laws import JointLaw
from dano.physics.trees.loops import Loop


@wp.func
def row_product(a: StateRow, b: StateRow) -> real:
    """⟨a, b⟩ of rows of states."""
    return (
        wp.dot(a.position, b.position)
        + wp.dot(a.orientation, b.orientation)
        + wp.dot(a.velocity, b.velocity)
        + wp.dot(a.omega, b.omega)
    )


@wp.func
def body_product(a: Body, b: Body) -> real:
    """⟨a, b⟩ of what bodies are."""
    return a.mass * b.mass + wp.ddot(a.inertia, b.inertia) + wp.dot(a.com, b.com) + wp.dot(a.scale, b.scale)


@wp.func
def leaf_product(a: Leaf, b: Leaf) -> real:
    """⟨a, b⟩ of leaves of solids."""
    return (
        a.factor * b.factor
        + wp.dot(a.position, b.position)
        + wp.ddot(a.rotation, b.rotation)
        + wp.dot(a.sizes, b.sizes)
        + a.length * b.length
        + wp.dot(a.spacing, b.spacing)
    )


@wp.func
def pair_product(a: SamplePair, b: SamplePair) -> real:
    """⟨a, b⟩ of pairs with samples that press, whose other numbers only choose samples."""
    return a.share * b.share + a.sink * b.sink + a.impact_depth * b.impact_depth


@wp.func
def material_product(a: Material, b: Material) -> real:
    """⟨a, b⟩ of materials."""
    return (
        a.stiffness * b.stiffness
        + a.restitution * b.restitution
        + a.restitution_velocity * b.restitution_velocity
        + a.hysteresis * b.hysteresis
        + a.friction * b.friction
        + a.friction_fading * b.friction_fading
        + a.friction_pressure * b.friction_pressure
        + a.stiction * b.stiction
        + a.ahead * b.ahead
        + a.timestep * b.timestep
        + a.bounce * b.bounce
        + a.uplift * b.uplift
    )


@wp.func
def patch_material_product(a: PatchMaterial, b: PatchMaterial) -> real:
    """⟨a, b⟩ of numbers of contacts with a patch law."""
    return (
        a.spring * b.spring
        + a.damper * b.damper
        + a.sliding_friction * b.sliding_friction
        + a.sliding_drag * b.sliding_drag
        + a.torsional_friction * b.torsional_friction
        + a.torsional_drag * b.torsional_drag
        + a.rolling_friction * b.rolling_friction
        + a.rolling_drag * b.rolling_drag
        + a.smoothing * b.smoothing
        + a.regularizer * b.regularizer
        + a.stiction * b.stiction
    )


@wp.func
def weighted_product(a: WeightedSample, b: WeightedSample) -> real:
    """⟨a, b⟩ of weighted samples."""
    return wp.dot(a.point, b.point) + a.weight * b.weight


@wp.func
def sample_product(a: Sample, b: Sample) -> real:
    """⟨a, b⟩ of samples."""
    return wp.dot(a.point, b.point) + wp.dot(a.area, b.area)


@wp.func
def push_product(a: Push, b: Push) -> real:
    """⟨a, b⟩ of controls of bodies."""
    return wp.dot(a.force, b.force) + wp.dot(a.torque, b.torque)


@wp.func
def law_product(a: JointLaw, b: JointLaw) -> real:
    """⟨a, b⟩ of what acts on coordinates."""
    return (
        a.damping * b.damping
        + a.armature * b.armature
        + a.stiffness * b.stiffness
        + a.rest * b.rest
        + a.friction * b.friction
        + a.least * b.least
        + a.most * b.most
        + a.gear * b.gear
        + a.motor_stiffness * b.motor_stiffness
        + a.motor_damping * b.motor_damping
        + a.least_effort * b.least_effort
        + a.most_effort * b.most_effort
    )


@wp.func
def loop_product(a: Loop, b: Loop) -> real:
    """⟨a, b⟩ of loops."""
    return wp.dot(a.position, b.position) + wp.dot(a.anchor, b.anchor) + wp.dot(a.orientation, b.orientation)


@wp.func
def row_change(
    launch: Launch, changes: Changes, world: int, t: int, i: int, direction: int, n: int
) -> StateRow:
    """Change of a body's state at the start of a step."""
    if t == 0:
        if changes.state.shape[1] == 0:
            return StateRow()
        return changes.state[world, direction * n + i]
    return changes.states[world, (direction * launch.n_steps + t - 1) * n + i]


@wp.func
def unit_row(k: int) -> StateRow:
    """A row of a state with a one."""
    unit = StateRow()
    if k < 3:
        unit.position[k] = ONE
    elif k < 7:
        unit.orientation[k - 3] = ONE
    elif k < 10:
        unit.velocity[k - 7] = ONE
    else:
        unit.omega[k - 10] = ONE
    return unit


@wp.func
def unit_vector(k: int) -> vec6:
    """The k-th unit vector."""
    unit = vec6()
    unit[k] = ONE
    return unit


@wp.func
def summed_material(a: Material, b: Material) -> Material:
    """Sum of two derivatives by a material."""
    a.stiffness += b.stiffness
    a.restitution += b.restitution
    a.restitution_velocity += b.restitution_velocity
    a.hysteresis += b.hysteresis
    a.friction += b.friction
    a.friction_fading += b.friction_fading
    a.friction_pressure += b.friction_pressure
    a.stiction += b.stiction
    a.ahead += b.ahead
    a.timestep += b.timestep
    a.bounce += b.bounce
    a.uplift += b.uplift
    return a


@wp.func
def total_material(a: Material) -> Material:
    """Sum over the lanes of a world."""
    if wp.static(LANES > 1):
        a.stiffness = total(a.stiffness)
        a.restitution = total(a.restitution)
        a.restitution_velocity = total(a.restitution_velocity)
        a.hysteresis = total(a.hysteresis)
        a.friction = total(a.friction)
        a.friction_fading = total(a.friction_fading)
        a.friction_pressure = total(a.friction_pressure)
        a.stiction = total(a.stiction)
        a.ahead = total(a.ahead)
        a.timestep = total(a.timestep)
        a.bounce = total(a.bounce)
        a.uplift = total(a.uplift)
    return a


@wp.func
def summed_pose(a: PairPose, b: PairPose) -> PairPose:
    """Sum of two derivatives by a pose."""
    a.points += b.points
    a.origin += b.origin
    a.vectors += b.vectors
    a.rotation += b.rotation
    a.com += b.com
    a.velocity += b.velocity
    a.spin += b.spin
    a.com_difference += b.com_difference
    a.arms += b.arms
    a.arm_offset += b.arm_offset
    a.lowest += b.lowest
    a.axis += b.axis
    return a


@wp.func
def total_pose(a: PairPose) -> PairPose:
    """Sum over the lanes of a world."""
    if wp.static(LANES > 1):
        a.points = total33(a.points)
        a.origin = total3(a.origin)
        a.vectors = total33(a.vectors)
        a.rotation = total33(a.rotation)
        a.com = total3(a.com)
        a.velocity = total3(a.velocity)
        a.spin = total3(a.spin)
        a.com_difference = total3(a.com_difference)
        a.arms = total33(a.arms)
        a.arm_offset = total3(a.arm_offset)
        a.lowest = total3(a.lowest)
        a.axis = total3(a.axis)
    return a


@wp.func
def summed_body(a: BodyState, b: BodyState) -> BodyState:
    """Sum of two derivatives by the state of a body."""
    a.position += b.position
    a.orientation = a.orientation + b.orientation
    a.ahead = a.ahead + b.ahead
    a.velocity += b.velocity
    a.spin += b.spin
    a.com += b.com
    a.inverse_mass += b.inverse_mass
    a.inverse_inertia += b.inverse_inertia
    return a


@wp.func
def scaled_body(s: real, a: BodyState) -> BodyState:
    """A derivative by the state of a body, times a number."""
    a.position *= s
    a.orientation = a.orientation * s
    a.ahead = a.ahead * s
    a.velocity *= s
    a.spin *= s
    a.com *= s
    a.inverse_mass *= s
    a.inverse_inertia *= s
    return a
