"""What changes of samples and of sampled solids make of an equation, from its derivatives.

Few of them touch: only these are looked at.
"""

import warp as wp

from dano.engine.kernels.derivatives.products import sample_product, weighted_product
from dano.engine.kernels.patches import contact_of
from dano.engine.kernels.tables import BLOCK, Ends, FoundPair, Room, Scene
from dano.physics.features import KINDS, LANES
from dano.physics.overlap import Density, grid_density, in_leaf, WeightedSample
from dano.physics.real import real, vec3
from dano.physics.samples import Sample
from dano.physics.solids.distances import Solid
from dano.physics.solids.grids import distance_change, moved_kind, moved_solids
from dano.physics.solids.kinds import GRID
from dano.physics.solids.leaves import Distance

_LANES, _BLOCK, _GRID = wp.constant(LANES), wp.constant(BLOCK), wp.constant(GRID)


@wp.func
def change_by_samples(
    room: wp.ref[Room], ends: wp.ref[Ends], world: int, found: FoundPair, direction: int
) -> real:
    """What the changes of samples that touch make of an equation; the part of a lane."""
    change = real(0.0)
    n = room.bars.samples.shape[1]
    if n > 0:
        for k in range(found.first, found.end):
            s = room.where[world, k].sample
            change += sample_product(room.bars.samples[world, s], ends.samples[world, direction * n + s])
    return change


@wp.func
def clear_samples(room: wp.ref[Room], world: int, found: FoundPair):
    """Zero the derivatives by samples that touch."""
    if room.bars.samples.shape[1] > 0:
        for k in range(found.first, found.end):
            room.bars.samples[world, room.where[world, k].sample] = Sample()


@wp.func
def change_by_weighted(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    ends: wp.ref[Ends],
    world: int,
    lane: int,
    found: FoundPair,
    direction: int,
) -> real:
    """What the changes of weighted samples of a contact make of an equation; the part of a lane."""
    change = real(0.0)
    n = room.bars.weighted.shape[1]
    if n > 0:
        contact = scene.patches.contacts[contact_of(scene, found)]
        sides = scene.patches.side_index
        for side in range(contact.first_side, contact.first_side + contact.sides):
            # Two bodies of one object have the same samples.
            if side == contact.first_side or (
                sides[side].first_block != sides[contact.first_side].first_block
            ):
                begin = _BLOCK * sides[side].first_block
                for s in range(begin + lane, begin + _BLOCK * sides[side].blocks, _LANES):
                    moved = ends.weighted[world, direction * n + s]
                    change += weighted_product(room.bars.weighted[world, s], moved)
    return change


@wp.func
def clear_weighted(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, found: FoundPair):
    """Zero the derivatives by the weighted samples of a contact."""
    if room.bars.weighted.shape[1] > 0:
        contact = scene.patches.contacts[contact_of(scene, found)]
        for side in range(contact.first_side, contact.first_side + contact.sides):
            index = scene.patches.side_index[side]
            begin = _BLOCK * index.first_block
            for s in range(begin + lane, begin + _BLOCK * index.blocks, _LANES):
                room.bars.weighted[world, s] = WeightedSample()


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
