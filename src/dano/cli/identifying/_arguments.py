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
    """

    # Scene file (.toml). Or a wrist's log (.csv) with nothing else: time, the sensor's pose (x, y, z, qw, qx,
    # qy, qz), fx, fy, fz [N] and mx, my, mz [N m].
    scene: Positional[Path]
    # Observed motions (.npz, .csv, .txt, .tum): times [s], positions [m], quaternions. The guide
    # "Identification" lists the columns.
    motions: Positional[tuple[Path, ...]] = ()
    # Unknown parameters, each as NAME:LOWER:UPPER or NAME:LOWER:UPPER:START, e.g.
    # soap,table.sliding_friction:0:1 or soap.mass_scale:0.2:5:1.
    parameter: Annotated[tuple[str, ...], arg(aliases=["-p"])] = ()
    output: Annotated[Path | None, arg(aliases=["-o"])] = None  # Where to write the result (.json)
    report: Path | None = None  # Where to write a page with the motions, residuals, losses and films (.html)
    body: str | None = None  # Name of the body that moved, for files that do not name it
    # What to estimate of the initial states: nothing (given), velocities, or all (states); default:
    # velocities if the motions have none, else nothing.
    initial: Literal["given", "velocities", "states"] | None = None
    position_noise: float | None = None  # Standard deviation of observed positions [m]
    rotation_noise: float | None = None  # Standard deviation of observed orientations [rad]
    huber: float | None = None  # Number of standard deviations beyond which residuals count linearly
    # Between what errors are independent: all observed numbers, windows, or motions.
    independent: Literal["numbers", "windows", "motions"] = "numbers"
    window: int | None = None  # Cut motions into windows of this many frames; default: do not cut
    # Allowed gap between a window's end and the next one's start, in standard deviations; default: any.
    continuity: float | None = None
    # Number of points within the bounds to start from; default: one, of one or two parameters with bounds the
    # best of 16.
    starts: int | None = None
    held_out: tuple[Path, ...] = ()  # Motions that are not fitted; the error on them is measured
    # Order of the quaternions in .npz files; default: wxyz, unless they cannot be meant so.
    order: Literal["wxyz", "xyzw"] | None = None
    # What positions refer to: centre of mass (com) or origin of the field's frame (origin).
    point: Literal["com", "origin"] | None = None
    rate: float | None = None  # Frames per second, for files without times
    # Unit of the times in the files; default: as their columns say, or as their size tells.
    time_unit: Literal["s", "ms", "us", "ns"] | None = None
    # Unit of positions and velocities in the files; default likewise.
    length_unit: Literal["m", "cm", "mm"] | None = None
    timestep: float | None = None  # Timestep of the simulation [s]; default: the scene's
    # Axes of a wrist's forces and torques: of its sensor, or of the world.
    frame: Literal["sensor", "world"] = "sensor"
    # The film that the one motion was tracked in: its pixels are fitted through the simulation. Needs --look
    # and --camera.
    video: Path | None = None
    # What the body in the film looks like: what `dano train` wrote, or trained_bunny or trained_soap.
    look: str | None = None
    filming: OmitArgPrefixes[Filming] = Filming()  # How the film was taken
    resume: bool = False  # Go on with a search that was interrupted or killed; the result is the same
    json: bool = False  # Print one JSON object instead of text
