"""A learned object that stood on a table has nothing below it."""

import jax.numpy as jnp
import numpy as np
import pytest

from dano.scene_file import asset_look
from dano.vision import LearnedField


def density(field: LearnedField, *heights: float) -> np.ndarray:
    """On a vertical line through the middle of the soap."""
    return np.array([float(field.density(jnp.array([0.0, 0.0, z], jnp.float32))) for z in heights])


def test_what_lies_below_the_table_is_gone():
    soap = asset_look("trained_soap")
    assert soap is not None
    cut = soap.above(0.002)
    # The soap reaches from −15 to 15 mm; the edge is as soft as that of the whole.
    assert density(soap, -0.01, 0.0).min() > 0.9
    assert density(cut, -0.01, -0.004).max() < 0.05
    assert float(density(cut, 0.002)[0]) == pytest.approx(0.5, abs=0.1)
    np.testing.assert_allclose(density(cut, 0.009, 0.013), density(soap, 0.009, 0.013), atol=0.05)
    lower, upper = np.asarray(cut.solid.solid_bounds)
    assert lower[2] == pytest.approx(0.002, abs=0.001)
    np.testing.assert_allclose(upper, np.asarray(soap.solid.solid_bounds)[1], atol=0.001)
    # It is what files keep, too.
    assert np.all(cut.arrays["distance"] >= soap.arrays["distance"])
    below = soap.above(-0.1)
    np.testing.assert_allclose(below.arrays["distance"], soap.arrays["distance"])


def test_a_table_above_the_object_is_refused():
    soap = asset_look("trained_soap")
    assert soap is not None
    with pytest.raises(ValueError, match="holds no solid"):
        soap.above(0.1)
