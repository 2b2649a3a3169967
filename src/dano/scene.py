"""Scenes: bodies, the contacts between them, and the states they move through."""

import os
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dano.archive import read_archive, write_archive
from dano.contact import (
    AbstractContactLaw,
    CentroidLaw,
    Collider,
    ContactParams,
    non_negative,
    SampleSet,
    Support,
)
from dano.fields import AbstractField, AbstractShape, HalfSpace, PosedShape, Sphere
from dano.maths import checked_array, checked_quaternion, floating, is_traced, Numbers
from dano.objects import checked_inertia, MassProperties, NeuralObject, surface_samples

# Edge width of a primitive relative to the size of what touches it: 0.5 % made gradients and rest
# right, 0.1 % did not.
EDGE_SHARE = 0.005
SHAPE_SAMPLES = 2000


class Body(eqx.Module):
    """A rigid body: geometry, mass properties, and a name.

    Attributes:
        name: Unique name in its scene.
        shape: Primitive shape, or None for a neural object.
        object: Neural object, or None for a shape.
        samples: Contact samples in the layout of the contact kernels, or None for a shape without them.
        support: Culling map of the object's grid.
        density_scale: Makes the object's density dimensionless in neural–neural contacts: one over the mean
            density of its samples.
        mass: [kg].
        inertia: Tensor about the centre of mass [kg m², B].
        com: Centre of mass in the field frame [m, F].
        mass_scale: Multiplies mass and inertia [1].
        com_offset: Moves the centre of mass [m, F].
        fixed: Whether the body never moves.
    """

    name: str = eqx.field(static=True)
    shape: AbstractShape | None
    object: NeuralObject | None
    samples: SampleSet | None
    support: Support | None
    density_scale: Float[Array, ""]
    mass: Float[Array, ""]
    inertia: Float[Array, "3 3"]
    com: Float[Array, "3"]
    mass_scale: Float[Array, ""]
    com_offset: Float[Array, "3"]
    fixed: bool = eqx.field(static=True)

    def __init__(
        self,
        name: str,
        geometry: NeuralObject | AbstractField,
        *,
        mass: Numbers | None = None,
        inertia: Numbers | None = None,
        com: Numbers | None = None,
        mass_scale: Numbers = 1.0,
        com_offset: Numbers = (0.0, 0.0, 0.0),
        fixed: bool = False,
    ):
        """A body from a neural object (which brings its mass) or a shape (homogeneous, of the given mass).

        Args:
            name: Unique name.
            geometry: Neural object or shape.
            mass: [kg]; required for a shape that moves. For a neural object: replaces its mass, inertia in
                proportion.
            inertia: Tensor about the centre of mass [kg m²]; default from the geometry.
            com: Centre of mass [m, F]; default from the geometry.
            mass_scale: Multiplies mass and inertia.
            com_offset: Moves the centre of mass [m, F].
            fixed: Whether the body never moves; then it needs no mass.

        Raises:
            ValueError: If the name is empty, the geometry is no shape or object, or a mass property is
                missing or out of range.
        """
        if not isinstance(name, str) or not name:
            raise ValueError(f"name must be a non-empty string, got {name!r}")
        self.name = name
        self.fixed = bool(fixed)
        self.samples = self.support = self.object = self.shape = None
        self.density_scale = floating(1.0)
        if isinstance(geometry, NeuralObject):
            self.object = geometry
            self.samples = SampleSet.create(geometry.samples.points, geometry.samples.density)
            self.density_scale = 1 / jnp.mean(geometry.samples.density)
            if geometry.grid is not None:
                self.support = Support.create(geometry.grid)
            properties = geometry.mass
        elif isinstance(geometry, AbstractShape):
            self.shape = geometry
            properties = None if mass is None else _homogeneous(name, geometry, float(np.asarray(mass)))
        else:
            raise ValueError(
                f"geometry of body {name!r} must be a NeuralObject or a shape, "
                f"got {type(geometry).__name__}; a field becomes an object by NeuralObject.from_field"
            )
        if properties is None:
            if not self.fixed:
                raise ValueError(
                    f"mass of body {name!r} must be given: a shape that moves has none of its own"
                )
            properties = MassProperties(1.0, (0.0, 0.0, 0.0), np.eye(3))
        share = 1.0
        if mass is not None:
            mass = checked_array(f"mass of body {name!r}", mass, ())
            if not is_traced(mass) and not float(mass) > 0:
                raise ValueError(f"mass of body {name!r} must be > 0 kg, got {float(mass)}")
            share = mass / properties.mass
        self.mass = properties.mass if mass is None else mass
        self.inertia = (
            properties.inertia * share
            if inertia is None
            else checked_inertia(f"inertia of body {name!r}", inertia)
        )
        self.com = properties.com if com is None else checked_array(f"com of body {name!r}", com, (3,))
        self.mass_scale = checked_array(f"mass_scale of body {name!r}", mass_scale, ())
        if not is_traced(self.mass_scale) and not float(self.mass_scale) > 0:
            raise ValueError(f"mass_scale of body {name!r} must be > 0, got {float(self.mass_scale)}")
        self.com_offset = checked_array(f"com_offset of body {name!r}", com_offset, (3,))

    @property
    def size(self) -> float:
        """Largest extent [m]; infinite for a half-space."""
        if self.object is not None:
            return self.object.size
        assert self.shape is not None
        extent = np.asarray(self.shape.bounds[1] - self.shape.bounds[0])
        return float(extent.max())

    @property
    def field(self) -> AbstractField | None:
        """What other bodies' samples query: the shape, or the object's grid."""
        return self.shape if self.object is None else self.object.grid

    def collider(self, position: Float[Array, "3"], rotation: Float[Array, "3 3"]) -> Collider:
        """The body as a contact sees it: centre of mass at `position` [m, W], axes `rotation` (B → W)."""
        com = self.com + self.com_offset
        origin = position - sum(rotation[:, i] * com[i] for i in range(3))
        return Collider(
            self.field,
            self.samples,
            support=self.support,
            density_scale=self.density_scale,
            mass=self.mass * self.mass_scale,
            rotation=rotation,
            origin=origin,
        )


