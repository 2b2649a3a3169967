"""What a robot's file says: links, what joins them, and what they look like; plain numbers."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dano.maths import quat_from_axis_angle, quat_multiply, quat_rotate
from dano.names import did_you_mean


@dataclass(frozen=True)
class Placed:
    """A place in a frame: position [m] and orientation, wxyz."""

    position: tuple[float, ...] = (0.0, 0.0, 0.0)
    orientation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Solid:
    """A geometry of a link."""

    # "box" (half extents), "sphere" (radius), "cylinder" and "capsule" (radius, half length), "ellipsoid"
    # (half axes), "plane" (none: all below its x and y axes), "mesh" (scales along its axes).
    kind: str
    numbers: tuple[float, ...]  # Its measures [m], or scales [1]
    place: Placed = Placed()  # In the frame of the link
    path: Path | None = None  # Of a mesh that is a file
    # Vertices [m] and faces of a mesh that a reader has read already.
    triangles: tuple[np.ndarray, np.ndarray] | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Link:
    """A link of a robot."""

    name: str  # Unique among links
    mass: float = 0.0  # [kg]; 0 for a link that is only a frame
    com: np.ndarray = field(default_factory=lambda: np.zeros(3))  # Centre of mass [m, frame of the link]
    # About it [kg m², axes of the link], shape (3, 3).
    inertia: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    solids: tuple[Solid, ...] = ()  # What it touches with
    visuals: tuple[Solid, ...] = ()  # What it looks like
    gravcomp: float = 0.0  # Share of its weight that is held [1]


@dataclass(frozen=True)
class Drive:
    """An actuator of a joint, with the numbers of a `dano.Motor`."""

    name: str  # Unique among drives
    kind: str  # "effort", "position" or "velocity"
    stiffness: float = 0.0  # Of "position" [N m/rad or N/m]
    damping: float = 0.0  # Of "position" and "velocity" [N m s/rad or N s/m]
    gear: float = 1.0  # How far it turns when the joint moves by one [1]
    limits: tuple[float, float] = (-np.inf, np.inf)  # Least and largest effort [N m or N]
    commands: tuple[float, float] = (-np.inf, np.inf)  # Least and largest command


@dataclass(frozen=True)
class Connection:
    """A joint of a robot."""

    name: str  # Unique among joints
    kind: str  # "hinge", "slide", "weld", "ball", "planar" or "floating"
    parent: str  # Link that carries it
    child: str  # Link that hangs on it
    place: Placed = Placed()  # Of the child's frame at q = 0, in the parent's
    axis: tuple[float, ...] = (0.0, 0.0, 1.0)  # In the child's frame
    anchor: tuple[float, ...] = (0.0, 0.0, 0.0)  # A point of the axis [m, child's frame]
    limits: tuple[float, float] | None = None  # Least and largest q [rad or m]; None without
    # Least and largest torque or force [N m or N]; infinite without.
    efforts: tuple[float, float] = (-np.inf, np.inf)
    damping: float = 0.0  # [N m s/rad or N s/m]
    friction: float = 0.0  # [N m or N]
    armature: float = 0.0  # [kg m² or kg]
    stiffness: float = 0.0  # Of a spring [N m/rad or N/m]
    rest: float = 0.0  # Where it exerts no force
    home: float = 0.0  # q in the pose that the file shows [rad or m]
    # Name of the joint that it follows, ratio, shift; None if it does not.
    mimics: tuple[str, float, float] | None = None
    drive: Drive | None = None  # Its actuator

    @property
    def effort(self) -> float:
        """Largest torque or force in either direction [N m or N]."""
        return max(map(abs, self.efforts))


@dataclass(frozen=True)
class Keyframe:
    """A state that a file names."""

    q: dict[str, np.ndarray]  # Coordinates of joints by name [rad or m]; of a ball its rotation vector
    v: dict[str, np.ndarray]  # Their velocities
    # Of links that move freely, by name: position [m, W] and orientation wxyz of the link's frame.
    places: dict[str, tuple[np.ndarray, np.ndarray]]
    # Theirs: velocity of the frame's origin [m/s, W] and omega [rad/s, link].
    speeds: dict[str, tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Tie:
    """What closes a loop of a robot: see `dano.Loop`, with links for bodies."""

    kind: str  # "point" or "weld"
    first: str  # A link
    second: str  # Another
    position: tuple[float, ...]  # A point of the first [m, frame of the link]
    anchor: tuple[float, ...]  # The point of the second that stays there
    # Of a weld: of the second link's frame in the first's, wxyz.
    orientation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Lacking:
    """Something in a file that dano has no counterpart of."""

    feature: str  # By which it may be left out
    text: str  # What the file says


class GeomPair(NamedTuple):
    """Two links that touch each other."""

    frictions: tuple[float, ...]  # Sliding frictions of their shapes, different ones
    named: bool  # Whether the file names the pair


@dataclass(frozen=True)
class Description:
    """A robot's file."""

    name: str  # Of the robot
    source: Path  # The file
    links: tuple[Link, ...]  # All links
    joints: tuple[Connection, ...]  # All joints
    ties: tuple[Tie, ...] = ()  # What closes loops
    # Name of the root link if it stands for the world; what is welded to it are things of their own.
    world: str | None = None
    gravity: tuple[float, float, float] | None = None  # [m/s²]; None if the format has none
    lacking: tuple[Lacking, ...] = ()  # What must be left out by name
    notes: tuple[str, ...] = ()  # What was read in another way than it is written, one line each
    keyframes: dict[str, Keyframe] = field(default_factory=dict)  # States that the file names
    # Which links touch each other; None where the format does not say.
    meets: dict[frozenset[str], GeomPair] | None = None
    silent: tuple[str, ...] = ()  # What is not read and changes how it is simulated, one line each

    def link(self, name: str) -> Link:
        """A link by name."""
        return next(link for link in self.links if link.name == name)

    def checked(self) -> "Description":
        """This description, if its joints make one tree of its links.

        Raises:
            ValueError: If names are missing, double or unknown, a link hangs on two joints, links hang on
                each other in a circle, there are two roots, or a joint mimics none.
        """
        where = str(self.source)
        names = _unique(where, "link", [link.name for link in self.links])
        joints = _unique(where, "joint", [joint.name for joint in self.joints])
        if not names:
            raise ValueError(f"{where}: a robot needs at least one link, got none")
        hangs: dict[str, str] = {}
        for joint in self.joints:
            for role in ("parent", "child"):
                link = getattr(joint, role)
                if link not in names:
                    hint = did_you_mean(link, names)
                    raise ValueError(
                        f"{where}: {role} of joint {joint.name!r} must be a link, got {link!r}{hint}"
                    )
            if joint.child in hangs:
                raise ValueError(f"{where}: link {joint.child!r} must hang on one joint, got two")
            hangs[joint.child] = joint.parent
        for name in names:
            at, seen = name, 0
            while at in hangs:
                at, seen = hangs[at], seen + 1
                if seen > len(names):
                    raise ValueError(f"{where}: joints must make a tree, got a circle through link {name!r}")
        roots = [name for name in names if name not in hangs]
        if len(roots) > 1:
            raise ValueError(
                f"{where}: a robot must have one root link, got {len(roots)}: {', '.join(roots)}"
            )
        for link in [link for tie in self.ties for link in (tie.first, tie.second)]:
            if link not in names:
                raise ValueError(f"{where}: a loop must join links, got {link!r}{did_you_mean(link, names)}")
        self._check_mimics(where, joints)
        return self

    def _check_mimics(self, where: str, names: list[str]) -> None:
        kinds = {joint.name: joint for joint in self.joints}
        for joint in self.joints:
            if joint.mimics is None:
                continue
            leader = joint.mimics[0]
            if leader not in names:
                hint = did_you_mean(leader, names)
                raise ValueError(f"{where}: joint {joint.name!r} must mimic a joint, got {leader!r}{hint}")
            if kinds[leader].kind not in ("hinge", "slide") or joint.kind not in ("hinge", "slide"):
                raise ValueError(
                    f"{where}: joint {joint.name!r} must mimic a joint with one coordinate, got {leader!r}, "
                    f"a {kinds[leader].kind}"
                )
            seen, follows = {joint.name}, kinds[leader].mimics
            while follows is not None and leader in kinds:
                if leader in seen:
                    raise ValueError(f"{where}: joints must not mimic each other in a circle, got {leader!r}")
                seen.add(leader)
                leader = follows[0]
                follows = kinds[leader].mimics if leader in kinds else None


