"""Loops: what closes a chain of bodies on joints, so that bodies no longer make a tree."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano import maths
from dano.checks import checked_choice, checked_text
from dano.names import did_you_mean

LOOP_KINDS = ("point", "weld")
"""What a loop holds: a point of one body at a point of another, or their orientations, too."""


class Loop(eqx.Module):
    """What closes a loop: a point of one body stays at a point of another, or of the world.

    A weld keeps the orientations, too. A hinge is two points on its axis.

    Attributes:
        first: Name of a body; None for the world.
        second: Name of the other body.
        kind: "point" or "weld".
        position: The point of the first body [m, F of the first, or W].
        anchor: The point of the second that stays there [m, F of the second].
        orientation: Of a weld: the second field frame's orientation in that of the first, wxyz.
    """

    first: str | None = eqx.field(static=True)
    second: str = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    position: Float[Array, "3"]
    anchor: Float[Array, "3"]
    orientation: Float[Array, "4"]

    def __init__(
        self,
        first: str | None,
        second: str,
        kind: str = "point",
        *,
        position: maths.Numbers = (0.0, 0.0, 0.0),
        anchor: maths.Numbers = (0.0, 0.0, 0.0),
        orientation: maths.Numbers = (1.0, 0.0, 0.0, 0.0),
    ):
        """See the class.

        Raises:
            ValueError: If the kind is unknown, both bodies are one, a shape is wrong or a quaternion is zero.
        """
        checked_choice("kind", kind, LOOP_KINDS)
        checked_text("second", second)
        if first is not None:
            checked_text("first", first)
        if first == second:
            raise ValueError(f"loop must join two different bodies, got {second!r} twice")
        self.first, self.second, self.kind = first, second, kind
        what = f"of the loop at {second!r}"
        self.position = maths.checked_array(f"position {what}", position, (3,))
        self.anchor = maths.checked_array(f"anchor {what}", anchor, (3,))
        self.orientation = maths.checked_quaternion(f"orientation {what}", orientation)


class Loops(eqx.Module):
    """All loops of a scene as arrays."""

    # Indices of the first bodies; the number of bodies for the world (static).
    first: tuple[int, ...] = eqx.field(static=True)
    second: tuple[int, ...] = eqx.field(static=True)  # Of the second bodies (static)
    welds: tuple[int, ...] = eqx.field(static=True)  # Rows of those that are welds (static)
    # Points of the first bodies, from their centres of mass [m, B, or W].
    position: Float[maths.AnyArray, "l 3"]
    anchor: Float[maths.AnyArray, "l 3"]  # Of the second bodies
    orientation: Float[maths.AnyArray, "l 4"]  # See `Loop`

    @property
    def size(self) -> int:
        """How many numbers the loops hold at zero."""
        return 3 * (len(self.first) + len(self.welds))

    def gaps(
        self, position: Float[maths.AnyArray, "n 3"], orientation: Float[maths.AnyArray, "n 4"]
    ) -> Float[maths.AnyArray, " c"]:
        """How far the loops are from being closed, at poses of all bodies.

        Returns:
            Distances of the points [m, W], then turns of the welds [rad, F of the first body].
        """
        (x, q), (a, b) = _with_world(position, orientation), self._ends
        apart = x[b] + maths.quat_rotate(q[b], self.anchor) - x[a] - maths.quat_rotate(q[a], self.position)
        rows = np.array(self.welds, int)
        turn = maths.quat_multiply(
            maths.quat_conjugate(maths.quat_multiply(q[a[rows]], self.orientation[rows])), q[b[rows]]
        )
        xp = maths.library(apart, turn)
        return xp.concatenate([apart.ravel(), (2 * xp.sign(turn[:, :1]) * turn[:, 1:]).ravel()])

    def slopes(
        self,
        position: Float[maths.AnyArray, "n 3"],
        orientation: Float[maths.AnyArray, "n 4"],
        moved: Float[maths.AnyArray, "n 6 k"],
    ) -> Float[maths.AnyArray, "c k"]:
        """How the gaps change with numbers that move the bodies, where the loops are closed.

        Args:
            position: Of the centres of mass [m, W].
            orientation: wxyz.
            moved: By how much each number moves and turns each body [m, rad; W].
        """
        (_, q), (a, b) = _with_world(position, orientation), self._ends
        moved = jnp.concatenate([moved, jnp.zeros_like(moved[:1])])

        def of(bodies, arms):
            return moved[bodies, :3] - jnp.cross(arms[:, :, None], moved[bodies, 3:], axis=1)

        apart = of(b, maths.quat_rotate(q[b], self.anchor)) - of(a, maths.quat_rotate(q[a], self.position))
        rows = np.array(self.welds, int)
        back = maths.quat_conjugate(maths.quat_multiply(q[a[rows]], self.orientation[rows]))
        turns = (moved[b[rows], 3:] - moved[a[rows], 3:]).transpose(0, 2, 1)
        own = maths.quat_rotate(back[:, None], turns).transpose(0, 2, 1)
        return jnp.concatenate([apart, own]).reshape(self.size, -1)

    @property
    def _ends(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array(self.first, int), np.array(self.second, int)


def check_loops(names: Sequence[str], hanging: Sequence[int], loops: Sequence[Loop]) -> None:
    """Check that loops join bodies of a scene, one of which hangs on a joint.

    Args:
        names: Of the bodies.
        hanging: Bodies that hang on joints.
        loops: The loops.

    Raises:
        ValueError: If not.
    """
    for loop in loops:
        ends = [name for name in (loop.first, loop.second) if name is not None]
        for name in ends:
            if name not in names:
                hint = did_you_mean(name, names)
                raise ValueError(f"loop must name bodies of the scene {list(names)}, got {name!r}{hint}")
        if not any(names.index(name) in hanging for name in ends):
            raise ValueError(
                f"loop must close a chain of joints, got {' and '.join(map(repr, ends))}, which hang on none:"
                " join them by a dano.Joint"
            )


def loops_of(names: Sequence[str], loops: Sequence[Loop], com: Float[maths.AnyArray, "n 3"]) -> Loops | None:
    """The loops of a scene as arrays, in the dtype of the centres of mass [m, F]; None if there are none."""
    if not loops:
        return None
    first = tuple(len(names) if loop.first is None else names.index(loop.first) for loop in loops)
    second = tuple(names.index(loop.second) for loop in loops)
    welds = tuple(i for i, loop in enumerate(loops) if loop.kind == "weld")
    xp = maths.library(com, *jax.tree.leaves(loops))
    centres = xp.concatenate([com, xp.zeros((1, 3), com.dtype)])
    position, anchor, orientation = (
        xp.stack([getattr(loop, name) for loop in loops]).astype(com.dtype)
        for name in ("position", "anchor", "orientation")
    )
    position, anchor = position - centres[np.array(first)], anchor - centres[np.array(second)]
    return Loops(first, second, welds, position, anchor, orientation)


def _with_world(position: maths.AnyArray, orientation: maths.AnyArray) -> tuple[Any, Any]:
    """Poses with the world as the last row."""
    xp = maths.library(position, orientation)
    still = np.array([[1.0, 0.0, 0.0, 0.0]], orientation.dtype)
    return (
        xp.concatenate([position, np.zeros((1, 3), position.dtype)]),
        xp.concatenate([orientation, still]),
    )
