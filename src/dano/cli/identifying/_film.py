"""The film that a fit is of: how the command names it, and what its pixels said."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from dano.cli._console import Progress, put
from dano.cli.identifying._arguments import Identify
from dano.cli.tracking import filming
from dano.identification import Motion, Parameter
from dano.pixels import FilmFit, identify_in_film
from dano.scene import Scene
from dano.vision import Film, LearnedField, PosedCamera


class Seen(NamedTuple):
    """A film, what is in it, from where it was taken, and what its pixels said."""

    film: Film
    look: LearnedField
    camera: PosedCamera
    found: FilmFit

    def numbers(self, command: Identify) -> dict[str, Any]:
        """What pixels said, beside the poses."""
        poses, tracked = self.found.poses, self.found.tracked
        return {
            "file": str(command.video),
            "from_poses": {name: np.asarray(value).tolist() for name, value in poses.values.items()},
            "from_poses_standard_errors": {
                name: np.asarray(value).tolist() for name, value in poses.standard_errors.items()
            },
            "passes": len(self.found.history) - 1,
            "settled": self.found.settled,
            "frames": len(tracked.status),
            "frames_used": tracked.n_tracked,
            "colour_error": float(np.nanmedian(tracked.colour_error)),
            "lamps": [
                {"towards": np.asarray(lamp.place).tolist(), "power": np.asarray(lamp.colour).tolist()}
                for lamp in self.found.lamps
            ],
        }

    def tell(self) -> None:
        """Print it."""
        poses, tracked = self.found.poses, self.found.tracked
        put(
            f"film        pixels of {tracked.n_tracked} of {len(tracked.status)} frames,"
            f" {len(self.found.history) - 1} passes{'' if self.found.settled else ', not settled'};"
            " from the poses alone:"
        )
        for name, value in poses.values.items():
            if np.ndim(value) == 0:
                put(f"{name:<32.32} {value:12.6g} {poses.standard_errors[name]:15.3g}")


def film_of(command: Identify) -> Callable[..., Seen]:
    """What fits the pixels of the film that the command names.

    Raises:
        ValueError: If the film lacks something, or is of several motions.
    """
    video = command.video
    assert video is not None
    if command.look is None:
        raise ValueError("video needs --look: what `dano train` wrote of the body in it")
    if len(command.motions) != 1:
        raise ValueError(f"video must be that of the one motion, got {len(command.motions)} motions")
    if command.resume:
        raise ValueError("resume goes on with fits of poses only: leave out --resume, or --video")
    filming.check_camera(command.filming)
    look = filming.look_of(command.look, "look")

    def fit(
        scene: Scene,
        motion: Motion,
        chosen: Sequence[Parameter],
        progress: Progress,
        settings: dict[str, Any],
    ) -> Seen:
        film = filming.filmed(command.filming, video, command.rate, progress)
        camera = filming.camera_of(command.filming, film)
        found = identify_in_film(
            scene,
            film,
            look,
            camera,
            motion,
            chosen,
            tracking=filming.options_of(command.filming),
            background=command.filming.background,
            progress=progress,
            **settings,
        )
        return Seen(film, look, camera, found)

    return fit
