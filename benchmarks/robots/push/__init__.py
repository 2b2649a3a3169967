"""The Panda pushes the shipped bunny with torques of its joints.

Nothing here imports JAX, whose settings must stand before.
"""

import importlib.util
from pathlib import Path


def panda() -> Path | None:
    """The file of the arm, if the package that ships it is installed."""
    found = importlib.util.find_spec("frax")
    if found is None or not found.submodule_search_locations:
        return None
    return Path(found.submodule_search_locations[0]) / "assets" / "franka_panda" / "panda.urdf"
