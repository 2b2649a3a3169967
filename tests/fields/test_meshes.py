"""Meshes as people have them: damaged by seeds, from CAD, in other units, of every kind of file."""

import importlib.util
import re
import warnings
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.fields import load_field, mesh_field, SignedDistanceGrid

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("igl")

distance_of = eqx.filter_jit(lambda field, x: field.sdf_jet(x, 0))
BALL = trimesh.creation.icosphere(4, 0.05)
DATA = Path(__file__).parents[1] / "data" / "imports"
BOX = trimesh.creation.box((0.1, 0.1, 0.1))


def raw(vertices, faces):
    return trimesh.Trimesh(vertices, faces, process=False)


def some(share: float, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random(len(BALL.faces)) < share


def missing(share, seed):
    return raw(BALL.vertices, BALL.faces[~some(share, seed)])


def flipped(share, seed):
    faces, chosen = BALL.faces.copy(), some(share, seed)
    faces[chosen] = faces[chosen][:, ::-1]
    return raw(BALL.vertices, faces)


def doubled(share, seed):
    return raw(BALL.vertices, np.concatenate([BALL.faces, BALL.faces[some(share, seed)]]))


def doubled_and_flipped(share, seed):
    return raw(BALL.vertices, np.concatenate([BALL.faces, BALL.faces[some(share, seed)][:, ::-1]]))


def all_at_once(share, seed):
    faces = flipped(share, seed).faces[~some(share, seed + 1)]
    return raw(BALL.vertices, np.concatenate([faces, faces[:50]])[:, ::-1])


DAMAGES = {
    missing: "open edges of 76.. closed",
    flipped: "faces of 5120 turned like their neighbours",
    doubled: "doubled faces",
    doubled_and_flipped: "doubled faces",
    all_at_once: "1 shells were inside out",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_balls_weigh_what_the_ball_does(damage):
    share = 0.03
    with pytest.warns(UserWarning, match=DAMAGES[damage]):
        field = mesh_field(damage(share, 7), 32)
    moments = field.solid_moments()
    assert moments is not None
    assert float(moments.volume) == pytest.approx(BALL.volume, rel=0.01)
    second = BALL.moment_inertia.trace() / 2 * np.eye(3) - BALL.moment_inertia
    np.testing.assert_allclose(moments.second_moment, second, rtol=0.01, atol=0.01 * second.max())
    # Where a hole was there is a surface, and not a pit.
    there = jnp.asarray(BALL.triangles_center[some(share, 7)].T)
    np.testing.assert_allclose(distance_of(field, there), 0, atol=5e-4)


def silent(mesh, resolution=32, up=None):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return mesh_field(mesh, resolution, up=up)


@pytest.mark.parametrize(
    "shift", [(0, 0, 0.1), (0, 0.1, 0.1), (0.1, 0.1, 0.1)], ids=["face", "edge", "corner"]
)
def test_closed_parts_that_touch_are_as_they_are(shift):
    other = BOX.copy()
    other.apply_translation(shift)
    for mirror in (1, -1):
        # Mirrored, the faces that touch are cut along the other diagonal.
        second = raw(
            other.vertices * [mirror, 1, 1] + [shift[0] * (1 - mirror), 0, 0], other.faces[:, ::mirror]
        )
        moments = silent(trimesh.util.concatenate([BOX, second])).solid_moments()
        assert moments is not None and float(moments.volume) == pytest.approx(2e-3, rel=1e-9)


def test_sliver_faces_of_a_closed_mesh_stay():
    i, j, k = BOX.faces[0]
    vertices = np.concatenate([BOX.vertices, [0.5 * (BOX.vertices[i] + BOX.vertices[j])]])
    n = len(BOX.vertices)
    field = silent(raw(vertices, [*BOX.faces[1:], (i, n, k), (n, j, k), (i, j, n)]))
    moments = field.solid_moments()
    assert moments is not None and float(moments.volume) == pytest.approx(1e-3, rel=1e-9)
    assert float(field.sdf(jnp.zeros(3))) == pytest.approx(-0.05, abs=1e-3)


def test_a_surface_through_itself_counts_once():
    # A tube along a figure of eight runs through itself: less what two cylinders share that cross, 16/3 r³.
    n, m, radius = 400, 48, 0.012
    t = np.linspace(0, 2 * np.pi, n, endpoint=False)[:, None]
    middle = 0.1 * np.concatenate([np.cos(t), np.sin(t) * np.cos(t), 0 * t], axis=1) / (1 + np.sin(t) ** 2)
    step = np.roll(middle, -1, axis=0) - np.roll(middle, 1, axis=0)
    along = step / np.linalg.norm(step, axis=1, keepdims=True)
    side = np.stack([-along[:, 1], along[:, 0], 0 * along[:, 0]], axis=1)
    angle = np.linspace(0, 2 * np.pi, m, endpoint=False)[None, :, None]
    points = middle[:, None] + radius * (np.cos(angle) * side[:, None] + np.sin(angle) * np.array([0, 0, 1]))
    i, j = (k.ravel() for k in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
    a, b = i * m + j, (i + 1) % n * m + j
    c, d = (i + 1) % n * m + (j + 1) % m, i * m + (j + 1) % m
    tube = raw(points.reshape(-1, 3), np.concatenate([np.stack(f, axis=1) for f in ((a, c, b), (a, d, c))]))
    length = np.linalg.norm(np.roll(middle, -1, axis=0) - middle, axis=1).sum()
    volume = np.pi * radius**2 * length - 16 / 3 * radius**3
    assert tube.volume > 1.02 * volume
    field = silent(tube, 96)
    assert field.solid_moments() is None
    made = dano.MassProperties.from_field(field, mass_scale=1000.0)
    assert float(made.mass) == pytest.approx(1000 * volume, rel=0.01)


@pytest.mark.parametrize(
    "mesh",
    [
        raw(BOX.vertices, BOX.faces[:2]),
        raw(BALL.vertices, BALL.faces[BALL.triangles_center[:, 2] > 0.02]),
        raw(BOX.vertices, np.concatenate([BOX.faces[:1], BOX.faces[:1, ::-1]])),
    ],
    ids=["two faces", "cap", "two-sided sheet"],
)
def test_what_has_no_inside_is_refused_at_once(mesh):
    with pytest.raises(ValueError, match="must enclose a volume"):
        mesh_field(mesh)


def test_arguments_are_checked_before_files(tmp_path):
    gone = tmp_path / "none.stl"
    cases: tuple[tuple[dict[str, Any], str], ...] = (
        ({"resolution": 3}, "resolution"),
        ({"interpolation": "fast"}, "interpolation"),
        ({"units": "inch"}, "units must be one of"),
        ({"units": "mm", "scale": 1.0}, "either scale or units"),
        ({"edge": -1.0}, "edge"),
    )
    for options, message in cases:
        with pytest.raises(ValueError, match=message):
            mesh_field(gone, **options)


def test_millimetres_are_guessed_and_said(tmp_path):
    path = tmp_path / "part.stl"
    trimesh.creation.box((80, 40, 30)).export(path)
    volume = 0.08 * 0.04 * 0.03
    with pytest.warns(UserWarning, match=r"80 units long .* read as millimetres, 0\.08 m; units='m' "):
        moments = mesh_field(path, 24).solid_moments()
    assert moments is not None and float(moments.volume) == pytest.approx(volume, rel=1e-6)
    for unit, metre in (("mm", 1e-3), ("in", 0.0254), ("m", 1.0)):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            field = load_field(path, units=unit, resolution=24)
        assert isinstance(field, SignedDistanceGrid)
        moments = field.solid_moments()
        assert moments is not None
        assert float(moments.volume) == pytest.approx(volume * (1e3 * metre) ** 3, rel=1e-6)


@pytest.mark.parametrize("kind", ["stl", "stl_ascii", "obj", "ply", "off", "glb", "3mf", "dae"])
def test_every_kind_of_file(tmp_path, kind):
    if kind == "3mf":
        pytest.importorskip("lxml")
    if kind == "dae":
        pytest.importorskip("collada")
    ending = kind.split("_")[0]
    # A torus and a box apart from it; 3MF of trimesh says millimetres.
    size = 1000.0 if kind == "3mf" else 1.0
    parts = [trimesh.creation.torus(0.04, 0.015), trimesh.creation.box((0.02, 0.02, 0.02))]
    volume = sum(part.volume for part in parts)
    mesh = trimesh.util.concatenate(parts)
    mesh.apply_scale(size)
    path = tmp_path / f"m.{ending}"
    path.write_bytes(data if isinstance(data := mesh.export(file_type=kind), bytes) else data.encode())
    # glTF says that y is up, which turns it, and is said.
    moments = silent(path, up="z" if ending == "glb" else None).solid_moments()
    assert moments is not None and float(moments.volume) == pytest.approx(volume, rel=1e-5)


def test_the_unit_of_a_collada_file_is_read(tmp_path):
    pytest.importorskip("collada")
    text = trimesh.creation.box((10, 20, 30)).export(file_type="dae").decode()
    unit = re.sub(r"<unit[^>]*/>", "", text).replace(
        "<asset>", '<asset><unit meter="0.01" name="centimeter"/>', 1
    )
    (tmp_path / "m.dae").write_text(unit, encoding="utf-8")
    moments = silent(tmp_path / "m.dae", 24).solid_moments()
    assert moments is not None and float(moments.volume) == pytest.approx(6e-3, rel=1e-5)


def test_an_object_of_several_groups(tmp_path):
    lines, first = [], 1
    for k in range(3):
        lines += [f"g part{k}", f"usemtl m{k}"]
        lines += [f"v {x} {y} {z + 0.1 * k}" for x, y, z in BOX.vertices]
        lines += ["f " + " ".join(str(i + first) for i in face) for face in BOX.faces]
        first += 8
    (tmp_path / "m.obj").write_text("\n".join(lines), encoding="utf-8")
    moments = silent(tmp_path / "m.obj").solid_moments()
    assert moments is not None and float(moments.volume) == pytest.approx(3e-3, rel=1e-9)


def test_solids_of_cad_are_in_metres():
    """A box of 100 × 70 × 50 mm as a STEP file; without its reader one line says what to install."""
    path = DATA / "box.step"
    if importlib.util.find_spec("cascadio") is None:
        with pytest.raises(ImportError, match=r"reading .step needs cascadio: pip install 'dano\[step\]'"):
            load_field(path)
        return
    box: Any = load_field(path, resolution=32)
    moments = box.solid_moments()
    np.testing.assert_allclose(moments.volume, 3.5e-4, rtol=1e-6)
    np.testing.assert_allclose(moments.centroid, (0.05, 0.035, 0.025), atol=1e-6)


def test_a_file_that_was_cut_off_is_said_to_be(tmp_path):
    path = tmp_path / "ball.stl"
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.icosphere(3).export(path)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(ValueError, match="got no whole triangle: is it cut off"):
        load_field(path)
