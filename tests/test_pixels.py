"""Pixels of rollouts: derivatives against differences at a step that can be seen."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vision.models import learned

import dano
from dano.pixels import film
from dano.vision import Camera, LearnedField, Light

STEPS, EVERY = 12, 6


@pytest.fixture(scope="module")
def look():
    return LearnedField.from_model(learned(), 60.0)


@pytest.fixture(scope="module")
def scene():
    params = dano.ContactParams(sliding_friction=0.4, sliding_drag=0.0, spring=5e4, damper=1e5)
    law = dano.CentroidLaw(stiction_velocity=1e-4)
    bodies = [dano.Body("ball", dano.Sphere(0.3), mass=1.0), dano.Body("floor", dano.HalfSpace(), fixed=True)]
    return dano.Scene.create(bodies, [dano.Contact("ball", "floor", params, law)], timestep=0.02)


@pytest.fixture(scope="module")
def pictures(scene, look):
    """A function of friction, first speed and the lamp's direction; compiled once for each derivative."""
    state = scene.initial_state(ball={"position": (-0.2, 0, 0.3), "velocity": (2.0, 0, 0)})
    camera = Camera((0.1, -1.8, 0.7), (0.1, 0, 0.3), width=24, height=16)
    lamp = Light((0.3, -0.6, 0.8))

    def at(numbers):
        friction, speed, aside = numbers
        moved = scene.replace_contact("ball", "floor", sliding_friction=friction)
        begun = dataclasses.replace(state, velocity=state.velocity.at[0, 0].set(speed))
        place = jnp.asarray(lamp.place).at[0].set(aside.astype(jnp.float32))
        lit = eqx.tree_at(lambda light: light.place, lamp, place / jnp.linalg.norm(place))
        seen = film(
            moved, begun, STEPS, {"ball": look}, camera, (lit,), every=EVERY, background=(0.1, 0.2, 0.4)
        )
        return seen.colour.astype(jnp.float64)

    return at


POINT = jnp.array([0.4, 2.0, 0.3])


def test_a_picture_shows_the_body_where_it_is(pictures, scene, look):
    seen = pictures(POINT)
    assert seen.shape == (STEPS // EVERY + 1, 24 * 16, 3)
    blue = np.abs(np.asarray(seen) - [0.1, 0.2, 0.4]).max(axis=2) > 0.05
    middle = [(frame.reshape(16, 24).sum(axis=0) * np.arange(24)).sum() / frame.sum() for frame in blue]
    # Some 0.2 m a frame to the right, at 0.1 m a pixel.
    assert np.all(np.diff(middle) > 1)


def test_derivatives_of_pixels_are_differences_at_a_visible_step(pictures):
    forward = np.asarray(jax.jit(jax.jacfwd(pictures))(POINT))
    value = jax.jit(pictures)
    across = np.tile(np.arange(24) - 11.5, 16)
    apart, together = [], []
    for k, step in enumerate((0.05, 0.05, 0.05)):
        high, low = (np.asarray(value(POINT.at[k].add(s * step))) for s in (1, -1))
        difference = (high - low) / (2 * step)
        assert np.linalg.norm(difference) > 0.1
        apart.append(np.linalg.norm(forward[..., k] - difference) / np.linalg.norm(difference))
        # All pixels together, weighted by how far to the right they are, say where the light has gone.
        slope, change = (np.einsum("fpc,p->f", x, across)[-1] for x in (forward[..., k], difference))
        together.append(abs(slope / change - 1))
    # Where an edge passes a sample of a ray, a difference of that size is no derivative.
    assert max(apart) < 0.35, apart
    assert max(together) < 0.2, together


@pytest.mark.slow
def test_forward_is_reverse(pictures):
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(STEPS // EVERY + 1, 24 * 16, 3)))
    loss = lambda numbers: jnp.sum(weights * pictures(numbers))  # noqa: E731
    np.testing.assert_allclose(jax.jacfwd(loss)(POINT), jax.grad(loss)(POINT), rtol=2e-3, atol=1e-3)


def test_what_is_wrong_is_said(scene, look):
    state = scene.initial_state()
    camera = Camera((0, -2, 0.5))
    with pytest.raises(ValueError, match="got 'cube'"):
        film(scene, state, 2, {"cube": look}, camera, (Light((0, 0, 1)),))
    with pytest.raises(ValueError, match="lights must hold a Light"):
        film(scene, state, 2, {"ball": look}, camera, ())
