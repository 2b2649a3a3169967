"""The kernels of `dano.native` as functions of JAX arrays."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.contact import changes_of
from dano.engine._newton import levels_of, Report, SOFT_TOLERANCE, SolverOptions
from dano.engine._primal_dual import RULES
from dano.engine._trees import LARGEST_TURN
from dano.engine.joints import changing, STICKS, STOPS, TreeTables
from dano.scene import Control, State

POSES = 8.0
"""How many times the rounding of a pose a step's equations may miss, where the tolerance is its power 3/4."""


Step = tuple[TreeTables, State, Control | None, Float[Array, "p 7"]]
"""Of a step of bodies on joints: tables of the scene, state, control and patches."""


def native_tree_step(given: Step, options: SolverOptions) -> tuple[State, Report, Float[Array, " k"]]:
    """A step of bodies on joints: the state at its end, the report, and its generalised velocities."""
    from dano.native.trees import tree_step_name  # compiles or loads the kernel, so only where it is used

    tables, state, _, _ = given
    dtype = state.position.dtype
    arrays = _parts(state)
    *following, y, residual, passes, solved = jax.ffi.ffi_call(
        tree_step_name(dtype),
        (
            *(jax.ShapeDtypeStruct(x.shape, dtype) for x in arrays),
            jax.ShapeDtypeStruct((tables.layout.n_velocities,), dtype),
            jax.ShapeDtypeStruct((1,), dtype),
            jax.ShapeDtypeStruct((1,), jnp.int32),
            jax.ShapeDtypeStruct((1,), bool),
        ),
        vmap_method="sequential",
    )(
        *_tree_inputs(given, options),
        levels_of(tables.softens, options.max_iterations).astype(dtype),
        np.array([options.max_iterations], np.int32),
    )
    return State(*following), Report(residual[0], passes[0].astype(int), solved[0]), y


def native_tree_change(given: Step, tangents, y: Float[Array, " k"], options: SolverOptions) -> State:
    """How the end of a step of bodies on joints changes, by the implicit function theorem.

    Args:
        given: The step.
        tangents: Its changes; None where there is none.
        y: Generalised velocities at the end.
        options: Of the step.
    """
    from dano.native.trees import tree_slopes_name

    tables, state, control, _ = given
    of_tables, of_state, of_control, of_patches = tangents
    none = (None,) * 4
    changes = [
        *_parts(of_state),
        *(none if control is None else (getattr(of_control, name) for name in _CONTROLS)),
        *(getattr(of_tables, name) for name in _TABLES),
        of_patches,
    ]
    chosen = changing(tables, [x is not None for x in changes])
    dtype, parts = state.position.dtype, _parts(state)
    if not len(chosen):
        return State(*(jnp.zeros_like(x) for x in parts))
    k, size, count = tables.layout.n_velocities, sum(x.size for x in parts), sum(chosen[:, 3] >= 0)
    momenta, by_momentum, ends = jax.ffi.ffi_call(
        tree_slopes_name(dtype),
        tuple(jax.ShapeDtypeStruct(shape, dtype) for shape in ((len(chosen), k), (k, size), (count, size))),
        vmap_method="sequential",
    )(*_tree_inputs(given, options), y.astype(dtype), chosen)
    # Machine code reads and writes numbers of one type.
    changes = [None if x is None else x.astype(dtype) for x in changes]
    change = changes_of(changes, chosen[:, :3])
    moved = (change @ momenta) @ by_momentum + change[chosen[:, 3] >= 0] @ ends
    found = jnp.split(moved, np.cumsum([x.size for x in parts])[:-1])
    return State(*(end.reshape(x.shape) for end, x in zip(found, parts, strict=True)))


_CONTROLS = ("force", "torque", "effort", "command")
_TABLES = ("bodies", "joints", "laws", "settings", "contacts")


def _parts(state: State) -> tuple:
    return state.position, state.orientation, state.velocity, state.omega, state.q, state.v


def _tree_inputs(given: Step, options: SolverOptions) -> list:
    """What the kernels of trees read, in their order."""
    tables, state, control, patches = given
    assert state.q is not None and state.v is not None
    dtype = state.position.dtype
    epsilon = float(jnp.finfo(dtype).eps)
    relative = epsilon**0.75 if options.tolerance is None else options.tolerance
    none, nothing = np.zeros((0, 3), dtype), np.zeros(state.q.shape, dtype)
    force, torque = (none, none) if control is None else (control.force, control.torque)
    driven = (None, None) if control is None else (control.effort, control.command)
    effort, command = (nothing if x is None else x for x in driven)
    rules = [*RULES, relative, epsilon, POSES, STICKS, STOPS, LARGEST_TURN, SOFT_TOLERANCE]
    return [
        # Machine code reads numbers of one type.
        *(x.astype(dtype) for x in (*_parts(state), force, torque, effort, command)),
        tables.layout.nodes,
        tables.coordinates,
        *(getattr(tables, name).astype(dtype) for name in _TABLES),
        patches.astype(dtype),
        tables.pairs,
        np.array(rules, dtype),
    ]
