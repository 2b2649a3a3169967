"""The search for contacts as a launch of a kernel: tables of a model, and MuJoCo's arrays where they are."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from dano.mujoco._settings import ContactSettings
from dano.mujoco._things import AttachedObject, Geom, is_gap_beyond, object_solid, Solid, Surface
from dano.mujoco.kernels import words
from dano.mujoco.kernels.words import REALS, WHOLES
from dano.native import (
    compiled_kernel,
    cpu_kernel,
    Features,
    instance,
    KernelLaunch,
    kind_numbers,
    layout_of,
    lower_bounds,
    Parameters,
)

_TABLES, _FINDING = "dano.mujoco.kernels.tables", "dano.mujoco.kernels.finding"
CALLBACK, CALLBACK_FEATURES = "dano.mujoco.kernels.callback", Features(WIDE=True)
_WORLDS = "dano.mujoco.kernels.worlds"
_FEATURES = Features(KINDS=frozenset(range(7)), DEGREES=frozenset({2}), UNIONS=False)
_BLOCK = 16
"""Samples of a block, as kernels have it."""
_TOLD = 6
"""Numbers of `dano.mujoco.kernels.tables.Options`."""
_LANES = 64
"""Threads of a block on a GPU: each needs many registers."""
_NONE = 1e30
"""Area of a sample where there are none [m²]."""
_FLAT = 10.0
"""A shape with this radius of curvature, in distances between samples, is as a plane to an object's: they
miss no more than 1/80 of that distance of its depth. Its own samples, which are few, are not asked then.
Those of a ball turn to what is nearest; with several feet on it, that is one after the other."""


class Part(NamedTuple):
    """A geom or an object."""

    body: int  # Body that it moves with
    geom: int  # Geom that it is, or that stands for the object
    solid: Solid  # Its solid
    surface: Surface | None  # Samples that press on others; None for none
    scale: Float[np.ndarray, "3"]  # Factors of samples on the unit ball [m]
    thing: AttachedObject | None  # The object, None for a geom


def kernel_builds() -> list[tuple[Features, str]]:
    """Features and modules of the kernels that bridges to MuJoCo usually ask for."""
    return [(_FEATURES, _FINDING), (CALLBACK_FEATURES, CALLBACK)]


def part_of_geom(body: int, geom: int, found: Geom) -> Part:
    """A geom of a model."""
    return Part(body, geom, found.solid, found.surface, found.scale, None)


def part_of_thing(body: int, geom: int, thing: AttachedObject) -> Part:
    """An object."""
    return Part(body, geom, object_solid(thing.obj), thing.surface, np.ones(3), thing)


class BridgeModel:
    """Arrays of `dano.mujoco.kernels.tables.Known` of a model, and what their kernels must know."""

    def __init__(
        self,
        parts: Sequence[Part],
        pairs: Int[np.ndarray, "k 2"],
        sizes: Float[np.ndarray, "g 3"],
        device: str | None = None,
    ):
        """See `dano.mujoco.kernels.tables.Known`.

        Args:
            parts: Parts.
            pairs: Those that may touch.
            sizes: Of the model's geoms [m].
            device: Where MuJoCo Warp has its worlds, with numbers of 32 bits; None for MuJoCo itself.
        """
        degrees = {part.solid.degree for part in parts if part.solid.kind == "GRID"}
        self.features = _FEATURES if degrees <= {2} else _FEATURES.but(DEGREES=frozenset({1, 2, 3}))
        if device is not None:
            self.features = self.features.but(WIDE=False)
        self.device = device or "cpu"
        self.lanes = 1 if device is None else _LANES
        self.parts, self.pairs = parts, pairs
        self.kernel: Any = self._kernel(device)
        layout = self.kernel.layout if device is None else layout_of(self.kernel)
        self.arrays = _arrays(Parameters(layout), parts, pairs, sizes)
        most = [sum(_count(parts[i]) for i in pair) for pair in pairs]
        self.room = max(most, default=0)

    def _kernel(self, device: str | None) -> Any:
        if device is None:
            return cpu_kernel(self.features, _FINDING, "find", what="the bridge")
        return compiled_kernel(
            lambda: instance(self.features, _WORLDS).find_in_worlds, device, self.lanes, what="the bridge"
        )

    def structure(self) -> Any:
        """The arrays as a structure of Warp's, where the kernel runs."""
        return filled(instance(self.features, _TABLES).Known(), self.arrays, "known", self.device)


def filled(structure: Any, arrays: Mapping[str, np.ndarray], place: str, device: str) -> Any:
    """A structure of Warp's with copies of arrays, by the places of its fields."""
    import warp as wp

    for name, variable in structure._cls.vars.items():
        if not isinstance(variable.type, wp.array):
            filled(getattr(structure, name), arrays, f"{place}.{name}", device)
        elif f"{place}.{name}" in arrays:
            values = arrays[f"{place}.{name}"]
            shown = values if variable.type.ndim == 1 else values[None]
            setattr(structure, name, wp.array(shown, dtype=variable.type.dtype, device=device))
    return structure


