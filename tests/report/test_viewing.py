"""Pages in the browser: what they show, against closed forms. Whether they open: tests/test_browser.py."""

import json
import re
import socket
import urllib.request
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from vision.models import learned
from vision.photographs import capture, CENTRE, SEMI_AXES

import dano
from dano.report import view, view_capture, view_field, write_capture_view, write_field_view, write_view
from dano.report.viewing._capture import _camera_length
from dano.report.viewing._drawn import (
    add_coloured,
    body_mesh,
    BodyMesh,
    Drawn,
    shape_mesh,
    ShownExtras,
    surface_mesh,
)
from dano.report.viewing._field import FieldSurface
from dano.report.viewing._serving import open_on, serve
from dano.scene_file import asset_look, load_asset
from dano.vision import Camera, Capture, LearnedField, visual_hull


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def fall() -> tuple[dano.Scene, dano.Trajectory]:
    """A ball that falls freely."""
    bodies = [
        dano.Body("ball", dano.Sphere(0.05), mass=0.3),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    scene = dano.Scene.create(bodies, [dano.Contact("ball", "floor")], timestep=2e-3)
    start = scene.initial_state(ball=dict(position=(0, 0, 0.5), omega=(3.0, 0, 1)))
    return scene, dano.simulate(scene, start, 50)


def volume(mesh) -> float:
    return float(np.sum(np.linalg.det(mesh.vertices[mesh.faces].astype(np.float64))) / 6)


def test_viewer_serves_a_page_and_stops(fall):
    pytest.importorskip("viser")
    viewer = view(*fall, port=free_port(), block=False)
    try:
        with urllib.request.urlopen(viewer.url, timeout=10) as answer:
            assert answer.status == 200
    finally:
        viewer.stop()
    viewer.stop()
    with pytest.raises(OSError):
        urllib.request.urlopen(viewer.url, timeout=2)
    with pytest.raises(ValueError, match="port must lie"):
        view(*fall, port=0)
    with pytest.raises(ValueError, match="host must be"):
        view(*fall, host="")


def test_numbers_beside_the_viewer_are_those_of_a_fall(fall):
    """Energy of a ball that falls freely is kept, and a force carries it when it lies."""
    pytest.importorskip("viser")
    scene, falls = fall
    lies = dano.simulate(scene, scene.initial_state(ball=dict(position=(0, 0, 0.05))), 400)
    shown = []

    def fill(server):
        shown.append(Drawn(server, scene, falls, {}, falls))

    viewer = serve(fill, port=free_port(), host="127.0.0.1", block=False)
    (drawn,) = shown
    try:
        numbers = drawn.numbers
        # Of m g h = 0.3 · 9.81 · 0.048 m that it falls; what it keeps is known to the order of the step.
        assert np.ptp(numbers.energy) < 0.03 * 0.3 * 9.81 * 0.048
        assert numbers.force is not None
        assert np.abs(numbers.force).max() < 1e-9
        drawn.replace(scene, lies)
        carried = drawn.numbers.force
        assert carried is not None
        assert carried[-1] == pytest.approx(0.3 * 9.81, rel=1e-3)
        drawn.show_extras(ShownExtras(trails=True, centres=True))
        drawn.show_extras(ShownExtras())
    finally:
        viewer.stop()
    soap = asset_look("trained_soap")
    assert soap is not None
    with pytest.raises(ValueError, match="body must be one of"):
        view(scene, falls, looks={"bal": soap})


def test_meshes_of_objects_have_the_colours_that_were_learned(trained):
    pytest.importorskip("igl")
    body, look = trained
    mesh = body_mesh(body, look)
    assert mesh is not None and mesh.colours is not None
    distance = np.asarray(body.object.solid.sdf_jet(jnp.asarray(mesh.vertices.T), 0))
    assert np.abs(distance).max() < 0.01 * body.size
    assert mesh.colours.shape == mesh.vertices.shape
    # The shipped soap is blue where it was photographed.
    middle = np.median(mesh.colours, axis=0)
    assert middle[2] > middle[0]
    plain = body_mesh(body, None)
    assert plain is not None and plain.colours is None


@pytest.fixture(scope="module")
def trained():
    return dano.Body("soap", load_asset("trained_soap")), asset_look("trained_soap")


def test_meshes_of_shapes_lie_on_their_surface():
    for shape in (dano.Box((0.3, 0.2, 0.1)), dano.Capsule(0.1, 0.3), dano.Sphere(0.2)):
        vertices, faces = surface_mesh(shape)
        distance = np.asarray(shape.sdf_jet(jnp.asarray(vertices.T, dtype=jnp.float64), 0))
        assert np.abs(distance).max() < 1e-5
        # Closed and outward: the volume is that of the solid, less what flat triangles cut off.
        volume = np.sum(np.linalg.det(vertices[faces].astype(np.float64))) / 6
        assert volume == pytest.approx(float(shape.solid_moments().volume), rel=0.03)


def test_the_surface_of_a_density_lies_where_it_has_the_level():
    """A density that falls linearly with the radius: every level is a sphere of a known radius."""
    pytest.importorskip("igl")
    x = np.stack(np.meshgrid(*(np.arange(41) - 20.0,) * 3, indexing="ij"), axis=-1)
    values = np.clip(18 - np.linalg.norm(x, axis=-1), 0, None)
    surface = FieldSurface(dano.GridField(values, (-0.2, -0.2, -0.2), 0.01, "linear"), 6.0)
    assert surface.level == 6.0 and surface.levels is not None
    assert surface.levels[0] < 6.0 < surface.levels[1] < 18
    for level in (3.0, 6.0, 12.0):
        mesh = surface.mesh(level)
        assert mesh is not None and mesh.colours is None
        assert volume(mesh) == pytest.approx(4 / 3 * np.pi * (0.01 * (18 - level)) ** 3, rel=0.02)
    assert surface.mesh(18.5) is None


def test_a_density_that_reaches_its_bounds_is_closed_there():
    pytest.importorskip("igl")
    mesh = FieldSurface(dano.GridField(np.ones((9, 9, 9)), (0.0, 0.0, 0.0), 0.1, "linear"), None).mesh(0.5)
    assert mesh is not None
    # Half a cell outside the last node lies the level, between one and nothing.
    assert volume(mesh) == pytest.approx(0.9**3, rel=0.05)


def test_a_fine_grid_is_drawn_coarser():
    pytest.importorskip("igl")
    x = (np.arange(200) - 99.5) / 100
    values = np.clip(20 * (0.8 - np.sqrt(x[:, None, None] ** 2 + x[:, None] ** 2 + x**2)), 0, 1)
    mesh = FieldSurface(dano.GridField(values, (-0.995, -0.995, -0.995), 0.01, "linear"), 0.5).mesh(0.5)
    assert mesh is not None
    # On all 200 nodes there would be 340,000.
    assert len(mesh.faces) < 150_000
    # The density is a half 1/40 inside of the radius 0.8.
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi * 0.775**3, rel=0.01)


