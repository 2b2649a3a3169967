"""From a scene and a task to a problem of optimal control.

Controls of the problem are shares of their bounds' half-widths, u = middle + width w, so that all are of
order one. Costs of rates are multiplied by the timestep: a plan is the same at half the step.

Softer contact and gradual friction, with which a plan is found more easily.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dano.checks import checked_number
from dano.contact import DistributedLaw
from dano.engine import AbstractEngine, difference, retract
from dano.planning._task import Goal, Limit, Task
from dano.scene import Scene, State
from dano.solvers import TrajectoryConstraint, TrajectoryProblem

_STIFF = ("stiffness", "spring", "damper")


def softened(scene: Scene, factor: float) -> Scene:
    """The scene with softer contacts: bodies sink deeper into each other, and forces change less abruptly.

    Args:
        scene: The scene.
        factor: What the stiffness (distributed law), or spring and damper (centroid law), is multiplied with.

    Raises:
        ValueError: If the factor is not positive.
    """
    checked_number("factor", factor, above=0)

    def params_of(scene: Scene) -> list:
        every = [contact.params for contact in _contacts(scene)]
        return [x for params in every for name in _STIFF if (x := getattr(params, name)) is not None]

    return eqx.tree_at(params_of, scene, [factor * x for x in params_of(scene)])


def gradual(scene: Scene, slip: float) -> Scene:
    """The scene with friction that grows with the slip in derivatives; its motion is the same.

    What sticks does not move however one pushes, so that derivatives do not say where a stronger push leads.

    Args:
        scene: The scene.
        slip: v_g, see `DistributedLaw.gradual_stiction` [m/s]. Other laws stay as they are.

    Raises:
        ValueError: If the slip is not positive.
    """
    checked_number("slip", slip, above=0)

    def laws_of(scene: Scene) -> list:
        every = [contact.law for contact in _contacts(scene)]
        return [law.gradual_stiction for law in every if isinstance(law, DistributedLaw)]

    found = laws_of(scene)
    return eqx.tree_at(laws_of, scene, [jnp.full_like(x, slip) for x in found]) if found else scene


def _contacts(scene: Scene) -> list:
    """All that have parameters and a law: the contacts, and what lets other pairs touch."""
    return [*scene.contacts, *([] if scene.others is None else [scene.others])]


VIOLATION = 1e-3
"""The solver's violation of a goal that is missed by `Goal.within`."""


class Chart(eqx.Module):
    """Coordinates of changes of a state: those of `dano.linearize`."""

    scene: Scene

    @property
    def rows(self) -> np.ndarray:
        """Bodies that move freely."""
        return np.array(self.scene.layout.free, int)

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return 12 * len(self.rows) + 2 * self.scene.layout.n_joints


class Retract(Chart):
    """The state that a change leads to.

    Rows of bodies on joints stay: readers run forward kinematics themselves, because doing it here compiles
    slowly.
    """

    def __call__(self, state: State, change: Float[Array, " n"]) -> State:
        """See `TrajectoryProblem.retract`."""
        n, k = len(self.rows), self.scene.layout.n_joints
        of_bodies, q, v = jnp.split(change, [12 * n, 12 * n + k])
        moved = retract(state, self.rows, of_bodies.reshape(n, 12)) if n else state
        if moved.q is None or moved.v is None:
            return moved
        return dataclasses.replace(moved, q=moved.q + q, v=moved.v + v)


class Difference(Chart):
    """The change that leads from one state to another."""

    def __call__(self, nominal: State, state: State) -> Float[Array, " n"]:
        """See `TrajectoryProblem.difference`."""
        # Of the two quaternions of an orientation the nearer.
        near = jnp.sum(nominal.orientation * state.orientation, axis=1, keepdims=True) >= 0
        state = dataclasses.replace(state, orientation=jnp.where(near, state.orientation, -state.orientation))
        gone = difference(nominal, state, self.rows).ravel()
        if state.q is None or state.v is None or nominal.q is None or nominal.v is None:
            return gone
        return jnp.concatenate([gone, state.q - nominal.q, state.v - nominal.v])


class Scales(eqx.Module):
    """From controls of the problem to those of the task."""

    middle: Float[Array, " m"]
    width: Float[Array, " m"]

    @classmethod
    def of(cls, task: Task) -> "Scales":
        """Those of the task's bounds; symmetric where zero lies between them, so that zero stays zero."""
        lower, upper = task.bounds()
        spans = (lower <= 0) & (upper >= 0)
        middle = jnp.where(spans, 0.0, 0.5 * (lower + upper))
        return cls(middle, jnp.where(spans, jnp.maximum(-lower, upper), 0.5 * (upper - lower)))

    def physical(self, w: Float[Array, "*T m"]) -> Float[Array, "*T m"]:
        """U [N, N m]."""
        return jnp.broadcast_to(self.middle, w.shape) + jnp.broadcast_to(self.width, w.shape) * w

    def scaled(self, u: Float[Array, "*T m"]) -> Float[Array, "*T m"]:
        """W."""
        return (u - jnp.broadcast_to(self.middle, u.shape)) / jnp.broadcast_to(self.width, u.shape)


