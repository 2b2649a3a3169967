"""Readers of captures: `transforms.json` of nerfstudio, instant-ngp and Blender, OSF's `anno.json`.

All of them give poses as camera to world with OpenGL's axes. They differ in where the intrinsics stand, how
photographs are named, how they are split, and whether a light is given.
"""

import json
import math
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dano.checks import checked_count, checked_path, shown
from dano.vision.capture._camera import PosedCamera
from dano.vision.capture._capture import Capture, SPLITS, View
from dano.vision.capture._pictures import PictureTurn, read_mask, read_picture
from dano.vision.capture.masks import cut_out

_HOLD_OUT = 8
"""Where a capture has no split, one in this many views is held out, as is usual since LLFF."""

_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "OPENCV", "SIMPLE_RADIAL", "RADIAL")
_FOREIGN = (
    "is_fisheye",
    "fisheye",
    "is_equirectangular",
    "rolling_shutter",
    "distortion",
    "distortion_params",
)
_FOREIGN += (
    "k4",
    "k5",
    "k6",
    "s1",
    "s2",
    "s3",
    "s4",
    "ftheta_p0",
    "ftheta_p1",
    "ftheta_p2",
    "ftheta_p3",
    "ftheta_p4",
)
"""What other programs say of lenses and shutters that dano does not draw."""

_UNSET = (None, "", [])


