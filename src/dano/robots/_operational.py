"""Control of a link in the space in which its task is told."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dano.checks import checked_number
from dano.maths import checked_array, checked_floating, Numbers
from dano.robots._dynamics import bias_forces, drifted, generalised_velocities, mass_matrix
from dano.robots._robot import check_arguments, Robot
from dano.scene import Scene, State


def operational_space_torque(
    robot: Robot,
    scene: Scene,
    state: State,
    link: str,
    acceleration: Numbers,
    *,
    posture: Numbers | None = None,
    softness: float = 1e-9,
) -> Float[Array, " k"]:
    """Generalised forces that give a link an acceleration (Khatib 1987, A unified approach …, eq. 51).

    With J of the link and M(q) v̇ + b(q, v) = τ,

        τ = Jᵀ Λ (a − J̇ v) + b + (1 − Jᵀ Λ J M⁻¹) τ₀,        Λ = (J M⁻¹ Jᵀ)⁻¹,

    so that what the task leaves free follows τ₀, which does not disturb it.

    Args:
        robot: The robot.
        scene: A scene with it.
        state: Where it is and how it moves.
        link: Name in the file.
        acceleration: a of the link's frame: linear [m/s², W], shape (3,), or linear and angular [rad/s², W],
            shape (6,).
        posture: τ₀ [N, N m], shape (k,). Default: none.
        softness: Share of the mean of J M⁻¹ Jᵀ that is added to it, so that torques stay finite where the
            link cannot move in some direction.

    Raises:
        ValueError: If the link is unknown, a shape is wrong, or `softness` < 0.
    """
    check_arguments(robot, scene, state)
    dtype, k = scene.timestep.dtype, scene.layout.n_velocities
    wanted = checked_floating("acceleration", acceleration)
    if wanted.shape not in ((3,), (6,)):
        raise ValueError(f"acceleration must have shape (3,) or (6,), got {wanted.shape}")
    wanted = checked_array("acceleration", wanted, wanted.shape).astype(dtype)
    free = jnp.zeros(k) if posture is None else checked_array("posture", posture, (k,))
    free = free.astype(dtype)
    checked_number("softness", softness, least=0)
    n, speeds = wanted.shape[0], generalised_velocities(scene, state)
    jacobian = robot.place(scene, state, link)[2][:n]

    def moved(share: Float[Array, ""]) -> Float[Array, " n"]:
        return robot.place(scene, drifted(scene, state, share), link)[2][:n] @ speeds

    zero, one = jnp.zeros((), dtype), jnp.ones((), dtype)
    _, drift = jax.jvp(moved, (zero,), (one,))
    follows = jnp.linalg.solve(mass_matrix(scene, state), jacobian.T)
    mobility = jacobian @ follows
    softer = mobility + softness * jnp.trace(mobility) / n * jnp.eye(n, dtype=dtype)
    force = jnp.linalg.solve(softer, wanted - drift - follows.T @ free)
    return jacobian.T @ force + bias_forces(scene, state) + free
