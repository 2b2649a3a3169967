"""Renders films of known motions: the painted bunny and the soap slide and tumble on a patterned table.

Path tracing by Mitsuba 3 (`pip install mitsuba mujoco trimesh libigl opencv-python-headless pillow av`), in
sunlight and a sky that the photographs in `images/` do not have. Slides are closed forms,
x = v t − ½ μ g t²; what tumbles is moved by MuJoCo, as the convex hull of its mesh. Each film gets a folder
with `frames/`, `masks/` (the object's true silhouettes), `film.mp4`, `empty.png` (the table without the
object) and `truth.json`: the camera in nerfstudio's convention, and times [s], positions [m] and orientations
(wxyz) of the object's frame.
Nothing of it is shipped: it is what `dano track` is measured with.

Usage: python assets/render_videos.py FOLDER [soap_slide bunny_slide soap_tumble bunny_tumble] [--paths 24]
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from render_images import camera_to_world, painted_file, srgb
from render_table import TABLE_SIDE, tabletop, write
from solids import bunny_mesh, Mesh, soap_mesh

WIDTH, HEIGHT, FOCAL = 400, 300, 420.0  # [pixels]
EYE, TARGET = np.array([0.14, -0.42, 0.30]), np.array([0.0, 0.0, 0.03])  # [m]
RATE, FRAMES = 60.0, 24  # [frames/s]
GRAVITY = 9.81  # [m/s²]
LIGHT = np.array([-0.5, -0.35, 0.79])  # towards the sun

Motion = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Film:
    """What is filmed.

    Attributes:
        mesh: Of the object, in its own frame.
        medium: Whether it scatters within, as the soap does.
        friction: Of the table.
        moved: Times → positions [m] and orientations of the object's frame.
    """

    mesh: Callable[[], Mesh]
    medium: bool
    friction: float
    moved: Callable[["Film", np.ndarray], Motion]


def main() -> None:
    """Render the films asked for."""
    parser = argparse.ArgumentParser(description="Render films of known motions.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("films", nargs="*", default=list(FILMS))
    parser.add_argument("--paths", type=int, default=24, help="paths per pixel")
    arguments = parser.parse_args()
    import mitsuba as mi  # pyright: ignore[reportMissingImports]

    mi.set_variant("scalar_rgb")
    for name in arguments.films:
        render(mi, FILMS[name], arguments.folder / name, arguments.paths)


def slide(distance: float, turn: float, height: float) -> Callable[[Film, np.ndarray], Motion]:
    """A flat slide that comes to rest after a distance [m], symmetric about the middle of the picture."""

    def moved(film: Film, times: np.ndarray) -> Motion:
        speed = np.sqrt(2 * film.friction * GRAVITY * distance)
        t = np.minimum(times, speed / (film.friction * GRAVITY))
        along = speed * t - 0.5 * film.friction * GRAVITY * t**2 - 0.5 * distance
        direction = np.array([0.94, 0.34, 0.0]) / np.hypot(0.94, 0.34)
        position = along[:, None] * direction + np.array([0.0, 0.0, height])
        orientation = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
        return position, np.tile(orientation, (len(times), 1))

    return moved


def tumble(start: tuple[float, ...], velocity: tuple[float, ...]) -> Callable[[Film, np.ndarray], Motion]:
    """A toss onto the table, by MuJoCo, of the convex hull."""

    def moved(film: Film, times: np.ndarray) -> Motion:
        import mujoco  # pyright: ignore[reportMissingImports]

        vertices, _ = film.mesh()
        points = " ".join(f"{x:.6f}" for x in vertices[::7].ravel())
        model = mujoco.MjModel.from_xml_string(f"""
