"""Tracking a learned object in films that are drawn of it, by another path than the tracker's own."""

import dataclasses
import json

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from dano import HalfSpace, Pose
from dano.cli import main
from dano.identify import load_motion
from dano.maths import quat_conjugate, quat_exp, quat_log, quat_multiply, quat_rotate, quat_to_matrix
from dano.scene_file import asset_look
from dano.vision import adjust_poses, Camera, compose, Film, Item, Light, PosedCamera, track, TrackOptions
from dano.vision.drawing import GAMMA
from dano.vision.tracking._light import LightFit, ShadowFit, unlit
from dano.vision.tracking._placement import Drift, Placement
from dano.vision.tracking._refine import (
    _without_common,
    MASK_NOISE,
    refine,
    Refined,
    silhouette,
    Target,
    window_of,
)
from dano.vision.tracking._segments import common_offset, differs, edge_offset, moved_edge, overlap
from dano.vision.tracking._subject import Subject
from dano.vision.tracking._sureness import covariance_of, unobservable

SIZE = (96, 72)
LIGHT = np.array([-0.4, -0.5, 0.77])
BACK = np.array([0.1, 0.6, 0.2])


@pytest.fixture(scope="module")
def bunny():
    return asset_look("trained_bunny")


@pytest.fixture(scope="module")
def camera():
    """Looks along +y at the origin from half a metre away, a little from above."""
    eye, forward = np.array([0.0, -0.48, 0.2]), np.array([0.0, 0.48, -0.14])
    forward = forward / np.linalg.norm(forward)
    right = np.array([1.0, 0, 0])
    up = np.cross(right, forward)
    pose = np.stack([right, up, -forward, eye], axis=1)
    return PosedCamera(pose, focal=200.0, width=SIZE[0], height=SIZE[1])


def path(count, speed=(0.006, 0.002, 0.001), spin=(0.05, 0.08, 0.12)):
    """Poses of a steady motion."""
    start = quat_exp(np.array([0.2, -0.1, 0.8]))
    position = np.array([-0.02, 0.0, 0.0]) + np.outer(np.arange(count), speed)
    orientation = np.stack([quat_multiply(start, quat_exp(i * np.array(spin))) for i in range(count)])
    return position, orientation


def drawn(field, camera, position, orientation):
    """Frame and mask: not the object is moved, but the camera, the other way, by the library's drawing."""
    rotation = quat_to_matrix(orientation)
    pose = rotation.T @ np.concatenate([camera.pose[:, :3], (camera.position - position)[:, None]], axis=1)
    seen = field.picture(camera.replaced(camera_to_world=pose), rotation.T @ LIGHT)
    return np.rint(255 * seen.over(BACK)).astype(np.uint8), seen.opacity


def film_of(frames, masks, times=None):
    n = len(frames)
    stamps = np.arange(n) / 30 if times is None else times
    names = tuple(map(str, range(n)))
    return Film(names, stamps, list(frames), list(masks), [None] * n, 1, ())


@pytest.fixture(scope="module")
def filmed(bunny, camera):
    position, orientation = path(4)
    frames, masks = zip(
        *(drawn(bunny, camera, p, q) for p, q in zip(position, orientation, strict=True)), strict=True
    )
    return position, orientation, frames, masks


def errors(found, position, orientation, rows):
    shift = np.linalg.norm(found.position[rows] - position[rows], axis=1) / 0.12
    turned = quat_log(quat_multiply(quat_conjugate(found.orientation[rows]), orientation[rows]))
    return shift, np.linalg.norm(turned, axis=1)


ROUGH = TrackOptions(rays=700, views=24, turns=12, candidates=2)


