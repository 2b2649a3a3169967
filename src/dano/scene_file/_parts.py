"""One object of several parts, each of a material or a mass of its own."""

import dataclasses
import itertools
import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from dano.building import BuildOptions
from dano.checks import checked_items, checked_kind, checked_number, checked_path, checked_progress, shown
from dano.fields import AbstractShape, load_field, scaled, SignedDistanceGrid
from dano.keys import seed_key
from dano.maths import rigidly_joined
from dano.objects import MassProperties, NeuralObject
from dano.progress import Progress
from dano.scene_file._forecast import size_doubts

_OVERLAPS = 0.1
"""Share of a part's volume inside another from which it is refused: that material would count twice."""

_APART = 0.01
"""Gap between a part and the rest, in sizes of the whole, from which they do not touch."""

_PROBES = 20_000
"""Points of each part that are asked whether they lie in another: a tenth of overlap is known to .5 %."""

_NODES, _MARGIN = (96, 256), 3
"""Least and most nodes along the longest side of several parts, and those around them."""

_STEEL, _PLASTIC = 7850.0, 1100.0
"""Densities [kg/m³] of what tools are made of, for what a doubt says."""

_NOTABLE, _OTHER_COLOUR, _MOST_FACES = 0.01, 30.0, 300_000
"""Least share of the volume of a part that counts, least difference of a colour of 255, and most faces: a
second of work."""

_COLOURED = (".ply", ".obj", ".off")
"""Formats of single meshes whose faces or vertices may have colours."""

_LIKELY = (10.0, 30_000.0)
"""Densities of solids [kg/m³]: from foams to above gold. What is beyond is likely in other units."""

_WEIGHED = re.compile(r"^(?P<source>.+):(?P<number>[-+]?[\d.]+(?:[eE][-+]?\d+)?)(?P<unit>kg|g)?$")


@dataclasses.dataclass(frozen=True)
class Part:
    """A part of an object, homogeneous."""

    source: "str | os.PathLike[str] | AbstractShape"  # A mesh's file, or a shape
    density: int | float | None = None  # Mass per volume [kg/m³]
    mass: int | float | None = None  # Its mass [kg], instead of the density

    def __post_init__(self) -> None:
        """Check it.

        Raises:
            ValueError: If the source is neither, or there is not exactly one of density and mass, > 0.
        """
        if not isinstance(self.source, AbstractShape):
            checked_path("source of a part", self.source)
        if (self.density is None) == (self.mass is None):
            raise ValueError(
                f"{self.name} needs either a density [kg/m³] or a mass [kg], as {self.name}:7850 or"
                f" {self.name}:0.3kg, got density {self.density} and mass {self.mass}"
            )
        for name in ("density", "mass"):
            if getattr(self, name) is not None:
                checked_number(f"{name} of {self.name}", getattr(self, name), above=0)
        if self.density is not None and not _LIKELY[0] <= self.density <= _LIKELY[1]:
            raise ValueError(
                f"density of {self.name} must be in kg/m³, from {_LIKELY[0]:g} to {_LIKELY[1]:g} (steel 7850,"
                f" plastic 1100), got {self.density:g}"
            )

    @property
    def name(self) -> str:
        """What messages call it."""
        return type(self.source).__name__ if isinstance(self.source, AbstractShape) else str(self.source)


def part_of(text: str | os.PathLike[str]) -> Part | None:
    """A part as the command line has it, FILE:DENSITY or FILE:MASSkg; None if neither is given.

    Raises:
        ValueError: If the number is out of range.
    """
    found = None if os.path.exists(text) else _WEIGHED.match(str(text))
    if found is None:
        return None
    number, source = float(found["number"]), found["source"]
    if found["unit"] is None:
        return Part(source, density=number)
    return Part(source, mass=number * (1e-3 if found["unit"] == "g" else 1.0))


def parts_of(texts: Sequence[str | os.PathLike[str]]) -> list[Part]:
    """Parts as the command line has them; none if it is a single file without a density.

    Raises:
        ValueError: If one of several has neither density nor mass.
    """
    found = [part_of(text) for text in texts]
    if len(texts) == 1 and found[0] is None:
        return []
    for text, part in zip(texts, found, strict=True):
        if part is None:
            raise ValueError(
                f"{text} needs a density [kg/m³] or a mass, as the other parts have: {text}:7850 or"
                f" {text}:0.3kg"
            )
    return [part for part in found if part is not None]


