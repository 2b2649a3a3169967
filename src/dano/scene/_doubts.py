"""What is odd about a scene or a state, and hints at other units, another frame or a slip: said once.

Every doubt is a test of numbers that are there anyway. None is made of traced values. Bodies whose inertia is
that of something larger than their shape are not judged by their shape, nor are links that touch nothing.
"""

import math
import warnings
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from dano.fields import HalfSpace
from dano.maths import is_traced, quat_rotate
from dano.names import see
from dano.scene._bodies import Body, by_geometry, sizes_of
from dano.scene._contacts import Contact
from dano.scene._frames import RESOLVED
from dano.scene._joints import Joint, StateLayout
from dano.scene._states import State

MOST_SAID = 3
"""Doubts of one thing that are said at once, the worst first."""
LIGHTEST, HEAVIEST = 0.1, 25e3
"""Densities [kg/m³] far below that of air (1.2), and above that of osmium (22,600), which no body exceeds."""
_LONGEST = 20.0
"""Size [m] of a body that moves, from which it is rather in millimetres."""
_THINNEST = 1e-4
"""Share of its size below which a body is thinner than its samples can tell."""
_NO_LENGTHS = ("normal", "offset", "rounding")
_STRONGEST = 100.0
"""Gravity [m/s²] beyond that of all planets, and of centrifuges for people."""
_FAR = 3.0
"""Sizes from a body's middle at which an anchor, or a centre of mass, is rather given in another frame."""
_WIDEST_EDGE = 1.0
"""Share of a shape's thickness from which the smooth edge reaches through it."""
_COARSE = 1e-3
"""Share of a body's size by which places may be rounded."""
_SHORTEST = 1e-7
"""Timestep [s] below which it is rather given in another unit."""
_TURNS = 10.0
"""Whole numbers beyond these, as limits of a hinge, are rather degrees [rad]."""
_LEAPS = 10.0
"""Sizes that a body goes in a step from which its speed is rather in other units."""
_ROUGHEST = 5.0
"""Sliding friction beyond that of rubber on rubber, and of racing tyres."""
_SOFT = 0.1
"""Share of its size by which a body sinks that is too soft: twenty times that of the default."""
_DEEP = 0.1
"""Share of its thickness by which a body may begin in a fixed one; at rest it is less than a hundredth."""


class SceneDoubt(NamedTuple):
    """Something odd."""

    rank: int  # The lowest is said first
    text: str  # In one line
    subject: str = "sizes"  # "sizes": units, frames and slips; "spin" or "start"


class SceneWarning(UserWarning):
    """Something odd about a scene or a state, which is made all the same."""


def say_doubts(doubts: Sequence[SceneDoubt], stacklevel: int) -> None:
    """Warn of the worst, and of how many more there are."""
    ordered = sorted(doubts)
    for place, doubt in enumerate(ordered[:MOST_SAID]):
        left = len(ordered) - MOST_SAID
        more = f" (and {left} more: `dano check` lists them)" if left > 0 and place == MOST_SAID - 1 else ""
        warnings.warn(doubt.text + more, SceneWarning, stacklevel=stacklevel + 1)


