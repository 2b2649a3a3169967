"""The formulas of a step, once, as functions of NVIDIA Warp that run on CPU cores and GPUs.

They are named and ordered as docs/theory: `rotations` and `momentum` (the integrator), `solids`, `pairs`
and `samples` (finding contact), `point_law` (the distributed law), `overlap`, `patch_law` and `friction` (the
centroid law), `twists`, `trees` (joints and loops). Kernels in `dano.engine` are loops around them and
own no formula. A structure says its units in its docstring; rows of numbers from JAX are read as such
structures, in the order of their fields.

Importing this package imports Warp, which takes half a second: only what makes steps does.
"""
