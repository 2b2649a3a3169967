"""Derivatives of patches: by the states of two bodies that touch, from a virtual work (docs/gradients.md).

What only skips work, balls around samples and maps of where a density is positive, has none.
"""

import warp as wp

from dano.engine.kernels.derivatives.adjoint import distance_work, Virtual
from dano.engine.kernels.derivatives.contact import PairBar, summed_body
from dano.engine.kernels.derivatives.pair_changes import add_density_changes, add_distance_changes
from dano.engine.kernels.derivatives.patch_adjoint import (
    cap_work,
    gathered_work,
    grid_work,
    patch_work,
    plane_work,
    sample_work,
    shell_work,
    side_work,
    view_work,
)
from dano.engine.kernels.derivatives.products import add_patch_material, add_to_leaf
from dano.engine.kernels.lanes import total_of, wait
from dano.engine.kernels.patch_tables import PatchSideIndex
from dano.engine.kernels.patches import contact_of, frame_of, next_block, side_field, side_sign
from dano.engine.kernels.tables import BLOCK, Changes, FoundPair, Room, Scene
from dano.physics.features import KINDS, LANES
from dano.physics.overlap import (
    added,
    densest,
    DENSITY,
    Density,
    Field,
    Patch,
    seen_density,
    Sums,
    sums_in_world,
    View,
    view_of,
)
from dano.physics.pairs import BodyState
from dano.physics.real import real, vec3, ZERO
from dano.physics.solids.distances import leaf_distance
from dano.physics.solids.kinds import HALF_SPACE, SPHERE
from dano.physics.structures import sum_of

_LANES, _BLOCK, _DENSITY = wp.constant(LANES), wp.constant(BLOCK), wp.constant(DENSITY)

summed_view, total_view = sum_of(View), total_of(View)


@wp.func
def add_edge(bars: wp.ref[Changes], world: int, part: int, bar: real):
    """Add a derivative by the width of a part's edge."""
    if bars.parts.shape[1] > 0:
        bars.parts[world, part].edge += bar


@wp.func
def add_mass(bars: wp.ref[Changes], world: int, body: int, bar: real):
    """Add a derivative by a mass."""
    if bars.bodies.shape[1] > 0:
        bars.bodies[world, body].mass += bar


