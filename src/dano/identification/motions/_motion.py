"""Motions: poses of bodies over time, from a tracker, a file, another simulation or a log of joints.

How fast values change, by the parabola through those of some frames.
"""

import dataclasses
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.checks import checked_choice, checked_count, checked_items, checked_kind, checked_number, shown
from dano.identification.logs import unwrapped
from dano.maths import (
    checked_floating,
    checked_numbers,
    Numbers,
    quat_conjugate,
    quat_log,
    quat_multiply,
    quat_rotate,
)
from dano.scene import Scene, State, StateLayout, Trajectory

if TYPE_CHECKING:
    from dano.vision import Tracked


def slope(times: np.ndarray, values: np.ndarray, when: float, frames: int) -> np.ndarray:
    """Derivative at a time of the parabola through the nearest known values; a line through only two."""
    nearest = _nearest(times, values, when, frames)
    if len(nearest) < 2:
        return np.full(values.shape[1], np.nan)
    terms, reach = _parabola(times[nearest], when)
    return np.linalg.lstsq(terms, values[nearest], rcond=None)[0][1] / reach


def slope_deviation(times: np.ndarray, values: np.ndarray, when: float, frames: int) -> float:
    """By how much `slope` may be off; values (n, 6), the last three columns the deviations of the first."""
    nearest = _nearest(times, values, when, frames)
    if len(nearest) < 2:
        return float("nan")
    terms, reach = _parabola(times[nearest], when)
    known, widths = values[nearest, :3], values[nearest, 3:]
    free = len(nearest) - terms.shape[1]
    away = known - terms @ np.linalg.lstsq(terms, known, rcond=None)[0]
    scatter = float(np.sum(away**2)) / (3 * free) if free else 0.0
    variance = max(scatter, float(np.mean(widths**2)))
    return float(np.sqrt(variance * np.linalg.inv(terms.T @ terms)[1, 1])) / reach


def _nearest(times: np.ndarray, values: np.ndarray, when: float, frames: int) -> np.ndarray:
    """Frames nearest to a time of which values are known."""
    known = np.flatnonzero(np.isfinite(values).all(axis=1))
    return known[np.argsort(np.abs(times[known] - when), kind="stable")[:frames]]


def _parabola(times: np.ndarray, when: float) -> tuple[np.ndarray, float]:
    """Powers of the times that make a parabola, or a line of few frames; and their unit [s]."""
    reach = float(np.ptp(times))
    return np.vander((times - when) / reach, 2 if len(times) < 4 else 3, increasing=True), reach


QUANTITIES = {"position": 3, "orientation": 4, "velocity": 3, "omega": 3}
"""What a motion may hold of each body and frame, and how many numbers it has."""

UNNAMED = "(unnamed)"
"""Name of the body of a file that does not say: `identify` takes the only one that moves."""

JOINT_NUMBERS = 3
"""How many coordinates a joint has at most."""

