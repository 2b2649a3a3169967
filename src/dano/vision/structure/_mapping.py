"""Cameras and points in space from matched points, and what can be said about them.

Schönberger and Frahm 2016, *Structure-from-motion revisited*: pictures are added one after another, each
followed by bundle adjustment. pycolmap does it; thresholds are lower than its own, because small pictures of
plaster have few points. A global method was quicker on the dinosaur, but some of its cameras were wrong by
70 % of their distance.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dano.progress import Progress
from dano.vision.structure._colmap import colmap, interruptible
from dano.vision.structure._features import FEWEST_MATCHES, Matches
from dano.vision.structure._options import PoseOptions

_FEWEST_PICTURES = 3
"""Smallest model that is reported."""

_NEVER = 2**31 - 1
"""Residuals from which a bundle adjustment takes several threads."""

_THRESHOLDS: tuple[dict[str, int | float], ...] = (
    # Common points to begin with, points and their share to add a picture with.
    {"init_min_num_inliers": 40, "abs_pose_min_num_inliers": 12, "abs_pose_min_inlier_ratio": 0.1},
    # COLMAP's own: when the first pair of pictures was a poor one, they begin elsewhere.
    {"init_min_num_inliers": 100, "abs_pose_min_num_inliers": 30, "abs_pose_min_inlier_ratio": 0.25},
)


class Lens(NamedTuple):
    """Intrinsics of a picture [pixels of the upright picture], OpenCV's model."""

    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: tuple[float, float, float, float]


