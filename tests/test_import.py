"""Importing dano has no side effects and stays light."""

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

PROGRAM = """
import json, sys, time
import jax, jax.numpy
before = {name: getattr(jax.config, name) for name in dir(jax.config) if name.startswith("jax_")}
begin = time.process_time()
import dano
seconds = time.process_time() - begin
changed = [name for name, value in before.items() if getattr(jax.config, name) != value]
print(json.dumps({"seconds": seconds, "changed": changed, "modules": sorted(sys.modules)}))
"""
OPTIONAL = {"PIL", "av", "blosc", "igl", "imageio", "matplotlib", "mujoco", "msgpack", "plyfile", "skimage"}
OPTIONAL |= {"torch", "trimesh", "viser", "zarr"}
# Not optional, but each takes as long as much of dano: imported where they are used.
OPTIONAL |= {"scipy.ndimage", "scipy.optimize", "scipy.spatial", "scipy.special", "scipy.stats"}


def import_in_new_process(bytecode: Path) -> dict:
    """What an import does and takes, with bytecode in a folder of its own, also where Python keeps none."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPYCACHEPREFIX"] = str(bytecode)
    answer = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True, env=environment
    )
    return json.loads(answer.stdout)


def test_import_is_light_and_changes_nothing(tmp_path):
    report = import_in_new_process(tmp_path)
    assert report["changed"] == []
    assert OPTIONAL.isdisjoint(report["modules"])
    # The first import of an installation also compiles bytecode: what counts are later ones.
    seconds = min(import_in_new_process(tmp_path)["seconds"] for _ in range(3))
    assert seconds < 1.0, f"import dano took {seconds:.2f} s of processor time beyond JAX"


def test_the_extra_all_holds_every_extra_for_users():
    project = Path(__file__).resolve().parents[1] / "pyproject.toml"
    extras = tomllib.loads(project.read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    (requirement,) = extras["all"]
    named = requirement.removeprefix("dano[").removesuffix("]").split(",")
    # Newton asks for an older MuJoCo than others do.
    apart = {"mjwarp", "newton"}
    assert sorted(named) == sorted(set(extras) - {"all", "dev", "docs"} - apart)
