"""Contacts between bodies, and what a scene fills in for them."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from dano.contact import (
    AbstractContactLaw,
    Collider,
    ContactParams,
    DistributedLaw,
    non_negative,
    SampleSet,
    Setting,
    STANDARD_GRAVITY,
    SurfaceSet,
)
from dano.fields import AbstractShape, HalfSpace, PosedShape, Sphere
from dano.maths import AnyArray, by_numpy, floating, library, Numbers, Q
from dano.objects import draw_contact_samples, NeuralObject, surface_quadrature
from dano.scene._bodies import are_flat, Body, by_geometry, sizes_of

# Edge width of a primitive relative to the size of what touches it: 0.5 % made gradients and rest
# right, 0.1 % did not.
EDGE_SHARE = 0.005
# Samples of a shape that an object touches by the centroid law (convention; neural objects choose theirs).
SHAPE_SAMPLES = 2000


class Contact(eqx.Module):
    """A pair of bodies that may touch, and how.

    The default law is `DistributedLaw`: pressure, friction and restitution at every surface sample. The law
    of the paper, one wrench at the centroid of the overlap, is `law=CentroidLaw()`; it reads other
    parameters.
    """

    a: str = eqx.field(static=True)  # Name of the first body; the patch normal points from b to a
    b: str = eqx.field(static=True)  # Name of the second body
    params: ContactParams  # Parameters of the law; a scene fills in those that are None
    law: AbstractContactLaw  # The law
    # Width of the smooth occupancy of a primitive in this pair [m]; None until a scene resolves it.
    edge: Float[Array, ""] | None

    def __init__(
        self,
        a: str,
        b: str,
        params: ContactParams | None = None,
        law: AbstractContactLaw | None = None,
        edge: Numbers | None = None,
    ):
        """A contact of two bodies of a scene.

        Args:
            a: Name of the first body.
            b: Name of the second body.
            params: Parameters of the law; default: all of them are chosen when the scene is created.
            law: The law; default `DistributedLaw()`.
            edge: Width of the smooth occupancy of a primitive in this pair [m], for the centroid law.

        Raises:
            ValueError: If the two names are equal, the edge is negative, an argument is of another type, or
                the law does not read a parameter that was given.
        """
        for what, name in (("a", a), ("b", b)):
            if not isinstance(name, str):
                raise ValueError(f"{what} must be the name of a body, got {name!r}")
        if a == b:
            raise ValueError(f"contact must join two different bodies, got {a!r} twice")
        if params is not None and not isinstance(params, ContactParams):
            raise ValueError(
                f"params must be dano.ContactParams(…), e.g. sliding_friction=0.3, got {params!r}"
            )
        if law is not None and not isinstance(law, AbstractContactLaw):
            raise ValueError(f"law must be dano.DistributedLaw() or dano.CentroidLaw(), got {law!r}")
        self.a, self.b = a, b
        self.params = ContactParams() if params is None else params
        self.law = DistributedLaw() if law is None else law
        self.law.check(self.params)
        self.edge = None if edge is None else non_negative("edge", edge)


def prepared(
    bodies: Sequence[Body],
    contacts: Sequence[Contact],
    timestep: Float[Array, ""],
    gravity: Float[Array, "3"],
) -> tuple[tuple[Body, ...], tuple[Contact, ...]]:
    """Bodies with the samples that their contacts need, and contacts with all defaults filled in.

    Raises:
        ValueError: If a pair cannot touch.
    """
    by_name = {body.name: body for body in bodies}
    # Measured once: pairs are many.
    names = [body.name for body in bodies]
    sizes = dict(zip(names, sizes_of(bodies).tolist(), strict=True))
    pressed = {name for contact in contacts if contact.law.presses for name in (contact.a, contact.b)}
    rows = [body for body in bodies if body.name in pressed]
    by_name |= {body.name: body for body in with_surfaces(rows)}
    for contact in contacts:
        a, b = by_name[contact.a], by_name[contact.b]
        if a.fixed and b.fixed:
            raise ValueError(
                f"contact must join at least one body that moves, got fixed {a.name!r} and {b.name!r}"
            )
        if a.object is not None and b.object is not None:
            check_objects(contact, a.object, b.object)
        for body in (a, b):
            if not contact.law.presses and _needs_samples(a, b) and not body.fixed:
                by_name[body.name] = _with_samples(body)
    weight, strength = heaviest(bodies, gravity)
    carried = functools.cache(lambda name, sinking: by_name[name].typical_support(sinking * sizes[name]))
    flat = dict(zip(by_name, are_flat(list(by_name.values())), strict=True))
    completed = []
    for contact in contacts:
        a, b = by_name[contact.a], by_name[contact.b]
        stiffness = functools.partial(_stiffness, a, b, weight, carried)
        size = min(sizes[a.name], sizes[b.name])
        on_fixed = are_on_fixed(a.object is None, b.object is None, a.fixed, b.fixed)
        setting = Setting(size, strength, stiffness, timestep, flat[a.name] and flat[b.name], on_fixed)
        contact = eqx.tree_at(lambda c: c.params, contact, contact.law.complete(contact.params, setting))
        completed.append(contact if contact.law.presses else _with_edge(contact, a, b))
    return tuple(by_name[body.name] for body in bodies), tuple(completed)


def are_on_fixed(first: Any, second: Any, first_fixed: Any, second_fixed: Any) -> Any:
    """Whether both bodies of a pair are shapes, of which one is fixed; or of pairs, as arrays.

    Args:
        first: Whether the first one is a shape and no neural object.
        second: … the second.
        first_fixed: Whether the first one is fixed.
        second_fixed: … the second.
    """
    return first & second & (first_fixed | second_fixed)


def colliders(a: Body, b: Body, edge: Float[Array, ""] | None) -> tuple[Collider, Collider]:
    """Both sides of a contact with a patch law, where shapes have edges of a width."""
    return _collider(a, b, edge), _collider(b, a, edge)


def _collider(body: Body, other: Body, edge: Float[Array, ""] | None) -> Collider:
    if body.shape is None:
        return Collider(body.field, body.samples, body.support, body.density_scale)
    # Against a neural object a primitive has no samples of its own (paper: the sum runs over the object's).
    samples = body.samples if other.object is None else None
    return Collider(_shape_with_edge(body.shape, edge), samples, body.support, body.density_scale)


def _shape_with_edge(shape: AbstractShape, edge: Array | None) -> AbstractShape:
    if edge is None:
        return shape
    if isinstance(shape, PosedShape):
        return eqx.tree_at(lambda s: s.shape, shape, _shape_with_edge(shape.shape, edge))
    return eqx.tree_at(lambda s: s.edge, shape, edge, is_leaf=_none)


def _none(x: Any) -> bool:
    return x is None


def heaviest(bodies: Sequence[Body], gravity: Float[Array, "3"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Weight of the heaviest body [N], and the strength of gravity that it is taken with [m/s²]."""
    masses = [(body.mass, body.mass_scale) for body in bodies if not body.fixed]
    return _heaviest(masses, gravity)


