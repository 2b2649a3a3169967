"""First-order variational integrator for free rigid bodies in contact, one implicit solve a step.

Unknowns of a step are the end-of-step velocities V⁺ = (v⁺, ω⁺) of all bodies that move:

    translation   m (v⁺ − v) = h m g + h f + impulses,                              x⁺ = x + h v⁺
    rotation      P(ω⁺) − P⁻(ω) = h Rᵀτ + impulses (body frame),                    q⁺ = q ⊗ (h/2) (s(ω⁺), ω⁺)
    with          P(ω) = (h/2)(s J ω + ω × Jω),  P⁻(ω) = (h/2)(s J ω − ω × Jω),     s(ω) = √(4/h² − |ω|²)

(Dojo, eq. 5–9.) P(ω⁺) is the body's angular momentum seen from its old orientation, P⁻(ω) the one it came
with, so free motion conserves momentum to rounding. Geometry is taken at the old configuration, velocities in
the contact laws are the unknown ones. Each step solves R(V⁺; θ) = 0 by Newton with a line search and is
differentiated by the implicit function theorem, never through the iterations. R is in velocity units: momenta
over mass and mean inertia.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from dano.contact import AbstractContactLaw, ContactParams, Patch, Softening
from dano.contact._derivatives import KEPT
from dano.contact._small import matmul, matvec
from dano.engine._newton import newton, Report, solve_small, SolverOptions
from dano.maths import quat_multiply, quat_to_matrix, skew
from dano.scene import colliders, Control, Scene, State


class _Problem(eqx.Module):
    """Everything the residual of a step depends on, except the unknown velocities.

    Attributes:
        mass: [kg], shape (m,) for m bodies that move.
        inertia: [kg m², B], shape (m, 3, 3).
        impulse: Momentum before contact: old momentum plus gravity and controls, shape (m, 6), rotation in B.
        rotation: Body → world, shape (m, 3, 3).
        timestep: h [s].
        patches: Geometry of each contact, as its law sees it.
        arms: From the centres of mass of a contact's two bodies to the patch's point [m, W]; unused for a
            fixed body.
        params: Parameters of each contact.
        laws: Law of each contact.
    """

    mass: Float[Array, " m"]
    inertia: Float[Array, "m 3 3"]
    impulse: Float[Array, "m 6"]
    rotation: Float[Array, "m 3 3"]
    timestep: Float[Array, ""]
    patches: tuple[Any, ...]
    arms: tuple[tuple[Float[Array, "3"], Float[Array, "3"]], ...]
    params: tuple[ContactParams, ...]
    laws: tuple[AbstractContactLaw, ...]


class _Pairs(NamedTuple):
    """Static structure: which bodies move, and which of them each contact joins; −1 is a fixed one."""

    moving: tuple[int, ...]
    of_contact: tuple[tuple[int, int], ...]


# The second body of a contact feels the opposite wrench and counts negative in the relative twist.
_SIGNS = (1, -1)


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
    found = _contact_wrenches(velocities, problem, pairs, Softening())
    rows = []
    for contact, patch, (wrench, _) in zip(scene.contacts, problem.patches, found, strict=True):
        centroid = contact.law.summary(patch).centroid
        shift = jnp.where(jnp.any(wrench != 0), patch.point - centroid, 0)
        rows.append(wrench.at[3:].add(jnp.cross(shift, wrench[:3])))
    return jnp.stack(rows)


def patches(scene: Scene, state: State) -> tuple[Patch, ...]:
    """Overlap of every contact of a scene at a state, in the order of `scene.contacts`."""
    found = _patches(scene, state, tuple(quat_to_matrix(q) for q in state.orientation))
    return tuple(c.law.summary(patch) for c, patch in zip(scene.contacts, found, strict=True))


def _patches(scene: Scene, state: State, rotations: tuple[Float[Array, "3 3"], ...]) -> tuple[Any, ...]:
    items = [(c.law, *colliders(scene.bodies, c, state, rotations), scene.timestep) for c in scene.contacts]
    return _grouped(lambda item: item[0].patch(*item[1:]), items)


def _grouped(function, items: list):
    """Apply a function to each item; items of equal structure and shapes are stacked and mapped together.

    Written out pair by pair, scenes with many equal bodies would compile slowly.
    """

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
    rows, h = pairs.moving, scene.timestep
    bodies = [scene.bodies[i] for i in rows]
    rotations = tuple(quat_to_matrix(q) for q in state.orientation)
    rotation = jnp.stack([rotations[i] for i in rows])
    mass = jnp.stack([body.mass * body.mass_scale for body in bodies])
    inertia = jnp.stack([body.inertia * body.mass_scale for body in bodies])
    velocity, omega = _rows(state.velocity, rows), _rows(state.omega, rows)
    linear = mass[:, None] * (velocity + (h * scene.gravity)[None])
    angular = jax.vmap(_angular_momentum, (0, 0, None, None))(omega, inertia, h, -1)
    if control is not None:
        linear = linear + h * _rows(control.force, rows)
        angular = angular + h * jax.vmap(lambda r, t: matvec(r.T, t))(rotation, _rows(control.torque, rows))
    overlaps = _patches(scene, state, rotations)
    arms = tuple(
        (
            _arm(patch, state.position[scene.index(contact.a)]),
            _arm(patch, state.position[scene.index(contact.b)]),
        )
        for contact, patch in zip(scene.contacts, overlaps, strict=True)
    )
    return _Problem(
        mass,
        inertia,
        jnp.concatenate([linear, angular], axis=1),
        rotation,
        h,
        overlaps,
        arms,
        tuple(contact.params for contact in scene.contacts),
        tuple(contact.law for contact in scene.contacts),
    )


def _arm(patch: Any, position: Float[Array, "3"]) -> Float[Array, "3"]:
    # Without contact a centroid is nowhere; any arm will do, and zero keeps far-away bodies well scaled.
    return jnp.where(patch.touching, patch.point - position, 0)


# Floor of s(ω)² h²: 0.1 is |ω| = 1.975/h, 162° in one step. Beyond 2/h a step cannot represent the rotation;
# the root is kept real so that a line search can come back.
_SLOWEST = 0.1


def _half_angle_root(omega: Float[Array, "3"], h: Float[Array, ""]) -> Float[Array, ""]:
    """s(ω) = √(4/h² − |ω|²), floored."""
    return jnp.sqrt(jnp.maximum(4 / h**2 - jnp.sum(omega * omega), _SLOWEST / h**2))


def _angular_momentum(omega: Float[Array, "3"], inertia: Float[Array, "3 3"], h: Float[Array, ""], sign: int):
    """(h/2)(s(ω) J ω ± ω × Jω) [B]: seen from the orientation at the start (+) or the end (−) of a step."""
    spin = matvec(inertia, omega)
    return 0.5 * h * (_half_angle_root(omega, h) * spin + sign * jnp.cross(omega, spin))


def _angular_jacobian(omega: Float[Array, "3"], inertia: Float[Array, "3 3"], h: Float[Array, ""]):
    """Derivative of `_angular_momentum` at the start of a step with respect to ω."""
    s = _half_angle_root(omega, h)
    slope = jnp.where(s**2 * h**2 > 1.0001 * _SLOWEST, 1 / s, 0)
    spin = matvec(inertia, omega)
    along = slope * spin[:, None] * omega[None]
    return 0.5 * h * (s * inertia - along + matmul(skew(omega), inertia) - skew(spin))


def _contact_wrenches(
    velocities: Float[Array, "m 6"], problem: _Problem, pairs: _Pairs, softening: Softening
):
    """Wrench and its derivative with respect to the relative twist, for every contact at given velocities."""
    spins = [matvec(r, w) for r, w in zip(problem.rotation, velocities[:, 3:], strict=True)]
    twists = []
    for arms, joined in zip(problem.arms, pairs.of_contact, strict=True):
        terms = [
            sign * jnp.concatenate([velocities[i, :3] + jnp.cross(spins[i], arm), spins[i]])
            for sign, arm, i in zip(_SIGNS, arms, joined, strict=True)
            if i >= 0
        ]
        twists.append(sum(terms[1:], terms[0]))
    timesteps = [problem.timestep] * len(twists)
    items = list(zip(problem.laws, problem.patches, problem.params, twists, timesteps, strict=True))
    return _grouped(lambda item: item[0].wrench(*item[1:], softening), items)


def _residual(velocities: Float[Array, "m 6"], problem: _Problem, pairs: _Pairs, softening: Softening):
    """R(V⁺), shape (6 m,), and the derivative of each contact's wrench with respect to its twist."""
    h = problem.timestep
    linear = problem.mass[:, None] * velocities[:, :3]
    angular = jax.vmap(_angular_momentum, (0, 0, None, None))(velocities[:, 3:], problem.inertia, h, 1)
    rows = list(jnp.concatenate([linear, angular], axis=1) - problem.impulse)
    wrenches = _contact_wrenches(velocities, problem, pairs, softening)
    for (wrench, _), arms, joined in zip(wrenches, problem.arms, pairs.of_contact, strict=True):
        for sign, arm, i in zip(_SIGNS, arms, joined, strict=True):
            if i >= 0:
                torque = jnp.cross(arm, wrench[:3]) + wrench[3:]
                in_body = matvec(problem.rotation[i].T, torque)
                rows[i] = rows[i] - sign * h * jnp.concatenate([wrench[:3], in_body])
    return _to_velocity(problem) * jnp.concatenate(rows), [slope for _, slope in wrenches]


