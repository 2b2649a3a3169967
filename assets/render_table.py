"""Renders photographs as a phone takes them: a painted bunny on a patterned table with a printed AprilTag.

Path tracing by Mitsuba 3 (`pip install mitsuba trimesh opencv-python-headless pillow`), a sun and a sky that
stay. The pictures lie in `images/`, the silhouettes of the bunny in `masks/`, the true cameras in
`truth.json` (nerfstudio's convention; metres; z up; the centre of the tag is `tag_centre`). Nothing of it is
shipped: it is what `dano poses` is measured with.

Usage: python assets/render_table.py FOLDER [--pictures 40] [--paths 32]
"""

import argparse
import json
from pathlib import Path

import numpy as np
from render_images import camera_to_world, painted_file, srgb
from solids import bunny_mesh

SEED = 11
WIDTH, HEIGHT, FOCAL = 640, 480, 620.0  # [pixels]
TABLE_SIDE, TEXELS = 0.9, 3072  # [m], texels along it
TAG_TEXELS, TAG_ID = 205, 7  # side of the black square of tag36h11
TAG_SIDE = TAG_TEXELS * TABLE_SIDE / TEXELS  # [m], 60.06 mm
TAG_CENTRE = np.array([0.12, -0.03, 0.0])  # [m]


def main() -> None:
    """Render into a folder."""
    parser = argparse.ArgumentParser(description="Render photographs of an object on a table with a tag.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--pictures", type=int, default=40)
    parser.add_argument("--paths", type=int, default=32, help="paths per pixel")
    arguments = parser.parse_args()
    import mitsuba as mi  # pyright: ignore[reportMissingImports]

    mi.set_variant("scalar_rgb")
    photograph(mi, arguments.folder, arguments.pictures, arguments.paths)


def photograph(mi, folder: Path, count: int, paths: int) -> None:
    """Render all pictures."""
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    solid = painted_file(*bunny_mesh(), folder / "mesh.ply")
    whole, alone = scene(mi, solid, table=True), scene(mi, solid, table=False)
    frames = []
    for i, (eye, target) in enumerate(stations(count)):
        name = f"{i:03d}.png"
        sensor = pinhole(mi, eye, target, WIDTH / FOCAL, width=WIDTH, height=HEIGHT, pixel_format="rgba")
        colours = np.array(mi.render(whole, sensor=sensor, spp=paths, seed=i))[..., :3]
        cover = np.array(mi.render(alone, sensor=sensor, spp=16, seed=i))[..., 3]
        write(folder / "images" / name, srgb(colours))
        write(folder / "masks" / name, np.clip(cover, 0, 1))
        pose = np.round(camera_to_world(eye, target), 9).tolist()
        frames.append({"file_path": f"images/{name}", "mask_path": f"masks/{name}", "transform_matrix": pose})
        print(f"{i + 1} of {count}", flush=True)
    solid.unlink()
    truth = {
        **{"camera_model": "OPENCV", "w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL},
        **{"cx": WIDTH / 2, "cy": HEIGHT / 2, "units": "m", "tag_side": TAG_SIDE},
        "tag_centre": TAG_CENTRE.tolist(),
        "frames": frames,
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")


def stations(count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Where from and where to: two rounds at different heights, by hand, so neither even nor centred."""
    rng = np.random.default_rng(SEED)
    result = []
    for i in range(count):
        upper = i >= (count + 1) // 2
        turn = 2 * np.pi * (i % ((count + 1) // 2) + 0.3 * rng.uniform(-1, 1)) / ((count + 1) // 2)
        height = np.radians(rng.normal(50 if upper else 27, 3))
        away = np.array([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)])
        target = np.array([0.02, 0.0, 0.045]) + rng.normal(0, 0.008, 3)
        result.append((target + rng.uniform(0.36, 0.46) * away, target))
    return result


def pinhole(mi, eye, target, across: float, **film):
    """A pinhole camera without a filter between pixels.

    Args:
        mi: Mitsuba.
        eye: Where it is [m].
        target: What it looks at [m].
        across: Width of its picture over its focal length.
        film: Width, height and more of Mitsuba's `hdrfilm`.
    """
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(0.5 * across))),
            "fov_axis": "x",
            "to_world": mi.ScalarTransform4f().look_at(list(eye), list(target), [0, 0, 1]),
            "near_clip": 0.01,
            "film": {"type": "hdrfilm", "rfilter": {"type": "box"}, **film},
        }
    )


def scene(mi, mesh: Path, *, table: bool):
    """The bunny under sun and sky, on the table or alone."""
    light = np.array([0.45, 0.3, 0.84])
    content = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4, "hide_emitters": True},
        "bunny": {
            "type": "ply",
            "filename": str(mesh),
            "bsdf": {
                "type": "principled",
                "base_color": {"type": "mesh_attribute", "name": "vertex_color"},
                "roughness": 0.6,
                "specular": 0.3,
            },
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.42, 0.44, 0.46]}},
        "sun": {
            "type": "directional",
            "direction": (-light).tolist(),
            "irradiance": {"type": "rgb", "value": [1.5, 1.45, 1.35]},
        },
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
    return mi.load_dict(content)


def tabletop() -> np.ndarray:
    """Colours of the table from above, as sRGB, first row furthest along y: cloth and a printed sheet."""
    import cv2

    rng = np.random.default_rng(SEED)
    colours = np.full((TEXELS, TEXELS, 3), (0.50, 0.45, 0.38))
    for cells, strength in ((12, 0.10), (40, 0.10), (120, 0.09), (400, 0.07)):
        noise = rng.normal(size=(cells, cells, 1)) + 0.3 * rng.normal(size=(cells, cells, 3))
        colours += strength * cv2.resize(noise, (TEXELS, TEXELS), interpolation=cv2.INTER_CUBIC)
    per_metre = TEXELS / TABLE_SIDE
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    side = TAG_TEXELS
    tag = cv2.aruco.generateImageMarker(family, TAG_ID, side)
    border = side // 5
    sheet = np.pad(tag, border, constant_values=255)[..., None] / 255 * 0.86 + 0.04
    left = round((TAG_CENTRE[0] + 0.5 * TABLE_SIDE) * per_metre - 0.5 * side) - border
    top = round((0.5 * TABLE_SIDE - TAG_CENTRE[1]) * per_metre - 0.5 * side) - border
    colours[top : top + len(sheet), left : left + len(sheet)] = sheet
    return np.clip(colours, 0.02, 0.95)


def write(path: Path, pixels: np.ndarray) -> None:
    """Write grey or colours with 8 bits a channel."""
    from PIL import Image

    Image.fromarray(np.rint(255 * pixels).astype(np.uint8)).save(path)


if __name__ == "__main__":
    main()