def test_a_learned_field_has_its_colours_at_every_level():
    pytest.importorskip("igl")
    field = LearnedField.from_model(learned(), 120.0)
    surface = FieldSurface(field, None)
    assert surface.level == 0.5
    solid = field.solid.sdf_jet
    for level in (0.2, 0.5, 0.8):
        mesh = surface.mesh(level)
        assert mesh is not None and mesh.colours is not None
        assert mesh.colours.shape == mesh.vertices.shape
        distance = np.asarray(solid(jnp.asarray(mesh.vertices.T, jnp.float32), 0))
        # φ = 1/(1 + exp(s d)), to the curvature of a cell of 2.5 cm.
        expected = np.log(1 / level - 1) / float(field.sharpness)
        assert np.median(distance) == pytest.approx(expected, abs=1e-3)


def test_solids_are_shown_as_they_are():
    pytest.importorskip("igl")
    thin = shape_mesh(dano.Box((0.5, 0.3, 0.0005)))
    assert volume(thin) == pytest.approx(1.0 * 0.6 * 0.001, rel=0.03)
    both = shape_mesh(dano.union(dano.Sphere(0.2), dano.posed(dano.Sphere(0.2), dano.Pose((1.0, 0, 0)))))
    assert volume(both) == pytest.approx(2 * 4 / 3 * np.pi * 0.2**3, rel=0.02)


