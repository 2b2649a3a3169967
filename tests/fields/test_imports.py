"""Files of other programs: densities agree with what the library of each format says (tests/data/imports)."""

import io
import pickle
import re
import runpy
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano import memory
from dano.fields import GridField, load_field, save_field, SignedDistanceGrid
from dano.fields.readers import _checkpoint
from dano.fields.readers._splats import splat_field

FILES = Path(__file__).parents[1] / "data" / "imports"
CHECKPOINT = FILES / "nerfacto" / "nerfstudio_models" / "step-000000003.ckpt"
POINTS = runpy.run_path(str(FILES / "make.py"))["points"]
PACKAGES = {"splats": "plyfile", "openvdb": "blosc"}

CASES = {
    "nerfacto": lambda: load_field(CHECKPOINT, crop=[(-3,) * 3, (3,) * 3], undo_transform=False),
    "tcnn": lambda: load_field(
        FILES / "tcnn.ckpt",
        hidden_dim=16,
        base_res=4,
        disable_scene_contraction=True,
        average_init_density=1.0,
    ),
    "splats": lambda: load_field(FILES / "splats.ply"),
    "fog": lambda: load_field(FILES / "openvdb.vdb", grid="density"),
    "half": lambda: load_field(FILES / "openvdb.vdb", grid="half"),
    "nano": lambda: load_field(FILES / "nanovdb.nvdb"),
}


def needs(name: str) -> None:
    package = {"splats": "plyfile", "fog": "blosc", "half": "blosc", "levelset": "blosc", "ngp": "msgpack"}
    if name in package:
        pytest.importorskip(package[name])


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize("name", CASES)
def test_density_agrees_with_the_library_of_the_format(name, dtype):
    needs(name)
    field, x = CASES[name](), jnp.asarray(POINTS(name).T, dtype)
    found, expected = np.asarray(field.jet(x, 0)), np.load(FILES / f"{name}.npy")
    assert expected.std() > 1e-3, "the points must meet the field"
    error = np.abs(found - expected)
    # Relative to the density, where there is one worth the name: a thousandth of the largest.
    assert np.max(error / np.maximum(expected, 1e-3 * expected.max())) < 1e-3


def test_level_set_agrees_and_goes_on_beyond_its_band():
    needs("levelset")
    shape = load_field(FILES / "openvdb.vdb", grid="levelset", interpolation="linear")
    assert isinstance(shape, SignedDistanceGrid)
    x = POINTS("levelset")
    found, expected = np.asarray(shape.sdf_jet(jnp.asarray(x.T), 0)), np.load(FILES / "levelset.npy")
    near = np.abs(expected) < 0.004
    assert near.sum() > 300
    np.testing.assert_allclose(found[near], expected[near], atol=1e-3 * 0.04)
    true = np.linalg.norm(x - [0.05, 0.04, 0.03], axis=1) - 0.04
    inside = true < 0
    assert true.min() < -0.035
    np.testing.assert_allclose(found[inside], true[inside], atol=0.5 * 0.004)


def test_the_transform_of_training_is_undone():
    """x_train = scale (R x + t), as in nerfstudio's dataparser_transforms.json."""
    x = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    turned = 0.25 * (np.stack([-x[:, 1] + 0.3, x[:, 0] - 0.2, x[:, 2] + 0.1], axis=1))
    in_training = load_field(CHECKPOINT, undo_transform=False)
    np.testing.assert_allclose(
        load_field(CHECKPOINT).jet(jnp.asarray(x.T), 0), in_training.jet(jnp.asarray(turned.T), 0), rtol=1e-9
    )


def snapshot(path, grid, **dataset):
    msgpack = pytest.importorskip("msgpack")
    content = {"density_grid_size": 128, "density_grid_binary": grid.astype(np.float16).tobytes()}
    content |= {"mode": "nerf", "nerf": {"dataset": dataset}}
    data = msgpack.packb({"snapshot": content})
    if path.suffix == ".ingp":
        import zlib

        data = zlib.compress(data)
    path.write_bytes(data)


