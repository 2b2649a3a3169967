"""Puts the client of viser into the page of the scene on the home page, while MkDocs builds it (`hooks`)."""

import logging
import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

PAGE = "scene.html"
_LARGE = 1000
_MARK = "<!-- client of viser, part {} -->"


def _client() -> list[str] | None:
    """The large parts of viser's client; what dano and a run add lies between them."""
    spec = find_spec("viser")
    if spec is None or spec.origin is None:
        return None
    text = (Path(spec.origin).parent / "client" / "build" / "index.html").read_text(encoding="utf-8")
    # Dano writes behind the first and the third of these words and before the last, and changes the title.
    parts = re.split(r"<head>|<title>Viser</title>|</head>", text.rpartition("</body>")[0], maxsplit=3)
    return [part for part in parts if len(part) > _LARGE]


def without_client(page: str) -> str:
    """A page of `run.show` with a mark in place of each part of the client.

    Raises:
        ValueError: If the page is of another version of viser.
    """
    for i, part in enumerate(_client() or ()):
        if page.count(part) != 1:
            raise ValueError(f"part {i} of viser's client is {page.count(part)} times in the page, not once")
        page = page.replace(part, _MARK.format(i))
    return page


def with_client(page: str) -> str | None:
    """The page as it was; None without viser."""
    parts = _client()
    if parts is None:
        return None
    for i, part in enumerate(parts):
        page = page.replace(_MARK.format(i), part)
    return page


def on_post_build(config: Any, **_: Any) -> None:
    """Completes the page in the finished site."""
    path = Path(config["site_dir"]) / PAGE
    whole = with_client(path.read_text(encoding="utf-8"))
    if whole is None:
        logging.getLogger("mkdocs.hooks").info(
            "viser is not installed: the scene on the home page stays empty"
        )
        whole = "<p>The scene needs viser where the site is built: pip install viser</p>"
    path.write_text(whole, encoding="utf-8")
