"""First-order variational integrator for free rigid bodies in contact, one implicit solve a step.

Unknowns of a step are the end-of-step velocities V⁺ = (v⁺, ω⁺) of all bodies that move:

    translation   m (v⁺ − v) = h m g + h f + impulses,                              x⁺ = x + h v⁺
    rotation      P(ω⁺) − P⁻(ω) = h Rᵀτ + impulses (body frame),                    q⁺ = q ⊗ (h/2) (s(ω⁺), ω⁺)
    with          P(ω) = (h/2)(s J ω + ω × Jω),  P⁻(ω) = (h/2)(s J ω − ω × Jω),     s(ω) = √(4/h² − |ω|²)

(Dojo, eq. 5–9.) P(ω⁺) is the body's angular momentum seen from its old orientation, P⁻(ω) the one it came with, so
free motion conserves momentum to rounding. Geometry is taken at the old configuration, velocities in the contact
laws are the unknown ones. Each step solves R(V⁺; θ) = 0 by Newton with a line search and is differentiated by the
implicit function theorem, never through the iterations.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int

from dano.contact import AbstractContactLaw, ContactParams, KEPT, overlap, Patch
from dano.contact._small import matmul, matvec
from dano.maths import quat_multiply, quat_to_matrix, skew
from dano.scene import colliders, Control, Scene, State


class Report(NamedTuple):
    """What the solver says of a step: see `Trajectory`."""

    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]


class SolverOptions(NamedTuple):
    """When a step's Newton solve stops: see `VariationalEngine`."""

    tolerance: float | None = None
    max_iterations: int = 50


class _Problem(eqx.Module):
    """Everything the residual of a step depends on, except the unknown velocities.

    Attributes:
        mass: [kg], shape (m,) for m bodies that move.
        inertia: [kg m², B], shape (m, 3, 3).
        impulse: Momentum before contact: old momentum plus gravity and controls, shape (m, 6), rotation in B.
        timestep: h [s].
        patches: Overlap of each contact.
        maps: For each contact, the 6×6 maps from the velocities of its two bodies to the relative twist at the
            centroid in W.
        params: Parameters of each contact.
        laws: Law of each contact.
    """

    mass: Float[Array, " m"]
    inertia: Float[Array, "m 3 3"]
    impulse: Float[Array, "m 6"]
    timestep: Float[Array, ""]
    patches: tuple[Patch, ...]
    maps: tuple[tuple[Float[Array, "6 6"], Float[Array, "6 6"]], ...]
    params: tuple[ContactParams, ...]
    laws: tuple[AbstractContactLaw, ...]


class _Pairs(NamedTuple):
    """Static structure: which moving bodies each contact joins; −1 is a fixed one."""

    moving: tuple[int, ...]
    of_contact: tuple[tuple[int, int], ...]


def step(scene: Scene, state: State, control: Control | None, options: SolverOptions) -> tuple[State, Report]:
    """Advance all bodies by one timestep. See `dano.step`."""
    pairs = _structure(scene)
    if not pairs.moving:
        return state, Report(jnp.zeros((), state.position.dtype), jnp.asarray(0), jnp.asarray(True))
    problem = _problem(scene, state, control, pairs)
    start = _rows(jnp.concatenate([state.velocity, state.omega], axis=1), pairs.moving)
    velocities, report = _solve(problem, start, pairs, options)
    return _advance(state, velocities, scene.timestep, pairs), report


def wrenches(scene: Scene, state: State, following: State) -> Float[Array, "contacts 6"]:
    """Force [N] and torque about the centroid [N m] on the first body of each contact [W] during a step.

    Args:
        scene: The scene.
        state: State at the start of the step, which gives the geometry.
        following: State at its end, which gives the velocities.

    Returns:
        One row per contact, in the order of `scene.contacts`.
    """
    pairs = _structure(scene)
    problem = _problem(scene, state, None, pairs)
    velocities = _rows(jnp.concatenate([following.velocity, following.omega], axis=1), pairs.moving)
    return jnp.stack([f for f, _ in _contact_wrenches(velocities, problem, pairs)])


