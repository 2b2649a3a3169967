"""Objects built of files are kept by what is in these, and are the same the second time."""

import errno
import os
import subprocess
import sys
import tomllib
import warnings
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

import jax
import numpy as np
import pytest

import dano
from dano import caches
from dano.building import BuildOptions
from dano.fields import companion_files, GridField, save_field
from dano.objects import NeuralObject
from dano.scene_file import _objects, load_object, object_of_file, parse_scene

OPTIONS = BuildOptions(samples=200, resolution=16, mass=0.2)
QUICK = BuildOptions(samples=100, resolution=12, mass_scale=1000.0)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> Iterator[Path]:
    """An empty cache, and a process that has built nothing."""
    monkeypatch.setenv("DANO_CACHE_DIR", str(tmp_path / "cache"))
    forget(monkeypatch)
    caches._none.cache_clear()
    yield tmp_path / "cache"
    caches._none.cache_clear()


def forget(monkeypatch):
    monkeypatch.setattr(_objects, "_kept_or_built", {})
    monkeypatch.setattr(_objects, "_said", set())


@pytest.fixture
def built(monkeypatch) -> list[int]:
    """Grows with each object that is built."""
    calls, make = [], NeuralObject.from_field

    def counted(field, **options):
        calls.append(1)
        return make(field, **options)

    monkeypatch.setattr(NeuralObject, "from_field", counted)
    return calls


def egg(path: Path, size: float = 0.05) -> Path:
    x = np.stack(np.meshgrid(*[np.linspace(-1, 1, 17)] * 3, indexing="ij"))
    values = np.clip(4 * (0.7 - np.linalg.norm(x, axis=0)), 0, 1)
    save_field(GridField(values, (-size, -size, -size), size / 8), path)
    return path


def leaves(made: NeuralObject) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(made)]


def equal(a: NeuralObject, b: NeuralObject) -> bool:
    return jax.tree.structure(a) == jax.tree.structure(b) and all(
        x.dtype == y.dtype and np.array_equal(x, y, equal_nan=True)
        for x, y in zip(leaves(a), leaves(b), strict=True)
    )


def test_built_once_for_bytes_and_options(tmp_path, cache, built, monkeypatch):
    path = egg(tmp_path / "egg.npz")
    first = object_of_file(path, OPTIONS)
    assert len(built) == 1
    kept = sorted(cache.rglob("*.dano"))
    assert len(kept) == 1 and equal(NeuralObject.load(kept[0]), first)
    assert object_of_file(path, OPTIONS) is first
    # Another process, and the same bytes elsewhere.
    forget(monkeypatch)
    again = object_of_file(path, OPTIONS)
    (tmp_path / "elsewhere").mkdir()
    moved = object_of_file(egg(tmp_path / "elsewhere" / "copy.npz"), OPTIONS)
    assert len(built) == 1 and equal(first, again) and equal(first, moved)
    # Other options, other bytes, another precision.
    object_of_file(path, BuildOptions(samples=201, resolution=16, mass=0.2))
    assert len(built) == 2
    egg(path, 0.06)
    object_of_file(path, OPTIONS)
    assert len(built) == 3
    with jax.enable_x64(False):
        object_of_file(path, OPTIONS)
    assert len(built) == 4
    # Building is what it was without a cache, in all digits.
    egg(path)
    monkeypatch.setenv("DANO_CACHE_DIR", "off")
    forget(monkeypatch)
    assert equal(object_of_file(path, OPTIONS), first)
    assert len(built) == 5


def test_other_code_builds_anew(tmp_path, built, monkeypatch):
    path = egg(tmp_path / "egg.npz")
    object_of_file(path, OPTIONS)
    for code in ("other code", None):
        monkeypatch.setattr(caches, "_code", lambda code=code: code)
        for _ in range(2):
            forget(monkeypatch)
            object_of_file(path, OPTIONS)
    # Where the code cannot be told, nothing is kept.
    assert len(built) == 1 + 1 + 2


