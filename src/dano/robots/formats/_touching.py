"""Which shapes of MuJoCo's files touch which, and with what friction: its own rules.

Two geoms touch where their masks say so, unless they are parts of one body or of neighbours, or their bodies
are excluded; or where a pair names them (MuJoCo's documentation, "Collision detection", "Selection").
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from dano.robots.formats._description import Meeting


def meets_of(
    model: Any, mujoco: Any, links: Sequence[str]
) -> tuple[dict[frozenset[str], Meeting], list[str]]:
    """Who touches whom, and what of that is read otherwise than MuJoCo does, one line each.

    Args:
        model: MuJoCo's model.
        mujoco: The library.
        links: The link of each geom.
    """
    disabled = int(model.opt.disableflags)
    bits = mujoco.mjtDisableBit
    if disabled & (int(bits.mjDSBL_CONTACT) | int(bits.mjDSBL_CONSTRAINT)):
        return {}, []
    may = _may_touch(model, filters_parents=not disabled & int(bits.mjDSBL_FILTERPARENT))
    friction = _mixed_friction(model)
    named = np.zeros_like(may)
    for k in range(model.npair):
        i, j = int(model.pair_geom1[k]), int(model.pair_geom2[k])
        slides = float(model.pair_friction[k][0]) if model.pair_dim[k] > 1 else 0.0
        for pair in ((i, j), (j, i)):
            may[pair] = named[pair] = True
            friction[pair] = slides
    if int(model.opt.enableflags) & int(mujoco.mjtEnableBit.mjENBL_OVERRIDE):
        friction = np.where(friction > 0, float(model.opt.o_friction[0]), 0.0)
    found: dict[frozenset[str], Meeting] = {}
    rows = {name: np.flatnonzero(np.array(links) == name) for name in dict.fromkeys(links)}
    touching = np.asarray(may.any(axis=1))
    parted = []
    names = [name for name, geoms in rows.items() if touching[geoms].any()]
    for k, first in enumerate(names):
        for second in names[k + 1 :]:
            block = np.ix_(rows[first], rows[second])
            if not may[block].any():
                continue
            slides = tuple(np.unique(friction[block][may[block]]).tolist())
            found[frozenset((first, second))] = Meeting(slides, bool(named[block].any()))
            both = np.ix_(rows[first][touching[rows[first]]], rows[second][touching[rows[second]]])
            if not may[both].all():
                parted.append(f"{first} and {second}")
    said = []
    if parted:
        shown = ", ".join(parted[:3]) + (f" and {len(parted) - 3} more" if len(parted) > 3 else "")
        said.append(f"that only some shapes of {shown} touch each other: in dano all of a link do")
    return found, said


def touching_geoms(model: Any) -> Bool[np.ndarray, " g"]:
    """Whether each geom can touch anything: by its masks, or because a pair names it."""
    touches = (np.asarray(model.geom_contype) != 0) | (np.asarray(model.geom_conaffinity) != 0)
    touches[np.asarray(model.pair_geom1, int)] = True
    touches[np.asarray(model.pair_geom2, int)] = True
    return touches


def _may_touch(model: Any, *, filters_parents: bool) -> Bool[np.ndarray, "g g"]:
    """By masks, bodies and exclusions."""
    kinds, others = np.asarray(model.geom_contype), np.asarray(model.geom_conaffinity)
    may = (kinds[:, None] & others[None, :]) | (kinds[None, :] & others[:, None])
    body = np.asarray(model.geom_bodyid)
    welded = np.asarray(model.body_weldid)
    own = welded[body]
    above = welded[np.asarray(model.body_parentid)[own]]
    may = (may != 0) & (own[:, None] != own[None, :])
    if filters_parents:
        moves = (own[:, None] != 0) & (own[None, :] != 0)
        near = (own[:, None] == above[None, :]) | (own[None, :] == above[:, None])
        may &= ~(moves & near)
    for signature in np.asarray(model.exclude_signature, int):
        first, second = signature >> 16, signature & 0xFFFF
        one, other = body == first, body == second
        may &= ~((one[:, None] & other[None, :]) | (other[:, None] & one[None, :]))
    return may


def _mixed_friction(model: Any) -> Float[np.ndarray, "g g"]:
    """Sliding friction of two geoms: that of the higher priority, of equal ones the larger."""
    sliding, priority = np.asarray(model.geom_friction, float)[:, 0], np.asarray(model.geom_priority)
    dims = np.asarray(model.geom_condim)
    above, below = priority[:, None] > priority[None, :], priority[:, None] < priority[None, :]

    def mixed(values: np.ndarray) -> np.ndarray:
        first, second = values[:, None] + 0 * values[None, :], values[None, :] + 0 * values[:, None]
        return np.where(above, first, np.where(below, second, np.maximum(first, second)))

    return np.where(mixed(dims) > 1, mixed(sliding), 0.0)
