"""Each command on a small object."""

import contextlib
import json
import shutil
import signal
from importlib.resources import files
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cli.conftest import ellipsoid_values
from vision.photographs import capture, write_transforms

import dano
from dano.cli import _scenes
from dano.cli._outputs import run_files
from dano.fields import GridField, load_field, save_field
from dano.scene_file import _objects as shipped, _runs, load_run, load_scene
from dano.vision import read_film


def test_help_without_arguments(run):
    answer = run()
    assert answer.code == 0
    for command in ("build", "import", "inspect", "simulate", "view", "demo"):
        assert command in answer.out
        assert run(command, "--help").code == 0
    assert dano.__version__ in run("--version").out
    assert run("nonsense").code == 2
    answer = run("buidl", "x")
    assert answer.code == 2 and answer.err.endswith("got 'buidl'; did you mean 'build'?\n")


def test_build_writes_an_object(run, field, tmp_path):
    path = tmp_path / "egg.dano"
    options = ("--samples", 150, "--resolution", 20, "--length", 0.24, "--mass", 0.5)
    answer = run("build", field, "-o", path, *options, "--json")
    assert answer.code == 0
    assert answer.err == ""
    report = json.loads(answer.out)
    made = dano.NeuralObject.load(path)
    assert report["samples"] == len(made.samples.points) == 150
    assert report["mass"] == pytest.approx(0.5)
    a, b, c = 0.5 * np.array(report["extents"])
    np.testing.assert_allclose((a, b, c), (0.12, 0.10, 0.08), rtol=0.05)
    # The outermost samples lie on the surface, at half of the plateau.
    a, b, c = 0.12, 0.10, 0.08
    inertias = 0.5 / 5 * np.array([b**2 + c**2, a**2 + c**2, a**2 + b**2])
    np.testing.assert_allclose(report["principal_inertias"], inertias, rtol=0.05)


def test_build_of_another_mass_model_and_range(run, field, tmp_path):
    path = tmp_path / "egg.dano"
    options = ("--samples", 100, "--resolution", 16, "--density-range", 40, 60, "--mass-model", "density")
    answer = run("build", field, "-o", path, *options, "--mass-scale", 2)
    assert answer.code == 0
    assert "centre of mass" in answer.out
    made = dano.NeuralObject.load(path)
    assert made.mass_model == "density"
    assert "mass model          density: as asked; auto would take solid: densities of" in answer.out
    assert 40 <= float(made.samples.density.min()) <= float(made.samples.density.max()) <= 60
    with np.load(field) as data:
        assert float(made.mass.mass) == pytest.approx(2 * data["values"].sum() * 1e-6, rel=0.02)


DOUBTS = {
    "no mass": (
        0.01,
        slice(None),
        (),
        "no mass was given: the object has 0.04",
        "give --mass or --mass-scale",
    ),
    "millimetres": (
        10.0,
        slice(None),
        ("--mass", 1),
        "warning: the object is 118 m long",
        "give --length, its longest extent [m] (0.118 if it is in millimetres)",
    ),
    "cut off": (0.01, slice(5, 12), ("--mass", 1), "cut off where its grid ends, at −x, +x;", "--crop"),
}


@pytest.mark.parametrize("case", DOUBTS)
def test_build_says_what_it_assumed_and_what_mends_it(case, run, tmp_path):
    spacing, kept, options, *texts = DOUBTS[case]
    path = tmp_path / "egg.npz"
    save_field(GridField(jnp.asarray(ellipsoid_values()[kept]), (0.0, 0.0, 0.0), spacing), path)
    answer = run(
        "build", path, "-o", tmp_path / "egg.dano", "--samples", 100, "--resolution", 16, *options, "--json"
    )
    assert answer.code == 0
    assert answer.err.count("\n") == 1
    for text in texts:
        assert text in answer.err
    # What the warning names mends it.
    if case == "millimetres":
        options = ("--samples", 100, "--resolution", 16, *options, "--length", 0.118)
        assert run("build", path, "-o", tmp_path / "egg.dano", *options).err == ""


def test_scene_files_say_that_nobody_gave_a_mass(field, run, tmp_path):
    scene = tmp_path / "scene.toml"
    build = "build = {samples = 50, resolution = 12}"
    scene.write_text(f'n_steps = 2\n[[bodies]]\nname = "egg"\nfield = {json.dumps(str(field))}\n{build}\n')
    answer = run("simulate", scene, "-o", tmp_path / "run.npz")
    assert answer.code == 0
    assert "warning: no mass was given" in answer.err and "give mass or mass_scale" in answer.err


