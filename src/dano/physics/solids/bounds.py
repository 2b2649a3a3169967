"""Lower bounds on sampled distances, which cost less than they do.

See docs/theory/contact.md, "Bounds before splines".
"""

import warp as wp

from dano.physics.features import KINDS, LANES
from dano.physics.real import mat33, ONE, real, vec3, ZERO
from dano.physics.solids.distances import Solid
from dano.physics.solids.grids import STEEPEST
from dano.physics.solids.kinds import CELL, GRID
from dano.physics.solids.leaves import Solids

_GRID, _CELL = wp.constant(GRID), wp.constant(CELL)
QUICK = LANES == 1 and GRID in KINDS
"""Whether grids are asked for bounds first. Lanes of a GPU wait for the one that asks most."""


@wp.struct
class GridView:
    """A grid as the samples of another body see it."""

    known: bool  # Whether the solid is one, and samples are fixed to their body
    turn: mat33  # Sample coordinates → cells from the first node inside the border, without the origin
    origin: vec3  # Where the origin of the samples is [cells]
    last: vec3  # The outermost nodes at the other end [cells]
    spacing: vec3  # Between nodes, in the frame of the solid [m]
    factor: real  # Size of the grid [1]
    first: int  # Place of the coefficient of the first node inside the border
    along_x: int  # From one to the next along x
    along_y: int  # The same along y
    first_bound: int  # Place of the first bound
    bounds_x: int  # From one to the next along x
    bounds_y: int  # The same along y
    bends: int  # From a bound to the bend of its cells: see `dano.native`


@wp.func
def view_of_grid(solid: Solid, points: mat33, origin: vec3, turning: int) -> GridView:
    """A solid as samples see it whose coordinates s are at `points` s + `origin` [m, F].

    Args:
        solid: The solid.
        points: Sample coordinates → frame of the solid.
        origin: Where their origin is [m].
        turning: How samples turn: of those that keep facing the solid, all are near.
    """
    view = GridView()
    if wp.static(QUICK):
        view.known = solid.kind.kind == _GRID and solid.count == 1 and turning == 0
        if view.known:
            leaf = solid.leaf
            kind = solid.kind
            back = wp.transpose(leaf.rotation)
            view.factor = leaf.factor
            view.spacing = leaf.factor * leaf.spacing
            by_cell = wp.diag(vec3(ONE / view.spacing[0], ONE / view.spacing[1], ONE / view.spacing[2]))
            view.turn = by_cell * (back * points)
            view.origin = by_cell * (back * (origin - leaf.position) - leaf.factor * leaf.sizes)
            ends = 2 * kind.degree + 3
            view.last = vec3(real(kind.nodes_x - ends), real(kind.nodes_y - ends), real(kind.nodes_z - ends))
            view.along_y = kind.nodes_z
            view.along_x = kind.nodes_y * kind.nodes_z
            view.first = kind.first + (kind.degree + 1) * (view.along_x + view.along_y + 1)
            view.first_bound = kind.first_bound
            view.bounds_y = (kind.nodes_z - ends) // _CELL + 1
            view.bounds_x = view.bounds_y * ((kind.nodes_y - ends) // _CELL + 1)
            view.bends = view.bounds_x * ((kind.nodes_x - ends) // _CELL + 1)
    return view


@wp.func
def closest_to(view: GridView, u: vec3) -> vec3:
    """The place between the outermost nodes that is closest to a place [cells]."""
    return vec3(
        wp.min(wp.max(u[0], ZERO), view.last[0]),
        wp.min(wp.max(u[1], ZERO), view.last[1]),
        wp.min(wp.max(u[2], ZERO), view.last[2]),
    )


@wp.func
def cells_at(view: GridView, i: int, j: int, k: int) -> int:
    """Place of the bound of the cells that have one with a place."""
    return view.first_bound + i // _CELL * view.bounds_x + j // _CELL * view.bounds_y + k // _CELL


@wp.func
def with_way(low: real, squared: real) -> real:
    """A bound beyond the border from that at its closest place, and the square of the way there [m²]."""
    if squared == ZERO:
        return low
    inside = wp.max(low, ZERO)
    return wp.sqrt(inside * inside + squared)


@wp.func
def bound_in_ball(
    solids: Solids, world: int, view: GridView, middle: vec3, radius: real, enough: real
) -> real:
    """A lower bound on the clearance of a grid in a ball of samples [m], by the least coefficient around.

    Args:
        solids: Of the scene.
        world: Which world.
        view: The grid.
        middle: Of the ball.
        radius: Of the ball [m].
        enough: Where the bound exceeds this, any that does will do [m].
    """
    u = view.turn * middle + view.origin
    c = closest_to(view, u)
    away = wp.cw_mul(u - c, view.spacing)
    squared = wp.dot(away, away)
    # The solid lies inside the border: beyond it, nothing is nearer than this.
    least = wp.sqrt(squared) - radius
    if least > enough:
        return least
    low = view.factor * solids.bounds[world, cells_at(view, int(c[0]), int(c[1]), int(c[2]))]
    return with_way(low, squared) - STEEPEST * radius


@wp.func
def straight_plane(solids: Solids, world: int, at: int, along_y: int, fy: real, fz: real) -> real:
    """Coefficients of a grid with straight lines between the four from a place on along y and z."""
    a = solids.coefficients[world, at]
    b = solids.coefficients[world, at + along_y]
    low = a + fz * (solids.coefficients[world, at + 1] - a)
    high = b + fz * (solids.coefficients[world, at + along_y + 1] - b)
    return low + fy * (high - low)


@wp.func
def bound_at(solids: Solids, world: int, view: GridView, point: vec3, enough: real) -> real:
    """A lower bound on the clearance of a grid at a sample [m]; where it exceeds `enough`, any that does.

    A spline is no further from its coefficients with straight lines between them than these bend.
    """
    u = view.turn * point + view.origin
    c = closest_to(view, u)
    i = int(c[0])
    j = int(c[1])
    k = int(c[2])
    cells = cells_at(view, i, j, k)
    low = view.factor * solids.bounds[world, cells]
    if low <= enough:
        at = view.first + i * view.along_x + j * view.along_y + k
        fy = c[1] - real(j)
        fz = c[2] - real(k)
        a = straight_plane(solids, world, at, view.along_y, fy, fz)
        b = straight_plane(solids, world, at + view.along_x, view.along_y, fy, fz)
        low = view.factor * (a + (c[0] - real(i)) * (b - a) - solids.bounds[world, cells + view.bends])
    away = wp.cw_mul(u - c, view.spacing)
    return with_way(low, wp.dot(away, away))
