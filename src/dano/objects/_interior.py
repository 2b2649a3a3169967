"""What the inside of a density looks like: where its surface is, whether it is solid, and how to weigh it.

A field learned from images knows its surface and little else: its inside is a fog at half the density of the
shell, a true hollow, or as uneven as a cheese, and its density is an extinction per length, not a mass per
volume. Read as mass it makes inertias wrong by tens of per cent. The solid that its surface encloses is right
to a few, if the surface is watertight at the level at which it is cut.
"""

import math
from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from dano.checks import checked_kind
from dano.fields import density_at, GridField
from dano.maths import floating
from dano.objects._samples import Lattice, plateau

LEVELS = (0.5, 0.35, 0.25, 0.17, 0.12)
"""Levels to be tried, as fractions of the plateau density; the first is right for most fields."""

GAPS = (0, 1, 2)
"""Radii [cells] to which pores of the surface are closed, tried in turn at each level."""

POROUS = 0.06
"""A solid that closing by one more cell enlarges by more than this share has pores; convex edges add 1–3
%."""

LEAK = 0.05
"""Share of the solid's volume that may be hollow at a lower level without being inside at this one."""

_SURROUNDED = 0.7
"""Share of a hollow's border that must lie within two cells of the dense part; pockets in a haze have
less."""

_LEAST_NODES = 6
_EVEN = 0.3
"""Share of the slope of a distance by which the middle half of its slopes on the border differ."""

_BALL = np.ones((3, 3, 3))
"""A node and its neighbours, those over corners included."""

_NEAR_ONE, _OVERSHOOT = (0.8, 1.1), 1.3
"""Limits of the density near the surface of an occupancy, and the most it reaches: splines through samples of
an occupancy may overshoot by a fifth."""

_HOLLOW, _SOLID = 0.25, (0.85, 1.15)
"""Density deep inside over that near the surface: below the first the inside is hollow, between the others it
is solid (convention)."""

_UNEVEN, _CAVITY, _HAZE = 0.1, 0.02, 0.01
"""Unevenness, share of hollow volume and share of density outside, from which mass does not follow density
(convention)."""
_DENSE, _FOOT = 0.5, 0.1
"""Share of the largest density that is a wall, and of the height that is the foot of what stands."""


class Interior(eqx.Module):
    """The inside of a density field in numbers."""

    level: Float[Array, ""]  # Density of its surface
    wall: Float[Array, ""]  # Median density near the surface, 1.5 to 4 cells inside
    # Radius [cells of the lattice] of the pores that were closed to make the surface watertight; NaN if no
    # watertight surface was found.
    gap: Float[Array, ""]
    # Median density deep inside as a share of that near the surface: 1 for a solid, 0 for a hollow; NaN if it
    # is too thin to tell.
    deep: Float[Array, ""]
    # Unevenness, (upper − lower quartile)/(2 · median) of the densities inside; about 0 for a solid.
    spread: Float[Array, ""]
    outside: Float[Array, ""]  # Share of ∫φ further than two cells from the solid: haze and floaters
    cavity: Float[Array, ""]  # Share of the solid's volume whose density is below the level
    largest: Float[Array, ""]  # Largest density
    # Share by which the volume of the solid grows if the level is halved; ≪ 1 if the wall is sharp.
    growth: Float[Array, ""]

    def flaws(self) -> list[str]:
        """Why the density should not be read as mass density, in words; empty if it may be."""
        found = []
        deep, wall, largest = float(self.deep), float(self.wall), float(self.largest)
        if not _NEAR_ONE[0] <= wall <= _NEAR_ONE[1] or largest > _OVERSHOOT:
            found.append(
                f"densities of {wall:.3g} near the surface and up to {largest:.3g} are not"
                " probabilities of occupancy"
            )
        if deep < _HOLLOW:
            found.append(f"it is hollow: deep inside {100 * deep:.0f} % of the density near the surface")
        elif deep < _SOLID[0]:
            found.append(f"its inside is foggy: {100 * deep:.0f} % of the density near the surface")
        elif deep > _SOLID[1]:
            found.append(f"deep inside it has {100 * deep:.0f} % of the density near the surface")
        if float(self.spread) > _UNEVEN:
            found.append(f"the density inside is uneven by {100 * float(self.spread):.0f} %")
        if float(self.cavity) > _CAVITY and not deep < _HOLLOW:
            found.append(f"{100 * float(self.cavity):.0f} % of its volume is hollow")
        if float(self.gap) > 0:
            found.append(f"its surface had pores, closed up to {2 * float(self.gap):.0f} cells wide")
        if math.isnan(float(self.gap)):
            found.append("no watertight surface was found, so what is inside is uncertain")
        if float(self.outside) > _HAZE:
            found.append(f"{100 * float(self.outside):.0f} % of the density is haze or floaters")
        return found