def load_capture(path: str | Path, *, hold_out: int | None = None, downscale: int = 1) -> Capture:
    """Read photographs with poses.

    - `transforms.json` (nerfstudio, instant-ngp): `fl_x fl_y cx cy w h k1 k2 k3 p1 p2` or `camera_angle_x`,
      for all frames or per frame; `mask_path` or an alpha channel; per frame `split` ("train", "test",
      "relight"), and `light_direction` (towards the light) or `light_position`.
    - `transforms_train.json`, `transforms_test.json`, … (Blender's NeRF-synthetic scenes).
    - `anno_train.json` and `anno_test.json`, or `anno.json` (object-centric neural scattering functions): a
      list of records with `filename` (in `rgba/`), `RT` (world to camera, OpenCV's axes), `K`, `light_pos`.

    Args:
        path: A folder that holds one of these files, or the file.
        hold_out: Where the file has no split: hold out one view in this many, 0 none; default 8.
        downscale: Average so many pixels a side into one.

    Returns:
        The capture.

    Raises:
        ValueError: If a file is missing or cannot be read, a pose is not a rotation, or an image does not
            have the size that its camera states; the message names the file.
        ImportError: If pillow is missing.
    """
    path = checked_path("path", path)
    if hold_out is not None:
        checked_count("hold_out", hold_out, least=0)
    checked_count("downscale", downscale)
    if not path.exists():
        raise ValueError(
            f"{path}: no such folder or file; expected a folder with transforms.json or anno.json"
        )
    views = _views(path)
    if not views:
        raise ValueError(f"{path}: it lists no images")
    if not any(view.split != "train" for view in views) and hold_out != 0:
        step = _HOLD_OUT if hold_out is None else hold_out
        held = range(step // 2, len(views), step) if len(views) >= 2 * step else ()
        views = [v.replaced(split="test") if i in held else v for i, v in enumerate(views)]
    views = _cut_out(views)
    if downscale > 1:
        views = [view.resized(downscale) for view in views]
    return Capture(views, path)


def load_camera(
    path: str | Path, width: int | None = None, height: int | None = None, *, frame: str | None = None
) -> PosedCamera:
    """Read one camera that stands still, for pictures of a size.

    Args:
        path: A .json file in nerfstudio's convention: fl_x (or camera_angle_x), w, h, cx, cy, k1 …, and
            transform_matrix, of itself or of its only frame. Without w and h the intrinsics are those of
            pictures of the size asked for.
        width: Of the pictures [pixels]; None: as the file says.
        height: Of the pictures [pixels]; None likewise.
        frame: Name of the picture whose camera it is, where the file holds several.

    Raises:
        ValueError: If the file is missing or lacks something, holds several frames and none was chosen, or
            the pictures have another shape.
    """
    source = checked_path("path", path)
    content = _json(source)
    frames = content.get("frames", [])
    if frame is not None:
        frames = _named(source, frames, frame)
    if frame is not None or "transform_matrix" not in content:
        if not isinstance(frames, list) or len(frames) != 1:
            raise ValueError(
                f"{source}: camera must have one transform_matrix, or a single frame that has it, got"
                f" {len(frames)} frames"
            )
        content = {**content, **frames[0]}
    _check_model(source, {**content, "frames": []})
    height, width = (
        content.get(key) if side is None else side for key, side in (("h", height), ("w", width))
    )
    if height is None or width is None:
        raise ValueError(f"{source}: camera must state w and h, or width and height must be given")
    return _camera(source, source.name, {"transform_matrix": None, **content}, (height, width))


def _named(source: Path, frames: Any, name: str) -> list[dict[str, Any]]:
    """The frame of a picture, by its path or the last part of it.

    Raises:
        ValueError: If there is not exactly one.
    """
    rows = [f for f in frames if isinstance(f, dict)] if isinstance(frames, list) else []
    known = [str(row.get("file_path")) for row in rows]
    found = [row for row, file in zip(rows, known, strict=True) if name in (file, Path(file).name)]
    if len(found) != 1:
        names = f"one of {', '.join(known[:6])}{', …' * (len(known) > 6)}" if known else "given for frames"
        raise ValueError(f"{source}: frame must be {names}, got {name!r}, which {len(found)} are called")
    return found


def _cut_out(views: Sequence[View]) -> list[View]:
    """Objects without plain backgrounds; says where that has completed masks."""
    cut = [cut_out(view) for view in views]
    grown = [
        a.name
        for a, b in zip(views, cut, strict=True)
        if a.mask is not None and b.mask is not None and b.mask.sum() > 1.005 * a.mask.sum()
    ]
    if grown:
        warnings.warn(
            f"{len(grown)} masks left out shadows on the object, holes or narrow bays in which the photograph"
            f" shows no background; they were filled: {', '.join(grown[:4])}",
            RuntimeWarning,
            stacklevel=3,
        )
    return cut


def _views(path: Path) -> list[View]:
    if path.is_file():
        if path.suffix != ".json":
            raise ValueError(f"{path}: expected a .json file or a folder, got {path.suffix!r}")
        return _reader(path.name)(path)
    for name in ("transforms.json", "anno.json"):
        if (path / name).is_file():
            return _reader(name)(path / name)
    for form in ("transforms", "anno"):
        # Validation views are neither needed nor should they be learned from.
        files = [(split, path / f"{form}_{split}.json") for split in SPLITS]
        if files[0][1].is_file():
            return [
                view.replaced(split=split)
                for split, file in files
                if file.is_file()
                for view in _reader(file.name)(file)
            ]
    found = sorted(p.name for p in path.iterdir())[:8]
    raise ValueError(
        f"{path}: no transforms.json, transforms_train.json, anno.json or anno_train.json in it, only"
        f" {found}; photographs without poses need `dano poses` first"
    )


def _reader(name: str) -> Callable[[Path], list[View]]:
    return _read_anno if name.startswith("anno") else _read_transforms


def _read_transforms(path: Path) -> list[View]:
    content = _json(path)
    frames = content.get("frames")
    if not isinstance(frames, list):
        raise ValueError(f"{path}: it must have a list of frames, got {sorted(content)[:12]}")
    _check_model(path, content)
    if content.get("units") == "arbitrary":
        warnings.warn(
            f"{path}: the scale of its cameras is not known, so lengths are not metres; `dano poses` takes"
            f" it from"
            " a printed marker or a measured length",
            RuntimeWarning,
            stacklevel=4,
        )
    named = {str(name): split for split in SPLITS for name in content.get(f"{split}_filenames", ())}
    views = []
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict) or "file_path" not in frame or "transform_matrix" not in frame:
            raise ValueError(f"{path}: frame {i} must have file_path and transform_matrix")
        name = str(frame["file_path"])
        file = _image_file(path, name)
        values = {**{k: v for k, v in content.items() if k != "frames"}, **frame}
        picture = read_picture(file, lambda turned, values=values: _is_of_upright(path, turned, values))
        image, mask, cut_out = picture.over_black, picture.alpha, picture.alpha is not None
        if frame.get("mask_path") not in _UNSET:
            mask = read_mask(path.parent / str(frame["mask_path"]), image.shape[:2], picture.orientation)
            image, cut_out = picture.colours, False
        doubt = None
        if frame.get("doubt_path") not in _UNSET:
            doubt = read_mask(path.parent / str(frame["doubt_path"]), image.shape[:2], picture.orientation)
        light, near = _light(path, i, frame)
        views.append(
            View(
                name=name,
                camera=_camera(path, name, values, image.shape[:2]),
                image=image,
                mask=mask,
                doubt=doubt,
                light=light,
                light_is_near=near,
                split=_split(path, i, frame.get("split", named.get(name, "train"))),
                cut_out=cut_out,
            )
        )
    return views


