"""What the search for contacts reads and writes: tables of a model, MuJoCo's own arrays, rows of contacts.

Whatever may touch is a *part*: a geom of the model, in the geom's frame, or an object, in the frame of its
body. MuJoCo's arrays are read where they are.
"""

import warp as wp

from dano.physics.real import mat33, real, vec3, vec4, vec6
from dano.physics.samples import Sample
from dano.physics.solids.leaves import Solids

BLOCK = 16
"""Samples of a block."""
RUN = 8
"""Blocks that the search looks at together first."""

vec2 = wp.types.vector(length=2, dtype=real)
vec5 = wp.types.vector(length=5, dtype=real)
vec8 = wp.types.vector(length=8, dtype=real)
vec9 = wp.types.vector(length=9, dtype=real)


@wp.struct
class Part:
    """A geom or an object.

    Attributes:
        middle: Centre of a ball and of a box around an object [m]; geoms have it at their origin.
        half: Half the sides of that box, along the axes of the frame [m]; endless where there is none.
        scale: Semi-axes of a ball or an ellipsoid, ones for others [m].
        radius: Of the ball around an object [m]; unused for geoms.
        thickness: Half of what is to be gone through at the thickest place [m].
        band: How far from their planes the flat faces of an object say its distance [m].
        slack: How much less than the sampled distance that may be [m].
        grain: Area of one of its samples [m²].
        corner_share: Samples for which one of a polyhedron's corners stands.
    """

    middle: vec3
    half: vec3
    scale: vec3
    radius: real
    thickness: real
    band: real
    slack: real
    grain: real
    corner_share: real


@wp.struct
class PartIndex:
    """Whole numbers of a part."""

    body: wp.int32  # Body that it moves with
    geom: wp.int32  # Geom that it is, or that stands for the object
    is_object: wp.int32  # 1 for an object
    first_block: wp.int32  # Of its samples
    blocks: wp.int32  # How many it has; none where its samples are not asked
    first_run: wp.int32  # Of runs of its blocks
    first_corner_block: wp.int32  # Of a polyhedron's corners, which are asked against half-spaces
    corner_blocks: wp.int32  # How many of these there are; none for what is no polyhedron
    first_corner_run: wp.int32  # Of runs of these
    turning: wp.int32  # How its samples turn
    solid: wp.int32  # Kind of its solid, see `dano.mujoco.kernels.solids`; −1 for none
    at: wp.int32  # Leaf of a solid of `dano.physics`, first plane of a hull, height field
    count: wp.int32  # Planes of a hull
    first_face: wp.int32  # Of the flat faces of an object
    faces: wp.int32  # How many it has
    contype: wp.int32  # Of an object, as of MuJoCo's geoms
    conaffinity: wp.int32  # The same


@wp.struct
class Face:
    """A convex flat face of an object."""

    plane: vec4  # Unit outward normal and offset [m]
    first: wp.int32  # Of the planes through its edges, normal to it
    count: wp.int32  # How many there are


@wp.struct
class TouchPair:
    """Two parts that may touch; the second is an object."""

    first: wp.int32  # Part
    second: wp.int32  # Part
    both: wp.int32  # 1 where samples of the first are asked, too


@wp.struct
class Known:
    """What is known of a model."""

    parts: wp.array(dtype=Part)  # Shape (p,)
    index: wp.array(dtype=PartIndex)  # Shape (p,)
    pairs: wp.array(dtype=TouchPair)  # Shape (k,)
    samples: wp.array(dtype=Sample)  # Of all parts, in blocks
    precedence: wp.array(dtype=real)  # Of each sample as a head of others, see `dano.mujoco.kernels.merging`
    balls: wp.array(dtype=vec4)  # Centre and radius [m] of a ball around each block
    runs: wp.array(dtype=vec4)  # The same around each run of blocks
    solids: Solids  # Sampled distances and shapes
    planes: wp.array(dtype=vec4)  # Unit outward normal and offset [m] of the faces of hulls
    faces: wp.array(dtype=Face)  # Of objects
    edges: wp.array(dtype=vec4)  # Planes through the edges of faces
    facing: wp.array(dtype=vec3)  # Normal of the face that each sample lies within, zero for none
    rim: wp.array(dtype=wp.int32)  # 1 where it lies on the edge of a face
    sizes: wp.array(dtype=vec3)  # Of the geoms when this was made [m], shape (geoms,)


@wp.struct
class Model:
    """Arrays of `mjModel`, with its names. Those with two axes may differ between worlds, the first."""

    body_rootid: wp.array(dtype=wp.int32)
    geom_size: wp.array2d(dtype=vec3)
    geom_rbound: wp.array2d(dtype=real)
    geom_margin: wp.array2d(dtype=real)
    geom_gap: wp.array2d(dtype=real)
    geom_friction: wp.array2d(dtype=vec3)
    geom_solref: wp.array2d(dtype=vec2)
    geom_solimp: wp.array2d(dtype=vec5)
    geom_solmix: wp.array2d(dtype=real)
    geom_priority: wp.array(dtype=wp.int32)
    geom_condim: wp.array(dtype=wp.int32)
    geom_contype: wp.array(dtype=wp.int32)
    geom_conaffinity: wp.array(dtype=wp.int32)
    hfield_size: wp.array(dtype=vec4)
    hfield_nrow: wp.array(dtype=wp.int32)
    hfield_ncol: wp.array(dtype=wp.int32)
    hfield_adr: wp.array(dtype=wp.int32)
    hfield_data: wp.array(dtype=wp.float32)


