"""The last page of a story: what came out, and what each stage says of itself."""

import html
import os
from collections.abc import Sequence

from dano.report._page import table, warnings, write_page


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
