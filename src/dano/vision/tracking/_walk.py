"""A film half tracked: the pose in each frame, from those in the frames beside it."""

import dataclasses
import functools
import time
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from dano.vision.capture import PosedCamera
from dano.vision.radiance import LearnedField
from dano.vision.tracking._film import Film, Target
from dano.vision.tracking._light import LightFit
from dano.vision.tracking._masking import BLIND, Masking
from dano.vision.tracking._options import TrackOptions
from dano.vision.tracking._placement import Drift, Placement
from dano.vision.tracking._refine import refine, Refined, window_of
from dano.vision.tracking._result import HIDDEN, LOST, OUTSIDE, TRACKED, Tracked, tracked
from dano.vision.tracking._search import (
    aligned,
    colours_of,
    from_coarse,
    half_turns,
    learn_light,
    likeliest,
    score,
    search,
    Start,
    turned_aside,
)
from dano.vision.tracking._segments import overlap
from dano.vision.tracking._subject import ROUGH, Subject
from dano.vision.tracking._whole import region_of, turned, Whole

_STEPS = 4
"""Steps of a refinement, most."""

_MOSTLY_OUT = 0.25
"""Share of an object's surface that must be expected within the picture for a frame to be looked at."""

_SHARP = 0.7
"""Difference of ways during an exposure that hardly shows [pixels]."""

_LIGHT_EVERY = 4
"""Frames after which the light is fitted again; exposure and clouds change slower."""

_FOUND = 0.75
"""Overlap from which a search has found the object."""

_UNLIKE = 0.1
"""Usual difference of colours [sRGB] above which a segment is rejected as a different object: a blurred,
noisy object has 0.055."""

_TWIN = 1.5
"""Ratio of the scores of two things in a frame up to which both look like the object."""

_WORSE = 0.03
"""By how much less than usually a silhouette must overlap for other poses to be tried."""

_PALER = 1.5
"""How many times larger than usual the difference of colours must be for that."""

_TRIED = 3
"""Frames in which the object is looked for at first, most."""

_CONVINCING = 0.45
"""Score of a start from which no other frame is tried: an overlap of 0.93, and colours within 0.05."""

_AS_GOOD = 1.5
"""Ratio of the scores of coarse starts up to which the worse one may be the right one."""

_CUT = 0.02
"""Share of a mask's outline on the picture's edge from which the object may go on beyond it: then neither
its middle nor its size is that of the mask."""

_CAUGHT = 0.4
"""Overlap with a thing from which it may be the object, turned meanwhile."""

_FAR_WORSE = 2.2
"""How many times larger than usual a score may be: frames of a fast motion have 1.5 times."""

_NEAR = 4
"""Frames between two that say where the object is in others near them."""

_LITTLE = 15.0
"""How far apart (see `Subject.off`) poses before and after a gap may be to say where it is within."""

_PULL = 0.01
"""What so much costs in a score, which is known to about as much."""