def _jacobian(
    velocities: Float[Array, "m 6"], problem: _Problem, pairs: _Pairs, slopes
) -> Float[Array, "n n"]:
    """∂R/∂V⁺, shape (6 m, 6 m), in closed form."""
    h, m = problem.timestep, len(pairs.moving)
    eye, zero = jnp.eye(3, dtype=velocities.dtype), jnp.zeros((3, 3), velocities.dtype)
    inertial = jax.vmap(_angular_jacobian, (0, 0, None))(velocities[:, 3:], problem.inertia, h)
    blocks = {(i, i): _corners(problem.mass[i] * eye, zero, zero, inertial[i]) for i in range(m)}
    # Without barriers XLA computes a law again inside each of the many small products that read it.
    slopes = jax.lax.optimization_barrier(slopes)
    for slope, arms, joined in zip(slopes, problem.arms, pairs.of_contact, strict=True):
        # From a body's (v, ω) to the relative twist at the centroid; its transpose takes the wrench back.
        maps = {
            i: sign * _corners(eye, -matmul(skew(arm), problem.rotation[i]), zero, problem.rotation[i])
            for sign, arm, i in zip(_SIGNS, arms, joined, strict=True)
            if i >= 0
        }
        for i, row in maps.items():
            half = jax.lax.optimization_barrier(h * matmul(row.T, slope))
            for j, column in maps.items():
                block = matmul(half, column)
                blocks[i, j] = blocks[i, j] - block if (i, j) in blocks else -block
    empty = jnp.zeros((6, 6), velocities.dtype)
    rows = [jnp.concatenate([blocks.get((i, j), empty) for j in range(m)], axis=1) for i in range(m)]
    return _to_velocity(problem)[:, None] * jnp.concatenate(rows)