def doubts_of_scene(
    bodies: Sequence[Body],
    joints: Sequence[Joint],
    contacts: Sequence[Contact],
    gravity: Float[Array, "3"],
    meeting: Collection[str],
) -> list[SceneDoubt]:
    """What is odd about what stays constant.

    Args:
        bodies: All bodies.
        joints: All joints.
        contacts: Those that are named.
        gravity: [m/s²].
        meeting: Names of the bodies that may touch something. The shape of what hangs on a joint, or carries
            one, and touches nothing is only seen: a mark of a link, mostly.
    """
    linked = {name for joint in joints for name in (joint.parent, joint.child)}
    seen = linked - set(meeting)
    found = []
    if len(bodies) > 1 and all(body.fixed for body in bodies):
        found.append(SceneDoubt(2, "nothing moves: all bodies are fixed"))
    for contact in contacts:
        mu = contact.params.sliding_friction
        if not is_traced(mu) and float(mu) > _ROUGHEST:
            text = (
                f"sliding_friction {float(mu):.3g} of {contact.a!r} and {contact.b!r} is more than any pair"
            )
            found.append(SceneDoubt(3, f"{text} has: it is a ratio of forces, not an angle"))
        found += _too_soft(contact, bodies, gravity)
    judged = [
        body
        for body in bodies
        if not body.fixed
        and body.name not in seen
        and not is_traced(body.shape, body.object, body.mass, body.mass_scale, body.inertia)
    ]
    boxes, sizes = by_geometry(_bounds, judged), sizes_of(judged).tolist()
    for body, box, size in zip(judged, boxes, sizes, strict=True):
        found += _of_body(body, box, size)
    by_name = {body.name: body for body in bodies}
    for joint in joints:
        if not is_traced(joint):
            found += _of_joint(joint, None if joint.child in seen else by_name[joint.child])
    if not is_traced(gravity) and float(np.linalg.norm(np.asarray(gravity))) > _STRONGEST:
        strength = float(np.linalg.norm(np.asarray(gravity)))
        found.append(SceneDoubt(1, f"gravity is {strength:.4g} m/s²: that of the earth is 9.81"))
    if not is_traced(gravity) and float(gravity[2]) > 0 and float(abs(gravity[:2]).max()) == 0:
        found.append(SceneDoubt(1, f"gravity points up, {float(gravity[2]):.3g} m/s² along z: z is up"))
    return found


def _too_soft(contact: Contact, bodies: Sequence[Body], gravity: Float[Array, "3"]) -> list[SceneDoubt]:
    """Whether a body sinks deep into what it rests on, by the stiffness that was given."""
    stiffness, found = contact.params.stiffness, []
    if stiffness is None or is_traced(stiffness, gravity):
        return found
    for body in bodies:
        if body.name not in (contact.a, contact.b) or body.fixed or body.surface is None:
            continue
        if is_traced(body.surface, body.mass, body.mass_scale, body.scale) or not np.isfinite(body.size):
            continue
        weight = float(body.mass * body.mass_scale) * float(np.linalg.norm(np.asarray(gravity)))
        other = contact.b if body.name == contact.a else contact.a
        if float(stiffness) * body.typical_support(_SOFT * body.size) < weight:
            found.append(
                SceneDoubt(
                    3,
                    f"{body.name!r} sinks by more than {100 * _SOFT:.0f} % of its size where it rests: its"
                    f" stiffness of {float(stiffness):.3g} Pa/m with {other!r} is small",
                )
            )
    return found


def is_homogeneous(body: Body) -> bool:
    """Whether a body's mass can lie within its shape: its radius of gyration is not larger than that."""
    return _gyration(body) <= body.size


def _gyration(body: Body) -> float:
    """Radius of gyration [m]."""
    mass = float(body.mass)
    return math.sqrt(max(float(np.trace(np.asarray(body.inertia, np.float64))), 0.0) / (2 * mass))


def box_volume(body: Body) -> float:
    """Volume [m³] of the box around a body."""
    return float(np.prod(_extents(body)))


def density_doubt(body: Body, box: Float[np.ndarray, "2 3"], size: float) -> str | None:
    """What to say of a body that is lighter than air or heavier than any metal, for the box around it."""
    mass, volume = float(body.mass) * float(body.mass_scale), float(np.prod(np.ptp(box, axis=0)))
    density = mass / max(volume, 1e-300)
    if LIGHTEST <= density <= HEAVIEST or _gyration(body) > size:
        return None
    than = "more than any metal has" if density > 1 else "less than air has"
    return (
        f"{body.name!r} is {size:.3g} m long and has {mass:.3g} kg, {density:.2g} kg/m³ of the box"
        f" around it, {than}; are its lengths in metres and its mass in kilograms?"
    )


def _extents(body: Body) -> Float[np.ndarray, "3"]:
    return np.ptp(_bounds(body), axis=0)


def _bounds(body: Body) -> Float[np.ndarray, "2 3"]:
    """Lower and upper corner of the box around a body [m, F]."""
    if body.object is not None:
        points = np.asarray(body.object.surface.points, np.float64)
        return np.stack([points.min(axis=0), points.max(axis=0)])
    assert body.shape is not None
    return np.asarray(body.shape.bounds, np.float64)