def examine(lattice: Lattice) -> tuple[Interior, Bool[np.ndarray, "nx ny nz"]]:
    """Find the solid that a density stands for, and what its inside looks like.

    The level of the surface is half the plateau density. For an occupancy this is the natural level, for
    other fields the middle of the wall. Another level is taken if the part above it is not a watertight
    solid. It is not if

    - closing its pores by one more cell enlarges it by more than 6 %, or
    - a lower level finds a hollow of more than 5 % of its volume, bordered by its dense part, that it does
      not enclose: then the hollow is connected with the outside through pores.

    In that case pores of up to four cells are closed, and then lower levels are tried. Higher levels are not
    tried: they lose volume, and no check would show it, since a porous solid still covers its silhouettes.

    If none of these is watertight, the first level is taken as it is, and `gap` is NaN.

    Returns:
        The numbers, and the lattice points inside the solid: the largest connected part, its pores closed and
        its hollows filled.
    """
    values = lattice.values
    scale = plateau(values)
    solids: dict[tuple[float, int], np.ndarray] = {}

    def solid(level: float, gap: int) -> np.ndarray:
        if (level, gap) not in solids:
            solids[level, gap] = _filled(values, level * scale, gap)
        return solids[level, gap]

    tight = next(
        ((level, gap) for level in LEVELS for gap in GAPS if _is_tight(values, scale, level, gap, solid)),
        None,
    )
    level, gap = tight or (LEVELS[0], GAPS[0])
    inside = solid(level, gap)
    stated = math.nan if tight is None else float(gap)
    return _described(values, level * scale, stated, inside, solid(level / 2, gap)), inside


def fill_hollows(grid: GridField, *, stood: bool = False) -> tuple[GridField, Interior]:
    """A shell of density as a solid: what it encloses gets the density of its wall.

    Gaussian splats and many radiance fields are shells. Pores of up to four cells are closed if need be.

    Args:
        grid: Density.
        stood: It stood on a table, with z up, and was seen from above: a shell that is open at its foot is
            closed there first.

    Returns:
        The grid whose nodes inside the solid have at least the density of the wall, and what `grid` was like
        (`cavity`: share of the solid that was hollow).
    """
    checked_kind("grid", grid, GridField)
    origin, spacing = np.asarray(grid.origin, np.float64), np.asarray(grid.spacing, np.float64)
    values = node_values(grid)
    lattice = Lattice(_closed_below(values) if stood and values.any() else values, origin, spacing)
    interior, inside = examine(lattice)
    return sealed(lattice, interior, inside), interior


def _closed_below(values: Float[np.ndarray, "nx ny nz"]) -> Float[np.ndarray, "nx ny nz"]:
    """Densities with a wall across the lowest layers: in the one whose outline encloses most."""
    from scipy import ndimage

    dense = values > _DENSE * values.max()
    layers = np.flatnonzero(dense.any(axis=(0, 1)))
    lowest = layers[0] + np.arange(max(1, round(_FOOT * len(layers))))
    filled = [ndimage.binary_fill_holes(dense[:, :, k]) for k in lowest]
    best = int(np.argmax([layer.sum() for layer in filled]))
    closed = values.copy()
    closed[:, :, lowest[best]][filled[best]] = values.max()
    return closed


def node_values(grid: GridField) -> Float[np.ndarray, "nx ny nz"]:
    """Densities at the nodes of a grid, where its coefficients may overshoot."""
    origin, spacing = np.asarray(grid.origin, np.float64), np.asarray(grid.spacing, np.float64)
    nodes = origin + spacing * np.argwhere(np.ones(grid.shape, bool))
    return density_at(grid, nodes).reshape(grid.shape)