# Frames that a local parabola is fitted to for velocities: three on each side.
SMOOTHING_FRAMES = 7
# Finite differences of a motion and its own angular velocity differ by noise, but not by so large a share.
_INCONSISTENT = 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class Motion:
    """Observed motion of some bodies. What was not observed is NaN."""

    times: np.ndarray  # Of the frames [s], increasing, shape (T,)
    position: np.ndarray  # Of `point` [m, W], shape (T, n, 3)
    orientation: np.ndarray  # Unit quaternions wxyz, body → world, shape (T, n, 4)
    velocity: np.ndarray  # Of `point` [m/s, W], shape (T, n, 3)
    omega: np.ndarray  # [rad/s, B], shape (T, n, 3)
    names: tuple[str, ...]  # Names of the n bodies
    # Whether positions are those of the centres of mass or of the origins of the field frames (F).
    point: str = "com"
    # How long before a frame its velocities hold [s]: half a timestep in a `Trajectory`, because x⁺ = x + h
    # v⁺; 0 for measured ones.
    lag: float = 0.0
    # Of each pose, or None if no more is known than one noise for all: of the position [m, W], then of the
    # rotation vector [rad, B] by which the true orientation follows the observed one, shape (T, n, 6, 6); NaN
    # where it is unknown.
    covariance: np.ndarray | None = None
    # By how much poses with a covariance may be off in all frames alike, as standard deviations: an offset,
    # in sizes of the body, a turn [rad], and a share by which the body goes too far. None: not at all, and
    # covariances are those of independent errors.
    alike: tuple[float, float, float] | None = None
    # Coordinates of the joint that each body hangs on [rad or m], or None if they were not observed, shape
    # (T, n, 3): as many numbers as the joint has, then zeros. Poses of such a motion follow from them, and do
    # not count beside them.
    q: np.ndarray | None = None

    @classmethod
    def create(
        cls,
        times: Numbers,
        names: str | Sequence[str],
        *,
        point: str = "com",
        lag: float = 0.0,
        covariance: Numbers | None = None,
        alike: Numbers | None = None,
        **observed: Numbers | None,
    ) -> "Motion":
        """A motion from arrays of shape (T, n, ·), or (T, ·) for a single body.

        Args:
            times: [s], shape (T,).
            names: Name or names of the bodies.
            point: What positions and velocities refer to: "com" or "origin".
            lag: How long before a frame its velocities hold [s].
            covariance: Of each pose, as a tracker gives it, shape (T, n, 6, 6), or (T, 6, 6) for one body.
            alike: By how much poses may be off in all frames alike, see the attribute; needs `covariance`.
            **observed: `position` [m, W], `orientation` (quaternions wxyz, body → world, normalised here,
                with signs that do not jump), `velocity` [m/s, W], `omega` [rad/s, B]; and `q`, the joint
                coordinates of each body, see the attribute (`motion_of_joints` makes them). NaN where a body
                was not seen.

        Raises:
            ValueError: If there are fewer than two frames, times do not increase, nothing was observed, or an
                array has a wrong shape or impossible values. Orientations that contradict the angular
                velocities are refused, too: quaternions in another order than wxyz do.
        """
        names = (names,) if isinstance(names, str) else checked_items("names", names, str)
        if not names or len(set(names)) < len(names) or not all(names):
            raise ValueError(f"names must be different non-empty names of bodies, got {list(names)}")
        stamps = checked_numbers("times", times)
        if stamps.ndim != 1 or len(stamps) < 2:
            raise ValueError(f"times must be a vector of at least two frames, got shape {stamps.shape}")
        if not np.all(np.isfinite(stamps)) or not np.all(np.diff(stamps) > 0):
            bad = int(np.flatnonzero(~(np.diff(stamps) > 0))[0]) + 1
            raise ValueError(f"times must be finite and increase, got {stamps[bad]} s at frame {bad}")
        checked_choice("point", point, ("com", "origin"))
        lag = checked_number("lag", lag, least=0)
        for name in observed:
            checked_choice("observed", name, (*QUANTITIES, "q"))
        q = observed.get("q")
        arrays = {name: _frames(name, observed.get(name), len(stamps), len(names)) for name in QUANTITIES}
        for row, name in enumerate(names):
            if not any(np.isfinite(arrays[key][:, row]).all(axis=-1).any() for key in QUANTITIES):
                raise ValueError(f"motion of {name!r} must hold at least one observed frame, got none")
        arrays["orientation"] = _unit_quaternions(arrays["orientation"])
        motion = cls(stamps, *(arrays[key] for key in QUANTITIES), names=names, point=point, lag=lag)
        if covariance is not None:
            matrices = _covariances(covariance, len(stamps), len(names))
            motion = dataclasses.replace(motion, covariance=matrices)
        if alike is not None:
            motion = dataclasses.replace(motion, alike=_alike(alike, covariance))
        if q is not None:
            motion = dataclasses.replace(motion, q=_frames("q", q, len(stamps), len(names)))
        _check_rotation(motion)
        return motion

    @classmethod
    def from_trajectory(
        cls, trajectory: Trajectory, *, bodies: Sequence[str] | None = None, every: int = 1
    ) -> "Motion":
        """Some bodies of a simulated trajectory, every so many steps.

        Raises:
            ValueError: If a body is unknown or `every` < 1.
        """
        checked_kind("trajectory", trajectory, Trajectory)
        chosen = trajectory.names if bodies is None else checked_items("bodies", bodies, str)
        for name in chosen:
            if name not in trajectory.names:
                raise ValueError(f"bodies must be among {list(trajectory.names)}, got {name!r}")
        every = checked_count("every", every)
        rows = [trajectory.names.index(name) for name in chosen]
        times = np.asarray(trajectory.times)
        states = trajectory.states
        return cls.create(
            times[::every],
            chosen,
            position=np.asarray(states.position)[::every, rows],
            orientation=np.asarray(states.orientation)[::every, rows],
            velocity=np.asarray(states.velocity)[::every, rows],
            omega=np.asarray(states.omega)[::every, rows],
            lag=0.5 * float(times[1] - times[0]),
        )

    @classmethod
    def from_tracked(cls, tracked: "Tracked", name: str) -> "Motion":
        """Poses of an object that was tracked in a film, with their covariances, as those of a body.

        Frames of a motion count as independent. Those of a film that was tracked as one motion are not, and
        their covariances are multiplied by how many frames say the same. What all of them are off by alike is
        what training says of the learned object (`Doubt`, here `alike`).
        """
        return cls.create(
            tracked.times,
            name,
            position=tracked.position,
            orientation=tracked.orientation,
            covariance=tracked.own * tracked.repeats[:, None, None],
            alike=tracked.doubt,
            point="origin",
        )

    def named(self, scene: Scene) -> "Motion":
        """This motion as that of the scene's only body that moves, if nobody named the body.

        Raises:
            ValueError: If several bodies move, or none does.
        """
        if self.names != (UNNAMED,):
            return self
        moving = [body.name for body in scene.bodies if not body.fixed]
        if len(moving) != 1:
            raise ValueError(
                f"the motion does not name its body, and of the scene's {moving} move: say which by names="
                " of load_motion, --body of the command, or columns such as soap.x"
            )
        return dataclasses.replace(self, names=(moving[0],))

    def part(self, first: int, last: int) -> "Motion":
        """Frames from `first` up to, not including, `last`; times stay as they are."""
        rows = slice(first, last)
        cut = {name: getattr(self, name)[rows] for name in ("times", *QUANTITIES)}
        for name in ("covariance", "q"):
            value = getattr(self, name)
            cut |= {} if value is None else {name: value[rows]}
        return dataclasses.replace(self, **cut)

    def with_velocities(self, frames: int = SMOOTHING_FRAMES) -> "Motion":
        """The motion with velocities and spins where they are missing, from its poses.

        A parabola is fitted to the nearest frames around each; orientations as rotation vectors from the
        middle frame, so that the slope there is the angular velocity in body axes. A motion in contact is not
        that smooth: estimate initial states rather than trust these where it matters.

        Raises:
            ValueError: If `frames` is even or < 3.
        """
        if frames < 3 or frames % 2 == 0:
            raise ValueError(f"frames must be odd and ≥ 3, got {frames}")
        shift = self.times - self.lag
        velocity, omega = self.velocity.copy(), self.omega.copy()
        for row in range(len(self.names)):
            places, turns = self.position[:, row], self.orientation[:, row]
            for t in np.flatnonzero(~np.isfinite(velocity[:, row]).all(axis=1)):
                velocity[t, row] = slope(self.times, places, shift[t], frames)
            for t in np.flatnonzero(~np.isfinite(omega[:, row]).all(axis=1)):
                if np.isfinite(turns[t]).all():
                    vectors = quat_log(quat_multiply(quat_conjugate(turns[t : t + 1]), turns))
                    omega[t, row] = slope(self.times, vectors, shift[t], frames)
        return dataclasses.replace(self, velocity=velocity, omega=omega)

    def velocity_deviations(self, frame: int, frames: int = SMOOTHING_FRAMES) -> dict[str, np.ndarray]:
        """By how much velocities of `with_velocities` may be off at a frame, as covariances of poses say.

        Where poses scatter more about the parabola than these, as they do around an impact, that says it.

        Returns:
            "velocity" [m/s] and "omega" [rad/s], shape (bodies,); NaN where no velocity was filled in, or
            poses have no covariances.
        """
        found = {key: np.full(len(self.names), np.nan) for key in ("velocity", "omega")}
        if self.covariance is None:
            return found
        when = self.times[frame] - self.lag
        spread = np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))
        for row in range(len(self.names)):
            turns = quat_log(
                quat_multiply(
                    quat_conjugate(self.orientation[frame : frame + 1, row]), self.orientation[:, row]
                )
            )
            parts = (
                ("velocity", self.position[:, row], spread[:, row, :3]),
                ("omega", turns, spread[:, row, 3:]),
            )
            for key, values, widths in parts:
                if not np.isfinite(getattr(self, key)[frame, row]).all():
                    found[key][row] = slope_deviation(self.times, np.hstack([values, widths]), when, frames)
        return found