def _read_anno(path: Path) -> list[View]:
    """Records with filename (in rgba/), RT (world to camera, 3 × 4, OpenCV's axes), K and light_pos."""
    views = []
    for i, record in enumerate(_json(path)["frames"]):
        if not isinstance(record, dict) or not {"filename", "RT", "K"} <= set(record):
            raise ValueError(f"{path}: image {i} must have filename, RT and K")
        name = str(record["filename"])
        folder = "rgba/" if (path.parent / "rgba").is_dir() else ""
        picture = read_picture(_image_file(path, folder + name))
        image, mask, cut_out = picture.over_black, picture.alpha, picture.alpha is not None
        try:
            world_to_camera = np.asarray(record["RT"], dtype=np.float64).reshape(3, 4)
            k = np.asarray(record["K"], dtype=np.float64)[:3, :3].reshape(9)
        except (ValueError, TypeError, IndexError) as error:
            raise ValueError(f"{path}: image {name}: RT must be 3 × 4 and K 3 × 3 ({error})") from error
        rotation = world_to_camera[:, :3].T
        # To the right, downwards, forwards → to the right, upwards, backwards.
        axes = rotation * np.array([1.0, -1.0, -1.0])
        pose = np.concatenate([axes, -rotation @ world_to_camera[:, 3:]], axis=1)
        values = {"transform_matrix": pose, "fl_x": k[0], "fl_y": k[4], "cx": k[2], "cy": k[5]}
        # Of the position only the direction counts: the light is a distant one.
        light, _ = _light(path, i, {"light_direction": record.get("light_pos")})
        views.append(
            View(
                name=name,
                camera=_camera(path, name, values, image.shape[:2]),
                image=image,
                mask=mask,
                light=light,
                cut_out=cut_out,
            )
        )
    return views


def _json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: cannot be read as JSON ({error})") from error
    if isinstance(content, list):
        content = {"frames": content}
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected an object with frames, got {type(content).__name__}")
    return content


def _check_model(path: Path, content: dict[str, Any]) -> None:
    """Refuse lenses that `PosedCamera` does not know, by whatever key a program says so."""
    for values in (content, *(f for f in content["frames"] if isinstance(f, dict))):
        for key in ("camera_model", "camera_type", "lens"):
            model = values.get(key)
            if model not in _UNSET and str(model).upper() not in _MODELS:
                raise ValueError(
                    f"{path}: {key} must be one of {', '.join(_MODELS)}, got {model}: undistort the"
                    " photographs first"
                )
        for key in _FOREIGN:
            if key in values and _is_set(values[key]):
                raise ValueError(
                    f"{path}: {key} must be false, zero or left out, got {shown(values[key])}: dano knows"
                    " pinhole cameras with k1, k2, k3, p1, p2 of OpenCV; undistort the photographs first"
                )


