"""The search for contacts as a launch of a kernel: tables of a model, and MuJoCo's arrays where they are."""

import ctypes
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dano.mujoco._settings import is_gap_beyond, Settings
from dano.mujoco._solids import Geom, object_solid, Solid
from dano.mujoco._surfaces import Surface
from dano.mujoco._things import Thing
from dano.mujoco.kernels.words import REALS, WHOLES
from dano.native import compiled_kernel, Features, instance, kind_numbers, lower_bounds

_TABLES, _FINDING = "dano.mujoco.kernels.tables", "dano.mujoco.kernels.finding"
_WORLDS = "dano.mujoco.kernels.worlds"
_SOLIDS, _LEAVES = "dano.mujoco.kernels.solids", "dano.physics.solids.leaves"
_BLOCK = 16
"""Samples of a block, as kernels have it."""
_TOLD = 6
"""Numbers of `dano.mujoco.kernels.tables.Options`."""
_LANES = 64
"""Threads of a block on a GPU: each needs many registers."""
_FLAT = 10.0
"""A shape with this radius of curvature, in distances between samples, is as a plane to an object's: they
miss no more than 1/80 of that distance of its depth. Its own samples, which are few, are not asked then.
Those of a ball turn to what is nearest; with several feet on it, that is one after the other."""


class Part(NamedTuple):
    """A geom or an object.

    Attributes:
        body: Body that it moves with.
        geom: Geom that it is, or that stands for the object.
        solid: Its solid.
        surface: Samples that press on others; None for none.
        scale: Factors of samples on the unit ball [m].
        thing: The object, None for a geom.
    """

    body: int
    geom: int
    solid: Solid
    surface: Surface | None
    scale: Float[np.ndarray, "3"]
    thing: Thing | None


def part_of_geom(body: int, geom: int, found: Geom) -> Part:
    """A geom of a model."""
    return Part(body, geom, found.solid, found.surface, found.scale, None)


def part_of_thing(body: int, geom: int, thing: Thing) -> Part:
    """An object."""
    return Part(body, geom, object_solid(thing.obj), thing.surface, np.ones(3), thing)


class Known:
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
        self.features = Features(
            KINDS=frozenset(range(7)),
            DEGREES=frozenset({2}) if degrees <= {2} else frozenset({1, 2, 3}),
            UNIONS=False,
            **({} if device is None else {"WIDE": False}),
        )
        self.device = device or "cpu"
        self.lanes = 1 if self.device == "cpu" else _LANES
        _array = functools.partial(_placed, device=self.device)
        self.parts, self.pairs = parts, pairs
        self.kernel: Any = compiled_kernel(lambda: self._kernel(device is not None), self.device, self.lanes)
        self.tables = tables = instance(self.features, _TABLES)
        structs = instance(self.features, _LEAVES)
        sampled = [part.surface for part in parts if part.surface is not None]
        planes = [part.solid.planes for part in parts if part.solid.planes is not None]
        leaves, kinds, coefficients, bounds, at = _solids(structs, parts)
        numbers, index = _parts(self.features, parts, at)
        samples = _rows(tables.Sample, sum(len(each.points) for each in sampled))
        if sampled:
            samples["point"] = np.concatenate([each.points for each in sampled])
            samples["area"] = np.concatenate([each.vectors for each in sampled])
        precedence = np.concatenate([np.zeros(0), *(each.precedence for each in sampled)])
        balls = np.concatenate([np.zeros((0, 4)), *(each.balls for each in sampled)])
        solids = structs.Solids()
        solids.leaves = _array(leaves[None], structs.Leaf)
        solids.kinds = _array(kinds, structs.LeafKind)
        solids.coefficients = _array(coefficients[None], structs.real)
        solids.bounds = _array(bounds[None], structs.real)
        self.known = known = tables.Known()
        known.parts, known.index = _array(numbers, tables.Part), _array(index, tables.PartIndex)
        touching = _rows(tables.TouchPair, len(pairs))
        touching["first"], touching["second"] = pairs.T
        touching["both"] = [not _is_flat(parts[a], parts[b]) for a, b in pairs]
        known.pairs = _array(touching, tables.TouchPair)
        known.samples, known.precedence = _array(samples, tables.Sample), _array(precedence, tables.real)
        known.balls = _array(balls, tables.vec4)
        runs = np.concatenate([np.zeros((0, 4)), *(each.runs for each in sampled)])
        known.runs = _array(runs, tables.vec4)
        known.solids = solids
        known.planes = _array(np.concatenate([np.zeros((0, 4)), *planes]), tables.vec4)
        known.sizes = _array(np.array(sizes, np.float64), tables.vec3)
        most = [sum(_count(parts[i]) for i in pair) for pair in pairs]
        self.room = max(most, default=0)

    def _kernel(self, in_worlds: bool) -> Any:
        return (
            instance(self.features, _WORLDS).find_in_worlds
            if in_worlds
            else instance(self.features, _FINDING).find
        )


def _count(part: Part) -> int:
    return 0 if part.surface is None else len(part.surface.points)


def _is_flat(part: Part, object_part: Part) -> bool:
    """Whether a part is as a plane to the samples of an object."""
    if object_part.surface is None:
        return False
    areas = np.linalg.norm(object_part.surface.vectors, axis=1)
    return part.solid.bend >= _FLAT * float(np.sqrt(areas.max()))


