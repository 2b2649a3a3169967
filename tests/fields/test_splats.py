"""Gaussian splats: one object out of a scene, moved with its colours, and written for others."""

import dataclasses
import json
import math
import shlex

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

import dano
from dano.fields import load_field, read_splats, Splats
from dano.fields.readers._splats import harmonics
from dano.maths import Pose
from dano.objects import fill_hollows, node_values
from dano.report import view_splats
from dano.report.viewing._serving import serve
from dano.report.viewing._splats import Choice, struck

pytest.importorskip("plyfile")
RADIUS, CENTRE = 0.05, np.array([0.2, -0.1, 0.06])
BOX = (0.14, -0.16, 0.005, 0.26, -0.04, 0.12)


def test_a_foot_that_nobody_saw_is_closed():
    # A hollow cup of 40 × 40 × 40 nodes, open below, beside its solid.
    shape = np.zeros((48, 48, 48))
    shape[4:44, 4:44, 4:44] = 1
    hollow = shape.copy()
    hollow[7:41, 7:41, :41] = 0
    grid = dano.GridField(hollow, (0, 0, 0), 0.01, "linear")
    assert fill_hollows(grid)[1].cavity < 0.01
    closed, before = fill_hollows(grid, stood=True)
    assert before.cavity > 0.5
    middle = node_values(closed)[8:40, 8:40, 8:40]
    np.testing.assert_allclose(middle, middle.max(), rtol=0.1)


def even(n: int) -> np.ndarray:
    """Points spread evenly over the unit sphere (Fibonacci)."""
    z = 1 - (2 * np.arange(n) + 1) / n
    turn = math.pi * (1 + math.sqrt(5)) * np.arange(n)
    return np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=1)


def scene() -> Splats:
    """A ball that looks another colour from each side, beside a smaller one, on a table."""
    rng = np.random.default_rng(0)
    ball = CENTRE + RADIUS * even(1500)
    other = np.array([-0.1, 0.05, 0.03]) + 0.02 * even(300)
    table = np.concatenate([rng.uniform(-0.3, 0.3, (800, 2)), np.zeros((800, 1))], axis=1)
    means = np.concatenate([ball, other, table])
    n = len(means)
    quats = rng.normal(size=(n, 4))
    return Splats(
        means=means,
        scales=np.log(rng.uniform(0.002, 0.004, (n, 3))),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        opacities=np.full(n, 5.0),
        colours=rng.normal(0, 0.3, (n, 16, 3)),
    )


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("splats") / "scene.ply"
    scene().save(path)
    return path


def test_files_hold_what_was_saved(file):
    read, made = read_splats(file), scene()
    for name, values in vars(read).items():
        np.testing.assert_allclose(values, getattr(made, name), rtol=1e-6, atol=1e-6)
    assert read.degree == 3
    # Kerbl et al. list the higher coefficients of red first, then those of green and blue.
    plyfile = pytest.importorskip("plyfile")
    row = plyfile.PlyData.read(str(file))["vertex"].data[7]
    assert row["f_rest_0"] == pytest.approx(made.colours[7, 1, 0])
    assert row["f_rest_15"] == pytest.approx(made.colours[7, 1, 1])
    assert row["f_rest_44"] == pytest.approx(made.colours[7, 15, 2])


def test_harmonics_are_those_of_splat_files():
    # Signs and order of the authors: m from −l to l, odd m with the phase of Condon and Shortley.
    d = even(40)
    theta, phi = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    found = harmonics(d, 3)
    for degree in range(4):
        for order in range(-degree, degree + 1):
            wave = sph_harm_y(degree, abs(order), theta, phi)
            part = wave.real if order >= 0 else wave.imag
            expected = part if order == 0 else math.sqrt(2) * part
            np.testing.assert_allclose(found[:, degree * (degree + 1) + order], expected, atol=1e-12)