@pytest.mark.parametrize("name", ["a.ingp", "a.msgpack"])
def test_instant_ngp_snapshots(name, tmp_path):
    """Cell by cell from the sources of instant-ngp: bits of x, y, z in turn; value = density · √3/1024."""
    random = np.random.default_rng(0)
    grid = np.where(random.random(2 * 128**3) < 0.1, random.uniform(0.01, 50, 2 * 128**3), -1)
    snapshot(tmp_path / name, grid, scale=0.4, offset=[0.5, 0.4, 0.6], from_mitsuba=False)
    for cascade, size in ((0, 1.0), (1, 2.0)):
        field = load_field(tmp_path / name, cascade=cascade)
        cells = random.integers(0, 128, (10_000, 3))
        found = np.asarray(grid[cascade * 128**3 :].astype(np.float16), float)
        expected = np.zeros(len(cells))
        for row, (x, y, z) in enumerate(cells.tolist()):
            code = sum(((n >> k) & 1) << (3 * k + axis) for axis, n in enumerate((x, y, z)) for k in range(7))
            expected[row] = max(found[code], 0) * 1024 / np.sqrt(3) * 0.4
        # ngp = (y, z, x) · scale + offset.
        ngp = 0.5 + size * ((cells + 0.5) / 128 - 0.5)
        yzx = (ngp - [0.5, 0.4, 0.6]) / 0.4
        x = jnp.asarray(yzx[:, [2, 0, 1]].T)
        np.testing.assert_allclose(field.jet(x, 0), expected, rtol=1e-3, atol=1e-3 * expected.max())
    with pytest.raises(ValueError, match=f"{name}: cascade must lie between 0 and 1, got 2"):
        load_field(tmp_path / name, cascade=2)


def test_modules_of_pytorch(tmp_path, monkeypatch):
    torch = pytest.importorskip("torch")
    torch.manual_seed(0)
    (tmp_path / "lamps.py").write_text(
        "import torch\n"
        "def lamp():\n"
        "    return torch.nn.Sequential(torch.nn.Linear(3, 8), torch.nn.ReLU(), torch.nn.Linear(8, 1),"
        " torch.nn.Softplus())\n"
        "def ball(x):\n"
        "    return 1.0 * ((x * x).sum(1) < 0.25)\n"
    )
    monkeypatch.chdir(tmp_path)
    model = torch.nn.Sequential(
        torch.nn.Linear(3, 8), torch.nn.ReLU(), torch.nn.Linear(8, 1), torch.nn.Softplus()
    )
    box = [(-1.0,) * 3, (1.0,) * 3]
    x = np.random.default_rng(0).uniform(-1, 1, (10_000, 3))
    with torch.no_grad():
        expected = model(torch.tensor(x, dtype=torch.float32))[:, 0].numpy()
    torch.save({"state_dict": model.state_dict()}, "weights.pt")
    with warnings.catch_warnings():
        # Deprecated, under one category or another by version; but such files are around.
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.simplefilter("ignore", FutureWarning)
        torch.jit.trace(model, torch.zeros(5, 3)).save("script.pt")
    batch = {0: torch.export.Dim("batch")}
    torch.export.save(
        torch.export.export(model, (torch.zeros(5, 3),), dynamic_shapes=(batch,)), "exported.pt2"
    )
    for field in (
        load_field("weights.pt", module="lamps:lamp", crop=box),
        load_field("script.pt", crop=box),
        load_field("exported.pt2", crop=box),
    ):
        np.testing.assert_allclose(field.jet(jnp.asarray(x.T), 0), expected, rtol=1e-4)
    ball = load_field("lamps:ball", crop=box)
    np.testing.assert_array_equal(ball.jet(jnp.asarray(x.T), 0), (x * x).sum(1) < 0.25)
    for bad, message in {
        "weights.pt": "expected an exported or TorchScript module, or weights and module=",
        "script.pt": "a function has no bounds of its own",
    }.items():
        with pytest.raises(ValueError, match=message):
            load_field(bad, crop=None if bad == "script.pt" else box)
    with pytest.raises(ImportError, match="'lamps' has no 'lump'"):
        load_field("lamps:lump", crop=box)
    with pytest.raises(ValueError, match="do not fit 'lamps:lamp'"):
        torch.save({"0.weight": torch.zeros(8, 4)}, "other.pt")
        load_field("other.pt", module="lamps:lamp", crop=box)


