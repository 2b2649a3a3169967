"""Importing dano has no side effects and stays light."""

import json
import subprocess
import sys

PROGRAM = """
import json, sys, time
start = time.process_time()
import jax, jax.numpy
before = {name: getattr(jax.config, name) for name in dir(jax.config) if name.startswith("jax_")}
begin = time.process_time()
import dano
seconds, jax_seconds = time.process_time() - begin, begin - start
changed = [name for name, value in before.items() if getattr(jax.config, name) != value]
report = {"seconds": seconds, "jax": jax_seconds, "changed": changed, "modules": sorted(sys.modules)}
print(json.dumps(report))
"""
OPTIONAL = {"PIL", "av", "blosc", "igl", "imageio", "matplotlib", "mujoco", "msgpack", "plyfile", "skimage"}
OPTIONAL |= {"torch", "trimesh", "viser"}
# Not optional, but each takes as long as much of dano: imported where they are used.
OPTIONAL |= {"scipy.ndimage", "scipy.optimize", "scipy.spatial", "scipy.special", "scipy.stats"}


def import_in_new_process() -> dict:
    answer = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    return json.loads(answer.stdout)


def test_import_is_light_and_changes_nothing():
    report = import_in_new_process()
    assert report["changed"] == []
    assert OPTIONAL.isdisjoint(report["modules"])
    # The first import of an installation also compiles bytecode: what counts is the second.
    again = import_in_new_process()
    seconds, jax_seconds = (min(report[key], again[key]) for key in ("seconds", "jax"))
    # One second on a machine that imports JAX in less, and otherwise no longer than JAX itself.
    allowed = max(1.0, jax_seconds)
    assert seconds < allowed, f"import dano took {seconds:.2f} s of processor time, allowed {allowed:.2f} s"
