"""Hold a bunny in the air with a linear–quadratic regulator, and throw a ball at it."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import solve_discrete_are

import dano
from dano.maths import quat_conjugate, quat_multiply

HOME = (0.0, 0.0, 0.5)  # [m]


def main(quick: bool = False) -> dict[str, float]:
    bunny = dano.load_object("bunny")
    alone = dano.Scene.create([dano.Body("bunny", bunny)], timestep=0.002)
    goal = alone.initial_state(bunny={"position": HOME})
    weight = 9.81 * float(bunny.mass.mass)

    # Coordinates: position, rotation vector, velocity, omega; of the control: force, torque.
    hover = alone.control(bunny={"force": (0, 0, weight)})
    A, B = (np.asarray(m) for m in dano.linearize(alone, goal, hover))
    Q, R = np.diag([100.0] * 3 + [1.0] * 3 + [1.0] * 3 + [0.01] * 3), np.diag([0.1] * 3 + [10.0] * 3)
    P = solve_discrete_are(A, B, Q, R)
    gain = jnp.asarray(np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A))
    slowest = float(np.max(np.abs(np.linalg.eigvals(A - B @ np.asarray(gain)))))

    scene = dano.Scene.create(
        [dano.Body("bunny", bunny), dano.Body("ball", dano.Sphere(0.03), mass=0.1)],
        [dano.Contact("bunny", "ball")],
        timestep=0.002,
    )
    hold = scene.control(bunny={"force": (0, 0, weight)})

    def regulator(state, time):
        turn = quat_multiply(quat_conjugate(goal.orientation[0]), state.orientation[0])
        rotation = 2 * jnp.sign(turn[0]) * turn[1:]
        error = jnp.concatenate(
            [state.position[0] - goal.position[0], rotation, state.velocity[0], state.omega[0]]
        )
        push = -gain @ error
        return dano.Control(hold.force.at[0].add(push[:3]), hold.torque.at[0].add(push[3:]))

    thrown = {"position": (0.4, 0.01, 0.42), "velocity": (-4.0, 0, 1.0)}
    start = scene.initial_state(bunny={"position": HOME}, ball=thrown)
    run = dano.simulate(scene, start, 1000, controls=regulator)
    offset = jnp.linalg.norm(run.states.position[:, 0] - goal.position, axis=1)
    return {
        "unconverged_steps": int(jnp.sum(~run.converged)),
        "largest_eigenvalue": slowest,
        "largest_offset": float(jnp.max(offset)),
        "final_offset": float(offset[-1]),
        "final_spin": float(jnp.linalg.norm(run.states.omega[-1, 0])),
    }


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for name, value in main().items():
        print(f"{name:18} {value:.6g}")
