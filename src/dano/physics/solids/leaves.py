"""What solids are made of: leaves, each with a kind, a size s and a pose.

In the axes of a leaf, y stands for x = s R y + p.
"""

import warp as wp

from dano.physics.real import mat33, ONE, real, vec3, ZERO


@wp.struct
class Leaf:
    """One part of a solid.

    Attributes:
        factor: Size s [1].
        position: p [m, F].
        rotation: R, leaf → F.
        sizes: Unit normal of a half-space; half extents of a box; radius and half length of a capsule or
            cylinder; radius of a sphere; semi-axes of an ellipsoid; first node of a grid [m].
        length: Offset of a half-space's plane; rounding of a box [m].
        spacing: Between nodes of a grid [m].
    """

    factor: real
    position: vec3
    rotation: mat33
    sizes: vec3
    length: real
    spacing: vec3


@wp.struct
class LeafKind:
    """Whole numbers of a leaf.

    Attributes:
        kind: Its number, see above.
        first: Place of a grid's first spline coefficient.
        nodes_x: Number of coefficients along x, border included.
        nodes_y: Along y.
        nodes_z: Along z.
        degree: Of the spline.
        first_bound: Place of the first lower bound on a grid's spline.
    """

    kind: wp.int32
    first: wp.int32
    nodes_x: wp.int32
    nodes_y: wp.int32
    nodes_z: wp.int32
    degree: wp.int32
    first_bound: wp.int32


@wp.struct
class Solids:
    """All solids of a scene.

    Attributes:
        leaves: Shape (worlds, leaves).
        kinds: Shape (leaves,).
        coefficients: Spline coefficients of all grids [m], shape (worlds, coefficients).
        bounds: Lower bounds on the splines of all grids, one for each `CELL`³ cells [m], (worlds, bounds).
        changes: Of the coefficients, one direction after the other; only for forward derivatives.
    """

    leaves: wp.array2d(dtype=Leaf)
    kinds: wp.array(dtype=LeafKind)
    coefficients: wp.array2d(dtype=real)
    bounds: wp.array2d(dtype=real)
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
