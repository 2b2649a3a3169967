"""Command lines that are wrong: files of another kind, words in place of numbers, outputs that cannot be."""

import contextlib
import io
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

from dano.cli import main
from tests.fuzz.judging import LIMIT, limited, LONGEST, Outcome, TookTooLongError
from tests.fuzz.world import World


@dataclass(frozen=True)
class Command:
    """A command line that would run, and what can be wrong with it.

    Attributes:
        words: The line; names of files are those in the folder of the world.
        inputs: Which words are files or folders to read.
        outputs: Options that name a file to write, and how it must end.
        numbers: Options that take a number, and numbers that each must refuse.
        choices: Options that take one of a few words.
    """

    words: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: Mapping[str, str] = field(default_factory=dict)
    numbers: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    choices: tuple[str, ...] = ()


POSITIVE = ("0", "-1", "nan", "inf", "many", "1e400")
COUNT = ("0", "-1", "2.5", "nan", "many")
LENGTHS = ("-1", "nan", "inf", "many")
CAMERA = ("--focal", "100", "--eye", "0", "-1", "1")
COMMANDS = (
    Command(
        ("build", "field.npz", "-o", "new.dano"),
        ("field.npz",),
        {"-o": ".dano"},
        {
            "--samples": (*COUNT, "100000000"),
            "--resolution": (*COUNT, "1", "100000"),
            "--mass": POSITIVE,
            "--mass-scale": POSITIVE,
            "--length": POSITIVE,
            "--seed": ("2.5", "many"),
        },
        ("--mass-model",),
    ),
    Command(
        ("import", "field.npz", "-o", "new.npz"),
        ("field.npz",),
        {"-o": ".npz"},
        {"--scale": POSITIVE, "--resolution": COUNT, "--crop": ("1 1 1 0 0 0", "1 2", "nan nan nan 1 1 1")},
        ("--interpolation",),
    ),
    Command(("inspect", "thing.dano", "--png", "new.png"), ("thing.dano",), {"--png": ".png"}),
    Command(
        ("simulate", "scene.toml", "-o", "new.npz"),
        ("scene.toml",),
        {"-o": ".npz", "--video": ".mp4", "--strip": ".png"},
        {"--steps": (*COUNT, "100000000000"), "--timestep": POSITIVE, "--slow-motion": POSITIVE},
    ),
    Command(
        ("simulate", "scene.toml", "other.toml", "-o", "pair"),
        ("scene.toml", "other.toml"),
        {"--video": ".mp4", "--strip": ".png"},
        {"--steps": (*COUNT, "100000000000"), "--timestep": POSITIVE, "--slow-motion": POSITIVE},
        ("--camera",),
    ),
    Command(("check", "scene.toml"), ("scene.toml",), {}, {"--steps": COUNT, "--timestep": POSITIVE}),
    Command(
        ("identify", "scene.toml", "motion.npz", "-p", "ball,floor.sliding_friction:0:1", "-o", "new.json"),
        ("scene.toml", "motion.npz"),
        {"-o": ".json", "--report": ".html"},
        {
            "-p": ("ball", "ball.mass:1:0", "wall.mass:0:1", "ball.colour:0:1", "ball.mass:a:b"),
            "--starts": (*COUNT, "1000000"),
            "--window": (*COUNT, "1"),
            "--huber": POSITIVE,
            "--position-noise": POSITIVE,
            "--rotation-noise": POSITIVE,
            "--timestep": POSITIVE,
        },
        ("--initial", "--order", "--point"),
    ),
    Command(
        ("plan", "scene.toml", "task.toml", "-o", "new.npz"),
        ("scene.toml", "task.toml"),
        {"-o": ".npz", "--video": ".mp4", "--strip": ".png", "--controls": ".png"},
        {"--slow-motion": POSITIVE},
        ("--method",),
    ),
    Command(("view", "run.npz"), ("run.npz",), {}, {"--port": ("0", "-1", "70000", "http")}),
    Command(
        ("export", "thing.dano", "-o", "new"),
        ("thing.dano",),
        {},
        {
            "--concavity": (*POSITIVE, "2"),
            "--max-pieces": COUNT,
            "--resolution": (*COUNT, "1"),
            "--texture-size": (*COUNT, "1"),
            "--friction": LENGTHS,
            "--restitution": (*LENGTHS, "2"),
            "--name": ("../outside", "a.b", "3"),
        },
        ("--to", "--collision"),
    ),
    Command(
        ("compare", "thing.dano", "-o", "new.html"),
        ("thing.dano",),
        {"-o": ".html"},
        {"--drops": (*COUNT, "1000"), "--levels": ("-1", "nan", "1e9"), "--truth-scale": POSITIVE},
    ),
    Command(
        ("train", "photos", "-o", "new.dano"),
        ("photos",),
        {"-o": ".dano"},
        {
            "--resolution": (*COUNT, "1"),
            "--iterations": COUNT,
            "--batch": (*COUNT, "1"),
            "--seconds": POSITIVE,
            "--downscale": COUNT,
            "--mass": POSITIVE,
            "--mass-density": POSITIVE,
        },
    ),
    Command(("data", "photos"), ("photos",), {"--png": ".png"}, {"--downscale": COUNT}),
    Command(
        ("poses", "photos", "-o", "new.json"),
        ("photos",),
        {"-o": ".json"},
        {
            "--marker-size": POSITIVE,
            "--focal": POSITIVE,
            "--features": (*COUNT, "1"),
            "--frames": (*COUNT, "1"),
            "--model": COUNT,
            "--length": POSITIVE,
        },
        ("--features-on", "--up", "--lens", "--marker-family"),
    ),
    Command(("track", "film.mp4", "trained_soap", "-o", "new.npz", *CAMERA), ("film.mp4",)),
    Command(
        ("track", "frames", "trained_soap", "-o", "new.npz", *CAMERA, "--rate", "30"),
        ("frames",),
        {"-o": ".npz", "--report": ".html"},
        {
            "--focal": POSITIVE,
            "--rate": POSITIVE,
            "--every": COUNT,
            "--slow-motion": POSITIVE,
            "--rays": COUNT,
        },
        ("--loss", "--mask-source"),
    ),
    Command(("demo", "-o", "new"), (), {}, {}, ("",)),
)