def _arrays(
    like: Parameters, parts: Sequence[Part], pairs: Int[np.ndarray, "k 2"], sizes: Float[np.ndarray, "g 3"]
) -> dict[str, np.ndarray]:
    """Arrays of `dano.mujoco.kernels.tables.Known` by place."""
    sampled = [each for part in parts for each in _surfaces(part)]
    planes = [part.solid.planes for part in parts if part.solid.planes is not None]
    solids, at = _solids(like, parts)
    numbers, index = _parts(like, parts, at)
    samples = like.rows("known.samples", sum(len(each.points) for each in sampled))
    if sampled:
        samples["point"] = np.concatenate([each.points for each in sampled])
        samples["area"] = np.concatenate([each.vectors for each in sampled])
    faces = [face for part in parts if part.thing is not None for face in part.thing.faces.faces]
    flat = like.rows("known.faces", len(faces))
    if faces:
        counts = [len(face.edges) for face in faces]
        flat["plane"], flat["count"] = np.array([face.plane for face in faces]), counts
        flat["first"] = np.cumsum([0, *counts[:-1]])
    on_faces = [_on_faces(part, each) for part in parts for each in _surfaces(part)]
    touching = like.rows("known.pairs", len(pairs))
    touching["first"], touching["second"] = pairs.T
    touching["both"] = [not _is_flat(parts[a], parts[b]) for a, b in pairs]
    plain = {
        "precedence": [np.zeros(0), *(each.precedence for each in sampled)],
        "balls": [np.zeros((0, 4)), *(each.balls for each in sampled)],
        "runs": [np.zeros((0, 4)), *(each.runs for each in sampled)],
        "planes": [np.zeros((0, 4)), *planes],
        "edges": [np.zeros((0, 4)), *(face.edges for face in faces)],
        "facing": [np.zeros((0, 3)), *(facing for facing, _ in on_faces)],
        "rim": [np.zeros(0), *(rim for _, rim in on_faces)],
        "sizes": [np.asarray(sizes)],
    }
    found = {"parts": numbers, "index": index, "pairs": touching, "samples": samples, "faces": flat}
    for name, values in plain.items():
        base = like.layout.arrays[f"known.{name}"].dtype.base
        found[name] = np.ascontiguousarray(np.concatenate(values), base)
    return {**{f"known.{name}": values for name, values in found.items()}, **solids}


def _surfaces(part: Part) -> list[Surface]:
    """The samples of a part, then a polyhedron's corners."""
    corners = None if part.thing is None else part.thing.corners
    return [each for each in (part.surface, corners) if each is not None]


