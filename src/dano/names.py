"""Names that were meant, in messages about names that are unknown."""

import difflib
from collections.abc import Iterable


def did_you_mean(name: object, valid: Iterable[str]) -> str:
    """What to append, such as "; did you mean 'radius'?" where a valid name is nearly the given one."""
    if not isinstance(name, str):
        return ""
    lower = {word.lower(): word for word in valid}
    near = difflib.get_close_matches(name.lower(), lower, n=1, cutoff=0.7)
    return f"; did you mean {lower[near[0]]!r}?" if near else ""