def patches(scene: Scene, state: State) -> tuple[Patch, ...]:
    """Overlap of every contact of a scene at a state, in the order of `scene.contacts`.

    Contacts of one kind (same laws, same array shapes) are evaluated together under `vmap`, which keeps the compile
    time of scenes with many equal bodies flat.
    """
    sides = [colliders(scene, contact, state) for contact in scene.contacts]
    return _grouped(lambda pair: overlap(*pair), sides)


def _grouped(function, items: list):
    """Apply a function to each item; items of equal structure and shapes are stacked and mapped together."""

    def kind(item):
        dynamic, static = eqx.partition(item, eqx.is_array)
        return (
            jax.tree.structure(item),
            tuple((x.shape, x.dtype) for x in jax.tree.leaves(dynamic)),
            str(static),
        )

    groups: dict[object, list[int]] = {}
    for i, item in enumerate(items):
        groups.setdefault(kind(item), []).append(i)
    results: list = [None] * len(items)
    for members in groups.values():
        if len(members) == 1:
            results[members[0]] = function(items[members[0]])
            continue
        dynamic, static = zip(*(eqx.partition(items[i], eqx.is_array) for i in members), strict=True)
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *dynamic)
        mapped = jax.vmap(lambda d, s=static[0]: function(eqx.combine(d, s)))(stacked)
        for k, i in enumerate(members):
            results[i] = jax.tree.map(lambda leaf, k=k: leaf[k], mapped)
    return tuple(results)


def _structure(scene: Scene) -> _Pairs:
    moving = tuple(i for i, body in enumerate(scene.bodies) if not body.fixed)
    position = {scene.bodies[i].name: k for k, i in enumerate(moving)}
    return _Pairs(moving, tuple((position.get(c.a, -1), position.get(c.b, -1)) for c in scene.contacts))


def _problem(scene: Scene, state: State, control: Control | None, pairs: _Pairs) -> _Problem:
    rows = pairs.moving
    bodies = [scene.bodies[i] for i in pairs.moving]
    h = scene.timestep
    mass = jnp.stack([body.mass * body.mass_scale for body in bodies])
    inertia = jnp.stack([body.inertia * body.mass_scale for body in bodies])
    velocity, omega = _rows(state.velocity, rows), _rows(state.omega, rows)
    linear = mass[:, None] * (velocity + (h * scene.gravity)[None])
    momentum, gyroscopic = jax.vmap(_spin_momentum, (0, 0, None))(omega, inertia, h)
    angular = momentum - gyroscopic
    if control is not None:
        linear = linear + h * _rows(control.force, rows)
        rotation = quat_to_matrix(_rows(state.orientation, rows))
        angular = angular + h * jax.vmap(lambda r, t: matvec(r.T, t))(rotation, _rows(control.torque, rows))
    overlaps = patches(scene, state)
    maps = tuple(
        (
            _twist_map(scene, state, contact.a, patch, 1.0),
            _twist_map(scene, state, contact.b, patch, -1.0),
        )
        for contact, patch in zip(scene.contacts, overlaps, strict=True)
    )
    return _Problem(
        mass,
        inertia,
        jnp.concatenate([linear, angular], axis=1),
        h,
        overlaps,
        maps,
        tuple(contact.params for contact in scene.contacts),
        tuple(contact.law for contact in scene.contacts),
    )


def _twist_map(scene: Scene, state: State, name: str, patch: Patch, sign: float) -> Float[Array, "6 6"]:
    """Map from (v [W], ω [B]) of a body to its velocity at the centroid and its spin in W, times `sign`."""
    i = scene.index(name)
    dtype = state.position.dtype
    zero = jnp.zeros((3, 3), dtype)
    if scene.bodies[i].fixed:
        return jnp.zeros((6, 6), dtype)
    rotation = quat_to_matrix(state.orientation[i])
    # Without contact there is no centroid; any arm will do, and zero keeps far-away bodies well scaled.
    arm = jnp.where(patch.overlap > 0, patch.centroid - state.position[i], 0)
    at_centroid = -matmul(skew(arm), rotation)
    upper = jnp.concatenate([jnp.eye(3, dtype=dtype), at_centroid], axis=1)
    return sign * jnp.concatenate([upper, jnp.concatenate([zero, rotation], axis=1)])


