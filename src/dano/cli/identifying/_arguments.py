"""The command's arguments, and nothing that is slow to import."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg, OmitArgPrefixes, Positional

from dano.cli.tracking import Filming


@dataclass(frozen=True)
class Identify:
    """Find the parameters of a scene from observed motions of its bodies, with error bars.

    Or mass, centre of mass and inertia of what a robot holds, from a log of its wrist's forces and torques.

    Attributes:
        scene: Scene file (.toml). Or a wrist's log (.csv) with nothing else: time, the sensor's pose (x, y,
            z, qw, qx, qy, qz), fx, fy, fz [N] and mx, my, mz [N m].
        motions: Observed motions (.npz, .csv, .txt, .tum): times [s], positions [m], quaternions. The guide
            "Identification" lists the columns.
        parameter: Unknown parameters, each as NAME:LOWER:UPPER or NAME:LOWER:UPPER:START, e.g.
            soap,table.sliding_friction:0:1 or soap.mass_scale:0.2:5:1.
        output: Where to write the result (.json).
        report: Where to write a page with the motions, residuals, losses and films (.html).
        body: Name of the body that moved, for files that do not name it.
        initial: What to estimate of the initial states: nothing (given), velocities, or all (states);
            default: velocities if the motions have none, else nothing.
        position_noise: Standard deviation of observed positions [m].
        rotation_noise: Standard deviation of observed orientations [rad].
        huber: Number of standard deviations beyond which residuals count linearly.
        independent: Between what errors are independent: all observed numbers, windows, or motions.
        window: Cut motions into windows of this many frames; default: do not cut.
        continuity: Allowed gap between a window's end and the next one's start, in standard deviations;
            default: any.
        starts: Number of points within the bounds to start from; default: one, of one or two parameters with
            bounds the best of 16.
        held_out: Motions that are not fitted; the error on them is measured.
        order: Order of the quaternions in .npz files; default: wxyz, unless they cannot be meant so.
        point: What positions refer to: centre of mass (com) or origin of the field's frame (origin).
        rate: Frames per second, for files without times.
        time_unit: Unit of the times in the files; default: as their columns say, or as their size tells.
        length_unit: Unit of positions and velocities in the files; default likewise.
        timestep: Timestep of the simulation [s]; default: the scene's.
        frame: Axes of a wrist's forces and torques: of its sensor, or of the world.
        video: The film that the one motion was tracked in: its pixels are fitted through the simulation.
            Needs --look and --camera.
        look: What the body in the film looks like: what `dano train` wrote, or trained_bunny or trained_soap.
        filming: How the film was taken.
        resume: Go on with a search that was interrupted or killed; the result is the same.
        json: Print one JSON object instead of text.
    """

    scene: Positional[Path]
    motions: Positional[tuple[Path, ...]] = ()
    parameter: Annotated[tuple[str, ...], arg(aliases=["-p"])] = ()
    output: Annotated[Path | None, arg(aliases=["-o"])] = None
    report: Path | None = None
    body: str | None = None
    initial: Literal["given", "velocities", "states"] | None = None
    position_noise: float | None = None
    rotation_noise: float | None = None
    huber: float | None = None
    independent: Literal["numbers", "windows", "motions"] = "numbers"
    window: int | None = None
    continuity: float | None = None
    starts: int | None = None
    held_out: tuple[Path, ...] = ()
    order: Literal["wxyz", "xyzw"] | None = None
    point: Literal["com", "origin"] | None = None
    rate: float | None = None
    time_unit: Literal["s", "ms", "us", "ns"] | None = None
    length_unit: Literal["m", "cm", "mm"] | None = None
    timestep: float | None = None
    frame: Literal["sensor", "world"] = "sensor"
    video: Path | None = None
    look: str | None = None
    filming: OmitArgPrefixes[Filming] = Filming()
    resume: bool = False
    json: bool = False