@by_numpy
def _heaviest(masses: list[tuple[Q, Q]], gravity: Float[Q, "3"]) -> tuple[AnyArray, AnyArray]:
    """See `heaviest`; of masses and what they are multiplied with."""
    xp = library(gravity, *(x for each in masses for x in each))
    strength = xp.sqrt(xp.sum(gravity**2))
    strength = xp.where(strength > 0, strength, STANDARD_GRAVITY)
    most = functools.reduce(xp.maximum, [mass * scale for mass, scale in masses], xp.zeros((), gravity.dtype))
    return most * strength, strength


def _needs_samples(a: Body, b: Body) -> bool:
    """Whether a patch law needs samples of the shapes of a pair; a fixed shape has no mass to carry any."""
    if a.object is not None or b.object is not None:
        return False
    return {type(a.shape), type(b.shape)} != {Sphere, HalfSpace}


def check_objects(contact: Contact, a: NeuralObject, b: NeuralObject) -> None:
    """Check that the samples of one object have something to meet in the other.

    Raises:
        ValueError: If neither object has a solid to press on, or a density to query.
    """
    met = "solid" if contact.law.presses else "grid"
    if getattr(a, met) is None and getattr(b, met) is None:
        raise ValueError(
            f"contact between the objects {contact.a!r} and {contact.b!r} by {type(contact.law).__name__} "
            f"needs a {met} on one side, got {met}=None on both: give NeuralObject.from_samples a field "
            "for one of them"
        )


