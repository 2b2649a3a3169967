"""What hand-written derivative rules share."""

import equinox as eqx
import jax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array

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
