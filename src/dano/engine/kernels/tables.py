"""What kernels read and write: a scene, what a launch is given, and the room that a world works in.

Arrays have the world as their first axis. Rows of real numbers come from JAX and are read as structures,
whose fields stand in the order of the row; whole numbers are the same for all worlds.
"""

import warp as wp

from dano.engine.kernels.patch_tables import PatchRoom, PatchSide, PatchTables
from dano.engine.kernels.trees.tables import Chain, TreeRoom, Trees
from dano.physics.features import ADJOINTS
from dano.physics.impacts import Impact, Patch, Rest
from dano.physics.overlap import Part, Sums, WeightedSample
from dano.physics.pairs import BodyState
from dano.physics.patch_law import PatchMaterial
from dano.physics.point_law import Duals, Gate, Linear, Material, PointLaw
from dano.physics.real import mat33, mat66, real, vec3, vec4, vec6
from dano.physics.samples import Point, Sample
from dano.physics.solids.leaves import Leaf, Solids
from dano.physics.trees.joint_laws import JointLaw
from dano.physics.trees.joints import Joint
from dano.physics.trees.loops import Loop

BLOCK = 16
"""Samples of a block."""
RUN, LEVELS = 4, 3
"""Blocks that the search looks at together: 4, 16 and 64, the most first."""


@wp.struct
class Body:
    """A body of a scene.

    Attributes:
        mass: [kg].
        inertia: About the centre of mass [kg m², B].
        com: Centre of mass [m, F].
        scale: Semi-axes of a ball or an ellipsoid, ones for others [m].
        middle: Centre of a ball around the body [m, F].
        radius: Of that ball [m].
    """

    mass: real
    inertia: mat33
    com: vec3
    scale: vec3
    middle: vec3
    radius: real


@wp.struct
class BodyIndex:
    """Whole numbers of a body."""

    row: wp.int32  # Place among the bodies that move, or −1; of bodies on joints their node
    first_block: wp.int32  # Of its samples
    blocks: wp.int32  # How many it has
    turning: wp.int32  # How its samples turn
    first_leaf: wp.int32  # Of its solid
    leaves: wp.int32  # How many its solid has


@wp.struct
class SamplePair:
    """Samples of one body (first) that may press on the solid of another (second)."""

    share: real  # Share of the contact's stiffness that this pair carries [1]
    follows: real  # 1 where points follow the second body, which rolls on the first, else 0
    sink: real  # Depth up to which predicted geometry is taken [m]
    impact_depth: real  # δ, depth of an impact [m]
    factor: real  # F of its damper, see `dano.physics.impacts.Impact` [1]
    deepest: real  # Depth that no part gets beyond within a step with an impact of another part [m]
    margin: real  # Distance within which samples count as near [m]
    damper: real  # Hardest damper that a sample is, see `dano.physics.point_law.point_law` [N s/m]


@wp.struct
class PairIndex:
    """Whole numbers of a pair: its bodies, and where its numbers stand, which it shares with equal pairs."""

    first: wp.int32
    second: wp.int32
    contact: wp.int32  # Of `Scene.materials`, or number among the contacts with a patch law
    row: wp.int32  # Of `Scene.pairs`, −1 where points do not press
    number: wp.int32  # Of the contact among those of its kind of law


@wp.struct
class Scene:
    """What stays constant over a rollout.

    Attributes:
        n_blocks: Blocks of six unknowns: one of each free body, and those that joints and loops need.
        bodies: Shape (worlds, n).
        body_index: Shape (n,).
        moving: Bodies that move, shape (m,); with joints in the order of nodes.
        samples: Of all bodies, in blocks, shape (worlds, samples).
        balls: Centre [m, F] and radius [m] of a ball around each block, shape (worlds, blocks).
        slabs: Mean unit normal [F] of each block, and how far along it samples are from its centre [m].
        runs: Balls around blocks of a body that follow each other. Beside its k-th block, for k a multiple of
            `RUN`, that around `RUN` of them; beside the next, for k a multiple of `RUN`², around `RUN`²; ….
        solids: What samples press on.
        n_pressing: Pairs with samples that press.
        pairs: Of pairs that differ, shape (worlds, kinds of pairs).
        pair_index: Shape (pairs + contacts with a patch law,): of each pair with samples that press, then of
            each contact with a patch law.
        partners: Of each body and each other the pair in which the first one's samples press on the other, −1
            for none, shape (n · n,); no rows where all pairs are asked in each step.
        materials: Of contacts with point laws that differ, shape (worlds, kinds of contacts).
        gravity: [m/s²], shape (worlds, 1).
        timestep: h [s], shape (worlds, 1).
        patches: Contacts with a patch law.
        trees: Bodies on joints.
    """

    n_blocks: wp.int32
    n_pressing: wp.int32
    bodies: wp.array2d(dtype=Body)
    body_index: wp.array(dtype=BodyIndex)
    moving: wp.array(dtype=wp.int32)
    samples: wp.array2d(dtype=Sample)
    balls: wp.array2d(dtype=vec4)
    slabs: wp.array2d(dtype=vec4)
    runs: wp.array2d(dtype=vec4)
    solids: Solids
    pairs: wp.array2d(dtype=SamplePair)
    pair_index: wp.array(dtype=PairIndex)
    partners: wp.array(dtype=wp.int32)
    materials: wp.array2d(dtype=Material)
    gravity: wp.array2d(dtype=vec3)
    timestep: wp.array2d(dtype=real)
    patches: PatchTables
    trees: Trees


