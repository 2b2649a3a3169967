"""Free joints of MuJoCo's files that have damping, friction, armature or a spring.

MuJoCo's free joint has the velocity of the frame's origin [W] and the spin [link]. Damping, friction,
armature and springs act on these six. Free bodies of dano have none, but three slides along the axes of the
world and a ball at the frame's origin have just these coordinates: a link on such a joint hangs on those.
"""

import dataclasses
from typing import Any

import numpy as np

from dano.maths import quat_conjugate, quat_log, quat_multiply
from dano.robots._parts import FLOATING
from dano.robots.formats import Connection, Description, Keyframe, Link, Placed

FREE_JOINTS = "free joints"
"""Name by which what acts on free joints is left out."""
_LAWS = ("damping", "friction", "armature", "stiffness")
_AXES = dict(x=(1.0, 0.0, 0.0), y=(0.0, 1.0, 0.0), z=(0.0, 0.0, 1.0))


def laws_of(joint: Connection) -> list[str]:
    """What acts on a free joint; nothing on others."""
    return [law for law in _LAWS if getattr(joint, law)] if joint.kind == FLOATING else []


def without_free_laws(description: Description, *, ignored: bool) -> Description:
    """The description with links that hang on slides and a ball where something acts on a free joint.

    Of a joint NAME they are "NAME x", "NAME y" and "NAME z", the place of the frame's origin [m, W], and
    "NAME", the rotation vector from the pose of the file [rad].

    Args:
        description: What a file says.
        ignored: Whether what acts on free joints is left out; then they stay free.
    """
    links, joints, notes = list(description.links), [], list(description.notes)
    spread: dict[str, Connection] = {}
    for joint in description.joints:
        laws = laws_of(joint)
        if not laws:
            joints.append(joint)
            continue
        if ignored:
            joints.append(dataclasses.replace(joint, damping=0.0, friction=0.0, armature=0.0, stiffness=0.0))
            continue
        spread[joint.child] = joint
        chain = _chain(joint)
        row = next(i for i, link in enumerate(links) if link.name == joint.child)
        links[row:row] = [Link(each.child) for each in chain[:-1]]
        joints += chain
        names = ", ".join(repr(each.name) for each in chain)
        notes.append(
            f"the free joint {joint.name!r} has {' and '.join(laws)}: {joint.child!r} hangs on the joints"
            f" {names}; ignore=[{FREE_JOINTS!r}] leaves that out and lets it move freely"
        )
    if not spread:
        return dataclasses.replace(description, joints=tuple(joints))
    return dataclasses.replace(
        description,
        links=tuple(links),
        joints=tuple(joints),
        notes=tuple(notes),
        keyframes={name: _spread(frame, spread) for name, frame in description.keyframes.items()},
    ).checked()


def _chain(joint: Connection) -> list[Connection]:
    """Three slides and a ball for a free joint."""
    x, y, z = joint.place.position
    laws: dict[str, Any] = {law: getattr(joint, law) for law in _LAWS}
    found, parent = [], joint.parent
    for (axis, direction), home in zip(_AXES.items(), (x, y, z), strict=True):
        name = f"{joint.name} {axis}"
        child = f"{joint.child} after {name}"
        slide = Connection(name, "slide", parent, child, axis=direction, home=home, rest=home, **laws)
        found.append(slide)
        parent = child
    turned = Placed(orientation=joint.place.orientation)
    return [*found, Connection(joint.name, "ball", parent, joint.child, turned, **laws)]


def _spread(frame: Keyframe, spread: dict[str, Connection]) -> Keyframe:
    """A key frame with coordinates of slides and balls for links that hang on some."""
    q, v = ({name: np.asarray(x) for name, x in given.items()} for given in (frame.q, frame.v))
    for link, joint in spread.items():
        position, orientation = frame.places[link]
        velocity, omega = frame.speeds[link]
        for k, axis in enumerate(_AXES):
            name = f"{joint.name} {axis}"
            q[name], v[name] = np.asarray(position[k]), np.asarray(velocity[k])
        shown = quat_conjugate(np.array(joint.place.orientation))
        q[joint.name] = np.asarray(quat_log(quat_multiply(shown, orientation)))
        v[joint.name] = omega
    free = {link: place for link, place in frame.places.items() if link not in spread}
    speeds = {link: speed for link, speed in frame.speeds.items() if link not in spread}
    return Keyframe(q, v, free, speeds)
