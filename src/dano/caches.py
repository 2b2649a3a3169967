"""Where what was computed before is kept: a folder of the user, never the one that somebody works in."""

import functools
import os
import tempfile
import warnings
from pathlib import Path

VARIABLE = "DANO_CACHE_DIR"


def cache_folder() -> Path | None:
    """The folder for caches, which exists and can be written; None if nothing is kept.

    It is `$DANO_CACHE_DIR` (`off` or empty: nothing is kept), or `dano` in `$XDG_CACHE_HOME`, or
    `.cache/dano` in the home folder. Paths that are not absolute would depend on where a program is started,
    and what lies there may be anybody's: they count as none. Where nothing can be kept, a UserWarning says so
    once.
    """
    chosen = os.environ.get(VARIABLE)
    if chosen in ("", "off"):
        return None
    try:
        usual = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
        folder = Path(chosen or Path(usual, "dano"))
    except RuntimeError:
        return _none("there is no home folder")
    if not folder.is_absolute():
        return _none(f"{folder} is not an absolute path")
    if folder == Path.cwd():
        return _none(f"{folder} is the working folder")
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        # Only writing tells: of folders on read-only systems, permissions say nothing.
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        return _none(f"{folder} cannot be written ({error.strerror or error})")
    return folder


@functools.cache
def _none(reason: str) -> None:
    """Say once why nothing is kept."""
    warnings.warn(
        f"nothing is kept for the next run, because {reason}: everything works, but starts slower."
        f" {VARIABLE} names a folder, or says off",
        UserWarning,
        stacklevel=3,
    )
