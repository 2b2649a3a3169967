"""What users give of scenes, states and controls: checked, and made into arrays; what steps have room for."""

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from dano.checks import shown
from dano.contact import CHUNK, ContactParams
from dano.maths import (
    by_numpy,
    checked_array,
    checked_quaternion,
    is_traced,
    library,
    Numbers,
    Q,
    quat_conjugate,
    quat_rotate,
    stacked,
)
from dano.names import did_you_mean
from dano.physics.trees.sizes import CLOSES
from dano.scene._bodies import Body, check_once, sizes_of
from dano.scene._contacts import Contact
from dano.scene._joints import Joint, layout_of, StateLayout
from dano.scene._states import JOINT_QUANTITIES, STATE_SIZES

# Share of the smallest body's size by which gravity may move it in a step before a warning says so, and the
# share that the warning asks for.
LONGEST_FALL, SHORT_FALL = 0.5, 0.05
# How far beyond a limit a joint may be that stopped there, for rounding [rad or m].
_TOUCHED = 1e-6
# Room for what a body touches besides the floor that it lies on, and for chunks that are not full.
CHUNKS_A_BODY = 24


def check_names(bodies: Sequence[Body]) -> None:
    """Check that there are bodies, with different names.

    Raises:
        ValueError: If not.
    """
    if not bodies:
        raise ValueError("bodies must hold at least one body, got none")
    for name, count in Counter(body.name for body in bodies).items():
        if count > 1:
            raise ValueError(f"bodies must have different names, got {name!r} {count} times")


def check_contacts(bodies: Sequence[Body], joints: Sequence[Joint], contacts: Sequence[Contact]) -> None:
    """Check that contacts name bodies of the scene, each pair once, that can move against each other.

    Raises:
        ValueError: If not, or if the joints make no trees.
    """
    names = [body.name for body in bodies]
    layout = layout_of(bodies, joints)
    seen: set[frozenset[str]] = set()
    for contact in contacts:
        for name in (contact.a, contact.b):
            if name not in names:
                raise ValueError(
                    f"contact must name bodies of the scene {names}, got {name!r}" + did_you_mean(name, names)
                )
        pair = frozenset((contact.a, contact.b))
        if pair in seen:
            raise ValueError(f"contacts must join each pair once, got ({contact.a!r}, {contact.b!r}) twice")
        seen.add(pair)
        _check_apart(layout, names, contact)


def twins_of(bodies: Sequence[Body]) -> tuple[int, ...]:
    """For each body the first that is made of the same object, see `Scene.twins`."""
    first: dict[int, int] = {}
    return tuple(
        i if body.object is None else first.setdefault(id(body.object), i) for i, body in enumerate(bodies)
    )


def sampled_alike(bodies: Sequence[Body], twins: Sequence[int]) -> tuple[int, ...]:
    """For each body the first with the same samples, see `Scene.sampled`."""
    first: dict[int, int] = {}
    return tuple(
        twins[i]
        if body.object is not None or body.surface is None
        else first.setdefault(id(body.surface.points), i)
        for i, body in enumerate(bodies)
    )


def check_materials(
    bodies: Sequence[Body], others: ContactParams | None, apart: Sequence[tuple[str, str]]
) -> None:
    """Check that nothing is given that only `others` reads.

    Raises:
        ValueError: If there is.
    """
    if others is not None:
        return
    if apart:
        raise ValueError(f"apart must be empty where contacts are listed and others=None, got {list(apart)}")
    for body in bodies:
        if body.material is not None:
            raise ValueError(
                f"material of body {body.name!r} is only used between bodies that no contact names: "
                "give others=ContactParams(…), too"
            )


def warn_of_long_steps(
    bodies: Sequence[Body], timestep: Float[Array, ""], gravity: Float[Array, "3"]
) -> None:
    """Warn if gravity alone moves the smallest body by a good part of its size in a step."""
    if is_traced(timestep, gravity, [body.extent for body in bodies]):
        return
    free = [body for body in bodies if not body.fixed]
    sizes = [(size, body.name) for size, body in zip(sizes_of(free).tolist(), free, strict=True)]
    h, strength = float(timestep), float(np.linalg.norm(np.asarray(gravity)))
    if not sizes or h * h * strength <= LONGEST_FALL * min(sizes)[0]:
        return
    size, name = min(sizes)
    warnings.warn(
        f"timestep {h:.3g} s is long: gravity moves bodies by {h * h * strength:.3g} m in a step, and "
        f"{name!r} is {size:.3g} m large; take at most {(SHORT_FALL * size / strength) ** 0.5:.2g} s",
        RuntimeWarning,
        stacklevel=3,
    )


