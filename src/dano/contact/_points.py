"""The list of point contacts: where finding contact ends, and what laws turn into force.

Finding contact knows shapes and no forces; a law knows forces and no shapes. Between them stands `Points`:
chunks of at most `CHUNK` points that lie on one body (first), press on another (second), and share a contact.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

CHUNK = 16
"""Points of a chunk. A chunk belongs to one pair of bodies, so sums over pairs are sums over chunks."""
ROUND = 16
"""A list has room for a multiple of so many chunks."""
# Chunks of which derivatives are taken at once.
_TOGETHER = 4


class Points(eqx.Module):
    """Point contacts of a step, in chunks; c chunks of p points.

    Geometry is that of a configuration predicted by the old velocities (see `dano.contact.find`), moved back
    along with the first body's centre of mass, so that forces act on one line for both bodies.

    Attributes:
        rows: `arm`, `normal`, `moment`, `depth`, `rate`, `area` and `drift`, one below the other: one array,
            because machine code that writes and reads it needs no copies.
        stiffness: Of an impact that must end within the step: pressure per depth [Pa/m]; zero elsewhere,
            where the material's own holds. Shape (c,).
        between: From the second body's centre of mass to the first's, at the start of the step [m, W].
        first: Index of the body that the points lie on, shape (c,).
        second: Index of the other body.
        contact: Index into the scene's contacts.
    """

    rows: Float[Array, "15 c p"]
    stiffness: Float[Array, " c"]
    between: Float[Array, "3 c"]
    first: Int[Array, " c"]
    second: Int[Array, " c"]
    contact: Int[Array, " c"]

    @property
    def arm(self) -> Float[Array, "3 c p"]:
        """From the first body's centre of mass to the point [m, W]."""
        return self.rows[:3]

    @property
    def normal(self) -> Float[Array, "3 c p"]:
        """Unit normal out of the second body, toward the first [W]."""
        return self.rows[3:6]

    @property
    def moment(self) -> Float[Array, "3 c p"]:
        """Moment of a unit pressure about the first body's centre of mass [m, W].

        It is arm × normal, without what a body that rolls on a smooth surface would feel of single samples.
        """
        return self.rows[6:9]

    @property
    def depth(self) -> Float[Array, "c p"]:
        """Depth below the second body's surface at the end of the step if nothing moved in it [m]."""
        return self.rows[9]

    @property
    def rate(self) -> Float[Array, "c p"]:
        """Separating speed at the old velocities [m/s]."""
        return self.rows[10]

    @property
    def area(self) -> Float[Array, "c p"]:
        """Area that faces the second body [m²]; zero where a chunk is not full."""
        return self.rows[11]

    @property
    def drift(self) -> Float[Array, "3 c p"]:
        """Half of what the velocity of a point at the old motion changes by within the step [m/s, W].

        Zero but for samples that keep facing the second body: what touches is another place each time. The
        part along the surface is added to the slip. The other is taken off `rate` to tell how bodies that
        touch approached, half a step before.
        """
        return self.rows[12:]

    @property
    def approach(self) -> Float[Array, "c p"]:
        """Separating speed with which the step begins [m/s]."""
        return self.rate - dot(self.normal, self.drift)

    @property
    def extra_slip(self) -> Float[Array, "3 c p"]:
        """What is added to the slip [m/s, W]."""
        return self.drift - self.normal * dot(self.normal, self.drift)[None]


class Found(eqx.Module):
    """Where points were found: whole numbers, which derivatives hold fixed, and what was decided there.

    Attributes:
        sample: Row of each point in the table of samples, shape (c, p).
        filled: Whether a place of a chunk is taken, shape (c, p).
        group: Kind of solid that a chunk presses on, shape (c,).
        side: Which pair of that kind, shape (c,).
        share: Share of the step after which geometry was taken, shape (c,).
        stiffness: See `Points`.
        count: Number of chunks in use.
        overflow: Whether there were more than the list holds.
    """

    sample: Int[Array, "c p"]
    filled: Bool[Array, "c p"]
    group: Int[Array, " c"]
    side: Int[Array, " c"]
    share: Float[Array, " c"]
    stiffness: Float[Array, " c"]
    count: Int[Array, ""]
    overflow: Bool[Array, ""]


