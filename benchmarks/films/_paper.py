"""A newspaper from above, and the curve of a camera: what drawn photographs and films share."""

from functools import cache

import cv2
import numpy as np

PAPER = np.array([0.84, 0.81, 0.75])
"""Colour of the paper, sRGB."""

TEXELS, SIDE = 2048, 0.8
"""Side of the picture of the paper, and what it stands for [m]."""


def pattern(seed: int, side: int = 1024) -> np.ndarray:
    """Grey values with detail at every size, 0 to 1."""
    rng = np.random.default_rng(seed)
    total = np.zeros((side, side), np.float32)
    for cells, strength in ((16, 0.5), (48, 0.6), (140, 0.7), (400, 0.5)):
        noise = rng.normal(size=(cells, cells)).astype(np.float32)
        total += strength * cv2.resize(noise, (side, side), interpolation=cv2.INTER_CUBIC)
    return np.clip(0.5 + 0.16 * total, 0, 1)


@cache
def newspaper(seed: int = 0) -> np.ndarray:
    """A double page from above, sRGB, its middle at the origin."""
    rng = np.random.default_rng(seed)
    page = np.broadcast_to(PAPER, (TEXELS, TEXELS, 3)).copy()
    photograph = np.stack([pattern(seed + k, TEXELS) for k in range(3)], axis=-1)
    width, line = 180, 8
    for left in range(12, TEXELS - width, width + 16):
        row = int(rng.integers(0, 80))
        while row < TEXELS - 220:
            kind = rng.random()
            if kind < 0.12:
                size = int(rng.integers(80, 200))
                tint = 0.6 + 0.4 * rng.random(3)
                page[row : row + size, left : left + width] = (
                    0.9 * tint * photograph[row : row + size, left : left + width]
                )
                row += size + 14
            elif kind < 0.25:
                _words(page, rng, row, left, width, 22)
                row += 36
            elif kind < 0.32:
                row += int(rng.integers(30, 90))  # Pale.
            else:
                for _ in range(int(rng.integers(6, 24))):
                    _words(page, rng, row, left, width, 4)
                    row += line
                row += 8
    return page


def _words(page: np.ndarray, rng: np.random.Generator, row: int, left: int, width: int, tall: int) -> None:
    """A line of words: dark bars of letters."""
    x = left
    while x < left + width - 8:
        letters = int(rng.integers(2, 9))
        for _ in range(letters):
            broad = max(2, tall // 2 + int(rng.integers(-1, 2)))
            if x + broad > left + width:
                break
            high = tall - int(rng.integers(0, max(tall // 3, 1) + 1))
            page[row + tall - high : row + tall, x : x + broad - 1] = 0.16 + 0.08 * rng.random()
            x += broad
        x += max(3, tall // 2)


def linear(srgb: np.ndarray) -> np.ndarray:
    """Light of sRGB."""
    return np.where(srgb < 0.04045, srgb / 12.92, ((np.maximum(srgb, 0) + 0.055) / 1.055) ** 2.4)


def written(light: np.ndarray) -> np.ndarray:
    """SRGB of light."""
    light = np.clip(light, 0, 1)
    return np.where(light < 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
