"""Makes the picture at the head of each guide, and those of the gallery of examples.

Guides show what their own programs do, run as they stand on the page; the gallery shows the runs of the
programs in `examples/`. Each picture is a WebP of at most 300 kB. Needs the extras `all`, `mktestdocs`,
`frax`, `pybullet`, and `MUJOCO_GL=egl` where there is no screen; `guides/worlds` the extra `mjwarp`.

Usage: python assets/render_guides.py docs/images [NAME …]    (a quarter of an hour on two cores)
"""

import argparse
import contextlib
import os
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")  # before MuJoCo is imported

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pybullet_data
from filming import (
    Frames,
    frames_in_mujoco,
    frames_of,
    picture_in_mujoco,
    read_film,
    recorded,
    recorded_in_mujoco,
    SIZE,
    write_webp,
)
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mktestdocs import grab_code_blocks
from PIL import Image

import dano
from dano.report import draw_capture, draw_object
from dano.scene_file import asset_look, load_asset, parse_scene
from dano.vision import Camera, load_capture, survey

REPOSITORY = Path(__file__).resolve().parents[1]
INK, MEASURED, FITTED, OTHER = "#22262b", "#c66a00", "#00897b", "#9aa3ab"

Run = tuple[dano.Scene, dano.Trajectory]


def main() -> None:
    """Render and write."""
    parser = argparse.ArgumentParser(description="Make the pictures of the guides and of the gallery.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", help=f"of {', '.join(PICTURES)}; default: all")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.names if name not in PICTURES]
    if unknown:
        parser.error(f"names must be of {list(PICTURES)}, got {unknown[0]!r}")
    jax.config.update("jax_enable_x64", True)
    for name in arguments.names or PICTURES:
        path = arguments.folder / f"{name}.webp"
        path.parent.mkdir(exist_ok=True)
        write_webp(path, PICTURES[name]())


def runs_of_guide(page: str) -> list[Run]:
    """What the Python blocks of a guide simulate."""
    text = (REPOSITORY / "docs" / f"{page}.md").read_text(encoding="utf-8")
    program = "\n".join(grab_code_blocks(text, lang="python"))
    # Some write files where they run.
    with recorded() as runs, tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        exec(compile(program, page, "exec"), {"__name__": "__main__"})
    return runs


def longest(runs: list[Run]) -> Run:
    """The run of most time; of several, the one in which bodies move farthest."""

    def length(run: Run) -> tuple[float, float]:
        return float(run[1].times[-1]), float(
            jnp.abs(run[1].states.position[-1] - run[1].states.position[0]).max()
        )

    return max(runs, key=length)


def runs_of_example(name: str) -> list[Run]:
    """What a program of `examples/` simulates."""
    with recorded() as runs:
        runpy.run_path(str(REPOSITORY / "examples" / f"{name}.py"))["main"]()
    return runs


def picture_of(figure: Figure) -> np.ndarray:
    """The pixels of a figure."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def quickstart() -> Frames:
    """The program of the quickstart."""
    return frames_of(*longest(runs_of_guide("quickstart")), slow_motion=4)


def objects() -> Frames:
    """What `dano inspect` draws of the learned bunny."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "object.png"
        draw_object(load_asset("trained_bunny"), path)
        return [np.asarray(Image.open(path).convert("RGB"))]


def importing() -> Frames:
    """A mesh, the density that is made of it, and the body."""
    field = dano.bake(dano.load_field(REPOSITORY / "assets" / "bunny.obj"), 96).grid
    lines = (REPOSITORY / "assets" / "bunny.obj").read_text().splitlines()
    points = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], float)
    faces = [
        [int(word.split("/")[0]) - 1 for word in line.split()[1:4]] for line in lines if line[:2] == "f "
    ]
    figure = Figure(figsize=(10, 3.6), dpi=100, facecolor="white")
    axes = figure.add_subplot(1, 3, 1, projection="3d")
    axes.plot_trisurf(*points.T, triangles=faces, color="white", edgecolor=OTHER, linewidth=0.25)
    axes.set_box_aspect(np.ptp(points, axis=0), zoom=1.45)
    axes.view_init(12, -75)
    axes.set_axis_off()
    axes.set_title("a file: triangles", fontsize=11, color=INK)
    axes = figure.add_subplot(1, 3, 2)
    low, high = np.asarray(field.bounds)
    across, along = np.meshgrid(np.linspace(low[0], high[0], 300), np.linspace(low[2], high[2], 300))
    points = np.stack([across, np.full_like(across, (low[1] + high[1]) / 2), along], -1).reshape(-1, 3)
    density = jax.jit(jax.vmap(field.density))(points).reshape(300, 300)
    axes.imshow(density, origin="lower", cmap="Greys", vmin=0, vmax=1.3)
    axes.set_axis_off()
    axes.set_title("a field: density on a grid, a slice", fontsize=11, color=INK)
    axes = figure.add_subplot(1, 3, 3)
    body = dano.NeuralObject.from_field(field, mass=1.0, n_samples=2000)
    samples, normals = (np.asarray(x) for x in (body.samples.points, body.samples.normals))
    seen = normals @ np.array([0.26, -0.95, 0.2]) > 0
    right, up = samples[seen, 0] * 0.965 + samples[seen, 1] * 0.26, samples[seen, 2]
    axes.scatter(right, up, s=2.5, color=FITTED)
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title("a body: mass, inertia, contact samples", fontsize=11, color=INK)
    figure.subplots_adjust(0.01, 0.02, 0.99, 0.9, 0.03)
    return [picture_of(figure)]