def _spin_momentum(omega: Float[Array, "3"], inertia: Float[Array, "3 3"], h: Float[Array, ""]):
    """The two parts (h/2) s(ω) J ω and (h/2) ω × Jω of the discrete angular momentum [B]."""
    # Beyond 2/h a step cannot represent the rotation; the root is kept real so that a line search can come back.
    s = jnp.sqrt(jnp.maximum(4 / h**2 - jnp.sum(omega * omega), _SLOWEST / h**2))
    spin = matvec(inertia, omega)
    return 0.5 * h * s * spin, 0.5 * h * jnp.cross(omega, spin)


# Floor of s(ω)² h²: 0.1 is |ω| = 1.975/h, 114° in one step.
_SLOWEST = 0.1


def _momentum_and_jacobian(velocity: Float[Array, "6"], mass, inertia, h):
    """(m v, P(ω)) of one body and its 6×6 derivative."""
    omega = velocity[3:]
    squared = 4 / h**2 - jnp.sum(omega * omega)
    resolved = squared > _SLOWEST / h**2
    s = jnp.sqrt(jnp.where(resolved, squared, _SLOWEST / h**2))
    spin = matvec(inertia, omega)
    momentum = jnp.concatenate([mass * velocity[:3], 0.5 * h * (s * spin + jnp.cross(omega, spin))])
    slope = jnp.where(resolved, 1 / s, 0)
    rotational = s * inertia - slope * spin[:, None] * omega[None] + matmul(skew(omega), inertia) - skew(spin)
    zero = jnp.zeros_like(inertia)
    translational = mass * jnp.eye(3, dtype=inertia.dtype)
    return momentum, jnp.concatenate(
        [jnp.concatenate([translational, zero], 1), jnp.concatenate([zero, 0.5 * h * rotational], 1)]
    )


def _contact_wrenches(velocities: Float[Array, "m 6"], problem: _Problem, pairs: _Pairs):
    """Wrench and Jacobian of every contact at given velocities."""

    def twist(maps, joined):
        moving = [matvec(m, velocities[i]) for m, i in zip(maps, joined, strict=True) if i >= 0]
        return sum(moving[1:], moving[0])

    twists = [twist(maps, joined) for maps, joined in zip(problem.maps, pairs.of_contact, strict=True)]
    items = list(zip(problem.laws, problem.patches, problem.params, twists, strict=True))
    # Without the barrier XLA recomputes a law inside each of the many small products that read it.
    return jax.lax.optimization_barrier(_grouped(lambda item: item[0].wrench(*item[1:]), items))


def _residual(velocities: Float[Array, "m 6"], problem: _Problem, pairs: _Pairs):
    """R(V⁺), shape (6 m,), and its Jacobian (6 m, 6 m)."""
    h, m = problem.timestep, len(pairs.moving)
    momentum, blocks = jax.vmap(_momentum_and_jacobian, (0, 0, 0, None))(
        velocities, problem.mass, problem.inertia, h
    )
    residual = [momentum[i] - problem.impulse[i] for i in range(m)]
    jacobian = [[blocks[i] if i == j else None for j in range(m)] for i in range(m)]
    for (wrench, slope), maps, joined in zip(
        _contact_wrenches(velocities, problem, pairs), problem.maps, pairs.of_contact, strict=True
    ):
        for row, i in zip(maps, joined, strict=True):
            if i < 0:
                continue
            residual[i] = residual[i] - h * matvec(row.T, wrench)
            half = jax.lax.optimization_barrier(h * matmul(row.T, slope))
            for column, j in zip(maps, joined, strict=True):
                if j >= 0:
                    block = matmul(half, column)
                    jacobian[i][j] = -block if jacobian[i][j] is None else jacobian[i][j] - block
    zero = jnp.zeros((6, 6), velocities.dtype)
    rows = [jnp.concatenate([zero if b is None else b for b in row], axis=1) for row in jacobian]
    return jnp.concatenate(residual), jnp.concatenate(rows)