class Walk:
    """A film half tracked (host)."""

    def __init__(
        self, film: Film, field: LearnedField, camera: PosedCamera, options: TrackOptions, background
    ):
        self._film, self._options = film, options
        self._subject = Subject(field)
        self._camera = film.camera(camera)
        self._masking = Masking(film, options, background)
        self._light = LightFit(self._subject, table=options.table)
        self._random = np.random.default_rng(options.seed)
        self._found: list[Refined | None] = [None] * len(film.times)
        self._status: list[str] = [LOST] * len(film.times)
        self._path: list[int] = []
        self._begun: tuple[int, list[tuple[Start, float]]] | None = None
        self._given: Placement | None = None
        self._missed, self._ambiguity = 0, np.inf
        self._since = np.inf

    @functools.cached_property
    def _colours(self) -> Float[np.ndarray, "n 3"]:
        return colours_of(self._subject)

    def begin(self, place: Placement) -> None:
        """Take a pose for the one in the first frame."""
        self._given = place

    def first(self) -> int:
        """The frame to begin with: own masks are best where nothing is blurred, and some are wrong."""
        if self._masking.source == "object":
            self._masking.knows(self._colours)
        if self._given is not None or self._masking.source != "object":
            return 0
        cuts = [self._masking.cut(i) for i in range(len(self._found))]
        most = max(_CUT, 1.1 * min(cuts))
        for i in self._film.quiet(_TRIED, [cut > most for cut in cuts]):
            found = self._starts(i)
            if found and (self._begun is None or found[0][0].score < self._begun[1][0][0].score):
                self._begun = i, found
            if self._begun is not None and self._begun[1][0][0].score < _CONVINCING:
                break
        return 0 if self._begun is None else self._begun[0]

    def turn_back(self) -> None:
        """Go on from the first frame backwards."""
        self._path, self._missed = sorted(self._path, reverse=True), 0

    def step(self, i: int) -> None:
        """Track the next frame, after or before the others."""
        before = self._expected(i)
        searched = before is None
        if before is None:
            found, status = self._searched(i), LOST
        else:
            self._since = min(self._since, time.perf_counter())
            found, status = self._unmoved(i), TRACKED
            if found is None:
                found, status = self._followed(i, before)
            if status == LOST:
                found, status = self._followed(i, self._caught_up(i, before))
            if found is None and status == LOST and self._missed == 0:
                found, searched = self._searched(i), True
        if found is not None:
            found, status = self._exposed(i, found), TRACKED
            self._missed = 0
            count = self._status.count(TRACKED)
            if searched or count < _LIGHT_EVERY or count % _LIGHT_EVERY == 0:
                known = self._light.known
                self._learn(i, found)
                if count > _LIGHT_EVERY:
                    self._light.find_sun()
                if self._light.known and not known:
                    # Colours count only now.
                    found = self._fine(i, found.place, self._light) or found
        else:
            self._missed += 1
        self._found[i], self._status[i] = found, status
        self._path.append(i)
        if found is not None and self._status.count(TRACKED) == _LIGHT_EVERY:
            self._settle()

    def _settle(self) -> None:
        """Refine the first frames again, under the light that several frames tell."""
        self._light.find_sun()
        for j, found in enumerate(self._found):
            if found is not None:
                self._found[j] = self._fine(j, found.place, self._light) or found

    def _expected(self, i: int) -> Placement | None:
        """The pose at constant velocity; None if there is nothing to go by."""
        if not self._path:
            return self._given
        seen = [j for j in self._path if self._found[j] is not None]
        if not seen or self._missed > self._options.search_every:
            return None
        last = self._place(seen[-1])
        if len(seen) < 2 or abs(seen[-1] - seen[-2]) > 3:
            return last
        return dataclasses.replace(self._carried(seen[-2], seen[-1], i), drift=last.drift)

    def _caught_up(self, i: int, last: Placement) -> Placement:
        """A pose moved to the thing in a frame that it fits best: it may move faster than was expected."""
        shapes, lamps = [], self._light.lamps
        for part in self._masking.parts(i, self._camera):
            moved = aligned(self._subject, part, last, lamps)
            shape, _ = self._subject.whole(moved, lamps, self._camera)
            shapes.append((overlap(part.mask, shape, part.seen), moved))
        best = max(shapes, key=lambda one: one[0], default=(0.0, last))
        return best[1] if best[0] > _CAUGHT else last

    def _carried(self, j: int, k: int, i: int) -> Placement:
        """The pose in frame i at the constant velocity that leads from frame j to k, or at rest.

        Where nothing moves, by the pictures, what two poses are off by is no velocity.
        """
        near = min(j, k, key=lambda one: abs(one - i))
        if self._rests(i, near):
            return self._place(near)
        times = self._film.times
        return self._place(j).led_to(self._place(k), (times[i] - times[k]) / (times[k] - times[j]))

    def turn_over(self) -> None:
        """Turn all poses by 180° if patterns say so: where tracking began there may have been none."""
        places = {i: one.place for i, one in enumerate(self._found) if one is not None}
        options = self._options
        if self._given is not None or options.loss != "photometric" or not places:
            return
        found = turned(self._subject, self._masking, self._camera, self._light, places, options.table)
        self._ambiguity, self._light = max(self._ambiguity, found.clear), found.light
        for i, place in (found.places or {}).items():
            fine = self._fine(i, place, self._light)
            self._found[i], self._status[i] = fine, LOST if fine is None else TRACKED

    def look_again(self, tell: Callable[[float], None]) -> None:
        """Begin once more in frames that fit worse than usual, or were lost: where other frames say."""
        better, more = self._look_between(), self._look_back(tell)
        # What is usual is known only when most frames are right.
        if better or more:
            self._look_between()

    def _look_between(self) -> bool:
        """Begin where frames around say; returns whether some fit better.

        What spins fast is not near its first pose in the second frame, and nothing tells yet how it moves.
        """
        fits = {i: (found.overlap, found.colour_error) for i, found in enumerate(self._found) if found}
        overlap, colour = np.median(list(fits.values()), axis=0) if fits else (0.0, 0.0)
        # Colours that are not known are no worse.
        good = [i for i, fit in fits.items() if fit[0] > overlap - _WORSE and not fit[1] > _PALER * colour]
        better = False
        for i in sorted(set(range(len(self._found))) - set(good)):
            before, after = [j for j in good if j < i][-2:], [j for j in good if j > i][:2]
            between = [before[-1], after[0]] if before and after else []
            pair = next((some for some in (between, before, after) if self._tell(i, some)), None)
            if pair is None or not self._taken_up(i, self._carried(pair[0], pair[1], i)):
                continue
            better = True
            # What was taken up leads to the next one.
            good = sorted([*good, i])
        return better

    def _tell(self, i: int, pair: list[int]) -> bool:
        """Whether two frames say where the object is in a third one."""
        if len(pair) < 2 or max(*pair, i) - min(*pair, i) <= _NEAR:
            return len(pair) == 2
        return pair[0] < i < pair[1] and self._subject.off(*map(self._place, pair)) < _LITTLE

    def _look_back(self, tell: Callable[[float], None]) -> bool:
        """Follow the object backwards into frames where it was lost, or is not where later frames lead.

        It may come into the picture beside something else, and be alone only later; it may have been hidden
        and taken up again beside its place; and in the first frames nothing tells how it moves.
        """
        better = False
        for i in reversed(range(len(self._found) - 1)):
            tell(1 - i / len(self._found))
            if self._found[i + 1] is None:
                continue
            known, after = self._found[i], self._place(i + 1)
            further = i + 2 < len(self._found) and self._found[i + 2] is not None
            carried = self._carried(i + 2, i + 1, i) if further else after
            if known is not None and (not further or self._is_led_to(i, known.place, carried)):
                continue
            better = self._taken_up(i, dataclasses.replace(carried, drift=after.drift)) or better
        return better

    def _is_led_to(self, i: int, place: Placement, carried: Placement) -> bool:
        """Whether the frames after one lead to its pose, at constant velocity or as that changed before."""
        away = self._subject.off(place, carried)
        if away < 1 or i + 3 >= len(self._found) or self._found[i + 3] is None:
            return away < 1
        return away < 1 + self._subject.off(self._place(i + 1), self._carried(i + 3, i + 2, i + 1))

    def _taken_up(self, i: int, expected: Placement) -> bool:
        """Track a frame once more from an expected pose; returns whether the answer differs.

        Of poses that fit alike the one nearer to where it was expected is likelier.
        """
        found, status = self._followed(i, expected)
        # The coarse levels see further, but what is hidden in part may lead them away.
        near = self._fine(i, expected, self._light) if status in (TRACKED, LOST) else None
        if near is not None and (not self._is_it(near) or self._is_cut_off(near)):
            near = None
        poses = [one for one in (self._found[i], found, near) if one is not None]
        if not poses:
            return False
        best = min(poses, key=lambda one: score(one) + _PULL * self._subject.off(one.place, expected))
        if best is self._found[i]:
            return False
        self._found[i], self._status[i] = self._exposed(i, best), TRACKED
        return True

    def _exposed(self, i: int, found: Refined) -> Refined:
        """The pose once more, with how the object moves while the frame is exposed."""
        options = self._options
        seen = [j for j, one in enumerate(self._found) if one is not None and j != i]
        if not (options.shutter or options.readout) or not seen:
            return found
        near = min(seen, key=lambda j: abs(j - i))
        last = self._place(near)
        duration = float(self._film.times[i] - self._film.times[near])
        drift = Drift.between(
            last, found.place, duration, self._subject.middle, options.shutter, options.readout
        )
        known = found.place.drift or Drift(np.zeros(3), np.zeros(3), options.shutter, options.readout)
        away = drift.apart(known, self._subject.radius) / self._subject.pixel(found.place, self._camera)
        place = dataclasses.replace(found.place, drift=drift)
        if away < _SHARP:
            return found._replace(place=place)
        if last.drift is None and len(seen) == 1:
            # The first frame was taken for one of an object at rest.
            begun = self._fine(near, dataclasses.replace(last, drift=drift), self._light)
            self._found[near] = begun or self._found[near]
        fine = self._fine(i, place, self._light)
        # Where the frame beside it is wrong, so is the drift.
        return found if fine is None or not self._is_it(fine) else fine

    def _place(self, i: int) -> Placement:
        found = self._found[i]
        assert found is not None
        return found.place

    def _searched(self, i: int) -> Refined | None:
        """Look for the object in all orientations; now and then only."""
        if self._missed % self._options.search_every:
            return None
        found = self._begun[1] if self._begun is not None and self._begun[0] == i else self._starts(i)
        if not found:
            return None
        best, ambiguity = found[0]
        if not self._is_it(best.refined) or self._is_cut_off(best.refined):
            # A hand before it may have left little of it to see.
            return None
        if not self._light.known:
            self._ambiguity = ambiguity
            self._note_alike(i, best, [one for one, _ in found if one is not best])
        self._light = best.light
        return best.refined

    def _starts(self, i: int) -> list[tuple[Start, float]]:
        """Where the object may be in a frame, likeliest first, and how clearly it is turned as it is."""
        # Other masks are taken to show the object alone, or know nothing else to be there.
        colours = self._colours if self._masking.source == "object" else None
        parts = self._masking.parts(i, self._camera, colours)
        found = [one for target in parts if (one := self._searched_in(i, target)) is not None]
        return sorted(found, key=lambda pair: pair[0].score)

    def _note_alike(self, i: int, best: Start, others: list[Start]) -> None:
        """Say it if more than one thing in a frame looks like the object."""
        like = [one for one in others if one.score < _TWIN * best.score]
        if like:
            middles = np.stack([self._subject.middle(one.refined.place) for one in (best, *like)])
            places = [f"({x:.0f}, {y:.0f})" for x, y, _ in self._camera.project(middles)]
            self._masking.notes.append(
                f"{len(like) + 1} things in frame {self._film.names[i]} look like the object; the one at"
                f" pixel {places[0]} was taken, others are at {', '.join(places[1:])}: give start for another"
            )

    def _searched_in(self, i: int, target: Target) -> tuple[Start, float] | None:
        """The likeliest start for one thing that a frame shows, and how clearly it is."""
        starts = search(self._subject, target, self._options, self._random)
        # At low resolution a wrong pose may look as good as the right one: all that do are finished.
        starts = [start for start in starts if start.score < _AS_GOOD * starts[0].score]
        finished = [self._finished(i, start.refined.place, start.light) for start in starts]
        finer = sorted((s for s in finished if s is not None), key=lambda s: s.score)
        if not finer or finer[0].refined.overlap < _FOUND:
            return None
        # A light that was fitted to a wrong pose is wrong.
        turned = [
            self._finished(i, place, LightFit(self._subject, table=self._options.table))
            for place in half_turns(self._subject, finer[0].refined.place)
        ]
        best, ambiguity = likeliest(
            self._subject, target, self._options.loss, [*finer, *(s for s in turned if s is not None)]
        )
        return (best, ambiguity) if self._may_be_it(best.refined) else None

    def _finished(self, i: int, place: Placement, light: LightFit) -> Start | None:
        """A start at full resolution, under the light that it implies itself."""
        found = self._fine(i, place, light)
        if found is None:
            return None
        own = LightFit(self._subject, table=self._options.table)
        target = self._target(i, found.place, light)
        if target is not None and self._options.loss == "photometric":
            learn_light(self._subject, target, found.place, found.window, found.silhouette, own)
            if own.known and not light.known:
                # Without light colours did not count, and costs could not be compared.
                found = self._fine(i, found.place, own) or found
        return Start(found, own if own.known else light, score(found))

    def _rests(self, i: int, j: int) -> bool:
        """Whether the object, known in frame j, lies still between it and frame i, by their pictures."""
        known = [one for one in (self._found[j], self._found[i]) if one is not None]
        shape = self._film.images[i].shape[:2]
        return self._film.is_still(j, i, np.any([region_of(one, shape) for one in known], axis=0))

    def _unmoved(self, i: int) -> Refined | None:
        """The pose of the frame before, if the object lies still between both; None if it moves."""
        last = self._path[-1] if self._path else i
        before = self._found[last] if abs(i - last) == 1 else None
        if before is None or self._masking.hidden(i, before.window) > 1 - BLIND:
            return None
        if not self._rests(i, last):
            return None
        found = self._fine(i, dataclasses.replace(before.place, drift=None), self._light, 1)
        return found if found is not None and self._is_it(found) else None

    def _followed(self, i: int, before: Placement) -> tuple[Refined | None, str]:
        window = window_of(self._subject, before, self._camera)
        middle = self._camera.project(self._subject.middle(before)[None])[0]
        if window is None or not (
            0 <= middle[0] <= self._camera.width and 0 <= middle[1] <= self._camera.height
        ):
            return None, OUTSIDE
        if self._subject.inside(before, self._camera) < _MOSTLY_OUT:
            return None, OUTSIDE
        if self._masking.hidden(i, window) > 1 - BLIND:
            return None, HIDDEN
        found = self._refined(i, before, self._light)
        if found is None or not self._is_it(found):
            return None, LOST
        if self._is_cut_off(found):
            return None, OUTSIDE
        return found, TRACKED

    def _is_cut_off(self, found: Refined) -> bool:
        """Whether so little of the object is in the picture that its pose is doubtful."""
        return self._subject.inside(found.place, self._camera) < BLIND

    def _is_it(self, found: Refined) -> bool:
        """Whether shape and colours are the object's, and fit not much worse than in the other frames."""
        if not self._may_be_it(found):
            return False
        fits = [score(one) for one in self._found if one is not None]
        return len(fits) < _LIGHT_EVERY or score(found) < max(
            _FAR_WORSE * float(np.median(fits)), _CONVINCING
        )

    def _may_be_it(self, found: Refined) -> bool:
        another = self._options.loss == "photometric" and found.colour_error > _UNLIKE
        return bool(found.overlap >= self._options.lost and not another)

    def _refined(self, i: int, before: Placement, light: LightFit) -> Refined | None:
        """The pose near an expected one; also from beside it if that fits worse than usual."""
        found = self._from_coarse(i, before, light)
        if found is None:
            return None
        fine = self._fine(i, found.place, light)
        usual = [other.overlap for other in self._found if other is not None]
        if not usual or (fine is not None and fine.overlap > np.median(usual) - _WORSE):
            return fine
        around = [self._from_coarse(i, place, light) for place in turned_aside(self._subject, before)]
        best = min((other for other in [found, *around] if other is not None), key=score)
        return fine if best is found else self._fine(i, best.place, light)

    def _from_coarse(self, i: int, before: Placement, light: LightFit) -> Refined | None:
        size = self._subject.pixels(before, self._camera)
        target = self._masking.near(i, self._subject, before, light.lamps, self._camera, 0.06 * size)
        if target is None:
            return None
        return from_coarse(self._subject, target, before, light.lamps, self._loss(light), self._random)

    def _fine(self, i: int, place: Placement, light: LightFit, steps: int = _STEPS) -> Refined | None:
        target = self._target(i, place, light)
        if target is None:
            return None
        return refine(
            self._subject,
            target,
            place,
            light.lamps,
            loss=self._loss(light),
            steps=steps,
            # All frames together are looked at with all rays; of what is blurred neighbours say the same.
            rays=max(self._options.rays // (2 if place.drift is None else 4), ROUGH),
            random=self._random,
        )

    def _target(self, i: int, place: Placement, light: LightFit) -> Target | None:
        return self._masking.near(i, self._subject, place, light.lamps, self._camera, 2.0)

    def _loss(self, light: LightFit) -> str:
        return "silhouette" if self._options.loss == "photometric" and not light.known else self._options.loss

    def _learn(self, i: int, found: Refined) -> None:
        target = self._target(i, found.place, self._light) if self._options.loss == "photometric" else None
        if target is not None:
            learn_light(self._subject, target, found.place, found.window, found.silhouette, self._light)
            self._masking.learn(target, found.window, found.silhouette)
            self._masking.learn_shadow(i, target, found.place, self._light)

    def result(self, tell: Callable[[float], None]) -> Tracked:
        """What was found, after all frames have been looked at together; `tell` is told the share done.

        Raises:
            ValueError: If nothing was.
        """
        if not any(self._found):
            raise ValueError(
                f"video: the object was found in none of {len(self._found)} frames: it must be in the"
                " picture, of the size that camera and object say, and masks must show it (see docs/track.md)"
            )
        whole = Whole(self._film, self._subject, self._camera, self._options, self._found)
        self._light = whole.look(self._masking, self._light, self._random, self._may_be_it, tell)
        for i in range(len(self._found)):
            if self._status[i] == TRACKED and whole.found[i] is None:
                self._status[i] = LOST
        return tracked(
            self._film,
            self._subject,
            self._camera.position,
            whole.found,
            self._status,
            self._light.lamps,
            notes=self._masking.notes,
            ambiguity=self._ambiguity,
            seconds=max(time.perf_counter() - self._since, 0.0) / len(self._found),
            motion=whole.motion,
        )
