"""Pictures of several objects, against closed forms and geometry."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull
from vision.models import Fog, learned

from dano import Box as BoxShape, GridField, HalfSpace, Pose, Sphere
from dano.vision import Camera, compose, Item, Light, PosedCamera
from dano.vision.drawing._composed import shared_weights
from dano.vision.radiance._picture import picture

ABOVE = Light((0.0, 0.0, 1.0))


def fog(lower, upper, extinction) -> Item:
    return Item(Fog.create(lower, upper, extinction))


def test_overlapping_media_share_one_transmittance():
    a, b = 1.3, 0.7
    edges = [
        jnp.linspace(0.0, 2.0, 5, dtype=jnp.float32)[None],
        jnp.linspace(1.1, 3.0, 8, dtype=jnp.float32)[None],
    ]
    alphas = [-jnp.expm1(-s * jnp.diff(e, axis=1)) for s, e in zip((a, b), edges, strict=True)]
    weights, clear = shared_weights(edges, alphas, 1)
    assert float(clear[0]) == pytest.approx(math.exp(-2 * a - 1.9 * b), rel=1e-5)
    first = 1 - math.exp(-1.1 * a)
    both = math.exp(-1.1 * a) * (1 - math.exp(-0.9 * (a + b)))
    last = math.exp(-2 * a - 0.9 * b) * (1 - math.exp(-1.0 * b))
    assert float(weights[0].sum()) == pytest.approx(first + a / (a + b) * both, rel=1e-5)
    assert float(weights[1].sum()) == pytest.approx(b / (a + b) * both + last, rel=1e-5)

    items = [fog((-1, -1, 0), (1, 1, 2), a), fog((-1, -1, 1.1), (1, 1, 3), b)]
    camera = Camera((0.0, 0.0, 9.0), width=16, height=16)
    seen = compose(items, camera, ABOVE)
    # Straight down, but for the half pixel that the middle of an even picture lies off.
    assert seen.opacity[8, 8] == pytest.approx(1 - math.exp(-2 * a - 1.9 * b), rel=2e-3)


@pytest.mark.slow
def test_the_order_of_the_list_is_of_no_account():
    model = learned()
    items = [
        Item(model, Pose((0.0, 0.0, 0.5))),
        fog((-0.6, -0.2, 0.1), (0.1, 0.6, 0.9), 2.0),
        Item(Sphere(0.2), Pose((0.4, -0.3, 0.3)), "#ff8800"),
        Item(HalfSpace()),
    ]
    camera = Camera((1.5, -2.0, 1.6), (0.0, 0.0, 0.4), width=24, height=20)
    lights = [Light(position=(1, -1, 3), colour=(0.5, 0.6, 0.7), reach=2.0)]
    first = compose(items, camera, lights, ambient=0.1)
    back = compose(items[::-1], camera, lights, ambient=0.1)
    for name in ("colour", "opacity", "depth"):
        np.testing.assert_allclose(getattr(first, name), getattr(back, name), atol=2e-5)
    np.testing.assert_array_equal(first.identity, 3 - back.identity)
    assert set(np.unique(first.identity)) == {0, 1, 2, 3}


@pytest.mark.parametrize("near", [False, True])
def test_one_object_alone_is_what_it_looks_like(near):
    model = learned(near=near)
    camera = PosedCamera(
        np.array([[1.0, 0, 0, 0.02], [0, 0, -1, -1.5], [0, 1, 0, 0.03]]), focal=40.0, width=32, height=32
    )
    light = (
        np.array([0.3, -0.8, 0.9]) if near else np.array([0.3, -0.8, 0.9]) / np.linalg.norm([0.3, -0.8, 0.9])
    )
    alone = picture(model, camera, light, model.box, np.ones(model.box.shape, bool), 120.0)
    lamp = Light(position=light) if near else Light(light)
    seen = compose([Item(model, sharpness=120.0)], camera, lamp)
    # Rays through the box start elsewhere, hence are sampled elsewhere.
    assert np.abs(seen.opacity - alone.opacity).mean() < 2e-3
    assert np.abs(seen.colour - alone.colour).mean() < 2e-3
    inside = alone.opacity > 0.97
    np.testing.assert_allclose(seen.depth[inside], alone.depth[inside], atol=3e-3)
    assert alone.colour[inside].std() > 0.01


def test_moving_the_object_is_moving_the_camera():
    model = learned()
    pose = Pose((0.4, -0.2, 0.7), (math.cos(0.4), 0.0, math.sin(0.4), 0.0))
    rotation = np.array([[math.cos(0.8), 0, math.sin(0.8)], [0, 1, 0], [-math.sin(0.8), 0, math.cos(0.8)]])
    place = np.array([[1.0, 0, 0, 0.4], [0, 0, -1, -2.0], [0, 1, 0, 0.7]])
    back = rotation.T @ np.concatenate([place[:, :3], place[:, 3:] - [[0.4], [-0.2], [0.7]]], axis=1)
    options = {"focal": 40.0, "width": 24, "height": 24}
    light = np.array([1.0, -1.0, 0.5])
    moved = compose([Item(model, pose)], PosedCamera(place, **options), Light(light))
    still = compose([Item(model)], PosedCamera(back, **options), Light(rotation.T @ light))
    np.testing.assert_allclose(moved.colour, still.colour, atol=2e-3)
    np.testing.assert_allclose(moved.opacity, still.opacity, atol=2e-3)


def test_the_shadow_of_a_box_ends_where_geometry_says():
    half, height = np.array([0.3, 0.2, 0.1]), 0.6
    light = np.array([0.5, 0.2, 1.0])
    items = [Item(BoxShape(half), Pose((0.0, 0.0, height)), "#808080"), Item(HalfSpace())]
    camera = Camera((-0.3, -0.1, -0.0 + 8.0), (-0.3, -0.1, 0.0), vertical_fov=0.2, width=100, height=100)
    seen = compose(items, camera, Light(light))
    corners = half * (2 * np.array(list(np.ndindex(2, 2, 2))) - 1) + [0, 0, height]
    on_floor = corners - corners[:, 2:] / light[2] * light
    outline = ConvexHull(camera.project(on_floor)[:, :2])
    y, x = np.mgrid[:100, :100] + 0.5
    # Signed distance [pixels] to the outline, from its half-planes: exact but for the corners' outside.
    away = (np.stack([x, y], axis=-1) @ outline.equations[:, :2].T + outline.equations[:, 2]).max(axis=-1)
    floor = seen.identity == 1
    dark = seen.colour[..., 0] < 0.5 * seen.colour.max()
    assert (floor & (away < -1)).sum() > 300
    assert np.all(dark[floor & (away < -1)])
    assert not np.any(dark[floor & (away > 1)])


def test_the_shadow_of_fog_is_what_beer_and_lambert_say():
    items = [fog((-0.5, -0.5, 0.2), (0.5, 0.5, 0.6), 1.7), Item(HalfSpace())]
    light = np.array([0.6, 0.0, 0.8])
    # Seen from the side under the fog.
    camera = Camera((0.0, -3.0, 0.15), (-0.2, 0.0, 0.0), vertical_fov=0.02, width=9, height=9)
    shadowed, bare = (compose(part, camera, Light(light)) for part in (items, items[1:]))
    ratio = (shadowed.colour[4, 4] / bare.colour[4, 4]) ** 2.2
    np.testing.assert_allclose(ratio, math.exp(-1.7 * 0.4 / 0.8), rtol=5e-3)
    # Two lamps of half the power are one.
    halves = compose(items, camera, [Light(light, intensity=0.5)] * 2)
    np.testing.assert_allclose(halves.colour, shadowed.colour, atol=1e-4)


def test_a_lamp_nearby_sends_light_by_the_inverse_square():
    camera = Camera((0.0, 0.0, 5.0), vertical_fov=0.05, width=5, height=5)
    floor = [Item(HalfSpace())]
    powers = [
        compose(floor, camera, Light(position=(0, 0, h), colour=(0.3, 0.2, 0.1), reach=1.0)).colour[2, 2]
        ** 2.2
        for h in (1.0, 2.0)
    ]
    np.testing.assert_allclose(powers[0], (0.3, 0.2, 0.1), rtol=1e-3)
    np.testing.assert_allclose(powers[1], powers[0] / 4, rtol=1e-3)
    # Beside the foot of the lamp: cosine and distance, cos³.
    aside = Camera((1.0, 0.0, 5.0), (1.0, 0.0, 0.0), vertical_fov=0.05, width=5, height=5)
    light = Light(position=(0, 0, 1), reach=1.0, intensity=0.5)
    got = compose(floor, aside, light).colour[2, 2] ** 2.2
    np.testing.assert_allclose(got, 0.5 * 0.5**1.5, rtol=1e-3)


def test_a_look_learned_under_a_lamp_nearby_knows_where_it_is():
    near, far = learned(near=True), learned()
    rng = np.random.default_rng(0)
    points, view, normal = (jnp.asarray(rng.uniform(-0.3, 0.3, (50, 3)), jnp.float32) for _ in range(3))
    lamp = jnp.array([0.4, -0.2, 0.5], jnp.float32)
    towards = lamp[None] - points
    towards = towards / jnp.linalg.norm(towards, axis=1, keepdims=True)
    positions = jnp.broadcast_to(lamp, points.shape)
    expected = far.appearance(points, normal, view, towards)
    np.testing.assert_allclose(near.appearance(points, normal, view, positions), expected, atol=1e-6)
    assert float(jnp.std(expected)) > 0.01
    # In a picture: as a direction learned, from a place; and as a place learned, from a direction.
    camera, place = Camera((0.0, -1.5, 0.3), width=20, height=16), Pose((0.1, 0.0, 0.2))
    lamps = Light(position=(0.4, -0.9, 0.5)), Light((0.5, -0.8, 0.9))
    seen = [[compose([Item(model, place)], camera, lamp).colour for model in (near, far)] for lamp in lamps]
    for a, b in seen:
        np.testing.assert_allclose(a, b, atol=6e-3)
    assert np.abs(seen[0][0] - seen[1][0]).max() > 0.01


def test_each_item_may_have_its_own_lamps():
    items = [
        Item(Sphere(0.3), Pose((-0.5, 0, 0)), "#ffffff"),
        Item(Sphere(0.3), Pose((0.5, 0, 0)), "#ffffff"),
    ]
    camera = Camera((0.0, -4.0, 0.0), vertical_fov=0.5, width=32, height=16)
    light = Light((0, -1, 0), intensity=0.5)
    seen = compose(items, camera, light, item_lights={1: [Light((0, -1, 0), colour=(0.5, 0, 0))]})
    left, right = (seen.colour[seen.identity == i].mean(axis=0) for i in (0, 1))
    np.testing.assert_allclose(left, left[0])
    np.testing.assert_allclose(right[0], left[0], rtol=1e-3)
    assert right[1] < 0.01


def test_pictures_lie_over_any_background():
    medium = GridField(np.full((8, 8, 8), 3.0), (-0.35,) * 3, 0.1)
    seen = compose([Item(medium, density_scale=1.0)], Camera((0, -3, 0), width=12, height=10), ABOVE)
    noise = np.random.default_rng(0).uniform(size=(10, 12, 3))
    for background in (np.ones(3), noise):
        expected = seen.colour + (1 - seen.opacity[..., None]) * background
        np.testing.assert_allclose(seen.over(background), np.clip(expected, 0, 1), atol=1e-6)
    assert 0.1 < seen.opacity.max() < 0.999


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Light(), "either a direction or a position"),
        (lambda: Light((0, 0, 0)), "must not be zero"),
        (lambda: Light((0, 0, 1), intensity=-1), "must be finite and ≥ 0"),
        (lambda: Light((0, 0, 1), reach=2.0), "reach applies to lights with a position"),
        (lambda: compose([Item(Sphere(0.1))], Camera((1, 0, 0)), []), "lights must hold"),
        (lambda: compose([], Camera((1, 0, 0)), ABOVE, item_lights={2: []}), r"got \[2\]"),
        (lambda: compose([], Camera((1, 0, 0)), ABOVE, ambient=2.0), "ambient must lie"),
        (lambda: Item(learned(), level=3.0), "level and density_scale apply to fields"),
        (lambda: Item(Fog.create((0,) * 3, (1,) * 3, 1.0), colour="#ffffff"), "colour applies to solids"),
    ],
)
def test_bad_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
