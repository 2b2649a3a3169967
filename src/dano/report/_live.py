"""Pictures of states that are not part of a run yet, one after the other."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, UInt8

from dano.checks import checked_kind
from dano.report._framing import framed, Seen, seen_of, view_direction
from dano.report._stage import stage
from dano.report._video import checked_size
from dano.scene import Scene, State
from dano.vision import Camera, LearnedField, render


class Pictures:
    """Draws states of a scene (host).

    The camera stands where it sees all of the first state, and follows bodies where they would leave the
    picture.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        size: tuple[int, int] = (640, 400),
        camera: Camera | None = None,
        colours: Mapping[str, str] | None = None,
        looks: Mapping[str, LearnedField] | None = None,
    ):
        """Prepare pictures.

        Args:
            scene: The scene.
            size: Width and height [pixels], even numbers.
            camera: From where, in place of `size`.
            colours: "#rrggbb" by body name.
            looks: What bodies have learned to look like, by name, as in `render_trajectory`.

        Raises:
            ValueError: If nothing of the scene can be drawn, a name is of no body, or the size is wrong.
        """
        self._scene = checked_kind("scene", scene, Scene)
        self._size = checked_size(size)
        self._given = None if camera is None else checked_kind("camera", camera, Camera)
        self._drawn = stage(scene, colours, looks)
        self.begin()

    def begin(self) -> None:
        """Forget where bodies have been."""
        self._camera = self._given
        self._away = 1.0

    def of(self, state: State) -> UInt8[np.ndarray, "height width 3"]:
        """An sRGB picture of a state.

        Raises:
            ValueError: If the state does not fit the scene.
        """
        self._scene.check_state(state)
        position = np.asarray(state.position, np.float64)
        orientation = np.asarray(state.orientation, np.float64)
        camera = self._given or self._seeing(
            seen_of(self._scene, self._drawn, position[None], orientation[None])
        )
        return render(self._drawn.posed(position, orientation), camera, floor=False)

    def _seeing(self, seen: Seen) -> Camera:
        """The camera of the picture before, shifted no further than it must be."""
        points = seen.points
        if self._camera is None:
            self._camera = framed(points, view_direction(seen), *self._size)
            self._away = _distance(self._camera, self._camera.position, points)
        elif not _within(self._camera, points):
            self._camera = _shifted(self._camera, points, self._away)
        return self._camera


def _within(camera: Camera, points: Float[np.ndarray, "n 3"]) -> bool:
    places = camera.project(points)[:, :2]
    return bool(np.all((places > 0) & (places < [camera.width, camera.height])))


def _distance(camera: Camera, place: np.ndarray, points: Float[np.ndarray, "n 3"]) -> float:
    """How far ahead of a place points are on average, as a camera looks [m]; not zero."""
    if not len(points):
        return 1.0
    return max(float((points.mean(axis=0) - place) @ camera.axes[2]), 1e-6)


def _shifted(camera: Camera, points: Float[np.ndarray, "n 3"], away: float) -> Camera:
    """The camera moved towards where it sees all points from its direction, until it does.

    Places from where all points are seen are a convex cone, which the nearest one is the tip of.

    Args:
        camera: Before.
        points: To be seen [m, W].
        away: How far it stands from them at least [m].
    """
    ahead = camera.axes[2]
    nearest = framed(points, ahead, camera.width, camera.height).position
    there = nearest - max(0.0, away - _distance(camera, nearest, points)) * ahead

    off = max(away, _distance(camera, nearest, points))
    # At this distance from where it was, too, so that nothing becomes small.
    here = camera.position + (float((points.mean(axis=0) - camera.position) @ ahead) - off) * ahead

    def moved(share: float) -> Camera:
        place = here + share * (there - here)
        return Camera(place, place + off * ahead, width=camera.width, height=camera.height)

    low, high = 0.0, 1.0
    for _ in range(12):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _within(moved(middle), points) else (middle, high)
    return moved(high)
