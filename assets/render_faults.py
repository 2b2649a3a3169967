"""Draws what makes a film good or bad, for the guide *From a phone to a simulation*.

The toy and its newspaper are those of `benchmarks/films`. Two pictures, in the order of the guide's list: one
of how the film is taken and of what was learned, one of single frames.

Usage: PYTHONPATH=. python assets/render_faults.py docs/images
"""

import argparse
from pathlib import Path

import numpy as np
from filming import write_webp

from benchmarks.films._world import coded, looking, Pose, World
from dano.maths import quat_exp, quat_to_matrix

WIDTH, FOCAL = 320, 290.0
"""Of the frames: pixels, and as `looking` counts it for 240 of them."""

SUN, SKY, GAIN, NOISE = (-0.3, -0.5, 0.8), 0.5, 0.95, 0.008
TURN, HEIGHT, AWAY = -1.2, 0.6, 0.36
"""Where the camera is."""

CROP = (slice(20, 220), slice(40, 300))
GAP = 6
"""Between pictures [pixels]."""

COLOURS = ((0.95, 0.45, 0.25), (0.25, 0.22, 0.55))


def main() -> None:
    """Write both pictures."""
    parser = argparse.ArgumentParser(description="Draw what makes a film good or bad.")
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    taken = [[good(), short(), tunnel()], [bare(), moved(), ghost()]]
    write_webp(folder / "film_faults_taken.webp", [sheet(taken)])
    write_webp(folder / "film_faults.webp", [sheet([[pale(), blurred()], [small(), dark()]])])


def toy(share: float = 0.1, *, plain: bool = False) -> World:
    """The engine in two strong colours; `share` of it is as pale as the paper."""
    return World("engine", pale=share, colours=COLOURS, plain=plain)


def at(x: float = 0.0, y: float = 0.0) -> Pose:
    """Where it stands [m]."""
    return quat_to_matrix(quat_exp(np.array([0, 0, 0.5]))), np.array([x, y, 0.0])


def camera(away: float = AWAY, turn: float = TURN):
    """From where it is filmed."""
    return looking(turn, HEIGHT, away, WIDTH, FOCAL)


def frame(light: np.ndarray, *, gain: float = GAIN, noise: float = NOISE) -> np.ndarray:
    """A picture of linear light."""
    return coded(light, np.random.default_rng(0), gain, noise)[CROP]


def good() -> np.ndarray:
    """Sharp, large, with colours of its own."""
    return frame(toy().light(camera(), at(), SUN, SKY))


def blurred() -> np.ndarray:
    """The mean of a long exposure."""
    world = toy()
    ways = np.linspace(-0.011, 0.011, 9)
    return frame(np.mean([world.light(camera(), at(x, 0.3 * x), SUN, SKY) for x in ways], axis=0))


def small() -> np.ndarray:
    """From a metre away."""
    return frame(toy().light(camera(1.1), at(), SUN, SKY))


def dark() -> np.ndarray:
    """A sixth of the light, and its noise."""
    return frame(toy().light(camera(), at(), SUN, 0.08), gain=0.16, noise=0.05)


def pale() -> np.ndarray:
    """Most of it as pale as the paper."""
    return frame(toy(0.85).light(camera(), at(), SUN, SKY))


def bare() -> np.ndarray:
    """Pale, on a table that shows no points and no marker."""
    return frame(toy(0.85, plain=True).light(camera(), at(), SUN, SKY))


def short() -> np.ndarray:
    """Three frames of a slide over one another: it ends at the edge of the picture."""
    world, eye = toy(), camera()
    empty = world.light(eye, None, SUN, SKY)
    picture = empty.copy()
    for x in (-0.06, 0.02, 0.1):
        light = world.light(eye, at(x, 0.3 * x), SUN, SKY)
        there = np.abs(light - empty).max(axis=2) > 1e-6
        picture[there] = light[there]
    return frame(picture)


def tunnel() -> np.ndarray:
    """A solid as masks with a hole carve it."""
    return frame(World("engine", pale=0.1, colours=COLOURS, tunnel=0.006).light(camera(), at(), SUN, SKY))


def moved() -> np.ndarray:
    """By how much a frame differs from the place, from where the camera was 3 mm before."""
    world = toy()
    seen = frame(world.light(camera(), at(), SUN, SKY))
    return apart(seen, frame(world.light(camera(turn=TURN + 0.01), None, SUN, SKY)))


def ghost() -> np.ndarray:
    """By how much a frame differs from the median of a film in which the object moves by half its length."""
    world, eye = toy(), camera()
    ways = (-0.02, -0.015, 0.0, 0.012, 0.019, 0.022, 0.022)
    film = [frame(world.light(eye, at(x, 0.3 * x), SUN, SKY)) for x in ways]
    return apart(film[0], np.median(film, axis=0))


def apart(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Difference of two pictures, dark where there is much of it."""
    away = np.abs(first.astype(float) - second).max(axis=2, keepdims=True)
    return np.rint(255 - np.clip(2 * away, 0, 255)).astype(np.uint8).repeat(3, axis=2)


def sheet(rows: list[list[np.ndarray]]) -> np.ndarray:
    """Pictures beside and above one another."""
    padded = [[np.pad(x, ((0, GAP), (0, GAP), (0, 0)), constant_values=255) for x in row] for row in rows]
    return np.concatenate([np.concatenate(row, axis=1) for row in padded], axis=0)


if __name__ == "__main__":
    main()