def _frames(name: str, value: Numbers | None, n_frames: int, n_bodies: int) -> np.ndarray:
    size = QUANTITIES.get(name, JOINT_NUMBERS)
    shape = (n_frames, n_bodies, size)
    if value is None:
        return np.full(shape, np.nan)
    array = checked_numbers(name, value)
    if array.ndim == 2 and n_bodies == 1:
        array = array[:, None]
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape} (frames, bodies, {size}), got {array.shape}")
    if np.any(np.isinf(array)):
        frame = int(np.argwhere(np.isinf(array))[0, 0])
        raise ValueError(f"{name} must be finite, or NaN where it is unknown; frame {frame} is infinite")
    # A frame that is known in part is of no use.
    array[~np.isfinite(array).all(axis=-1)] = np.nan
    return array


def _covariances(value: Numbers, n_frames: int, n_bodies: int) -> np.ndarray:
    shape = (n_frames, n_bodies, 6, 6)
    array = checked_numbers("covariance", value)
    if array.ndim == 3 and n_bodies == 1:
        array = array[:, None]
    if array.shape != shape:
        raise ValueError(f"covariance must have shape {shape} (frames, bodies, 6, 6), got {array.shape}")
    known = np.isfinite(array).all(axis=(-2, -1))
    array[~known] = np.nan
    sizes = np.sqrt(np.abs(np.diagonal(array, axis1=-2, axis2=-1)))
    scaled = array / np.maximum(sizes[..., :, None] * sizes[..., None, :], 1e-300)
    for frame, body in np.argwhere(known):
        matrix = scaled[frame, body]
        if np.abs(matrix - matrix.T).max() > 1e-6 or np.linalg.eigvalsh(matrix).min() <= 0:
            raise ValueError(
                "covariance must be symmetric and positive definite, or NaN where it is unknown; that of"
                f" frame {frame} is not"
            )
    return array