@wp.func
def numbers_of(scene: wp.ref[Scene], world: int, pair: int) -> SamplePair:
    """What is known of a pair with samples that press."""
    return scene.pairs[world, scene.pair_index[pair].row]


@wp.struct
class Lasting:
    """What is kept from one step to the next."""

    candidates: wp.int32  # Pairs that may be near; −1 where they are not known
    blocks: wp.int32  # Of the Jacobian that are in use
    asleep: wp.int32  # Bodies that sleep
    margin: real  # Largest of all pairs [m]


@wp.struct
class Island:
    """Where lists have what belongs to bodies that touch, also through others: first, beyond last."""

    first: wp.int32  # Of its blocks of unknowns
    end: wp.int32
    first_pair: wp.int32
    end_pair: wp.int32
    first_block: wp.int32  # Of those of the Jacobian
    end_block: wp.int32


@wp.struct
class StateRow:
    """Configuration and motion of a body: see `dano.scene.State`."""

    position: vec3
    orientation: vec4
    velocity: vec3
    omega: vec3


@wp.struct
class Push:
    """Control of a body in a step: force [N, W] and torque [N m, W]."""

    force: vec3
    torque: vec3


@wp.struct
class StepReport:
    """What a step says of itself."""

    residual: real  # Largest that is left of the equations over mass or inertia [m/s, rad/s]
    passes: real  # Of the solver
    solved: real  # 1 where the equations were solved
    overflow: real  # 1 where more points touch than there is room for
    rebound: real  # Share of the restitution with which contact adds no energy


@wp.struct
class FoundPoint:
    """Where a point was found: its sample, its entry among the pairs found, whether it presses back."""

    sample: wp.int32
    pair: wp.int32
    presses_back: wp.int32


@wp.struct
class FoundPair:
    """A pair that is near in a step."""

    pair: wp.int32  # Index among the pairs
    first: wp.int32  # First of its points in a lane's list
    end: wp.int32  # Beyond its last
    critical: wp.int32  # Sample that says when the bodies meet, −1 where they do not within the step
    share: real  # τ
    hits: wp.int32  # 1 where τ is when the bodies are as deep as in an impact
    falls: wp.int32  # 1 where both fall freely until they meet: then gravity takes part in their way
    waits: wp.int32  # 1 where impulses of an impact take effect when the bodies meet
    other: wp.int32  # 1 or −1 where the next pair or the one before is the other side of its impact, else 0
    impact: Impact  # Of the pair
    patch: Patch  # Its samples that have sunk in
    rest: Rest  # Samples that it rests on when the step begins, where it has an impact, too
    # Impulse in the step of what the pair rests on, while a part of it nears an impact; on the first body, at
    # its centre of mass [N s, N m s, W].
    support: vec6
    toward: vec3  # Direction that samples which turn face [F]
    # From the second body's centre of mass to the first's [m, W], each where it is when impulses on it take
    # effect.
    com_difference: vec3


@wp.struct
class Given:
    """What a step is given of bodies. Warp adds derivatives by it to `Bars` of the same name.

    Attributes: those of `Scene` and `Launch` with the same names, of one step;
        seen: `Room.bodies`, with derivatives in `Room.body_bars`.
    """

    bodies: wp.array2d(dtype=Body)
    gravity: wp.array2d(dtype=vec3)
    timestep: wp.array2d(dtype=real)
    state: wp.array2d(dtype=StateRow)
    pushes: wp.array2d(dtype=Push)
    seen: wp.array2d(dtype=BodyState)


@wp.struct
class GivenTrees:
    """The same of bodies on joints.

    Attributes: those of `Trees` and `Launch` with the same names;
        chains: `TreeRoom.chains`, with derivatives in `TreeRoom.chain_bars`.
    """

    joints: wp.array2d(dtype=Joint)
    laws: wp.array2d(dtype=JointLaw)
    loops: wp.array2d(dtype=Loop)
    q: wp.array2d(dtype=real)
    v: wp.array2d(dtype=real)
    efforts: wp.array2d(dtype=real)
    commands: wp.array2d(dtype=real)
    chains: wp.array2d(dtype=Chain)