def test_slopes_are_differences_of_what_is_seen(bunny, camera):
    subject = Subject(bunny)
    position, orientation = path(1)
    place = Placement(position[0], orientation[0])
    y, x = np.mgrid[16:56:2, 30:66:2]
    pixels = np.stack([x.ravel(), y.ravel()], axis=1) + 0.5
    lamps = (Light(LIGHT), Light((1, 0, 0.5), intensity=0.3), Light((-1, 0, 0.2), intensity=0.2))
    seen = subject.picture(place, lamps, camera, pixels, slopes=True)
    for k in range(6):
        # A step of half a pixel: what the eye could see.
        step = np.zeros(6)
        step[k] = 0.012
        high, low = (
            subject.picture(place.moved(s * step, subject.radius), lamps, camera, pixels) for s in (1, -1)
        )
        # Colours jump where one part of the object hides another, which no derivative tells.
        for slope, values, least in (
            (seen.opacity_slope[:, k], (high.opacity - low.opacity) / 0.024, 0.85),
            (seen.colour_slope[:, :, k], (high.colour - low.colour) / 0.024, 0.75),
        ):
            cosine = np.sum(slope * values) / np.linalg.norm(slope) / np.linalg.norm(values)
            assert cosine > least
            assert np.linalg.norm(slope) == pytest.approx(np.linalg.norm(values), rel=0.4)


def fine_frame(field, camera, position, orientation, back, finer=4):
    """Frame and mask as a camera takes them: light is averaged over each pixel, then encoded."""
    rotation = quat_to_matrix(orientation)
    pose = rotation.T @ np.concatenate([camera.pose[:, :3], (camera.position - position)[:, None]], axis=1)
    near = camera.replaced(
        camera_to_world=pose,
        focal=finer * camera.focal,
        centre=finer * camera.centre,
        width=finer * camera.width,
        height=finer * camera.height,
    )
    seen = field.picture(near, rotation.T @ LIGHT)
    large = np.kron(back, np.ones((finer, finer, 1)))

    def mean(x):
        return x.reshape(camera.height, finer, camera.width, finer, -1).mean(axis=(1, 3))

    frame = mean(seen.over(large) ** GAMMA) ** (1 / GAMMA)
    return np.rint(255 * frame).astype(np.uint8), mean(seen.opacity)[..., 0]


@pytest.mark.parametrize("name", ["trained_bunny", "trained_soap"])
def test_silhouettes_are_as_large_as_the_object(camera, name):
    field = asset_look(name)
    assert field is not None
    subject, place = Subject(field), Placement(np.zeros(3), quat_exp(np.array([0.3, -0.2, 0.8])))
    window = window_of(subject, place, camera)
    assert window is not None
    shape, _ = silhouette(subject, place, unlit(), camera, window)
    _, mask = fine_frame(field, camera, place.position, place.orientation, np.zeros((*SIZE[::-1], 3)), 6)
    # Rays that graze came out too clear by 0.1 to 0.2 pixels, which is 0.5 to 1.5 % of the area here.
    assert abs(shape.sum() / mask.sum() - 1) < 3e-3


def test_losses_agree_on_the_size(bunny, camera):
    rng = np.random.default_rng(4)
    back = np.kron(rng.uniform(0.1, 0.7, (18, 24, 3)), np.ones((4, 4, 1)))
    subject = Subject(bunny)
    true = Placement(np.array([0.01, 0.0, 0.0]), quat_exp(np.array([0.2, -0.1, 0.8])))
    image, mask = fine_frame(bunny, camera, true.position, true.orientation, back)
    lamps = (Light(LIGHT), *[Light((0, 0, 1.0), intensity=0.0)] * 2)
    seen = np.ones(mask.shape, bool)
    plain = Target(camera, image / 255, mask, seen)
    ray = subject.middle(true) - camera.position
    ray = ray / np.linalg.norm(ray)
    begin = dataclasses.replace(true, position=true.position + 0.02 * subject.size * ray)
    found = {}
    for label, target, loss in (
        ("silhouette", plain, "silhouette"),
        ("colours", plain, "photometric"),
        ("background", plain._replace(behind=back, mask_noise=MASK_NOISE), "photometric"),
    ):
        one = refine(
            subject, target, begin, lamps, loss=loss, steps=12, rays=4000, random=np.random.default_rng(0)
        )
        assert one is not None
        found[label] = float((subject.middle(one.place) - subject.middle(true)) @ ray) / subject.size
    assert max(found.values()) - min(found.values()) < 3e-3, found
    assert max(map(abs, found.values())) < 4e-3, found


