"""`dano simulate`, `dano view` and `dano demo`."""

import json
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

from dano import scene_file
from dano.archive import checked_input, format_of, is_own, replacing, TRAJECTORY
from dano.checks import checked_number
from dano.cli import running
from dano.cli._arguments import Demo, Simulate, View
from dano.cli._console import ProgressLine, put, put_json, say
from dano.cli._outputs import check_distinct, check_output, missing_for_pictures, run_files
from dano.engine import simulate as simulate_scene
from dano.fields import FIELD_FORMATS, FIELD_SUFFIXES, is_splats, load_field, read_splats
from dano.names import did_you_mean
from dano.objects import NeuralObject
from dano.scene import Scene, Trajectory
from dano.vision import load_capture

SCENES = ("drop", "collision")
DEMO_FPS, DEMO_SIZE = 24, (560, 350)
"""Coarser than the default: the demo should take a minute on an old laptop, too."""


def simulate(command: Simulate) -> None:
    """See `dano simulate --help`."""
    video, strip = command.video, command.strip
    scenes = [command.scene] if command.beside is None else [command.scene, command.beside]
    outputs = _outputs(command, scenes)
    for picture, suffix in ((video, ".mp4"), (strip, ".png")):
        if picture is not None:
            check_output(picture, *scenes, suffix=suffix)
            if missing := missing_for_pictures(video=suffix == ".mp4"):
                raise ImportError(missing)
    if video is not None or strip is not None:
        from dano.report import checked_size

        checked_size(command.size, len(scenes))
    checked_number("slow_motion", command.slow_motion, above=0)
    check_distinct(output=outputs[0], video=video, strip=strip)
    clock = running.Clock(since_start=running.is_program())
    clock("reading the scene")
    loaded = [load(scene, command.steps, command.timestep) for scene in scenes]
    if command.camera == "scene":
        # What is wrong with it is said before the run.
        loaded[0].camera()
    if video is not None or strip is not None:
        from dano.report import frame_count

        frame_count(max(each.n_steps * float(each.scene.timestep) for each in loaded), command.slow_motion)
    if len(loaded) > 1:
        command.output.mkdir(exist_ok=True)
        say(f"writing {outputs[0]} and {outputs[1]}")
    for path in (*outputs, video, strip):
        if path is not None:
            check_output(path, *(source for each in loaded for source in each.inputs()))
    reports = _run(loaded, outputs, command, clock)
    _tell(command, reports, clock)
    for report in reports:
        running.warn_unconverged(report)


def _outputs(command: Simulate, scenes: list[Path]) -> list[Path]:
    """Where the trajectories go.

    Raises:
        ValueError: If they cannot be written, or a scene is missing.
    """
    for scene in scenes:
        if scene_file.is_shipped(scene):
            continue
        if not scene.exists() and (hint := did_you_mean(str(scene), scene_file.ASSETS)):
            raise ValueError(f"scene must be a file or a shipped object, got {scene}{hint}")
        checked_input(scene)
    if len(scenes) == 1:
        check_output(command.output, scenes[0])
        return [command.output]
    folder = command.output
    if not folder.is_dir() and (folder.exists() or folder.suffix.lower() == ".npz"):
        raise ValueError(f"output must be a folder for the runs of two scenes, got {folder}")
    if not folder.is_dir():
        check_output(folder)
    return run_files(folder, scenes, resume=command.resume)


def _tell(command: Simulate, reports: list[dict[str, Any]], clock: running.Clock) -> None:
    """Print what came out, and where it is."""
    drawn = {key: str(path) for key in ("video", "strip") if (path := getattr(command, key)) is not None}
    if command.json:
        numbers = reports[0] if len(reports) == 1 else {"runs": reports}
        put_json({**numbers, **drawn, "seconds": clock.parts()})
        return
    for report in reports:
        if len(reports) > 1:
            put(f"== {report['scene']} ==")
        running.print_rollout(report)
        put()
    put(clock.told())
    for report in reports:
        _print_files(report)
    _print_files(drawn)
    names = [[body["name"] for body in report["bodies"]] for report in reports]
    both = f" --beside {reports[1]['run']}" if len(reports) > 1 and names[0] == names[1] else ""
    put(f"`dano view {reports[0]['run']}{both}` shows {'them' if both else 'it'} in the browser")


