"""Motions cut into windows, each simulated from its own initial state, as arrays to map over.

What poses with covariances, such as a tracker's, say of a window, and what they are off by alike.
"""

import dataclasses
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dano.identification._settings import IdentifyOptions
from dano.identification.motions import (
    JOINT_NUMBERS,
    joint_numbers,
    joint_widths,
    Motion,
    QUANTITIES,
    SMOOTHING_FRAMES,
)
from dano.maths import quat_rotate, quat_to_matrix
from dano.scene import Control, Scene, State, StateLayout

_TOLD = 3.0
"""Factor of the standard deviations with which velocities from a tracker's poses count besides the poses: the
same data once more, as a ninth (convention)."""


def told_of(
    scene: Scene, motion: Motion, smooth, first: int, smoothing: int
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """What poses tell of velocities and spins at a frame, and by how much that may be off."""
    rows, told = [scene.index(name) for name in motion.names], {}
    for key, width in motion.velocity_deviations(first, smoothing).items():
        whole = np.full((len(scene.bodies), 1), np.nan)
        if motion.alike is None:
            told[key] = smooth[key][first], whole
            continue
        share = motion.alike[2] * np.linalg.norm(smooth[key][first, rows], axis=-1)
        whole[rows, 0] = _TOLD * np.hypot(width, share if key == "velocity" else 0.0)
        told[key] = smooth[key][first], whole
    return told


def add_told(
    key: str,
    told: Sequence[tuple[np.ndarray, np.ndarray]],
    seen: Sequence[int],
    observed: dict[str, Array],
    weights: dict[str, Array],
) -> None:
    """Let count what poses of a tracker tell of the velocities with which windows begin, but not much.

    Else a slide begins with a hop that ends before the next frame, of which its poses say nothing.
    """
    values, widths = (np.stack(part)[:, seen] for part in zip(*told, strict=True))
    known = np.isfinite(values).all(axis=-1) & np.isfinite(widths[..., 0])
    if known.any():
        shape = observed[key].shape[:3]
        weight = np.array(weights.get(key, np.zeros(shape)))
        value = np.array(observed[key])
        w, n = np.nonzero(known)
        weight[w, 0, np.array(seen)[n]] = 1 / widths[known, 0]
        value[w, 0, np.array(seen)[n]] = values[known]
        dtype = observed[key].dtype
        observed[key], weights[key] = jnp.asarray(value, dtype), jnp.asarray(weight, dtype)


def pose_deviations(weights: Mapping[str, Array]) -> np.ndarray:
    """Standard deviations by which residuals of poses are divided, shape (w, f, n, 6); 0 where none count."""
    sizes = np.zeros((*next(iter(weights.values())).shape, 6))
    for first, key in ((0, "position"), (3, "orientation")):
        if key in weights:
            weight = np.asarray(weights[key], np.float64)
            sizes[..., first : first + 3] = np.where(weight > 0, 1 / np.maximum(weight, 1e-300), 0)[..., None]
    return sizes


def whitening_of(pieces: list[dict], deviations: np.ndarray) -> np.ndarray | None:
    """See `Windows`."""
    if all(piece["covariance"] is None for piece in pieces):
        return None
    result = np.tile(np.eye(6), (*deviations.shape[:3], 1, 1))
    for w, f, n, on in _with_covariance(pieces, deviations):
        scale = deviations[w, f, n, on]
        scaled = pieces[w]["covariance"][f, n][np.ix_(on, on)] / np.outer(scale, scale)
        result[w, f, n][np.ix_(on, on)] = np.linalg.inv(np.linalg.cholesky(scaled))
    return result


def common_of(
    scene: Scene, pieces: list[dict], deviations: np.ndarray, whitening: np.ndarray | None
) -> np.ndarray | None:
    """What all poses of a body that was tracked may be off by alike, in whitened residuals: see `Windows`.

    An offset, turn and scale with normal priors that all frames share are integrated over: residuals with
    covariance 1 + A Aᵀ are whitened by 1 − U Uᵀ, where A says what these do to them. A scale about the camera
    is one about the middle of all places, and an offset.
    """
    if whitening is None or all(piece["alike"] is None for piece in pieces):
        return None
    moved = np.zeros((*deviations.shape, 7))
    for w, f, n, on in _with_covariance(pieces, deviations):
        body, piece = scene.bodies[n], pieces[w]
        if piece["alike"] is None:
            continue
        slope = np.zeros((6, 7))
        offset, turned, share = piece["alike"]
        slope[:, :6] = np.diag(np.repeat([offset * body.size, turned], 3))
        if piece["origins"][n] and len(on) == 6:
            # The body turns about its middle, not about a distant origin.
            arm = np.cross(np.eye(3), np.asarray(body.centre_of_mass))
            slope[:3, 3:6] = turned * quat_to_matrix(piece["orientation"][f, n]) @ arm
        if np.isfinite(piece["position"][:, n]).any():
            slope[:3, 6] = share * (piece["position"][f, n] - np.nanmean(piece["position"][:, n], axis=0))
        scaled = slope / np.maximum(deviations[w, f, n, :, None], 1e-300)
        moved[w, f, n, on] = (whitening[w, f, n] @ scaled)[on]
    windows, frames, bodies = deviations.shape[:3]
    stacked = moved.transpose(0, 2, 1, 3, 4).reshape(windows, bodies, 6 * frames, 7)
    left, size, _ = np.linalg.svd(stacked, full_matrices=False)
    columns = left * np.sqrt(1 - 1 / np.sqrt(1 + size**2))[..., None, :]
    return columns.reshape(windows, bodies, frames, 6, -1).transpose(0, 2, 1, 3, 4)


def _with_covariance(
    pieces: list[dict], deviations: np.ndarray
) -> Iterator[tuple[int, int, int, np.ndarray]]:
    """Window, frame and body of each pose with a covariance, and which of its six numbers count."""
    for w, piece in enumerate(pieces):
        if piece["covariance"] is not None:
            for f, n in np.argwhere(np.isfinite(piece["covariance"]).all(axis=(-2, -1))):
                on = np.flatnonzero(deviations[w, f, n] > 0)
                if len(on):
                    yield w, int(f), int(n), on


_CONFIGURATION = ("position", "orientation")

# Acceleration [m/s²] of a body, or of its surface by a change of spin, from which velocities of neighbouring
# frames are taken to have an impact between them: five times that of free fall.
_IMPACT = 50.0


class Windows(eqx.Module):
    """All windows of all motions, padded to one length; leaves have a leading axis of windows."""

    begin: Float[Array, " w"]  # Time of the first frame of each [s]
    first_step: Int[Array, " w"]  # Steps from the beginning of the motion to that of the window
    # Which bodies have positions of their field frame's origin instead of the centre of mass.
    origins: Bool[Array, "w n"]
    # Where in the rollout each frame lies: step, and share of the next one.
    frame: tuple[Int[Array, "w f"], Float[Array, "w f"]]
    # The same for velocities, which hold half a step before.
    moment: tuple[Int[Array, "w f"], Float[Array, "w f"]]
    observed: State  # What was seen, zero where nothing was; leaves (w, frames, bodies, ·)
    # The same for joint coordinates, see `Motion.q`; None if no motion has them.
    joints: Float[Array, "w f n 3"] | None
    # One over the standard deviation of each number, zero where nothing was seen, by quantity, "q" for joint
    # coordinates; shape (w, frames, bodies).
    weights: dict[str, Float[Array, "w f n"]]
    # What makes residuals of pose with these weights, position then orientation, independent and of variance
    # one, by the motions' covariances, shape (w, frames, bodies, 6, 6); None if no motion has any.
    whitening: Float[Array, "w f n 6 6"] | None
    # Columns U, shape (w, frames, bodies, 6, 7), by which these residuals r become r − U Uᵀ r: what all poses
    # of a body are off by alike does not count; None if no motion says it (`Motion.alike`).
    common: Float[Array, "w f n 6 7"] | None
    # Where the next window of the same motion begins, as `frame` has it.
    end: tuple[Int[Array, " w"], Float[Array, " w"]]
    chained: Float[Array, " w"]  # Whether there is such a window, 1 or 0
    controls: Control | None  # Forces and torques of each step, or None


@dataclasses.dataclass(frozen=True)
class WindowPlan:
    """Windows, and what the host knows of them."""

    windows: Windows  # The windows
    start: State  # Their initial states, positions as `Windows.origins` says
    n_steps: int  # Steps that each is simulated
    owner: np.ndarray  # Index of the motion that each belongs to
    rows: list[np.ndarray]  # The frames of the motion that each covers
    bodies: tuple[int, ...]  # Indices of the bodies that were observed and move
    quantities: tuple[str, ...]  # Quantities that count
    n_data: int  # How many numbers were observed and count


def plan_windows(
    scene: Scene,
    motions: Sequence[Motion],
    *,
    states: Sequence[State | None],
    controls: Sequence[Control | None],
    noise: Mapping[str, float],
    initial: Sequence[str],
    options: IdentifyOptions,
    smoothing: int = SMOOTHING_FRAMES,
) -> WindowPlan:
    """Cut motions into windows.

    Args:
        scene: The scene.
        motions: At least one.
        states: Initial state of each motion, for what it does not say itself.
        controls: Forces for each step of each motion, or None.
        noise: Standard deviation of each quantity that counts.
        initial: Quantities of the initial states that are estimated.
        options: How long windows are, and whether they are simulated up to the beginning of the next.
        smoothing: Frames that say how fast a window begins where that was not observed.

    Raises:
        ValueError: If a motion does not fit the scene, or does not say how a window begins.
    """
    h = float(scene.timestep)
    pieces: list[dict] = []
    for number, (motion, state, control) in enumerate(zip(motions, states, controls, strict=True)):
        what = f"motion {number}" if len(motions) > 1 else "the motion"
        for piece in _cut(scene, motion, state, options.window, smoothing, what):
            pieces.append({**piece, "owner": number, "control": control})
    _report_impacts(scene, pieces, initial)
    seen = _observed(scene, motions)
    dtype = scene.timestep.dtype
    observed, joints, weights = _weighed(scene.layout, pieces, seen, noise, initial, dtype)
    sizes = {key: np.full(len(scene.bodies), 3) for key in QUANTITIES} | {"q": joint_widths(scene.layout)}
    n_data = sum(int(np.sum((np.asarray(w) > 0) * sizes[key])) for key, w in weights.items())
    elapsed = [piece["times"] - piece["times"][0] for piece in pieces]
    until = [
        piece["until"] - piece["times"][0] if options.gaps else e[-1]
        for piece, e in zip(pieces, elapsed, strict=True)
    ]
    owner = np.array([piece["owner"] for piece in pieces])
    lags = [motions[piece["owner"]].lag for piece in pieces]
    # Velocities hold half a step before a state, so those of the last frame may need a step more.
    late = [np.maximum(e - lag + 0.5 * h, 0.0) for e, lag in zip(elapsed, lags, strict=True)]
    ends = [max(e[-1], u, v[-1]) for e, u, v in zip(elapsed, until, late, strict=True)]
    n_steps = max(1, _steps_to(max(ends), h))
    frame = _located(_stacked(elapsed) / h, n_steps)
    moment = _located(_stacked(late) / h, n_steps)
    first_step = np.array([_steps_to(piece["times"][0] - piece["origin"], h) for piece in pieces])
    forces = [piece["control"] for piece in pieces]
    deviations = pose_deviations(weights)
    white = whitening_of(pieces, deviations)
    common = common_of(scene, pieces, deviations, white)
    windows = Windows(
        jnp.asarray([piece["times"][0] - piece["origin"] for piece in pieces], dtype),
        jnp.asarray(first_step),
        jnp.asarray(np.stack([piece["origins"] for piece in pieces])),
        _arrays(frame, dtype),
        _arrays(moment, dtype),
        observed,
        joints,
        weights,
        None if white is None else jnp.asarray(white, dtype),
        None if common is None else jnp.asarray(common, dtype),
        _arrays(_located(np.array(until) / h, n_steps), dtype),
        jnp.asarray(np.append(owner[1:] == owner[:-1], False), dtype),
        _control_rows(scene, forces, first_step, n_steps),
    )
    names = pieces[0]["start"]
    start: dict[str, Any] = {
        key: jnp.asarray(np.stack([piece["start"][key] for piece in pieces]), dtype) for key in names
    }
    rows = [piece["rows"] for piece in pieces]
    return WindowPlan(windows, State(**start), n_steps, owner, rows, tuple(seen), tuple(weights), n_data)


def _observed(scene: Scene, motions: Sequence[Motion]) -> list[int]:
    """Bodies that move and are in a motion.

    Raises:
        ValueError: If there are none.
    """
    moving = [i for i, body in enumerate(scene.bodies) if not body.fixed]
    seen = [i for i in moving if any(scene.names[i] in motion.names for motion in motions)]
    if not seen:
        raise ValueError(f"observed must hold a body that moves, got only fixed ones of {list(scene.names)}")
    return seen


def _stacked(values: list[np.ndarray], fill: float = 0.0) -> np.ndarray:
    """Arrays of different lengths as one, the short ones filled up."""
    longest = max(len(v) for v in values)
    return np.stack(
        [np.concatenate([v, np.full((longest - len(v), *v.shape[1:]), fill, v.dtype)]) for v in values]
    )


def _weighed(
    layout: StateLayout,
    pieces: list[dict],
    seen: Sequence[int],
    noise: Mapping[str, float],
    initial: Sequence[str],
    dtype,
) -> tuple[State, Array | None, dict[str, Array]]:
    """What windows observe, of bodies and of joints, and what each number counts: see `Windows`.

    Raises:
        ValueError: If nothing counts.
    """
    observed, weights = {}, {}
    from_joints = np.array([piece["q"] is not None for piece in pieces])
    unseen = [i for i in range(layout.bodies) if i not in seen]
    unmoved = np.flatnonzero(joint_widths(layout) == 0)
    for key in [*QUANTITIES, *(["q"] if from_joints.any() else [])]:
        blank = np.full((1, layout.bodies, JOINT_NUMBERS), np.nan)
        values = _stacked([blank if piece[key] is None else piece[key] for piece in pieces], np.nan)
        known = np.asarray(np.isfinite(values).all(axis=-1))
        observed[key] = jnp.asarray(np.where(known[..., None], values, 0.0), dtype)
        if key not in noise:
            continue
        counts = known.copy()
        counts[:, :, unseen] = False
        if key == "q":
            counts[:, :, unmoved] = False
        else:
            hanging = np.isin(np.arange(layout.bodies), layout.children)
            counts &= ~(from_joints[:, None, None] & hanging[None, None])
        poses = ("position", "orientation")
        if not (any(each in initial for each in poses) if key == "q" else key in initial):
            counts[:, 0] = False
        if counts.any():
            weights[key] = jnp.asarray(counts / noise[key], dtype)
    for key in ("velocity", "omega"):
        if key in initial:
            add_told(key, [piece["told"][key] for piece in pieces], seen, observed, weights)
    if not weights:
        raise ValueError(
            f"observed must hold, after the first frame, values of some of {list(noise)}, got none"
        )
    joints = observed.pop("q", None)
    return State(**observed), joints, weights


def draw_velocities(
    start: State,
    bodies: Sequence[int],
    noise: Mapping[str, float],
    spacing: float,
    random: np.random.Generator,
) -> State:
    """Other initial states within the noise of velocities that the poses of three frames say.

    Args:
        start: Velocities from three frames, that is over twice the spacing.
        bodies: Those that move.
        noise: Standard deviations of positions [m] and orientations [rad]; what has none stays.
        spacing: Time between frames [s].
        random: Where draws come from.
    """
    changed = {}
    for key, pose in (("velocity", "position"), ("omega", "orientation")):
        value = getattr(start, key)
        width = np.zeros(value.shape)
        # The difference of two poses has the variance of both.
        width[:, list(bodies)] = np.sqrt(2) * noise.get(pose, 0.0) / (2 * spacing)
        changed[key] = value + jnp.asarray(width * random.standard_normal(value.shape), value.dtype)
    return dataclasses.replace(start, **changed)


def _on_all_bodies(scene: Scene, motion: Motion, what: str) -> dict[str, np.ndarray]:
    """Quantities of a motion for all bodies of a scene; NaN for those not in it."""
    for name in motion.names:
        if name not in scene.names:
            raise ValueError(f"{what} must be of bodies of the scene {list(scene.names)}, got {name!r}")
    rows = [scene.index(name) for name in motion.names]
    full = {}
    for key, size in QUANTITIES.items():
        full[key] = np.full((len(motion.times), len(scene.bodies), size), np.nan)
        full[key][:, rows] = getattr(motion, key)
    return full


def _joints_on_all_bodies(scene: Scene, motion: Motion, first: int, last: int) -> np.ndarray | None:
    if motion.q is None:
        return None
    full = np.full((last - first, len(scene.bodies), JOINT_NUMBERS), np.nan)
    full[:, [scene.index(name) for name in motion.names]] = motion.q[first:last]
    return full


def _covariance_on_all_bodies(scene: Scene, motion: Motion, first: int, last: int) -> np.ndarray | None:
    if motion.covariance is None:
        return None
    full = np.full((last - first, len(scene.bodies), 6, 6), np.nan)
    full[:, [scene.index(name) for name in motion.names]] = motion.covariance[first:last]
    return full


def _cut(scene, motion: Motion, state, window: int | None, smoothing: int, what: str) -> list[dict[str, Any]]:
    """The windows of one motion, one after the other without overlap."""
    full = _on_all_bodies(scene, motion, what)
    moving = np.array([i for i, body in enumerate(scene.bodies) if not body.fixed])
    smooth = _on_all_bodies(scene, motion.with_velocities(smoothing), what)
    complete = _says_where(scene, motion, full, state is not None, moving)
    origins = np.array([motion.point == "origin" and name in motion.names for name in scene.names])
    pieces, first, n = [], 0, len(motion.times)
    while first < n:
        ready = np.flatnonzero(complete[first:])
        if len(ready) == 0:
            break
        first += int(ready[0])
        last = n if window is None else min(first + window, n)
        if last - first >= 2:
            start, struck = _initial(scene, motion, full, smooth, state, first, what, origins)
            pieces.append(
                {
                    "rows": np.arange(first, last),
                    "times": motion.times[first:last],
                    "until": motion.times[min(last, n - 1)],
                    "origin": motion.times[0],
                    "origins": origins,
                    "start": start,
                    "struck": struck,
                    "q": _joints_on_all_bodies(scene, motion, first, last),
                    "covariance": _covariance_on_all_bodies(scene, motion, first, last),
                    "alike": motion.alike,
                    "told": told_of(scene, motion, smooth, first, smoothing),
                    **{key: full[key][first:last] for key in QUANTITIES},
                }
            )
        first = last
    if not pieces:
        seen = ", ".join(motion.names)
        raise ValueError(
            f"{what} must have a frame with positions of all its bodies ({seen}) and at least one after it, "
            "got none"
        )
    return pieces


def _says_where(scene, motion, full, has_state: bool, moving) -> np.ndarray:
    """Frames at which every body that moves has a position and an orientation, seen or stated."""
    ready = np.ones(len(motion.times), bool)
    for i in moving:
        name = scene.names[i]
        for key in _CONFIGURATION:
            known = np.isfinite(full[key][:, i]).all(axis=-1)
            never = name not in motion.names or (key == "orientation" and not known.any())
            if never and not has_state:
                raise ValueError(
                    f"{key} of {name!r} is not observed: give the state in which the motion begins"
                )
            if not never:
                ready &= known
    return ready


def _initial(scene, motion, full, smooth, state, first: int, what: str, origins):
    """Initial state of the window that begins at a frame, as a dict of arrays (n, ·).

    And which measured velocities of bodies, shape (n,), have an impact beside them.
    """
    start, struck, h = {}, {}, float(scene.timestep)
    unseen = [i for i, body in enumerate(scene.bodies) if not body.fixed and body.name not in motion.names]
    if unseen and first > 0:
        raise ValueError(
            f"{scene.names[unseen[0]]!r} moves and is not observed, so {what} must be one window that "
            "begins at its first frame"
        )
    for key in QUANTITIES:
        if state is None:
            value = np.zeros((len(scene.bodies), QUANTITIES[key]))
            if key == "orientation":
                value[:, 0] = 1.0
        else:
            value = np.array(getattr(state, key), dtype=float)
        if key in _CONFIGURATION:
            found = full[key][first]
        else:
            found, struck[key] = _earlier(scene, motion, key, smooth[key], first, h)
            struck[key] &= np.isfinite(full[key][first]).all(axis=-1)
        known = np.isfinite(found).all(axis=-1)
        value[known] = found[known]
        start[key] = value
    if scene.joints:
        start |= _joint_start(scene, motion, start, state, first, origins)
    return start, struck


def _joint_start(scene, motion, start, state, first: int, origins) -> dict[str, np.ndarray]:
    """Coordinates and velocities of the joints: those of observed bodies from their poses, others stated."""
    layout = scene.layout
    com = np.stack([np.asarray(body.centre_of_mass) for body in scene.bodies])
    arms = quat_rotate(start["orientation"], np.where(origins[:, None], com, 0.0))
    turning = quat_rotate(start["orientation"], start["omega"])
    dtype = scene.timestep.dtype
    rows = State(
        jnp.asarray(start["position"] + arms, dtype),
        jnp.asarray(start["orientation"], dtype),
        jnp.asarray(start["velocity"] + np.cross(turning, arms), dtype),
        jnp.asarray(start["omega"], dtype),
    )
    found = scene.joint_values(rows)
    seen = [scene.joints[j].child in motion.names for j in layout.with_coordinates]
    given = found if state is None else (state.q, state.v)
    q, v = (np.where(seen, np.asarray(f), np.asarray(g)) for f, g in zip(found, given, strict=True))
    logged = _joints_on_all_bodies(scene, motion, first, first + 1)
    if logged is not None:
        # Poses do not tell whole turns.
        own = joint_numbers(layout, logged[0])
        q = np.where(np.isfinite(own), own, q)
    return {"q": q, "v": v}


def _earlier(
    scene, motion: Motion, key: str, values: np.ndarray, first: int, h: float
) -> tuple[np.ndarray, np.ndarray]:
    """Velocities half a step before a frame, which is where the rollout has them, from the frames around.

    A slope over an impact does not count; that of the frames on the side to which the velocity is moved does.
    And where these have one between them, or are not there, the velocity stays that of its frame: the second
    array, shape (n,), says of which bodies.
    """
    shift = motion.lag - 0.5 * h
    last = len(values) - 1
    around = _slope(motion, values, max(first - 1, 0), min(first + 1, last))
    beside = _slope(motion, values, *((first - 1, first) if shift < 0 else (first, first + 1)))
    half = 0.5 * np.array([body.size if np.isfinite(body.size) else 0.0 for body in scene.bodies])
    reach = np.ones(len(scene.bodies)) if key == "velocity" else half
    struck = _IMPACT < np.linalg.norm(around, axis=-1) * reach
    # Not a number compares as false: without frames on that side there is no slope.
    smooth = np.linalg.norm(beside, axis=-1) * reach <= _IMPACT
    change = np.where(struck[:, None], np.where(smooth[:, None], beside, 0.0), around)
    moved = values[first] + shift * change
    return np.where(np.isfinite(moved), moved, values[first]), struck & ~smooth & (shift != 0)


def _slope(motion: Motion, values: np.ndarray, low: int, high: int) -> np.ndarray:
    """Change of values a second from one frame to another; not a number beyond the first and last frame."""
    if low < 0 or high >= len(values) or low == high:
        return np.full(values.shape[1:], np.nan)
    return (values[high] - values[low]) / (motion.times[high] - motion.times[low])


def _report_impacts(scene: Scene, pieces: list[dict], initial: Sequence[str]) -> None:
    """Report bodies whose measured first velocities are not known half a step before their frame."""
    for key in ("velocity", "omega"):
        if key in initial:
            continue
        struck = np.array([piece["struck"][key] for piece in pieces])
        if not struck.any():
            continue
        body = scene.names[int(np.flatnonzero(struck.any(axis=0))[0])]
        count = int(struck.any(axis=1).sum())
        where = f"{count} of {len(pieces)} windows" if len(pieces) > 1 else "the motion"
        warnings.warn(
            f"{key} of {body!r} changes beside the frame in which it begins as by an impact, in {where}: the"
            " simulation needs it half a step before that frame, and takes it as it is there."
            " Motion.create(lag=…) says when velocities were measured, half a timestep before frames in a"
            " simulation; initial='velocities' estimates them",
            UserWarning,
            stacklevel=2,
        )


def _steps_to(elapsed: float, h: float) -> int:
    """Steps after which a rollout has passed a time, forgiving rounding in it."""
    return int(np.ceil(elapsed / h - 1e-6))


def _located(at: np.ndarray, n_steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Step and share of the next one."""
    nearest = np.round(at)
    at = np.where(np.abs(at - nearest) < 1e-6, nearest, at)
    step = np.clip(np.floor(at).astype(int), 0, n_steps - 1)
    return step, np.clip(at - step, 0.0, 1.0)


def _arrays(located: tuple[np.ndarray, np.ndarray], dtype) -> tuple[Array, Array]:
    return jnp.asarray(located[0]), jnp.asarray(located[1], dtype)


def _control_rows(scene: Scene, controls: list[Control | None], first_step, n_steps: int) -> Control | None:
    """Rows of each window, zero after the last one that is given."""
    if all(control is None for control in controls):
        return None
    bodies = (len(scene.bodies), 3)

    def rows(name: str, shape: tuple[int, ...]) -> Array:
        table = np.zeros((len(controls), n_steps, *shape))
        for row, control, first in zip(table, controls, first_step, strict=True):
            if control is not None and getattr(control, name) is not None:
                part = np.asarray(getattr(control, name))[first : first + n_steps]
                row[: len(part)] = part
        return jnp.asarray(table, scene.timestep.dtype)

    of_joints = {
        name: rows(name, (scene.layout.n_joints,))
        for name in ("effort", "command")
        if any(control is not None and getattr(control, name) is not None for control in controls)
    }
    return Control(rows("force", bodies), rows("torque", bodies), **of_joints)
