"""First-order variational integrator for rigid bodies in contact, one implicit solve a step.

Unknowns of a step are the velocities at its end. Steps, and their derivatives by the implicit function
theorem, are kernels (`dano.engine.kernels`, docs/theory/step.md); here a scene becomes their tables.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Bool

from dano.contact import AbstractPatchLaw, CHUNK, DistributedLaw
from dano.engine._compiling import are_on_cpus
from dano.engine._finite import marked, sound
from dano.engine._reports import Report, SolverOptions
from dano.engine.launching import rollout as launched, scene_tables, Tables
from dano.maths import AnyArray, by_numpy, is_traced
from dano.scene import Control, lifted, Scene, State


class Prepared(eqx.Module):
    """What does not change from step to step: see `prepare`."""

    tables: Tables  # Of the scene
    # Whether the numbers of the scene are in their ranges, see `dano.engine._finite`
    sound: Bool[AnyArray, ""]
    capacity: int = eqx.field(static=True)  # Chunks of points that a step has room for (static)


def is_by_numpy(scene: Scene) -> bool:
    """Whether `prepare` computes the tables of a scene by NumPy: where nothing is traced, or on a GPU.

    Then no program depends on how many bodies there are. Contacts with a patch law are left to JAX.
    """
    arrays = jax.tree.leaves(scene)
    known = not is_traced(arrays) and are_on_cpus(arrays)
    return known and all(contact.law.presses for contact in scene.contacts)


def prepare(scene: Scene, capacity: int | None) -> Prepared:
    """Tables for the steps of a scene.

    Args:
        scene: The scene.
        capacity: Chunks of point contacts that a step has room for; None chooses by the bodies.

    Raises:
        ValueError: If the scene has a law or a shape that kernels do not know.
    """
    _check_laws(scene)
    return _by_numpy(scene, capacity) if is_by_numpy(scene) else _tables(scene, capacity)


def _tables(scene: Scene, capacity: int | None) -> Prepared:
    if not len(scene.point_pairs):
        return Prepared(scene_tables(scene), sound(scene), 0)
    if capacity is None:
        capacity = scene.room
    if capacity is None:
        # Room for all samples, where it is not known how many can touch at once.
        sampled = [body.surface.points.shape[1] for body in scene.bodies if body.surface is not None]
        capacity = -(-sum(sampled) // CHUNK)
    return Prepared(scene_tables(scene), sound(scene), capacity)


_by_numpy = by_numpy(_tables)


def _check_laws(scene: Scene) -> None:
    """Check that a step can turn each contact of a scene into forces.

    Raises:
        ValueError: If a contact has a law that is neither `DistributedLaw` nor one of a patch.
    """
    for contact in scene.contacts:
        law = contact.law
        if type(law) is not DistributedLaw and not isinstance(law, AbstractPatchLaw):
            raise ValueError(
                f"law of contact ({contact.a!r}, {contact.b!r}) must be a DistributedLaw, a CentroidLaw or "
                f"another AbstractPatchLaw, got {type(law).__name__}, which no step would ask for forces"
            )


def step(
    scene: Scene, prepared: Prepared, state: State, control: Control | None, options: SolverOptions
) -> tuple[State, Report]:
    """Advance all bodies by one timestep. See `dano.step`."""
    controls = None if control is None else jax.tree.map(lambda x: x[None], control)
    return jax.tree.map(lambda x: x[0], rollout(scene, prepared, state, controls, 1, options))


def rollout(
    scene: Scene,
    prepared: Prepared,
    state: State,
    controls: Control | None,
    n_steps: int,
    options: SolverOptions,
) -> tuple[State, Report]:
    """States at the ends of steps, and their reports, in one launch."""
    if not scene.layout.moving:
        none = jnp.zeros(n_steps, state.position.dtype)
        still = jax.tree.map(lambda x: jnp.broadcast_to(x, (n_steps, *x.shape)), state)
        return still, Report(none, none.astype(int), none == 0, none > 0)
    controls = lifted(scene, controls, n_steps)
    found = launched(prepared.tables, state, controls, n_steps, prepared.capacity, options)
    return marked(prepared.sound, state, controls, *found)