@wp.func
def pull_place(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    world: int,
    lane: int,
    field: Field,
    x: vec3,
    bar: Density,
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
            add_to_leaf(bars.leaves, world, solid.first, by_grid.leaf)
            add_density_changes(scene, room, world, lane, solid, x, bar)
            found = by_place
    if not is_grid:
        d = leaf_distance(scene.solids, world, solid.kind, solid.leaf, x)
        by_part, _d, by_solid, by_x, by_d, _e = wp.grad(shell_work)(
            leading.part, leading.kind, solid, x, d, bar
        )
        _f, _g, by_leaf, of_x, _h = wp.grad(distance_work)(scene.solids, world, solid, x, by_d)
        add_edge(bars, world, leading.first, by_part.edge)
        add_to_leaf(bars.leaves, world, solid.first, by_solid.leaf)
        add_to_leaf(bars.leaves, world, solid.first, by_leaf.leaf)
        add_distance_changes(scene, room, world, lane, solid, x, by_d)
        found = by_x + of_x
    return found


@wp.func
def pull_samples(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
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
                by_sample, by_density, _a = wp.grad(sample_work)(sample, density, bar)
                by_point = by_sample.point
                if view.is_plane:
                    by_view, by_edge, of_point, _b = wp.grad(plane_work)(
                        view, field.part.edge, sample.point, by_density
                    )
                    add_edge(bars, world, field.first, by_edge)
                    found = summed_view(found, by_view)
                    by_point += of_point
                else:
                    # x = rotation · point + origin
                    x = view.rotation * sample.point + view.origin
                    by_x = pull_place(scene, room, bars, world, lane, field, x, by_density)
                    found.rotation += wp.outer(by_x, sample.point)
                    found.origin += by_x
                    by_point += wp.transpose(view.rotation) * by_x
                if bars.weighted.shape[1] > 0:
                    bars.weighted[world, s].point += by_point
                    bars.weighted[world, s].weight += by_sample.weight
        i = next_block(scene, world, index, field, view, i + _LANES)
    return total_view(found)


@wp.func
def add_side(bar: PairBar, is_first: bool, sampled: BodyState, queried: BodyState) -> PairBar:
    """Add derivatives by the states of the bodies of a side."""
    if is_first:
        bar.first = summed_body(bar.first, sampled)
        bar.second = summed_body(bar.second, queried)
    else:
        bar.first = summed_body(bar.first, queried)
        bar.second = summed_body(bar.second, sampled)
    return bar


@wp.func
def pull_cap(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    world: int,
    lane: int,
    c: int,
    s: int,
    patch_bar: Patch,
    bar: PairBar,
) -> PairBar:
    """Add derivatives through the overlap of a ball with a half-space."""
    index = scene.patches.side_index[s]
    plane = side_field(scene, world, index).solid
    sign = side_sign(scene, c, index)
    by_ball, by_plane, by_sampled, by_queried, by_mass, _a, _b = wp.grad(cap_work)(
        scene.solids.leaves[world, index.ball],
        plane.leaf,
        room.bodies[world, index.sampled],
        room.bodies[world, index.queried],
        scene.bodies[world, index.sampled].mass,
        sign,
        patch_bar,
    )
    if lane == 0:
        add_to_leaf(bars.leaves, world, index.ball, by_ball)
        add_to_leaf(bars.leaves, world, plane.first, by_plane)
        add_mass(bars, world, index.sampled, by_mass)
    return add_side(bar, sign > ZERO, by_sampled, by_queried)


@wp.func
def pull_side(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    world: int,
    lane: int,
    c: int,
    s: int,
    sums_bar: Sums,
    bar: PairBar,
) -> PairBar:
    """Add derivatives through the sums over the samples of a side."""
    side = scene.patches.sides[world, s]
    index = scene.patches.side_index[s]
    a = room.bodies[world, index.sampled]
    b = room.bodies[world, index.queried]
    field = side_field(scene, world, index)
    sign = side_sign(scene, c, index)
    mass = scene.bodies[world, index.sampled].mass
    by_own, by_sampled, by_queried, by_mass, by_scale, _a, _b = wp.grad(side_work)(
        room.patches.sums[world, s], a, b, mass, side.density_scale, sign, sums_bar
    )
    view = view_of(field, frame_of(a), frame_of(b))
    by_view = pull_samples(scene, room, bars, world, lane, index, field, view, by_own)
    by_field, of_sampled, of_queried, _c = wp.grad(view_work)(field, a, b, by_view)
    if lane == 0:
        add_to_leaf(bars.leaves, world, field.solid.first, by_field.solid.leaf)
        add_mass(bars, world, index.sampled, by_mass)
        if bars.sides.shape[1] > 0:
            bars.sides[world, s].density_scale += by_scale
    bar = add_side(bar, sign > ZERO, by_sampled, by_queried)
    return add_side(bar, sign > ZERO, of_sampled, of_queried)


@wp.func
def summed_sides(scene: wp.ref[Scene], room: wp.ref[Room], world: int, c: int) -> Sums:
    """Sums over the samples of both sides of a contact, in the world."""
    contact = scene.patches.contacts[c]
    sums = Sums()
    for s in range(contact.first_side, contact.first_side + contact.sides):
        index = scene.patches.side_index[s]
        sampled = frame_of(room.bodies[world, index.sampled])
        queried = frame_of(room.bodies[world, index.queried])
        mass = scene.bodies[world, index.sampled].mass * scene.patches.sides[world, s].density_scale
        own = room.patches.sums[world, s]
        if own.share > ZERO:
            sums = added(sums, sums_in_world(own, sampled, queried, mass, side_sign(scene, c, index)))
    return sums


@wp.func
def pull_patch(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    bars: wp.ref[Changes],
    world: int,
    lane: int,
    found: FoundPair,
    twists: Virtual,
) -> PairBar:
    """Derivatives by the states of the bodies of a patch that touches; adds those by all that is constant."""
    c = contact_of(scene, found)
    contact = scene.patches.contacts[c]
    a = room.bodies[world, contact.first]
    b = room.bodies[world, contact.second]
    by_material, by_patch, _a, by_first, by_second, by_h, by_twists = wp.grad(patch_work)(
        scene.patches.materials[world, c],
        room.patches.patches[world, c],
        contact.adhesive > 0,
        a.position,
        b.position,
        scene.timestep[world, 0],
        twists,
    )
    if lane == 0:
        add_patch_material(bars.patch_materials, world, c, by_material)
    bar = PairBar()
    bar.first.position = by_first
    bar.second.position = by_second
    bar.timestep = by_h
    bar.twists = by_twists
    by_sums, _b, _c = wp.grad(gathered_work)(summed_sides(scene, room, world, c), ZERO, by_patch)
    s = int(contact.first_side)
    while s < contact.first_side + contact.sides:
        if scene.patches.side_index[s].ball >= 0:
            if wp.static(SPHERE in KINDS and HALF_SPACE in KINDS):
                bar = pull_cap(scene, room, bars, world, lane, c, s, by_patch, bar)
        elif room.patches.sums[world, s].share > ZERO:
            bar = pull_side(scene, room, bars, world, lane, c, s, by_sums, bar)
        s += 1
    wait()
    return bar
