"""What the steps of a scene will not resolve, estimated before it is simulated.

Speeds are bounded from the initial state: a body falls from where it starts to the lowest fixed body that it
may touch, v = √(v₀² + 2 g H), or for all of the simulated time if there is none.

What is odd about an object that was built of a field, or about a run that a file asks for, in words.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from dano.contact import CentroidLaw, DistributedLaw, Patch, STANDARD_GRAVITY
from dano.fields import AbstractField, GridField
from dano.names import see
from dano.objects import NeuralObject
from dano.scene import Body, box_volume, Contact, RESOLVED, Scene, SceneDoubt, State
from dano.scene_file._schedule import Schedule

_ROUNDED = 1e-6
"""Share of a duration by which steps may miss it unsaid: rounding."""

_MOST_WEIGHTS = 1e4
"""Weights of a body beyond which a force on it is doubted."""

_SHORT, _LONG = 1e-3, 5.0
"""Sizes [m] beyond which an object is rather in other units than so large or small."""


def mass_doubt(made: NeuralObject, dashes: str) -> str:
    """What to say where no mass was given."""
    return (
        f"no mass was given: the object has {float(made.mass.mass):.3g} kg by the default, 1 kg per unit of"
        f" density and cubic metre; give {dashes}mass or {dashes}mass{'-' if dashes else '_'}scale"
    )


def size_doubts(size: float, option: str) -> list[str]:
    """What to say of a size [m], if it hints at other units than metres.

    Args:
        size: Longest extent of an object.
        option: Name of the option that takes the right one.
    """
    if _SHORT <= size <= _LONG:
        return []
    likely = f" ({size / 1000:.3g} if it is in millimetres)" if size > _LONG else ""
    return [
        f"the object is {size:.3g} m long; if its field is not in metres, give {option}, its longest"
        f" extent [m]{likely}"
    ]


def border_doubts(field: AbstractField, points: np.ndarray) -> list[str]:
    """What to say of a grid that ends within the object.

    Args:
        field: What the object was made of.
        points: Points on its surface [m, F], shape (n, 3).
    """
    if not isinstance(field, GridField):
        return []
    origin, spacing = np.asarray(field.origin, np.float64), np.asarray(field.spacing, np.float64)
    last = origin + spacing * (np.array(field.shape) - 1)
    # The density of a node on the border falls to zero over the next cells: only there is surface beyond it.
    below = np.min(points - origin, axis=0) < -0.2 * spacing
    above = np.max(points - last, axis=0) > 0.2 * spacing
    sides = [f"−{axis}" for axis, cut in zip("xyz", below, strict=True) if cut]
    sides += [f"+{axis}" for axis, cut in zip("xyz", above, strict=True) if cut]
    if not sides:
        return []
    return [
        f"the object is cut off where its grid ends, at {', '.join(sides)}; take a larger part of the field,"
        " as with a larger crop (`dano import --crop`)"
    ]


def file_doubts(
    scene: Scene, state: State, schedule: Schedule | None, n_steps: int, asked: float | None
) -> list[SceneDoubt]:
    """What to say of a run: that controls begin too late, that its length is rounded, that bodies fall.

    Args:
        scene: The scene.
        state: Where the run begins.
        schedule: Controls.
        n_steps: Steps of the run.
        asked: Its length by the file [s], if that says one.
    """
    h, found = float(scene.timestep), []
    duration = h * n_steps
    starts = [] if schedule is None else np.asarray(schedule.start, np.float64).tolist()
    for i, start in enumerate(starts):
        if start >= duration:
            text = (
                f"[[controls]] {i + 1} never acts: it begins at {start:.4g} s, and {duration:.4g} s are run"
            )
            found.append(SceneDoubt(2, text))
    found += [] if schedule is None else _of_forces(scene, schedule)
    if asked is not None and abs(duration - asked) > _ROUNDED * asked:
        text = f"duration {asked:.6g} s is no whole number of steps of {h:.6g} s: {duration:.6g} s are run"
        found.append(SceneDoubt(3, text))
    if len(scene.bodies) > 1:
        limits = bounds(scene, scene.filled(state), duration)
        found += [SceneDoubt(2, finding.text) for finding in support(scene, limits)]
    return found


def _of_forces(scene: Scene, schedule: Schedule) -> list[SceneDoubt]:
    """Forces that are thousands of times a body's weight."""
    found = []
    for i, (row, force) in enumerate(zip(schedule.body.tolist(), np.asarray(schedule.force), strict=True)):
        body, size = scene.bodies[row], float(np.linalg.norm(force))
        weight = float(body.mass * body.mass_scale) * STANDARD_GRAVITY
        if not body.fixed and size > _MOST_WEIGHTS * weight:
            text = (
                f"[[controls]] {i + 1} pushes {body.name!r} with {size:.3g} N, {size / weight:.2g} times its"
            )
            found.append(SceneDoubt(2, f"{text} weight on earth: is it in newtons?"))
    return found


