"""Four textbook problems, written once in plain formulas: for dano's solver, and for CasADi with IPOPT.

Formulas take lists of numbers and a table of functions (`sin`, `cos`, `sqrt`), so that both programs solve
exactly the same problem and only the method differs.
"""

import importlib.metadata
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np

from dano.engine import compiler_options
from dano.solvers import optimal_trajectory, TrajectoryConstraint, TrajectoryOptions, TrajectoryProblem

Numbers = Sequence[Any]
IN_JAX = SimpleNamespace(sin=jnp.sin, cos=jnp.cos, sqrt=jnp.sqrt)


@dataclass(frozen=True)
class Case:
    """A problem of optimal control in plain formulas.

    Attributes:
        name: For tables.
        n_steps: T.
        start: x_0.
        dynamics: f(x, u, ops) → list.
        stage_cost: ℓ(x, u).
        final_cost: ℓ_T(x).
        lower: Of the controls.
        upper: Of the controls.
        final_equalities: h_T(x) → list.
        inequalities: g(x, u) → list, of every step.
        guess: First controls, shape (T, m).
        guessed_states: First states for the infeasible start, shape (T + 1, n), or None.
        quaternion: Place of a quaternion among the states, or None.
    """

    name: str
    n_steps: int
    start: tuple[float, ...]
    dynamics: Callable[[Numbers, Numbers, Any], list]
    stage_cost: Callable[[Numbers, Numbers], Any]
    final_cost: Callable[[Numbers], Any]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    guess: np.ndarray
    final_equalities: Callable[[Numbers], list] | None = None
    inequalities: Callable[[Numbers, Numbers], list] | None = None
    guessed_states: np.ndarray | None = None
    quaternion: int | None = None
    options: TrajectoryOptions = field(default_factory=TrajectoryOptions)


def runge_kutta(rate: Callable[[Numbers, Numbers, Any], list], h: float):
    """A step of the classical fourth-order method."""

    def step(x, u, ops):
        def moved(slopes, share):
            return [a + share * h * s for a, s in zip(x, slopes, strict=True)]

        k1 = rate(x, u, ops)
        k2 = rate(moved(k1, 0.5), u, ops)
        k3 = rate(moved(k2, 0.5), u, ops)
        k4 = rate(moved(k3, 1.0), u, ops)
        return [a + h / 6 * (b + 2 * c + 2 * d + e) for a, b, c, d, e in zip(x, k1, k2, k3, k4, strict=True)]

    return step


def _double_integrator() -> Case:
    h = 0.1
    return Case(
        "double integrator with bounds",
        n_steps=50,
        start=(2.0, 0.5),
        dynamics=lambda x, u, ops: [x[0] + h * x[1] + 0.5 * h * h * u[0], x[1] + h * u[0]],
        stage_cost=lambda x, u: 0.5 * h * (x[0] ** 2 + 0.1 * x[1] ** 2 + 0.1 * u[0] ** 2),
        final_cost=lambda x: 0.0 * x[0],
        lower=(-0.7,),
        upper=(0.7,),
        guess=np.zeros((50, 1)),
        final_equalities=lambda x: [x[0], x[1]],
    )


def _cartpole() -> Case:
    cart, pole, length, g, h = 1.0, 0.2, 0.5, 9.81, 0.05

    def rate(x, u, ops):
        s, c, w, f = ops.sin(x[1]), ops.cos(x[1]), x[3], u[0]
        # The angle is zero hanging down.
        below = cart + pole * s * s
        acceleration = (f + pole * s * (length * w * w + g * c)) / below
        spin = (-f * c - pole * length * w * w * c * s - (cart + pole) * g * s) / (length * below)
        return [x[2], w, acceleration, spin]

    return Case(
        "cartpole swing-up",
        n_steps=60,
        start=(0.0, 0.0, 0.0, 0.0),
        dynamics=runge_kutta(rate, h),
        stage_cost=lambda x, u: 0.5 * h * (0.1 * x[0] ** 2 + 0.1 * (x[1] - np.pi) ** 2 + 0.1 * u[0] ** 2),
        final_cost=lambda x: 0.0 * x[0],
        lower=(-6.0,),
        upper=(6.0,),
        guess=np.full((60, 1), 0.1),
        final_equalities=lambda x: [x[0], x[1] - np.pi, x[2], x[3]],
    )


