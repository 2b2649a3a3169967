"""Neural objects: a density field with mass properties and contact samples, saved as one file."""

import os
from typing import get_args, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from dano.archive import read_archive, write_archive
from dano.fields import AbstractField, GridField
from dano.maths import checked_array, floating, is_traced, Numbers
from dano.objects._mass import checked_density, integrate, MassProperties, Progress
from dano.objects._samples import (
    contact_grid,
    ContactSamples,
    draw_samples,
    Lattice,
    outward_normals,
    Region,
    surface_level,
    surface_range,
)

MassModel = Literal["density", "solid"]
FORMAT, VERSION = "dano-object", 1


class NeuralObject(eqx.Module):
    """A density field made ready for simulation.

    Attributes:
        samples: Contact samples.
        mass: Mass properties in the field's frame.
        grid: The field baked for other objects' samples to query, without its floaters; None if there is no
            field.
        density_range: Lower and upper density between which the samples lie, shape (2,).
        bake_error: Root mean square error of `grid` relative to the field's largest density (0 for a grid).
        mass_model: How density became mass.
    """

    samples: ContactSamples
    mass: MassProperties
    grid: GridField | None
    density_range: Float[Array, "2"]
    bake_error: Float[Array, ""]
    mass_model: str = eqx.field(static=True)

    @classmethod
    def from_field(
        cls,
        field: AbstractField,
        *,
        n_samples: int = 5000,
        density_range: tuple[float, float] | None = None,
        mass_model: MassModel = "density",
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
            n_samples: Number of contact samples.
            density_range: Densities between which the samples are drawn; default: around the field's own
                surface (`surface_range`).
            mass_model: "density": mass density is α φ, as in the paper. "solid": the same mean density
                everywhere inside the largest connected part of {φ ≥ half the plateau density}, its cavities
                filled, floaters dropped.
            mass_scale: α [kg per unit of density and m³].
            mass: If given, the total mass [kg]; replaces `mass_scale`.
            resolution: Cells along the longest axis for mass integrals, sampling and baking.
            floaters: Whether parts that are not connected to the largest one feel contact.
            key: Random key; default `jax.random.key(0)`.
            progress: Called with a description and the share done.

        Returns:
            The object; its frame is the field's.

        Raises:
            ValueError: If an argument is out of range, the field is empty, has a negative or non-finite
                density or unbounded support, or no point lies in `density_range`.
        """
        if mass_model not in get_args(MassModel):
            raise ValueError(f"mass_model must be one of {get_args(MassModel)}, got {mass_model!r}")
        if n_samples < 1:
            raise ValueError(f"n_samples must be ≥ 1, got {n_samples}")
        key = jax.random.key(0) if key is None else key
        sampling_key, mass_key = jax.random.split(key)
        density = checked_density(field)
        lattice = Lattice.create(density, field.bounds, resolution)
        low, high = surface_range(lattice.values) if density_range is None else density_range
        if not 0 <= low < high:
            raise ValueError(f"density_range must satisfy 0 ≤ low < high, got ({low}, {high})")
        body = Region.create(lattice, low, floaters=floaters)
        if progress is not None:
            progress("samples", 0.0)
        points, values = draw_samples(density, lattice, body, low, high, n_samples, sampling_key)
        samples = ContactSamples(
            floating(points), floating(values), floating(outward_normals(field, points, body))
        )
        if mass_model == "density":
            properties = MassProperties.from_field(
                field,
                mass_scale=mass_scale,
                mass=mass,
                resolution=resolution,
                key=mass_key,
                progress=progress,
            )
        else:
            solid = Region.create(lattice, surface_level(lattice.values), floaters=False).solid(density)
            properties = integrate(solid, field.bounds, mass_scale, mass, resolution, mass_key, progress)
        grid, error = contact_grid(field, body, resolution)
        if progress is not None:
            progress("done", 1.0)
        return cls(
            samples, properties, grid, floating((float(low), float(high))), floating(error), mass_model
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
            field: Grid for other objects' samples to query; without it the object meets shapes only.

        Raises:
            ValueError: If a shape or value is out of range.
        """
        points, density = floating(points), floating(density)
        if points.ndim != 2 or points.shape[1] != 3 or points.shape[0] == 0:
            raise ValueError(f"points must have shape (n, 3) with n ≥ 1, got {points.shape}")
        points = checked_array("points", points, points.shape)
        density = checked_array("density", density, (points.shape[0],))
        if not is_traced(density) and (float(density.min()) < 0 or float(density.max()) <= 0):
            raise ValueError(
                "density must be ≥ 0 and not all zero, got values in "
                f"[{float(density.min())}, {float(density.max())}]"
            )
        properties = MassProperties(mass, com, inertia)
        if normals is None:
            outward = np.asarray(points) - np.asarray(properties.com)
            normals = floating(outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-12))
        samples = ContactSamples(points, density, checked_array("normals", normals, points.shape))
        bounds = floating((float(density.min()), float(density.max())))
        return cls(samples, properties, field, bounds, floating(0.0), "given")

    @property
    def size(self) -> float:
        """Largest extent of the samples [m]."""
        return float(jnp.max(jnp.ptp(self.samples.points, axis=0)))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the object to one file (a zip of arrays, no pickle), replacing another only when complete.

        Raises:
            ValueError: If `path` is a directory or its parent does not exist.
        """
        members = {
            "format": np.array(FORMAT),
            "version": np.array(VERSION),
            "mass_model": np.array(self.mass_model),
            "points": self.samples.points,
            "density": self.samples.density,
            "normals": self.samples.normals,
            "density_range": self.density_range,
            "bake_error": self.bake_error,
            "mass": self.mass.mass,
            "com": self.mass.com,
            "inertia": self.mass.inertia,
            "mass_error": self.mass.mass_error,
            "com_error": self.mass.com_error,
            "inertia_error": self.mass.inertia_error,
        }
        if self.grid is not None:
            members |= {
                "grid_values": np.asarray(self.grid.values, dtype=np.float32),
                "grid_origin": self.grid.origin,
                "grid_spacing": self.grid.spacing,
                "grid_interpolation": np.array(self.grid.interpolation),
            }
        write_archive(path, {name: np.asarray(value) for name, value in members.items()})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "NeuralObject":
        """Read an object written by `save`.

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
            limits, error = floating(data["density_range"]), floating(data["bake_error"])
            return cls(samples, mass, grid, limits, error, str(data["mass_model"]))
        except (KeyError, ValueError) as error:
            raise ValueError(f"{path} is not a valid dano object: {error}") from error