def _corners(a, b, c, d):
    """The 6×6 matrix of four 3×3 blocks."""
    return jnp.concatenate([jnp.concatenate([a, b], axis=1), jnp.concatenate([c, d], axis=1)])


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

    def find(problem, start):
        def evaluate(point, softening):
            velocities = point.reshape(start.shape)
            residual, slopes = _residual(velocities, problem, pairs, softening)
            return residual, _jacobian(velocities, problem, pairs, slopes)

        scale = _to_velocity(problem)
        size = jnp.max(jnp.abs(scale * problem.impulse.ravel()))
        softens = any(law.stiction for law in problem.laws)
        point, jacobian, report = newton(evaluate, start.ravel(), scale, size, options, softens=softens)
        return point.reshape(start.shape), jacobian, report

    @eqx.filter_custom_jvp
    def root(problem, start):
        velocities, _, report = find(problem, start)
        return velocities, report

    @root.def_jvp
    def _(primals, tangents):
        problem, start = primals
        velocities, jacobian, report = find(problem, start)
        # The inverse, not a solve: the tangent must be linear in `change` for reverse mode to transpose it.
        inverse = solve_small(jacobian, jnp.eye(jacobian.shape[0], dtype=jacobian.dtype))
        velocities, inverse = (checkpoint_name(value, KEPT) for value in (velocities, inverse))
        d_problem = tangents[0]
        d_report = jax.tree.map(lambda _: None, report)
        if not jax.tree.leaves(d_problem):
            return (velocities, report), (jnp.zeros_like(velocities), d_report)
        perturbed = jax.tree.map(lambda t: t is not None, d_problem, is_leaf=lambda t: t is None)
        dynamic, static = eqx.partition(problem, perturbed)
        of_problem = lambda p: _residual(velocities, eqx.combine(p, static), pairs, Softening())[0]  # noqa: E731
        _, change = jax.jvp(of_problem, (dynamic,), (d_problem,))
        return (velocities, report), (-matvec(inverse, change).reshape(velocities.shape), d_report)

    velocities, report = root(problem, start)
    return velocities, jax.lax.stop_gradient(report)


def _advance(state: State, velocities: Float[Array, "m 6"], h: Float[Array, ""], pairs: _Pairs) -> State:
    velocity, omega = velocities[:, :3], velocities[:, 3:]
    s = jax.vmap(_half_angle_root, (0, None))(omega, h)[:, None]
    orientation = _rows(state.orientation, pairs.moving)
    turned = quat_multiply(orientation, 0.5 * h * jnp.concatenate([s, omega], axis=1))
    # Exactly a unit quaternion in exact arithmetic; this removes the rounding that thousands of products
    # gather.
    turned = turned * (1.5 - 0.5 * jnp.sum(turned * turned, axis=1, keepdims=True))
    moved = _rows(state.position, pairs.moving) + h * velocity
    return State(
        _with_rows(state.position, moved, pairs.moving),
        _with_rows(state.orientation, turned, pairs.moving),
        _with_rows(state.velocity, velocity, pairs.moving),
        _with_rows(state.omega, omega, pairs.moving),
    )


def _rows(x: Float[Array, "n k"], rows: tuple[int, ...]) -> Float[Array, "m k"]:
    """Some rows of an array; slices, because a gather or scatter costs XLA's CPU backend a microsecond."""
    return jnp.stack([x[i] for i in rows])


def _with_rows(
    x: Float[Array, "n k"], new: Float[Array, "m k"], rows: tuple[int, ...]
) -> Float[Array, "n k"]:
    """The array with some rows replaced."""
    return jnp.stack([new[rows.index(i)] if i in rows else x[i] for i in range(x.shape[0])])