def test_import_says_that_a_mesh_is_rather_in_millimetres(run, tmp_path):
    pytest.importorskip("igl")
    mesh = tmp_path / "box.stl"
    pytest.importorskip("trimesh").creation.box((60, 90, 120)).export(mesh)
    options = ("-o", tmp_path / "box.npz", "--resolution", 16)
    answer = run("import", mesh, *options)
    assert answer.code == 0
    assert "120 units long" in answer.err and "read as millimetres, 0.12 m" in answer.err
    for told in (("--scale", 0.001), ("--units", "mm")):
        assert run("import", mesh, *options, *told).err == ""
    answer = run("import", mesh, *options, "--scale", 1)
    assert "the field is 137 m wide" in answer.err and "give --units" in answer.err


def test_a_second_part_of_a_mesh_feels_contact(run, tmp_path):
    pytest.importorskip("igl")
    trimesh = pytest.importorskip("trimesh")
    other = trimesh.creation.box((0.02, 0.02, 0.02))
    other.apply_translation((0.08, 0, 0))
    mesh, made = tmp_path / "two.stl", tmp_path / "two.dano"
    trimesh.util.concatenate([trimesh.creation.box((0.04, 0.04, 0.04)), other]).export(mesh)
    options = ("--samples", 300, "--resolution", 32, "--mass", 1)
    assert run("build", mesh, "-o", made, *options).code == 0
    points = np.asarray(dano.NeuralObject.load(made).samples.points)
    np.testing.assert_allclose([points[:, 0].min(), points[:, 0].max()], [-0.02, 0.09], atol=1e-3)


IMPORTS = Path(__file__).parents[1] / "data" / "imports"


def test_import_writes_a_placed_grid(run, tmp_path):
    """A NanoVDB grid in centimetres, turned by 90° about z: the density where it belongs."""
    path, nano = tmp_path / "ball.npz", IMPORTS / "nanovdb.nvdb"
    half = float(np.sqrt(0.5))
    place = ("--scale", 0.01, "--position", 1, 0, 0, "--orientation", half, 0, 0, half)
    answer = run("import", nano, "-o", path, *place, "--resolution", 48, "--json")
    assert (answer.code, answer.err) == (0, "")
    report = json.loads(answer.out)
    assert report["bake_error"] < 0.01
    assert report["range"][1] == pytest.approx(3, rel=0.05)
    x = np.array([0.1, -0.2, 0.3]) + 0.02 * np.array([9.0, 13.0, 12.0])
    found = dano.load_field(path).density(jnp.asarray([1 - 0.01 * x[1], 0.01 * x[0], 0.01 * x[2]]))
    assert float(found) == pytest.approx(float(dano.load_field(nano).density(jnp.asarray(x))), rel=0.02)


def test_import_fills_splats_and_keeps_signed_distances(run, tmp_path):
    pytest.importorskip("plyfile")
    pytest.importorskip("blosc")
    middle = jnp.zeros(3)
    for options, filled in (((), True), (("--hollow",), False)):
        answer = run("import", IMPORTS / "splats.ply", "-o", tmp_path / "a.npz", "--resolution", 40, *options)
        assert answer.code == 0
        assert ("was hollow" in answer.out) == filled
        assert (float(dano.load_field(tmp_path / "a.npz").density(middle)) > 0.4) == filled
    level = tmp_path / "level.npz"
    assert run("import", IMPORTS / "openvdb.vdb", "-o", level, "--grid", "levelset").code == 0
    made = tmp_path / "ball.dano"
    answer = run("build", level, "-o", made, "--samples", 100, "--resolution", 24, "--mass", 1, "--json")
    assert json.loads(answer.out)["mass_reason"] == "a shape's occupancy is exact"
    np.testing.assert_allclose(json.loads(answer.out)["principal_inertias"], 0.4 * 0.04**2, rtol=0.03)


