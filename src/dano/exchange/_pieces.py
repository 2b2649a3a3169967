"""Convex pieces that stand for an object in engines whose contacts know convex shapes only."""

from typing import Any, get_args, Literal

import numpy as np
from jaxtyping import Float

from dano.exchange._triangles import Triangles
from dano.extras import is_installed, optional

Collision = Literal["auto", "coacd", "hull"]


def chosen_collision(collision: str) -> Literal["coacd", "hull"]:
    """What is made for `collision`: "auto" is CoACD where it is installed.

    Raises:
        ValueError: If it is none of the three.
        ImportError: If CoACD is asked for and missing.
    """
    if collision not in get_args(Collision):
        raise ValueError(f"collision must be one of {list(get_args(Collision))}, got {collision!r}")
    installed = is_installed("coacd")
    if collision == "coacd" and not installed:
        _coacd()
    return "hull" if collision == "hull" or not installed else "coacd"


def convex_hull(points: Float[np.ndarray, "n 3"]) -> Triangles:
    """The convex hull of points [m, F].

    Raises:
        ValueError: If they lie in a plane.
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except QhullError as error:
        raise ValueError(
            f"points must span a volume, got {len(points)} in a plane or fewer than 4"
        ) from error
    used, faces = np.unique(hull.simplices, return_inverse=True)
    vertices, faces = np.asarray(points, np.float64)[used], faces.reshape(-1, 3)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return Triangles(vertices, faces)


def decomposition(mesh: Triangles, threshold: float, most: int | None) -> list[Triangles]:
    """Convex pieces by CoACD (Wei et al. 2022).

    Args:
        mesh: What to cut; need not be closed.
        threshold: Largest concavity of a piece, as a share of the size; in [0.01, 1].
        most: Most pieces; None: as many as it takes.

    Raises:
        ImportError: If coacd is missing.
    """
    coacd = _coacd()
    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(mesh.vertices, mesh.faces),
        threshold=threshold,
        max_convex_hull=-1 if most is None else most,
        seed=0,
    )
    # Its own triangles may be turned inside out.
    return [convex_hull(np.asarray(vertices, np.float64)) for vertices, _ in parts]


def _coacd() -> Any:
    return optional("coacd", "a convex decomposition needs coacd", "export")
