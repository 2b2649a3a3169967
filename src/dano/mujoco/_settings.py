"""What MuJoCo's solver is told about a contact besides where it is."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

LEAST_FRICTION = 1e-5
"""MuJoCo's mjMINMU."""
_LEAST_WEIGHT = 1e-15
"""MuJoCo's mjMINVAL."""


class Settings(NamedTuple):
    """Parameters of the contacts of two geoms, as in `mjContact`.

    Attributes:
        dim: Directions of force: 1, 3, 4 or 6.
        friction: Two sliding [1], one torsional [m], two rolling coefficients [m], shape (5,).
        solref: Time constant [s] and damping ratio, or, negative, stiffness and damping.
        solimp: Impedance, shape (5,).
        margin: Distance from which contacts are listed [m].
        gap: By how much more than that at which they press [m].
    """

    dim: int
    friction: Float[np.ndarray, "5"]
    solref: Float[np.ndarray, "2"]
    solimp: Float[np.ndarray, "5"]
    margin: float = 0.0
    gap: float = 0.0


def mixed(model: Any, a: int, b: int, overridden: bool) -> Settings:
    """What MuJoCo would take for two of its geoms, by priority, solmix and size.

    Margins and gaps of the two add up.

    Args:
        model: The model.
        a: First geom.
        b: Second geom.
        overridden: Whether the model's global contact parameters (flag `override`) replace those of geoms.
    """
    margin = float(model.geom_margin[a] + model.geom_margin[b])
    gap = float(model.geom_gap[a] + model.geom_gap[b])
    dim = int(max(model.geom_condim[a], model.geom_condim[b]))
    first, second = model.geom_priority[a], model.geom_priority[b]
    if first != second:
        leader = a if first > second else b
        dim, share = int(model.geom_condim[leader]), float(leader == a)
        friction = model.geom_friction[leader]
    else:
        weights = model.geom_solmix[a], model.geom_solmix[b]
        total = weights[0] + weights[1]
        share = float(weights[0] / total) if total > _LEAST_WEIGHT else 0.5
        friction = np.maximum(model.geom_friction[a], model.geom_friction[b])
    references = model.geom_solref[a], model.geom_solref[b]
    if first == second and (references[0][0] <= 0 or references[1][0] <= 0):
        solref = np.minimum(*references)
    else:
        solref = share * references[0] + (1 - share) * references[1]
    solimp = share * model.geom_solimp[a] + (1 - share) * model.geom_solimp[b]
    five = np.maximum(friction[[0, 0, 1, 2, 2]], LEAST_FRICTION)
    if overridden:
        option = model.opt
        return Settings(dim, option.o_friction, option.o_solref, option.o_solimp, float(option.o_margin), gap)
    return Settings(dim, five, solref, solimp, margin, gap)


class Writer:
    """Adds contacts to an `mjData`, by one `mjContact` that is written over and over.

    Its arrays are views that are made once: making one takes longer than filling it.
    """

    def __init__(self, mujoco: Any):
        self._mujoco = mujoco
        self._contact = contact = mujoco.MjContact()
        contact.flex[:] = contact.elem[:] = contact.vert[:] = -1
        contact.efc_address = -1
        self._position, self._frame, self._geom = contact.pos, contact.frame, contact.geom
        self._friction, self._solref, self._solimp = contact.friction, contact.solref, contact.solimp

    def begin(self, settings: Settings, first: int, second: int) -> None:
        """Say between which geoms the next contacts are; normals point from the first to the second."""
        contact = self._contact
        contact.dim = settings.dim
        contact.geom1, contact.geom2 = first, second
        self._geom[:] = first, second
        self._friction[:] = settings.friction
        self._solref[:] = settings.solref
        self._solimp[:] = settings.solimp
        contact.includemargin = settings.margin - settings.gap

    def add(self, model: Any, data: Any, distance: float, position, frame) -> bool:
        """Add one: distance [m], place between the surfaces [m, W], normal and two tangents; False: full."""
        contact = self._contact
        contact.dist = distance
        contact.exclude = int(distance >= contact.includemargin)
        self._position[:] = position
        self._frame[:] = frame
        return self._mujoco.mj_addContact(model, data, contact) == 0


def frames(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 9"]:
    """Normals and two unit tangents each."""
    aside = np.where(np.abs(normals[:, 1:2]) < 0.5, [[0.0, 1.0, 0.0]], [[0.0, 0.0, 1.0]])
    first = aside - np.einsum("ij,ij->i", aside, normals)[:, None] * normals
    first /= np.sqrt(np.einsum("ij,ij->i", first, first))[:, None]
    x, y = normals.T, first.T
    second = np.stack([x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]])
    return np.concatenate([normals, first, second.T], axis=1)