class _Iterate(eqx.Module):
    """Carry of the Newton loop: the accepted point with its residual, and the length of the next try."""

    velocities: Float[Array, "m 6"]
    residual: Float[Array, " n"]
    jacobian: Float[Array, "n n"]
    length: Float[Array, ""]
    iteration: Int[Array, ""]


def _newton(problem: _Problem, start: Float[Array, "m 6"], pairs: _Pairs, options: SolverOptions):
    """Newton with a halving line search on the residual in velocity units.

    A loop pass evaluates residual and Jacobian once. If the residual did not fall, the pass is a line search step:
    the point stays and the length halves.
    """
    scale = _to_velocity(problem)
    # Rounding in R is relative to the momenta in it; asking for less would never end.
    relative = float(jnp.finfo(start.dtype).eps) ** 0.75 if options.tolerance is None else options.tolerance
    tolerance = relative * (1 + jnp.max(jnp.abs(scale * problem.impulse.ravel())))

    def error(residual):
        return jnp.max(jnp.abs(scale * residual))

    def unfinished(it: _Iterate):
        return (it.iteration < options.max_iterations) & ((it.iteration < 0) | ~(error(it.residual) <= tolerance))

    def advance(it: _Iterate):
        move = solve_small(it.jacobian, -it.residual[:, None]).reshape(it.velocities.shape)
        tried = it.velocities + it.length * move
        residual, jacobian = _residual(tried, problem, pairs)
        better = (it.iteration < 0) | (jnp.sum((scale * residual) ** 2) < jnp.sum((scale * it.residual) ** 2))
        pick = lambda new, old: jnp.where(better, new, old)  # noqa: E731
        return _Iterate(
            pick(tried, it.velocities),
            pick(residual, it.residual),
            pick(jacobian, it.jacobian),
            pick(jnp.ones_like(it.length), it.length / 2),
            it.iteration + 1,
        )

    # Pass −1 moves nowhere and only evaluates, so that the residual is compiled once.
    n = start.size
    first = _Iterate(
        start, jnp.ones(n, start.dtype), jnp.eye(n, dtype=start.dtype), jnp.zeros((), start.dtype), jnp.asarray(-1)
    )
    last = jax.lax.while_loop(unfinished, advance, first)
    remaining = error(last.residual)
    return last.velocities, last.jacobian, Report(remaining, last.iteration, remaining <= tolerance)


def _to_velocity(problem: _Problem) -> Float[Array, " n"]:
    """Factors that turn a momentum residual into velocities: 1/m, and 3/tr J."""
    trace = jnp.trace(problem.inertia, axis1=1, axis2=2)
    per_body = jnp.concatenate(
        [
            jnp.broadcast_to(1 / problem.mass[:, None], (*trace.shape, 3)),
            jnp.broadcast_to(3 / trace[:, None], (*trace.shape, 3)),
        ],
        axis=1,
    )
    return per_body.ravel()


