"""How far does the bunny slide, and how does that change with friction?

The derivative comes from reverse mode, from forward mode and from a difference at a step large enough to see.
"""

import jax
import jax.numpy as jnp

import dano

SPEED, FRICTION = 0.7, 0.25


def main(quick: bool = False) -> dict[str, float]:
    bunny = dano.load_object("bunny")
    scene = dano.Scene.create(
        [dano.Body("bunny", bunny), dano.Body("floor", dano.HalfSpace(), fixed=True)],
        [dano.Contact("bunny", "floor", dano.ContactParams(sliding_friction=FRICTION))],
        timestep=0.005,
    )
    # Let it stand first: the slide then starts without a bounce.
    settled = dano.simulate(scene, scene.initial_state(bunny={"position": (0, 0, 0.0415)}), 100)
    position, orientation = settled.states.position[-1, 0], settled.states.orientation[-1, 0]
    start = scene.initial_state(
        bunny={"position": position, "orientation": orientation, "velocity": (0, SPEED, 0)}
    )

    def distance(friction):
        changed = scene.replace_contact("bunny", "floor", sliding_friction=friction)
        return dano.simulate(changed, start, 100).states.position[-1, 0, 1] - position[1]

    mu = jnp.asarray(FRICTION)
    reverse = jax.grad(distance)(mu)
    _, forward = jax.jvp(distance, (mu,), (jnp.ones_like(mu),))
    step = 1e-2
    difference = (distance(mu + step) - distance(mu - step)) / (2 * step)
    return {
        "distance": float(distance(mu)),
        "coulomb_distance": SPEED**2 / (2 * FRICTION * 9.81),
        "reverse": float(reverse),
        "forward": float(forward),
        "difference": float(difference),
        "coulomb_slope": -(SPEED**2) / (2 * FRICTION**2 * 9.81),
    }


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for name, value in main().items():
        print(f"{name:18} {value:.6g}")
