"""One picture of what lies on the floor: a row for each object."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from dano.archive import replacing

_WIDTH = 250
"""Of a panel [pixels]."""
_LINES = 34
"""Room for the words under it [pixels]."""


class Panel(NamedTuple):
    """A picture with values in [0, 1], what it shows, and how it lies."""

    picture: np.ndarray
    title: str
    verdict: str


def draw(file: Path, rows: list[list[Panel]]) -> None:
    """Write the panels, lettered along each row."""
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(13)
    height = round(_WIDTH * rows[0][0].picture.shape[0] / rows[0][0].picture.shape[1])
    columns = max(map(len, rows))
    sheet = Image.new("RGB", (_WIDTH * columns, (height + _LINES) * len(rows)), "white")
    pen = ImageDraw.Draw(sheet)
    for i, row in enumerate(rows):
        for j, panel in enumerate(row):
            pixels = Image.fromarray(np.uint8(255 * panel.picture.clip(0, 1)))
            x, y = _WIDTH * j, (height + _LINES) * i
            sheet.paste(pixels.resize((_WIDTH, height), Image.Resampling.LANCZOS), (x, y))
            pen.text((x + 6, y + height + 1), f"({chr(ord('a') + j)}) {panel.title}", "black", font)
            pen.text((x + 6, y + height + 16), _shortened(panel.verdict), "dimgray", font)
    with replacing(file) as temporary:
        sheet.save(temporary, "png", optimize=True)


def _shortened(words: str, most: int = 38) -> str:
    return words if len(words) <= most else words[: most - 1] + "…"