class Contact(eqx.Module):
    """A pair of bodies that may touch, and how.

    Attributes:
        a: Name of the first body; the patch normal points from b to a.
        b: Name of the second body.
        params: Parameters of the law.
        law: The law.
        edge: Width of the smooth occupancy of a primitive in this pair [m]; None until a scene resolves it.
    """

    a: str = eqx.field(static=True)
    b: str = eqx.field(static=True)
    params: ContactParams
    law: AbstractContactLaw
    edge: Float[Array, ""] | None

    def __init__(
        self,
        a: str,
        b: str,
        params: ContactParams | None = None,
        law: AbstractContactLaw | None = None,
        edge: Numbers | None = None,
    ):
        """A contact with default parameters and the paper's law unless given otherwise.

        Raises:
            ValueError: If the two names are equal or the edge is negative.
        """
        if a == b:
            raise ValueError(f"contact must join two different bodies, got {a!r} twice")
        self.a, self.b = a, b
        self.params = ContactParams() if params is None else params
        self.law = CentroidLaw() if law is None else law
        self.edge = None if edge is None else non_negative("edge", edge)


class State(eqx.Module):
    """Configuration and motion of all bodies of a scene, in the order of `Scene.bodies`.

    Attributes:
        position: Position of the centre of mass [m, W], shape (n, 3).
        orientation: Unit quaternion wxyz, body → world, shape (n, 4).
        velocity: Velocity of the centre of mass [m/s, W], shape (n, 3).
        omega: Angular velocity [rad/s, B], shape (n, 3).
    """

    position: Float[Array, "*t n 3"]
    orientation: Float[Array, "*t n 4"]
    velocity: Float[Array, "*t n 3"]
    omega: Float[Array, "*t n 3"]


class Control(eqx.Module):
    """External force and torque on each body, constant over a step.

    Attributes:
        force: At the centre of mass [N, W], shape (n, 3).
        torque: [N m, W], shape (n, 3).
    """

    force: Float[Array, "*t n 3"]
    torque: Float[Array, "*t n 3"]


