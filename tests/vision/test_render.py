import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vision.models import Fog, learned

from dano import Box, GridField, HalfSpace, Pose, Sphere
from dano.fields import AbstractShape
from dano.vision import Camera, Item, level_surface, PosedCamera, render
from dano.vision.drawing._rays import CHUNK, TracedItem, Tracer, transmitted
from dano.vision.radiance._picture import picture

EYE = np.eye(3, dtype=np.float32)
ZERO = np.zeros(3, dtype=np.float32)


@pytest.fixture(scope="module")
def ball() -> Item:
    return Item(Sphere(0.4), Pose(), "#ff0000")


def test_silhouette_of_a_sphere_has_the_projected_area(ball):
    camera = Camera((0.0, -2.0, 0.0), vertical_fov=0.6, width=120, height=100)
    # A ball of radius r at distance d fills a cone of half angle asin(r/d).
    radius = math.tan(math.asin(0.4 / 2.0)) / camera.pixel_angle
    empty = render([], camera, floor=False)
    crisp = (render([ball], camera, floor=False, antialias=False) != empty).any(axis=2)
    assert crisp.sum() == pytest.approx(math.pi * radius**2, rel=0.008)
    # Smoothing changes pixels on the edge only.
    smooth = (render([ball], camera, floor=False) != empty).any(axis=2)
    assert 0 < (smooth & ~crisp).sum() < 4 * math.pi * radius


def test_rays_meet_a_box_where_the_slabs_do():
    rng = np.random.default_rng(0)
    angle, half = 0.7, np.array([0.5, 0.3, 0.2])
    item = Item(Box(half), Pose((0.1, 0.2, 0.3), (math.cos(angle / 2), 0, 0, math.sin(angle / 2))))
    rotation = np.array(
        [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]]
    )
    origin = np.array([-1.5, -2.0, 1.2])
    towards = np.array([0.1, 0.2, 0.3]) + rng.uniform(-0.8, 0.8, (3000, 3)) - origin
    d = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    o, local = (origin - [0.1, 0.2, 0.3]) @ rotation, d @ rotation
    near, far = np.sort(np.stack([(-half - o) / local, (half - o) / local]), axis=0)
    enter, leave = near.max(axis=1), far.min(axis=1)
    assert item.shape is not None
    thing = TracedItem(item.shape, rotation, np.array([0.1, 0.2, 0.3]), *item.placed_ball, False)
    numbers = {
        "light": (0.0, 0.0, 1.0),
        "focus": ZERO,
        "spread": 0.1,
        "pixel": 1e-4,
        "far": 1.0,
        "floor_reach": 1.0,
    }
    met = Tracer([thing], [], origin, **numbers)(d.T.astype(np.float32))
    hit = np.flatnonzero(met.which == 0)
    t = met.depth[hit]
    assert np.all(np.isinf(met.depth[met.which < 0]))
    assert set(hit) == set(np.flatnonzero(enter < leave - 2e-3)) | (
        set(hit) & set(np.flatnonzero(enter < leave + 1e-3))
    )
    np.testing.assert_allclose(t, enter[hit], atol=1e-3)


def test_a_slab_lets_through_what_beer_and_lambert_say():
    # 4 nodes of 2.0 at a distance of 0.1 m: ∫φ dz = 0.8 in the middle, whatever the spline does at the faces.
    field = GridField(np.full((9, 9, 4), 2.0, dtype=np.float32), (-0.4, -0.4, -0.15), np.float32(0.1))
    start = np.zeros((3, CHUNK), dtype=np.float32)
    start[2] = -1.0
    up = np.zeros_like(start)
    up[2] = 1.0
    far = np.full(CHUNK, np.inf, dtype=np.float32)
    item = Item(field, density_scale=1.5)
    opacity, depth, normal = transmitted(
        item.medium, *(jnp.asarray(x) for x in (np.float32(1.5), EYE, ZERO, start, up, far))
    )
    assert float(opacity[0]) == pytest.approx(1 - math.exp(-1.5 * 0.8), rel=1e-3)
    assert 0.7 < float(depth[0]) < 1.0
    np.testing.assert_allclose(np.asarray(normal[:, 0]), (0, 0, -1), atol=1e-3)
    picture = render([item], Camera((0, 0, 3), width=32, height=32), floor=False)
    assert picture[16, 16].astype(int).sum() < picture[0, 0].astype(int).sum() - 60


