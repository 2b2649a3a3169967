"""Arguments of `dano track` and how films were taken, and nothing that is slow to import."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg, OmitArgPrefixes, Positional

from dano.cli._arguments import Output, UNNAMED


@dataclass(frozen=True)
class Filming:
    """How the film was taken, and what tells the object from the rest.

    Attributes:
        camera: Intrinsics and pose of the camera: a .json file as of `dano poses`, with one frame, or
            FILE:PICTURE, such as walk.json:film.png, for that of one of several.
        focal: Focal length, or two, across and down [pixels], instead of --camera.
        centre: Principal point [pixels]; default: the middle.
        distortion: k1 k2 p1 p2 of OpenCV's model.
        eye: Where the camera is [m], z up, instead of --camera.
        look_at: Where it looks [m].
        masks: Folder with a mask for each frame, bright where the object is.
        mask_source: Where masks come from: given, static (unlike the place without the object), plain (unlike
            a background of one colour), object (like the object where it is expected); auto: given ones, else
            plain, else object.
        background: Picture of the place without the object.
        occluders: Folder with a mask for each frame, bright where something hides the object.
        slow_motion: How many times slower the video plays than it was filmed.
        shutter: How long a frame is exposed [s], if what moves is blurred.
        readout: How much later the last row of a frame is exposed than the first (rolling shutter) [s].
        table: Height z of a level table under the object [m]: it lies and slides there, and its shadow says
            where the sun is.
        every: Take every so many-th frame.
        since: Take frames from this time on [s], as a player shows it.
        until: Take frames up to this time [s].
        loss: What is minimised: photometric, silhouette, or the paper's two terms.
        rays: Most pixels of a frame.
        seed: Seed of all random numbers.
    """

    camera: Path | None = None
    focal: tuple[float, ...] = ()
    centre: tuple[float, float] | None = None
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    eye: tuple[float, float, float] | None = None
    look_at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    masks: Path | None = None
    mask_source: Literal["auto", "given", "static", "plain", "object"] = "auto"
    background: Path | None = None
    occluders: Path | None = None
    slow_motion: float = 1.0
    shutter: float = 0.0
    readout: float = 0.0
    table: float | None = None
    every: int = 1
    since: Annotated[float | None, arg(name="from")] = None
    until: Annotated[float | None, arg(name="to")] = None
    loss: Literal["photometric", "silhouette", "paper"] = "photometric"
    rays: int = 2048
    seed: int = 0


@dataclass(frozen=True)
class Track:
    """Find the pose of a learned object in every frame of a film by a camera that stands still.

    Attributes:
        video: The film: a video, or a folder of frames (then give --rate).
        object: What `dano train` wrote (.dano or .field.npz), or trained_bunny or trained_soap.
        output: Where to write the motion (.npz), for `dano identify`.
        report: Where to write a page with the silhouettes over the frames (.html).
        rate: Frames a second; default: the times in the video.
        body: Name of the body in the motion; default: the object's.
        start: Rough pose in the first frame: x y z [m] and qw qx qy qz; default: searched.
        filming: How the film was taken.
        json: Print one JSON object instead of text.
    """

    video: Positional[Path]
    object: Positional[str]
    output: Output = UNNAMED
    report: Path | None = None
    rate: float | None = None
    body: str | None = None
    start: tuple[float, float, float, float, float, float, float] | None = None
    filming: OmitArgPrefixes[Filming] = Filming()
    json: bool = False
