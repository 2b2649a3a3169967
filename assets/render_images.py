"""Renders the photographs that dano ships: a painted bunny and a semi-translucent bar of soap.

Path tracing by Mitsuba 3 (`pip install mitsuba`), one distant light a view out of several directions, a black
void around. Each object gets a folder of PNGs with alpha (the object's silhouette) and a `transforms.json`
in the
nerfstudio convention, with per-frame `light_direction` and `split`: "train"; "test", other views under the
lights of the training views; "relight", other views under lights that no training view has.

The soap is no surface but a scattering medium inside a boundary that does not refract, because light from far
away cannot be connected through a refracting one.

Usage: python assets/render_images.py [bunny soap mug block] [--out assets/images] [--quick]
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from solids import block_mesh, bunny_mesh, mug_mesh, soap_mesh

SEED = 7
FIELD_OF_VIEW = 30.0  # [degrees]
TRAIN_LIGHTS, RELIGHT_LIGHTS = 8, 3


@dataclass(frozen=True)
class Subject:
    """What is photographed.

    Attributes:
        mesh: Returns vertices [m] and faces.
        pixels: Side of the images.
        samples: Paths per pixel of training views.
        test_samples: Paths per pixel of the other views, whose noise would count as error.
        n_train: Number of training views.
        n_test: Number of held-out views under the lights of the training views.
        n_relight: Number of held-out views under other lights.
        medium: Whether it is a scattering medium, instead of a painted surface.
        faceted: Whether faces are flat, which leaves sharp edges sharp.
    """

    mesh: Callable[[], tuple[np.ndarray, np.ndarray]]
    pixels: int
    samples: int
    test_samples: int
    n_train: int = 80
    n_test: int = 8
    n_relight: int = 6
    medium: bool = False
    faceted: bool = False


SUBJECTS = {
    "bunny": Subject(bunny_mesh, 128, 64, 128),
    "soap": Subject(soap_mesh, 96, 96, 384, n_train=64, medium=True),
    "mug": Subject(mug_mesh, 128, 64, 128, faceted=True),
    "block": Subject(block_mesh, 128, 64, 128, faceted=True),
}


def main() -> None:
    """Render the subjects asked for."""
    parser = argparse.ArgumentParser(description="Render the photographs that dano ships.")
    parser.add_argument("subjects", nargs="*", default=["bunny", "soap"])
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parent / "images")
    parser.add_argument("--quick", action="store_true", help="a sixteenth of the paths")
    arguments = parser.parse_args()
    import mitsuba as mi  # pyright: ignore[reportMissingImports]

    mi.set_variant("scalar_rgb")
    for name in arguments.subjects:
        photograph(mi, SUBJECTS[name], arguments.out / name, 16 if arguments.quick else 1)


def photograph(mi, subject: Subject, folder: Path, fewer: int) -> None:
    """Render all views of one subject into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(SEED)
    vertices, faces = subject.mesh()
    centre = 0.5 * (vertices.min(0) + vertices.max(0))
    radius = float(np.linalg.norm(vertices - centre, axis=1).max())
    distance = 1.08 * radius / np.sin(np.radians(FIELD_OF_VIEW / 2))
    solid = painted_file(vertices, faces, folder / "mesh.ply")
    lights = directions(TRAIN_LIGHTS, 0.35, rng)
    new_lights = directions(RELIGHT_LIGHTS, 0.35, rng)
    focal = 0.5 * subject.pixels / np.tan(np.radians(FIELD_OF_VIEW / 2))
    frames = []
    for split, count in (
        ("train", subject.n_train),
        ("test", subject.n_test),
        ("relight", subject.n_relight),
    ):
        # From everywhere, also from below: nothing about the shape is left to guess.
        for i, away in enumerate(directions(count, -0.97, rng)):
            pool = new_lights if split == "relight" else lights
            light = pool[rng.integers(len(pool))]
            eye = centre + distance * away
            paths = max((subject.samples if split == "train" else subject.test_samples) // fewer, 4)
            name = f"{split}_{i:03d}.png"
            pixels = render_view(mi, subject, solid, eye, centre, light, radius, paths, seed=len(frames))
            write_png(folder / name, pixels)
            frames.append(
                {
                    "file_path": name,
                    "split": split,
                    "light_direction": np.round(light, 6).tolist(),
                    "transform_matrix": np.round(camera_to_world(eye, centre), 8).tolist(),
                }
            )
        print(f"{folder.name}: {count} {split} views", flush=True)
    solid.unlink()
    transforms = {
        "camera_model": "OPENCV",
        "w": subject.pixels,
        "h": subject.pixels,
        "fl_x": focal,
        "fl_y": focal,
        "cx": subject.pixels / 2,
        "cy": subject.pixels / 2,
        "units": "m",
        "frames": frames,
    }
    text = json.dumps(transforms, indent=None, separators=(",", ":")).replace(
        '{"file_path"', '\n{"file_path"'
    )
    (folder / "transforms.json").write_text(text + "\n", encoding="utf-8")


def directions(count: int, lowest: float, rng: np.random.Generator) -> np.ndarray:
    """Unit vectors spread evenly over the sphere above z = `lowest` (Fibonacci lattice, turned at random)."""
    z = lowest + (0.99 - lowest) * (np.arange(count) + 0.5) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count) + rng.uniform(0, 2 * np.pi)
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)


