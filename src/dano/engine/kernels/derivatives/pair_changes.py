"""What changes of samples, solids and densities of a pair make of an equation, from its derivatives.

Few of them touch: only these are looked at.
"""

import warp as wp

from dano.engine.kernels.derivatives.products import (
    leaf_product,
    patch_material_product,
    sample_product,
    weighted_product,
)
from dano.engine.kernels.patch_tables import PatchSide
from dano.engine.kernels.patches import contact_of
from dano.engine.kernels.tables import BLOCK, Changes, FoundPair, Room, Scene
from dano.physics.features import KINDS, LANES
from dano.physics.overlap import Density, grid_density, in_leaf, Part, WeightedSample
from dano.physics.patch_law import PatchMaterial
from dano.physics.real import real, vec3, ZERO
from dano.physics.samples import Sample
from dano.physics.solids.distances import Solid
from dano.physics.solids.grids import distance_change, moved_kind, moved_solids
from dano.physics.solids.kinds import GRID
from dano.physics.solids.leaves import Distance, Leaf

_LANES, _BLOCK, _GRID = wp.constant(LANES), wp.constant(BLOCK), wp.constant(GRID)


@wp.func
def change_by_samples(
    room: wp.ref[Room],
    changes: wp.ref[Changes],
    bars: wp.ref[Changes],
    world: int,
    found: FoundPair,
    direction: int,
) -> real:
    """What the changes of samples that touch make of an equation; the part of a lane."""
    change = real(0.0)
    if bars.samples.shape[1] > 0:
        for k in range(found.first, found.end):
            s = room.where[world, k].sample
            moved = changes.samples[world, direction * bars.samples.shape[1] + s]
            change += sample_product(bars.samples[world, s], moved)
    return change


@wp.func
def clear_samples(room: wp.ref[Room], bars: wp.ref[Changes], world: int, found: FoundPair):
    """Zero the derivatives by samples that touch."""
    if bars.samples.shape[1] > 0:
        for k in range(found.first, found.end):
            bars.samples[world, room.where[world, k].sample] = Sample()


@wp.func
def has_own_samples(scene: wp.ref[Scene], first: int, side: int) -> bool:
    """Whether the samples of a side are not those of the contact's first side: two bodies of one object."""
    index = scene.patches.side_index
    return side == first or index[side].first_block != index[first].first_block


@wp.func
def has_own_field(scene: wp.ref[Scene], first: int, side: int) -> bool:
    """Whether the field of a side is not that of the contact's first side."""
    index = scene.patches.side_index
    return side == first or index[side].first_part != index[first].first_part


@wp.func
def change_by_weighted(
    scene: wp.ref[Scene],
    changes: wp.ref[Changes],
    bars: wp.ref[Changes],
    world: int,
    lane: int,
    found: FoundPair,
    direction: int,
) -> real:
    """What the changes of weighted samples of a contact make of an equation; the part of a lane."""
    change = real(0.0)
    if bars.weighted.shape[1] > 0:
        contact = scene.patches.contacts[contact_of(scene, found)]
        for side in range(contact.first_side, contact.first_side + contact.sides):
            if has_own_samples(scene, contact.first_side, side):
                index = scene.patches.side_index[side]
                begin = _BLOCK * index.first_block
                for s in range(begin + lane, begin + _BLOCK * index.blocks, _LANES):
                    moved = changes.weighted[world, direction * bars.weighted.shape[1] + s]
                    change += weighted_product(bars.weighted[world, s], moved)
    return change


@wp.func
def clear_weighted(scene: wp.ref[Scene], bars: wp.ref[Changes], world: int, lane: int, found: FoundPair):
    """Zero the derivatives by the weighted samples of a contact."""
    if bars.weighted.shape[1] > 0:
        contact = scene.patches.contacts[contact_of(scene, found)]
        for side in range(contact.first_side, contact.first_side + contact.sides):
            index = scene.patches.side_index[side]
            begin = _BLOCK * index.first_block
            for s in range(begin + lane, begin + _BLOCK * index.blocks, _LANES):
                bars.weighted[world, s] = WeightedSample()


@wp.func
def change_by_leaves(
    changes: wp.ref[Changes], bars: wp.ref[Changes], world: int, first: int, count: int, direction: int
) -> real:
    """What the changes of some leaves make of an equation."""
    change = real(0.0)
    if bars.leaves.shape[1] > 0:
        for k in range(first, first + count):
            moved = changes.leaves[world, direction * bars.leaves.shape[1] + k]
            change += leaf_product(bars.leaves[world, k], moved)
    return change


