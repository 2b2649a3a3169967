"""Pairs of bodies that no contact names: what may touch, and what the bodies are made of."""

import functools
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple, overload

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dano.checks import shown
from dano.contact import combined, ContactParams, DistributedLaw, Setting
from dano.maths import AnyArray, by_numpy, library, Q
from dano.scene._bodies import alike, are_flat, Body, sizes_of
from dano.scene._contacts import (
    are_on_fixed,
    check_objects,
    checked_support,
    Contact,
    heaviest,
    with_surfaces,
)
from dano.scene._joints import Joint, Loop, unjoined

MOST_LISTED = 200
"""Pairs that a scene lists as contacts unasked: those of twenty bodies. A contact takes 8 ms to make, and its
numbers are leaves of the scene; `Others` holds those of thousands in arrays."""


class OfEdges(NamedTuple):
    """Parameters of each body where edges and faces of both bodies are known, arrays of shape (n,)."""

    stiffness: Float[Array, " n"]  # k [Pa/m]
    impact_depth: Float[Array, " n"]  # δ [m]
    stiffness_on_fixed: Float[Array, " n"]  # k of shapes of which one is fixed [Pa/m]


class Pairs(Sequence[tuple[int, int]]):
    """Pairs of indices: half a million of them are an array, not as many tuples.

    Attributes:
        array: The pairs, shape (k, 2); not to be written to.
    """

    def __init__(self, array: Int[np.ndarray, "k 2"]):
        """See the class."""
        self.array = np.ascontiguousarray(array, np.int32).reshape(-1, 2)
        self.array.flags.writeable = False
        self._hash: int | None = None

    def __len__(self) -> int:
        return len(self.array)

    @overload
    def __getitem__(self, index: int) -> tuple[int, int]: ...
    @overload
    def __getitem__(self, index: slice) -> "Pairs": ...
    def __getitem__(self, index: int | slice) -> "tuple[int, int] | Pairs":
        if isinstance(index, slice):
            return Pairs(self.array[index])
        first, second = self.array[index].tolist()
        return first, second

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return ((first, second) for first, second in self.array.tolist())

    def __eq__(self, other: object) -> bool:
        if isinstance(other, Pairs):
            return self is other or np.array_equal(self.array, other.array)
        return NotImplemented

    def __hash__(self) -> int:
        if self._hash is None:
            self._hash = hash(self.array.tobytes())
        return self._hash

    def __repr__(self) -> str:
        return f"Pairs({shown(self.array.tolist())})"


class Others(eqx.Module):
    """All pairs of bodies that no contact of a scene names.

    Parameters of a pair follow from those of its two bodies, see `pair_params`.
    """

    params: ContactParams  # Of each body of the scene, arrays of shape (n,)
    of_edges: OfEdges  # Some of them where edges and faces of both bodies are known
    law: DistributedLaw  # Of all these pairs
    pairs: Pairs = eqx.field(static=True)  # Indices of the bodies of each pair (static)
    flat: tuple[bool, ...] = eqx.field(static=True)  # Whether edges and faces of each body are known (static)
    shapes: tuple[bool, ...] = eqx.field(static=True)  # Whether each is a shape and no neural object (static)
    fixed: tuple[bool, ...] = eqx.field(static=True)  # Whether each is fixed (static)

    @property
    def pair_params(self) -> ContactParams:
        """Parameters of each pair, arrays of shape (k,).

        √(μ_a μ_b) of the sliding frictions; of restitution, stiffness, hysteresis and fading the larger; of
        `restitution_velocity`, `impact_depth` and `friction_pressure` the smaller.
        """
        return self.params_of(self.pairs.array)

    def params_of(self, pairs: Int[np.ndarray, "k 2"]) -> ContactParams:
        """`pair_params` of some pairs of indices of bodies, arrays of shape (k,)."""
        first, second = pairs.T
        a, b = (jax.tree.map(lambda x, rows=rows: x[rows], self.params) for rows in (first, second))
        found = combined(a, b)
        flat = np.array(self.flat)
        sharp = flat[first] & flat[second]
        if not sharp.any():
            return found
        xp = library(*jax.tree.leaves((self.params, self.of_edges)))
        k, depth, on_fixed = self.of_edges
        shapes, fixed = np.array(self.shapes), np.array(self.fixed)
        hard = are_on_fixed(shapes[first], shapes[second], fixed[first], fixed[second])
        of_edges = xp.where(
            hard, xp.maximum(on_fixed[first], on_fixed[second]), xp.maximum(k[first], k[second])
        )
        stiffness = xp.where(sharp, of_edges, found.stiffness)
        depth = xp.where(sharp, xp.minimum(depth[first], depth[second]), found.impact_depth)
        return eqx.tree_at(lambda p: (p.stiffness, p.impact_depth), found, (stiffness, depth))


