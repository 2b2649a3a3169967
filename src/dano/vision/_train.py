"""Training: from photographs with masks to a solid field.

The solid starts as the visual hull of the masks, on a coarse grid; rendering is compared with random rays
of the photographs, in front of random backgrounds, so that transparency cannot pass for colour:

    E |c + (1 − o) b − C − (1 − M) b|²  +  w_m |o − M|²  +  w_e (|∇d| − 1)²  +  w_s (h ∇²d)²

with c, o the rendered colour and opacity, C, M the photograph and its mask, b the background, and the last
two terms over nodes near the surface, which keep d a smooth signed distance. Coarse first, finer later.
"""

import dataclasses
import hashlib
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from dano.archive import read_archive, write_archive
from dano.vision._appearance import Appearance
from dano.vision._capture import Capture, View
from dano.vision._hull import Box
from dano.vision._learned import LearnedField
from dano.vision._metrics import mask_iou, psnr, ssim
from dano.vision._models import Rays, roughness, Sampling, see, SurfaceModel
from dano.vision._picture import picture
from dano.vision._preview import checked_folder, write_preview
from dano.vision._ray_set import collect, RaySet
from dano.vision._survey import Survey, survey, unseen_share

CHECKPOINT, CHECKPOINT_VERSION = "dano-training", 1

Stopped = Literal["finished", "converged", "geometry", "time", "diverged"]


