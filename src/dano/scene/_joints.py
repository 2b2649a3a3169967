"""Joints between bodies, and the layout of the coordinates that they leave free."""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from dano.maths import checked_array, checked_quaternion, is_traced, Numbers
from dano.names import did_you_mean

JOINT_KINDS = ("hinge", "slide", "weld")
"""What a joint lets its child do: turn about an axis, move along it, or nothing."""


class Joint(eqx.Module):
    """A joint by which one body (child) hangs on another (parent) or on the world.

    A hinge has an angle [rad] as its coordinate q, a slide a length [m]; a weld has none, so that welded
    bodies are one rigid body of several geometries.

    Attributes:
        parent: Name of the body that carries the joint; None for the world.
        child: Name of the body that hangs on it.
        kind: "hinge", "slide" or "weld".
        axis: Unit direction of the axis [F of the child].
        anchor: A point of the child on the axis [m, F of the child].
        position: Origin of the child's field frame at q = 0 [m, F of the parent, or W].
        orientation: Of the child's field frame at q = 0, wxyz, to the parent's field frame or W.
        damping: Torque [N m s/rad] or force [N s/m] against the joint's speed, per speed.
    """

    parent: str | None = eqx.field(static=True)
    child: str = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    axis: Float[Array, "3"]
    anchor: Float[Array, "3"]
    position: Float[Array, "3"]
    orientation: Float[Array, "4"]
    damping: Float[Array, ""]

    def __init__(
        self,
        parent: str | None,
        child: str,
        kind: str = "hinge",
        *,
        axis: Numbers = (0.0, 0.0, 1.0),
        anchor: Numbers = (0.0, 0.0, 0.0),
        position: Numbers = (0.0, 0.0, 0.0),
        orientation: Numbers = (1.0, 0.0, 0.0, 0.0),
        damping: Numbers = 0.0,
    ):
        """A joint of two bodies of a scene; see the attributes.

        Raises:
            ValueError: If the kind is unknown, a body hangs on itself, the axis or the orientation is zero, a
                shape is wrong, or the damping is negative.
        """
        if kind not in JOINT_KINDS:
            raise ValueError(f"kind must be one of {', '.join(JOINT_KINDS)}, got {kind!r}")
        if parent == child:
            raise ValueError(f"joint must join two different bodies, got {child!r} twice")
        self.parent, self.child, self.kind = parent, child, kind
        what = f"of the joint of {child!r}"
        axis = checked_array(f"axis {what}", axis, (3,))
        length = (axis @ axis) ** 0.5
        if not is_traced(length) and not float(length) > 0:
            raise ValueError(f"axis {what} must not be zero, got {np.asarray(axis).tolist()}")
        self.axis = axis / length
        self.anchor = checked_array(f"anchor {what}", anchor, (3,))
        self.position = checked_array(f"position {what}", position, (3,))
        self.orientation = checked_quaternion(f"orientation {what}", orientation)
        self.damping = checked_array(f"damping {what}", damping, ())
        if not is_traced(self.damping) and float(self.damping) < 0:
            raise ValueError(f"damping {what} must be ≥ 0, got {float(self.damping)}")


class Layout(NamedTuple):
    """Which numbers say how the bodies of a scene stand and move (static).

    Bodies form trees. A tree stands on a body that moves freely, on a fixed one, or on the world; all its
    other bodies hang on joints. Coordinates are the poses of the free bodies, and q of the joints; velocities
    are v and ω of the free bodies, six numbers each, then the speeds of the joints.

    Attributes:
        bodies: Number of bodies.
        moving: Bodies that are not fixed, in order.
        free: Those of them that hang on no joint.
        parents: Of each joint the body that carries it; the number of bodies for the world.
        children: Of each joint the body that hangs on it.
        coordinates: Of each joint its place among q, or −1 for a weld.
        levels: Joints by their distance from the root of their tree.
        roots: Of each body the place in `free` of the one that its tree stands on, or −1.
        moved_by: Whether a joint moves a body: joints with coordinates as columns, shape (bodies, joints).
    """

    bodies: int
    moving: tuple[int, ...]
    free: tuple[int, ...]
    parents: tuple[int, ...]
    children: tuple[int, ...]
    coordinates: tuple[int, ...]
    levels: tuple[tuple[int, ...], ...]
    roots: tuple[int, ...]
    moved_by: tuple[tuple[bool, ...], ...]

    @property
    def n_joints(self) -> int:
        """Number of joint coordinates q."""
        return sum(k >= 0 for k in self.coordinates)

    @property
    def n_velocities(self) -> int:
        """Degrees of freedom: six of each free body, one of each joint coordinate."""
        return 6 * len(self.free) + self.n_joints

    @property
    def with_coordinates(self) -> tuple[int, ...]:
        """Joints that have a coordinate, in the order of q."""
        return tuple(j for j, k in enumerate(self.coordinates) if k >= 0)

    def joint_of(self, body: int) -> int | None:
        """The joint on which a body hangs, or None."""
        return self.children.index(body) if body in self.children else None


