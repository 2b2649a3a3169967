"""Changes of what a rollout is given, and their products with derivatives by it; sums of derivatives."""

import warp as wp

from dano.engine.kernels.lanes import total_of
from dano.engine.kernels.rollout import Launch
from dano.engine.kernels.tables import Body, Changes, Moment, Push, SamplePair, StateRow
from dano.physics.overlap import WeightedSample
from dano.physics.pairs import BodyState, PairPose
from dano.physics.patch_law import PatchMaterial
from dano.physics.point_law import Material
from dano.physics.real import ONE, vec3, vec6
from dano.physics.samples import Sample
from dano.physics.solids.leaves import Leaf
from dano.physics.structures import adding_of, addition_of, product_of, scaled_of, sum_of
from dano.physics.trees.joint_laws import JointLaw
from dano.physics.trees.joints import Joint
from dano.physics.trees.loops import Loop

row_product = product_of(StateRow)
body_product = product_of(Body)
leaf_product = product_of(Leaf)
pair_product = product_of(SamplePair)
material_product = product_of(Material)
patch_material_product = product_of(PatchMaterial)
weighted_product = product_of(WeightedSample)
sample_product = product_of(Sample)
push_product = product_of(Push)
moment_product = product_of(Moment)
joint_product = product_of(Joint)
law_product = product_of(JointLaw)
loop_product = product_of(Loop)

add_to_material, total_material = adding_of(Material), total_of(Material)
add_to_pose, total_pose = adding_of(PairPose), total_of(PairPose)
summed_body, scaled_body, total_body = sum_of(BodyState), scaled_of(BodyState), total_of(BodyState)
scaled_leaf = scaled_of(Leaf)

add_row = addition_of(StateRow)
add_to_leaf = addition_of(Leaf)
add_patch_material = addition_of(PatchMaterial)
add_joint = addition_of(Joint)
add_law = addition_of(JointLaw)
add_loop = addition_of(Loop)


@wp.func
def row_change(
    launch: wp.ref[Launch], changes: wp.ref[Changes], world: int, t: int, i: int, direction: int, n: int
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
def unit_vec3(k: int) -> vec3:
    """The k-th unit vector."""
    unit = vec3()
    unit[k] = ONE
    return unit