def camera_to_world(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """OpenGL axes: x to the right, y upwards, z backwards."""
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross((0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    matrix[:3, 3] = eye
    return matrix


def painted_file(vertices: np.ndarray, faces: np.ndarray, path: Path) -> Path:
    """Write vertices, their paint and faces as a binary PLY file, the form in which Mitsuba takes colours."""
    corners = np.zeros(len(vertices), [(name, "<f4") for name in ("x", "y", "z", "r", "g", "b")])
    return write_ply(corners, np.hstack([vertices, paint(vertices)]), faces, path)


def write_ply(corners: np.ndarray, columns: np.ndarray, faces: np.ndarray, path: Path) -> Path:
    """Write a binary PLY file: corners, an array of records that the columns fill, and faces."""
    for name, column in zip(corners.dtype.names or (), columns.T, strict=True):
        corners[name] = column
    triangles = np.zeros(len(faces), [("n", "u1"), ("corners", "<i4", 3)])
    triangles["n"], triangles["corners"] = 3, faces
    header = [
        *("ply", "format binary_little_endian 1.0", f"element vertex {len(corners)}"),
        *(f"property float {name}" for name in corners.dtype.names or ()),
        *(f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""),
    ]
    path.write_bytes("\n".join(header).encode() + corners.tobytes() + triangles.tobytes())
    return path


def paint(x: np.ndarray) -> np.ndarray:
    """Linear colours of a surface: warm clay with cool patches, at two scales."""
    rng = np.random.default_rng(SEED)
    size = np.ptp(x, axis=0).max()

    def waves(length: float) -> np.ndarray:
        total = np.zeros(len(x))
        for _ in range(12):
            k = rng.normal(size=3)
            k *= 2 * np.pi / (length * size * np.linalg.norm(k))
            total += np.cos(x @ k + rng.uniform(0, 2 * np.pi))
        return total / np.sqrt(6)

    cool = 1 / (1 + np.exp(-4 * waves(0.45)))[:, None]
    base = (1 - cool) * np.array([0.62, 0.28, 0.13]) + cool * np.array([0.15, 0.34, 0.42])
    return np.clip(base * np.exp(0.35 * waves(0.16))[:, None], 0.02, 0.9)


def render_view(mi, subject, mesh, eye, target, light, radius, paths: int, seed: int) -> np.ndarray:
    """One view: sRGB colours in the light and the silhouette, shape (pixels, pixels, 4)."""
    sensor = {
        "type": "perspective",
        "fov": FIELD_OF_VIEW,
        "to_world": mi.ScalarTransform4f().look_at(list(eye), list(target), [0, 0, 1]),
        "near_clip": 0.05 * radius,
        "film": {
            "type": "hdrfilm",
            "width": subject.pixels,
            "height": subject.pixels,
            "pixel_format": "rgba",
            "rfilter": {"type": "box"},
        },
    }
    painted = {
        "type": "principled",
        "base_color": {"type": "mesh_attribute", "name": "vertex_color"},
        "roughness": 0.5,
        "specular": 0.4,
    }
    shape = {"type": "ply", "filename": str(mesh), "face_normals": subject.faceted, "bsdf": painted}
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 6, "hide_emitters": True},
        "shape": shape,
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.28, 0.3, 0.33]}},
        "lamp": {
            "type": "directional",
            "direction": (-light).tolist(),
            "irradiance": {"type": "rgb", "value": [2.4, 2.3, 2.1]},
        },
    }
    cover = 32 if subject.medium else paths
    if not subject.medium:
        pixels = np.array(mi.render(mi.load_dict(scene), sensor=mi.load_dict(sensor), spp=paths, seed=seed))
    else:
        # The silhouette is that of the solid; the medium alone is see-through at its edges.
        plain = np.array(mi.render(mi.load_dict(scene), sensor=mi.load_dict(sensor), spp=cover, seed=seed))
        inside = {
            "type": "homogeneous",
            "sigma_t": 320.0,  # [1/m]
            "albedo": {"type": "rgb", "value": [0.80, 0.945, 0.985]},
            "phase": {"type": "hg", "g": 0.3},
        }
        shape = {"type": "ply", "filename": str(mesh), "interior": inside, "bsdf": {"type": "null"}}
        scene |= {"shape": shape, "integrator": {"type": "volpath", "max_depth": 48, "hide_emitters": True}}
        pixels = np.array(mi.render(mi.load_dict(scene), sensor=mi.load_dict(sensor), spp=paths, seed=seed))
        pixels[..., 3] = plain[..., 3]
    alpha = np.clip(pixels[..., 3:], 0, 1)
    colour = np.where(alpha > 0, pixels[..., :3] / np.maximum(alpha, 1e-3), 0)
    return np.concatenate([srgb(colour), alpha], axis=-1)


def srgb(linear: np.ndarray) -> np.ndarray:
    """The sRGB transfer curve."""
    x = np.clip(linear, 0, 1)
    return np.where(x < 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def write_png(path: Path, pixels: np.ndarray) -> None:
    """Write straight-alpha RGBA with 8 bits a channel."""
    from PIL import Image

    Image.fromarray(np.rint(255 * pixels).astype(np.uint8), "RGBA").save(path, optimize=True)


if __name__ == "__main__":
    main()
