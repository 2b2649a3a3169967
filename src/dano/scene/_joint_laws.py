"""What acts on joint coordinates, as arrays over them: springs, friction, limits, motors."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from dano.maths import AnyArray, library, with_rows
from dano.scene._joints import Joint, Layout


class JointLaws(eqx.Module):
    """What acts on the k coordinates q of a scene. What no joint has is None.

    Damping, friction and armature of a joint that mimics another act on the coordinate of that one, by its
    ratio; those of a ball or a planar joint on each of its coordinates alike.

    Attributes:
        damping: [N m s/rad or N s/m], shape (k,).
        armature: [kg m² or kg].
        stiffness: Of springs [N m/rad or N/m].
        rest: Where they exert no force [rad or m].
        friction: [N m or N].
        limits: Least and largest q [rad or m], shape (k, 2).
        motor: Gear, stiffness and damping of motors, and their least and largest effort, see `Motor`;
            gear 0 where there is none. Shape (k, 5).
        constant: Whether a motor gives what it is told to, whatever the joint does (static).
        rough: Coordinates with limits, friction, or a motor that heeds the joint (static).
    """

    damping: Float[AnyArray, " k"]
    armature: Float[AnyArray, " k"] | None
    stiffness: Float[AnyArray, " k"] | None
    rest: Float[AnyArray, " k"]
    friction: Float[AnyArray, " k"] | None
    limits: Float[AnyArray, "k 2"] | None
    motor: Float[AnyArray, "k 5"] | None
    constant: tuple[bool, ...] = eqx.field(static=True)
    rough: tuple[int, ...] = eqx.field(static=True)


def joint_laws(layout: Layout, joints: Sequence[Joint], dtype) -> JointLaws:
    """The laws of the joints of a scene."""
    owners, xp = [joints[j] for j in layout.with_coordinates], library(*jax.tree.leaves(joints))

    def summed(name: str, power: Callable[[Any], Any]) -> Float[AnyArray, " k"]:
        values = xp.zeros(layout.n_joints, dtype)
        for j, _, place in layout.dofs:
            value = getattr(joints[j], name)
            if value is not None:
                share = power(joints[j].ratio) if layout.follows[j] else 1
                values = with_rows(values, place, values[place] + xp.asarray(share * value, dtype))
        return values

    def of_some(name: str, power: Callable[[Any], Any]) -> Float[AnyArray, " k"] | None:
        return summed(name, power) if any(getattr(joint, name) is not None for joint in joints) else None

    def column(values: list[Any]) -> Any:
        return xp.stack([x.astype(dtype) for x in values]) if values else xp.zeros(0, dtype)

    limits = motor = None
    if any(joint.limits is not None for joint in owners):
        free = np.array([-np.inf, np.inf])
        limits = column([free if joint.limits is None else joint.limits for joint in owners])
    if any(joint.motor is not None for joint in owners):
        motor = column([_motor(joint) for joint in owners])
    constant = tuple(joint.motor is not None and joint.motor.kind == "effort" for joint in owners)
    heeds = [joint.motor is not None and joint.motor.kind != "effort" for joint in owners]
    rubs = {place for j, _, place in layout.dofs if joints[j].friction is not None}
    rough = tuple(
        place
        for place, joint in enumerate(owners)
        if joint.limits is not None or place in rubs or heeds[place]
    )
    springs = of_some("stiffness", lambda ratio: ratio)
    return JointLaws(
        summed("damping", xp.square),
        of_some("armature", xp.square),
        springs,
        column([joint.rest for joint in owners]),
        of_some("friction", xp.abs),
        limits,
        motor,
        constant,
        rough,
    )


def _motor(joint: Joint) -> AnyArray:
    motor = joint.motor
    if motor is None:
        return np.array([0.0, 0.0, 0.0, -np.inf, np.inf])
    xp = library(*jax.tree.leaves(motor))
    stiffness = motor.stiffness if motor.kind == "position" else xp.zeros_like(motor.stiffness)
    damping = motor.damping if motor.kind != "effort" else xp.zeros_like(motor.damping)
    return xp.concatenate([xp.stack([motor.gear, stiffness, damping]), motor.limits])
