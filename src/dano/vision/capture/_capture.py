"""A capture: photographs of one object from known places, with masks and lights where they are known."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from dano.vision.capture._camera import PosedCamera

SPLITS = ("train", "test", "relight")
"""What a view is for: to learn from; to check, under known lights; to check, under other lights."""


class View(eqx.Module):
    """One photograph."""

    name: str = eqx.field(static=True)  # Of the file, for messages and reports (static)
    camera: PosedCamera  # Where and with what it was taken
    # sRGB in [0, 1] as photographed, or over black where the file has an alpha channel, in float32, shape
    # (height, width, 3).
    image: Float[np.ndarray, "height width 3"]
    # Share of each pixel that the object covers, (height, width); None if it is not known.
    mask: Float[np.ndarray, "height width"] | None = None
    # Unit direction towards the light [W], or its position [m, W] if `light_is_near`; None if it is not
    # known, as under light that stays the same.
    light: Float[np.ndarray, "3"] | None = None
    light_is_near: bool = eqx.field(static=True, default=False)  # Whether `light` is a position (static)
    split: str = eqx.field(static=True, default="train")  # One of `SPLITS` (static)
    # Whether `image` shows the object alone, over black (static).
    cut_out: bool = eqx.field(static=True, default=False)
    # Colour that it was photographed against, if that is plain and known, shape (3,).
    background: Float[np.ndarray, "3"] | None = None
    # How far the mask of each pixel may be wrong, (height, width): 1 where the mask says nothing and colours
    # decide (see `with_doubts`); None for nowhere.
    doubt: Float[np.ndarray, "height width"] | None = None
    # What each pixel would show without the object, sRGB, (height, width, 3), NaN where that is not known
    # (see `with_table`); None: `background` everywhere.
    behind: Float[np.ndarray, "height width 3"] | None = None

    @property
    def possible(self) -> Float[np.ndarray, "height width"] | None:
        """Share of each pixel that the object may cover: the mask, and what is doubted of it."""
        return self.mask if self.mask is None or self.doubt is None else np.maximum(self.mask, self.doubt)

    @property
    def known_behind(self) -> Float[np.ndarray, "height width 3"]:
        """What each pixel would show without the object; NaN where nothing says it."""
        if self.behind is not None:
            return self.behind
        plain = np.full(3, np.nan) if self.background is None else self.background
        return np.broadcast_to(plain.astype(np.float32), self.image.shape)

    @property
    def backdrop(self) -> Float[np.ndarray, "3"]:
        """What to draw the object on for comparison: the photograph's own background, or white."""
        return np.ones(3) if self.background is None else self.background

    def replaced(self, **fields: Any) -> "View":
        """This view with other values of some fields."""
        return View(**{**{name: getattr(self, name) for name in View.__dataclass_fields__}, **fields})

    def over(self, background: Float[np.ndarray, "3"]) -> Float[np.ndarray, "height width 3"]:
        """The object on a background: the photograph itself where its mask is not known."""
        if self.mask is None:
            return self.image
        seen = self.image if self.cut_out else self.image * self.mask[..., None]
        return seen + (1 - self.mask[..., None]) * background.astype(np.float32)

    def resized(self, factor: int) -> "View":
        """The view with `factor` × `factor` pixels averaged into one; edges that do not fill one are cut."""
        height, width = (n // factor * factor for n in self.image.shape[:2])

        def shrunk(a: np.ndarray) -> np.ndarray:
            blocks = a[:height, :width].reshape(
                height // factor, factor, width // factor, factor, *a.shape[2:]
            )
            return blocks.mean(axis=(1, 3), dtype=np.float32)

        camera = self.camera.replaced(
            focal=self.camera.focal / factor,
            centre=self.camera.centre / factor,
            width=width // factor,
            height=height // factor,
        )
        layers = {
            name: None if (layer := getattr(self, name)) is None else shrunk(layer)
            for name in ("mask", "doubt", "behind")
        }
        return self.replaced(camera=camera, image=shrunk(self.image), **layers)


class Capture(eqx.Module):
    """Photographs of one object that does not move, in one frame W with metres (or whatever the file has).

    Attributes:
        views: All of them.
        source: Where they come from, for messages (static).
    """

    views: tuple[View, ...]
    source: str = eqx.field(static=True, default="")

    def __init__(self, views: Sequence[View], source: str | Path = ""):
        """Collect views.

        Raises:
            ValueError: If there is none to learn from.
        """
        self.views = tuple(views)
        self.source = str(source)
        if not any(view.split == "train" for view in self.views):
            raise ValueError(
                f"a capture must have views to train on, got {len(self.views)} views, none for training"
            )

    def split(self, name: str) -> tuple[View, ...]:
        """The views of one split."""
        return tuple(view for view in self.views if view.split == name)

    @property
    def has_masks(self) -> bool:
        """Whether every training view says what belongs to the object."""
        return all(view.mask is not None for view in self.split("train"))

    @property
    def is_lit(self) -> bool:
        """Whether the light of every training view is known."""
        return all(view.light is not None for view in self.split("train"))

    def thinned(self, n_train: int) -> "Capture":
        """The capture with only some of its training views, evenly chosen, all others kept.

        Raises:
            ValueError: If there are not that many.
        """
        train = self.split("train")
        if not 1 <= n_train <= len(train):
            raise ValueError(f"n_train must lie between 1 and {len(train)}, got {n_train}")
        chosen = {train[i].name for i in np.linspace(0, len(train) - 1, n_train).round().astype(int)}
        return Capture([v for v in self.views if v.split != "train" or v.name in chosen], self.source)
