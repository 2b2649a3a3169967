"""Bodies on joints: the integrator of free bodies, restricted to what the joints allow.

Every body keeps the discrete Lagrangian that it has as a free body (see `_rigid`); its pose x_i(q) is that
of its tree. With unknown generalised velocities y a step leads to q⁺ = q + h y, body i moves by the twist
V_i(y) that takes x_i(q) to x_i(q⁺), and the sum of what free bodies would balance, projected on what the
joints allow, vanishes:

    Σ_i J_i(q)ᵀ (P_i(V_i(y)) − P_i⁻ − h f_i) + h g(y) = 0,        J_i = ∂x_i/∂q,

with what acts on the joints themselves in g (see `dano.engine.joints`). A ball joint turns in a step by its
part of y as a free body does by its spin; q⁺ is the rotation vector of what it has come to.

These are the discrete Euler–Lagrange equations of the whole (the discrete null space method: Betsch and
Leyendecker 2006), so bodies on joints have the order and the conservation of free ones, and joints hold
exactly. Contact sees bodies move by J_i(q) y + c_i, which is V_i at the old velocities. On a CPU, and where
contacts have the paper's law, machine code makes the whole step by these equations, and its derivatives (see
`_kernels`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.engine._newton import inverse3
from dano.engine._rigid import turn_slopes, turned
from dano.engine.joints import Closure, JointForces, Rough
from dano.maths import einsum, matmul, matvec, product, quat_exp, quat_log, quat_to_matrix, safe_norm
from dano.scene import (
    Chains,
    Control,
    joints_of,
    link_jacobian,
    Loops,
    place_links,
    Poses,
    Scene,
    State,
    step_twists,
    triples,
)

LARGEST_TURN = 2.8
"""Angle by which joints may turn a body in a step [rad]: from 180° on a turn reads as one the other way."""


class Tree(eqx.Module):
    """What a step knows of joints; n bodies, m of which move, k generalised velocities.

    Attributes:
        chains: The trees.
        position: Poses at the start of the step [m, W], shape (n, 3).
        orientation: wxyz, shape (n, 4).
        q: Joint coordinates at the start.
        forces: What acts on them.
        jacobian: J at the start: twists [W] of the bodies that move per velocity, shape (m, 6, k).
        offset: c: what they move by besides J y, shape (m, 6).
        loops: What closes chains; None if nothing does.
    """

    chains: Chains
    position: Float[Array, "n 3"]
    orientation: Float[Array, "n 4"]
    q: Float[Array, " j"]
    forces: JointForces
    jacobian: Float[Array, "m 6 k"]
    offset: Float[Array, "m 6"]
    loops: Loops | None = None

    def twists(self, y: Float[Array, " k"]) -> Float[Array, "m 6"]:
        """How bodies move as contact sees it [m/s; rad/s, W]."""
        return einsum("mak,k->ma", self.jacobian, y) + self.offset

    def pulled(self, momenta: Float[Array, "m 6"]) -> Float[Array, " k"]:
        """Momenta of bodies [W] as generalised ones."""
        return einsum("mak,ma->k", self.jacobian, momenta)


def build_tree(scene: Scene, state: State, control: Control | None) -> tuple[Tree, Poses]:
    """The tree of a step, and the poses at its end if the old velocities stay."""
    chains, h = scene.chains, scene.timestep
    assert state.q is not None and state.v is not None
    moving = np.array(scene.layout.moving)
    now = place_links(chains, state.position, state.orientation, state.q)
    jacobian = link_jacobian(chains, now)[moving]
    none = jnp.zeros_like(state.q)
    effort = none if control is None or control.effort is None else control.effort
    command = none if control is None or control.command is None else control.command
    tree = Tree(
        chains,
        state.position,
        state.orientation,
        state.q,
        JointForces(chains.laws, state.q, state.v, effort, command, h),
        jacobian,
        jnp.zeros(jacobian.shape[:2], h.dtype),
        scene.closing,
    )
    y = generalised(scene, state, state.orientation)
    ahead = _ahead(tree, y, h)
    moved = _world_twists(tree, ahead, y, h)
    return eqx.tree_at(lambda t: t.offset, tree, moved - einsum("mak,k->ma", jacobian, y)), ahead


def generalised(scene: Scene, state: State, orientation: Float[Array, "n 4"]) -> Float[Array, " k"]:
    """Generalised velocities of a state: velocity and spin [W] of each free body, then those of joints.

    Orientations are those at the start of the step that has the velocities.
    """
    assert state.v is not None
    free = np.array(scene.layout.free, int)
    spins = jax.vmap(matvec)(quat_to_matrix(orientation[free]), state.omega[free])
    return jnp.concatenate([jnp.concatenate([state.velocity[free], spins], axis=1).ravel(), state.v])


def tree_balance(tree: Tree, y: Float[Array, " k"], own, h: Float[Array, ""]):
    """Left side of the equation above without contact, and its derivative by y, shapes (k,) and (k, k).

    Args:
        tree: The tree.
        y: Generalised velocities at the end of the step.
        own: From twists of all bodies that move [W], shape (m, 6), to P − P⁻ − h f of each as if it were
            free, and its derivative, shape (m, 6, 6).
        h: Timestep [s].
    """
    ahead = _ahead(tree, y, h)
    momenta, slopes = own(_world_twists(tree, ahead, y, h))
    roots = 6 * len(tree.chains.layout.free)
    own, slope = tree.forces.smooth(y[roots:])
    residual = tree.pulled(momenta).at[roots:].add(own)
    by_y = einsum("mab,mbk->mak", slopes, _twist_slopes(tree, ahead, y, h))
    jacobian = einsum("mak,mal->kl", tree.jacobian, by_y)
    places = np.arange(roots, len(y))
    return residual, jacobian.at[places, places].add(slope)


def rough_of(tree: Tree, inverse_mass: Float[Array, "k k"], h: Float[Array, ""]) -> Rough:
    """The coordinates of a step with kinks.

    Args:
        tree: The tree, some of whose laws have kinks.
        inverse_mass: Inverse of the generalised mass.
        h: Timestep [s].
    """
    rows = 6 * len(tree.chains.layout.free) + np.array(tree.chains.laws.rough, int)
    weight = jax.lax.stop_gradient(1 / inverse_mass[rows, rows])
    return Rough(tree.forces.ramps(weight), rows, weight / h, h)


def closure_of(tree: Tree, inverse_mass: Float[Array, "k k"], h: Float[Array, ""]) -> Closure:
    """What closes the loops of a step; arguments are those of `rough_of`."""
    slopes = _loop_slopes(tree, tree.position, tree.orientation, tree.jacobian)
    return Closure.create(slopes, jax.lax.stop_gradient(inverse_mass), h)


def loop_gaps(tree: Tree, y: Float[Array, " k"], h: Float[Array, ""]):
    """Gaps of the loops after a step with generalised velocities y, and their derivative by y."""
    ahead = _ahead(tree, y, h)
    assert tree.loops is not None
    gaps = tree.loops.gaps(ahead.position, ahead.orientation)
    _, ends = _end_slopes(tree, ahead, y, h)
    return gaps, _loop_slopes(tree, ahead.position, ahead.orientation, ends)


def _loop_slopes(tree: Tree, position: Array, orientation: Array, moved: Float[Array, "m 6 k"]):
    """Derivative of the gaps by numbers that move the bodies that are not fixed."""
    layout = tree.chains.layout
    assert tree.loops is not None
    whole = jnp.zeros((layout.bodies, *moved.shape[1:]), moved.dtype)
    return tree.loops.slopes(position, orientation, whole.at[np.array(layout.moving)].set(moved))


def mass_matrix(tree: Tree, mass: Float[Array, " m"], inertia: Float[Array, "m 3 3"]) -> Float[Array, "k k"]:
    """Generalised mass at the start of the step, from masses and inertias [W] of the bodies that move."""
    return tree.chains.mass_matrix(tree.jacobian, mass, inertia)


def tree_mobilities(tree: Tree, mass: Float[Array, " m"], inertia: Float[Array, "m 3 3"]):
    """How easily each body that moves can be pushed [1/kg] and turned [1/(kg m²), W], shapes (m,), (m, 3, 3).

    Arguments are those of `mass_matrix`. A push has one number for all directions, the root mean square: that
    is 1/m for a free body.
    """
    inverse = jnp.linalg.inv(mass_matrix(tree, mass, inertia))
    both = einsum("mak,kl,mbl->mab", tree.jacobian, inverse, tree.jacobian)
    push = both[:, :3, :3]
    return jnp.sqrt(jnp.sum(push * push, axis=(1, 2)) / 3), both[:, 3:, 3:]


def advance_tree(scene: Scene, tree: Tree, state: State, y: Float[Array, " k"], h: Float[Array, ""]) -> State:
    """The state at the end of a step with generalised velocities y."""
    layout = tree.chains.layout
    roots, free, hanging = 6 * len(layout.free), np.array(layout.free, int), np.array(layout.children)
    ahead = _ahead(tree, y, h)
    velocity, omega = step_twists((tree.position, tree.orientation), ahead[:2], h)
    speeds = y[:roots].reshape(-1, 6)
    spins = jax.vmap(lambda r, w: matvec(r.T, w))(quat_to_matrix(state.orientation[free]), speeds[:, 3:])
    return State(
        state.position.at[hanging].set(ahead.position[hanging]).at[free].set(ahead.position[free]),
        state.orientation.at[hanging].set(ahead.orientation[hanging]).at[free].set(ahead.orientation[free]),
        state.velocity.at[hanging].set(velocity[hanging]).at[free].set(speeds[:, :3]),
        state.omega.at[hanging].set(omega[hanging]).at[free].set(spins),
        _moved(tree, y, h),
        y[roots:],
    )


def turns_too_far(tree: Tree, y: Float[Array, " k"], h: Float[Array, ""]) -> Array:
    """Whether joints turn a body by more than a step can tell from a turn the other way."""
    layout = tree.chains.layout
    moved = h * y[6 * len(layout.free) :]
    turns = jnp.zeros((len(layout.dofs),), y.dtype)
    for kind, part in (("hinge", 0), ("planar", 2)):
        rows = [(d, k) for d, (j, i, k) in enumerate(layout.dofs) if layout.kinds[j] == kind and i == part]
        at, places = np.array(rows, int).reshape(-1, 2).T
        joints = np.array([layout.dofs[d][0] for d in at], int)
        turns = turns.at[at].set(jnp.abs(tree.chains.ratio[joints] * moved[places]))
    balls, first = joints_of(layout, "ball")
    if balls.size:
        at = np.array([d for d, (j, i, _) in enumerate(layout.dofs) if j in balls and i == 0], int)
        turns = turns.at[at].set(safe_norm(moved[triples(first)]))
    moved_by = np.array(layout.moved_by, float).reshape(layout.bodies, -1)
    return jnp.any(product(jnp.asarray(moved_by, y.dtype), turns) > LARGEST_TURN)


def _moved(tree: Tree, y: Float[Array, " k"], h: Float[Array, ""]) -> Float[Array, " j"]:
    """Joint coordinates after a step with generalised velocities y."""
    own = y[6 * len(tree.chains.layout.free) :]
    q = tree.q + h * own
    _, first = joints_of(tree.chains.layout, "ball")
    if not first.size:
        return q
    places = triples(first)
    return q.at[places].set(quat_log(turned(quat_exp(tree.q[places]), own[places], h)))


def _ahead(tree: Tree, y: Float[Array, " k"], h: Float[Array, ""]) -> Poses:
    """Poses after a step with generalised velocities y."""
    layout = tree.chains.layout
    roots, free = 6 * len(layout.free), np.array(layout.free, int)
    speeds = y[:roots].reshape(-1, 6)
    spins = jax.vmap(lambda r, w: matvec(r.T, w))(quat_to_matrix(tree.orientation[free]), speeds[:, 3:])
    position = tree.position.at[free].add(h * speeds[:, :3])
    orientation = tree.orientation.at[free].set(turned(tree.orientation[free], spins, h))
    return place_links(tree.chains, position, orientation, _moved(tree, y, h))


def _world_twists(
    tree: Tree, ahead: Poses, y: Float[Array, " k"], h: Float[Array, ""]
) -> Float[Array, "m 6"]:
    """Twists [W] of the bodies that move with generalised velocities y, which lead to poses `ahead`."""
    layout = tree.chains.layout
    moving = np.array(layout.moving)
    velocity, omega = step_twists(
        (tree.position[moving], tree.orientation[moving]),
        (ahead.position[moving], ahead.orientation[moving]),
        h,
    )
    spins = jax.vmap(matvec)(quat_to_matrix(tree.orientation[moving]), omega)
    twists = jnp.concatenate([velocity, spins], axis=1)
    # A pose tells turns up to 180° only; those of free bodies are known.
    free = np.array([layout.moving.index(i) for i in layout.free], int)
    return twists.at[free].set(y[: 6 * len(layout.free)].reshape(-1, 6))


def _twist_slopes(
    tree: Tree, ahead: Poses, y: Float[Array, " k"], h: Float[Array, ""]
) -> Float[Array, "m 6 k"]:
    """Derivative of `_world_twists` by y."""
    turns, slopes = _end_slopes(tree, ahead, y, h)
    return jnp.concatenate([slopes[:, :3] / h, einsum("mab,mbk->mak", turns, slopes[:, 3:])], axis=1)


def _end_slopes(tree: Tree, ahead: Poses, y: Float[Array, " k"], h: Float[Array, ""]):
    """By how much y moves and turns bodies at the end of a step, and what turning does to their spins.

    Turning the end by a small angle a [W] changes the spin by R A(ω) Rᵀ a with A of `turn_slopes`, where R is
    the orientation at the start. Shapes (m, 3, 3) of that, and (m, 6, k).
    """
    layout = tree.chains.layout
    moving, free = np.array(layout.moving), np.array(layout.free, int)
    rotations = quat_to_matrix(tree.orientation[moving])
    _, omega = step_twists(
        (tree.position[moving], tree.orientation[moving]),
        (ahead.position[moving], ahead.orientation[moving]),
        h,
    )
    halves = jax.vmap(turn_slopes, (0, None))(omega, h)
    turns = jax.vmap(lambda r, a: matmul(matmul(r, a), r.T))(rotations, halves)
    slopes = link_jacobian(tree.chains, ahead)[moving]
    # Generalised velocities act for h; spins of roots turn the end of the step by the inverse of the above.
    own = slopes[:, :, 6 * len(layout.free) :]
    columns = [_with_balls(tree, own, y[6 * len(layout.free) :], h)]
    for place, body in reversed(list(enumerate(free))):
        mine = slopes[:, :, 6 * place : 6 * place + 6]
        inverse = inverse3(turns[layout.moving.index(int(body))])
        columns = [mine[:, :, :3] * h, einsum("mab,bc->mac", mine[:, :, 3:], inverse), *columns]
    return turns, jnp.concatenate(columns, axis=2)


def _with_balls(tree: Tree, slopes: Float[Array, "m 6 j"], v: Float[Array, " j"], h: Float[Array, ""]):
    """Derivative of the end of a step by the joints' velocities from the Jacobian there.

    A ball's velocity ω turns the end by A(ω)⁻¹, seen from the start; the Jacobian is seen from the end.
    """
    columns = slopes * h
    for place in joints_of(tree.chains.layout, "ball")[1]:
        three = slice(int(place), int(place) + 3)
        back = quat_to_matrix(turned(jnp.eye(4, dtype=v.dtype)[0], v[three], h)).T
        turn = matmul(back, inverse3(turn_slopes(v[three], h)))
        columns = columns.at[:, :, three].set(einsum("mab,bc->mac", slopes[:, :, three], turn))
    return columns
