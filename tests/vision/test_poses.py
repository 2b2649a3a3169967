"""Cameras from photographs: what comes out, and what is said where nothing can."""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from vision.tabletop import (
    BALL,
    camera,
    FOCAL,
    pattern,
    photograph,
    RADIUS,
    table,
    TAG_CENTRE,
    TAG_SIDE,
    write_pictures,
)

from dano.vision import (
    estimate_poses,
    EstimatedPoses,
    load_capture,
    pose_errors,
    PosedCamera,
    PoseOptions,
    save_transforms,
)
from dano.vision.structure._colmap import colmap
from dano.vision.structure._features import number_by_name

pytest.importorskip("pycolmap", reason="structure from motion needs the extra `poses`")

FEW = 800
"""Points of a picture: quick."""
CAMERAS = [camera(2 * math.pi * i / 8, 0.6 + 0.25 * (i % 2)) for i in range(8)]
NEAR = [camera(0.25 * i, 0.6 + 0.1 * (i % 2)) for i in range(6)]
UPRIGHT, LARGER, BROKEN, PLAIN = "001.jpg", "002.png", "050.png", "060.png"


@pytest.fixture(scope="module")
def mixed(tmp_path_factory) -> Path:
    """As from a phone: one noted as held upright, one larger, one cut off, one of a wall; and masks."""
    folder = tmp_path_factory.mktemp("mixed")
    pictures, masks = folder / "images", folder / "masks"
    write_pictures(pictures, CAMERAS)
    masks.mkdir()
    for i, view in enumerate(CAMERAS):
        mask = photograph(view, table(), pattern(1))[1]
        Image.fromarray(np.rint(255 * mask).astype(np.uint8)).save(masks / f"{i:03d}.png")
    # The pixels lie on their side, and EXIF says how to turn them: 6 is a quarter turn clockwise.
    with Image.open(pictures / "001.png") as picture:
        exif = Image.Exif()
        exif[0x0112] = 6
        picture.transpose(Image.Transpose.ROTATE_90).save(pictures / UPRIGHT, quality=98, exif=exif)
    (pictures / "001.png").unlink()
    large = camera(2 * math.pi * 2 / 8, 0.6, width=320)
    grey, mask = photograph(large, table(), pattern(1))
    Image.fromarray(grey).save(pictures / LARGER)
    Image.fromarray(np.rint(255 * mask).astype(np.uint8)).save(masks / LARGER)
    (pictures / BROKEN).write_bytes((pictures / "003.png").read_bytes()[:2000])
    wall = np.full((180, 240), 140, np.uint8)
    Image.fromarray(wall).save(pictures / PLAIN)
    corner = np.zeros((180, 240), np.uint8)
    corner[:30, :30] = 255
    Image.fromarray(corner).save(masks / PLAIN)
    return folder


@pytest.fixture(scope="module")
def found(mixed: Path) -> EstimatedPoses:
    return estimate_poses(mixed, PoseOptions(marker_size=TAG_SIDE, features=1500))


def test_cameras_scale_and_up_are_right(found: EstimatedPoses):
    assert [picture.name for picture in found.pictures] == [
        *("000.png", UPRIGHT, LARGER, "003.png", "004.png", "005.png", "006.png", "007.png")
    ]
    errors = pose_errors([picture.camera for picture in found.pictures], CAMERAS, scaled=False)
    # Eight pictures of 240 pixels, an eighth of a turn apart: 0.3° is a pixel.
    assert errors.position.max() < 0.006 and errors.angle.max() < math.radians(0.3)
    assert abs(errors.scale) < 0.005 and abs(errors.scale) < 4 * found.scale.error < 0.02
    # W has its origin in the tag's centre and z up, without any alignment.
    for picture, true in zip(found.pictures, CAMERAS, strict=True):
        assert np.linalg.norm(picture.camera.position - (true.position - TAG_CENTRE)) < 0.004
        assert np.arccos(picture.camera.axes[2] @ true.axes[2]) < 0.015
    assert found.models == (8,) and found.error < 0.6
    assert found.triangulation_angle > math.radians(30)
    focal = found.pictures[0].camera.focal[0]
    assert abs(focal / FOCAL - 1) < min(0.004, 5 * found.focal_error + 1e-4)


