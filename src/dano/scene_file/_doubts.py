"""What is odd about an object that was built of a field, or about a run that a file asks for, in words."""

import numpy as np

from dano.contact import STANDARD_GRAVITY
from dano.fields import AbstractField, GridField
from dano.objects import NeuralObject
from dano.scene import Doubt, Scene, State
from dano.scene_file._forecast import bounds, support
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
) -> list[Doubt]:
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
            found.append(Doubt(2, text))
    found += [] if schedule is None else _of_forces(scene, schedule)
    if asked is not None and abs(duration - asked) > _ROUNDED * asked:
        text = f"duration {asked:.6g} s is no whole number of steps of {h:.6g} s: {duration:.6g} s are run"
        found.append(Doubt(3, text))
    if len(scene.bodies) > 1:
        limits = bounds(scene, scene.filled(state), duration)
        found += [Doubt(2, finding.text) for finding in support(scene, limits)]
    return found


def _of_forces(scene: Scene, schedule: Schedule) -> list[Doubt]:
    """Forces that are thousands of times a body's weight."""
    found = []
    for i, (row, force) in enumerate(zip(schedule.body.tolist(), np.asarray(schedule.force), strict=True)):
        body, size = scene.bodies[row], float(np.linalg.norm(force))
        weight = float(body.mass * body.mass_scale) * STANDARD_GRAVITY
        if not body.fixed and size > _MOST_WEIGHTS * weight:
            text = (
                f"[[controls]] {i + 1} pushes {body.name!r} with {size:.3g} N, {size / weight:.2g} times its"
            )
            found.append(Doubt(2, f"{text} weight on earth: is it in newtons?"))
    return found