_STEPS_AN_IMPACT = 20
"""Steps that a spring needs to turn an impact round (see `DistributedLaw`)."""
_MASS_RATIO = 1e3
"""Measured: a box on one of a 1000th of its mass is solved in two passes a step, on a 10,000th no longer."""
_WAY_PER_WALL = 1e3
"""Measured: the distributed law finds walls of a 2000th of the way in a step, and not of a 4000th."""
_SINKING = 0.005
"""Share of its size by which a body at rest sinks at default stiffness (see `DistributedLaw`)."""
_INSIDE = 2e-3
"""Share of its volume by which a body may start in another: ten times what it sinks by at rest, see above."""


class Finding(NamedTuple):
    """Something that a scene's steps do not resolve, or that is odd."""

    subject: str  # start, support, impacts, spin, walls, masses, sizes, samples, timestep, file or solver
    text: str  # What it is and what would help, in words


class SpeedBound(NamedTuple):
    """Largest motion of a body, see the module."""

    speed: float  # Of its centre of mass [m/s]
    spin: float  # [rad/s]
    falls: bool  # Whether nothing that it may touch is fixed below it


def bounds(scene: Scene, state: State, duration: float) -> list[SpeedBound]:
    """Largest motion of each body, from the initial state and the height that it can fall."""
    gravity = np.asarray(scene.gravity, np.float64)
    strength = float(np.linalg.norm(gravity))
    found = []
    for i, body in enumerate(scene.bodies):
        speed, spin = (float(np.linalg.norm(np.asarray(x[i]))) for x in (state.velocity, state.omega))
        if body.fixed or i not in scene.layout.free or strength == 0.0:
            found.append(SpeedBound(0.0 if body.fixed else speed, 0.0 if body.fixed else spin, False))
            continue
        down = gravity / strength
        partners = _fixed_partners(scene, i)
        heights = [h for other in partners if (h := _height(scene, state, i, other, down)) is not None]
        falls = not heights
        gained = strength * duration if falls else 0.0
        reached = speed + gained if falls else math.sqrt(speed**2 + 2 * strength * min(heights))
        found.append(SpeedBound(reached, spin, falls))
    return found


def _fixed_partners(scene: Scene, i: int) -> list[int]:
    """Fixed bodies that a body may touch, itself or by way of others that it may touch."""
    pairs = [(scene.index(a), scene.index(b)) for a, b in scene.pairs]
    reached, front = {i}, [i]
    while front:
        j = front.pop()
        # What is fixed carries, and passes nothing on.
        for k in () if scene.bodies[j].fixed else (x for pair in pairs if j in pair for x in pair):
            if k not in reached:
                reached.add(k)
                front.append(k)
    return [j for j in sorted(reached) if scene.bodies[j].fixed]


