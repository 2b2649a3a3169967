"""`transforms.json`: cameras in the form that nerfstudio writes and `load_capture` reads."""

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from dano.archive import checked_output, replacing
from dano.vision.structure._estimate import EstimatedPoses, PosedPicture


def save_transforms(poses: EstimatedPoses, path: str | Path) -> None:
    """Write cameras beside what is known of them.

    Pictures are named relative to the file's folder. Additional entries, which other readers skip: `units`
    ("m", or "arbitrary" where the scale is not known), `scale`, `up`, `left_out`, `models`,
    `reprojection_error`.

    Args:
        poses: What `estimate_poses` found.
        path: Where to, *.json.

    Raises:
        ValueError: If it cannot be written.
    """
    target = checked_output(path)
    known = poses.scale.metres is not None
    content = {
        "camera_model": "OPENCV",
        "units": "m" if known else "arbitrary",
        "scale": {"source": poses.scale.source, "relative_error": _finite(poses.scale.error)},
        "up": {"source": poses.up.source, "error_degrees": _finite(math.degrees(poses.up.error))},
        "reprojection_error": poses.error,
        "models": list(poses.models),
        "left_out": [{"file": name, "reason": reason} for name, reason in poses.left_out],
        "frames": [_frame(picture, target.resolve().parent) for picture in poses.pictures],
    }
    with replacing(target) as file:
        file.write((json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _frame(picture: PosedPicture, folder: Path) -> dict[str, Any]:
    camera = picture.camera
    k1, k2, k3, p1, p2 = (float(k) for k in camera.distortion)
    pose = np.concatenate([camera.pose, [[0.0, 0.0, 0.0, 1.0]]])
    masked = {} if picture.mask_file is None else {"mask_path": _relative(picture.mask_file, folder)}
    return {
        "file_path": _relative(picture.file, folder),
        **masked,
        "w": camera.width,
        "h": camera.height,
        "fl_x": float(camera.focal[0]),
        "fl_y": float(camera.focal[1]),
        "cx": float(camera.centre[0]),
        "cy": float(camera.centre[1]),
        **{"k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2},
        "transform_matrix": pose.tolist(),
    }


def _relative(file: Path, folder: Path) -> str:
    return Path(os.path.relpath(file.resolve(), folder)).as_posix()