@pytest.mark.parametrize(
    "file, options, message",
    {
        "kind": ("field.txt", (), "unknown kind of field '.txt'"),
        "absent": ("no.vdb", (), "no such file"),
        "damaged": ("damaged.ckpt", (), "expected a PyTorch checkpoint"),
        "option": ("damaged.ckpt", ("--cascade", 1), "unknown options"),
        "scale": ("damaged.ckpt", ("--scale", 0), "scale must be finite and > 0"),
        "resolution": ("damaged.ckpt", ("--resolution", 1), "resolution must lie between 4 and 1024"),
        "fine": ("damaged.ckpt", ("--resolution", 100000), "resolution must lie between 4 and 1024"),
        "orientation": ("damaged.ckpt", ("--orientation", 0, 0, 0, 0), "non-zero quaternion"),
        "module": ("nowhere.module:density", ("--crop", 0, 0, 0, 1, 1, 1), "No module named 'nowhere'"),
    }.values(),
)
def test_bad_imports_leave_what_was_there(run, file, options, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "damaged.ckpt").write_bytes(b"PK\x03\x04 and nothing more")
    (tmp_path / "a.npz").write_bytes(b"precious")
    answer = run("import", file, "-o", "a.npz", *options)
    assert answer.code == 2
    assert message in answer.err
    assert (tmp_path / "a.npz").read_bytes() == b"precious"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "damaged.ckpt"]


