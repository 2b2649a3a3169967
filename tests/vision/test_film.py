"""Films as phones write them: turned, of uneven rate, in slow motion, broken."""

import struct
from fractions import Fraction

import av
import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from dano.vision import Film, read_film

H, W = 48, 64


def pictures(count=6):
    """A white mark in the upper left corner, on greys that grow lighter."""
    frames = [np.full((H, W, 3), 40 + 10 * i, np.uint8) for i in range(count)]
    for frame in frames:
        frame[:16, :16] = 255
    return frames


def write_video(path, frames, stamps=None):
    """Frames at times [ms], 33 apart if none are given."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=1000)
        stream.width, stream.height, stream.pix_fmt = W, H, "yuv420p"
        stream.time_base = Fraction(1, 1000)
        for i, pixels in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.pts, frame.time_base = (33 * i if stamps is None else stamps[i]), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def turn_display(path):
    """Note in the track's header that it is to be shown turned by 90° clockwise, as phones do."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 40
    data[at : at + 36] = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, H << 16, 0, 1 << 30)
    path.write_bytes(data)


def test_a_turned_phone_video_is_upright(tmp_path):
    file = tmp_path / "turned.mp4"
    write_video(file, pictures())
    turn_display(file)
    film = read_film(file)
    assert film.size == (H, W)
    # What is stored in the upper left is shown in the upper right.
    image = film.images[0].mean(axis=2)
    assert image[:12, -12:].min() > 200
    assert image[-16:, :].max() < 100


def test_frames_of_a_variable_rate_keep_their_times(tmp_path):
    file = tmp_path / "uneven.mp4"
    stamps = [0, 33, 66, 166, 199, 232]
    write_video(file, pictures(), stamps)
    film = read_film(file)
    np.testing.assert_allclose(film.times, np.array(stamps) / 1000, atol=1e-3)
    assert any("frame rate varies" in note for note in film.notes)
    slow = read_film(file, slow_motion=8.0, every=2)
    np.testing.assert_allclose(slow.times, np.array(stamps)[::2] / 8000, atol=1e-3)
    assert any("slow motion" in note for note in slow.notes)
    np.testing.assert_allclose(read_film(file, rate=240.0).times, np.arange(6) / 240)


def test_folders_of_frames_with_alpha_and_masks(tmp_path):
    frames, masks = tmp_path / "frames", tmp_path / "masks"
    frames.mkdir()
    masks.mkdir()
    for i, pixels in enumerate(pictures(4)):
        alpha = np.where(pixels[..., :1] == 255, 255, 0).astype(np.uint8)
        Image.fromarray(np.concatenate([pixels, alpha], axis=2)).save(frames / f"{i}.png")
        Image.fromarray(255 - alpha[..., 0]).save(masks / f"{i}.png")
    with pytest.raises(ValueError, match="no times: give rate"):
        read_film(frames)
    film = read_film(frames, rate=30.0)
    assert film.masks[0] is not None
    assert film.masks[0][:16, :16].min() == 1
    assert film.masks[0].sum() == 256
    given = read_film(frames, rate=30.0, masks=masks)
    assert given.masks[0] is not None
    assert given.masks[0][:16, :16].max() == 0
    (masks / "3.png").unlink()
    with pytest.raises(ValueError, match="masks must be as many as frames, 4, got 3"):
        read_film(frames, rate=30.0, masks=masks)


def test_a_part_of_a_film(tmp_path):
    frames, masks = tmp_path / "frames", tmp_path / "masks"
    frames.mkdir()
    masks.mkdir()
    for i, pixels in enumerate(pictures(12)):
        Image.fromarray(pixels).save(frames / f"{i:02d}.png")
        Image.fromarray(np.where(np.arange(256).reshape(16, 16) == i, 255, 0).astype(np.uint8)).resize(
            (pixels.shape[1], pixels.shape[0]), Image.Resampling.NEAREST
        ).save(masks / f"{i:02d}.png")
    film = read_film(frames, rate=10.0, since=0.4, until=0.9, every=2, masks=masks)
    assert film.names == ("04.png", "06.png", "08.png")
    np.testing.assert_allclose(film.times, [0, 0.2, 0.4])
    whole = read_film(frames, rate=10.0, masks=masks)
    for k, i in enumerate((4, 6, 8)):
        np.testing.assert_array_equal(film.masks[k], whole.masks[i])
    video = tmp_path / "v.mp4"
    write_video(video, pictures(12), [40 * i for i in range(12)])
    part = read_film(video, since=0.1, until=0.3)
    np.testing.assert_allclose(part.times, 0.04 * np.arange(5), atol=1e-3)
    assert part.names == ("3", "4", "5", "6", "7")
    with pytest.raises(ValueError, match="2 frames from 9 to inf s, got 0"):
        read_film(video, since=9.0)
    with pytest.raises(ValueError, match="since must be before until"):
        read_film(video, since=2.0, until=1.0)


def test_large_frames_are_averaged(tmp_path):
    frames = tmp_path / "frames"
    frames.mkdir()
    large = np.zeros((400, 1000, 3), np.uint8)
    large[:, ::2] = 200
    for i in range(2):
        Image.fromarray(large).save(frames / f"{i}.png")
    film = read_film(frames, rate=30.0)
    assert film.shrunk == 2
    assert film.size == (500, 200)
    assert set(np.unique(film.images[0])) == {100}


