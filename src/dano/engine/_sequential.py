"""Loops of unequal length under `jax.vmap`.

Batched by `jax.vmap`, a loop runs as long as the longest in the batch, and every pass of it copies all that
the loop carries, to keep the results of those that have ended. For the many short loops of a step that costs
a CPU ten times what one rollout after the other does. A GPU is better off with the batch.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax


def one_at_a_time(function: Callable[..., Any], *arguments: Any) -> Any:
    """`function(*arguments)`, which `jax.vmap` turns into a loop over the batch where the backend is a CPU.

    Args:
        function: Returns arrays. It is not differentiated.
        arguments: Trees of arrays and of other things, which are no part of the batch.
    """
    arrays, static = eqx.partition(arguments, eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)

    def plain(*leaves):
        return function(*eqx.combine(jax.tree.unflatten(structure, leaves), static))

    call = jax.custom_batching.custom_vmap(plain)

    @call.def_vmap
    def _(_, in_batch: list[bool], *leaves):
        if jax.default_backend() != "cpu":
            results = jax.vmap(plain, [0 if batched else None for batched in in_batch])(*leaves)
        else:
            rows = [leaf for leaf, batched in zip(leaves, in_batch, strict=True) if batched]

            def one(row):
                own = iter(row)
                pairs = zip(leaves, in_batch, strict=True)
                return call(*[next(own) if batched else leaf for leaf, batched in pairs])

            results = jax.lax.map(one, rows)
        return results, jax.tree.map(lambda _: True, results)

    return call(*leaves)