def test_what_a_tile_shares_does_not_pull():
    rng = np.random.default_rng(0)
    index = np.stack(np.meshgrid(np.arange(12), np.arange(12), indexing="ij"), axis=-1).reshape(-1, 2)
    common = rng.uniform(0.2, 0.8, (144, 3, 1))
    change = rng.normal(size=(144, 3, 6))
    tile = index[:, 0] // 6 * 2 + index[:, 1] // 6
    share = np.array([0.9, -0.5, 0.2, 0.0])[tile][:, None]
    true = rng.normal(size=6) * 0.01
    away = share * common[..., 0] + change @ true
    rest, slopes = _without_common(away, change, common, index)
    found = np.linalg.lstsq(slopes.reshape(-1, 6), rest.ravel(), rcond=None)[0]
    np.testing.assert_allclose(found, true, atol=2e-3)
    plain = np.linalg.lstsq(change.reshape(-1, 6), away.ravel(), rcond=None)[0]
    assert np.abs(plain - true).max() > 5 * np.abs(found - true).max()


def test_masks_are_believed_where_the_object_differs_from_the_place():
    expected = np.zeros((20, 40))
    expected[5:15, 5:35] = 1
    colour = expected[..., None] * [0.2, 0.5, 0.8]
    place = np.full((20, 40, 3), 0.3)
    place[:, 20:] = np.array([0.2, 0.5, 0.8]) * 0.85  # the object's colour in a shadow
    telling = differs(expected, colour, place)
    assert telling[5:15, 5:18].all() and not telling[5:15, 22:35].any()


def test_exposures_are_those_of_a_moving_object(bunny, camera):
    subject = Subject(bunny)
    position, orientation = path(1)
    velocity, spin = np.array([0.5, 0.1, -0.2]), np.array([0.0, 1.5, 2.0])
    still = Placement(position[0], orientation[0])
    y, x = np.mgrid[12:60:3, 26:74:3]
    pixels = np.stack([x.ravel(), y.ravel()], axis=1) + 0.5
    lamps = (Light(LIGHT), Light((1, 0, 0.5), intensity=0.3), Light((-1, 0, 0.2), intensity=0.2))

    def later(time, rows):
        """The object itself moved, not the rays."""
        turned = quat_multiply(quat_exp(time * spin), still.orientation)
        place = subject.around(subject.middle(still) + time * velocity, turned)
        return subject.picture(place, lamps, camera, pixels[rows])

    everything = np.arange(len(pixels))
    drift = Drift(velocity, spin, 0.02, 0.0)
    blurred = dataclasses.replace(still, drift=drift)
    seen = subject.picture(blurred, lamps, camera, pixels)
    speed = (np.linalg.norm(velocity) + subject.radius * np.linalg.norm(spin)) / (
        camera.pixel_angle * np.linalg.norm(subject.middle(still) - camera.position)
    )
    moments = drift.moments(pixels[:, 1] / camera.height, speed)
    assert moments.shape[1] == 5
    mean = np.mean([later(t, everything).opacity for t in moments[0]], axis=0)
    np.testing.assert_allclose(seen.opacity, mean, atol=5e-3)
    sharp = subject.picture(still, lamps, camera, pixels)
    assert np.abs(sharp.opacity - mean).max() > 0.2

    rolling = dataclasses.replace(still, drift=Drift(velocity, spin, 0.0, 0.03))
    seen = subject.picture(rolling, lamps, camera, pixels)
    for row in np.unique(pixels[:, 1])[::5]:
        rows = np.flatnonzero(pixels[:, 1] == row)
        late = (row / camera.height - 0.5) * 0.03
        np.testing.assert_allclose(seen.opacity[rows], later(late, rows).opacity, atol=5e-3)


