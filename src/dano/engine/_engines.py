"""Engines: what makes the steps of a scene, and what it says of them.

`VariationalEngine` is a first-order variational integrator for rigid bodies in contact, with one implicit
solve a step. Unknowns of a step are the velocities at its end. Steps, and their derivatives by the implicit
function theorem, are kernels (`dano.engine.kernels`, docs/theory/step.md); here a scene becomes their tables.

What is not a number, or out of its range, is never simulated in silence. Where values are traced, nothing can
be refused: a NaN force of a controller, a negative mass on the way of a search. Steps that depend on such a
number turn their states into NaN, from the first such step on, and are marked as not converged with a
residual that is NaN.
"""

import abc
import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dano.checks import checked_count, checked_kind, checked_number
from dano.compiling import are_on_cpus, by_numpy_on_cpus
from dano.contact import CHUNK, PARAMETER_RANGES, Patch
from dano.engine import launching
from dano.engine.launching import Report, SolverOptions
from dano.fields import AbstractShape, PosedShape
from dano.maths import AnyArray, by_numpy, is_traced, library, safe_normalize
from dano.native import kind_numbers, n_cores
from dano.scene import Control, lifted, Scene, State

_LARGEST = float(np.finfo(np.float32).max)


class AbstractEngine(eqx.Module):
    """Advances the state of a scene."""

    def prepare(self, scene: Scene) -> Any:
        """What the steps of a scene share, computed once a rollout; passed to `step`."""
        return None

    def prepares_by_numpy(self, scene: Scene) -> bool:
        """Whether `prepare` computes by NumPy, and is called outside of a program."""
        return False

    @abc.abstractmethod
    def step(
        self, scene: Scene, prepared: Any, state: State, control: Control | None
    ) -> tuple[State, Report]:
        """One timestep; the report says whether the step's equations were solved."""

    def enlarged(self, scene: Scene, factor: int) -> "AbstractEngine | None":
        """The engine with `factor` times the contact capacity that it chose; None if it was given."""
        return None

    def rollout(
        self, scene: Scene, prepared: Any, state: State, controls: Control | None, n_steps: int
    ) -> tuple[State, Report] | None:
        """Many timesteps at once; arrays with a leading axis of steps. None: `step` makes each of them."""
        return None

    def touch(self, scene: Scene, prepared: Any, state: State) -> Patch:
        """Overlap of every pair that may touch at a state, arrays in the order of `scene.pairs`.

        Raises:
            ValueError: If the engine does not say.
        """
        raise ValueError(f"engine must say where bodies touch, got {type(self).__name__}, which does not")

    def wrenches(
        self, scene: Scene, prepared: Any, before: State, after: State, about: Float[Array, "contacts 3"]
    ) -> Float[Array, "contacts 6"]:
        """Force [N] and torque about points [N m] on the first body of every pair [W] during a step.

        Raises:
            ValueError: If the engine does not say.
        """
        raise ValueError(f"engine must say contact forces, got {type(self).__name__}, which does not")


class VariationalEngine(AbstractEngine):
    """The variational integrator with an implicit solve per step."""

    # A step is solved when no component of its residual, divided by mass or inertia, exceeds this times (1 +
    # its largest velocity) [m/s, rad/s]; default: the dtype's resolution to the power 3/4 (2e-12, 6e-6).
    tolerance: float | None = eqx.field(static=True, default=None)
    # Newton and line search passes after which a step is reported as not converged.
    max_iterations: int = eqx.field(static=True, default=500)
    # Chunks of 16 point contacts that a step has room for. A step with more is reported as not converged.
    # Default: by the bodies; and where `dano.step` and `dano.simulate` find more, they compile and run again
    # with room for all (outside of `jax.jit`).
    capacity: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        """Raise a ValueError unless both options are positive."""
        if self.tolerance is not None:
            checked_number("tolerance", self.tolerance, above=0)
        checked_count("max_iterations", self.max_iterations)
        if self.capacity is not None:
            checked_count("capacity", self.capacity)

    def prepare(self, scene: Scene) -> "Prepared":
        """See `AbstractEngine.prepare`.

        Raises:
            ValueError: If the scene has a law or a shape that kernels do not know.
        """
        made = _prepared_by_numpy if self.prepares_by_numpy(scene) else _prepared
        return made(scene, self.capacity)

    def prepares_by_numpy(self, scene: Scene) -> bool:
        """See `AbstractEngine.prepares_by_numpy`: where nothing is traced, or on a GPU.

        Then no program depends on how many bodies there are. Contacts with a patch law are left to JAX.
        """
        arrays = jax.tree.leaves(scene)
        known = not is_traced(arrays) and are_on_cpus(arrays)
        return known and all(contact.law.presses for contact in scene.contacts)

    def enlarged(self, scene: Scene, factor: int) -> "VariationalEngine | None":
        """See `AbstractEngine.enlarged`."""
        if self.capacity is not None or scene.room is None:
            return None
        return VariationalEngine(self.tolerance, self.max_iterations, factor * scene.room)

    def step(
        self, scene: Scene, prepared: "Prepared", state: State, control: Control | None
    ) -> tuple[State, Report]:
        """See `AbstractEngine.step`."""
        controls = None if control is None else jax.tree.map(lambda x: x[None], control)
        return jax.tree.map(lambda x: x[0], self.rollout(scene, prepared, state, controls, 1))

    def rollout(
        self, scene: Scene, prepared: "Prepared", state: State, controls: Control | None, n_steps: int
    ) -> tuple[State, Report]:
        """See `AbstractEngine.rollout`: all steps in one launch."""
        if not scene.layout.moving:
            none = jnp.zeros(n_steps, state.position.dtype)
            still = jax.tree.map(lambda x: jnp.broadcast_to(x, (n_steps, *x.shape)), state)
            return still, Report(none, none.astype(int), none == 0, none > 0)
        controls = lifted(scene, controls, n_steps)
        options = SolverOptions(self.tolerance, self.max_iterations)
        found = launching.rollout(prepared.tables, state, controls, n_steps, prepared.capacity, options)
        return marked(prepared.sound, state, controls, *found)

    def touch(self, scene: Scene, prepared: "Prepared", state: State) -> Patch:
        """See `AbstractEngine.touch`.

        Overlap of a pair with a point law is the volume Σ A d [m³].
        """
        still = dataclasses.replace(state, velocity=0 * state.velocity, omega=0 * state.omega)
        if state.v is not None:
            still = dataclasses.replace(still, v=0 * state.v)
        rows = launching.overlaps(prepared.tables, still, prepared.capacity)
        pair, sign, _ = _places(scene, prepared.tables)
        sums, moments, directions = jnp.split(rows, (1, 4), axis=1)
        directions = jnp.asarray(sign, rows.dtype)[:, None] * directions
        total, moment, direction = (
            jax.ops.segment_sum(x, pair, len(scene.pairs)) for x in (sums, moments, directions)
        )
        centroid = moment / jnp.where(total > 0, total, 1)
        return jax.vmap(lambda *x: Patch(x[0], x[1], safe_normalize(x[2])))(total[:, 0], centroid, direction)

    def wrenches(
        self,
        scene: Scene,
        prepared: "Prepared",
        before: State,
        after: State,
        about: Float[Array, "contacts 3"],
    ) -> Float[Array, "contacts 6"]:
        """See `AbstractEngine.wrenches`: geometry is that of the start, velocities are those of the end."""
        rows = launching.wrenches(prepared.tables, before, after, prepared.capacity)
        pair, sign, first = _places(scene, prepared.tables)
        arm = before.position[first] - about[pair]
        shifted = jnp.concatenate([rows[:, :3], rows[:, 3:] + jnp.cross(arm, rows[:, :3])], axis=1)
        return jax.ops.segment_sum(jnp.asarray(sign, rows.dtype)[:, None] * shifted, pair, len(scene.pairs))