def test_what_does_not_count_as_code_lies_above():
    """Folders whose sources do not count lie above objects in the order of imports."""
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
    order = project["tool"]["importlinter"]["contracts"][0]["layers"]
    names = [[name.strip(" ()") for name in layer.split("|")] for layer in order]
    place = next(i for i, layer in enumerate(names) if "objects" in layer)
    above = {name for layer in names[:place] for name in layer}
    # Data have no sources.
    assert caches._ABOVE - {"assets", "compiled"} <= above - {"scene_file", "robots", "building"}
    counted = {str(path) for path in caches._sources(files("dano"))}
    for module in (
        "fields/_grid",
        "objects/_surface",
        "vision/radiance/_osf",
        "maths",
        "scene_file/_objects",
    ):
        assert any(path.endswith(f"{module}.py") for path in counted), module


def test_what_was_said_is_said_again(tmp_path, built, monkeypatch):
    """What was found when the object was built, and what nobody gave, in each process once."""
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("igl")
    mesh = trimesh.creation.icosphere(2, radius=0.1)
    mesh.update_faces(np.arange(len(mesh.faces)) > 2)
    mesh.export(tmp_path / "open.stl")
    texts = []
    for name in ("open.stl", "open.stl", "other.stl"):
        path = tmp_path / name
        if name == "other.stl":
            (tmp_path / "open.stl").rename(path)
        forget(monkeypatch)
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            object_of_file(path, QUICK)
            object_of_file(path, QUICK)
        texts.append([str(each.message).replace(str(path), "FILE") for each in heard])
        assert f"{path}: repaired" in str(heard[0].message)
    assert len(built) == 1
    assert texts[0] == texts[1] == texts[2]
    forget(monkeypatch)
    with pytest.warns(UserWarning, match="no mass was given"):
        object_of_file(egg(tmp_path / "egg.npz"), BuildOptions(samples=100, resolution=12))


@pytest.mark.parametrize("damage", ["cut off", "foreign", "empty", "half"])
def test_what_is_damaged_is_built_anew(tmp_path, cache, built, monkeypatch, damage):
    path = egg(tmp_path / "egg.npz")
    first = object_of_file(path, OPTIONS)
    (kept,) = cache.rglob("*.dano")
    if damage == "half":
        kept.with_suffix(".json").unlink()
    else:
        data = {"cut off": kept.read_bytes()[:-100], "foreign": b"PK nothing", "empty": b""}[damage]
        kept.write_bytes(data)
    for _ in range(2):
        forget(monkeypatch)
        assert equal(object_of_file(path, OPTIONS), first)
    assert len(built) == 2


def test_a_full_disk_is_said_once(tmp_path, cache, built, monkeypatch):
    path, other = egg(tmp_path / "egg.npz"), egg(tmp_path / "other.npz", 0.06)

    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(caches.os, "replace", full)
    with pytest.warns(UserWarning, match="nothing is kept.*No space left on device"):
        object_of_file(path, OPTIONS)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        object_of_file(other, OPTIONS)
    assert [path for path in cache.rglob("*") if path.is_file()] == []


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() == 0, reason="root may write everywhere")
def test_a_cache_that_cannot_be_written_is_read(tmp_path, cache, built, monkeypatch):
    path = egg(tmp_path / "egg.npz")
    object_of_file(path, OPTIONS)
    for folder in (cache / "objects", cache):
        folder.chmod(0o500)
    try:
        forget(monkeypatch)
        object_of_file(path, OPTIONS)
        assert len(built) == 1
    finally:
        for folder in (cache, cache / "objects"):
            folder.chmod(0o700)


def test_a_folder_that_takes_nothing_is_read(tmp_path, cache, built, monkeypatch):
    """As on a system that can only be read."""
    path = egg(tmp_path / "egg.npz")
    object_of_file(path, OPTIONS)

    def refused(*_, **__):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    for name in ("mkdtemp", "TemporaryFile", "TemporaryDirectory"):
        monkeypatch.setattr(caches.tempfile, name, refused)
    monkeypatch.setattr(caches.os, "utime", refused)
    forget(monkeypatch)
    object_of_file(path, OPTIONS)
    assert len(built) == 1
    with pytest.warns(UserWarning, match="cannot be written"):
        object_of_file(path, BuildOptions(samples=99, resolution=16, mass=0.2))
    assert len(built) == 2


PROGRAM = """
import sys, jax
jax.config.update("jax_enable_x64", True)
from dano.building import BuildOptions
from dano.scene_file import object_of_file
made = object_of_file(sys.argv[1], BuildOptions(samples=200, resolution=16, mass=0.2))
print(float(made.mass.com @ made.mass.com), made.surface.points.sum())
"""


