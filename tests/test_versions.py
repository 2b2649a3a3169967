"""Files of every version that was ever written load, with what they held."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.archive import FIELD, MOTION, OBJECT, TRAJECTORY
from dano.scene_file import load_run

FILES = Path(__file__).parent / "data" / "versions"


@pytest.mark.parametrize(
    ("stem", "newest", "suffix"),
    [
        ("object", OBJECT[1], ".dano"),
        ("field", FIELD[1], ".npz"),
        ("motion", MOTION[1], ".npz"),
        ("trajectory", TRAJECTORY[1], ".npz"),
    ],
)
def test_there_is_a_file_of_every_version(stem, newest, suffix):
    missing = [n for n in range(1, newest + 1) if not (FILES / f"{stem}_{n}{suffix}").exists()]
    assert missing == [], "run tests/data/versions/make.py"


@pytest.mark.parametrize("version", range(1, OBJECT[1] + 1))
def test_objects(version):
    made = dano.NeuralObject.load(FILES / f"object_{version}.dano")
    # A ball of 9 cells of 1 cm across, in the middle of 12 nodes.
    assert float(made.mass.mass) == pytest.approx(0.3)
    np.testing.assert_allclose(made.mass.com, 0.055, atol=2e-3)
    assert len(made.samples.points) == 60
    assert made.solid is not None and len(made.surface.points) > 50
    assert float(made.surface.areas.sum()) == pytest.approx(4 * np.pi * 0.042**2, rel=0.15)
    body = dano.Body("thing", made)
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    assert dano.Scene.create([body, floor], [dano.Contact("thing", "floor")]).pairs == (("thing", "floor"),)


def test_fields():
    for version in range(1, FIELD[1] + 1):
        field = dano.load_field(FILES / f"field_{version}.npz")
        assert float(field.density(jnp.full(3, 0.055))) == pytest.approx(100, rel=0.01)


def test_motions():
    for version in range(1, MOTION[1] + 1):
        motion = dano.load_motion(FILES / f"motion_{version}.npz")
        assert motion.names == ("ball",)
        np.testing.assert_allclose(motion.position[0, 0], (0, 0, 0.3))


def test_trajectories():
    for version in range(1, TRAJECTORY[1] + 1):
        run = load_run(FILES / f"trajectory_{version}.npz")
        assert run.scene.names == run.trajectory.names == ("ball", "floor")
    first = dano.Trajectory.load(FILES / "trajectory_1_first.npz")
    # It flew: nothing but gravity and its first velocity.
    np.testing.assert_allclose(first.states.position[10, 0], (0.1, 0, 0.3 - 0.5 * 9.81 * 0.1**2), atol=6e-3)