def test_colours_turn_with_the_splats():
    made = scene()
    pose = Pose((0.3, 0.1, -0.2), (0.5, 0.1, -0.7, 0.4))
    moved = made.moved(pose, 0.5)
    point = np.array([0.1, 0.2, 0.3])
    matrix = Rotation.from_quat([0.1, -0.7, 0.4, 0.5]).as_matrix()
    place = matrix @ (0.5 * made.means[3]) + [0.3, 0.1, -0.2]
    np.testing.assert_allclose(moved.means[3], place, atol=1e-12)
    np.testing.assert_allclose(np.exp(moved.scales), 0.5 * np.exp(made.scales))
    # Each looks from the turned direction as it did before, and its axes are turned.
    direction = point / np.linalg.norm(point)
    turned = matrix @ direction
    before = harmonics(direction[None], 3) @ made.colours
    after = harmonics(turned[None], 3) @ moved.colours
    np.testing.assert_allclose(after, before, atol=1e-12)
    axes = [Rotation.from_quat(np.roll(x.quats[3], -1)).as_matrix() for x in (made, moved)]
    np.testing.assert_allclose(axes[1], matrix @ axes[0], atol=1e-12)


def test_one_object_is_cut_out(file):
    splats = read_splats(file)
    inside = splats.inside(BOX)
    assert inside.sum() == 1500 and inside[:1500].all()
    np.testing.assert_array_equal(splats.inside(sphere=(*CENTRE, 0.055)), inside)
    # Whole: none is cut off where it reaches out of the box.
    field = load_field(file, box=BOX)
    low, high = np.asarray(field.bounds)
    assert np.all(low < CENTRE - RADIUS) and np.all(high > CENTRE + RADIUS)
    table = jnp.asarray(splats.means[1900])
    assert float(field.density(table)) == 0 and float(load_field(file).density(table)) > 0.5


def test_what_takes_nothing_out_is_refused(file):
    splats = read_splats(file)
    with pytest.raises(ValueError, match=r"no centre of the 2600 Gaussians lies in box"):
        splats.inside((5, 5, 5, 6, 6, 6))
    with pytest.raises(ValueError, match="second corner above its first"):
        splats.inside((1, 0, 0, 0, 1, 1))
    with pytest.raises(ValueError, match="radius > 0"):
        splats.inside(sphere=(0, 0, 0, -1))
    with pytest.raises(ValueError, match=r"must end in \.ply"):
        splats.save(file.with_suffix(".txt"))


def test_arrays_are_those_of_mujoco_warp(file):
    arrays = read_splats(file).arrays
    assert {name: x.shape for name, x in arrays.items()} == {
        "splat_position": (2600, 3),
        "splat_rotation": (2600, 4),
        "splat_scale": (2600, 3),
        "splat_rgba": (2600, 4),
    }
    np.testing.assert_allclose(arrays["splat_rgba"][:, 3], 1 / (1 + math.exp(-5)), rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(arrays["splat_rotation"], axis=1), 1, rtol=1e-6)


@pytest.fixture(scope="module")
def folder(file, tmp_path_factory):
    """What `dano import --to` writes of the ball."""
    from dano.cli import main

    place = tmp_path_factory.mktemp("imported") / "ball"
    formats = ["mjcf", "usd"] if pytest.importorskip("pxr") else ["mjcf"]
    box = [str(x) for x in BOX]
    words = ["import", str(file), "--box", *box, "--to", *formats, "--mass", "0.3", "--resolution", "48"]
    assert main([*words, "-o", str(place)]) in (0, None)
    return place


def test_import_writes_the_object_and_its_splats(folder):
    mujoco = pytest.importorskip("mujoco")
    manifest = json.loads((folder / "export.json").read_text())
    assert {"ball.dano", "splats.ply", "surroundings.ply", "ball.xml", "ball.usd"} <= set(manifest["files"])
    assert len(read_splats(folder / "splats.ply")) == 1500
    assert len(read_splats(folder / "surroundings.ply")) == 1100
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    # A solid ball, though its Gaussians are a shell of up to 4 mm: two deviations are seen as full.
    assert model.body_mass[1] == pytest.approx(0.3)
    np.testing.assert_allclose(model.body_ipos[1], CENTRE, atol=1e-3)
    assert RADIUS < math.sqrt(model.body_inertia[1].mean() / (0.4 * 0.3)) < RADIUS + 0.008
    np.testing.assert_allclose(model.body_inertia[1], model.body_inertia[1].mean(), rtol=0.02)


