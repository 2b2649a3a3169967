"""Results of every kind that reports are written of, made up instead of computed: that takes no time."""

import jax.numpy as jnp
import numpy as np

import dano
from dano.comparison import Comparison, Row, Scenery
from dano.exchange import convex_hull
from dano.identification import Errors, Identification, Motion
from dano.pixels import FilmFit
from dano.planning import GoalError, Plan
from dano.solvers import Stop
from dano.vision import (
    Capture,
    Doubt,
    Film,
    HistoryEntry,
    LearnedField,
    NodeGrid,
    Overlay,
    PosedCamera,
    Score,
    Survey,
    Tracked,
    Trained,
    View,
)

BOX = convex_hull((np.array(list(np.ndindex(2, 2, 2))) - 0.5) * (0.2, 0.1, 0.1))


def comparison() -> Comparison:
    """Of three routes, one of which failed."""
    own = Row("neural object", "dano", preparation=2.0, tilt=0.1, gap=0.0, phantom=0.0, step_time=3e-4)
    surface = Row("hull of the surface as it is", "MuJoCo", 3.0, 0.5, 12, 1, 1, tilt=7.0, gap=0.04)
    failed = Row("hull of the cleaned surface", "MuJoCo", 99.0, note="points must span a volume")
    rows = [own, surface, failed]
    at = np.array([0.0, 0.0, 0.05])
    scenery = [Scenery(row, [BOX], BOX, np.eye(3), at) for row in rows[:2]]
    return Comparison(rows, scenery, "the neural object", 0.2, [3.0, 99.0], 50.0, 1, ["CoACD <is> left out."])


def fit(scene: dano.Scene, state: dano.State, motion: Motion) -> Identification:
    """Of a friction, from one motion, which is fitted without any error."""
    far = Errors(0.01, 0.02, 0.1, 0.2, 3.0)
    return Identification(
        values={"mu": 0.3},
        standard_errors={"mu": 0.01},
        covariance=np.array([[1e-4]]),
        labels=("mu",),
        stop=next(iter(Stop)),
        loss_history=np.array([10.0, 1.0, 0.5]),
        messages=("this <is> made up",),
        smoothed=False,
        worth=None,
        errors=far,
        held_out_errors=None,
        minima=(),
        scene=scene,
        controls=None,
        initial=(),
        initial_states=dano.State(
            *(x[None] for x in (state.position, state.orientation, state.velocity, state.omega))
        ),
        motions=(motion,),
        fitted=(motion,),
        guessed=(motion,),
        freedom=10,
        evaluations=3,
        seconds=1.0,
    )


def plan(task: dano.Task, trajectory: dano.Trajectory) -> Plan:
    """That does nothing."""
    n = task.n_steps
    size = sum(actuator.size for actuator in task.actuators)
    name = "position of ball"
    return Plan(
        controls=dano.Control(force=jnp.zeros((n, 2, 3)), torque=jnp.zeros((n, 2, 3))),
        values=jnp.zeros((n, size)),
        trajectory=trajectory,
        gains=jnp.zeros((n, size, 6)),
        cost=0.0,
        goals=(GoalError(name, 0.1, 0.1, 0.01, True),),
        limits=(),
        reached=False,
        message="made up",
        method="none",
        seconds=0.0,
        distances={name: np.linspace(1.0, 0.1, n + 1)},
    )


def film(frames: int = 3) -> Film:
    """Of noise."""
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (48, 64, 3), np.uint8) for _ in range(frames)]
    nothing: list[np.ndarray | None] = [None] * frames
    names = tuple(f"{i}.png" for i in range(frames))
    return Film(names, 0.1 * np.arange(frames), images, nothing, nothing, 1, ())


def tracked(frames: int = 3) -> Tracked:
    """A square in the middle of the film; in the last frame it is lost."""
    window = (slice(10, 30), slice(20, 40))
    overlays = [Overlay(window, np.pad(np.ones((16, 16)), 2))] * (frames - 1) + [None]
    position, orientation = np.zeros((frames, 3)), np.tile([1.0, 0, 0, 0], (frames, 1))
    return Tracked(
        times=0.1 * np.arange(frames),
        position=position,
        orientation=orientation,
        covariance=np.tile(1e-6 * np.eye(6), (frames, 1, 1)),
        own=np.tile(1e-6 * np.eye(6), (frames, 1, 1)),
        status=("tracked",) * (frames - 1) + ("lost",),
        quality=np.full(frames, 0.9),
        colour_error=np.full(frames, 0.02),
        lamps=(),
        ambiguity=np.inf,
        overlays=tuple(overlays),
        messages=("this <is> made up",),
        seconds=0.1,
        repeats=np.ones(frames),
        doubt=Doubt(),
    )


def film_fit(found: Identification, frames: int = 3) -> FilmFit:
    """An identification from a film."""
    return FilmFit(found, found, tracked(frames), ({"mu": 0.2}, {"mu": 0.3}), True, (0.1,))


def trained(field: LearnedField, photographs: Capture, box: NodeGrid, hull: np.ndarray) -> Trained:
    """A training of one evaluation, with a hull."""
    silhouettes = Survey(box, hull, 0.01, 0.3, np.array([0.0, 0.0, 1.0]), ())
    history = (HistoryEntry(100, 200, 3.0, 5e4, 0.1, 30.0, 0.98, 1e-4),)
    score = Score(30.0, 28.0, 0.95, 0.98)
    return Trained(
        field, photographs, silhouettes, {"test": score}, history, "finished", 4.0, 0.02, 0.02, ("<made up>",)
    )


def photographs(n: int = 4, pixels: int = 8) -> Capture:
    """Grey photographs without masks, from a ring around the z axis at a height of 0.5."""
    views = []
    for i in range(n):
        angle = 2 * np.pi * i / n
        back = np.array([np.cos(angle), np.sin(angle), 0.5])
        back /= np.linalg.norm(back)
        right = np.cross((0.0, 0.0, 1.0), back)
        right /= np.linalg.norm(right)
        pose = np.stack([right, np.cross(back, right), back, back / np.linalg.norm(back)], axis=1)
        camera = PosedCamera(pose, focal=1.5 * pixels, width=pixels, height=pixels)
        views.append(
            View(name=f"{i}.png", camera=camera, image=np.full((pixels, pixels, 3), 0.5, np.float32))
        )
    return Capture(views, "made up")