def sealed(lattice: Lattice, interior: Interior, inside: Bool[np.ndarray, "nx ny nz"]) -> GridField:
    """The field on its lattice, with everything inside the solid at least as dense as its wall."""
    wall = max(float(interior.wall), 2 * float(interior.level))
    values = np.where(inside, np.maximum(lattice.values, wall), lattice.values)
    return GridField.interpolating(values, lattice.origin, lattice.side)


def _is_tight(
    values: np.ndarray, scale: float, level: float, gap: int, solid: Callable[[float, int], np.ndarray]
) -> bool:
    from scipy import ndimage

    here = solid(level, gap)
    volume = here.sum()
    if solid(level, gap + 1).sum() > (1 + POROUS) * volume:
        return False
    near = None
    for lower in LEVELS[LEVELS.index(level) + 1 :]:
        hollow = solid(lower, gap) & (values < lower * scale) & ~here
        if hollow.sum() <= LEAK * volume:
            continue
        if near is None:
            near = ndimage.binary_dilation(values >= level * scale, _BALL, iterations=2)
        border = ndimage.binary_dilation(hollow, _BALL) & ~hollow
        if (border & near).sum() >= _SURROUNDED * border.sum():
            return False
    return True


def is_distance(field: GridField) -> bool:
    """Whether a density looks like a distance, which is zero within its object and grows evenly outside.

    The object of such a density would be what lies around.
    """
    values = np.asarray(field.values, np.float64)
    if min(values.shape) < _LEAST_NODES:
        return False
    inner = tuple(slice(n // 4, n - n // 4) for n in values.shape)
    border = np.ones(values.shape, bool)
    border[1:-1, 1:-1, 1:-1] = False
    if values[border].mean() <= 2 * values[inner].mean():
        return False
    slopes = np.linalg.norm(np.gradient(values, *np.asarray(field.spacing, np.float64)), axis=0)
    low, middle, high = np.quantile(slopes[border & (values > 0)], [0.25, 0.5, 0.75])
    return bool(high - low < _EVEN * middle)


def _filled(values: np.ndarray, level: float, gap: int) -> np.ndarray:
    """The largest part above a level, closed by `gap` cells, with what it encloses."""
    from scipy import ndimage

    labels, parts = ndimage.label(values >= level, _BALL)
    if parts == 0:
        return np.zeros(values.shape, bool)
    mass = ndimage.sum_labels(values, labels, np.arange(1, parts + 1))
    part = labels == 1 + int(np.argmax(mass))
    if gap:
        # Within the part's own box and a margin: distances over all of the lattice would be wasted.
        box = ndimage.find_objects(part.astype(np.int8))[0]
        padded = np.pad(part[box], gap + 1)
        grown = ndimage.distance_transform_edt(~padded) <= gap + 0.01
        closed = padded | (ndimage.distance_transform_edt(grown) > gap + 0.01)
        part = part.copy()
        part[box] = closed[(slice(gap + 1, -gap - 1),) * 3]
    return ndimage.binary_fill_holes(part)


def _described(
    values: np.ndarray, level: float, gap: float, inside: np.ndarray, wider: np.ndarray
) -> Interior:
    from scipy import ndimage

    depth = ndimage.distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1, 1:-1]
    volume = inside.sum()
    core = depth >= 2.5
    quartiles = np.quantile(values[core], [0.25, 0.5, 0.75]) if core.any() else np.ones(3)
    spread = 0.5 * (quartiles[2] - quartiles[0]) / max(quartiles[1], 1e-3 * level)
    deepest = float(depth.max())
    near = (depth >= min(1.5, deepest)) & (depth < 4)
    wall = float(np.median(values[near]))
    deep = math.nan
    if deepest >= 6:
        deep = float(np.median(values[depth >= max(4.0, 0.5 * deepest)])) / max(wall, 1e-3 * level)
    far = ~ndimage.binary_dilation(inside, _BALL, iterations=2)
    numbers = {
        "level": level,
        "wall": wall,
        "gap": gap,
        "deep": deep,
        "spread": min(float(spread), 1e3),
        "outside": values[far].sum() / values.sum(),
        "cavity": (inside & (values < level)).sum() / volume,
        "largest": values.max(),
        "growth": wider.sum() / volume - 1,
    }
    return Interior(**{name: floating(float(value)) for name, value in numbers.items()})
