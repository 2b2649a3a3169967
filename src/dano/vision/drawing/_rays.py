"""Where rays meet solids and what light arrives there, by kernels; what a medium lets through, by JAX."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from dano.compiling import one_program
from dano.fields import AbstractShape, GridField
from dano.maths import product
from dano.native import (
    cpu_kernel,
    Features,
    Kernel,
    KernelLaunch,
    leaf_tables,
    Leaves,
    leaves_of,
    n_cores,
    Parameters,
    PlacedField,
    together,
)
from dano.vision.capture import box_interval

CHUNK = 2048
"""Rays per call of what JAX compiles: enough to make a call worth while."""

_MEDIUM_STEPS = 128
"""Steps along a ray through a medium: a cell of the shipped grids each, nearly."""

_TRACING, _PAINTING = "dano.vision.drawing.kernels.tracing", "dano.vision.drawing.kernels.painting"
# Kernels for all scenes: they are compiled once.
_FEATURES = Features(WIDE=False)
# Rays that a thread traces together: `tracing.BLOCK`, which is asked for only where kernels are compiled.
_BLOCK = 16
# So few rays are not worth a second core, else each has some shares of them.
_FEW, _SHARES = 512, 4


class TracedItem(NamedTuple):
    """A solid somewhere (host only)."""

    shape: AbstractShape  # Its signed distance, bounded
    rotation: Float[np.ndarray, "3 3"]  # F → W (3, 3)
    position: Float[np.ndarray, "3"]  # Of the field frame [m, W] (3,)
    centre: Float[np.ndarray, "3"]  # Of a ball around it [m, W] (3,)
    radius: float  # Of that ball [m]
    own_shadows: bool  # Whether it already shows the light that it takes from itself


class Met(NamedTuple):
    """What rays meet."""

    depth: Float[np.ndarray, " n"]  # Distance [m] (n,), infinite where nothing is met
    which: Int[np.ndarray, " n"]  # Number of the plane, or of the thing after all planes; −1 for none; (n,)
    normals: Float[np.ndarray, "3 n"]  # Unit normals [W] (3, n)
    lamp: Float[np.ndarray, " n"]  # Shares of the lamp's light that arrive (n,)
    ambient: Float[np.ndarray, " n"]  # Shares of the light from all around (n,)


class Tracer:
    """Finds what rays from one point meet."""

    def __init__(
        self, things: Sequence[TracedItem], planes: Sequence[np.ndarray], origin: np.ndarray, **numbers: Any
    ):
        """Make a view of things.

        Args:
            things: Solids.
            planes: Unit normal and offset [m] of half-spaces.
            origin: Of rays [m, W].
            numbers: Other fields of `tracing.View`.
        """
        self._kernel = _kernel(_TRACING, "trace")
        tables = _tables([thing.shape for thing in things])
        like = Parameters(self._kernel.layout)
        rows = like.rows("view.things", len(things))
        for row, thing, (first, count, bounds) in zip(rows, things, tables.parts, strict=True):
            row["first"], row["count"], row["own_shadows"] = first, count, thing.own_shadows
            row["rotation"], row["position"] = thing.rotation, thing.position
            row["centre"], row["radius"] = thing.centre, thing.radius
            row["low"], row["high"] = bounds
        self._arrays = {
            **{f"view.solids.{name}": values for name, values in tables.arrays.items()},
            "view.things": rows,
            "view.planes": np.array(planes, np.float32).reshape(-1, 4),
        }
        self._numbers = {f"view.{name}": value for name, value in {"origin": origin, **numbers}.items()}

    def __call__(self, directions: Float[np.ndarray, "3 n"], regular: int = 0, together: int = 1) -> Met:
        """What rays of some unit directions [W] meet.

        Args:
            directions: Of the rays; neighbours share much of the work if they stand together.
            regular: How many of them, from the first on, come in blocks of 4 × 4 pixels: see
                `dano.vision.radiance.pixel_order`.
            together: How many in a row go around one pixel; a divisor of a block's 16.
        """
        n = directions.shape[1]
        rays = np.ascontiguousarray(directions.T, np.float32)
        depth, which = np.empty(n, np.float32), np.empty(n, np.int32)
        normals, lamp, ambient = (
            np.empty((n, 3), np.float32),
            np.empty(n, np.float32),
            np.empty(n, np.float32),
        )
        written = (rays, depth, which, normals, lamp, ambient)
        names = ("directions", "depths", "which", "normals", "lamp", "ambient")
        of_rays = {f"rays.{name}": values for name, values in zip(names, written, strict=True)}
        numbers = {**self._numbers, "rays.together": together}
        _launch(self._kernel, self._arrays, numbers, of_rays, block=_BLOCK, regular=regular)
        return Met(depth, which, normals.T, lamp, ambient)


class Painter:
    """Gives colours to what rays meet."""

    def __init__(self, albedos: Sequence[np.ndarray], n_planes: int, **numbers: Any):
        """Make it.

        Args:
            albedos: Linear, of planes, of things, and of whatever else is painted.
            n_planes: Number of planes.
            numbers: Other fields of `painting.Scenery`.
        """
        self._kernel = _kernel(_PAINTING, "paint")
        self._arrays = {"scenery.albedos": np.array(albedos, np.float32).reshape(-1, 3)}
        named = {"n_planes": n_planes, **numbers}
        self._numbers = {f"scenery.{name}": value for name, value in named.items()}

    def __call__(
        self, directions: Float[np.ndarray, "3 n"], met: Met
    ) -> tuple[Float[np.ndarray, "3 n"], UInt8[np.ndarray, "n 3"]]:
        """Linear colours and values of a picture, of rays of some unit directions [W]."""
        n = directions.shape[1]
        colours, picture = np.empty((n, 3), np.float32), np.empty((n, 3), np.uint8)
        rays = np.ascontiguousarray(directions.T, np.float32)
        normals = np.ascontiguousarray(met.normals.T, np.float32)
        arrays = {
            "directions": rays,
            "depths": met.depth,
            "which": met.which,
            "normals": normals,
            "lamp": met.lamp,
            "ambient": met.ambient,
            "colours": colours,
            "picture": picture,
        }
        _launch(self._kernel, self._arrays, self._numbers, arrays)
        return colours.T, picture


def compile_kernels() -> None:
    """Compile what draws, or load it; so that others may compile something else meanwhile."""
    _kernel(_PAINTING, "paint")
    _kernel(_TRACING, "trace")


def kernel_builds() -> list[tuple[Features, str]]:
    """Features and modules of the kernels that draw."""
    return [(_FEATURES, _TRACING), (_FEATURES, _PAINTING)]


def _kernel(module: str, name: str) -> Kernel:
    return cpu_kernel(_FEATURES, module, name, what="what draws")


def _launch(
    kernel: Kernel,
    shared: Mapping[str, np.ndarray],
    numbers: Mapping[str, Any],
    of_rays: Mapping[str, np.ndarray],
    *,
    block: int = 1,
    regular: int | None = None,
) -> None:
    """Launch a kernel on all cores.

    Args:
        kernel: The kernel.
        shared: Arrays that all rays read, by place.
        numbers: Numbers and vectors by place.
        of_rays: Arrays with a row for each ray.
        block: How many rays a thread has.
        regular: `rays.regular`, if the kernel asks for it.
    """
    n = len(next(iter(of_rays.values())))
    # Neighbouring shares cost different times: several for each core make all end together.
    count = min(max(n // _FEW, 1), 1 if n_cores() == 1 else _SHARES * n_cores())
    ends = [n * (k + 1) // count // block * block for k in range(count - 1)] + [n]
    works = []
    for begin, end in zip([0, *ends[:-1]], ends, strict=True):
        if end == begin:
            continue
        parameters = Parameters(kernel.layout)
        for place, values in {**shared, **{name: x[begin:end] for name, x in of_rays.items()}}.items():
            parameters.show(place, values)
        for place, value in numbers.items():
            parameters.put(place, value)
        if regular is not None:
            parameters.put("rays.regular", max(min(regular, end) - begin, 0))
        works.append(KernelLaunch(kernel, parameters, -(-(end - begin) // block)))
    if works:
        together([functools.partial(_each, works[k :: n_cores()]) for k in range(min(n_cores(), len(works)))])


def _each(works: Sequence[KernelLaunch]) -> None:
    for work in works:
        work()


class _Tables(NamedTuple):
    """Leaves of some shapes."""

    parts: list[tuple[int, int, np.ndarray]]  # First leaf, number of leaves and bounds [m, F] of each shape
    arrays: dict[str, np.ndarray]  # Of `dano.physics.solids.leaves.Solids`, by name


_known: dict[tuple[int, ...], tuple[list[Any], _Tables]] = {}


def _tables(shapes: Sequence[AbstractShape]) -> _Tables:
    """Leaves of shapes, kept from the last call if these are the same: pictures come in series."""
    numbers = jax.tree.leaves(list(shapes))
    key = tuple(map(id, numbers))
    if key not in _known:
        made = _made(shapes)
        _known.clear()
        # With the arrays themselves, so that no other can have their place in memory.
        _known[key] = numbers, made
    return _known[key][1]


def _made(shapes: Sequence[AbstractShape]) -> _Tables:
    leaves = [leaves_of(PlacedField.still(shape, np.float32)) for shape in shapes]
    counts = [len(each) for each in leaves]
    bounds = [np.asarray(shape.bounds, float) for shape in shapes]
    parts = list(zip(np.cumsum([0, *counts])[:-1].tolist(), counts, bounds, strict=True))
    found = _leaf_tables([leaf for each in leaves for leaf in each])
    named = {"leaves": found.rows, "kinds": found.kinds, "coefficients": found.coefficients}
    named["bounds"] = found.bounds
    return _Tables(parts, {name: np.ascontiguousarray(x) for name, x in named.items()})


@one_program
def _leaf_tables(leaves: list[PlacedField]) -> Leaves:
    return leaf_tables(leaves, jnp.float32)


@functools.partial(jax.jit, static_argnames="n_steps")
def transmitted(
    medium: GridField,
    density_scale: Float[Array, ""],
    rotation: Float[Array, "3 3"],
    position: Float[Array, "3"],
    origins: Float[Array, "3 n"],
    directions: Float[Array, "3 n"],
    limit: Float[Array, " n"],
    n_steps: int = _MEDIUM_STEPS,
) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, "3 n"]]:
    """Emission–absorption rendering of a medium: T = exp(−∫ σ dt), σ = density_scale · φ.

    Returns:
        Opacity 1 − T, mean distance [m] of what is seen of the medium, and its mean unit normal [W].
    """
    o, d = _local(rotation, position, origins, directions)
    enter, leave = box_interval(medium.bounds[0][:, None], medium.bounds[1][:, None], o, d)
    leave = jnp.minimum(leave, limit)
    step = jnp.maximum(leave - enter, 0) / n_steps

    def advance(i: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        clear, depth, normal = carry
        t = enter + (i.astype(enter.dtype) + 0.5) * step
        density, gradient = medium.jet(o + t[None] * d, 1)
        weight = clear * (1 - jnp.exp(-density_scale * density * step))
        return clear - weight, depth + weight * t, normal - weight[None] * _unit(gradient)

    start = (jnp.ones_like(enter), jnp.zeros_like(enter), jnp.zeros_like(o))
    clear, depth, normal = jax.lax.fori_loop(jnp.int32(0), jnp.int32(n_steps), advance, start)
    opacity = 1 - clear
    return opacity, depth / jnp.maximum(opacity, 1e-6), product(rotation, _unit(normal))


def _local(rotation: Array, position: Array, origins: Array, directions: Array) -> tuple[Array, Array]:
    return product(rotation.T, origins - position[:, None]), product(rotation.T, directions)


def _unit(vectors: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
    return vectors * jax.lax.rsqrt(jnp.maximum(jnp.sum(vectors * vectors, axis=0), 1e-24))[None]
