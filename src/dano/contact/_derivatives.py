"""What hand-written derivative rules share."""

from collections.abc import Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float, Int

# Name of the values that reverse mode keeps instead of computing them again: results of passes over samples,
# of solves.
KEPT = "kept"


def keep(*values: Array) -> tuple[Array, ...]:
    """Mark what a rollout's reverse mode keeps of a step: everything else is cheap to compute again."""
    return tuple(checkpoint_name(value, KEPT) for value in values)


def by_autodiff(function, primals, tangents):
    """Plain forward derivative, for arguments that few ever perturb (a grid's values, samples, a radius)."""
    perturbed = jax.tree.map(lambda t: t is not None, tangents, is_leaf=lambda t: t is None)
    dynamic, static = eqx.partition(primals, perturbed)
    return jax.jvp(lambda d: function(*eqx.combine(d, static)), (dynamic,), (tangents,))


def numbers_of(
    tables: Iterable[tuple[Iterable[Any], int]], perturbed: Sequence[bool]
) -> Int[np.ndarray, "n 3"]:
    """Table, row and column of the numbers by which a rule takes derivatives.

    Args:
        tables: Of each table the rows that count, and its width; a vector has one row.
        perturbed: Which tables change.
    """
    found = [
        (k, i, j)
        for k, (rows, width) in enumerate(tables)
        if perturbed[k]
        for i in rows
        for j in range(width)
    ]
    return np.array(found, np.int32).reshape(-1, 3)


def changes_of(changes: Sequence[Array | None], numbers: Int[np.ndarray, "n 3"]) -> Float[Array, " n"]:
    """By how much these numbers change, from the changes of the tables; None where there is none."""
    parts = []
    for k, change in enumerate(changes):
        if change is not None:
            rows, columns = numbers[numbers[:, 0] == k, 1:].T
            parts.append(change.ravel()[rows * change.shape[-1] + columns])
    return jnp.concatenate(parts)
