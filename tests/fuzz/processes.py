"""Commands that are stopped, killed, starved of disk, or not alone: nothing is lost, nothing half written."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import dano
from tests.fuzz.judging import Outcome
from tests.fuzz.world import World

PRECIOUS = b"what stood there before"
PROGRAM = """
import resource, signal, sys
# A shell that runs this in its background has interrupts ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
limit = int(sys.argv.pop(1))
if limit >= 0:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
sys.argv[0] = "dano"
from dano_start import main
print("started", file=sys.stderr, flush=True)
main()
"""
CACHE = tempfile.mkdtemp(prefix="dano-tests-")
"""What commands compile is compiled once."""
WAIT = 240
"""Seconds after which a command counts as hanging."""
MOMENTS = (0.2, 1.0, 2.0, 4.0, 7.0, 11.0)
"""Seconds after its start at which a command is stopped: it starts, reads, compiles, simulates, writes."""


def tried_processes(world: World) -> Iterator[Outcome]:
    """Signals at several moments, kill −9 during a write, full disks, two processes with one output."""
    scene = world.saved("scene.toml")
    text = scene.read_text(encoding="utf-8").replace("n_steps = 4", "n_steps = 30000")
    scene.write_text(text, encoding="utf-8")
    for number in (signal.SIGINT, signal.SIGTERM):
        for moment in MOMENTS:
            yield _stopped(world.folder, number, moment)
    yield _killed_in_a_write(world)
    for size in (0, 4096, 100_000):
        yield _full_disk(world, size)
    yield from _read_only(world)
    yield _two_at_once(world)


def _start(folder: Path, *words: str, limit: int | None = None) -> subprocess.Popen[str]:
    """A command in a process of its own; `limit`: largest file that it may write [bytes]."""

    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(-1 if limit is None else limit), *words],
        cwd=folder,
        env={**os.environ, "DANO_CACHE_DIR": CACHE, "PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    assert process.stderr.readline() == "started\n"
    return process


def _left(folder: Path) -> list[str]:
    """What is left of unfinished writes."""
    return sorted(path.name for path in folder.rglob("*.part"))


def _one_line(err: str, says: str) -> bool:
    """Whether an error is one line that names what it is about; lines of progress do not count."""
    lines = [line for line in err.splitlines() if not line.endswith(" %") and " s left" not in line]
    return len(lines) == 1 and lines[0].startswith("dano: error: ") and says in lines[0]


def _ended(case: str, process: subprocess.Popen[str], good: Callable[[int, str, str], str]) -> Outcome:
    """Wait for a command; `good` says what is wrong with code, stdout and stderr, nothing if all is well."""
    try:
        out, err = process.communicate(timeout=WAIT)
    except subprocess.TimeoutExpired:
        process.kill()
        return Outcome(case, "silently wrong", f"ran for more than {WAIT} s")
    told = err.strip().replace("\n", " | ")[-300:]
    if "Traceback" in err:
        return Outcome(case, "traceback", told)
    wrong = good(process.returncode, out, err)
    return Outcome(case, "silently wrong" if wrong else "clear", f"{wrong}: {told}" if wrong else told)


def _stopped(folder: Path, number: signal.Signals, moment: float) -> Outcome:
    """A signal at some moment: the old output stays, or the new one is whole."""
    output = folder / "stopped.npz"
    output.write_bytes(PRECIOUS)
    process = _start(folder, "simulate", "scene.toml", "-o", output.name)
    time.sleep(moment)
    process.send_signal(number)

    def wrong(code: int, out: str, err: str) -> str:
        if code not in (0, 130):
            return f"ended with code {code}"
        if left := _left(folder):
            return f"left {left}"
        if output.read_bytes() != PRECIOUS:
            dano.Trajectory.load(output)
        return ""

    return _ended(f"simulate, {number.name} after {moment} s", process, wrong)


def _killed_in_a_write(world: World) -> Outcome:
    """SIGKILL while a file is written: the old file stays, and the next command works."""
    case, path = "kill -9 in the middle of a write", world.folder / "killed.npz"
    path.write_bytes(PRECIOUS)
    program = (
        "import os, signal, sys; from dano.archive import replacing\n"
        "with replacing(sys.argv[1]) as file:\n"
        "    file.write(b'half'); file.flush(); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", program, str(path)], check=False, capture_output=True)
    if path.read_bytes() != PRECIOUS:
        return Outcome(case, "silently wrong", "the old file is gone")
    for part in world.folder.glob("*.part"):
        part.unlink()
    for part in world.folder.glob(".*.part"):
        part.unlink()
    world.trajectory.save(path)
    return Outcome(
        case, "clear", f"the old file stayed, {len(dano.Trajectory.load(path).times)} states after"
    )


def _full_disk(world: World, size: int) -> Outcome:
    """No file may grow beyond some bytes: one line, code 2, the old file stays."""
    world.saved("field.npz")
    output = world.folder / "full.dano"
    output.write_bytes(PRECIOUS)
    process = _start(world.folder, "build", "field.npz", "-o", output.name, "--mass", "1", limit=size)

    def wrong(code: int, out: str, err: str) -> str:
        if code != 2 or not _one_line(err, output.name):
            return f"ended with code {code}"
        if output.read_bytes() != PRECIOUS:
            return "the old file is gone"
        return f"left {left}" if (left := _left(world.folder)) else ""

    return _ended(f"build, files of at most {size} bytes", process, wrong)


def _read_only(world: World) -> Iterator[Outcome]:
    """Where nothing can be written, whoever asks."""
    for place in ("/proc/dano.npz", "/sys/dano.npz", "/dev/full"):
        process = _start(world.folder, "build", "field.npz", "-o", place, "--mass", "1", "--samples", "50")

        def wrong(code: int, out: str, err: str, place: str = place) -> str:
            return "" if code == 2 and _one_line(err, place) else f"ended with code {code}"

        yield _ended(f"build -o {place}", process, wrong)


def _two_at_once(world: World) -> Outcome:
    """Two commands with one output: one of their results, whole."""
    case, output = "two processes with one output", world.folder / "both.dano"
    words = ("build", "field.npz", "-o", output.name, "--mass", "1", "--samples", "200")
    both = [_start(world.folder, *words) for _ in range(2)]
    codes = [process.wait(WAIT) for process in both]
    for process in both:
        process.communicate()
    if codes != [0, 0] or _left(world.folder):
        return Outcome(case, "silently wrong", f"codes {codes}, left {_left(world.folder)}")
    return Outcome(case, "clear", f"{len(dano.NeuralObject.load(output).samples.points)} samples")
