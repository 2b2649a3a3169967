"""Kernels compiled for this machine, and solids as they read them."""

from dano.native._cores import n_cores as n_cores, together as together
from dano.native._instances import Features as Features, instance as instance
from dano.native._leaves import (
    balls_around_runs as balls_around_runs,
    degrees_of as degrees_of,
    is_known as is_known,
    kind_number as kind_number,
    kind_numbers as kind_numbers,
    kinds_of as kinds_of,
    leaf_tables as leaf_tables,
    LEAF_WIDTH as LEAF_WIDTH,
    Leaves as Leaves,
    leaves_of as leaves_of,
    lower_bounds as lower_bounds,
    Placed as Placed,
    shape_kinds as shape_kinds,
    slabs_of_blocks as slabs_of_blocks,
)
from dano.native._warp import begin as begin, compiled_kernel as compiled_kernel