def _with_samples(body: Body) -> Body:
    """The shape with samples of mass, so that it can meet other shapes."""
    assert body.shape is not None
    if body.samples is not None:
        return body
    drawn = draw_contact_samples(body.shape, SHAPE_SAMPLES)
    samples = SampleSet.create(drawn.points, drawn.density)
    return eqx.tree_at(lambda b: b.samples, body, samples, is_leaf=_none)


def with_surfaces(bodies: Sequence[Body]) -> list[Body]:
    """Bodies with their extents and, unless they have no end, samples of their surfaces."""
    found = by_geometry(_measured, bodies)
    # All at once: each replacement by `eqx.tree_at` looks at all of a tree.
    values = [x for each in found for x in each]
    return eqx.tree_at(
        lambda all: [x for body in all for x in (body.extent, body.surface)],
        list(bodies),
        values,
        is_leaf=lambda x: x is None or isinstance(x, SurfaceSet),
    )


def _measured(body: Body) -> tuple[Float[Array, "6"], SurfaceSet | None]:
    """Extent, and samples of the surface, of a body."""
    extent, surface = body.extent, body.surface
    if surface is None and body.shape is not None and np.isfinite(body.size):
        surface = SurfaceSet.create(*surface_quadrature(body.shape))
    return body.measured() if extent is None else extent, surface


def _stiffness(
    a: Body, b: Body, weight: Float[Array, ""], carried: Callable[[str, float], float], sinking: float
) -> Float[Array, ""]:
    """See `Setting.stiffness`.

    Args:
        a: First body.
        b: Second body.
        weight: Of the heaviest body of the scene [N].
        carried: `Body.typical_support` of a body at a share of its size.
        sinking: That share.

    Raises:
        ValueError: If a body is so small that its support vanishes.
    """
    # An object made of samples may meet a body that has none.
    sampled = [x if x.surface is not None else y for x, y in ((a, b), (b, a)) if not x.fixed]
    whose = f"of the contact between {a.name!r} and {b.name!r} must be given, or law=CentroidLaw()"
    least = min(checked_support(body, carried(body.name, sinking), whose) for body in sampled)
    return _quotient(weight, floating(least))


@by_numpy
def _quotient(x: Float[AnyArray, ""], y: Float[AnyArray, ""]) -> Float[AnyArray, ""]:
    return x / y.astype(x.dtype)


def checked_support(body: Body, support: float, whose: str) -> float:
    """The support of a body, from which its default stiffness follows.

    Raises:
        ValueError: If the body is so small that there is none.
    """
    if not support > 0:
        raise ValueError(
            f"stiffness and restitution_velocity {whose}: "
            f"the size of {body.name!r}, {body.size} m, gives none"
        )
    return support


def _with_edge(contact: Contact, a: Body, b: Body) -> Contact:
    """Resolve the width of the smooth occupancy of the shapes in a pair."""
    if contact.edge is not None:
        return contact
    stated = [body.shape.edge for body in (a, b) if body.shape is not None and body.shape.edge is not None]
    if stated:
        edge = max(stated, key=float)
    else:
        edge = floating(EDGE_SHARE * min(a.size, b.size))
    return eqx.tree_at(lambda c: c.edge, contact, edge, is_leaf=_none)
