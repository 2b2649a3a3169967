"""Signed distances of solids, with gradients (docs/theory/contact.md, "Which side is sampled").

A solid is a run of *leaves*: one for a shape, several for a union, whose distance is the least of theirs.
Each leaf has a kind, a size s, and a pose: x = s R y + p for y in the axes of its own.
"""

import warp as wp

from dano.physics.features import KINDS, UNIONS
from dano.physics.real import INFINITY, ONE, real, vec3, ZERO
from dano.physics.solids.grids import (
    closest_in_grid,
    coarse_bound,
    grid_distance,
    grid_value,
    place_in_grid,
)
from dano.physics.solids.kinds import GRID
from dano.physics.solids.leaves import Distance, Leaf, LeafKind, Solids
from dano.physics.solids.shapes import shape_distance

_GRID = wp.constant(GRID)


@wp.struct
class Solid:
    """A solid: a run of leaves, and the first of them.

    Attributes:
        first: Index of the first leaf.
        count: Number of leaves.
        leaf: The first leaf.
        kind: Its whole numbers.
    """

    first: int
    count: int
    leaf: Leaf
    kind: LeafKind


@wp.func(inline=True)
def leaf_distance(solids: Solids, world: int, kind: LeafKind, leaf: Leaf, x: vec3) -> Distance:
    """Of one leaf, at a point [m, F]."""
    y = (ONE / leaf.factor) * (wp.transpose(leaf.rotation) * (x - leaf.position))
    d = shape_distance(kind.kind, leaf, y)
    if wp.static(GRID in KINDS):
        if kind.kind == _GRID:
            d = grid_distance(solids, world, kind, leaf, y)
    d.value = leaf.factor * d.value
    d.gradient = leaf.rotation * d.gradient
    return d


@wp.func
def leaf_clearance(solids: Solids, world: int, kind: LeafKind, leaf: Leaf, x: vec3, enough: real) -> real:
    """A lower bound on the distance to one leaf [m]; where it exceeds `enough`, any that does.

    Beyond a grid's border its distance d adds the way b to the border, which is more than the true distance:
    the solid lies in the grid, so √(d² + b²) bounds that from below, and so does b.
    """
    if wp.static(GRID in KINDS):
        if kind.kind == _GRID:
            y = (ONE / leaf.factor) * (wp.transpose(leaf.rotation) * (x - leaf.position))
            u = place_in_grid(leaf, y)
            closest = closest_in_grid(kind, u)
            way = leaf.factor * wp.length(wp.cw_mul(u - closest, leaf.spacing))
            if way > wp.max(enough, ZERO):
                return way
            bound = leaf.factor * coarse_bound(solids, world, kind, closest)
            if way > ZERO:
                bound = wp.sqrt(wp.max(bound, ZERO) * wp.max(bound, ZERO) + way * way)
            if bound <= enough:
                bound = leaf.factor * grid_value(solids, world, kind, closest)
                if way > ZERO:
                    bound = wp.sqrt(bound * bound + way * way)
            return bound
    return leaf_distance(solids, world, kind, leaf, x).value


@wp.func
def solid_of(solids: Solids, world: int, first: int, count: int) -> Solid:
    """A solid by its leaves."""
    solid = Solid()
    solid.first = first
    solid.count = count
    solid.leaf = solids.leaves[world, first]
    solid.kind = solids.kinds[first]
    return solid


@wp.func
def nearest_leaf(solids: Solids, world: int, solid: Solid, x: vec3) -> Solid:
    """The leaf with the least distance, as a solid of its own."""
    nearest = solid.first
    least = real(INFINITY)
    for i in range(solid.first, solid.first + solid.count):
        d = leaf_distance(solids, world, solids.kinds[i], solids.leaves[world, i], x)
        if d.value < least:
            least = d.value
            nearest = i
    return solid_of(solids, world, nearest, 1)


@wp.func(inline=False)
def clearance_of_others(
    solids: Solids, world: int, solid: Solid, x: vec3, enough: real, clearance: real
) -> real:
    """Of all leaves, from the clearance of the first one [m]."""
    least = clearance
    for i in range(solid.first + 1, solid.first + solid.count):
        other = leaf_clearance(solids, world, solids.kinds[i], solids.leaves[world, i], x, enough)
        least = wp.min(least, other)
    return least


@wp.func
def solid_clearance(solids: Solids, world: int, solid: Solid, x: vec3, enough: real) -> real:
    """Lower bound on the distance [m] from a point [m, F] to a solid; beyond `enough`, any that is, too."""
    clearance = leaf_clearance(solids, world, solid.kind, solid.leaf, x, enough)
    if wp.static(UNIONS):
        if solid.count > 1:
            return clearance_of_others(solids, world, solid, x, enough, clearance)
    return clearance


@wp.func(inline=False)
def union_distance(solids: Solids, world: int, solid: Solid, x: vec3) -> Distance:
    """Of the nearest leaf, at a point [m, F]."""
    nearest = nearest_leaf(solids, world, solid, x)
    return leaf_distance(solids, world, nearest.kind, nearest.leaf, x)


@wp.func(inline=True)
def solid_distance(solids: Solids, world: int, solid: Solid, x: vec3) -> Distance:
    """Signed distance of a solid and its gradient at a point [m, F]; of a union, of its nearest leaf."""
    if wp.static(UNIONS):
        if solid.count > 1:
            return union_distance(solids, world, solid, x)
    return leaf_distance(solids, world, solid.kind, solid.leaf, x)