def build_parts(
    parts: Sequence[Part],
    options: BuildOptions | None = None,
    *,
    dashes: str = "",
    progress: Progress | None = None,
) -> NeuralObject:
    """One rigid object of parts that are homogeneous each, in the frame that their files share.

    Its surface is that of their union. Mass, centre of mass and inertia are sums over the parts,

        m = Σ mᵢ,  c = Σ mᵢ cᵢ / m,  J = Σ Jᵢ + mᵢ (|cᵢ − c|² I − (cᵢ − c)(cᵢ − c)ᵀ),

    of the closed forms of meshes and shapes; a mesh that overlaps itself is integrated. That parts do not
    touch, or overlap by a little, raises a UserWarning.

    Args:
        parts: The parts, at least one.
        options: See `build_object`; `mass` and `mass_scale` are the parts' own. Meshes without units are all
            read in the same: if one is so long that it must be in millimetres, all are.
        dashes: What names of options begin with in messages.
        progress: Called with a description and the share done.

    Raises:
        ValueError: If a part is no solid, overlaps another by more than a tenth of its volume, or an option
            does not fit.
    """
    parts = checked_items("parts", parts, Part)
    if not parts:
        raise ValueError("parts must hold at least one part, got none")
    chosen = BuildOptions() if options is None else checked_kind("options", options, BuildOptions)
    if chosen.mass is not None or chosen.mass_scale is not None:
        raise ValueError(
            f"parts have densities or masses of their own: leave out {dashes}mass and"
            f" {dashes}mass{'-' if dashes else '_'}scale"
        )
    tell = checked_progress(progress)
    shapes = _shapes(parts, chosen, tell)
    whole = _joined(shapes)
    if chosen.length is not None:
        factor = checked_number("length", chosen.length, above=0) / float(whole.size)
        shapes = [scaled(shape, factor) for shape in shapes]
        whole = scaled(whole, factor)
    weights = [_weight(part, shape, chosen) for part, shape in zip(parts, shapes, strict=True)]
    said = _fits(parts, shapes, float(whole.size)) + size_doubts(float(whole.size), f"{dashes}length")
    made = NeuralObject.from_field(
        whole,
        n_samples=chosen.samples,
        density_range=chosen.density_range,
        mass_model="density",
        mass=float(sum(weight.mass for weight in weights)),
        resolution=chosen.resolution,
        floaters=True,
        key=seed_key(chosen.seed),
        progress=progress,
    )
    for text in said:
        warnings.warn(text, UserWarning, stacklevel=2)
    words = ", ".join(
        f"{Path(part.name).name} {weight.mass:.4g} kg" for part, weight in zip(parts, weights, strict=True)
    )
    total = _sum(weights, made.mass.mass.dtype)
    made = eqx.tree_at(lambda o: o.mass, made, total)
    return dataclasses.replace(made, mass_model="given", mass_reason=f"sum of {len(parts)} parts: {words}")


def materials_doubt(path: Path) -> str | None:
    """What to say of a mesh that is weighed as one material, but whose closed parts have different colours.

    It says by how much the centre of mass may be off: were the largest part plastic and the rest steel, or
    the other way round.
    """
    if path.suffix.lower() not in _COLOURED or not path.is_file():
        return None
    import trimesh

    try:
        mesh = trimesh.load(path, process=True)
    except Exception:  # each of trimesh's readers raises its own kinds; it was read and mended before
        return None
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) > _MOST_FACES:
        return None
    if mesh.visual is None or not mesh.visual.defined:
        return None
    pieces = [piece for piece in mesh.split(only_watertight=True) if piece.volume > 0]
    volumes = np.array([piece.volume for piece in pieces])
    large = [k for k in range(len(pieces)) if volumes[k] > _NOTABLE * volumes.sum()]
    looks: list[Any] = [pieces[k].visual for k in large]
    colours = np.array([np.asarray(look.face_colors)[:, :3].mean(axis=0) for look in looks])
    if len(large) < 2 or np.ptp(colours, axis=0).max() < _OTHER_COLOUR:
        return None
    volumes = volumes[large]
    centres = np.array([pieces[k].center_mass for k in large])
    same = volumes @ centres / volumes.sum()
    shifts = []
    for first, rest in ((_PLASTIC, _STEEL), (_STEEL, _PLASTIC)):
        weights = volumes * np.where(np.arange(len(volumes)) == np.argmax(volumes), first, rest)
        shifts.append(np.linalg.norm(weights @ centres / weights.sum() - same))
    share = 100 * max(shifts) / float(np.max(mesh.extents))
    return (
        f"{path} has {len(large)} closed parts of different colours, and is weighed as one material: were the"
        f" largest plastic and the rest steel, or the other way round, the centre of mass would be off by"
        f" {share:.0f} % of the size; give them as files of their own, FILE:DENSITY each, or their masses"
    )


