"""Adam with a learning rate for each part of what is learned."""

from collections.abc import Mapping
from typing import Any

import jax
from jaxtyping import Array


def adam(rates: Mapping[str, float]) -> Any:
    """An optimiser of a tuple with one entry for each rate."""
    # Here, because it takes long to import, and only training needs it.
    import optax

    # Grids get a gradient only where rays pass: a short memory, and no floor under tiny gradients.
    parts = {name: optax.adam(rate, b1=0.9, b2=0.99, eps=1e-12) for name, rate in rates.items()}
    return optax.multi_transform(parts, tuple(rates))


def updates_of(optimiser: Any, gradient: Any, state: Any, parts: Any, decay: Array) -> tuple[Any, Any]:
    """What to add to parts, all rates times `decay`, and the optimiser's next state."""
    # optax counts steps in integers and takes powers of floats by them.
    with jax.numpy_dtype_promotion("standard"):
        updates, state = optimiser.update(gradient, state, parts)
    return jax.tree.map(lambda u: decay * u, updates), state
