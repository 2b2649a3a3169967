"""The commands' arguments, and nothing that is slow to import."""

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import arg, FlagCreatePairsOff, Positional

from dano import __version__
from dano.cli._compare import compare
from dano.cli._export import export
from dano.names import did_you_mean

Output = Annotated[Path, arg(aliases=["-o"])]


def parse(argv: Sequence[str]) -> Callable[[], None]:
    """The command that the arguments ask for, ready to be called.

    Exits with code 0 after printing help, with 2 if the arguments are wrong.

    Raises:
        ValueError: If there is no such command.
    """
    if not argv:
        argv = ["--help"]
    if list(argv) == ["--version"]:
        print(f"dano {__version__}")
        raise SystemExit(0)
    functions = (train, data, build, import_, inspect, simulate, identify, view, export, compare, demo)
    commands = {function.__name__.rstrip("_"): function for function in functions}
    if not argv[0].startswith("-") and argv[0] not in commands:
        raise ValueError(
            f"command must be one of {', '.join(commands)}, got {argv[0]!r}{did_you_mean(argv[0], commands)}"
        )
    return tyro.extras.subcommand_cli_from_dict(
        commands,
        prog="dano",
        description=(
            "Simulate what robots see: neural density fields as rigid bodies.\n\n"
            "`dano demo` shows it; `dano build` makes a body of your field."
        ),
        args=list(argv),
        config=(FlagCreatePairsOff,),
    )


def train(
    images: Positional[Path],
    /,
    output: Output,
    resolution: int = 96,
    iterations: int = 800,
    batch: int = 4096,
    seconds: float | None = None,
    views: int | None = None,
    downscale: int = 1,
    network: Path | None = None,
    mass: float | None = None,
    mass_density: float = 1000.0,
    resume: bool = False,
    no_report: bool = False,
    seed: int = 0,
    json: Path | None = None,
    previews: Path | None = None,
) -> Callable[[], None]:
    """Learn a solid neural object from photographs with known poses.

    Writes the object, and beside it the learned field (.field.npz), its density grid (.grid.npz) and a report
    (.html).

    Args:
        images: Folder with transforms.json or anno_train.json, or one of these files.
        output: Where to write the object, *.dano.
        resolution: Nodes along the longest side of the object.
        iterations: Training steps at most.
        batch: Rays per step.
        seconds: Stop training after this time [s].
        views: Train on so many of the views only.
        downscale: Average so many pixels a side into one.
        network: Segmentation network (.onnx) for photographs without masks; default: what differs from the
            background.
        mass: Mass of the object [kg].
        mass_density: Else: mass per volume [kg/m³].
        resume: Go on with a training that was interrupted.
        no_report: Write no report.
        seed: Seed of everything random.
        json: Write figures of merit and mass properties to this file.
        previews: Folder for pictures of what has been learned so far, beside photographs held out.
    """
    from dano.cli import _learn
    from dano.vision import TrainOptions

    def run() -> None:
        _learn.train(
            images,
            output,
            options=TrainOptions(
                resolution=resolution, iterations=iterations, batch=batch, seconds=seconds, seed=seed
            ),
            downscale=downscale,
            views=views,
            network=network,
            mass=mass,
            mass_density=mass_density,
            resume=resume,
            report=not no_report,
            json_file=json,
            previews=previews,
        )

    return run


def data(
    images: Positional[Path],
    /,
    png: Path | None = None,
    no_png: bool = False,
    downscale: int = 1,
    network: Path | None = None,
    json: bool = False,
) -> Callable[[], None]:
    """Check photographs before training: poses, masks, coverage; and draw the cameras.

    Args:
        images: Folder with transforms.json or anno_train.json, or one of these files.
        png: Where to draw; default: the folder's name in the current folder.
        no_png: Draw nothing.
        downscale: Average so many pixels a side into one.
        network: Segmentation network (.onnx) for photographs without masks.
        json: Print one JSON object instead of text.
    """
    from dano.cli import _learn

    return functools.partial(
        _learn.data,
        images,
        png=png,
        draw=not no_png,
        downscale=downscale,
        network=network,
        as_json=json,
    )


