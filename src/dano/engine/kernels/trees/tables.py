"""What kernels read and write of bodies on joints: see `dano.engine.kernels.tables`."""

import warp as wp

from dano.physics.pairs import BodyState
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
    """Whole numbers of a joint coordinate.

    Attributes:
        place: Among the unknowns.
        constant: 1 where a motor gives what it is told to.
        nonsmooth: 1 where its law has kinks.
        of_ball: 1 for those of a ball joint.
    """

    place: wp.int32
    constant: wp.int32
    nonsmooth: wp.int32
    of_ball: wp.int32


@wp.struct
class Unknown:
    """How an unknown of a tree is eliminated: all that it is coupled with are among its ancestors.

    Attributes:
        parent: The unknown that is eliminated next of those that it is coupled with, or −1.
        depth: Number of ancestors.
        first: Where its entries begin: one for each ancestor, from the root on.
        is_joint: 1 for a coordinate of a joint.
    """

    parent: wp.int32
    depth: wp.int32
    first: wp.int32
    is_joint: wp.int32


@wp.struct
class BlockIndex:
    """Whole numbers of a block of six unknowns.

    Attributes:
        tree: Which tree it belongs to; −1 if it is a free body's or a loop's.
        is_loop: 1 for forces in loops, which are eliminated last.
        used: Unknowns in it; the others are padding.
    """

    tree: wp.int32
    is_loop: wp.int32
    used: wp.int32


@wp.struct
class LoopIndex:
    """Whole numbers of a loop.

    Attributes:
        first: Node of its first body, or −1.
        second: Of its second one.
        first_body: The body, −1 for the world.
        second_body: …
        place: Of its first force among the unknowns.
        width: Numbers that it holds at zero: 3, or 6 for a weld.
    """

    first: wp.int32
    second: wp.int32
    first_body: wp.int32
    second_body: wp.int32
    place: wp.int32
    width: wp.int32


@wp.struct
class Trees:
    """Bodies on joints. Empty where there are none.

    Attributes:
        nodes: Of all bodies that move, shape (m,).
        joints: Shape (worlds, joints).
        laws: Of the coordinates, shape (worlds, coordinates).
        coordinates: Shape (coordinates,).
        unknowns: Shape (6 · blocks,).
        order: Unknowns of trees, in the opposite order of their elimination.
        columns: Unknowns that move bodies, see `Node`.
        blocks: Shape (blocks,).
        closed: 1 for each tree that loops close, shape (trees,).
        loops: Shape (worlds, loops).
        loop_index: Shape (loops,).
    """

    nodes: wp.array(dtype=Node)
    joints: wp.array2d(dtype=Joint)
    laws: wp.array2d(dtype=JointLaw)
    coordinates: wp.array(dtype=Coordinate)
    unknowns: wp.array(dtype=Unknown)
    order: wp.array(dtype=wp.int32)
    columns: wp.array(dtype=wp.int32)
    blocks: wp.array(dtype=BlockIndex)
    closed: wp.array(dtype=wp.int32)
    loops: wp.array2d(dtype=Loop)
    loop_index: wp.array(dtype=LoopIndex)


@wp.struct
class JointState:
    """A coordinate within a step.

    Attributes:
        drive: What drives it.
        ramps: What of its law has kinks.
        rho: ρ [kg m²/s or kg/s].
        dual: λ at the accepted velocities [N m or N].
        change: Of λ by the whole step of the solver.
        resolved: (ρ + g)⁻¹(λ + ρ y) at what was tried last.
        factored: Slope of g with which the Jacobian was factored last.
    """

    drive: JointDrive
    ramps: Ramps
    rho: real
    dual: real
    change: real
    resolved: Resolved
    factored: real


@wp.struct
class Chain:
    """How a body of a tree stands at the start of a step, and how it moves.

    Attributes:
        position: Of the centre of mass [m, W].
        orientation: Body → world.
        before: How the old velocities move it.
        after: How those at the end of the step do.
        change: Twist at the origin of its tree by which the latter differ, by motions at the start.
        work: Virtual twist there.
    """

    position: vec3
    orientation: quat
    before: Displacement
    after: Displacement
    change: vec6
    work: vec6


