"""How to make a neural object of a field: what `dano build`, scene files and Python let one choose."""

import dataclasses
from typing import Any, Literal

from dano.objects import MassModel

Units = Literal["m", "cm", "mm", "in", "ft", "um"]

Up = Literal["y", "z"]


@dataclasses.dataclass(frozen=True)
class BuildOptions:
    """How to make a neural object of a density field."""

    samples: int = 5000  # Number of contact samples
    # Lower and upper density of the samples; default: around the field's own surface.
    density_range: tuple[float, float] | None = None
    # solid: uniform inside the surface, hollow cores filled. density: as dense as the field. auto: density
    # where it is the occupancy of a solid inside, else solid.
    mass_model: MassModel = "auto"
    mass_scale: float | None = None  # Mass per unit of density and cubic metre [kg]; default 1
    mass: float | None = None  # Total mass [kg], instead of the mass scale
    resolution: int = 96  # Cells along the longest axis for mass integrals and sampling
    # Unit of the lengths in the file; default: as meshes say or their size tells, else metres.
    units: Units | None = None
    # Axis of a mesh's file that points up: it is turned so that z does; default: y in glTF, else z.
    up: Up | None = None
    length: float | None = None  # Scale the field so that the object's longest extent is this [m]
    # Parts that are separate from the largest one feel contact, too; those of meshes always do.
    floaters: bool = False
    seed: int = 0  # Seed of the random samples

    @property
    def of_file(self) -> dict[str, Any]:
        """Those that count where the file is read, as options of `load_field`."""
        given = {"units": self.units, "up": self.up}
        return {name: value for name, value in given.items() if value is not None}