def _parking() -> Case:
    h, axle = 0.1, 1.0
    obstacles = ((1.3, -0.2, 0.55), (0.2, 1.6, 0.5), (2.4, 1.5, 0.45))

    def rate(x, u, ops):
        speed = x[3]
        tangent = ops.sin(x[4]) / ops.cos(x[4])
        return [speed * ops.cos(x[2]), speed * ops.sin(x[2]), speed * tangent / axle, u[0], u[1]]

    return Case(
        "car parking with obstacles",
        n_steps=60,
        start=(0.0, 0.0, 0.0, 0.0, 0.0),
        dynamics=runge_kutta(rate, h),
        stage_cost=lambda x, u: 0.5 * h * (0.05 * x[3] ** 2 + 0.1 * x[4] ** 2 + u[0] ** 2 + u[1] ** 2),
        final_cost=lambda x: 0.0 * x[0],
        lower=(-1.5, -1.0),
        upper=(1.5, 1.0),
        guess=np.tile([0.3, 0.1], (60, 1)),
        final_equalities=lambda x: [x[0] - 2.5, x[1] - 0.5, x[2] - np.pi / 2, x[3], x[4]],
        inequalities=lambda x, u: (
            [r * r - (x[0] - a) ** 2 - (x[1] - b) ** 2 for a, b, r in obstacles] + [x[4] - 0.6, -0.6 - x[4]]
        ),
    )


def _quadrotor() -> Case:
    h, n_steps, mass, arm, drag, g = 0.05, 36, 0.5, 0.17, 0.03, 9.81
    inertia = (0.0023, 0.0023, 0.004)
    goal, window = (3.0, 0.0, 1.0), (1.5, 0.8, 1.6)

    def rate(x, u, ops):
        w, i, j, k = x[3:7]
        p, q, r = x[10:13]
        thrust = (u[0] + u[1] + u[2] + u[3]) / mass
        spin = [
            (arm * (u[1] - u[3]) - (inertia[2] - inertia[1]) * q * r) / inertia[0],
            (arm * (u[2] - u[0]) - (inertia[0] - inertia[2]) * p * r) / inertia[1],
            (drag * (u[0] - u[1] + u[2] - u[3]) - (inertia[1] - inertia[0]) * p * q) / inertia[2],
        ]
        turn = [
            0.5 * (-i * p - j * q - k * r),
            0.5 * (w * p + j * r - k * q),
            0.5 * (w * q - i * r + k * p),
            0.5 * (w * r + i * q - j * p),
        ]
        up = [2 * (i * k + w * j), 2 * (j * k - w * i), 1 - 2 * (i * i + j * j)]
        return [*x[7:10], *turn, thrust * up[0], thrust * up[1], thrust * up[2] - g, *spin]

    def dynamics(x, u, ops):
        after = runge_kutta(rate, h)(x, u, ops)
        size = ops.sqrt(sum(a * a for a in after[3:7]))
        return [*after[:3], *(a / size for a in after[3:7]), *after[7:]]

    hover = mass * g / 4
    start = (0.0, 0.0, 1.0, 1.0, *(0.0,) * 9)
    states = np.zeros((n_steps + 1, 13))
    share = np.linspace(0, 1, n_steps + 1)
    for column, (a, b, c) in enumerate(zip(start[:3], window, goal, strict=True)):
        states[:, column] = np.interp(share, (0, 0.5, 1), (a, b, c))
    states[:, 3] = 1.0

    def outside(x, u):
        # A funnel that is as wide as the window where it passes through the wall.
        reach = (x[1] - window[1]) ** 2 + (x[2] - window[2]) ** 2
        return [reach - 0.2**2 - 0.7 * (x[0] - window[0]) ** 2]

    return Case(
        "quadrotor through a window",
        n_steps=n_steps,
        start=start,
        dynamics=dynamics,
        stage_cost=lambda x, u: (
            0.5
            * h
            * (
                0.1 * sum(a * a for a in x[7:10])
                + 0.1 * sum(a * a for a in x[10:13])
                + sum((a - hover) ** 2 for a in u)
            )
        ),
        final_cost=lambda x: 0.0 * x[0],
        lower=(0.0,) * 4,
        upper=(1.35 * hover,) * 4,
        guess=np.full((n_steps, 4), hover),
        final_equalities=lambda x: [x[0] - goal[0], x[1] - goal[1], x[2] - goal[2], *x[4:7], *x[7:13]],
        inequalities=outside,
        guessed_states=states,
        quaternion=3,
    )


CASES: dict[str, Callable[[], Case]] = {
    "double integrator": _double_integrator,
    "cartpole": _cartpole,
    "parking": _parking,
    "quadrotor": _quadrotor,
}