def test_pixels_pull_wrong_poses_towards_the_true_ones(bunny, camera, filmed):
    position, orientation, frames, masks = filmed
    film = film_of(frames, masks)
    off = position + np.array([0.002, 0.0, -0.0015])
    turned = quat_multiply(orientation, quat_exp(np.tile([0.0, 0.02, 0.0], (4, 1))))
    off[3] = [5.0, 0.0, 0.0]
    dark = Light((0.0, 0.0, 1.0), intensity=0.0)
    lamps = (Light(LIGHT), dark, dark)
    found = adjust_poses(film, bunny, camera, off, turned, ROUGH, lamps=lamps)
    assert found.status == ("tracked", "tracked", "tracked", "outside")
    again = adjust_poses(film, bunny, camera, found.position, found.orientation, ROUGH, lamps=lamps)
    shift, turn = errors(again, position, orientation, slice(0, 3))
    assert shift.max() < 0.5 * 0.0025 / 0.12
    assert turn.max() < 0.5 * 0.02
    assert np.isnan(found.position[3]).all()
    assert np.all(np.linalg.eigvalsh(found.covariance[:3]) > 0)
    with pytest.raises(ValueError, match=r"position must have shape \(4, 3\), got \(3, 3\)"):
        adjust_poses(film, bunny, camera, off[:3], turned[:3], ROUGH)
    with pytest.raises(ValueError, match="no frame of 4 shows the object"):
        adjust_poses(film, bunny, camera, off + 9.0, turned, ROUGH)


def test_a_film_is_tracked_and_its_end_lies_outside(bunny, camera, filmed):
    position, orientation, frames, masks = filmed
    empty = np.broadcast_to(np.rint(255 * BACK), frames[0].shape).astype(np.uint8)
    film = film_of([*frames, empty], [*masks, np.zeros_like(masks[0])])
    start = (
        position[0] + [0.004, 0, -0.003],
        quat_multiply(orientation[0], quat_exp(np.array([0.05, 0.05, 0]))),
    )
    found = track(film, bunny, camera, ROUGH, start=start)
    assert found.status[:4] == ("tracked",) * 4
    assert found.status[4] == "lost"
    assert np.isnan(found.position[4]).all()
    assert any("lost" in text and "frames: 4" in text for text in found.messages)
    shift, turn = errors(found, position, orientation, slice(0, 4))
    assert shift.max() < 0.02
    assert np.degrees(turn.max()) < 2
    assert found.quality[:4].min() > 0.93
    assert found.colour_error[:4].max() < 0.06
    # The truth lies within what the covariances say, far from which would be 22 (0.1 %).
    for i in range(4):
        off = np.append(position[i] - found.position[i], turn_of(found.orientation[i], orientation[i]))
        assert off @ np.linalg.solve(found.covariance[i], off) < 22.5
    outline = found.overlays[2]
    assert outline is not None
    assert overlap(masks[2][outline.window], outline.opacity) > 0.93


