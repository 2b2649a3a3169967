"""What is not a number, or out of its range, is never simulated in silence.

Where values are traced, nothing can be refused: a NaN force of a controller, a negative mass on the way of a
search. Steps that depend on such a number turn their states into NaN, from the first such step on, and are
marked as not converged with a residual that is NaN.
"""

from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool

from dano.contact import PARAMETER_RANGES
from dano.engine._compiling import by_numpy_on_cpus
from dano.engine._reports import Report
from dano.fields import AbstractShape, PosedShape
from dano.maths import AnyArray, is_traced, library
from dano.scene import Control, Scene, State

_LARGEST = float(np.finfo(np.float32).max)


class _Numbers(NamedTuple):
    """Numbers of a scene with one range."""

    what: str  # What they are, for messages
    values: list[AnyArray]  # The numbers
    least: float = -_LARGEST  # They are not smaller, or, where it is zero and `divides`, larger
    most: float = _LARGEST  # They are not larger
    divides: bool = False  # Whether zero is out of range


def sound(scene: Scene) -> Bool[AnyArray, ""]:
    """Whether every number of a scene is finite, and in the range that `Scene.create` asks for."""
    held = [_holds(each).all() for each in _numbers(scene)]
    xp = library(*held)
    return xp.all(xp.stack(held))


def unsound(scene: Scene) -> str | None:
    """What is not finite, or out of its range; None where nothing is, or where values are traced."""
    for each in _numbers(scene):
        if not is_traced(each.values) and not bool(_holds(each).all()):
            values = np.concatenate([np.ravel(x) for x in each.values])
            bad = values[~np.asarray(_holds(each))]
            return f"{each.what} must be finite{_range(each)}, got {bad[0]:.4g}"
    return None


def _range(each: _Numbers) -> str:
    if each.least != 0:
        return ""
    return " and > 0" if each.divides else " and in [0, 1]" if each.most == 1 else " and ≥ 0"


def _holds(each: _Numbers) -> Bool[AnyArray, " n"]:
    # Comparisons with NaN are false.
    values = library(*each.values).concatenate([x.reshape(-1) for x in each.values])
    large_enough = values > each.least if each.divides else values >= each.least
    return large_enough & (values <= each.most)


def _numbers(scene: Scene) -> Iterator[_Numbers]:
    """The numbers of a scene by kind: few operations, however many bodies there are."""
    moving = [body for body in scene.bodies if not body.fixed]
    yield _Numbers("timestep", [scene.timestep], least=0.0, divides=True)
    yield _Numbers("gravity", [scene.gravity])
    if moving:
        masses = [x for body in moving for x in (body.mass, body.mass_scale)]
        yield _Numbers("mass and mass_scale of bodies", masses, least=0.0, divides=True)
        diagonal = [body.inertia.diagonal() for body in moving]
        yield _Numbers("principal inertia of bodies", diagonal, least=0.0, divides=True)
        yield _Numbers("inertia of bodies", [body.inertia for body in moving])
    places = [x for body in scene.bodies for x in (body.com, body.com_offset)]
    yield _Numbers("centre of mass of bodies", places)
    if held := [body.gravcomp for body in moving if body.gravcomp is not None]:
        yield _Numbers("gravcomp of bodies", held)
    if sizes := [x for body in scene.bodies if body.shape is not None for x in _sizes(body.shape)]:
        yield _Numbers("size of shapes", sizes, least=0.0)
    yield from _of_contacts(scene)
    yield from _of_joints(scene)


def _sizes(shape: AbstractShape) -> list[AnyArray]:
    """Lengths that a shape is made from."""
    while isinstance(shape, PosedShape):
        shape = shape.shape
    names = [name for name in getattr(shape, "takes", ()) if name not in ("normal", "offset")]
    return [getattr(shape, name) for name in names]


def _of_contacts(scene: Scene) -> Iterator[_Numbers]:
    given = [contact.params for contact in scene.contacts]
    if scene.others is not None:
        given.append(scene.others.params)
    for name, (least, most, divides) in PARAMETER_RANGES.items():
        values = [x for params in given if (x := getattr(params, name)) is not None]
        if values:
            yield _Numbers(f"{name} of contacts", values, least, most, divides)
    laws = [jax.tree.leaves(eqx.filter(contact.law, eqx.is_inexact_array)) for contact in scene.contacts]
    if leaves := [x for law in laws for x in law]:
        yield _Numbers("numbers of contact laws", leaves)


def _of_joints(scene: Scene) -> Iterator[_Numbers]:
    joints = scene.joints
    if not joints:
        return
    for name in ("damping", "friction", "armature", "stiffness"):
        values = [x for joint in joints if (x := getattr(joint, name)) is not None]
        if values:
            yield _Numbers(f"{name} of joints", values, least=0.0)
    names = ("axis", "anchor", "position", "orientation", "rest", "ratio", "shift")
    yield _Numbers("numbers of joints", [getattr(joint, name) for joint in joints for name in names])
    if motors := [joint.motor for joint in joints if joint.motor is not None]:
        yield _Numbers("gear of motors", [motor.gear for motor in motors])
        gains = [x for motor in motors for x in (motor.stiffness, motor.damping)]
        yield _Numbers("stiffness and damping of motors", gains, least=0.0)
    ends = [joint.limits for joint in joints if joint.limits is not None]
    ends += [motor.limits for motor in motors]
    if ends:
        # Either may be infinite: those of NaN, or that are crossed, have no difference ≥ 0.
        yield _Numbers("upper minus lower limit", [x[1] - x[0] for x in ends], least=0.0, most=np.inf)
    if scene.loops:
        held = [x for loop in scene.loops for x in (loop.position, loop.anchor, loop.orientation)]
        yield _Numbers("numbers of loops", held)


@by_numpy_on_cpus
def marked(
    holds: Bool[AnyArray, ""], state: State, controls: Control | None, states: State, report: Report
) -> tuple[State, Report]:
    """States and reports of steps, marked from the first on that depends on what is not finite.

    Args:
        holds: `sound` of the scene.
        state: Where the steps began.
        controls: Of the steps, or None.
        states: At their ends, with a leading axis.
        report: Of the steps, with a leading axis.
    """
    xp = library(*jax.tree.leaves((holds, state, controls, states, report)))
    # A sum is finite only where all of its parts are: half of the operations, and XLA on a CPU computes
    # programs of less than 1,000 of them in the thread that asks, at once.
    known = sum(xp.sum(x) for x in jax.tree.leaves(state))
    rows = [*jax.tree.leaves(states), *jax.tree.leaves(controls)]
    fine = xp.isfinite(sum(xp.sum(x.reshape(x.shape[0], -1), axis=1) for x in rows))
    each = holds & xp.isfinite(known) & (xp.cumsum(~fine) == 0)
    # A factor, so that derivatives are lost with the states.
    factor = xp.where(each, 1.0, xp.nan)
    lost = jax.tree.map(lambda x: x * factor.astype(x.dtype).reshape(-1, *(1,) * (x.ndim - 1)), states)
    residual = report.residual * factor.astype(report.residual.dtype)
    return lost, report._replace(residual=residual, converged=report.converged & each)
