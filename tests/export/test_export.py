"""What other programs read of an exported object is what dano knows of it."""

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from export.conftest import check_mass, QUICK, tensor

import dano
from dano.contact import ContactParams
from dano.exchange import _export, export_object
from dano.exchange._triangles import chosen_collision, painted, solid_triangles
from dano.exchange._urdf import roll_pitch_yaw
from dano.maths import quat_to_matrix


@pytest.fixture(scope="module")
def folder(thing, tmp_path_factory):
    """The object in the formats that need no optional package."""
    place = tmp_path_factory.mktemp("exports") / "angle"
    contact = ContactParams(sliding_friction=0.35, restitution=0.25, stiffness=1e6)
    export_object(thing, place, to=["mjcf", "urdf", "obj"], contact=contact, **QUICK)
    return place


def mujoco_mass(model):
    matrix = quat_to_matrix(np.asarray(model.body_iquat[1]))
    return model.body_mass[1], model.body_ipos[1], tensor(model.body_inertia[1], matrix)


def test_inertia_has_products_in_the_frame_of_the_files(thing):
    inertia = np.asarray(thing.mass.inertia)
    assert abs(inertia[0, 2]) > 0.05 * inertia[0, 0]


def test_mjcf_compiles_to_our_mass_and_friction(thing, folder):
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_path(str(folder / "angle.xml"))
    check_mass(thing, *mujoco_mass(model))
    touching = model.geom_contype > 0
    assert touching.sum() == 1
    np.testing.assert_allclose(model.geom_friction[touching][0], (0.35, 0, 0))
    np.testing.assert_array_equal(model.geom_condim[touching], 3)
    # What is seen lies where our surface does, whatever frame MuJoCo keeps meshes in.
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    seen = int(np.flatnonzero(~touching)[0])
    mesh = model.geom_dataid[seen]
    rows = slice(model.mesh_vertadr[mesh], model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh])
    points = model.mesh_vert[rows] @ data.geom_xmat[seen].reshape(3, 3).T + data.geom_xpos[seen]
    np.testing.assert_allclose(points.min(axis=0), (0.05, 0, 0.01), atol=1e-3)
    np.testing.assert_allclose(points.max(axis=0), (0.15, 0.04, 0.1), atol=1e-3)


def test_scene_drops_the_object_onto_its_floor(folder):
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    data = mujoco.MjData(model)
    floor = model.geom("floor").pos[2]
    start = data.qpos[2]
    mujoco.mj_step(model, data, 1000)
    # Its lowest place was at z = 0.01 m.
    assert start + 0.01 - floor == pytest.approx(0.02, abs=2e-3)
    assert data.qpos[2] + 0.01 == pytest.approx(floor, abs=2e-3)


def test_more_friction_directions_where_the_contact_has_them(thing, tmp_path):
    mujoco = pytest.importorskip("mujoco")
    contact = ContactParams(torsional_friction=0.01, rolling_friction=0.002)
    export_object(thing, tmp_path / "rolls", contact=contact, name="box", **QUICK)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "rolls" / "box.xml"))
    assert 6 in model.geom_condim
    np.testing.assert_allclose(model.geom_friction[-1], (0.2, 0.01, 0.002))


def test_objects_may_be_attached_to_a_model_twice(folder):
    mujoco = pytest.importorskip("mujoco")
    world = mujoco.MjSpec()
    for i in range(2):
        frame = world.worldbody.add_frame(pos=[0, 0, 0.3 * (i + 1)])
        child = mujoco.MjSpec.from_file(str(folder / "angle.xml"))
        world.attach(child, frame=frame, prefix=f"n{i}_")
    assert world.compile().nbody == 3