def test_frames_in_which_it_lies_still_share_one_pose(bunny, camera, filmed):
    rng = np.random.default_rng(7)
    position, orientation, frames, masks = filmed
    rows = [0, 1, 2, 2, 2, 2]
    noisy = [
        np.rint(np.clip(frames[i] + 4 * rng.normal(size=frames[i].shape), 0, 255)).astype(np.uint8)
        for i in rows
    ]
    # Masks that are wrong in another place in each frame.
    given = [np.roll(masks[i], k % 2, axis=k // 2 % 2) for k, i in enumerate(rows)]
    start = position[0], orientation[0]
    found = track(film_of(noisy, given), bunny, camera, ROUGH, start=start)
    assert np.ptp(found.position[2:], axis=0).max() < 2e-3 * 0.12
    for q in found.orientation[3:]:
        assert np.linalg.norm(turn_of(found.orientation[2], q)) < 2e-3
    shift, _ = errors(found, position[rows], orientation[rows], slice(None))
    assert np.median(shift) < 0.02


def turn_of(p, q):
    return quat_log(quat_multiply(quat_conjugate(p), q))


def test_the_start_is_found_among_all_orientations(bunny, camera, filmed):
    position, orientation, frames, _ = filmed
    # No masks are given: the background is plain.
    options = TrackOptions(rays=700, views=48, turns=16, candidates=3)
    found = track(film_of(frames[:2], [None, None]), bunny, camera, options)
    shift, turn = errors(found, position, orientation, slice(0, 2))
    # Edges of masks by a threshold are not exact, which shows along the line of sight.
    assert (np.degrees(turn.max()) < 5, shift.max() < 0.1) == (True, True), (turn, shift)


def test_what_pushes_the_object_is_neither_it_nor_the_place(bunny, camera, tmp_path):
    """A block touches the object from the first frame on, hides a part of it, and stays behind."""
    rng = np.random.default_rng(5)
    place = 0.5 + 0.8 * (
        ndimage.gaussian_filter(rng.uniform(size=(SIZE[1], SIZE[0], 3)), (1.5, 1.5, 0)) - 0.5
    )
    Image.fromarray(np.rint(255 * place).astype(np.uint8)).save(tmp_path / "empty.png")
    position, orientation = path(3)
    frames = []
    for k, (p, q) in enumerate(zip(position, orientation, strict=True)):
        shown, opacity = drawn(bunny, camera, p, q)
        # The plain background is taken off again.
        shown = shown / 255 + (1 - opacity[..., None]) * (place - BACK)
        top, left = np.argwhere(opacity > 0.5).min(axis=0)
        shown[top + 8 : top + 40, max(left - 24 - k, 0) : left + 7 - k] = [0.65, 0.56, 0.44]
        noise = 0.01 * rng.normal(size=shown.shape)
        frames.append(np.rint(255 * np.clip(shown + noise, 0, 1)).astype(np.uint8))
    options = TrackOptions(masks="object", rays=700, views=36, turns=12, candidates=2)
    found = track(film_of(frames, [None] * 3), bunny, camera, options, background=tmp_path / "empty.png")
    assert found.n_tracked == 3
    shift, turn = errors(found, position, orientation, slice(None))
    # Half of its edge is not seen, at 40 pixels of size.
    assert (np.median(shift) < 0.06, np.degrees(np.median(turn)) < 5) == (True, True), (shift, turn)


@pytest.mark.slow
def test_of_several_things_the_object_is_found_and_two_alike_are_said(bunny, camera):
    position, orientation = path(2)
    wide = camera.replaced(width=150, centre=np.array([75.0, 36.0]))
    beside = position + np.array([0.16, 0.02, 0.0])
    frames, masks, mixed, both = [], [], [], []
    for p, other, q in zip(position, beside, orientation, strict=True):
        (one, here), (two, there) = (drawn(bunny, wide, x, q) for x in (p, other))
        frames.append(np.where(there[..., None] > 0.02, two, one))
        masks.append(np.maximum(here, there))
        # A box instead of the second one, somewhat larger.
        box = np.zeros(here.shape, bool)
        box[20:55, 100:140] = True
        mixed.append(np.where(box[..., None], np.array([200, 180, 160], np.uint8), one))
        both.append(np.maximum(here, box))
    options = TrackOptions(rays=700, views=48, turns=16, candidates=3)
    found = track(film_of(mixed, both), bunny, wide, options)
    shift, _ = errors(found, position, orientation, slice(0, 2))
    assert (found.status, shift.max() < 0.1) == (("tracked", "tracked"), True)
    assert not any("look like the object" in text for text in found.messages)
    found = track(film_of(frames, masks), bunny, wide, options)
    assert found.status == ("tracked", "tracked")
    assert any("2 things in frame 0 look like the object" in text for text in found.messages)
    given = track(film_of(frames, masks), bunny, wide, options, start=(beside[0], orientation[0]))
    shift, _ = errors(given, beside, orientation, slice(0, 2))
    assert shift.max() < 0.1


def test_the_paper_s_loss_and_a_hand_in_front(bunny, camera, filmed):
    position, orientation, frames, masks = filmed
    hidden = [mask.copy() for mask in masks[:2]]
    hand = np.zeros_like(masks[0])
    hand[:, :40] = 1
    covered = [np.where(hand[..., None] > 0, np.uint8(90), frame) for frame in frames[:2]]
    for mask in hidden:
        mask[hand > 0] = 0
    film = film_of(covered, hidden)._replace(occluders=[hand, hand])
    for loss in ("photometric", "paper"):
        options = TrackOptions(rays=700, loss=loss)
        found = track(film, bunny, camera, options, start=(position[0], orientation[0]))
        shift, turn = errors(found, position, orientation, slice(0, 2))
        assert shift.max() < 0.05
        assert np.degrees(turn.max()) < 8


def test_what_is_wrong_is_said(bunny, camera, filmed):
    _, _, frames, masks = filmed
    film = film_of(frames[:2], masks[:2])
    wide = camera.replaced(width=SIZE[1], height=SIZE[0])
    with pytest.raises(
        ValueError, match="size of the film, 96 × 72 pixels, got 72 × 96, as if the film were turned"
    ):
        track(film, bunny, wide, ROUGH)
    with pytest.raises(ValueError, match="orientation of start"):
        track(film, bunny, camera, ROUGH, start=(np.zeros(3), np.zeros(4)))
    with pytest.raises(ValueError, match="masks='given'"):
        track(film_of(frames[:2], [None, None]), bunny, camera, TrackOptions(masks="given"))
    nothing = [np.zeros_like(m) for m in masks[:2]]
    with pytest.raises(ValueError, match="found in none of 2 frames"):
        track(film_of(frames[:2], nothing), bunny, camera, ROUGH)
    shaky = [np.roll(np.tile(ramp(), (1, 1, 1)), 30 * i, axis=1) for i in range(4)]
    with pytest.raises(ValueError, match="background is not static"):
        track(film_of(shaky, [None] * 4), bunny, camera, TrackOptions(masks="static"))
    with pytest.raises(ValueError, match="masks must be one of"):
        TrackOptions(masks="magic")
    with pytest.raises(ValueError, match="table must be finite, got nan"):
        TrackOptions(table=float("nan"))
    with pytest.raises(ValueError, match="rays must be ≥ 256, got 3"):
        TrackOptions(rays=3)


@pytest.mark.parametrize("change", [-2.0, -1.0, 0.0, 1.0, 2.0])
def test_the_edge_of_a_mask_is_found_in_the_picture_and_moved_there(change):
    y, x = np.mgrid[:90, :120]
    inside = 25.3 - np.hypot(y - 44.2, (x - 61.7) / 1.4)  # pixels, nearly: an ellipse of closed form
    truth = np.clip(0.5 + inside, 0, 1)
    rng = np.random.default_rng(0)
    texture = ndimage.gaussian_filter(rng.normal(size=(2, 90, 120, 3)), (0, 1.5, 1.5, 0))
    image = truth[..., None] * (0.7 + 0.15 * texture[0]) + (1 - truth[..., None]) * (0.3 + 0.15 * texture[1])
    mask = np.clip(0.5 + inside + change, 0, 1)
    seen = np.ones(mask.shape, bool)
    offset = edge_offset(mask, image, seen)
    # Sideways a unit of the ellipse is 1.4 pixels.
    assert offset == pytest.approx(1.2 * change, abs=0.35)
    assert overlap(moved_edge(mask, -offset), truth) > 0.975
    # A plain picture shows no edge, and what differs from frame to frame is not a common offset.
    assert np.isnan(edge_offset(mask, np.full_like(image, 0.5), seen))
    assert np.isnan(edge_offset(np.zeros_like(mask), image, seen))
    assert common_offset([offset] * 5) == (pytest.approx(offset) if change else 0)
    assert common_offset([-2.0, 2.0, -1.5, 1.5]) == 0
    assert common_offset([offset, np.nan, np.nan]) == 0


@pytest.mark.parametrize("grown", [-1.5, 1.5])
def test_masks_of_a_wrong_size_are_moved_and_that_is_said(bunny, camera, filmed, grown):
    position, orientation, frames, masks = filmed
    wrong = [np.float32(moved_edge(mask, grown)) for mask in masks]
    found = track(film_of(frames, wrong), bunny, camera, ROUGH, start=(position[0], orientation[0]))
    assert any("their edge lies 1." in text and "they were moved" in text for text in found.messages)
    place, _ = errors(found, position, orientation, slice(None))
    # A pixel and a half of 40 is 4 % of the distance, or 17 % of the size.
    assert np.median(place) < 0.03


def test_the_sun_is_found_between_the_directions_that_lamps_have(bunny, camera):
    subject = Subject(bunny)
    light = LightFit(subject)
    sun = np.array([-0.35, -0.55, 0.76]) / np.linalg.norm([-0.35, -0.55, 0.76])
    sky = np.random.default_rng(1).normal(size=(16, 3))
    sky[:, 2] = np.abs(sky[:, 2])
    dark = Light((0.0, 0.0, 1.0), intensity=0.0)
    y, x = np.mgrid[10:62:2, 24:72:2]
    pixels = np.stack([x.ravel(), y.ravel()], axis=1) + 0.5
    for turn in ((0.2, -0.1, 0.8), (0.5, 0.4, -1.2), (-0.3, 0.2, 2.4)):
        place = subject.around(np.zeros(3), quat_exp(np.array(turn)))
        # Sunlight and that of a cloudy sky add up, in linear light.
        shares = [(sun, 0.8), *((towards, 0.3 / len(sky)) for towards in sky)]
        pictures = [
            subject.picture(place, (Light(towards), dark, dark), camera, pixels) for towards, _ in shares
        ]
        inside = pictures[0].opacity > 0.95
        linear = sum(
            share * seen.colour[inside] ** GAMMA for (_, share), seen in zip(shares, pictures, strict=True)
        )
        light.add(place, camera, pixels[inside], linear ** (1 / GAMMA))

    def off():
        strongest = max(light.lamps, key=lambda lamp: float(np.sum(lamp.colour)))
        return np.degrees(np.arccos(np.clip(np.asarray(strongest.place) @ sun, -1, 1)))

    before = off()
    light.find_sun()
    assert before > 8
    assert off() < 5


@pytest.mark.parametrize("sun", [(-0.5, -0.35, 0.79), (0.7, 0.3, 0.5)])
def test_the_shadow_on_a_table_says_where_the_sun_is(bunny, sun):
    towards = np.array(sun) / np.linalg.norm(sun)
    camera = Camera((0.14, -0.42, 0.3), (0.0, 0.0, 0.03), width=160, height=120)
    lamps, table = [Light(towards, intensity=0.8)], Item(HalfSpace())
    rng = np.random.default_rng(3)
    texture = ndimage.gaussian_filter(rng.uniform(0.6, 1.0, (120, 160)), 1.0)[..., None]
    bare = compose([table], camera, lamps, ambient=0.3).colour * texture
    shadows, nothing = (ShadowFit(Subject(bunny), 0.0, keep=6) for _ in range(2))
    for x, angle in ((-0.03, 0.4), (0.02, 1.5)):
        place = Placement(np.array([x, 0.01, 0.0]), np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)]))
        pose = Pose(place.position, place.orientation)
        seen = compose([Item(bunny, pose), table], camera, lamps, ambient=0.3)
        free = ~ndimage.binary_dilation(seen.identity == 0, iterations=2)
        noise = 0.01 * rng.normal(size=bare.shape)
        # A third less exposure, which shades are relative to.
        image = np.clip(0.85 * seen.colour * texture + noise, 0, 1)
        shadows.add(place, camera, image, np.sum(bare**GAMMA, axis=2), free)
        nothing.add(place, camera, np.clip(0.85 * bare + noise, 0, 1), np.sum(bare**GAMMA, axis=2), free)
    found = shadows.sun()
    assert found is not None
    assert np.degrees(np.arccos(found @ towards)) < 2
    assert nothing.sun() is None