def test_what_is_wrong_with_a_film_is_said(tmp_path):
    broken = tmp_path / "broken.mp4"
    write_video(broken, pictures())
    broken.write_bytes(broken.read_bytes()[:200])
    with pytest.raises(ValueError, match="cannot be read as a video"):
        read_film(broken)
    with pytest.raises(ValueError, match="does not exist"):
        read_film(tmp_path / "none.mp4")
    text = tmp_path / "notes.txt"
    text.write_text("no film")
    with pytest.raises(ValueError, match=r"must be one of \*\.mp4"):
        read_film(text)
    short = tmp_path / "short.mp4"
    write_video(short, pictures(1))
    with pytest.raises(ValueError, match="at least 2 frames, got 1"):
        read_film(short)
    with pytest.raises(ValueError, match="slow_motion must be finite and > 0, got 0"):
        read_film(short, slow_motion=0.0)


@pytest.mark.parametrize(("shift", "gain", "still"), [(0.0, 1.2, True), (0.04, 1.0, True), (0.3, 0.9, False)])
def test_what_lies_still_is_told_from_what_creeps(shift, gain, still):
    rng = np.random.default_rng(2)
    large = ndimage.gaussian_filter(rng.uniform(0, 1, (60, 80, 3)), (1.5, 1.5, 0))
    large = 0.2 + 0.4 * (large - large.min()) / np.ptp(large)
    images = []
    for x, g in ((0.0, 1.0), (shift, gain)):
        frame = g * ndimage.shift(large, (0, x, 0)) + 0.01 * rng.normal(size=large.shape)
        images.append(np.rint(255 * np.clip(frame, 0, 1)).astype(np.uint8))
    film = Film(("0", "1"), np.array([0, 1 / 30]), images, [None] * 2, [None] * 2, 1, ())
    region = np.zeros((60, 80), bool)
    region[15:45, 20:60] = True
    assert film.is_still(0, 1, region) == still
    assert not film.is_still(0, 1, np.zeros_like(region))


def test_frames_that_were_turned_back_are_less_exact():
    rng = np.random.default_rng(2)
    large = 255 * ndimage.gaussian_filter(rng.uniform(0, 1, (60, 80, 3)), (1.5, 1.5, 0))
    images = [np.rint(ndimage.shift(large, (0, x, 0))).astype(np.uint8) for x in (0.0, 0.2)]
    film = Film(("0", "1"), np.array([0, 1 / 30]), images, [None] * 2, [None] * 2, 1, ())
    region = np.zeros((60, 80), bool)
    region[15:45, 20:60] = True
    assert not film.is_still(0, 1, region)
    assert not film._replace(turns=np.tile([1.0, 0, 0, 0], (2, 1))).is_still(0, 1, region)
    assert film._replace(turns=np.array([[1.0, 0, 0, 0], [1.0, 1e-3, 0, 0]])).is_still(0, 1, region)


def test_noise_does_not_move_a_small_thing():
    """One of 20 × 30 pixels in noise of 2 %: shown twice at one place, and 0.4 pixels aside."""
    region = np.zeros((60, 80), bool)
    region[20:40, 25:55] = True
    found = {0.0: [], 0.4: []}
    for seed in range(40):
        rng = np.random.default_rng(seed)
        large = ndimage.gaussian_filter(rng.uniform(0, 1, (60, 80, 3)), (1.5, 1.5, 0))
        large = 0.2 + 0.6 * (large - large.min()) / np.ptp(large)
        for shift, rows in found.items():
            images = [
                np.rint(255 * np.clip(frame + 0.02 * rng.normal(size=large.shape), 0, 1)).astype(np.uint8)
                for frame in (large, ndimage.shift(large, (0, shift, 0), mode="nearest"))
            ]
            film = Film(("0", "1"), np.array([0, 1 / 30]), images, [None] * 2, [None] * 2, 1, ())
            rows.append(film.is_still(0, 1, region))
    # By the displacement alone, 0.63 of the first.
    assert np.mean(found[0.0]) > 0.9
    assert not np.any(found[0.4])


def test_quiet_frames_are_those_in_which_little_moves():
    rng = np.random.default_rng(0)
    place, images = rng.integers(60, 200, (40, 60, 3)), []
    # It moves in frames 0 to 5 and 9 to 11, and lies still from 6 to 8; the exposure changes throughout.
    for i, x in enumerate([0, 5, 10, 15, 20, 25, 30, 30, 30, 36, 42, 48]):
        frame = place.copy()
        frame[10:30, x : x + 10] = 0
        images.append(np.rint(frame * (1 - 0.02 * i)).astype(np.uint8))
    nothing: list[np.ndarray | None] = [None] * len(images)
    film = Film(tuple(map(str, range(12))), 0.1 * np.arange(12), images, nothing, nothing, 1, ())
    assert film.quiet(1) == [7]
    first, *others = film.quiet(3)
    assert first == 7
    assert sorted(others)[0] < 4 and sorted(others)[1] > 7
