"""The masks of a film, from wherever its options say."""

import functools
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from dano.vision.capture import background_mask, Light, PosedCamera, View
from dano.vision.drawing import GAMMA
from dano.vision.tracking._film import Film, Target
from dano.vision.tracking._light import bare_brightness, LightFit, on_table
from dano.vision.tracking._options import TrackOptions
from dano.vision.tracking._placement import Placement
from dano.vision.tracking._refine import MASK_NOISE, OWN_MASK_NOISE, silhouette, window_of
from dano.vision.tracking._segments import (
    common_offset,
    differs,
    edge_offset,
    like_object,
    moved_edge,
    Palette,
    Place,
    SHADES,
    uncommon,
    unlike_place,
)
from dano.vision.tracking._subject import pixels_of, Subject

_EDGE_FRAMES = 8
"""Frames, spread over a film, in which edges of given masks are measured."""

BLIND = 0.5
"""Share of the silhouette that must not be hidden."""

_SHADOW_GAP = 3
"""Pixels around the object that say nothing of its shadow."""

_JOINED = 2
"""Distance [pixels] up to which parts of a mask are one thing, which a shadow or a string cuts in two."""

_SPECK = 0.2
"""Share of the largest thing's area from which another one counts: the object may be further away."""

_GAP = 0.06
"""Width of gaps that are closed in what is left of a thing, as a share of the root of its area."""

_JOINED_SHARE = 0.1
"""Share of a thing's area that has other colours than the object from which something is joined to it."""

_REMEMBERED = 4
"""Frames whose colours of the object are kept. Before there are so many, the light that they tell is not
known well enough to say how the object looks."""

_CAST = 0.3
"""Share by which an object darkens what it stands on, standard deviation beside its edge."""

_CAST_REACH = 8.0
"""Distance from the object at which that ends [pixels]: `Place.seen_in` sees what is wider."""

_MOST_THINGS = 6
"""Things that are looked at, largest first."""


