"""Checks before any work starts: where results go, and whether what draws them is installed."""

from importlib.util import find_spec
from pathlib import Path

from dano.archive import checked_output


def check_output(path: Path, *inputs: Path, suffix: str | None = None) -> None:
    """Check that a file can be written.

    Args:
        path: Where to.
        inputs: Files that must not be overwritten.
        suffix: How the name must end, if it matters.

    Raises:
        ValueError: If the path is a directory, its parent does not exist, it is one of the inputs, or it ends
            otherwise.
    """
    checked_output(path)
    for source in inputs:
        if path.exists() and source.exists() and path.samefile(source):
            raise ValueError(f"output path must not be the input, got {path} for both")
    if suffix is not None and path.suffix.lower() != suffix:
        raise ValueError(f"output path must end in {suffix}, got {path}")


def missing_for_pictures(*, video: bool) -> str | None:
    """What to install before pictures, or videos, can be made; None if all is there."""
    packages = ["matplotlib", "PIL", *(["av"] if video else [])]
    if missing := [name for name in packages if find_spec(name) is None]:
        return f"pictures need {', '.join(missing)}: pip install 'dano[view]'"
    return None
