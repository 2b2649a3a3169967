"""Stages that follow one another, each kept when it has ended, so that what is done is not done again.

What a stage was made of is remembered by the content of its files and by its choices, in one file beside the
results. A stage whose inputs are the same, and whose results are there, is taken up again.
"""

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dano.archive import write_json
from dano.cli._console import duration
from dano.names import did_you_mean

_BLOCK = 2**20
"""Bytes of a file that are read at a time."""

AGAIN = "Then run the same command again: what was done before is taken up"
"""What the advice of a stage ends with."""

Inputs = dict[str, str]
"""What a stage is made of: a fingerprint of each file, folder and choice, by its name."""


@dataclass(frozen=True)
class Stage:
    """A step of a longer piece of work that leaves files.

    Attributes:
        name: As `--from` and `--to` have it, and messages.
        what: What it does, for a line before it begins.
        files: Files, and folders of files, that it reads, by what they are called in messages. Folders need
            not be there.
        choices: Everything else that its results depend on, as JSON has it.
        outputs: Files that it writes, all of which are there when it has ended.
        make: Does it. Told whether to go on with what was interrupted, with the same inputs.
        advice: What to do if it fails.
        judge: Asked when it has ended, for a line about how good its results are, and whether to go on; None:
            nothing is said.
    """

    name: str
    what: str
    files: Mapping[str, Sequence[Path]]
    choices: Mapping[str, Any]
    outputs: Sequence[Path]
    make: Callable[[bool], object]
    advice: str
    judge: Callable[[], tuple[str, bool]] | None = None

    def inputs(self) -> Inputs:
        """Fingerprints of all that it is made of."""
        files = {label: _fingerprint(paths) for label, paths in self.files.items()}
        choices = {name: json.dumps(value, default=str) for name, value in self.choices.items()}
        return files | choices

    def missing(self) -> list[Path]:
        """Its results that are not there."""
        return [path for path in self.outputs if not path.exists()]


def run_stages(
    stages: Sequence[Stage],
    record: Path,
    *,
    first: str | None = None,
    last: str | None = None,
    force: bool = False,
    tell: Callable[[str], None],
    clock: Callable[[], float] = time.monotonic,
) -> list[str]:
    """Run stages in their order, and take up those again that were done before.

    Args:
        stages: All of them.
        record: File that remembers what stages were made of; it need not be there.
        first: Begin with this one: what comes before is taken as it is, this one and those after it are made
            again. None: make what is not there, or is of other inputs.
        last: Stop after this one; None: after all.
        force: Go on after a stage of which `judge` says not to.
        tell: Told in a line what becomes of each stage.
        clock: Gives the time [s].

    Returns:
        Names of the stages that were made.

    Raises:
        ValueError: If `first` or `last` is not a stage, they are in the wrong order, something before `first`
            is not there, a stage fails, or its results are too bad to go on; the message names the stage and
            says what to do.
    """
    begin, end = chosen(stages, first, last)
    known, made = _read(record), []
    for number, stage in enumerate(stages[: end + 1]):
        label = f"{stage.name} ({number + 1} of {len(stages)})"
        if first is not None and number < begin:
            _check_there(stage, stages[begin].name)
            tell(f"{label}: taken as it is")
            continue
        inputs, before = stage.inputs(), known.get(stage.name)
        if first is None and _is_done(stage, before, inputs):
            assert before is not None
            tell(f"{label}: taken up again, it took {duration(before['seconds'])} and nothing has changed")
            _judge(stage, label, force or number == end, tell)
            continue
        tell(f"{label}: {stage.what}{_because(stage, before, inputs)}")
        goes_on = before is not None and before["seconds"] is None and before["inputs"] == inputs
        _write(record, known, stage.name, inputs, None)
        began = clock()
        _make(stage, goes_on)
        seconds = clock() - began
        _write(record, known, stage.name, inputs, seconds)
        tell(f"{label}: done in {duration(seconds)}")
        made.append(stage.name)
        _judge(stage, label, force or number == end, tell)
    return made