class _Weight(NamedTuple):
    """Mass [kg], centre [m, F], inertia about it [kg m²] of a part, and errors of their integration."""

    mass: float
    com: np.ndarray
    inertia: np.ndarray
    errors: tuple[float, np.ndarray, np.ndarray]


def _shapes(parts: Sequence[Part], options: BuildOptions, tell: Progress) -> list[AbstractShape]:
    """The solid of each part; all meshes in the same unit."""
    found, guessed, said = [], [], []
    for k, part in enumerate(parts):
        tell(f"reading {Path(part.name).name}", k / len(parts))
        shape, texts = _shape(part, options.of_file)
        found.append(shape)
        guessed.append(any("read as millimetres" in text for text in texts))
        said.append(texts)
    if any(guessed) and not all(guessed):
        for k, part in enumerate(parts):
            if guessed[k] or isinstance(part.source, AbstractShape):
                continue
            found[k], said[k] = _shape(part, {**options.of_file, "units": "mm"})
        first = parts[guessed.index(True)].name
        said.append(
            [f"all parts are read in millimetres, as {first} must be; units of BuildOptions says otherwise"]
        )
    for text in dict.fromkeys(text for texts in said for text in texts):
        warnings.warn(text, UserWarning, stacklevel=3)
    return found


def _shape(part: Part, options: dict[str, Any]) -> tuple[AbstractShape, list[str]]:
    if isinstance(part.source, AbstractShape):
        if not np.isfinite(float(part.source.size)):
            raise ValueError(f"{part.name} must be bounded to be a part, got a solid without an end")
        return part.source, []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        shape = load_field(Path(part.source), **options)
    if not isinstance(shape, AbstractShape):
        raise ValueError(
            f"{part.name} must be a mesh to be a part with a density, got {shown(shape)}: it has its own"
        )
    return shape, [str(each.message) for each in caught]


def _joined(shapes: Sequence[AbstractShape]) -> AbstractShape:
    """The union as one sampled distance: a spline has normals where parts meet, a minimum has none."""
    if len(shapes) == 1:
        return shapes[0]
    boxes = np.array([np.asarray(shape.bounds, np.float64) for shape in shapes])
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    longest = float((high - low).max())
    finest = [float(np.min(shape.spacing)) for shape in shapes if isinstance(shape, SignedDistanceGrid)]
    spacing = max(min(finest, default=longest / _NODES[0]), longest / _NODES[1])
    counts = np.ceil((high - low) / spacing).astype(int) + 2 * _MARGIN + 1
    origin = 0.5 * (low + high) - 0.5 * spacing * (counts - 1)
    distances = np.empty(counts, np.float32)
    y, z = (origin[k] + spacing * np.arange(counts[k]) for k in (1, 2))
    for i in range(counts[0]):
        plane = np.stack(np.meshgrid([origin[0] + spacing * i], y, z, indexing="ij")).reshape(3, -1)
        each = [np.asarray(_distances(shape, jnp.asarray(plane))) for shape in shapes]
        distances[i] = np.min(each, axis=0).reshape(counts[1:])
    return SignedDistanceGrid(distances, origin, spacing)


@eqx.filter_jit
def _distances(shape: AbstractShape, points: Array) -> Array:
    """Compiled once for a part: uncompiled, each plane of points would compile its loop over them anew."""
    return shape.sdf_jet(points, 0)


