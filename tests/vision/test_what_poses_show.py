"""What poses of a learned object show: silhouettes, blur, light and shadow; and what masks tell of it."""

import dataclasses

import numpy as np
import pytest
from scipy import ndimage
from vision.drawn_films import fine_frame, LIGHT, path, SIZE

from dano import HalfSpace, Pose
from dano.maths import quat_conjugate, quat_exp, quat_multiply, quat_rotate, quat_to_matrix
from dano.scene_file import asset_look, load_asset
from dano.vision import Camera, compose, Item, Light
from dano.vision.capture import PosedCamera
from dano.vision.drawing import GAMMA
from dano.vision.tracking._film import Target
from dano.vision.tracking._light import LightFit, ShadowFit, unlit
from dano.vision.tracking._placement import Drift, Placement
from dano.vision.tracking._refine import (
    _along,
    _without_common,
    _without_shadow,
    MASK_NOISE,
    refine,
    Refined,
    silhouette,
    window_of,
)
from dano.vision.tracking._result import covariance_of, shared_covariance, unobservable
from dano.vision.tracking._search import half_turns
from dano.vision.tracking._segments import common_offset, differs, edge_offset, moved_edge, overlap
from dano.vision.tracking._subject import _exposed, Seen, Subject
from dano.vision.tracking._whole import told_apart, turn_evidence
from dano.vision.trajectory import crossings


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


def test_a_dark_strip_beside_the_object_does_not_pull():
    """Of an edge over a place, a strip outside is in its shadow: 40 % darker, in the same hue."""
    behind = np.tile([0.5, 0.7, 0.8], (400, 1))
    rng = np.random.default_rng(2)
    change = rng.normal(size=(400, 3, 6))
    strip = np.arange(400) < 60
    true = rng.normal(size=6) * 0.01
    away = change @ true + np.where(strip, 0.4, 0)[:, None] * behind
    found = {}
    for cast in (0.0, 0.3):
        rest, slopes = _without_shadow(away, change, behind, np.where(strip, cast, 0))
        found[cast] = np.linalg.lstsq(slopes.reshape(-1, 6), rest.ravel(), rcond=None)[0]
    assert np.abs(found[0.3] - true).max() < 0.1 * np.abs(found[0.0] - true).max()
    # What is brighter is no shadow, and counts in full.
    bright, slopes = _without_shadow(-0.4 * behind, change, behind, np.full(400, 0.3))
    np.testing.assert_array_equal(bright, -0.4 * behind)
    np.testing.assert_array_equal(slopes, change)


def test_clearance_is_the_distance_from_the_surface(bunny):
    subject, place = (
        Subject(bunny),
        Placement(np.array([0.3, -0.1, 0.2]), quat_exp(np.array([0.3, 0.5, -1.0]))),
    )
    middle = subject.middle(place)
    # Far away: between the distances from the ball around it and from its middle.
    ways = np.random.default_rng(3).normal(size=(50, 3))
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    far = subject.clearance(place, middle + 4 * subject.radius * ways)
    assert (far > 0.9 * 3 * subject.radius).all() and (far < 4 * subject.radius).all()
    # Where rays meet it there is none.
    eye = Camera(middle + [0.0, -0.5, 0.3], middle, width=32, height=32)
    pixels = np.stack(np.meshgrid(np.arange(8, 24), np.arange(8, 24)), axis=-1).reshape(-1, 2) + 0.5
    away, opacity = subject.distances(place, eye, pixels)
    met = opacity > 0.99
    points = eye.position + away[:, None] * eye.directions(pixels)
    assert met.sum() > 20
    assert np.median(np.abs(subject.clearance(place, points[met]))) < 0.01 * subject.size


def test_costs_along_a_move_make_the_curvature_there_and_leave_the_rest():
    random = np.random.default_rng(3)
    root = random.normal(size=(6, 6))
    hessian, gradient, move = root @ root.T + np.eye(6), random.normal(size=6), random.normal(size=6)

    def parabola(curvature: float, slope: float) -> tuple[float, float, float]:
        cost = 7.0
        return cost, cost - slope + 0.5 * curvature, cost + slope + 0.5 * curvature

    steep = float(move @ hessian @ move)
    # Costs of Gauss and Newton's own parabola change nothing.
    same = _along(move, gradient, hessian, *parabola(steep, float(gradient @ move)))
    np.testing.assert_allclose(same[0], gradient, atol=1e-10)
    np.testing.assert_allclose(same[1], hessian, atol=1e-10)
    slope, flatter = _along(move, gradient, hessian, *parabola(0.3 * steep, -0.2))
    assert slope @ move == pytest.approx(-0.2) and move @ flatter @ move == pytest.approx(0.3 * steep)
    across = random.normal(size=6)
    across -= move * (move @ hessian @ across) / steep
    assert slope @ across == pytest.approx(gradient @ across)
    np.testing.assert_allclose(flatter @ across, hessian @ across, atol=1e-10)


