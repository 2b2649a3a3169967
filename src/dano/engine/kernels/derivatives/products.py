"""Sums of derivatives, and units that a derivative is asked for in."""

import warp as wp

from dano.engine.kernels.derivatives.adjoint import Touching, Virtual
from dano.engine.kernels.lanes import total_of
from dano.engine.kernels.tables import StateRow
from dano.engine.kernels.trees.tables import Chain
from dano.physics.overlap import View, WeightedSample
from dano.physics.pairs import BodyState
from dano.physics.point_law import Material
from dano.physics.real import ONE, vec6
from dano.physics.samples import Sample
from dano.physics.solids.leaves import Leaf
from dano.physics.structures import adding_of, addition_of, product_of, scaled_of, sum_of

sample_product, weighted_product = product_of(Sample), product_of(WeightedSample)
body_product, row_product = product_of(BodyState), product_of(StateRow)
add_to_touching, total_touching = adding_of(Touching), total_of(Touching)
add_to_twists, total_twists = adding_of(Virtual), total_of(Virtual)
summed_body, scaled_body = sum_of(BodyState), scaled_of(BodyState)
summed_chain = sum_of(Chain)
summed_view, total_view = sum_of(View), total_of(View)
scaled_leaf = scaled_of(Leaf)
add_to_leaf, add_to_material, add_to_row = addition_of(Leaf), addition_of(Material), addition_of(StateRow)


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
