"""What photographs and films say of themselves before anything is learned from them."""

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage
from vision.tabletop import camera, FOCAL, photograph, table, TAG, write_pictures

from dano.maths import quat_exp, quat_to_matrix
from dano.vision import check_slide, check_walk, Film, PosedCamera, PoseOptions, write_frames

pytest.importorskip("cv2", reason="markers need the extra `poses`")

OPTIONS = PoseOptions(marker_size=0.05)


def walk(folder: Path, count: int = 8, *, tag: bool = True) -> list[Path]:
    """Photographs from all around."""
    write_pictures(folder, [camera(2 * math.pi * i / count) for i in range(count)], tag=tag)
    return sorted(folder.glob("*.png"))


def with_masks(files: list[Path]) -> Path:
    folder = files[0].parent / "masks"
    folder.mkdir()
    for file in files:
        with Image.open(file) as picture:
            mask = Image.new("L", picture.size)
            mask.paste(255, (80, 60, 160, 120))
            mask.save(folder / file.name)
    return folder


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> list[Path]:
    files = walk(tmp_path_factory.mktemp("walk"))
    with_masks(files)
    return files


def test_a_walk_around_a_marker_is_fine(photos: list[Path]):
    said: list[str] = []
    found = check_walk(photos, OPTIONS, progress=lambda what, _: said.append(what))
    assert found.photographs == found.looked_at == 8 and found.markers == (TAG,)
    assert found.marked >= 6 and found.masks == "given" and found.blur < 0.5
    assert found.warnings == ("8 photographs are few: 30 to 60 from all sides, at two heights, are usual",)
    assert set(said) == {"looking at photographs", "looking for markers"}


def test_one_place_shows_no_depth(tmp_path: Path):
    stand = camera(0.4)
    turned = [
        PosedCamera(
            np.column_stack([quat_to_matrix(quat_exp(np.array(turn))) @ stand.pose[:, :3], stand.position]),
            focal=FOCAL,
            width=stand.width,
            height=stand.height,
        )
        for turn in [(0, 0, 0.05 * i) for i in range(-2, 3)] + [(0.05, 0, 0), (0.0, 0.05, 0.02), (0.1, 0, 0)]
    ]
    write_pictures(tmp_path, turned)
    with pytest.raises(ValueError, match="the camera only turned .* walk around the object"):
        check_walk(sorted(tmp_path.glob("*.png")), OPTIONS)


def test_no_marker_another_family_and_too_few(photos: list[Path], tmp_path: Path):
    plain = walk(tmp_path, tag=False)
    with pytest.raises(
        ValueError, match=r"must show a marker of DICT_APRILTAG_36h11 in 3 .*, got 0 of the 8"
    ):
        check_walk(plain, OPTIONS)
    with pytest.raises(ValueError, match="marker of DICT_4X4_50"):
        check_walk(photos, PoseOptions(marker_size=0.05, marker_family="DICT_4X4_50"))
    with pytest.raises(ValueError, match="photographs must be 5 at least, .* got 4"):
        check_walk(photos[:4], OPTIONS)


def test_blur_in_all_of_them_and_in_some(photos: list[Path], tmp_path: Path):
    blurred = []
    for i, file in enumerate(photos):
        with Image.open(file) as picture:
            grey = np.asarray(picture.convert("L"), np.float32)
        blurred.append(tmp_path / file.name)
        smooth = ndimage.gaussian_filter(grey, 5.0 if i else 0.0)
        Image.fromarray(np.rint(smooth).astype(np.uint8)).save(blurred[-1])
    with pytest.raises(ValueError, match="photographs are blurred .* hold still"):
        check_walk(blurred, OPTIONS)
    masks = photos[0].parent / "masks"
    found = check_walk([*photos[:5], *blurred[5:7]], OPTIONS, masks=masks)
    assert any("2 of 7 photographs are blurred" in text for text in found.warnings)


