"""Joints between bodies, loops that close chains of them, and the layout of the coordinates left free.

What drives joints: commands of a step become torques or forces, within limits and through a gear.
What acts on joint coordinates, as arrays over them: springs, friction, limits, motors.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dano import checks, maths
from dano.names import did_you_mean
from dano.scene._bodies import Body

MOTOR_KINDS = ("effort", "position", "velocity")
"""What the command of a motor is: a torque or force, a place to go to, or a speed to keep."""


class Motor(eqx.Module):
    """A motor on a joint. With gear r it turns r times as far as the joint, and its torque f acts r-fold.

    With joint coordinate q and velocity v at the end of the step, and command u:

        effort      f = u
        position    f = stiffness (u − r q) − damping r v
        velocity    f = damping (u − r v)

    f is kept within limits. Taking the end of the step keeps stiff ones stable at any timestep.

    Attributes:
        kind: "effort", "position" or "velocity".
        stiffness: Of "position" [N m/rad or N/m].
        damping: Of "position" and "velocity" [N m s/rad or N s/m].
        gear: r [1, or rad/m for a motor that turns to move a slide].
        limits: Least and largest f [N m or N].
    """

    kind: str = eqx.field(static=True)
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    gear: Float[Array, ""]
    limits: Float[Array, "2"]

    def __init__(
        self,
        kind: str = "effort",
        *,
        stiffness: maths.Numbers = 0.0,
        damping: maths.Numbers = 0.0,
        gear: maths.Numbers = 1.0,
        limits: maths.Numbers | None = None,
    ):
        """A motor; see the attributes. Without limits f is not bounded.

        Raises:
            ValueError: If the kind is unknown, a number is out of range, the gear is zero, or what the kind
                needs is missing.
        """
        checks.checked_choice("kind of motor", kind, MOTOR_KINDS)
        self.kind = kind
        self.stiffness = maths.checked_array("stiffness of motor", stiffness, ())
        self.damping = maths.checked_array("damping of motor", damping, ())
        self.gear = maths.checked_array("gear of motor", gear, ())
        self.limits = checked_limits("limits of motor", (-np.inf, np.inf) if limits is None else limits)
        for name in ("stiffness", "damping"):
            value = getattr(self, name)
            if not maths.is_traced(value) and float(value) < 0:
                raise ValueError(f"{name} of motor must be ≥ 0, got {float(value)}")
        if not maths.is_traced(self.gear) and float(self.gear) == 0:
            raise ValueError("gear of motor must not be 0, got 0.0")
        needed = {"effort": (), "position": ("stiffness",), "velocity": ("damping",)}[kind]
        for name in needed:
            value = getattr(self, name)
            if not maths.is_traced(value) and not float(value) > 0:
                raise ValueError(f"{name} of a {kind} motor must be > 0, got {float(value)}")


def checked_limits(name: str, value: maths.Numbers) -> Float[Array, "2"]:
    """Two numbers of which the first is not the larger; they may be infinite.

    Raises:
        ValueError: If they are not.
    """
    limits = maths.checked_floating(name, value)
    if limits.shape != (2,):
        raise ValueError(f"{name} must be two numbers, got shape {limits.shape}")
    if not maths.is_traced(limits) and not np.less_equal(*np.asarray(limits)):
        raise ValueError(f"{name} must be a least and a largest number, got {np.asarray(limits).tolist()}")
    return limits


JOINT_KINDS = ("hinge", "slide", "weld", "ball", "planar")
"""What a joint lets its child do: turn about an axis, move along it, nothing, turn about a point, slide on a
plane and turn in it."""
WIDTHS = {"hinge": 1, "slide": 1, "weld": 0, "ball": 3, "planar": 3}
"""How many coordinates a joint of each kind has."""


class Joint(eqx.Module):
    """A joint by which one body (child) hangs on another (parent) or on the world.

    A hinge has an angle [rad] as its coordinate q, a slide a length [m]; a weld has none, so that welded
    bodies are one rigid body of several geometries. The q of a ball is a rotation vector [rad], from the
    orientation at q = 0 to that of the child; its v is the child's spin against the parent [rad/s, F of the
    child]. A planar joint has two lengths in the plane across its axis [m], and the angle about it [rad].
    The lengths are along the projection of x on the plane (of y where the axis lies within 8° of x), and
    along what completes it and the axis to a right-handed frame.

    Attributes:
        parent: Name of the body that carries the joint; None for the world.
        child: Name of the body that hangs on it.
        kind: "hinge", "slide", "weld", "ball" or "planar".
        axis: Unit direction of the axis [F of the child]; a ball has none.
        anchor: A point of the child on the axis, or the centre of the ball [m, F of the child].
        position: Origin of the child's field frame at q = 0 [m, F of the parent, or W].
        orientation: Of the child's field frame at q = 0, wxyz, to the parent's field frame or W.
        damping: Torque [N m s/rad] or force [N s/m] against the joint's speed, per speed.
        limits: Least and largest q of a hinge or slide [rad or m], which stops there without a rebound.
        friction: Torque [N m] or force [N] up to which the joint sticks, and with which it slips.
        armature: Inertia [kg m²] or mass [kg] of what turns with the joint, such as rotors through gears.
        stiffness: Of a spring [N m/rad or N/m], which pulls to `rest`.
        rest: q at which the spring exerts no force [rad or m].
        mimics: Child of the joint whose coordinate moves this one, too: q = ratio · q of that + shift.
        ratio: See `mimics`.
        shift: See `mimics` [rad or m].
        motor: What turns commands into torques or forces.
    """

    parent: str | None = eqx.field(static=True)
    child: str = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    axis: Float[Array, "3"]
    anchor: Float[Array, "3"]
    position: Float[Array, "3"]
    orientation: Float[Array, "4"]
    damping: Float[Array, ""]
    limits: Float[Array, "2"] | None
    friction: Float[Array, ""] | None
    armature: Float[Array, ""] | None
    stiffness: Float[Array, ""] | None
    rest: Float[Array, ""]
    mimics: str | None = eqx.field(static=True)
    ratio: Float[Array, ""]
    shift: Float[Array, ""]
    motor: Motor | None

    def __init__(
        self,
        parent: str | None,
        child: str,
        kind: str = "hinge",
        *,
        axis: maths.Numbers = (0.0, 0.0, 1.0),
        anchor: maths.Numbers = (0.0, 0.0, 0.0),
        position: maths.Numbers = (0.0, 0.0, 0.0),
        orientation: maths.Numbers = (1.0, 0.0, 0.0, 0.0),
        damping: maths.Numbers = 0.0,
        limits: maths.Numbers | None = None,
        friction: maths.Numbers | None = None,
        armature: maths.Numbers | None = None,
        stiffness: maths.Numbers | None = None,
        rest: maths.Numbers = 0.0,
        mimics: str | None = None,
        ratio: maths.Numbers = 1.0,
        shift: maths.Numbers = 0.0,
        motor: Motor | None = None,
    ):
        """A joint of two bodies of a scene; see the attributes.

        Raises:
            ValueError: If the kind is unknown, a body hangs on itself, the axis or the orientation is zero, a
                shape is wrong, a number is out of range, or the kind has no such thing.
        """
        checks.checked_choice("kind", kind, JOINT_KINDS)
        checks.checked_text("child", child)
        for name, other in (("parent", parent), ("mimics", mimics)):
            if other is not None:
                checks.checked_text(name, other)
        if parent == child:
            raise ValueError(f"joint must join two different bodies, got {child!r} twice")
        self.parent, self.child, self.kind = parent, child, kind
        what = f"of the joint of {child!r}"
        axis = maths.checked_array(f"axis {what}", axis, (3,))
        length = (axis @ axis) ** 0.5
        if not maths.is_traced(length) and not float(length) > 0:
            raise ValueError(f"axis {what} must not be zero, got {np.asarray(axis).tolist()}")
        self.axis = axis / length
        self.anchor = maths.checked_array(f"anchor {what}", anchor, (3,))
        self.position = maths.checked_array(f"position {what}", position, (3,))
        self.orientation = maths.checked_quaternion(f"orientation {what}", orientation)
        self.damping = maths.checked_array(f"damping {what}", damping, (), least=0.0)
        self.friction, self.armature, self.stiffness = (
            None if value is None else maths.checked_array(f"{name} {what}", value, (), least=0.0)
            for name, value in (("friction", friction), ("armature", armature), ("stiffness", stiffness))
        )
        self.limits = None if limits is None else checked_limits(f"limits {what}", limits)
        self.rest = maths.checked_array(f"rest {what}", rest, ())
        self.ratio = maths.checked_array(f"ratio {what}", ratio, ())
        self.shift = maths.checked_array(f"shift {what}", shift, ())
        self.mimics, self.motor = mimics, checks.checked_optional(f"motor {what}", motor, Motor)
        self._check_kind(what)

    def _check_kind(self, what: str) -> None:
        """Raise a ValueError if the joint has something that its kind, or one that follows, has not."""
        given = [name for name in _LAWS if getattr(self, name) is not None]
        single = WIDTHS[self.kind] == 1
        if self.kind == "weld" and (given or self.mimics):
            raise ValueError(f"joint of {self.child!r} is a weld, which has no {given or 'mimics'}")
        if not single and (self.mimics or self.limits is not None or self.motor is not None):
            raise ValueError(f"limits, mimics and motor {what} need a hinge or a slide, got a {self.kind}")
        if self.mimics and (bad := [name for name in given if name not in ("friction", "armature")]):
            raise ValueError(f"{bad[0]} {what} must be given to {self.mimics!r}, whose coordinate it mimics")

    @property
    def width(self) -> int:
        """How many coordinates of its own the joint has."""
        return 0 if self.mimics else WIDTHS[self.kind]


_LAWS = ("limits", "friction", "armature", "stiffness", "motor")


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
        checks.checked_choice("kind", kind, LOOP_KINDS)
        checks.checked_text("second", second)
        if first is not None:
            checks.checked_text("first", first)
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


class StateLayout(NamedTuple):
    """Which numbers say how the bodies of a scene stand and move (static).

    Bodies form trees. A tree stands on a body that moves freely, on a fixed one, or on the world; all its
    other bodies hang on joints. Coordinates are the poses of the free bodies, and q of the joints; velocities
    are v and ω of the free bodies, six numbers each, then the speeds of the joints.
    """

    bodies: int  # Number of bodies
    moving: tuple[int, ...]  # Bodies that are not fixed, in order
    free: tuple[int, ...]  # Those of them that hang on no joint
    parents: tuple[int, ...]  # Of each joint the body that carries it; the number of bodies for the world
    children: tuple[int, ...]  # Of each joint the body that hangs on it
    # Of each joint the first place of its own among q, or −1 for a weld; of one that mimics another the place
    # of that.
    coordinates: tuple[int, ...]
    kinds: tuple[str, ...]  # Of the joints
    follows: tuple[bool, ...]  # Whether each mimics another
    # What joints let bodies do: joint, which of its motions, and place among q of each.
    dofs: tuple[tuple[int, int, int], ...]
    levels: tuple[tuple[int, ...], ...]  # Joints by their distance from the root of their tree
    roots: tuple[int, ...]  # Of each body the place in `free` of the one that its tree stands on, or −1
    moved_by: tuple[tuple[bool, ...], ...]  # Whether a motion of `dofs` moves a body, shape (bodies, dofs)

    @property
    def n_joints(self) -> int:
        """Number of joint coordinates q."""
        return 1 + max((place for _, _, place in self.dofs), default=-1)

    @property
    def n_velocities(self) -> int:
        """Degrees of freedom: six of each free body, one of each joint coordinate."""
        return 6 * len(self.free) + self.n_joints

    @property
    def with_coordinates(self) -> tuple[int, ...]:
        """The joint of each coordinate, in the order of q."""
        owners: dict[int, int] = {}
        for joint, _, place in self.dofs:
            if not self.follows[joint]:
                owners[place] = joint
        return tuple(owners[place] for place in range(self.n_joints))

    @property
    def nodes(self) -> Int[np.ndarray, "nodes 8"]:
        """How nodes hang on each other; parents come before children.

        A node is a body that moves freely, or a joint with the body that hangs on it.
        Of each node its body, node and body on which it hangs, kind, joint, place of its first velocity,
        number of velocities, and the body from which its tree is looked at. −1 stands for none, n for the
        world.
        """
        root = len(JOINT_KINDS)
        rows = [(i, -1, self.bodies, root, -1, 6 * k, 6, i) for k, i in enumerate(self.free)]
        place = {row[0]: k for k, row in enumerate(rows)}
        for j in (j for level in self.levels for j in level):
            parent, child, kind = self.parents[j], self.children[j], self.kinds[j]
            up = place.get(parent, -1)
            first = 6 * len(self.free) + max(self.coordinates[j], 0)
            origin = rows[up][-1] if up >= 0 else child
            place[child] = len(rows)
            width = sum(joint == j for joint, _, _ in self.dofs)
            rows.append((child, up, parent, JOINT_KINDS.index(kind), j, first, width, origin))
        return np.array(rows, np.int32)

    def width(self, joint: int) -> int:
        """How many coordinates of its own a joint has."""
        return 0 if self.follows[joint] else WIDTHS[self.kinds[joint]]

    def joint_of(self, body: int) -> int | None:
        """The joint on which a body hangs, or None."""
        return self.children.index(body) if body in self.children else None


def unjoined(names: Sequence[str], joints: Sequence[Joint | Loop]) -> Bool[np.ndarray, "n n"]:
    """Which bodies are neither parts of one rigid body nor neighbours, which overlap where a joint is.

    Args:
        names: Of the bodies.
        joints: The joints of a scene, and its loops.
    """
    link: dict[str | None, str | None] = {}

    def link_of(name: str | None) -> str | None:
        while name in link:
            name = link[name]
        return name

    for joint in joints:
        if isinstance(joint, Joint) and joint.kind == "weld":
            link[link_of(joint.child)] = link_of(joint.parent)
    ends = [(x.parent, x.child) if isinstance(x, Joint) else (x.first, x.second) for x in joints]
    number: dict[str | None, int] = {}
    of_bodies = np.array([number.setdefault(link_of(name), len(number)) for name in names], int)
    apart = ~np.eye(len(number), dtype=bool)
    for a, b in ends:
        links = [number[link] for link in (link_of(a), link_of(b)) if link in number]
        apart[np.ix_(links, links)] = False
    return apart[np.ix_(of_bodies, of_bodies)]


def layout_of(bodies: Sequence[Body], joints: Sequence[Joint]) -> StateLayout:
    """The layout of bodies and joints.

    Raises:
        ValueError: If a joint names an unknown body, a body hangs on two joints or is fixed and hangs on one,
            bodies hang on each other in a circle, or a joint mimics none that has one coordinate.
    """
    return _layout(
        tuple(body.name for body in bodies),
        tuple(body.fixed for body in bodies),
        tuple((joint.parent, joint.child, joint.kind, joint.mimics) for joint in joints),
    )


@functools.lru_cache(maxsize=256)
def _layout(
    names: tuple[str, ...],
    fixed: tuple[bool, ...],
    joints: tuple[tuple[str | None, str, str, str | None], ...],
) -> StateLayout:
    """`layout_of`; of joints their parents, children, kinds and the child of the joint that each mimics."""
    index = {name: i for i, name in enumerate(names)}
    for parent, child, _, _ in joints:
        for name in (parent, child):
            if name is not None and name not in index:
                hint = did_you_mean(name, names)
                raise ValueError(f"joint must name bodies of the scene {list(names)}, got {name!r}{hint}")
        if fixed[index[child]]:
            raise ValueError(f"joint must carry a body that moves, got the fixed {child!r}")
    children = tuple(index[child] for _, child, _, _ in joints)
    for i in children:
        if children.count(i) > 1:
            raise ValueError(f"body {names[i]!r} must hang on one joint, got {children.count(i)}")
    parents = tuple(len(names) if parent is None else index[parent] for parent, _, _, _ in joints)
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
    coordinates, dofs = _coordinates(joints)
    depth = [len(chains[child]) for child in children]
    levels = tuple(
        tuple(j for j in range(len(joints)) if depth[j] == level + 1)
        for level in range(max(depth, default=0))
    )
    moved_by = tuple(tuple(j in chain for j, _, _ in dofs) for chain in chains)
    kinds = tuple(kind for _, _, kind, _ in joints)
    follows = tuple(bool(mimics) for *_, mimics in joints)
    hanging = (parents, children, coordinates, kinds, follows, dofs)
    return StateLayout(len(names), moving, free, *hanging, levels, tuple(roots), moved_by)


def _coordinates(joints: Sequence[tuple[str | None, str, str, str | None]]):
    """First coordinate of each joint, and all motions: joint, which of its own, place among q.

    Raises:
        ValueError: If a joint mimics none that has one coordinate.
    """
    first, count = [], 0
    for _, _, kind, mimics in joints:
        width = 0 if mimics else WIDTHS[kind]
        first.append(count if width else -1)
        count += width
    leads = {c: j for j, (_, c, kind, mimics) in enumerate(joints) if WIDTHS[kind] == 1 and not mimics}
    for j, (_, child, _, mimics) in enumerate(joints):
        if not mimics:
            continue
        if mimics not in leads:
            raise ValueError(
                f"mimics of the joint of {child!r} must name one of {list(leads)}, whose joints have one "
                f"coordinate of their own, got {mimics!r}"
            )
        first[j] = first[leads[mimics]]
    dofs = tuple((j, k, first[j] + k) for j, joint in enumerate(joints) for k in range(WIDTHS[joint[2]]))
    return tuple(first), dofs


class JointLaws(eqx.Module):
    """What acts on the k coordinates q of a scene. What no joint has is None.

    Damping, friction and armature of a joint that mimics another act on the coordinate of that one, by its
    ratio; those of a ball or a planar joint on each of its coordinates alike.
    """

    damping: Float[maths.AnyArray, " k"]  # [N m s/rad or N s/m], shape (k,)
    armature: Float[maths.AnyArray, " k"] | None  # [kg m² or kg]
    stiffness: Float[maths.AnyArray, " k"] | None  # Of springs [N m/rad or N/m]
    rest: Float[maths.AnyArray, " k"]  # Where they exert no force [rad or m]
    friction: Float[maths.AnyArray, " k"] | None  # [N m or N]
    limits: Float[maths.AnyArray, "k 2"] | None  # Least and largest q [rad or m], shape (k, 2)
    # Gear, stiffness and damping of motors, and their least and largest effort, see `Motor`; gear 0 where
    # there is none. Shape (k, 5).
    motor: Float[maths.AnyArray, "k 5"] | None
    # Whether a motor gives what it is told to, whatever the joint does (static).
    constant: tuple[bool, ...] = eqx.field(static=True)
    # Coordinates with limits, friction, or a motor that heeds the joint (static).
    rough: tuple[int, ...] = eqx.field(static=True)


def joint_laws(layout: StateLayout, joints: Sequence[Joint], dtype) -> JointLaws:
    """The laws of the joints of a scene."""
    owners, xp = [joints[j] for j in layout.with_coordinates], maths.library(*jax.tree.leaves(joints))

    def summed(name: str, power: Callable[[Any], Any]) -> Float[maths.AnyArray, " k"]:
        values = xp.zeros(layout.n_joints, dtype)
        for j, _, place in layout.dofs:
            value = getattr(joints[j], name)
            if value is not None:
                share = power(joints[j].ratio) if layout.follows[j] else 1
                values = maths.with_rows(values, place, values[place] + xp.asarray(share * value, dtype))
        return values

    def of_some(name: str, power: Callable[[Any], Any]) -> Float[maths.AnyArray, " k"] | None:
        return summed(name, power) if any(getattr(joint, name) is not None for joint in joints) else None

    def column(values: list[Any]) -> Any:
        return xp.stack([x.astype(dtype) for x in values]) if values else xp.zeros(0, dtype)

    limits = motor = None
    if any(joint.limits is not None for joint in owners):
        free = np.array([-np.inf, np.inf])
        limits = column([free if joint.limits is None else joint.limits for joint in owners])
    if any(joint.motor is not None for joint in owners):
        motor = column([_motor(joint) for joint in owners])
    constant = tuple(joint.motor is not None and joint.motor.kind == "effort" for joint in owners)
    heeds = [joint.motor is not None and joint.motor.kind != "effort" for joint in owners]
    rubs = {place for j, _, place in layout.dofs if joints[j].friction is not None}
    rough = tuple(
        place
        for place, joint in enumerate(owners)
        if joint.limits is not None or place in rubs or heeds[place]
    )
    springs = of_some("stiffness", lambda ratio: ratio)
    return JointLaws(
        summed("damping", xp.square),
        of_some("armature", xp.square),
        springs,
        column([joint.rest for joint in owners]),
        of_some("friction", xp.abs),
        limits,
        motor,
        constant,
        rough,
    )


def _motor(joint: Joint) -> maths.AnyArray:
    motor = joint.motor
    if motor is None:
        return np.array([0.0, 0.0, 0.0, -np.inf, np.inf])
    xp = maths.library(*jax.tree.leaves(motor))
    stiffness = motor.stiffness if motor.kind == "position" else xp.zeros_like(motor.stiffness)
    damping = motor.damping if motor.kind != "effort" else xp.zeros_like(motor.damping)
    return xp.concatenate([xp.stack([motor.gear, stiffness, damping]), motor.limits])