def ball_distances(n=24, width=None):
    axis = np.linspace(-1, 1, n)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    distances = np.linalg.norm(x, axis=-1) - 0.6
    return distances if width is None else np.clip(distances, -width, width)


@pytest.mark.parametrize("width", [None, 0.3])
def test_signed_distances_in_files(width, tmp_path):
    """Also such as were cut off: the distance goes on to the middle of the ball."""
    np.save(tmp_path / "ball.npy", ball_distances(width=width))
    ball = load_field(tmp_path / "ball.npy", spacing=2 / 23, signed_distance=True)
    assert isinstance(ball, SignedDistanceGrid)
    assert float(ball.sdf(jnp.zeros(3))) == pytest.approx(-0.6, abs=0.05)
    assert float(ball.sdf(jnp.asarray([0.7, 0.0, 0.0]))) == pytest.approx(0.1, abs=5e-3)
    save_field(ball, tmp_path / "again.npz")
    again = load_field(tmp_path / "again.npz", scale=0.1)
    assert isinstance(again, SignedDistanceGrid)
    x = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (3, 100)))
    np.testing.assert_allclose(again.sdf_jet(0.1 * x, 0), 0.1 * ball.sdf_jet(x, 0), atol=1e-12)
    with pytest.raises(ValueError, match="change by about 1 a unit near the surface, got 11.5"):
        load_field(tmp_path / "ball.npy", signed_distance=True, spacing=2 / 23 / 11.5)


def test_crop_scale_and_pose(tmp_path):
    values = np.random.default_rng(0).random((9, 9, 9))
    np.save(tmp_path / "a.npy", values)
    whole = load_field(tmp_path / "a.npy", spacing=0.25, interpolation="linear")
    box, pose = [(-0.5, -0.5, -1.0), (0.5, 0.5, 0.5)], dano.Pose((1.0, 2.0, 3.0), (1.0, 0.2, 0.1, -0.4))
    placed = load_field(
        tmp_path / "a.npy", spacing=0.25, interpolation="linear", crop=box, scale=0.1, pose=pose
    )
    x = np.random.default_rng(1).uniform([-0.5, -0.5, -1.0], [0.5, 0.5, 0.5], (200, 3))
    moved = pose.apply(jnp.asarray(0.1 * x))
    np.testing.assert_allclose(placed.jet(moved.T, 0), whole.jet(jnp.asarray(x.T), 0), atol=1e-12)
    outside = pose.apply(jnp.asarray([[0.08, 0.0, 0.0]]))
    assert float(placed.jet(outside.T, 0)[0]) == 0
    with pytest.raises(ValueError, match="a.npy: crop must hold two nodes"):
        load_field(tmp_path / "a.npy", spacing=0.25, crop=[(5, 5, 5), (6, 6, 6)])
    with pytest.raises(ValueError, match="scale must be finite and > 0, got -1.0"):
        load_field(tmp_path / "a.npy", spacing=0.25, scale=-1.0)
    save_field(GridField(values, (0, 0, 0), 0.1), tmp_path / "a.npz")
    with pytest.raises(ValueError, match="lower corner below"):
        load_field(tmp_path / "a.npz", crop=[(1, 0, 0), (0, 1, 1)])