def _alike(value: Numbers, covariance: Numbers | None) -> tuple[float, float, float]:
    if covariance is None:
        raise ValueError("alike needs the covariance of poses, got covariance None")
    widths = checked_numbers("alike", value)
    if widths.shape != (3,) or not np.all(np.isfinite(widths) & (widths >= 0)):
        raise ValueError(
            "alike must be three standard deviations ≥ 0, of an offset [sizes], a turn [rad] and a share, got"
            f" {value}"
        )
    offset, turn, share = widths.tolist()
    return offset, turn, share


def _unit_quaternions(orientation: np.ndarray) -> np.ndarray:
    norms = np.linalg.norm(orientation, axis=-1)
    wrong = np.isfinite(norms) & (np.abs(norms - 1) > 0.05)
    if np.any(wrong):
        frame, body = (int(i) for i in np.argwhere(wrong)[0])
        raise ValueError(
            "orientation must hold unit quaternions (w, x, y, z), got one of length "
            f"{norms[frame, body]:.4g} at frame {frame}"
        )
    unit = orientation / norms[..., None]
    # q and −q are one rotation; programs jump between them. Each goes on from the last one that was seen.
    for body in range(unit.shape[1]):
        seen = np.flatnonzero(np.isfinite(unit[:, body]).all(axis=-1))
        turns = np.sum(unit[seen[1:], body] * unit[seen[:-1], body], axis=-1) < 0
        flips = np.concatenate([[0], np.cumsum(turns)]) % 2 == 1
        unit[seen[flips[: len(seen)]], body] *= -1
    return unit


