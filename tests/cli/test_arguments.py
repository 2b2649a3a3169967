"""Help, examples in it, and names of outputs that nobody gave."""

import os
from pathlib import Path

import pytest

from dano.cli._arguments import Simulate, Train, UNNAMED
from dano.cli._outputs import free_path, named
from dano.cli._parse import GROUPS, parse

ROWS = {name: row for group in GROUPS.values() for name, row in group.items()}


def output_of(command: object) -> Path:
    return vars(command)["output"]


@pytest.mark.parametrize("command", ROWS)
def test_examples_are_commands_and_stand_in_help(command, run):
    row = ROWS[command]
    words = row.example.split()
    assert words[:2] == ["dano", command]
    assert type(parse(words[1:])) is row.kind
    assert row.example in run("--help").out
    # Wrapped to the width of the terminal.
    assert row.example in " ".join(run(command, "--help").out.split())


def test_shells_complete_commands(run):
    answer = run("--tyro-print-completion", "bash")
    assert answer.code == 0
    assert all(command in answer.out for command in ROWS)


@pytest.mark.parametrize(
    ("words", "name"),
    [
        ("train shots/photos/", "photos.dano"),
        ("train shots/photos/transforms.json", "photos.dano"),
        ("train .", "here.dano"),
        ("simulate ../mug.dano", "mug_run.npz"),
        ("simulate scenes/drop.toml", "drop_run.npz"),
        ("build my_nerf.grid.npz", "my_nerf.dano"),
        ("import package.module:egg", "egg.grid.npz"),
        ("poses shots", "shots/transforms.json"),
        ("poses shots/images", "shots/transforms.json"),
        ("poses walk.mp4", "walk_transforms.json"),
        ("track throw.mp4 mug.dano", "throw_motion.npz"),
        ("plan scene.toml push.toml", "push_plan.npz"),
        ("export mug.dano", "mug_export"),
        ("compare mug.dano", "mug_meshes.html"),
    ],
)
def test_outputs_are_named_after_inputs(words, name, tmp_path, monkeypatch):
    here = tmp_path / "here"
    (here / "shots" / "images").mkdir(parents=True)
    monkeypatch.chdir(here)
    command = parse(words.split())
    assert output_of(command) is UNNAMED
    ready, line = named(command)
    assert (output_of(ready), line) == (Path(name), f"wrote {name}")
    assert output_of(parse([*words.split(), "-o", "x"])) == Path("x")


def test_what_is_there_is_kept(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for taken in ("mug_run.npz", "mug_run_2.npz", "photos.dano"):
        Path(taken).touch()
    ready, line = named(Simulate(Path("mug.dano")))
    assert output_of(ready) == Path("mug_run_3.npz")
    assert line == "wrote mug_run_3.npz, because mug_run.npz was there already"
    assert output_of(named(Train(Path("photos")))[0]) == Path("photos_2.dano")
    # A training that goes on has its checkpoint beside the first name.
    assert output_of(named(Train(Path("photos"), resume=True))[0]) == Path("photos.dano")
    os.symlink("nowhere", "link.npz")
    assert free_path(Path("link.npz")) == Path("link_2.npz")


def test_an_object_is_simulated_without_further_options(run, egg, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    answer = run("simulate", egg, "--steps", 5)
    assert answer.code == 0 and answer.err == "dano: wrote egg_run.npz\n"
    assert Path("egg_run.npz").exists()