def test_a_fast_spin_is_followed_from_the_first_frame_on(bunny, camera):
    """31° a frame, which nothing tells before the third one."""
    position, orientation = path(5, spin=(0.2, 0.4, -0.3))
    frames, masks = zip(
        *(drawn(bunny, camera, p, q) for p, q in zip(position, orientation, strict=True)), strict=True
    )
    found = track(film_of(frames, masks), bunny, camera, ROUGH, start=(position[0], orientation[0]))
    assert found.n_tracked == 5
    _, turn = errors(found, position, orientation, slice(None))
    assert np.degrees(turn).max() < 5


def ramp():
    values = np.random.default_rng(0).integers(0, 255, (SIZE[1], SIZE[0], 3))
    return values.astype(np.uint8)


def test_directions_that_are_not_seen_are_said_and_have_large_variances(bunny):
    subject = Subject(bunny)
    # Curvature as of a surface of revolution about y of the object's frame.
    axis = np.array([0, 0, 0, 0, 1.0, 0])
    hessian = 1e6 * (np.eye(6) - np.outer(axis, axis))
    window = (slice(0, 1), slice(0, 1))
    place = Placement(np.zeros(3), np.array([1.0, 0, 0, 0]))
    blind = Refined(place, 0.0, 1.0, 0.0, hessian, 1e-8 * np.eye(6), window, np.zeros((1, 1)))
    texts = unobservable([blind, blind], subject)
    assert len(texts) == 1
    assert "turns about the axis (0.00, 1.00, 0.00)" in texts[0]
    eye = np.array([0, -0.5, 0])
    covariance = covariance_of(blind, subject, eye)
    assert np.sqrt(covariance[4, 4]) > 1.5
    assert np.sqrt(covariance[3, 3]) < 0.01
    # A scale that is not known shows along the line of sight.
    assert covariance[1, 1] > 2 * covariance[0, 0]
    seen = blind._replace(hessian=1e6 * np.eye(6))
    assert unobservable([seen, seen], subject) == []


