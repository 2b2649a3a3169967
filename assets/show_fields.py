"""What comments say of the fields of a class, as the table of its page in docs/api: for griffe."""

import ast
import re
from collections.abc import Sequence
from typing import Any

from griffe import Class, Extension


def field_comments(node: ast.ClassDef, lines: Sequence[str]) -> dict[str, str]:
    """What stands beside each public field of a class, or else in the lines of comments above it.

    Args:
        node: The class.
        lines: Of its file.
    """
    found = {}
    for field in node.body:
        if not isinstance(field, ast.AnnAssign) or not isinstance(field.target, ast.Name):
            continue
        first, last = field.lineno - 1, field.end_lineno or field.lineno
        if beside := re.match(r"\s*# (.*)", lines[last - 1].encode()[field.end_col_offset :].decode()):
            words = [beside[1]]
        else:
            above = first
            while above and lines[above - 1].lstrip().startswith("# "):
                above -= 1
            words = [line.strip()[2:] for line in lines[above:first]]
        if words and not field.target.id.startswith("_"):
            found[field.target.id] = " ".join(words)
    return found


class ShowFields(Extension):
    """Adds them to docstrings of classes, as their section "Attributes"."""

    def on_class_members(self, *, node: Any, cls: Class, **_: Any) -> None:
        """Called by griffe when a class is read."""
        if not isinstance(node, ast.ClassDef) or isinstance(cls.filepath, list) or cls.docstring is None:
            return
        if comments := field_comments(node, cls.lines_collection[cls.filepath]):
            rows = [f"    {name}: {text.rstrip('.')}." for name, text in comments.items()]
            cls.docstring.value += "\n\nAttributes:\n" + "\n".join(rows)