def view(command: View) -> None:
    """See `dano view --help`."""
    path = command.source
    if not 0 < command.port < 65536:
        raise ValueError(f"port must lie between 1 and 65535, got {command.port}")
    if command.page is not None:
        check_output(command.page, path, suffix=".html")
    kind = _kind(path)
    if command.beside is not None and kind != "run":
        raise ValueError(f"--beside goes with a run, a scene or an object, got it with the {kind} {path}")
    shown = {"run": _view_run, "field": _view_field, "capture": _view_capture, "splats": _view_splats}
    shown[kind](command)


def _kind(path: Path) -> str:
    """What is to be shown: a "run" or what is simulated to have one, a "field", "splats" or a "capture"."""
    if scene_file.is_shipped(path):
        return "run"
    if not path.exists():
        raise ValueError(
            f"{path}: no such file or folder, and no shipped object"
            + did_you_mean(str(path), scene_file.ASSETS)
        )
    suffix = path.suffix.lower()
    if path.is_dir() or suffix == ".json":
        return "capture"
    form = format_of(path)
    if suffix in (".toml", ".dano") or form == TRAJECTORY[0]:
        return "run"
    if suffix not in FIELD_SUFFIXES or (is_own(form) and form not in FIELD_FORMATS):
        raise ValueError(
            f"{path} must be a run (.npz), a scene (.toml), an object (.dano), a field"
            f" ({', '.join(FIELD_SUFFIXES)}), or photographs with poses (transforms.json or its folder),"
            f" got a {form or suffix or 'nameless'} file"
        )
    return "splats" if suffix == ".ply" and is_splats(path) else "field"


def _view_run(command: View) -> None:
    """A run; scenes and objects are simulated first."""
    progress = ProgressLine()
    again = None
    if command.source.suffix.lower() in (".toml", ".dano") or scene_file.is_shipped(command.source):
        loaded = load(command.source, None, None)
        trajectory = running.roll_out(loaded, progress, running.Clock()).trajectory
        again = partial(_again, loaded)
    else:
        run = scene_file.load_run(command.source, progress=progress)
        loaded, trajectory = run.source, run.trajectory
    beside = None
    if command.beside is not None:
        beside = scene_file.load_run(command.beside, progress=progress).trajectory
    progress.close()
    looks = loaded.looks()
    from dano.report import view as show, write_view

    if command.page is not None:
        write_view(loaded.scene, trajectory, command.page, looks=looks, beside=beside)
        put(f"wrote {command.page}")
        return
    show(loaded.scene, trajectory, looks=looks, beside=beside, again=again, port=command.port)


def _view_field(command: View) -> None:
    try:
        field = load_field(command.source)
    except ValueError as error:
        if command.source.suffix.lower() != ".npz" or format_of(command.source):
            raise
        raise ValueError(f"{command.source} must be a run of `dano simulate` or a field: {error}") from error
    from dano.report import view_field, write_field_view

    if command.page is not None:
        write_field_view(field, command.page)
        put(f"wrote {command.page}")
        return
    view_field(field, port=command.port)


def _view_splats(command: View) -> None:
    """Gaussian splats, out of which a click chooses an object; as a file the surface of their density."""
    if command.page is not None:
        _view_field(command)
        return
    from dano.report import view_splats

    view_splats(read_splats(command.source), command.source, port=command.port)


def _view_capture(command: View) -> None:
    capture, unit = load_capture(command.source), _unit(command.source)
    from dano.report import view_capture, write_capture_view

    if command.page is not None:
        write_capture_view(capture, command.page, unit=unit)
        put(f"wrote {command.page}")
        return
    view_capture(capture, unit=unit, port=command.port)


def _unit(path: Path) -> str:
    """What lengths of a capture are in: `dano poses` writes where it does not know their scale."""
    file = path / "transforms.json" if path.is_dir() else path
    content = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    known = not isinstance(content, dict) or content.get("units") != "arbitrary"
    return "m" if known else "units (scale not known)"


def _again(loaded: scene_file.SceneFile, scene: Scene) -> Trajectory:
    """A scene file's run with other parameters."""
    return simulate_scene(scene, loaded.state, loaded.n_steps, controls=loaded.controls)