def test_mujoco_reads_the_urdf(thing, folder):
    mujoco = pytest.importorskip("mujoco")
    check_mass(thing, *mujoco_mass(mujoco.MjModel.from_xml_path(str(folder / "angle.urdf"))))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_pybullet_reads_the_urdf(thing, folder):
    bullet = pytest.importorskip("pybullet", reason="there is no wheel of PyBullet for this Python")
    client = bullet.connect(bullet.DIRECT)
    try:
        body = bullet.loadURDF(str(folder / "angle.urdf"), flags=bullet.URDF_USE_INERTIA_FROM_FILE)
        mass, friction, moments, com, orientation = bullet.getDynamicsInfo(body, -1)[:5]
        rays = [bullet.rayTest((0.07, 0.02, z), (0.07, 0.02, -z))[0] for z in (-1, 1)]
    finally:
        bullet.disconnect(client)
    check_mass(thing, mass, com, tensor(moments, bullet.getMatrixFromQuaternion(orientation)))
    assert friction == pytest.approx(0.35)
    # The post of the L, from below and from above, with PyBullet's margin of 1 mm.
    np.testing.assert_allclose([ray[3][2] for ray in rays], (0.009, 0.101), atol=2e-4)


def test_folder_says_what_is_in_it_and_what_is_lost(folder):
    manifest = json.loads((folder / "export.json").read_text())
    held = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    assert manifest["files"] == held
    assert manifest["contact"] == {"sliding_friction": 0.35, "restitution": 0.25, "stiffness": 1e6}
    text = (folder / "README.md").read_text()
    assert "No format has a place for stiffness." in text
    assert "no coefficient of restitution" in text
    assert "convex hull of the object: what is concave is filled" in text


def test_convex_pieces_where_asked_for(thing, tmp_path):
    pytest.importorskip("coacd")
    options = {"collision": "coacd", "concavity": 0.2, "max_pieces": 2, "resolution": 20}
    written = export_object(thing, tmp_path / "angle", **options)
    assert written.pieces == 2 and written.collision == "coacd"
    assert "meshes/collision_001.obj" in written.files


def test_object_of_samples_becomes_its_hull(tmp_path):
    points = np.random.default_rng(0).normal(size=(200, 3))
    points /= 10 * np.linalg.norm(points, axis=1, keepdims=True)
    made = dano.NeuralObject.from_samples(
        points=points, density=np.ones(200), mass=1.0, com=np.zeros(3), inertia=4e-3 * np.eye(3)
    )
    written = export_object(made, tmp_path / "ball", to="obj")
    assert (written.collision, written.pieces) == ("hull", 1)


def look_of_positions() -> Any:
    """A look whose colours are the coordinates, under no known light."""

    class Coordinates:
        lit, near_light = False, False

        def __call__(self, points, normals, view, light, view_share):
            return 5 * points

    return SimpleNamespace(model=SimpleNamespace(appearance=Coordinates()))


@pytest.mark.parametrize("side", [64, 700])
def test_texture_has_each_place_in_its_colour(thing, side):
    mesh, normals = solid_triangles(thing.solid, 20)
    texture = painted(look_of_positions(), mesh, normals, side)
    size = len(texture.image)
    random = np.random.default_rng(0)
    weights = random.dirichlet(np.ones(3), len(mesh.faces))
    u, v = np.einsum("fk,fkd->df", weights, texture.corners)
    places = np.einsum("fk,fkd->fd", weights, mesh.corners)
    # Bilinear interpolation between the centres of texels, as renderers do it.
    x, y = size * u - 0.5, size * (1 - v) - 0.5
    i, j = np.floor(y).astype(int), np.floor(x).astype(int)
    a, b = (y - i)[:, None], (x - j)[:, None]
    image = texture.image / 255
    below, right = np.minimum(i + 1, size - 1), np.minimum(j + 1, size - 1)
    found = (1 - a) * ((1 - b) * image[i, j] + b * image[i, right])
    found += a * ((1 - b) * image[below, j] + b * image[below, right])
    np.testing.assert_allclose(found, 5 * places, atol=0.5 / 255 + 1e-6)


