"""Neural objects: a density field with mass properties and contact samples, saved as one file."""

import dataclasses
import os
import warnings
from collections.abc import Mapping
from typing import get_args, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from dano.archive import LOOK, OBJECT, read_archive, write_archive
from dano.checks import checked_choice, checked_count, checked_progress
from dano.fields import AbstractField, AbstractShape, GridField, SignedDistanceGrid
from dano.keys import folded_key, split_key
from dano.maths import checked_array, checked_key, checked_points, floating, is_traced, Numbers
from dano.memory import check_nodes
from dano.notebook import card, cloud, numbers
from dano.objects._flats import flat_share, flattened
from dano.objects._interior import examine, Interior, is_distance, sealed
from dano.objects._mass import (
    check_scale,
    checked_density,
    Density,
    integrate,
    integrated,
    MassProperties,
)
from dano.objects._samples import (
    baked,
    contact_grid,
    contact_samples,
    ContactSamples,
    Lattice,
    Region,
    surface_level,
)
from dano.objects._solid import field_solid, level_set
from dano.objects._surface import draw_surface, equal_areas, SurfaceSamples
from dano.progress import Progress

MassModel = Literal["auto", "density", "solid"]
FORMAT, VERSION = OBJECT

_FLAT = 0.95
"""Share of the surface of a body of flat faces that is flat, at least."""

_MOST_SAMPLES = 200_000
"""As many contact samples take two minutes and 3 GB; a hundredth of them do for most purposes."""

_BYTES_PER_NODE = 150
"""Measured: what building an object takes at its peak, over the nodes of its lattice."""


_INTERIOR = tuple(field.name for field in dataclasses.fields(Interior))

# Of a field that grows evenly from its middle to the border of its grid.
_LIKE_A_DISTANCE = (
    "the density is smallest in the middle and grows evenly to the border of its grid, as a distance does:"
    " the object is what lies around; for signed distances there is dano.fields.SignedDistanceGrid"
)


