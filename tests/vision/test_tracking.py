"""Tracking a learned object in films that are drawn of it, by another path than the tracker's own."""

import dataclasses
import json

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage
from vision.drawn_films import BACK, drawn, errors, film_of, fine_frame, LIGHT, path, ramp, ROUGH, SIZE

from dano.cli import main
from dano.identification import load_motion
from dano.maths import quat_conjugate, quat_exp, quat_log, quat_multiply
from dano.vision import adjust_poses, Light, track, TrackOptions
from dano.vision.drawing import GAMMA
from dano.vision.tracking._placement import Placement
from dano.vision.tracking._refine import Refined
from dano.vision.tracking._segments import moved_edge, overlap
from dano.vision.tracking._subject import Subject
from dano.vision.tracking._walk import Walk


@pytest.fixture(scope="module")
def filmed(bunny, camera):
    position, orientation = path(4)
    frames, masks = zip(
        *(drawn(bunny, camera, p, q) for p, q in zip(position, orientation, strict=True)), strict=True
    )
    return position, orientation, frames, masks


@pytest.mark.slow
def test_a_jump_is_caught_up_with_where_masks_need_no_pose(bunny, camera, tmp_path, monkeypatch):
    rng = np.random.default_rng(5)
    back = np.kron(rng.uniform(0.2, 0.6, (18, 24, 3)), np.ones((4, 4, 1)))
    # From one frame to the next by half the size; the second frame is a fifth brighter.
    position = np.array([[-0.04, 0.0, 0.0], [0.02, 0.01, 0.0]])
    orientation = np.tile(quat_exp(np.array([0.2, -0.1, 0.8])), (2, 1))
    frames = [fine_frame(bunny, camera, p, q, back)[0] for p, q in zip(position, orientation, strict=True)]
    frames[1] = np.rint(np.clip(1.2 * frames[1], 0, 255)).astype(np.uint8)
    file = tmp_path / "place.png"
    Image.fromarray(np.rint(255 * back).astype(np.uint8)).save(file)
    options = dataclasses.replace(ROUGH, masks="object")
    walk = Walk(film_of(frames, [None, None]), bunny, camera, options, file)
    monkeypatch.setattr(walk, "_searched", lambda i: None)
    walk.begin(Placement(position[0], orientation[0]))
    walk.step(0)
    walk.step(1)
    found = walk.result(lambda share: None)
    shift, turn = errors(found, position, orientation, slice(None))
    assert found.status == ("tracked", "tracked")
    assert (shift.max() < 0.05, turn.max() < np.radians(4)) == (True, True), (shift, turn)


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


@pytest.mark.slow
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


def test_an_error_of_one_pose_is_no_velocity_where_nothing_moves(bunny, camera, filmed):
    """It rests in frames 0 and 1, whose poses are wrong along the line of sight; then it moves."""
    position, orientation, frames, masks = filmed
    rows, whole, nothing = [0, 0, 1, 2], (slice(0, SIZE[1]), slice(0, SIZE[0])), np.eye(6)
    walk = Walk(film_of([frames[i] for i in rows], [masks[i] for i in rows]), bunny, camera, ROUGH, None)
    wrong = position[0] + 0.05 * (camera.position - position[0])
    for i, place in enumerate([wrong, wrong, position[1]]):
        known = Placement(place, orientation[rows[i]])
        walk._found[i] = Refined(known, 0.0, 1.0, 0.0, nothing, nothing, whole, masks[rows[i]])
    np.testing.assert_array_equal(walk._carried(2, 1, 0).position, wrong)
    np.testing.assert_allclose(walk._carried(1, 2, 3).position, 2 * position[1] - wrong, atol=1e-9)


def turn_of(p, q):
    return quat_log(quat_multiply(quat_conjugate(p), q))


def test_what_the_edge_of_the_picture_cuts_is_fitted_by_what_is_seen(bunny, camera):
    """No frame shows all of it; what lies beside the picture is unknown, and too little is no pose."""
    orientation = np.tile(path(1)[1], (3, 1))
    position = np.array([[0.09, 0.0, 0.0], [0.112, 0.0, 0.0], [0.134, 0.0, 0.0]])
    places = [Placement(p, q) for p, q in zip(position, orientation, strict=True)]
    shares = [Subject(bunny).inside(place, camera) for place in places]
    assert shares[0] < 0.9 and shares[1] > 0.55 and shares[2] < 0.35
    frames, masks = zip(
        *(drawn(bunny, camera, p, q) for p, q in zip(position, orientation, strict=True)), strict=True
    )
    options = TrackOptions(rays=700, views=48, turns=16, candidates=3)
    found = track(film_of(frames, masks), bunny, camera, options)
    assert found.status == ("tracked", "tracked", "outside")
    assert np.isnan(found.position[2]).all()
    assert any("its pose is doubtful, in 1 frames: 2" in text for text in found.messages)
    shift, turn = errors(found, position, orientation, slice(0, 2))
    assert (shift.max() < 0.03, np.degrees(turn.max()) < 3) == (True, True), (shift, turn)


def test_light_of_many_lamps_is_that_of_each(bunny, camera):
    """Beside the renderer, lamp by lamp."""
    subject, (position, orientation) = Subject(bunny), path(1)
    place = Placement(position[0], orientation[0])
    pixels = np.stack(np.meshgrid(np.arange(30, 66), np.arange(20, 52)), axis=-1).reshape(-1, 2) + 0.5
    towards = np.array([[0.6, 0.0, 0.8], [-0.48, -0.6, 0.64], [0.0, 1.0, 0.0]])
    light = subject.shown(place, camera, pixels).light(towards)
    for k, direction in enumerate(towards):
        seen = subject.picture(place, (Light(direction),), camera, pixels)
        each = np.maximum(seen.colour / np.maximum(seen.opacity, 0.5)[:, None], 0) ** GAMMA
        np.testing.assert_allclose(light[..., k], each, atol=1e-5)
    assert light.max() > 0.1


def test_the_start_is_found_among_all_orientations(bunny, camera, filmed):
    position, orientation, frames, _ = filmed
    # No masks are given: the background is plain.
    options = TrackOptions(rays=700, views=48, turns=16, candidates=3)
    found = track(film_of(frames[:2], [None, None]), bunny, camera, options)
    shift, turn = errors(found, position, orientation, slice(0, 2))
    # Edges of masks by a threshold are not exact, which shows along the line of sight.
    assert (np.degrees(turn.max()) < 5, shift.max() < 0.1) == (True, True), (turn, shift)


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("grown", [-1.5, 1.5])
def test_masks_of_a_wrong_size_are_moved_and_that_is_said(bunny, camera, filmed, grown):
    position, orientation, frames, masks = filmed
    wrong = [np.float32(moved_edge(mask, grown)) for mask in masks]
    found = track(film_of(frames, wrong), bunny, camera, ROUGH, start=(position[0], orientation[0]))
    assert any("their edge lies 1." in text and "they were moved" in text for text in found.messages)
    place, _ = errors(found, position, orientation, slice(None))
    # A pixel and a half of 40 is 4 % of the distance, or 17 % of the size.
    assert np.median(place) < 0.03


@pytest.mark.slow
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