def _of_body(body: Body, box: Float[np.ndarray, "2 3"], size: float) -> list[SceneDoubt]:
    """What is odd about a body, with the box around it [m, F] and its size [m]."""
    found = []
    if (text := density_doubt(body, box, size)) is not None:
        found.append(SceneDoubt(0, text))
    elif _LONGEST < size < np.inf:
        found.append(SceneDoubt(0, f"{body.name!r} is {size:.3g} m long: are its lengths in metres?"))
    if (away := _beside(body, box)) > _FAR * size:
        text = (
            f"the centre of mass of {body.name!r} lies {away:.3g} m beside its shape, {away / size:.2g}"
            " times its size: it is a point of the body's own frame"
        )
        found.append(SceneDoubt(3, text))
    thin = _thickness(body)
    edge = getattr(body.shape, "edge", None)
    if edge is not None and not is_traced(edge) and float(edge) > _WIDEST_EDGE * thin:
        text = f"the edge of {body.name!r} is {float(edge):.3g} m wide and its shape {thin:.3g} m thick"
        found.append(SceneDoubt(3, f"{text}: it has no inside"))
    if thin < _THINNEST * size:
        text = f"{body.name!r} is {thin:.2g} m thick and {size:.2g} m long: too thin for its samples"
        found.append(SceneDoubt(5, text))
    return found


def _beside(body: Body, box: Float[np.ndarray, "2 3"]) -> float:
    """How far the centre of mass lies beside the box around a body [m]; 0 of what has none or is endless."""
    if not np.all(np.isfinite(box)) or is_traced(body.com):
        return 0.0
    low, high = box
    com = np.asarray(body.com, np.float64)
    return float(np.linalg.norm(np.maximum(0, np.maximum(low - com, com - high))))


def _thickness(body: Body) -> float:
    """Least extent [m] of a shape, without the width of its edge; infinite of what is no plain shape."""
    names = [name for name in getattr(body.shape, "takes", ()) if name not in _NO_LENGTHS]
    return min((2 * float(np.min(np.asarray(getattr(body.shape, name)))) for name in names), default=np.inf)


def _of_joint(joint: Joint, body: Body | None) -> list[SceneDoubt]:
    """Limits in degrees, and anchors far from a body; None for one that is not judged by its shape."""
    found = []
    if joint.kind == "hinge" and joint.limits is not None:
        ends = np.asarray(joint.limits, np.float64)
        finite = ends[np.isfinite(ends)]
        whole = finite.size and np.all(finite == np.round(finite))
        if whole and np.abs(finite).max() > _TURNS:
            turns = np.abs(finite).max() / (2 * np.pi)
            found.append(
                SceneDoubt(
                    2,
                    f"limits of the hinge of {joint.child!r}, {ends[0]:g} to {ends[1]:g} rad, are"
                    f" {turns:.3g} turns: are they in degrees?",
                )
            )
    if body is None:
        return found
    shown = body.shape if body.object is None else body.object.solid
    # A robot's link may hang on an axis far from what it is seen by.
    if shown is not None and np.isfinite(body.size) and is_homogeneous(body) and not is_traced(body.com):
        anchor = np.asarray(joint.anchor, np.float64) - np.asarray(body.com, np.float64)
        away = float(np.linalg.norm(anchor))
        if joint.kind != "weld" and away > _FAR * body.size:
            found.append(
                SceneDoubt(
                    3,
                    f"the anchor of the joint of {joint.child!r} lies {away:.3g} m from the body's middle,"
                    f" {away / body.size:.2g} times its size: it is a point of the body's own frame",
                )
            )
    return found