class NeuralObject(eqx.Module):
    """A density field made ready for simulation."""

    samples: ContactSamples  # Samples of the density near its surface, for the centroid law
    surface: SurfaceSamples  # Samples on the surface of `solid`, with areas
    mass: MassProperties  # Mass properties in the field's frame
    # The field baked for other objects' samples to query, without its floaters; None if there is no field.
    grid: GridField | None
    # Signed distance of the object: of {φ = `interior.level`}, without floaters, cavities filled; of a shape,
    # its own. None if there is no field.
    solid: SignedDistanceGrid | None
    density_range: Float[Array, "2"]  # Lower and upper density between which the samples lie, shape (2,)
    # Root mean square error of `grid` relative to the field's largest density (0 for a grid).
    bake_error: Float[Array, ""]
    # What the inside of the field looks like; None for objects made of samples, and in older files.
    interior: Interior | None
    # How density became mass: "density", "solid", or "given" (static).
    mass_model: str = eqx.field(static=True)
    mass_reason: str = eqx.field(static=True)  # Why this model, in words (static)

    def _repr_html_(self) -> str:
        """What notebooks show: mass properties beside a drawing of the surface samples."""
        principal = np.linalg.eigvalsh(np.asarray(self.mass.inertia, np.float64))
        rows = [
            ("mass [kg]", numbers([float(self.mass.mass)])),
            ("centre of mass [m]", numbers(np.asarray(self.mass.com))),
            ("principal inertias [kg m²]", numbers(principal)),
            ("longest extent [m]", numbers([self.size])),
            ("samples", f"{len(self.samples.points)}, on the surface {len(self.surface.points)}"),
            ("mass model", f"{self.mass_model}: {self.mass_reason}"),
        ]
        points, normals = (np.asarray(x, np.float64) for x in (self.surface.points, self.surface.normals))
        return card("NeuralObject", rows, cloud(points, normals))

    @classmethod
    def from_field(
        cls,
        field: AbstractField,
        *,
        n_samples: int = 5000,
        density_range: tuple[float, float] | None = None,
        mass_model: MassModel = "auto",
        mass_scale: float = 1.0,
        mass: float | None = None,
        resolution: int = 96,
        floaters: bool = False,
        key: PRNGKeyArray | None = None,
        progress: Progress | None = None,
    ) -> "NeuralObject":
        """Turn a density field into an object.

        Args:
            field: Density with finite bounds.
            n_samples: Number of contact samples, and of surface samples.
            density_range: Densities between which the samples are drawn; default: around the field's own
                surface (`surface_range`).
            mass_model: "density": mass density is α φ, as in the paper. "solid": the same mean density
                everywhere inside the largest connected part of {φ ≥ `interior.level`}, its pores closed, its
                cavities filled, floaters dropped. "auto": "density" for shapes, and for probabilities of
                occupancy of a solid inside; "solid" for everything else, that is for most fields learned from
                images. `mass_reason` says what was chosen and why.
            mass_scale: α [kg per unit of density and m³].
            mass: If given, the total mass [kg]; replaces `mass_scale`.
            resolution: Cells along the longest axis for mass integrals, sampling and baking.
            floaters: Whether parts that are not connected to the largest one feel contact.
            key: Random key; default `jax.random.key(0)`.
            progress: Called with a description and the share done.

        Returns:
            The object; its frame is the field's.

        Raises:
            ValueError: If an argument is out of range, the field is empty, unbounded, or has negative or
                non-finite densities, or no point lies in `density_range`. At most 200,000 samples, and a
                resolution that fits into half of the memory, are allowed.
        """
        checked_choice("mass_model", mass_model, get_args(MassModel))
        check_scale(mass_scale, mass)
        density_range = None if density_range is None else _checked_range(density_range)
        say = checked_progress(progress)
        n_samples, key = _checked_samples(n_samples), checked_key(key)
        sampling_key, mass_key = split_key(key)
        original = field
        if isinstance(field, GridField) and is_distance(field):
            warnings.warn(_LIKE_A_DISTANCE, stacklevel=2)
        field, density, lattice, interior = _closed(original, resolution)
        level = float(interior.level)
        model, reason = _weighed(original, interior, mass_model)
        low, high = (level, 1.8 * level) if density_range is None else density_range
        body = Region.create(lattice, low, floaters=floaters)
        say("samples", 0.0)
        samples = contact_samples(field, density, lattice, body, low, high, n_samples, sampling_key)
        say("surface", 0.0)
        grid, error = baked(field, resolution)
        filled = field_solid(field, grid, level, floaters=floaters)
        drawn = draw_surface(filled, n_samples, key=folded_key(key, 2))
        surface = flattened(drawn, filled.spacing)
        solid = Region.create(lattice, level, floaters=False).solid(density)
        how = (mass_scale, mass, resolution, mass_key, progress)
        properties = (
            integrated(original, *how) if model == "density" else integrate(solid, field.bounds, *how)
        )
        say("done", 1.0)
        return cls(
            samples=samples,
            surface=surface,
            mass=properties,
            grid=contact_grid(grid, body),
            solid=filled,
            density_range=floating((float(low), float(high))),
            bake_error=floating(error),
            interior=interior,
            mass_model=model,
            mass_reason=reason,
        )

    @classmethod
    def from_samples(
        cls,
        *,
        points: Numbers,
        density: Numbers,
        mass: Numbers,
        com: Numbers,
        inertia: Numbers,
        normals: Numbers | None = None,
        areas: Numbers | None = None,
        field: GridField | None = None,
    ) -> "NeuralObject":
        """Build an object from explicit samples in the field frame.

        Args:
            points: Sample positions [m, F].
            density: Density of each, ≥ 0, not all zero.
            mass: Mass [kg].
            com: Centre of mass [m, F].
            inertia: Inertia tensor about the centre of mass [kg m²].
            normals: Unit outward normals [F]; default: away from the centre of mass.
            areas: Area of the surface that each point stands for [m²]; default: equal shares of the area of
                the points' convex hull. Points in a plane share the area of their bounding box, points on a
                line or at one place that of the ball with this mass and inertia.
            field: Grid for other objects' samples to query; without it the object meets shapes only.

        Raises:
            ValueError: If a shape or value is out of range, or the centre of mass lies farther beside the
                points than these are apart.
        """
        points = checked_points("points", points)
        density = checked_array("density", density, (points.shape[0],))
        if not is_traced(density) and (float(density.min()) < 0 or float(density.max()) <= 0):
            raise ValueError(
                "density must be ≥ 0 and not all zero, got values in "
                f"[{float(density.min())}, {float(density.max())}]"
            )
        properties = MassProperties(mass, com, inertia)
        _check_com(points, properties.com)
        if normals is None:
            outward = np.asarray(points) - np.asarray(properties.com)
            normals = floating(outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-12))
        samples = ContactSamples(points, density, checked_array("normals", normals, points.shape))
        areas = equal_areas(points, properties) if areas is None else areas
        areas = checked_array("areas", areas, (points.shape[0],))
        if not is_traced(areas) and not (float(areas.min()) >= 0 and float(areas.max()) > 0):
            raise ValueError(
                f"areas must be ≥ 0 m² and not all zero, got values in [{float(areas.min())}, "
                f"{float(areas.max())}]"
            )
        return cls(
            samples=samples,
            surface=SurfaceSamples(points, samples.normals, areas),
            mass=properties,
            grid=field,
            solid=None if field is None else _grid_solid(field),
            density_range=floating((float(density.min()), float(density.max()))),
            bake_error=floating(0.0),
            interior=None,
            mass_model="given",
            mass_reason="mass, centre of mass and inertia were given",
        )

    @property
    def size(self) -> float:
        """Largest extent of the samples [m]."""
        return float(np.ptp(np.asarray(self.samples.points), axis=0).max())

    @property
    def is_flat(self) -> bool:
        """Whether nearly all of the surface are flat faces, whose samples lie on their planes."""
        solid, surface = self.solid, self.surface
        if not isinstance(solid, SignedDistanceGrid) or is_traced(surface.points, solid.spacing):
            return False
        return flat_share(surface, solid.spacing) > _FLAT

    def save(self, path: str | os.PathLike[str], *, look: Mapping[str, np.ndarray] | None = None) -> None:
        """Write the object to one file (a zip of arrays, no pickle), replacing another only when complete.

        Args:
            path: The file.
            look: Arrays that say what the object looks like, kept beside its physics for those who draw it:
                `dano.vision.LearnedField.arrays`.

        Raises:
            ValueError: If `path` is a directory or its parent does not exist.
        """
        members = {
            "format": np.array(FORMAT),
            "version": np.array(VERSION),
            "mass_model": np.array(self.mass_model),
            "mass_reason": np.array(self.mass_reason),
            "points": self.samples.points,
            "density": self.samples.density,
            "normals": self.samples.normals,
            "surface_points": self.surface.points,
            "surface_normals": self.surface.normals,
            "surface_areas": self.surface.areas,
            "surface_vectors": self.surface.vectors,
            "density_range": self.density_range,
            "bake_error": self.bake_error,
            "mass": self.mass.mass,
            "com": self.mass.com,
            "inertia": self.mass.inertia,
            "mass_error": self.mass.mass_error,
            "com_error": self.mass.com_error,
            "inertia_error": self.mass.inertia_error,
        }
        if self.interior is not None:
            members |= {f"interior_{name}": getattr(self.interior, name) for name in _INTERIOR}
        if self.grid is not None:
            members |= {
                "grid_values": np.asarray(self.grid.values, dtype=np.float32),
                "grid_origin": self.grid.origin,
                "grid_spacing": self.grid.spacing,
                "grid_interpolation": np.array(self.grid.interpolation),
            }
        if self.solid is not None:
            members |= {
                "solid_distances": np.asarray(self.solid.distances, dtype=np.float32),
                "solid_origin": self.solid.origin,
                "solid_spacing": self.solid.spacing,
                "solid_interpolation": np.array(self.solid.interpolation),
            }
        if look is not None:
            members |= {f"{LOOK}{name}": value for name, value in look.items()}
        write_archive(path, {name: np.asarray(value) for name, value in members.items()})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "NeuralObject":
        """Read an object written by `save`.

        Files of version 1 hold no solid and no surface samples: these are computed from the grid, in some
        seconds, or from the contact samples as `from_samples` does where there is no grid.

        Raises:
            ValueError: If the file is missing, truncated, not a dano object, or of a newer version.
        """
        data = read_archive(path, FORMAT, VERSION)
        try:
            grid = None
            if "grid_values" in data:
                grid = GridField(
                    floating(data["grid_values"].astype(np.float64)),
                    floating(data["grid_origin"]),
                    floating(data["grid_spacing"]),
                    interpolation=str(data["grid_interpolation"]),
                )
            mass = MassProperties(
                *(floating(data[name]) for name in ("mass", "com", "inertia")),
                **{name: floating(data[name]) for name in ("mass_error", "com_error", "inertia_error")},
            )
            n = len(data["points"])
            samples = ContactSamples(
                checked_array("points", floating(data["points"]), (n, 3)),
                checked_array("density", floating(data["density"]), (n,)),
                checked_array("normals", floating(data["normals"]), (n, 3)),
            )
            solid = _stored_solid(data)
            if int(data["version"]) == 1 and grid is not None:
                solid = _grid_solid(grid)
            return cls(
                samples=samples,
                surface=_stored_surface(data, samples, mass, solid),
                mass=mass,
                grid=grid,
                solid=solid,
                density_range=floating(data["density_range"]),
                bake_error=floating(data["bake_error"]),
                interior=_stored_interior(data),
                mass_model=str(data["mass_model"]),
                mass_reason=str(data.get("mass_reason", "not recorded")),
            )
        except (KeyError, ValueError) as error:
            raise ValueError(f"{path} is not a valid dano object: {error}") from error


