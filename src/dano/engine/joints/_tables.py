"""Trees as tables of numbers, in the order in which `dano.native` reads them."""

from collections.abc import Sequence
from typing import TypeGuard

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dano.contact import AbstractContactLaw, CentroidLaw, numbers_of, Patch
from dano.scene import JointLaws, Layout, Scene

# Tables of `changing` that say where bodies are: position, orientation, q, bodies, joints, settings.
_PLACING = (0, 1, 4, 10, 11, 13)
CONTACT = 11
"""Numbers of a contact: see `CentroidLaw.numbers`."""
PATCH = 7
"""Numbers of a patch: overlap, centroid and normal, see `dano.contact.Patch`."""


class TreeTables(eqx.Module):
    """The trees of a scene for machine code; n bodies, j joints, c joint coordinates.

    Attributes:
        bodies: Mass [kg], inertia [kg m², B] and centre of mass [m, F] of each, and a row of zeros for the
            world, shape (n + 1, 13); zero mass and inertia of fixed ones.
        joints: See `Chains.table`.
        laws: Damping, armature, stiffness, rest, friction, two limits and five numbers of a motor of each
            coordinate, see `JointLaws`; shape (c, 12). What no joint has is 0, or endless.
        settings: Timestep [s] and gravity [m/s²], shape (4,).
        contacts: Parameters of each of p contacts with the paper's law and its smoothing, regularizer and
            stiction velocity, 0 for none; shape (p, 11). See `CentroidLaw`.
        layout: Structure (static).
        constant: See `JointLaws`, as is the next (static).
        rough: See there (static).
        touching: Bodies of each contact, and whether it is adhesive (static).
        softens: Whether friction of contacts sticks (static).
    """

    bodies: Float[Array, "n 13"]
    joints: Float[Array, "j 15"]
    laws: Float[Array, "c 12"]
    settings: Float[Array, "4"]
    contacts: Float[Array, "p 11"]
    layout: Layout = eqx.field(static=True)
    constant: tuple[bool, ...] = eqx.field(static=True)
    rough: tuple[int, ...] = eqx.field(static=True)
    touching: tuple[tuple[int, int, bool], ...] = eqx.field(static=True)
    softens: bool = eqx.field(static=True)

    @property
    def coordinates(self) -> Int[np.ndarray, "c 2"]:
        """Whether a motor does what it is told to, and the place among those with kinks, or −1."""
        places = {c: r for r, c in enumerate(self.rough)}
        rows = [(constant, places.get(c, -1)) for c, constant in enumerate(self.constant)]
        return np.array(rows, np.int32).reshape(-1, 2)

    @property
    def pairs(self) -> Int[np.ndarray, "p 3"]:
        """Nodes of the bodies of each contact, −1 for one that does not move, and whether it is adhesive."""
        places = {int(row[0]): n for n, row in enumerate(self.layout.nodes)}
        rows = [(places.get(a, -1), places.get(b, -1), pulls) for a, b, pulls in self.touching]
        return np.array(rows, np.int32).reshape(-1, 3)


def changing(tables: TreeTables, perturbed: Sequence[bool]) -> Int[np.ndarray, "changes 4"]:
    """By which numbers of a step its end is differentiated: table, row and column of each.

    The last column counts those that say where bodies are, not only how they are pushed; −1 for the others.

    Tables are those of a state (position, orientation, velocity, omega, q, v), of a control (force, torque,
    effort, command), of a scene (bodies, joints, laws, settings, contacts) and of patches. Vectors have one
    row.

    Args:
        tables: Of the scene.
        perturbed: Which of these tables change.
    """
    layout = tables.layout
    n, c = layout.bodies, len(tables.constant)
    moving = np.array(layout.moving, int)
    # Bodies on joints stand where their coordinates say.
    standing = np.setdiff1d(np.arange(n), np.array(layout.children, int))
    rows = [(standing, 3), (standing, 4), (moving, 3), (moving, 3), (range(1), c), (range(1), c)]
    rows += [(moving, 3), (moving, 3), (range(1), c), (range(1), c)]
    # The last row of bodies is the world's.
    rows += [(range(n), tables.bodies.shape[1])]
    rows += [(range(len(x)), x.shape[1]) for x in (tables.joints, tables.laws)]
    rows += [(range(1), tables.settings.size)]
    rows += [(range(len(tables.contacts)), width) for width in (tables.contacts.shape[1], PATCH)]
    found = numbers_of(rows, perturbed)
    placing = np.isin(found[:, 0], _PLACING)
    places = np.where(placing, np.cumsum(placing) - 1, -1)
    return np.concatenate([found, places[:, None]], axis=1).astype(np.int32)


def tree_tables(scene: Scene) -> TreeTables:
    """The tables of a scene with joints."""
    dtype, chains = scene.timestep.dtype, scene.chains
    layout = chains.layout
    known = [(c, c.law) for c in scene.contacts if in_tables(c.law)]
    rows = []
    for i, body in enumerate(scene.bodies):
        moves = float(i in layout.moving)
        own = moves * body.mass_scale * jnp.concatenate([body.mass[None], body.inertia.ravel()])
        rows.append(jnp.concatenate([own, chains.com[i]]).astype(dtype))
    return TreeTables(
        jnp.stack([*rows, jnp.zeros(13, dtype)]),
        chains.table,
        law_rows(chains.laws, dtype),
        jnp.concatenate([scene.timestep[None], scene.gravity]).astype(dtype),
        _rows([law.numbers(c.params) for c, law in known], CONTACT, dtype),
        layout,
        chains.laws.constant,
        chains.laws.rough,
        tuple((scene.index(c.a), scene.index(c.b), law.adhesive) for c, law in known),
        any(law.stiction for _, law in known),
    )


def patch_rows(patches: Sequence[Patch], dtype) -> Float[Array, "p 7"]:
    """Patches as a table."""
    return _rows([jnp.concatenate([x.overlap[None], x.centroid, x.normal]) for x in patches], PATCH, dtype)


def _rows(rows: Sequence[Array], width: int, dtype) -> Float[Array, "n k"]:
    """Rows as a table, of which there may be none."""
    return jnp.stack(rows).astype(dtype) if rows else jnp.zeros((0, width), dtype)


def in_tables(law: AbstractContactLaw) -> TypeGuard[CentroidLaw]:
    """Whether machine code knows a law; one that is derived from the paper's may be another."""
    return type(law) is CentroidLaw


def law_rows(laws: JointLaws, dtype) -> Float[Array, "c 12"]:
    """Laws of joint coordinates as a table, see `TreeTables.laws`."""
    none = jnp.zeros_like(laws.damping)

    def column(values: Array | None) -> Array:
        return (none if values is None else values)[:, None]

    endless = np.broadcast_to(np.array([-np.inf, np.inf]), (none.size, 2))
    limits = jnp.asarray(endless, dtype) if laws.limits is None else laws.limits
    motor = laws.motor
    if motor is None:
        motor = jnp.concatenate([jnp.zeros((none.size, 3), dtype), jnp.asarray(endless, dtype)], axis=1)
    single = (laws.damping, laws.armature, laws.stiffness, laws.rest, laws.friction)
    return jnp.concatenate([*(column(x) for x in single), limits, motor], axis=1)
