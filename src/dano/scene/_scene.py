"""Scenes: bodies, the contacts between them, a timestep and gravity."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.contact import checked_parameter, ContactParams
from dano.maths import checked_array, checked_quaternion, is_traced, Numbers
from dano.objects import checked_inertia
from dano.scene._bodies import Body
from dano.scene._contacts import Contact, prepared
from dano.scene._states import Control, State, STATE_SIZES


class Scene(eqx.Module):
    """Everything that stays constant over a rollout. Every array in it is a leaf that can be differentiated.

    Attributes:
        bodies: The bodies, in the order that states index.
        contacts: Which pairs may touch.
        timestep: h [s].
        gravity: [m/s², W].
        twins: For each body the first that is made of the same object: its samples and its solid stand once
            in memory (static).
    """

    bodies: tuple[Body, ...]
    contacts: tuple[Contact, ...]
    timestep: Float[Array, ""]
    gravity: Float[Array, "3"]
    twins: tuple[int, ...] = eqx.field(static=True, default=())

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
        gravity = checked_array("gravity", gravity, (3,))
        # Before the bodies are prepared, which makes new ones.
        objects = [body.object for body in bodies]
        twins = tuple(
            i if o is None else next(j for j, p in enumerate(objects) if p is o)
            for i, o in enumerate(objects)
        )
        bodies, contacts = prepared(bodies, contacts, gravity)
        return cls(bodies, contacts, timestep, gravity, twins)

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
        names = list(changes)
        for name in names:
            if name not in self.contacts[i].law.reads:
                raise ValueError(
                    f"contact parameter must be one of {list(self.contacts[i].law.reads)}, got {name!r}"
                )
        values = [checked_parameter(name, changes[name]).astype(self.timestep.dtype) for name in names]
        return eqx.tree_at(
            lambda s: [getattr(s.contacts[i].params, name) for name in names],
            self,
            values,
            is_leaf=lambda x: x is None,
        )

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
        rows: dict[str, list[Array]] = {name: [] for name in STATE_SIZES}
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
                if key not in STATE_SIZES:
                    raise ValueError(f"state of {name!r} must be given by {list(STATE_SIZES)}, got {key!r}")
            for key, size in STATE_SIZES.items():
                label, value = f"{key} of {name!r}", given[key] if key in given else default[key]
                check = checked_quaternion(label, value) if size == 4 else checked_array(label, value, (3,))
                rows[key].append(check.astype(self.timestep.dtype))
        state = State(*(jnp.stack(rows[key]) for key in STATE_SIZES))
        self.check_state(state)
        return state

    def check_state(self, state: State) -> None:
        """Check a concrete state against the scene; traced values pass.

        Raises:
            ValueError: If a shape is wrong, a number is not finite, a quaternion is not of unit length, or
                |ω| ≥ 2/h.
        """
        for key, size in STATE_SIZES.items():
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


def _as_leaf(value: Array, like: Array) -> Array:
    return value.astype(like.dtype)
