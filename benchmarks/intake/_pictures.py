"""A picture of a disc in every variant of file, mask, alpha and camera, read as captures are."""

import importlib.util
import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.intake._verdict import Case, Outcome, verdict
from dano.vision import load_capture
from dano.vision.capture import read_mask, read_picture

_SIZE = (48, 64)
_AWAY = np.hypot(*(np.mgrid[: _SIZE[0], : _SIZE[1]] - np.array([20.5, 29.5])[:, None, None]))
_DISC = _AWAY < 15
_ALPHA = np.clip((17 - _AWAY) / 4, 0, 1)
_COLOUR = np.array([0.8, 0.5, 0.3])
_TAG = 0x0112
_QUALITY: dict[str, dict[str, Any]] = {kind: {"quality": 95} for kind in ("jpg", "webp", "heic", "avif")}


def cases() -> list[Case]:
    """All of them, by name."""
    found: list[Case] = []
    for kind in ("png", "jpg", "webp", "bmp", "tiff", "heic", "avif"):
        if kind == "heic" and importlib.util.find_spec("pillow_heif") is None:
            continue
        found.append((f"picture as .{kind}", lambda k=kind: _as_file(k)))
    for name, make in _MODES.items():
        found.append((f"picture, {name}", lambda m=make: _with_mode(m)))
    for name, make in _MASKS.items():
        found.append((f"mask, {name}", lambda m=make: _masked(m)))
    found.append(
        ("mask of three labels", lambda: _mask_refused(np.digitize(_AWAY, [8, 15]).astype(np.uint8)))
    )
    for colour in (_COLOUR, 0.08 * _COLOUR):
        for kind in ("straight", "premultiplied"):
            name = f"{kind} alpha, {'dark' if colour.max() < 0.2 else 'bright'}"
            found.append((name, lambda c=colour, k=kind: _with_alpha(c, k)))
    for tag in range(1, 9):
        for whose in ("stored", "upright"):
            found.append((f"EXIF {tag}, camera of the {whose} pixels", lambda t=tag, w=whose: _turned(t, w)))
    for key, value in _FLAGS.items():
        found.append((f"camera with {key} = {value}", lambda k=key, v=value: _flagged({k: v})))
    return found


def _capture(folder: Path, file: str, frame: dict[str, Any] | None = None, **keys: Any) -> Any:
    frames = [{"file_path": file, "transform_matrix": np.eye(4).tolist(), **(frame or {})}]
    content = {"fl_x": 60.0, "w": _SIZE[1], "h": _SIZE[0], "frames": frames, **keys}
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
    return load_capture(folder).views[0]


def _in_folder(work: Callable[[Path], Outcome]) -> Outcome:
    with tempfile.TemporaryDirectory() as folder:
        return work(Path(folder))


def _picture() -> np.ndarray:
    return np.rint(255 * np.where(_DISC[..., None], _COLOUR, 0.1)).astype(np.uint8)


def _as_file(kind: str) -> Outcome:
    def work(folder: Path) -> Outcome:
        if kind == "heic":
            import pillow_heif

            pillow_heif.register_heif_opener()
        Image.fromarray(_picture()).save(folder / f"a.{kind}", **_QUALITY.get(kind, {}))
        inner, outer = _AWAY < 12, _AWAY > 18

        def is_right(view: Any) -> bool:
            off = np.abs(view.image - _picture() / 255)
            return bool(off[inner].mean() < 0.02 and off[outer].mean() < 0.02)

        return verdict(lambda: _capture(folder, f"a.{kind}"), is_right)

    return _in_folder(work)


_MODES: dict[str, Callable[[], Any]] = {
    "grey of 8 bits": lambda: Image.fromarray(_picture()[..., 0]),
    "grey of 16 bits": lambda: Image.fromarray(257 * _picture()[..., 0].astype(np.uint16)),
    "dark grey of 16 bits": lambda: Image.fromarray(_picture()[..., 0].astype(np.uint16)),
    "palette": lambda: Image.fromarray(_picture()).quantize(8),
    "opaque RGBA": lambda: Image.fromarray(_picture()).convert("RGBA"),
    "opaque LA": lambda: Image.fromarray(_picture()[..., 0]).convert("LA"),
    "one bit": lambda: Image.fromarray(_DISC),
}


def _with_mode(make: Callable[[], Any]) -> Outcome:
    def work(folder: Path) -> Outcome:
        picture = make()
        picture.save(folder / "a.png")
        if picture.mode.startswith("I;16"):
            truth = np.repeat(np.asarray(picture, float)[..., None] / 65535, 3, axis=2)
        else:
            truth = np.asarray(picture.convert("RGB"), float) / 255

        def is_right(view: Any) -> bool:
            return bool(np.abs(view.image - truth).max() < 0.003 and view.mask is None)

        return verdict(lambda: _capture(folder, "a.png"), is_right)

    return _in_folder(work)