def test_what_silhouettes_leave_holds_the_object():
    """The hull of an ellipsoid seen from all sides is nearly the ellipsoid."""
    box, hull = visual_hull(capture(), 48)
    inside = (hull < 0).mean() * np.prod(box.upper - box.origin)
    assert inside == pytest.approx(4 / 3 * np.pi * np.prod(SEMI_AXES), rel=0.1)
    nodes = box.nodes[hull.ravel() < 0]
    np.testing.assert_allclose(nodes.mean(axis=0), CENTRE, atol=2e-3)


def test_cameras_are_small_enough_to_be_told_apart():
    photos = capture(n_train=40, pixels=8)
    places = np.array([view.camera.position for view in photos.views])
    length = _camera_length(photos.views, places)
    apart = np.linalg.norm(places[:, None] - places[None], axis=2) + np.eye(len(places))
    width = length / 2.2
    assert width < np.median(apart.min(axis=1))
    # Of one photograph, or several from one place, too.
    assert _camera_length(photos.views[:1], places[:1]) > 0


def test_pages_of_fields_and_captures_are_written(tmp_path):
    pytest.importorskip("viser")
    pytest.importorskip("igl")
    write_field_view(dano.Sphere(0.1), tmp_path / "ball.html")
    # Without masks there is no hull, and photographs from one place are shown, too.
    photos = capture(n_train=2, n_test=0, pixels=8)
    bare = Capture([view.replaced(mask=None, cut_out=False) for view in photos.views])
    write_capture_view(bare, tmp_path / "capture.html", unit="feet")
    for name in ("ball.html", "capture.html"):
        text = (tmp_path / name).read_text(encoding="utf-8")
        assert text.lower().startswith("<!doctype html>")
    ball = dano.Sphere(0.1)
    for show in (
        lambda **options: view_field(ball, **options),
        lambda **options: view_capture(bare, **options),
    ):
        viewer = show(port=free_port(), block=False)
        try:
            with urllib.request.urlopen(viewer.url, timeout=10) as answer:
                assert answer.status == 200
        finally:
            viewer.stop()


def test_what_cannot_be_shown_is_refused(tmp_path):
    path = tmp_path / "page.html"
    flat = dano.GridField(np.full((5, 5, 5), 2.0), (0, 0, 0), 0.1, "linear")
    for field, options, message in (
        (dano.HalfSpace(), {}, "field must have finite bounds"),
        (dano.Sphere(0.1), {"level": 0.5}, "level applies to densities"),
        (flat, {"level": 3.0}, "level must be below the largest density 2, got 3"),
        (flat, {"level": -1.0}, "level must be finite and > 0"),
    ):
        with pytest.raises(ValueError, match=message):
            write_field_view(field, path, **options)
    assert not list(tmp_path.iterdir())


def test_a_written_page_says_what_a_run_is(fall, tmp_path):
    scene, run = fall
    write_view(scene, run, tmp_path / "run.html", title="a <fall> </script>")
    page = (tmp_path / "run.html").read_text(encoding="utf-8")
    assert "<title>a &lt;fall&gt; &lt;/script&gt;</title>" in page
    (text,) = re.findall(r"const run = (\{.*\});", page)
    said = json.loads(text)
    assert said["title"] == "a <fall> </script>"
    energy, force = said["graphs"]
    # A free fall keeps its energy, to a share of what moves between its kinds, and touches nothing.
    assert 0 <= min(energy["values"]) and max(energy["values"]) < 0.05 * 0.3 * 9.81 * 0.05
    assert not any(force["values"]) and len(force["values"]) == len(said["times"])
    bodies, parameters = said["tables"]
    assert [row[:2] for row in bodies] == [["ball", "0.3 kg"], ["floor", "fixed"]]
    assert ["friction, ball – floor", "0.2", None] in parameters
    assert said["frame"] == pytest.approx(0.1 / 3, rel=0.01)
    assert set(said["cameras"]) == {"front", "side", "top"}
    # The camera of an upright window is chosen before anything else on the page runs.
    assert page.index("window.stepBack =") < page.index("</head>") < page.index("window.stepBack *")


