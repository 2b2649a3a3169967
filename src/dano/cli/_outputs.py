"""Checks before any work starts: where results go, and whether what draws them is installed."""

from pathlib import Path

from dano.archive import checked_output
from dano.extras import is_installed


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


def check_distinct(**outputs: Path | None) -> None:
    """Check that no two results go to one file.

    Args:
        **outputs: Where to, by the name of the option; None where nothing is written.

    Raises:
        ValueError: If two are the same file. Devices and pipes may take several.
    """
    named: dict[Path, str] = {}
    for name, path in outputs.items():
        if path is None or (path.exists() and not path.is_file()):
            continue
        other = named.setdefault(path.resolve(), name)
        if other != name:
            raise ValueError(f"{other} and {name} must be different files, got {path} for both")


def missing_for_pictures(*, video: bool) -> str | None:
    """What to install before pictures, or videos, can be made; None if all is there."""
    packages = ["matplotlib", "PIL", *(["av"] if video else [])]
    if missing := [name for name in packages if not is_installed(name)]:
        return f"pictures need {', '.join(missing)}: pip install 'dano[view]'"
    return None
