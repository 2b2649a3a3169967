"""From where a page opens: one camera for wide windows, one for upright ones, as phones have."""

import json
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from dano.vision import Camera

_WIDE, _UPRIGHT = (3, 2), (1, 2)
"""Width and height of the windows that the two cameras are made for (convention)."""

_NARROW, _COVERED = 576, 0.6
"""In windows up to so wide [px] viser's controls cover that share of the height, from below (viser 1.1)."""

_CHOICE = """<script>
(() => {
  const start = "START", query = new URLSearchParams(location.search), shape = innerWidth / innerHeight;
  window.stepBack = shape < 1 ? start.stepBack * Math.max(1, start.shape / shape) : 1;
  if (window.stepBack === 1 || query.has("initialCameraPosition")) return;
  const back = Math.max(1, start.shape / shape);
  const from = start.lookAt.map((x, i) => x + back * (start.position[i] - x));
  query.set("initialCameraPosition", from.join(","));
  query.set("initialCameraLookAt", start.lookAt.join(","));
  history.replaceState(null, "", "?" + query + location.hash);
})();
</script>
"""


class Place(NamedTuple):
    """A camera."""

    position: Float[np.ndarray, "3"]  # Where it stands [m, W]
    look_at: Float[np.ndarray, "3"]  # What it looks at [m, W]

    @property
    def distance(self) -> float:
        """From what it looks at [m]."""
        return float(np.linalg.norm(self.position - self.look_at))


class Opening(NamedTuple):
    """Where a page opens."""

    wide: Place  # In windows that are wider than high
    upright: Place  # In others

    def in_page(self, page: str) -> str:
        """A page in one file, which chooses when it is opened."""
        start = {
            "position": self.upright.position.tolist(),
            "lookAt": self.upright.look_at.tolist(),
            "shape": _UPRIGHT[0] / _UPRIGHT[1],
            "stepBack": self.upright.distance / self.wide.distance,
        }
        before, head, after = page.partition("<head>")
        return before + head + _CHOICE.replace('"START"', json.dumps(start), 1) + after

    def choose(self, client: Any) -> None:
        """Move the camera of a window that has just been opened, if it is upright.

        On a phone what is shown is above the controls, not behind them.
        """
        camera, shape = client.camera, client.camera.aspect
        if shape >= 1 or shape <= 0:
            return
        back = max(1.0, _UPRIGHT[0] / _UPRIGHT[1] / shape)
        ahead = self.upright.look_at - self.upright.position
        lower = np.zeros(3)
        if camera.image_width <= _NARROW:
            right = np.cross(ahead, (0.0, 0.0, 1.0))
            above = np.cross(right, ahead)
            half = back * float(np.linalg.norm(ahead)) * np.tan(0.5 * camera.fov)
            lower = -_COVERED * half * above / max(float(np.linalg.norm(above)), 1e-12)
        camera.position = self.upright.look_at - back * ahead + lower
        # Moving a camera moves what it looks at.
        camera.look_at = self.upright.look_at + lower


def open_on(
    server: Any,
    centres: Float[np.ndarray, "n 3"],
    radii: Float[np.ndarray, " n"],
    margin: float,
    *,
    level: bool = False,
) -> Opening:
    """Let a page open with all of some balls in view.

    Args:
        server: Of viser.
        centres: Their centres [m, W].
        radii: Their radii [m].
        margin: Share of the window kept free on each side.
        level: Whether to turn the camera until there is as much room above as below.
    """
    places = []
    for width, height in (_WIDE, _UPRIGHT):
        camera = Camera.framing(centres, radii, width=width, height=height, margin=margin)
        place = Place(camera.position, camera.look_at)
        if level:
            seen = camera.project(centres)[:, :2]
            middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
            ahead = place.distance * camera.directions(middle[None])[0]
            place = Place(place.position, place.position + ahead)
        places.append(place)
    opening = Opening(*places)
    start = server.initial_camera
    start.up, start.fov = (0.0, 0.0, 1.0), camera.vertical_fov
    start.position, start.look_at = tuple(opening.wide.position), tuple(opening.wide.look_at)
    server.on_client_connect(opening.choose)
    return opening