@wp.struct
class HangingBar:
    """By what the equations ask of a body on a joint besides its momentum.

    Attributes:
        state: By how contact sees it at the start.
        twist: By the twist that contact sees at the end.
        work: By its virtual twist.
        velocity: By its velocity at the end.
        omega: By its spin there [B].
    """

    state: BodyState
    twist: vec6
    work: vec6
    velocity: vec3
    omega: vec3


@wp.struct
class TreeRoom:
    """Where a world works on bodies on joints.

    Attributes:
        q: Joint coordinates at the start of a step, shape (worlds, coordinates).
        v: Their velocities.
        frames: Joint of each node, shape (worlds, m).
        displacements: Of the body of each node in a step.
        pivots: Shift of its joint's pivot [m, W].
        twists: Velocity and spin of that body [W].
        offsets: c of the twist J y + c by which contact sees it move [m/s; rad/s, W].
        wrenches: What the bodies from each node on miss, at the origin of the tree.
        composites: Its derivative.
        start: Twist of each motion at the origin, at the start of a step, shape (worlds, motions).
        end: … at its end, over h.
        columns: J of the bodies that may touch something [W], shape (worlds, columns).
        joints: Shape (worlds, coordinates).
        diagonal: Of the Jacobian of trees, shape (worlds, 6 · blocks).
        lower: What is before it in each row, see `Unknown`, shape (worlds, entries).
        upper: What is above it in each column.
        column: Right-hand side, shape (worlds, 6 · blocks).
        spread: The same for six of them at once.
        impulses: What contact and limits give trees at what was tried last, as generalised momenta, shape
            (worlds, 6 · blocks).
        turned: Angle by which joints turn each node's body in a step [rad].
        coupled: 1 for trees that touch something in the step, or are closed by loops.
        sizes: Magnitude of the velocities [m/s], of the terms in the residual of trees that touch nothing
            [m/s], the compliance of loops [m s/N], and 1 where springs or dampers are strong, shape
            (worlds, 4).
        chains: How the body of each node stands and moves; this and the next are for derivatives.
        chain_bars: Derivatives by these.
        hanging_bars: By what else is asked of bodies on joints.
        asked: Whether some of these are not zero.
        q_bar: By joint coordinates at the start of a step, shape (worlds, coordinates).
        v_bar: By their velocities there.
        q_after: By coordinates at its end.
        v_after: …
    """

    q: wp.array2d(dtype=real)
    v: wp.array2d(dtype=real)
    frames: wp.array2d(dtype=JointFrame)
    displacements: wp.array2d(dtype=Displacement)
    pivots: wp.array2d(dtype=vec3)
    twists: wp.array2d(dtype=vec6)
    offsets: wp.array2d(dtype=vec6)
    wrenches: wp.array2d(dtype=vec6)
    composites: wp.array2d(dtype=Composite)
    start: wp.array2d(dtype=vec6)
    end: wp.array2d(dtype=vec6)
    columns: wp.array2d(dtype=vec6)
    joints: wp.array2d(dtype=JointState)
    diagonal: wp.array2d(dtype=real)
    lower: wp.array2d(dtype=real)
    upper: wp.array2d(dtype=real)
    column: wp.array2d(dtype=real)
    spread: wp.array2d(dtype=vec6)
    impulses: wp.array2d(dtype=real)
    turned: wp.array2d(dtype=real)
    coupled: wp.array2d(dtype=wp.int32)
    sizes: wp.array2d(dtype=real)
    chains: wp.array2d(dtype=Chain)
    chain_bars: wp.array2d(dtype=Chain)
    hanging_bars: wp.array2d(dtype=HangingBar)
    asked: wp.array2d(dtype=wp.int32)
    q_bar: wp.array2d(dtype=real)
    v_bar: wp.array2d(dtype=real)
    q_after: wp.array2d(dtype=real)
    v_after: wp.array2d(dtype=real)
