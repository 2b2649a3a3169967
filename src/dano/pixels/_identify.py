"""Parameters of a scene from the pixels of a film, through the simulation."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dano.checks import checked_kind, checked_optional
from dano.identification import Identification, identify, IdentifyOptions, Motion, Parameter
from dano.maths import quat_conjugate, quat_exp, quat_log, quat_multiply
from dano.scene import Scene
from dano.vision import (
    adjust_poses,
    Film,
    LearnedField,
    Light,
    PosedCamera,
    steady_film,
    Tracked,
    TrackOptions,
)

SETTLED = 0.25
"""Move of a parameter that ends the search, in the standard errors that it has then: each pass moves it by
about half of what the one before did, and as much is left. Not in those of the poses alone: where pixels say
less than the poses, their share makes the error larger, and by that much they may differ by chance."""

_NEARBY = 2.0
"""Standard deviations of what pixels alone say up to which poses agree with them."""

_MEDIAN = 5.35
"""Median of the square of six normal numbers, by their standard deviations (χ² of six degrees of freedom)."""

_PASSES = 6
"""Steps on pixels at most."""

_LIGHT_PASSES = 2
"""Passes in which the light is fitted: after that poses are right, and it would only follow the noise."""

_LEVEL = 0.999
"""Least z of the unit normal of a level table: 2.5°."""

_SUNK = 0.25
"""Share of the body's size by which the origin of its frame may lie below the table."""


class FilmFit(NamedTuple):
    """Parameters from a film."""

    # Values with error bars, and the motion that they give; that of the poses if pixels add nothing.
    fit: Identification
    poses: Identification  # The same from the poses alone, which the search began with
    # What the film shows at the motion found: quality and status of frames, light, silhouettes.
    tracked: Tracked
    # Values of the parameters after each pass, the first of them from the poses alone.
    history: tuple[Mapping[str, Any], ...]
    settled: bool  # Whether the last pass moved no value by more than a quarter of its standard error
    # Largest move of a value in each pass, in the standard errors that values have after it
    moves: tuple[float, ...]

    @property
    def lamps(self) -> tuple[Light, ...]:
        """Light that the film is under."""
        return self.tracked.lamps


def identify_in_film(
    scene: Scene,
    film: Film,
    look: LearnedField,
    camera: PosedCamera,
    motion: Motion,
    parameters: Sequence[Parameter | str],
    *,
    tracking: TrackOptions | None = None,
    background: str | Path | None = None,
    **settings: Any,
) -> FilmFit:
    """Find the parameters of a scene with which its rollout, rendered, looks like a film.

    Begins with the parameters that poses of the body give (`identify`). Then the film is rendered at the
    simulated poses, and residuals of silhouettes and colours, weighted robustly, are linearised there: a step
    of Gauss–Newton on pixels, through renderer and simulation, in parameters and initial state. The light is
    fitted in between. Poses of the motion, which all frames together have made, count as well as what the
    pixels of a frame say near the simulated one, each by its covariance, and neither makes the other surer.
    Covariances of frames grow until frames disagree with the simulation by no more than they say.

    Where most poses lie within two standard deviations of where the pixels want them, and the first step
    moves no value by more than a quarter of the standard error that it has then, pixels say what the poses
    said. The fit of the poses is the result then, and the search ends. Standard errors are never smaller than
    those from the poses. Memory is that of one frame beside the rollout.

    Args:
        scene: The scene, with values for whatever is not a parameter.
        film: The frames.
        look: How the body looks.
        camera: Which took the film.
        motion: Poses of that one body, as `Motion.from_tracked` gives them, at the film's times.
        parameters: What is unknown.
        tracking: How pixels are compared, as for `track`; without a `table` the scene's level half-space
            below the body is taken for it, if there is one.
        background: Picture of the place without the object.
        **settings: More arguments of `identify`, such as `initial`, `controls`, `options` or `progress`.

    Raises:
        ValueError: If the motion is not of one body at the film's times, or as `identify` and `track` say.
    """
    checked_kind("scene", scene, Scene)
    _check(film, look, camera, motion, settings)
    tracking = _with_table(
        scene, motion, checked_optional("tracking", tracking, TrackOptions) or TrackOptions()
    )
    film = steady_film(film, camera, background, tracking.readout)
    options = checked_optional("options", settings.pop("options", None), IdentifyOptions) or IdentifyOptions()
    # The trend of a rough loss is worth its simulations only where the search ends.
    on_the_way = dataclasses.replace(options, smooth=False)
    refit = functools.partial(identify, scene, parameters=parameters, **settings)
    before = refit(observed=motion, options=options)
    fit, history, settled, lamps = before, [before.values], False, None
    moves: list[float] = []
    found, pulled, more = None, None, {"background": background, "progress": settings.get("progress")}
    for k in range(_PASSES):
        seen = fit.fitted[0]
        poses = seen.position[:, 0], seen.orientation[:, 0]
        found = adjust_poses(film, look, camera, *poses, tracking, lamps=lamps, **more)
        lamps = found.lamps if k + 1 >= _LIGHT_PASSES else None
        alone = Motion.from_tracked(found, motion.names[0])
        pulled = _fused(alone, motion, _disagreement(alone, seen))
        last, fit = fit, refit(observed=pulled, after=fit, options=on_the_way)
        history.append(fit.values)
        moves.append(moved := _moved(last, fit))
        if k == 0 and moved < SETTLED and _agree(alone, motion):
            # The poses were made of these pixels, which have nothing to add.
            return FilmFit(before, before, found, tuple(history), True, tuple(moves))
        if settled := moved < SETTLED and k + 1 >= _LIGHT_PASSES:
            break
    assert found is not None and pulled is not None
    if options.smooth:
        fit = refit(observed=pulled, after=fit, options=options)
    return FilmFit(_no_smaller(fit, before), before, found, tuple(history), settled, tuple(moves))