<mujoco><option timestep="0.0005" cone="elliptic" impratio="10" gravity="0 0 {-GRAVITY}"/>
<asset><mesh name="hull" vertex="{points}"/></asset>
<worldbody><geom type="plane" size="1 1 1" friction="{film.friction} 0 0" condim="3"/>
<body name="object"><freejoint/><geom type="mesh" mesh="hull" density="800" friction="{film.friction} 0 0"
condim="3"/></body></worldbody></mujoco>""")
        data = mujoco.MjData(model)
        data.qpos[:] = start
        data.qpos[3:] /= np.linalg.norm(data.qpos[3:])
        data.qvel[:] = velocity
        positions, orientations = [], []
        for time in times:
            while data.time < time - 1e-9:
                mujoco.mj_step(model, data)
            positions.append(data.qpos[:3].copy())
            orientations.append(data.qpos[3:].copy())
        return np.array(positions), np.array(orientations)

    return moved


FILMS = {
    "soap_slide": Film(soap_mesh, True, 0.35, slide(0.20, 0.35, 0.0151)),
    "bunny_slide": Film(bunny_mesh, False, 0.25, slide(0.18, -0.6, 0.0)),
    "soap_tumble": Film(
        soap_mesh, True, 0.35, tumble((-0.09, -0.03, 0.10, 0.9, 0.5, 0.2, 0.3), (0.45, 0.1, 0.2, 5, 9, 3))
    ),
    "bunny_tumble": Film(
        bunny_mesh, False, 0.4, tumble((-0.09, 0.0, 0.07, 0.8, 0.4, -0.3, 0.2), (0.4, 0.05, 0.3, 4, 7, -3))
    ),
}


def render(mi, film: Film, folder: Path, paths: int) -> None:
    """Render one film."""
    for name in ("frames", "masks"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    times = np.arange(FRAMES) / RATE
    positions, orientations = film.moved(film, times)
    mesh = painted_file(*film.mesh(), folder / "mesh.ply")
    sensor = camera(mi)
    empty = mi.load_dict(scene(mi, None, film.medium, np.eye(4), table=True))
    write(folder / "empty.png", srgb(np.array(mi.render(empty, sensor=sensor, spp=4 * paths))[..., :3]))
    for i in range(FRAMES):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = matrix(orientations[i]), positions[i]
        whole = mi.load_dict(scene(mi, mesh, film.medium, pose, table=True))
        alone = mi.load_dict(scene(mi, mesh, False, pose, table=False))
        colours = np.array(mi.render(whole, sensor=sensor, spp=paths, seed=i))[..., :3]
        cover = np.array(mi.render(alone, sensor=sensor, spp=16, seed=i))[..., 3]
        write(folder / "frames" / f"{i:03d}.png", srgb(colours))
        write(folder / "masks" / f"{i:03d}.png", np.clip(cover, 0, 1))
        print(f"{folder.name}: {i + 1} of {FRAMES}", flush=True)
    mesh.unlink()
    encode(folder)
    truth = {
        **{"camera_model": "OPENCV", "w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL},
        **{"cx": WIDTH / 2, "cy": HEIGHT / 2, "units": "m", "friction": film.friction, "rate": RATE},
        "transform_matrix": np.round(camera_to_world(EYE, TARGET), 9).tolist(),
        "times": times.tolist(),
        "position": np.round(positions, 8).tolist(),
        "orientation": np.round(orientations, 8).tolist(),
    }
    (folder / "truth.json").write_text(json.dumps(truth) + "\n", encoding="utf-8")


def matrix(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrix of a unit quaternion wxyz."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def camera(mi):
    """The camera, which stands still."""
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}}
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(0.5 * WIDTH / FOCAL))),
            "fov_axis": "x",
            "to_world": mi.ScalarTransform4f().look_at(list(EYE), list(TARGET), [0, 0, 1]),
            "near_clip": 0.01,
            "film": film | {"pixel_format": "rgba"},
        }
    )


def scene(mi, mesh: Path | None, medium: bool, pose: np.ndarray, *, table: bool) -> dict:
    """The object under sun and sky, on the table or alone."""
    light = LIGHT / np.linalg.norm(LIGHT)
    content = {
        "type": "scene",
        "integrator": {
            "type": "volpath" if medium else "path",
            "max_depth": 48 if medium else 6,
            "hide_emitters": True,
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.36, 0.38, 0.41]}},
        "sun": {
            "type": "directional",
            "direction": (-light).tolist(),
            "irradiance": {"type": "rgb", "value": [1.9, 1.82, 1.7]},
        },
    }
    if mesh is not None:
        content["object"] = {
            "type": "ply",
            "filename": str(mesh),
            "to_world": mi.ScalarTransform4f(pose),
            **(_scattering() if medium else _painted()),
        }
    if table:
        # The first row of a bitmap lies at v = 0, the lowest y.
        paint = mi.Bitmap((255 * tabletop()[::-1] + 0.5).astype(np.uint8))
        content["table"] = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().scale(0.5 * TABLE_SIDE),
            "bsdf": {
                "type": "diffuse",
                "reflectance": {"type": "bitmap", "bitmap": paint, "wrap_mode": "clamp"},
            },
        }
    return content


def _painted() -> dict:
    """As in the photographs of `render_images`."""
    colour = {"type": "mesh_attribute", "name": "vertex_color"}
    return {"bsdf": {"type": "principled", "base_color": colour, "roughness": 0.5, "specular": 0.4}}


def _scattering() -> dict:
    """As in the photographs of `render_images`."""
    return {
        "bsdf": {"type": "null"},
        "interior": {
            "type": "homogeneous",
            "sigma_t": 320.0,  # [1/m]
            "albedo": {"type": "rgb", "value": [0.80, 0.945, 0.985]},
            "phase": {"type": "hg", "g": 0.3},
        },
    }


def encode(folder: Path) -> None:
    """Put the frames into a film, at a quality at which compression is not seen."""
    import av
    from PIL import Image

    with av.open(str(folder / "film.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=round(RATE))
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.options = {"crf": "14"}
        for file in sorted((folder / "frames").glob("*.png")):
            with Image.open(file) as picture:
                frame = av.VideoFrame.from_ndarray(np.asarray(picture.convert("RGB")), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


if __name__ == "__main__":
    main()