def field_size(
    field: AbstractField,
    *,
    density_range: tuple[float, float] | None = None,
    resolution: int = 64,
    floaters: bool = False,
) -> float:
    """Longest extent [m] of the object that `NeuralObject.from_field` makes of a field, without making it.

    Args:
        field: Density with finite bounds.
        density_range: See there; its lower end bounds the object.
        resolution: Cells along the longest axis. The ends of the object are found within them.
        floaters: See there.

    Raises:
        ValueError: If the field is empty, has a negative or non-finite density or unbounded support, or does
            not reach the density range.
    """
    density_range = None if density_range is None else _checked_range(density_range)
    _, density, lattice, interior = _closed(field, resolution)
    low = float(interior.level) if density_range is None else density_range[0]
    return float(Region.create(lattice, low, floaters=floaters).extents(density).max())


def _checked_samples(n: int) -> int:
    n = checked_count("n_samples", n)
    if n > _MOST_SAMPLES:
        raise ValueError(f"n_samples must be at most {_MOST_SAMPLES}, got {n}")
    return n


def _checked_range(density_range: tuple[float, float]) -> tuple[float, float]:
    low, high = np.asarray(checked_array("density_range", density_range, (2,)), np.float64).tolist()
    if not 0 <= low < high:
        raise ValueError(f"density_range must satisfy 0 ≤ low < high, got ({low}, {high})")
    return low, high