@wp.func
def clear_leaves(bars: wp.ref[Changes], world: int, first: int, count: int):
    """Zero the derivatives by some leaves."""
    if bars.leaves.shape[1] > 0:
        for k in range(first, first + count):
            bars.leaves[world, k] = Leaf()


@wp.func
def change_by_field(
    scene: wp.ref[Scene], changes: wp.ref[Changes], bars: wp.ref[Changes], world: int, s: int, direction: int
) -> real:
    """What the changes of a side's field make of an equation."""
    index = scene.patches.side_index[s]
    change = real(0.0)
    for p in range(index.first_part, index.first_part + index.parts):
        if bars.parts.shape[1] > 0:
            moved = changes.parts[world, direction * bars.parts.shape[1] + p]
            change += bars.parts[world, p].edge * moved.edge
        kind = scene.patches.fields.kinds[p]
        change += change_by_leaves(changes, bars, world, kind.first_leaf, kind.leaves, direction)
    if index.ball >= 0:
        change += change_by_leaves(changes, bars, world, index.ball, 1, direction)
    return change


@wp.func
def change_by_patch(
    scene: wp.ref[Scene],
    changes: wp.ref[Changes],
    bars: wp.ref[Changes],
    world: int,
    found: FoundPair,
    direction: int,
) -> real:
    """What the changes of a patch's material, sides and fields make of an equation."""
    c = contact_of(scene, found)
    contact = scene.patches.contacts[c]
    change = real(0.0)
    if bars.patch_materials.shape[1] > 0:
        moved = changes.patch_materials[world, direction * bars.patch_materials.shape[1] + c]
        change += patch_material_product(bars.patch_materials[world, c], moved)
    for s in range(contact.first_side, contact.first_side + contact.sides):
        if bars.sides.shape[1] > 0:
            moved_side = changes.sides[world, direction * bars.sides.shape[1] + s]
            change += bars.sides[world, s].density_scale * moved_side.density_scale
        if has_own_field(scene, contact.first_side, s):
            change += change_by_field(scene, changes, bars, world, s, direction)
    return change


@wp.func
def clear_patch(scene: wp.ref[Scene], bars: wp.ref[Changes], world: int, found: FoundPair):
    """Zero the derivatives by a patch's material, sides and fields."""
    c = contact_of(scene, found)
    contact = scene.patches.contacts[c]
    if bars.patch_materials.shape[1] > 0:
        bars.patch_materials[world, c] = PatchMaterial()
    for s in range(contact.first_side, contact.first_side + contact.sides):
        index = scene.patches.side_index[s]
        if bars.sides.shape[1] > 0:
            bars.sides[world, s] = PatchSide()
        for p in range(index.first_part, index.first_part + index.parts):
            if bars.parts.shape[1] > 0:
                bars.parts[world, p] = Part()
            kind = scene.patches.fields.kinds[p]
            clear_leaves(bars, world, kind.first_leaf, kind.leaves)
        if index.ball >= 0:
            clear_leaves(bars, world, index.ball, 1)


@wp.func
def add_distance_changes(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, solid: Solid, x: vec3, bar: Distance
):
    """Add what changes of coefficients make of an equation through a sampled distance at a point."""
    if wp.static(GRID in KINDS):
        if solid.kind.kind == _GRID:
            for d in range(room.splines.shape[1] // _LANES):
                moved = distance_change(scene.solids, world, solid.kind, solid.leaf, x, d)
                change = bar.value * moved.value + wp.dot(bar.gradient, moved.gradient)
                room.splines[world, d * _LANES + lane] = room.splines[world, d * _LANES + lane] + change


@wp.func
def add_density_changes(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, solid: Solid, x: vec3, bar: Density
):
    """Add what changes of coefficients make of an equation through a grid of densities at a point."""
    for d in range(room.splines.shape[1] // _LANES):
        kind = moved_kind(scene.solids, solid.kind, d)
        y = in_leaf(solid.leaf, x)
        moved = grid_density(moved_solids(scene.solids), world, kind, solid.leaf, y)
        change = bar.value * moved.value + wp.dot(bar.direction, moved.direction)
        room.splines[world, d * _LANES + lane] = room.splines[world, d * _LANES + lane] + change


@wp.func
def clear_splines(room: wp.ref[Room], world: int, lane: int):
    """Zero what changes of coefficients make of an equation."""
    for d in range(room.splines.shape[1] // _LANES):
        room.splines[world, d * _LANES + lane] = ZERO


@wp.func
def change_by_splines(room: wp.ref[Room], world: int, lane: int, direction: int) -> real:
    """What changes of coefficients make of an equation; the part of a lane."""
    change = real(0.0)
    if room.splines.shape[1] > 0:
        change = room.splines[world, direction * _LANES + lane]
    return change
