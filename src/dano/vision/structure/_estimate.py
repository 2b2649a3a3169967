"""From pictures to cameras: the whole way.

`transforms.json`: cameras in the form that nerfstudio writes and `load_capture` reads.
"""

import json
import math
import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from dano.archive import checked_output, replacing
from dano.checks import checked_items, checked_optional, checked_path, checked_progress
from dano.progress import Progress
from dano.vision.capture import PosedCamera
from dano.vision.structure import _diagnosis, _gauge, _photographs
from dano.vision.structure._colmap import colmap, opencv, quiet
from dano.vision.structure._features import enlargement, find_matches, Matches, where_points_count
from dano.vision.structure._mapping import find_models, Lens, SparseModel
from dano.vision.structure._markers import detect_markers, place_markers, PlacedMarker
from dano.vision.structure._options import FEWEST, PoseOptions
from dano.vision.structure._similarity import Similarity

_PLAIN = 6.0
"""Contrast [grey levels] below which surroundings are plain."""

_STANDS_STILL = 0.8
"""Correlation between the surroundings of two pictures from which on they stand still."""


class PosedPicture(NamedTuple):
    """A picture with its camera."""

    name: str  # Of the file
    file: Path  # The file
    mask_file: Path | None  # Its mask's; None if there is none
    camera: PosedCamera  # In W
    error: float  # Root mean square reprojection error of its points [pixels]
    n_points: int  # Their number


class EstimatedPoses(NamedTuple):
    """What structure from motion found."""

    pictures: tuple[PosedPicture, ...]  # Those with a camera
    left_out: tuple[tuple[str, str], ...]  # Name and reason of the others
    models: tuple[int, ...]  # Number of pictures of each model that was found, largest first
    model: int  # Which of them this is, from 0
    error: float  # Root mean square reprojection error [pixels]
    focal_error: float  # Standard deviation of the focal length, as a share of it; 0 where it was given
    triangulation_angle: float  # Largest angle between two rays to a point, median over points [rad]
    n_points: int  # Number of points in space
    features_on: str  # Where points were looked for
    scale: _gauge.Scale  # Of the model, with its uncertainty
    up: _gauge.Up  # Where up is, in W if it is known (0, 0, 1), with its uncertainty
    markers: tuple[PlacedMarker, ...]  # Printed markers that were found, in units of the model
    warnings: tuple[str, ...]  # What to know before using it


def estimate_poses(
    images: str | Path | Sequence[Path],
    options: PoseOptions | None = None,
    *,
    masks: str | Path | None = None,
    frames: str | Path | None = None,
    progress: Progress | None = None,
) -> EstimatedPoses:
    """Find where pictures were taken from, by structure from motion.

    Args:
        images: A folder of pictures (or one with `images` in it), a video, or a list of pictures, videos and
            folders.
        options: How; see there.
        masks: Folder with a mask for each picture, bright where the object is; default: `masks` in or beside
            the folder of pictures, or their alpha channel.
        frames: New folder for the frames of a video; it is removed again if no cameras are found.
        progress: Called with what is being done and how far it is; what it raises stops the work.

    Returns:
        Cameras in W, where lengths are metres if a marker or a known length says so, and z is up.

    Raises:
        ValueError: If there are too few pictures, or they show no cameras; says why.
        ImportError: If pycolmap, OpenCV or, for a video, av is missing.
    """
    options = checked_optional("options", options, PoseOptions) or PoseOptions()
    if isinstance(images, (str, os.PathLike)):
        images = checked_path("images", images)
    else:
        images = checked_items("images", images, Path)
    told = checked_progress(progress)
    # What is missing is said before work starts.
    colmap()
    opencv()
    between = _photographs.stretch(options.since, options.until)
    if not isinstance(images, (str, Path)) and len(images) == 1 and _photographs.is_video(images[0]):
        images = images[0]
    if isinstance(images, (str, Path)) and _photographs.is_video(Path(images)):
        if frames is None:
            raise ValueError("frames must be a folder for the frames of the video, got None")
        files = _photographs.write_frames(Path(images), Path(frames), options.frames, told, between=between)
        try:
            return _from_files(files, options, masks, told, ordered=True)
        except BaseException:
            shutil.rmtree(frames, ignore_errors=True)
            raise
    if isinstance(images, (str, Path)):
        return _from_files(_photographs.picture_files(Path(images)), options, masks, told, ordered=False)
    videos = _videos(images, frames)
    try:
        files = _listed(images, videos, frames, options, between, told)
        return _from_files(_photographs.picture_files(files), options, masks, told, ordered=False)
    except BaseException:
        if videos and frames is not None:
            shutil.rmtree(frames, ignore_errors=True)
        raise


