"""All frames of a film together: one motion, from what each frame says near it."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from dano.vision.capture import Light, PosedCamera
from dano.vision.tracking._film import Film, Target
from dano.vision.tracking._light import LightFit
from dano.vision.tracking._masking import Masking
from dano.vision.tracking._options import TrackOptions
from dano.vision.tracking._placement import Drift, Placement
from dano.vision.tracking._refine import beside, costs_of, linearized, refine, Refined, silhouette, window_of
from dano.vision.tracking._result import own_covariance, SCALE_DOUBT
from dano.vision.tracking._search import ALIKE, half_turns, learn_light, pattern
from dano.vision.tracking._segments import overlap
from dano.vision.tracking._subject import ROUGH, Subject
from dano.vision.trajectory import Poses, Scenery, Smoothed, smoothed

_PASSES = 2
"""Times that frames are looked at again, at the poses of the motion."""

_STEPS = 4
"""Steps of Gauss and Newton in a frame that is not where the motion has it, most."""

_COARSE_STEPS, _FINE_STEPS = 10, 8
"""Steps of Gauss and Newton at half of the resolution and at all of it, most, until a frame has settled.
Where a blow led tracking beside the object, along the line of sight, four steps went half of the distance."""

_SMALLEST = 40.0
"""Size of an object [pixels] from which half of the resolution shows it."""

LIGHT_FRAMES = 6
"""Frames, spread over the film, that the light is fitted to at these poses."""

_EDGE_DOUBT = 0.1
"""By how much colours alone may show the edge beside the true one, in all frames alike [pixels]: a camera
sharpens, and a video is compressed."""

_ALIKE = 4.0
"""Standard deviations by which all frames may be off alike where an object stands on a known table: its
shadow is beside it there, and the table tells (measured in rendered films)."""

_COMPARED = 8
"""Frames, spread over the film, whose patterns say how the object is turned."""

_TELLING = 12.0
"""Evidence of a pattern from which it may decide how an object is turned (see `Pattern`). Sides that are
known only in another light have had up to 9 by chance."""

_CLEARER = 3.0
"""By how much it must be more than for any other half turn: it is 20 times as likely then. Not by a share: a
word that is upside down has much in common with the word."""

_LITTLE = 0.1
"""Evidence that patterns have by chance."""

_RIM = 3
"""Pixels around a silhouette in which a motion shows."""

_PLAINLY = 0.95
"""Cost of a picture at the frame's own pose over that at the motion's, below which the frame decides: 0.96 to
1.01 where the motion is right, 0.78 where it was 2.6 pixels beside it, between two blows (measured)."""

_USUAL = 1.25
"""Cost of it over that of other frames, from which something else, such as a hand, may be in the picture."""

_FAR = 3.0
"""Displacement by the poses from which frames are not compared [pixels]: it would not be measured."""


class Turned(NamedTuple):
    """What patterns say of all poses."""

    places: dict[int, Placement] | None  # Poses after a half turn; None: they stay
    light: LightFit  # As these poses imply it: a light that was fitted to wrong ones is wrong
    clear: float  # As in `told_apart`


class Whole:
    """A film whose frames have been tracked one by one (host).

    Attributes:
        found: What each frame says near the motion.
        motion: The motion.
    """

    def __init__(
        self,
        film: Film,
        subject: Subject,
        camera: PosedCamera,
        options: TrackOptions,
        found: Sequence[Refined | None],
    ):
        self._film, self._subject, self._camera, self._options = film, subject, camera, options
        self.found = list(found)
        self._own: dict[int, Refined] = {}  # What frames by themselves say, once they have settled
        self._sure = np.zeros(len(self.found), bool)
        self._still = self._stillness()
        self.motion = self._smoothed()

    def look(
        self,
        masking: Masking,
        light: LightFit,
        random: np.random.Generator,
        may_be_it: Callable[[Refined], bool],
        tell: Callable[[float], None],
    ) -> LightFit:
        """Look at the frames again where the motion has them, under the light that they have there.

        What does not fit there, such as a hand in front of the object, is nothing to go by.
        """
        for k in range(_PASSES):
            light = self._relit(masking, light)
            if k == 0:
                for i in self._known():
                    self.found[i] = self._own[i] = self._settled(i, masking, light, random)
                self.motion = self._smoothed()
            for i in self._known():
                tell((k + i / len(self.found)) / _PASSES)
                self.found[i] = self._looked_at(i, masking, light, random) or self.found[i]
            fits = [one if one is not None and may_be_it(one) else None for one in self.found]
            self.found = fits if any(fits) else self.found
            self.motion = self._smoothed()
        return light

    def _settled(self, i: int, masking: Masking, light: LightFit, random: np.random.Generator) -> Refined:
        """What a frame says by itself, where steps lead that go on until nothing changes."""
        before = self.found[i]
        assert before is not None
        place = before.place
        target = masking.near(i, self._subject, place, light.lamps, self._camera, 2.0)
        if target is None:
            return before
        how = {"loss": self._options.loss, "rays": 2 * ROUGH, "random": random}
        found = before
        if self._subject.pixels(place, self._camera) > _SMALLEST:
            coarse = target.reduced(2)
            found = refine(self._subject, coarse, place, light.lamps, steps=_COARSE_STEPS, **how) or before
        others = [before.place, self._place(i)]
        best = beside(self._subject, target, found, light.lamps, others, **how)
        found = refine(self._subject, target, best, light.lamps, steps=_FINE_STEPS, **how)
        if found is None or best is before.place:
            return found or before
        places = [before.place, found.place]
        costs = costs_of(self._subject, target, places, light.lamps, **how)
        return found if costs[1] < costs[0] else before

    def _looked_at(
        self, i: int, masking: Masking, light: LightFit, random: np.random.Generator
    ) -> Refined | None:
        """What a frame says near the motion; of what lies further away, near that."""
        place, found = self._place(i), None
        for k in range(_STEPS):
            target = masking.near(i, self._subject, place, light.lamps, self._camera, 2.0)
            if target is None:
                return found
            if k == 0:
                place = self._decided(i, target, place, light, random)
            found = linearized(
                self._subject,
                target,
                place,
                light.lamps,
                loss=self._options.loss,
                rays=self._options.rays,
                random=random,
            )
            if found is None or self._subject.off(found.place, place) < 1:
                return found
            place = found.place
        return found

    def _decided(
        self, i: int, target: Target, place: Placement, light: LightFit, random: np.random.Generator
    ) -> Placement:
        """Where to look at a frame: where the motion has it, or where the frame by itself does.

        Near a blow a motion may pass a frame by. Where a picture that fits as well as others do is plainly
        more like the frame's own pose, the frame is sure, and looking elsewhere would tell little of it.
        """
        own = self._own.get(i)
        if own is None:
            return place
        how = {"loss": self._options.loss, "rays": 2 * ROUGH, "random": random}
        costs = costs_of(self._subject, target, [own.place, place], light.lamps, **how)
        usual = float(np.median([one.cost for one in self._own.values()]))
        self._sure[i] = costs[0] < _PLAINLY * costs[1] and own.cost < _USUAL * usual
        return own.place if self._sure[i] else place

    def _known(self) -> list[int]:
        return [i for i, one in enumerate(self.found) if one is not None]

    def _smoothed(self) -> Smoothed:
        n = len(self.found)
        poses = Poses(np.full((n, 3), np.nan), np.full((n, 4), np.nan), np.full((n, 6, 6), np.nan))
        for i, one in enumerate(self.found):
            if one is not None:
                poses.position[i], poses.orientation[i] = one.place.position, one.place.orientation
                poses.covariance[i] = own_covariance(one, self._subject)
        scale, alike = self._alike()
        eye = self._camera.position
        scenery = Scenery(
            self._subject.solid, self._still, self._options.table, eye, scale, alike, self._sure
        )
        return smoothed(self._film.times, poses, scenery)

    def _alike(self) -> tuple[float, float]:
        """Share by which it may look too large, and standard deviations that all frames may be off alike."""
        masks = self._film.masks
        if self._options.masks in ("auto", "given") and any(mask is not None for mask in masks):
            return SCALE_DOUBT, 0.0
        sizes = [self._subject.pixels(one.place, self._camera) for one in self.found if one is not None]
        edge = _EDGE_DOUBT / np.median(sizes) if sizes else 0.0
        return float(np.hypot(SCALE_DOUBT, 2 * edge)), 0.0 if self._options.table is None else _ALIKE

    def _place(self, i: int) -> Placement:
        """Where the motion has the object in a frame, and how it moves meanwhile."""
        place = self._bare(i)
        options, known = self._options, self._known()
        if not (options.shutter or options.readout) or len(known) < 2:
            return place
        k = known.index(i)
        first, last = known[max(k - 1, 0)], known[min(k + 1, len(known) - 1)]
        duration = float(self._film.times[last] - self._film.times[first])
        drift = Drift.between(
            self._bare(first),
            self._bare(last),
            duration,
            self._subject.middle,
            options.shutter,
            options.readout,
        )
        return dataclasses.replace(place, drift=drift)

    def _bare(self, i: int) -> Placement:
        poses = self.motion.poses
        return Placement(poses.position[i], poses.orientation[i])

    def _relit(self, masking: Masking, light: LightFit) -> LightFit:
        """The light that some frames show at the poses of the motion."""
        known = self._known()
        if self._options.loss != "photometric":
            return light
        some = np.unique(np.linspace(0, len(known) - 1, min(LIGHT_FRAMES, len(known))).astype(int))
        places = {known[k]: self._place(known[k]) for k in some}
        return relit(self._subject, masking, self._camera, light, places)

    def _stillness(self) -> Bool[np.ndarray, " T_minus_1"]:
        """Whether the object lies still between a frame and the next one, by their pictures."""
        still = np.zeros(len(self.found) - 1, bool)
        begun, shape = 0, self._film.images[0].shape[:2]
        for i in range(len(still)):
            if not still[i - 1] or i == 0:
                begun = i
            first, second = self.found[i], self.found[i + 1]
            if first is None or second is None or self._apart(first, second) > _FAR:
                continue
            region = region_of(first, shape) | region_of(second, shape)
            # What creeps lies still from one frame to the next, but not from the first one on.
            still[i] = self._film.is_still(i, i + 1, region) and self._film.is_still(begun, i + 1, region)
        return still

    def _apart(self, first: Refined, second: Refined) -> float:
        """Displacement of the middle in the picture [pixels], across the line of sight."""
        middles = np.stack([self._subject.middle(one.place) for one in (first, second)])
        return float(np.linalg.norm(np.diff(self._camera.project(middles)[:, :2], axis=0)))


def relit(
    subject: Subject, masking: Masking, camera: PosedCamera, light: LightFit, places: Mapping[int, Placement]
) -> LightFit:
    """The light that some frames show with the object at given poses, which is near a known light."""
    fit = light.afresh(len(places))
    for i, place in places.items():
        learn_frame(i, subject, masking, camera, place, light.lamps, fit)
    fit.find_sun()
    return fit if fit.known else light


def learn_frame(
    i: int,
    subject: Subject,
    masking: Masking,
    camera: PosedCamera,
    place: Placement,
    lamps: tuple[Light, ...],
    fit: LightFit,
) -> tuple[Target, tuple[slice, slice], Float[np.ndarray, "_ _"]] | None:
    """Take a frame into account for the light; what it shows, where, and the silhouette; None: nothing."""
    target = masking.near(i, subject, place, lamps, camera, 2.0)
    window = window_of(subject, place, camera)
    if target is None or window is None:
        return None
    shape, _ = silhouette(subject, place, lamps, camera, window)
    learn_light(subject, target, place, window, shape, fit)
    masking.learn_shadow(i, target, place, fit)
    return target, window, shape


def turned(
    subject: Subject,
    masking: Masking,
    camera: PosedCamera,
    light: LightFit,
    places: Mapping[int, Placement],
    table: float | None,
) -> Turned:
    """Turn the poses of a film by 180° if patterns say so.

    What a look is wrong about, such as a side that was photographed in the shade only, is wrong in all
    frames, which so do not add up: the frame decides in which patterns are seen best.

    Args:
        subject: The object.
        masking: Masks of the film.
        camera: Which took it.
        light: Light at the poses as they are.
        places: Poses of frames.
        table: Height of a known table [m, W].
    """
    rows = list(places)
    some = [rows[k] for k in np.unique(np.linspace(0, len(rows) - 1, _COMPARED).astype(int))]
    targets = {i: masking.near(i, subject, places[i], light.lamps, camera, 2.0) for i in some}
    frames = [(target, places[i]) for i, target in targets.items() if target is not None]
    if not frames:
        return Turned(None, light, 1.0)
    turn, clear = told_apart(turn_evidence(subject, frames, light.lamps).max(axis=1))
    if turn == 0:
        return Turned(None, light, clear)
    after = {i: half_turns(subject, place)[turn - 1] for i, place in places.items()}
    lit = {i: after[i] for i in rows[:: len(rows) // LIGHT_FRAMES or 1]}
    return Turned(after, relit(subject, masking, camera, LightFit(subject, table=table), lit), clear)


def turn_evidence(
    subject: Subject, frames: Sequence[tuple[Target, Placement]], lamps: tuple[Light, ...]
) -> Float[np.ndarray, "4 frames"]:
    """How much patterns speak for poses as they are, and after half turns; 0 where silhouettes are unlike.

    Args:
        subject: The object.
        frames: Some frames, and the poses in them.
        lamps: Light.

    Returns:
        `Pattern.evidence`; rows as in `half_turns`, after the first.
    """
    evidence, fits = np.zeros((4, len(frames))), np.zeros((4, len(frames)))
    for k, (target, place) in enumerate(frames):
        for h, other in enumerate([place, *half_turns(subject, place)]):
            shape, _ = subject.whole(other, lamps, target.camera)
            fits[h, k] = overlap(target.mask, shape, target.seen)
            if fits[h, k] > fits[0, k] - ALIKE:
                evidence[h, k] = pattern(subject, target, other, lamps).evidence
    alike = np.median(fits - fits[0], axis=1) > -ALIKE
    return np.where(alike[:, None], evidence, 0.0)


def told_apart(most: Float[np.ndarray, "4"]) -> tuple[int, float]:
    """Which of the half turns has the most evidence, and how many times that of the next; (0, 1): unsure."""
    best, second = np.sort(most)[[-1, -2]]
    if best < _TELLING or best < second + _CLEARER:
        return 0, 1.0
    return int(np.argmax(most)), float(best / max(second, _LITTLE))


def region_of(one: Refined, shape: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
    """Where a picture of some height and width shows the object, and a motion of it.

    Args:
        one: The object's pose there.
        shape: Of the picture.
    """
    region = np.zeros(shape, bool)
    region[one.window] = one.silhouette > 0.5
    return ndimage.binary_dilation(region, iterations=_RIM)
