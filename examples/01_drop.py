"""Drop the shipped bunny on a floor, until the floor carries its weight.

Run it with `python examples/01_drop.py`; it prints how the bunny came to rest and saves drop.png.
"""

import jax
import jax.numpy as jnp

import dano


def main(quick: bool = False, strip: str | None = None) -> dict[str, float]:
    """Simulate 1.2 s; `strip` is a file name (.png) for pictures of the motion."""
    bunny = dano.load_object("bunny")  # 12 cm, 1 kg, from a density grid with a hollow core and floaters
    params = dano.ContactParams(sliding_friction=0.3, restitution=0.3)
    scene = dano.Scene.create(
        [dano.Body("bunny", bunny), dano.Body("floor", dano.HalfSpace(), fixed=True)],
        [dano.Contact("bunny", "floor", params)],
        timestep=0.002,
    )
    start = scene.initial_state(
        bunny={"position": (0, 0, 0.12), "orientation": (1, 0.2, 0.1, 0), "velocity": (0.2, 0, 0)}
    )
    run = dano.simulate(scene, start, 600)

    force = dano.contact_wrenches(scene, run.states)[:, 0, 2]
    last = slice(-100, None)  # 0.2 s
    answer = {
        "unconverged_steps": int(jnp.sum(~run.converged)),
        "height": float(run.states.position[-1, 0, 2]),
        "speed": float(jnp.linalg.norm(run.states.velocity[-1, 0])),
        "carried_weight": float(jnp.mean(force[last]) / (bunny.mass.mass * 9.81)),
        "largest_force": float(jnp.max(force)),
    }
    if strip is not None and not quick:
        from dano.report import render_trajectory  # needs pip install 'dano[view]'

        render_trajectory(scene, run, None, strip=strip)
    return answer


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for name, value in main(strip="drop.png").items():
        print(f"{name:18} {value:.6g}")
