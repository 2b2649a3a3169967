"""Arguments of `dano track` and how films were taken, and nothing that is slow to import."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg, OmitArgPrefixes, Positional

from dano.cli._arguments import Output, UNNAMED


@dataclass(frozen=True)
class Filming:
    """How the film was taken, and what tells the object from the rest."""

    # Intrinsics and pose of the camera: a .json file as of `dano poses`, with one frame, or FILE:PICTURE,
    # such as walk.json:film.png, for that of one of several.
    camera: Path | None = None
    focal: tuple[float, ...] = ()  # Focal length, or two, across and down [pixels], instead of --camera
    centre: tuple[float, float] | None = None  # Principal point [pixels]; default: the middle
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # k1 k2 p1 p2 of OpenCV's model
    eye: tuple[float, float, float] | None = None  # Where the camera is [m], z up, instead of --camera
    look_at: tuple[float, float, float] = (0.0, 0.0, 0.0)  # Where it looks [m]
    masks: Path | None = None  # Folder with a mask for each frame, bright where the object is
    # Where masks come from: given, static (unlike the place without the object), plain (unlike a background
    # of one colour), object (like the object where it is expected); auto: given ones, else plain, else
    # object.
    mask_source: Literal["auto", "given", "static", "plain", "object"] = "auto"
    background: Path | None = None  # Picture of the place without the object
    # Folder with a mask for each frame, bright where something hides the object.
    occluders: Path | None = None
    slow_motion: float = 1.0  # How many times slower the video plays than it was filmed
    shutter: float = 0.0  # How long a frame is exposed [s], if what moves is blurred
    # How much later the last row of a frame is exposed than the first (rolling shutter) [s].
    readout: float = 0.0
    # Height z of a level table under the object [m]: it lies and slides there, and its shadow says where the
    # sun is.
    table: float | None = None
    every: int = 1  # Take every so many-th frame
    # Take frames from this time on [s], as a player shows it.
    since: Annotated[float | None, arg(name="from")] = None
    until: Annotated[float | None, arg(name="to")] = None  # Take frames up to this time [s]
    # What is minimised: photometric, silhouette, or the paper's two terms.
    loss: Literal["photometric", "silhouette", "paper"] = "photometric"
    rays: int = 2048  # Most pixels of a frame
    seed: int = 0  # Seed of all random numbers


@dataclass(frozen=True)
class Track:
    """Find the pose of a learned object in every frame of a film by a camera that stands still."""

    video: Positional[Path]  # The film: a video, or a folder of frames (then give --rate)
    object: Positional[str]  # What `dano train` wrote (.dano or .field.npz), or trained_bunny or trained_soap
    output: Output = UNNAMED  # Where to write the motion (.npz), for `dano identify`
    report: Path | None = None  # Where to write a page with the silhouettes over the frames (.html)
    rate: float | None = None  # Frames a second; default: the times in the video
    body: str | None = None  # Name of the body in the motion; default: the object's
    # Rough pose in the first frame: x y z [m] and qw qx qy qz; default: searched.
    start: tuple[float, float, float, float, float, float, float] | None = None
    filming: OmitArgPrefixes[Filming] = Filming()  # How the film was taken
    json: bool = False  # Print one JSON object instead of text