def _weight(part: Part, shape: AbstractShape, options: BuildOptions) -> _Weight:
    moments = shape.solid_moments()
    if moments is None:
        found = MassProperties.from_field(
            shape,
            mass=None if part.mass is None else float(part.mass),
            mass_scale=1.0 if part.density is None else float(part.density),
            resolution=options.resolution,
            key=seed_key(options.seed),
        )
        errors = (float(found.mass_error), np.asarray(found.com_error), np.asarray(found.inertia_error))
        return _Weight(float(found.mass), np.asarray(found.com), np.asarray(found.inertia), errors)
    volume = float(moments.volume)
    mass = part.mass if part.mass is not None else float(part.density or 0.0) * volume
    second = np.asarray(moments.second_moment, float) * mass / volume
    inertia = np.trace(second) * np.eye(3) - second
    return _Weight(mass, np.asarray(moments.centroid, float), inertia, (0.0, np.zeros(3), np.zeros((3, 3))))


def _sum(weights: Sequence[_Weight], dtype) -> MassProperties:
    """Mass properties of rigidly joined parts (parallel-axis theorem)."""
    mass, com, inertia = rigidly_joined(*(np.array([weight[k] for weight in weights]) for k in range(3)))
    errors = [np.sqrt(sum(np.asarray(weight.errors[k]) ** 2 for weight in weights)) for k in range(3)]
    return MassProperties(
        jnp.asarray(mass, dtype),
        jnp.asarray(com, dtype),
        jnp.asarray(0.5 * (inertia + inertia.T), dtype),
        mass_error=jnp.asarray(errors[0], dtype),
        com_error=jnp.asarray(errors[1], dtype),
        inertia_error=jnp.asarray(errors[2], dtype),
    )


def _fits(parts: Sequence[Part], shapes: Sequence[AbstractShape], size: float) -> list[str]:
    """What to say of parts that overlap by a little, or do not touch.

    Raises:
        ValueError: If one overlaps another by much.
    """
    said, touches = [], np.eye(len(parts), dtype=bool)
    for i, j in itertools.combinations(range(len(parts)), 2):
        depth = [_share_within(shapes[i], shapes[j]), _share_within(shapes[j], shapes[i])]
        a, b = parts[i].name, parts[j].name
        inner = i if depth[0][0] >= depth[1][0] else j
        share = max(depth[0][0], depth[1][0])
        gap = min(depth[0][1], depth[1][1])
        touches[i, j] = touches[j, i] = gap < _APART * size
        if share > _OVERLAPS:
            raise ValueError(
                f"{a} and {b} overlap: {100 * share:.0f} % of {parts[inner].name} lies in the other part and"
                " would weigh twice; cut it out of one of them (or check that their files share a frame and"
                " units)"
            )
        if share > 0.05 * _OVERLAPS:
            said.append(
                f"{a} and {b} overlap by {100 * share:.1f} % of {parts[inner].name}, which weighs twice"
            )
    reached = touches[0]
    for _ in parts:
        reached = np.atleast_1d(touches[reached].any(axis=0))
    if not reached.all():
        loose = ", ".join(part.name for part, there in zip(parts, reached, strict=True) if not there)
        said.append(
            f"{loose} does not touch the other parts: they are one rigid object all the same; if they should"
            " touch, check that the files share a frame and units"
        )
    return said


def _share_within(inner: AbstractShape, outer: AbstractShape) -> tuple[float, float]:
    """Share of a solid that lies in another, and the gap between them [m], from points in its bounds."""
    low, high = np.asarray(inner.bounds, np.float64)
    drawn = np.random.default_rng(0).uniform(low, high, (_PROBES, 3))
    own = np.asarray(inner.sdf_jet(jnp.asarray(drawn.T), 0)).ravel()
    inside = drawn[own < 0]
    if not len(inside):
        # Thinner than the points are dense: asked at what is nearest to it.
        inside = drawn[np.argsort(own)[:100]]
    other = np.asarray(outer.sdf_jet(jnp.asarray(inside.T), 0)).ravel()
    there = np.asarray(inner.sdf_jet(jnp.asarray(inside.T), 0)).ravel()
    share = float(np.mean((other < 0) & (there < 0)))
    # From a point at depth d in one, the other is no nearer than their distance.
    return share, float(np.min(np.maximum(other + there, 0.0)))
