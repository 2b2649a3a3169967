"""From what a robot's file says to bodies and joints."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dano import fields, maths, scene
from dano.checks import shown
from dano.robots import _parts, formats
from dano.robots._dynamics import balanced, chained, Inertial
from dano.robots._geometry import checked_collision, shape_of
from dano.robots._parts import FREE_JOINTS, without_free_laws
from dano.robots._robot import PLANE, Robot

# Radius of what stands for a link without a shape, in pictures only [m].
_MARK = 0.01

Frames = dict[str, tuple[str | None, np.ndarray, np.ndarray]]


def build_robot(
    description: formats.Description,
    *,
    base: maths.Pose | str | None = None,
    prefix: str = "",
    collision: bool | str | Mapping[str, str] = True,
    ignore: str | Sequence[str] = (),
    balance_inertia: bool = False,
) -> Robot:
    """Bodies and joints of what a file says; see `load_urdf`."""
    if not isinstance(prefix, str):
        raise ValueError(f"prefix must be a string, got {shown(prefix)}")
    place = _parts.checked_base(base, description)
    shapes = checked_collision(collision, [link.name for link in description.links])
    ignored = formats.checked_ignore(ignore)
    description = _parts.without_lacking(description, ignored)
    description = without_free_laws(description, ignored=FREE_JOINTS in ignored)
    if balance_inertia:
        description = balanced(description)
    description = _parts.without_weightless(description, ignored)
    parts = _parts.parts_of(description, place)
    weighed = formats.MASSES not in ignored
    inertials = _parts.inertials_of(parts) if weighed else _parts.placeholders_of(parts)
    for note in description.notes:
        warnings.warn(f"{description.source}: {note}", UserWarning, stacklevel=3)
    bodies: list[scene.Body] = []
    frames: Frames = {}
    touching, surroundings = [], []
    places: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    carriers = {joint.parent for joint in description.joints if joint.kind not in ("weld", _parts.FLOATING)}
    for name, members in parts.groups.items():
        made = _bodies(parts, name, prefix, shapes, inertials.get(name), weighed=weighed)
        for link, where in members.items():
            stands = _as_arrays(chained(parts.places[name], where))
            frames[link] = (made[0][0].name, *_as_arrays(where)) if made else (None, *stands)
        for body, touches in made:
            bodies.append(body)
            touching += [body.name] * touches
            if name in parts.fixed | parts.free:
                places[body.name] = _as_arrays(parts.places[name])
            if name in parts.fixed and description.world is not None and not carriers & set(members):
                surroundings.append(body.name)
    moving = [joint for joint in description.joints if joint.kind not in ("weld", _parts.FLOATING)]
    own = [joint for joint in moving if joint.mimics is None]
    return Robot(
        name=description.name,
        bodies=tuple(bodies),
        joints=tuple(_joint(description, joint, frames, prefix) for joint in moving),
        joint_names={joint.name: prefix + joint.child for joint in own},
        frames=frames,
        base=None if place is None else _as_arrays(place),
        efforts={joint.name: _largest_effort(joint) for joint in own},
        touching=tuple(touching),
        description=description,
        loops=tuple(_loop(tie, frames) for tie in _closing(description, frames, moving, prefix, ignored)),
        places=places,
        home={joint.name: joint.home for joint in own},
        gravity=description.gravity,
        drives={joint.drive.name: (joint.name, joint.drive) for joint in own if joint.drive is not None},
        surroundings=tuple(surroundings),
    )


def _bodies(
    parts: _parts.Parts,
    name: str,
    prefix: str,
    shapes: Mapping[str, str],
    inertial: Inertial | None,
    *,
    weighed: bool,
) -> list[tuple[scene.Body, bool]]:
    """The bodies of a group, and whether each has a shape; none for what stands still without one."""
    description = parts.description
    where = f"{description.source}: link {name!r}"
    links = [(description.link(link), place) for link, place in parts.groups[name].items()]
    solids = [
        (solid, place, shapes[link.name])
        for link, place in links
        for solid in link.solids
        if shapes[link.name] != "none"
    ]
    planes = [(solid, place) for solid, place, _ in solids if solid.kind == "plane"]
    shape = shape_of([each for each in solids if each[0].kind != "plane"], where)
    name = prefix + name
    if inertial is None:
        made = [] if shape is None else [(name, shape)]
        made += [
            (name + (PLANE if made or i else ""), _half_space(*each)) for i, each in enumerate(planes[:1])
        ]
        if len(planes) > 1:
            raise ValueError(f"{where}: a link must have one plane, got {len(planes)}")
        return [(scene.Body(what, each, fixed=True), True) for what, each in made]
    if planes:
        raise ValueError(f"{where}: a plane must stand still, got one on a link that moves")
    mass, com, inertia = inertial
    # Those that differ are refused before; links without mass have no weight.
    held = next((link.gravcomp for link, _ in links if link.mass > 0 and link.gravcomp), None)
    geometry = fields.Sphere(_MARK) if shape is None else shape
    try:
        body = scene.Body(name, geometry, mass=mass, com=com, inertia=inertia, gravcomp=held, weighed=weighed)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    return [(body, shape is not None)]


def _half_space(solid: formats.Solid, place: formats.Placed) -> fields.AbstractShape:
    at = chained(place, solid.place)
    normal = formats.rotation_of(at.orientation)[:, 2]
    return fields.HalfSpace(normal, float(normal @ np.array(at.position)))


def _joint(
    description: formats.Description, joint: formats.Connection, frames: Frames, prefix: str
) -> scene.Joint:
    """A joint between bodies: places of links in their bodies are part of its own."""
    parent, position, orientation = frames[joint.parent]
    own = formats.Placed(tuple(map(float, position)), tuple(map(float, orientation)))
    place = _as_arrays(chained(own, joint.place))
    where = f"{description.source}: joint {joint.name!r}"
    options: dict[str, Any] = {}
    for key in ("damping", "friction", "armature", "stiffness"):
        value = getattr(joint, key)
        if value < 0:
            raise ValueError(f"{where}: {key} must be ≥ 0, got {value}")
        if value > 0:
            options[key] = value
    leader = _leader(description, joint)
    if leader is not None:
        options |= {"mimics": prefix + leader[0], "ratio": leader[1], "shift": leader[2]}
    elif joint.kind in ("hinge", "slide") and joint.limits is not None:
        options["limits"] = joint.limits
    if joint.drive is not None:
        drive = joint.drive
        # What the joint lets through of a motor's effort, at the motor.
        least, most = sorted(effort / drive.gear for effort in joint.efforts)
        limits = (max(drive.limits[0], least), min(drive.limits[1], most))
        if limits[0] > limits[1]:
            raise ValueError(
                f"{where}: efforts {joint.efforts} let nothing through of actuator {drive.name!r}, whose"
                f" force is between {drive.limits[0]} and {drive.limits[1]}"
            )
        options["motor"] = scene.Motor(
            drive.kind, stiffness=drive.stiffness, damping=drive.damping, gear=drive.gear, limits=limits
        )
    try:
        return scene.Joint(
            parent,
            prefix + joint.child,
            joint.kind,
            axis=joint.axis,
            anchor=joint.anchor,
            position=place[0],
            orientation=place[1],
            rest=joint.rest,
            **options,
        )
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def _largest_effort(joint: formats.Connection) -> float:
    if joint.drive is None:
        return joint.effort
    return min(joint.effort, abs(joint.drive.gear) * max(map(abs, joint.drive.limits)))


def _closing(
    description: formats.Description,
    frames: Frames,
    moving: Sequence[formats.Connection],
    prefix: str,
    ignored: Sequence[str],
) -> list[formats.Tie]:
    """The ties of which at least one body hangs on a joint.

    Raises:
        ValueError: If there are others that are not to be left out.
    """
    hanging = {prefix + joint.child for joint in moving}
    found = []
    for tie in description.ties:
        if {frames[tie.first][0], frames[tie.second][0]} & hanging:
            found.append(tie)
        elif formats.EQUALITIES not in ignored:
            raise ValueError(
                f"{description.source}: an equality ties {tie.first!r} and {tie.second!r}, and neither hangs"
                f" on a joint: dano ties chains of joints; ignore=[{formats.EQUALITIES!r}] leaves it out"
            )
    return found


def _loop(tie: formats.Tie, frames: Frames) -> scene.Loop:
    """A loop between bodies: places of links in their bodies are part of its own."""
    (first, *place), (second, *other) = frames[tie.first], frames[tie.second]
    points = [_moved((p, q), formats.Placed(x)) for (p, q), x in ((place, tie.position), (other, tie.anchor))]
    turn = maths.quat_multiply(
        maths.quat_multiply(place[1], np.array(tie.orientation)), maths.quat_conjugate(other[1])
    )
    if second is None:
        first, second, points, turn = second, first, points[::-1], maths.quat_conjugate(turn)
    if second is None:
        raise ValueError(f"loop must join links that move, got {tie.first!r} and {tie.second!r}")
    return scene.Loop(first, second, tie.kind, position=points[0][0], anchor=points[1][0], orientation=turn)


def _leader(description: formats.Description, joint: formats.Connection) -> tuple[str, float, float] | None:
    """The child of the joint that one mimics, through others that mimic, too; with ratio and shift."""
    ratio, shift, at = 1.0, 0.0, joint
    named = {each.name: each for each in description.joints}
    while at.mimics is not None:
        name, times, plus = at.mimics
        ratio, shift, at = ratio * times, ratio * plus + shift, named[name]
    return None if at is joint else (at.child, ratio, shift)


def _as_arrays(place: formats.Placed) -> tuple[np.ndarray, np.ndarray]:
    return np.array(place.position), np.array(place.orientation)


def _moved(frame: tuple[np.ndarray, np.ndarray], place: formats.Placed) -> tuple[np.ndarray, np.ndarray]:
    position, orientation = (tuple(map(float, x)) for x in frame)
    return _as_arrays(chained(formats.Placed(position, orientation), place))