class _Attack:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_checkpoints_run_no_code(tmp_path):
    """A checkpoint whose pickle would make a file: its tensors are read, the file is not made."""
    path, trace = tmp_path / "evil.ckpt", tmp_path / "trace"
    content = io.BytesIO()
    pickle.Pickler(content, protocol=2).dump({"pipeline": {"x": 1}, "evil": _Attack(trace)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", content.getvalue())
    with pytest.raises(ValueError, match="evil.ckpt: expected a PyTorch checkpoint; it holds no tensor"):
        load_field(path)
    assert not trace.exists()


BROKEN = ["nerfacto/nerfstudio_models/step-000000003.ckpt", "splats.ply", "openvdb.vdb", "nanovdb.nvdb"]


@pytest.mark.parametrize("name", BROKEN)
@pytest.mark.filterwarnings("ignore:.* Gaussians lie far from the others")
def test_broken_files(name, tmp_path):
    """Cut off, empty, foreign, or with a spoilt byte: a ValueError that names the file, or no effect."""
    needs({"splats.ply": "splats", "openvdb.vdb": "fog"}.get(name, ""))
    whole, path = (FILES / name).read_bytes(), tmp_path / Path(name).name
    options: dict[str, Any] = {"grid": "density"} if name == "openvdb.vdb" else {}
    for content in (b"", b"nothing of the kind", whole[:100], whole[: len(whole) // 3]):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=path.name):
            load_field(path, **options)
    for place in np.linspace(4, len(whole) // 2, 25).astype(int):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x5A]) + whole[place + 1 :])
        try:
            load_field(path, **options)
        except ValueError as error:
            assert path.name in str(error)


def test_what_does_not_fit_is_said(tmp_path):
    needs("fog")
    for options, message in {
        "grid": (
            {"grid": "mask"},
            r"expected one grid of floats named 'mask', got the grids 'density' \(Tree_float",
        ),
        "crop": ({"grid": "levelset", "crop": [(0, 0, 0), (1, 1, 1)]}, "level set, which cannot be cropped"),
        "far": ({"grid": "density", "crop": [(8, 8, 8), (9, 9, 9)]}, "less than two voxels"),
    }.values():
        with pytest.raises(ValueError, match=f"openvdb.vdb: .*{message}"):
            load_field(FILES / "openvdb.vdb", **options)
    with pytest.raises(ValueError, match="do not fit a nerfacto field with .*'hidden_dim': 64"):
        load_field(FILES / "tcnn.ckpt")
    with pytest.raises(ValueError, match=r"unknown options \['cascade'\] for a .ckpt file"):
        load_field(CHECKPOINT, cascade=1)
    (tmp_path / "x.ingp").write_bytes(b"\x78\x9cnothing")
    pytest.importorskip("msgpack")
    with pytest.raises(ValueError, match="x.ingp: it is cut off or no msgpack"):
        load_field(tmp_path / "x.ingp")


def test_stray_gaussians_are_said_with_a_crop_that_leaves_them_out():
    random = np.random.default_rng(0)
    n = 200
    parameters = {
        "means": 0.1 * random.standard_normal((n, 3)),
        "scales": np.full((n, 3), np.log(0.01)),
        "quats": np.tile([1.0, 0, 0, 0], (n, 1)),
        "opacities": np.full(n, 3.0),
    }
    splat_field(parameters, None)
    parameters["means"][7] = 8000.0, 0, 0
    with pytest.warns(UserWarning, match="1 of 200 Gaussians lie far .* is 8e.03 wide") as said:
        splat_field(parameters, None)
    crop = re.search(r"--crop ([-0-9. ]+)`", str(said[0].message))
    assert crop is not None
    box = np.reshape([float(x) for x in crop[1].split()], (2, 3))
    others = np.delete(parameters["means"], 7, axis=0)
    assert np.all(box[0] < others.min(0)) and np.all(box[1] > others.max(0)) and np.all(np.ptp(box, 0) < 1)
    splat_field(parameters, box)


def test_files_that_unfold_into_more_than_fits_are_refused(tmp_path, monkeypatch):
    needs("ngp")
    snapshot, weights = tmp_path / "x.ingp", tmp_path / "x.ckpt"
    snapshot.write_bytes(zlib.compress(bytes(1 << 21)))
    with zipfile.ZipFile(weights, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data/0", bytes(1 << 21))
    monkeypatch.setattr(memory, "memory_limit", lambda: 1 << 20)
    monkeypatch.setattr(_checkpoint, "memory_limit", lambda: 1 << 20)
    for path in (snapshot, weights):
        assert path.stat().st_size < 5000
        with pytest.raises(ValueError, match=rf"{path.name}: .*it unfolds into .* MiB"):
            load_field(path)
