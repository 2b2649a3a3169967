"""What an installed wheel needs for a first rollout and its gradient: no compiler, and a few seconds."""

import resource
import sys

import jax

import dano

jax.config.update("jax_enable_x64", True)


def cpu_seconds() -> float:
    """Of this process."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


imported = cpu_seconds()
bodies = [
    dano.Body("box", dano.Box((0.05, 0.04, 0.03)), mass=1.0),
    dano.Body("floor", dano.HalfSpace(), fixed=True),
]
scene = dano.Scene.create(bodies, [dano.Contact("box", "floor")], timestep=0.005)
state = scene.initial_state(box=dict(position=(0, 0, 0.031), velocity=(0.5, 0, 0)))


def slide(friction):
    """How far the box slides [m]."""
    changed = scene.replace_contact("box", "floor", sliding_friction=friction)
    return dano.simulate(changed, state, 100).states.position[-1, 0, 0]


run = dano.simulate(scene, state, 100)
assert bool(run.converged.all())
stepped = cpu_seconds()
value, gradient = jax.value_and_grad(slide)(0.3)
# v²/(2 μ g), and its derivative.
assert abs(value - 0.25 / (0.6 * 9.81)) < 2e-3 and abs(gradient + 0.25 / (0.18 * 9.81)) < 1e-2, (
    value,
    gradient,
)
print(f"CPU seconds: imports {imported:.1f}, first rollout {stepped:.1f}, its gradient {cpu_seconds():.1f}")
if sys.platform == "linux" and "warp" in sys.modules:
    sys.exit("the wheel lacks kernels for this processor: they were compiled")
