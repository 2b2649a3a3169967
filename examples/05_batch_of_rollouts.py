"""One compiled program, many frictions: `jax.vmap` over rollouts."""

import time
from typing import Any

import jax
import jax.numpy as jnp

import dano

SPEED = 0.5


def main(quick: bool = False) -> dict[str, Any]:
    bunny = dano.load_object("bunny")
    # The paper's law: one wrench a pair is what runs fastest under vmap. Its friction moments are lengths.
    params = dano.ContactParams(sliding_drag=0.0, rolling_friction=1e-3, torsional_friction=1e-3)
    scene = dano.Scene.create(
        [dano.Body("bunny", bunny), dano.Body("floor", dano.HalfSpace(), fixed=True)],
        [dano.Contact("bunny", "floor", params, dano.CentroidLaw(smoothing=1000.0))],
        timestep=0.005,
    )
    start = scene.initial_state(bunny={"position": (0, 0, 0.0415), "velocity": (0, SPEED, 0)})
    n_steps = 100

    @jax.jit
    @jax.vmap
    def slide(friction):
        changed = scene.replace_contact("bunny", "floor", sliding_friction=friction)
        run = dano.simulate(changed, start, n_steps)
        return run.states.position[-1, 0, 1], jnp.all(run.converged)

    frictions = jnp.linspace(0.1, 0.3, 4 if quick else 64)
    distances, converged = jax.block_until_ready(slide(frictions))  # the first call compiles
    began = time.perf_counter()
    jax.block_until_ready(slide(frictions))
    seconds = time.perf_counter() - began
    return {
        "frictions": frictions.tolist(),
        "distances": distances.tolist(),
        "converged": bool(jnp.all(converged)),
        "microseconds_per_step": 1e6 * seconds / (n_steps * len(frictions)),
    }


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    answer = main()
    for friction, distance in zip(answer["frictions"][::9], answer["distances"][::9], strict=True):
        coulomb = SPEED**2 / (2 * friction * 9.81)
        print(f"friction {friction:.3f}: {1e3 * distance:6.1f} mm (Coulomb's law {1e3 * coulomb:6.1f} mm)")
    print(f"{answer['microseconds_per_step']:.1f} µs a step and rollout; converged: {answer['converged']}")
