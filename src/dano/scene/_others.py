"""Pairs of bodies that no contact names: what may touch, and what the bodies are made of."""

import functools
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.checks import shown
from dano.contact import combined, ContactParams, DistributedLaw, Setting
from dano.scene._bodies import are_flat, Body
from dano.scene._contacts import (
    check_objects,
    checked_support,
    Contact,
    heaviest,
    with_surface,
)
from dano.scene._joints import joined, Joint
from dano.scene._loops import Loop

MOST_LISTED = 200
"""Pairs that a scene lists as contacts unasked: those of twenty bodies. A contact takes 8 ms to make, and its
numbers are leaves of the scene; `Others` holds those of thousands in arrays."""


class OfEdges(NamedTuple):
    """Parameters of each body where edges and faces of both bodies are known, arrays of shape (n,)."""

    stiffness: Float[Array, " n"]  # k [Pa/m]
    impact_depth: Float[Array, " n"]  # δ [m]


class Others(eqx.Module):
    """All pairs of bodies that no contact of a scene names.

    Parameters of a pair follow from those of its two bodies, see `pair_params`.

    Attributes:
        params: Of each body of the scene, arrays of shape (n,).
        of_edges: Some of them where edges and faces of both bodies are known.
        law: Of all these pairs.
        pairs: Indices of the bodies of each pair (static).
        sharp: Whether in a pair edges and faces of both bodies are known (static).
    """

    params: ContactParams
    of_edges: OfEdges
    law: DistributedLaw
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)
    sharp: tuple[bool, ...] = eqx.field(static=True)

    @property
    def pair_params(self) -> ContactParams:
        """Parameters of each pair, arrays of shape (k,).

        √(μ_a μ_b) of the sliding frictions; of restitution, stiffness, hysteresis and fading the larger; of
        `restitution_velocity`, `impact_depth` and `friction_pressure` the smaller.
        """
        first, second = np.array(self.pairs, int).reshape(-1, 2).T
        a, b = (jax.tree.map(lambda x, rows=rows: x[rows], self.params) for rows in (first, second))
        found = combined(a, b)
        if not any(self.sharp):
            return found
        k, depth, sharp = *self.of_edges, np.array(self.sharp)
        stiffness = jnp.where(sharp, jnp.maximum(k[first], k[second]), found.stiffness)
        depth = jnp.where(sharp, jnp.minimum(depth[first], depth[second]), found.impact_depth)
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
    left_out = {frozenset(pair) for pair in apart} | {frozenset((c.a, c.b)) for c in contacts}
    neighbours = joined(joints)
    ends = [_Ends.of(body, True) for body in bodies]
    pairs = []
    for (i, a), (j, b) in itertools.combinations(enumerate(ends), 2):
        if (left_out and frozenset((a.name, b.name)) in left_out) or neighbours(a.name, b.name):
            continue
        first, second = bodies[i].object, bodies[j].object
        if a.can_touch(b):
            pairs.append((i, j))
        elif not (a.fixed and b.fixed) and first is not None and second is not None:
            check_objects(Contact(a.name, b.name), first, second)
    if not pairs:
        return tuple(bodies), None
    touching = {i for pair in pairs for i in pair}
    bodies = tuple(with_surface(body) if i in touching else body for i, body in enumerate(bodies))
    flat = are_flat(bodies)
    sharp = tuple(flat[i] and flat[j] for i, j in pairs)
    complete, of_edges = _stacked(bodies, pairs, sharp, law, params, timestep, gravity)
    return bodies, Others(complete, of_edges, law, tuple(pairs), sharp)


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
    left_out = {frozenset(pair) for pair in apart}
    pairs = [pair for pair in touching_pairs(bodies, joints) if frozenset(pair) not in left_out]
    if len(pairs) > MOST_LISTED or any(body.material is not None for body in bodies):
        return None
    return [Contact(a, b) for a, b in pairs]


def touching_pairs(
    bodies: Sequence[Body], joints: Sequence[Joint | Loop], *, presses: bool = True
) -> list[tuple[str, str]]:
    """Names of all pairs of bodies between which there can be a contact.

    Args:
        bodies: All bodies of a scene.
        joints: And loops: what joins does not touch.
        presses: Whether the law of the contacts acts at points, see `AbstractContactLaw`.
    """
    apart = joined(joints)
    ends = [_Ends.of(body, presses) for body in bodies]
    return [
        (a.name, b.name)
        for a, b in itertools.combinations(ends, 2)
        if a.name != b.name and a.can_touch(b) and not apart(a.name, b.name)
    ]


class _Ends(NamedTuple):
    """What decides whether `Scene.create` would accept a contact of a body with another."""

    name: str
    fixed: bool
    is_object: bool
    has_solid: bool  # Of an object: whether others' samples can ask it
    finite: bool

    @classmethod
    def of(cls, body: Body, presses: bool) -> "_Ends":
        obj = body.object
        solid = None if obj is None else obj.solid if presses else obj.grid
        return cls(body.name, body.fixed, obj is not None, solid is not None, math.isfinite(body.size))

    def can_touch(self, other: "_Ends") -> bool:
        if self.fixed and other.fixed:
            return False
        if self.is_object and other.is_object:
            return self.has_solid or other.has_solid
        return self.finite or other.finite


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
    pairs: Sequence[tuple[int, int]],
    sharp: Sequence[bool],
    law: DistributedLaw,
    usual: ContactParams,
    timestep: Float[Array, ""],
    gravity: Float[Array, "3"],
) -> tuple[ContactParams, OfEdges]:
    """Complete parameters of all bodies as arrays, and those where edges and faces of both are known.

    What does not move or has no end presses as softly, and is as large, as what it may meet: the other body
    decides.
    """
    touching = {i for pair in pairs for i in pair}
    weight, strength = heaviest(bodies, gravity)
    moving = [i for i in touching if not bodies[i].fixed]
    largest = max(bodies[i].size for i in moving)

    @functools.cache
    def stiffness(i: int, sinking: float) -> Float[Array, ""]:
        support = bodies[i].typical_support(sinking * bodies[i].size)
        return weight / checked_support(bodies[i], support, "in others must be given")

    def rule(i: int) -> Callable[[float], Float[Array, ""]]:
        decide = [i] if i in moving else moving
        return lambda sinking: functools.reduce(jnp.minimum, [stiffness(k, sinking) for k in decide])

    met = {i for pair, is_so in zip(pairs, sharp, strict=True) if is_so for i in pair}
    complete, of_edges = [], []
    for i, body in enumerate(bodies):
        given = usual if body.material is None else body.material
        size = min(body.size, largest)
        complete.append(law.complete(given, Setting(size, strength, rule(i), timestep, False)))
        there = complete[-1]
        if i in met:
            there = law.complete(given, Setting(size, strength, rule(i), timestep, True))
        of_edges.append(OfEdges(there.stiffness, there.impact_depth))
    found, there = (jax.tree.map(lambda *x: jnp.stack(x), *each) for each in (complete, of_edges))
    return found, there
