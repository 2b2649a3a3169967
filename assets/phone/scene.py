"""The scene of a phone film for Mitsuba, and its camera."""

from pathlib import Path

import numpy as np
import trimesh
from render_images import camera_to_world, paint, write_ply
from render_table import pinhole
from render_videos import matrix, scattering
from solids import Mesh

from phone.camera import FOCAL, HEIGHT, WIDTH
from phone.films import Film, mesh_of
from phone.motion import Motion
from phone.table import hand, SIDE, tabletop, things

PAD = 34  # pixels around object and shadow that are rendered anew
SUN = tuple(np.array([-0.5, -0.35, 0.79]) / np.linalg.norm([-0.5, -0.35, 0.79]))
LAMP = 0.14  # half sides of a lamp [m]
LAMPS = (
    ((0.55, 0.15, 0.95), [13.0, 11.2, 8.6]),
    ((-0.75, -0.30, 0.80), [5.0, 5.0, 5.2]),
)


class Place:
    """The scene of a film for Mitsuba.

    Args:
        mi: Mitsuba.
        film: What is filmed.
        folder: For temporary files.
        paths: Per pixel.
    """

    def __init__(self, mi, film: Film, folder: Path, paths: int):
        self.mi, self.film, self.paths = mi, film, paths
        self.motion = film.motion(film)
        mesh = mesh_of(film.object)
        own = _own(film.object, mesh)
        self._files = {"object": folder / "object.ply", "hand": folder / "hand.ply"}
        colours = faceted_file(*mesh, self._files["object"])
        hand().export(self._files["hand"])
        for k, (thing, _) in enumerate(things(own, film.seed)):
            self._files[f"thing{k}"] = folder / f"thing{k}.ply"
            thing.export(self._files[f"thing{k}"])
        tints = [tint for _, tint in things(own, film.seed)]
        self.hull = trimesh.Trimesh(*mesh, process=False).convex_hull.vertices
        self._palm = hand().vertices
        top = tabletop(film.seed, own, papers=film.papers, patches=film.patches)
        # The first row of a bitmap lies at v = 0, the lowest y.
        bitmap = mi.Bitmap((255 * top[::-1] + 0.5).astype(np.uint8))
        self._still = {
            False: self._at_rest({"type": "bitmap", "bitmap": bitmap, "wrap_mode": "clamp"}, tints),
            True: self._at_rest(_rgb([0.0, 0.0, 0.0]), len(tints) * [[0.0, 0.0, 0.0]]),
        }
        skin = {"bsdf": _diffuse([0.62, 0.40, 0.30])}
        self._groups = {
            ("object", True): self._group("object", {"bsdf": _diffuse([1.0, 0.0, 0.0])}),
            ("hand", True): self._group("hand", {"bsdf": _diffuse([0.0, 1.0, 0.0])}),
            ("hand", False): self._group("hand", skin),
        }
        surface = scattering() if film.object == "soap" else _painted(mi.Bitmap(colours))
        self._groups["object", False] = self._group("object", surface)

    def _at_rest(self, paint: dict, colours: list[list[float]]) -> dict:
        """The table and the things on it, with this paint and these colours."""
        contents = {
            "table": {
                "type": "rectangle",
                "to_world": self.mi.ScalarTransform4f().scale(0.5 * SIDE),
                "bsdf": {"type": "diffuse", "reflectance": paint},
            }
        }
        for k, colour in enumerate(colours):
            file = str(self._files[f"thing{k}"])
            contents[f"thing{k}"] = {
                **{"type": "ply", "filename": file, "face_normals": True},
                "bsdf": _diffuse(colour),
            }
        return {name: self.mi.load_dict(content) for name, content in contents.items()}

    def _group(self, name: str, surface: dict):
        """A body of which scenes hold instances, which need not be read and sorted anew."""
        body = {"type": "ply", "filename": str(self._files[name]), **surface}
        return self.mi.load_dict({"type": "shapegroup", "body": body})

    def close(self) -> None:
        """Remove temporary files."""
        for file in self._files.values():
            file.unlink()

    def hand_at(self, time: float) -> np.ndarray | None:
        """Where the hand is, None if it is not in the way: shape (4, 4)."""
        if self.film.passes is None:
            return None
        start, end = self.film.passes
        share = (time - start) / (end - start)
        if not 0 <= share <= 1:
            return None
        pose = np.eye(4)
        pose[:3, :3] = matrix(np.array([np.cos(0.15), 0.0, 0.0, np.sin(0.15)]))
        pose[:3, 3] = -0.46 + 0.92 * share, -0.13 + 0.05 * np.sin(np.pi * share), 0.11
        return pose

    def scene(
        self, object_pose: np.ndarray | None, hand_pose: np.ndarray | None = None, *, cover: bool = False
    ):
        """The place with the object and the hand.

        Args:
            object_pose: Of the object, None without it.
            hand_pose: Of the hand, None without it.
            cover: The object is red and the hand green, on black and without light, instead of what is seen.
        """
        medium = self.film.object == "soap"
        content = {"type": "scene", **self._still[cover]}
        if cover:
            content["integrator"] = {"type": "aov", "aovs": "colour:albedo"}
        else:
            content["integrator"] = {
                "type": "volpath" if medium else "path",
                "max_depth": 32 if medium else 5,
            }
            content |= self._lights()
        for name, pose in (("object", object_pose), ("hand", hand_pose)):
            if pose is not None:
                group = self._groups[name, cover]
                placed_so = self.mi.ScalarTransform4f(pose)
                content |= {
                    f"{name}s": group,
                    name: {"type": "instance", "to_world": placed_so, "body": group},
                }
        return self.mi.load_dict(content)

    def _lights(self) -> dict:
        if self.film.light == "sun":
            return {
                "sky": {"type": "constant", "radiance": _rgb([0.36, 0.38, 0.41])},
                "sun": {
                    "type": "directional",
                    "direction": (-np.array(SUN)).tolist(),
                    "irradiance": _rgb([1.9, 1.82, 1.7]),
                },
            }
        lights: dict = {"sky": {"type": "constant", "radiance": _rgb([0.16, 0.15, 0.14])}}
        for k, (middle, colour) in enumerate(LAMPS):
            look = self.mi.ScalarTransform4f().look_at(list(middle), [0, 0, 0], [0, 1, 0.1])
            lights[f"lamp{k}"] = {
                "type": "rectangle",
                "to_world": look.scale(LAMP),
                "emitter": {"type": "area", "radiance": _rgb(colour)},
            }
        return lights

    def box(self, poses: list[np.ndarray], hands: list[np.ndarray]) -> tuple[int, int, int, int] | None:
        """Columns and rows (left, top, right, bottom) that bodies and their shadows change; None: none."""
        placed = [self.hull @ pose[:3, :3].T + pose[:3, 3] for pose in poses]
        placed += [self._palm @ pose[:3, :3].T + pose[:3, 3] for pose in hands]
        points = np.concatenate(placed)
        if self.film.light == "sun":
            rays = [np.broadcast_to(-np.array(SUN), points.shape)]
        else:
            corners = [
                np.array(m) + (x, y, 0) for m, _ in LAMPS for x in (-LAMP, LAMP) for y in (-LAMP, LAMP)
            ]
            rays = [points - corner for corner in corners]
        shadows = [points + np.maximum(points[:, 2:], 0) / -ray[:, 2:] * ray for ray in rays]
        pixels = project(self.film, np.concatenate([points, *shadows]))
        low = np.floor(pixels.min(axis=0)).astype(int) - PAD
        high = np.ceil(pixels.max(axis=0)).astype(int) + PAD
        left, top = np.maximum(low, 0)
        right, bottom = np.minimum(high, (WIDTH, HEIGHT))
        return None if left >= right or top >= bottom else (left, top, right, bottom)

    def look(self, scene, box: tuple[int, int, int, int], paths: int, seed: int) -> np.ndarray:
        """Linear light in a part of the film's picture, shape (rows, columns, 3)."""
        sensor = camera(self.mi, self.film.eye, self.film.target, 1.0, box)
        return np.array(self.mi.render(scene, sensor=sensor, spp=paths, seed=seed))[..., :3]


