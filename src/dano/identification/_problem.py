"""The least squares problem: residuals of all windows over parameters and initial states, and its search.

Normal equations of motions whose windows are to meet.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from dano.engine import device_mesh
from dano.identification._checkpoint import Keep, SearchCheckpoint
from dano.identification._residuals import (
    Linearized,
    linearized,
    losses,
    moved,
    ResidualModel,
    shifted,
    Smoothing,
    WindowStart,
)
from dano.identification._settings import Setup, start_deviations
from dano.identification._settling import settled
from dano.identification._uncertainty import Groups, Identification
from dano.identification._windows import draw_velocities, plan_windows
from dano.identification.motions import Motion, QUANTITIES
from dano.scene import Control, Scene, State
from dano.solvers import (
    bounded_least_squares,
    eliminated,
    Iterate,
    LeastSquaresOptions,
    NormalEquations,
    Solution,
    Stop,
)


class _Local(NamedTuple):
    """The first five of `Linearized`, as arrays of NumPy."""

    loss: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray
    jump: np.ndarray
    slope: np.ndarray

    @classmethod
    def of(cls, found: Linearized) -> "_Local":
        """Those of a simulation of all windows."""
        return cls(*(np.asarray(v, float) for v in found[:5]))


def chained(p: int, owner: np.ndarray, jumps: Array, local: _Local) -> NormalEquations:
    """Normal equations with one block for each motion, whose windows are tied by their jumps.

    Args:
        p: Number of parameters; other unknowns are a window's own.
        owner: Motion of each window.
        jumps: Standard deviation of each number of a jump.
        local: What was simulated.
    """
    loss, gradient, hessian, jump, slope = local
    k = gradient.shape[1] - p
    counts = np.bincount(owner)
    size = int(counts.max()) * k
    place = np.concatenate([np.arange(n) for n in counts])
    m = len(counts)
    shared, shared_hessian = gradient[:, :p].sum(axis=0), hessian[:, :p, :p].sum(axis=0)
    g, b, c = np.zeros((m, size)), np.zeros((m, size, size)), np.zeros((m, size, p))
    # Windows that a shorter motion does not have stay where they are.
    for i, n in enumerate(counts):
        tail = np.arange(n * k, size)
        b[i, tail, tail] = 1.0
    losses = by_owner(owner, loss, jump)
    # The jump falls one to one as the next window's beginning moves towards the end of this one.
    step = 1 / np.asarray(jumps)
    for w, (i, j) in enumerate(zip(owner, place, strict=True)):
        mine = slice(j * k, (j + 1) * k)
        g[i, mine] += gradient[w, p:]
        b[i, mine, mine] += hessian[w, p:, p:]
        c[i, mine] += hessian[w, p:, :p]
        if j + 1 == counts[i]:
            continue
        by_x, by_mine, by_next = slope[w, :, :p], slope[w, :, p:], -np.diag(step)
        following = slice((j + 1) * k, (j + 2) * k)
        shared += by_x.T @ jump[w]
        shared_hessian += by_x.T @ by_x
        for rows, a in ((mine, by_mine), (following, by_next)):
            g[i, rows] += a.T @ jump[w]
            c[i, rows] += a.T @ by_x
            for columns, d in ((mine, by_mine), (following, by_next)):
                b[i, rows, columns] += a.T @ d
    return NormalEquations(float(losses.sum()), shared, shared_hessian, g, b, c, losses)


def by_owner(owner: np.ndarray, loss: np.ndarray, jump: np.ndarray) -> np.ndarray:
    """Loss of each motion, jumps between its windows included."""
    return np.bincount(owner, loss + 0.5 * np.sum(jump**2, axis=1))


def unchained(change: np.ndarray, owner: np.ndarray, k: int) -> np.ndarray:
    """Changes of motions as those of their windows, of k numbers each."""
    counts = np.bincount(owner)
    return np.concatenate([change[i, : n * k].reshape(n, k) for i, n in enumerate(counts)])


# Points whose loss is computed for each start that is refined.
_LOOKS = 4
# Parameters up to which all of the bounds are looked at by default, at so many points.
_SCANNED, _SCANS = 2, 16
# Least variance of residuals, as a share of what the stated noise has.
_QUIET = 1e-2
# Windows that fit worse than most by the first factor are restarted. The result is kept if the loss of their
# motion falls by the second.
_POOR, _BETTER = 2.0, 5.0
# Restarts of badly fitting windows: so often from where the windows before end; then with velocities from so
# few frames, which are noisier, but wrong only within a frame of an impact; then from so many draws of these.
_SWEEPS, _NARROW, _DRAWS = 2, 3, 8
# Tolerance [standard errors] of all searches but the last.
_NEAR = 3.0
# Windows simulated at once on an accelerator; a CPU is fastest one by one.
_BATCH = 1024


class _Last(NamedTuple):
    """The last simulation, and what it was of."""

    model: ResidualModel
    smoothing: Smoothing | None
    x: Array
    states: tuple[State, State]
    found: Linearized


class Problem:
    """The least squares problem of some motions: residuals of windows over parameters and initial states."""

    def __init__(self, setup: Setup, motions: Sequence[Motion], state: Any):
        space, scene, controls, initial = setup.space, setup.scene, setup.controls, setup.initial
        noise, options = setup.noise, setup.options
        self.space, self.noise, self.seed = space, noise, options.seed
        self._usual = functools.partial(start_deviations, scene, motions, noise)
        self.ties = options.gaps
        self.spacing = float(np.median(np.concatenate([np.diff(motion.times) for motion in motions])))
        self.simulations = 0
        self.lower, self.upper = space.lower, space.upper
        self.smooth = options.smooth
        self.smoothing: Smoothing | None = None
        self.roughness = np.zeros((0, 0))
        self._last: _Last | None = None
        policy = controls if callable(controls) else None
        self._planned = functools.partial(
            plan_windows,
            scene,
            motions,
            states=_for_each("state", state, motions),
            controls=[None] * len(motions) if policy is not None else _control_list(scene, controls, motions),
            noise=noise,
            initial=initial,
            options=options,
        )
        self.plan = self._planned()
        self.measured, self._near = True, False
        # Frames of a tracked film share errors, and scatter less than they are off.
        self.least_variance = _QUIET if self.plan.windows.common is None else 1.0
        dtype = scene.timestep.dtype
        self.start = _start_of(scene, self.plan.bodies, initial)
        self.private = self.start.size
        unknowns = len(space.start) + self.private
        n_windows = len(self.plan.rows)
        self.freedom = self.plan.n_data - len(space.start) - n_windows * self.private
        if self.freedom <= 0:
            raise ValueError(
                f"observed must hold more numbers than there are unknowns, got {self.plan.n_data} for "
                f"{len(space.start)} parameters and {n_windows * self.private} of initial states: take "
                "more frames, longer windows, or estimate less"
            )
        numbers = max(1, self.plan.n_data // n_windows)
        # A backward pass per observed number costs about four forward ones.
        costly = unknowns > 4 * numbers
        reverse = options.jacobian == "reverse" or (options.jacobian == "auto" and costly)
        on_cpu = jax.default_backend() == "cpu"
        self.jumps = None
        if self.ties:
            # Velocities that were not observed may miss by what would move a window's end by the noise.
            span = max(1e-6, float(self.plan.n_steps * scene.timestep))
            self.jumps = jnp.asarray(self.start.widths(self._usual(span)), dtype)
        self.model = ResidualModel(
            scene,
            policy,
            setup.engine,
            self.plan.windows,
            None if options.huber is None else jnp.asarray(options.huber, dtype),
            # Starts are compared as the first search sees them.
            None if self.jumps is None else self.ties[0] * self.jumps,
            space.selections,
            self.plan.bodies,
            self.plan.quantities,
            self.start,
            self.plan.n_steps,
            reverse,
            options.batch or (1 if on_cpu else _BATCH),
            device_mesh(),
        )

    def check_groups(self, independent: str | Sequence[str]) -> None:
        """Refuse fewer independent groups than can tell how far they pull the parameters apart.

        Raises:
            ValueError: If there are, or labels are not one for each motion.
        """
        if independent == "numbers":
            return
        motions = int(self.plan.owner[-1]) + 1
        if not isinstance(independent, str) and len(independent) != motions:
            raise ValueError(
                f"options.independent must be one label for each of {motions} motions, got {len(independent)}"
            )
        count, least = len(np.unique(_labels(self, independent))), len(self.space.start) + 2
        if count < least:
            what = independent if isinstance(independent, str) else "labels"
            raise ValueError(
                f"options.independent needs at least {least} {what}, two more than there are parameters, got"
                f" {count}"
            )

    def begin_near(self, after: Identification) -> None:
        """Begin where an earlier fit left what it estimated of the windows' states, if this one does too."""
        self._near = True
        start, states = self.plan.start, after.initial_states
        if states.position.shape != start.position.shape:
            here, there = start.position.shape[:2], states.position.shape[:2]
            raise ValueError(
                "after must be a fit of the same motions in the same windows: "
                f"{here[0]} windows of {here[1]} bodies, got {there[0]} of {there[1]}"
            )
        states = shifted(after.scene, states, self.plan.windows.origins, -1)
        taken = [key for key in self.start.initial if key in after.initial]
        if self.start.turning:
            poses = any(key in taken for key in ("position", "orientation"))
            taken += [name for name, mine in (("q", poses), ("v", "velocity" in taken)) if mine]
        fitted = {key: jnp.asarray(getattr(states, key), start.position.dtype) for key in taken}
        self.plan = dataclasses.replace(self.plan, start=dataclasses.replace(start, **fitted))
        # Windows that were fitted have left the wrong basins that measured velocities may begin in.
        self.measured = not set(QUANTITIES) <= set(taken)

    def simulate(self, x: np.ndarray, start: State) -> Linearized:
        """All windows at coordinates and initial states; those as last time are not simulated again."""
        at = jnp.asarray(x, self.model.scene.timestep.dtype)
        following = _following(start)
        changed = np.ones(len(self.plan.rows), bool)
        last = self._last
        if last is not None and not (last.model is self.model and last.smoothing is self.smoothing):
            last = None
        if last is not None and np.array_equal(at, last.x):
            changed = _different((start, following), last.states)
        found = linearized(self.model, at, start, following, jnp.asarray(changed), self.smoothing)
        if last is not None and not changed.all():
            found = jax.tree.map(
                lambda new, old: jnp.where(changed.reshape(-1, *[1] * (new.ndim - 1)), new, old),
                found,
                last.found,
            )
        self._last = _Last(self.model, self.smoothing, at, (start, following), found)
        self.simulations += int(changed.sum())
        return found

    def loss(self, x: np.ndarray, start: State) -> float:
        """The loss at coordinates and initial states, without derivatives where one device does the work."""
        if jax.process_count() * self.model.mesh.size > 1:
            kept, self.smoothing = self.smoothing, None
            try:
                return self.linearize(x, start).loss
            finally:
                self.smoothing = kept
        self.simulations += len(self.plan.rows)
        at = jnp.asarray(x, self.model.scene.timestep.dtype)
        return float(np.sum(losses(self.model, at, start, _following(start))))

    @property
    def evaluations(self) -> int:
        """How often all windows were simulated; those that were simulated alone count as their share."""
        return -(-self.simulations // len(self.plan.rows))

    def linearize(self, x: np.ndarray, start: State) -> NormalEquations:
        """Normal equations over parameters and the blocks of initial states.

        A block is a window; or a motion, where windows are to meet.
        """
        return self.assembled(self.simulate(x, start))

    def assembled(self, found: Linearized) -> NormalEquations:
        """Normal equations of a simulation of all windows."""
        return self._assembled(_Local.of(found), self.plan.owner)

    def groups(self, found: Linearized, independent: str | Sequence[str]) -> Groups:
        """What each independent group of a simulation says of the parameters; see `IdentifyOptions`."""
        labels = _labels(self, independent)
        local, parts = _Local.of(found), []
        for label in np.unique(labels):
            mine = labels == label
            _, owner = np.unique(self.plan.owner[mine], return_inverse=True)
            parts.append(eliminated(self._assembled(_Local(*(v[mine] for v in local)), owner)))
        return Groups(np.array([g for g, _ in parts]), np.array([h for _, h in parts]))

    def _assembled(self, local: _Local, owner: np.ndarray) -> NormalEquations:
        p, k = len(self.space.start), self.private
        if self.model.jumps is not None:
            return chained(p, owner, self.model.jumps, local)
        loss, gradient, hessian, _, _ = local
        return NormalEquations(
            float(loss.sum()),
            gradient[:, :p].sum(axis=0),
            hessian[:, :p, :p].sum(axis=0),
            gradient[:, p:] if k else np.zeros((0, 0)),
            hessian[:, p:, p:] if k else np.zeros((0, 0, 0)),
            hessian[:, p:, :p] if k else np.zeros((0, 0, p)),
            loss if k else np.zeros(0),
        )

    def start_widths(self) -> np.ndarray:
        """By how much initial states are uncertain, of their unknowns, as the noise says."""
        span = max(1e-6, float(self.plan.n_steps * self.model.scene.timestep))
        return self.start.deviations(self._usual(span))

    def retract(self, start: State, change: np.ndarray) -> State:
        """Initial states moved by the change of all blocks."""
        if not self.private:
            return start
        n = len(self.plan.rows)
        if self.model.jumps is not None:
            change = unchained(change, self.plan.owner, self.private)
        rows = jnp.asarray(change.reshape(n, self.private), self.model.scene.timestep.dtype)
        return moved(start, rows, self.start)

    def points(self, starts: int | None) -> list[np.ndarray]:
        """Where to start: the given start, and the best by loss of many others in the bounds.

        Args:
            starts: How many; None: one, with one or two bounded parameters the best of some in the bounds.
        """
        lower, upper = self.space.lower, self.space.upper
        bounded = bool(np.all(np.isfinite(lower)) and np.all(np.isfinite(upper)))
        if starts is None:
            if self._near or not bounded or len(lower) > _SCANNED:
                return [self.space.start]
            tried = [self.space.start, *_spread(self, _SCANS)]
            # The program of the search itself: another one takes longer to compile than this.
            found = [self.linearize(x, self.plan.start).loss for x in tried]
            return [tried[int(np.argmin(np.where(np.isfinite(found), found, np.inf)))]]
        if starts == 1:
            return [self.space.start]
        if not bounded:
            raise ValueError("options.starts > 1 needs finite bounds on every parameter")
        tried = _spread(self, _LOOKS * (starts - 1))
        found = np.array([self.loss(x, self.plan.start) for x in tried])
        order = np.argsort(np.where(np.isfinite(found), found, np.inf))
        return [self.space.start] + [tried[i] for i in order[: starts - 1]]

    def search(
        self,
        x: np.ndarray,
        max_iterations: int,
        tolerance: float,
        tell,
        free: bool = True,
        kept: SearchCheckpoint | None = None,
    ) -> Solution:
        """Minimise from x; with `free` false over the initial states alone.

        Args:
            x: Coordinates of the parameters.
            max_iterations: Steps of each minimisation.
            tolerance: Of the predicted move of the parameters [standard errors].
            tell: Called with the number of steps and the loss; or None.
            free: Whether the parameters move.
            kept: Where minimisations are kept; None to keep nothing.
        """

        def minimise(x, blocks, tolerance: float, held: bool = not free) -> Solution:
            options = LeastSquaresOptions(
                max_iterations,
                # A step of δ standard errors reduces the loss ½ s² (N − p) by ½ s² δ².
                tolerance=tolerance**2 / self.freedom,
                # A step is solved to about the dtype's resolution to the power 3/4.
                perfect=0.5 * self.plan.n_data * float(jnp.finfo(self.plan.start.position.dtype).eps) ** 0.75,
            )

            def begun(since: Iterate | None = None, keep: Keep | None = None) -> Solution:
                def before_step(now: Iterate) -> None:
                    if keep is not None:
                        keep(now)
                    if tell is not None:
                        tell(len(now.losses) - 1, now.losses[-1])

                return bounded_least_squares(
                    self.linearize,
                    since or x,
                    lower=x if held else self.space.lower,
                    upper=x if held else self.space.upper,
                    start_blocks=blocks,
                    retract=self.retract,
                    options=options,
                    callback=before_step,
                )

            return begun() if kept is None else kept.minimised(self, begun)

        self.smoothing = None
        if self.jumps is None:
            solution = minimise(x, self.plan.start, tolerance)
            return self.settled(solution, x) if free else solution
        rough = tolerance if len(self.ties) == 1 else max(tolerance, _NEAR)
        self.model = self.model._replace(jumps=self.ties[0] * self.jumps)
        solution = minimise(x, self.plan.start, rough)
        first = solution
        if self.measured:

            def refit(x, blocks, held: bool) -> Solution:
                return minimise(x, blocks, rough, held or not free)

            solution = self._redrawn(self._swept(first, refit), refit)
        # Parameters may have been held meanwhile.
        for tie in self.ties[1:] or (() if solution is first else self.ties):
            if solution.stop is Stop.INTERRUPTED:
                break
            self.model = self.model._replace(jumps=tie * self.jumps)
            solution = minimise(solution.x, solution.blocks, tolerance if tie == self.ties[-1] else rough)
        return self.settled(solution, x) if free else solution

    def settled(self, solution: Solution, first: np.ndarray, *, rough: bool = False) -> Solution:
        """The solution, or that of the trend where the loss is rough.

        Args:
            solution: Where a search ended.
            first: Coordinates at which it began.
            rough: Whether the loss is known to be rough, from another start.
        """
        if not self.smooth or not self.model.scene.pairs or solution.stop is Stop.INTERRUPTED:
            return solution
        return settled(self, solution, (first, self.plan.start), rough=rough)

    def count(self, share: float) -> None:
        """Let a share of the frames of each window count, the first ones; all of them by 1."""
        windows = self.plan.windows
        seen = {key: np.asarray(weight) for key, weight in windows.weights.items()}
        frames = np.max(
            [np.max(np.where(w > 0, 1 + np.arange(w.shape[1])[:, None], 0), (1, 2)) for w in seen.values()], 0
        )
        counts = np.arange(next(iter(seen.values())).shape[1])[None] < np.maximum(3, share * frames)[:, None]
        weights = {key: jnp.asarray(w * counts[:, :, None], w.dtype) for key, w in seen.items()}
        windows = dataclasses.replace(windows, weights=weights) if share < 1 else windows
        self.model = self.model._replace(windows=windows)

    def _swept(self, solution: Solution, minimise: Callable[..., Solution]) -> Solution:
        """A better minimum for motions with a window that began in the wrong basin.

        What was measured says little of velocities around impacts. Where the window before ends says more,
        once that window fits: so windows begin there.
        """
        for _ in range(_SWEEPS):
            found = self.simulate(solution.x, solution.blocks)
            missed = np.asarray(found.jump) * np.asarray(self.model.jumps)
            change = np.concatenate([np.zeros_like(missed[:1]), missed[:-1]])
            ends = jnp.asarray(change, self.model.scene.timestep.dtype)
            begin = moved(solution.blocks, ends, self.start)
            poor = np.bincount(self.plan.owner, self._fits_poorly(found)) > 0
            # One or two motions may be wrong for the most part.
            mine = poor[self.plan.owner] if len(poor) > 2 else np.ones(len(self.plan.rows), bool)
            solution, better = self._better_of(solution, found, mine, begin, minimise)
            if not better:
                break
        return solution

    def _redrawn(self, solution: Solution, minimise: Callable[..., Solution]) -> Solution:
        """A better minimum for motions with a window that still fits worse than others.

        Such windows begin with velocities that only the frames next to theirs say, then within their noise.
        """
        narrow, random = None, np.random.default_rng(self.seed)
        # Too few windows do not tell which of them fits poorly.
        for draw in range(1 + (_DRAWS if len(self.plan.rows) > 2 else 0)):
            found = self.simulate(solution.x, solution.blocks)
            poor = self._fits_poorly(found)
            if solution.stop is Stop.INTERRUPTED or not poor.any():
                break
            narrow = self._planned(smoothing=_NARROW).start if narrow is None else narrow
            begin = narrow
            if draw > 0:
                begin = draw_velocities(narrow, self.plan.bodies, self.noise, self.spacing, random)
            solution, _ = self._better_of(solution, found, poor, begin, minimise)
        return solution

    def _better_of(
        self,
        solution: Solution,
        found: Linearized,
        windows: np.ndarray,
        begin: State,
        minimise: Callable[..., Solution],
    ) -> tuple[Solution, bool]:
        """The solution in which the motions that fit better from other initial states start there."""
        if solution.stop is Stop.INTERRUPTED or not windows.any():
            return solution, False
        # Where most windows fit, the parameters are good enough to compare initial states. With fixed
        # parameters only the restarted motions are simulated.
        held = bool(np.mean(windows) <= 0.5)
        other = minimise(solution.x, _where(windows, begin, solution.blocks), held=held)
        if other.stop is Stop.INTERRUPTED:
            return solution._replace(stop=Stop.INTERRUPTED), False
        here, there = _by_motion(self, found), _by_motion(self, self.simulate(solution.x, other.blocks))
        better = there < here - _BETTER
        if not better.any():
            return solution, False
        if not held and np.all(there < here + _BETTER):
            return other, True
        blocks = _where(better[self.plan.owner], other.blocks, solution.blocks)
        if held:
            return other._replace(blocks=blocks, normal=self.linearize(solution.x, blocks)), True
        return minimise(solution.x, blocks, held=False), True

    def _fits_poorly(self, found: Linearized) -> np.ndarray:
        """Which windows explain each of their numbers much worse than most do; all if there are too few."""
        lengths = np.asarray(found.lengths)
        counts = np.sum(lengths >= 0, axis=tuple(range(1, lengths.ndim)))
        losses = np.asarray(found.loss) + 0.5 * np.sum(np.asarray(found.jump) ** 2, axis=1)
        mean = losses / np.maximum(counts, 1)
        worse = mean > _POOR * np.median(mean) if len(mean) > 2 else np.ones(len(mean), bool)
        return worse & (losses > _BETTER)


def _labels(problem: Problem, independent: str | Sequence[str]) -> np.ndarray:
    """Of each window, what it shares errors with."""
    if independent == "windows":
        return np.arange(len(problem.plan.rows))
    return problem.plan.owner if independent == "motions" else np.array(independent)[problem.plan.owner]


def _spread(problem: Problem, count: int) -> np.ndarray:
    """So many points all over the bounds."""
    from scipy.stats import qmc

    unit = qmc.Sobol(len(problem.space.start), seed=problem.seed).random(1 << (count - 1).bit_length())[
        :count
    ]
    return problem.space.lower + unit * (problem.space.upper - problem.space.lower)


def _by_motion(problem: Problem, found: Linearized) -> np.ndarray:
    return by_owner(problem.plan.owner, np.asarray(found.loss), np.asarray(found.jump))


def _following(start: State) -> State:
    """Initial states of the windows that come next; the last one's its own."""
    return jax.tree.map(lambda leaf: jnp.concatenate([leaf[1:], leaf[-1:]]), start)


def _different(states: tuple[State, State], others: tuple[State, State]) -> np.ndarray:
    """Which windows have other states."""
    pairs = zip(jax.tree.leaves(states), jax.tree.leaves(others), strict=True)
    return np.any(
        [(np.asarray(a) != np.asarray(b)).reshape(len(a), -1).any(axis=1) for a, b in pairs], axis=0
    )


def _where(windows: np.ndarray, one: State, other: State) -> State:
    pick = jnp.asarray(windows)
    return jax.tree.map(lambda a, b: jnp.where(pick.reshape(-1, *[1] * (a.ndim - 1)), a, b), one, other)


def _start_of(scene: Scene, bodies: Sequence[int], initial: tuple[str, ...]) -> WindowStart:
    """What is estimated of initial states when some bodies were observed."""
    layout = scene.layout
    kinds = [scene.joints[j].kind for j in layout.with_coordinates]
    on_joints = any(i in layout.children for i in bodies)
    free = tuple(i for i in bodies if i in layout.free)
    return WindowStart(free, tuple(kind == "hinge" for kind in kinds) if on_joints else (), initial)


def _for_each(name: str, given: Any, motions: Sequence[Motion]) -> list[Any]:
    items = list(given) if isinstance(given, (list, tuple)) else [given] * len(motions)
    if len(items) != len(motions):
        raise ValueError(f"{name} must be one for all or one for each of {len(motions)}, got {len(items)}")
    return items


def _control_list(scene: Scene, controls: Any, motions: Sequence[Motion]) -> list[Control | None]:
    items = _for_each("controls", controls, motions)
    for control in items:
        if control is None:
            continue
        shapes = control.force.shape, control.torque.shape
        if any(len(s) != 3 or s[1:] != (len(scene.bodies), 3) for s in shapes):
            raise ValueError(
                f"controls must have shape (steps, {len(scene.bodies)}, 3), got {shapes[0]} and {shapes[1]}"
            )
    return items
