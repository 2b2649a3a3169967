"""Keys of JAX on the host: what `jax.random` makes of them, without compiling a program for two numbers.

JAX's usual generator is Threefry-2x32 (Salmon et al., 2011): 20 rounds on a counter of two words, for a key
of two words. Keys of other generators go the usual way.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray, UInt32

Words = UInt32[np.ndarray, " words"]

_GENERATOR = "threefry2x32"
_ROTATIONS = (13, 15, 26, 6), (17, 29, 16, 24)
_PARITY = np.uint32(0x1BD11BDA)


def seed_key(seed: int) -> PRNGKeyArray:
    """`jax.random.key` of a seed."""
    if not _is_usual() or not 0 <= seed < 1 << 31:
        return jax.random.key(seed)
    return _key(np.array([0, seed], np.uint32))


def split_key(key: PRNGKeyArray) -> tuple[PRNGKeyArray, PRNGKeyArray]:
    """`jax.random.split` of a key."""
    if not _is_threefry(key):
        first, second = jax.random.split(key)
        return first, second
    first, second = np.stack(_threefry(key_words(key), np.arange(2, dtype=np.uint64)), axis=1)
    return _key(first), _key(second)


def folded_key(key: PRNGKeyArray, data: int) -> PRNGKeyArray:
    """`jax.random.fold_in` of a key and a small number."""
    if not _is_threefry(key):
        return jax.random.fold_in(key, data)
    return _key(np.concatenate(_threefry(key_words(key), np.array([data], np.uint64))))


def key_words(key: PRNGKeyArray) -> Words:
    """What a key holds."""
    return np.asarray(jax.random.key_data(key))


def uniform(key: PRNGKeyArray, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """`jax.random.uniform` between 0 and 1, in the precision that JAX is set to."""
    if not _is_threefry(key):
        return np.asarray(jax.random.uniform(key, shape))
    high, low = _threefry(key_words(key), np.arange(int(np.prod(shape)), dtype=np.uint64))
    if jax.dtypes.canonicalize_dtype(np.float64) == np.float64:
        bits = (high.astype(np.uint64) << np.uint64(32)) | low
        # The upper bits as digits of a number between 1 and 2.
        numbers = ((bits >> np.uint64(12)) | np.float64(1).view(np.uint64)).view(np.float64)
    else:
        numbers = (((high ^ low) >> np.uint32(9)) | np.float32(1).view(np.uint32)).view(np.float32)
    return (numbers - numbers.dtype.type(1)).reshape(shape)


def _key(words: Words) -> PRNGKeyArray:
    data: Any = words
    return jax.random.wrap_key_data(data, impl=_GENERATOR)


def _is_usual() -> bool:
    """Whether keys are those of Threefry unless something else is asked for."""
    return jax.config.jax_default_prng_impl == _GENERATOR  # pyright: ignore[reportAttributeAccessIssue]


def _is_threefry(key: PRNGKeyArray) -> bool:
    """Whether a key is Threefry's, in the order of counters that is usual."""
    if not jax.config.jax_threefry_partitionable:  # pyright: ignore[reportAttributeAccessIssue]
        return False
    if jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        return str(jax.random.key_impl(key)) == _GENERATOR
    return _is_usual() and key.shape == (2,)


def _threefry(key: Words, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two words for each counter (Salmon et al., 2011, fig. 2)."""
    words = [key[0], key[1], key[0] ^ key[1] ^ _PARITY]
    with np.errstate(over="ignore"):
        x = (counts >> np.uint64(32)).astype(np.uint32) + words[0]
        y = (counts & np.uint64(0xFFFFFFFF)).astype(np.uint32) + words[1]
        for step in range(5):
            for turn in _ROTATIONS[step % 2]:
                x = x + y
                y = ((y << np.uint32(turn)) | (y >> np.uint32(32 - turn))) ^ x
            x = x + words[(step + 1) % 3]
            y = y + words[(step + 2) % 3] + np.uint32(step + 1)
    return x, y
