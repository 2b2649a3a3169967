"""Write guides as notebooks: `python assets/write_notebooks.py`.

Text becomes cells of text, Python blocks become cells of code, in the order of the page. What a notebook
says is what its page says, and `tests/test_docs.py` runs the blocks of every page.
"""

import json
import re
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1] / "docs"
GUIDES = ("quickstart", "objects", "gradients", "plan", "robots", "mujoco")
"""Pages whose programs are worth to be changed and run again."""
PYTHON = re.compile(r"^```python\n(.*?)^```\n?", re.MULTILINE | re.DOTALL)
TO_PAGES = re.compile(r"\]\((?!https?:|#)")


def notebook(page: str) -> str:
    """A guide as a notebook (nbformat 4.5), which lies one folder deeper than its page."""
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    cells = []
    # Text and code take turns.
    for k, part in enumerate(PYTHON.split(text)):
        source = part.strip("\n")
        if not source:
            continue
        kind = "code" if k % 2 else "markdown"
        if kind == "markdown":
            source = TO_PAGES.sub("](../", source)
        cell = {"cell_type": kind, "id": f"cell-{len(cells)}", "metadata": {}, "source": source}
        cells.append(cell | ({"execution_count": None, "outputs": []} if kind == "code" else {}))
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    book = {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(book, ensure_ascii=False, indent=1) + "\n"


if __name__ == "__main__":
    (DOCS / "notebooks").mkdir(exist_ok=True)
    for page in GUIDES:
        (DOCS / "notebooks" / f"{page}.ipynb").write_text(notebook(page), encoding="utf-8")
