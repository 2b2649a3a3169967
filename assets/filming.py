"""Frames of runs and what is written of them: animated WebP within a number of bytes."""

import io
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import av
import jax
import mujoco
import numpy as np
from jax.core import Tracer
from PIL import Image

import dano
from dano.report import render_trajectory, VideoOptions
from dano.vision import LearnedField

MOST_BYTES = 300_000
"""Of a picture of the documentation."""

FPS = 12
SIZE = (640, 360)
SKY = (236, 238, 240)

Frames = list[np.ndarray]


@contextmanager
def recorded() -> Iterator[list[tuple[dano.Scene, dano.Trajectory]]]:
    """Collects what `dano.simulate` returns while the block runs, except inside of JAX transformations."""
    runs: list[tuple[dano.Scene, dano.Trajectory]] = []
    simulate = dano.simulate

    def recording(scene: dano.Scene, *args: Any, **kwargs: Any) -> dano.Trajectory:
        run = simulate(scene, *args, **kwargs)
        if not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((scene, run))):
            runs.append((scene, run))
        return run

    dano.simulate = recording
    try:
        yield runs
    finally:
        dano.simulate = simulate


@contextmanager
def recorded_in_mujoco() -> Iterator[list[tuple[mujoco.MjModel, np.ndarray]]]:
    """Collects the model and the coordinates of every step of `mujoco.mj_step` while the block runs."""
    steps: list[tuple[mujoco.MjModel, np.ndarray]] = []
    step = mujoco.mj_step

    def recording(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        steps.append((model, data.qpos.copy()))
        step(model, data)

    mujoco.mj_step = recording
    try:
        yield steps
    finally:
        mujoco.mj_step = step


def frames_of(
    scene: dano.Scene,
    run: dano.Trajectory,
    slow_motion: float = 1.0,
    looks: Mapping[str, LearnedField] | None = None,
    **style: Any,
) -> Frames:
    """Frames of a run as `render_trajectory` draws them; `style` are more fields of its options."""
    options = VideoOptions(fps=FPS, slow_motion=slow_motion, **{"size": SIZE, "clock": False, **style})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        render_trajectory(scene, run, path, looks=looks, options=options)
        return read_film(path)


def read_film(path: Path) -> Frames:
    """The frames of an MP4 file."""
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def frames_in_mujoco(
    model: mujoco.MjModel, coordinates: Sequence[np.ndarray], look_at: Sequence[float], away: Sequence[float]
) -> Frames:
    """Frames that MuJoCo draws.

    Args:
        model: The model.
        coordinates: `qpos` of each step, some of which are drawn.
        look_at: Point in the middle of the picture [m, W].
        away: Distance [m], azimuth and elevation [degrees] of the camera.
    """
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    camera.lookat[:] = look_at
    camera.distance, camera.azimuth, camera.elevation = away
    every = max(1, round(1 / (FPS * model.opt.timestep)))
    frames = []
    for qpos in coordinates[::every]:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        frames.append(picture_in_mujoco(model, data, camera))
    return frames


def picture_in_mujoco(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    camera: mujoco.MjvCamera,
    size: tuple[int, int] = SIZE,
    option: mujoco.MjvOption | None = None,
) -> np.ndarray:
    """What MuJoCo draws, with a bright floor and sky, and with a lamp if the model has none."""
    planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    model.geom_matid[planes] = -1
    model.geom_rgba[planes] = [0.86, 0.87, 0.88, 1]
    model.geom_size[planes, :2] = 12.0  # so that no edge is near
    model.vis.headlight.ambient[:] = 0.35
    model.vis.headlight.diffuse[:] = 0.25
    with mujoco.Renderer(model, size[1], size[0]) as renderer:
        renderer.update_scene(data, camera, option)
        if model.nlight == 0:
            _add_lamp(renderer.scene, camera.lookat)
        picture = renderer.render().copy()
        renderer.enable_depth_rendering()
        nothing = renderer.render() > 0.95 * model.vis.map.zfar * model.stat.extent
    picture[nothing] = SKY
    return picture


def _add_lamp(scene: mujoco.MjvScene, where: np.ndarray) -> None:
    """A lamp above a point, which casts shadows."""
    lamp = scene.lights[scene.nlight]
    scene.nlight += 1
    lamp.type = mujoco.mjtLightType.mjLIGHT_SPOT
    lamp.cutoff, lamp.exponent = 60, 1
    lamp.attenuation[:] = 1, 0, 0
    lamp.pos[:] = where + np.array([-0.6, -0.8, 2.0])
    lamp.dir[:] = np.array([0.3, 0.4, -1.0]) / np.linalg.norm([0.3, 0.4, -1.0])
    lamp.ambient[:], lamp.diffuse[:], lamp.specular[:] = 0.0, 0.7, 0.1
    lamp.headlight, lamp.castshadow = 0, 1


def write_webp(path: Path, frames: Sequence[np.ndarray], fps: int = FPS) -> None:
    """Write a picture, or a film of several frames that repeats, of at most `MOST_BYTES`."""
    pictures = [Image.fromarray(frame) for frame in frames]
    for quality in (84, 76, 68, 60, 50, 40, 30):
        data = io.BytesIO()
        # The last frame stays for a second before the film begins again.
        durations = [round(1000 / fps)] * (len(pictures) - 1) + [1000]
        options: dict[str, Any] = dict(save_all=True, append_images=pictures[1:], duration=durations, loop=0)
        pictures[0].save(data, "WEBP", quality=quality, method=4, **(options if len(pictures) > 1 else {}))
        if data.tell() <= MOST_BYTES:
            break
    else:
        raise ValueError(f"{path} must have at most {MOST_BYTES} bytes, got {data.tell()}: fewer frames")
    path.write_bytes(data.getvalue())
    print(f"{path}: {len(frames)} frames, {data.tell() / 1e3:.0f} kB, quality {quality}", flush=True)