def _is_set(value: Any) -> bool:
    """Whether a flag or numbers say something other than no."""
    if isinstance(value, str):
        return value.lower() not in ("", "false", "no", "0", "none")
    if isinstance(value, (list, tuple)):
        return any(_is_set(part) for part in value)
    return bool(value)


def _is_of_upright(path: Path, turned: PictureTurn, values: dict[str, Any]) -> bool:
    """Whether a camera is that of the upright picture, or of the pixels as they are stored.

    COLMAP, instant-ngp and others do not heed how a camera was held; `dano poses` does, and says `units`.

    Raises:
        ValueError: If it cannot be told.
    """
    if "units" in values:
        return True
    width, height = turned.size
    if turned.orientation >= 5 and width != height and "w" in values and "h" in values:
        try:
            return (float(values["w"]) > float(values["h"])) != (width > height)
        except (TypeError, ValueError):
            pass  # said where the camera is made
    raise ValueError(
        f"{path}: {turned.file.name} is stored turned (EXIF orientation {turned.orientation}), and"
        f" {'w and h do not say' if 'w' in values else 'there are no w and h to say'} whether its camera is"
        " that of the stored or of the upright pixels: write it upright without the tag, and find poses again"
    )


def _image_file(source: Path, name: str) -> Path:
    """The photograph; Blender's files leave the ending out."""
    base = source.parent / name
    for file in (base, *(base.with_name(base.name + ending) for ending in (".png", ".jpg", ".jpeg"))):
        if file.is_file():
            return file
    raise ValueError(f"{source}: image {name} is missing; looked for {base}")


def _camera(path: Path, name: str, values: dict[str, Any], shape: tuple[int, ...]) -> PosedCamera:
    height, width = shape
    try:
        stated = (int(values.get("h", height)), int(values.get("w", width)))
        # Smaller copies of photographs (nerfstudio's images_2) with the intrinsics of the original.
        scale = width / stated[1]
        if abs(stated[0] * scale - height) > 1:
            raise ValueError(f"image is {width} × {height} but w × h is {stated[1]} × {stated[0]}")
        if "fl_x" in values:
            focal = (float(values["fl_x"]), float(values.get("fl_y", values["fl_x"])))
        elif "camera_angle_x" in values:
            fx = 0.5 * stated[1] / math.tan(0.5 * float(values["camera_angle_x"]))
            angle = values.get("camera_angle_y")
            focal = (fx, fx if angle is None else 0.5 * stated[0] / math.tan(0.5 * float(angle)))
        else:
            raise ValueError("it states neither fl_x nor camera_angle_x")
        centre = (float(values.get("cx", 0.5 * stated[1])), float(values.get("cy", 0.5 * stated[0])))
        return PosedCamera(
            values["transform_matrix"],
            focal=np.multiply(focal, scale),
            centre=np.multiply(centre, scale),
            width=width,
            height=height,
            distortion=[float(values.get(key, 0.0)) for key in ("k1", "k2", "k3", "p1", "p2")],
        )
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: frame {name}: {error}") from error


def _light(path: Path, i: int, frame: dict[str, Any]) -> tuple[np.ndarray | None, bool]:
    for key, near in (("light_direction", False), ("light_position", True)):
        if frame.get(key) in _UNSET:
            continue
        light = np.asarray(frame[key], dtype=np.float64)
        if light.shape != (3,) or not np.all(np.isfinite(light)) or not np.any(light):
            raise ValueError(
                f"{path}: {key} of frame {i} must be three numbers, not all zero, got {frame[key]}"
            )
        return (light if near else light / np.linalg.norm(light)), near
    return None, False


def _split(path: Path, i: int, value: Any) -> str:
    split = {"val": "test", "eval": "test"}.get(str(value), str(value))
    if split not in SPLITS:
        raise ValueError(f"{path}: split of frame {i} must be one of {SPLITS}, got {value!r}")
    return split
