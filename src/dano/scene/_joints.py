"""Joints between bodies, and the layout of the coordinates that they leave free."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dano.checks import checked_choice, checked_optional, checked_text
from dano.maths import checked_array, checked_quaternion, is_traced, Numbers
from dano.names import did_you_mean
from dano.scene._loops import Loop
from dano.scene._motors import checked_limits, Motor

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
        axis: Numbers = (0.0, 0.0, 1.0),
        anchor: Numbers = (0.0, 0.0, 0.0),
        position: Numbers = (0.0, 0.0, 0.0),
        orientation: Numbers = (1.0, 0.0, 0.0, 0.0),
        damping: Numbers = 0.0,
        limits: Numbers | None = None,
        friction: Numbers | None = None,
        armature: Numbers | None = None,
        stiffness: Numbers | None = None,
        rest: Numbers = 0.0,
        mimics: str | None = None,
        ratio: Numbers = 1.0,
        shift: Numbers = 0.0,
        motor: Motor | None = None,
    ):
        """A joint of two bodies of a scene; see the attributes.

        Raises:
            ValueError: If the kind is unknown, a body hangs on itself, the axis or the orientation is zero, a
                shape is wrong, a number is out of range, or the kind has no such thing.
        """
        checked_choice("kind", kind, JOINT_KINDS)
        checked_text("child", child)
        for name, other in (("parent", parent), ("mimics", mimics)):
            if other is not None:
                checked_text(name, other)
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
        self.damping = checked_array(f"damping {what}", damping, (), least=0.0)
        self.friction, self.armature, self.stiffness = (
            None if value is None else checked_array(f"{name} {what}", value, (), least=0.0)
            for name, value in (("friction", friction), ("armature", armature), ("stiffness", stiffness))
        )
        self.limits = None if limits is None else checked_limits(f"limits {what}", limits)
        self.rest = checked_array(f"rest {what}", rest, ())
        self.ratio = checked_array(f"ratio {what}", ratio, ())
        self.shift = checked_array(f"shift {what}", shift, ())
        self.mimics, self.motor = mimics, checked_optional(f"motor {what}", motor, Motor)
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
        coordinates: Of each joint the first place of its own among q, or −1 for a weld; of one that mimics
            another the place of that.
        kinds: Of the joints.
        follows: Whether each mimics another.
        dofs: What joints let bodies do: joint, which of its motions, and place among q of each.
        levels: Joints by their distance from the root of their tree.
        roots: Of each body the place in `free` of the one that its tree stands on, or −1.
        moved_by: Whether a motion of `dofs` moves a body, shape (bodies, dofs).
    """

    bodies: int
    moving: tuple[int, ...]
    free: tuple[int, ...]
    parents: tuple[int, ...]
    children: tuple[int, ...]
    coordinates: tuple[int, ...]
    kinds: tuple[str, ...]
    follows: tuple[bool, ...]
    dofs: tuple[tuple[int, int, int], ...]
    levels: tuple[tuple[int, ...], ...]
    roots: tuple[int, ...]
    moved_by: tuple[tuple[bool, ...], ...]

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


@functools.lru_cache(maxsize=256)
def layout_of(
    names: tuple[str, ...],
    fixed: tuple[bool, ...],
    joints: tuple[tuple[str | None, str, str, str | None], ...],
) -> Layout:
    """The layout of bodies and joints.

    Args:
        names: Names of the bodies.
        fixed: Whether each is fixed.
        joints: Parent, child and kind of each joint, and the child of the joint that it mimics.

    Raises:
        ValueError: If a joint names an unknown body, a body hangs on two joints or is fixed and hangs on one,
            bodies hang on each other in a circle, or a joint mimics none that has one coordinate.
    """
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
    return Layout(len(names), moving, free, *hanging, levels, tuple(roots), moved_by)


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
