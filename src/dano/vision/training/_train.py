"""Training: from photographs with masks to a solid field.

The solid starts as the visual hull of the masks, without the cavities that a fog finds in it, on a coarse
grid; rendering is compared with random rays of the photographs (see `make_step`). Coarse first, finer later.
"""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import ndimage

from dano.progress import Progress
from dano.vision.capture import (
    Capture,
    collect,
    decided_by_colours,
    hull_distance,
    NodeGrid,
    object_box,
    RaySet,
    resampled,
    silhouette,
    Solid,
    spare_of,
    View,
)
from dano.vision.radiance import Appearance, Doubt, LearnedField, picture, SurfaceModel
from dano.vision.training import _checkpoint
from dano.vision.training._adjustment import Adjustment
from dano.vision.training._cavities import find_cavities, STEPS
from dano.vision.training._contradicted import differences, sunk
from dano.vision.training._doubt import with_doubts
from dano.vision.training._metrics import mask_iou, psnr
from dano.vision.training._options import TrainOptions
from dano.vision.training._preview import checked_folder, write_preview
from dano.vision.training._score import Score, score
from dano.vision.training._steps import Learned, make_step, optimiser_of
from dano.vision.training._survey import Corners, Survey, survey, unseen_share

_WORTH_TRYING = 0.003
"""Share of the hull that cavities must take for a surface without them to be tried."""

_CLOSE = 0.2
"""Blur [pixels] of a surface that starts without the cavities of the hull."""

_TRIAL = 80
"""Steps that tell whether a surface without cavities explains more."""

_STILL, _COHERENT, _SHARP = 0.125, 0.6, 0.7
"""Shares of the steps until which the surface stays where it is, so that the untrained appearance does not
distort the surface (but cameras and surface are learned together); until its nodes move each on its own; and
until it is sharp."""

_AGAIN = 1 / 6, 1 / 3, 1 / 2, 0.7
"""Shares of the steps after which masks that colours decide are those of what has been learned."""

_PER_DECIBEL = 0.002
"""What a decibel of PSNR counts beside mask IoU where the best state is chosen: 5 dB as much as 0.01."""

_WORSE, _OF_RESIDUAL = 0.004, 0.5
"""Loss of mask IoU on held-out views that stops training, at least this and this share of what no solid
explains (chosen; no benchmark varies them)."""

_UNLIKE = 0.12
"""Difference of colours [sRGB] from which a pixel is not explained."""

_STEADY_VOLUME, _STEADY_QUALITY = 5e-4, 0.03
"""Relative change of volume, and gain of PSNR [dB], below which training has converged (chosen)."""

Stopped = Literal["finished", "converged", "geometry", "time", "diverged"]


class HistoryEntry(NamedTuple):
    """What held-out views tell during training."""

    iteration: int  # Steps done
    iterations: int  # Steps to do at most
    seconds: float  # Time in steps so far, without compilation [s]
    rays_per_second: float  # Of the last steps
    loss: float  # Of the last step
    psnr: float  # Of held-out views [dB]
    mask_iou: float  # Of held-out views
    volume: float  # Of the solid [m³]


class Trained(NamedTuple):
    """What comes out of training."""

    field: LearnedField  # The field
    # The photographs as they were compared: at the resolution that was worked with, seen by corrected
    # cameras.
    capture: Capture
    survey: Survey  # What the silhouettes told, with the visual hull
    # By split: "test", "relight", or "train" (some of its views) if nothing was held out.
    scores: dict[str, Score]
    history: tuple[HistoryEntry, ...]  # One entry per evaluation on held-out views
    stopped: Stopped  # Why training ended
    seconds: float  # From the start, with compilation and final measurements [s]
    unseen: float  # Share of the surface that fewer than two training views see
    # Share of the silhouettes that the field does not explain: of what is not in both its silhouettes and the
    # masks, or where colours decide, of pixels that show another colour.
    unexplained: float
    warnings: tuple[str, ...]  # Sentences for the user


class _State(eqx.Module):
    """What a checkpoint holds besides options."""

    learned: Learned
    optimiser: Any
    iteration: int
    blur: Float[Array, ""]

    @property
    def model(self) -> SurfaceModel:
        return self.learned.model