def demo(command: Demo) -> None:
    """See `dano demo --help`."""
    folder = command.output
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"output path must be a folder, got the file {folder}")
    folder.mkdir(parents=True, exist_ok=True)
    missing = missing_for_pictures(video=True)
    began = time.monotonic()
    tell = (lambda _: None) if command.json else _clock(began)
    if command.name == "soap":
        if missing:
            raise ImportError(missing)
        # Here, because no other demo trains or tracks.
        from dano.cli.tracking.soap import demo_soap

        demo_soap(folder, tell, began, as_json=command.json)
        return
    if missing:
        say(f"warning: numbers only, {missing}")
    reports: dict[str, dict[str, Any]] = {}
    with _Artist(draws=missing is None, draft=command.draft, tell=tell) as artist:
        for scene in SCENES if command.name == "all" else (command.name,):
            reports[scene] = _demo_scene(scene, folder, artist, tell)
            if not command.json:
                put()
                put(f"== {scene} ==")
                running.print_rollout(reports[scene])
                put()
            running.warn_unconverged(reports[scene])
        tell("drawing films")
        artist.finish()
    for scene, report in reports.items():
        with replacing(folder / f"{scene}.json") as file:
            file.write(json.dumps(report, indent=2).encode())
    seconds = time.monotonic() - began
    if command.json:
        put_json({"folder": str(folder), "seconds": seconds, "scenes": reports})
        return
    for made in sorted({path for report in reports.values() for path in report["objects"].values()}):
        drawn = f", drawn in {Path(made).with_suffix('.png')}" if missing is None else ""
        put(f"object      {made}{drawn}")
    for report in reports.values():
        _print_files(report)
    put()
    first = next(iter(reports.values()))["scene"]
    put(f"took {seconds:.0f} s; change {first} and run it with `dano simulate {first} -o RUN.npz`")


def _clock(began: float) -> Callable[[str], None]:
    """Prints what happens when, in seconds of wall time since `began`, also where output goes to a file."""

    def tell(what: str) -> None:
        put(f"[{time.monotonic() - began:5.1f} s] {what}")

    return tell


def _demo_scene(name: str, folder: Path, artist: "_Artist", tell: Callable[[str], None]) -> dict[str, Any]:
    """Write a shipped scene, its objects and its run to a folder, and order the pictures."""
    path = folder / f"{name}.toml"
    with replacing(path) as file:
        file.write((files("dano") / "scenes" / path.name).read_bytes())
    tell(f"{name}: {path} written")
    loaded = load(path, None, None)
    artist.begin(loaded, path.with_suffix(".png"))
    tell(f"{name}: compiling and simulating {loaded.n_steps} steps")
    objects, text = {}, path.read_text(encoding="utf-8")
    for asset in scene_file.ASSETS:
        if f'asset = "{asset}"' in text:
            objects[asset] = str(folder / f"{asset}.dano")
            made = scene_file.load_asset(asset)
            made.save(folder / f"{asset}.dano")
            artist.draw(made, folder / f"{asset}.png")
    rollout, report = _simulated(loaded, path.with_suffix(".npz"), running.Clock())
    tell(f"{name}: simulated, {path.with_suffix('.npz')} written")
    report = {"scene": str(path), "objects": objects, **report}
    report.update(artist.film(loaded, rollout, path.with_suffix(".mp4"), path.with_suffix(".png")))
    return report


class _Artist:
    """Makes the pictures of the demo in a second thread, while the next scene is simulated in the first."""

    def __init__(self, *, draws: bool, draft: bool, tell: Callable[[str], None]):
        self._draws, self._draft, self._say = draws, draft, tell
        self._thread = ThreadPoolExecutor(1, "dano artist")
        self._progress = ProgressLine()
        self._orders: list[Future[None]] = []
        self._drawn: set[Path] = set()
        self._watched, self._stopped = threading.Event(), threading.Event()

    def __enter__(self) -> "_Artist":
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.shutdown(cancel_futures=True)

    def begin(self, loaded: scene_file.SceneFile, path: Path) -> None:
        """Order a first picture: the scene before it is simulated."""
        if self._draws:
            self._order(self._thread.submit(_draw_start, loaded, path), path)

    def draw(self, made: NeuralObject, path: Path) -> None:
        """Order the figure of an object, once."""
        if self._draws and path not in self._drawn:
            from dano.report import draw_object

            self._drawn.add(path)
            self._order(self._thread.submit(draw_object, made, path, title=path.stem), path)

    def film(
        self, loaded: scene_file.SceneFile, rollout: running.Rollout, video: Path, strip: Path
    ) -> dict[str, str]:
        """Order the film of a run; the paths of what will be there, for the report."""
        if not self._draws:
            return {}
        from dano.report import render_trajectory, VideoOptions

        order = self._thread.submit(
            render_trajectory,
            loaded.scene,
            rollout.trajectory,
            video,
            strip=strip,
            looks=loaded.looks(),
            options=VideoOptions(fps=DEMO_FPS, size=DEMO_SIZE, draft=self._draft),
            progress=self._tell,
        )
        self._order(order, video)
        return {"video": str(video), "strip": str(strip)}

    def _order(self, order: Future[None], path: Path) -> None:
        def tell(done: Future[None]) -> None:
            if not done.cancelled() and done.exception() is None:
                self._say(f"{path} drawn")

        order.add_done_callback(tell)
        self._orders.append(order)

    def finish(self) -> None:
        """Wait until everything is drawn."""
        self._watched.set()
        for order in self._orders:
            order.result()
        self._progress.close()

    def _tell(self, description: str, share: float) -> None:
        if self._stopped.is_set():
            raise InterruptedError("the demo was stopped")
        # Until then the line on the terminal belongs to the simulation.
        if self._watched.is_set():
            self._progress(description, share)