def _on_faces(part: Part, surface: Surface) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Normals of the faces that samples lie within, and which lie on edges: see `Faces.around`."""
    if part.thing is None:
        return np.zeros((len(surface.points), 3)), np.zeros(len(surface.points), bool)
    return part.thing.faces.around(surface.points, surface.vectors)


def _grain(part: Part) -> float:
    """Area of a sample [m²], of those that turn the finest; endless where there are none that are asked."""
    if part.surface is None:
        return _NONE
    areas = np.linalg.norm(part.surface.vectors * np.prod(part.scale) / part.scale, axis=1)
    areas = areas[areas > 0]
    return float(np.median(areas) if part.surface.turning == 0 else areas.min())


def _count(part: Part) -> int:
    return 0 if part.surface is None else len(part.surface.points)


def _is_flat(part: Part, object_part: Part) -> bool:
    """Whether a part is as a plane to the samples of an object."""
    if object_part.surface is None:
        return False
    areas = np.linalg.norm(object_part.surface.vectors, axis=1)
    return part.solid.bend >= _FLAT * float(np.sqrt(areas.max()))


def _number(kind: str) -> int:
    """Of a kind of solid by its name."""
    return kind_numbers()[kind] if kind in kind_numbers() else getattr(words, kind)


def _solids(like: Parameters, parts: Sequence[Part]) -> tuple[dict[str, np.ndarray], list[int]]:
    """Leaves, kinds, spline coefficients and lower bounds by place, and for each part where its solid is."""
    own = [part for part in parts if part.solid.kind in kind_numbers()]
    leaves = like.rows("known.solids.leaves", len(own))
    kinds = like.rows("known.solids.kinds", len(own))
    grids: dict[int, tuple[int, int]] = {}
    flat, first = [np.zeros(1)], 1
    bounds, first_bound = [np.zeros(1)], 1
    for row, kind, part in zip(leaves, kinds, own, strict=True):
        solid, thing = part.solid, part.thing
        row["factor"], row["sizes"], row["spacing"] = 1.0, solid.sizes, solid.spacing
        row["rotation"] = np.eye(3) if thing is None else thing.rotation
        row["position"] = 0.0 if thing is None else thing.origin
        kind["kind"] = kind_numbers()[solid.kind]
        if solid.coefficients is not None and thing is not None:
            # Bodies with the same object share its grid.
            if id(thing.obj) not in grids:
                grids[id(thing.obj)] = first, first_bound
                flat.append(solid.coefficients.ravel())
                first += solid.coefficients.size
                bounds.append(np.asarray(lower_bounds(solid.coefficients, solid.degree), float).ravel())
                first_bound += bounds[-1].size
            kind["first"], kind["first_bound"] = grids[id(thing.obj)]
            kind["nodes_x"], kind["nodes_y"], kind["nodes_z"] = solid.coefficients.shape
            kind["degree"] = solid.degree
    at, leaf, plane = [], 0, 0
    for part in parts:
        if part.solid.planes is not None:
            at.append(plane)
            plane += len(part.solid.planes)
        elif part.solid.kind == "HEIGHTS":
            at.append(part.solid.field)
        else:
            at.append(leaf)
            leaf += part.solid.kind in kind_numbers()
    real = like.layout.arrays["known.solids.bounds"].dtype
    found = {"leaves": leaves, "kinds": kinds, "coefficients": np.concatenate(flat).astype(real)}
    found["bounds"] = np.concatenate(bounds).astype(real)
    return {f"known.solids.{name}": values for name, values in found.items()}, at


def _parts(like: Parameters, parts: Sequence[Part], at: Sequence[int]):
    numbers, index = like.rows("known.parts", len(parts)), like.rows("known.index", len(parts))
    block, run, face = 0, 0, 0
    for row, whole, part, place in zip(numbers, index, parts, at, strict=True):
        thing = part.thing
        row["scale"], row["thickness"], row["half"] = part.scale, part.solid.thickness, part.solid.half
        whole["first_face"], whole["faces"], row["grain"] = face, 0, _grain(part)
        whole["body"], whole["geom"], whole["is_object"] = part.body, part.geom, thing is not None
        whole["solid"], whole["at"] = _number(part.solid.kind), place
        whole["count"] = 0 if part.solid.planes is None else len(part.solid.planes)
        if thing is not None:
            row["middle"], row["radius"], row["thickness"] = thing.middle, thing.radius, thing.thickness
            row["half"] = thing.half
            if thing.corners is not None:
                corners = np.count_nonzero(thing.corners.vectors.any(axis=1))
                row["corner_share"] = len(thing.obj.surface.points) / corners
            whole["contype"], whole["conaffinity"] = thing.bits
            row["band"], row["slack"] = thing.faces.band(thing.thickness), thing.faces.slack
            whole["faces"] = len(thing.faces.faces)
            face += len(thing.faces.faces)
        whole["turning"] = 0 if part.surface is None else part.surface.turning
        for surface, kind in zip(_surfaces(part), ("", "corner_"), strict=False):
            whole[f"first_{kind}block"], whole[f"{kind}blocks"] = block, len(surface.balls)
            whole[f"first_{kind}run"] = run
            block += len(surface.balls)
            run += len(surface.runs)
    return numbers, index


class NearSearch:
    """The search in some data of a model: a launch with its arrays, and what it found."""

    def __init__(self, mujoco: Any, model: Any, data: Any, known: BridgeModel, most: int):
        """`most`: contacts of a pair."""
        n = len(known.pairs)
        self.rows, self.wholes = np.zeros((most * n, REALS)), np.zeros((most * n, WHOLES), np.int32)
        self.options, self.settings = np.zeros(_TOLD), np.zeros((n, 15))
        self.options[1], self.options[4] = most, is_gap_beyond(mujoco)
        self.found = np.zeros(1, np.int32)
        parameters = Parameters(known.kernel.layout)
        self.touches = parameters.rows("work.touches", max(known.room, 1))
        work = {
            "options": self.options[None],
            "settings": self.settings,
            "touches": self.touches,
            "scores": np.zeros(most + 1),
            "heads": np.zeros(most, np.int32),
            "groups": parameters.rows("work.groups", -(-most // 8)),
            "rows": self.rows,
            "index": self.wholes,
            "found": self.found,
        }
        arrays = {**known.arrays, **{f"work.{name}": values for name, values in work.items()}}
        for place, values in {**arrays, **views_of(parameters, model=model, data=data)}.items():
            parameters.show(place, values)
        self.launch = KernelLaunch(known.kernel, parameters, 1)
        self.lines = list(zip(self.rows, self.wholes, strict=True))

    def give(self, pair: int, settings: ContactSettings | None) -> None:
        """Say what the parameters of a pair are."""
        self.settings[pair] = 0.0 if settings is None else settings.numbers()


def views_of(parameters: Parameters, **owners: Any) -> dict[str, np.ndarray]:
    """Arrays of `mjModel` and `mjData` by place, under their names."""
    places = (place.split(".") for place in parameters.layout.arrays)
    return {
        f"{owner}.{name}": getattr(owners[owner], name)
        for owner, name, *_ in (place for place in places if place[0] in owners)
    }
