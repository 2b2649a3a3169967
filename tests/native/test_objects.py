"""Compiled kernels: that come with dano, that are kept, that have to be made."""

import ctypes
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from dano.native import (
    _instances,
    _layout,
    _objects,
    Features,
    fields_of,
    instance,
    layout_of,
)

# The smallest kernel there is.
MODULE, KERNEL = "dano.vision.drawing.kernels.painting", "paint"
FEATURES = Features(WIDE=False, KINDS=frozenset({0}))


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """An object of the smallest kernel, in a folder for caches."""
    folder = tmp_path_factory.mktemp("cache")
    path = _objects.kept_path(FEATURES, MODULE, folder / "kernels")
    _objects.make_object(FEATURES, MODULE, path, _objects.FLAGS)
    return folder


@pytest.fixture
def cache(made, tmp_path, monkeypatch) -> Iterator[Path]:
    """A copy of it, which a test may damage, as the only place where objects lie."""
    folder = tmp_path / "cache"
    shutil.copytree(made, folder)
    monkeypatch.setenv("DANO_CACHE_DIR", str(folder))
    monkeypatch.setattr(_objects, "SHIPPED", tmp_path / "nothing")
    _objects._loaded.clear()
    yield folder
    _objects._loaded.clear()


@pytest.fixture
def compiled(monkeypatch) -> list[str]:
    """Modules that were compiled."""
    found: list[str] = []
    make = _objects.make_object

    def noted(features, module, *rest):
        found.append(module)
        return make(features, module, *rest)

    monkeypatch.setattr(_objects, "make_object", noted)
    return found


def stored(folder: Path, ending: str) -> Path:
    """The only file with an ending."""
    (found,) = (folder / "kernels").glob(f"*{ending}")
    return found


def test_layouts_are_those_of_warp():
    """Every array and number lies where Warp's structures have it."""
    kernel = instance(FEATURES, MODULE).paint
    layout = layout_of(kernel)
    scenery = instance(FEATURES, MODULE).Scenery()
    given = _layout.Parameters(layout)
    given.put("scenery.n_planes", 3)
    given.put("scenery.sky", (0.25, 0.5, 0.75))
    scenery.n_planes, scenery.sky = 3, wp.vec3f(0.25, 0.5, 0.75)
    own = ctypes.string_at(ctypes.addressof(scenery.__ctype__()), layout.arguments["scenery"][1])
    assert given.memory.raw[: len(own)] == own
    assert layout.arrays["picture"].dtype == np.dtype(("u1", (3,)))
    assert layout.arguments["picture"][1] == ctypes.sizeof(_layout.Array)


@pytest.mark.parametrize("law", ["", __file__], ids=["usual", "own"])
@pytest.mark.parametrize("structure", ["Body", "SamplePair", "Material"])
def test_fields_are_read_as_they_run(structure, law):
    """What the text of a structure says is what Warp makes of it."""
    module, features = "dano.engine.kernels.tables", Features(LAW=law)
    if law:
        assert ("numbers" in fields_of(features, module, structure)) == (structure == "Material")
    else:
        assert fields_of(features, module, structure) == tuple(
            getattr(instance(features, module), structure).vars
        )


def test_a_structure_that_is_not_there():
    with pytest.raises(KeyError, match="has no structure Nothing"):
        fields_of(Features(LAW=""), "dano.engine.kernels.tables", "Nothing")


def test_numbers_that_do_not_fit_an_array():
    given = _layout.Parameters(layout_of(instance(FEATURES, MODULE).paint))
    with pytest.raises(ValueError, match="colours must be contiguous items of 12 bytes"):
        given.show("colours", np.zeros((4, 3)))


def test_all_sources_count():
    """A formula that changes makes objects out of date; one of another kernel does not."""
    behind = _instances.modules_behind("dano.engine.kernels.rollout")
    assert {"dano.physics.point_law", "dano.engine.kernels.solve", "dano.physics.features"} <= set(behind)
    assert not any("derivatives" in name for name in behind)
    assert "dano.engine.kernels.derivatives.bodies" in _instances.modules_behind(
        "dano.engine.kernels.derivatives.pullback"
    )
    other = FEATURES.but(WIDE=True)
    assert _objects.fingerprint(FEATURES, MODULE) != _objects.fingerprint(other, MODULE)


def test_what_is_kept_is_loaded(cache, compiled):
    """Without compiling, and it computes."""
    kernel = _objects.cpu_kernel(FEATURES, MODULE, KERNEL)
    assert compiled == [] and kernel.address != 0 and kernel.layout.symbol == "paint_cpu_forward"