def build(
    field: Positional[Path],
    /,
    output: Output,
    samples: int = 5000,
    density_range: tuple[float, float] | None = None,
    mass_model: Literal["auto", "density", "solid"] = "auto",
    mass_scale: float | None = None,
    mass: float | None = None,
    resolution: int = 96,
    length: float | None = None,
    floaters: bool = False,
    seed: int = 0,
    json: bool = False,
) -> Callable[[], None]:
    """Make a neural object of a density field: mass, centre of mass, inertia, contact samples.

    Args:
        field: Density grid (.npz with values, origin, spacing), voxels (.npy), mesh (.obj, .stl, …), object
            (.dano), or what `dano import` reads.
        output: Where to write the object, usually *.dano.
        samples: Number of contact samples.
        density_range: Lower and upper density of the samples; default: around the field's own surface.
        mass_model: solid: uniform inside the surface, hollow cores filled. density: as dense as the field.
            auto: density where it is the occupancy of a solid inside, else solid.
        mass_scale: Mass per unit of density and cubic metre [kg]; default 1.
        mass: Total mass [kg], instead of the mass scale.
        resolution: Cells along the longest axis for mass integrals and sampling.
        length: Scale the field so that the object's longest extent is this [m].
        floaters: Let parts apart from the largest one feel contact, too; those of meshes always do.
        seed: Seed of the random samples.
        json: Print one JSON object instead of text.
    """
    from dano.cli import _objects

    return functools.partial(
        _objects.build,
        field,
        output,
        samples=samples,
        density_range=density_range,
        mass_model=mass_model,
        mass_scale=mass_scale,
        mass=mass,
        resolution=resolution,
        length=length,
        floaters=floaters,
        seed=seed,
        as_json=json,
    )


def import_(
    file: Positional[str],
    /,
    output: Output,
    crop: tuple[float, float, float, float, float, float] | None = None,
    scale: float = 1.0,
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    orientation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
    resolution: int | None = None,
    interpolation: Literal["linear", "quadratic", "cubic"] | None = None,
    hollow: bool = False,
    spacing: float | None = None,
    origin: tuple[float, float, float] | None = None,
    signed_distance: bool = False,
    grid: str | None = None,
    cascade: int | None = None,
    module: str | None = None,
    keep_transform: bool = False,
    json: bool = False,
) -> Callable[[], None]:
    """Read a field of another program and write it as a grid that dano reads.

    Args:
        file: nerfstudio checkpoint (.ckpt), instant-ngp snapshot (.ingp, .msgpack), Gaussian splats (.ply),
            OpenVDB or NanoVDB grid (.vdb, .nvdb), PyTorch module (.pt2, .pt, .pth), voxels (.npy, .npz),
            mesh (.obj, .stl, .ply, .off, .glb, .gltf), or a function as package.module:name.
        output: Where to write the grid (.npz).
        crop: Lowest x y z and highest x y z to be kept, in the file's frame and units.
        scale: Length of a unit of the file [m].
        position: Moves the scaled field [m].
        orientation: Turns the scaled field before it is moved; quaternion w x y z.
        resolution: Nodes along the longest axis of what is not a grid already; default 128, and for meshes as
            many as their walls need.
        interpolation: Between nodes.
        hollow: Leave what Gaussian splats enclose empty. Splats are shells; otherwise it is filled.
        spacing: Voxels (.npy): distance between voxels in the file's units; default: longest side 1.
        origin: Voxels (.npy): centre of the first voxel.
        signed_distance: Voxels (.npy) are signed distances, negative inside.
        grid: OpenVDB, NanoVDB: name of the grid.
        cascade: instant-ngp: which cascade of the density grid; 0 is the finest.
        module: Weights (.pt, .pth): package.module:name of what makes their torch.nn.Module. Its code runs.
        keep_transform: nerfstudio: stay in the frame of training instead of that of the data set.
        json: Print one JSON object instead of text.
    """
    from dano.cli import _import

    options = {
        "interpolation": interpolation,
        "spacing": spacing,
        "origin": origin,
        "signed_distance": signed_distance or None,
        "grid": grid,
        "cascade": cascade,
        "module": module,
        "undo_transform": False if keep_transform else None,
    }
    return functools.partial(
        _import.import_field,
        file,
        output,
        crop=crop,
        scale=scale,
        position=position,
        orientation=orientation,
        resolution=resolution,
        hollow=hollow,
        options={name: value for name, value in options.items() if value is not None},
        as_json=json,
    )


def inspect(
    object: Positional[Path], /, png: Path | None = None, no_png: bool = False, json: bool = False
) -> Callable[[], None]:
    """Print an object's mass properties and samples, and draw it.

    Args:
        object: A neural object (.dano).
        png: Where to draw it; default: beside the object.
        no_png: Draw nothing.
        json: Print one JSON object instead of text.
    """
    from dano.cli import _objects

    return functools.partial(_objects.inspect, object, png=png, draw=not no_png, as_json=json)