def test_inspect_prints_and_draws(run, egg, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr("dano.report.draw_object", lambda made, path, *, title: drawn.append((path, title)))
    copy = Path(shutil.copy(egg, tmp_path))
    answer = run("inspect", copy)
    assert answer.code == 0
    assert "principal inertias" in answer.out
    assert drawn == [(copy.with_suffix(".png"), "egg")]
    report = json.loads(run("inspect", copy, "--json", "--no-png").out)
    assert report["mass"] == pytest.approx(0.5)
    assert "picture" not in report


def test_simulate_a_scene(run, scene, tmp_path):
    out = tmp_path / "run.npz"
    answer = run("simulate", scene, "-o", out, "--json")
    assert answer.code == 0
    assert answer.err == ""
    report = json.loads(answer.out)
    loaded = load_run(out)
    # The command's pieces are of this length, which is compiled already.
    first = dano.simulate(loaded.scene, load_scene(scene).state, 20)
    second = dano.simulate(loaded.scene, jax.tree.map(lambda x: x[-1], first.states), 20)
    for name in ("position", "orientation", "velocity", "omega"):
        pieces = getattr(loaded.trajectory.states, name)
        steps = np.concatenate([getattr(first.states, name), getattr(second.states, name)[1:]])
        np.testing.assert_allclose(pieces[:41], steps, atol=1e-12)
        np.testing.assert_array_equal(report["bodies"][0][name], pieces[-1, 0])
    np.testing.assert_allclose(loaded.trajectory.times, 0.002 * np.arange(401), atol=1e-12)
    iterations = np.concatenate([first.iterations, second.iterations])
    np.testing.assert_array_equal(loaded.trajectory.iterations[:40], iterations)
    assert report["unconverged_steps"] == 0
    assert report["compile_seconds"] >= 0
    (contact,) = report["contacts"]
    # At the end the floor carries the weight.
    assert contact["last_force"] == pytest.approx(0.5 * 9.81, rel=0.05)


def test_simulate_options(run, scene, tmp_path):
    out = tmp_path / "run.npz"
    answer = run("simulate", scene, "-o", out, "--steps", 397, "--timestep", 0.001)
    assert answer.code == 0
    assert "steps that did not converge: 0" in answer.out
    np.testing.assert_allclose(dano.Trajectory.load(out).times, 0.001 * np.arange(398), atol=1e-12)


def test_simulate_an_object_drops_it(run, egg, tmp_path):
    out = tmp_path / "run.npz"
    report = json.loads(run("simulate", egg, "-o", out, "--steps", 400, "--json").out)
    body = report["bodies"][0]
    assert np.linalg.norm(body["velocity"]) < 0.05
    # It fell from 0.3 of its size and lies on its flattest side: its samples reach 4 cm from the middle.
    first = dano.Trajectory.load(out).states.position[0, 0, 2]
    assert first == pytest.approx(0.040 + 0.3 * dano.NeuralObject.load(egg).size, abs=0.003)
    assert body["position"][2] == pytest.approx(0.040, abs=0.003)


def test_simulate_draws(run, scene, tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(
        "dano.report.render_trajectory", lambda *given, **options: calls.append((given, options))
    )
    paths = [tmp_path / name for name in ("run.npz", "run.mp4", "run.png")]
    assert run("simulate", scene, "-o", paths[0], "--video", paths[1], "--strip", paths[2]).code == 0
    ((_, trajectory, video), options) = calls[0]
    assert trajectory.names == ("egg", "floor")
    assert (video, options["strip"]) == (paths[1], paths[2])


def test_a_run_is_drawn_by_the_camera_that_the_scene_names(run, scene, tmp_path):
    film = tmp_path / "run.mp4"
    words = "simulate", scene, "-o", tmp_path / "run.npz", "--video", film, "--camera", "scene", "--steps", 40
    answer = run(*words)
    assert answer.code == 2 and "camera must be a non-empty string, got None" in answer.err
    # Looks down on the floor from half a metre; its picture is no square.
    above = {"fl_x": 60, "w": 64, "h": 48, "transform_matrix": np.diag([1.0, 1, 1, 1]).tolist()}
    above["transform_matrix"][2][3] = 0.5
    (tmp_path / "camera.json").write_text(json.dumps(above), encoding="utf-8")
    scene.write_text('camera = "camera.json"\n' + scene.read_text(encoding="utf-8"), encoding="utf-8")
    answer = run(*words)
    assert answer.code == 0, answer.err
    frame = read_film(film).images[0].astype(float)
    assert frame.shape == (48, 64, 3)
    # The egg is in the middle, and not at the left.
    assert np.abs(frame[20:28, 28:36].mean((0, 1)) - frame[20:28, :8].mean((0, 1))).max() > 20


def test_two_scenes_are_simulated_and_filmed_side_by_side(run, scene, tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(
        "dano.report.render_side_by_side", lambda *given, **options: calls.append((given, options))
    )
    other, folder = tmp_path / "rough.toml", tmp_path / "both"
    other.write_text(scene.read_text(encoding="utf-8").replace("n_steps = 400", "n_steps = 200"))
    answer = run("simulate", scene, other, "-o", folder, "--video", tmp_path / "both.mp4", "--json")
    assert answer.code == 0, answer.err
    assert answer.err == f"dano: writing {folder / 'scene_run.npz'} and {folder / 'rough_run.npz'}\n"
    report = json.loads(answer.out)
    assert report["video"] == str(tmp_path / "both.mp4")
    assert [each["scene"] for each in report["runs"]] == [str(scene), str(other)]
    runs = [dano.Trajectory.load(each["run"]) for each in report["runs"]]
    assert [len(each.converged) for each in runs] == [400, 200]
    (((scenes, trajectories, video), options),) = calls
    assert [each.names for each in scenes] == [("egg", "floor")] * 2 and video == tmp_path / "both.mp4"
    np.testing.assert_array_equal(trajectories[1].states.position, runs[1].states.position)
    assert options["labels"] == ["scene", "rough"]
    # What is there is kept, and scenes of one name have runs of their own.
    (tmp_path / "again").mkdir()
    shutil.copy(other, tmp_path / "again" / "rough.toml")
    monkeypatch.chdir(tmp_path)
    answer = run("simulate", "rough.toml", "again/rough.toml", "--steps", 200, "--strip", "both.png")
    assert answer.code == 0, answer.err
    assert answer.err == "dano: writing rough_run.npz and rough_run_2.npz\n"
    assert calls[1][1]["labels"] == ["rough.toml", "again/rough.toml"]
    assert "== again/rough.toml ==" in answer.out
    assert "`dano view rough_run.npz --beside rough_run_2.npz` shows them in the browser" in answer.out
    assert run_files(Path(), [scene, other, other], resume=False)[1:] == [
        Path("rough_run_3.npz"),
        Path("rough_run_4.npz"),
    ]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            "scene.toml scene.toml -o run.npz",
            "output must be a folder for the runs of two scenes, got run.npz",
        ),
        ("scene.toml scene.toml -o scene.toml", "output must be a folder for the runs of two scenes"),
        ("scene.toml scene.toml -o no/where", "must be in an existing directory"),
        ("scene.toml none.toml", "must be an existing file, got none.toml"),
        ("scene.toml scene.toml scene.toml", "too many arguments: scene.toml; see dano simulate --help"),
        ("scene.toml scene.toml --video both.avi", "must end in .mp4"),
    ],
)
def test_bad_pairs_of_scenes_are_refused(run, scene, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(_scenes, "load", lambda *_: pytest.fail("work has begun"))
    before = sorted(tmp_path.iterdir())
    answer = run("simulate", *words.split())
    assert (answer.code, answer.err.count("\n")) == (2, 1) and message in answer.err
    assert sorted(tmp_path.iterdir()) == before


def test_unconverged_steps_are_said(run, scene, tmp_path, monkeypatch):
    def failing(*given, **options):
        piece = dano.simulate(*given, **options)
        return dano.Trajectory(
            piece.times, piece.states, piece.residuals + 1, piece.iterations, ~piece.converged, piece.names
        )

    monkeypatch.setattr(_runs, "simulate", failing)
    answer = run("simulate", scene, "-o", tmp_path / "run.npz", "--json")
    assert answer.code == 0
    assert json.loads(answer.out)["unconverged_steps"] == 400
    assert "warning: 400 of 400 steps did not converge, first step 0" in answer.err


def test_interrupt_leaves_nothing(run, scene, tmp_path, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(_runs, "simulate", interrupted)
    before = sorted(tmp_path.iterdir())
    answer = run("simulate", scene, "-o", tmp_path / "run.npz")
    assert answer.code == 130
    assert "Traceback" not in answer.err
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_that_was_swallowed_still_ends_the_command(run, scene, tmp_path, monkeypatch):
    def swallowing(*given, **options):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        return dano.simulate(*given, **options)

    monkeypatch.setattr(_runs, "simulate", swallowing)
    answer = run("simulate", scene, "-o", tmp_path / "run.npz")
    assert (answer.code, answer.err) == (130, "dano: interrupted\n")
    assert not (tmp_path / "run.npz").exists()
    # The next command is none the wiser.
    monkeypatch.setattr(_runs, "simulate", dano.simulate)
    assert run("simulate", scene, "-o", tmp_path / "run.npz", "--steps", 400).code == 0


@pytest.mark.usefixtures("interruptible")
def test_interrupting_the_page_is_an_interrupt(run, scene, tmp_path, monkeypatch):
    out = tmp_path / "run.npz"
    assert run("simulate", scene, "-o", out).code == 0

    def serve(*_, **__):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("dano.report.view", serve)
    answer = run("view", out)
    assert (answer.code, answer.err) == (130, "dano: interrupted\n")


def test_view_shows_the_run(run, scene, tmp_path, monkeypatch):
    out = tmp_path / "run.npz"
    assert run("simulate", scene, "-o", out).code == 0
    # The run holds its scene: the file may go, the object it names may not.
    scene.unlink()
    seen = []
    monkeypatch.setattr("dano.report.view", lambda *given, **options: seen.append((given, options)))
    assert run("view", out, "--port", 9000).code == 0
    ((shown, trajectory), options) = seen[0]
    assert shown.names == trajectory.names == ("egg", "floor")
    assert options == {"port": 9000, "looks": {}, "beside": None, "again": None}


def test_view_simulates_a_scene_and_again_with_other_parameters(run, scene, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr("dano.report.view", lambda *given, **options: seen.append((given, options)))
    assert run("view", scene).code == 0
    ((shown, trajectory), options) = seen[0]
    again = options["again"](shown)
    np.testing.assert_allclose(again.states.position, trajectory.states.position, atol=1e-6)
    heavy = options["again"](shown.replace_body("egg", mass_scale=2.0))
    assert heavy.names == trajectory.names


def test_view_writes_a_page_with_a_second_run(run, scene, tmp_path):
    pytest.importorskip("viser")
    out, page = tmp_path / "run.npz", tmp_path / "page.html"
    assert run("simulate", scene, "-o", out).code == 0
    answer = run("view", out, "--beside", out, "--page", page)
    assert (answer.code, answer.out.strip()) == (0, f"wrote {page}")
    text = page.read_text(encoding="utf-8")
    assert text.lower().startswith("<!doctype html>")
    assert len(text) > 100_000
    assert run("view", out, "--page", tmp_path / "page.png").code == 2


@pytest.mark.filterwarnings("default:.*lengths are not metres")
def test_view_shows_fields_and_photographs(run, field, tmp_path, monkeypatch):
    shown = {}
    for name in ("view_field", "view_capture"):
        monkeypatch.setattr(
            f"dano.report.{name}", lambda given, name=name, **options: shown.update({name: (given, options)})
        )
    assert run("view", field, "--port", 9000).code == 0
    seen, options = shown["view_field"]
    expected = load_field(field)
    assert isinstance(seen, GridField) and isinstance(expected, GridField)
    np.testing.assert_array_equal(seen.values, expected.values)
    assert options == {"port": 9000}

    photos = capture(n_train=3, n_test=0, pixels=8)
    write_transforms(tmp_path, photos, units="arbitrary")
    for source in (tmp_path, tmp_path / "transforms.json"):
        answer = run("view", source)
        assert answer.code == 0
        assert "lengths are not metres" in answer.err
        seen, options = shown["view_capture"]
        assert len(seen.views) == 3
        assert options == {"port": 8080, "unit": "units (scale not known)"}
    write_transforms(tmp_path, photos)
    assert run("view", tmp_path).code == 0
    assert shown["view_capture"][1]["unit"] == "m"


def test_view_says_what_it_takes(run, field, tmp_path):
    pytest.importorskip("viser")
    page = tmp_path / "page.html"
    answer = run("view", field, "--page", page)
    assert (answer.code, answer.out.strip()) == (0, f"wrote {page}")
    assert len(page.read_bytes()) > 100_000
    answer = run("view", field, "--beside", field)
    assert (answer.code, answer.out) == (2, "")
    assert "--beside goes with a run" in answer.err
    motion = dano.Motion.create(np.arange(3.0), ["egg"], position=np.zeros((3, 1, 3)))
    dano.save_motion(tmp_path / "motion.npz", motion)
    (tmp_path / "notes.txt").write_text("no field", encoding="utf-8")
    for name, kind in (("motion.npz", "dano-motion"), ("notes.txt", ".txt")):
        answer = run("view", tmp_path / name)
        assert answer.code == 2
        assert f"{name} must be a run" in answer.err and f"got a {kind} file" in answer.err


@pytest.fixture
def small_assets(egg, monkeypatch):
    """The shipped objects, replaced by one that is quick to simulate."""
    made = dano.NeuralObject.load(egg)
    precision = jnp.result_type(float).name
    monkeypatch.setattr(shipped, "_built", {(name, precision): made for name in shipped.ASSETS})


@pytest.fixture
def small_scenes(scene, egg, tmp_path, monkeypatch, small_assets):
    """The shipped scenes, replaced by the one that other tests have compiled."""
    text = scene.read_text(encoding="utf-8").replace(f'object = "{egg}"', 'asset = "bunny"')
    (tmp_path / "scenes").mkdir()
    for name in _scenes.SCENES:
        (tmp_path / "scenes" / f"{name}.toml").write_text(text, encoding="utf-8")
    monkeypatch.setattr(_scenes, "files", lambda _: tmp_path)


def test_demo(run, tmp_path, monkeypatch, small_scenes):
    drawn = []
    monkeypatch.setattr("dano.report.draw_object", lambda *given, **_: drawn.append(given[1].name))
    monkeypatch.setattr("dano.report.render_trajectory", lambda *given, **_: drawn.append(given[2].name))
    monkeypatch.setattr("dano.report.render_start", lambda *given, **_: drawn.append(given[2].name))
    folder = tmp_path / "demo"
    answer = run("demo", "all", "-o", folder, "--json")
    assert answer.code == 0
    report = json.loads(answer.out)["scenes"]
    assert list(report) == list(_scenes.SCENES)
    # First of all how a scene begins; an object of both scenes is drawn once.
    assert drawn == ["drop.png", "bunny.png", "drop.mp4", "collision.png", "collision.mp4"]
    written = {f"{name}.{suffix}" for name in _scenes.SCENES for suffix in ("toml", "npz", "json")}
    assert {path.name for path in folder.iterdir()} == {*written, "bunny.dano"}
    assert json.loads((folder / "drop.json").read_text(encoding="utf-8")) == report["drop"]
    told = run("demo", "collision", "-o", folder).out
    assert "== collision ==" in told
    # What happens is said in the order in which it happens, with the time, also where nobody watches.
    times = [float(line[1:].split(" s]")[0]) for line in told.splitlines() if line.startswith("[")]
    assert len(times) >= 4 and times == sorted(times)
    assert "bunny.png drawn" in told and "collision.mp4 drawn" in told


def test_demo_says_what_its_pictures_lack(run, tmp_path, monkeypatch, small_scenes):
    def failing(*_: object, **__: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr("dano.report.draw_object", failing)
    monkeypatch.setattr("dano.report.render_trajectory", lambda *_, **__: None)
    answer = run("demo", "collision", "-o", tmp_path / "demo")
    assert answer.code == 2
    assert "no space left" in answer.err


def test_shipped_scenes_load(small_assets):
    names = {path.name for path in (files("dano") / "scenes").iterdir() if path.name.endswith(".toml")}
    assert names == {f"{name}.toml" for name in _scenes.SCENES}
    for name in names:
        loaded = load_scene(str(files("dano") / "scenes" / name))
        assert len(loaded.scene.contacts) == 6