def warn_of_limits(
    layout: StateLayout,
    joints: Sequence[Joint],
    q: Float[Array, " k"] | None,
    timestep: Float[Array, ""],
    names: Mapping[str, str],
) -> None:
    """Warn if joints are beyond their limits, which take them back at a speed of their own.

    Args:
        layout: Of the scene.
        joints: Of the scene.
        q: Coordinates [rad or m].
        timestep: [s].
        names: Of joints, by the bodies that hang on them; for messages.
    """
    if q is None or is_traced(q, timestep, joints):
        return
    found = []
    for place, j in enumerate(layout.with_coordinates):
        limits = joints[j].limits
        if limits is None:
            continue
        at, (least, most) = float(q[place]), np.asarray(limits).tolist()
        beyond = max(least - at, at - most)
        if beyond > _TOUCHED * max(1.0, abs(at)):
            name = names.get(joints[j].child, joints[j].child)
            unit = "m" if joints[j].kind == "slide" else "rad"
            found.append((beyond, name, at, least, most, unit))
    if not found:
        return
    beyond, name, at, least, most, unit = max(found)
    more = f" (and {len(found) - 1} other joints)" if len(found) > 1 else ""
    warnings.warn(
        f"joint {name!r} starts at {at:.4g} {unit}, beyond its limits {least:.4g} to {most:.4g}{more}:"
        f" they take it back at {min(beyond / float(timestep), CLOSES):.3g} {unit}/s",
        RuntimeWarning,
        stacklevel=4,
    )


