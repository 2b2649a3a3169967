"""Derivatives of patches: by the states of two bodies that touch, from a virtual work (docs/gradients.md).

First the work of the wrench of a patch along virtual velocities, from the sums over samples on; then what
these ask of each sample's density, and of the poses of both bodies. What only skips work, balls around
samples and maps of where a density is positive, has no derivatives.
"""

import warp as wp

from dano.engine.kernels.derivatives.contact import add_part, add_to_leaf, n_moving, pull_distance, Virtual
from dano.engine.kernels.lanes import total_of, wait
from dano.engine.kernels.patch_tables import PatchContact, PatchTables
from dano.engine.kernels.patches import contact_of, frame_of, next_block, side_field
from dano.engine.kernels.tables import BLOCK, FoundPair, Given, GivenPatches, Room, Scene
from dano.physics.features import KINDS, LANES
from dano.physics.overlap import (
    added,
    cap_patch,
    densest,
    DENSITY,
    Density,
    Field,
    grid_density,
    in_leaf,
    Patch,
    patch_of,
    plane_density,
    sample_sums,
    seen_density,
    shell_density,
    Sums,
    sums_in_world,
    View,
    view_of,
)
from dano.physics.patch_law import patch_law
from dano.physics.real import ONE, real, vec3, ZERO
from dano.physics.solids.distances import leaf_distance, Solid
from dano.physics.solids.grids import moved_kind, moved_solids
from dano.physics.solids.kinds import HALF_SPACE, SPHERE
from dano.physics.solids.leaves import Solids
from dano.physics.structures import adding_of, need_adjoints, product_of, vjp_of
from dano.physics.twists import relative_twist


@wp.func
def patch_of_sides(
    given: Given, patches: GivenPatches, tables: PatchTables, world: int, contact: PatchContact
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
    given: Given, patches: GivenPatches, tables: PatchTables, world: int, c: int, twists: Virtual
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


@wp.func
def grid_at(solids: Solids, world: int, solid: Solid, x: vec3) -> Density:
    """Density of a grid at a point."""
    return grid_density(solids, world, solid.kind, solid.leaf, in_leaf(solid.leaf, x))


@wp.func
def view_at(
    given: Given, patches: GivenPatches, world: int, sampled: int, queried: int, field: Field
) -> View:
    """A field as the samples of another body see it."""
    solid = field.solid
    solid.leaf = patches.leaves[world, field.solid.first]
    own = field
    own.solid = solid
    return view_of(own, frame_of(given.seen[world, sampled]), frame_of(given.seen[world, queried]))


sample_sums_work, plane_work, shell_work = map(vjp_of, (sample_sums, plane_density, shell_density))
grid_work, view_work = vjp_of(grid_at), vjp_of(view_at)
add_to_view, total_view = adding_of(View), total_of(View)
density_product = product_of(Density)

for _function in (patch_work, sample_sums_work, plane_work, shell_work, grid_work, view_work):
    need_adjoints(_function)


_LANES, _BLOCK, _DENSITY = wp.constant(LANES), wp.constant(BLOCK), wp.constant(DENSITY)


@wp.func
def pull_place(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, field: Field, x: vec3, bar: Density
) -> vec3:
    """Derivative by a point in a field's frame from one by the density there; adds those by the field."""
    leading = densest(scene.solids, scene.patches.fields, world, field, x)
    solid = leading.solid
    if wp.static(DENSITY in KINDS):
        if solid.kind.kind == _DENSITY:
            _a, _b, by_grid, by_place, _c = wp.grad(grid_work)(scene.solids, world, solid, x, bar)
            add_to_leaf(room.bars.leaves, world, solid.first, by_grid.leaf)
            for k in range(n_moving(scene, room)):
                kind = moved_kind(scene.solids, solid.kind, k)
                moved = moved_solids(scene.solids)
                change = grid_density(moved, world, kind, solid.leaf, in_leaf(solid.leaf, x))
                add_part(room, world, lane, k, density_product(bar, change))
            return by_place
    d = leaf_distance(scene.solids, world, solid.kind, solid.leaf, x)
    by_part, _d, by_solid, by_x, by_d, _e = wp.grad(shell_work)(leading.part, leading.kind, solid, x, d, bar)
    room.bars.parts[world, leading.first].edge += by_part.edge
    add_to_leaf(room.bars.leaves, world, solid.first, by_solid.leaf)
    return by_x + pull_distance(scene, room, world, lane, solid, x, by_d)


@wp.func
def pull_side(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, s: int):
    """Add derivatives through the sums over the samples of a side."""
    index = scene.patches.side_index[s]
    field = side_field(scene, world, index)
    sampled = frame_of(room.bodies[world, index.sampled])
    view = view_of(field, sampled, frame_of(room.bodies[world, index.queried]))
    bar = room.patches.sum_bars[world, s]
    by_view = View()
    i = next_block(scene, world, index, field, view, lane)
    while i < index.blocks:
        begin = _BLOCK * (index.first_block + i)
        for k in range(begin, begin + _BLOCK):
            sample = scene.patches.samples[world, k]
            density = seen_density(scene.solids, scene.patches.fields, world, field, view, sample.point)
            if density.value > ZERO:
                by_sample, by_density, _a = wp.grad(sample_sums_work)(sample, density, bar)
                by_point = by_sample.point
                if view.is_plane:
                    of_plane, by_edge, of_point, _b = wp.grad(plane_work)(
                        view, field.part.edge, sample.point, by_density
                    )
                    room.bars.parts[world, field.first].edge += by_edge
                    add_to_view(by_view, of_plane)
                    by_point += of_point
                else:
                    # x = rotation · point + origin
                    x = view.rotation * sample.point + view.origin
                    by_x = pull_place(scene, room, world, lane, field, x, by_density)
                    by_view.rotation += wp.outer(by_x, sample.point)
                    by_view.origin += by_x
                    by_point += wp.transpose(view.rotation) * by_x
                if room.bars.weighted.shape[1] > 0:
                    room.bars.weighted[world, k].point += by_point
                    room.bars.weighted[world, k].weight += by_sample.weight
        i = next_block(scene, world, index, field, view, i + _LANES)
    by_view = total_view(by_view)
    if lane == 0:
        _c, _d, _e, _f, _g, _h, _i = wp.grad(view_work)(
            room.given, room.given_patches, world, index.sampled, index.queried, field, by_view
        )


@wp.func
def pull_patch(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, found: FoundPair, twists: Virtual
) -> Virtual:
    """Derivatives by the twists of the bodies of a patch, for the first lane; adds all others."""
    c = contact_of(scene, found)
    contact = scene.patches.contacts[c]
    bar = Virtual()
    if lane == 0:
        for s in range(contact.first_side, contact.first_side + contact.sides):
            room.patches.sum_bars[world, s] = Sums()
        _a, _b, _c, _d, _e, by_twists = wp.grad(patch_work)(
            room.given, room.given_patches, scene.patches, world, c, twists
        )
        bar = by_twists
    wait()
    for side in range(contact.first_side, contact.first_side + contact.sides):
        if scene.patches.side_index[side].ball < 0 and room.patches.sums[world, side].share > ZERO:
            pull_side(scene, room, world, lane, side)
    wait()
    return bar