def doubts_of_state(
    bodies: Sequence[Body],
    pairs: Int[np.ndarray, "k 2"],
    layout: StateLayout,
    state: State,
    timestep: float,
) -> list[SceneDoubt]:
    """What is odd about how bodies stand and move.

    Args:
        bodies: Of the scene.
        pairs: Indices of the bodies that may touch.
        layout: Of the scene.
        state: The state.
        timestep: [s].
    """
    found = []
    position, speeds = np.asarray(state.position, np.float64), np.asarray(state.velocity, np.float64)
    spins, orientation = np.asarray(state.omega, np.float64), np.asarray(state.orientation, np.float64)
    rounding = float(np.finfo(state.position.dtype).eps)
    sizes = sizes_of(bodies).tolist()
    for i in layout.free:
        body, size = bodies[i], sizes[i]
        far = float(np.abs(position[i]).max())
        if np.isfinite(size) and far * rounding > _COARSE * size:
            apart = f"where numbers are {far * rounding:.1g} m apart"
            text = f"{body.name!r} lies {far:.3g} m from the origin, {apart}"
            found.append(SceneDoubt(2, f"{text}: is its position in metres?"))
        way = float(np.linalg.norm(speeds[i])) * timestep
        if np.isfinite(size) and way > _LEAPS * size and way > 0:
            found.append(
                SceneDoubt(
                    1,
                    f"{body.name!r} goes {way:.3g} m in a step, {way / size:.2g} times its size: is its"
                    " velocity in m/s?",
                )
            )
        spin = float(np.linalg.norm(spins[i]))
        if spin * timestep > 2 * RESOLVED:
            found.append(
                SceneDoubt(
                    1,
                    f"{body.name!r} turns by {math.degrees(spin * timestep):.0f}° in a step, more than 60°:"
                    f" its precession is not resolved; use a timestep of {2 * RESOLVED / spin:.2g} s, or is"
                    " omega in rad/s?",
                    "spin",
                )
            )
    turns = orientation[list(layout.free)]
    # One among others is meant so.
    if len(turns) and np.all(turns == np.array([0.0, 0.0, 0.0, 1.0])):
        names = ", ".join(repr(bodies[i].name) for i in layout.free[:3])
        text = f"orientation [0, 0, 0, 1] of {names} is a half turn about z: quaternions are wxyz"
        found.append(SceneDoubt(4, f"{text}, and no turn is [1, 0, 0, 0]"))
    found += _of_coordinates(bodies, layout, state)
    if timestep < _SHORTEST:
        text = (
            f"timestep {timestep:.3g} s is short: a second takes {1 / timestep:.2g} steps; is it in seconds?"
        )
        found.append(SceneDoubt(3, text))
    for i, body in enumerate(bodies):
        if body.fixed and (np.any(speeds[i]) or np.any(spins[i])):
            found.append(SceneDoubt(3, f"{body.name!r} is fixed: the velocity of its state moves nothing"))
    floors = [i for i, body in enumerate(bodies) if isinstance(body.shape, HalfSpace)]
    for i, j in pairs[np.isin(pairs, floors).any(axis=1)].tolist():
        found += _begins_inside(bodies, position, orientation, i, j)
    return found


def _of_coordinates(bodies: Sequence[Body], layout: StateLayout, state: State) -> list[SceneDoubt]:
    """Angles of hinges that are rather in degrees."""
    found = []
    for joint, _, place in layout.dofs:
        if state.q is None or layout.kinds[joint] != "hinge" or layout.follows[joint]:
            continue
        q = float(state.q[place])
        if abs(q) > _TURNS and q == round(q):
            name, turns = bodies[layout.children[joint]].name, abs(q) / (2 * np.pi)
            found.append(SceneDoubt(4, f"q of {name!r} is {q:g} rad, {turns:.3g} turns: is it in degrees?"))
    return found


def _begins_inside(
    bodies: Sequence[Body],
    position: Float[np.ndarray, "n 3"],
    orientation: Float[np.ndarray, "n 4"],
    i: int,
    j: int,
) -> list[SceneDoubt]:
    """Whether a body's lowest point is far below a half-space."""
    found = []
    for k, other in ((i, j), (j, i)):
        body, floor = bodies[k], bodies[other]
        if not isinstance(floor.shape, HalfSpace) or body.fixed or not np.isfinite(body.size):
            continue
        plane = floor.half_space_at(position[other], orientation[other])
        if plane is None or body.surface is None or is_traced(body.surface, plane[0]):
            continue
        normal, offset = plane
        points = (np.asarray(body.scale)[:, None] * np.asarray(body.surface.points)[:3]).T
        points = points - (np.asarray(body.com) + np.asarray(body.com_offset))
        turned = np.asarray(quat_rotate(orientation[k][None], points))
        depth = offset - float(((position[k] + turned) @ normal).min())
        if depth > _DEEP * float(_extents(body).min()):
            text = f"{body.name!r} begins {depth:.3g} m inside {floor.name!r}: it will be pushed out"
            if body.object is not None:
                text += " (position is the centre of mass; origin= places the file's own origin)"
            found.append(SceneDoubt(1, f"{text}; {see('a-body-begins-inside-another')}", "start"))
    return found
