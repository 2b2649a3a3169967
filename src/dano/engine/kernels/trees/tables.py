"""What kernels read and write of bodies on joints: see `dano.engine.kernels.tables`."""

import warp as wp

from dano.physics.real import quat, real, vec3, vec6
from dano.physics.trees.composites import Composite
from dano.physics.trees.joint_laws import JointDrive, JointLaw, Ramps, Resolved
from dano.physics.trees.joints import Displacement, Joint, JointFrame
from dano.physics.trees.loops import Loop


@wp.struct
class Node:
    """A body that moves, and what lets it: a joint, or nothing that holds it. Parents come before children.

    Attributes:
        body: The body.
        parent: Node on which it hangs, or −1.
        carrier: Body on which it hangs, −1 for the world.
        kind: See `dano.physics.trees.joints`.
        joint: Row of its joint, or −1.
        coordinate: Place of its first coordinate among q; 0 where it has none.
        place: Of its first velocity among the unknowns: 6 · block + row.
        width: Number of velocities that move it beside those of its parent.
        motion: First of its motions.
        origin: Body from which its tree is looked at.
        first_column: Of the unknowns that move it, if it may touch something.
        columns: How many there are.
        alone: 1 for a body that moves freely and carries nothing.
        tree: Which tree it belongs to, or −1 if it is alone.
    """

    body: wp.int32
    parent: wp.int32
    carrier: wp.int32
    kind: wp.int32
    joint: wp.int32
    coordinate: wp.int32
    place: wp.int32
    width: wp.int32
    motion: wp.int32
    origin: wp.int32
    first_column: wp.int32
    columns: wp.int32
    alone: wp.int32
    tree: wp.int32


@wp.struct
class Coordinate:
    """Whole numbers of a joint coordinate."""

    place: wp.int32  # Among the unknowns
    constant: wp.int32  # 1 where a motor gives what it is told to
    nonsmooth: wp.int32  # 1 where its law has kinks
    of_ball: wp.int32  # 1 for those of a ball joint


@wp.struct
class Unknown:
    """How an unknown of a tree is eliminated: all that it is coupled with are among its ancestors."""

    parent: wp.int32  # The unknown that is eliminated next of those that it is coupled with, or −1
    depth: wp.int32  # Number of ancestors
    first: wp.int32  # Where its entries begin: one for each ancestor, from the root on
    is_joint: wp.int32  # 1 for a coordinate of a joint


@wp.struct
class BlockIndex:
    """Whole numbers of a block of six unknowns."""

    tree: wp.int32  # Which tree it belongs to; −1 if it is a free body's or a loop's
    is_loop: wp.int32  # 1 for forces in loops, which are eliminated last
    used: wp.int32  # Unknowns in it; the others are padding


@wp.struct
class LoopIndex:
    """Whole numbers of a loop."""

    first: wp.int32  # Node of its first body, or −1
    second: wp.int32  # Of its second one
    first_body: wp.int32  # The body, −1 for the world
    second_body: wp.int32  # …
    place: wp.int32  # Of its first force among the unknowns
    width: wp.int32  # Numbers that it holds at zero: 3, or 6 for a weld


@wp.struct
class Trees:
    """Bodies on joints. Empty where there are none."""

    nodes: wp.array(dtype=Node)  # Of all bodies that move, shape (m,)
    joints: wp.array2d(dtype=Joint)  # Shape (worlds, joints)
    laws: wp.array2d(dtype=JointLaw)  # Of the coordinates, shape (worlds, coordinates)
    coordinates: wp.array(dtype=Coordinate)  # Shape (coordinates,)
    unknowns: wp.array(dtype=Unknown)  # Shape (6 · blocks,)
    order: wp.array(dtype=wp.int32)  # Unknowns of trees, in the opposite order of their elimination
    columns: wp.array(dtype=wp.int32)  # Unknowns that move bodies, see `Node`
    blocks: wp.array(dtype=BlockIndex)  # Shape (blocks,)
    closed: wp.array(dtype=wp.int32)  # 1 for each tree that loops close, shape (trees,)
    loops: wp.array2d(dtype=Loop)  # Shape (worlds, loops)
    loop_index: wp.array(dtype=LoopIndex)  # Shape (loops,)


