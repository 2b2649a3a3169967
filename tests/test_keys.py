"""Keys on the host are those of JAX, and cost no program."""

import jax
import numpy as np
import pytest
from jax import monitoring

from dano.keys import folded_key, key_words, seed_key, split_key, uniform

COMPILED = "/jax/core/compile/backend_compile_duration"


@pytest.fixture(params=[("key", None), ("PRNGKey", None), ("key", "rbg")], ids=str)
def key(request):
    kind, generator = request.param
    return getattr(jax.random, kind)(12345, impl=generator)


def test_are_those_of_jax(key):
    words = np.asarray(jax.random.key_data(key))
    np.testing.assert_array_equal(key_words(key), words)
    np.testing.assert_array_equal(
        np.stack([key_words(each) for each in split_key(key)]), jax.random.key_data(jax.random.split(key))
    )
    for data in (0, 2, 70_000):
        found = key_words(folded_key(key, data))
        np.testing.assert_array_equal(found, jax.random.key_data(jax.random.fold_in(key, data)))
    drawn = np.asarray(jax.random.uniform(key, (3, 41)))
    np.testing.assert_array_equal(uniform(key, (3, 41)), drawn)
    assert uniform(key, (2,)).dtype == drawn.dtype


@pytest.mark.parametrize("seed", [0, 7, 2**31 - 1, 2**40])
def test_seeds(seed):
    np.testing.assert_array_equal(key_words(seed_key(seed)), jax.random.key_data(jax.random.key(seed)))


def test_single_precision():
    with jax.enable_x64(False):
        drawn = uniform(seed_key(3), (50,))
        assert drawn.dtype == np.float32
        np.testing.assert_array_equal(drawn, jax.random.uniform(jax.random.key(3), (50,)))


def test_other_order_of_counters():
    before = getattr(jax.config, "jax_threefry_partitionable")  # noqa: B009 (not among its types)
    jax.config.update("jax_threefry_partitionable", not before)
    try:
        drawn = uniform(seed_key(3), (5,))
        np.testing.assert_array_equal(drawn, jax.random.uniform(jax.random.key(3), (5,)))
    finally:
        jax.config.update("jax_threefry_partitionable", before)


def test_compile_nothing():
    seen = []
    monitoring.register_event_duration_secs_listener(lambda event, duration_secs, **_: seen.append(event))
    first, _ = split_key(seed_key(99))
    uniform(folded_key(first, 5), (3, 17))
    assert COMPILED not in seen
