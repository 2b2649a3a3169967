"""HTML pages that need no other file."""

import base64
import html
import io
import os
from collections.abc import Sequence

import numpy as np

from dano.archive import checked_output, replacing
from dano.checks import checked_text

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
