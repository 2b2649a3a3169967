"""Writes the scene that one turns on the home page, without the client of viser, which MkDocs puts in.

    python assets/write_scene_page.py    # docs/scene.html, in a minute

The client is 800 kB and the same for all pages: `assets/embed_viewer.py` takes it from the installed viser.
"""

import tempfile
from pathlib import Path

import jax
from embed_viewer import without_client

import dano

PAGE = Path(__file__).parents[1] / "docs" / "scene.html"


def write() -> None:
    """A bunny lands, and a ball rolls into it."""
    jax.config.update("jax_enable_x64", True)
    bodies = [
        dano.Body("bunny", dano.load_object("bunny"), position=(0, 0, 0.12), omega=(0, 1.0, 0.5)),
        dano.Body("ball", dano.Sphere(0.03), mass=0.4, position=(0.45, 0.01, 0.031), velocity=(-1.2, 0, 0)),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    scene = dano.Scene.create(bodies, timestep=0.005)
    run = dano.simulate(scene, duration=1.2)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.html"
        run.show(path)
        PAGE.write_text(without_client(path.read_text(encoding="utf-8")), encoding="utf-8")
    print(f"{PAGE}: {PAGE.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    write()