def _agree(pulled: Motion, motion: Motion) -> bool:
    """Whether poses of a motion lie where the pixels want them, by what pixels alone know."""
    assert pulled.covariance is not None
    known, seen = _information(pulled.covariance[:, 0])
    return bool(seen.any()) and _median_square(motion, pulled, known, seen) < 6 * _NEARBY**2


def _no_smaller(fit: Identification, before: Identification) -> Identification:
    """A fit with errors that are nowhere smaller than those of another one of the same pixels."""
    here, there = np.diagonal(fit.covariance), np.diagonal(before.covariance)
    some = np.isfinite(here) & np.isfinite(there) & (here > 0)
    wider = np.ones(len(here))
    wider[some] = np.sqrt(np.maximum(there[some] / here[some], 1.0))
    errors = {
        name: np.maximum(np.asarray(error), np.asarray(before.standard_errors[name]))
        for name, error in fit.standard_errors.items()
    }
    covariance = fit.covariance * np.outer(wider, wider)
    return dataclasses.replace(fit, standard_errors=errors, covariance=covariance)


def _with_table(scene: Scene, motion: Motion, options: TrackOptions) -> TrackOptions:
    """The options with the height of the scene's highest level half-space below the body."""
    if options.table is not None:
        return options
    reach = float(np.nanmax(motion.position[..., 2])) + _SUNK * scene.body(motion.names[0]).size
    state, heights = scene.initial_state(), []
    for body, at, turn in zip(scene.bodies, state.position, state.orientation, strict=True):
        plane = body.half_space_at(at, turn)
        if body.fixed and plane is not None and plane[0][2] > _LEVEL:
            heights.append(plane[1] / float(plane[0][2]))
    below = [height for height in heights if height <= reach]
    return dataclasses.replace(options, table=max(below)) if below else options


def _disagreement(pulled: Motion, simulated: Motion) -> float:
    """By how much variances of single frames are too small, at least 1.

    A frame by itself does not know how far frames disagree: that is by how much the poses to which their
    pixels pull lie beside one motion, in the median of the frames.
    """
    assert pulled.covariance is not None
    known, seen = _information(pulled.covariance[:, 0])
    return max(1.0, _median_square(simulated, pulled, known, seen) / _MEDIAN)


