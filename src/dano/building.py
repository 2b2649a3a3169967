"""How to make a neural object of a field: what `dano build`, scene files and Python let one choose."""

import dataclasses
from typing import Any, Literal

from dano.objects import MassModel

Units = Literal["m", "cm", "mm", "in", "ft", "um"]

Up = Literal["y", "z"]


@dataclasses.dataclass(frozen=True)
class BuildOptions:
    """How to make a neural object of a density field.

    Attributes:
        samples: Number of contact samples.
        density_range: Lower and upper density of the samples; default: around the field's own surface.
        mass_model: solid: uniform inside the surface, hollow cores filled. density: as dense as the field.
            auto: density where it is the occupancy of a solid inside, else solid.
        mass_scale: Mass per unit of density and cubic metre [kg]; default 1.
        mass: Total mass [kg], instead of the mass scale.
        resolution: Cells along the longest axis for mass integrals and sampling.
        units: Unit of the lengths in the file; default: as meshes say or their size tells, else metres.
        up: Axis of a mesh's file that points up: it is turned so that z does; default: y in glTF, else z.
        length: Scale the field so that the object's longest extent is this [m].
        floaters: Parts that are separate from the largest one feel contact, too; those of meshes always do.
        seed: Seed of the random samples.
    """

    samples: int = 5000
    density_range: tuple[float, float] | None = None
    mass_model: MassModel = "auto"
    mass_scale: float | None = None
    mass: float | None = None
    resolution: int = 96
    units: Units | None = None
    up: Up | None = None
    length: float | None = None
    floaters: bool = False
    seed: int = 0

    @property
    def of_file(self) -> dict[str, Any]:
        """Those that count where the file is read, as options of `load_field`."""
        given = {"units": self.units, "up": self.up}
        return {name: value for name, value in given.items() if value is not None}