def joined(joints: Sequence[Joint]) -> Callable[[str, str], bool]:
    """Whether two bodies are parts of one rigid body, or neighbours: they overlap where a joint is.

    Args:
        joints: The joints of a scene.
    """
    link: dict[str | None, str | None] = {}

    def link_of(name: str | None) -> str | None:
        while name in link:
            name = link[name]
        return name

    for joint in joints:
        if joint.kind == "weld":
            link[link_of(joint.child)] = link_of(joint.parent)
    neighbours = {frozenset((link_of(j.parent), link_of(j.child))) for j in joints if j.kind != "weld"}

    def check(a: str, b: str) -> bool:
        ends = frozenset((link_of(a), link_of(b)))
        return len(ends) == 1 or ends in neighbours

    return check


@functools.lru_cache(maxsize=256)
def layout_of(
    names: tuple[str, ...],
    fixed: tuple[bool, ...],
    joints: tuple[tuple[str | None, str, str], ...],
) -> Layout:
    """The layout of bodies and joints.

    Args:
        names: Names of the bodies.
        fixed: Whether each is fixed.
        joints: Parent, child and kind of each joint.

    Raises:
        ValueError: If a joint names an unknown body, a body hangs on two joints or is fixed and hangs on one,
            or bodies hang on each other in a circle.
    """
    index = {name: i for i, name in enumerate(names)}
    for parent, child, _ in joints:
        for name in (parent, child):
            if name is not None and name not in index:
                hint = did_you_mean(name, names)
                raise ValueError(f"joint must name bodies of the scene {list(names)}, got {name!r}{hint}")
        if fixed[index[child]]:
            raise ValueError(f"joint must carry a body that moves, got the fixed {child!r}")
    children = tuple(index[child] for _, child, _ in joints)
    for i in children:
        if children.count(i) > 1:
            raise ValueError(f"body {names[i]!r} must hang on one joint, got {children.count(i)}")
    parents = tuple(len(names) if parent is None else index[parent] for parent, _, _ in joints)
    hangs = dict(zip(children, zip(parents, range(len(joints)), strict=True), strict=True))
    chains: list[list[int]] = []
    roots = []
    moving = tuple(i for i in range(len(names)) if not fixed[i])
    free = tuple(i for i in moving if i not in hangs)
    for i in range(len(names)):
        chain: list[int] = []
        at = i
        while at in hangs:
            at, joint = hangs[at]
            chain.append(joint)
            if len(chain) > len(joints):
                raise ValueError(f"joints must make trees, got a circle through {names[i]!r}")
        chains.append(chain)
        roots.append(free.index(at) if at in free else -1)
    count = iter(range(len(joints)))
    coordinates = tuple(-1 if kind == "weld" else next(count) for _, _, kind in joints)
    numbered = [j for j, k in enumerate(coordinates) if k >= 0]
    depth = [len(chains[child]) for child in children]
    levels = tuple(
        tuple(j for j in range(len(joints)) if depth[j] == level + 1)
        for level in range(max(depth, default=0))
    )
    moved_by = tuple(tuple(j in chain for j in numbered) for chain in chains)
    return Layout(len(names), moving, free, parents, children, coordinates, levels, tuple(roots), moved_by)
