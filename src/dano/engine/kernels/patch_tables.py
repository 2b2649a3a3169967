"""What kernels read and write for contacts with a patch law: parts of `tables.Scene` and `tables.Room`."""

import warp as wp

from dano.physics.overlap import Fields, Patch, Sums, WeightedSample
from dano.physics.patch_law import PatchDuals, PatchLinear, PatchMaterial
from dano.physics.real import mat66, real, vec3, vec4, vec6


@wp.struct
class PatchSide:
    """One side of a contact: the samples of a body in the field of another."""

    density_scale: real  # Makes the field's density dimensionless
    middle: vec3  # Centre of a ball around the samples [m, F]
    radius: real  # Of that ball [m]


@wp.struct
class PatchSideIndex:
    """Whole numbers of a side."""

    sampled: wp.int32  # The sampled body
    queried: wp.int32  # The body with the field
    first_block: wp.int32  # Of the samples
    blocks: wp.int32  # How many there are
    first_part: wp.int32  # Of the field
    parts: wp.int32  # How many it has
    # Leaf of the sampled body where it is a ball on a half-space, whose overlap has a closed form; else −1.
    ball: wp.int32


@wp.struct
class PatchContact:
    """Whole numbers of a contact."""

    first: wp.int32  # The body that the wrench acts on
    second: wp.int32  # The other body
    pair: wp.int32  # Index of both in `Scene.pair_index`
    first_side: wp.int32  # Of its sides
    sides: wp.int32  # How many it has: one or two
    adhesive: wp.int32  # 1 where the normal force may pull


@wp.struct
class PatchTables:
    """Contacts with a patch law."""

    contacts: wp.array(dtype=PatchContact)  # Shape (contacts,)
    materials: wp.array2d(dtype=PatchMaterial)  # Shape (worlds, contacts)
    sides: wp.array2d(dtype=PatchSide)  # Shape (worlds, sides)
    side_index: wp.array(dtype=PatchSideIndex)  # Shape (sides,)
    samples: wp.array2d(dtype=WeightedSample)  # Weighted samples in blocks, shape (worlds, samples)
    # Centre [m, F] and radius [m] of a ball around each block, shape (worlds, blocks).
    balls: wp.array2d(dtype=vec4)
    runs: wp.array2d(dtype=vec4)  # Balls around each block and those after it, `RUN` in all
    fields: Fields  # Fields that are queried; their leaves stand among those of `Scene.solids`


@wp.struct
class PatchRoom:
    """Where a world keeps its patches, shape (worlds, contacts) unless said."""

    count: wp.array2d(dtype=wp.int32)  # How many touch, shape (worlds, 1)
    patches: wp.array2d(dtype=Patch)  # Of all contacts, at the start of the step
    arms: wp.array2d(dtype=vec3)  # From the first body's centre of mass to χ [m, W]
    duals: wp.array2d(dtype=PatchDuals)  # At the accepted velocities
    changes: wp.array2d(dtype=PatchDuals)  # Of the duals by the whole step
    linear: wp.array2d(dtype=PatchLinear)  # The law as it was linearised last
    wrenches: wp.array2d(dtype=vec6)  # In the step, about the first body's centre of mass [N s; N m s, W]
    jacobians: wp.array2d(dtype=mat66)  # Their derivatives by the relative twist there
    sums: wp.array2d(dtype=Sums)  # Over the samples of each side, shape (worlds, sides); only for derivatives
    sum_bars: wp.array2d(dtype=Sums)  # Derivatives by these
