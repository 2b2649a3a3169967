"""Residuals of windows, and their normal equations, in one compiled program each.

Where bodies hit each other, residuals are rough: their derivatives are those of ripples, and a search ends in
one of many small minima. Then unknowns are drawn around the point, in pairs ± d of independent directions,
and a plane is put through the residuals. Its slopes take the place of derivatives and its value that of
residuals; what is left beside it, the ripple, tells how far the answer may be off because of it.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int

from dano.engine import AbstractEngine, compiled, difference, gather, map_rows, retract, simulate
from dano.identification._settings import Selection, with_values
from dano.identification._windows import Windows
from dano.identification.motions import joint_table, QUANTITIES
from dano.maths import einsum, product, quat_conjugate, quat_log, quat_multiply, quat_normalize, quat_rotate
from dano.scene import Control, Scene, State


class Smoothing(NamedTuple):
    """Where unknowns of windows are drawn: at c ± L d, as near to the point as the bounds allow."""

    draws: Float[Array, "k u"]  # Rows d, without their opposites, shape (K, u); Σ d dᵀ = K 1
    spread: Float[Array, "w u u"]  # L of each window, shape (windows, u, u)
    inverse: Float[Array, "w u u"]  # L⁻¹
    lower: Float[Array, " p"]  # Bounds of the parameters, shape (p,); may be −∞
    upper: Float[Array, " p"]  # Bounds; may be ∞


class LossPlane(NamedTuple):
    """The plane through the residuals around a point."""

    value: Float[Array, " r"]  # At the point
    slope: Float[Array, "r u"]  # By the unknowns
    # By which residuals miss it in their odd part, so that curvature does not count.
    ripple: Float[Array, "k r"]


def plane_through(
    residuals: Callable[[Array], tuple[Array, Any]],
    at: Float[Array, " u"],
    smoothing: Smoothing,
    spread,
    inverse,
) -> tuple[LossPlane, Any]:
    """The plane around a point, and what else the residuals at the point say; see `Smoothing`."""
    draws = smoothing.draws
    moves = product(draws, spread.T)
    middle = _inside(at, moves, smoothing.lower, smoothing.upper)
    unknowns = jnp.concatenate([at[None], middle[None] + moves, middle[None] - moves])
    rows, others = jax.vmap(residuals)(unknowns)
    k = moves.shape[0]
    above, below = rows[1 : 1 + k], rows[1 + k :]
    odd = 0.5 * (above - below)
    by_draw = product(draws.T, odd) / k
    # Each odd part is the mean of two, and slopes took as many draws as there are unknowns.
    share = 2 * k / max(1, k - at.shape[0])
    ripple = jnp.sqrt(jnp.asarray(share, rows.dtype)) * (odd - product(draws, by_draw))
    slope = product(by_draw.T, inverse)
    value = 0.5 * jnp.mean(above + below, axis=0) + product(slope, at - middle)
    return LossPlane(value, slope, ripple), jax.tree.map(lambda leaf: leaf[0], others)


def _inside(at: Float[Array, " u"], moves: Float[Array, "k u"], lower, upper) -> Float[Array, " u"]:
    """The point nearest to one from which all moves, and their opposites, stay within the bounds."""
    p = lower.shape[0]
    reach = jnp.max(jnp.abs(moves[:, :p]), axis=0)
    # Where bounds are closer together than the moves reach, as far from both; NaN without bounds.
    between = 0.5 * (lower + upper)
    low, high = jnp.fmin(lower + reach, between), jnp.fmax(upper - reach, between)
    return at.at[:p].set(jnp.clip(at[:p], low, high))


class WindowStart(NamedTuple):
    """What is estimated of the state in which a window begins (static).

    Unknowns are, body by body, three numbers of each quantity, then coordinates of the joints, then their
    velocities.
    """

    free: tuple[int, ...]  # Bodies that were observed and move freely
    # Of each joint coordinate whether it is an angle; none if no body on a joint was observed.
    turning: tuple[bool, ...]
    # Quantities that are estimated. Coordinates of joints are with positions or orientations, their
    # velocities with velocities or spins.
    initial: tuple[str, ...]

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return 3 * len(self.free) * len(self.initial) + len(self.turning) * (self.poses + self.speeds)

    @property
    def poses(self) -> bool:
        """Whether coordinates of joints are estimated."""
        return "position" in self.initial or "orientation" in self.initial

    @property
    def speeds(self) -> bool:
        """Whether velocities of joints are estimated."""
        return "velocity" in self.initial or "omega" in self.initial

    def moved(self, state: State, change: Float[Array, " k"]) -> State:
        """A state moved by a change of the unknowns."""
        if not self.size:
            return state
        n, joints = 3 * len(self.free) * len(self.initial), len(self.turning)
        if self.free:
            given = iter(jnp.split(change[:n].reshape(len(self.free), -1), len(self.initial), axis=1))
            zero = jnp.zeros((len(self.free), 3), change.dtype)
            rows = [next(given) if key in self.initial else zero for key in QUANTITIES]
            state = retract(state, np.array(self.free), jnp.concatenate(rows, axis=1))
        if state.q is None or state.v is None or not joints:
            return state
        none = jnp.zeros(joints, change.dtype)
        q = change[n : n + joints] if self.poses else none
        v = change[len(change) - joints :] if self.speeds else none
        return dataclasses.replace(state, q=state.q + q, v=state.v + v)

    def jump(self, nominal: State, state: State) -> Float[Array, " c"]:
        """What leads from one state to another, as a change of all that could be estimated."""
        gone = difference(nominal, state, np.array(self.free, int)).ravel()
        if not self.turning:
            return gone
        assert nominal.q is not None and nominal.v is not None and state.q is not None and state.v is not None
        return jnp.concatenate([gone, state.q - nominal.q, state.v - nominal.v])

    def widths(self, usual: Sequence[float]) -> np.ndarray:
        """Standard deviations of the numbers of a jump from those of the four quantities."""
        position, orientation, velocity, omega = usual
        of_bodies = np.tile(np.repeat(usual, 3), len(self.free))
        q = [orientation if turns else position for turns in self.turning]
        v = [omega if turns else velocity for turns in self.turning]
        return np.concatenate([of_bodies, q, v])

    def deviations(self, usual: Sequence[float]) -> np.ndarray:
        """Standard deviations of the unknowns from those of the four quantities."""
        position, orientation, velocity, omega = usual
        each = dict(zip(QUANTITIES, usual, strict=True))
        of_bodies = np.tile(
            np.repeat([each[key] for key in QUANTITIES if key in self.initial], 3), len(self.free)
        )
        q = [orientation if turns else position for turns in self.turning if self.poses]
        v = [omega if turns else velocity for turns in self.turning if self.speeds]
        return np.concatenate([of_bodies, q, v])


class ResidualModel(NamedTuple):
    """What residuals depend on besides the unknowns; its static part decides the program."""

    scene: Scene  # The scene
    policy: Any  # Controls as a function of state and time, or None
    engine: AbstractEngine  # What simulates
    windows: Windows  # The windows
    # Length of a residual, in standard deviations, from which it counts linearly; None: never.
    huber: Float[Array, ""] | None
    # Standard deviations by which a window may miss the beginning of the next, of the numbers of
    # `Start.jump`, or None.
    jumps: Float[Array, " c"] | None
    selections: tuple[Selection, ...]  # The parameters
    bodies: tuple[int, ...]  # Which bodies were observed
    quantities: tuple[str, ...]  # Which quantities count
    start: WindowStart  # What of the initial states is estimated
    n_steps: int  # Steps of each window
    reverse: bool  # Whether Jacobians are taken in reverse mode
    batch: int  # How many windows a device simulates at once
    mesh: Mesh  # The devices of this process


class Linearized(NamedTuple):
    """A simulation of all windows, with derivatives: leaves with a leading axis of windows.

    Unknowns u of a window are the coordinates x, then the change of its initial state.
    """

    loss: Float[Array, " w"]  # Half the sum of squared residuals, or Huber's function of them
    gradient: Float[Array, "w u"]  # Of the loss
    hessian: Float[Array, "w u u"]  # Gauss–Newton's
    # By which a window misses the beginning of the next, in standard deviations; one zero if it may.
    jump: Float[Array, "w c"]
    jump_slope: Float[Array, "w c u"]  # Its derivative
    predicted: State  # States at the frames: positions and velocities that correspond to the observed ones
    lengths: Float[Array, "w f b q"]  # Of the residuals in standard deviations; −1 where nothing was observed
    unconverged: Int[Array, " w"]  # Steps that did not converge
    # Gradients of the loss that ripples of the residuals would have alone, one for each draw of unknowns; one
    # of zeros without smoothing.
    ripple: Float[Array, "w k u"]
    jump_ripple: Float[Array, "w k c"]  # Ripples of `jump`


class _Late(eqx.Module):
    """A policy for a rollout that begins later than its motion."""

    policy: Any
    begin: Float[Array, ""]

    def __call__(self, state: State, time: Float[Array, ""]) -> Control:
        """Control of the step that begins at a time [s] of the rollout."""
        return self.policy(state, self.begin + time)


def linearized(
    model: ResidualModel,
    x: Float[Array, " p"],
    start: State,
    following: State,
    wanted: Bool[Array, " w"],
    smoothing: Smoothing | None = None,
) -> Linearized:
    """Simulate windows at coordinates x from their initial states.

    Args:
        model: The model.
        x: Coordinates of the parameters.
        start: Initial states of the windows.
        following: Initial states of the windows that come next in the same motions.
        wanted: Which windows to simulate; rows of the others are zero.
        smoothing: For a plane through draws of the unknowns instead of derivatives.

    Returns:
        All windows, in every process: each process, and each of its devices, simulates a share of them.
    """
    n, processes = len(wanted), jax.process_count()
    if processes * model.mesh.size == 1:
        return _linearized(model, x, start, following, wanted, smoothing)
    each = -(-n // (processes * model.mesh.size)) * model.mesh.size
    mine = jax.process_index() * each + np.arange(each)
    # Past the end nothing is wanted: the shares have one size.
    rows = np.minimum(mine, n - 1)
    windows, start, following = jax.tree.map(lambda leaf: leaf[rows], (model.windows, start, following))
    share = jnp.asarray(np.asarray(wanted)[rows] & (mine < n))
    if smoothing is not None:
        smoothing = smoothing._replace(spread=smoothing.spread[rows], inverse=smoothing.inverse[rows])
    found = _linearized(model._replace(windows=windows), x, start, following, share, smoothing)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[:n]), gather(found))


@compiled
def _linearized(
    model: ResidualModel,
    x: Float[Array, " p"],
    start: State,
    following: State,
    wanted: Bool[Array, " w"],
    smoothing: Smoothing | None,
) -> Linearized:
    p, draws = x.shape[0], 1 if smoothing is None else smoothing.draws.shape[0]
    smoothing = jax.tree.map(lambda part: part.astype(x.dtype), smoothing)

    def one(item):
        window, state, after, _, seen_from = item

        def residuals(unknowns):
            rows, jump, predicted, unconverged = _residuals(
                model, window, state, after, unknowns[:p], unknowns[p:]
            )
            return jnp.concatenate([rows.ravel(), jump]), (rows, jump, predicted, unconverged)

        at = jnp.concatenate([x, _no_change(model)])
        if smoothing is None:
            jacobian = jax.jacrev if model.reverse else jax.jacfwd
            slope, (rows, jump, predicted, unconverged) = jacobian(residuals, has_aux=True)(at)
            middle, ripple = rows, jnp.zeros((1, slope.shape[0]), slope.dtype)
        else:
            plane, (rows, jump, predicted, unconverged) = plane_through(residuals, at, smoothing, *seen_from)
            slope, ripple = plane.slope, plane.ripple
            middle, jump = plane.value[: rows.size].reshape(rows.shape), plane.value[rows.size :]
        weights, lengths, loss = _robust(model, middle)
        lengths = lengths if smoothing is None else jnp.sqrt(jnp.sum(rows * rows, axis=-1))
        seen = jnp.stack([window.weights[key][:, _bodies(model)] for key in model.quantities], axis=-1) > 0
        slope, jump_slope = slope[: rows.size], slope[rows.size :]
        weighted = jnp.broadcast_to(weights[..., None], rows.shape).ravel()[:, None] * slope
        return Linearized(
            loss,
            weighted.T @ middle.ravel(),
            weighted.T @ slope,
            jump,
            jump_slope,
            predicted,
            jnp.where(seen, lengths, -1),
            unconverged,
            ripple[:, : rows.size] @ weighted,
            ripple[:, rows.size :],
        )

    def one_or_none(item):
        return jax.lax.cond(item[3], one, lambda item: _nothing(model, item[1], p, draws), item)

    # A row for every window, also without smoothing.
    spread = (wanted, wanted) if smoothing is None else smoothing[1:3]
    rows = model.windows, start, following, wanted, spread
    return map_rows(one_or_none, rows, batch_size=model.batch, mesh=model.mesh)


def _nothing(model: ResidualModel, state: State, p: int, draws: int) -> Linearized:
    """Zeros in place of a window."""
    frames, bodies = model.windows.frame[0].shape[1], len(model.bodies)
    unknowns = p + len(_no_change(model))
    jumps = 1 if model.jumps is None else len(model.jumps)

    def zeros(*shape: int) -> Array:
        return jnp.zeros(shape, model.scene.timestep.dtype)

    return Linearized(
        zeros(),
        zeros(unknowns),
        zeros(unknowns, unknowns),
        zeros(jumps),
        zeros(jumps, unknowns),
        jax.tree.map(lambda leaf: zeros(frames, *leaf.shape), _rows_of(state)),
        zeros(frames, bodies, len(model.quantities)),
        jnp.zeros((), int),
        zeros(draws, unknowns),
        zeros(draws, jumps),
    )


@compiled
def losses(model: ResidualModel, x: Float[Array, " p"], start: State, following: State) -> Float[Array, " w"]:
    """Losses of windows, jumps included, without derivatives."""

    def one(item):
        window, state, after = item
        rows, jump, _, _ = _residuals(model, window, state, after, x, _no_change(model))
        return _robust(model, rows)[2] + 0.5 * jnp.sum(jump * jump)

    return map_rows(one, (model.windows, start, following), batch_size=model.batch, mesh=model.mesh)


@compiled
def moved(start: State, change: Float[Array, "w k"], unknowns: WindowStart) -> State:
    """Initial states after a change of their estimated parts."""
    return jax.vmap(unknowns.moved)(start, change)


def _rows_of(state: State) -> State:
    """The part of a state that is observed."""
    return dataclasses.replace(state, v=None)


def _no_change(model: ResidualModel) -> Float[Array, " k"]:
    return jnp.zeros(model.start.size, model.scene.timestep.dtype)


def _bodies(model: ResidualModel) -> np.ndarray:
    return np.array(model.bodies)


def _residuals(model: ResidualModel, window: Windows, start: State, following: State, x, change):
    """Residuals (frames, bodies, quantities, 3) in standard deviations, and what they were computed from."""
    scene = with_values(model.selections, "scene", model.scene, x)
    controls = window.controls
    if model.policy is not None:
        controls = _Late(with_values(model.selections, "controls", model.policy, x), window.begin)
    elif controls is not None:
        controls = with_values(model.selections, "controls", controls, x)
    start = model.start.moved(start, change)
    trajectory = simulate(
        scene,
        shifted(scene, start, window.origins, 1),
        model.n_steps,
        controls=controls,
        engine=model.engine,
    )
    states = trajectory.states
    places = _at(states, window.frame)
    speeds = _at(states, window.moment)
    mixed = dataclasses.replace(places, velocity=speeds.velocity, omega=speeds.omega, v=None)
    predicted = shifted(scene, mixed, window.origins, -1)
    rows = jnp.stack([_row(model, window, predicted, key) for key in model.quantities], axis=2)
    if window.whitening is not None:
        rows = _whitened(model, rows, window)
    # Not empty: mapping in batches cannot put empty arrays together.
    jump = jnp.zeros(1, rows.dtype)
    if model.jumps is not None:
        last = shifted(scene, _at(states, tuple(part[None] for part in window.end)), window.origins, -1)
        last = jax.tree.map(lambda leaf: leaf[0], last)
        jump = window.chained * model.start.jump(following, last) / model.jumps
    used = jnp.arange(model.n_steps) <= jnp.max(window.frame[0])
    unconverged = jnp.sum(used & ~trajectory.converged)
    return rows, jump, predicted, unconverged


def _at(states: State, where) -> State:
    """States between steps: positions and velocities in proportion, orientations normalised."""
    step, share = where

    def mix(leaf):
        before, after = leaf[step], leaf[step + 1]
        return before + share.reshape(-1, *[1] * (leaf.ndim - 1)) * (after - before)

    mixed = jax.tree.map(mix, states)
    return eqx.tree_at(lambda s: s.orientation, mixed, quat_normalize(mixed.orientation))


def shifted(scene: Scene, state: State, origins, sign: int) -> State:
    """From origins of the field frames to centres of mass (+) or back (−), for the bodies marked.

    Args:
        scene: The scene.
        state: States, shape (…, bodies, ·).
        origins: The bodies marked, shape (bodies,) or as the states.
        sign: 1 or −1.
    """
    arm = jnp.stack([body.centre_of_mass for body in scene.bodies])
    arm = jnp.where(origins[..., None], sign * arm, 0).astype(state.position.dtype)
    arm = jnp.broadcast_to(arm, state.position.shape)
    return dataclasses.replace(
        state,
        position=state.position + quat_rotate(state.orientation, arm),
        velocity=state.velocity + quat_rotate(state.orientation, jnp.cross(state.omega, arm)),
    )


def _row(model: ResidualModel, window: Windows, predicted: State, key: str) -> Float[Array, "f b 3"]:
    bodies = _bodies(model)
    if key == "q":
        assert predicted.q is not None and window.joints is not None
        missed = joint_table(model.scene.layout, predicted.q) - window.joints
        return window.weights[key][:, bodies, None] * missed[:, bodies]
    found, seen = getattr(predicted, key)[:, bodies], getattr(window.observed, key)[:, bodies]
    weight = window.weights[key][:, bodies, None]
    if key == "orientation":
        # Where nothing was seen, a rotation to differentiate, not to count.
        seen = jnp.where(weight > 0, seen, found)
        return weight * quat_log(quat_multiply(quat_conjugate(seen), found))
    return weight * (found - seen)


def _whitened(model: ResidualModel, rows: Float[Array, "f b q 3"], window: Windows) -> Array:
    """Residuals of poses as independent ones of variance one; others as they are."""
    poses = [key for key in ("position", "orientation") if key in model.quantities]
    if not poses:
        return rows
    index = [model.quantities.index(key) for key in poses]
    numbers = np.concatenate([3 * ("position", "orientation").index(key) + np.arange(3) for key in poses])
    bodies = _bodies(model)
    assert window.whitening is not None
    part = window.whitening[:, bodies][:, :, numbers][..., numbers]
    flat = rows[:, :, np.array(index)].reshape(*rows.shape[:2], len(numbers))
    white = einsum("fbij,fbj->fbi", part, flat)
    if window.common is not None:
        common = window.common[:, bodies][:, :, numbers]
        white = white - einsum("fbik,bk->fbi", common, einsum("fbik,fbi->bk", common, white))
    return rows.at[:, :, np.array(index)].set(white.reshape(*rows.shape[:2], len(index), 3))


def _robust(model: ResidualModel, rows: Float[Array, "f b q 3"]):
    """Weight and length of each residual, and the loss."""
    squared = jnp.sum(rows * rows, axis=-1)
    lengths = jnp.sqrt(squared)
    if model.huber is None:
        return jnp.ones_like(squared), lengths, 0.5 * jnp.sum(squared)
    far = lengths > model.huber
    weights = jnp.where(far, model.huber / jnp.where(far, lengths, 1), 1)
    each = jnp.where(far, model.huber * (lengths - 0.5 * model.huber), 0.5 * squared)
    return weights, lengths, jnp.sum(each)
