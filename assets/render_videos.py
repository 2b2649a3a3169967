"""Renders films of known motions: the painted bunny and the soap slide, tumble and are pushed on a table.

Path tracing by Mitsuba 3 (`pip install mitsuba mujoco trimesh libigl opencv-python-headless pillow av`), in
sunlight and a sky that the photographs in `images/` do not have. Slides are closed forms,
x = v t − ½ μ g t²; what tumbles or is pushed is moved by MuJoCo, as the convex hull of its mesh. Each film
gets a folder with `frames/`, `masks/` (the object's true silhouettes), `film.mp4`, `empty.png` (the table
without the object) and `truth.json`: the camera in nerfstudio's convention, and times [s], positions [m] and
orientations (wxyz) of the object's frame, friction, centre of mass, and the direction of the sun.

`bunny_loaded` is a toss of a bunny whose centre of mass was moved by 5 % of its size. `bunny_hard` and
`soap_hard` are slides made hard on purpose: blur of motion, noise, exposure that falls by a third, and a hand
that passes in front (`occluders/`). Times are those of the middle of the exposure.
`dano track` is measured with them; the slide of the soap is shipped for `dano demo soap`.

Usage: python assets/render_videos.py FOLDER [FILM ...] [--paths 24]
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from render_images import camera_to_world, painted_file, srgb
from render_table import pinhole, TABLE_SIDE, tabletop, write
from solids import bunny_mesh, Mesh, soap_mesh

WIDTH, HEIGHT, FOCAL = 400, 300, 420.0  # [pixels]
EYE, TARGET = np.array([0.14, -0.42, 0.30]), np.array([0.0, 0.0, 0.03])  # [m]
RATE, FRAMES = 60.0, 24  # [frames/s]
STEP = 1e-4  # [s]; contact is eight steps wide: what is in the table would be hidden by it
GRAVITY = 9.81  # [m/s²]
LIGHT = np.array([-0.5, -0.35, 0.79])  # towards the sun
BLOCK = (0.03, 0.05, 0.025)  # half sides of what pushes [m]
SHUTTER, BLURRED = 1 / 120, 5  # exposure of the hard films [s], moments that it is made of
NOISE, DARKER = 0.02, 0.33  # of sRGB; share of the light lost at the end

Motion = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Film:
    """What is filmed.

    Attributes:
        mesh: Of the object, in its own frame.
        medium: Whether it scatters within, as the soap does.
        friction: Of the table.
        moved: Times → positions [m] and orientations of the object's frame, and what else is known.
        hard: Whether it is blurred, noisy, darker and darker, and something passes in front.
        pusher: Times → middle of a block that pushes [m], or None.
    """

    mesh: Callable[[], Mesh]
    medium: bool
    friction: float
    moved: Callable[["Film", np.ndarray], tuple[Motion, dict]]
    hard: bool = False
    pusher: Callable[[np.ndarray], np.ndarray] | None = None


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


def slide(distance: float, turn: float, height: float) -> Callable[[Film, np.ndarray], tuple[Motion, dict]]:
    """A flat slide that comes to rest after a distance [m], symmetric about the middle of the picture."""

    def moved(film: Film, times: np.ndarray) -> tuple[Motion, dict]:
        speed = np.sqrt(2 * film.friction * GRAVITY * distance)
        t = np.minimum(times, speed / (film.friction * GRAVITY))
        along = speed * t - 0.5 * film.friction * GRAVITY * t**2 - 0.5 * distance
        direction = np.array([0.94, 0.34, 0.0]) / np.hypot(0.94, 0.34)
        position = along[:, None] * direction + np.array([0.0, 0.0, height])
        orientation = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
        return (position, np.tile(orientation, (len(times), 1))), {}

    return moved


def tumble(
    start: tuple[float, ...],
    velocity: tuple[float, ...],
    *,
    moved_by: tuple[float, float, float] = (0.0, 0.0, 0.0),
    pusher: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Callable[[Film, np.ndarray], tuple[Motion, dict]]:
    """What the convex hull does by MuJoCo, its centre of mass moved [m, object's frame].

    Also tells the centre of mass, and how many frames pass before anything is touched.
    """

    def moved(film: Film, times: np.ndarray) -> tuple[Motion, dict]:
        import mujoco  # pyright: ignore[reportMissingImports]

        vertices, _ = film.mesh()
        hull = trimesh.PointCloud(vertices).convex_hull.vertices
        points = " ".join(f"{x:.6f}" for x in hull.ravel())
        spec = mujoco.MjSpec.from_string(f"""
<mujoco><option timestep="{STEP}" cone="elliptic" impratio="10" gravity="0 0 {-GRAVITY}"/>
<default><geom solref="{8 * STEP} 1" solimp="0.99 0.999 0.0001"/></default>
<asset><mesh name="hull" vertex="{points}"/></asset>
<worldbody><geom type="plane" size="1 1 1" friction="{film.friction} 0 0" condim="3"/>
<body name="pusher" mocap="true" pos="0 0 -1"><geom type="box" size="{" ".join(map(str, BLOCK))}" condim="1"/>
</body><body name="object"><freejoint/><geom type="mesh" mesh="hull" density="800"
friction="{film.friction} 0 0" condim="3"/></body></worldbody></mujoco>""")
        whole = spec.compile()
        body = spec.body("object")
        body.explicitinertial = True
        body.mass, body.ipos = whole.body("object").mass[0], whole.body("object").ipos + moved_by
        body.iquat, body.inertia = whole.body("object").iquat, whole.body("object").inertia
        model = spec.compile()
        data = mujoco.MjData(model)
        data.qpos[:] = start
        data.qpos[3:] /= np.linalg.norm(data.qpos[3:])
        data.qvel[:] = velocity
        positions, orientations, airborne, touched = [], [], 0, False
        for time in times:
            while data.time < time - 1e-9:
                if pusher is not None:
                    data.mocap_pos[0] = pusher(np.array([data.time]))[0]
                mujoco.mj_step(model, data)
                touched |= data.ncon > 0
            positions.append(data.qpos[:3].copy())
            orientations.append(data.qpos[3:].copy())
            airborne += not touched
        known = {"com": np.round(body.ipos, 8).tolist(), "airborne": airborne}
        return (np.array(positions), np.array(orientations)), known

    return moved


def push(times: np.ndarray) -> np.ndarray:
    """The middle of a block that pushes at constant speed and then stops."""
    x = -0.205 + 0.6 * np.minimum(times, 0.22)
    return np.stack([x, np.full_like(x, 0.005), np.full_like(x, BLOCK[2])], axis=1)


# It turns by more than once before it lands. After half a turn the circle of the centre of mass cannot be
# told from another velocity: with poses within 0.5 mm it is known to 3.3 mm then, here to 0.7 mm.
_LOADED = tumble(
    (-0.10, -0.05, 0.085, 0.8, 0.4, -0.3, 0.2),
    (0.15, 0.07, 0.83, 5, 16, -14),
    moved_by=(0.0042, -0.003, 0.003),
)

FILMS = {
    "soap_slide": Film(soap_mesh, True, 0.35, slide(0.20, 0.35, 0.0151)),
    "bunny_slide": Film(bunny_mesh, False, 0.25, slide(0.18, -0.6, 0.0)),
    "soap_tumble": Film(
        soap_mesh, True, 0.35, tumble((-0.09, -0.03, 0.10, 0.9, 0.5, 0.2, 0.3), (0.45, 0.1, 0.2, 5, 9, 3))
    ),
    "bunny_tumble": Film(
        bunny_mesh, False, 0.4, tumble((-0.09, 0.0, 0.07, 0.8, 0.4, -0.3, 0.2), (0.4, 0.05, 0.3, 4, 7, -3))
    ),
    "bunny_push": Film(
        bunny_mesh,
        False,
        0.3,
        tumble((-0.10, 0, 0, 1, 0, 0, 0.3), (0, 0, 0, 0, 0, 0), pusher=push),
        pusher=push,
    ),
    "bunny_loaded": Film(bunny_mesh, False, 0.4, _LOADED),
    "bunny_hard": Film(bunny_mesh, False, 0.25, slide(0.18, -0.6, 0.0), hard=True),
    "soap_hard": Film(soap_mesh, True, 0.35, slide(0.20, 0.35, 0.0151), hard=True),
}


def render(mi, film: Film, folder: Path, paths: int) -> None:
    """Render one film."""
    for name in ("frames", "masks", *(["occluders"] if film.hard else [])):
        (folder / name).mkdir(parents=True, exist_ok=True)
    times = np.arange(FRAMES) / RATE
    (positions, orientations), known = film.moved(film, times)
    mesh, ball = painted_file(*film.mesh(), folder / "mesh.ply"), folder / "ball.ply"
    trimesh.creation.icosphere(3).export(ball)
    sensor = pinhole(mi, EYE, TARGET, WIDTH / FOCAL, width=WIDTH, height=HEIGHT, pixel_format="rgba")
    random = np.random.default_rng(5)
    empty = mi.load_dict(scene(mi, None, film.medium, np.eye(4), table=True))
    write(folder / "empty.png", srgb(np.array(mi.render(empty, sensor=sensor, spp=4 * paths))[..., :3]))
    for i, time in enumerate(times):
        extra = others(mi, film, time, ball)
        exposures = (
            time + SHUTTER * (np.arange(BLURRED) + 0.5 - BLURRED / 2) / BLURRED if film.hard else [time]
        )
        (places, turns), _ = film.moved(film, np.maximum(exposures, 0.0))
        colours, cover = np.zeros((HEIGHT, WIDTH, 3)), np.zeros((HEIGHT, WIDTH))
        for place, turn in zip(places, turns, strict=True):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = matrix(turn), place
            whole = mi.load_dict(scene(mi, mesh, film.medium, pose, table=True) | extra)
            alone = mi.load_dict(scene(mi, mesh, False, pose, table=False))
            share = 1 / len(places)
            seed = BLURRED * i + len(places)
            colours += (
                share
                * np.array(mi.render(whole, sensor=sensor, spp=-(-paths // len(places)), seed=seed))[..., :3]
            )
            cover += share * np.array(mi.render(alone, sensor=sensor, spp=16, seed=i))[..., 3]
        if film.hard:
            hidden = mi.load_dict(scene(mi, None, False, np.eye(4), table=False) | extra)
            hand = np.clip(np.array(mi.render(hidden, sensor=sensor, spp=16, seed=i))[..., 3], 0, 1)
            write(folder / "occluders" / f"{i:03d}.png", hand)
            cover *= 1 - hand
            colours *= 1 - DARKER * i / (FRAMES - 1)
        picture = srgb(colours)
        if film.hard:
            picture = np.clip(picture + NOISE * random.standard_normal(picture.shape), 0, 1)
        write(folder / "frames" / f"{i:03d}.png", picture)
        write(folder / "masks" / f"{i:03d}.png", np.clip(cover, 0, 1))
        print(f"{folder.name}: {i + 1} of {FRAMES}", flush=True)
    mesh.unlink()
    ball.unlink()
    encode(folder)
    truth = {
        **{"camera_model": "OPENCV", "w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL},
        **{"cx": WIDTH / 2, "cy": HEIGHT / 2, "units": "m", "friction": film.friction, "rate": RATE},
        **{"sun": (LIGHT / np.linalg.norm(LIGHT)).tolist(), "shutter": SHUTTER if film.hard else 0.0},
        **known,
        "transform_matrix": np.round(camera_to_world(EYE, TARGET), 9).tolist(),
        "times": times.tolist(),
        "position": np.round(positions, 8).tolist(),
        "orientation": np.round(orientations, 8).tolist(),
    }
    (folder / "truth.json").write_text(json.dumps(truth) + "\n", encoding="utf-8")


def others(mi, film: Film, time: float, ball: Path) -> dict:
    """What else is seen: the block that pushes, and the hand that passes in front."""
    found = {}
    if film.pusher is not None:
        found["pusher"] = {
            "type": "cube",
            "to_world": mi.ScalarTransform4f().translate(film.pusher(np.array([time]))[0]).scale(BLOCK),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.55, 0.40, 0.24]}},
        }
    if film.hard:
        # Four fingers and a palm, a few centimetres above the table, across the picture during the film.
        along = -0.13 + 0.34 * time * RATE / (FRAMES - 1)
        skin = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.62, 0.40, 0.30]}}
        parts = [((along, -0.17, 0.155), (0.035, 0.045, 0.014))]
        parts += [((along + 0.016 * (k - 1.5), -0.115, 0.15), (0.007, 0.034, 0.007)) for k in range(4)]
        for k, (middle, radii) in enumerate(parts):
            # Mitsuba's spheres stay round when they are scaled.
            placed = mi.ScalarTransform4f().translate(list(middle)).scale(list(radii))
            found[f"hand{k}"] = {"type": "ply", "filename": str(ball), "to_world": placed, "bsdf": skin}
    return found


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
            **(scattering() if medium else _painted()),
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


def scattering() -> dict:
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
