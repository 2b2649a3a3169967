"""Where neural objects touch geoms and each other: what is known of a model, and the search of a step."""

import weakref
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from dano.mujoco._search import BridgeModel, NearSearch, Part, part_of_geom, part_of_thing
from dano.mujoco._settings import ContactSettings, overriding
from dano.mujoco._things import AttachedObject, geom_of, standin_name
from dano.mujoco._worlds import Worlds

MOST = 8
"""Contacts of a pair, unless said otherwise."""

Chooser = Callable[[Any, int, int], ContactSettings | None]
"""From a model and two of its geoms to the parameters of their contacts; None if they do not touch."""


class CarrierRow(NamedTuple):
    """A body with an object."""

    body: int  # Its index
    geom: int  # The geom that stands for the object in MuJoCo's list of contacts
    thing: AttachedObject  # The object
    others: Int[np.ndarray, " k"]  # Geoms that it may touch, by the tree of bodies


class BridgeTable:
    """What the search needs of a model. Frictions, heights and the like are read in every step.

    So are sizes of geoms: where one has changed, what is known of them is made anew.
    """

    def __init__(
        self,
        mujoco: Any,
        model: Any,
        things: Mapping[str, AttachedObject],
        choose: Chooser | None = None,
        most: int = MOST,
    ):
        """Look the bodies up.

        Raises:
            ValueError: If a body is missing or has no geom.
        """
        self._mujoco, self._choose, self._most = mujoco, choose, most
        bodies = {name: body_index(model, name) for name in things}
        taken = np.isin(model.geom_bodyid, list(bodies.values()))
        self.carriers = [
            CarrierRow(body, _geom_of(model, body, name), things[name], _others(mujoco, model, body, taken))
            for name, body in bodies.items()
        ]
        self.geoms = frozenset(carrier.geom for carrier in self.carriers)
        self._hulls = {
            geom: things[name].bits for name in things if (geom := _standin(model, name)) is not None
        }
        self._collide = True
        self._known = self._look(model)
        self._searches: dict[int, tuple[Any, BridgeModel, NearSearch]] = {}

    def _look(self, model: Any, device: str | None = None) -> BridgeModel:
        """The parts of the model, and which of them may touch; `device` as `BridgeModel` has it."""
        parts: list[Part] = [part_of_thing(each.body, each.geom, each.thing) for each in self.carriers]
        at: dict[int, int] = {}
        pairs = []
        for i, carrier in enumerate(self.carriers):
            for geom in carrier.others.tolist():
                if geom not in at:
                    at[geom] = len(parts)
                    body = int(model.geom_bodyid[geom])
                    parts.append(part_of_geom(body, geom, geom_of(self._mujoco, model, geom)))
                pairs.append((at[geom], i))
            for j, other in enumerate(self.carriers[i + 1 :], i + 1):
                if _may_meet(self._mujoco, model, carrier.body, other.body):
                    pairs.append((i, j))
        return BridgeModel(parts, np.array(pairs, np.int32).reshape(-1, 2), model.geom_size, device)

    def stand_in(self, model: Any, collides: bool) -> bool:
        """Let the hulls that stand in for objects collide, or not; whether that changed."""
        if collides == self._collide or not self._hulls:
            return False
        self._collide = collides
        for geom, bits in self._hulls.items():
            model.geom_contype[geom], model.geom_conaffinity[geom] = bits if collides else (0, 0)
        return True

    def in_worlds(self, model: Any, device: str) -> Worlds:
        """What finds the contacts in worlds of MuJoCo Warp on a device.

        Raises:
            ValueError: If a geom that an object may touch cannot touch it.
        """
        known = self._look(model, device)
        for a, b in known.pairs.tolist():
            geom, carrier = known.parts[a], known.parts[b]
            if geom.solid.error and _do_touch(model, geom, carrier):
                raise ValueError(_unknown(model, known, geom.geom))
        given = None
        if self._choose is not None:
            ends = [(known.parts[a].geom, known.parts[b].geom) for a, b in known.pairs.tolist()]
            given = [self._choose(model, a, b) for a, b in ends]
        return Worlds(known, self._most, given)

    def find(self, model: Any, data: Any) -> tuple[int, NearSearch]:
        """All contacts of the objects at the present pose: how many, and where they are.

        Raises:
            ValueError: If a geom near an object cannot touch it.
        """
        search = self._search(model, data)
        search.options[0] = model.opt.timestep
        if self._choose is not None:
            search.options[2] = 1.0
            known = self._known
            for k, (a, b) in enumerate(known.pairs.tolist()):
                search.give(k, self._choose(model, known.parts[a].geom, known.parts[b].geom))
        elif model.opt.enableflags & self._mujoco.mjtEnableBit.mjENBL_OVERRIDE:
            search.options[3] = 1.0
            search.give(0, overriding(model))
        else:
            search.options[3] = 0.0
        search.launch()
        n = int(search.found[0])
        if n >= 0:
            return n, search
        if n < -1:
            raise ValueError(_unknown(model, self._known, -2 - n))
        self._known = self._look(model)
        return self.find(model, data)

    def search_in(self, data: Any) -> NearSearch | None:
        """The search that has been made for some data, if it still is the one."""
        found = self._searches.get(id(data))
        return found[2] if found is not None and found[0]() is data and found[1] is self._known else None

    def _search(self, model: Any, data: Any) -> NearSearch:
        key, known, found = id(data), self._known, self.search_in(data)
        if found is None:
            gone = weakref.ref(data, lambda _: self._searches.pop(key, None))
            found = NearSearch(self._mujoco, model, data, known, self._most)
            self._searches[key] = gone, known, found
        return found


def _do_touch(model: Any, geom: Part, carrier: Part) -> bool:
    assert carrier.thing is not None
    contype, conaffinity = carrier.thing.bits
    own = int(model.geom_contype[geom.geom]), int(model.geom_conaffinity[geom.geom])
    return bool(own[0] & conaffinity or contype & own[1])


def _standin(model: Any, name: str) -> int | None:
    # Not by MuJoCo's functions, see `body_index`.
    try:
        return model.geom(standin_name(name)).id
    except KeyError:
        return None


def _unknown(model: Any, known: BridgeModel, geom: int) -> str:
    error = next(part.solid.error for part in known.parts if part.geom == geom)
    return (
        f"geom {model.geom(geom).name or geom!r} must be a plane, height field, sphere, capsule, ellipsoid, "
        f"cylinder, box or mesh with a volume to touch a neural object, {error}; take it out of contact by "
        "contype and conaffinity"
    )


def _others(mujoco: Any, model: Any, body: int, taken: Bool[np.ndarray, " g"]) -> Int[np.ndarray, " k"]:
    meets = np.array([_may_meet(mujoco, model, body, b) for b in range(model.nbody)])
    return np.flatnonzero(meets[model.geom_bodyid] & ~taken)


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
