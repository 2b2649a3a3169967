"""Two bunnies collide in free space: what one gains the other loses."""

import jax
import jax.numpy as jnp

import dano
from dano.maths import quat_rotate


def angular_momentum(scene: dano.Scene, states: dano.State):
    """Total angular momentum about the world's origin [kg m²/s, W] of each state, as the integrator has it.

    A body's spin is (h/2)(s Jω − ω × Jω), s = √(4/h² − |ω|²): Jω up to a term of the size of the timestep.
    """
    h = scene.timestep
    mass = jnp.stack([body.mass for body in scene.bodies])[None, :, None]
    inertia = jnp.stack([body.inertia for body in scene.bodies])
    omega = states.omega
    j_omega = jnp.einsum("nij,tnj->tni", inertia, omega)
    s = jnp.sqrt(4 / h**2 - jnp.sum(omega**2, axis=-1, keepdims=True))
    spin = quat_rotate(states.orientation, 0.5 * h * (s * j_omega - jnp.cross(omega, j_omega)))
    return jnp.sum(spin + jnp.cross(states.position, mass * states.velocity), axis=1)


def main(quick: bool = False) -> dict[str, float]:
    bunny = dano.load_object("bunny")
    scene = dano.Scene.create(
        [dano.Body("left", bunny), dano.Body("right", bunny, mass=2.0)],
        [dano.Contact("left", "right", dano.ContactParams(sliding_friction=0.3))],
        timestep=0.002,
        gravity=(0.0, 0.0, 0.0),
    )
    half_turn = (0, 0, 0, 1)
    start = scene.initial_state(
        left={"position": (-0.08, 0.01, 0), "velocity": (1.0, 0, 0), "omega": (0, 0, 1.0)},
        right={"position": (0.08, -0.01, 0.005), "velocity": (-0.4, 0, 0), "orientation": half_turn},
    )
    run = dano.simulate(scene, start, 60 if quick else 150)

    linear = sum(body.mass * run.states.velocity[:, i] for i, body in enumerate(scene.bodies))
    angular = angular_momentum(scene, run.states)
    exchanged = scene.bodies[0].mass * jnp.linalg.norm(run.states.velocity[-1, 0] - run.states.velocity[0, 0])
    return {
        "unconverged_steps": int(jnp.sum(~run.converged)),
        "exchanged_momentum": float(exchanged),
        "linear_drift": float(jnp.max(jnp.ptp(linear, axis=0))),
        "angular_drift": float(jnp.max(jnp.ptp(angular, axis=0))),
        "steps_in_contact": int(jnp.sum(dano.contact_patches(scene, run.states)[0].overlap > 0)),
    }


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for name, value in main().items():
        print(f"{name:18} {value:.6g}")