@pytest.mark.parametrize("ending", [".o", ".json"])
@pytest.mark.parametrize("content", [b"", b"\x7fELF but cut off", None], ids=["empty", "cut off", "gone"])
def test_what_is_damaged_is_made_again(cache, compiled, ending, content):
    path = stored(cache, ending)
    path.unlink() if content is None else path.write_bytes(content)
    assert _objects.cpu_kernel(FEATURES, MODULE, KERNEL).address != 0
    assert compiled == [MODULE]
    assert json.loads(stored(cache, ".json").read_text())["kernels"]["paint"]


def test_what_is_out_of_date_is_made_again(cache, compiled):
    path = stored(cache, ".json")
    path.write_text(json.dumps({**json.loads(path.read_text()), "fingerprint": "of another text"}))
    assert _objects.cpu_kernel(FEATURES, MODULE, KERNEL).address != 0
    assert compiled == [MODULE]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_cache_that_cannot_be_written(cache, compiled):
    """What is there is loaded all the same."""
    (cache / "kernels").chmod(0o500)
    assert _objects.cpu_kernel(FEATURES, MODULE, KERNEL).address != 0
    assert compiled == []


def test_a_full_disk_is_one_line(tmp_path, monkeypatch):
    def full(*_args, **_options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(_objects.os, "replace", full)
    path = _objects.kept_path(FEATURES, MODULE, tmp_path / "kernels")
    with pytest.raises(
        OSError, match=r"the simulator cannot be compiled in .*kernels: .*No space left.*DANO_CACHE_DIR"
    ):
        _objects.make_object(FEATURES, MODULE, path, _objects.FLAGS)
    assert list((tmp_path / "kernels").iterdir()) == []


def test_levels_of_processors(monkeypatch):
    """Objects run where all features of their level are, the best first."""
    monkeypatch.setattr(_objects.sys, "platform", "linux")
    monkeypatch.setattr(_objects.platform, "machine", lambda: "x86_64")
    third, fourth = _objects.LEVELS["x86-64-v3"], _objects.LEVELS["x86-64-v4"]
    for has, expected in (
        (third | fourth, ["x86-64-v4", "x86-64-v3"]),
        (third, ["x86-64-v3"]),
        (third - {"fma"}, []),
        (fourth, []),
    ):
        monkeypatch.setattr(_objects, "processor_features", lambda has=has: has)
        assert _objects.levels() == expected
    monkeypatch.setattr(_objects.platform, "machine", lambda: "arm64")
    assert _objects.levels() == []


PROGRAM = f"""
import sys
from dano.native import cpu_kernel, Features
assert cpu_kernel(Features(WIDE=False, KINDS=frozenset({{0}})), "{MODULE}", "{KERNEL}").address
print("warp" in sys.modules)
"""


@pytest.mark.slow
def test_two_processes_at_once(tmp_path):
    """Both make the object, one of them stays; the next process needs no compiler."""
    environment = {**os.environ, "DANO_CACHE_DIR": str(tmp_path)}

    def started():
        return subprocess.Popen(
            [sys.executable, "-c", PROGRAM], env=environment, stdout=subprocess.PIPE, text=True
        )

    both = [started(), started()]
    assert [each.communicate()[0].strip() for each in both] == ["True", "True"]
    assert len(list((tmp_path / "kernels").glob("*.o"))) == 1
    assert started().communicate()[0].strip() == "False"


SOURCE = """
import hashlib, sys
from dano.native import Features, instance
from dano.engine.launching._tables import builds
for module in sys.argv[1:]:
    features = builds()[0]
    if "derivatives" in module:
        features = features.but(ADJOINTS=True)
    name = module.rsplit(".", 1)[1]
    kernel = getattr(instance(features, f"dano.engine.kernels.{module}"), name)
    if name == "rollout":
        found = kernel
options = found.module.resolved_options.get(1) or {**found.module.options, "block_dim": 1}
print(len(found.module._run_codegen({**options, "output_arch": None}, True)[0]))
"""


@pytest.mark.slow
def test_what_ran_before_changes_no_source():
    """A rollout is the same text whether derivatives were run before it or not."""
    orders = (["rollout"], ["derivatives.pullback", "rollout"])
    sizes = [
        subprocess.run(
            [sys.executable, "-c", SOURCE, *order], capture_output=True, text=True, check=True
        ).stdout
        for order in orders
    ]
    assert sizes[0] == sizes[1] and int(sizes[0]) > 1e5