def test_the_shadow_lies_opposite_to_the_lamp():
    light = np.array([1.0, 0.3, 1.5])
    item = Item(Sphere(0.2), Pose((0.0, 0.0, 0.5)))
    camera = Camera((0.0, -2.5, 4.0), (0.0, 0.0, 0.0), width=160, height=120)
    bare, shadowed = (render(items, camera, light=light).astype(int).sum(axis=2) for items in ([], [item]))
    spot = np.array([[-0.5 / 1.5 * 1.0, -0.5 / 1.5 * 0.3, 0.0], [0.5 / 1.5 * 1.0, 0.5 / 1.5 * 0.3, 0.0]])
    (x, y), (x_other, y_other) = camera.project(spot)[:, :2].astype(int)
    assert shadowed[y, x] < 0.8 * bare[y, x]
    assert shadowed[y_other, x_other] == pytest.approx(bare[y_other, x_other], abs=12)


def test_rays_of_a_pixel_get_the_light_that_each_would_get_alone():
    shapes = [(Sphere(0.2), (0.0, 0.0, 0.35)), (Box((0.1, 0.1, 0.1)), (0.3, 0.1, 0.1))]
    items = [(shape, Item(shape, Pose(place))) for shape, place in shapes]
    things = [
        TracedItem(shape, np.eye(3), np.asarray(item.pose.position), *item.placed_ball, False)
        for shape, item in items
    ]
    camera = Camera((0.6, -1.5, 1.2), (0.1, 0.0, 0.15), width=160, height=120)
    light = np.array([0.6, -0.3, 1.0])
    tracer = Tracer(
        things,
        [np.array([0.0, 0.0, 1.0, 0.0])],
        camera.position,
        light=light / np.linalg.norm(light),
        focus=ZERO,
        spread=0.08,
        pixel=camera.pixel_angle,
        far=5.0,
        floor_reach=0.1,
        shaded=True,
    )
    y, x = np.mgrid[:120, :160]
    corners = np.array([[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.25, 0.75]])
    points = (np.stack([x.ravel(), y.ravel()], axis=1)[:, None] + corners).reshape(-1, 2)
    d = camera.directions(points).T.astype(np.float32)
    alone, shared = tracer(d), tracer(d, together=4)
    np.testing.assert_array_equal(shared.which, alone.which)
    for each, other in ((shared.lamp, alone.lamp), (shared.ambient, alone.ambient)):
        assert other.min() < 0.4 < 0.99 < other.max()
        # The mean of a pixel's four rays is what is shown.
        off = np.abs((each - other).reshape(-1, 4).mean(axis=1))
        lit = other.reshape(-1, 4).min(axis=1) < 1
        # A few pixels hold an edge between light and shade of the solid's own.
        assert np.quantile(off[lit], 0.98) < 0.02
        assert off.max() < 0.1


def test_level_surface_of_a_smooth_density_is_where_the_density_says():
    line = np.linspace(-1, 1, 41)
    x, y, z = np.meshgrid(line, line, line, indexing="ij")
    values = 100 * np.exp(-6 * (x**2 + y**2 + z**2))
    radius = math.sqrt(math.log(100 / 20.0) / 6)
    surface = level_surface(GridField(values, (-1, -1, -1), 0.05), 20.0)
    rng = np.random.default_rng(1)
    points = rng.normal(size=(3, 200))
    points *= radius / np.linalg.norm(points, axis=0)
    points = jnp.asarray(np.concatenate([points, np.zeros((3, 1))], axis=1), jnp.float32)
    distance = np.asarray(jax.jit(lambda x: surface.sdf_jet(x, 0))(points))
    assert np.abs(distance[:-1]).max() < 0.2 * 0.05
    assert distance[-1] < -0.8 * radius


def test_haze_below_the_level_is_not_drawn(ball):
    values = np.full((12, 12, 12), 0.5)
    values[4:8, 4:8, 4:8] = 50.0
    item = Item(GridField(values, (-0.55, -0.55, -0.55), 0.1), level=5.0)
    # Up to a corner of the block, √3 · 0.2 m away, and one cell of smoothing.
    assert item.radius < 0.6
    with pytest.raises(ValueError, match="level must be at most"):
        Item(GridField(values, (0, 0, 0), 0.1), level=1e3)


def test_planes_are_known_wherever_they_are_put():
    half = math.sqrt(0.5)
    plane = Item(HalfSpace((0, 0, 1), 0.2), Pose((1.0, 2.0, 3.0), (half, half, 0, 0))).plane
    # Turned by 90° about x: z becomes −y; the plane passes 0.2 above the new origin along it.
    assert plane is not None
    np.testing.assert_allclose(plane, (0, -1, 0, 0.2 - 2.0), atol=1e-7)


def test_a_learned_look_is_drawn_as_it_was_learned():
    model = learned(lit=False)
    camera = PosedCamera(
        np.array([[1.0, 0, 0, 0.02], [0, 0, -1, -1.5], [0, 1, 0, 0.03]]), focal=80.0, width=64, height=64
    )
    seen = picture(model, camera, None, model.box, np.ones(model.box.shape, bool), 400.0)
    drawn = render([Item(model)], camera, floor=False, antialias=False) / 255
    inside = seen.opacity > 0.97
    assert inside.sum() > 500
    difference = np.abs(drawn - seen.colour / np.maximum(seen.opacity, 0.1)[..., None])[inside]
    assert np.median(difference) < 0.004
    assert np.quantile(difference, 0.99) < 0.03
    # In one colour, if that is asked for.
    painted = render([Item(model, colour="#ff0000")], camera, floor=False)[inside]
    assert np.all(painted[:, 0].astype(int) > painted[:, 1] + 40)