def tried_commands(world: World) -> Iterator[Outcome]:
    """All command lines."""
    with contextlib.chdir(world.folder):
        hostile = _hostile(world)
        for command in COMMANDS:
            for case, words, says in _cases(command, hostile):
                yield _judged(case, words, says, world.folder)
        yield _judged("dano nonsense", ("nonsense",), "nonsense", world.folder)


def _hostile(world: World) -> dict[str, bytes]:
    """Contents that no file of dano's has, by what they are; and the good files, in the folder."""
    for name in ("field.npz", "thing.dano", "motion.npz", "scene.toml", "scene_run.npz"):
        world.saved(name)
    (world.folder / "scene_run.npz").rename(world.folder / "run.npz")
    shutil.copy(world.folder / "scene.toml", world.folder / "other.toml")
    (world.folder / "task.toml").write_text("[[goals]]\nbody = 'wall'\n", encoding="utf-8")
    (world.folder / "film.mp4").write_bytes(b"no film")
    (world.folder / "photos").mkdir()
    (world.folder / "frames").mkdir()
    for i in range(6):
        Image.new("RGB", (64, 48), (200, 200, 10 * i)).save(world.folder / "frames" / f"{i}.png")
    pickled, lying = io.BytesIO(), io.BytesIO()
    np.savez(pickled, format=np.array({"a": 1}, dtype=object))
    np.savez(lying, values=np.zeros(3))
    whole = (world.folder / "thing.dano").read_bytes()
    return {
        "empty": b"",
        "noise": bytes(np.random.default_rng(0).integers(0, 256, 5000, np.uint8)),
        "cut off": whole[: len(whole) // 2],
        "pickle": b"\x80\x04\x95\x10\x00\x00\x00\x00\x00\x00\x00\x8c\x05posix.",
        "pickled array": pickled.getvalue(),
        "another archive": lying.getvalue(),
        "no text": b"\xff\xfe\x00name = 3",
    }


def _cases(command: Command, hostile: Mapping[str, bytes]) -> Iterator[tuple[str, tuple[str, ...], str]]:
    """Command lines that are wrong in one place: what is wrong, the words, and what must be said."""
    verb = command.words[0]
    if command.inputs:
        yield f"dano {verb} (nothing)", (verb,), verb
    yield f"dano {verb} --nonsense", (*command.words, "--nonsense"), "--nonsense"
    for given in command.inputs:
        suffix = Path(given).suffix
        for what in ("missing", "folder", *(hostile if suffix else ())):
            bad = Path(f"bad_{what.replace(' ', '_')}{suffix}")
            if what == "folder":
                bad.mkdir(exist_ok=True)
            elif what != "missing":
                bad.write_bytes(hostile[what])
            words = tuple(str(bad) if word == given else word for word in command.words)
            yield f"dano {verb} {given}: {what}", words, bad.name
    for option, suffix in command.outputs.items():
        taken = Path(f"taken{suffix}")
        taken.mkdir(exist_ok=True)
        for what, bad in (("folder", taken), ("no folder", Path("nowhere") / f"a{suffix}")):
            yield f"dano {verb} {option}: {what}", _with(command.words, option, str(bad)), bad.name
    for option, values in command.numbers.items():
        for value in values:
            says = "" if option == "-p" else option.strip("-").split("-")[-1]
            yield f"dano {verb} {option} {value}", _with(command.words, option, *value.split()), says
    for option in command.choices:
        yield f"dano {verb} {option} nonsense", _with(command.words, option, "nonsense"), "nonsense"


def _with(words: tuple[str, ...], option: str, *values: str) -> tuple[str, ...]:
    """The words with an option set, or at the end."""
    if option and option in words:
        place = words.index(option)
        return (*words[: place + 1], *values, *words[place + 2 :])
    return (*words, *([option] if option else []), *values)


def _judged(case: str, words: tuple[str, ...], says: str, folder: Path) -> Outcome:
    """Run a command line; a clear answer is one line with code 2, and nothing is written."""
    before = _held(folder)
    out, err = io.StringIO(), io.StringIO()
    code: object = 0
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), limited():
            main(list(words))
    except SystemExit as stop:
        code = stop.code
    except TookTooLongError:
        return Outcome(case, "silently wrong", f"worked for {LIMIT} s")
    except BaseException as error:  # whatever it is: it is what the user would see
        return Outcome(case, "traceback", f"{type(error).__name__}: {error}".splitlines()[0])
    lines = [line for line in err.getvalue().splitlines() if not line.startswith("dano: warning: ")]
    told = " | ".join(lines) or f"code {code}: {out.getvalue()[:80]!r}"
    if changed := before.items() ^ _held(folder).items():
        return Outcome(case, "silently wrong", f"wrote {sorted({name for name, _ in changed})}: {told}")
    if code == 0:
        return Outcome(case, "silently wrong", told)
    clear = (
        code == 2
        and out.getvalue() == ""
        and len(lines) == 1
        and lines[0].startswith("dano: error: ")
        and len(lines[0]) <= LONGEST
        and says in lines[0]
    )
    return Outcome(case, "clear" if clear else "unclear", told)


def _held(folder: Path) -> dict[str, tuple[int, int]]:
    """What is in a folder: sizes and times of all files."""
    found = {}
    for path in folder.rglob("*"):
        stat = path.stat()
        found[str(path.relative_to(folder))] = (0, 0) if path.is_dir() else (stat.st_size, stat.st_mtime_ns)
    return found
