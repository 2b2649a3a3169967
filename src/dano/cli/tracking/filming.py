"""A film, its camera and the object in it, as commands name them."""

from pathlib import Path

import numpy as np

from dano import vision
from dano.cli._outputs import chosen
from dano.cli.tracking._arguments import Filming
from dano.progress import Progress
from dano.scene_file import asset_look


def check_camera(filming: Filming) -> None:
    """Refuse no camera, and two.

    Raises:
        ValueError: If it is not said from where the film was taken, or twice.
    """
    if (filming.camera is None) == (filming.eye is None or not filming.focal):
        raise ValueError(
            "camera: give either --camera FILE, or --focal with --eye (and --look-at), to say from where the"
            " film was taken"
        )


def filmed(filming: Filming, video: Path, rate: float | None, progress: Progress) -> vision.Film:
    """The frames of a video or a folder, as if the camera had kept the direction of the first one."""
    film = vision.read_film(
        video,
        rate=rate,
        slow_motion=filming.slow_motion,
        every=filming.every,
        since=filming.since,
        until=filming.until,
        masks=filming.masks,
        occluders=filming.occluders,
        progress=progress,
    )
    return vision.steady_film(film, camera_of(filming, film), filming.background, filming.readout)


def options_of(filming: Filming) -> vision.TrackOptions:
    """How frames are compared with the object."""
    return chosen(vision.TrackOptions, filming, masks=filming.mask_source)


def focal_of(numbers: tuple[float, ...]) -> float | tuple[float, float] | None:
    """Focal lengths as options give them: one number, two, or None for none.

    Raises:
        ValueError: If there are more.
    """
    match numbers:
        case ():
            return None
        case (focal,):
            return focal
        case (across, down):
            return across, down
    raise ValueError(f"focal must be one number or two [pixels], got {len(numbers)}")


def camera_of(filming: Filming, film: vision.Film) -> vision.PosedCamera:
    """The camera that took a film.

    Raises:
        ValueError: If the focal length is more than two numbers, or the file is not one of a camera.
    """
    width, height = (n * film.shrunk for n in film.size)
    if filming.camera is not None:
        file, frame = named_frame(filming.camera)
        return vision.load_camera(file, width, height, frame=frame)
    assert filming.eye is not None
    axes = vision.Camera(filming.eye, filming.look_at, width=width, height=height).axes
    pose = np.concatenate([axes.T * np.array([1.0, 1.0, -1.0]), np.array(filming.eye)[:, None]], axis=1)
    k1, k2, p1, p2 = filming.distortion
    focal = focal_of(filming.focal)
    assert focal is not None
    return vision.PosedCamera(
        pose,
        focal=focal,
        width=width,
        height=height,
        centre=filming.centre,
        distortion=(k1, k2, 0.0, p1, p2),
    )


def named_frame(camera: Path) -> tuple[Path, str | None]:
    """A file of cameras, and the picture whose camera is meant, if FILE:PICTURE says one."""
    file, colon, frame = str(camera).rpartition(":")
    # A file may have a colon in its name, or a drive before it.
    if camera.exists() or not colon or not file.lower().endswith(".json"):
        return camera, None
    return Path(file), frame


def look_of(name: str, argument: str) -> vision.LearnedField:
    """A learned object: from a file, or one that is shipped.

    Raises:
        ValueError: If it has no learned look; the message names the argument.
    """
    path = Path(name)
    if not path.suffix:
        look = asset_look(name)
        if look is not None:
            return look
    elif path.suffix.lower() == ".dano":
        look = vision.LearnedField.of_object(path)
        if look is not None:
            return look
    else:
        return vision.LearnedField.load(path)
    raise ValueError(
        f"{argument} must have a learned look (a .dano or .field.npz file of `dano train`, or trained_bunny,"
        f" trained_soap), got {name}, which has none"
    )