class SparseModel(NamedTuple):
    """Pictures whose cameras are known in one frame, whose scale and orientation mean nothing."""

    pictures: tuple[int, ...]  # Their indices
    # World to camera, x right, y down, z forward, by picture, shape (pictures, 3, 4).
    cameras: Float[np.ndarray, "pictures 3 4"]
    lenses: tuple[Lens, ...]  # By picture
    points: Float[np.ndarray, "points 3"]  # Points in space, shape (points, 3)
    # For each observation the row of `cameras` and of `points`, shape (observations, 2).
    seen: Int[np.ndarray, "observations 2"]
    coordinates: Float[np.ndarray, "observations 2"]  # And where [pixels], shape (observations, 2)
    # Distance between it and the projected point [pixels], shape (observations,).
    residuals: Float[np.ndarray, " observations"]
    # Standard deviation of each picture's focal length, as a share of it; 0 where it was given.
    focal_error: Float[np.ndarray, " pictures"]
    # Where focal lengths were given: by what factor they would change if they were estimated; 1 otherwise.
    freed_focal: float = 1.0
    freed_gain: float = 1.0  # And by what factor the residuals would fall

    @property
    def centres(self) -> Float[np.ndarray, "pictures 3"]:
        """Centres of projection."""
        return -np.einsum("nji,nj->ni", self.cameras[:, :, :3], self.cameras[:, :, 3])

    @property
    def error(self) -> float:
        """Root mean square of the residuals [pixels]."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def triangulation_angle(self) -> float:
        """Largest angle between two rays to a point, median over points [rad]."""
        away = self.points[self.seen[:, 1]] - self.centres[self.seen[:, 0]]
        away = away / np.linalg.norm(away, axis=1, keepdims=True)
        order = np.argsort(self.seen[:, 1], kind="stable")
        starts = np.flatnonzero(np.diff(self.seen[order, 1], prepend=-1))
        widest = [float(np.min(rays @ rays.T)) for rays in np.split(away[order], starts[1:]) if len(rays) > 1]
        return float(np.arccos(np.clip(np.median(widest), -1, 1))) if widest else 0.0


def find_models(
    matches: Matches, scales: list[float], options: PoseOptions, folder: Path, progress: Progress
) -> list[SparseModel]:
    """Models, the one with most pictures first; empty if there are none.

    Args:
        matches: Of all pictures.
        scales: By what factor each picture was enlarged for them.
        options: See there.
        folder: For files.
        progress: Told how far it is.
    """
    best: list[Any] = []
    for attempt, thresholds in enumerate(_THRESHOLDS):
        found = _attempt(matches, thresholds, options, folder / f"models{attempt}", progress)
        found.sort(key=lambda r: (-r.num_reg_images(), r.compute_mean_reprojection_error()))
        if found and (not best or found[0].num_reg_images() > best[0].num_reg_images()):
            best = found
        if best and best[0].num_reg_images() == len(scales):
            break
    return [_model(r, scales, options) for r in best if r.num_reg_images() >= _FEWEST_PICTURES]


def _attempt(
    matches: Matches,
    thresholds: dict[str, int | float],
    options: PoseOptions,
    folder: Path,
    progress: Progress,
) -> list[Any]:
    library = colmap()
    folder.mkdir()
    library.set_random_seed(options.seed)
    settings = library.IncrementalPipelineOptions()
    settings.random_seed = options.seed
    settings.extract_colors = False
    # Threads sum in different orders: what follows would not be the same twice.
    settings.num_threads = 1
    settings.ba_min_num_residuals_for_cpu_multi_threading = _NEVER
    settings.min_model_size = _FEWEST_PICTURES
    settings.min_num_matches = FEWEST_MATCHES
    settings.ba_refine_focal_length = options.focal is None
    settings.ba_refine_extra_params = options.focal is None
    settings.mapper.abs_pose_refine_focal_length = options.focal is None
    settings.mapper.abs_pose_refine_extra_params = options.focal is None
    settings.mapper.init_min_tri_angle = 8.0
    settings.mapper.init_max_forward_motion = 1.0
    for name, value in thresholds.items():
        setattr(settings.mapper, name, value)
    count = max(len(matches.points), 1)
    placed = [0]

    def next_picture() -> None:
        placed[0] += 1

    found = interruptible(
        library.incremental_mapping,
        matches.database,
        folder,
        folder,
        settings,
        next_image_callback=next_picture,
        poll=lambda: progress("placing cameras", placed[0] / count),
    )
    return list(found.values())


def _model(reconstruction: Any, scales: list[float], options: PoseOptions) -> SparseModel:
    """A reconstruction of COLMAP in numbers."""
    images = sorted(
        (reconstruction.image(key) for key in reconstruction.reg_image_ids()), key=lambda image: image.name
    )
    pictures = tuple(int(image.name[:5]) for image in images)
    rows = {key: row for row, key in enumerate(sorted(reconstruction.point3D_ids()))}
    points = np.array([reconstruction.point3D(key).xyz for key in rows]).reshape(-1, 3)
    seen, coordinates, residuals = [], [], []
    for i, image in enumerate(images):
        observed = [p for p in image.points2D if p.has_point3D()]
        row = [rows[p.point3D_id] for p in observed]
        where = np.array([p.xy for p in observed]).reshape(-1, 2)
        camera = image.cam_from_world()
        local = points[row] @ camera.rotation.matrix().T + camera.translation
        projected = np.asarray(image.camera.img_from_cam(local)).reshape(-1, 2)
        seen.append(np.stack([np.full(len(row), i), np.array(row, dtype=np.int64)], axis=1))
        coordinates.append(where / scales[pictures[i]])
        residuals.append(np.linalg.norm(projected - where, axis=1) / scales[pictures[i]])
    errors = {} if options.focal is not None else _focal_errors(reconstruction)
    freed, gain = (1.0, 1.0) if options.focal is None else _freed(reconstruction)
    return SparseModel(
        pictures=pictures,
        cameras=np.array([image.cam_from_world().matrix() for image in images]),
        lenses=tuple(_lens(image.camera, scales[i]) for image, i in zip(images, pictures, strict=True)),
        points=points,
        seen=np.concatenate(seen),
        coordinates=np.concatenate(coordinates),
        residuals=np.concatenate(residuals),
        focal_error=np.array([errors.get(image.camera_id, 0.0) for image in images]),
        freed_focal=freed,
        freed_gain=gain,
    )


def _lens(camera: Any, scale: float) -> Lens:
    numbers = list(camera.params)
    distortion = (0.0, 0.0, 0.0, 0.0)
    if camera.model_name == "OPENCV":
        k1, k2, p1, p2 = map(float, numbers[4:8])
        distortion = (k1, k2, p1, p2)
    elif camera.model_name == "SIMPLE_RADIAL":
        distortion = (float(numbers[3]), 0.0, 0.0, 0.0)
    return Lens(
        focal=(camera.focal_length_x / scale, camera.focal_length_y / scale),
        centre=(camera.principal_point_x / scale, camera.principal_point_y / scale),
        distortion=distortion,
    )


def _focal_errors(reconstruction: Any) -> dict[int, float]:
    """Relative standard deviations of focal lengths by camera, if residuals are independent."""
    library = colmap()
    adjuster = _adjuster(reconstruction, extra=True)
    wanted = library.BACovarianceOptions()
    wanted.params = library.BACovarianceOptionsParams.ALL
    covariance = library.estimate_ba_covariance(wanted, reconstruction, adjuster)
    if covariance is None:
        return {}
    errors = {}
    squares = reconstruction.compute_mean_reprojection_error() ** 2
    for key, camera in reconstruction.cameras.items():
        block = covariance.get_other_params_cov(camera.params)
        if block is not None:
            errors[key] = float(np.sqrt(squares * block[0, 0])) / camera.mean_focal_length()
    return errors


def _freed(reconstruction: Any) -> tuple[float, float]:
    """By what factors given focal lengths and the residuals change when they are estimated after all."""
    free = colmap().Reconstruction(reconstruction)
    before = {key: camera.mean_focal_length() for key, camera in free.cameras.items()}
    free.update_point_3d_errors()
    error = free.compute_mean_reprojection_error()
    _adjuster(free, extra=False).solve()
    free.update_point_3d_errors()
    used = {image.camera_id for image in free.images.values() if image.has_pose}
    factors = [free.cameras[key].mean_focal_length() / before[key] for key in sorted(used)]
    return float(np.median(factors)), error / max(free.compute_mean_reprojection_error(), 1e-9)


def _adjuster(reconstruction: Any, *, extra: bool) -> Any:
    """Bundle adjustment of everything, and of distortion if `extra`."""
    library = colmap()
    options = library.BundleAdjustmentOptions()
    options.refine_extra_params = extra
    options.ceres.min_num_residuals_for_cpu_multi_threading = _NEVER
    options.print_summary = False
    settings = library.BundleAdjustmentConfig()
    for key in reconstruction.reg_image_ids():
        settings.add_image(key)
    settings.fix_gauge(library.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    return library.create_default_ceres_bundle_adjuster(options, settings, reconstruction)
