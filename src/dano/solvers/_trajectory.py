"""Optimal trajectories: the problem, and what a solution says of itself.

The problem. Find controls u_0 … u_{T−1} and states x_1 … x_T that

    minimise     J(x, u) = Σ_{t<T} ℓ(x_t, u_t, t) + ℓ_T(x_T)
    subject to   x_0 given
                 x_{t+1} = f(x_t, u_t, t)          dynamics
                 lower ≤ u_t ≤ upper               bounds
                 g(x_t, u_t, t) ≤ 0                inequalities of steps
                 h(x_t, u_t, t) = 0                equalities of steps
                 g_T(x_T) ≤ 0,  h_T(x_T) = 0       of the end

States may lie on a manifold. A state moves by a change in n coordinates, x ⊞ δ = retract(x, δ), and
y ⊟ x = difference(x, y) is the change that takes x to y; for vectors these are sums and differences. All
derivatives are taken in these coordinates:

    A_t = ∂(f(x_t ⊞ δ, u_t, t) ⊟ x_{t+1})/∂δ,  B_t = ∂(f(x_t, u_t, t) ⊟ x_{t+1})/∂u_t

The method (Howell, Jackson, Manchester, "ALTRO", IROS 2019, with bounds as in Tassa, Mansard, Todorov,
ICRA 2014, and shooting gaps as in Mastalli et al., "Crocoddyl", ICRA 2020).

Constraints c with multipliers λ and a penalty μ enter an augmented Lagrangian

    L(x, u) = J + Σ ½ μ |c + λ/μ|² − ½ |λ|²/μ,     for inequalities with max(0, c + λ/μ)

which is minimised over the controls for fixed λ and μ; then λ ← λ + μ c (not below 0 for inequalities), and μ
grows where c has not become small enough. Around a trajectory with gaps d_t = f(x_t, u_t) ⊟ x_{t+1} the terms
of L have gradients q, r and Hessians Q, R, H (states, controls, mixed). The value function
V(δ) = vᵀδ + ½ δᵀVδ runs back from the end:

    v' = v + V d
    Q_x = q + Aᵀv',    Q_u = r + Bᵀv'
    Q_xx = Q + AᵀV A,  Q_ux = H + BᵀV A,  Q_uu = R + BᵀV B + ρ D
    k = argmin Q_uᵀk + ½ kᵀQ_uu k  with lower ≤ u + k ≤ upper,    K = −Q_uu⁻¹ Q_ux for controls inside
    v ← Q_x + KᵀQ_uu k + KᵀQ_u + Q_uxᵀk,    V ← Q_xx + KᵀQ_uu K + KᵀQ_ux + Q_uxᵀK

The new controls are u + α k + K (x_new ⊟ x), with α from a line search, and the gaps shrink by 1 − α. ρ grows
when no α reduces L enough; D is the diagonal of R + BᵀV B.
"""

import enum
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

State = PyTree[Array]


def added(x: Array, change: Array) -> Array:
    """`retract` of a vector space."""
    return x + change


def subtracted(nominal: Array, x: Array) -> Array:
    """`difference` of a vector space."""
    return x - nominal


class TrajectoryConstraint(eqx.Module):
    """A condition on a trajectory.

    Attributes:
        name: What it is called in results (static).
        function: c(x, u, t), shape (p,); of the end c(x). It should be of order 1 where it matters, for all
            constraints share one penalty.
        equality: Whether c = 0 is asked for; otherwise c ≤ 0 (static).
        final: Whether it concerns the last state only; otherwise every step (static).
    """

    name: str = eqx.field(static=True)
    function: Callable[..., Float[Array, " p"]]
    equality: bool = eqx.field(static=True, default=False)
    final: bool = eqx.field(static=True, default=False)


class TrajectoryProblem(eqx.Module):
    """A problem of optimal control, as at the top of this module.

    Functions that are `eqx.Module`s or `jax.tree_util.Partial`s carry their numbers as arrays: with other
    numbers nothing is compiled again. Plain functions are compiled once each.
    """

    dynamics: Callable[..., State]  # f(x, u, t) with u of shape (m,) and t an integer
    stage_cost: Callable[..., Float[Array, ""]]  # ℓ(x, u, t)
    final_cost: Callable[..., Float[Array, ""]]  # ℓ_T(x)
    constraints: tuple[TrajectoryConstraint, ...] = ()  # g, h, g_T and h_T
    # Bounds of the controls, shape (m,), or (T, m); None where there are none.
    lower: Float[Array, "..."] | None = None
    upper: Float[Array, "..."] | None = None  # As `lower`
    retract: Callable[[Any, Array], Any] = added  # x ⊞ δ
    difference: Callable[[Any, Any], Array] = subtracted  # difference(x, y) = y ⊟ x, shape (n,)
    # r(x, u, t) of costs that are ℓ = ½ r·r; their Hessians are then taken as Gauss and Newton do, from first
    # derivatives. None where costs are not of this kind.
    stage_residuals: Callable[..., Float[Array, " r"]] | None = None
    final_residuals: Callable[..., Float[Array, " r"]] | None = None  # The same of ℓ_T
    # Whether the Hessians of the costs are known to have no negative eigenvalue; otherwise negative ones are
    # set to zero (static).
    convex: bool = eqx.field(static=True, default=False)
    # Whether derivatives of all steps are taken at once; otherwise one step after the other, which suits long
    # programs with loops in them (static).
    parallel: bool = eqx.field(static=True, default=True)


