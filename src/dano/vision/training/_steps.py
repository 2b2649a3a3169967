"""One step of training: the loss of a batch of random rays, its derivative, Adam.

Rays are rendered in front of random backgrounds, so that transparency cannot pass for colour:

    E |c + (1 − o) b − C − (1 − M) b|²  +  w_m |o − M|²  +  w_e (|∇d| − 1)²  +  w_s (h ∇²d)²

with c, o the rendered colour and opacity, C, M the photograph and its mask, b the background, and the last
two terms over nodes near the surface, which keep d a smooth signed distance. Where a mask is doubted the
object may be there or not, as long as the photograph comes out: b is its own background, C + (1 − M) b the
photograph, and w_m is 0.

Where a pixel shows nothing but the object, its error is |c/o − C|² and opacity enough at o = 0.9: a thin wall
is not opaque as long as its surface is blurred, and to want it to be would thicken it by more than its looks
could ever correct.

What single rays say of single nodes is mostly noise, and what many agree on is that a whole wall should move.
So the derivative with respect to distances is spread over neighbouring nodes at first (`coherence`).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from dano.vision.capture import RaySet
from dano.vision.radiance import Sampling, see, SurfaceModel
from dano.vision.training._adam import adam, updates_of
from dano.vision.training._adjustment import Adjustment
from dano.vision.training._level_set import roughness, spread
from dano.vision.training._options import TrainOptions

_REACH = 3.0
"""Cells from the surface within which distances are learned."""

_WHOLE, _OPAQUE = 0.999, 0.9
"""Mask of a pixel that shows nothing but the object, and the opacity that is enough there."""

_DOUBTED = 0.5
"""Doubt of a mask from which a pixel may show anything."""

_PASSES = 3
"""Times that derivatives are spread to neighbours."""

_RATE_CAMERAS = 0.02
"""Learning rate of corrections of cameras [pixels]."""

_STATED = 1e-4
"""Weight of squared corrections [pixels²]: what photographs leave open stays as stated."""


_OF_THE_LOOP = ("iterations", "features", "cavities", "blur", "check_every", "seconds", "seed")
"""Options that only the loop around the steps reads."""

_DEFAULT = TrainOptions()


class Learned(eqx.Module):
    """What is learned: an object, and where it was photographed from."""

    model: SurfaceModel  # The object
    cameras: Adjustment  # Corrections of the cameras

    @property
    def parts(self) -> Any:
        """Arrays that change: distances, features, network, cameras."""
        appearance = self.model.appearance
        return self.model.distance, appearance.features, appearance.network, self.cameras.correction

    def replaced(self, parts: Any) -> "Learned":
        """With other values of `parts`."""
        return eqx.tree_at(lambda learned: learned.parts, self, parts)

    def moved_to(self, distance: Float[Array, "nx ny nz"]) -> "Learned":
        """With another surface."""
        return eqx.tree_at(lambda learned: learned.model.distance, self, distance)


def optimiser_of(options: TrainOptions, *, lit: bool) -> Any:
    """Adam with a rate for each of `Learned.parts`; `lit` says whether the light is known."""
    # Half the longest side of the box is the unit of distances.
    cell = 2 / options.resolution
    return adam(
        {
            "distance": options.rate_distance * cell,
            "features": options.rate_of_features(lit=lit),
            "network": options.rate_network,
            "cameras": _RATE_CAMERAS,
        }
    )


def make_step(options: TrainOptions, *, lit: bool) -> Callable[..., tuple[Learned, Any, Array]]:
    """One step of the optimiser on a random batch of rays, compiled.

    Args:
        options: Of the training.
        lit: Whether the light of the photographs is known.

    Returns:
        A function that returns the new model, the new state of the optimiser, and the mean error of colours
        and masks. It takes the model, the state of the optimiser, rays, sharpness [1/m], a factor of all
        rates, the share of the view's direction in colours (see `Appearance`), the share of the derivative of
        distances that is spread over neighbours, and a key.
    """
    # What steps do not read is set to one value: trainings that differ only there share the compiled step.
    read = dataclasses.replace(options, **{name: getattr(_DEFAULT, name) for name in _OF_THE_LOOP})
    return _made_step(read, lit)


@functools.lru_cache(maxsize=2)
def _made_step(options: TrainOptions, lit: bool) -> Callable[..., tuple[Learned, Any, Array]]:
    import optax

    sampling = Sampling(48, 16, 5)
    optimiser = optimiser_of(options, lit=lit)

    def loss(
        parts: Any, learned: Learned, batch: RaySet, sharpness: Array, view_share: Array, key: PRNGKeyArray
    ) -> tuple[Array, Array]:
        learned = learned.replaced(parts)
        model, rays, stated = learned.model, batch.rays, jnp.float32(0)
        if options.cameras:
            rays = learned.cameras.moved(rays, batch.view)
            stated = jnp.mean(learned.cameras.corrections**2)
        jitter, paint = jax.random.split(key)
        doubt = batch.doubt[:, None]
        background = jax.random.uniform(paint, batch.colour.shape, jnp.float32)
        background = (1 - doubt) * background + doubt * batch.backdrop
        seen = see(model, rays, sharpness, sampling=sampling, view_share=view_share, key=jitter)
        # What is wrong about a camera shows where object and background mix: that counts everywhere then.
        whole = (batch.mask > _WHOLE) & (batch.doubt < _DOUBTED) & (not options.cameras)
        met = seen.colour / jnp.maximum(seen.opacity, 0.05)[:, None]
        mixed = seen.colour + (1 - seen.opacity)[:, None] * background
        got = jnp.where(whole[:, None], met, mixed)
        # Nothing of the background where the mask is whole, but for a thousandth.
        wanted = batch.colour + (1 - batch.mask)[:, None] * background
        lacking = jnp.where(whole, jnp.maximum(_OPAQUE - seen.opacity, 0), seen.opacity - batch.mask)
        eikonal, bending = roughness(model.distance, model.spacing / model.scale)
        error = jnp.mean((got - wanted) ** 2) + options.mask_weight * jnp.mean((1 - batch.doubt) * lacking**2)
        smooth = options.eikonal_weight * eikonal + options.smoothness_weight * bending
        return error + smooth + _STATED * stated, error

    @eqx.filter_jit
    def step(
        learned: Learned,
        state: Any,
        rays: RaySet,
        sharpness: Array,
        decay: Array,
        view_share: Array,
        coherence: Array,
        key: PRNGKeyArray,
    ) -> tuple[Learned, Any, Array]:
        pick, own = jax.random.split(key)
        parts = learned.parts
        (_, error), gradient = jax.value_and_grad(loss, has_aux=True)(
            parts, learned, rays.drawn(options.batch, pick), sharpness, view_share, own
        )
        model = learned.model
        near = jnp.abs(model.distance) < _REACH * model.spacing / model.scale
        shared = jax.lax.cond(
            coherence > 0,
            lambda own: coherence * spread(own, near, _PASSES) + (1 - coherence) * own,
            lambda own: own,
            gradient[0],
        )
        updates, state = updates_of(optimiser, (shared, *gradient[1:]), state, parts, decay)
        # Adam makes steps of one length of gradients of any length: where the surface is far away, of mere
        # traces of them, out of which walls would grow in empty space.
        updates = (jnp.where(near, updates[0], 0), *updates[1:])
        return learned.replaced(optax.apply_updates(parts, updates)), state, error

    return step