def others_of(
    bodies: Sequence[Body],
    contacts: Sequence[Contact],
    joints: Sequence[Joint | Loop],
    apart: Sequence[tuple[str, str]],
    params: ContactParams,
    timestep: Float[Array, ""],
    gravity: Float[Array, "3"],
) -> tuple[tuple[Body, ...], Others | None]:
    """The bodies with what contact needs of them, and the pairs that are left; None if there are none.

    Args:
        bodies: All bodies of a scene.
        contacts: Pairs that are named.
        joints: And loops: what joins needs not touch.
        apart: Names of further pairs that do not touch.
        params: What bodies without a material of their own are made of.
        timestep: h [s].
        gravity: [m/s², W].

    Raises:
        ValueError: If `apart` names an unknown body, objects cannot touch, or a material has a parameter that
            the law does not read.
    """
    _check_apart(bodies, apart)
    law = DistributedLaw()
    for given in (params, *(body.material for body in bodies)):
        if given is not None:
            law.check(given)
    place = {body.name: i for i, body in enumerate(bodies)}
    left_out = {frozenset(pair) for pair in apart} | {frozenset((c.a, c.b)) for c in contacts}
    left = unjoined([body.name for body in bodies], joints)
    for pair in left_out:
        left[np.ix_(*2 * ([place[name] for name in pair],))] = False
    ends = _Ends.of(bodies, True)
    may = ends.can_touch()
    moves = ~(ends.fixed[:, None] & ends.fixed)
    # Two objects of which neither has a solid: that is said.
    for i, j in np.argwhere(np.triu(left & ~may & moves & (ends.is_object[:, None] & ends.is_object), 1)):
        first, second = bodies[i].object, bodies[j].object
        assert first is not None and second is not None
        check_objects(Contact(bodies[i].name, bodies[j].name), first, second)
    pairs = Pairs(np.argwhere(np.triu(left & may, 1)))
    if not pairs:
        return tuple(bodies), None
    touching = np.unique(pairs.array).tolist()
    prepared = dict(zip(touching, with_surfaces([bodies[i] for i in touching]), strict=True))
    bodies = tuple(prepared.get(i, body) for i, body in enumerate(bodies))
    flat = are_flat(bodies)
    complete, of_edges = _stacked(bodies, touching, flat, law, params, timestep, gravity)
    shapes = tuple(body.object is None for body in bodies)
    fixed = tuple(body.fixed for body in bodies)
    return bodies, Others(complete, of_edges, law, pairs, tuple(flat), shapes, fixed)


def unnamed_contacts(
    bodies: Sequence[Body], joints: Sequence[Joint | Loop], apart: Sequence[tuple[str, str]]
) -> list[Contact] | None:
    """A contact of each pair of a scene that may touch, for a scene that names none.

    Args:
        bodies: All bodies of the scene.
        joints: And loops: what joins needs not touch.
        apart: Names of pairs that do not touch.

    Returns:
        The contacts; None where `Others` has to hold them: bodies have materials, or there are more than
        `MOST_LISTED` pairs.

    Raises:
        ValueError: If `apart` names an unknown body.
    """
    _check_apart(bodies, apart)
    if any(body.material is not None for body in bodies):
        return None
    may = _Ends.of(bodies, True).can_touch() & unjoined([body.name for body in bodies], joints)
    place = {body.name: i for i, body in enumerate(bodies)}
    for a, b in apart:
        may[[place[a], place[b]], [place[b], place[a]]] = False
    pairs = np.argwhere(np.triu(may, 1)).tolist()
    if len(pairs) > MOST_LISTED:
        return None
    return [Contact(bodies[i].name, bodies[j].name) for i, j in pairs]


def touching_pairs(
    bodies: Sequence[Body], joints: Sequence[Joint | Loop], *, presses: bool = True
) -> list[tuple[str, str]]:
    """Names of all pairs of bodies between which there can be a contact.

    Args:
        bodies: All bodies of a scene.
        joints: And loops: what joins does not touch.
        presses: Whether the law of the contacts acts at points, see `AbstractContactLaw`.
    """
    names = [body.name for body in bodies]
    may = _Ends.of(bodies, presses).can_touch() & unjoined(names, joints)
    pairs = np.argwhere(np.triu(may, 1)).tolist()
    return [(names[i], names[j]) for i, j in pairs if names[i] != names[j]]


class _Ends(NamedTuple):
    """What decides whether `Scene.create` would accept contacts of bodies, arrays of shape (n,)."""

    fixed: Bool[np.ndarray, " n"]
    is_object: Bool[np.ndarray, " n"]
    has_solid: Bool[np.ndarray, " n"]  # Of an object: whether others' samples can ask it
    finite: Bool[np.ndarray, " n"]

    @classmethod
    def of(cls, bodies: Sequence[Body], presses: bool) -> "_Ends":
        objects = [body.object for body in bodies]
        solids = [None if o is None else o.solid if presses else o.grid for o in objects]
        return cls(
            np.array([body.fixed for body in bodies], bool),
            np.array([o is not None for o in objects], bool),
            np.array([solid is not None for solid in solids], bool),
            np.isfinite(sizes_of(bodies)),
        )

    def can_touch(self) -> Bool[np.ndarray, "n n"]:
        """Whether there can be a contact of each with each other."""
        objects = self.is_object[:, None] & self.is_object
        met = np.where(objects, self.has_solid[:, None] | self.has_solid, self.finite[:, None] | self.finite)
        return met & ~(self.fixed[:, None] & self.fixed)


