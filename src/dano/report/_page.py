"""HTML pages that need no other file.

The last page of a story: what came out, and what each stage says of itself.
Pictures of states that are not part of a run yet, one after the other.
"""

import base64
import html
import io
import os
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, UInt8

from dano.archive import checked_output, replacing
from dano.checks import checked_kind, checked_text
from dano.report._stage import framed, Seen, seen_of, stage, view_direction
from dano.report._video import checked_size
from dano.scene import Scene, State
from dano.vision import Camera, LearnedField, render


def write_grades(
    path: str | os.PathLike[str], title: str, result: str, rows: Sequence[Sequence[str]], poor: Sequence[str]
) -> None:
    """Write a page with the result and a table of stages.

    Args:
        path: An HTML file.
        title: Of the page.
        result: What came out, in a sentence.
        rows: Stage, what its number means, the number.
        poor: Stages that should not be believed.

    Raises:
        ValueError: If `path` is a directory or lies in none.
    """
    texts = [f"Stage {stage} should not be believed, and nothing that follows from it" for stage in poor]
    links = "".join(
        f'<li><a href="{name}">{name}</a>: {html.escape(what)}</li>'
        for name, what in (
            ("masks.png", "outlines must be those of the object"),
            ("motion.html", "the outline must follow the object"),
            ("story.html", "the film beside the simulation"),
        )
    )
    head = ["stage", "its number", "value"]
    write_page(
        path,
        title,
        [f"<p><b>{html.escape(result)}</b></p>", warnings(texts), table(head, rows), f"<ul>{links}</ul>"],
    )


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


_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:980px;padding:0 1rem;color:#22262b}
h1{font-size:1.5rem}h2{font-size:1.1rem;margin-top:2rem}
table{border-collapse:collapse}td,th{padding:.25rem .8rem .25rem 0;text-align:right}
td,th{border-bottom:1px solid #e5e8eb}
td:first-child,th:first-child{text-align:left}th{color:#6b747c;font-weight:500}
.views{display:flex;flex-wrap:wrap;gap:1rem}figure{margin:0}figcaption{font-size:.8rem;color:#6b747c}
img,video{max-width:100%;border:1px solid #e5e8eb}
.warn{background:#fff4e0;padding:.5rem .8rem;border-radius:4px}
"""


def write_page(path: str | os.PathLike[str], title: str, parts: Sequence[str]) -> None:
    """Write a page with a heading and parts in HTML, whole or not at all.

    Raises:
        ValueError: If `path` is a directory or lies in none, or the title is not text.
    """
    heading = html.escape(checked_text("title", title))
    page = (
        "<!doctype html><html lang='en'><meta charset='utf-8'>"
        f"<title>{heading}</title><style>{_STYLE}</style><body><h1>{heading}</h1>{''.join(parts)}</body></html>"
    )
    with replacing(path) as file:
        file.write(page.encode())


def check_page(path: str | os.PathLike[str], title: str) -> None:
    """Check where a page goes, and its title, before what is on it is drawn.

    Raises:
        ValueError: If `path` is a directory or lies in none, or the title is not text.
    """
    checked_output(path)
    checked_text("title", title)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of plain text."""
    cells = "".join(f"<th>{html.escape(x)}</th>" for x in head)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(x)}</td>" for x in row) + "</tr>" for row in rows)
    return f"<table><tr>{cells}</tr>{body}</table>"


def warnings(texts: Sequence[str]) -> str:
    """Sentences that should not be overlooked."""
    return "".join(f'<p class="warn">{html.escape(text)}</p>' for text in texts)


def image(picture: np.ndarray, width: int) -> str:
    """A picture of values from 0 to 1, shape (height, width, 3), so many CSS pixels wide."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)).save(buffer, "PNG")
    return png(buffer.getvalue(), width)


def png(data: bytes, width: int) -> str:
    """A PNG file, so many CSS pixels wide."""
    return f'<img alt="" width="{width}" src="data:image/png;base64,{base64.b64encode(data).decode()}">'


def video(data: bytes, width: int) -> str:
    """An MP4 file, so many CSS pixels wide."""
    source = f"data:video/mp4;base64,{base64.b64encode(data).decode()}"
    return f'<video controls loop muted autoplay width="{width}" src="{source}"></video>'