def train(
    capture: Capture,
    options: TrainOptions | None = None,
    *,
    table: float | None = None,
    views: int | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
    previews: str | Path | None = None,
) -> Trained:
    """Learn a solid field from photographs with poses and masks (`with_masks` makes these).

    Args:
        capture: The photographs.
        options: How; default `TrainOptions()`.
        table: Height z of a level table [m, W] that the object stands on: masks that are doubted (those that
            `with_masks` found on a table) are only a beginning, and colours of object and table decide.
        views: Train on so many of the views only.
        checkpoint: File that the state is written to at each evaluation, and when interrupted.
        resume: Go on from `checkpoint` if it exists.
        progress: Called after every few steps, while cavities are looked for and during training.
        previews: Folder for a PNG per evaluation: held-out photographs, and their renderings below.

    Returns:
        The field, and how good it is.

    Raises:
        ValueError: If the capture cannot be learned from (see `survey`), or the checkpoint is of another
            training, or `previews` is not a folder.
        ImportError: If pillow is missing for previews.
        KeyboardInterrupt: When interrupted, after the state has been saved to `checkpoint`.
    """
    start = time.perf_counter()
    options = TrainOptions() if options is None else options
    folder = None if previews is None else checked_folder(previews)
    if views is not None:
        capture = capture.thinned(views)
    near = {view.light_is_near for view in capture.views if view.light is not None}
    if len(near) > 1:
        raise ValueError("lights must be given as directions or as positions, got some of each")
    capture, corners = _shrunk(capture, options)
    capture, found = with_doubts(capture, survey(capture, options.resolution, corners=corners))
    trainer = _Trainer(
        capture, options, found, Path(checkpoint) if checkpoint is not None else None, progress, folder, table
    )
    state = trainer.resumed() if resume else None
    state, stopped = trainer.run(state)
    field = LearnedField.from_model(state.model, trainer.sharpness(options.iterations, options.blur[0]))
    capture = trainer.with_corrected_cameras(state)
    splits = [s for s in ("test", "relight") if capture.split(s)] or ["train"]
    scores = {s: score(field, capture.split(s)[: 16 if s == "train" else None]) for s in splits}
    unseen = unseen_share(state.model, capture.split("train"))
    unexplained = trainer.unexplained(field)
    field = field.doubted(Doubt.of_training(unexplained, unseen))
    warnings = list(found.warnings)
    if unseen > 0.05:
        warnings.append(f"{100 * unseen:.0f} % of the surface is seen by fewer than two views and is a guess")
    if stopped == "diverged":
        warnings.append("training reached a number that is not finite; the result is the state before")
    return Trained(
        field,
        capture,
        found,
        scores,
        tuple(trainer.history),
        stopped,
        time.perf_counter() - start,
        unseen,
        unexplained,
        tuple(warnings),
    )


