"""Trees of many joints are placed by a loop over their levels: the same places and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.scene import _frames, place_links

# Scenes here are odd on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::dano.scene.SceneWarning")

PARENTS = [None, "0", "0", "1", "3", "3", "2"]
KINDS = ["hinge", "slide", "ball", "weld", "planar", "hinge", "hinge"]


def test_a_loop_over_levels_places_what_levels_one_after_the_other_place(monkeypatch):
    """Levels of one, two and three joints, of all kinds."""
    rng = np.random.default_rng(0)
    bodies = [dano.Body(str(i), dano.Box((0.1, 0.2, 0.3)), mass=1.0 + i) for i in range(len(KINDS))]
    joints = [
        dano.Joint(parent, str(i), kind, axis=rng.normal(size=3), anchor=rng.normal(size=3))
        for i, (parent, kind) in enumerate(zip(PARENTS, KINDS, strict=True))
    ]
    scene = dano.Scene.create(bodies, contacts=(), joints=joints)
    state = scene.initial_state()
    q = jnp.asarray(rng.normal(size=scene.layout.n_joints))

    def placed(q):
        found = place_links(scene.chains, state.position, state.orientation, q)
        return jnp.concatenate([x.ravel() for x in jax.tree.leaves(found)])

    one = placed(q), jax.jacfwd(placed)(q), jax.jacrev(placed)(q)
    monkeypatch.setattr(_frames, "_MANY_JOINTS", 1)
    for plain, looped in zip(one, (placed(q), jax.jacfwd(placed)(q), jax.jacrev(placed)(q)), strict=True):
        np.testing.assert_allclose(looped, plain, atol=1e-13)
