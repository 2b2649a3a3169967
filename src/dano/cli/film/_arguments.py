"""The command's arguments, and nothing that is slow to import."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg, Positional

StageName = Literal["check", "cameras", "masks", "object", "motion", "friction", "scene"]
STAGES: tuple[StageName, ...] = ("check", "cameras", "masks", "object", "motion", "friction", "scene")
"""In the order in which they run."""


@dataclass(frozen=True)
class Film:
    """From photographs of an object, and a film in which it slides, to a simulation, in one go.

    A printed marker lies on the table. The walk shows object and marker from all around; the film, from a
    camera that stands still, shows how the object is pushed and slides until it rests. Stages, in their
    order: check, cameras, masks, object, motion, friction, scene. What they leave is kept in a folder beside
    the output, and taken up again when the command is repeated with the same inputs.

    Attributes:
        walk: Folder of photographs (or one with `images` in it), or a film, taken while walking around.
        slide: Film of the object that is pushed and slides.
        marker_size: Side of the black square of the printed marker [m].
        output: Where to write the object, *.dano; the other results lie in a folder beside it, soap_film for
            soap.dano.
        marker_family: Its dictionary, by OpenCV's name.
        masks: Folder with a mask for each photograph of the walk, bright where the object is; default:
            `masks` in or beside the folder of photographs, their alpha channel, or made.
        network: Segmentation network (.onnx) that makes masks; default: what stands on the table, or differs
            from a plain background.
        background: Picture of the film's place without the object.
        slow_motion: How many times slower the film plays than it was filmed.
        shutter: How long a frame of the film is exposed [s], if what moves is blurred.
        readout: How much later the last row of a frame is exposed than the first (rolling shutter) [s].
        release: When the hand lets go, as a player shows it [s]; default: when the object is fastest.
        mass: Mass of the object [kg]; default: that of water in its volume.
        resolution: Nodes along the longest side of the object.
        iterations: Largest number of training steps.
        frames: Most frames of a walk that is a film.
        first: Begin with this stage; what comes before is taken as it is, the others are made again.
        last: Stop after this stage.
        force: Go on after a stage whose number says that the rest would be vain.
        seed: Seed of all random numbers.
        json: Print one JSON object instead of text.
    """

    walk: Positional[Path]
    slide: Positional[Path]
    marker_size: float
    output: Annotated[Path, arg(aliases=["-o"])]
    marker_family: str = "DICT_APRILTAG_36h11"
    masks: Path | None = None
    network: Path | None = None
    background: Path | None = None
    slow_motion: float = 1.0
    shutter: float = 0.0
    readout: float = 0.0
    release: float | None = None
    mass: float | None = None
    resolution: int = 96
    iterations: int = 800
    frames: int = 80
    first: Annotated[StageName | None, arg(name="from")] = None
    last: Annotated[StageName | None, arg(name="to")] = None
    force: bool = False
    seed: int = 0
    json: bool = False