def _draw_start(loaded: scene_file.SceneFile, path: Path) -> None:
    from dano.report import render_start

    render_start(loaded.scene, loaded.state, path, looks=loaded.looks(), size=DEMO_SIZE)


def load(path: Path, steps: int | None, timestep: float | None) -> scene_file.SceneFile:
    """The scene in a file, or that of an object dropped onto a floor."""
    progress = ProgressLine()
    if path.suffix.lower() != ".toml":
        text = scene_file.drop_scene(path, progress=progress)
        where = path.with_suffix(".toml")
        loaded = scene_file.parse_scene(text, where, timestep=timestep, n_steps=steps, progress=progress)
    else:
        loaded = scene_file.load_scene(path, timestep=timestep, n_steps=steps, progress=progress)
    progress.close()
    return loaded


def _run(
    loaded: list[scene_file.SceneFile], outputs: list[Path], command: Simulate, clock: running.Clock
) -> list[dict[str, Any]]:
    """Simulate, save and draw; what came out in numbers."""
    scenes, reports, rollouts = (command.scene, command.beside), [], []
    kept = [running.RunCheckpoint(output, each) for output, each in zip(outputs, loaded, strict=True)]
    for scene, each, output, checkpoint in zip(scenes, loaded, outputs, kept, strict=False):
        rollout, report = _simulated(each, output, clock, checkpoint, resume=command.resume)
        rollouts.append(rollout)
        reports.append({"scene": str(scene), **report})
    # Only now: if the second run is stopped, the first need not be run again.
    for checkpoint in kept:
        checkpoint.remove()
    clock("drawing")
    if command.video is not None or command.strip is not None:
        _draw(loaded, [rollout.trajectory for rollout in rollouts], command)
    return reports


def _draw(loaded: list[scene_file.SceneFile], trajectories: list[Trajectory], command: Simulate) -> None:
    """A film of one run, or of two side by side."""
    from dano.report import render_side_by_side, render_trajectory, VideoOptions

    progress = ProgressLine()
    film = VideoOptions(
        size=command.size,
        draft=command.draft,
        slow_motion=command.slow_motion,
        camera=loaded[0].camera() if command.camera == "scene" else command.camera,
    )
    given: dict[str, Any] = {"strip": command.strip, "options": film, "progress": progress}
    scenes, looks = [each.scene for each in loaded], [each.looks() for each in loaded]
    if command.beside is None:
        render_trajectory(scenes[0], trajectories[0], command.video, looks=looks[0], **given)
    else:
        labels = [command.scene.stem, command.beside.stem]
        if labels[0] == labels[1]:
            labels = [str(command.scene), str(command.beside)]
        render_side_by_side(scenes, trajectories, command.video, labels=labels, looks=looks, **given)
    progress.close()


def _simulated(
    loaded: scene_file.SceneFile,
    output: Path,
    clock: running.Clock,
    kept: running.RunCheckpoint | None = None,
    *,
    resume: bool = False,
) -> tuple[running.Rollout, dict[str, Any]]:
    """Simulate and save; the rollout, and what came out in numbers."""
    progress = ProgressLine()
    rollout = running.roll_out(loaded, progress, clock, kept, resume=resume)
    clock("writing")
    scene_file.save_run(output, rollout.trajectory, loaded)
    clock("contact forces")
    progress("contact forces", 0.0)
    report = {**running.describe(rollout, loaded.scene), "run": str(output)}
    progress.close()
    return rollout, report


def _print_files(report: dict[str, Any]) -> None:
    for key, label in (("run", "run"), ("video", "video"), ("strip", "pictures")):
        if key in report:
            put(f"{label:<11} {report[key]}")