def checked_engine(engine: AbstractEngine | None) -> AbstractEngine:
    """An engine; None stands for `VariationalEngine()`.

    Raises:
        ValueError: If it is not an engine.
    """
    return VariationalEngine() if engine is None else checked_kind("engine", engine, AbstractEngine)


class Prepared(eqx.Module):
    """What does not change from step to step: see `VariationalEngine.prepare`."""

    tables: launching.Tables  # Of the scene
    sound: Bool[AnyArray, ""]  # Whether the numbers of the scene are in their ranges
    capacity: int = eqx.field(static=True)  # Chunks of points that a step has room for (static)


def _prepared(scene: Scene, capacity: int | None) -> Prepared:
    """Tables for the steps of a scene, with room for so many chunks of points; None chooses by the bodies."""
    if not len(scene.point_pairs):
        capacity = 0
    elif capacity is None:
        capacity = scene.room
    if capacity is None:
        # Room for all samples, where it is not known how many can touch at once.
        sampled = [body.surface.points.shape[1] for body in scene.bodies if body.surface is not None]
        capacity = -(-sum(sampled) // CHUNK)
    return Prepared(launching.scene_tables(scene), sound(scene), capacity)


_prepared_by_numpy = by_numpy(_prepared)


def _places(
    scene: Scene, tables: launching.Tables
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Of each row of what kernels see: its place in `scene.pairs`, its sign, and its first body.

    The sign is 1 where the first body is that of the pair, else −1.
    """
    presses = np.array([c.law.presses for c in scene.contacts], bool)
    listed = np.arange(len(scene.contacts))
    of_points = [*listed[presses], *range(len(scene.contacts), len(scene.pairs))]
    of_patches = listed[~presses]
    index = tables.whole.arrays["scene.pair_index"]
    n_points = len(index) - len(of_patches)
    pair = np.array([*np.array(of_points, int)[index[:n_points, 4]], *of_patches], int)
    first = np.array([scene.index(a) for a, _ in scene.pairs], int)[pair]
    return pair, np.where(index[:, 0] == first, 1, -1), index[:, 0]


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


def runs_on(scene: Scene) -> str:
    """What the steps of a scene run on: device, precision, and what its kernels are built for.

    Args:
        scene: The scene.

    Raises:
        ValueError: If the scene has a law or a shape that kernels do not know.
    """
    checked_kind("scene", scene, Scene)
    built = dict(launching.scene_tables(scene).features.values)
    parts = []
    if scene.contacts or scene.others is not None:
        own = f" with {built['LAW']}" if built.get("LAW") else ""
        laws = {"points" + own: len(scene.point_pairs) > 0, "patches": built["PATCHES"]}
        names = {number: name.lower().replace("_", " ") for name, number in kind_numbers().items()}
        solids = ", ".join(sorted(names[kind] for kind in built["KINDS"] if kind in names))
        parts.append(f"contact of {' and '.join(law for law, used in laws.items() if used)} on {solids}")
    if scene.joints:
        parts.append("joints and loops" if scene.loops else "joints")
    device = jax.default_backend()
    where = f"CPU ({n_cores()} cores; a rollout takes one)" if device == "cpu" else device.upper()
    return f"{where}, {scene.timestep.dtype.name}; kernels for {'; '.join(parts) or 'free bodies'}"
