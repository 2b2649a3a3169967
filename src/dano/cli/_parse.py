"""The commands' arguments, and nothing that is slow to import."""

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import arg, FlagCreatePairsOff, Positional

from dano import __version__

Output = Annotated[Path, arg(aliases=["-o"])]


def parse(argv: Sequence[str]) -> Callable[[], None]:
    """The command that the arguments ask for, ready to be called.

    Exits with code 0 after printing help, with 2 if the arguments are wrong.
    """
    if not argv:
        argv = ["--help"]
    if list(argv) == ["--version"]:
        print(f"dano {__version__}")
        raise SystemExit(0)
    commands = {
        function.__name__: function for function in (train, data, build, inspect, simulate, view, demo)
    }
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
    iterations: int = 1000,
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
    mass_model: Literal["density", "solid"] = "solid",
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
        field: Density grid (.npz with values, origin, spacing), voxels (.npy), mesh (.obj, .stl, …) or object
            (.dano).
        output: Where to write the object, usually *.dano.
        samples: Number of contact samples.
        density_range: Lower and upper density of the samples; default: around the field's own surface.
        mass_model: solid: uniform inside the surface, hollow cores filled. density: as dense as the field.
        mass_scale: Mass per unit of density and cubic metre [kg]; default 1.
        mass: Total mass [kg], instead of the mass scale.
        resolution: Cells along the longest axis for mass integrals and sampling.
        length: Scale the field so that the object's longest extent is this [m].
        floaters: Let parts apart from the largest one feel contact, too.
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
