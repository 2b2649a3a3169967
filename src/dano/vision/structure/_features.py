"""Points that several pictures show: found by SIFT, matched between pictures, checked by geometry.

Lowe 2004, *Distinctive image features from scale-invariant keypoints*; pycolmap does the work. What is done
here decides whether it succeeds: small pictures are enlarged, contrast is made even (on plaster it is faint
everywhere but at shadows), weak points are taken, too, and masks say where.
"""

from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from dano.progress import Progress
from dano.vision.structure._colmap import colmap, interruptible, opencv
from dano.vision.structure._options import PoseOptions
from dano.vision.structure._photographs import Photograph

_SMALL, _LARGE = 640, 1600
"""Longest side [pixels] that pictures are enlarged to, but at most twice as large, and reduced to."""

_WEAK = 0.002
"""Contrast of the weakest points, a third of COLMAP's; on plaster every second point is below that."""

_MARGIN = 0.004
"""By how much masks are widened, as a share of the picture's longest side: silhouettes have points, too."""

_ALL_PAIRS = 150
"""Pictures of which every pair is compared; of more, neighbours in order and pairs ever further apart."""

STILL = 1.0
"""Motion between two pictures [pixels] below which a point stands still."""

FEWEST_MATCHES = 12
"""Common points of two pictures below which they are taken for chance."""

_CHUNK, _PAIRS_CHUNK = 8, 200
"""Pictures, and pairs of them, that are worked on between looks at the progress."""


class Matches(NamedTuple):
    """What pictures have in common."""

    database: Path  # File of COLMAP
    points: Int[np.ndarray, " pictures"]  # Number of points by picture
    # Coordinates x, y of points by picture [pixels of the upright picture].
    coordinates: tuple[np.ndarray, ...]
    pairs: Int[np.ndarray, "pairs 2"]  # Indices of compared pictures, shape (pairs, 2)
    raw: Int[np.ndarray, " pairs"]  # Number of similar points by pair
    # Median distance by pair between the places of similar points in its pictures [pixels]; NaN where there
    # are too few.
    moved: Float[np.ndarray, " pairs"]
    # Indices of points in both pictures that one motion explains, by pair, each of shape (matches, 2).
    verified: tuple[np.ndarray, ...]


def enlargement(photograph: Photograph) -> float:
    """By how much a picture is enlarged before points are looked for."""
    longest = max(photograph.size)
    return min(_SMALL / longest, 2.0) if longest < _SMALL else min(_LARGE / longest, 1.0)


def find_matches(
    photographs: Sequence[Photograph],
    masks: Sequence[np.ndarray | None],
    options: PoseOptions,
    folder: Path,
    *,
    ordered: bool,
    progress: Progress,
) -> Matches:
    """Find points in all pictures and match them.

    Args:
        photographs: The pictures.
        masks: For each, where points count.
        options: See there.
        folder: For files.
        ordered: Whether the pictures are frames of a video, neighbours similar.
        progress: Told how far it is; what it raises stops the work.
    """
    pictures = folder / "pictures"
    pictures.mkdir()
    (folder / "masks").mkdir()
    database = folder / "database.db"
    names = [f"{i:05d}.png" for i in range(len(photographs))]
    for i, (photograph, mask) in enumerate(zip(photographs, masks, strict=True)):
        progress("looking for points", 0.2 * i / len(names))
        _write_prepared(photograph, mask, folder, names[i])
    done = 0
    for members in _by_camera(photographs):
        for start in range(0, len(members), _CHUNK):
            chunk = members[start : start + _CHUNK]
            share = 0.2 + 0.8 * done / len(names)
            _extract(
                folder,
                [names[i] for i in chunk],
                photographs[chunk[0]],
                options,
                _camera_of(database, names[members[0]]) if start else -1,
                lambda share=share: progress("looking for points", share),
            )
            done += len(chunk)
        number_by_name(database, [names[i] for i in members])
    pairs = _pairs(len(names), ordered)
    for start in range(0, len(pairs), _PAIRS_CHUNK):
        chunk = [(names[a], names[b]) for a, b in pairs[start : start + _PAIRS_CHUNK]]
        share = start / len(pairs)
        _match(database, folder, chunk, options, lambda share=share: progress("matching pictures", share))
    return _read(database, photographs)