def _height(scene: Scene, state: State, i: int, other: int, down: np.ndarray) -> float | None:
    """How far [m] a body's middle can fall to a fixed one; None if that is not below it."""
    position = np.asarray(state.position, np.float64)
    body = scene.bodies[other]
    if np.isfinite(body.size):
        way = float((position[other] - position[i]) @ down)
        return way + 0.5 * body.size if way + body.size > 0 else None
    solid, from_it = body.shape, position[i] - position[other]
    assert solid is not None
    inside, further = (
        float(solid.sdf(jnp.asarray(from_it + s * down, scene.timestep.dtype))) for s in (0.0, 1.0)
    )
    closing = inside - further
    # A body whose middle is in it already, but not all of it, falls no further: what `starts` says.
    is_above = inside > -0.5 * scene.bodies[i].size
    return max(inside, 0.0) / closing if is_above and closing > 0.05 else None


def forecast(scene: Scene, state: State, limits: list[SpeedBound]) -> list[Finding]:
    """What will not be resolved, from numbers alone."""
    return [
        *support(scene, limits),
        # Where bodies start is measured, see `starts`.
        *(Finding(x.subject, x.text) for x in scene.doubts(state) if x.subject != "start"),
        *(finding for contact in scene.contacts for finding in _pair(scene, state, contact, limits)),
        *_masses(scene),
        *_samples(scene),
    ]


def support(scene: Scene, limits: list[SpeedBound]) -> list[Finding]:
    """Bodies that touch nothing, or have nothing below."""
    touched = {name for pair in scene.pairs for name in pair}
    found = []
    for i in scene.layout.free:
        name = scene.names[i]
        if name not in touched:
            found.append(
                Finding("support", f"{name!r} touches nothing: no contact names it; {see('nothing-touches')}")
            )
        elif limits[i].falls:
            text = f"nothing fixed that {name!r} may touch is below it: it may fall without end"
            found.append(Finding("support", f"{text}; {see('a-body-falls-through')}"))
    return found


def too_fast(turn: Any) -> Any:
    """Whether a body that would turn by so much in a step [rad], one or many, turns by more than 60°."""
    return turn > 2 * RESOLVED


def fast_spin(name: str, verb: str, spin: float, h: float) -> Finding:
    """What is said of a body that turns too far in a step.

    Args:
        name: Of the body.
        verb: What it does: "turns", or "comes to turn".
        spin: [rad/s].
        h: Timestep [s].
    """
    return Finding(
        "spin",
        f"{name!r} {verb} by {math.degrees(spin * h):.0f}° in a step, more than 60°: its precession is not"
        f" resolved; use a timestep of {2 * RESOLVED / spin:.2g} s",
    )


def _pair(scene: Scene, state: State, contact: Contact, limits: list[SpeedBound]) -> list[Finding]:
    a, b = scene.index(contact.a), scene.index(contact.b)
    return [*_impact(scene, contact, limits[a].speed + limits[b].speed), *_wall(scene, contact, limits)]


def _impact(scene: Scene, contact: Contact, speed: float) -> list[Finding]:
    h, pair = float(scene.timestep), f"{contact.a!r} and {contact.b!r}"
    law, params = contact.law, contact.params
    if isinstance(law, CentroidLaw):
        edge = float(contact.edge or 0.0)
        if speed * h <= edge:
            return []
        return [
            Finding(
                "impacts",
                f"{pair} meet at up to {speed:.2g} m/s and go {1e3 * speed * h:.2g} mm in a step, more"
                f" than the edge ({1e3 * edge:.2g} mm): how hard they push depends on where in a step they"
                f' meet; use a timestep of {edge / speed:.1g} s, a wider edge or law = "distributed"',
            )
        ]
    if not isinstance(law, DistributedLaw):
        return []
    if law.compliant:
        # At rest there is no impact.
        if speed == 0.0:
            return []
        period = scene.impact_duration(contact.a, contact.b, speed)
        if period >= _STEPS_AN_IMPACT * h:
            return []
        return [
            Finding(
                "impacts",
                f"an impact of {pair} lasts {period:.2g} s, {period / h:.2g} steps, and a spring"
                f" (compliant) needs {_STEPS_AN_IMPACT}; use a timestep of"
                f" {period / _STEPS_AN_IMPACT:.1g} s",
            )
        ]
    slow = float(params.restitution_velocity) + float(np.linalg.norm(np.asarray(scene.gravity))) * h
    if float(params.restitution) == 0.0 or speed == 0.0 or speed > slow:
        return []
    return [
        Finding(
            "impacts",
            f"{pair} meet at up to {speed:.2g} m/s and bounce by restitution only from {slow:.2g} m/s on:"
            " they will bounce less; use a smaller timestep or restitution_velocity",
        )
    ]