class Masking:
    """Masks of the frames of a film (host).

    Attributes:
        source: Where they come from: "given", "static", "plain" or "object".
        notes: Sentences about that.
    """

    def __init__(self, film: Film, options: TrackOptions, background: str | Path | None):
        self._film = film
        self._table = options.table
        self._palette: Palette | None = None
        self._colours: list[np.ndarray] = []
        self._place: Place | None = None
        self._last: tuple[int, np.ndarray] | None = None
        self._own: Palette | None = None
        self._exposures: dict[int, np.ndarray] = {}
        self._ground: tuple[PosedCamera, np.ndarray, np.ndarray] | None = None
        self.notes: list[str] = []
        given = any(mask is not None for mask in film.masks)
        self.source = options.masks
        if options.masks == "auto":
            self.source = "given" if given else "plain" if self._is_plain() else "object"
        if self.source == "given" and not given:
            raise ValueError(
                "masks: there are none (a folder of masks, or frames with alpha), though masks='given'"
            )
        self._too_large = self._offset() if self.source == "given" else 0.0
        if background is not None:
            self._place = Place(film.place(background), film.images)
        elif self.source in ("static", "object"):
            self._place = Place.of_film(film.images)
            self.notes.append(
                "masks: what is behind the object is taken from the median of all frames; a picture of"
                " the place without it (background) is better"
            )

    def knows(self, colours: Float[np.ndarray, "n 3"]) -> None:
        """Look for what has an object's colours, whose sRGB from all sides is given, under any light."""
        self._own, self._last = Palette(np.clip(np.concatenate([k * colours for k in SHADES]), 0, 1)), None

    def _offset(self) -> float:
        """By how much given masks are too large [pixels]."""
        given = [i for i, mask in enumerate(self._film.masks) if mask is not None]
        some = np.unique(np.linspace(0, len(given) - 1, min(_EDGE_FRAMES, len(given))).astype(int))
        offsets = []
        for i in (given[k] for k in some):
            mask = self._film.masks[i]
            assert mask is not None
            offsets.append(edge_offset(mask, self._image(i), self._seen(i)))
        offset = common_offset(offsets)
        if offset:
            self.notes.append(
                f"masks: their edge lies {abs(offset):.1f} pixels {'outside' if offset > 0 else 'inside'} the"
                " edge that the frames show; they were moved by that"
            )
        return offset

    def _is_plain(self) -> bool:
        try:
            background_mask(self._view(0))
        except ValueError:
            return False
        return True

    def _view(self, i: int) -> View:
        height, width = self._film.images[i].shape[:2]
        anywhere = PosedCamera(np.eye(4)[:3], focal=float(width), width=width, height=height)
        return View(name=self._film.names[i], camera=anywhere, image=self._image(i), mask=None)

    def _image(self, i: int) -> Float[np.ndarray, "height width 3"]:
        """A frame, as bright as the place is known."""
        image = self._film.images[i].astype(np.float32) / 255
        if self._place is None:
            return image
        if i not in self._exposures:
            self._exposures[i] = self._place.exposure(image)
        return np.minimum(image / self._exposures[i], 1)

    def _seen(self, i: int) -> np.ndarray:
        occluder = self._film.occluders[i]
        if occluder is None:
            return np.ones(self._film.images[i].shape[:2], bool)
        return occluder < 0.05

    @functools.cached_property
    def _bare(self) -> Float[np.ndarray, "height width"] | None:
        """Linear brightness of the place without object and shadow, NaN where unknown; or None."""
        if self._place is not None:
            return np.sum(self._place.colours.astype(np.float64) ** GAMMA, axis=2)
        return None if self.source != "given" else bare_brightness(self._film.images, self._film.masks)

    def learn_shadow(self, i: int, target: Target, place: Placement, light: LightFit) -> None:
        """Take the shadow of an object in a frame into account for the light."""
        if not light.sees_shadows or self._bare is None:
            return
        mask = ndimage.binary_dilation(target.mask > 0.02, iterations=_SHADOW_GAP)
        light.add_shadow(place, target.camera, target.image, self._bare, ~mask & target.seen)

    def cut(self, i: int) -> float:
        """Share of the outline of a frame's mask that lies on the picture's edge; 0 without a mask."""
        mask = self._alone(i)
        if mask is None or not (mask > 0.5).any():
            return 0.0
        thing = np.pad(mask > 0.5, 1)
        outline = ndimage.binary_dilation(thing) & ~thing
        on_edge = outline.sum() - outline[1:-1, 1:-1].sum()
        return float(on_edge / outline.sum())

    def hidden(self, i: int, window: tuple[slice, slice]) -> float:
        """Share of a window that something else hides."""
        return 1 - float(self._seen(i)[window].mean())

    def alone(self, i: int, camera: PosedCamera) -> Target | None:
        """A frame with a mask that needs no pose; None if there is none for it."""
        mask = self._alone(i)
        if mask is None:
            return None
        seen = self._seen(i)
        return Target(camera, self._image(i).astype(np.float64), mask * seen, seen)

    def parts(
        self, i: int, camera: PosedCamera, colours: Float[np.ndarray, "n 3"] | None = None
    ) -> list[Target]:
        """A frame once for each separate thing that its mask shows, largest first; none if there is no mask.

        What else there is counts as hidden, so that an object may be one of several. Things that look as if
        something else were joined to the object come once more without that.

        Args:
            i: The frame.
            camera: From where.
            colours: sRGB of the object from all sides; None: nothing is joined to it.
        """
        whole = self.alone(i, camera)
        if whole is None:
            return []
        if not whole.seen.all():
            # Something in front may cut one thing in two.
            return [whole]
        labels = _things(whole.mask)
        things = [_without(whole, (labels > 0) & (labels != k)) for k in range(1, labels.max() + 1)]
        divided = [] if colours is None else [_divided(one, colours) for one in things]
        return [*(things or [whole]), *(one for one in divided if one is not None)]

    def _alone(self, i: int) -> np.ndarray | None:
        if self._last is not None and self._last[0] == i:
            return self._last[1]
        if self.source == "given":
            mask = self._film.masks[i]
            if mask is not None and self._too_large:
                mask = moved_edge(mask, -self._too_large)
            self._last = None if mask is None else (i, mask)
            return mask
        if self.source == "plain":
            try:
                mask = background_mask(self._view(i))
            except ValueError:
                return None
        else:
            assert self._place is not None
            mask = unlike_place(self._image(i), self._place, self._own)
        self._last = i, mask
        return mask

    def near(
        self,
        i: int,
        subject: Subject,
        place: Placement,
        lamps: tuple[Light, ...],
        camera: PosedCamera,
        blur: float,
    ) -> Target | None:
        """A frame with a mask, for an object near an expected pose.

        Args:
            i: The frame.
            subject: The object.
            place: Where it is expected.
            lamps: Light.
            camera: From where.
            blur: By how much the pose may be off [pixels].
        """
        if self.source != "object":
            target = self.alone(i, camera)
            if target is None:
                return None
            target = _near(target, window_of(subject, place, camera, 1.0))
            if self._place is None:
                return target
            window = window_of(subject, place, camera, 1.5)
            if window is None:
                return target
            behind = self._place.seen_in(target.image, target.mask < 0.05, window)
            return target._replace(behind=behind, mask_noise=MASK_NOISE)
        window = window_of(subject, place, camera, 1.5)
        if window is None:
            return None
        expected, colour = silhouette(subject, place, lamps, camera, window)
        image = self._image(i)
        mask = np.zeros(image.shape[:2], np.float32)
        seen = self._seen(i).copy()
        look = None if len(self._colours) < _REMEMBERED else colour
        found = like_object(image[window], expected, blur, self._palette, self._place, window, look)
        mask[window] = found.mask
        seen[window] &= ~found.other
        behind = None
        if self._place is not None:
            free = seen.copy()
            free[window] &= ~ndimage.binary_dilation(expected > 0.02, iterations=int(np.ceil(blur)))
            behind = self._place.seen_in(image, free & (mask < 0.05), window)
        target = Target(camera, image.astype(np.float64), mask, seen, behind)
        if behind is None:
            return target
        cast = self._cast(subject, place, camera, window)
        if cast is not None or found.other.any():
            # A mask takes the object's shadow for the object, and beside something else it does not know.
            return target._replace(cast=cast)
        telling = np.zeros(mask.shape, bool)
        telling[window] = differs(expected, colour, behind[window])
        return target._replace(mask_noise=OWN_MASK_NOISE, telling=telling)

    def _cast(
        self, subject: Subject, place: Placement, camera: PosedCamera, window: tuple[slice, slice]
    ) -> Float[np.ndarray, "height width"] | None:
        """See `Target.cast`: on a known table, near where the object is close to it."""
        if self._table is None or camera.position[2] <= self._table:
            return None
        if self._ground is None or self._ground[0] is not camera:
            size = (camera.height, camera.width)
            down, points = on_table(camera, pixels_of((slice(0, size[0]), slice(0, size[1]))), self._table)
            places = np.full((len(down), 3), np.nan)
            places[down] = points
            self._ground = camera, down.reshape(size), places.reshape(*size, 3)
        _, down, places = self._ground
        apart = subject.clearance(place, places[window][down[window]]) / subject.pixel(place, camera)
        result = np.zeros(down.shape)
        result[window][down[window]] = _CAST * np.clip(1 - apart / _CAST_REACH, 0, 1)
        return result

    def learn(self, target: Target, window: tuple[slice, slice], shape: np.ndarray) -> None:
        """Take the object's colours in a frame into account, where it surely is."""
        inside = (shape > 0.95) & (target.mask[window] > 0.5) & target.seen[window]
        if inside.sum() > 100:
            self._colours = [*self._colours, target.image[window][inside]][-_REMEMBERED:]
            self._palette = Palette(np.concatenate(self._colours))


