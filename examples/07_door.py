"""A neural object on a hinge: a bar of soap, hung like a door, swings into a ball.

Run it with `python examples/07_door.py`; it prints how fast both leave and saves door.png.
"""

import jax
import jax.numpy as jnp

import dano


def main(quick: bool = False, strip: str | None = None) -> dict[str, float]:
    """Simulate 0.3 s; `strip` is a file name (.png) for pictures of the motion."""
    door = dano.Body("door", dano.load_object("soap"))
    ball = dano.Body("ball", dano.Sphere(0.02), mass=0.05)
    edge = (-0.045, 0.0, 0.0)
    hinge = dano.Joint(None, "door", "hinge", axis=(0, 0, 1), anchor=edge, position=(0.0, 0.0, 0.05))
    contact = dano.Contact("door", "ball", dano.ContactParams(sliding_friction=0.0, restitution=0.5))
    scene = dano.Scene.create([door, ball], [contact], joints=[hinge], timestep=0.002, gravity=(0, 0, 0))
    state = scene.initial_state(door={"q": -0.6, "v": 4.0}, ball={"position": (0.02, 0.055, 0.05)})
    run = dano.simulate(scene, state, n_steps=150)

    # About the hinge: the door's inertia is Jᵀ M J, the ball's momentum is m (r × v).
    jacobian = scene.frames(state).jacobian[0, :, -1]
    inertia = door.mass * jacobian[:3] @ jacobian[:3] + jacobian[3:] @ door.inertia @ jacobian[3:]
    assert run.states.v is not None
    spin, place, speed = run.states.v[:, 0], run.states.position[:, 1], run.states.velocity[:, 1]
    arm = place - jnp.array(edge)[None]
    momentum = inertia * spin + ball.mass * (arm[:, 0] * speed[:, 1] - arm[:, 1] * speed[:, 0])
    answer = {
        "unconverged_steps": int(jnp.sum(~run.converged)),
        "door_before": float(spin[0]),
        "door_after": float(spin[-1]),
        "ball_after": float(jnp.linalg.norm(speed[-1])),
        "momentum_drift": float(jnp.max(jnp.abs(momentum / momentum[0] - 1))),
        "energy_left": float(
            (inertia * spin[-1] ** 2 + ball.mass * speed[-1] @ speed[-1]) / (inertia * 16.0)
        ),
    }
    if strip is not None and not quick:
        from dano.report import render_trajectory  # needs pip install 'dano[view]'

        render_trajectory(scene, run, None, strip=strip)
    return answer


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for name, value in main(strip="door.png").items():
        print(f"{name:18} {value:.6g}")
