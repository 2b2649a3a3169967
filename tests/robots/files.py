"""Robot files that tests share."""

import importlib.util
from importlib.resources import files
from pathlib import Path

import pytest

ARM = Path(str(files("dano") / "assets" / "arm.urdf"))


def panda() -> Path:
    """The Panda that the package frax ships."""
    return shipped("frax", "assets/franka_panda/panda.urdf")


def shipped(package: str, path: str) -> Path:
    """A file of a package; the test is skipped without it."""
    found = importlib.util.find_spec(package)
    if found is None or not found.submodule_search_locations:
        pytest.skip(f"the package {package} ships {path} and is not installed: pip install {package}")
    return Path(found.submodule_search_locations[0]) / path
