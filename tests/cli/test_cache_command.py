"""`dano cache` shows what is kept, and removes what it is asked to."""

import json
import os

import pytest

from dano import caches


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A cache with an object, two shapes, two kernels, a compiled program, and something of somebody else."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("DANO_CACHE_DIR", str(folder))
    contents = {
        "objects/a.dano": 1000,
        "objects/a.json": 24,
        "meshes/b.npz": 512,
        "meshes/c.npz": 512,
        "kernels/1.9/wp_x_123/x.o": 4096,
        "kernels/1.9/wp_x_123/x.meta": 1,
        "kernels/y-456.o": 2000,
        "kernels/y-456.json": 48,
        "compiled/0f/p-cache.1": 64,
        "compiled/0f/.run-host-1-x/p-cache": 64,
        "notes.txt": 10,
    }
    for age, (name, size) in enumerate(contents.items()):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(bytes(size))
        os.utime(path, (1e9 + age, 1e9 + age))
    return folder


def files(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_shows(run, cache):
    answer = run("cache", "--json")
    assert answer.code == 0 and answer.err == ""
    said = json.loads(answer.out)
    assert said["folder"] == str(cache)
    found = {kind: (row["entries"], row["bytes"]) for kind, row in said["kinds"].items()}
    assert found == {
        "objects": (1, 1024),
        "meshes": (2, 1024),
        "kernels": (2, 6145),
        "compiled": (1, 64),
    }
    assert said["kinds"]["objects"]["oldest_days"] > 1000
    text = run("cache").out
    assert str(cache) in text and "objects built of meshes and fields" in text and "8.06 KiB" in text
    assert "meshes" not in run("cache", "kernels").out


def test_clears(run, cache):
    answer = run("cache", "meshes", "compiled", "--clear")
    assert answer.code == 0 and "removed" in answer.out
    left = files(cache)
    assert not any(name.startswith("meshes") for name in left)
    # What a command that runs has, and what is not dano's, stays.
    assert {"compiled/0f/.run-host-1-x/p-cache", "notes.txt", "objects/a.dano"} <= left
    run("cache", "--clear")
    assert files(cache) == {"compiled/0f/.run-host-1-x/p-cache", "notes.txt"}
    assert "nothing" in run("cache").out


@pytest.mark.parametrize(
    ("limit", "left"),
    [
        ("1GB", {"objects", "meshes", "kernels", "compiled"}),
        ("2.1 kB", {"kernels", "compiled"}),
        ("64", {"compiled"}),
        ("0", set()),
    ],
)
def test_limits(run, cache, limit, left):
    assert run("cache", "--limit", limit).code == 0
    names = {name.split("/")[0] for name in files(cache) if ".run-" not in name and "/" in name}
    assert names == left


def test_refuses(run, cache):
    before = files(cache)
    for words, said in (
        (("--limit", "much"), "--limit must be a size such as 500MB"),
        (("--limit", "-1MB"), "--limit"),
        (("--limit", "nan"), "--limit must be a size"),
        (("--limit", "1MB", "--clear"), "give either --clear or --limit"),
        (("pictures",), "kinds"),
    ):
        answer = run("cache", *words)
        assert answer.code == 2 and said in answer.err, words
    assert files(cache) == before


def test_without_a_cache(run, monkeypatch, tmp_path):
    monkeypatch.setenv("DANO_CACHE_DIR", "off")
    answer = run("cache", "--clear")
    assert answer.code == 0 and "none: nothing is kept" in answer.out
    monkeypatch.setenv("DANO_CACHE_DIR", "/dev/null/cache")
    caches._none.cache_clear()
    answer = run("cache")
    caches._none.cache_clear()
    assert answer.code == 0
    assert answer.err.count("cannot be written") == 1