class Trajectory(eqx.Module):
    """States over time, with what the solver said of each step.

    Attributes:
        times: [s], shape (n_steps + 1,).
        states: States, leaves of shape (n_steps + 1, n_bodies, ·); the first entry is the initial state.
        residuals: Largest remaining momentum error of each step divided by mass or inertia [m/s, rad/s],
            shape (n_steps,).
        iterations: Newton iterations of each step, shape (n_steps,).
        converged: Whether each step reached the solver's tolerance, shape (n_steps,).
        names: Names of the bodies.
    """

    times: Float[Array, " times"]
    states: State
    residuals: Float[Array, " steps"]
    iterations: Int[Array, " steps"]
    converged: Bool[Array, " steps"]
    names: tuple[str, ...] = eqx.field(static=True)

    def save(self, path: str | os.PathLike[str], *, source: str | None = None) -> None:
        """Write the trajectory to an .npz file, replacing an existing one only when complete.

        Args:
            path: The file.
            source: Text kept in the file as member `source`: where the trajectory comes from.

        Raises:
            ValueError: If `path` is a directory or its parent does not exist.
        """
        write_archive(
            path,
            {
                "format": np.array("dano-trajectory"),
                "version": np.array(1),
                "names": np.array(self.names),
                "times": np.asarray(self.times),
                **{name: np.asarray(getattr(self.states, name)) for name in _STATE_SHAPES},
                **{name: np.asarray(getattr(self, name)) for name in _REPORTED},
                **({} if source is None else {"source": np.array(source)}),
            },
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Trajectory":
        """Read a trajectory written by `save`.

        Raises:
            ValueError: If the file is missing, truncated or not a dano trajectory.
        """
        data = read_archive(path, "dano-trajectory", 1)
        try:
            arrays = {name: jnp.asarray(data[name]) for name in ("times", *_REPORTED)}
            states = State(*(jnp.asarray(data[name]) for name in _STATE_SHAPES))
            return cls(states=states, names=tuple(str(name) for name in data["names"]), **arrays)
        except KeyError as error:
            raise ValueError(f"{path} is not a valid dano trajectory: it lacks {error}") from error


_REPORTED = ("residuals", "iterations", "converged")
_REPORTED = ("residuals", "iterations", "converged")
_STATE_SHAPES = {"position": 3, "orientation": 4, "velocity": 3, "omega": 3}


class Scene(eqx.Module):
    """Everything that stays constant over a rollout. Every array in it is a leaf that can be differentiated.

    Attributes:
        bodies: The bodies, in the order that states index.
        contacts: Which pairs may touch.
        timestep: h [s].
        gravity: [m/s², W].
    """

    bodies: tuple[Body, ...]
    contacts: tuple[Contact, ...]
    timestep: Float[Array, ""]
    gravity: Float[Array, "3"]

    @classmethod
    def create(
        cls,
        bodies: Sequence[Body],
        contacts: Sequence[Contact] = (),
        *,
        timestep: Numbers = 0.01,
        gravity: Numbers = (0.0, 0.0, -9.81),
    ) -> "Scene":
        """Check the parts against each other and resolve defaults that depend on both bodies of a contact.

        Raises:
            ValueError: If there is no body, two have one name, a contact names an unknown body, joins two
                fixed ones or a pair twice, a pair cannot overlap, or a number is out of range.
        """
        bodies, contacts = tuple(bodies), tuple(contacts)
        names = [body.name for body in bodies]
        if not bodies:
            raise ValueError("bodies must hold at least one body, got none")
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"bodies must have different names, got {name!r} {names.count(name)} times")
        timestep = checked_array("timestep", timestep, ())
        if not is_traced(timestep) and not float(timestep) > 0:
            raise ValueError(f"timestep must be > 0 s, got {float(timestep)}")
        seen: set[frozenset[str]] = set()
        for contact in contacts:
            for name in (contact.a, contact.b):
                if name not in names:
                    raise ValueError(f"contact must name bodies of the scene {names}, got {name!r}")
            if frozenset((contact.a, contact.b)) in seen:
                raise ValueError(
                    f"contacts must join each pair once, got ({contact.a!r}, {contact.b!r}) twice"
                )
            seen.add(frozenset((contact.a, contact.b)))
        by_name = dict(zip(names, bodies, strict=True))
        needs_samples: set[str] = set()
        for contact in contacts:
            needs_samples |= _check_pair(by_name[contact.a], by_name[contact.b])
        bodies = tuple(_with_samples(b) if b.name in needs_samples else b for b in bodies)
        by_name = dict(zip(names, bodies, strict=True))
        contacts = tuple(_with_edge(c, by_name[c.a], by_name[c.b]) for c in contacts)
        return cls(bodies, contacts, timestep, checked_array("gravity", gravity, (3,)))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the bodies, in order."""
        return tuple(body.name for body in self.bodies)

    def index(self, name: str) -> int:
        """Index of a body.

        Raises:
            ValueError: If there is no such body.
        """
        if name not in self.names:
            raise ValueError(f"body must be one of {list(self.names)}, got {name!r}")
        return self.names.index(name)

    def body(self, name: str) -> Body:
        """A body by name.

        Raises:
            ValueError: If there is no such body.
        """
        return self.bodies[self.index(name)]

    def contact_index(self, a: str, b: str) -> int:
        """Index of the contact between two bodies, in either order.

        Raises:
            ValueError: If there is none.
        """
        pairs = [(c.a, c.b) for c in self.contacts]
        for i, pair in enumerate(pairs):
            if pair in ((a, b), (b, a)):
                return i
        raise ValueError(f"contact must be one of {pairs}, got {(a, b)}")

    def contact(self, a: str, b: str) -> ContactParams:
        """Parameters of the contact between two bodies, in either order.

        Raises:
            ValueError: If there is none.
        """
        return self.contacts[self.contact_index(a, b)].params

    def replace_contact(self, a: str, b: str, **changes: Numbers) -> "Scene":
        """The scene with some parameters of one contact changed, e.g. ``sliding_friction=0.3``.

        Raises:
            ValueError: If there is no such contact or parameter, or a value is out of range.
        """
        i = self.contact_index(a, b)
        valid = list(ContactParams.__dataclass_fields__)
        for name in changes:
            if name not in valid:
                raise ValueError(f"contact parameter must be one of {valid}, got {name!r}")
        names = list(changes)
        values = [
            _as_leaf(non_negative(name, changes[name]), getattr(self.contacts[i].params, name))
            for name in names
        ]
        return eqx.tree_at(lambda s: [getattr(s.contacts[i].params, name) for name in names], self, values)

    def replace_body(self, name: str, **changes: Numbers) -> "Scene":
        """The scene with some of a body's `mass, inertia, com, mass_scale, com_offset` changed.

        Raises:
            ValueError: If there is no such body or property, or a shape differs.
        """
        i = self.index(name)
        valid = ["mass", "inertia", "com", "mass_scale", "com_offset"]
        for key in changes:
            if key not in valid:
                raise ValueError(f"body property must be one of {valid}, got {key!r}")
        keys = list(changes)
        values = [
            _as_leaf(
                checked_array(key, changes[key], getattr(self.bodies[i], key).shape),
                getattr(self.bodies[i], key),
            )
            for key in keys
        ]
        for key, value in zip(keys, values, strict=True):
            if key in ("mass", "mass_scale") and not is_traced(value) and not float(value) > 0:
                raise ValueError(f"{key} must be > 0, got {float(value)}")
            if key == "inertia":
                checked_inertia(key, value)
        return eqx.tree_at(lambda s: [getattr(s.bodies[i], key) for key in keys], self, values)

    def initial_state(self, /, **bodies: dict[str, Numbers]) -> State:
        """A state: bodies by keyword, each a dict of `position, orientation, velocity, omega`.

        Bodies that are not named rest at the origin. Orientations are normalised.

        Raises:
            ValueError: If a body or quantity is unknown, a shape is wrong, a number is not finite, a
                quaternion is zero, or a body spins faster than the timestep resolves (|ω| ≥ 2/h).
        """
        rows: dict[str, list[Array]] = {name: [] for name in _STATE_SHAPES}
        for name in bodies:
            self.index(name)
        default: dict[str, Numbers] = {
            "position": (0.0,) * 3,
            "orientation": (1.0, 0.0, 0.0, 0.0),
            "velocity": (0.0,) * 3,
            "omega": (0.0,) * 3,
        }
        for name in self.names:
            given = bodies.get(name, {})
            for key in given:
                if key not in _STATE_SHAPES:
                    raise ValueError(f"state of {name!r} must be given by {list(_STATE_SHAPES)}, got {key!r}")
            for key, size in _STATE_SHAPES.items():
                label, value = f"{key} of {name!r}", given[key] if key in given else default[key]
                check = checked_quaternion(label, value) if size == 4 else checked_array(label, value, (3,))
                rows[key].append(check.astype(self.timestep.dtype))
        state = State(*(jnp.stack(rows[key]) for key in _STATE_SHAPES))
        self.check_state(state)
        return state

    def check_state(self, state: State) -> None:
        """Check a concrete state against the scene; traced values pass.

        Raises:
            ValueError: If a shape is wrong, a number is not finite, a quaternion is not of unit length, or
                |ω| ≥ 2/h.
        """
        for key, size in _STATE_SHAPES.items():
            value = getattr(state, key)
            if value.shape[-2:] != (len(self.bodies), size):
                raise ValueError(
                    f"state.{key} must have shape (…, {len(self.bodies)}, {size}), got {value.shape}"
                )
            if not is_traced(value) and not np.all(np.isfinite(np.asarray(value))):
                raise ValueError(f"state.{key} must be finite, got {np.asarray(value).tolist()}")
        if not is_traced(state.orientation):
            norms = np.linalg.norm(np.asarray(state.orientation), axis=-1)
            if np.any(np.abs(norms - 1) > 1e-3):
                raise ValueError(f"state.orientation must hold unit quaternions, got norms {norms.tolist()}")
        if not is_traced(state.omega, self.timestep):
            fastest, limit = (
                float(np.linalg.norm(np.asarray(state.omega), axis=-1).max()),
                2 / float(self.timestep),
            )
            if fastest >= limit:
                raise ValueError(
                    f"state.omega must be below 2/timestep = {limit:.6g} rad/s, got {fastest:.6g}; "
                    "take a smaller timestep"
                )

    def control(self, /, **bodies: dict[str, Numbers]) -> Control:
        """Control for one step: bodies by keyword, each a dict of `force` [N, W] and `torque` [N m, W].

        Raises:
            ValueError: If a body or quantity is unknown or a shape is wrong.
        """
        rows: dict[str, list[Array]] = {"force": [], "torque": []}
        for name in bodies:
            self.index(name)
        for name in self.names:
            given = bodies.get(name, {})
            for key in given:
                if key not in rows:
                    raise ValueError(f"control of {name!r} must be given by {list(rows)}, got {key!r}")
            for key, values in rows.items():
                value = checked_array(f"{key} of {name!r}", given.get(key, (0.0,) * 3), (3,))
                values.append(value.astype(self.timestep.dtype))
        return Control(jnp.stack(rows["force"]), jnp.stack(rows["torque"]))


def colliders(
    scene: Scene, contact: Contact, positions: Float[Array, "n 3"], rotations: Sequence[Float[Array, "3 3"]]
) -> tuple[Collider, Collider]:
    """Both sides of a contact, as `dano.overlap` takes them, with bodies at given positions and rotations."""
    a, b = (scene.body(name) for name in (contact.a, contact.b))
    sides = []
    for body, other in ((a, b), (b, a)):
        i = scene.index(body.name)
        side = body.collider(positions[i], rotations[i])
        if body.shape is not None:
            # Against a neural object a primitive has no samples of its own (paper: the sum runs over the
            # object's).
            samples = side.samples if other.object is None else None
            side = eqx.tree_at(
                lambda c: (c.field, c.samples),
                side,
                (_shape_with_edge(body.shape, contact.edge), samples),
                is_leaf=_none,
            )
        sides.append(side)
    return sides[0], sides[1]


def _shape_with_edge(shape: AbstractShape, edge: Array | None) -> AbstractShape:
    if edge is None:
        return shape
    if isinstance(shape, PosedShape):
        return eqx.tree_at(lambda s: s.shape, shape, _shape_with_edge(shape.shape, edge))
    return eqx.tree_at(lambda s: s.edge, shape, edge, is_leaf=_none)


def _none(x: Any) -> bool:
    return x is None


def _homogeneous(name: str, shape: AbstractShape, mass: float) -> MassProperties:
    """Mass properties of a homogeneous solid shape: closed form where there is one, else integrated."""
    if not mass > 0:
        raise ValueError(f"mass of body {name!r} must be > 0 kg, got {mass}")
    if not np.all(np.isfinite(np.asarray(shape.bounds))):
        raise ValueError(f"body {name!r} must have a bounded shape or be fixed, got {type(shape).__name__}")
    moments = shape.solid_moments()
    if moments is None:
        return MassProperties.from_field(shape, mass=mass)
    second = np.asarray(moments.second_moment) * (mass / float(moments.volume))
    return MassProperties(mass, moments.centroid, np.trace(second) * np.eye(3) - second)


def _check_pair(a: Body, b: Body) -> set[str]:
    """Names of the shapes that need contact samples for this pair.

    Raises:
        ValueError: If the pair cannot overlap.
    """
    if a.fixed and b.fixed:
        raise ValueError(
            f"contact must join at least one body that moves, got fixed {a.name!r} and {b.name!r}"
        )
    if a.object is not None and b.object is not None:
        if a.object.grid is None and b.object.grid is None:
            raise ValueError(
                f"contact between {a.name!r} and {b.name!r} needs a density grid on one side: give "
                "NeuralObject.from_samples a field"
            )
        return set()
    if a.object is not None or b.object is not None:
        return set()
    kinds = {type(a.shape), type(b.shape)}
    if kinds == {Sphere, HalfSpace}:
        return set()
    # A fixed shape has no mass that its samples could carry; the moving side's samples find it.
    return {body.name for body in (a, b) if not body.fixed}


def _with_samples(body: Body) -> Body:
    """The shape with contact samples on its surface, so that it can meet other shapes."""
    if body.samples is not None or body.shape is None:
        return body
    drawn = surface_samples(body.shape, SHAPE_SAMPLES)
    samples = SampleSet.create(drawn.points, drawn.density)
    return eqx.tree_at(lambda b: b.samples, body, samples, is_leaf=_none)


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


def _as_leaf(value: Array, like: Array) -> Array:
    return value.astype(like.dtype)
