"""Types of numbers in formulas: 64 bits wide, or 32 where a GPU is to be fast.

Names are those of the quantities: `real` a number, `vec3` a vector, `mat33` a matrix, `vec6` a twist or
wrench (linear part first), `mat66` its derivative by another, `quat` a unit quaternion as Warp stores it
(x, y, z, w). Rows that come from JAX keep quaternions as (w, x, y, z), see `rotations.from_wxyz`.
"""

import warp as wp

from dano.physics.features import WIDE

real = wp.float64 if WIDE else wp.float32
vec3 = wp.types.vector(length=3, dtype=real)
vec4 = wp.types.vector(length=4, dtype=real)
vec6 = wp.types.vector(length=6, dtype=real)
mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
mat36 = wp.types.matrix(shape=(3, 6), dtype=real)
mat66 = wp.types.matrix(shape=(6, 6), dtype=real)
quat = wp.types.quaternion(dtype=real)

ZERO = wp.constant(real(0.0))
HALF = wp.constant(real(0.5))
ONE = wp.constant(real(1.0))
TWO = wp.constant(real(2.0))
INFINITY = wp.constant(real(1e300 if WIDE else 1e30))
"""Larger than any length, time or speed that occurs."""