def _videos(images: Sequence[Path], frames: str | Path | None) -> list[Path]:
    """Those of a list that are videos, after a check of where their frames go.

    Raises:
        ValueError: If it holds something, or two videos have one name.
    """
    videos = [file for file in images if _photographs.is_video(file)]
    if not videos:
        return []
    if frames is None:
        raise ValueError("frames must be a folder for the frames of the videos, got None")
    if len({video.stem for video in videos}) < len(videos):
        raise ValueError(f"videos must have different names, got {', '.join(v.name for v in videos)}")
    place = Path(frames)
    if place.exists() and (not place.is_dir() or any(place.iterdir())):
        raise ValueError(f"frames must be a new or empty folder, got {place}")
    return videos


def _listed(
    images: Sequence[Path],
    videos: Sequence[Path],
    frames: str | Path | None,
    options: PoseOptions,
    between: tuple[float, float],
    told: Progress,
) -> list[Path]:
    """The pictures of a list: files, those in folders, and frames of videos, which share `options.frames`."""
    files: list[Path] = []
    for file in images:
        if frames is not None and file in videos:
            Path(frames).mkdir(exist_ok=True)
            count = max(1, options.frames // len(videos))
            place = Path(frames) / file.stem
            files += _photographs.write_frames(
                file, place, count, told, prefix=f"{file.stem}_", between=between
            )
        else:
            files += _photographs.picture_files(file) if file.is_dir() else [file]
    return files


def _from_files(
    files: list[Path], options: PoseOptions, masks: str | Path | None, told: Progress, *, ordered: bool
) -> EstimatedPoses:
    photographs, left_out = _read(files, masks, told)
    if len(photographs) < FEWEST:
        raise ValueError(_diagnosis.too_few(len(photographs), left_out))
    on = _features_on(photographs, options.features_on)
    counted = [where_points_count(photograph.mask, on) for photograph in photographs]
    with tempfile.TemporaryDirectory(prefix="dano-poses-") as folder, quiet():
        matches = find_matches(photographs, counted, options, Path(folder), ordered=ordered, progress=told)
        if (still := _diagnosis.stands_still(photographs, matches)) is not None:
            # It hides what moves: few points of the object are among the strongest of a picture.
            cleaned, again = _photographs.without_what_stays(photographs, counted), Path(folder) / "again"
            again.mkdir()
            matches = find_matches(cleaned, counted, options, again, ordered=ordered, progress=told)
        if fault := _diagnosis.motion_fault(photographs, matches, options, still=still):
            raise ValueError(f"no cameras: {fault}")
        scales = [enlargement(photograph) for photograph in photographs]
        models = find_models(matches, scales, options, Path(folder), told)
    if not models or len(models[0].pictures) < FEWEST:
        raise ValueError(f"no cameras: {_diagnosis.why_none(photographs, matches)}")
    if options.model > len(models):
        raise ValueError(f"model must be at most {len(models)}, the number of models, got {options.model}")
    return _result(photographs, left_out, matches, models, options, on, told)


def _read(
    files: list[Path], masks: str | Path | None, told: Progress
) -> tuple[list[_photographs.Photograph], list[tuple[str, str]]]:
    photographs, left_out = [], []
    folder = _photographs.mask_folder(files[0], None if masks is None else Path(masks)) if files else None
    for i, file in enumerate(files):
        told("reading pictures", i / len(files))
        try:
            photographs.append(_photographs.read_photograph(file, folder))
        except ValueError as error:
            left_out.append((file.name, str(error)))
    return photographs, left_out


def _features_on(photographs: Sequence[_photographs.Photograph], asked: str) -> str:
    """Where to look for points: see `PoseOptions.features_on`.

    Raises:
        ValueError: If it needs masks and there are none.
    """
    masked = [photograph for photograph in photographs if photograph.mask is not None]
    if len(masked) < len(photographs):
        if asked in ("object", "surroundings"):
            raise ValueError(
                f"features_on={asked!r} needs a mask for every picture, {len(photographs) - len(masked)} of"
                f" {len(photographs)} have none"
            )
        return "everything"
    if asked != "auto":
        return asked
    around = [_surroundings(photograph) for photograph in masked]
    contrast = [float(np.std(values[seen])) if seen.any() else 0.0 for values, seen in around]
    if np.median(contrast) < _PLAIN:
        return "object"
    alike = [
        float(np.corrcoef(a[both], b[both])[0, 1])
        for (a, in_a), (b, in_b) in zip(around, around[1:], strict=False)
        if a.shape == b.shape and (both := in_a & in_b).sum() > 50 and min(a[both].std(), b[both].std()) > 0
    ]
    return "object" if alike and np.median(alike) > _STANDS_STILL else "surroundings"


def _surroundings(photograph: _photographs.Photograph) -> tuple[np.ndarray, np.ndarray]:
    """A picture without its slow changes of brightness, reduced; and where it does not show the object."""
    step = max(1, max(photograph.size) // 160)
    grey = photograph.grey[::step, ::step].astype(np.float64)
    assert photograph.mask is not None
    far = ~ndimage.binary_dilation(photograph.mask[::step, ::step] > 0.1, iterations=3)
    # Averages of what is around the object only: its own brightness must not reach into a dark background.
    near = ndimage.gaussian_filter(np.where(far, grey, 0.0), 8)
    return grey - near / np.maximum(ndimage.gaussian_filter(far.astype(np.float64), 8), 1e-3), far


def _posed(lens: Lens, world_to_camera: np.ndarray, size: tuple[int, int]) -> PosedCamera:
    rotation = world_to_camera[:, :3].T
    # To the right, downwards, forwards → to the right, upwards, backwards.
    axes = rotation * np.array([1.0, -1.0, -1.0])
    pose = np.concatenate([axes, -rotation @ world_to_camera[:, 3:]], axis=1)
    k1, k2, p1, p2 = lens.distortion
    return PosedCamera(
        pose,
        focal=lens.focal,
        centre=lens.centre,
        width=size[0],
        height=size[1],
        distortion=(k1, k2, 0.0, p1, p2),
    )


def _result(
    photographs: list[_photographs.Photograph],
    left_out: list[tuple[str, str]],
    matches: Matches,
    models: list[SparseModel],
    options: PoseOptions,
    on: str,
    told: Progress,
) -> EstimatedPoses:
    chosen = options.model - 1
    model = models[chosen]
    shown = [photographs[i] for i in model.pictures]
    cameras = [
        _posed(lens, pose, photograph.size)
        for lens, pose, photograph in zip(model.lenses, model.cameras, shown, strict=True)
    ]
    markers = _markers(shown, cameras, options, told)
    warnings = _diagnosis.doubts(photographs, models, chosen, options)
    scale = _scale(shown, cameras, markers, options, warnings)
    up = _up(shown, cameras, markers, model, options, warnings)
    frame = _gauge.world_frame(cameras, scale, up, markers)
    return EstimatedPoses(
        pictures=_pictures(shown, cameras, model, frame),
        left_out=tuple(
            left_out
            + [
                (photograph.name, _diagnosis.why_left_out(i, photographs, matches, models, chosen))
                for i, photograph in enumerate(photographs)
                if i not in model.pictures
            ]
        ),
        models=tuple(len(m.pictures) for m in models),
        model=chosen,
        error=model.error,
        focal_error=float(np.max(model.focal_error)),
        triangulation_angle=model.triangulation_angle,
        n_points=len(model.points),
        features_on=on,
        scale=scale,
        up=up._replace(direction=None if up.direction is None else np.array([0.0, 0.0, 1.0])),
        markers=tuple(markers),
        warnings=tuple(warnings),
    )


def _pictures(
    shown: list[_photographs.Photograph], cameras: list[PosedCamera], model: SparseModel, frame: Similarity
) -> tuple[PosedPicture, ...]:
    pictures = []
    for i, (photograph, camera) in enumerate(zip(shown, cameras, strict=True)):
        residuals = model.residuals[model.seen[:, 0] == i]
        error = float(np.sqrt(np.mean(residuals**2))) if len(residuals) else math.inf
        pictures.append(
            PosedPicture(
                photograph.name,
                photograph.file,
                photograph.mask_file,
                frame.camera(camera),
                error,
                len(residuals),
            )
        )
    return tuple(pictures)


def _markers(
    shown: list[_photographs.Photograph], cameras: list[PosedCamera], options: PoseOptions, told: Progress
) -> list[PlacedMarker]:
    if options.marker_size is None:
        return []
    seen = []
    for i, photograph in enumerate(shown):
        told("looking for markers", i / len(shown))
        seen.append(detect_markers(photograph.grey, options.marker_family))
    return place_markers(cameras, seen)


def _scale(
    shown: list[_photographs.Photograph],
    cameras: list[PosedCamera],
    markers: list[PlacedMarker],
    options: PoseOptions,
    warnings: list[str],
) -> _gauge.Scale:
    """The most exact of the answers, compared with the other."""
    answers = []
    if options.marker_size is not None:
        if markers:
            answers.append(_gauge.marker_scale(markers, options.marker_size))
        else:
            warnings.append(
                f"no marker of {options.marker_family} is seen in three pictures: is the family right, has"
                f" the"
                " sheet a white border?"
            )
    if options.known_length is not None:
        named = {p.name: camera for p, camera in zip(shown, cameras, strict=True)}
        answers.append(_gauge.length_scale(options.known_length, named))
    if not answers:
        warnings.append("the scale is not known, lengths are in units of the cameras' mean distance")
        return _gauge.UNKNOWN_SCALE
    best, *others = sorted(answers, key=lambda answer: answer.error)
    for other in others:
        assert best.metres is not None and other.metres is not None
        apart = abs(other.metres / best.metres - 1)
        if apart > 3 * math.hypot(best.error, other.error):
            warnings.append(f"{other.source} and {best.source} differ by {100 * apart:.1f} %")
    if best.error > 0.02:
        warnings.append(f"the scale is known to {100 * best.error:.1f} % only")
    return best


def _up(
    shown: list[_photographs.Photograph],
    cameras: list[PosedCamera],
    markers: list[PlacedMarker],
    model: SparseModel,
    options: PoseOptions,
    warnings: list[str],
) -> _gauge.Up:
    """The first that can be had of those asked for."""
    if options.up == "none":
        return _gauge.UNKNOWN_UP
    if options.up in ("auto", "marker"):
        if up := _gauge.marker_up(markers, cameras):
            return up
        if options.up == "marker":
            raise ValueError("up='marker', but no marker is seen lying flat in three pictures")
    if options.up in ("auto", "plane"):
        if up := _gauge.plane_up(_around_object(shown, model), cameras, options.seed):
            return up
        if options.up == "plane":
            raise ValueError("up='plane', but no plane below the cameras holds a quarter of the points")
    up = _gauge.cameras_up(cameras)
    warnings.append(f"up is only taken from how the cameras were held, to {math.degrees(up.error):.1f}°")
    return up


def _around_object(shown: list[_photographs.Photograph], model: SparseModel) -> np.ndarray:
    """Points that most pictures show beside the object; all where there are no masks."""
    inside, count = np.zeros(len(model.points)), np.zeros(len(model.points))
    for i, photograph in enumerate(shown):
        if photograph.mask is None:
            continue
        mine = model.seen[:, 0] == i
        x, y = model.coordinates[mine].astype(int).T
        height, width = photograph.mask.shape
        on = photograph.mask[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)] > 0.5
        np.add.at(inside, model.seen[mine, 1], on)
        np.add.at(count, model.seen[mine, 1], 1)
    return model.points[inside <= 0.5 * count]


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
