"""`dano plan`."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from dano import scene_file
from dano.checks import checked_number
from dano.cli._arguments import PlanTask
from dano.cli._console import ProgressLine, put, put_json, say
from dano.cli._interrupt import interrupted
from dano.cli._outputs import check_distinct, check_output, missing_for_pictures
from dano.planning import Plan as Planned, plan as find_plan


def plan(command: PlanTask) -> None:
    """See `dano plan --help`."""
    pictures = {"video": command.video, "strip": command.strip, "controls": command.controls}
    check_output(command.output, command.scene, command.task, suffix=".npz")
    for name, path in pictures.items():
        if path is not None:
            check_output(path, command.scene, command.task, suffix=".mp4" if name == "video" else ".png")
            if missing := missing_for_pictures(video=name == "video"):
                raise ImportError(missing)
    check_distinct(output=command.output, **pictures)
    checked_number("slow_motion", command.slow_motion, above=0)
    # An interrupted search returns its best so far.
    progress = ProgressLine(stops=False)
    loaded = scene_file.load_scene(command.scene, progress=progress)
    given = scene_file.load_task(command.task, loaded.scene)
    found = _found(loaded, given, command, progress)
    progress.close()
    source = {"scene": loaded.text, "path": str(loaded.path.resolve()), "task": given.text}
    found.save(command.output, source=json.dumps(source))
    stopped = interrupted()
    files = {"plan": command.output} | ({} if stopped else _drawn(loaded, given, found, command, progress))
    if command.json:
        put_json(_numbers(found, command))
    else:
        put(found.describe())
        put()
        for label, path in files.items():
            put(f"{label:<10}  {path}")
    if stopped:
        raise KeyboardInterrupt("the plan is the best so far")
    if not found.reached:
        say("warning: the plan does not reach all that is required")


def _found(loaded, given, command: PlanTask, progress: ProgressLine) -> Planned:
    options = given.options
    most = options.ilqr.max_iterations * options.ilqr.max_updates

    def tell(stage: str, iteration: int, cost: float) -> bool:
        whole = options.sampling.passes if stage == "sampling" else most
        progress(f"{stage}, cost {cost:.3g}", iteration / whole)
        return interrupted()

    return find_plan(
        loaded.scene,
        loaded.state,
        given.task,
        method=command.method or given.method,
        controls=given.controls,
        options=options,
        callback=tell,
    )


def _drawn(loaded, given, found: Planned, command: PlanTask, progress: ProgressLine) -> dict[str, Path]:
    """The pictures that were asked for."""
    files: dict[str, Path] = {}
    if command.video is not None or command.strip is not None:
        from dano.report import film_plan, PLAN_VIDEO

        film_plan(
            loaded.scene,
            given.task,
            found,
            command.video,
            strip=command.strip,
            looks=loaded.looks(),
            options=dataclasses.replace(PLAN_VIDEO, slow_motion=command.slow_motion),
            progress=progress,
        )
        named = {"video": command.video, "strip": command.strip}
        files |= {name: path for name, path in named.items() if path is not None}
    if command.controls is not None:
        from dano.report import draw_controls

        draw_controls(given.task, found, command.controls)
        files["controls"] = command.controls
    progress.close()
    return files


def _numbers(found: Planned, command: PlanTask) -> dict[str, Any]:
    return {
        "scene": str(command.scene),
        "task": str(command.task),
        "reached": found.reached,
        "message": found.message,
        "method": found.method,
        "cost": found.cost,
        "seconds": found.seconds,
        "iterations": None if found.solution is None else found.solution.iterations,
        "goals": [{**goal._asdict(), "reached": goal.reached} for goal in found.goals],
        "limits": [{"name": name, "excess": excess, "step": step} for name, excess, step in found.limits],
        "steps": len(found.values),
        "unsolved_steps": int(np.sum(~np.asarray(found.trajectory.converged))),
    }