@wp.struct
class JointState:
    """A coordinate within a step."""

    drive: JointDrive  # What drives it
    ramps: Ramps  # What of its law has kinks
    rho: real  # ρ [kg m²/s or kg/s]
    dual: real  # λ at the accepted velocities [N m or N]
    change: real  # Of λ by the whole step of the solver
    resolved: Resolved  # (ρ + g)⁻¹(λ + ρ y) at what was tried last
    factored: real  # Slope of g with which the Jacobian was factored last


@wp.struct
class Chain:
    """How a body of a tree stands at the start of a step, and how it moves."""

    position: vec3  # Of the centre of mass [m, W]
    orientation: quat  # Body → world
    before: Displacement  # How the old velocities move it
    after: Displacement  # How those at the end of the step do
    change: vec6  # Twist at the origin of its tree by which the latter differ, by motions at the start
    work: vec6  # Virtual twist there


@wp.struct
class HangingBar:
    """By what the equations ask of a body on a joint besides its momentum."""

    twist: vec6  # By the twist that contact sees at the end
    work: vec6  # By its virtual twist
    velocity: vec3  # By its velocity at the end
    omega: vec3  # By its spin there [B]


@wp.struct
class TreeRoom:
    """Where a world works on bodies on joints."""

    q: wp.array2d(dtype=real)  # Joint coordinates at the start of a step, shape (worlds, coordinates)
    v: wp.array2d(dtype=real)  # Their velocities
    frames: wp.array2d(dtype=JointFrame)  # Joint of each node, shape (worlds, m)
    displacements: wp.array2d(dtype=Displacement)  # Of the body of each node in a step
    pivots: wp.array2d(dtype=vec3)  # Shift of its joint's pivot [m, W]
    twists: wp.array2d(dtype=vec6)  # Velocity and spin of that body [W]
    offsets: wp.array2d(dtype=vec6)  # c of the twist J y + c by which contact sees it move [m/s; rad/s, W]
    wrenches: wp.array2d(dtype=vec6)  # What the bodies from each node on miss, at the origin of the tree
    composites: wp.array2d(dtype=Composite)  # Its derivative
    # Twist of each motion at the origin, at the start of a step, shape (worlds, motions).
    start: wp.array2d(dtype=vec6)
    end: wp.array2d(dtype=vec6)  # … at its end, over h
    columns: wp.array2d(dtype=vec6)  # J of the bodies that may touch something [W], shape (worlds, columns)
    joints: wp.array2d(dtype=JointState)  # Shape (worlds, coordinates)
    diagonal: wp.array2d(dtype=real)  # Of the Jacobian of trees, shape (worlds, 6 · blocks)
    lower: wp.array2d(dtype=real)  # What is before it in each row, see `Unknown`, shape (worlds, entries)
    upper: wp.array2d(dtype=real)  # What is above it in each column
    column: wp.array2d(dtype=real)  # Right-hand side, shape (worlds, 6 · blocks)
    spread: wp.array2d(dtype=vec6)  # The same for six of them at once
    # What contact and limits give trees at what was tried last, as generalised momenta, shape (worlds, 6 ·
    # blocks).
    impulses: wp.array2d(dtype=real)
    turned: wp.array2d(dtype=real)  # Angle by which joints turn each node's body in a step [rad]
    # 1 for trees that touch something in the step, or are closed by loops.
    coupled: wp.array2d(dtype=wp.int32)
    # Magnitude of the velocities [m/s], of the terms in the residual of trees that touch nothing [m/s], the
    # compliance of loops [m s/N], and 1 where springs or dampers are strong, shape (worlds, 4).
    sizes: wp.array2d(dtype=real)
    # How the body of each node stands and moves; this and the next are for derivatives.
    chains: wp.array2d(dtype=Chain)
    chain_bars: wp.array2d(dtype=Chain)  # Derivatives by these
    hanging_bars: wp.array2d(dtype=HangingBar)  # By what else is asked of bodies on joints
    asked: wp.array2d(dtype=wp.int32)  # Whether some of these are not zero
    q_after: wp.array2d(dtype=real)  # By coordinates at the end of a step, shape (worlds, coordinates)
    v_after: wp.array2d(dtype=real)  # …