def test_a_word_says_how_a_soap_is_turned(camera):
    """The soap is a box but for a word on one side: one of four half turns has it where it is seen."""
    soap = asset_look("trained_soap")
    assert soap is not None
    subject, place = Subject(soap), Placement(np.zeros(3), quat_exp(np.array([0.8, 0.0, 0.2])))
    near = camera.replaced(focal=2 * camera.focal, centre=2 * camera.centre, width=192, height=144)
    image, mask = fine_frame(soap, near, place.position, place.orientation, np.full((144, 192, 3), 0.2))
    noise = np.random.default_rng(0).normal(0, 0.02, image.shape)
    target = Target(near, np.clip(image / 255 + noise, 0, 1), mask, np.ones(mask.shape, bool))
    found = turn_evidence(subject, [(target, place)], unlit())[:, 0]
    turn, clear = told_apart(found)
    assert turn == 0 and clear > 1.5, found
    # Begun with the wrong side, the turn back is told.
    for h, turned in enumerate(half_turns(subject, place), start=1):
        found = turn_evidence(subject, [(target, turned)], unlit())[:, 0]
        assert told_apart(found)[0] == h, found


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
    back = np.full((len(pixels), 3), 0.9)
    seen = subject.picture(blurred, lamps, camera, pixels, behind=back)
    over = [
        one.colour + (1 - one.opacity[:, None]) * back for one in (later(t, everything) for t in moments[0])
    ]
    light = np.mean([frame**GAMMA for frame in over], axis=0) ** (1 / GAMMA)
    found = seen.colour + (1 - seen.opacity[:, None]) * back
    np.testing.assert_allclose(found, light, atol=5e-3)
    # The mean of sRGB is darker where the object passed.
    assert (found - np.mean(over, axis=0)).max() > 0.02
    sharp = subject.picture(still, lamps, camera, pixels)
    assert np.abs(sharp.opacity - mean).max() > 0.2

    rolling = dataclasses.replace(still, drift=Drift(velocity, spin, 0.0, 0.03))
    seen = subject.picture(rolling, lamps, camera, pixels)
    for row in np.unique(pixels[:, 1])[::5]:
        rows = np.flatnonzero(pixels[:, 1] == row)
        late = (row / camera.height - 0.5) * 0.03
        np.testing.assert_allclose(seen.opacity[rows], later(late, rows).opacity, atol=5e-3)

    # Of a whole picture the middle of the exposure is spread, as if the object were flat.
    both = dataclasses.replace(still, drift=Drift(velocity, spin, 0.02, 0.03))
    opacity, colour = subject.whole(both, lamps, camera)
    x, y = pixels.astype(int).T
    seen = subject.picture(both, lamps, camera, pixels)
    assert overlap(opacity[y, x], seen.opacity) > 0.98 > 0.95 > overlap(sharp.opacity, seen.opacity)
    assert np.sqrt(np.mean((colour[y, x] - seen.colour) ** 2)) < 0.02
    assert subject.whole(both, lamps, camera)[0] is opacity


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


def test_derivatives_of_exposures_are_those_of_means_of_light():
    rng = np.random.default_rng(9)
    back, way, step = rng.uniform(0.2, 0.9, (5, 3)), rng.normal(size=6), 1e-6
    plain = []
    for _ in range(4):
        slopes = rng.normal(size=(5, 6)), rng.normal(size=(5, 3, 6))
        plain.append(Seen(rng.uniform(0.2, 0.8, 5), rng.uniform(0, 0.5, (5, 3)), *slopes))

    def blurred(far: float) -> Seen:
        ones = [
            one._replace(
                opacity=one.opacity + far * one.opacity_slope @ way,
                colour=one.colour + far * one.colour_slope @ way,
            )
            for one in plain
        ]
        mean = Seen(*(np.mean(column, axis=0) for column in zip(*ones, strict=True)))
        return _exposed(ones, mean, back)

    change = (blurred(step).colour - blurred(-step).colour) / (2 * step)
    np.testing.assert_allclose(blurred(0.0).colour_slope @ way, change, rtol=1e-6)


@pytest.mark.parametrize("angle", [0, 20, 45, 70])
def test_edges_are_moved_by_as_much_in_all_directions(angle):
    x, y = np.meshgrid(np.arange(60.0), np.arange(50.0))
    middle, length = (
        (slice(8, -8),) * 2,
        min(44 / np.sin(np.radians(angle) + 1e-9), 34 / np.cos(np.radians(angle))),
    )
    for change in (-2.0, -1.0, 1.0, 2.0):
        wide = []
        for start in np.linspace(28, 29, 9, endpoint=False):
            inside = (x - start) * np.cos(np.radians(angle)) + (y - 24.1) * np.sin(np.radians(angle))
            found = moved_edge(np.clip(0.5 + inside, 0, 1), change)
            wide.append((found - np.clip(0.5 + inside + change, 0, 1))[middle].sum() / length)
        # By distances between whole pixels it would be 0.2 pixels too far.
        assert abs(np.mean(wide)) < 0.08


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