def test_a_learned_look_follows_the_lamp_and_others_shadows():
    item, camera = Item(learned()), Camera((0.0, -2.0, 0.4), width=48, height=32)
    screen = Item(Box((0.5, 0.02, 0.5)), Pose((0.0, -0.9, 1.2)), "#222222")
    left, right = (render([item], camera, light=(x, -1, 1), floor=False).astype(int) for x in (-2, 2))
    assert np.abs(left - right)[16, 24].max() > 2
    bare, shaded = (
        render(items, camera, light=(0, -1, 1.2), floor=False).astype(int)[14:18, 22:26].sum()
        for items in ([item], [item, screen])
    )
    assert shaded < 0.85 * bare


def test_learned_media_dim_what_is_behind_them_and_shadow_the_floor():
    cloud = Item(Fog.create((-0.5, -0.5, 0.2), (0.5, 0.5, 0.6), 2.0))
    camera = Camera((0.0, 0.0, 40.0), vertical_fov=0.06, width=40, height=40)
    light = (1.0, 0.0, 1.0)
    bare, clouded = (render(items, camera, light=light) / 255 for items in ([], [cloud]))
    # Where the cloud's shadow falls beside it: lamp light dimmed, light of the sky as before.
    x, y = camera.project(np.array([[-0.6, 0.0, 0.0]]))[0, :2].astype(int)
    dimmed = (clouded[y, x] / bare[y, x]) ** 2.2
    # At 45° through 0.4 m.
    share = math.exp(-2.0 * 0.4 * math.sqrt(2))
    lamp = 0.78 * math.sqrt(0.5)
    np.testing.assert_allclose(dimmed[0], (lamp * share + 0.42 * 0.93) / (lamp + 0.42 * 0.93), rtol=0.03)
    # The medium is brighter than black: it lies over what is behind it.
    assert clouded[20, 20].max() < bare[20, 20].max()
    assert np.abs(clouded[2, 2] - bare[2, 2]).max() < 0.02


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Item(Sphere(0.1), colour="red"), "colour must be"),
        (lambda: Item(Sphere(0.1), colour=(2, 0, 0)), "colour must have"),
        (lambda: Item(Sphere(0.1), level=1.0, density_scale=1.0), "excludes"),
        (lambda: Item(Sphere(0.1), level=-1.0), "level must be finite and > 0"),
        (lambda: Item(HalfSpace(), density_scale=1.0), "finite bounds"),
        (lambda: render([], Camera((1, 0, 0)), light=(0, 0, 0)), "light must be"),
    ],
)
def test_bad_pictures_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


class Egg(AbstractShape):
    """A shape that kernels do not know."""

    edge: None = None  # pyright: ignore[reportIncompatibleVariableOverride]

    def sdf(self, x):
        stretched = x * jnp.array([1.0, 1.0, 0.7], x.dtype)
        return jnp.linalg.norm(stretched) - 0.4

    @property
    def bounds(self):
        reach = jnp.array([0.4, 0.4, 0.4 / 0.7])
        return jnp.stack([-reach, reach])

    def solid_moments(self):
        return None


def test_shapes_of_users_are_drawn():
    camera = Camera((0.0, -30.0, 0.0), vertical_fov=0.06, width=120, height=100)
    empty = render([], camera, floor=False)
    seen = (render([Item(Egg())], camera, floor=False, antialias=False) != empty).any(axis=2)
    # From afar an ellipse.
    area = math.pi * 0.4 * 0.4 / 0.7 / (30 * camera.pixel_angle) ** 2
    assert seen.sum() == pytest.approx(area, rel=0.02)


def test_threads_get_the_blocks_that_kernels_trace():
    from dano.native._instances import instance
    from dano.vision.drawing import _rays

    assert _rays._BLOCK == instance(_rays._FEATURES, _rays._TRACING).BLOCK


def test_a_medium_is_a_field_with_bounds():
    field = Fog.create((-0.5, -0.4, -0.3), (0.5, 0.4, 0.3), 7.0).field()
    assert float(field.density(jnp.array([0.1, -0.2, 0.05]))) == 7
    assert float(field.density(jnp.array([0.1, -0.45, 0.0]))) == 0
    np.testing.assert_allclose(field.bounds, [(-0.5, -0.4, -0.3), (0.5, 0.4, 0.3)], rtol=1e-6)