def simulate(
    scene: Positional[Path],
    /,
    output: Output,
    video: Path | None = None,
    strip: Path | None = None,
    steps: int | None = None,
    timestep: float | None = None,
    slow_motion: float = 1.0,
    json: bool = False,
) -> Callable[[], None]:
    """Simulate a scene, or drop an object onto a floor.

    Args:
        scene: A scene file (.toml), or a neural object (.dano) that is dropped onto a floor.
        output: Where to write the trajectory, usually *.npz.
        video: Where to write a video (.mp4).
        strip: Where to write a picture of several moments side by side (.png).
        steps: Number of steps, instead of the scene's.
        timestep: Timestep [s], instead of the scene's.
        slow_motion: Video seconds per simulated second.
        json: Print one JSON object instead of text.
    """
    from dano.cli import _scenes

    return functools.partial(
        _scenes.simulate,
        scene,
        output,
        video=video,
        strip=strip,
        steps=steps,
        timestep=timestep,
        slow_motion=slow_motion,
        as_json=json,
    )


def identify(
    scene: Positional[Path],
    motions: Positional[tuple[Path, ...]],
    /,
    parameter: Annotated[tuple[str, ...], arg(aliases=["-p"])],
    output: Annotated[Path | None, arg(aliases=["-o"])] = None,
    report: Path | None = None,
    body: str | None = None,
    initial: Literal["given", "velocities", "states"] | None = None,
    position_noise: float | None = None,
    rotation_noise: float | None = None,
    huber: float | None = None,
    window: int | None = None,
    continuity: float | None = None,
    starts: int = 1,
    held_out: tuple[Path, ...] = (),
    order: Literal["wxyz", "xyzw"] = "wxyz",
    point: Literal["com", "origin"] | None = None,
    rate: float | None = None,
    timestep: float | None = None,
    json: bool = False,
) -> Callable[[], None]:
    """Find parameters of a scene with which its bodies move as observed, with error bars.

    Args:
        scene: Scene file (.toml).
        motions: Observed motions (.npz, .csv): times [s], positions [m], quaternions, see docs.
        parameter: What is unknown, with bounds and where to start, e.g. soap,table.sliding_friction:0:1,
            soap,table.sliding_friction:0:1:0.3 or soap.mass_scale:0.2:5; several after each other.
        output: Where to write the result (.json).
        report: Where to write a page with the motions, residuals, losses and a film (.html).
        body: Which body the motions are of, if they do not say.
        initial: What to estimate of the initial states: nothing (given), velocities, or all (states).
        position_noise: Standard deviation of observed positions [m].
        rotation_noise: Standard deviation of observed orientations [rad].
        huber: Residuals count linearly from so many standard deviations on.
        window: Frames of the windows that motions are cut into; default: whole.
        continuity: How far windows may miss the beginning of the next, in standard deviations; default: any.
        starts: Points in the bounds to start from.
        held_out: Motions not to fit, to measure the error on.
        order: Of the quaternions in the files.
        point: What positions refer to: centre of mass (com) or origin of the field's frame (origin).
        rate: Frames a second, if the files have no times.
        timestep: Of the simulation [s], instead of the file's.
        json: Print one JSON object instead of text.
    """
    from dano.cli import _identify

    return functools.partial(
        _identify.identify,
        scene,
        motions,
        parameter,
        output=output,
        report=report,
        body=body,
        held_out=held_out,
        timestep=timestep,
        as_json=json,
        noise={"position": position_noise, "orientation": rotation_noise},
        reading={"order": order, "point": point, "rate": rate},
        options={
            "initial": initial,
            "huber": huber,
            "window": window,
            "continuity": continuity,
            "starts": starts,
        },
    )


def view(run: Positional[Path], /, port: int = 8080) -> Callable[[], None]:
    """Look at a saved run in the browser.

    Args:
        run: A trajectory written by `dano simulate`.
        port: Where to serve the page on this computer.
    """
    from dano.cli import _scenes

    return functools.partial(_scenes.view, run, port=port)


def demo(
    name: Positional[Literal["all", "drop", "collision"]] = "all",
    /,
    output: Annotated[Path, arg(aliases=["-o"])] = Path("dano-demo"),
    json: bool = False,
) -> Callable[[], None]:
    """Build the shipped objects, simulate scenes of them, and draw everything.

    Args:
        name: drop: a bunny, a bar of soap and a ball fall. collision: a ball hits two bunnies. all: both.
        output: Folder for everything that is written.
        json: Print one JSON object instead of text.
    """
    from dano.cli import _scenes

    return functools.partial(_scenes.demo, name, output, as_json=json)