def test_placements_turn_about_the_ball(bunny):
    subject = Subject(bunny)
    turn = quat_exp(np.array([0.3, 0.2, -0.5]))
    place = subject.around(np.array([0.1, 0.2, 0.3]), turn)
    np.testing.assert_allclose(subject.middle(place), [0.1, 0.2, 0.3], atol=1e-12)
    moved = place.moved(np.array([0.5, 0, 0, 0, 0, 0.2]), subject.radius)
    np.testing.assert_allclose(moved.position - place.position, [0.5 * subject.radius, 0, 0], atol=1e-12)
    ahead = quat_rotate(quat_conjugate(turn), quat_rotate(moved.orientation, np.array([1.0, 0, 0])))
    np.testing.assert_allclose(ahead, [np.cos(0.2), np.sin(0.2), 0], atol=1e-12)


def test_the_command_writes_a_motion_and_a_page(tmp_path, camera, filmed, capsys):
    position, orientation, frames, masks = filmed
    for name, pictures in (("frames", frames[:2]), ("masks", [np.uint8(255 * m) for m in masks[:2]])):
        (tmp_path / name).mkdir()
        for i, pixels in enumerate(pictures):
            Image.fromarray(pixels).save(tmp_path / name / f"{i}.png")
    lens = {
        "fl_x": 200.0,
        "w": SIZE[0],
        "h": SIZE[1],
        "transform_matrix": [*camera.pose.tolist(), [0, 0, 0, 1]],
    }
    (tmp_path / "camera.json").write_text(json.dumps(lens))
    command = ["track", str(tmp_path / "frames"), "trained_bunny", "-o", str(tmp_path / "m.npz")]
    command += [
        "--camera",
        str(tmp_path / "camera.json"),
        "--masks",
        str(tmp_path / "masks"),
        "--rays",
        "700",
    ]
    command += ["--start", *(f"{x:.4f}" for x in (*position[0], *orientation[0]))]
    with pytest.raises(SystemExit):
        main(command)
    assert "give rate" in capsys.readouterr().err
    main([*command, "--rate", "30", "--report", str(tmp_path / "page.html"), "--json"])
    told = json.loads(capsys.readouterr().out)
    assert told["tracked"] == 2
    motion = load_motion(tmp_path / "m.npz")
    assert motion.names == ("trained_bunny",)
    assert motion.point == "origin"
    assert motion.covariance is not None
    assert np.linalg.norm(motion.position[1, 0] - position[1]) < 0.0025
    page = (tmp_path / "page.html").read_text()
    assert page.count("<figure>") == 2
    assert "tracked" in page
