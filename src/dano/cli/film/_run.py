"""`dano film`: all stages, one after the other, and what is said at the end."""

import contextlib
import sys
import time
from typing import Any

from dano.cli._console import put, put_json, say
from dano.cli.film._after import stages_after
from dano.cli.film._arguments import Film
from dano.cli.film._before import stages_before
from dano.cli.film._place import Place, place_of, read_json
from dano.cli.film._stages import chosen, run_stages


def film(command: Film) -> None:
    """See `dano film --help`."""
    began = time.monotonic()
    place = place_of(command)
    stages = [*stages_before(place), *stages_after(place)]
    chosen(stages, command.first, command.last)
    place.folder.mkdir(exist_ok=True)
    # What the stages print is not part of the object.
    with contextlib.redirect_stdout(sys.stderr) if command.json else contextlib.nullcontext():
        try:
            made = run_stages(
                stages, place.folder / "stages.json", first=command.first, last=command.last, tell=say
            )
        except KeyboardInterrupt:
            raise KeyboardInterrupt("the same command, without --from, goes on from here") from None
    _tell(place, made, time.monotonic() - began)


def _tell(place: Place, made: list[str], seconds: float) -> None:
    """What came out, and where it is."""
    folder, output, last = place.folder, place.command.output, place.command.last
    result: dict[str, Any] = {"object": str(output), "folder": str(folder), "made": made, "seconds": seconds}
    if last is None or last in ("friction", "scene"):
        found = read_json(folder / "friction.json")
        (result["friction"],) = found["values"].values()
        (result["standard_error"],) = found["standard_errors"].values()
    if place.command.json:
        put_json(result)
        return
    put()
    if "friction" in result:
        error = result["standard_error"]
        put(f"friction    {result['friction']:.4f}" + ("" if error is None else f" ± {error:.4f}"))
        put(f"look at     {folder / 'story.html'}: the film beside the simulation")
    if last in (None, "scene"):
        put(f"scene       {folder / 'scene.toml'}, for `dano simulate` and `dano view`")
    put(f"took {seconds:.0f} s; the same command takes up what is done")
