"""States and controls from numbers that are given by the names of bodies."""

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from dano.checks import shown
from dano.maths import (
    by_numpy,
    checked_array,
    checked_quaternion,
    library,
    Numbers,
    Q,
    quat_conjugate,
    quat_rotate,
    stacked,
)
from dano.scene._bodies import Body, check_once
from dano.scene._joints import Joint, StateLayout
from dano.scene._states import JOINT_QUANTITIES, STATE_SIZES

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