def _palette(colours: list[tuple[int, int, int]]) -> Any:
    picture = Image.fromarray(_DISC.astype(np.uint8), "P")
    picture.putpalette([v for colour in colours for v in colour] + [0] * (768 - 3 * len(colours)))
    return picture


_MASKS: dict[str, Callable[[], Any]] = {
    "0 and 255": lambda: Image.fromarray(255 * _DISC.astype(np.uint8)),
    "0 and 1": lambda: Image.fromarray(_DISC.astype(np.uint8)),
    "0 and 2": lambda: Image.fromarray(2 * _DISC.astype(np.uint8)),
    "0 and 128": lambda: Image.fromarray(128 * _DISC.astype(np.uint8)),
    "one bit": lambda: Image.fromarray(_DISC),
    "16 bits": lambda: Image.fromarray(65535 * _DISC.astype(np.uint16)),
    "16 bits, 0 and 1": lambda: Image.fromarray(_DISC.astype(np.uint16)),
    "palette of grey": lambda: _palette([(0, 0, 0), (255, 255, 255)]),
    "palette of a label": lambda: _palette([(0, 0, 0), (128, 0, 0)]),
    "RGB": lambda: Image.fromarray(np.repeat(255 * _DISC[..., None], 3, axis=2).astype(np.uint8)),
    "RGBA, opaque": lambda: Image.fromarray(255 * _DISC.astype(np.uint8)).convert("RGBA"),
    "LA, opaque": lambda: Image.fromarray(255 * _DISC.astype(np.uint8)).convert("LA"),
    "alpha": lambda: Image.fromarray(np.dstack([np.full((*_SIZE, 3), 90), 255 * _DISC]).astype(np.uint8)),
}


def _masked(make: Callable[[], Any]) -> Outcome:
    def work(folder: Path) -> Outcome:
        Image.fromarray(_picture()).save(folder / "a.png")
        make().save(folder / "m.png")

        def is_right(view: Any) -> bool:
            return bool(view.mask is not None and np.array_equal(view.mask > 0.5, _DISC))

        return verdict(lambda: _capture(folder, "a.png", {"mask_path": "m.png"}), is_right)

    return _in_folder(work)


def _mask_refused(labels: np.ndarray) -> Outcome:
    def work(folder: Path) -> Outcome:
        Image.fromarray(labels).save(folder / "m.png")
        return verdict(lambda: read_mask(folder / "m.png"), None)

    return _in_folder(work)


def _with_alpha(colour: np.ndarray, kind: str) -> Outcome:
    def work(folder: Path) -> Outcome:
        alone = colour * _ALPHA[..., None]
        stored = alone if kind == "premultiplied" else np.broadcast_to(colour, (*_SIZE, 3))
        rgba = np.concatenate([stored, _ALPHA[..., None]], axis=2)
        Image.fromarray(np.rint(255 * rgba).astype(np.uint8)).save(folder / "a.png")

        def is_right(view: Any) -> bool:
            return bool(np.abs(view.image - alone).max() < 0.006 and np.abs(view.mask - _ALPHA).max() < 0.003)

        return verdict(lambda: _capture(folder, "a.png"), is_right)

    return _in_folder(work)


def _turned(tag: int, whose: str) -> Outcome:
    """A camera of stored or of upright pixels; where w and h cannot tell, it must be refused."""

    def work(folder: Path) -> Outcome:
        exif = Image.Exif()
        exif[_TAG] = tag
        stored = _picture()
        Image.fromarray(stored).save(folder / "a.png", exif=exif)
        upright = read_picture(folder / "a.png").colours
        wanted = stored / 255 if whose == "stored" else upright
        size = {"w": wanted.shape[1], "h": wanted.shape[0]}

        def is_right(view: Any) -> bool:
            return bool(view.image.shape == wanted.shape and np.abs(view.image - wanted).max() < 0.003)

        ambiguous = 2 <= tag <= 4
        return verdict(lambda: _capture(folder, "a.png", **size), None if ambiguous else is_right)

    return _in_folder(work)


_FLAGS = {
    "is_fisheye": True,
    "camera_model": "OPENCV_FISHEYE",
    "camera_type": "EQUIRECTANGULAR",
    "k4": 0.02,
    "k5": 0.02,
    "rolling_shutter": [0, 0, 0.01, 0],
    "ftheta_p1": 0.1,
}


def _flagged(keys: dict[str, Any]) -> Outcome:
    def work(folder: Path) -> Outcome:
        Image.fromarray(_picture()).save(folder / "a.png")
        return verdict(lambda: _capture(folder, "a.png", **keys), None)

    return _in_folder(work)