@wp.struct
class GivenPatches:
    """The same of contacts with a patch law.

    Attributes: those of `PatchTables` with the same names, and leaves of solids;
        sums: `PatchRoom.sums`, with derivatives in `PatchRoom.sum_bars`.
    """

    patch_materials: wp.array2d(dtype=PatchMaterial)
    sides: wp.array2d(dtype=PatchSide)
    leaves: wp.array2d(dtype=Leaf)
    sums: wp.array2d(dtype=Sums)


@wp.struct
class Bars:
    """Derivatives by what a step is given.

    Attributes: those of `Given`, `GivenTrees`, `GivenPatches` and `Scene` with the same names; `weighted` are
    samples of contacts with a patch law, `coefficients` those of `Solids`. These and samples have no columns
    where nobody asks for them.
    """

    bodies: wp.array2d(dtype=Body)
    leaves: wp.array2d(dtype=Leaf)
    pairs: wp.array2d(dtype=SamplePair)
    materials: wp.array2d(dtype=Material)
    gravity: wp.array2d(dtype=vec3)
    timestep: wp.array2d(dtype=real)
    joints: wp.array2d(dtype=Joint)
    laws: wp.array2d(dtype=JointLaw)
    loops: wp.array2d(dtype=Loop)
    patch_materials: wp.array2d(dtype=PatchMaterial)
    sides: wp.array2d(dtype=PatchSide)
    parts: wp.array2d(dtype=Part)
    state: wp.array2d(dtype=StateRow)
    pushes: wp.array2d(dtype=Push)
    q: wp.array2d(dtype=real)
    v: wp.array2d(dtype=real)
    efforts: wp.array2d(dtype=real)
    commands: wp.array2d(dtype=real)
    samples: wp.array2d(dtype=Sample)
    weighted: wp.array2d(dtype=WeightedSample)
    coefficients: wp.array2d(dtype=real)


