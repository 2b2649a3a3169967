"""Joint coordinates that bring links to where they should be, within limits, and that close loops."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.checks import checked_count, checked_items, checked_kind, checked_number, checked_text
from dano.maths import checked_array, checked_quaternion, Numbers, quat_conjugate, quat_log, quat_multiply
from dano.names import did_you_mean
from dano.robots._robot import check_arguments, Robot
from dano.scene import Scene, State
from dano.solvers import bounded_least_squares, LeastSquaresOptions, NormalEquations

# Gap [m, rad] at which loops count as closed in float64, in float32, and steps to get there.
_CLOSED, _FLOAT32, _STEPS = 1e-12, 1e-5, 60
# Largest change of a coordinate in a step [rad or m].
_LONGEST = 0.5


def loop_gaps(scene: Scene, state: State) -> Float[Array, " c"]:
    """How far the loops of a scene are from being closed at a state, see `Loops.gaps`.

    Raises:
        ValueError: If the state does not fit the scene, or it has no loops.
    """
    checked_kind("scene", scene, Scene)
    loops = scene.closing
    if loops is None:
        raise ValueError("scene must have loops, got none")
    frames = scene.frames(state)
    return loops.gaps(frames.position, frames.orientation)


def close_loops(scene: Scene, state: State, hold: Sequence[str] = ()) -> State:
    """The state near to one in which the loops of a scene are closed, and stay so with its velocities.

    Joint coordinates change as little as closing takes (Newton's method with the pseudoinverse). Bodies that
    move freely stay where they are.

    Args:
        scene: A scene with loops.
        state: Where to start.
        hold: Bodies whose joints keep their coordinates, such as a crank.

    Raises:
        ValueError: If the scene has no loops, a body hangs on no joint, or loops stay open: the error says by
            how much.
    """
    gaps = loop_gaps(scene, state)
    hold = checked_items("hold", hold, str)
    moves = _free_columns(scene, hold)
    limit = _CLOSED if gaps.dtype == jnp.float64 else _FLOAT32
    assert state.q is not None and state.v is not None
    q = state.q
    for _ in range(_STEPS):
        gaps, slopes = _gaps_and_slopes(scene, state, q)
        if float(jnp.max(jnp.abs(gaps))) <= limit:
            break
        step = -np.linalg.lstsq(np.asarray(slopes)[:, moves], np.asarray(gaps), rcond=1e-9)[0]
        step *= min(1.0, _LONGEST / max(1e-12, float(np.abs(step).max(initial=0.0))))
        q = q.at[moves].add(step)
    gaps, slopes = (np.asarray(x) for x in _gaps_and_slopes(scene, state, q))
    if not np.abs(gaps).max() <= 100 * limit:
        held = f" with {', '.join(map(repr, hold))} held" if hold else ""
        raise ValueError(
            f"loops must be closed by the joints{held}, got a gap of {np.abs(gaps).max():.3g} m or rad at"
            f" {_worst(scene, gaps)} where it is smallest near the start"
        )
    v = np.asarray(state.v, float)
    missed = slopes @ v
    v = v.copy()
    v[moves] -= np.linalg.lstsq(slopes[:, moves], missed, rcond=1e-9)[0]
    return scene.filled(dataclasses.replace(state, q=q, v=jnp.asarray(v, q.dtype)))


def _free_columns(scene: Scene, hold: Sequence[str]) -> np.ndarray:
    """Places among q that may change."""
    layout = scene.layout
    held: set[int] = set()
    children = {joint.child: j for j, joint in enumerate(scene.joints) if layout.width(j)}
    for name in hold:
        if name not in children:
            hint = did_you_mean(name, children)
            raise ValueError(f"hold must name bodies on joints {list(children)}, got {name!r}{hint}")
        first = layout.coordinates[children[name]]
        held |= set(range(first, first + layout.width(children[name])))
    return np.array([i for i in range(layout.n_joints) if i not in held], int)


@eqx.filter_jit
def _gaps_and_slopes(scene: Scene, state: State, q: Float[Array, " k"]):
    def gaps(q):
        return loop_gaps(scene, dataclasses.replace(state, q=q))

    return gaps(q), jax.jacfwd(gaps)(q)


def _worst(scene: Scene, gaps: np.ndarray) -> str:
    row = int(np.abs(gaps).argmax())
    loops = scene.loops
    welds = [loop for loop in loops if loop.kind == "weld"]
    loop = loops[row // 3] if row < 3 * len(loops) else welds[row // 3 - len(loops)]
    return f"the loop of {loop.first or 'the world'!r} and {loop.second!r}"


# What a gap in a loop counts for, beside a target's distance.
_LOOPS = 100.0

# Ratio of the smallest to the largest singular value of a Jacobian below which it counts as singular: a
# degree and a half from a stretched elbow.
_SINGULAR = 1e-3


class Target(eqx.Module):
    """Where a link should be; what is None is left free.

    Attributes:
        link: Name in the robot's file.
        position: Of the link's frame [m, W].
        orientation: wxyz.
        weight: What a metre counts for, and 1/length [1/m] times a radian.
        length: What turns angles into lengths [m].
    """

    link: str = eqx.field(static=True)
    position: Float[Array, "3"] | None
    orientation: Float[Array, "4"] | None
    weight: Float[Array, ""]
    length: Float[Array, ""]

    def __init__(
        self,
        link: str,
        position: Numbers | None = None,
        orientation: Numbers | None = None,
        *,
        weight: Numbers = 1.0,
        length: Numbers = 0.3,
    ):
        """A target; see the attributes.

        Raises:
            ValueError: If neither a position nor an orientation is given, or a number is wrong.
        """
        checked_text("link", link)
        if position is None and orientation is None:
            raise ValueError(f"target of link {link!r} must have a position or an orientation, got neither")
        self.link = link
        what = f"of link {link!r}"
        self.position = None if position is None else checked_array(f"position {what}", position, (3,))
        self.orientation = (
            None if orientation is None else checked_quaternion(f"orientation {what}", orientation)
        )
        self.weight = checked_array(f"weight {what}", weight, (), least=0.0)
        self.length = checked_array(f"length {what}", length, (), above=0.0)


class InverseKinematics(NamedTuple):
    """What inverse kinematics found."""

    state: State  # The state, which rests
    reached: bool  # Whether all targets are met to 0.1 mm and 1e-3 rad
    position_errors: np.ndarray  # Distance of each target [m]; NaN where it has no position
    angle_errors: np.ndarray  # Angle of each target [rad]; NaN where it has no orientation
    at_limits: tuple[int, ...]  # Coordinates that lie on a limit
    # Whether the arm is where some motion of the links needs infinite speeds of the joints, e.g. stretched,
    # or with two axes in line.
    singular: bool
    reason: str  # Which target was missed, by how much and why, or why the search ended


def inverse_kinematics(
    robot: Robot,
    scene: Scene,
    state: State,
    targets: Sequence[Target],
    *,
    posture: Numbers | None = None,
    posture_weight: float = 1e-4,
    max_iterations: int = 100,
) -> InverseKinematics:
    """Joint coordinates that bring links to targets, within the joints' limits.

    Minimises Σ (weight · distance)² + (weight · length · angle)² by bounded least squares. What the targets
    leave free goes to the posture. It finds the minimum next to where it starts, and says what it missed.
    Loops stay closed.

    Args:
        robot: The robot.
        scene: A scene with it.
        state: Where to start. Bodies that move freely stay where they are.
        targets: At least one.
        posture: Coordinates q to stay near to, shape (k,); default those of `state`.
        posture_weight: What a radian or metre away from the posture counts for; small against the targets.
        max_iterations: Of the least squares.

    Raises:
        ValueError: If there is no target, a link is unknown, or a shape is wrong.
    """
    check_arguments(robot, scene, state)
    targets = checked_items("targets", targets, Target)
    if not targets:
        raise ValueError("targets must hold at least one, got none")
    posture_weight = checked_number("posture_weight", posture_weight, least=0)
    max_iterations = checked_count("max_iterations", max_iterations)
    for target in targets:
        if target.link not in robot.frames:
            hint = did_you_mean(target.link, robot.frames)
            raise ValueError(f"target must name one of {list(robot.frames)}, got {target.link!r}{hint}")
    if state.q is None or not scene.layout.n_joints:
        raise ValueError("scene must have joints with coordinates to move, got none")
    k = scene.layout.n_joints
    near = state.q if posture is None else checked_array("posture", posture, (k,))
    lower, upper = _limits(scene)
    start = np.clip(np.asarray(state.q, float), lower, upper)
    resting = dataclasses.replace(state, v=jnp.zeros_like(state.q))
    dtype = scene.timestep.dtype

    def linearize(x: np.ndarray, blocks: object) -> NormalEquations:
        q = jnp.asarray(x, dtype)
        missed, slope = _linearized(robot.place, scene, resting, tuple(targets), q)
        residual = np.concatenate([missed, posture_weight * (x - np.asarray(near, float))])
        rows = np.concatenate([slope, posture_weight * np.eye(k)])
        none = np.zeros((0, 0))
        empty = (np.zeros((0, 0)), np.zeros((0, 0, 0)), np.zeros((0, 0, k)), none.ravel())
        return NormalEquations(0.5 * float(residual @ residual), rows.T @ residual, rows.T @ rows, *empty)

    options = LeastSquaresOptions(max_iterations, tolerance=1e-12)
    solution = bounded_least_squares(linearize, start, lower=lower, upper=upper, options=options)
    found = scene.filled(dataclasses.replace(resting, q=jnp.asarray(solution.x, dtype)))
    found = close_loops(scene, found) if scene.loops else found
    errors = np.array([_errors(robot, scene, found, target) for target in targets])
    tight = np.flatnonzero((solution.x <= lower) | (solution.x >= upper))
    met = bool(np.nanmax(errors[:, 0], initial=0) <= 1e-4 and np.nanmax(errors[:, 1], initial=0) <= 1e-3)
    residual, slope = _linearized(robot.place, scene, resting, tuple(targets), solution.x)
    singular = _is_singular(slope)
    reason = solution.stop.value
    if not met:
        layout = scene.layout
        pulls = np.abs(slope.T @ residual) > _SINGULAR * np.linalg.norm(slope) * np.linalg.norm(residual)
        held = set(tight[pulls[tight]].tolist())
        names = [scene.names[layout.children[joint]] for joint, _, place in layout.dofs if place in held]
        reason = _missed_because(targets, errors, names, singular and not pulls.any())
    return InverseKinematics(found, met, errors[:, 0], errors[:, 1], tuple(map(int, tight)), singular, reason)


def _is_singular(slope: np.ndarray) -> bool:
    """Whether joints cannot move targets in a direction in which they usually can."""
    values = np.linalg.svd(slope, compute_uv=False)
    return bool(values[-1] < _SINGULAR * values[0])


def _missed_because(targets: Sequence[Target], errors: np.ndarray, limited: list[str], blocked: bool) -> str:
    worst = int(np.argmax(np.nan_to_num(errors).sum(axis=1)))
    distance, angle = errors[worst]
    off = [f"{1e3 * distance:.4g} mm"] * bool(distance > 0) + [f"{np.degrees(angle):.3g}°"] * bool(angle > 0)
    text = f"link {targets[worst].link!r} is {' and '.join(off)} away from its target"
    if limited:
        return f"{text}; joints at a limit: {', '.join(limited)}"
    if blocked:
        return (
            f"{text}, and no joint moves it there from this singular configuration (a stretched arm, or two"
            " axes in line): the target is out of reach, or start at another posture"
        )
    return f"{text}, the nearest that the search found: the target is out of reach, or start at another state"


def _limits(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    limits = scene.chains.laws.limits
    k = scene.layout.n_joints
    if limits is None:
        return np.full(k, -np.inf), np.full(k, np.inf)
    lower, upper = np.asarray(limits, float).T
    return lower, upper


def _linearized(place, scene: Scene, state: State, targets: tuple[Target, ...], q):
    """What is missed, and its derivative by q; as NumPy."""
    missed, slope = _missed(place, scene, state, targets, q)
    return np.asarray(missed, float), np.asarray(slope, float)


@eqx.filter_jit
def _missed(place, scene: Scene, state: State, targets: tuple[Target, ...], q):
    def of(q):
        at = dataclasses.replace(state, q=q)
        parts = [part for target in targets for part in _parts(place, scene, at, target)]
        return jnp.concatenate([*parts, *([_LOOPS * loop_gaps(scene, at)] if scene.loops else [])])

    return of(q), jax.jacfwd(of)(q)


def _parts(place, scene: Scene, state: State, target: Target) -> list[Array]:
    position, orientation, _ = place(scene, state, target.link)
    dtype, parts = position.dtype, []
    weight = target.weight.astype(dtype)
    if target.position is not None:
        parts.append(weight * (position - target.position.astype(dtype)))
    if target.orientation is not None:
        turn = quat_log(quat_multiply(quat_conjugate(target.orientation.astype(dtype)), orientation))
        parts.append(weight * target.length.astype(dtype) * turn)
    return parts


def _errors(robot: Robot, scene: Scene, state: State, target: Target) -> tuple[float, float]:
    position, orientation, _ = robot.place(scene, state, target.link)
    distance = angle = float("nan")
    if target.position is not None:
        distance = float(jnp.linalg.norm(position - target.position))
    if target.orientation is not None:
        turn = quat_log(quat_multiply(quat_conjugate(target.orientation), orientation))
        angle = float(jnp.linalg.norm(turn))
    return distance, angle
