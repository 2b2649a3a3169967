"""Makes the pictures of the guide *From a phone to a simulation* from what `dano film` left.

The photographs and the film are those of `assets/render_phone.py`, `block_plain` with its walk. Each picture
is a WebP of at most 300 kB. Needs the extra `all`.

Usage: python assets/render_story.py docs/images WALK SLIDE.mp4 STORY    (STORY: soap_film for -o soap.dano)
"""

import argparse
from pathlib import Path

import av
import numpy as np
from filming import read_film, write_webp
from PIL import Image

from dano.vision import picture_files

SHOWN = 4  # photographs, and frames of the film
CELL = (320, 180)  # of each [pixels]
GAP = 6  # between them [pixels]


def main() -> None:
    """Make all pictures that there are results for."""
    parser = argparse.ArgumentParser(description="Make the pictures of the guide from a phone.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("walk", type=Path, help="photographs")
    parser.add_argument("slide", type=Path, help="film")
    parser.add_argument("story", type=Path, help="folder of dano film")
    arguments = parser.parse_args()
    folder, story = arguments.folder, arguments.story
    film = read_film(arguments.slide)
    (folder / "guides").mkdir(exist_ok=True)
    write_webp(folder / "guides" / "phone.webp", [taken(picture_files(arguments.walk), film)])
    write_webp(folder / "phone_masks.webp", [reduced(read_picture(story / "masks.png"), 960)])
    run = story / "run.mp4"
    write_webp(
        folder / "phone_story.webp", beside(film, rate_of(arguments.slide), read_film(run), rate_of(run))
    )


def taken(photographs: list[Path], film: list[np.ndarray]) -> np.ndarray:
    """Photographs of the walk above frames of the film, until the object rests."""
    rows = [
        [read_picture(photographs[i]) for i in np.linspace(0, len(photographs) // 2 - 1, SHOWN).astype(int)],
        [film[i] for i in np.linspace(0, 0.45 * len(film), SHOWN).astype(int)],
    ]
    return np.concatenate([_row([sized(picture, CELL) for picture in row]) for row in rows], axis=0)


def beside(
    film: list[np.ndarray], film_rate: float, run: list[np.ndarray], run_rate: float
) -> list[np.ndarray]:
    """The simulation that was fitted to a film, and the film at the same times; rates in frames a second."""
    height, width = film[0].shape[:2]
    size = (3 * CELL[0] // 2, 3 * CELL[0] * height // (2 * width))
    last = len(film) - 1
    return [
        _row([sized(film[min(round(k * film_rate / run_rate), last)], size), sized(picture, size)])
        for k, picture in enumerate(run)
    ]


def rate_of(path: Path) -> float:
    """Frames a second of a film."""
    with av.open(str(path)) as container:
        rate = container.streams.video[0].average_rate
    assert rate is not None
    return float(rate)


def _row(pictures: list[np.ndarray]) -> np.ndarray:
    """Pictures from left to right, with white around."""
    return np.concatenate(
        [np.pad(picture, ((0, GAP), (0, GAP), (0, 0)), constant_values=255) for picture in pictures], axis=1
    )


def sized(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A picture of this width and height [pixels]."""
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.LANCZOS))


def reduced(picture: np.ndarray, width: int) -> np.ndarray:
    """A picture of this width [pixels]."""
    return sized(picture, (width, round(width * picture.shape[0] / picture.shape[1])))


def read_picture(file: Path) -> np.ndarray:
    """Colours with 8 bits a channel."""
    with Image.open(file) as picture:
        return np.asarray(picture.convert("RGB"))


if __name__ == "__main__":
    main()
