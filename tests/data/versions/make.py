"""Writes files of the versions of today; run once when a format gets a new version, and never over old files.

`object_1.dano` and `trajectory_1_first.npz` were written by the first code that had these formats.
"""

import json
import sys
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)
sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

import dano  # noqa: E402
from dano.archive import FIELD, MOTION, OBJECT, TRAJECTORY  # noqa: E402
from tests.fuzz.world import SCENE, World  # noqa: E402


def main() -> None:
    """Write what is not there yet."""
    folder = Path(__file__).parent
    world = World(folder)
    source = json.dumps({"scene": SCENE, "path": "scene.toml", "default_law": "distributed"})
    writers = {
        f"object_{OBJECT[1]}.dano": world.thing.save,
        f"field_{FIELD[1]}.npz": lambda path: dano.save_field(world.grid, path),
        f"motion_{MOTION[1]}.npz": lambda path: dano.save_motion(path, world.motion),
        f"trajectory_{TRAJECTORY[1]}.npz": lambda path: world.trajectory.save(
            path, source=json.dumps(source)
        ),
    }
    for name, write in writers.items():
        if not (folder / name).exists():
            write(folder / name)


if __name__ == "__main__":
    main()