def _check_apart(bodies: Sequence[Body], apart: Sequence[tuple[str, str]]) -> None:
    """Check that pairs that are not to touch are names of bodies.

    Raises:
        ValueError: If not.
    """
    names = [body.name for body in bodies]
    if isinstance(apart, str) or not isinstance(apart, Iterable):
        raise ValueError(f"apart must be pairs of names of bodies, got {shown(apart)}")
    for pair in apart:
        if isinstance(pair, str) or not isinstance(pair, Sequence) or len(pair) != 2:
            raise ValueError(f"apart must hold pairs of names of bodies, got {shown(pair)}")
        for name in pair:
            if name not in names:
                raise ValueError(f"apart must name bodies of the scene {names}, got {name!r}")


def _stacked(
    bodies: Sequence[Body],
    touching: Sequence[int],
    flat: Sequence[bool],
    law: DistributedLaw,
    usual: ContactParams,
    timestep: Float[Array, ""],
    gravity: Float[Array, "3"],
) -> tuple[ContactParams, OfEdges]:
    """Complete parameters of all bodies as arrays, and those where edges and faces of both are known.

    What does not move or has no end presses as softly, and is as large, as what it may meet: the other body
    decides.
    """
    weight, strength = heaviest(bodies, gravity)
    own = sizes_of(bodies)
    moving = [i for i in touching if not bodies[i].fixed]
    sizes = np.minimum(own, max(own[i] for i in moving))
    kinds = alike(bodies)

    @functools.cache
    def support(kind: int, sinking: float) -> float:
        body = bodies[kind]
        found = body.typical_support(sinking * own[kind])
        return checked_support(body, found, "in others must be given")

    def stiffness(asked: set[int], sinking: float) -> Float[AnyArray, " n"]:
        # What does not move takes the least of what does.
        largest = max(support(kinds[i], sinking) for i in (asked if asked <= set(moving) else moving))
        every = [
            support(kinds[i], sinking) if i in asked and not body.fixed else largest
            for i, body in enumerate(bodies)
        ]
        return _quotients(weight, np.array(every))

    every = functools.partial(stiffness, set(touching))
    setting = Setting(sizes, strength, every, timestep, False, False)
    found = _of_bodies(bodies, law, usual, setting)
    met = {i for i in touching if flat[i]}
    if len(met) < 2:
        return found, OfEdges(found.stiffness, found.impact_depth, found.stiffness)
    setting = setting._replace(stiffness=functools.partial(stiffness, met), sharp=True)
    there = _of_bodies(bodies, law, usual, setting)
    hard = _of_bodies(bodies, law, usual, setting._replace(on_fixed=True))
    return found, OfEdges(
        _where(flat, there.stiffness, found.stiffness),
        _where(flat, there.impact_depth, found.impact_depth),
        _where(flat, hard.stiffness, found.stiffness),
    )


def _of_bodies(
    bodies: Sequence[Body], law: DistributedLaw, usual: ContactParams, setting: Setting
) -> ContactParams:
    """Complete parameters of all bodies as arrays."""
    given = [usual if body.material is None else body.material for body in bodies]
    some = next((params for params in given if params.stiffness is None), given[0])
    defaults = law.defaults(some, setting)
    columns = [[getattr(params, name) for params in given] for name in law.reads]
    arrays = _filled_columns(columns, [defaults.get(name, 0.0) for name in law.reads], setting.timestep)
    empty = ContactParams()
    places = lambda params: [getattr(params, name) for name in law.reads]  # noqa: E731
    return eqx.tree_at(places, empty, arrays, is_leaf=lambda x: x is None)


@by_numpy
def _filled_columns(columns: list[list[Any]], defaults: list[Any], like: AnyArray) -> list[AnyArray]:
    """Arrays over bodies: of numbers that are given, and else of defaults, one for all or one each."""
    arrays = []
    for given, default in zip(columns, defaults, strict=True):
        n = len(given)
        xp = library(default, *(x for x in given if x is not None))
        every = xp.broadcast_to(xp.asarray(default), (n,))
        if any(x is not None for x in given):
            rows = [every[i] if x is None else x for i, x in enumerate(given)]
            # The type of numbers that are given is kept, as a body's alone would be.
            every = xp.stack(rows)
        arrays.append(every.astype(like.dtype))
    return arrays


@by_numpy
def _where(which: Sequence[bool], x: Float[Q, " n"], y: Float[Q, " n"]) -> Float[AnyArray, " n"]:
    return library(x, y).where(np.array(which), x, y)


@by_numpy
def _quotients(weight: Float[Q, ""], supports: Float[np.ndarray, " n"]) -> Float[AnyArray, " n"]:
    return weight / supports.astype(weight.dtype)
