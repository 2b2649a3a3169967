"""What the wrench of a patch depends on, as numbers whose gradients are derivatives (docs/gradients.md).

As in `adjoint`: the work of the wrench along virtual velocities, from the sums over samples on; then what these
ask of each sample's density, and of the poses of both bodies.
"""

import warp as wp

from dano.engine.kernels.derivatives.adjoint import need_adjoints, Virtual
from dano.engine.kernels.patch_tables import PatchContact, PatchTables
from dano.engine.kernels.patches import frame_of
from dano.engine.kernels.tables import Given, GivenPatches
from dano.physics.features import KINDS
from dano.physics.overlap import (
    added,
    cap_patch,
    Density,
    Field,
    grid_density,
    in_leaf,
    Part,
    PartKind,
    Patch,
    patch_of,
    plane_density,
    sample_sums,
    shell_density,
    Sums,
    sums_in_world,
    View,
    view_of,
    WeightedSample,
)
from dano.physics.patch_law import patch_law
from dano.physics.real import ONE, real, vec3, ZERO
from dano.physics.solids.distances import Solid
from dano.physics.solids.kinds import HALF_SPACE, SPHERE
from dano.physics.solids.leaves import Distance, Solids
from dano.physics.structures import product_of
from dano.physics.twists import relative_twist


@wp.func
def patch_of_sides(
    given: Given,
    patches: GivenPatches,
    tables: PatchTables,
    world: int,
    contact: PatchContact,
) -> Patch:
    """The patch of a contact from the sums over the samples of its sides."""
    patch = Patch()
    whole = Sums()
    is_cap = bool(False)
    for k in range(2):
        if k < contact.sides:
            s = contact.first_side + k
            index = tables.side_index[s]
            sampled = frame_of(given.seen[world, index.sampled])
            queried = frame_of(given.seen[world, index.queried])
            mass = given.bodies[world, index.sampled].mass
            sign = wp.where(index.sampled == contact.first, ONE, -ONE)
            if index.ball >= 0:
                if wp.static(SPHERE in KINDS and HALF_SPACE in KINDS):
                    plane = tables.fields.kinds[index.first_part].first_leaf
                    patch = cap_patch(
                        patches.leaves[world, index.ball],
                        patches.leaves[world, plane],
                        sampled,
                        queried,
                        mass,
                    )
                    patch.normal = sign * patch.normal
                    is_cap = True
            else:
                own = patches.sums[world, s]
                if own.share > ZERO:
                    mass = mass * patches.sides[world, s].density_scale
                    whole = added(whole, sums_in_world(own, sampled, queried, mass, sign))
    if not is_cap:
        patch = patch_of(whole, ZERO)
    return patch


@wp.func
def patch_work(
    given: Given,
    patches: GivenPatches,
    tables: PatchTables,
    world: int,
    c: int,
    twists: Virtual,
) -> real:
    """Work of the impulse of a patch along the virtual velocities of its bodies."""
    contact = tables.contacts[c]
    patch = patch_of_sides(given, patches, tables, world, contact)
    first = given.seen[world, contact.first].position
    apart = first - given.seen[world, contact.second].position
    arm = patch.centroid - first
    twist = relative_twist(twists.first, twists.second, apart)
    virtual = relative_twist(twists.first_virtual, twists.second_virtual, apart)
    slip = twist.velocity + wp.cross(twist.spin, arm)
    found = patch_law(patches.patch_materials[world, c], patch, contact.adhesive > 0, slip, twist.spin)
    moved = virtual.velocity + wp.cross(virtual.spin, arm)
    return given.timestep[world, 0] * (wp.dot(found.force, moved) + wp.dot(found.moment, virtual.spin))


sums_product, view_product = product_of(Sums), product_of(View)
density_product = product_of(Density)


@wp.func
def sample_sums_work(sample: WeightedSample, found: Density, bar: Sums) -> real:
    """⟨bar, what one sample adds⟩."""
    return sums_product(bar, sample_sums(sample, found))


@wp.func
def plane_work(view: View, edge: real, point: vec3, bar: Density) -> real:
    """⟨bar, density of a half-space at a sample⟩."""
    return density_product(bar, plane_density(view, edge, point))


@wp.func
def shell_work(part: Part, kind: PartKind, solid: Solid, x: vec3, d: Distance, bar: Density) -> real:
    """⟨bar, density of a solid at a distance⟩."""
    return density_product(bar, shell_density(part, kind, solid, x, d))


@wp.func
def grid_work(solids: Solids, world: int, solid: Solid, x: vec3, bar: Density) -> real:
    """⟨bar, density of a grid at a point⟩."""
    found = grid_density(solids, world, solid.kind, solid.leaf, in_leaf(solid.leaf, x))
    return density_product(bar, found)


@wp.func
def view_work(
    given: Given,
    patches: GivenPatches,
    world: int,
    sampled: int,
    queried: int,
    field: Field,
    leaf: int,
    bar: View,
) -> real:
    """⟨bar, a field as the samples of another body see it⟩."""
    solid = field.solid
    solid.leaf = patches.leaves[world, leaf]
    own = field
    own.solid = solid
    return view_product(
        bar, view_of(own, frame_of(given.seen[world, sampled]), frame_of(given.seen[world, queried]))
    )


for _function in (patch_work, sample_sums_work, plane_work, shell_work, grid_work, view_work):
    need_adjoints(_function)