def _judge(stage: Stage, label: str, goes_on: bool, tell: Callable[[str], None]) -> None:
    """Say how good the results of a stage are.

    Raises:
        ValueError: If they are too bad to go on, unless that is wished.
    """
    if stage.judge is None:
        return
    text, good = stage.judge()
    tell(f"{label}: {text}")
    if not good and not goes_on:
        raise ValueError(
            f"stage {stage.name}: {text}, what follows would be wrong. {stage.advice}; --force goes on anyway"
        )


def chosen(stages: Sequence[Stage], first: str | None, last: str | None) -> tuple[int, int]:
    """Which stages to begin and to end with, by number.

    Raises:
        ValueError: If a name is not that of a stage, or the last one comes before the first.
    """
    names = [stage.name for stage in stages]
    for option, name in (("from", first), ("to", last)):
        if name is not None and name not in names:
            raise ValueError(
                f"{option} must be one of {', '.join(names)}, got {name!r}{did_you_mean(name, names)}"
            )
    begin = 0 if first is None else names.index(first)
    end = len(names) - 1 if last is None else names.index(last)
    if end < begin:
        raise ValueError(f"from must not come after to, got {first!r} and {last!r} of {', '.join(names)}")
    return begin, end


def _check_there(stage: Stage, first: str) -> None:
    if missing := stage.missing():
        raise ValueError(
            f"from={first} needs what stage {stage.name} makes, but {missing[0]} is not there: leave out"
            f" --from, or say --from {stage.name}"
        )


def _is_done(stage: Stage, before: Mapping[str, Any] | None, inputs: Inputs) -> bool:
    if before is None or before["seconds"] is None:
        return False
    return before["inputs"] == inputs and not stage.missing()


def _because(stage: Stage, before: Mapping[str, Any] | None, inputs: Inputs) -> str:
    """Why a stage is made that was made before."""
    if before is None:
        return ""
    if before["seconds"] is None and before["inputs"] == inputs:
        return ", once more, because it did not end"
    was = before["inputs"]
    if changed := [name for name in inputs if was.get(name) != inputs[name]]:
        return f", once more, because of another {', '.join(changed)}"
    if missing := stage.missing():
        return f", once more, because {missing[0].name} is gone"
    return ", once more"


def _make(stage: Stage, goes_on: bool) -> None:
    try:
        stage.make(goes_on)
    except ImportError as error:
        raise ImportError(f"stage {stage.name}: {error}") from error
    except (ValueError, OSError, MemoryError) as error:
        said = " ".join(str(error).split()) or "out of memory"
        raise ValueError(f"stage {stage.name}: {said.rstrip('.')}. {stage.advice}") from error
    if missing := stage.missing():
        raise ValueError(f"stage {stage.name}: {missing[0]} was not written. {stage.advice}")


def _read(record: Path) -> dict[str, dict[str, Any]]:
    """What is remembered; nothing if the file is missing or broken, as everything can be made again."""
    try:
        content = json.loads(record.read_text(encoding="utf-8"))
        return {
            str(name): {"inputs": dict(row["inputs"]), "seconds": row["seconds"]}
            for name, row in content["stages"].items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _write(
    record: Path, known: dict[str, dict[str, Any]], name: str, inputs: Inputs, seconds: float | None
) -> None:
    """Remember a stage; `seconds` is None until it has ended."""
    known[name] = {"inputs": inputs, "seconds": seconds}
    write_json(record, {"stages": known})


def _fingerprint(paths: Iterable[Path]) -> str:
    """Of the names and the content of some files."""
    total = hashlib.blake2b(digest_size=16)
    for path in _files(paths):
        total.update(path.name.encode() + b"\0")
        with open(path, "rb") as file:
            while block := file.read(_BLOCK):
                total.update(block)
        total.update(b"\0")
    return total.hexdigest()


def _files(paths: Iterable[Path]) -> Iterable[Path]:
    """Those, and in place of folders what is in them."""
    for path in paths:
        if path.is_file():
            yield path
        else:
            yield from sorted(file for file in path.glob("*") if file.is_file())