def _solve(problem: _Problem, start: Float[Array, "m 6"], pairs: _Pairs, options: SolverOptions):
    """Root of the residual, with the derivative that the implicit function theorem gives it."""

    @eqx.filter_custom_jvp
    def root(problem, start):
        velocities, _, report = _newton(problem, start, pairs, options)
        return velocities, report

    @root.def_jvp
    def _(primals, tangents):
        problem, start = primals
        velocities, jacobian, report = _newton(problem, start, pairs, options)
        d_problem = tangents[0]
        perturbed = jax.tree.map(lambda t: t is not None, d_problem, is_leaf=lambda t: t is None)
        dynamic, static = eqx.partition(problem, perturbed)
        d_report = jax.tree.map(lambda _: None, report)
        if not jax.tree.leaves(d_problem):
            return (velocities, report), (jnp.zeros_like(velocities), d_report)
        # The inverse, not a solve: the tangent must be linear in `change` for reverse mode to transpose it.
        inverse = solve_small(jacobian, jnp.eye(jacobian.shape[0], dtype=jacobian.dtype))
        velocities, inverse = (checkpoint_name(value, KEPT) for value in (velocities, inverse))
        of_problem = lambda p: _residual(velocities, eqx.combine(p, static), pairs)[0]  # noqa: E731
        _, change = jax.jvp(of_problem, (dynamic,), (d_problem,))
        tangent = -matvec(inverse, change).reshape(velocities.shape)
        return (velocities, report), (tangent, d_report)

    velocities, report = root(problem, start)
    return velocities, jax.lax.stop_gradient(report)


# Up to here elimination written out beats a LAPACK call (0.3 against 1.3 µs for 6 unknowns).
_UNROLLED = 12


def solve_small(matrix: Float[Array, "n n"], right: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Solution of a small dense system with k right-hand sides; n is a multiple of three.

    Up to 12 unknowns by Gauss–Jordan elimination with 3×3 pivots (a body's translation, its rotation) and without
    exchanges, LAPACK beyond. The matrices here are inertia plus dissipation: their symmetric part is positive, so
    pivots stay away from singular.
    """
    n = matrix.shape[0]
    if n > _UNROLLED:
        return jnp.linalg.solve(matrix, right)
    augmented = jnp.concatenate([matrix, right], axis=1)
    for start in range(0, n, 3):
        rows = slice(start, start + 3)
        pivot_rows = matmul(_inverse3(augmented[rows, rows]), augmented[rows])
        factor = jnp.where((np.arange(n) // 3 == start // 3)[:, None], 0, augmented[:, rows])
        reduced = augmented - matmul(factor, pivot_rows)
        augmented = jnp.concatenate([reduced[:start], pivot_rows, reduced[start + 3 :]])
    return augmented[:, n:]


def _inverse3(m: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Inverse of a 3×3 matrix by cofactors."""
    rows = jnp.stack([jnp.cross(m[:, 1], m[:, 2]), jnp.cross(m[:, 2], m[:, 0]), jnp.cross(m[:, 0], m[:, 1])])
    return rows / jnp.sum(m[:, 0] * rows[0])


def _advance(state: State, velocities: Float[Array, "m 6"], h: Float[Array, ""], pairs: _Pairs) -> State:
    velocity, omega = velocities[:, :3], velocities[:, 3:]
    s = jnp.sqrt(jnp.maximum(4 / h**2 - jnp.sum(omega * omega, axis=1, keepdims=True), _SLOWEST / h**2))
    orientation = _rows(state.orientation, pairs.moving)
    turned = quat_multiply(orientation, 0.5 * h * jnp.concatenate([s, omega], axis=1))
    # Exactly a unit quaternion in exact arithmetic; this removes the rounding that thousands of products gather.
    turned = turned * (1.5 - 0.5 * jnp.sum(turned * turned, axis=1, keepdims=True))
    moved = _rows(state.position, pairs.moving) + h * velocity
    return State(
        _with_rows(state.position, moved, pairs.moving),
        _with_rows(state.orientation, turned, pairs.moving),
        _with_rows(state.velocity, velocity, pairs.moving),
        _with_rows(state.omega, omega, pairs.moving),
    )


def _rows(x: Float[Array, "n k"], rows: tuple[int, ...]) -> Float[Array, "m k"]:
    """Some rows of an array; slices, because gathers and scatters cost XLA's CPU backend a microsecond each."""
    return jnp.stack([x[i] for i in rows])


def _with_rows(
    x: Float[Array, "n k"], new: Float[Array, "m k"], rows: tuple[int, ...]
) -> Float[Array, "n k"]:
    """The array with some rows replaced."""
    return jnp.stack([new[rows.index(i)] if i in rows else x[i] for i in range(x.shape[0])])
