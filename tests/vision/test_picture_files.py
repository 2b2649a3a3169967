"""Pictures and masks as phones and programs write them; what is known of them is written by hand here."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dano.vision import load_capture
from dano.vision.capture import picture_files, read_mask, read_picture
from dano.vision.structure._photographs import read_photograph

POSE = np.eye(4).tolist()
DISC = np.hypot(*(np.mgrid[:24, :32] - np.array([11.5, 15.5])[:, None, None])) < 9
ORIENTATION = 0x0112


def smooth_alpha() -> np.ndarray:
    distance = np.hypot(*(np.mgrid[:24, :32] - np.array([11.5, 15.5])[:, None, None]))
    return np.clip((10 - distance) / 4, 0, 1)


def write_capture(folder: Path, *, frame=None, **keys) -> None:
    frames = [{"file_path": "a.png", "transform_matrix": POSE, **(frame or {})}]
    content = {"fl_x": 40.0, "w": 32, "h": 24, "frames": frames, **keys}
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")


@pytest.mark.parametrize(
    "flags",
    [
        {"is_fisheye": True},
        {"is_fisheye": "true"},
        {"frame": {"is_fisheye": 1}},
        {"camera_type": "EQUIRECTANGULAR"},
        {"camera_model": "THIN_PRISM_FISHEYE"},
        {"k4": 0.01},
        {"k5": 0.01},
        {"rolling_shutter": [0.0, 0.0, 0.01, 0.0]},
        {"ftheta_p1": 0.3},
    ],
)
def test_lenses_of_other_programs_are_refused_by_name(tmp_path: Path, flags):
    Image.fromarray(np.full((24, 32, 3), 99, np.uint8)).save(tmp_path / "a.png")
    write_capture(tmp_path, **flags)
    name = next(iter(flags.get("frame", flags)))
    with pytest.raises(ValueError, match=rf"{name} must be .* undistort"):
        load_capture(tmp_path)
    off = {"is_fisheye": False, "k4": 0.0, "rolling_shutter": [0, 0, 0, 0], "camera_model": "OPENCV"}
    write_capture(tmp_path, **off)
    assert load_capture(tmp_path).views[0].camera.width == 32


def test_pixels_that_are_stored_turned(tmp_path: Path):
    # COLMAP and instant-ngp take pixels as they are stored; `dano poses` turns them upright.
    stored = np.zeros((24, 32, 3), np.uint8)
    stored[2, 5] = 255
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    Image.fromarray(stored).save(tmp_path / "a.png", exif=exif)
    write_capture(tmp_path)
    view = load_capture(tmp_path).views[0]
    assert (view.camera.width, view.camera.height) == (32, 24) and view.image[2, 5, 0] == 1
    write_capture(tmp_path, w=24, h=32)
    view = load_capture(tmp_path).views[0]
    # A quarter turn clockwise takes row 2 from above to column 2 from the right.
    assert (view.camera.width, view.camera.height) == (24, 32) and view.image[5, 23 - 2, 0] == 1
    mask = np.zeros((24, 32), np.uint8)
    mask[2, 5] = 1  # made from the stored pixels
    Image.fromarray(mask).save(tmp_path / "m.png")
    write_capture(tmp_path, w=24, h=32, frame={"mask_path": "m.png"})
    np.testing.assert_array_equal(load_capture(tmp_path).views[0].mask, view.image[..., 0])
    exif[ORIENTATION] = 3
    Image.fromarray(stored).save(tmp_path / "a.png", exif=exif)
    write_capture(tmp_path)
    with pytest.raises(ValueError, match=r"a.png is stored turned \(EXIF orientation 3\)"):
        load_capture(tmp_path)
    write_capture(tmp_path, units="m")
    assert load_capture(tmp_path).views[0].image[-3, -6, 0] == 1


def test_an_iphones_pictures(tmp_path: Path):
    heif = pytest.importorskip("pillow_heif")
    heif.register_heif_opener()
    colours = np.full((48, 64, 3), (200, 120, 40), np.uint8)
    Image.fromarray(colours).save(tmp_path / "IMG_1.HEIC", quality=95)
    read = read_picture(tmp_path / "IMG_1.HEIC")
    np.testing.assert_allclose(read.colours.mean(axis=(0, 1)), colours[0, 0] / 255, atol=0.02)
    assert read_photograph(tmp_path / "IMG_1.HEIC", None).size == (64, 48)


@pytest.mark.parametrize("dark", [False, True])
def test_grey_with_16_bits(tmp_path: Path, dark: bool):
    values = (np.linspace(0, 200 if dark else 60000, 24 * 32).reshape(24, 32)).astype(np.uint16)
    Image.fromarray(values).save(tmp_path / "a.png")
    read = read_picture(tmp_path / "a.png")
    np.testing.assert_allclose(read.colours[..., 1], values / 65535, atol=1e-6)
    assert read.alpha is None
    assert read_photograph(tmp_path / "a.png", None).grey.max() == round(int(values.max()) * 255 / 65535)


@pytest.mark.parametrize("colour", [(0.9, 0.6, 0.3), (0.06, 0.05, 0.04)])
@pytest.mark.parametrize("premultiplied", [False, True])
def test_alpha_of_either_kind(tmp_path: Path, colour, premultiplied):
    # Some programs write colours multiplied by alpha, though PNG says not to: the dark one tells by its edge.
    alpha = smooth_alpha()
    over_black = np.array(colour) * alpha[..., None]
    colours = over_black if premultiplied else np.broadcast_to(colour, (24, 32, 3))
    rgba = np.concatenate([colours, alpha[..., None]], axis=2)
    Image.fromarray(np.rint(255 * rgba).astype(np.uint8)).save(tmp_path / "a.png")
    write_capture(tmp_path)
    view = load_capture(tmp_path).views[0]
    np.testing.assert_allclose(view.image, over_black, atol=0.004)
    assert view.mask is not None
    np.testing.assert_allclose(view.mask, alpha, atol=0.003)


def test_alpha_without_transparency_says_nothing_of_the_object(tmp_path: Path):
    Image.fromarray(np.full((24, 32, 4), 255, np.uint8)).save(tmp_path / "a.png")
    write_capture(tmp_path)
    assert load_capture(tmp_path).views[0].mask is None
    assert read_photograph(tmp_path / "a.png", None).mask is None


def as_palette(colours) -> Image.Image:
    picture = Image.fromarray(DISC.astype(np.uint8), "P")
    picture.putpalette([v for colour in colours for v in colour] + [0] * (768 - 3 * len(colours)))
    return picture


MASKS = {
    "0 and 255": lambda: Image.fromarray(255 * DISC.astype(np.uint8)),
    "0 and 1": lambda: Image.fromarray(DISC.astype(np.uint8)),
    "0 and 128": lambda: Image.fromarray(128 * DISC.astype(np.uint8)),
    "one bit": lambda: Image.fromarray(DISC),
    "16 bits": lambda: Image.fromarray(65535 * DISC.astype(np.uint16)),
    "16 bits, 0 and 1": lambda: Image.fromarray(DISC.astype(np.uint16)),
    "palette of grey": lambda: as_palette([(0, 0, 0), (255, 255, 255)]),
    "palette of a label": lambda: as_palette([(0, 0, 0), (128, 0, 0)]),
    "RGB": lambda: Image.fromarray(np.repeat(255 * DISC[..., None], 3, axis=2).astype(np.uint8)),
    "RGBA, opaque": lambda: MASKS["0 and 255"]().convert("RGBA"),
    "LA, opaque": lambda: MASKS["0 and 255"]().convert("LA"),
    "RGBA, transparent": lambda: Image.fromarray(
        np.dstack([np.full((24, 32, 3), 90), 255 * DISC]).astype(np.uint8)
    ),
}


@pytest.mark.parametrize("kind", MASKS)
def test_masks_are_read_alike_however_they_are_written(tmp_path: Path, kind: str):
    MASKS[kind]().save(tmp_path / "a_mask.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "a_mask.png"), DISC)
    Image.fromarray(np.full((24, 32, 3), 99, np.uint8)).save(tmp_path / "a.png")
    write_capture(tmp_path, frame={"mask_path": "a_mask.png"})
    np.testing.assert_array_equal(np.asarray(load_capture(tmp_path).views[0].mask) > 0.5, DISC)
    np.testing.assert_array_equal(read_photograph(tmp_path / "a.png", tmp_path).mask, DISC)


def test_masks_of_several_labels_are_refused(tmp_path: Path):
    labels = np.zeros((24, 32), np.uint8)
    labels[:4], labels[8:12] = 1, 2
    Image.fromarray(labels).save(tmp_path / "m.png")
    with pytest.raises(ValueError, match="labels of several things"):
        read_mask(tmp_path / "m.png")


def test_what_is_left_out_of_a_folder_is_said(tmp_path: Path):
    for name in ("b.JPG", "a.png"):
        Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / name)
    (tmp_path / "notes.txt").write_text("x", encoding="utf-8")
    assert [file.name for file in picture_files(tmp_path)] == ["a.png", "b.JPG"]
    (tmp_path / "c.dng").write_bytes(b"raw")
    with pytest.warns(RuntimeWarning, match=r"left out 1 files that are not pictures .*c\.dng"):
        assert len(picture_files(tmp_path)) == 2
