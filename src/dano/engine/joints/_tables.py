"""Trees as tables of numbers, in the order in which `dano.native` reads them."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dano.scene import JOINT_KINDS, JointLaws, Layout, Scene

_ROOT = len(JOINT_KINDS)


class TreeTables(eqx.Module):
    """The trees of a scene for machine code; n bodies, j joints, c joint coordinates.

    A node is a body that moves freely, or a joint with the body that hangs on it.

    Attributes:
        bodies: Mass [kg], inertia [kg m², B] and centre of mass [m, F] of each, and a row of zeros for the
            world, shape (n + 1, 13); zero mass and inertia of fixed ones.
        joints: Axis, anchor, position, orientation, ratio and shift of each, see `Chains`; shape (j, 15).
        laws: Damping, armature, stiffness, rest, friction, two limits and five numbers of a motor of each
            coordinate, see `JointLaws`; shape (c, 12). What no joint has is 0, or endless.
        settings: Timestep [s] and gravity [m/s²], shape (4,).
        layout: Structure (static).
        constant: See `JointLaws`, as is the next (static).
        rough: See there (static).
    """

    bodies: Float[Array, "n 13"]
    joints: Float[Array, "j 15"]
    laws: Float[Array, "c 12"]
    settings: Float[Array, "4"]
    layout: Layout = eqx.field(static=True)
    constant: tuple[bool, ...] = eqx.field(static=True)
    rough: tuple[int, ...] = eqx.field(static=True)

    @property
    def nodes(self) -> Int[np.ndarray, "nodes 8"]:
        """How nodes hang on each other; parents come before children.

        Of each node its body, node and body on which it hangs, kind, joint, place of its first velocity,
        number of velocities, and the body from which its tree is looked at. −1 stands for none, n for the
        world.
        """
        layout = self.layout
        rows = [(i, -1, layout.bodies, _ROOT, -1, 6 * k, 6, i) for k, i in enumerate(layout.free)]
        place = {row[0]: k for k, row in enumerate(rows)}
        for j in (j for level in layout.levels for j in level):
            parent, child, kind = layout.parents[j], layout.children[j], layout.kinds[j]
            up = place.get(parent, -1)
            first = 6 * len(layout.free) + max(layout.coordinates[j], 0)
            origin = rows[up][-1] if up >= 0 else child
            place[child] = len(rows)
            width = sum(joint == j for joint, _, _ in layout.dofs)
            rows.append((child, up, parent, JOINT_KINDS.index(kind), j, first, width, origin))
        return np.array(rows, np.int32)

    @property
    def coordinates(self) -> Int[np.ndarray, "c 2"]:
        """Whether a motor does what it is told to, and the place among those with kinks, or −1."""
        places = {c: r for r, c in enumerate(self.rough)}
        rows = [(constant, places.get(c, -1)) for c, constant in enumerate(self.constant)]
        return np.array(rows, np.int32).reshape(-1, 2)


def changing(tables: TreeTables, perturbed: Sequence[bool]) -> Int[np.ndarray, "changes 3"]:
    """By which numbers of a step its end is differentiated: table, row and column of each.

    Tables are those of a state (position, orientation, velocity, omega, q, v), of a control (force, torque,
    effort, command) and of a scene (bodies, joints, laws, settings). Vectors have one row.

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
    found = [
        (k, i, j) for k, (some, width) in enumerate(rows) if perturbed[k] for i in some for j in range(width)
    ]
    return np.array(found, np.int32).reshape(-1, 3)


def tree_tables(scene: Scene) -> TreeTables:
    """The tables of a scene with joints."""
    dtype, chains = scene.timestep.dtype, scene.chains
    layout = chains.layout
    rows = []
    for i, body in enumerate(scene.bodies):
        moves = float(i in layout.moving)
        own = moves * body.mass_scale * jnp.concatenate([body.mass[None], body.inertia.ravel()])
        rows.append(jnp.concatenate([own, chains.com[i]]).astype(dtype))
    parts = (chains.axis, chains.anchor, chains.position, chains.orientation)
    joints = jnp.concatenate([*parts, chains.ratio[:, None], chains.shift[:, None]], axis=1)
    return TreeTables(
        jnp.stack([*rows, jnp.zeros(13, dtype)]),
        joints,
        _law_rows(chains.laws, dtype),
        jnp.concatenate([scene.timestep[None], scene.gravity]).astype(dtype),
        layout,
        chains.laws.constant,
        chains.laws.rough,
    )


def _law_rows(laws: JointLaws, dtype) -> Float[Array, "c 12"]:
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