@wp.struct
class Room:
    """Where a world works: arrays that nothing outside reads.

    Attributes:
        bodies: State of each body at the start of the step.
        momentum: That each moving body has before contact [kg m/s; kg m²/s, W].
        inertia: Of each moving body [kg m², W].
        bounds: Centre of a ball around each body [m, W], and how far anything of it reaches from there within
            the step [m]; only where candidates are kept.
        kept: The same when candidates were listed, with room to move.
        lasting: What else is kept, shape (worlds, 1).
        sorted: Bodies along an axis.
        marked: A bit for each pair that is a candidate.
        candidates: Pairs that may be near.
        partners: The body that a body has an impact with, see `dano.engine.kernels.impacts`.
        found: Pairs that are near, then those whose patches touch, shape (worlds, pairs · lanes).
        where: Of each point where it was found, shape (worlds, capacity).
        points: The points.
        laws: Their constants.
        gates: Whether they stay apart.
        marks: Whether they have duals, and whether they press: see `dano.engine.kernels.assembly`.
        duals: At the accepted velocities.
        changes: Of the duals by the whole step.
        linear: The law as it was linearised last.
        near: Blocks whose samples may meet a solid within the step, of each lane a part.
        until: Share of the step before which none of such a block does.
        some: Blocks of the pair that is looked at that may be near.
        bound: Beneath the clearance of their samples when the step begins [m].
        blocks: Of the Jacobian, those that are not zero, row by row, shape (worlds, blocks · blocks + 1).
        spare: The same, used up by the solve.
        used: Of each row and column the place of its block, from 1 on, or 0.
        order: Of elimination; later neighbours; their numbers.
        later: …
        counts: …
        beside: With which others a block is coupled, and with how many.
        neighbours: …
        degrees: With how many that are to be eliminated.
        islands: First of the blocks with which a block is coupled, by others, too: see `linear_solve`.
        members: Blocks of unknowns, island by island.
        sorted_pairs: Pairs with points, island by island.
        of_islands: Where islands begin and end, by the first of their blocks.
        rests: Whether bodies that move rest at the end of a step.
        asleep: Number of the island that each of them sleeps with, −1 where it is awake.
        sizes: Of the velocities that each body's momentum stands for [m/s].
        listed: Row and column of each block of the Jacobian.
        begins: Where those of each row begin and end.
        ends: …
        velocity: Accepted, of each free body [m/s; rad/s, W], or six coordinates of joints; (worlds, blocks).
        old: Those of the step before; only with joints.
        tried: …
        best: Where the residual was smallest.
        meetings: Of each moving body what waits for when it meets others, see `dano.engine.kernels.impacts`.
        step: Of Newton's method.
        residual: What each block misses [kg m/s; kg m²/s, W].
        scale: Turns momenta into velocities [1/kg; 1/(kg m²)].
        patches: Contacts with a patch law.
        trees: Room for bodies on joints.
        given: What the step is given; only for derivatives.
        given_trees: …
        given_patches: …
        bars: Derivatives by it.
        body_bars: By `bodies`.
        after_bar: By the states at the end of a step.
        wrenches: Impulse of each pair that is near, at the first body's centre of mass [N s, N m s, W].
        missing: Changes of the equations of a step, shape (worlds, directions · m).
        moving: Changes of what the step is given, one direction after the other.
        along: What they make of a number, by directions.
        lane_sums: … by changes of samples and coefficients, of each lane, shape (worlds, directions · lanes).
    """

    bodies: wp.array2d(dtype=BodyState)
    momentum: wp.array2d(dtype=vec6)
    inertia: wp.array2d(dtype=mat33)
    bounds: wp.array2d(dtype=vec4)
    kept: wp.array2d(dtype=vec4)
    lasting: wp.array2d(dtype=Lasting)
    sorted: wp.array2d(dtype=wp.int32)
    marked: wp.array2d(dtype=wp.uint32)
    candidates: wp.array2d(dtype=wp.int32)
    partners: wp.array2d(dtype=wp.int32)
    found: wp.array2d(dtype=FoundPair)
    where: wp.array2d(dtype=FoundPoint)
    points: wp.array2d(dtype=Point)
    laws: wp.array2d(dtype=PointLaw)
    gates: wp.array2d(dtype=Gate)
    marks: wp.array2d(dtype=wp.int32)
    duals: wp.array2d(dtype=Duals)
    changes: wp.array2d(dtype=Duals)
    linear: wp.array2d(dtype=Linear)
    near: wp.array2d(dtype=wp.int32)
    until: wp.array2d(dtype=real)
    some: wp.array2d(dtype=wp.int32)
    bound: wp.array2d(dtype=real)
    blocks: wp.array2d(dtype=mat66)
    spare: wp.array2d(dtype=mat66)
    used: wp.array2d(dtype=wp.int32)
    order: wp.array2d(dtype=wp.int32)
    later: wp.array2d(dtype=wp.int32)
    counts: wp.array2d(dtype=wp.int32)
    beside: wp.array2d(dtype=wp.int32)
    neighbours: wp.array2d(dtype=wp.int32)
    degrees: wp.array2d(dtype=wp.int32)
    islands: wp.array2d(dtype=wp.int32)
    members: wp.array2d(dtype=wp.int32)
    sorted_pairs: wp.array2d(dtype=wp.int32)
    of_islands: wp.array2d(dtype=Island)
    rests: wp.array2d(dtype=wp.int32)
    asleep: wp.array2d(dtype=wp.int32)
    sizes: wp.array2d(dtype=real)
    listed: wp.array2d(dtype=wp.int32)
    begins: wp.array2d(dtype=wp.int32)
    ends: wp.array2d(dtype=wp.int32)
    velocity: wp.array2d(dtype=vec6)
    old: wp.array2d(dtype=vec6)
    tried: wp.array2d(dtype=vec6)
    best: wp.array2d(dtype=vec6)
    meetings: wp.array2d(dtype=vec3)
    step: wp.array2d(dtype=vec6)
    residual: wp.array2d(dtype=vec6)
    scale: wp.array2d(dtype=vec6)
    patches: PatchRoom
    trees: TreeRoom
    wrenches: wp.array2d(dtype=vec6)
    if ADJOINTS:
        given: Given
        given_trees: GivenTrees
        given_patches: GivenPatches
        bars: Bars
        body_bars: wp.array2d(dtype=BodyState)
        after_bar: wp.array2d(dtype=StateRow)
        missing: wp.array2d(dtype=vec6)
        along: wp.array2d(dtype=real)
        moving: wp.array2d(dtype=real)
        lane_sums: wp.array2d(dtype=real)


@wp.struct
class Ends:
    """What derivatives of a rollout are given, and what they give: derivatives, or changes in directions.

    All are numbers in the order of a launch, of shape (worlds, …); changes are one direction after the other.

    Attributes:
        given: What is given at the start of the rollout.
        changes: Its changes.
        values: What a step is given, as `Room.given` and others show it.
        bars: Derivatives by it, as `Room.bars` shows them.
        after: By the state at the end of a step.
        ends: By those at the ends of all steps, or their changes.
        controls: By the controls of all steps, or their changes.
        samples: Changes of samples; no columns where they do not change.
        weighted: …
    """

    given: wp.array2d(dtype=real)
    changes: wp.array2d(dtype=real)
    values: wp.array2d(dtype=real)
    bars: wp.array2d(dtype=real)
    after: wp.array2d(dtype=real)
    ends: wp.array2d(dtype=real)
    controls: wp.array2d(dtype=real)
    samples: wp.array2d(dtype=Sample)
    weighted: wp.array2d(dtype=WeightedSample)
