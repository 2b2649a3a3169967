"""Derivatives of patches: by the states of two bodies that touch, from a virtual work (docs/gradients.md).

What only skips work, balls around samples and maps of where a density is positive, has none.
"""

import warp as wp

from dano.engine.kernels.derivatives.adjoint import Virtual
from dano.engine.kernels.derivatives.contact import pull_distance
from dano.engine.kernels.derivatives.pair_changes import add_density_changes
from dano.engine.kernels.derivatives.patch_adjoint import (
    grid_work,
    patch_work,
    plane_work,
    sample_sums_work,
    shell_work,
    view_work,
)
from dano.engine.kernels.derivatives.products import add_to_leaf, summed_view, total_view
from dano.engine.kernels.lanes import wait
from dano.engine.kernels.patch_tables import PatchSideIndex
from dano.engine.kernels.patches import contact_of, frame_of, next_block, side_field
from dano.engine.kernels.tables import BLOCK, FoundPair, Room, Scene
from dano.physics.features import KINDS, LANES
from dano.physics.overlap import densest, DENSITY, Density, Field, seen_density, Sums, View, view_of
from dano.physics.real import vec3, ZERO
from dano.physics.solids.distances import leaf_distance

_LANES, _BLOCK, _DENSITY = wp.constant(LANES), wp.constant(BLOCK), wp.constant(DENSITY)


@wp.func
def pull_place(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, field: Field, x: vec3, bar: Density
) -> vec3:
    """Derivative by a point in a field's frame from one by the density there; adds those by the field."""
    leading = densest(scene.solids, scene.patches.fields, world, field, x)
    solid = leading.solid
    found = vec3()
    is_grid = bool(False)
    if wp.static(DENSITY in KINDS):
        is_grid = solid.kind.kind == _DENSITY
        if is_grid:
            _a, _b, by_grid, by_place, _c = wp.grad(grid_work)(scene.solids, world, solid, x, bar)
            add_to_leaf(room.bars.leaves, world, solid.first, by_grid.leaf)
            add_density_changes(scene, room, world, lane, solid, x, bar)
            found = by_place
    if not is_grid:
        d = leaf_distance(scene.solids, world, solid.kind, solid.leaf, x)
        by_part, _d, by_solid, by_x, by_d, _e = wp.grad(shell_work)(
            leading.part, leading.kind, solid, x, d, bar
        )
        room.bars.parts[world, leading.first].edge += by_part.edge
        add_to_leaf(room.bars.leaves, world, solid.first, by_solid.leaf)
        found = by_x + pull_distance(scene, room, world, lane, solid, x, by_d)
    return found


@wp.func
def pull_weighted(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    lane: int,
    index: PatchSideIndex,
    field: Field,
    view: View,
    bar: Sums,
) -> View:
    """Derivative by how samples see a field, from one by their sums; adds those by samples and the field."""
    found = View()
    i = next_block(scene, world, index, field, view, lane)
    while i < index.blocks:
        b = index.first_block + i
        for s in range(_BLOCK * b, _BLOCK * b + _BLOCK):
            sample = scene.patches.samples[world, s]
            density = seen_density(scene.solids, scene.patches.fields, world, field, view, sample.point)
            if density.value > ZERO:
                by_sample, by_density, _a = wp.grad(sample_sums_work)(sample, density, bar)
                by_point = by_sample.point
                if view.is_plane:
                    by_view, by_edge, of_point, _b = wp.grad(plane_work)(
                        view, field.part.edge, sample.point, by_density
                    )
                    room.bars.parts[world, field.first].edge += by_edge
                    found = summed_view(found, by_view)
                    by_point += of_point
                else:
                    # x = rotation · point + origin
                    x = view.rotation * sample.point + view.origin
                    by_x = pull_place(scene, room, world, lane, field, x, by_density)
                    found.rotation += wp.outer(by_x, sample.point)
                    found.origin += by_x
                    by_point += wp.transpose(view.rotation) * by_x
                if room.bars.weighted.shape[1] > 0:
                    room.bars.weighted[world, s].point += by_point
                    room.bars.weighted[world, s].weight += by_sample.weight
        i = next_block(scene, world, index, field, view, i + _LANES)
    return total_view(found)


@wp.func
def pull_side(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, s: int):
    """Add derivatives through the samples of a side."""
    index = scene.patches.side_index[s]
    field = side_field(scene, world, index)
    sampled = frame_of(room.bodies[world, index.sampled])
    view = view_of(field, sampled, frame_of(room.bodies[world, index.queried]))
    by_view = pull_weighted(scene, room, world, lane, index, field, view, room.patches.sum_bars[world, s])
    if lane == 0:
        _a, _b, _c, _d, _e, _f, _g, _h = wp.grad(view_work)(
            room.given,
            room.given_patches,
            world,
            index.sampled,
            index.queried,
            field,
            field.solid.first,
            by_view,
        )


@wp.func
def pull_patch(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, found: FoundPair, twists: Virtual
) -> Virtual:
    """Derivatives by the twists of the bodies of a patch that touches, for the first lane; adds all others."""
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
    s = int(contact.first_side)
    while s < contact.first_side + contact.sides:
        if scene.patches.side_index[s].ball < 0 and room.patches.sums[world, s].share > ZERO:
            pull_side(scene, room, world, lane, s)
        s += 1
    wait()
    return bar