@dataclasses.dataclass(frozen=True)
class TrainOptions:
    """How to train.

    Attributes:
        resolution: Nodes along the longest side of the finest grid of distances.
        iterations: Steps in all; a third of them on a grid of two thirds the resolution.
        batch: Rays per step.
        features: Numbers that say what a place looks like.
        rate_distance: Learning rate of the distances, in cells per step.
        rate_features: Learning rate of the features.
        rate_network: Learning rate of the network.
        mask_weight: Weight of the mask's error.
        eikonal_weight: Weight of (|∇d| − 1)².
        smoothness_weight: Weight of (h ∇²d)².
        blur: Distance over which the surface is soft, in pixels, at the start and from 70 % of the steps on.
        check_every: Steps between looks at held-out views, which decide when to stop.
        seconds: Stop after this time [s]; None for no limit.
        seed: Of everything random.
    """

    resolution: int = 96
    iterations: int = 1000
    batch: int = 4096
    features: int = 8
    rate_distance: float = 0.25
    rate_features: float = 0.01
    rate_network: float = 0.003
    mask_weight: float = 0.5
    eikonal_weight: float = 0.05
    smoothness_weight: float = 0.003
    blur: tuple[float, float] = (0.5, 0.15)
    check_every: int = 100
    seconds: float | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        """Check all numbers.

        Raises:
            ValueError: If one is out of range.
        """
        ranges: dict[str, tuple[float, float]] = {
            "resolution": (16, 384),
            "iterations": (1, 10**6),
            "batch": (16, 2**20),
            "features": (1, 64),
            "check_every": (1, 10**6),
        }
        for name, (low, high) in ranges.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} must lie between {low} and {high}, got {getattr(self, name)}")
        for name in ("rate_distance", "rate_features", "rate_network"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("mask_weight", "eikonal_weight", "smoothness_weight"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"{name} must be ≥ 0, got {getattr(self, name)}")
        if not all(b > 0 for b in self.blur):
            raise ValueError(f"blur must be positive, got {self.blur}")
        if self.seconds is not None and not self.seconds > 0:
            raise ValueError(f"seconds must be positive, got {self.seconds}")


class Score(NamedTuple):
    """How well views are rendered, means over them.

    Attributes:
        psnr: Of whole images, on the photographs' own background or on white [dB].
        psnr_object: Of the pixels that show the object [dB].
        ssim: Structural similarity of whole images.
        mask_iou: Intersection over union of the silhouettes.
    """

    psnr: float
    psnr_object: float
    ssim: float
    mask_iou: float


class Progress(NamedTuple):
    """What is known during training.

    Attributes:
        iteration: Steps done.
        iterations: Steps to do at most.
        seconds: Time in steps so far, without compilation [s].
        rays_per_second: Of the last steps.
        loss: Of the last step.
        psnr: Of held-out views, when last looked at [dB]; None before.
        mask_iou: Of held-out views, when last looked at; None before.
        volume: Of the solid [m³].
    """

    iteration: int
    iterations: int
    seconds: float
    rays_per_second: float
    loss: float
    psnr: float | None
    mask_iou: float | None
    volume: float


class Trained(NamedTuple):
    """What comes out of training.

    Attributes:
        field: The field.
        survey: What the silhouettes told, with the visual hull.
        scores: By split: "test", "relight", or "train" (some of its views) if nothing was held out.
        history: One entry per look at held-out views.
        stopped: Why training ended.
        seconds: From the start, with compilation and final measurements [s].
        unseen: Share of the surface that fewer than two training views see.
        warnings: Sentences for the user.
    """

    field: LearnedField
    survey: Survey
    scores: dict[str, Score]
    history: tuple[Progress, ...]
    stopped: Stopped
    seconds: float
    unseen: float
    warnings: tuple[str, ...]


class _State(eqx.Module):
    """What a checkpoint holds besides options."""

    model: SurfaceModel
    optimiser: Any
    iteration: int


def train(
    capture: Capture,
    options: TrainOptions | None = None,
    *,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    progress: Callable[[Progress], None] | None = None,
    previews: str | Path | None = None,
) -> Trained:
    """Learn a solid field from photographs with poses and masks (`with_masks` makes these).

    Args:
        capture: The photographs.
        options: How; default `TrainOptions()`.
        checkpoint: File that the state is written to at each look at held-out views, and when interrupted.
        resume: Go on from `checkpoint` if it exists.
        progress: Called after every few steps.
        previews: Folder for a PNG per look at held-out views: photographs, and their renderings below.

    Returns:
        The field, and how good it is.

    Raises:
        ValueError: If the capture cannot be learned from (see `survey`), or the checkpoint is of another
            training, or `previews` is no folder.
        ImportError: If optax is missing, or pillow for previews.
        KeyboardInterrupt: When interrupted, after the state has been saved to `checkpoint`.
    """
    start = time.perf_counter()
    options = TrainOptions() if options is None else options
    folder = None if previews is None else checked_folder(previews)
    near = {view.light_is_near for view in capture.views if view.light is not None}
    if len(near) > 1:
        raise ValueError("lights must be given as directions or as positions, got some of each")
    found = survey(capture, options.resolution)
    trainer = _Trainer(
        capture, options, found, Path(checkpoint) if checkpoint is not None else None, progress, folder
    )
    state = trainer.resumed() if resume else None
    state, stopped = trainer.run(state)
    field = LearnedField.from_model(state.model, trainer.sharpness(options.iterations))
    splits = [s for s in ("test", "relight") if capture.split(s)] or ["train"]
    scores = {s: score(field, capture.split(s)[: 16 if s == "train" else None]) for s in splits}
    unseen = unseen_share(state.model, capture.split("train"))
    warnings = list(found.warnings)
    if unseen > 0.05:
        warnings.append(f"{100 * unseen:.0f} % of the surface is seen by fewer than two views: a guess")
    if stopped == "diverged":
        warnings.append("training met a number that is not finite; what it had before is kept")
    return Trained(
        field,
        found,
        scores,
        tuple(trainer.history),
        stopped,
        time.perf_counter() - start,
        unseen,
        tuple(warnings),
    )


def score(field: LearnedField, views: tuple[View, ...]) -> Score:
    """Compare renderings with photographs, on these's own background if it is plain, else both on white.

    Raises:
        ValueError: If there is no view, or one has no mask.
    """
    if not views:
        raise ValueError("views must hold at least one view, got none")
    rows = []
    for view in views:
        if view.mask is None:
            raise ValueError(f"{view.name} must have a mask to be compared with")
        drawn = field.picture(view.camera, view.light)
        wanted, got = view.over(view.backdrop), drawn.over(view.backdrop)
        rows.append(
            (
                psnr(got, wanted),
                psnr(got, wanted, view.mask > 0.5),
                ssim(got, wanted),
                mask_iou(drawn.opacity, view.mask),
            )
        )
    return Score(*(float(x) for x in np.mean(rows, axis=0)))


class _Trainer:
    """One training; what is the same for all of its steps, and the record of how it went."""

    def __init__(
        self,
        capture: Capture,
        options: TrainOptions,
        found: Survey,
        checkpoint: Path | None,
        progress: Callable[[Progress], None] | None,
        previews: Path | None,
    ):
        self.capture, self.options, self.found = capture, options, found
        self.checkpoint, self.progress, self.previews = checkpoint, progress, previews
        self.history: list[Progress] = []
        self.key = jax.random.key(options.seed)
        held = capture.split("test") or capture.split("train")
        few = [held[i] for i in np.unique(np.linspace(0, len(held) - 1, 6).round().astype(int))]
        self.checked = [view.resized(max(1, min(view.image.shape[:2]) // 96)) for view in few]
        self.switch = options.iterations // 3
        views = capture.split("train")
        angles = [view.camera.pixel_angle for view in views]
        middle = 0.5 * (found.box.origin + found.box.upper)
        ranges = [np.linalg.norm(view.camera.position - middle) for view in views]
        self.pixel = float(np.median(np.multiply(angles, ranges)))

    def sharpness(self, iteration: int) -> float:
        """Of the surface [1/m] at a step: geometric from the first blur to the last."""
        first, last = self.options.blur
        share = min(1.0, iteration / (0.7 * self.options.iterations))
        return 1 / (max(self.pixel, 0.5 * self.found.box.spacing) * first * (last / first) ** share)

    def box(self, iteration: int) -> Box:
        """The grid of a step: coarse first."""
        fine = self.found.box
        if iteration >= self.switch:
            return fine
        return Box.around(fine.origin, fine.upper, max(16, 2 * self.options.resolution // 3))

    def fresh(self) -> _State:
        """The visual hull, grey all over."""
        views, box = self.capture.split("train"), self.box(0)
        lit = self.capture.is_lit
        look = Appearance.create(
            box,
            lit=lit,
            near_light=lit and views[0].light_is_near,
            n_features=self.options.features,
            resolution=max(8, 2 * self.options.resolution // 3),
            key=jax.random.fold_in(self.key, 1),
        )
        model = SurfaceModel.create(_resampled(self.found.hull, self.found.box, box), box, look)
        return _State(model, _optimiser(model, self.options).init(_trainable(model)), 0)

    def refined(self, state: _State) -> _State:
        """The state on the fine grid; the optimiser's memory starts anew."""
        coarse, fine = state.model.box, self.found.box
        distances = _resampled(state.model.distances, coarse, fine)
        model = SurfaceModel.create(distances, fine, state.model.appearance)
        return _State(model, _optimiser(model, self.options).init(_trainable(model)), state.iteration)

    def run(self, state: _State | None) -> tuple[_State, Stopped]:
        """All steps, or as many as it takes."""
        state = self.fresh() if state is None else state
        good, best, best_score = state, state, -np.inf
        rays, spent, stopped = self._rays(state.iteration), 0.0, "finished"
        options = self.options
        step = _make_step(options)
        last_loss, last_speed, since = float("nan"), 0.0, time.perf_counter()
        try:
            while state.iteration < options.iterations:
                if state.iteration == self.switch and state.model.distance.shape != self.found.box.shape:
                    state = self.refined(state)
                    rays = self._rays(state.iteration)
                begin = time.perf_counter()
                key = jax.random.fold_in(self.key, 2 + state.iteration)
                sharpness = jnp.float32(self.sharpness(state.iteration))
                # First without highlights: what moves with the viewer must be explained by shape.
                view_share = jnp.float32(state.iteration >= self.switch)
                decay = jnp.float32(0.1 ** (state.iteration / options.iterations))
                model, optimiser, loss = step(
                    state.model, state.optimiser, rays, sharpness, decay, view_share, key
                )
                last_loss = float(loss)
                if not np.isfinite(last_loss):
                    return good, "diverged"
                state = _State(model, optimiser, state.iteration + 1)
                took = time.perf_counter() - begin
                spent, last_speed = spent + took, options.batch / took
                if state.iteration % options.check_every == 0 or state.iteration == options.iterations:
                    entry = self._checked(state, spent, last_speed, last_loss)
                    good = state
                    self._save(state)
                    merit = (entry.mask_iou or 0.0) + 0.002 * (entry.psnr or 0.0)
                    if merit > best_score:
                        best, best_score = state, merit
                    if reason := self._reason_to_stop():
                        stopped = reason
                        break
                elif self.progress is not None and state.iteration % 5 == 0:
                    previous = self.history[-1] if self.history else None
                    self.progress(
                        Progress(
                            state.iteration,
                            options.iterations,
                            spent,
                            last_speed,
                            last_loss,
                            previous.psnr if previous else None,
                            previous.mask_iou if previous else None,
                            previous.volume if previous else float("nan"),
                        )
                    )
                if options.seconds is not None and time.perf_counter() - since > options.seconds:
                    stopped = "time"
                    break
        except KeyboardInterrupt:
            self._save(state)
            raise
        return (best if stopped == "geometry" else state), stopped

    def _rays(self, iteration: int) -> RaySet:
        """Rays that may meet the hull: the same whenever training is resumed."""
        box = self.box(iteration)
        hull = _resampled(self.found.hull, self.found.box, box)
        # Wide enough that the surface can move outwards by as much as its blur.
        return collect(self.capture.split("train"), box, hull < max(3 * box.spacing, 2 * self.pixel))

    def _checked(self, state: _State, spent: float, speed: float, loss: float) -> Progress:
        """Look at a few held-out views and at the solid."""
        sharpness = self.sharpness(state.iteration)
        model, rows, pairs = state.model, [], []
        occupied = model.distances < 3 * model.box.spacing
        for view in self.checked:
            light = view.light if model.appearance.lit else None
            drawn = picture(model, view.camera, light, model.box, occupied, sharpness)
            assert view.mask is not None
            pairs.append((view.over(view.backdrop), drawn.over(view.backdrop)))
            rows.append((psnr(pairs[-1][1], pairs[-1][0]), mask_iou(drawn.opacity, view.mask)))
        if self.previews is not None:
            write_preview(self.previews / f"{state.iteration:06d}.png", pairs)
        quality, overlap = np.mean(rows, axis=0)
        entry = Progress(
            state.iteration,
            self.options.iterations,
            spent,
            speed,
            loss,
            float(quality),
            float(overlap),
            volume(model.distances, model.box),
        )
        self.history.append(entry)
        if self.progress is not None:
            self.progress(entry)
        return entry

    def _reason_to_stop(self) -> Stopped | None:
        """Whether the outlines of held-out views have become worse, or nothing changes any more."""
        if len(self.history) < 4 or self.history[-1].iteration < 0.7 * self.options.iterations:
            # Until then the surface is still being made sharp.
            return None
        overlap = [entry.mask_iou or 0.0 for entry in self.history]
        # Brighter pictures with worse outlines: training has begun to eat into the solid.
        if max(overlap[:-2]) - max(overlap[-2:]) > 0.004:
            return "geometry"
        quality = [entry.psnr or 0.0 for entry in self.history]
        volumes = [entry.volume for entry in self.history[-3:]]
        settled = max(volumes) - min(volumes) < 5e-4 * volumes[-1]
        return "converged" if settled and max(quality[-2:]) < max(quality[:-2]) + 0.03 else None

    def _name(self) -> str:
        """What a checkpoint must belong to."""
        told = {**dataclasses.asdict(self.options), "seconds": None}
        names = [(view.name, view.split, view.image.shape) for view in self.capture.views]
        return hashlib.sha256(json.dumps([told, names], default=str).encode()).hexdigest()

    def _save(self, state: _State) -> None:
        if self.checkpoint is None:
            return
        leaves = jax.tree.leaves((state.model, state.optimiser))
        members = {f"leaf_{i:03d}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
        members |= {
            "format": np.array(CHECKPOINT),
            "version": np.array(CHECKPOINT_VERSION),
            "training": np.array(self._name()),
            "iteration": np.array(state.iteration),
            "history": np.array([[np.nan if x is None else x for x in entry] for entry in self.history]),
        }
        try:
            write_archive(self.checkpoint, members)
        except OSError as error:
            # A full disk must not cost what has been learned.
            import warnings

            warnings.warn(f"checkpoint {self.checkpoint} could not be written: {error}", stacklevel=2)

    def resumed(self) -> _State | None:
        """The state in the checkpoint; None if there is no checkpoint.

        Raises:
            ValueError: If it is of another training, or damaged.
        """
        if self.checkpoint is None or not self.checkpoint.exists():
            return None
        data = read_archive(self.checkpoint, CHECKPOINT, CHECKPOINT_VERSION)
        if str(data["training"]) != self._name():
            raise ValueError(
                f"{self.checkpoint} is of a training with other photographs or options: remove it, or train"
                " without resuming"
            )
        iteration = int(data["iteration"])
        state = self.fresh()
        if iteration > self.switch or len(data["leaf_000"]) != len(state.model.distance):
            state = self.refined(state)
        leaves, structure = jax.tree.flatten((state.model, state.optimiser))
        stored = [jnp.asarray(data[f"leaf_{i:03d}"]) for i in range(len(leaves))]
        if [x.shape for x in stored] != [x.shape for x in leaves]:
            raise ValueError(f"{self.checkpoint} does not fit this training: arrays of other shapes")
        model, optimiser = jax.tree.unflatten(structure, stored)
        self.history = [
            Progress(int(row[0]), int(row[1]), *(float(x) for x in row[2:])) for row in data["history"]
        ]
        return _State(model, optimiser, iteration)


def volume(distances: Float[np.ndarray, "nx ny nz"], box: Box) -> float:
    """Volume [m³] of {d < 0}, nodes near the surface counted in part."""
    return float(np.sum(np.clip(0.5 - distances / box.spacing, 0, 1)) * box.spacing**3)


def _resampled(values: np.ndarray, old: Box, new: Box) -> np.ndarray:
    from scipy import ndimage

    index = (new.nodes - old.origin).T / old.spacing
    return ndimage.map_coordinates(values, index, order=1, mode="nearest").reshape(new.shape)


def _trainable(model: SurfaceModel) -> Any:
    return model.distance, model.appearance.features, model.appearance.network


def _optimiser(model: SurfaceModel | None, options: TrainOptions) -> Any:
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


def _make_step(options: TrainOptions) -> Callable[..., tuple[SurfaceModel, Any, Array]]:
    """One step of the optimiser on a random batch of rays, compiled."""
    import optax

    sampling = Sampling(48, 16, 5)
    optimiser = _optimiser(None, options)

    def loss(
        parts: Any, model: SurfaceModel, batch: RaySet, sharpness: Array, view_share: Array, key: PRNGKeyArray
    ) -> Array:
        model = eqx.tree_at(_trainable, model, parts)
        jitter, paint = jax.random.split(key)
        background = jax.random.uniform(paint, batch.colour.shape, jnp.float32)
        seen = see(model, batch.rays, sharpness, sampling=sampling, view_share=view_share, key=jitter)
        wanted = batch.colour + (1 - batch.mask)[:, None] * background
        got = seen.colour + (1 - seen.opacity)[:, None] * background
        eikonal, bending = roughness(model.distance, model.spacing / model.scale, 4.0)
        return (
            jnp.mean((got - wanted) ** 2)
            + options.mask_weight * jnp.mean((seen.opacity - batch.mask) ** 2)
            + options.eikonal_weight * eikonal
            + options.smoothness_weight * bending
        )

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
        parts = _trainable(model)
        value, gradient = jax.value_and_grad(loss)(parts, model, batch, sharpness, view_share, own)
        # optax counts steps in integers and takes powers of floats by them.
        with jax.numpy_dtype_promotion("standard"):
            updates, state = optimiser.update(gradient, state, parts)
        updates = jax.tree.map(lambda u: decay * u, updates)
        return eqx.tree_at(_trainable, model, optax.apply_updates(parts, updates)), state, value

    return step
