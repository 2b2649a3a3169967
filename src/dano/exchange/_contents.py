"""What is written of an object, whatever the format."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dano.contact import ContactParams
from dano.exchange._look import Texture
from dano.exchange._triangles import Triangles
from dano.fields import Splats

MESHES = "meshes"
"""Folder of the meshes, in that of the object."""

SPLATS, SURROUNDINGS = "splats", "surroundings"
"""Names of the Gaussians of the object, and of what does not move with it."""

VISUAL = "visual"
"""Name of the visual mesh, its material and its picture."""


class Contents(NamedTuple):
    """An object as other programs take it; everything in its field frame F."""

    name: str  # A letter, then letters, digits and underscores
    mass: float  # [kg]
    com: Float[np.ndarray, "3"]  # Centre of mass [m, F], shape (3,)
    inertia: Float[np.ndarray, "3 3"]  # About the centre of mass, in the axes of F [kg m²], shape (3, 3)
    mesh: Triangles  # What is seen
    resolution: int  # Nodes along the longest axis that it was made with
    normals: Float[np.ndarray, "v 3"]  # At its vertices, shape (v, 3)
    texture: Texture | None  # Its colours, if they are known
    pieces: list[Triangles]  # Convex solids whose union stands for the object in contact
    contact: ContactParams  # Parameters of its contacts
    splats: Splats | None = None  # Gaussians that it is drawn with, if it was seen by them
    surroundings: Splats | None = None  # Those of what does not move with it

    @property
    def friction(self) -> float:
        """Sliding friction [1]."""
        return float(self.contact.sliding_friction)

    def parameter(self, name: str) -> float | None:
        """A parameter of the contact, None if it is not given."""
        value = getattr(self.contact, name)
        return None if value is None else float(value)

    @property
    def piece_names(self) -> list[str]:
        """A name for each piece."""
        return [f"collision_{i:03}" for i in range(len(self.pieces))]


def words(numbers: Float[np.ndarray, "..."]) -> str:
    """Numbers with all of their digits, separated by blanks."""
    return " ".join(repr(float(x)) for x in np.ravel(numbers))
