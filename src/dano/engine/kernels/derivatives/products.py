"""Changes of what a rollout is given, and their products with derivatives by it, number by number."""

import warp as wp

from dano.engine.kernels.rollout import Launch
from dano.engine.kernels.tables import Body, Changes, Push, StateRow
from dano.physics.overlap import WeightedSample
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
