"""Forces and torques over time, as a scene file gives them."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from dano.scene import Control, Scene, State
from dano.scene_file._table import located, Table

_CONTROL = ("body", "force", "torque", "effort", "target", "stiffness", "damping", "from", "to")


class Schedule(eqx.Module):
    """Forces and torques that act for a while: a policy for `dano.simulate`.

    Row i acts on body `body[i]` while `start[i]` ≤ t < `end[i]`, with the force f + k (target − x) − c v and
    the torque τ. Rows that act on one body at one time add up.
    """

    body: Int[Array, " m"]  # Index of the body, shape (m,)
    start: Float[Array, " m"]  # [s], shape (m,)
    end: Float[Array, " m"]  # [s], shape (m,)
    force: Float[Array, "m 3"]  # Constant force f at the centre of mass [N, W], shape (m, 3)
    torque: Float[Array, "m 3"]  # τ [N m, W], shape (m, 3)
    effort: Float[Array, " m"]  # Of the body's joint [N m or N], shape (m,)
    joint: Int[Array, " m"]  # Place of that joint among the coordinates q, shape (m,)
    target: Float[Array, "m 3"]  # Where a spring pulls the centre of mass to [m, W], shape (m, 3)
    stiffness: Float[Array, " m"]  # k of that spring [N/m], shape (m,)
    damping: Float[Array, " m"]  # c [N s/m], shape (m,)
    # h [s]. A step counts as a whole: it belongs to the interval that its middle lies in.
    timestep: Float[Array, ""]
    now: Float[Array, ""]  # Time at which the rollout begins [s]

    def __call__(self, state: State, time: Float[Array, ""]) -> Control:
        """Control for the step that begins at `time` [s] after `now`."""
        middle = self.now + time + 0.5 * self.timestep
        acts = ((self.start <= middle) & (middle < self.end)).astype(middle.dtype)[:, None]
        pull = self.stiffness[:, None] * (self.target - state.position[self.body])
        force = self.force + pull - self.damping[:, None] * state.velocity[self.body]
        none = jnp.zeros_like(state.position)
        effort = None
        if state.q is not None:
            effort = jnp.zeros_like(state.q).at[self.joint].add(acts[:, 0] * self.effort)
        return Control(
            none.at[self.body].add(acts * force), none.at[self.body].add(acts * self.torque), effort
        )

    def starting_at(self, time: float) -> "Schedule":
        """The same schedule for a rollout that begins at `time` [s]."""
        return eqx.tree_at(lambda s: s.now, self, jnp.asarray(time, self.now.dtype))


def read_schedule(top: Table, scene: Scene) -> Schedule | None:
    """The rows of [[controls]] as a policy; None if there are none.

    Raises:
        ValueError: If a row names an unknown body, or has a wrong or missing key.
    """
    rows = [
        Table(f"{top.where}: [[controls]] {i + 1}", row, _CONTROL)
        for i, row in enumerate(top.tables("controls"))
    ]
    if not rows:
        return None
    columns: dict[str, list] = {
        key: []
        for key in (
            "body",
            "joint",
            "start",
            "end",
            "force",
            "torque",
            "target",
            "effort",
            "stiffness",
            "damping",
        )
    }
    layout = scene.layout
    for row in rows:
        with located(row.where):
            index = scene.index(row.word("body"))
            if scene.bodies[index].fixed:
                raise ValueError(f"body must be one that moves, got the fixed {row.data['body']!r}")
        start, end = row.number("from", 0.0), row.number("to", 1e30)
        if not 0 <= start < end:
            raise ValueError(
                f"{row.where}: from and to must satisfy 0 ≤ from < to [s], got {start} and {end}"
            )
        stiffness, damping = row.number("stiffness", 0.0), row.number("damping", 0.0)
        if stiffness < 0 or damping < 0:
            raise row.wrong("stiffness" if stiffness < 0 else "damping", "≥ 0")
        if ("target" in row) != ("stiffness" in row):
            raise ValueError(f"{row.where}: target [m] and stiffness [N/m] must be given together")
        joint = layout.joint_of(index)
        place = layout.coordinates[joint] if joint is not None and layout.width(joint) == 1 else -1
        if "effort" in row and place < 0:
            raise ValueError(f"{row.where}: effort needs a body on a hinge or a slide")
        zero = (0.0, 0.0, 0.0)
        vectors = (row.vector(key, 3, zero) for key in ("force", "torque", "target"))
        numbers = (row.number("effort", 0.0), stiffness, damping)
        values = (index, max(place, 0), start, end, *vectors, *numbers)
        for key, value in zip(columns, values, strict=True):
            columns[key].append(value)
    dtype = scene.timestep.dtype
    whole = {key: jnp.asarray(columns.pop(key), jnp.int32) for key in ("body", "joint")}
    arrays = {key: jnp.asarray(value, dtype) for key, value in columns.items()}
    return Schedule(**whole, **arrays, timestep=scene.timestep, now=jnp.zeros((), dtype))
