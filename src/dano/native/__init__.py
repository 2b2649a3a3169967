"""Kernels compiled for this machine, and solids as they read them."""

from dano.native._instances import (
    Features as Features,
    fields_of as fields_of,
    instance as instance,
)
from dano.native._layout import (
    Array as Array,
    Layout as Layout,
    layout_of as layout_of,
    Parameters as Parameters,
)
from dano.native._leaves import (
    balls_around_runs as balls_around_runs,
    is_known as is_known,
    kind_number as kind_number,
    kind_numbers as kind_numbers,
    kinds_of as kinds_of,
    leaf_tables as leaf_tables,
    LEAF_WIDTH as LEAF_WIDTH,
    Leaves as Leaves,
    leaves_of as leaves_of,
    lower_bounds as lower_bounds,
    PlacedField as PlacedField,
    shape_kinds as shape_kinds,
    slabs_of_blocks as slabs_of_blocks,
)
from dano.native._objects import (
    ARCHITECTURES as ARCHITECTURES,
    cpu_kernel as cpu_kernel,
    Kernel as Kernel,
    kernel_in_lanes as kernel_in_lanes,
    KernelLaunch as KernelLaunch,
    LEVELS as LEVELS,
    make_cubin as make_cubin,
    make_object as make_object,
    n_cores as n_cores,
    shipped_path as shipped_path,
    together as together,
    what_is_shipped as what_is_shipped,
)
from dano.native._warp import begin as begin, compiled_kernel as compiled_kernel, FLAGS as FLAGS