def scenes() -> Frames:
    """The first scene file of its guide."""
    text = (REPOSITORY / "docs" / "scenes.md").read_text(encoding="utf-8")
    loaded = parse_scene(grab_code_blocks(text, lang="toml")[0], Path("scene.toml"))
    run = dano.simulate(loaded.scene, loaded.state, loaded.n_steps, controls=loaded.controls)
    return frames_of(loaded.scene, run, slow_motion=2)


def joints() -> Frames:
    """The door of its guide, seen from above its hinge's side."""
    camera = Camera((1.9, 2.3, 1.9), (0.42, 0.2, 0.6), vertical_fov=0.45, width=SIZE[0], height=SIZE[1])
    return frames_of(*runs_of_guide("joints")[0], slow_motion=8, camera=camera)


def robots() -> Frames:
    """A Panda whose motors go from pose to pose, as those of the guide's arm do."""
    robot = dano.load_urdf(Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf")
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    scene = robot.scene(bodies=[floor], timestep=4e-3)
    arm = [f"panda_joint{i}" for i in range(1, 8)]
    for name in robot.joint_names:
        stiffness = 2000.0 if name in arm else 200.0
        motor = dano.Motor("position", stiffness=stiffness, damping=stiffness / 8)
        scene = scene.replace_joint(robot.joint_names[name], motor=motor)
    poses = np.array([[0, -0.6, 0, -2.3, 0, 1.8, 0.8], [0.9, 0.5, 0.2, -1.6, 0, 2.1, 0.8]])
    poses = np.vstack([poses, [-0.7, 0.7, -0.4, -2.0, 0.5, 2.7, 0.2], poses[:1]])
    start = robot.state(scene, dict(zip(arm, poses[0], strict=True)))
    told = [
        scene.control(**{robot.joint_names[n]: {"command": q} for n, q in zip(arm, pose, strict=True)})
        for pose in poses[1:]
    ]
    controls = jax.tree.map(lambda *x: jnp.repeat(jnp.stack(x), 225, axis=0), *told)
    run = dano.simulate(scene, start, controls=controls)
    camera = Camera((1.7, -1.5, 0.95), (0.2, 0, 0.35), vertical_fov=0.56, width=SIZE[0], height=SIZE[1])
    return frames_of(scene, run, camera=camera, contact_points=False)


def arm() -> Frames:
    """The Panda of its guide, which lifts a mug."""
    return frames_of(*runs_of_guide("arm")[-1])


def identify() -> Frames:
    """Positions with noise, and simulations with the friction guessed first and the one that was found."""
    bodies = [
        dano.Body("soap", dano.Box((0.045, 0.03, 0.02)), mass=0.15),
        dano.Body("table", dano.HalfSpace(), fixed=True),
    ]
    scene = dano.Scene.create(bodies, [dano.Contact("soap", "table")], timestep=0.005)
    state = scene.initial_state(soap=dict(position=(0, 0, 0.02), velocity=(1.2, 0, 0)))

    def slide(friction: float) -> np.ndarray:
        changed = scene.replace_contact("soap", "table", sliding_friction=friction)
        return np.asarray(dano.simulate(changed, state, 100).states.position[:, :1])

    noise, true, guess = 4e-3, 0.35, 0.7
    times = 0.005 * np.arange(101)
    seen = (slide(true) + np.random.default_rng(0).normal(scale=noise, size=(101, 1, 3)))[::4]
    turned = np.tile([1.0, 0, 0, 0], (len(seen), 1, 1))
    motion = dano.Motion.create(times[::4], ["soap"], position=seen, orientation=turned)
    friction = dano.Parameter(
        "friction", lambda s: s.contact("soap", "table").sliding_friction, 0.0, 1.0, start=guess
    )
    fit = dano.identify(scene, motion, [friction], initial="states", state=state)
    found, error = float(fit.values["friction"]), float(fit.standard_errors["friction"])
    figure = Figure(figsize=(6.4, 3.6), dpi=110, facecolor="white")
    axes = figure.add_subplot()
    axes.plot(times, slide(guess)[:, 0, 0], "--", color=OTHER, label=f"first guess, friction {guess}")
    axes.plot(times, slide(found)[:, 0, 0], color=FITTED, label=f"found, {found:.3f} ± {error:.3f}")
    axes.plot(times[::4], seen[:, 0, 0], "o", ms=4, color=MEASURED, label=f"observed, friction {true}")
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("how far the soap slides [m]")
    axes.legend(frameon=False, loc="lower right")
    figure.tight_layout()
    return [picture_of(figure)]


def plan() -> Frames:
    """The grasp of `benchmarks/grasp`, planned and filmed by `dano plan`."""
    words = "-c", "import dano_start; dano_start.main()", "plan", "scene.toml", "task.toml"
    with tempfile.TemporaryDirectory() as folder:
        video = Path(folder) / "grasp.mp4"
        files = "-o", str(Path(folder) / "grasp.npz"), "--video", str(video)
        subprocess.run([sys.executable, *words, *files], cwd=REPOSITORY / "benchmarks" / "grasp", check=True)
        return read_film(video)


def learn() -> Frames:
    """Renders that training has not seen, and below them the shipped bunny in the same views and light."""
    look = asset_look("trained_bunny")
    assert look is not None
    views = load_capture(REPOSITORY / "assets" / "images" / "bunny").split("test")[:6]
    seen = [view.over(np.ones(3)) for view in views]
    drawn = [look.picture(view.camera, view.light).over(np.ones(3)) for view in views]
    rows = [np.concatenate(row, axis=1) for row in (seen, drawn)]
    picture = Image.fromarray(np.uint8(np.round(255 * np.clip(np.concatenate(rows), 0, 1))))
    return [np.asarray(picture.resize((960, 320), Image.Resampling.LANCZOS))]


def poses() -> Frames:
    """Where the cameras of the shipped renders stood, as `dano data` draws it."""
    with contextlib.chdir(REPOSITORY):  # the title of the figure names the folder
        capture = load_capture("assets/images/bunny")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "capture.png"
        draw_capture(capture, survey(capture), path)
        return [np.asarray(Image.open(path).convert("RGB"))]


def batches() -> Frames:
    """Rollouts with eight frictions, computed at once and drawn side by side."""
    soap = load_asset("trained_soap")
    params = dano.ContactParams(sliding_friction=0.2)
    scene = dano.Scene.create(
        [dano.Body("soap", soap), dano.Body("floor", dano.HalfSpace(), fixed=True)],
        [dano.Contact("soap", "floor", params)],
        timestep=0.005,
    )
    start = scene.initial_state(soap=dict(position=(0, 0, 0.0155), velocity=(1.4, 0, 0)))
    frictions = jnp.linspace(0.1, 0.45, 8)
    found = dano.rollouts(
        lambda mu: scene.replace_contact("soap", "floor", sliding_friction=mu),
        start,
        200,
        parameters=frictions,
    )
    lanes = np.arange(8)[:, None] * np.array([0.0, 0.085, 0.0])
    names = [f"soap {i}" for i in range(8)]
    shown = dano.Scene.create(
        [*(dano.Body(name, soap) for name in names), dano.Body("floor", dano.HalfSpace(), fixed=True)],
        contacts=(),
        timestep=0.005,
    )
    states, n_times = found.states, 201

    # Rollouts × times × (soap, floor) become times × (soap of each rollout, floor).
    def gathered(x: jax.Array, shift: np.ndarray | float = 0.0) -> jax.Array:
        soaps = jnp.moveaxis(x[:, :, 0] + (shift[:, None] if isinstance(shift, np.ndarray) else 0.0), 0, 1)
        return jnp.concatenate([soaps, x[0, :, 1:]], axis=1)

    joined = dano.State(
        gathered(states.position, lanes),
        gathered(states.orientation),
        gathered(states.velocity),
        gathered(states.omega),
    )
    run = dano.Trajectory(
        0.005 * jnp.arange(n_times),
        joined,
        jnp.zeros(200),
        jnp.zeros(200, int),
        jnp.ones(200, bool),
        shown.names,
    )
    look = asset_look("trained_soap")
    assert look is not None
    camera = Camera((0.49, -0.7, 0.7), (0.49, 0.26, 0.0), vertical_fov=0.62, width=SIZE[0], height=SIZE[1])
    return frames_of(shown, run, 2, camera=camera, looks=dict.fromkeys(names, look), contact_points=False)


def export() -> Frames:
    """The exported bunny in MuJoCo: how it looks, and the convex pieces that touch."""
    with tempfile.TemporaryDirectory() as folder:
        dano.export_object(load_asset("trained_bunny"), folder, to="mjcf", look=asset_look("trained_bunny"))
        model = mujoco.MjModel.from_xml_path(f"{folder}/scene.xml")
    return [beside_its_pieces(model)]


def worlds() -> Frames:
    """How far the bunnies of worlds of MuJoCo Warp slide, beside v²/(2 μ g)."""
    program = runpy.run_path(str(REPOSITORY / "examples" / "11_mujoco_worlds.py"))
    found = program["main"]()
    figure = Figure((6.4, 3.2), dpi=100, layout="constrained")
    axes = figure.add_subplot()
    mu = np.linspace(0.09, 0.62, 100)
    axes.plot(mu, 100 * program["SPEED"] ** 2 / (2 * mu * 9.81), color=OTHER, label="v²/(2 μ g)")
    axes.plot(found["friction"], 100 * found["way"], "o", color=FITTED, label="bunny, one world each")
    axes.set(xlabel="friction", ylabel="way of the slide [cm]")
    axes.legend(frameon=False)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return [np.asarray(canvas.buffer_rgba())[..., :3]]


def beside_its_pieces(model: mujoco.MjModel) -> np.ndarray:
    """Two pictures of a model: its visual geoms, and those that touch in colours of their own."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
    camera.lookat[:] = data.xipos[-1]
    camera.distance, camera.azimuth, camera.elevation = 0.3, 105, -18
    touching = np.flatnonzero((model.geom_contype > 0) & (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH))
    visual = np.flatnonzero((model.geom_contype == 0) & (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH))
    colours = np.random.default_rng(1).uniform(0.25, 0.95, (len(touching), 3))
    model.geom_rgba[touching, :3] = colours
    model.geom_matid[touching] = -1
    option.geomgroup[:] = 1
    panels = []
    for hidden in (touching, visual):
        model.geom_rgba[touching, 3] = 1
        model.geom_rgba[visual, 3] = 1
        model.geom_rgba[hidden, 3] = 0
        panels.append(picture_in_mujoco(model, data, camera, (480, 360), option))
    return np.concatenate(panels, axis=1)


def example(
    name: str, slow_motion: float = 1.0, most: int | None = None, **options: Any
) -> Callable[[], Frames]:
    """The longest run of a program of `examples/`, at most so many frames."""
    return lambda: frames_of(*longest(runs_of_example(name)), slow_motion=slow_motion, **options)[:most]


def mujoco_example(
    name: str, look_at: tuple[float, float, float], away: tuple[float, float, float]
) -> Callable[[], Frames]:
    """The run of a program of `examples/` in MuJoCo, as MuJoCo draws it."""

    def frames() -> Frames:
        with recorded_in_mujoco() as steps:
            runpy.run_path(str(REPOSITORY / "examples" / f"{name}.py"))["main"]()
        return frames_in_mujoco(steps[0][0], [qpos for _, qpos in steps], look_at, away)

    return frames


PICTURES: dict[str, Callable[[], Frames]] = {
    "guides/quickstart": quickstart,
    "guides/objects": objects,
    "guides/importing": importing,
    "guides/scenes": scenes,
    "guides/joints": joints,
    "guides/robots": robots,
    "guides/arm": arm,
    "guides/identify": identify,
    "guides/plan": plan,
    "guides/learn": learn,
    "guides/poses": poses,
    "guides/batches": batches,
    "guides/export": export,
    "guides/worlds": worlds,
    "examples/01_drop": example("01_drop", slow_motion=2),
    "examples/02_gradient_of_a_slide": example("02_gradient_of_a_slide", slow_motion=2),
    "examples/03_two_bunnies": example("03_two_bunnies", slow_motion=6),
    "examples/04_own_field": example("04_own_field", slow_motion=2),
    "examples/06_linearize_and_control": example(
        "06_linearize_and_control",
        slow_motion=4,
        most=36,
        camera=Camera((0.4, -0.95, 0.62), (0.09, 0, 0.475), vertical_fov=0.3, width=SIZE[0], height=SIZE[1]),
    ),
    "examples/07_door": example("07_door", slow_motion=10),
    "examples/08_mujoco_kick": mujoco_example("08_mujoco_kick", (0.1, 0, 0.2), (1.15, 90, -14)),
    "examples/09_mujoco_push": mujoco_example("09_mujoco_push", (-0.08, 0, 0.03), (0.8, 75, -28)),
    "examples/10_mujoco_panda": mujoco_example("10_mujoco_panda", (0.35, 0, 0.28), (1.5, 115, -12)),
    "examples/12_mujoco_grip": mujoco_example("12_mujoco_grip", (0.47, 0, 0.16), (0.75, 150, -22)),
}
"""How each picture is made, by its path below the folder of images."""


if __name__ == "__main__":
    main()