def test_two_processes_at_once(tmp_path, cache):
    path = egg(tmp_path / "egg.npz")
    environment = {**os.environ, "PYTHONPATH": str(Path(dano.__file__).parents[1])}
    command = [sys.executable, "-c", PROGRAM, str(path)]
    running = [subprocess.Popen(command, env=environment, text=True, stdout=subprocess.PIPE) for _ in "ab"]
    answers = {process.communicate(timeout=300)[0] for process in running}
    assert [process.returncode for process in running] == [0, 0]
    assert len(answers) == 1
    assert len(list(cache.rglob("*.dano"))) == 1
    assert not list(cache.rglob(".*"))


def test_scene_files_share_what_is_kept(tmp_path, built, monkeypatch):
    path = egg(tmp_path / "egg.npz")
    text = f"""
timestep = 0.01
duration = 0.1
[[bodies]]
name = "a"
{{kind}} = "{path.name}"
mass = 0.2
position = [0.0, 0.0, 0.1]
build = {{{{ samples = 200, resolution = 16 }}}}
[[bodies]]
name = "floor"
shape = "half_space"
fixed = true
"""
    for kind in ("object", "field", "object"):
        forget(monkeypatch)
        parse_scene(text.format(kind=kind), tmp_path / "scene.toml")
    assert len(built) == 1
    forget(monkeypatch)
    with pytest.warns(UserWarning, match="built of it with defaults"):
        load_object(path, weighed=True)
    assert len(built) == 2


def test_files_that_a_file_refers_to(tmp_path):
    def named(name: str) -> list[str]:
        return [path.name for path in companion_files(tmp_path / name)]

    (tmp_path / "cup.obj").write_text("# cup\nmtllib cup.mtl\nv 0 0 0\nmtllib other one.mtl\n")
    (tmp_path / "cup.gltf").write_text(
        '{"buffers": [{"uri": "cup%20data.bin"}, {"uri": "data:;base64,AA"}], "images": [{"uri": "a.png"}]}'
    )
    chunk = b'{"buffers": [{"byteLength": 1}, {"uri": "more.bin"}]}'
    header = b"glTF" + (2).to_bytes(4, "little") + (20 + len(chunk)).to_bytes(4, "little")
    (tmp_path / "cup.glb").write_bytes(header + len(chunk).to_bytes(4, "little") + b"JSON" + chunk)
    (tmp_path / "bad.gltf").write_text("[1, 2")
    assert named("cup.obj") == ["cup.mtl", "other one.mtl"]
    assert named("cup.gltf") == ["cup data.bin"]
    assert named("cup.glb") == ["more.bin"]
    assert named("bad.gltf") == named("missing.obj") == named("mug.stl") == []
    assert set(named("step.ckpt")) == {"config.yml", "dataparser_transforms.json"}
    # A buffer that changes, or appears, makes another object.
    files = [tmp_path / "cup.gltf", *companion_files(tmp_path / "cup.gltf")]
    names = [caches.digest(files)]
    for data in (b"1", b"2"):
        (tmp_path / "cup data.bin").write_bytes(data)
        names.append(caches.digest(files))
    assert len(set(names)) == 3


def test_the_oldest_go_when_there_are_too_many(cache, monkeypatch):
    monkeypatch.setattr(caches, "LIMIT", 250)
    for k in range(4):
        caches.keep("objects", f"{k}.json", lambda file: file.write_text("x"))
        caches.keep("objects", f"{k}.dano", lambda file: file.write_bytes(bytes(99)))
        for path in (cache / "objects").glob(f"{k}.*"):
            os.utime(path, (1000 + k, 1000 + k))
        if k == 1:
            # What is used stays.
            assert caches.find("objects", "0.dano") is not None
    assert {path.stem for path in (cache / "objects").iterdir()} == {"0", "3"}


def test_what_an_interrupt_leaves_goes(cache):
    with pytest.raises(KeyboardInterrupt):

        def stop(file):
            file.write_bytes(b"half")
            raise KeyboardInterrupt

        caches.keep("objects", "a.dano", stop)
    assert list((cache / "objects").iterdir()) == []
    killed = cache / "objects" / f"{caches._PART}killed"
    killed.mkdir()
    (killed / "a.dano").write_bytes(b"half")
    assert caches.contents(["objects"]) == {"objects": []}
    assert killed.exists()
    os.utime(killed, (0, 0))
    caches.contents(["objects"])
    assert not killed.exists()