def _check_rotation(motion: Motion) -> None:
    """Compare turns from frame to frame with the angular velocities.

    Raises:
        ValueError: If they contradict each other as given but not in another convention.
    """
    for row, name in enumerate(motion.names):
        turns, omega = motion.orientation[:, row], motion.omega[:, row]
        steps = np.diff(motion.times)[:, None]
        known = np.isfinite(turns[:-1]).all(axis=1) & np.isfinite(turns[1:]).all(axis=1)
        known &= np.isfinite(omega[:-1]).all(axis=1) & np.isfinite(omega[1:]).all(axis=1)
        mean = 0.5 * (omega[:-1] + omega[1:])
        # Slower than this, noise decides; faster, frames are too far apart to tell turns.
        known &= (np.linalg.norm(mean, axis=1) > 0.2) & (np.linalg.norm(mean * steps, axis=1) < 1.0)
        if known.sum() < 4:
            continue

        def mismatch(q: np.ndarray, spin: np.ndarray, known=known, steps=steps) -> float:
            rates = (quat_log(quat_multiply(quat_conjugate(q[:-1]), q[1:])) / steps)[known]
            wrong = np.linalg.norm(rates - spin[known], axis=1) / np.linalg.norm(spin[known], axis=1)
            return float(np.median(wrong))

        given = mismatch(turns, mean)
        if given < _INCONSISTENT:
            continue
        other_order = mismatch(turns[:, [3, 0, 1, 2]], mean)
        inverse = mismatch(turns * np.array([1.0, -1, -1, -1]), mean)
        in_world = mismatch(turns, quat_rotate(quat_conjugate(turns[:-1]), mean))
        best = min(other_order, inverse, in_world)
        if best < 0.5 * given and best < _INCONSISTENT:
            reason = {
                other_order: "they fit as (x, y, z, w): say so, or reorder them",
                inverse: "they fit as world → body: take their conjugates",
                in_world: "they fit if omega is given in world axes: turn it into body axes",
            }[best]
            raise ValueError(
                f"orientation of {name!r} must be wxyz, body → world, and omega in body axes, but they "
                f"contradict each other ({100 * given:.0f} % apart): {reason}"
            )


def joint_table(layout: StateLayout, q: Float[Array, "t k"]) -> Float[Array, "t n 3"]:
    """Joint coordinates by the bodies that hang on the joints, as `Motion.q` has them for all n bodies."""
    bodies, parts = _places(layout)
    return jnp.zeros((q.shape[0], layout.bodies, JOINT_NUMBERS), q.dtype).at[:, bodies, parts].set(q)


def joint_numbers(layout: StateLayout, table: np.ndarray) -> np.ndarray:
    """Joint coordinates (k,) from a row of `joint_table`, shape (n, 3)."""
    return table[_places(layout)]


def joint_widths(layout: StateLayout) -> np.ndarray:
    """How many numbers of its own the joint of each body has, shape (n,)."""
    return np.bincount(_places(layout)[0], minlength=layout.bodies)