def room_for(bodies: Sequence[Body], timestep: Float[Array, ""], gravity: Float[Array, "3"]) -> int | None:
    """Chunks of point contacts for bodies that lie as flat as they can; None where something is traced."""
    pressing = [body for body in bodies if not body.fixed and body.surface is not None]
    if is_traced([body.surface for body in pressing], [body.scale for body in pressing], timestep, gravity):
        return None
    margin = 2 * float(timestep) ** 2 * float(np.linalg.norm(np.asarray(gravity)))
    n_moving = sum(not body.fixed for body in bodies)
    flat = [-(-body.most_touching(margin) // CHUNK) for body in pressing if body.object is not None]
    return CHUNKS_A_BODY * n_moving + sum(flat)


def _check_apart(layout: StateLayout, names: list[str], contact: Contact) -> None:
    """Check that joints let the bodies of a contact move against each other.

    Raises:
        ValueError: If they are welded together.
    """
    a, b = names.index(contact.a), names.index(contact.b)
    same_root = layout.roots[a] == layout.roots[b]
    hang = {a, b} <= {*layout.children, *layout.free}
    if layout.children and same_root and hang and layout.moved_by[a] == layout.moved_by[b]:
        raise ValueError(
            f"contact must join bodies that can move against each other, got {contact.a!r} and "
            f"{contact.b!r}, which are welded together"
        )


ByName = Mapping[str, Mapping[str, Numbers]]
"""Numbers by quantity, by the name of a body."""

_AT_REST: dict[str, Numbers] = {
    "position": (0.0,) * 3,
    "orientation": (1.0, 0.0, 0.0, 0.0),
    "velocity": (0.0,) * 3,
    "omega": (0.0,) * 3,
}
_INSTEAD = {"origin": "position", "spin_world": "omega"}
"""In place of a quantity: the origin of the field frame; the angular velocity in world axes."""


def merged(what: str, first: ByName | None, named: ByName) -> ByName:
    """Bodies of a mapping and bodies given by keyword.

    Raises:
        ValueError: If `first` is not a mapping, or a body is given twice.
    """
    if first is None:
        return named
    if not isinstance(first, Mapping):
        raise ValueError(f"{what} must be dicts by names of bodies, got {shown(first)}")
    twice = sorted(set(first) & set(named))
    if twice:
        raise ValueError(f"{what} of {twice[0]!r} is given twice")
    return {**first, **named}


def started(bodies: Sequence[Body], given: ByName) -> ByName:
    """What a state is given by, filled up with what bodies say of their own start."""
    found = dict(given)
    for body in bodies:
        if not body.start:
            continue
        own = dict(body.start)
        told = _numbers("state", body.name, given)
        for pair in _INSTEAD.items():
            if set(pair) & set(told):
                own = {key: value for key, value in own.items() if key not in pair}
        found[body.name] = {**own, **told}
    return found


def state_arrays(
    bodies: Sequence[Body], layout: StateLayout, given: ByName, dtype: DTypeLike
) -> dict[str, Float[Array, "n _"]]:
    """Rows of all bodies, by quantity; those that are not given rest at the origin.

    Raises:
        ValueError: If a quantity is unknown, a shape is wrong, a number is not finite, or a quaternion is
            zero.
    """
    rows: dict[str, list[Array]] = {key: [] for key in STATE_SIZES}
    for i, body in enumerate(bodies):
        numbers = _numbers("state", body.name, given)
        valid = _state_keys(layout, i)
        for key in numbers:
            if key not in valid:
                why = "" if layout.joint_of(i) is None else ", for it hangs on a joint"
                raise ValueError(f"state of {body.name!r} must be given by {valid}{why}, got {key!r}")
        check_once(f"state of {body.name!r}", numbers)
        row = {}
        for key, size in STATE_SIZES.items():
            label, value = f"{key} of {body.name!r}", numbers.get(key, _AT_REST[key])
            check = checked_quaternion(label, value) if size == 4 else checked_array(label, value, (3,))
            row[key] = check.astype(dtype)
        if "origin" in numbers:
            origin = checked_array(f"origin of {body.name!r}", numbers["origin"], (3,)).astype(dtype)
            row["position"] = _centre(origin, row["orientation"], body.com, body.com_offset)
        if "spin_world" in numbers:
            spin = checked_array(f"spin_world of {body.name!r}", numbers["spin_world"], (3,)).astype(dtype)
            row["omega"] = _in_body(spin, row["orientation"])
        for key, value in row.items():
            rows[key].append(value)
    return {key: stacked(values) for key, values in rows.items()}


@by_numpy
def _centre(origin: Q, orientation: Q, com: Q, offset: Q) -> Q:
    """Where the centre of mass is of a body whose field frame has an origin [m, W]."""
    return origin + quat_rotate(orientation, (com + offset).astype(origin.dtype))


@by_numpy
def _in_body(spin: Q, orientation: Q) -> Q:
    """An angular velocity in world axes, in the body's."""
    return quat_rotate(quat_conjugate(orientation), spin)


def control_arrays(
    bodies: Sequence[Body], joints: Sequence[Joint], layout: StateLayout, given: ByName, dtype: DTypeLike
) -> dict[str, Float[Array, "n 3"]]:
    """Forces and torques of all bodies, zero by default.

    Raises:
        ValueError: If a quantity is unknown or a shape is wrong.
    """
    rows: dict[str, list[Array]] = {"force": [], "torque": []}
    for i, body in enumerate(bodies):
        numbers = _numbers("control", body.name, given)
        joint = layout.joint_of(i)
        driven = joint is not None and layout.width(joint) > 0
        valid = [*rows, *(["effort"] if driven else [])]
        if joint is not None and joints[joint].motor is not None:
            valid.append("command")
        for key in numbers:
            if key not in valid:
                raise ValueError(f"control of {body.name!r} must be given by {valid}, got {key!r}")
        for key, values in rows.items():
            value = checked_array(f"{key} of {body.name!r}", numbers.get(key, (0.0,) * 3), (3,))
            values.append(value.astype(dtype))
    return {key: stacked(values) for key, values in rows.items()}


def joint_arrays(
    joints: Sequence[Joint], given: ByName, keys: Sequence[str], dtype: DTypeLike
) -> dict[str, Float[Array, " k"]]:
    """Numbers of the joints that have coordinates, given by their bodies' names; zero by default.

    Raises:
        ValueError: If a shape is wrong.
    """
    names = [(joint.child, joint.width) for joint in joints if joint.width]

    def numbers(key: str, name: str, width: int) -> Array:
        shape = () if width == 1 else (width,)
        value = given.get(name, {}).get(key, 0.0 if width == 1 else (0.0,) * width)
        return checked_array(f"{key} of {name!r}", value, shape).astype(dtype)

    none = [jnp.zeros(0, dtype)]
    return {key: _joined([numbers(key, *name) for name in names] or none) for key in keys}


@by_numpy
def _joined(parts: Sequence[Float[Q, "..."]]) -> Float[Q, " k"]:
    return library(*parts).concatenate([x.reshape(-1) for x in parts])


def _numbers(what: str, name: str, given: ByName) -> Mapping[str, Numbers]:
    """What was given of a body, by quantity."""
    numbers = given.get(name, {})
    if not isinstance(numbers, Mapping):
        raise ValueError(f"{what} of {name!r} must be a dict such as dict(…=…), got {shown(numbers)}")
    return numbers


def _state_keys(layout: StateLayout, body: int) -> list[str]:
    """What the state of a body is given by."""
    joint = layout.joint_of(body)
    if joint is None:
        return [*STATE_SIZES, *_INSTEAD]
    return list(JOINT_QUANTITIES) if layout.width(joint) else []
