"""`dano simulate`, `dano view` and `dano demo`."""

import json
import time
from importlib.resources import files
from pathlib import Path
from typing import Any

from dano import scene_file
from dano.archive import replacing
from dano.cli import _rollout
from dano.cli._console import Progress, put, put_json, say
from dano.cli._outputs import check_output, missing_for_pictures

SCENES = ("drop", "collision")
SECONDS_FOR_ONE = 50.0
"""If the first scene of the demo took longer, the second might not end within two minutes."""


def simulate(
    scene: Path,
    output: Path,
    *,
    video: Path | None,
    strip: Path | None,
    steps: int | None,
    timestep: float | None,
    slow_motion: float,
    as_json: bool,
) -> None:
    """See `dano simulate --help`."""
    check_output(output, scene)
    for picture, suffix in ((video, ".mp4"), (strip, ".png")):
        if picture is not None:
            check_output(picture, scene, suffix=suffix)
            if missing := missing_for_pictures(video=suffix == ".mp4"):
                raise ImportError(missing)
    if not slow_motion > 0:
        raise ValueError(f"slow_motion must be > 0, got {slow_motion}")
    loaded = _load(scene, steps, timestep)
    report = _run(loaded, output, video, strip, slow_motion)
    if as_json:
        put_json({"scene": str(scene), **report})
    else:
        _rollout.print_rollout(report)
        put()
        _print_files(report)
        put(f"`dano view {output}` shows it in the browser")
    _rollout.warn_unconverged(report)


def view(run: Path, *, port: int) -> None:
    """See `dano view --help`."""
    if not 0 < port < 65536:
        raise ValueError(f"port must lie between 1 and 65535, got {port}")
    progress = Progress()
    loaded = scene_file.load_run(run, progress=progress)
    progress.close()
    from dano.report import view as show

    show(loaded.scene, loaded.trajectory, port=port)


def demo(name: str, folder: Path, *, as_json: bool) -> None:
    """See `dano demo --help`."""
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"output path must be a folder, got the file {folder}")
    folder.mkdir(parents=True, exist_ok=True)
    missing = missing_for_pictures(video=True)
    if missing:
        say(f"warning: numbers only, {missing}")
    began = time.monotonic()
    reports: dict[str, Any] = {}
    for scene in SCENES if name == "all" else (name,):
        if reports and time.monotonic() - began > SECONDS_FOR_ONE:
            say(f"`dano demo {scene}` shows the next scene: the time for one command is used up")
            break
        reports[scene] = _demo_scene(scene, folder, draw=missing is None, quiet=as_json)
    seconds = time.monotonic() - began
    if as_json:
        put_json({"folder": str(folder), "seconds": seconds, "scenes": reports})
    else:
        first = folder / f"{next(iter(reports))}.toml"
        put(f"took {seconds:.0f} s; change {first} and run it with `dano simulate`")


def _demo_scene(name: str, folder: Path, *, draw: bool, quiet: bool) -> dict[str, Any]:
    """Write a shipped scene, its objects and its run to a folder."""
    path = folder / f"{name}.toml"
    with replacing(path) as file:
        file.write((files("dano") / "scenes" / path.name).read_bytes())
    loaded = _load(path, None, None)
    objects = {}
    for asset in scene_file.ASSETS:
        if f'asset = "{asset}"' in loaded.text:
            made = scene_file.build_asset(asset)
            made.save(folder / f"{asset}.dano")
            objects[asset] = str(folder / f"{asset}.dano")
            if draw:
                from dano.report import draw_object

                draw_object(made, folder / f"{asset}.png", title=asset)
    pictures = (path.with_suffix(".mp4"), path.with_suffix(".png")) if draw else (None, None)
    report = {
        "scene": str(path),
        "objects": objects,
        **_run(loaded, path.with_suffix(".npz"), *pictures, 1.0),
    }
    with replacing(path.with_suffix(".json")) as file:
        file.write(json.dumps(report, indent=2).encode())
    if not quiet:
        put(f"== {name} ==")
        _rollout.print_rollout(report)
        put()
        for file_name in objects.values():
            put(
                f"object      {file_name}"
                + (f", drawn in {Path(file_name).with_suffix('.png')}" if draw else "")
            )
        _print_files(report)
        put()
    _rollout.warn_unconverged(report)
    return report


def _load(path: Path, steps: int | None, timestep: float | None) -> scene_file.SceneFile:
    """The scene in a file, or that of an object dropped onto a floor."""
    progress = Progress()
    if path.suffix.lower() == ".dano":
        text = scene_file.drop_scene(path)
        where = path.with_suffix(".toml")
        loaded = scene_file.parse_scene(text, where, timestep=timestep, n_steps=steps, progress=progress)
    else:
        loaded = scene_file.load_scene(path, timestep=timestep, n_steps=steps, progress=progress)
    progress.close()
    return loaded


def _run(
    loaded: scene_file.SceneFile, output: Path, video: Path | None, strip: Path | None, slow_motion: float
) -> dict[str, Any]:
    """Simulate, save and draw; what came out in numbers."""
    progress = Progress()
    rollout = _rollout.roll_out(loaded, progress)
    scene_file.save_run(output, rollout.trajectory, loaded)
    progress("contact forces", 0.0)
    report = {**_rollout.describe(rollout, loaded.scene), "run": str(output)}
    if video is not None or strip is not None:
        from dano.report import render_trajectory

        render_trajectory(
            loaded.scene, rollout.trajectory, video, strip=strip, slow_motion=slow_motion, progress=progress
        )
    progress.close()
    for key, picture in (("video", video), ("strip", strip)):
        if picture is not None:
            report[key] = str(picture)
    return report


def _print_files(report: dict[str, Any]) -> None:
    for key, label in (("run", "run"), ("video", "video"), ("strip", "pictures")):
        if key in report:
            put(f"{label:<11} {report[key]}")
