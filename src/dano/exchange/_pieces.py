"""Convex pieces that stand for an object in engines whose contacts know convex shapes only."""

from typing import get_args, Literal

import numpy as np
from jaxtyping import Float

from dano.exchange._triangles import Triangles
from dano.extras import is_installed
from dano.fields import convex_hull as hull_of, convex_pieces, load_coacd

Collision = Literal["auto", "coacd", "hull"]


def chosen_collision(collision: str) -> Literal["coacd", "hull"]:
    """What is made for `collision`: "auto" is CoACD where it is installed.

    Raises:
        ValueError: If it is not one of the three.
        ImportError: If CoACD is requested and missing.
    """
    if collision not in get_args(Collision):
        raise ValueError(f"collision must be one of {list(get_args(Collision))}, got {collision!r}")
    installed = is_installed("coacd")
    if collision == "coacd" and not installed:
        load_coacd()
    return "hull" if collision == "hull" or not installed else "coacd"


def convex_hull(points: Float[np.ndarray, "n 3"]) -> Triangles:
    """The convex hull of points [m, F].

    Raises:
        ValueError: If they lie in a plane.
    """
    return Triangles(*hull_of(points))


def decomposition(mesh: Triangles, threshold: float, most: int | None) -> list[Triangles]:
    """Convex pieces by CoACD (Wei et al. 2022), see `dano.fields.convex_pieces`.

    Raises:
        ImportError: If coacd is missing.
    """
    return [Triangles(*piece) for piece in convex_pieces((mesh.vertices, mesh.faces), threshold, most)]