def test_sizes_and_orientations_of_pictures_are_their_cameras(found: EstimatedPoses):
    by_name = {picture.name: picture.camera for picture in found.pictures}
    assert (by_name[UPRIGHT].width, by_name[UPRIGHT].height) == (240, 180)
    assert (by_name[LARGER].width, by_name[LARGER].height) == (320, 240)
    assert by_name[LARGER].focal[0] == pytest.approx(FOCAL * 320 / 240, rel=0.01)


def test_what_is_left_out_is_said(found: EstimatedPoses):
    reasons = dict(found.left_out)
    assert set(reasons) == {BROKEN, PLAIN}
    assert "cannot be read" in reasons[BROKEN]
    assert "points to recognise" in reasons[PLAIN]
    # Around the ball the pattern moves with the cameras' turn: a walk.
    assert found.features_on == "surroundings"
    assert any("8 pictures are few" in text for text in found.warnings)


def test_the_file_is_read_by_those_that_train(found: EstimatedPoses, mixed: Path):
    path = mixed / "transforms.json"
    save_transforms(found, path)
    content = json.loads(path.read_text(encoding="utf-8"))
    assert content["units"] == "m" and content["scale"]["relative_error"] == found.scale.error
    assert {entry["file"] for entry in content["left_out"]} == {BROKEN, PLAIN}
    capture = load_capture(path)
    assert len(capture.views) == 8 and all(view.mask is not None for view in capture.views)
    for view, picture in zip(capture.views, found.pictures, strict=True):
        np.testing.assert_allclose(view.camera.position, picture.camera.position, atol=1e-9)
        np.testing.assert_allclose(view.camera.focal, picture.camera.focal)
    with pytest.raises(ValueError, match="existing directory"):
        save_transforms(found, mixed / "nowhere" / "transforms.json")


