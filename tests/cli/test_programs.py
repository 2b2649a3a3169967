"""What is compiled is kept for the next one: whole, for this processor, whoever else does the same."""

import os
import re
import signal
import subprocess
import sys
import zlib
from pathlib import Path

import pytest

import dano
from dano import programs
from dano.cli import main

PROGRAM = """
import os, sys
from dano.programs import keep_programs
import jax, jax.numpy as jnp
hits = []
jax.monitoring.register_event_listener(lambda name, **_: hits.append(name) if "cache_hit" in name else None)
jax.jit(jnp.sin)(1.0)
keep_programs()
x = jax.jit(lambda x: jnp.linalg.inv(x @ x.T + jnp.eye(9)).sum())(jnp.ones((9, 9)))
if "die" in sys.argv:
    os.kill(os.getpid(), 9)
print(float(x), len(hits))
"""


@pytest.fixture
def start(tmp_path):
    environment = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")}
    environment |= {"PYTHONPATH": str(Path(dano.__file__).parents[1]), "DANO_CACHE_DIR": str(tmp_path)}

    def call(*arguments: str) -> subprocess.Popen:
        command = [sys.executable, "-c", PROGRAM, *arguments]
        return subprocess.Popen(
            command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )

    return call


def answer(process: subprocess.Popen) -> tuple[str, int]:
    """The number it printed, and how many programs it did not compile."""
    out, err = process.communicate(timeout=120)
    assert (process.returncode, err) == (0, "")
    value, hits = out.split()
    return value, int(hits)


def entries(root: Path) -> list[Path]:
    return [path for path in root.rglob("*-cache.*") if ".run-" not in str(path)]


needs_features = pytest.mark.skipif(programs._processor() is None, reason="the processor is not known")


@needs_features
def test_second_process_compiles_nothing(start, tmp_path: Path):
    """Two at once on an empty folder, one that is killed, then entries that were cut off or changed."""
    dying = start("die")
    together = [start(), start()]
    first = [answer(process) for process in together]
    dying.communicate(timeout=120)
    assert dying.returncode == -signal.SIGKILL
    assert len(list(tmp_path.rglob(".run-*"))) == 1
    found = entries(tmp_path)
    assert found and all(programs._digest(path.read_bytes()) == path.name.split(".")[-1] for path in found)

    # Both may have made the same at the same time.
    made = {path.name.split("-cache.")[0] for path in found}
    name = made.pop()
    for path in found:
        if path.name.startswith(name):
            path.write_bytes(path.read_bytes()[:-7])
    again = answer(start())
    assert {value for value, _ in first} == {again[0]}
    assert again[1] == len(made)
    assert not list(tmp_path.rglob(".run-*"))
    assert answer(start())[1] == len(made) + 1


def test_what_is_cut_off_is_not_published(tmp_path: Path):
    own, folder = tmp_path / ".run-own", tmp_path / "shared"
    own.mkdir()
    folder.mkdir()
    whole = zlib.compress(bytes(range(256)) * 40)
    (own / "a-cache").write_bytes(whole)
    (own / "b-cache").write_bytes(whole[:-5])
    (own / "c-cache").write_bytes(b"\x28\xb5\x2f\xfd" + whole[:5])
    (own / "known-cache").write_bytes(whole)
    programs._publish(own, folder, {"known-cache"})
    assert [path.name.split("-")[0] for path in folder.iterdir()] == ["a"]


def test_oldest_entries_go(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(programs, "LIMIT", 250)
    for age, (folder, name) in enumerate([("old", "a"), ("new", "b"), ("new", "c"), ("old", "d")]):
        (tmp_path / folder).mkdir(exist_ok=True)
        path = tmp_path / folder / f"{name}-cache.0"
        path.write_bytes(b"x" * 100)
        os.utime(path, (age, age))
    programs._prune(tmp_path)
    assert sorted(path.name[0] for path in entries(tmp_path)) == ["c", "d"]


@needs_features
def test_folder(tmp_path: Path, monkeypatch):
    if programs._setting("jax_compilation_cache_dir"):
        pytest.skip("the tests run with a cache of their own")
    monkeypatch.setenv("DANO_CACHE_DIR", str(tmp_path))
    here = programs._folder()
    assert here is not None and re.fullmatch("[0-9a-f]{16}", here.name)
    monkeypatch.setattr(programs, "_processor", lambda: "flags: fewer")
    other = programs._folder()
    assert other is not None and other != here
    monkeypatch.setattr(programs, "_processor", lambda: None)
    assert programs._folder() is None
    monkeypatch.undo()

    monkeypatch.setenv("DANO_CACHE_DIR", str(tmp_path))
    here.chmod(0o777)
    assert programs._folder() is None
    here.chmod(0o700)
    monkeypatch.setenv("DANO_CACHE_DIR", "off")
    assert programs._folder() is None
    monkeypatch.delenv("DANO_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    folder = programs._folder()
    assert folder is not None and folder.parents[2] == tmp_path / "home"


def test_only_the_program_keeps(run, tmp_path: Path, monkeypatch):
    """JAX's settings of a program that calls `main` with arguments stay as they are."""
    asked = []
    monkeypatch.setattr(programs, "_folder", lambda: asked.append(None))
    programs.keep_programs.cache_clear()
    arguments = ["inspect", str(tmp_path / "missing.dano")]
    assert run(*arguments).code == 2
    assert not asked
    monkeypatch.setattr(sys, "argv", ["dano", *arguments])
    with pytest.raises(SystemExit):
        main()
    assert asked
