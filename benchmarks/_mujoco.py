"""Scenes in MuJoCo's own loop, for what it does and what a step of it costs."""

from collections.abc import Mapping
from typing import Any

import numpy as np

import dano


def at_defaults(**changes: Any) -> dict[str, Any]:
    """Options with which `MuJoCoEngine` is at all of MuJoCo's defaults, but for some."""
    import mujoco

    defaults = {
        "cone": mujoco.mjtCone.mjCONE_PYRAMIDAL,
        "impratio": 1.0,
        "integrator": mujoco.mjtIntegrator.mjINT_EULER,
    }
    return {**defaults, **changes}


class World:
    """A scene as MuJoCo's model."""

    def __init__(self, scene: dano.Scene, *, objects: str = "samples", options: Mapping[str, Any]):
        """Compile it; see `dano.mujoco.MuJoCoEngine`."""
        from dano.mujoco import MuJoCoEngine

        self.scene = scene
        self.engine = MuJoCoEngine(scene, objects=objects, options=options)

    def data(self, **starts: dict[str, Any]):
        """MuJoCo's data at a state, by `Scene.initial_state`."""
        return self.engine.data(self.scene, self.scene.initial_state(**starts))

    def play(self, seconds: float, **starts: dict[str, Any]) -> np.ndarray:
        """Poses of the bodies that move over time [m, W; wxyz], shape (t, n, 7), from a state."""
        import mujoco

        model, data = self.engine.model, self.data(**starts)
        poses = [data.qpos.copy()]
        with self.engine.bridge:
            for _ in range(round(seconds / model.opt.timestep)):
                mujoco.mj_step(model, data)
                poses.append(data.qpos.copy())
        return np.array(poses).reshape(len(poses), -1, 7)