class _Trainer:
    """One training; what is the same for all of its steps, and the record of how it went."""

    def __init__(
        self,
        capture: Capture,
        options: TrainOptions,
        found: Survey,
        checkpoint: Path | None,
        progress: Progress | None,
        previews: Path | None,
        table: float | None,
    ):
        self.capture, self.options, self.found = capture, options, found
        self.views = capture.split("train")
        doubted = any(view.doubt is not None for view in self.views)
        self.table = table if doubted and table is not None else None
        self.checkpoint = _checkpoint.file_of(checkpoint, options, capture)
        self.progress, self.previews = progress, previews
        self.history: list[HistoryEntry] = []
        self.key = jax.random.key(options.seed)
        held = capture.split("test") or capture.split("train")
        few = [held[i] for i in np.unique(np.linspace(0, len(held) - 1, 6).round().astype(int))]
        self.checked = [view.resized(max(1, min(view.image.shape[:2]) // 96)) for view in few]
        self.switch = options.iterations // 3
        self.step = make_step(options, lit=capture.is_lit)
        self.middle = 0.5 * (found.box.origin + found.box.upper)
        self.pixel = pixel_at(self.views, self.middle)
        if self.table is not None:
            # What one photograph alone takes away is left to colours.
            hull = hull_distance(self.views, found.box, spare=spare_of(len(self.views)))
            self.found = found._replace(hull=hull)
            self.views = decided_by_colours(self.views, self.table, Solid(found.box, hull), masks_stay=True)

    def cleared(self, state: _State) -> _State:
        """The surface without what is in the way of what photographs show, once colours are learned."""
        model, sharpness = state.model, self.sharpness(state.iteration, float(state.blur))
        if state.iteration < self.switch:
            return state
        views = state.learned.cameras.corrected(self.views)
        distances = sunk(model.distances, model.box, differences(model, views, sharpness))
        distance = jnp.asarray(distances / float(model.scale), jnp.float32)
        return _State(state.learned.moved_to(distance), state.optimiser, state.iteration, state.blur)

    def looked_again(self, state: _State) -> None:
        """Take what has been learned for the masks, where colours decide these."""
        assert self.table is not None
        solid = Solid(state.model.box, state.model.distances)
        self.views = decided_by_colours(self.views, self.table, solid)
        self.checked = [view.replaced(mask=silhouette(view.camera, *solid)) for view in self.checked]

    def sharpness(self, iteration: int, first: float) -> float:
        """Of the surface [1/m] at a step: geometric from the first blur to the last."""
        last = self.options.blur[1]
        share = min(1.0, iteration / (_SHARP * self.options.iterations))
        return 1 / (max(self.pixel, 0.5 * self.found.box.spacing) * first * (last / first) ** share)

    def box(self, iteration: int) -> NodeGrid:
        """The grid of a step: coarse first."""
        fine = self.found.box
        if iteration >= self.switch:
            return fine
        return NodeGrid.around(fine.origin, fine.upper, max(16, 2 * self.options.resolution // 3))

    def fresh(self, start: np.ndarray, blur: float) -> _State:
        """A surface at signed distances [m] on the survey's box, grey all over and blurred [pixels]."""
        views, box = self.capture.split("train"), self.box(0)
        lit = self.capture.is_lit
        appearance = Appearance.create(
            box,
            lit=lit,
            near_light=lit and views[0].light_is_near,
            n_features=self.options.features,
            resolution=max(8, 2 * self.options.resolution // 3),
            key=jax.random.fold_in(self.key, 1),
        )
        model = SurfaceModel.create(resampled(start, self.found.box, box), box, appearance)
        cameras = Adjustment.create(views, self.middle)
        return self._begun(Learned(model, cameras), 0, jnp.float32(blur))

    def _begun(self, learned: Learned, iteration: int, blur: Float[Array, ""]) -> _State:
        optimiser = optimiser_of(self.options, lit=self.capture.is_lit)
        return _State(learned, optimiser.init(learned.parts), iteration, blur)

    def refined(self, state: _State) -> _State:
        """The state on the fine grid; the optimiser's memory starts anew."""
        coarse, fine = state.model.box, self.found.box
        distances = resampled(state.model.distances, coarse, fine)
        model = SurfaceModel.create(distances, fine, state.model.appearance)
        return self._begun(Learned(model, state.learned.cameras), state.iteration, state.blur)

    def started(self) -> _State:
        """The visual hull, or the hull without the cavities that a fog finds if that explains more."""
        hull = self.fresh(self.found.hull, self.options.blur[0])
        if not self.options.cavities:
            return hull
        found = find_cavities(
            self.views,
            self.found.hull,
            self.found.box,
            lit=self.capture.is_lit,
            key=jax.random.fold_in(self.key, 0),
            n_steps=min(STEPS, max(1, self.options.iterations // 2)),
            progress=self.progress,
        )
        worth = [each for each in found if each.share > _WORTH_TRYING]
        if not worth:
            return hull
        # Blur helps to find the way from a hull; a start that is close already would be filled up by it.
        sharp = min(_CLOSE, self.options.blur[0])
        rays = self._rays(0)
        without, *starts = (
            self.fresh(distance, sharp) for distance in (self.found.hull, *(each.distance for each in worth))
        )
        each = [without, *starts]
        error, *errors = (self._trial(begun, rays, k, len(each)) for k, begun in enumerate(each))
        return starts[int(np.argmin(errors))] if min(errors) < error else hull

    def _tell(self, iteration: int, speed: float) -> None:
        """Say how far training is; `speed` is that of the last steps [rays/s]."""
        if self.progress is not None:
            quality = f"{self.history[-1].psnr:.1f} dB " if self.history else ""
            share = iteration / self.options.iterations
            self.progress(f"training, {quality}{speed / 1000:.0f}k rays/s", share)

    def _trial(self, state: _State, rays: RaySet, number: int, of: int) -> float:
        """Mean loss of the last of a few steps: translucency deceives a fog, but not a surface.

        Args:
            state: Where to begin.
            rays: What is compared.
            number: Of this trial, for progress.
            of: How many there are.
        """
        losses, steps = [], max(1, min(_TRIAL, self.switch))
        for i in range(steps):
            state, loss = self.advanced(state, rays)
            losses.append(loss)
            if self.progress is not None and i % 5 == 0:
                self.progress("trying cavities", (number + i / steps) / of)
        return float(np.mean(losses[-max(1, len(losses) // 4) :]))

    def advanced(self, state: _State, rays: RaySet) -> tuple[_State, float]:
        """One step, and the loss before it."""
        i, options = state.iteration, self.options
        learned, optimiser, error = self.step(
            state.learned,
            state.optimiser,
            rays,
            jnp.float32(self.sharpness(i, float(state.blur))),
            jnp.float32(0.1 ** (i / options.iterations)),
            # First without highlights: what moves with the viewer must be explained by shape.
            jnp.float32(i >= self.switch),
            jnp.float32(max(0.0, 1 - i / (_COHERENT * options.iterations))),
            jax.random.fold_in(self.key, 2 + i),
        )
        if i < _STILL * options.iterations and not options.cameras:
            learned = learned.moved_to(state.model.distance)
        return _State(learned, optimiser, i + 1, state.blur), float(error)

    def run(self, state: _State | None) -> tuple[_State, Stopped]:
        """All steps, or as many as it takes."""
        state = self.started() if state is None else state
        good, best, best_score = state, state, -np.inf
        if self.table is not None and state.iteration > 0:
            self.looked_again(state)
        rays, spent, stopped = self._rays(state.iteration), 0.0, "finished"
        options, since = self.options, time.perf_counter()
        again = {round(share * options.iterations) for share in _AGAIN} if self.table is not None else set()
        try:
            while state.iteration < options.iterations:
                if state.iteration == self.switch and state.model.distance.shape != self.found.box.shape:
                    state = self.refined(state)
                    rays = self._rays(state.iteration)
                if state.iteration in again:
                    state = self.cleared(state)
                    self.looked_again(state)
                    rays = self._rays(state.iteration, state.model.distances)
                begin = time.perf_counter()
                state, loss = self.advanced(state, rays)
                if not np.isfinite(loss):
                    return good, "diverged"
                took = time.perf_counter() - begin
                spent, speed = spent + took, options.batch / took
                if state.iteration % options.check_every == 0 or state.iteration == options.iterations:
                    entry = self._checked(state, spent, speed, loss)
                    good = state
                    self._save(state)
                    merit = entry.mask_iou + _PER_DECIBEL * entry.psnr
                    if merit > best_score:
                        best, best_score = state, merit
                    if reason := reason_to_stop(self.history, self.found.residual):
                        stopped = reason
                        break
                elif state.iteration % 5 == 0:
                    self._tell(state.iteration, speed)
                if options.seconds is not None and time.perf_counter() - since > options.seconds:
                    stopped = "time"
                    break
        except KeyboardInterrupt:
            self._save(state)
            raise
        return (best if stopped == "geometry" else state), stopped

    def unexplained(self, field: LearnedField) -> float:
        """Share of the silhouettes that a field does not explain (see `Trained`)."""
        some = np.unique(np.linspace(0, len(self.views) - 1, 16).round().astype(int))
        given = self.capture.split("train")
        return float(np.mean([unexplained_share(field, self.views[i], given[i]) for i in some]))

    def with_corrected_cameras(self, state: _State) -> Capture:
        """The photographs, those held out corrected by what all cameras have in common."""
        train, cameras = self.capture.split("train"), state.learned.cameras
        other = [view for view in self.capture.views if view.split != "train"]
        return Capture((*cameras.corrected(train), *cameras.corrected_lens(other)), self.capture.source)

    def _rays(self, iteration: int, learned: np.ndarray | None = None) -> RaySet:
        """Rays that may meet the hull, or what has been learned: the same whenever training is resumed."""
        box = self.box(iteration)
        hull = resampled(self.found.hull, self.found.box, box)
        if learned is not None and learned.shape == hull.shape:
            hull = np.minimum(hull, learned)
        # Wide enough that the surface can move outwards by as much as its blur.
        return collect(self.views, box, hull < max(3 * box.spacing, 2 * self.pixel))

    def _checked(self, state: _State, spent: float, speed: float, loss: float) -> HistoryEntry:
        """Evaluate a few held-out views and the solid."""
        sharpness = self.sharpness(state.iteration, float(state.blur))
        model, rows, pairs = state.model, [], []
        occupied = model.distances < 3 * model.box.spacing
        for view in state.learned.cameras.corrected_lens(self.checked):
            light = view.light if model.appearance.lit else None
            drawn = picture(model, view.camera, light, model.box, occupied, sharpness)
            assert view.mask is not None
            pairs.append((view.over(view.backdrop), drawn.over(view.backdrop)))
            rows.append((psnr(pairs[-1][1], pairs[-1][0]), mask_iou(drawn.opacity, view.mask)))
        if self.previews is not None:
            write_preview(self.previews / f"{state.iteration:06d}.png", pairs)
        quality, overlap = np.mean(rows, axis=0)
        entry = HistoryEntry(
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
        self._tell(state.iteration, speed)
        return entry

    def _save(self, state: _State) -> None:
        rows = [[float(x) for x in entry] for entry in self.history]
        tree = state.learned, state.optimiser, state.blur
        _checkpoint.save(self.checkpoint, state.iteration, tree, rows)

    def resumed(self) -> _State | None:
        """The state in the checkpoint; None if there is no checkpoint.

        Raises:
            ValueError: If it is of another training, or damaged.
        """
        stored = _checkpoint.load(self.checkpoint)
        if stored is None:
            return None
        state = self.fresh(self.found.hull, self.options.blur[0])
        if stored.iteration > self.switch or len(stored.leaves[0]) != len(state.model.distance):
            state = self.refined(state)
        learned, optimiser, blur = stored.filled((state.learned, state.optimiser, state.blur))
        self.history = [
            HistoryEntry(int(row[0]), int(row[1]), *(float(x) for x in row[2:])) for row in stored.history
        ]
        return _State(learned, optimiser, stored.iteration, blur)


def unexplained_share(field: LearnedField, view: View, given: View) -> float:
    """Share of a silhouette that a field does not explain.

    Where the photograph shows what is behind the object, colours tell: pixels count in which the field, or
    what is behind where it is not, has another colour. Otherwise all in which its silhouette is not the mask.

    Args:
        field: What was learned.
        view: A photograph, with what is behind the object if that is known.
        given: The same with the mask that it came with.
    """
    drawn = field.picture(view.camera, view.light)
    assert given.mask is not None
    if view.behind is None:
        return 1 - mask_iou(drawn.opacity, given.mask)
    shown, stated = drawn.opacity > 0.5, given.mask > 0.5
    known = np.all(np.isfinite(view.behind), axis=-1)
    expected = drawn.over(np.where(known[..., None], view.behind, 0))
    # Without the blur, letters that are a quarter of a pixel beside would count.
    apart = np.abs(ndimage.gaussian_filter(expected - view.image, (1, 1, 0))).max(axis=-1)
    asked = shown | stated
    wrong = np.where(known | shown, apart > _UNLIKE, shown != stated)
    return float(np.sum(wrong & asked) / max(np.sum(asked), 1))


def reason_to_stop(history: Sequence[HistoryEntry], residual: float) -> Stopped | None:
    """Whether the outlines of held-out views have become worse, or nothing changes any more.

    Args:
        history: All evaluations on held-out views.
        residual: Share of the silhouettes that no solid explains (see `Survey`).
    """
    if len(history) < 4 or history[-1].iteration < _SHARP * history[-1].iterations:
        # Until then the surface is still being made sharp.
        return None
    overlap = [entry.mask_iou for entry in history]
    # Brighter pictures with worse outlines: training has begun to eat into the solid. Outlines that do not
    # agree with one another cannot tell that any more exactly.
    if max(overlap[:-2]) - max(overlap[-2:]) > max(_WORSE, _OF_RESIDUAL * residual):
        return "geometry"
    quality = [entry.psnr for entry in history]
    volumes = [entry.volume for entry in history[-3:]]
    settled = max(volumes) - min(volumes) < _STEADY_VOLUME * volumes[-1]
    return "converged" if settled and max(quality[-2:]) < max(quality[:-2]) + _STEADY_QUALITY else None


def pixel_at(views: Sequence[View], point: Float[np.ndarray, "3"]) -> float:
    """Width of a pixel [m] at a point [m, W], median over views."""
    ranges = [np.linalg.norm(view.camera.position - point) for view in views]
    return float(np.median(np.multiply([view.camera.pixel_angle for view in views], ranges)))


def _shrunk(capture: Capture, options: TrainOptions) -> tuple[Capture, Corners | None]:
    """Photographs whose pixels are about as large as the cells of the finest grid, if they are smaller.

    Returns:
        The photographs, and the corners of the object's box if these photographs told them.
    """
    views = capture.split("train")
    if not capture.has_masks:
        return capture, None
    lower, upper = object_box(views)
    cell = float((upper - lower).max()) / options.resolution
    factor = max(1, round(cell / pixel_at(views, 0.5 * (lower + upper))))
    if factor == 1:
        return capture, (lower, upper)
    return Capture([view.resized(factor) for view in capture.views], capture.source), None


def volume(distances: Float[np.ndarray, "nx ny nz"], box: NodeGrid) -> float:
    """Volume [m³] of {d < 0}, nodes near the surface counted in part."""
    return float(np.sum(np.clip(0.5 - distances / box.spacing, 0, 1)) * box.spacing**3)