@pytest.fixture(scope="module")
def near(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("near")
    write_pictures(folder, NEAR, tag=False)
    return folder


def test_pictures_are_numbered_by_name_with_the_points_of_their_own(tmp_path: Path):
    """Threads number them as they end: here b, d, a; c has another camera."""
    library, file = colmap(), tmp_path / "database.db"
    with library.Database.open(file) as database:
        camera = library.Camera.create_from_model_id(0, library.CameraModelId.SIMPLE_PINHOLE, 100.0, 64, 48)
        one, other = (database.write_camera(camera) for _ in range(2))
        for name, key in (("b", one), ("c", other), ("d", one), ("a", one)):
            number = database.write_image(library.Image(name=name, camera_id=key))
            database.write_keypoints(number, np.full((ord(name), 4), ord(name), np.float32))
            told = np.full((ord(name), 128), ord(name), np.uint8)
            kind = library.FeatureExtractorType.SIFT
            database.write_descriptors(number, library.FeatureDescriptors(type=kind, data=told))
    number_by_name(file, ["b", "a", "d"])
    with library.Database.open(file) as database:
        images = database.read_all_images()
        assert {image.image_id: image.name for image in images} == {1: "a", 2: "c", 3: "b", 4: "d"}
        for image in images:
            for read in (database.read_keypoints, lambda key: database.read_descriptors(key).data):
                found = np.asarray(read(image.image_id))
                assert len(found) == ord(image.name) and (found == ord(image.name)).all()


@pytest.mark.slow
def test_an_unknown_scale_and_a_wrong_focal_length_are_said_and_runs_repeat(near: Path, tmp_path: Path):
    options = PoseOptions(focal=1.3 * FOCAL, up="cameras", features=FEW)
    found = estimate_poses(near, options)
    assert found.scale.metres is None and "not known" in found.scale.source
    said = "\n".join(found.warnings)
    assert "the scale is not known" in said and "how the cameras were held" in said
    assert "the given focal length does not fit: 0.7" in said
    assert all(picture.camera.focal[0] == pytest.approx(1.3 * FOCAL) for picture in found.pictures)
    again = estimate_poses(near, options)
    for one, other in zip(found.pictures, again.pictures, strict=True):
        np.testing.assert_array_equal(one.camera.pose, other.camera.pose)
    path = tmp_path / "transforms.json"
    save_transforms(found, path)
    with pytest.warns(RuntimeWarning, match="lengths are not metres"):
        load_capture(path)


def rotation_only(folder: Path) -> None:
    base = camera(0.0, 0.6)
    views = []
    for i in range(6):
        c, s = math.cos(0.1 * (i - 3)), math.sin(0.1 * (i - 3))
        pose = base.pose.copy()
        pose[:, :3] = pose[:, :3] @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        views.append(base.replaced(camera_to_world=pose))
    write_pictures(folder, views)


def blurred(folder: Path) -> None:
    write_pictures(folder, NEAR)
    for file in folder.iterdir():
        picture = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert picture is not None
        cv2.imwrite(str(file), cv2.GaussianBlur(picture, (0, 0), 8))


def plain(folder: Path) -> None:
    for i in range(5):
        Image.fromarray(np.full((120, 160), 100 + 10 * i, np.uint8)).save(folder / f"{i}.png")


def mirror_ball(folder: Path) -> None:
    """A ball that shows a room of 2 m, before black."""
    room = pattern(9)
    for i, view in enumerate(NEAR):
        y, x = np.mgrid[: view.height, : view.width] + 0.5
        ray = view.directions(np.stack([x.ravel(), y.ravel()], axis=1))
        away = view.position - BALL
        b = ray @ away
        root = b * b - (away @ away - RADIUS**2)
        normal = (away + (-b - np.sqrt(np.maximum(root, 0)))[:, None] * ray) / RADIUS
        seen = ray - 2 * np.sum(ray * normal, axis=1, keepdims=True) * normal
        place = BALL + RADIUS * normal
        far = np.min(np.where(seen > 0, 1 - place, -1 - place) / np.where(seen == 0, 1e-9, seen), axis=1)
        hit = place + far[:, None] * seen
        wall = np.argmax(np.abs(hit), axis=1)
        u = np.where(wall == 0, hit[:, 1], hit[:, 0])
        v = np.where(wall == 2, hit[:, 1], hit[:, 2])
        rows = np.clip(((v + 1) * 500).astype(int), 0, 1023)
        columns = np.clip(((u + 1) * 170 + 341 * wall).astype(int), 0, 1023)
        grey = np.where(root > 0, room[rows, columns], 0.03).reshape(view.height, view.width)
        Image.fromarray(np.rint(255 * grey).astype(np.uint8)).save(folder / f"{i}.png")


def three(folder: Path) -> None:
    write_pictures(folder, NEAR[:3])


def unreadable(folder: Path) -> None:
    for i in range(6):
        (folder / f"{i}.jpg").write_bytes(b"\xff\xd8 no picture")


def nothing(folder: Path) -> None:
    (folder / "notes.txt").write_text("no pictures here")


def still(folder: Path) -> None:
    write_pictures(folder, [CAMERAS[0]] * 5)


def scratched(seed: int, shape: tuple[int, int]) -> np.ndarray:
    """What a sensor and a watermark add to every picture [grey levels]."""
    mark = np.zeros(shape, np.uint8)
    cv2.putText(mark, "(c)", (shape[1] // 2, shape[0] // 2), cv2.FONT_HERSHEY_SIMPLEX, 0.8, 80, 2)
    return np.random.default_rng(seed).normal(0, 20, shape) + mark


def plain_ball_behind_scratches(folder: Path) -> None:
    """A ball of one colour that is given masks; all that pictures share is what the sensor adds."""
    for i, view in enumerate([camera(0.1 * i, 0.5 + 0.1 * i, 0.2) for i in range(6)]):
        grey, mask = photograph(view, np.full((1024, 1024), 0.02), np.full((1024, 1024), 0.5))
        shown = np.clip(grey + scratched(0, grey.shape), 0, 255)
        Image.fromarray(np.rint(np.dstack([shown] * 3 + [255 * mask])).astype(np.uint8), "RGBA").save(
            folder / f"{i}.png"
        )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (plain_ball_behind_scratches, "masks move, but the points that pictures share stand still"),
        (rotation_only, "the camera only turned .* walk around"),
        (blurred, "the pictures are blurred"),
        (plain, "plain .* nothing to recognise"),
        (mirror_ball, "a mirror"),
        (three, "3 pictures are too few"),
        (unreadable, "0 pictures are too few .* cannot be read"),
        (nothing, "there are no pictures in it"),
        (still, "nothing moves between the pictures"),
    ],
    ids=lambda case: getattr(case, "__name__", ""),
)
def test_captures_that_cannot_work_are_refused_in_words(
    make: Callable[[Path], None], message: str, tmp_path: Path
):
    make(tmp_path)
    with pytest.raises(ValueError, match=message):
        estimate_poses(tmp_path, PoseOptions(features=FEW))


@pytest.mark.slow
def test_models_that_have_nothing_in_common_are_said(near: Path, tmp_path: Path):
    folder = tmp_path / "two"
    shutil.copytree(near, folder)
    write_pictures(folder, NEAR[:5], seed=50, first=20, tag=False)
    first = estimate_poses(folder, PoseOptions(focal=FOCAL, features=FEW))
    assert first.models == (6, 5) and first.model == 0
    assert "2 models of 6, 5" in "\n".join(first.warnings)
    assert dict(first.left_out)["020.png"] == "it is in model 2 of 2, of 5 pictures"
    with pytest.raises(ValueError, match="needs a mask for every picture, 11 of 11"):
        estimate_poses(folder, PoseOptions(features_on="object", features=FEW))


def test_an_interrupt_stops_the_work_at_once(near: Path):
    def interrupted(what: str, share: float) -> None:
        if what == "matching pictures":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        estimate_poses(near, PoseOptions(features=FEW), progress=interrupted)


def film(path: Path, views: list[PosedCamera]) -> None:
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 240, 180, "yuv420p"
        stream.bit_rate = 8_000_000
        for view in views:
            grey = photograph(view, table(tag=False), pattern(1))[0]
            frame = av.VideoFrame.from_ndarray(np.repeat(grey[..., None], 3, axis=2), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


@pytest.mark.slow
def test_a_video_leaves_its_frames_or_nothing(tmp_path: Path):
    film(tmp_path / "walk.mp4", [camera(0.1 * i, 0.6) for i in range(12)])
    found = estimate_poses(
        tmp_path / "walk.mp4", PoseOptions(frames=6, features=FEW), frames=tmp_path / "frames"
    )
    names = [picture.name for picture in found.pictures]
    assert len(names) == 6 and [int(name[:6]) // 2 for name in names] == list(range(6))
    assert sorted(file.name for file in (tmp_path / "frames").iterdir()) == names
    with pytest.raises(ValueError, match="new or empty folder"):
        estimate_poses(tmp_path / "walk.mp4", frames=tmp_path / "frames")
    with pytest.raises(ValueError, match="frames must be a folder for the frames"):
        estimate_poses(tmp_path / "walk.mp4")
    part = PoseOptions(frames=10, features=FEW, since=0.05, until=10.0)
    film(tmp_path / "back.mp4", [camera(0.1 * i, 0.7) for i in range(12)])
    both = [tmp_path / "walk.mp4", tmp_path / "back.mp4"]
    with pytest.raises(ValueError, match="new or empty folder"):
        estimate_poses(both, part, frames=tmp_path / "frames")
    found = estimate_poses(both, part, frames=tmp_path / "both")
    assert {p.name.split("_")[0] for p in found.pictures} == {"walk", "back"} and len(found.pictures) == 10
    assert "walk_000000.png" not in {p.name for p in found.pictures}
    film(tmp_path / "still.mp4", [CAMERAS[0]] * 6)
    with pytest.raises(ValueError, match="nothing moves"):
        estimate_poses(tmp_path / "still.mp4", PoseOptions(frames=5, features=FEW), frames=tmp_path / "none")
    (tmp_path / "broken.mp4").write_bytes(b"no film")
    with pytest.raises(ValueError, match="cannot be read as a video"):
        estimate_poses(tmp_path / "broken.mp4", frames=tmp_path / "none")
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"walk.mp4", "back.mp4", "still.mp4", "broken.mp4", "frames", "both"}


def test_an_upright_video_is_turned(tmp_path: Path):
    from dano.vision.structure._photographs import _upright

    class Frame:
        rotation = 90

        def to_ndarray(self, format: str) -> np.ndarray:
            return np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)

    turned = _upright(Frame())
    assert turned.shape == (3, 2, 3)
    # A quarter turn against the clock: the last column becomes the first row.
    np.testing.assert_array_equal(turned[0], Frame().to_ndarray("rgb24")[:, -1])


def test_where_points_are_looked_for_follows_from_what_is_around_the_object(tmp_path: Path):
    from dano.vision.structure._estimate import _features_on
    from dano.vision.structure._photographs import read_photograph

    walk, turntable, backdrop = [], [], []
    top, skin, wall = table(), pattern(1), np.rint(255 * pattern(7)[:180, :240]).astype(np.uint8)
    for i, view in enumerate(NEAR[:4]):
        grey, mask = photograph(view, top, skin)
        on = mask[..., None] > 0.5
        alpha = np.rint(255 * mask).astype(np.uint8)[..., None]
        for kind, around in ((walk, grey), (turntable, wall), (backdrop, np.full_like(grey, 4))):
            colours = np.where(on, grey[..., None], around[..., None]).repeat(3, axis=2)
            file = tmp_path / f"{i}.png"
            Image.fromarray(np.concatenate([colours, alpha], axis=2)).save(file)
            kind.append(read_photograph(file, None))
    assert _features_on(walk, "auto") == "surroundings"
    assert _features_on(turntable, "auto") == "object"
    assert _features_on(backdrop, "auto") == "object"
    assert _features_on(walk, "everything") == "everything"
    assert _features_on([*walk[:2], walk[2]._replace(mask=None)], "auto") == "everything"


@pytest.mark.parametrize("masked", [False, True])
def test_what_all_pictures_have_in_the_same_place_is_taken_out(masked: bool):
    from dano.vision.structure._photographs import Photograph, without_what_stays

    top, skin = table(), pattern(1)
    true, photographs, counted = [], [], []
    for view in [camera(0.3 * i, 0.6 + 0.1 * (i % 2), 0.2) for i in range(16)]:
        grey, mask = photograph(view, top, skin)
        shown = np.rint(np.clip(grey + scratched(0, grey.shape), 0, 255)).astype(np.uint8)
        true.append(grey.astype(float))
        counted.append((mask > 0.5).astype(np.float32) if masked else None)
        photographs.append(Photograph("", Path(), None, shown, mask, None, 0.0))
    cleaned = without_what_stays(photographs, counted)
    inside = [np.ones_like(true[0], bool) if where is None else where > 0.5 for where in counted]

    def spoiled(pictures: list[Photograph]) -> float:
        """What the pictures have in common and should not, as its root mean square."""
        added = [np.where(w, p.grey - t, np.nan) for p, t, w in zip(pictures, true, inside, strict=True)]
        enough = np.sum(inside, axis=0) == len(inside)
        return float(np.sqrt(np.mean(np.mean(added, axis=0)[enough] ** 2)))

    assert spoiled(photographs) > 15
    assert spoiled(cleaned) < 0.5 * spoiled(photographs)
    # Four pictures say nothing of what they have in common; one of another size has none like it.
    assert without_what_stays(photographs[:4], counted[:4]) == photographs[:4]
    odd = photographs[0]._replace(grey=photographs[0].grey[:90])
    assert without_what_stays([*photographs, odd], [*counted, None])[-1] is odd
