"""A small object that is concave and whose principal axes are not those of its frame."""

import numpy as np
import pytest

import dano
from dano.maths import Pose

QUICK = {"resolution": 20, "collision": "hull"}
TOLERANCE = 1e-6


def angle() -> dano.AbstractField:
    """Two bars of 10 × 4 × 4 and 4 × 4 × 9 cm that form an L, somewhere off the origin."""
    long = dano.posed(dano.Box((0.05, 0.02, 0.02), edge=1e-3), Pose((0.1, 0.02, 0.03)))
    up = dano.posed(dano.Box((0.02, 0.02, 0.045), edge=1e-3), Pose((0.07, 0.02, 0.055)))
    return dano.union(long, up)


@pytest.fixture(scope="session")
def thing() -> dano.NeuralObject:
    return dano.NeuralObject.from_field(angle(), n_samples=400, resolution=32, mass=0.5)


def tensor(moments, rotation) -> np.ndarray:
    """Inertia from principal moments and the matrix of their axes."""
    rotation = np.reshape(rotation, (3, 3))
    return rotation @ np.diag(moments) @ rotation.T


def check_mass(thing, mass, com, inertia):
    """Check that an object has a mass, a centre of mass and an inertia about it."""
    assert mass == pytest.approx(float(thing.mass.mass), rel=TOLERANCE)
    np.testing.assert_allclose(com, thing.mass.com, atol=TOLERANCE * thing.size)
    scale = float(np.abs(np.asarray(thing.mass.inertia)).max())
    np.testing.assert_allclose(inertia, thing.mass.inertia, atol=TOLERANCE * scale)
