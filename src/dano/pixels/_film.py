"""From parameters and forces to pixels: rollout and renderer as one differentiable function.

Physics moves the bodies, their learned looks are rendered at the poses, and what comes out can be
differentiated with respect to everything that goes in: leaves of the scene such as friction, the initial
state, controls, and light. Where a silhouette moves, derivatives are those of a soft edge that is about a
pixel wide.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.checks import checked_count, checked_kind, checked_number
from dano.engine import AbstractEngine, Policy, simulate
from dano.maths import Numbers, quat_normalize, quat_rotate, quat_to_matrix
from dano.scene import Control, Scene, State
from dano.vision import AbstractCamera, AbstractModel, GAMMA, LearnedField, Light, Part, Sampling, through

FILM_SAMPLING = Sampling(24, 16, 8, moves=True, grazes=True)
"""How finely rays are sampled: a picture to compare, not one to look at.

By measurement, inside pictures of a ball and of the shipped bunny: colours are three times closer to those of
many samples than with (48, 16, 3), and derivatives twice. Few coarse sections look for a wide layer, so that
the fine ones hold all of the soft surface.
"""

_EDGE = 4.0
"""Sharpness of a silhouette times the width of a pixel at the object."""

_MOMENTS = 5
"""Pictures that a blurred frame is the mean of: enough for some pixels of blur."""


@dataclasses.dataclass(frozen=True)
class FilmOptions:
    """Which frames and pixels of a rollout are rendered, and how.

    Attributes:
        every: Steps between frames; the first frame shows the initial state.
        pixels: Image coordinates (x to the right, y downwards) of the pixels wanted; default: all, row by
            row. Fewer cost less, e.g. those near silhouettes.
        background: sRGB behind the bodies, of one colour (3,) or of every pixel (n, 3).
        shutter: How long a frame is exposed, half before and half after its time [s]; what moves is blurred.
        sampling: How finely rays are sampled.
    """

    every: int = 1
    pixels: Float[np.ndarray, "n 2"] | None = None
    background: Numbers = (0.0, 0.0, 0.0)
    shutter: float = 0.0
    sampling: Sampling = FILM_SAMPLING

    def __post_init__(self) -> None:
        """Check what can be checked without a camera.

        Raises:
            ValueError: If `every` is < 1, or `shutter` is negative.
        """
        checked_count("every", self.every)
        checked_number("shutter", self.shutter, least=0)


class RolloutPictures(NamedTuple):
    """Pictures of a rollout."""

    # sRGB of the pixels over the background, shape (frames, pixels, 3).
    colour: Float[Array, "frames pixels 3"]
    opacity: Float[Array, "frames pixels"]  # Share of each pixel that bodies cover, shape (frames, pixels)
    times: Float[Array, " frames"]  # Of the frames since the beginning of the rollout [s], shape (frames,)


def film(
    scene: Scene,
    state: State,
    n_steps: int,
    looks: Mapping[str, LearnedField],
    camera: AbstractCamera,
    lights: Sequence[Light],
    *,
    controls: Control | Policy | None = None,
    engine: AbstractEngine | None = None,
    **options: Any,
) -> RolloutPictures:
    """Simulate a scene and render some of its bodies, differentiably.

    Differentiate with respect to leaves of `scene`, `state`, `controls` or `lights`, forward or in reverse;
    under `jax.jit` close over the rest. Frames are rendered one after the other and again in the reverse
    pass, so that memory is that of one frame, beside the rollout's.

    Args:
        scene: Bodies and contacts.
        state: Initial state.
        n_steps: Steps of the rollout.
        looks: Learned looks of the bodies that are seen, by their names; others are not drawn.
        camera: From where.
        lights: Lamps, fixed in the world while bodies turn.
        controls: As in `simulate`.
        engine: As in `simulate`.
        **options: Of `FilmOptions`.

    Raises:
        ValueError: If a look is of no body, there is none, there is no light, `every` is < 1, `shutter` is
            negative, or the background has another shape.
    """
    checked_kind("scene", scene, Scene)
    scene.check_state(state)
    n_steps = checked_count("n_steps", n_steps)
    checked_kind("camera", camera, AbstractCamera)
    checked_kind("looks", looks, Mapping)
    chosen = FilmOptions(**options)
    _check(scene, looks, lights)
    trajectory = simulate(scene, state, n_steps, controls=controls, engine=engine)
    at = np.arange(0, n_steps + 1, chosen.every)
    during = (np.arange(_MOMENTS) + 0.5) / _MOMENTS - 0.5 if chosen.shutter else np.zeros(1)
    steps = jnp.asarray(at[:, None] + 0.0) + jnp.asarray(during[None] * chosen.shutter) / scene.timestep
    position, orientation = _placed(scene, trajectory.states, list(looks), steps.ravel())
    colour, opacity = draw_frames(
        list(looks.values()),
        position,
        orientation,
        camera,
        lights,
        pixels=chosen.pixels,
        background=chosen.background,
        sampling=chosen.sampling,
    )
    if chosen.shutter:
        # Light adds up linearly while the shutter is open.
        light = jnp.maximum(colour, 1e-6).reshape(*steps.shape, *colour.shape[1:]) ** GAMMA
        colour = jnp.mean(light, axis=1) ** (1 / GAMMA)
        opacity = jnp.mean(opacity.reshape(*steps.shape, -1), axis=1)
    return RolloutPictures(colour, opacity, trajectory.times[at])


def _placed(
    scene: Scene, states: State, names: Sequence[str], steps: Float[Array, " n"]
) -> tuple[Float[Array, "n k 3"], Float[Array, "n k 4"]]:
    """Origins [m, W] and orientations of bodies at times in steps, clipped to those of the rollout."""
    rows = np.array([scene.index(name) for name in names])
    last = len(states.position) - 1
    steps = jnp.clip(steps, 0, last)
    # Integer steps are taken as they are: their share of the next one is 0.
    before = jnp.clip(jnp.floor(steps).astype(jnp.int32), 0, max(last - 1, 0))
    share = (steps - before.astype(steps.dtype)).astype(states.position.dtype)[:, None, None]
    after = jnp.minimum(before + 1, last)
    x, q = states.position[:, rows], quat_normalize(states.orientation[:, rows])
    near = jnp.where(jnp.sum(q[before] * q[after], axis=-1, keepdims=True) < 0, -q[after], q[after])
    orientation = quat_normalize((1 - share) * q[before] + share * near)
    arms = jnp.stack([scene.bodies[i].centre_of_mass for i in rows])
    arms = jnp.broadcast_to(arms.astype(orientation.dtype), (*orientation.shape[:2], 3))
    return (1 - share) * x[before] + share * x[after] - quat_rotate(orientation, arms), orientation


def draw_frames(
    looks: Sequence[LearnedField],
    position: Float[Array, "frames n 3"],
    orientation: Float[Array, "frames n 4"],
    camera: AbstractCamera,
    lights: Sequence[Light],
    *,
    pixels: Float[np.ndarray, "m 2"] | None = None,
    background: Numbers = (0.0, 0.0, 0.0),
    sampling: Sampling = FILM_SAMPLING,
) -> tuple[Float[Array, "frames m 3"], Float[Array, "frames m"]]:
    """Colour and opacity of the pixels of objects at given poses, differentiable in poses and lights.

    Args:
        looks: What the n objects look like.
        position: Of the origins of their frames [m, W].
        orientation: Unit quaternions wxyz, object → world.
        camera: From where.
        lights: Lamps, fixed in the world.
        pixels: Image coordinates of the pixels wanted; default: all, row by row.
        background: sRGB behind the objects, of one colour (3,) or of every pixel (m, 3).
        sampling: How finely rays are sampled.

    Raises:
        ValueError: If the background has another shape.
    """
    if pixels is None:
        y, x = np.mgrid[: camera.height, : camera.width] + 0.5
        pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    view = _View(
        [jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), look.model) for look in looks],
        [float(look.drawn_sharpness) for look in looks],
        camera,
        camera.directions(np.asarray(pixels, np.float64)).astype(np.float32),
        _backdrop(background, len(pixels)),
        tuple(lights),
        sampling,
    )
    drawn = jax.checkpoint(lambda pose: _drawn(view, *pose))
    return jax.lax.map(drawn, (jnp.asarray(position, jnp.float32), jnp.asarray(orientation, jnp.float32)))


class _View(NamedTuple):
    """What is the same in all frames: what is seen, how sharp it may be, from where, and in which light."""

    models: list[AbstractModel]
    sharpest: list[float]
    camera: AbstractCamera
    directions: np.ndarray
    behind: np.ndarray
    lights: tuple[Light, ...]
    sampling: Sampling


def _drawn(
    view: _View, position: Float[Array, "n 3"], orientation: Float[Array, "n 4"]
) -> tuple[Array, Array]:
    """Colour and opacity of one frame, of bodies whose field frames are at these poses."""
    origin = jnp.asarray(view.camera.position, jnp.float32)
    parts = []
    for i, model in enumerate(view.models):
        # How soft an edge is drawn says nothing about where it is.
        away = jax.lax.stop_gradient(jnp.linalg.norm(position[i] - origin))
        softest = _EDGE / (np.float32(view.camera.pixel_angle) * away)
        sharpness = jnp.minimum(softest, np.float32(view.sharpest[i]))
        parts.append(Part(model, quat_to_matrix(orientation[i]), position[i], sharpness))
    origins = jnp.broadcast_to(origin, view.directions.shape)
    limit = jnp.full(len(view.directions), jnp.inf, jnp.float32)
    lamps = (view.lights,) * len(parts)
    directions = jnp.asarray(view.directions)
    colour, _, _, clear = through(tuple(parts), lamps, origins, directions, limit, 0.0, view.sampling)
    return colour + clear[:, None] * view.behind, 1 - clear


def _backdrop(background: Numbers, n_pixels: int) -> np.ndarray:
    colours = np.asarray(background, np.float32)
    if colours.shape not in ((3,), (n_pixels, 3)):
        raise ValueError(f"background must have shape (3,) or ({n_pixels}, 3), got {colours.shape}")
    return np.broadcast_to(colours, (n_pixels, 3))


def _check(scene: Scene, looks: Mapping[str, LearnedField], lights: Sequence[Light]) -> None:
    if not looks:
        raise ValueError("looks must hold the look of at least one body, got none")
    for name, look in looks.items():
        if name not in scene.names:
            raise ValueError(f"looks must be of bodies of the scene {list(scene.names)}, got {name!r}")
        if not isinstance(look, LearnedField):
            raise ValueError(f"looks must be LearnedFields, got {type(look).__name__} for {name!r}")
    if not lights:
        raise ValueError("lights must hold a Light, got none: everything would be black")