def over_chunks(function: Callable[[Any], Any], chunks: Any, count: Int[Array, ""]) -> Any:
    """What a function gives for the chunks in use, zeros for others, as it can be differentiated quickly.

    A list has room for many more chunks than are in use. Machine code skips the others; so does this.

    Args:
        function: Of a few chunks; arrays with the chunks along the first axis, as are its results.
        chunks: All chunks, `ROUND` times a whole number.
        count: How many are in use.
    """
    blocks = jax.tree.map(lambda x: x.reshape(-1, _TOGETHER, *x.shape[1:]), chunks)
    n = jax.tree.leaves(blocks)[0].shape[0]

    # Reverse mode computes a block again: what it would keep of each costs more to store.
    @jax.checkpoint
    def visit(_, inputs):
        start, block = inputs
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(function, block))
        return None, jax.lax.cond(start < count, function, lambda _: nothing, block)

    _, results = jax.lax.scan(visit, None, (_TOGETHER * jnp.arange(n), blocks))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), results)


class Motion(NamedTuple):
    """How points move relative to the body that they press on.

    Attributes:
        rate: Separating speed [m/s], shape (c, p).
        slip: Velocity across the normal [m/s, W], shape (3, c, p).
    """

    rate: Float[Array, "c p"]
    slip: Float[Array, "3 c p"]


def point_motion(velocity: Float[Array, "n 3"], spin: Float[Array, "n 3"], points: Points) -> Motion:
    """Motion of points at the velocities of all bodies, see `relative_twist`."""
    u, w = (x[:, :, None] for x in relative_twist(velocity, spin, points))
    rate, slip = motion_at(points.arm, points.normal, points.moment, u, w)
    return Motion(rate, slip + points.extra_slip)


def motion_at(
    arm: Float[Array, "3 *#batch"],
    normal: Float[Array, "3 *#batch"],
    moment: Float[Array, "3 *#batch"],
    u: Float[Array, "3 *#batch"],
    w: Float[Array, "3 *#batch"],
) -> Motion:
    """Motion of points from a relative twist; axes after the first broadcast.

    Args:
        arm: See `Points`, as are the next two.
        normal: Unit normals.
        moment: Moments of a unit pressure.
        u: Velocity at the first body's centre of mass, relative to the second body [m/s, W].
        w: Relative spin [rad/s, W].
    """
    full = u + cross(w, arm)
    slip = full - normal * dot(normal, full)[None]
    return Motion(dot(normal, u) + dot(moment, w), slip)


def relative_twist(
    velocity: Float[Array, "n 3"], spin: Float[Array, "n 3"], points: Points
) -> tuple[Float[Array, "3 c"], Float[Array, "3 c"]]:
    """Velocity at the first body's centre of mass and spin, of the first body relative to the second [W].

    Args:
        velocity: Of the centres of mass of all bodies [m/s, W].
        spin: Of all bodies [rad/s, W].
        points: The points.
    """
    va, vb = velocity[points.first].T, velocity[points.second].T
    wa, wb = spin[points.first].T, spin[points.second].T
    return va - vb - cross(wb, points.between), wa - wb


def cross(a: Float[Array, "3 *#batch"], b: Float[Array, "3 *#batch"]) -> Float[Array, "3 *batch"]:
    """Cross product of vectors stored as columns, whose other axes broadcast."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def dot(a: Float[Array, "3 *#batch"], b: Float[Array, "3 *#batch"]) -> Float[Array, "*batch"]:
    """Scalar product of vectors stored as columns, whose other axes broadcast."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
