"""Programs as a stranger writes them."""

SCENE = """
timestep = 0.01
duration = 1.2

[[bodies]]
name = "box"
shape = "box"
half_extents = [0.1, 0.1, 0.1]
mass = 1.0
position = [0.0, 0.0, 0.5]
orientation = [0.9, 0.3, 0.2, 0.0]

[[bodies]]
name = "floor"
shape = "half_space"
fixed = true
"""

_FALL = """
import jax, dano

jax.config.update("jax_enable_x64", True)
bodies = [
    dano.Body("box", dano.Box((0.1, 0.1, 0.1)), mass=1.0),
    dano.Body("floor", dano.HalfSpace(), fixed=True),
]
scene = dano.Scene.create(bodies, [dano.Contact("box", "floor")], timestep=0.01)
state = scene.initial_state(box=dict(position=(0, 0, 0.5), velocity=(1.0, 0, 0)))
"""

SMALL = f"""{_FALL}
print(dano.simulate(scene, state, n_steps=100).states.position[-1])
"""

GRADIENT = f"""{_FALL}
def way(friction):
    changed = scene.replace_contact("box", "floor", sliding_friction=friction)
    return dano.simulate(changed, state, n_steps=100).states.position[-1, 0, 0]

print(jax.grad(way)(0.3))
"""

FILM = """
from pathlib import Path
import jax
jax.config.update("jax_enable_x64", True)
from dano.report import render_trajectory, VideoOptions
from dano.scene_file import load_run

run = load_run(Path("run.npz"))
options = VideoOptions(fps=100, size=(1280, 720))
render_trajectory(run.source.scene, run.trajectory, "run.mp4", options=options)
"""