def _closed(field: AbstractField, resolution: int) -> tuple[AbstractField, Density, Lattice, Interior]:
    """A field whose surface has no pores, its density, the lattice it is sampled on, and its inside.

    Contact, too, is with the solid whose pores are closed.
    """
    resolution = checked_count("resolution", resolution, least=4)
    density = checked_density(field)
    check_nodes(np.ptp(np.asarray(field.bounds), axis=0), resolution, _BYTES_PER_NODE)
    lattice = Lattice.create(density, field.bounds, resolution)
    interior, inside = examine(lattice)
    if float(interior.gap) > 0:
        field = sealed(lattice, interior, inside)
        density = checked_density(field)
        lattice = Lattice.create(density, field.bounds, resolution)
    return field, density, lattice, interior


def _weighed(field: AbstractField, interior: Interior, wanted: MassModel) -> tuple[str, str]:
    """The mass model to be used, "density" or "solid", and why."""
    flaws = [] if isinstance(field, AbstractShape) else interior.flaws()
    best = "solid" if flaws else "density"
    if isinstance(field, AbstractShape):
        reason = "a shape's occupancy is exact"
    else:
        reason = "; ".join(flaws) or "densities are the occupancy of a solid inside"
    if wanted == "auto":
        return best, reason
    return wanted, "as asked" if wanted == best else f"as asked; auto would take {best}: {reason}"


def _stored_interior(data: dict[str, np.ndarray]) -> Interior | None:
    names = {name: f"interior_{name}" for name in _INTERIOR}
    if not all(member in data for member in names.values()):
        return None
    return Interior(**{name: floating(data[member]).reshape(()) for name, member in names.items()})


def _grid_solid(grid: GridField) -> SignedDistanceGrid | None:
    """The solid of a density grid at its own surface level, all of its parts; None while it is traced."""
    if is_traced(grid.coefficients, grid.origin, grid.spacing):
        return None
    return level_set(grid, surface_level(np.asarray(grid.values)), floaters=True)


def _stored_solid(data: dict[str, np.ndarray]) -> SignedDistanceGrid | None:
    if "solid_distances" not in data:
        return None
    return SignedDistanceGrid(
        floating(data["solid_distances"].astype(np.float64)),
        floating(data["solid_origin"]),
        floating(data["solid_spacing"]),
        str(data["solid_interpolation"]),
    )


def _stored_surface(
    data: dict[str, np.ndarray],
    samples: ContactSamples,
    mass: MassProperties,
    solid: SignedDistanceGrid | None,
) -> SurfaceSamples:
    if int(data["version"]) > 1:
        n = len(data["surface_points"])
        return SurfaceSamples(
            checked_array("surface_points", floating(data["surface_points"]), (n, 3)),
            checked_array("surface_normals", floating(data["surface_normals"]), (n, 3)),
            checked_array("surface_areas", floating(data["surface_areas"]), (n,)),
            checked_array("surface_vectors", floating(data["surface_vectors"]), (n, 3)),
        )
    if solid is not None:
        return draw_surface(solid, len(samples.points))
    return SurfaceSamples(samples.points, samples.normals, equal_areas(samples.points, mass))


def _check_com(points: Float[Array, "n 3"], com: Float[Array, "3"]) -> None:
    """Check that a centre of mass lies about where the points are; one point alone says nothing."""
    if is_traced(points, com):
        return
    low, high = (np.asarray(end(np.asarray(points), axis=0)) for end in (np.min, np.max))
    size = float((high - low).max())
    beside = float(np.linalg.norm(np.maximum(0, np.maximum(low - np.asarray(com), np.asarray(com) - high))))
    if size and beside > size:
        raise ValueError(
            f"com must lie within the body [m, F], got {np.asarray(com).tolist()}, {beside:.3g} m beside"
            f" points that span {size:.3g} m"
        )
