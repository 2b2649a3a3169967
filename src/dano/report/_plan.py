"""Pictures of plans: a film with ghosts where the goals are, and the controls over time."""

import os
from collections.abc import Mapping

import numpy as np

from dano.archive import checked_output, replacing
from dano.checks import checked_kind
from dano.planning import Plan, Task
from dano.progress import Progress
from dano.report._stage import frame_times, PictureStage, stage
from dano.report._video import check_film, checked_video, film, require, take_of, VideoOptions
from dano.scene import Scene
from dano.vision import Item, LearnedField

PLAN_VIDEO = VideoOptions(camera="fixed", contact_points=False, clock=False)
"""Of plans: nothing but bodies and ghosts, all in view all the time."""


def film_plan(
    scene: Scene,
    task: Task,
    plan: Plan,
    path: str | os.PathLike[str] | None = None,
    *,
    strip: str | os.PathLike[str] | None = None,
    looks: Mapping[str, LearnedField] | None = None,
    options: VideoOptions | None = None,
    progress: Progress | None = None,
) -> None:
    """Film a plan, with a ghost of every body at the position or orientation that its goals ask for.

    Args:
        scene: The scene.
        task: Whose goals are shown.
        plan: The plan.
        path: The video (.mp4), or None.
        strip: A picture of some moments (.png), or None.
        looks: What bodies have learned to look like, by name.
        options: How the film looks; default `PLAN_VIDEO`.
        progress: Called with a description and the share done.

    Raises:
        ValueError: If the plan is of another scene, a number is out of range, or neither output is given or
            one cannot be written.
        ImportError: If av or pillow is missing.
    """
    checked_kind("scene", scene, Scene)
    checked_kind("task", task, Task)
    checked_kind("plan", plan, Plan)
    options = checked_video(options, PLAN_VIDEO)
    outputs = check_film([(scene, plan.trajectory)], path, strip, options, progress)
    count = len(frame_times(plan.trajectory, options.fps, options.slow_motion))
    drawn = stage(scene, options.colours, looks)
    take = take_of(scene, plan.trajectory, drawn, count, options)
    film([take._replace(ghosts=_ghosts(scene, task, plan, drawn))], options, outputs, progress)


def _ghosts(scene: Scene, task: Task, plan: Plan, drawn: PictureStage) -> list[Item]:
    """The bodies that a goal places, where it wants them; what it leaves open is as at the plan's end."""
    position = np.array(plan.trajectory.states.position[-1], dtype=float)
    orientation = np.array(plan.trajectory.states.orientation[-1], dtype=float)
    placed = set()
    for goal in task.goals:
        row = scene.index(goal.body)
        if goal.quantity == "position":
            axes = ["xyz".index(axis) for axis in goal.axes]
            position[row, axes] = np.asarray(goal.value)[axes]
        elif goal.quantity == "orientation" and goal.axes == "xyz":
            orientation[row] = np.asarray(goal.value)
        else:
            continue
        placed.add(row)
    shown = [i for i, row in enumerate(drawn.rows) if row in placed]
    part = PictureStage(
        [drawn.items[i] for i in shown], [drawn.rows[i] for i in shown], [drawn.offsets[i] for i in shown]
    )
    return part.posed(position, orientation)


def draw_controls(task: Task, plan: Plan, path: str | os.PathLike[str]) -> None:
    """Draw the controls of a plan over time, with their bounds, and how far the goals are.

    Args:
        task: The task.
        plan: Its plan.
        path: The picture (.png).

    Raises:
        ValueError: If the path does not end in .png or cannot be written.
        ImportError: If matplotlib is missing.
    """
    checked_kind("task", task, Task)
    checked_kind("plan", plan, Plan)
    output = checked_output(path)
    if output.suffix.lower() != ".png":
        raise ValueError(f"path must end in .png, got {output}")
    require("matplotlib")
    from matplotlib.figure import Figure

    times = np.asarray(plan.trajectory.times)
    figure = Figure(figsize=(8, 2.2 * (len(task.actuators) + 1)), layout="constrained")
    axes = figure.subplots(len(task.actuators) + 1, 1, sharex=True)
    at = 0
    units = {"force": "N", "torque": "N m", "effort": "N or N m", "command": "of its motor"}
    for axis, actuator in zip(axes, task.actuators, strict=False):
        for j in range(actuator.size):
            label = actuator.axes[j] if actuator.axes else None
            axis.stairs(np.asarray(plan.values)[:, at + j], times, label=label, baseline=None)
        bounds = [float(np.min(np.asarray(actuator.lower))), float(np.max(np.asarray(actuator.upper)))]
        for bound in bounds:
            axis.axhline(bound, color="0.7", linestyle=":", linewidth=1)
        axis.set_ylabel(f"{actuator.kind} of\n{actuator.body} [{units[actuator.kind]}]")
        if actuator.size > 1:
            axis.legend(loc="upper right", ncols=3, fontsize="small")
        at += actuator.size
    for name, error in plan.distances.items():
        # The axis is logarithmic.
        axes[-1].plot(times, np.maximum(np.asarray(error), 1e-9), label=name)
    axes[-1].set_ylabel("distance\nfrom the goal")
    axes[-1].set_yscale("log")
    axes[-1].legend(loc="lower left", fontsize="small")
    axes[-1].set_xlabel("time [s]")
    with replacing(output) as file:
        figure.savefig(file, format="png", dpi=120)