def test_stages_hold_the_splats_on_the_body(folder):
    pxr = pytest.importorskip("pxr.Usd")
    stage = pxr.Stage.Open(str(folder / "ball.usd"))
    seen = stage.GetPrimAtPath("/ball/splats")
    assert seen.GetTypeName() == "ParticleField3DGaussianSplat"
    # Drawn instead of the mesh.
    assert not stage.GetPrimAtPath("/ball/visual").IsActive()
    made = scene()
    np.testing.assert_allclose(seen.GetAttribute("positions").Get(), made.means[:1500], atol=1e-6)
    np.testing.assert_allclose(seen.GetAttribute("scales").Get(), np.exp(made.scales[:1500]), rtol=1e-5)
    turn = seen.GetAttribute("orientations").Get()[5]
    np.testing.assert_allclose([turn.GetReal(), *turn.GetImaginary()], made.quats[5], atol=1e-6)
    assert seen.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 3
    colours = np.array(seen.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get())
    np.testing.assert_allclose(colours.reshape(1500, 16, 3), made.colours[:1500], atol=1e-6)
    around = pxr.Stage.Open(str(folder / "surroundings.usd"))
    assert len(around.GetPrimAtPath("/surroundings/splats").GetAttribute("positions").Get()) == 1100


def test_newton_draws_them(folder):
    newton = pytest.importorskip("newton", reason="what Newton reads needs newton")
    builder = newton.ModelBuilder()
    builder.add_usd(str(folder / "ball.usd"))
    kinds = list(builder.shape_type)
    assert newton.GeoType.GAUSSIAN in kinds
    assert builder.body_mass[0] == pytest.approx(0.3, rel=1e-6)


def met(splats: Splats, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Where a ray meets splats, which it does."""
    found = struck(splats, origin, direction)
    assert found is not None
    return found


def test_a_ray_meets_what_is_seen_first():
    """One opaque Gaussian before another: at its middle; beside both nothing."""
    sigma = 0.01
    two = Splats(
        means=np.array([[0.0, 0, 0], [0.0, 0, 0.2], [0.0, 0.0, -0.3]]),
        scales=np.log(np.full((3, 3), sigma)),
        quats=np.tile([1.0, 0, 0, 0], (3, 1)),
        opacities=np.full(3, 5.0),
        colours=np.zeros((3, 1, 3)),
    )
    down = np.array([0.0, 0, -1])
    np.testing.assert_allclose(met(two, np.array([0.005, 0, 1.0]), down), (0.005, 0, 0.2), atol=1e-12)
    # Behind the first one, and from between them upwards.
    np.testing.assert_allclose(met(two, np.array([0.0, 0, 0.1]), down), (0, 0, 0), atol=1e-12)
    np.testing.assert_allclose(met(two, np.array([0.0, 0, 0.1]), -down), (0, 0, 0.2), atol=1e-12)
    assert struck(two, np.array([0.02, 0, 1.0]), down) is None
    # Opacity α lets 1 − α through: 0.7² is the first below a half.
    thin = dataclasses.replace(two, opacities=np.full(3, math.log(0.3 / 0.7)))
    np.testing.assert_allclose(met(thin, np.array([0.0, 0, 1.0]), down), (0, 0, 0), atol=1e-12)
    # A long Gaussian along x that is turned to y is met far along y.
    long = dataclasses.replace(
        two,
        scales=np.log(np.array([[0.2, sigma, sigma]] * 3)),
        quats=np.tile([math.sqrt(0.5), 0, 0, math.sqrt(0.5)], (3, 1)),
    )
    assert struck(long, np.array([0.0, 0.1, 1.0]), down) is not None
    assert struck(long, np.array([0.1, 0.0, 1.0]), down) is None


def test_a_click_shows_the_command_that_takes_the_object_out(file):
    """A ray from above through the ball: the sphere's numbers are those that `inside` takes."""
    pytest.importorskip("viser")
    splats, made = read_splats(file), []

    def fill(server):
        made.append(Choice(server, splats, str(file)))
        return None

    viewer = serve(fill, port=8790, host="127.0.0.1", block=False)
    try:
        found = struck(splats, CENTRE + (0, 0, 1.0), np.array([0.0, 0, -1]))
        assert found is not None
        np.testing.assert_allclose(found, CENTRE + (0, 0, RADIUS), atol=0.2 * RADIUS)
        made[0].choose(CENTRE, 1.3 * RADIUS)
        words = shlex.split(made[0].command.replace("\\\n", ""))
        assert words[:2] == ["dano", "import"] and words[3] == "--sphere"
        assert splats.inside(sphere=[float(x) for x in words[4:8]]).sum() > 100
    finally:
        viewer.stop()
    with pytest.raises(ValueError, match="at least one Gaussian"):
        view_splats(splats.chosen(np.zeros(len(splats), bool)), file)