def _rgb(value: list[float]) -> dict:
    return {"type": "rgb", "value": value}


def _diffuse(colour: list[float]) -> dict:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": _rgb(colour)}}


def _painted(colours) -> dict:
    """As in the photographs of `render_images`, the colours of faces in a bitmap."""
    bitmap = {"type": "bitmap", "bitmap": colours, "raw": True, "filter_type": "nearest"}
    bsdf = {"type": "principled", "base_color": bitmap, "roughness": 0.5, "specular": 0.4}
    return {"face_normals": True, "bsdf": {"type": "twosided", "bsdf": bsdf}}


def faceted_file(vertices: np.ndarray, faces: np.ndarray, path: Path) -> np.ndarray:
    """Write a PLY file whose faces each point to a texel, because instances know no colours of vertices.

    Returns:
        Linear colours of the texels, shape (side, side, 3), first row at v = 0.
    """
    side = int(np.ceil(np.sqrt(len(faces))))
    colours = np.zeros((side * side, 3), np.float32)
    colours[: len(faces)] = paint(vertices)[faces].mean(axis=1)
    row, column = np.divmod(np.arange(len(faces)), side)
    corners = np.zeros(3 * len(faces), [(name, "<f4") for name in ("x", "y", "z", "u", "v")])
    texel = np.repeat(np.stack([column + 0.5, row + 0.5], axis=1) / side, 3, axis=0)
    columns = np.hstack([vertices[faces].reshape(-1, 3), texel])
    write_ply(corners, columns, np.arange(3 * len(faces)).reshape(-1, 3), path)
    return colours.reshape(side, side, 3)


def _own(name: str, mesh: Mesh) -> np.ndarray:
    """Colours of the object, linear, shape (n, 3)."""
    if name == "soap":
        return np.array([[0.62, 0.80, 0.86], [0.50, 0.70, 0.78], [0.75, 0.86, 0.90]])
    return paint(mesh[0])[::97]


def camera(mi, eye, target, scale: float, box: tuple[int, int, int, int] | None = None):
    """The phone's lens; pictures of `scale` times the size of a frame, or a part of one."""
    width, height = round(scale * WIDTH), round(scale * HEIGHT)
    left, top, right, bottom = box or (0, 0, width, height)
    part = {"crop_offset_x": int(left), "crop_offset_y": int(top)}
    part |= {"crop_width": int(right - left), "crop_height": int(bottom - top)}
    return pinhole(mi, eye, target, WIDTH / FOCAL, width=width, height=height, **part)


def project(film: Film, points: np.ndarray) -> np.ndarray:
    """Pixels of points [m], shape (n, 2)."""
    to_world = camera_to_world(np.array(film.eye), np.array(film.target))
    x, y, z = ((points - to_world[:3, 3]) @ to_world[:3, :3]).T
    return np.stack([0.5 * WIDTH + FOCAL * x / -z, 0.5 * HEIGHT - FOCAL * y / -z], axis=1)


def placed(motion: Motion, times: np.ndarray) -> list[np.ndarray]:
    """Poses at times as matrices (4, 4)."""
    result = []
    for position, orientation in zip(*motion.at(times), strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = matrix(orientation), position
        result.append(pose)
    return result
