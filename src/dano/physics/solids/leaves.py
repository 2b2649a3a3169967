"""What solids are made of: leaves, each with a kind, a size s and a pose.

In the axes of a leaf, y stands for x = s R y + p.
"""

import warp as wp

from dano.physics.real import mat33, ONE, real, vec3, ZERO


@wp.struct
class Leaf:
    """One part of a solid."""

    factor: real  # Size s [1]
    position: vec3  # p [m, F]
    rotation: mat33  # R, leaf → F
    # Unit normal of a half-space; half extents of a box; radius and half length of a capsule or cylinder;
    # radius of a sphere; semi-axes of an ellipsoid; first node of a grid [m].
    sizes: vec3
    length: real  # Offset of a half-space's plane; rounding of a box [m]
    spacing: vec3  # Between nodes of a grid [m]


@wp.struct
class LeafKind:
    """Whole numbers of a leaf."""

    kind: wp.int32  # Its number, see above
    first: wp.int32  # Place of a grid's first spline coefficient
    nodes_x: wp.int32  # Number of coefficients along x, border included
    nodes_y: wp.int32  # Along y
    nodes_z: wp.int32  # Along z
    degree: wp.int32  # Of the spline
    first_bound: wp.int32  # Place of the first lower bound on a grid's spline


@wp.struct
class Solids:
    """All solids of a scene."""

    leaves: wp.array2d(dtype=Leaf)  # Shape (worlds, leaves)
    kinds: wp.array(dtype=LeafKind)  # Shape (leaves,)
    coefficients: wp.array2d(dtype=real)  # Spline coefficients of all grids [m], shape (worlds, coefficients)
    # Lower bounds on the splines of all grids, one for each `CELL`³ cells [m], (worlds, bounds).
    bounds: wp.array2d(dtype=real)
    # Of the coefficients, one direction after the other; only for forward derivatives.
    changes: wp.array2d(dtype=real)


@wp.struct
class Distance:
    """Signed distance [m], negative inside, and its gradient [1]."""

    value: real
    gradient: vec3


@wp.func
def inverse_or_zero(x: real) -> real:
    """1 / x, or 0 at 0."""
    return wp.where(x > ZERO, ONE / wp.where(x > ZERO, x, ONE), ZERO)


@wp.func
def root_or_zero(x: real) -> real:
    """√x, which counts as constant at 0, where it has no derivative."""
    return wp.where(x > ZERO, wp.sqrt(wp.where(x > ZERO, x, ONE)), ZERO)
