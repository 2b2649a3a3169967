"""Ranks of pages in search, and anchors of keys, while MkDocs builds them (`hooks` in mkdocs.yml)."""

import re
from typing import Any

API_RANK = 0.2
"""How much a page of the API counts in search beside a guide: it names everything, and explains little."""
KEYED = ("scenes.md", "joints.md", "plan.md")
"""Guides whose tables list the keys of files."""

_PART = re.compile(r'<h2 id="([^"]+)">(.*?)</h2>|<tr>\s*<td>(.*?)</td>', re.DOTALL)
_KEY = re.compile(r"<code>(\w+)(?: = [^<]*)?</code>")


def with_anchors(page: str) -> str:
    """The HTML of a page whose rows of keys can be linked to: `#bodies.mass`, `#timestep`."""
    section, taken = "", set()

    def replace(match: re.Match[str]) -> str:
        nonlocal section
        if match[1]:
            named = re.search(r"\[+([\w.]+)\]+", re.sub(r"<[^>]+>", "", match[2]))
            section = named[1] if named else ""
            return match[0]
        keys = _KEY.findall(match[3])
        anchors = [f"{section}.{key}" if section else key for key in keys]
        new = [anchor for anchor in anchors if anchor not in taken]
        taken.update(new)
        marks = "".join(f'<a id="{anchor}"></a>' for anchor in new)
        link = f'<a class="headerlink" href="#{new[0]}" title="Permanent link">¶</a>' if new else ""
        return match[0].replace(f"<td>{match[3]}</td>", f"<td>{marks}{match[3]}{link}</td>")

    return _PART.sub(replace, page)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Ranks pages of the API below guides."""
    if page.file.src_uri.startswith("api/"):
        page.meta.setdefault("search", {}).setdefault("boost", API_RANK)
    return markdown


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Gives keys of files anchors."""
    return with_anchors(html) if page.file.src_uri in KEYED else html