def _wall(scene: Scene, contact: Contact, limits: list[SpeedBound]) -> list[Finding]:
    h = float(scene.timestep)
    a, b = (scene.index(name) for name in (contact.a, contact.b))
    way = (limits[a].speed + limits[b].speed) * h
    depths = {scene.names[i]: _half_thickness(scene.bodies[i]) for i in (a, b)}
    if isinstance(contact.law, DistributedLaw):
        most = _WAY_PER_WALL * 2 * min(depths.values())
    else:
        # Beyond the middle of both, normals push to the far side.
        most = 0.5 * sum(depths.values())
    if way <= most:
        return []
    thin = min(depths, key=depths.__getitem__)
    return [
        Finding(
            "walls",
            f"{contact.a!r} and {contact.b!r} come up to {1e3 * way:.3g} mm closer in a step, and {thin!r} is"
            f" {2e3 * depths[thin]:.2g} mm thick: one may pass through the other; use a timestep of"
            f" {h * most / way:.1g} s",
        )
    ]


def _half_thickness(body: Body) -> float:
    return float((body.measured() if body.extent is None else body.extent)[5])


def _masses(scene: Scene) -> list[Finding]:
    masses = {body.name: float(body.mass * body.mass_scale) for body in scene.bodies if not body.fixed}
    found = []
    for a, b in scene.pairs:
        if a not in masses or b not in masses:
            continue
        light, heavy = sorted((a, b), key=masses.__getitem__)
        ratio = masses[heavy] / masses[light]
        if ratio > _MASS_RATIO:
            found.append(
                Finding(
                    "masses",
                    f"{heavy!r} has {ratio:.3g} times the mass of {light!r}: steps in which it lies on it"
                    f" may not converge (up to {_MASS_RATIO:.0f} times they do)",
                )
            )
    return found


def _samples(scene: Scene) -> list[Finding]:
    """Bodies whose samples are so far apart that a round body sinks deeper between them than it does at rest.

    Between samples at a distance s a ball of diameter D reaches s²/(4 D) below the chord.
    """
    touched = {name for pair in scene.pairs for name in pair}
    found = []
    for body in scene.bodies:
        if body.object is None or body.name not in touched:
            continue
        areas = np.asarray(body.object.surface.areas, np.float64)
        spacing = math.sqrt(float(areas.sum()) / len(areas))
        if spacing**2 / (4 * body.size) > _SINKING * body.size:
            enough = math.ceil(float(areas.sum()) / (4 * _SINKING * body.size**2))
            found.append(
                Finding(
                    "samples",
                    f"{body.name!r} has {len(areas)} surface samples, {1e3 * spacing:.2g} mm apart: it will"
                    f" lie on single ones; use at least {enough}, better {10 * enough}",
                )
            )
    return found


def starts(scene: Scene, patches: Sequence[Patch]) -> list[Finding]:
    """Bodies that begin inside each other.

    Args:
        scene: The scene.
        patches: Overlap of each pair at the initial state, arrays of shape (1,): `contact_patches`.
    """
    found = []
    for k, ((a, b), patch) in enumerate(zip(scene.pairs, patches, strict=True)):
        moving = [body for body in (scene.body(a), scene.body(b)) if not body.fixed]
        # The distributed law gives a volume, the centroid law a mass.
        volumes = k >= len(scene.contacts) or scene.contacts[k].law.presses
        whole = min(box_volume(body) if volumes else float(body.mass * body.mass_scale) for body in moving)
        share = float(patch.overlap[0]) / whole
        if share > _INSIDE:
            text = f"{a!r} and {b!r} start inside each other, by {100 * share:.2g} % of the smaller one"
            found.append(
                Finding("start", f"{text}: they will be pushed apart; {see('a-body-begins-inside-another')}")
            )
    return found
