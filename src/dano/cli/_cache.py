"""`dano cache`."""

import math
import time

from dano.caches import cache_folder, CacheEntry, clear, contents, KINDS, limit
from dano.cli._arguments import Cache
from dano.cli._console import put, put_json
from dano.memory import in_bytes

_UNITS = {"B": 0, "KB": 1, "MB": 2, "GB": 3, "TB": 4}
_DAY = 86_400.0


def cache(command: Cache) -> None:
    """See `dano cache --help`."""
    if command.clear and command.limit is not None:
        raise ValueError(f"give either --clear or --limit, got both, with {command.limit}")
    kinds = command.kinds or tuple(KINDS)
    folder = cache_folder()
    if command.clear:
        removed = clear(kinds)
    elif command.limit is not None:
        removed = limit(_bytes(command.limit), kinds)
    else:
        removed = []
    kept = contents(kinds)
    if command.json:
        rows = {kind: _summary(entries) for kind, entries in kept.items()}
        put_json({"folder": folder and str(folder), "kinds": rows, "removed": _summary(removed)})
        return
    put(f"folder      {'none: nothing is kept' if folder is None else folder}")
    for kind, entries in kept.items():
        put(f"{kind:<11} {_line(entries):<28} {KINDS[kind]}")
    put(f"{'all':<11} {_line([entry for entries in kept.values() for entry in entries])}")
    if command.clear or command.limit is not None:
        put(f"removed     {_line(removed)}")


def _bytes(text: str) -> int:
    """A size in words, as 500MB or 2 GB, in bytes.

    Raises:
        ValueError: If it is not a size.
    """
    word = text.strip().upper().replace("IB", "B")
    unit = next((unit for unit in sorted(_UNITS, key=len, reverse=True) if word.endswith(unit)), "")
    try:
        number = float(word.removesuffix(unit))
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and number >= 0):
        raise ValueError(f"--limit must be a size such as 500MB or 2GB, got {text!r}")
    return int(number * 1024 ** _UNITS.get(unit, 0))


def _line(entries: list[CacheEntry]) -> str:
    if not entries:
        return "nothing"
    size, days = sum(entry.size for entry in entries), _age(entries)
    ages = "today" if days < 1 else f"used up to {days:.0f} days ago"
    return f"{len(entries):>4}, {in_bytes(size)}, {ages}"


def _age(entries: list[CacheEntry]) -> float:
    """Days since the oldest was used last."""
    return max(0.0, (time.time() - min(entry.used for entry in entries)) / _DAY)


def _summary(entries: list[CacheEntry]) -> dict[str, int | float]:
    days = _age(entries) if entries else 0.0
    return {"entries": len(entries), "bytes": sum(entry.size for entry in entries), "oldest_days": days}
