"""Contact points and forces drawn over pictures."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from dano.report._stage import Touches
from dano.vision import AbstractCamera

# Colours, chosen by eye.
_DOT = (24, 26, 30)
_ARROW = (214, 40, 57)
# Drawn this many times larger and then reduced: Pillow's lines are not smooth.
_FINE = 3


def draw_touches(
    picture: UInt8[np.ndarray, "height width 3"],
    camera: AbstractCamera,
    touched: Touches,
    frame: int,
    length: float,
) -> UInt8[np.ndarray, "height width 3"]:
    """The picture with a dot and a force arrow at every contact of one frame.

    Args:
        picture: sRGB.
        camera: From where it was taken.
        touched: Contacts of all frames.
        frame: Which frame.
        length: Length [m] of the arrow of a usual force.
    """
    from PIL import Image, ImageDraw

    rows = np.flatnonzero(touched.shares[frame] > 0.02)
    if len(rows) == 0:
        return picture
    force = touched.forces[frame, rows]
    direction = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-12)
    tails = touched.points[frame, rows]
    # Towards the upper side, so that the arrow is not under the floor.
    direction = np.where(direction[:, 2:] < -0.05, -direction, direction)
    heads = tails + length * touched.shares[frame, rows, None] * direction
    ends = [camera.project(tails)[:, :2], camera.project(heads)[:, :2]]
    layer = Image.new("L", (camera.width * _FINE, camera.height * _FINE), 0)
    dots = Image.new("L", layer.size, 0)
    for tail, head in zip(*ends, strict=True):
        if np.all(np.isfinite([tail, head])):
            _arrow(ImageDraw.Draw(layer), tail * _FINE, head * _FINE, camera.height * _FINE / 400)
            radius = 2.6 * camera.height * _FINE / 400
            box = [*(tail * _FINE - radius), *(tail * _FINE + radius)]
            ImageDraw.Draw(dots).ellipse(box, fill=255)
    result = Image.fromarray(picture)
    for mask, colour in ((layer, _ARROW), (dots, _DOT)):
        result.paste(colour, mask=mask.resize(result.size, Image.Resampling.BOX))
    return np.asarray(result)


def draw_clock(
    picture: UInt8[np.ndarray, "height width 3"], camera: AbstractCamera, time: float, distance: float
) -> UInt8[np.ndarray, "height width 3"]:
    """The picture with the time and a bar that says how long things are, in its lower corners.

    Args:
        picture: sRGB.
        camera: From where it was taken.
        time: Of the frame [s].
        distance: From the camera at which the bar has its length [m].
    """
    from PIL import Image, ImageDraw, ImageFont

    result = Image.fromarray(picture)
    draw = ImageDraw.Draw(result)
    height = camera.height
    font, margin = ImageFont.load_default(size=_letters(height)), height / 30
    base = height - margin
    draw.text((margin, base), f"{time:.2f} s", font=font, fill=_DOT, anchor="ls")
    metre = 1 / (camera.pixel_angle * distance)
    length = round_below(camera.width / 5 / metre)
    right, left = camera.width - margin, camera.width - margin - length * metre
    draw.line([left, base, right, base], fill=_DOT, width=max(2, height // 200))
    draw.text((right, base - height / 60), length_text(length), font=font, fill=_DOT, anchor="rs")
    return np.asarray(result)


def draw_label(
    picture: UInt8[np.ndarray, "height width 3"], text: str
) -> UInt8[np.ndarray, "height width 3"]:
    """The picture with a text in its upper left corner, without its beginning if it is too long."""
    from PIL import Image, ImageDraw, ImageFont

    result = Image.fromarray(picture)
    height, width, _ = picture.shape
    font, margin = ImageFont.load_default(size=_letters(height)), height / 30
    shown = text = " ".join(text.split())
    while text and font.getlength(shown) > width - 2 * margin:
        text = text[1:]
        shown = f"…{text}"
    ImageDraw.Draw(result).text((margin, margin), shown, font=font, fill=_DOT, anchor="la")
    return np.asarray(result)


def _letters(height: int) -> float:
    """Size of letters [pixels] in a picture of a height."""
    return max(10.0, height / 24)


def round_below(x: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above x > 0."""
    power = 10.0 ** np.floor(np.log10(x))
    return float(max(k * power for k in (1, 2, 5) if k * power <= x * (1 + 1e-12)))


def length_text(length: float) -> str:
    """A length [m] with the unit that it is usually said in."""
    for unit, name in ((1.0, "m"), (1e-2, "cm")):
        if length >= unit * (1 - 1e-9):
            return f"{length / unit:.4g} {name}"
    return f"{length / 1e-3:.4g} mm"


def _arrow(draw, tail: np.ndarray, head: np.ndarray, scale: float) -> None:
    """A line with a filled head, in pixels of the fine layer."""
    along = head - tail
    size = float(np.linalg.norm(along))
    if size < 1e-6:
        return
    along = along / size
    across = np.array([-along[1], along[0]])
    tip = min(7.0 * scale, 0.6 * size)
    neck = head - tip * along
    draw.line([*tail, *neck], fill=255, width=max(int(round(2.0 * scale)), 1))
    draw.polygon(
        [tuple(head), tuple(neck + 0.45 * tip * across), tuple(neck - 0.45 * tip * across)], fill=255
    )


def side_by_side(images: Sequence[np.ndarray], per_row: int | None = None) -> np.ndarray:
    """Pictures from left to right with a thin white line between them; default: three a row."""
    per_row = per_row or (3 if len(images) > 3 else len(images))
    height, width, _ = images[0].shape
    n_rows = -(-len(images) // per_row)
    gap = _gap(height)
    sheet = np.full((n_rows * (height + gap) - gap, per_row * (width + gap) - gap, 3), 255, dtype=np.uint8)
    for i, image in enumerate(images):
        top, left = (i // per_row) * (height + gap), (i % per_row) * (width + gap)
        sheet[top : top + height, left : left + width] = image
    return sheet


def _gap(height: int) -> int:
    """Pixels between pictures: an even number, as codecs want the whole to be."""
    return 2 * max(1, height // 200)
