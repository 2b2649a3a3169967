"""Bad fields, files and options: one line on stderr, code 2, and nothing written or destroyed."""

import io
import os
import shutil
import socket
import stat
import threading
import zipfile
from pathlib import Path

import numpy as np
import pytest

from dano.archive import replacing

ORIGIN, SPACING = np.zeros(3), np.asarray(0.01)


def write_field(path: Path, values: np.ndarray) -> Path:
    np.savez(path, values=values, origin=ORIGIN, spacing=SPACING)
    return path


def ball() -> np.ndarray:
    x = np.stack(np.meshgrid(*(np.arange(10) - 4.5,) * 3, indexing="ij"), axis=-1)
    return 100.0 * (np.linalg.norm(x, axis=-1) < 3.5)


def spoilt(value: float) -> np.ndarray:
    values = ball()
    values[5, 5, 5] = value
    return values


FIELDS = {
    "NaN": (spoilt(np.nan), (), "finite"),
    "infinite": (spoilt(np.inf), (), "finite"),
    "negative": (spoilt(-1.0), (), "≥ 0"),
    "empty": (np.zeros((10, 10, 10)), (), "zero"),
    "flat": (np.zeros((10, 10)), (), "(nx, ny, nz)"),
    "range above": (ball(), ("--density-range", "1e5", "2e5"), "density_range"),
    "range reversed": (ball(), ("--density-range", "60", "40"), "density_range"),
    "no samples": (ball(), ("--samples", "0"), "n_samples must be ≥ 1"),
    "coarse": (ball(), ("--resolution", "1"), "resolution must be ≥ 4"),
    "many samples": (ball(), ("--samples", "100000000"), "samples must be at most 200000, got 100000000"),
    "fine": (ball(), ("--resolution", "100000"), "here, got 100000, which needs 1.36e+05 TiB of memory"),
    "no mass": (ball(), ("--mass", "0"), "> 0 kg, got 0"),
    "mass twice": (ball(), ("--mass", "1", "--mass-scale", "1"), "--mass"),
    "no length": (ball(), ("--length", "-1"), "length must be finite and > 0"),
}


def assert_refused(answer, message: str, folder: Path, files: dict[str, bytes]) -> None:
    assert answer.code == 2
    assert answer.out == ""
    assert answer.err.startswith("dano: error: ")
    assert answer.err.count("\n") == 1
    assert message in answer.err
    assert {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()} == files


@pytest.mark.parametrize("case", FIELDS)
def test_bad_fields(case, run, tmp_path):
    values, options, message = FIELDS[case]
    path = write_field(tmp_path / "field.npz", values)
    # What stands there already must survive.
    (tmp_path / "out.dano").write_bytes(b"precious")
    files = {"field.npz": path.read_bytes(), "out.dano": b"precious"}
    answer = run(
        "build", path, "-o", tmp_path / "out.dano", "--resolution", "10", "--samples", "50", *options
    )
    assert_refused(answer, message, tmp_path, files)


@pytest.mark.parametrize("command", ["build", "inspect", "simulate", "view"])
@pytest.mark.parametrize("kind", ["missing", "folder", "truncated", "foreign", "bare", "pickled"])
def test_bad_input_files(command, kind, run, egg, tmp_path):
    source = (
        tmp_path / {"build": "in.npz", "inspect": "in.dano", "simulate": "in.dano", "view": "in.npz"}[command]
    )
    if kind == "folder":
        source.mkdir()
    elif kind == "truncated":
        source.write_bytes(egg.read_bytes()[:3000])
    elif kind == "foreign":
        source.write_bytes(b"PK\x03\x04 not really a zip of arrays")
    elif kind == "bare":
        np.save(tmp_path / "bare.npy", np.arange(3))
        (tmp_path / "bare.npy").rename(source)
    elif kind == "pickled":
        with open(source, "wb") as file:
            np.savez(file, format=np.array({"a": 1}, dtype=object), values=np.array([None]))
    files = {} if kind in ("missing", "folder") else {source.name: source.read_bytes()}
    out = [] if command in ("inspect", "view") else ["-o", tmp_path / "out.npz"]
    assert_refused(run(command, source, *out), source.name, tmp_path, files)


def test_one_kind_for_another(run, egg, field, scene, tmp_path):
    # Of a field an object is built, and that is said.
    answer = run("inspect", field, "--no-png")
    assert answer.code == 0 and "an object was built of it with defaults" in answer.err
    missing = egg.with_suffix(".toml")
    answer = run("simulate", missing, "-o", tmp_path / "run.npz")
    assert answer.code == 2 and missing.name in answer.err
    assert list(tmp_path.iterdir()) == [scene]
    robot = tmp_path / "arm.urdf"
    robot.write_text('<robot name="r"><link name="a"/></robot>')
    answer = run("simulate", robot)
    assert answer.code == 2 and "is a robot's file, not an object: `dano inspect" in answer.err
    robot.unlink()
    for word in ("simulate", "inspect"):
        answer = run(word, "bunn")
        assert answer.code == 2 and "did you mean 'bunny'?" in answer.err
    assert list(tmp_path.iterdir()) == [scene]