def _places(layout: StateLayout) -> tuple[np.ndarray, np.ndarray]:
    """Body, and which of the coordinates of its joint, of each coordinate."""
    joints = layout.with_coordinates
    bodies = [layout.children[j] for j in joints]
    parts = [place - layout.coordinates[j] for place, j in enumerate(joints)]
    return np.array(bodies, int), np.array(parts, int)


def motion_of_joints(scene: Scene, times: Numbers, q: Numbers, *, state: State | None = None) -> Motion:
    """The motion of a log of joint coordinates.

    What `identify` compares are the coordinates. Poses of the bodies that hang on the joints follow from
    them: each noisy coordinate moves all bodies after its joint, so these are not observations of their own.
    Positions are those of the field frames, so that they say nothing of centres of mass, which may be
    unknown.

    Args:
        scene: The scene.
        times: Of the rows of the log [s], shape (T,).
        q: Coordinates of all joints, in the order of `State.q` [rad or m], shape (T, k); NaN where they were
            not observed. Angles of hinges that were kept within one turn are unwrapped, which a UserWarning
            says.
        state: Where the bodies are that hang on no joint; default: as in `Scene.initial_state`.

    Raises:
        ValueError: If shapes do not fit, or the scene has no joints with coordinates.
    """
    checked_kind("scene", scene, Scene)
    if state is not None:
        checked_kind("state", state, State)
        scene.check_state(state)
    k = scene.layout.n_joints
    stamps, rows = checked_numbers("times", times), checked_floating("q", q).astype(scene.timestep.dtype)
    if not k:
        raise ValueError("scene must have joints with coordinates, got none")
    if stamps.ndim != 1 or not np.all(np.diff(stamps) > 0):
        raise ValueError(f"times must be a vector of increasing numbers [s], got {shown(times)}")
    if rows.shape != (len(stamps), k):
        raise ValueError(f"q must have shape ({len(stamps)}, {k}) as times have it, got {rows.shape}")
    if np.any(np.isinf(np.asarray(rows))) or not np.any(np.isfinite(np.asarray(rows))):
        raise ValueError("q must hold finite numbers, or NaN where it was not observed")
    rows = jnp.asarray(_whole_turns(scene, np.asarray(rows)))
    base = scene.initial_state() if state is None else state

    def placed(row):
        return scene.frames(dataclasses.replace(base, q=row, v=jnp.zeros_like(row)))

    frames = jax.vmap(placed)(rows)
    com = jnp.stack([body.centre_of_mass for body in scene.bodies]).astype(scene.timestep.dtype)
    hanging = list(scene.layout.children)
    origin = frames.position - quat_rotate(frames.orientation, com[None])
    return Motion.create(
        stamps,
        [scene.names[i] for i in hanging],
        position=np.asarray(origin)[:, hanging],
        orientation=np.asarray(frames.orientation)[:, hanging],
        point="origin",
        q=np.asarray(joint_table(scene.layout, rows))[:, hanging],
    )


def _whole_turns(scene: Scene, rows: np.ndarray) -> np.ndarray:
    """Joint coordinates without the jumps of angles that a log keeps within ±π or from 0 to 2π."""
    rows, notes = rows.copy(), []
    for place, j in enumerate(scene.layout.with_coordinates):
        joint = scene.joints[j]
        if joint.kind != "hinge":
            continue
        if joint.limits is not None and float(np.ptp(np.asarray(joint.limits))) < 2 * np.pi - 0.1:
            # It cannot turn all the way round: what jumps is not an angle that was wrapped.
            continue
        rows[:, place], jumps = unwrapped(rows[:, place])
        if jumps:
            notes.append(f"angles of the joint of {joint.child!r} jump by 2π {jumps} times and are unwrapped")
    if notes:
        warnings.warn("; ".join(notes), UserWarning, stacklevel=3)
    return rows
