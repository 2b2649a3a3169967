"""Where neural objects touch geoms and each other: the search of a step."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from dano.mujoco._settings import frames, mixed, Settings
from dano.mujoco._solids import geom_solid, Solid
from dano.mujoco._things import samples_of, Thing

MOST = 48
"""Contacts of a pair. Of more samples that touch those are taken that are spread most evenly."""

Chooser = Callable[[Any, int, int], Settings | None]
"""From a model and two of its geoms to the parameters of their contacts; None if they do not touch."""


class Carrier(NamedTuple):
    """A body with an object.

    Attributes:
        body: Its index.
        geom: The geom that stands for the object in MuJoCo's list of contacts.
        thing: The object.
        others: Geoms that it may touch, by the tree of bodies.
    """

    body: int
    geom: int
    thing: Thing
    others: Int[np.ndarray, " k"]


class Batch(NamedTuple):
    """Contacts of one pair.

    Attributes:
        settings: Their parameters.
        first: Geom that the normals point away from.
        second: Geom that they point to.
        distances: Negative where bodies overlap [m].
        positions: In the middle of the overlap [m, W].
        frames: Normal and tangents [W].
    """

    settings: Settings
    first: int
    second: int
    distances: Float[np.ndarray, " n"]
    positions: Float[np.ndarray, "n 3"]
    frames: Float[np.ndarray, "n 9"]


class Table:
    """What the search needs of a model. Sizes, frictions and heights are read in every step."""

    def __init__(self, mujoco: Any, model: Any, things: Mapping[str, Thing], choose: Chooser | None = None):
        """Look the bodies up.

        Raises:
            ValueError: If a body is missing or has no geom.
        """
        self._mujoco = mujoco
        self._kinds = mujoco.mjtGeom
        self._choose = choose or self._mixed
        bodies = {name: body_index(model, name) for name in things}
        taken = np.isin(model.geom_bodyid, list(bodies.values()))
        self.carriers = [
            Carrier(body, _geom_of(model, body, name), things[name], self._others(model, body, taken))
            for name, body in bodies.items()
        ]
        self.pairs = [
            (a, b)
            for i, a in enumerate(self.carriers)
            for b in self.carriers[i + 1 :]
            if _may_meet(mujoco, model, a.body, b.body)
        ]
        self._own = {carrier.geom: carrier.thing.bits for carrier in self.carriers}
        self.geoms = frozenset(self._own)
        self._solids: dict[int, Solid] = {}

    def _others(self, model: Any, body: int, taken: Bool[np.ndarray, " g"]) -> Int[np.ndarray, " k"]:
        meets = np.array([_may_meet(self._mujoco, model, body, b) for b in range(model.nbody)])
        return np.flatnonzero(meets[model.geom_bodyid] & ~taken)

    def _mixed(self, model: Any, a: int, b: int) -> Settings | None:
        bits, other = self._bits(model, a), self._bits(model, b)
        if not (bits[0] & other[1]) and not (other[0] & bits[1]):
            return None
        overridden = bool(model.opt.enableflags & self._mujoco.mjtEnableBit.mjENBL_OVERRIDE)
        return mixed(model, a, b, overridden)

    def _bits(self, model: Any, geom: int) -> tuple[int, int]:
        if geom in self._own:
            return self._own[geom]
        return int(model.geom_contype[geom]), int(model.geom_conaffinity[geom])

    def find(self, model: Any, data: Any) -> list[Batch]:
        """All contacts of the objects at the present pose."""
        found = []
        for carrier in self.carriers:
            found += self._with_geoms(model, data, carrier)
        for a, b in self.pairs:
            found += self._with_each_other(model, data, a, b)
        return found

    def _with_geoms(self, model: Any, data: Any, carrier: Carrier) -> list[Batch]:
        rotation, origin = _pose(data, carrier.body)
        thing = carrier.thing
        away = data.geom_xpos[carrier.others] - (rotation @ thing.middle + origin)
        reach = thing.radius + model.geom_rbound[carrier.others] + model.geom_margin[carrier.others]
        reach = reach + model.geom_margin[carrier.geom]
        flat = model.geom_type[carrier.others] == self._kinds.mjGEOM_PLANE
        squares = np.einsum("ij,ij->i", away, away)
        near = flat | (squares <= reach * reach)
        found = []
        for geom in carrier.others[near]:
            settings = self._choose(model, int(geom), carrier.geom)
            if settings is None:
                continue
            axes, center = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
            place = axes.T @ rotation, (origin - center) @ axes
            hits = _search(thing, place, self._solid(model, int(geom)), settings.margin)
            if hits is not None:
                found.append(_batch(settings, int(geom), carrier.geom, hits, axes, center))
        return found

    def _with_each_other(self, model: Any, data: Any, a: Carrier, b: Carrier) -> list[Batch]:
        settings = self._choose(model, a.geom, b.geom)
        if settings is None:
            return []
        poses = [_pose(data, each.body) for each in (a, b)]
        middles = [poses[k][0] @ each.thing.middle + poses[k][1] for k, each in enumerate((a, b))]
        if np.linalg.norm(middles[0] - middles[1]) > a.thing.radius + b.thing.radius + settings.margin:
            return []
        found = []
        for sampled, queried, (turn, origin), (axes, center) in (
            (b, a, poses[1], poses[0]),
            (a, b, poses[0], poses[1]),
        ):
            thing = queried.thing
            if thing.solid is None:
                continue
            axes, center = axes @ thing.rotation, axes @ thing.origin + center
            place = axes.T @ turn, (origin - center) @ axes
            hits = _search(sampled.thing, place, thing.solid, settings.margin)
            if hits is not None:
                found.append(_batch(settings, queried.geom, sampled.geom, hits, axes, center))
        return found

    def _solid(self, model: Any, geom: int) -> Solid:
        kind = model.geom_type[geom]
        if kind != self._kinds.mjGEOM_MESH:
            return geom_solid(self._mujoco, model, geom)
        # The hull is the only one that takes time to make, and no size changes it.
        if geom not in self._solids:
            self._solids[geom] = geom_solid(self._mujoco, model, geom)
        return self._solids[geom]


def body_index(model: Any, name: str) -> int:
    """Index of a body of a compiled model.

    Raises:
        ValueError: If there is none.
    """
    # Not by MuJoCo's functions: before 4.0 an error in a callback that has called one ends the process.
    try:
        return model.body(name).id
    except KeyError:
        names = [model.body(i).name for i in range(model.nbody)]
        raise ValueError(f"body must be one of {names}, got {name!r}") from None


def _geom_of(model: Any, body: int, name: str) -> int:
    if model.body_geomnum[body] < 1:
        raise ValueError(
            f"body {name!r} must have a geom, which stands for the object in contacts; it has none"
        )
    return int(model.body_geomadr[body])


def _may_meet(mujoco: Any, model: Any, a: int, b: int) -> bool:
    """Whether MuJoCo lets two bodies touch: not if welded, nor as parent and child, nor if excluded."""
    weld, parent = model.body_weldid, model.body_parentid
    first, second = weld[a], weld[b]
    if first == second:
        return False
    parents = weld[parent[first]], weld[parent[second]]
    filtered = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    if filtered and first != 0 and second != 0 and (first == parents[1] or second == parents[0]):
        return False
    low, high = sorted((a, b))
    return (low << 16) + high not in model.exclude_signature


def _pose(data: Any, body: int) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    return data.xmat[body].reshape(3, 3), data.xpos[body]


def _search(thing: Thing, place, solid: Solid, margin: float):
    """Points, distances and normals in the solid's frame of samples nearer than the margin; None without any.

    Args:
        thing: Whose samples.
        place: Rotation and translation from its body frame into the solid's.
        solid: What they may touch.
        margin: [m].
    """
    turn, shift = place
    blocks = np.flatnonzero(solid.bound(thing.centers @ turn.T + shift) < margin + thing.radii)
    if not len(blocks):
        return None
    rows = samples_of(blocks)
    points = thing.points[rows] @ turn.T + shift
    distances, normals = solid.jet(points)
    outward = thing.normals[rows] @ turn.T
    # Samples on the far side of a thin body do not press.
    near = np.flatnonzero((distances < margin) & (np.einsum("ij,ij->i", outward, normals) < 0))
    if not len(near):
        return None
    if len(near) > MOST:
        near = near[np.argpartition(thing.rank[rows[near]], MOST - 1)[:MOST]]
    return points[near], distances[near], normals[near]


def _batch(settings: Settings, first: int, second: int, hits, axes, center) -> Batch:
    points, distances, normals = hits
    # MuJoCo wants the middle between the two surfaces.
    middle = points - 0.5 * distances[:, None] * normals
    return Batch(settings, first, second, distances, middle @ axes.T + center, frames(normals @ axes.T))
