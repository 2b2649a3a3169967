"""`dano film`: all stages, one after the other, and what is said at the end."""

import contextlib
import dataclasses
import sys
import time
from typing import Any

from dano.cli._console import put, put_json, say
from dano.cli.film._after import stages_after
from dano.cli.film._arguments import Film, STAGES
from dano.cli.film._before import stages_before
from dano.cli.film._grades import DECIDING, Grade, grade_of, grades_of, verdict_of, write_verdict
from dano.cli.film._place import Place, place_of, read_json
from dano.cli.film._stages import chosen, run_stages, Stage


def film(command: Film) -> None:
    """See `dano film --help`."""
    began = time.monotonic()
    place = place_of(command)
    stages = [_judged(place, stage) for stage in (*stages_before(place), *stages_after(place))]
    chosen(stages, command.first, command.last)
    place.folder.mkdir(exist_ok=True)
    # What the stages print is not part of the object.
    with contextlib.redirect_stdout(sys.stderr) if command.json else contextlib.nullcontext():
        try:
            made = run_stages(
                stages,
                place.folder / "stages.json",
                first=command.first,
                last=command.last,
                force=command.force,
                tell=say,
            )
        except KeyboardInterrupt:
            raise KeyboardInterrupt("the same command, without --from, goes on from here") from None
    _tell(place, made, time.monotonic() - began)


def _judged(place: Place, stage: Stage) -> Stage:
    """A stage that says its number when it has ended."""

    def judge() -> tuple[str, bool]:
        grade = grade_of(place, stage.name)
        return f"{grade.what} {grade.text}", grade.mark != "poor"

    return dataclasses.replace(stage, judge=judge)


def _tell(place: Place, made: list[str], seconds: float) -> None:
    """What came out, and where it is."""
    grades: list[Grade] = []
    folder, output, last = place.folder, place.command.output, place.command.last
    result: dict[str, Any] = {"object": str(output), "folder": str(folder), "made": made, "seconds": seconds}
    if last is None or last in ("friction", "scene"):
        found = read_json(folder / "friction.json")
        (result["friction"],) = found["values"].values()
        (result["standard_error"],) = found["standard_errors"].values()
        verdict, grades = verdict_of(place), grades_of(place, STAGES[: STAGES.index(last or "scene") + 1])
        result["error"] = verdict.error
        result["grades"] = {grade.stage: grade.value for grade in grades}
        write_verdict(folder / "summary.html", place, grades, verdict)
        result["page"] = str(folder / "summary.html")
    if place.command.json:
        put_json(result)
        return
    put()
    if "friction" in result:
        error, stated = result["error"], result["standard_error"]
        narrow = "" if error is None or error < 1.05 * stated else f" (the fit alone: ± {stated:.4f})"
        put(f"friction    {result['friction']:.4f}" + ("" if error is None else f" ± {error:.4f}{narrow}"))
        for grade in grades:
            if grade.stage in DECIDING:
                put(f"{grade.stage:<11} {grade.what}: {grade.text}")
        put(f"look at     {folder / 'summary.html'}, and {folder / 'story.html'}: film beside simulation")
    if last in (None, "scene"):
        put(f"scene       {folder / 'scene.toml'}, for `dano simulate` and `dano view`")
    put(f"took {seconds:.0f} s; the same command takes up what is done")