@wp.struct
class Data:
    """Arrays of `mjData`, with its names, for one world or more."""

    xpos: wp.array2d(dtype=vec3)
    xmat: wp.array2d(dtype=mat33)
    xipos: wp.array2d(dtype=vec3)
    geom_xpos: wp.array2d(dtype=vec3)
    geom_xmat: wp.array2d(dtype=mat33)
    cvel: wp.array2d(dtype=vec6)
    subtree_com: wp.array2d(dtype=vec3)


@wp.struct
class Settings:
    """Parameters of the contacts of a pair, see `dano.mujoco.Settings`.

    Attributes:
        margin: [m].
        gap: [m].
        friction: Shape (5,).
        solref: …
        solimp: …
        dim: Directions of force; 0: the two do not touch.
    """

    margin: real
    gap: real
    friction: vec5
    solref: vec2
    solimp: vec5
    dim: real


@wp.struct
class Options:
    """What a step is told besides."""

    timestep: real  # h [s]
    most: real  # Contacts of a pair
    given: real  # 1 where `settings` has those of each pair, 0 where they are mixed of those of two geoms
    # 1 where the model's global contact parameters replace those of geoms: those of the first row of
    # `settings`.
    overridden: real
    # 1 where contacts are listed from margin and gap on and press from the margin on, as MuJoCo has it since
    # some version; 0 where they are listed from the margin on and press a gap later.
    beyond: real
    within: real  # 1 where the solver takes no contact beyond its margin, see `mixing.held_back`


@wp.struct
class Touch:
    """A sample that touches, or will within the step.

    Attributes:
        weight: Its area times its depth at the end of the step, or now if that is more [m³].
        position: Between the two surfaces [m, W].
        normal: From the first part to the second [W].
        slope: How the gap grows along the face, of flat ones [1, W].
        gap: Between the surfaces, negative where they overlap [m].
        nearing: Speed at which the gap closes [m/s].
        area: What of the sample's area faces the other body [m²].
        score: How much it counts as a head of others, see `dano.mujoco.kernels.merging`.
        precedence: See `Known`.
        kept: Share of its weight that it keeps, see `dano.mujoco.kernels.merging`.
        presses: 0 where it only counts as near.
        flat: 1 where the normal is that of a flat face of an object, 2 where what is round presses on it.
    """

    weight: real
    position: vec3
    normal: vec3
    slope: vec3
    gap: real
    nearing: real
    area: real
    score: real
    precedence: real
    kept: real
    presses: wp.int32
    flat: wp.int32


@wp.struct
class Heads:
    """Eight heads, and what they stand for: sums over their shares w of loads. Arms are from the head on.

    Attributes:
        x: Where they are [m, W], by axis.
        y: …
        z: …
        normal_x: Their normals [W], by axis.
        normal_y: …
        normal_z: …
        kept: What they keep of their own load, 0 where there is no head.
        pulls: How much they draw a sample.
        weight: Σ w [m³].
        squares: Σ w · load, with the whole load [m⁶].
        force_x: Σ w n [m³], by axis.
        force_y: …
        force_z: …
        moment_x: Σ w arm × n [m⁴], by axis.
        moment_y: …
        moment_z: …
        place_x: Σ w arm [m⁴], by axis.
        place_y: …
        place_z: …
        gap: Σ w · gap [m⁴].
        nearing: Σ w · nearing [m⁴/s].
    """

    x: vec8
    y: vec8
    z: vec8
    normal_x: vec8
    normal_y: vec8
    normal_z: vec8
    kept: vec8
    pulls: vec8
    weight: vec8
    squares: vec8
    force_x: vec8
    force_y: vec8
    force_z: vec8
    moment_x: vec8
    moment_y: vec8
    moment_z: vec8
    place_x: vec8
    place_y: vec8
    place_z: vec8
    gap: vec8
    nearing: vec8


@wp.struct
class ContactRow:
    """The part of MuJoCo's `mjContact` that has real numbers, in its order, with its names."""

    dist: real
    pos: vec3
    frame: vec9
    includemargin: real
    friction: vec5
    solref: vec2
    solreffriction: vec2
    solimp: vec5


@wp.struct
class ContactIndex:
    """What is whole in MuJoCo's `mjContact`, in its order, with its names."""

    dim: wp.int32
    geom1: wp.int32
    geom2: wp.int32
    first: wp.int32
    second: wp.int32
    flex1: wp.int32
    flex2: wp.int32
    elem1: wp.int32
    elem2: wp.int32
    vert1: wp.int32
    vert2: wp.int32
    exclude: wp.int32
    efc_address: wp.int32


@wp.struct
class Work:
    """What a search is told, works in, and finds."""

    options: wp.array(dtype=Options)  # Shape (1,)
    settings: wp.array(dtype=Settings)  # Shape (k,), see `Options`
    touches: wp.array(dtype=Touch)  # Room for the samples of a pair that touch
    scores: wp.array(dtype=real)  # Room for the highest of them, shape (most + 1,)
    heads: wp.array(dtype=wp.int32)  # Room for which of them are heads, shape (most,)
    groups: wp.array(dtype=Heads)  # Room for them, eight in a group
    rows: wp.array(dtype=ContactRow)  # The contacts
    index: wp.array(dtype=ContactIndex)  # The same
    # Number of contacts, or −1 where sizes of geoms differ from those that are known; shape (1,).
    found: wp.array(dtype=wp.int32)
