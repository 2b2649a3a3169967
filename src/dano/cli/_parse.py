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
    commands = {function.__name__: function for function in (build, inspect, simulate, view, demo)}
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
