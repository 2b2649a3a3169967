"""Programs as a stranger writes them."""

from pathlib import Path

import numpy as np

MEASURED = "measured:"
"""Begins a line of what a program measures itself: a name, and seconds of processors."""

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

BUNNY = """
timestep = 0.01
duration = 1.5

[[bodies]]
name = "bunny"
object = "bunny"
position = [0.0, 0.0, 0.3]
omega = [1.0, 2.0, 0.0]

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
import time

print(dano.simulate(scene, state, n_steps=100).states.position[-1])
began = time.process_time()
print(dano.simulate(scene, state, n_steps=90).states.position[-1])
print("{MEASURED} another number of steps", time.process_time() - began)
"""

GRADIENT = f"""{_FALL}
def way(friction):
    changed = scene.replace_contact("box", "floor", sliding_friction=friction)
    return dano.simulate(changed, state, n_steps=100).states.position[-1, 0, 0]

print(jax.grad(way)(0.3))
"""

MUG = """
timestep = 0.005
duration = 1.5

[[bodies]]
name = "mug"
object = "mug.stl"
mass = 0.3
position = [0.0, 0.0, 0.15]
orientation = [0.9, 0.3, 0.2, 0.0]

[[bodies]]
name = "table"
shape = "half_space"
fixed = true
"""

PANDA = """
from importlib.util import find_spec
from pathlib import Path
import jax, jax.numpy as jnp, numpy as np, dano

jax.config.update("jax_enable_x64", True)
package = Path(find_spec("frax").origin).parent
robot = dano.load_urdf(package / "assets/franka_panda/bubblify/panda_spherized.urdf")
box = dano.Body("box", dano.Box((0.05, 0.05, 0.05)), mass=0.5)
table = dano.Body("table", dano.HalfSpace(), fixed=True)
contacts = [dano.Contact("box", "table"), *robot.contacts_with(box)]
scene = robot.scene(bodies=[box, table], contacts=contacts, timestep=0.002)
names = list(robot.joint_names)
home = np.array([0.0, 0.6, 0.0, -2.0, 0.0, 2.6, 0.8, 0.02, 0.02])[: len(names)]
state = robot.state(scene, dict(zip(names, home)), box=dict(position=(0.65, 0, 0.05)))
print(robot.place(scene, state, "panda_hand")[0], np.diag(dano.mass_matrix(scene, state)))

def torques(state, time):
    goal = jnp.asarray(home).at[1].add(0.3 * time)
    holding = dano.gravity_forces(scene, state)[-len(names):]
    return dano.joint_control(scene, 300 * (goal - state.q) - 30 * state.v + holding)

print(dano.simulate(scene, state, 750, controls=torques).states.position[-1, -2])
"""

MJCF = """
import mujoco
from dano.mujoco import Bridge

spec = mujoco.MjSpec.from_string('''
<mujoco><option timestep="0.002"/><worldbody>
  <geom type="plane" size="1 1 0.1"/>
  <body name="mug" pos="0 0 0.1"><freejoint/></body>
</worldbody></mujoco>''')
bridge = Bridge(spec)
bridge.attach("mug", "mug.stl", look=False)
model = bridge.compile()
data = mujoco.MjData(model)
with bridge:
    mujoco.mj_step(model, data, 500)
print(data.body("mug").xpos)
"""

FILM = """
from pathlib import Path
import jax
jax.config.update("jax_enable_x64", True)
from dano.report import render_trajectory, VideoOptions
from dano.scene_file import load_run

run = load_run(Path("run.npz"))
render_trajectory(run.source.scene, run.trajectory, "run.mp4", options=VideoOptions(size=(640, 480)))
"""


def write_files(folder: Path) -> None:
    """What programs read: scenes, and a mug of trimesh."""
    import trimesh

    (folder / "scene.toml").write_text(SCENE)
    (folder / "mug.toml").write_text(MUG)
    (folder / "bunny.toml").write_text(BUNNY)
    wall = trimesh.creation.annulus(r_min=0.036, r_max=0.04, height=0.1)
    floor = trimesh.creation.cylinder(radius=0.038, height=0.006)
    floor.apply_translation((0, 0, -0.047))
    handle = trimesh.creation.torus(major_radius=0.025, minor_radius=0.006)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    handle.apply_translation((0.055, 0, 0))
    trimesh.util.concatenate([wall, floor, handle]).export(folder / "mug.stl")