def test_colours_go_into_every_format(thing, tmp_path):
    pytest.importorskip("PIL")
    mujoco = pytest.importorskip("mujoco")
    look = look_of_positions()
    written = export_object(thing, tmp_path / "red", to=["mjcf", "obj"], look=look, texture_size=64, **QUICK)
    assert written.textured and "meshes/visual.png" in written.files
    assert "map_Kd visual.png" in (tmp_path / "red" / "meshes" / "visual.mtl").read_text()
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "red" / "red.xml"))
    assert model.ntex == 1 and model.mesh_texcoordadr[0] >= 0


@pytest.mark.parametrize("seed", range(5))
def test_angles_give_the_rotation_back(seed):
    q = np.random.default_rng(seed).normal(size=4)
    rotation = quat_to_matrix(q / np.linalg.norm(q))
    if seed == 0:  # upright
        rotation = np.array([[0.0, 0.6, 0.8], [0.0, 0.8, -0.6], [-1.0, 0.0, 0.0]])
    r, p, y = roll_pitch_yaw(rotation)

    def about(axis: int, angle: float) -> np.ndarray:
        half = 0.5 * angle
        return quat_to_matrix(np.array([np.cos(half), *(np.sin(half) * np.eye(3)[axis])]))

    np.testing.assert_allclose(about(2, y) @ about(1, p) @ about(0, r), rotation, atol=1e-14)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"to": "stl"}, "to must be one of .*got 'stl'"),
        ({"to": ["mjcf", "udrf"]}, "got 'udrf'; did you mean 'urdf'"),
        ({"to": []}, "at least one"),
        ({"name": "a b"}, "name must be a letter.*got 'a b'"),
        ({"name": "scene"}, "must not be 'scene'"),
        ({"concavity": 0.0}, r"concavity must lie in \[0.01, 1\], got 0.0"),
        ({"max_pieces": 0}, "max_pieces must be ≥ 1, got 0"),
        ({"resolution": 7}, "resolution must lie between 8 and 512"),
        ({"texture_size": 3}, "texture_size must lie between 64 and 8192"),
    ],
)
def test_bad_options_are_named_before_anything_is_written(thing, tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        export_object(thing, tmp_path / "out", **options)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ValueError, match="collision must be one of .* got 'vhacd'"):
        chosen_collision("vhacd", solid=True)


def test_folder_of_others_is_left_alone(thing, tmp_path):
    place = tmp_path / "mine"
    place.mkdir()
    (place / "thesis.tex").write_text("…")
    with pytest.raises(ValueError, match=r"nothing but an earlier export, got .* with thesis.tex"):
        export_object(thing, place, **QUICK)
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="must be a folder, got the file"):
        export_object(thing, tmp_path / "file", **QUICK)
    with pytest.raises(ValueError, match="in missing"):
        export_object(thing, tmp_path / "no" / "where", **QUICK)


def test_export_replaces_an_earlier_one_whole_or_not_at_all(thing, tmp_path, monkeypatch):
    place = tmp_path / "angle"
    export_object(thing, place, **QUICK)
    before = {path: path.read_bytes() for path in place.rglob("*") if path.is_file()}

    def fails(*_):
        raise KeyboardInterrupt

    monkeypatch.setitem(_export._WRITERS, "urdf", fails)
    with pytest.raises(KeyboardInterrupt):
        export_object(thing, place, to="urdf", **QUICK)
    assert {path: path.read_bytes() for path in place.rglob("*") if path.is_file()} == before
    assert list(tmp_path.iterdir()) == [place]
    written = export_object(thing, place, to="obj", **QUICK)
    assert not (place / "angle.xml").exists() and "export.json" in written.files
    # A file of the user's own in it, however, is not to be lost.
    (place / "notes.txt").write_text("")
    with pytest.raises(ValueError, match="with notes.txt"):
        export_object(thing, place, **QUICK)