def test_bad_outputs(run, egg, field, scene, tmp_path):
    copy = Path(shutil.copy(field, tmp_path / "field.npz"))
    (tmp_path / "folder").mkdir()
    files = {path.name: path.read_bytes() for path in (copy, scene)}
    bad = {
        tmp_path / "folder": "must be a file",
        tmp_path / "nowhere" / "out": "existing directory",
        copy: "must not be the input",
    }
    for output, message in bad.items():
        assert_refused(run("build", copy, "-o", output), message, tmp_path, files)
    for output, message in list(bad.items())[:2]:
        assert_refused(run("simulate", scene, "-o", output), message, tmp_path, files)
        assert_refused(run("inspect", egg, "--png", output), message, tmp_path, files)
    for option, name, message in (
        ("--video", "run.gif", "must end in .mp4"),
        ("--strip", "run.jpg", "must end in .png"),
        ("--video", "folder", "must be a file"),
    ):
        answer = run("simulate", scene, "-o", tmp_path / "run.npz", option, tmp_path / name)
        assert_refused(answer, message, tmp_path, files)
    assert_refused(run("demo", "-o", copy), "must be a folder", tmp_path, files)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--steps", "0"), "n_steps must be ≥ 1, got 0"),
        (("--timestep", "0"), "timestep must be finite and > 0 s, got 0.0"),
        (("--timestep", "nan"), "timestep must be finite and > 0 s, got nan"),
        (("--slow-motion", "0"), "slow_motion must be finite and > 0, got 0.0"),
        (("--slow-motion", "1e9", "--video", "RUN.mp4"), "slow_motion must be at most 4.17e+03, so that"),
        (("--steps", "100000000000"), "steps of 2 bodies, got 1e+11 of 0.002 s"),
    ],
)
@pytest.mark.filterwarnings("ignore:timestep 2.5 s is long")
def test_bad_options(options, message, run, scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    files = {scene.name: scene.read_bytes()}
    answer = run("simulate", scene, "-o", tmp_path / "run.npz", *options)
    assert_refused(answer, message, tmp_path, files)


def test_pictures_without_their_packages(run, egg, scene, tmp_path, monkeypatch):
    monkeypatch.setattr("dano.cli._outputs.is_installed", lambda name: False)
    files = {scene.name: scene.read_bytes()}
    answer = run("simulate", scene, "-o", tmp_path / "run.npz", "--video", tmp_path / "run.mp4")
    assert_refused(answer, "pip install 'dano[view]'", tmp_path, files)
    assert_refused(run("inspect", egg, "--png", tmp_path / "a.png"), "dano[view]", tmp_path, files)
    # Not asked for, not missed.
    answer = run("inspect", egg)
    assert answer.code == 0
    assert "warning: not drawn" in answer.err


@pytest.fixture
def pipe(tmp_path):
    """A named pipe, what has arrived in it, and its reader, which ends when it has been written to."""
    path, arrived = tmp_path / "pipe", []
    os.mkfifo(path)
    reader = threading.Thread(target=lambda: arrived.append(path.read_bytes()), daemon=True)
    reader.start()
    return path, arrived, reader


def test_a_pipe_is_written_to_and_stays(run, field, pipe):
    path, arrived, reader = pipe
    assert run("build", field, "-o", path, "--samples", 50, "--resolution", 12, "--mass", 1).code == 0
    reader.join(timeout=10)
    assert stat.S_ISFIFO(path.stat().st_mode)
    with zipfile.ZipFile(io.BytesIO(arrived[0])) as archive:
        assert archive.testzip() is None


def test_a_link_stays_and_what_it_leads_to_is_replaced(tmp_path):
    (tmp_path / "folder").mkdir()
    link, file = tmp_path / "link", tmp_path / "folder" / "file"
    for old in (None, b"old"):
        if old is not None:
            file.write_bytes(old)
        else:
            link.symlink_to(file)
        with replacing(link) as stream:
            stream.write(b"new")
        assert link.is_symlink()
        assert file.read_bytes() == b"new"


def test_a_socket_is_refused(run, field, tmp_path, monkeypatch):
    # Paths of sockets must be short.
    monkeypatch.chdir(tmp_path)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind("s")
        answer = run("build", field, "-o", "s")
    assert (answer.code, answer.err.count("\n")) == (2, 1)
    assert "must be a file, a character device or a pipe, got the socket s" in answer.err


def test_outputs_must_differ_from_each_other_and_from_what_is_read(run, egg, scene, tmp_path):
    copy = Path(shutil.copy(egg, tmp_path / "egg.mp4"))
    scene.write_text(scene.read_text().replace(str(egg), copy.name))
    files = {path.name: path.read_bytes() for path in (copy, scene)}
    for options, message in (
        (
            ("-o", tmp_path / "a.mp4", "--video", tmp_path / "." / "a.mp4"),
            "output and video must be different",
        ),
        (("-o", tmp_path / "a.png", "--strip", tmp_path / "a.png"), "output and strip must be different"),
        (("-o", copy), "must not be the input"),
        (("-o", tmp_path / "a.npz", "--video", copy), "must not be the input"),
    ):
        assert_refused(run("simulate", scene, *options), message, tmp_path, files)
