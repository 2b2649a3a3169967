"""What contact needs to know of all bodies, laid out so that code grows with their kinds, not their number.

Surface samples of all bodies stand in one table of blocks. Solids are grouped by kind (the same class, the
same array shapes), and those of a kind are stacked. All pairs go through the same code; only the distance to
a solid is a branch for each kind. Sixty boxes compile like one, and another kind adds its distance.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float, Int

from dano.contact._colliders import BLOCK, SurfaceSet
from dano.contact._kernels import Tables, tables_of
from dano.fields import AbstractShape

FIXED, AXIS, BALL = 0, 1, 2
"""How the samples of a surface turn with its body: with it; about its z axis they keep facing the other body;
or they keep facing it altogether."""
TURNING = {"fixed": FIXED, "axis": AXIS, "ball": BALL}

# Samples count as near within this share of the smaller body's size, besides the way they go.
_MARGIN = 0.001
# Geometry is taken where bodies have sunk into each other by at most this share of the smaller one's size …
_SINK = 0.01
# … and by this share of the thinner one's half thickness.
_THIN = 0.25
# Up to so many blocks the moment of meeting is found from samples, beyond from the centres of blocks.
_FEW_BLOCKS = 16


class Part(NamedTuple):
    """What contact sees of a body besides its motion.

    Attributes:
        surface: Samples, or None.
        scale: Semi-axes that directions on the unit ball are multiplied with [m]; ones for other surfaces.
        solid: What the samples of others press on, or None.
        extent: Centre of a ball around the body [m, F], its radius [m] (infinite for a half-space), the
            body's largest extent and its largest depth below the surface [m].
        twin: Index of the first body with the same samples and solid.
    """

    surface: SurfaceSet | None
    scale: Float[Array, "3"]
    solid: AbstractShape | None
    extent: Float[Array, "6"]
    twin: int


class Links(eqx.Module):
    """Where n bodies are and how they move.

    Attributes:
        position: Of the centre of mass [m, W], shape (n, 3).
        orientation: wxyz, shape (n, 4).
        ahead: Orientation at the end of the step at the old spin, shape (n, 4).
        velocity: Of the centre of mass [m/s, W].
        spin: [rad/s, W].
        com: Centre of mass in the field frame [m, F].
        lightness: 1 / mass, zero for a fixed body [1/kg], shape (n,).
        mobility: Inverse of the inertia, zero for a fixed body [1/(kg m²), W], shape (n, 3, 3).
    """

    position: Float[Array, "n 3"]
    orientation: Float[Array, "n 4"]
    ahead: Float[Array, "n 4"]
    velocity: Float[Array, "n 3"]
    spin: Float[Array, "n 3"]
    com: Float[Array, "n 3"]
    lightness: Float[Array, " n"]
    mobility: Float[Array, "n 3 3"]


class Side(NamedTuple):
    """Samples of one body (first) that may press on the solid of another (second), as arrays over pairs.

    Attributes:
        first: Index of the sampled body.
        second: Index of the queried body.
        kind: Index of the kind of the second body's solid.
        member: Index of that solid among those of its kind.
        contact: Index into the scene's contacts.
        share: Share of the contact's stiffness that this side carries.
        follows: 1 where points follow the second body, which rolls on the first, else 0.
        sink: Depth up to which predicted geometry is taken [m].
        margin: Distance within which samples count as near [m].
    """

    first: Any
    second: Any
    kind: Any
    member: Any
    contact: Any
    share: Any
    follows: Any
    sink: Any
    margin: Any


class Kind(eqx.Module):
    """All pairs whose second body's solid is of one kind.

    Attributes:
        solids: Solids of this kind, leaves stacked if there are several.
        sides: The pairs, arrays of shape (s,).
        several: Whether leaves are stacked (static).
        widest: Most blocks of samples that a first body of these pairs has (static).
        probes: Most probes that a first body of these pairs has (static).
        turns: Which ways of turning occur among the first bodies (static).
    """

    solids: AbstractShape
    sides: Side
    several: bool = eqx.field(static=True)
    widest: int = eqx.field(static=True)
    probes: int = eqx.field(static=True)
    turns: tuple[int, ...] = eqx.field(static=True)

    def sdf_jet(self, side: Side, x: Float[Array, "3 n"], order: int):
        """Distance to the solid of a side, with order 1 its gradient, too: see `AbstractShape.sdf_jet`."""
        solid = jax.tree.map(lambda leaf: leaf[side.member], self.solids) if self.several else self.solids
        return solid.sdf_jet(x, order)


class Mixture(NamedTuple):
    """Pairs of several kinds, which all go through the same code up to the distances to their solids.

    Attributes: as of `Kind`.
    """

    kinds: tuple[Kind, ...]
    sides: Side

    @property
    def widest(self) -> int:
        """Most blocks."""
        return max(kind.widest for kind in self.kinds)

    @property
    def probes(self) -> int:
        """Most probes."""
        return max(kind.probes for kind in self.kinds)

    @property
    def turns(self) -> tuple[int, ...]:
        """Ways of turning."""
        return tuple(sorted({turn for kind in self.kinds for turn in kind.turns}))

    def sdf_jet(self, side: Side, x: Float[Array, "3 n"], order: int):
        """See `Kind.sdf_jet`."""
        if len(self.kinds) == 1:
            return self.kinds[0].sdf_jet(side, x, order)
        branches = [lambda x, kind=kind: kind.sdf_jet(side, x, order) for kind in self.kinds]
        return jax.lax.switch(side.kind, branches, x)


class Geometry(eqx.Module):
    """Samples and solids of a scene.

    Attributes:
        blocks: Points [m, F] and vector areas [m², F] of all samples, shape (b, 6, BLOCK).
        centers: Of balls around the blocks [m, F], shape (b, 3).
        radii: Of these balls [m], shape (b,).
        start: First block of each body, shape (n,).
        blocks_of: How many blocks each body has, shape (n,).
        probes: Points of all bodies that say how deep they are, coarsely if there are many samples [m, F].
        probe_start: First probe of each body.
        probes_of: How many probes each body has.
        scale: See `Part`, shape (n, 3).
        turning: See `TURNING`, shape (n,).
        middle: Centres of balls around the bodies [m, F], shape (n, 3).
        radius: Of these balls, shape (n,).
        kinds: Pairs by the kind of solid that is pressed on.
        tables: The same for the search in machine code, None where XLA searches.
    """

    blocks: Float[Array, "b 6 w"]
    centers: Float[Array, "b 3"]
    radii: Float[Array, " b"]
    start: Int[Array, " n"]
    blocks_of: Int[Array, " n"]
    probes: Float[Array, "3 k"]
    probe_start: Int[Array, " n"]
    probes_of: Int[Array, " n"]
    scale: Float[Array, "n 3"]
    turning: Int[Array, " n"]
    middle: Float[Array, "n 3"]
    radius: Float[Array, " n"]
    kinds: tuple[Kind, ...]
    tables: Tables | None = None

    @property
    def mixture(self) -> Mixture:
        """All pairs, those of the first kind first."""
        sides = jax.tree.map(lambda *x: jnp.concatenate(x), *(kind.sides for kind in self.kinds))
        return Mixture(self.kinds, sides)


def gather_geometry(
    parts: Sequence[Part],
    pairs: Sequence[tuple[int, int, int]],
    gravity_step: Float[Array, ""],
    dtype: DTypeLike,
) -> Geometry:
    """Tables for the pairs of bodies that press on each other.

    Args:
        parts: All bodies.
        pairs: (first, second, contact): samples of the first press on the solid of the second.
        gravity_step: Way that gravity adds to a body's in a step, h² g [m].
        dtype: Of the tables.
    """
    empty = SurfaceSet.none(dtype)
    sets = [part.surface if part.surface is not None else empty for part in parts]
    first_of: dict[int, tuple[int, int]] = {}
    tables, probes, start, blocks, points = [], [], [], 0, 0
    for part, each in zip(parts, sets, strict=True):
        if part.twin not in first_of:
            first_of[part.twin] = blocks, points
            tables.append(each)
            probes.append(_probes_of(each))
            blocks, points = blocks + each.radii.shape[0], points + probes[-1].shape[1]
        start.append(first_of[part.twin])
    # Reading a body's blocks, or probes, takes as many as the widest body has.
    probes.append(jnp.zeros((3, max((each.shape[1] for each in probes), default=0)), dtype))
    tables.append(SurfaceSet.none(dtype, max((each.radii.shape[0] for each in sets), default=0)))
    extents = jnp.stack([part.extent for part in parts]).astype(dtype)
    rows = [
        jnp.concatenate([t.points[:3], t.vectors]).reshape(6, -1, BLOCK).transpose(1, 0, 2) for t in tables
    ]
    geometry = Geometry(
        jnp.concatenate(rows).astype(dtype),
        jnp.concatenate([t.centers for t in tables]).astype(dtype),
        jnp.concatenate([t.radii for t in tables]).astype(dtype),
        jnp.asarray([block for block, _ in start]),
        jnp.asarray([each.radii.shape[0] for each in sets]),
        jnp.concatenate(probes, axis=1).astype(dtype),
        jnp.asarray([probe for _, probe in start]),
        jnp.asarray([_probes_of(each).shape[1] for each in sets]),
        jnp.stack([part.scale for part in parts]).astype(dtype),
        jnp.asarray([TURNING[each.turning] for each in sets]),
        extents[:, :3],
        extents[:, 3],
        tuple(_kinds(parts, sets, pairs, extents[:, 4:], gravity_step, dtype)),
    )
    return eqx.tree_at(lambda g: g.tables, geometry, tables_of(geometry, dtype), is_leaf=lambda x: x is None)


def _probes_of(surface: SurfaceSet) -> Float[Array, "3 k"]:
    """Its samples, or where they are many the centres of their blocks."""
    return surface.points[:3] if surface.radii.shape[0] <= _FEW_BLOCKS else surface.centers.T


def _kinds(parts, sets, pairs, sizes: Float[Array, "n 2"], gravity_step, dtype):
    """Pairs grouped by the kind of the second body's solid; `sizes` are extents and depths of the bodies."""
    both = {(first, second) for first, second, _ in pairs}
    groups: dict[Any, list[tuple[int, int, int]]] = {}
    for pair in pairs:
        groups.setdefault(_kind(parts[pair[1]].solid), []).append(pair)
    for number, members in enumerate(groups.values()):
        # A solid that several bodies share stands once.
        unique: dict[int, int] = {}
        solids, member = [], []
        for _, second, _ in members:
            twin = parts[second].twin
            if twin not in unique:
                unique[twin] = len(solids)
                solids.append(parts[second].solid)
            member.append(unique[twin])
        several = len(solids) > 1
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *solids) if several else solids[0]
        first, second, contact = (np.array(x) for x in zip(*members, strict=True))
        size, thickness = jnp.minimum(sizes[first], sizes[second]).T
        smooth = [sets[i].turning != "fixed" for i in range(len(sets))]
        yield Kind(
            stacked,
            Side(
                jnp.asarray(first),
                jnp.asarray(second),
                jnp.full(len(members), number),
                jnp.asarray(member),
                jnp.asarray(contact),
                jnp.asarray([0.5 if (j, i) in both else 1.0 for i, j, _ in members], dtype),
                jnp.asarray([float(smooth[j] and not smooth[i]) for i, j, _ in members], dtype),
                jnp.minimum(_SINK * size, _THIN * thickness),
                _MARGIN * size + 2 * gravity_step.astype(dtype),
            ),
            several,
            max(sets[i].radii.shape[0] for i in first),
            max(_probes_of(sets[i]).shape[1] for i in first),
            tuple(sorted({TURNING[sets[i].turning] for i in first})),
        )


def _kind(solid: AbstractShape):
    leaves, structure = jax.tree.flatten(solid)
    return structure, tuple((leaf.shape, str(leaf.dtype)) for leaf in leaves)
