"""Friction of a pair of bodies from recording to recording: what intervals hold.

A fit that takes every frame for independent is sure of friction to a per cent, and the next recording has
another one. Each recording is fitted three ways: frames independent, pieces of it independent (motions that
begin anew), and what the other recordings, each one number, predict for one more.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.stats import t as student

import dano
from benchmarks._measure import Row, skipped
from benchmarks.real import _impacts
from benchmarks.real._data import Impacts, NO_DATA, Source
from benchmarks.real._pushes import driven, FOOT, FRAME, halves, HEIGHT, Push, scene, start

MEASURING = {"radius": 0.004745, "scale": -0.00668, "x": 0.000862, "y": 0.000734}
BLOCK = {"friction": 0.252, "feet": 0.0684}
"""Of the pushes: what `pushes` fits to every second recording."""

OWN_SCALE = "Scale of the pusher's coordinates, from where it touches the block"
_SECOND = 250  # frames

PARTS = 12
"""Of the impacts."""


def rows(source: Source | None, *, quick: bool = False) -> list[Row]:
    """Frictions of recordings, and which share of intervals holds those of others."""
    if source is None:
        return [skipped("Frictions", "all of them", NO_DATA)]
    one, two = halves(source)
    pushes = [*one, *two][: 3 if quick else None]
    found, fits = (
        [],
        _fits(lambda k, kind, after: identify(pushes[k], independent=kind, after=after), len(pushes)),
    )
    for push, fit in zip(pushes, fits["motions"], strict=True):
        low, high = fit.interval("friction")
        note = f"95 % {low:.3f} to {high:.3f}; {len(fit.motions)} pieces of {PIECE * FRAME:g} s"
        found.append(
            Row("Friction of pusher and block", push.name, float(fit.values["friction"]), "", note=note)
        )
    for push in pushes:
        # The first second, before the block has turned.
        deep = 1e3 * float(np.median(push.overlap(MEASURING)[:_SECOND]))
        note = f"with the scale of all the pusher is {deep:.2f} mm in the block in the first second"
        found.append(Row(OWN_SCALE, push.name, 100 * push.measured(MEASURING)["scale"], "%", note=note))
    found += _shares("Pushes: 95 % intervals that hold the friction of the other recordings", fits)
    impacts = Impacts.load(source.folder / "impacts.npz", slice(None))
    parts = 3 if quick else PARTS
    chosen = [np.arange(k, len(impacts), parts)[: 20 if quick else None] for k in range(parts)]

    def part(k: int, kind: str, after: dano.Identification | None) -> dano.Identification:
        return _impacts.identify(impacts.some(chosen[k]), independent=kind, after=after)

    group = f"Impacts: 95 % intervals that hold the friction of the other {parts - 1} parts"
    return found + _shares(group, _fits(part, parts))


def _fits(fit: Callable[..., dano.Identification], count: int) -> dict[str, list[dano.Identification]]:
    """Fits of each recording in all kinds; the second begins where the first ended."""
    found: dict[str, list[dano.Identification]] = {kind: [] for kind in INDEPENDENT}
    for k in range(count):
        after = None
        for kind, each in found.items():
            after = fit(k, kind, after)
            each.append(after)
    return found


def _shares(group: str, fits: Mapping[str, Sequence[dano.Identification]]) -> list[Row]:
    found = []
    for kind, each in fits.items():
        held, note = agreement(each)
        words = "frames independent" if kind == "numbers" else "motions independent"
        found.append(Row(group, words, held, "%", note=note))
    held, note = predicted(np.array([float(fit.values["friction"]) for fit in fits["motions"]]))
    return [*found, Row(group, "recordings independent", held, "%", 90.0, True, note=note)]


INDEPENDENT = ("numbers", "motions")
PIECE = 125  # frames
MOST_PIECES = 15


def agreement(fits: Sequence[dano.Identification]) -> tuple[float, str]:
    """Share [%] of recordings whose 95 % interval holds what the others say, and words.

    What the others say is their mean with weights of the inverse variances; its own error is counted.
    """
    # One on a bound, or not observed, has no interval.
    fits = [fit for fit in fits if 0 < float(fit.standard_errors["friction"]) < np.inf]
    values = np.array([float(fit.values["friction"]) for fit in fits])
    sigmas = np.array([float(fit.standard_errors["friction"]) for fit in fits])
    weights = 1 / sigmas**2
    inside = []
    for k, fit in enumerate(fits):
        others = np.delete(weights, k)
        middle = others @ np.delete(values, k) / others.sum()
        low, high = fit.interval("friction")
        half = np.hypot(0.5 * (high - low), 1.96 / np.sqrt(others.sum()))
        inside.append(abs(values[k] - middle) <= half)
    scatter = f"scatter between recordings {np.std(values, ddof=1):.3f}, stated {np.median(sigmas):.3f}"
    return 100 * float(np.mean(inside)), f"{sum(inside)} of {len(inside)}; {scatter}"


def predicted(values: np.ndarray) -> tuple[float, str]:
    """Share [%] of recordings in the 95 % interval that the others predict for one more, and words.

    Mean ± t s √(1 + 1/m) of m others, with their standard deviation s and Student's t of m − 1.
    """
    inside = []
    for k, value in enumerate(values):
        others = np.delete(values, k)
        half = float(student.ppf(0.975, len(others) - 1)) * np.std(others, ddof=1)
        inside.append(abs(value - others.mean()) <= half * np.sqrt(1 + 1 / len(others)))
    half = float(student.ppf(0.975, len(values) - 1)) * np.std(values, ddof=1) * np.sqrt(1 + 1 / len(values))
    note = f"{sum(inside)} of {len(inside)}; for one more: {values.mean():.3f} ± {half:.3f}"
    return 100 * float(np.mean(inside)), note


def identify(
    push: Push, *, independent: str = "motions", after: dano.Identification | None = None
) -> dano.Identification:
    """Friction of the pusher from one recording, in pieces of half a second.

    The scale of the pusher's coordinates is the recording's own. Each piece is a motion that begins where
    the block was and as fast: a blow spoils only its own. The friction of the table does not show: the block
    stops as soon as it is not pushed.
    """
    made, measuring = scene(MEASURING["radius"], **BLOCK), push.measured(MEASURING)
    count = min(len(push) // PIECE, MOST_PIECES)
    pieces = [
        Push(push.name, push.block[k * PIECE : (k + 1) * PIECE], push.pusher[k * PIECE : (k + 1) * PIECE])
        for k in range(count)
    ]
    paths = [piece.path(measuring) for piece in pieces]
    friction = dano.Parameter("friction", lambda s: s.contact("pusher", "block").sliding_friction, 0.02, 1.0)
    options = dano.IdentifyOptions(huber=1.5, independent=independent, starts=1, smooth=False)
    with warnings.catch_warnings():
        # That residuals of a piece hang together.
        warnings.simplefilter("ignore", RuntimeWarning)
        return dano.identify(
            made,
            [_motion(piece) for piece in pieces],
            [friction],
            state=[start(made, piece, path, moving=True) for piece, path in zip(pieces, paths, strict=True)],
            controls=[driven(made, path[1:]) for path in paths],
            initial="given",
            noise={"position": 1e-3, "orientation": 5e-3},
            after=after,
            options=options,
        )


def _motion(push: Push) -> dano.Motion:
    frames = np.arange(0, len(push), 31)
    x, y, angle = push.block[frames].T
    still = np.zeros_like(x)
    return dano.Motion.create(
        frames * FRAME,
        "block",
        position=np.column_stack([x, y, still + FOOT + HEIGHT]),
        orientation=np.column_stack([np.cos(angle / 2), still, still, np.sin(angle / 2)]),
    )
