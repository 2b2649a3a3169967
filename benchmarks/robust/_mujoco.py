"""The same scenes in MuJoCo, at its default options but for the integrator.

That is "implicit", for with the default one bodies that tumble fast in free flight gain energy without limit.

Shapes are MuJoCo's own, without rounding; of objects it has the hulls, as it takes meshes. Its contact is the
default one, whatever the restitution.
"""

import time
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import dano
from benchmarks._mujoco import at_defaults, World
from benchmarks.robust._draw import Start, Structure
from benchmarks.robust._judge import Motion


@dataclass(frozen=True)
class Played:
    """A motion, the warnings that MuJoCo counted, and the CPU time [s]."""

    motion: Motion
    warnings: int
    seconds: float


def world_of(structure: Structure, scene: dano.Scene) -> World:
    """The shapes of a scene, compiled."""
    import mujoco

    # They are counted below; MuJoCo would also write each to the terminal and to a file.
    mujoco.set_mju_user_warning(lambda _: None)
    options = at_defaults(integrator=mujoco.mjtIntegrator.mjINT_IMPLICIT)
    return World(_plain(structure, scene), objects="hull", options=options)


def _plain(structure: Structure, scene: dano.Scene) -> dano.Scene:
    """The scene with sharp boxes and without restitution."""
    rounded = [i for i, piece in enumerate(structure.pieces) if piece.kind == "rounded box"]

    def changed(scene):
        return [scene.bodies[i].shape.rounding for i in rounded] + [
            contact.params.restitution for contact in scene.contacts
        ]

    return eqx.tree_at(changed, scene, [jnp.zeros_like(x) for x in changed(scene)])


def play(
    world: World, structure: Structure, scene: dano.Scene, start: Start, inertia: np.ndarray, n_steps: int
) -> Played:
    """Simulate a scene with the world's shapes and keep all states."""
    import mujoco

    model, n = world.engine.model, len(structure.pieces)
    world.scene = _plain(structure, scene)
    names = ("position", "orientation", "velocity", "omega")
    places = {
        piece.name: {name: getattr(start, name)[i] for name in names}
        for i, piece in enumerate(structure.pieces)
    }
    data = world.data(
        **places, **{wall.name: {"position": np.array(wall.centre)} for wall in structure.walls}
    )
    poses, speeds = [data.qpos.copy()], [data.qvel.copy()]
    seconds = 0.0
    for _ in range(n_steps):
        before = time.process_time()
        mujoco.mj_step(model, data)
        seconds += time.process_time() - before
        poses.append(data.qpos.copy())
        speeds.append(data.qvel.copy())
    pose, twist = np.array(poses).reshape(-1, n, 7), np.array(speeds).reshape(-1, n, 6)
    motion = Motion(pose[..., :3], pose[..., 3:], twist[..., :3], twist[..., 3:], inertia)
    return Played(motion, int(sum(warning.number for warning in data.warning)), seconds)
