"""The command's arguments, and nothing that is slow to import."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import OmitArgPrefixes, Positional

from dano.cli._arguments import Filming, Output, UNNAMED


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

    def __call__(self) -> None:
        """Run the command."""
        from dano.cli.tracking import _run

        _run.track(self)
