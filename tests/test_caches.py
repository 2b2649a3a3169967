"""Where caches may be: never in the folder that somebody works in, and nowhere is a place, too."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

import dano
from dano import caches
from dano.caches import cache_folder


@pytest.fixture(autouse=True)
def fresh(monkeypatch, tmp_path):
    for name in ("DANO_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    caches._none.cache_clear()
    yield
    caches._none.cache_clear()


def test_folders_in_order(monkeypatch, tmp_path: Path):
    assert cache_folder() == tmp_path / ".cache" / "dano"
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    assert cache_folder() == tmp_path / ".cache" / "dano"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder() == tmp_path / "xdg" / "dano"
    monkeypatch.setenv("DANO_CACHE_DIR", str(tmp_path / "own"))
    assert cache_folder() == tmp_path / "own"
    for off in ("off", ""):
        monkeypatch.setenv("DANO_CACHE_DIR", off)
        assert cache_folder() is None


@pytest.mark.parametrize(
    ("variables", "said"),
    [
        ({"DANO_CACHE_DIR": "cache"}, "cache is not an absolute path"),
        ({"XDG_CACHE_HOME": "."}, "dano is not an absolute path"),
        ({"HOME": "."}, "not an absolute path"),
        ({"DANO_CACHE_DIR": "{here}"}, "is the working folder"),
        ({"HOME": "/dev/null"}, "/dev/null/.cache/dano cannot be written"),
    ],
)
def test_nowhere_is_said_once(monkeypatch, tmp_path: Path, variables, said):
    monkeypatch.chdir(tmp_path)
    for name, value in variables.items():
        monkeypatch.setenv(name, value.format(here=tmp_path))
    with pytest.warns(UserWarning, match=said):
        assert cache_folder() is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert cache_folder() is None
    assert list(tmp_path.iterdir()) == []


def test_commands_work_without_a_place_to_write(tmp_path: Path):
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XDG_", "DANO_"))}
    environment |= {"HOME": "/dev/null", "PYTHONPATH": str(Path(dano.__file__).parents[1])}
    words = ["dano", "inspect", "bunny", "--no-png"]
    program = f"import sys; from dano.cli import main; sys.argv = {words}; main()"
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("nothing is kept for the next run") == 1
    assert list(tmp_path.iterdir()) == []