def _write_prepared(photograph: Photograph, mask: np.ndarray | None, folder: Path, name: str) -> None:
    cv2 = opencv()
    scale = enlargement(photograph)
    even = cv2.createCLAHE(clipLimit=3.0, tileGridSize=(8, 8)).apply(np.ascontiguousarray(photograph.grey))
    cv2.imwrite(str(folder / "pictures" / name), _scaled(even, scale))
    if mask is not None:
        cover = _scaled((255 * mask).astype(np.uint8), scale)
        cv2.imwrite(str(folder / "masks" / f"{name}.png"), np.where(cover > 127, 255, 0).astype(np.uint8))


def _scaled(image: np.ndarray, scale: float) -> np.ndarray:
    """Exactly so many times as large: sides that are rounded would be another focal length along each."""
    if scale == 1:
        return image
    cv2 = opencv()
    size = tuple(max(round(scale * side), 1) for side in image.shape[::-1])
    shift = 0.5 * scale - 0.5
    if scale < 1:
        image = cv2.GaussianBlur(image, (0, 0), 0.4 / scale)
    return cv2.warpAffine(
        image,
        np.array([[scale, 0, shift], [0, scale, shift]]),
        size,
        flags=cv2.INTER_CUBIC if scale > 1 else cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )


def where_points_count(mask: np.ndarray | None, on: str) -> np.ndarray | None:
    """The part of a picture that points may lie in, 0 or 1; None for all of it.

    Args:
        mask: Where the object is.
        on: "object", "surroundings" or "everything".
    """
    if mask is None or on == "everything":
        return None
    reach = max(1, round(_MARGIN * max(mask.shape)))
    wide = ndimage.binary_dilation(mask > 0.5, iterations=reach)
    return (wide if on == "object" else ~ndimage.binary_dilation(wide, iterations=reach)).astype(np.float32)


def _by_camera(photographs: Sequence[Photograph]) -> list[list[int]]:
    """Pictures of one size and stated focal length, which one camera took."""
    groups: dict[tuple[Any, ...], list[int]] = {}
    for i, photograph in enumerate(photographs):
        groups.setdefault((photograph.size, photograph.focal), []).append(i)
    return list(groups.values())


def _extract(
    folder: Path,
    names: list[str],
    like: Photograph,
    options: PoseOptions,
    camera: int,
    poll: Callable[[], None],
) -> None:
    """Points of pictures of one camera; `camera`: its number if it has one already, −1 if not."""
    library = colmap()
    reader = library.ImageReaderOptions()
    reader.camera_model, reader.camera_params = _camera(like, options)
    reader.existing_camera_id = camera
    if any((folder / "masks").iterdir()):
        reader.mask_path = str(folder / "masks")
    settings = library.FeatureExtractionOptions()
    settings.use_gpu = False
    settings.sift.peak_threshold = _WEAK
    settings.sift.edge_threshold = 16
    settings.sift.max_num_features = options.features
    # Large pictures are not looked at enlarged: it takes long, and their smallest points are noise.
    settings.sift.first_octave = 0 if enlargement(like) * max(like.size) > 1000 else -1
    interruptible(
        library.extract_features,
        folder / "database.db",
        folder / "pictures",
        image_names=names,
        camera_mode=library.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=settings,
        device=library.Device.cpu,
        poll=poll,
    )


def number_by_name(database: Path, names: list[str]) -> None:
    """Give pictures of one camera numbers in the order of their names.

    Threads number them as they end. Their order decides in which order points and cameras are summed, and
    the same photographs would not give the same cameras twice.
    """
    with colmap().Database.open(database) as file:
        images = [file.read_image_with_name(name) for name in sorted(names)]
        numbers = sorted(image.image_id for image in images)
        if [image.image_id for image in images] == numbers:
            return
        others = {image.image_id for image in file.read_all_images()} - set(numbers)
        found = {key: (file.read_keypoints(key), file.read_descriptors(key)) for key in [*numbers, *others]}
        file.clear_keypoints()
        file.clear_descriptors()
        kept = {key: found[key] for key in others}
        kept |= {number: found[image.image_id] for number, image in zip(numbers, images, strict=True)}
        for number, (points, descriptors) in kept.items():
            file.write_keypoints(number, points)
            file.write_descriptors(number, descriptors)
        # No two may have one name in between.
        for rename in ("renamed {}".format, str):
            for number, name in zip(numbers, sorted(names), strict=True):
                image = file.read_image(number)
                image.name = rename(name)
                file.update_image(image)


