"""One step of training: the loss of a batch of random rays, its derivative, Adam.

Rays are rendered in front of random backgrounds, so that transparency cannot pass for colour:

    E |c + (1 − o) b − C − (1 − M) b|²  +  w_m |o − M|²  +  w_e (|∇d| − 1)²  +  w_s (h ∇²d)²

with c, o the rendered colour and opacity, C, M the photograph and its mask, b the background, and the last
two terms over nodes near the surface, which keep d a smooth signed distance.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

from dano.vision._models import Rays, roughness, Sampling, see, SurfaceModel
from dano.vision._options import TrainOptions
from dano.vision._ray_set import RaySet

_REACH = 3.0
"""Cells from the surface within which distances are learned."""


def trainable(model: SurfaceModel) -> Any:
    return model.distance, model.appearance.features, model.appearance.network


def optimiser_of(model: SurfaceModel | None, options: TrainOptions) -> Any:
    try:
        import optax
    except ImportError as error:
        raise ImportError("training needs optax: pip install 'dano[train]'") from error
    # Half the longest side of the box is the unit of distances.
    cell = 2 / options.resolution

    def adam(rate: float) -> Any:
        # Grids get a gradient only where rays pass: a short memory, and no floor under tiny gradients.
        return optax.adam(rate, b1=0.9, b2=0.99, eps=1e-12)

    parts = {
        "distance": adam(options.rate_distance * cell),
        "features": adam(options.rate_features),
        "network": adam(options.rate_network),
    }
    return optax.multi_transform(parts, ("distance", "features", "network"))


def make_step(options: TrainOptions) -> Callable[..., tuple[SurfaceModel, Any, Array]]:
    """One step of the optimiser on a random batch of rays, compiled."""
    import optax

    sampling = Sampling(48, 16, 5)
    optimiser = optimiser_of(None, options)

    def loss(
        parts: Any, model: SurfaceModel, batch: RaySet, sharpness: Array, view_share: Array, key: PRNGKeyArray
    ) -> tuple[Array, Array]:
        model = eqx.tree_at(trainable, model, parts)
        jitter, paint = jax.random.split(key)
        background = jax.random.uniform(paint, batch.colour.shape, jnp.float32)
        seen = see(model, batch.rays, sharpness, sampling=sampling, view_share=view_share, key=jitter)
        wanted = batch.colour + (1 - batch.mask)[:, None] * background
        got = seen.colour + (1 - seen.opacity)[:, None] * background
        eikonal, bending = roughness(model.distance, model.spacing / model.scale)
        error = jnp.mean((got - wanted) ** 2) + options.mask_weight * jnp.mean((seen.opacity - batch.mask) ** 2)
        return error + options.eikonal_weight * eikonal + options.smoothness_weight * bending, error

    @eqx.filter_jit
    def step(
        model: SurfaceModel,
        state: Any,
        rays: RaySet,
        sharpness: Array,
        decay: Array,
        view_share: Array,
        key: PRNGKeyArray,
    ) -> tuple[SurfaceModel, Any, Array]:
        pick, own = jax.random.split(key)
        index = jax.random.randint(pick, (options.batch,), 0, len(rays.mask))
        batch = RaySet(Rays(*(x[index] for x in rays.rays)), rays.colour[index], rays.mask[index])
        parts = trainable(model)
        (_, error), gradient = jax.value_and_grad(loss, has_aux=True)(parts, model, batch, sharpness, view_share, own)
        # optax counts steps in integers and takes powers of floats by them.
        with jax.numpy_dtype_promotion("standard"):
            updates, state = optimiser.update(gradient, state, parts)
        updates = jax.tree.map(lambda u: decay * u, updates)
        # Adam makes steps of one length of gradients of any length: where the surface is far away, of mere
        # traces of them, out of which walls would grow in empty space.
        near = jnp.abs(model.distance) < _REACH * model.spacing / model.scale
        updates = (jnp.where(near, updates[0], 0), *updates[1:])
        return eqx.tree_at(trainable, model, optax.apply_updates(parts, updates)), state, error

    return step