@pytest.mark.parametrize(("width", "filled"), [(46, 0.85), (95, 0.45), (150, 0.85)])
@pytest.mark.parametrize("level", [False, True])
def test_windows_of_any_shape_open_on_all(width, filled, level):
    server = SimpleNamespace(initial_camera=SimpleNamespace(), on_client_connect=lambda _: None)
    places = np.random.default_rng(0).normal(size=(40, 3)) * (1.0, 1.0, 0.2)
    opening = open_on(server, places, np.zeros(40), 0.05, level=level)
    start = server.initial_camera
    window = SimpleNamespace(
        aspect=width / 100, image_width=1000, fov=start.fov, position=start.position, look_at=start.look_at
    )
    opening.choose(SimpleNamespace(camera=window))
    camera = Camera(window.position, window.look_at, vertical_fov=start.fov, width=width, height=100)
    seen = camera.project(places)[:, :2]
    assert seen.min() > 0 and (seen.max(axis=0) < (width, 100)).all()
    # Near: what is seen fills so much of the window in one direction.
    assert (np.ptp(seen, axis=0) / (width, 100)).max() > filled


def test_a_phone_shows_the_picture_above_the_controls():
    server = SimpleNamespace(initial_camera=SimpleNamespace(), on_client_connect=lambda _: None)
    places = np.random.default_rng(0).normal(size=(40, 3)) * (1.0, 1.0, 0.2)
    opening = open_on(server, places, np.zeros(40), 0.05)
    start = server.initial_camera
    window = SimpleNamespace(
        aspect=0.46, image_width=390, fov=start.fov, position=start.position, look_at=start.look_at
    )
    opening.choose(SimpleNamespace(camera=window))
    camera = Camera(window.position, window.look_at, vertical_fov=start.fov, width=46, height=100)
    seen = camera.project(places)[:, 1]
    assert seen.min() > 0 and seen.max() < 40


def test_arrows_of_forces_are_one_node_that_changes(fall):
    """A node that is added in each frame is not there yet when a slow browser draws the frame."""
    pytest.importorskip("viser")
    scene, _ = fall
    run = dano.simulate(scene, scene.initial_state(ball=dict(position=(0, 0, 0.06))), 40)
    shown = []

    def fill(server):
        drawn = Drawn(server, scene, run, {}, None)
        for time in (0.0, float(run.times[-1]), 0.0, float(run.times[-2])):
            drawn.show(time, ShownExtras())
            arrows = drawn._forces
            shown.append((arrows, arrows is not None and arrows.visible, arrows and arrows.points))
        return None

    serve(fill, port=free_port(), host="127.0.0.1", block=False).stop()
    assert [visible for _, visible, _ in shown] == [False, True, False, True]
    assert shown[1][0] is shown[3][0]
    # It comes out of the ball, which hides what is inside.
    assert shown[3][2][0, 1, 2] > 2 * 0.05


def test_learned_colours_are_linear_in_meshes():
    served = []

    class Scene:
        def add_mesh_trimesh(self, name, solid):
            served.append(solid)

    mesh = BodyMesh(np.eye(3), np.array([[0, 1, 2]]), np.array([[255, 186, 0]] * 3, np.uint8))
    add_coloured(Scene(), "a", mesh)
    # Half of the light is 186 of 255 in a picture.
    np.testing.assert_allclose(served[0].visual.vertex_colors[0, :3], (255, 127.5, 0), atol=1)
