"""Good arguments, made once: each case spoils one of them."""

import functools
from importlib.resources import files
from pathlib import Path

import jax
import numpy as np

import dano
from dano.scene_file import load_scene, save_run
from dano.vision import Capture
from tests.report import made_up


def ball_values() -> np.ndarray:
    """Densities of a ball on a grid of 12³ nodes."""
    x = np.stack(np.meshgrid(*(np.arange(12) - 5.5,) * 3, indexing="ij"), axis=-1)
    return 100.0 * np.clip(4.5 - np.linalg.norm(x, axis=-1), 0, 1)


class World:
    """Small things of every kind that dano's functions take.

    Attributes:
        folder: An empty folder for files.
    """

    def __init__(self, folder: Path):
        self.folder = folder

    @functools.cached_property
    def grid(self) -> dano.GridField:
        return dano.GridField(ball_values(), (0.0, 0.0, 0.0), 0.01)

    @functools.cached_property
    def thing(self) -> dano.NeuralObject:
        return dano.NeuralObject.from_field(self.grid, n_samples=60, resolution=12, mass=0.3)

    @functools.cached_property
    def look(self) -> "dano.vision.LearnedField":  # pyright: ignore[reportAttributeAccessIssue]
        from dano.scene_file import asset_look

        return asset_look("trained_soap")

    @functools.cached_property
    def ball(self) -> dano.Body:
        return dano.Body("ball", dano.Sphere(0.1), mass=1.0)

    @functools.cached_property
    def floor(self) -> dano.Body:
        return dano.Body("floor", dano.HalfSpace(), fixed=True)

    @functools.cached_property
    def contact(self) -> dano.Contact:
        return dano.Contact("ball", "floor")

    @functools.cached_property
    def scene(self) -> dano.Scene:
        return dano.Scene.create([self.ball, self.floor], [self.contact], timestep=0.01)

    @functools.cached_property
    def state(self) -> dano.State:
        return self.scene.initial_state(ball={"position": (0.0, 0.0, 0.3)})

    @functools.cached_property
    def trajectory(self) -> dano.Trajectory:
        return dano.simulate(self.scene, self.state, 4)

    @functools.cached_property
    def motion(self) -> dano.Motion:
        return dano.Motion.from_trajectory(self.trajectory, bodies=["ball"])

    @functools.cached_property
    def parameter(self) -> dano.Parameter:
        return dano.Parameter("mu", lambda s: s.contact("ball", "floor").sliding_friction, 0.0, 1.0)

    @functools.cached_property
    def door(self) -> dano.Scene:
        return dano.Scene.create([self.ball], joints=[dano.Joint(None, "ball", "hinge")])

    @functools.cached_property
    def open_door(self) -> dano.State:
        return self.door.initial_state(ball={"q": 0.3})

    @functools.cached_property
    def arm_file(self) -> Path:
        return Path(str(files("dano") / "assets" / "arm.urdf"))

    @functools.cached_property
    def arm(self) -> dano.Robot:
        return dano.load_urdf(self.arm_file)

    @functools.cached_property
    def arm_scene(self) -> dano.Scene:
        return self.arm.scene()

    @functools.cached_property
    def arm_state(self) -> dano.State:
        return self.arm.state(self.arm_scene)

    @functools.cached_property
    def link(self) -> str:
        return next(reversed(self.arm.frames))

    @functools.cached_property
    def joint(self) -> str:
        return next(iter(self.arm.joint_names))

    @functools.cached_property
    def actuator(self) -> dano.Actuator:
        return dano.Actuator("ball", limit=1.0)

    @functools.cached_property
    def goal(self) -> dano.Goal:
        return dano.Goal("ball", position=(0.0, 0.0, 0.3))

    @functools.cached_property
    def task(self) -> dano.Task:
        return dano.Task(4, [self.actuator], [self.goal])

    @functools.cached_property
    def plan(self) -> dano.Plan:
        return made_up.plan(self.task, self.trajectory)

    @functools.cached_property
    def fit(self) -> dano.Identification:
        return made_up.fit(self.scene, self.state, self.motion)

    @functools.cached_property
    def capture(self) -> Capture:
        return made_up.photographs()

    @functools.cached_property
    def key(self) -> jax.Array:
        return jax.random.key(0)

    def saved(self, name: str) -> Path:
        """A good file, written when it is asked for."""
        path = self.folder / name
        if not path.exists():
            write = {
                "field.npz": lambda: dano.save_field(self.grid, path),
                "thing.dano": lambda: self.thing.save(path),
                "run.npz": lambda: self.trajectory.save(path),
                "scene_run.npz": lambda: save_run(
                    path, self.trajectory, load_scene(self.saved("scene.toml"))
                ),
                "motion.npz": lambda: dano.save_motion(path, self.motion),
                "scene.toml": lambda: path.write_text(SCENE, encoding="utf-8"),
            }
            write[name]()
        return path


SCENE = """
timestep = 0.01
n_steps = 4

[[bodies]]
name = "ball"
shape = "sphere"
radius = 0.1
mass = 1.0
position = [0.0, 0.0, 0.3]

[[bodies]]
name = "floor"
shape = "half_space"
fixed = true

[[contacts]]
a = "ball"
b = "floor"
"""