def trajectory_problem(case: Case, *, bounds_as_constraints: bool = False) -> TrajectoryProblem:
    """A case for dano's solver.

    Args:
        case: The case.
        bounds_as_constraints: Whether bounds become inequalities of the augmented Lagrangian.
    """
    lower, upper = jnp.array(case.lower), jnp.array(case.upper)
    constraints = []
    if case.inequalities is not None:
        obstacles = case.inequalities
        constraints.append(TrajectoryConstraint("path", lambda x, u, t: jnp.stack(obstacles(x, u))))
    if case.final_equalities is not None:
        goal = case.final_equalities
        constraints.append(TrajectoryConstraint("goal", lambda x: jnp.stack(goal(x)), True, True))
    if bounds_as_constraints:
        limits = TrajectoryConstraint("bounds", lambda x, u, t: jnp.concatenate([u - upper, lower - u]))
        constraints.append(limits)
    moves: dict[str, Any] = {} if case.quaternion is None else _on_manifold(case.quaternion)
    return TrajectoryProblem(
        lambda x, u, t: jnp.stack(case.dynamics(x, u, IN_JAX)),
        lambda x, u, t: case.stage_cost(x, u),
        case.final_cost,
        tuple(constraints),
        None if bounds_as_constraints else lower,
        None if bounds_as_constraints else upper,
        **moves,
    )


def _on_manifold(place: int) -> dict[str, Callable]:
    """`retract` and `difference` of a state that holds a unit quaternion."""
    from dano.maths import quat_conjugate, quat_exp, quat_multiply

    here = slice(place, place + 4)

    def retract(x, change):
        turned = quat_multiply(x[here], quat_exp(change[place : place + 3]))
        before, after = x[:place] + change[:place], x[place + 4 :] + change[place + 3 :]
        return jnp.concatenate([before, turned, after])

    def difference(nominal, x):
        relative = quat_multiply(quat_conjugate(nominal[here]), x[here])
        turn = 2 * relative[1:] * jnp.where(relative[0] < 0, -1.0, 1.0)
        before, after = x[:place] - nominal[:place], x[place + 4 :] - nominal[place + 4 :]
        return jnp.concatenate([before, turn, after])

    return {"retract": retract, "difference": difference}


def solved(case: Case, **choices):
    """A case solved by dano; `choices` for `trajectory_problem`."""
    problem = trajectory_problem(case, **choices)
    states = None if case.guessed_states is None else jnp.asarray(case.guessed_states)
    start, guess = jnp.array(case.start), jnp.asarray(case.guess)
    return optimal_trajectory(
        problem, start, guess, states=states, options=case.options, compiler_options=compiler_options()
    )


def solved_by_ipopt(
    case: Case, guesses: int = 1, seed: int = 0, known: tuple[np.ndarray, np.ndarray] | None = None
) -> tuple[float, str]:
    """The least cost that IPOPT finds by multiple shooting from several guesses, and its version.

    Args:
        case: The case.
        guesses: How many: the case's own, and others around it.
        seed: Of the others.
        known: States (T + 1, n) and controls (T, m) from which to start, too.

    Raises:
        ImportError: Without CasADi.
        ValueError: If IPOPT fails from every guess.
    """
    try:
        import casadi  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError("IPOPT needs casadi: pip install 'dano[plan-bench]'") from error
    ops = SimpleNamespace(sin=casadi.sin, cos=casadi.cos, sqrt=casadi.sqrt)
    n, m, T = len(case.start), len(case.lower), case.n_steps
    rng, best = np.random.default_rng(seed), np.inf
    x_guess = np.tile(case.start, (T + 1, 1)) if case.guessed_states is None else case.guessed_states
    for attempt in range(guesses if known is None else guesses + 1):
        opti = casadi.Opti()
        X, U = opti.variable(n, T + 1), opti.variable(m, T)
        cost, rows = 0, lambda M, t, k: [M[i, t] for i in range(k)]
        opti.subject_to(X[:, 0] == casadi.DM(case.start))
        for t in range(T):
            x, u = rows(X, t, n), rows(U, t, m)
            opti.subject_to(X[:, t + 1] == casadi.vertcat(*case.dynamics(x, u, ops)))
            opti.subject_to(opti.bounded(casadi.DM(case.lower), U[:, t], casadi.DM(case.upper)))
            if case.inequalities is not None and t > 0:
                opti.subject_to(casadi.vertcat(*case.inequalities(x, u)) <= 0)
            cost += case.stage_cost(x, u)
        end = rows(X, T, n)
        if case.final_equalities is not None:
            opti.subject_to(casadi.vertcat(*case.final_equalities(end)) == 0)
        opti.minimize(cost + case.final_cost(end))
        spread = 0.0 if attempt == 0 else 0.3
        x, u = (x_guess, case.guess) if attempt < guesses or known is None else known
        spread = 0.0 if attempt == guesses else spread
        opti.set_initial(X, (x + spread * rng.standard_normal(x.shape)).T)
        opti.set_initial(U, (u + spread * rng.standard_normal(u.shape)).T)
        opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "max_iter": 400})
        try:
            best = min(best, float(opti.solve().value(opti.f)))
        except RuntimeError:
            continue
    if not np.isfinite(best):
        raise ValueError(f"IPOPT must solve {case.name!r}, got no solution from {guesses} guesses")
    return best, f"CasADi {importlib.metadata.version('casadi')} with IPOPT"