def _things(mask: Float[np.ndarray, "height width"]) -> Int[np.ndarray, "height width"]:
    """Numbers of the separate things in a mask, from 1 for the largest; specks and background are 0."""
    labels, count = ndimage.label(ndimage.binary_dilation(mask > 0.5, iterations=_JOINED))
    areas = ndimage.sum_labels(mask, labels, np.arange(1, count + 1))
    result = np.zeros(mask.shape, int)
    for number, k in enumerate(np.argsort(-areas)[:_MOST_THINGS]):
        if areas[k] >= _SPECK * areas.max():
            result[labels == k + 1] = number + 1
    return result


def _without(target: Target, others: Bool[np.ndarray, "height width"]) -> Target:
    """A frame without what its mask shows elsewhere."""
    if not others.any():
        return target
    return target._replace(mask=np.where(others, 0, target.mask), seen=target.seen & ~others)


def _divided(target: Target, colours: Float[np.ndarray, "n 3"]) -> Target | None:
    """A frame without what has other colours than the object; None if that is little, or nearly all."""
    thing = target.mask > 0.5
    other = uncommon(target.image, thing, colours)
    if not _JOINED_SHARE < other.sum() / max(thing.sum(), 1) < 1 - _JOINED_SHARE:
        return None
    rest = _without(target, ndimage.binary_dilation(other, iterations=2))
    labels = _things(rest.mask)
    main = (labels == 1) & (rest.mask > 0.5)
    gap = max(1, round(_GAP * np.sqrt(main.sum())))
    padded = np.pad(main, gap)
    closed = ndimage.binary_fill_holes(ndimage.binary_closing(padded, iterations=gap))
    assert closed is not None
    mask = np.maximum(rest.mask, closed[gap:-gap, gap:-gap])
    return _without(rest._replace(mask=np.where(rest.seen, mask, 0)), labels > 1)


def _near(target: Target, window: tuple[slice, slice] | None) -> Target:
    """A frame with the things alone that lie, for the most part, where the object is expected."""
    if window is None:
        return target
    labels = _things(target.mask)
    numbers = np.arange(1, labels.max() + 1)
    inside = ndimage.sum_labels(target.mask[window], labels[window], numbers)
    here = numbers[inside > 0.5 * ndimage.sum_labels(target.mask, labels, numbers)]
    return _without(target, (labels > 0) & ~np.isin(labels, here)) if len(here) else target