def _number(features: Features, kind: str) -> int:
    """Of a kind of solid by its name."""
    return getattr(instance(features, _SOLIDS), kind) if kind not in kind_numbers() else kind_numbers()[kind]


def _rows(struct: Any, n: int) -> np.ndarray:
    """Rows of a structure, by the names of its fields."""
    return np.zeros(n, dtype=struct.numpy_dtype())


def _placed(values: np.ndarray, dtype: Any, device: str) -> Any:
    import warp as wp

    return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)


def _solids(structs: Any, parts: Sequence[Part]):
    """Leaves, their kinds, spline coefficients and lower bounds, and for each part where its solid stands."""
    own = [part for part in parts if part.solid.kind in kind_numbers()]
    leaves, kinds = _rows(structs.Leaf, len(own)), _rows(structs.LeafKind, len(own))
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
    return leaves, kinds, np.concatenate(flat), np.concatenate(bounds), at


def _parts(features: Features, parts: Sequence[Part], at: Sequence[int]):
    tables = instance(features, _TABLES)
    numbers, index = _rows(tables.Part, len(parts)), _rows(tables.PartIndex, len(parts))
    block, run = 0, 0
    for row, whole, part, place in zip(numbers, index, parts, at, strict=True):
        thing = part.thing
        row["scale"], row["thickness"] = part.scale, part.solid.thickness
        whole["body"], whole["geom"], whole["is_object"] = part.body, part.geom, thing is not None
        whole["solid"], whole["at"] = _number(features, part.solid.kind), place
        whole["count"] = 0 if part.solid.planes is None else len(part.solid.planes)
        if thing is not None:
            row["middle"], row["radius"], row["thickness"] = thing.middle, thing.radius, thing.thickness
            whole["contype"], whole["conaffinity"] = thing.bits
        whole["first_block"], whole["blocks"] = block, _count(part) // _BLOCK
        whole["turning"] = 0 if part.surface is None else part.surface.turning
        whole["first_run"] = run
        block += _count(part) // _BLOCK
        run += 0 if part.surface is None else len(part.surface.runs)
    return numbers, index


class Search:
    """The search in some data of a model: a launch with its arrays, and what it found."""

    def __init__(self, mujoco: Any, model: Any, data: Any, known: Known, most: int):
        """`most`: contacts of a pair."""
        import warp as wp

        tables, n = known.tables, len(known.pairs)
        self.rows, self.wholes = np.zeros((most * n, REALS)), np.zeros((most * n, WHOLES), np.int32)
        self.options, self.settings = np.zeros(_TOLD), np.zeros((n, 15))
        self.options[1], self.options[4] = most, is_gap_beyond(mujoco)
        self.found = np.zeros(1, np.int32)
        work = tables.Work()
        work.options = _seen(self.options, tables.Options, 1)
        work.settings = _seen(self.settings, tables.Settings, n)
        work.touches = wp.zeros(max(known.room, 1), dtype=tables.Touch, device="cpu")
        work.scores = wp.zeros(most + 1, dtype=tables.real, device="cpu")
        work.heads = wp.zeros(most, dtype=wp.int32, device="cpu")
        work.rows = _seen(self.rows, tables.ContactRow, most * n)
        work.index = _seen(self.wholes, tables.ContactIndex, most * n)
        work.found = _seen(self.found, wp.int32, 1)
        self.arguments = [known.known, _views(tables.Model, model), _views(tables.Data, data), work]
        self._command: Any = wp.launch(known.kernel, 1, self.arguments, device="cpu", record_cmd=True)
        self.launch: Callable[[], None] = self._command.launch
        self.lines = list(zip(self.rows, self.wholes, strict=True))

    def call(self) -> tuple[int, Any, Any]:
        """Address of the kernel, and the two structures that it is called with; calls do not keep them."""
        bounds, *given = self._command.params
        arguments = _arguments(*map(type, given))(*given)
        return ctypes.cast(self._command.hooks.forward, ctypes.c_void_p).value or 0, bounds, arguments

    def give(self, pair: int, settings: Settings | None) -> None:
        """Say what the parameters of a pair are."""
        self.settings[pair] = 0.0 if settings is None else settings.numbers()


@functools.cache
def _arguments(*types: type) -> type:
    """The structure in which a kernel of Warp takes its arguments on a CPU."""
    fields = [(f"argument_{i}", each) for i, each in enumerate(types)]
    return type("Arguments", (ctypes.Structure,), {"_fields_": fields})


def _seen(array: np.ndarray, dtype: Any, n: int) -> Any:
    """An array of NumPy's as kernels see it, in the same memory; it must outlive what is seen."""
    import warp as wp

    return wp.array(ptr=array.ctypes.data, dtype=dtype, shape=(n,), device="cpu", copy=False)


def _views(struct: Any, owner: Any) -> Any:
    """A structure of arrays of `mjModel` or `mjData` with their names, as of one world."""
    views = struct()
    for name, variable in struct.vars.items():
        array = getattr(owner, name)
        seen = _seen(array, variable.type.dtype, len(array))
        setattr(views, name, seen if variable.type.ndim == 1 else seen.reshape((1, len(array))))
    return views