class Dynamics(eqx.Module):
    """A step of the task: `substeps` steps of the scene; after `remaining` of them nothing happens any more.

    So a plan with fewer steps left is the same program, and model-predictive control compiles once.
    """

    scene: Scene
    task: Task
    scales: Scales
    engine: AbstractEngine
    prepared: Any
    remaining: Int[Array, ""]
    substeps: int = eqx.field(static=True)

    def __call__(self, state: State, w: Float[Array, " m"], t: Int[Array, ""]) -> State:
        """See `TrajectoryProblem.dynamics`."""
        control = self.task.control(self.scene, self.scales.physical(w))

        def step(state):
            state = self.scene.filled(state) if self.scene.joints else state
            return self.engine.step(self.scene, self.prepared, state, control)[0]

        def steps(state):
            if self.substeps == 1:  # a loop of one step would take longer to compile
                return step(state)
            return jax.lax.scan(lambda state, _: (step(state), None), state, None, self.substeps)[0]

        return jax.lax.cond(t < self.remaining, steps, lambda state: state, state)


class StageCost(eqx.Module):
    """Costs of goals and controls during a step."""

    scene: Scene
    task: Task
    scales: Scales
    remaining: Int[Array, ""]
    substeps: int = eqx.field(static=True)

    def __call__(self, state: State, w: Float[Array, " m"], t: Int[Array, ""]) -> Float[Array, ""]:
        """See `TrajectoryProblem.stage_cost`."""
        return 0.5 * jnp.sum(self.residuals(state, w, t) ** 2)

    def residuals(self, state: State, w: Float[Array, " m"], t: Int[Array, ""]) -> Float[Array, " r"]:
        """See `TrajectoryProblem.stage_residuals`."""
        counts = (t < self.remaining).astype(w.dtype)
        terms = [jnp.sqrt(self.task.prices()) * self.scales.physical(w)]
        for goal in self.task.goals:
            terms.append(counts * jnp.sqrt(goal.running) * goal.error(self.scene, state))
        return jnp.sqrt(self.substeps * self.scene.timestep) * jnp.concatenate(terms)


class FinalCost(eqx.Module):
    """Costs of goals at the end."""

    scene: Scene
    task: Task

    def __call__(self, state: State) -> Float[Array, ""]:
        """See `TrajectoryProblem.final_cost`."""
        return 0.5 * jnp.sum(self.residuals(state) ** 2)

    def residuals(self, state: State) -> Float[Array, " r"]:
        """See `TrajectoryProblem.final_residuals`."""
        terms = [jnp.sqrt(goal.final) * goal.error(self.scene, state) for goal in self.task.goals]
        return jnp.concatenate([*terms, jnp.zeros(0, state.position.dtype)])


class Reached(eqx.Module):
    """A required goal as a constraint of the end."""

    scene: Scene
    goal: Goal

    def __call__(self, state: State) -> Float[Array, " p"]:
        """Its error, as `VIOLATION` says."""
        return self.goal.error(self.scene, state) * (VIOLATION / self.goal.within)


class KeptRollout(eqx.Module):
    """A limit as a constraint of every step."""

    scene: Scene
    limit: Limit

    def __call__(self, state: State, w: Float[Array, " m"], t: Int[Array, ""]) -> Float[Array, " p"]:
        """How far beyond it the state is."""
        return self.limit.excess(self.scene, state)


def problem_of(
    scene: Scene, task: Task, engine: AbstractEngine, remaining: int | None = None, substeps: int = 1
) -> TrajectoryProblem:
    """The problem of a scene and a task.

    Args:
        scene: The scene.
        task: The task.
        engine: What advances the scene.
        remaining: Steps of the task after which nothing happens any more; None: all count.
        substeps: Steps of the scene in a step of the task, during which controls are held.
    """
    left = jnp.asarray(task.n_steps if remaining is None else remaining)
    scales = Scales.of(task)
    prepared = eqx.filter_jit(engine.prepare)(scene)
    lower, upper = task.bounds()
    constraints = [
        TrajectoryConstraint(goal.name, Reached(scene, goal), True, True)
        for goal in task.goals
        if goal.required
    ]
    constraints += [TrajectoryConstraint(limit.name, KeptRollout(scene, limit)) for limit in task.limits]
    stage, final = StageCost(scene, task, scales, left, substeps), FinalCost(scene, task)
    return TrajectoryProblem(
        Dynamics(scene, task, scales, engine, prepared, left, substeps),
        stage,
        final,
        tuple(constraints),
        scales.scaled(lower),
        scales.scaled(upper),
        Retract(scene),
        Difference(scene),
        stage.residuals,
        final.residuals,
        parallel=False,
    )