def _fused(pulled: Motion, motion: Motion, disagreement: float) -> Motion:
    """Poses that pixels pull to together with those of a motion of the same film, by covariance intersection.

    Both say what the same pixels show, one frame by frame, the other in the light of all frames: half of what
    each says is never too sure (Julier and Uhlmann 1997). Without the motion nothing holds a pose along the
    line of sight, and a slide may hop there.

    Args:
        pulled: What pixels want.
        motion: That of all frames.
        disagreement: Factor of the covariances of the former.
    """
    assert pulled.covariance is not None
    if motion.covariance is None:
        return pulled
    here, seen = _information(disagreement * pulled.covariance[:, 0])
    there, told = _information(motion.covariance[:, 0])
    both, some = seen & told, seen | told
    covariance = np.full(pulled.covariance.shape, np.nan)
    covariance[some, 0] = np.linalg.inv(0.5 * (here + there)[some])
    # A frame in which pixels say nothing is that of the motion.
    position = np.where(seen[:, None, None], pulled.position, motion.position)
    orientation = np.where(seen[:, None, None], pulled.orientation, motion.orientation)
    apart = _apart(motion, dataclasses.replace(pulled, position=position, orientation=orientation), both)
    step = 0.5 * np.einsum("nij,njk,nk->ni", covariance[both, 0], there[both], apart)
    position[both, 0] += step[:, :3]
    orientation[both, 0] = quat_multiply(orientation[both, 0], quat_exp(step[:, 3:]))
    return dataclasses.replace(pulled, position=position, orientation=orientation, covariance=covariance)


def _apart(one: Motion, other: Motion, rows: np.ndarray) -> np.ndarray:
    """How far some poses of a motion are from those of another, as `Tracked.covariance` counts (n, 6)."""
    turn = quat_log(quat_multiply(quat_conjugate(other.orientation[rows, 0]), one.orientation[rows, 0]))
    return np.concatenate([one.position[rows, 0] - other.position[rows, 0], turn], axis=1)


def _median_square(one: Motion, other: Motion, known: np.ndarray, rows: np.ndarray) -> float:
    """Median square of how far poses are apart, by the information of the other one's (n, 6, 6).

    0 if there is none.
    """
    rows = rows & np.isfinite(one.position[:, 0]).all(axis=1)
    apart = _apart(one, other, rows)
    square = np.einsum("ni,nij,nj->n", apart, known[rows], apart)
    return float(np.median(square)) if len(square) else 0.0


def _information(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverses of covariances (n, 6, 6), zero where they are not known, and which are."""
    known = np.asarray(np.isfinite(covariance).all(axis=(-2, -1)))
    inverse = np.zeros(covariance.shape)
    inverse[known] = np.linalg.inv(covariance[known])
    return inverse, known


def _moved(before: Identification, after: Identification) -> float:
    """Largest move of a value, in its standard errors."""
    moves = [
        np.abs(np.asarray(after.values[name]) - np.asarray(before.values[name]))
        / np.maximum(np.asarray(after.standard_errors[name]), 1e-12)
        for name in after.values
    ]
    return max((float(np.max(move)) for move in moves), default=0.0)


def _check(
    film: Film, look: LearnedField, camera: PosedCamera, motion: Motion, settings: Mapping[str, Any]
) -> None:
    checked_kind("film", film, Film)
    checked_kind("look", look, LearnedField)
    checked_kind("camera", camera, PosedCamera)
    if not isinstance(motion, Motion) or len(motion.names) != 1:
        raise ValueError(
            f"motion must be of the one body that the film shows, got {getattr(motion, 'names', motion)!r}"
        )
    if motion.point != "origin":
        raise ValueError(
            "motion must hold positions of the origin of the body's field frame (point='origin'), as tracking"
            f" gives them, got point={motion.point!r}"
        )
    if len(motion.times) != len(film.times) or not np.allclose(motion.times, film.times, atol=1e-4):
        raise ValueError(
            f"motion must have a pose for each of the film's {len(film.times)} frames at their times, got"
            f" {len(motion.times)} from {motion.times[0]:.4g} to {motion.times[-1]:.4g} s (film: 0 to"
            f" {film.times[-1]:.4g} s)"
        )
    if "after" in settings:
        raise ValueError("settings must not hold after: the fit of the poses is what the search begins with")