def _camera_of(database: Path, name: str) -> int:
    with colmap().Database.open(database) as file:
        return file.read_image_with_name(name).camera_id


def _camera(photograph: Photograph, options: PoseOptions) -> tuple[str, str]:
    """Model and parameters of COLMAP to begin with, for the picture as it is enlarged."""
    scale = enlargement(photograph)
    width, height = photograph.size
    x, y = options.centre or (0.5 * width, 0.5 * height)
    if options.focals is not None:
        lens = options.distortion or (0.0, 0.0, 0.0, 0.0)
        numbers = (*(focal * scale for focal in options.focals), x * scale, y * scale, *lens)
        return "OPENCV", ",".join(map(str, numbers))
    focal = photograph.focal or 1.2 * max(photograph.size)
    place = (x * scale, y * scale)
    model, numbers = {
        "pinhole": ("SIMPLE_PINHOLE", (focal * scale, *place)),
        "radial": ("SIMPLE_RADIAL", (focal * scale, *place, 0.0)),
        "full": ("OPENCV", (focal * scale, focal * scale, *place, 0.0, 0.0, 0.0, 0.0)),
    }[options.lens]
    return model, ",".join(map(str, numbers))


def _pairs(count: int, ordered: bool) -> list[tuple[int, int]]:
    """Pictures to compare: all, or, of many frames in order, the next ten and those 16, 32, … on."""
    if count <= _ALL_PAIRS or not ordered:
        return list(combinations(range(count), 2))
    steps = [*range(1, 11), *(2**k for k in range(4, count.bit_length()))]
    return [(i, i + step) for i in range(count) for step in steps if i + step < count]


def _match(database: Path, folder: Path, pairs: list[tuple[str, str]], options: PoseOptions, poll) -> None:
    library = colmap()
    listed = folder / "pairs.txt"
    listed.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
    pairing = library.ImportedPairingOptions()
    pairing.match_list_path = str(listed)
    settings = library.FeatureMatchingOptions()
    settings.use_gpu = False
    geometry = library.TwoViewGeometryOptions()
    geometry.min_num_inliers = FEWEST_MATCHES
    # What stays in its place while the rest moves is dust, noise, a frame or a table around a turntable.
    geometry.filter_stationary_matches = True
    geometry.stationary_matches_max_error = STILL
    geometry.detect_watermark = True
    geometry.ransac.random_seed = options.seed
    interruptible(
        library.match_image_pairs,
        database,
        matching_options=settings,
        pairing_options=pairing,
        verification_options=geometry,
        device=library.Device.cpu,
        poll=poll,
    )


def _read(database: Path, photographs: Sequence[Photograph]) -> Matches:
    library = colmap()
    count = len(photographs)
    coordinates = [np.zeros((0, 2)) for _ in range(count)]
    with library.Database.open(database) as file:
        index = {image.image_id: int(image.name[:5]) for image in file.read_all_images()}
        for key, i in index.items():
            found = np.asarray(file.read_keypoints(key), dtype=np.float64)
            if len(found):
                coordinates[i] = found[:, :2] / enlargement(photographs[i])
        pairs, raw, moved, verified = [], [], [], []
        similar = dict(zip(*file.read_all_matches(), strict=True))
        geometries = dict(zip(*file.read_two_view_geometries(), strict=True))
        for key in dict.fromkeys((*similar, *geometries)):
            first, second = (index[k] for k in library.pair_id_to_image_pair(key))
            pairs.append((first, second))
            alike = np.asarray(similar.get(key, np.zeros((0, 2))), dtype=np.int64).reshape(-1, 2)
            raw.append(len(alike))
            apart = coordinates[first][alike[:, 0]] - coordinates[second][alike[:, 1]]
            enough = len(alike) >= 2 * FEWEST_MATCHES
            moved.append(float(np.median(np.linalg.norm(apart, axis=1))) if enough else np.nan)
            found = geometries[key].inlier_matches if key in geometries else np.zeros((0, 2))
            verified.append(np.asarray(found, dtype=np.int64).reshape(-1, 2))
    return Matches(
        database=database,
        points=np.array([len(c) for c in coordinates]),
        coordinates=tuple(coordinates),
        pairs=np.array(pairs, dtype=np.int64).reshape(-1, 2),
        raw=np.array(raw, dtype=np.int64),
        moved=np.array(moved, dtype=np.float64),
        verified=tuple(verified),
    )