def test_a_picture_from_each_second_pixel_has_the_same_edge(bunny, camera):
    """Looked at closely, through a lens that bends; what is interpolated lies inside."""
    subject = Subject(bunny)
    position, orientation = path(1)
    place = Placement(position[0], orientation[0])
    near = PosedCamera(
        np.concatenate([camera.axes.T * [1, 1, -1], camera.position[:, None]], axis=1),
        focal=3 * camera.focal.mean(),
        width=3 * camera.width,
        height=3 * camera.height,
        distortion=(0.05, -0.01, 0.0, 0.002, 0.001),
    )
    (whole, colour), (sparse, some) = (
        subject.whole(place, unlit(), near, pattern=pattern) for pattern in (True, False)
    )
    assert (whole > 0.5).sum() > 5000
    np.testing.assert_allclose(sparse, whole, atol=0.02)
    assert np.sqrt(np.mean((some - colour)[whole > 0.9] ** 2)) < 0.03
    pixels = np.array([[0.5, 0.5], [100.5, 7.5], [near.width - 0.5, near.height - 0.5]])
    np.testing.assert_allclose(subject._directions(near, pixels), near.directions(pixels), atol=1e-12)


def test_placements_turn_about_the_ball(bunny):
    subject = Subject(bunny)
    turn = quat_exp(np.array([0.3, 0.2, -0.5]))
    place = subject.around(np.array([0.1, 0.2, 0.3]), turn)
    np.testing.assert_allclose(subject.middle(place), [0.1, 0.2, 0.3], atol=1e-12)
    moved = place.moved(np.array([0.5, 0, 0, 0, 0, 0.2]), subject.radius)
    np.testing.assert_allclose(moved.position - place.position, [0.5 * subject.radius, 0, 0], atol=1e-12)
    ahead = quat_rotate(quat_conjugate(turn), quat_rotate(moved.orientation, np.array([1.0, 0, 0])))
    np.testing.assert_allclose(ahead, [np.cos(0.2), np.sin(0.2), 0], atol=1e-12)


def test_the_surface_is_where_distances_change_sign():
    """A ball cut off by a table: distances below the cut are no distances, and their slopes vanish there."""
    x, y, z = (np.stack(np.meshgrid(*[np.arange(24.0)] * 3, indexing="ij")) - 11.5) / 8.0
    values = np.where(z < -0.32, 0.3, np.sqrt(x**2 + y**2 + z**2) - 1.0)
    points = (crossings(values) - 11.5) / 8.0
    round_ = np.linalg.norm(points, axis=1)
    above = points[:, 2] > -0.3
    assert above.sum() > 500 and np.abs(round_[above] - 1).max() < 3e-3
    # Within one cell of the cut, wherever between its nodes the sign changes.
    assert np.all(points[:, 2] > -0.32 - 1 / 8)


def test_a_doubt_of_the_turn_is_one_about_the_middle(bunny):
    """The frame of an object may lie far beside it: its middle is as sure all the same."""
    far, near = Subject(bunny), Subject(bunny)
    far.centre, near.centre = np.array([0.1, -0.2, 0.02]), np.zeros(3)
    turn = np.asarray(quat_exp(np.array([0.3, -0.2, 0.5])))
    away = shared_covariance(far, turn)
    # How the middle p + R c moves with the pose, by differences.
    middle = np.eye(6)
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1e-6
        moved = quat_to_matrix(quat_multiply(turn, np.asarray(quat_exp(step)))) @ far.centre
        middle[:3, 3 + k] = (moved - quat_to_matrix(turn) @ far.centre) / 1e-6
    np.testing.assert_allclose(middle @ away @ middle.T, shared_covariance(near, turn), atol=1e-10)
    assert away[0, 0] > 3 * shared_covariance(near, turn)[0, 0]


@pytest.mark.parametrize("name", ["trained_bunny", "trained_soap"])
def test_a_look_has_the_centre_of_mass_and_the_inertia_of_its_object(name):
    """An object's come from its closed surface and its density; a look knows where it is solid."""
    known, look = load_asset(name).mass, asset_look(name)
    assert look is not None
    solid = Subject(look).solid
    assert solid.inertia is not None
    np.testing.assert_allclose(solid.com, known.com, atol=0.002 * solid.size)
    expected = np.asarray(known.inertia) / float(known.mass)
    np.testing.assert_allclose(solid.inertia, expected, atol=0.01 * np.trace(expected))