def test_where_masks_come_from(photos: list[Path], tmp_path: Path):
    bare = walk(tmp_path)
    # It stands on the table, which has a marker.
    assert check_walk(bare, OPTIONS).masks == "table"
    with pytest.raises(ValueError, match="network must be an .onnx file"):
        check_walk(bare, OPTIONS, network=tmp_path / "no.onnx")
    folder = with_masks(bare)
    (folder / bare[2].name).unlink()
    with pytest.raises(
        ValueError, match="masks must be there for all photographs or for none, but 1 of the 8"
    ):
        check_walk(bare, OPTIONS)
    bare[0].write_bytes(b"broken")
    (folder / bare[0].name).unlink()
    (folder / bare[2].name).write_bytes((folder / bare[3].name).read_bytes())
    found = check_walk(bare, OPTIONS)
    assert found.looked_at == 7 and f"{bare[0].name} is left out" in found.warnings[0]


TABLE = np.repeat(
    photograph(camera(-1.4, 0.75, 0.34, width=320), table(), np.full((1024, 1024), 0.5, np.float32))[0][
        ..., None
    ],
    3,
    axis=2,
)


def film_of(places: list[float], *, shift: float = 0.0, blurred: float = 0.0) -> Film:
    """A dark square that lies at columns of a table, whose picture moves by so many columns a frame."""
    images = []
    for i, place in enumerate(places):
        image = np.roll(TABLE, round(shift * i), axis=1).copy()
        image[150:200, round(place) : round(place) + 50] = 20
        image = ndimage.gaussian_filter(image, (blurred, blurred, 0)) if blurred else image
        # The exposure of a phone is never quite the same.
        images.append(np.rint(image * (1 - 0.02 * (i % 3))).astype(np.uint8))
    n = len(images)
    times = np.arange(n) / 30
    return Film(tuple(map(str, range(n))), times, images, [None] * n, [None] * n, 1, ())


SLIDE = [20.0 + 8 * i - 0.25 * i * i for i in range(16)] + [84.0] * 8


def test_a_film_of_a_slide_is_fine():
    found = check_slide(film_of(SLIDE), OPTIONS)
    assert found.frames == 24 and found.rests and found.marked and found.warnings == ()
    assert found.fastest < 0.2
    cut = check_slide(film_of(SLIDE[:14]), OPTIONS)
    assert not cut.rests and "still moves at the film's end" in cut.warnings[0]


def test_films_that_cannot_work():
    pushed = [20.0] * 6 + [20.0 + 0.8 * i * i for i in range(12)]
    with pytest.raises(ValueError, match="film ends at 0.57 s while what moves is fastest"):
        check_slide(film_of(pushed), OPTIONS)
    with pytest.raises(ValueError, match="film must have 10 frames at least, got 9"):
        check_slide(film_of(SLIDE[:9]), OPTIONS)
    with pytest.raises(ValueError, match="film must show something that moves"):
        check_slide(film_of([50.0] * 20), OPTIONS)
    with pytest.raises(ValueError, match="film is blurred"):
        check_slide(film_of(SLIDE, blurred=6.0), OPTIONS)
    with pytest.raises(ValueError, match="camera that stands still, but a marker moves by"):
        check_slide(film_of(SLIDE, shift=1.0), OPTIONS)


def test_a_camera_that_moves_is_found_without_a_marker():
    film = film_of(SLIDE, shift=7.0)
    hidden = [image.copy() for image in film.images]
    for image in hidden:
        image[:, ::8] = 128
    with pytest.raises(ValueError, match="camera that stands still"):
        check_slide(film._replace(images=hidden), OPTIONS)


def test_frames_of_a_film_are_written_once(tmp_path: Path):
    with pytest.raises(ValueError, match="count"):
        write_frames(tmp_path / "a.mp4", tmp_path / "frames", 0)
    with pytest.raises(ValueError, match="images must be a folder of pictures or a video"):
        write_frames(tmp_path / "a.mp4", tmp_path / "frames", 3)