class TrajectoryOptions(NamedTuple):
    """How hard to try.

    Attributes:
        tolerance: An inner minimum is reached when a step promises, or brings, less than this share of
            1 + |L|.
        constraint_tolerance: Largest violation that counts as none.
        max_iterations: Iterations (steps of iLQR) of one inner minimum.
        max_updates: Inner minima, with an update of multipliers after each.
        penalty: First μ.
        penalty_growth: Factor of μ where a violation has not become four times smaller.
        max_penalty: Largest μ.
        max_seconds: Time after which to stop, looked at between iterations [s]; None: no limit.
    """

    tolerance: float = 1e-7
    constraint_tolerance: float = 1e-5
    max_iterations: int = 200
    max_updates: int = 25
    penalty: float = 1.0
    penalty_growth: float = 10.0
    max_penalty: float = 1e8
    max_seconds: float | None = None


class TrajectoryStop(enum.Enum):
    """Why an optimisation ended."""

    OPTIMAL = "a minimum that meets the constraints"
    STUCK = "no step reduces the cost any more; the constraints are met, a minimum is not certain"
    INFEASIBLE = (
        "the constraints are not met, and larger penalties do not help: they may contradict each other"
    )
    ITERATIONS = "the largest number of iterations or of multiplier updates was reached"
    TIME = "the time limit was reached"
    STOPPED = "stopped by the callback or interrupted: this is the trajectory so far"


class Violation(NamedTuple):
    """How much a constraint is violated, and where most."""

    name: str  # Of the constraint; "dynamics" for gaps between steps
    amount: float  # Largest violation, 0 for none
    step: int  # Step at which it is largest; T for the end
    component: int  # Which of the constraint's numbers it is


class TrajectoryProgress(NamedTuple):
    """What a callback is told after every iteration."""

    update: int  # Number of multiplier updates so far
    iteration: int  # Number of iterations so far, of all inner minima
    cost: float  # J
    lagrangian: float  # L
    violation: Violation  # Largest violation, with its place
    regularization: float  # ρ
    states: Any  # x, leaves of shape (T + 1, …)
    controls: Float[Array, "T m"]  # u, shape (T, m)


class TrajectorySolution(NamedTuple):
    """Where an optimisation ended, and why."""

    states: Any  # x, leaves of shape (T + 1, …)
    controls: Float[Array, "T m"]  # u, shape (T, m)
    gains: Float[Array, "T m n"]  # K, shape (T, m, n): u_t + K_t (x ⊟ x_t) holds the system on the trajectory
    # λ of every constraint, shapes (T, p) or (p,): a warm start of a similar problem.
    multipliers: tuple[Array, ...]
    penalty: float  # μ at the end
    cost: float  # J
    violations: tuple[Violation, ...]  # Of every constraint and of the dynamics, the worst first
    stop: TrajectoryStop  # Why it ended
    iterations: int  # Iterations of all inner minima
    updates: int  # Multiplier updates
    history: np.ndarray  # J and the largest violation after every inner minimum, shape (updates, 2)
    seconds: float  # Time it took, with compilation [s]

    @property
    def reached(self) -> bool:
        """Whether the trajectory meets all constraints."""
        return self.stop in (TrajectoryStop.OPTIMAL, TrajectoryStop.STUCK)

    def describe(self) -> str:
        """The solution in a few lines: why it ended, its cost, and what it violates."""
        lines = [
            f"stopped: {self.stop.value}",
            f"cost {self.cost:.6g} after {self.iterations} iterations and {self.updates} multiplier updates, "
            f"{self.seconds:.1f} s",
        ]
        n_steps = self.controls.shape[0]
        for name, amount, step, component in self.violations:
            place = "at the end" if step == n_steps else f"at step {step}"
            where = "" if amount == 0 else f", most {place}, component {component}"
            lines.append(f"{name}: violated by {amount:.3g}{where}")
        return "\n".join(lines)


def indexed(tree: Any, t: Any) -> Any:
    """Row t of every leaf."""
    return jax.tree.map(lambda leaf: leaf[t], tree)


def constraint_values(problem: TrajectoryProblem, states: Any, controls: Array) -> tuple[Array, ...]:
    """C of every constraint, shapes (T, p), or (p,) at the end."""
    n_steps = controls.shape[0]
    inner, last = jax.tree.map(lambda x: x[:-1], states), indexed(states, -1)
    return tuple(
        c.function(last) if c.final else jax.vmap(c.function)(inner, controls, jnp.arange(n_steps))
        for c in problem.constraints
    )


def pressed(constraint: TrajectoryConstraint, value: Array, multiplier: Array, penalty: Array) -> Array:
    """λ + μ c, for inequalities not below 0: what a multiplier becomes."""
    shifted = multiplier + penalty * value
    return shifted if constraint.equality else jnp.maximum(shifted, 0)


def violated(constraint: TrajectoryConstraint, value: Array) -> Array:
    """How much each number of a constraint is violated."""
    return jnp.abs(value) if constraint.equality else jnp.maximum(value, 0)


def held(lower: Array | None, upper: Array | None, u: Array) -> Array:
    """Controls moved into their bounds."""
    u = u if lower is None else jnp.maximum(u, jnp.broadcast_to(lower, u.shape))
    return u if upper is None else jnp.minimum(u, jnp.broadcast_to(upper, u.shape))


def total_cost(problem: TrajectoryProblem, states: Any, controls: Array) -> Float[Array, ""]:
    """J."""
    inner = jax.tree.map(lambda x: x[:-1], states)
    stages = jax.vmap(problem.stage_cost)(inner, controls, jnp.arange(controls.shape[0]))
    return jnp.sum(stages) + problem.final_cost(indexed(states, -1))