def displaced(joint: Connection, q: float) -> Placed:
    """Place of the child's frame in the parent's at a coordinate of a hinge or a slide [rad or m]."""
    position, orientation = np.array(joint.place.position), np.array(joint.place.orientation)
    axis, anchor = np.array(joint.axis) / np.linalg.norm(joint.axis), np.array(joint.anchor)
    if joint.kind == "slide":
        turn, way = np.array([1.0, 0.0, 0.0, 0.0]), q * axis
    else:
        turn = np.asarray(quat_from_axis_angle(axis=axis, angle=q))
        way = anchor - np.asarray(quat_rotate(turn, anchor))
    position = position + np.asarray(quat_rotate(orientation, way))
    turned = np.asarray(quat_multiply(orientation, turn))
    return Placed(tuple(map(float, position)), tuple(map(float, turned)))


def at_home(joint: Connection) -> Placed:
    """Place of the child's frame in the parent's in the pose of the file."""
    return displaced(joint, joint.home) if joint.home else joint.place


def led_by(joints: list[Connection], name: str) -> tuple[str, float, float]:
    """The joint that one follows, through others that follow, too, with ratio and shift; itself if none."""
    named = {joint.name: joint for joint in joints}
    ratio, shift = 1.0, 0.0
    while (mimics := named[name].mimics) is not None:
        name, times, plus = mimics
        ratio, shift = ratio * times, ratio * plus + shift
    return name, ratio, shift


def held_at(joint: Connection, q: float) -> Connection:
    """A hinge or a slide that stays at a coordinate [rad or m]: a weld."""
    return Connection(joint.name, "weld", joint.parent, joint.child, displaced(joint, q))


def without_followers(joints: list[Connection], at: dict[str, float]) -> list[Connection]:
    """The joints, those that follow one which stays where it is held there, too.

    Args:
        joints: All joints.
        at: Coordinates of those that are welds although they could move [rad or m]; it gets those that follow
            them, too.
    """
    joints, held = list(joints), True
    while held:
        held = False
        for row, joint in enumerate(joints):
            if joint.mimics is not None and joint.mimics[0] in at:
                leader, ratio, shift = joint.mimics
                at[joint.name] = ratio * at[leader] + shift
                joints[row], held = held_at(joint, at[joint.name]), True
    return joints


def _unique(where: str, what: str, names: list[str]) -> list[str]:
    for name in names:
        if not name:
            raise ValueError(f"{where}: a {what} must have a name, got {name!r}")
        if names.count(name) > 1:
            raise ValueError(f"{where}: {what}s must have different names, got {name!r} twice")
    return names
