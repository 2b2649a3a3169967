"""What kernels read and write for contacts with a patch law: parts of `tables.Scene` and `tables.Room`."""

import warp as wp

from dano.physics.overlap import Fields, Patch, Sums, WeightedSample
from dano.physics.patch_law import PatchDuals, PatchLinear, PatchMaterial
from dano.physics.real import mat66, real, vec3, vec4, vec6


@wp.struct
class PatchSide:
    """One side of a contact: the samples of a body in the field of another.

    Attributes:
        density_scale: Makes the field's density dimensionless.
        middle: Centre of a ball around the samples [m, F].
        radius: Of that ball [m].
    """

    density_scale: real
    middle: vec3
    radius: real


@wp.struct
class PatchSideIndex:
    """Whole numbers of a side.

    Attributes:
        sampled: The sampled body.
        queried: The body with the field.
        first_block: Of the samples.
        blocks: How many there are.
        first_part: Of the field.
        parts: How many it has.
        ball: Leaf of the sampled body where it is a ball on a half-space, whose overlap has a closed form;
            else −1.
    """

    sampled: wp.int32
    queried: wp.int32
    first_block: wp.int32
    blocks: wp.int32
    first_part: wp.int32
    parts: wp.int32
    ball: wp.int32


@wp.struct
class PatchContact:
    """Whole numbers of a contact.

    Attributes:
        first: The body that the wrench acts on.
        second: The other body.
        pair: Index of both in `Scene.pair_index`.
        first_side: Of its sides.
        sides: How many it has: one or two.
        adhesive: 1 where the normal force may pull.
    """

    first: wp.int32
    second: wp.int32
    pair: wp.int32
    first_side: wp.int32
    sides: wp.int32
    adhesive: wp.int32


@wp.struct
class PatchTables:
    """Contacts with a patch law.

    Attributes:
        contacts: Shape (contacts,).
        materials: Shape (worlds, contacts).
        sides: Shape (worlds, sides).
        side_index: Shape (sides,).
        samples: Weighted samples in blocks, shape (worlds, samples).
        balls: Centre [m, F] and radius [m] of a ball around each block, shape (worlds, blocks).
        runs: Balls around each block and those after it, `RUN` in all.
        fields: Fields that are queried; their leaves stand among those of `Scene.solids`.
    """

    contacts: wp.array(dtype=PatchContact)
    materials: wp.array2d(dtype=PatchMaterial)
    sides: wp.array2d(dtype=PatchSide)
    side_index: wp.array(dtype=PatchSideIndex)
    samples: wp.array2d(dtype=WeightedSample)
    balls: wp.array2d(dtype=vec4)
    runs: wp.array2d(dtype=vec4)
    fields: Fields


@wp.struct
class PatchRoom:
    """Where a world keeps its patches, shape (worlds, contacts) unless said.

    Attributes:
        count: How many touch, shape (worlds, 1).
        patches: Of all contacts, at the start of the step.
        arms: From the first body's centre of mass to χ [m, W].
        duals: At the accepted velocities.
        changes: Of the duals by the whole step.
        linear: The law as it was linearised last.
        wrenches: In the step, about the first body's centre of mass [N s; N m s, W].
        jacobians: Their derivatives by the relative twist there.
        sums: Over the samples of each side, shape (worlds, sides); only for derivatives.
    """

    count: wp.array2d(dtype=wp.int32)
    patches: wp.array2d(dtype=Patch)
    arms: wp.array2d(dtype=vec3)
    duals: wp.array2d(dtype=PatchDuals)
    changes: wp.array2d(dtype=PatchDuals)
    linear: wp.array2d(dtype=PatchLinear)
    wrenches: wp.array2d(dtype=vec6)
    jacobians: wp.array2d(dtype=mat66)
    sums: wp.array2d(dtype=Sums)
