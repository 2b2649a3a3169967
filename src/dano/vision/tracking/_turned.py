"""Whether a tracked object is turned by 180° in all frames: the first frame may have shown no pattern."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dano.vision.capture import PosedCamera
from dano.vision.tracking._light import LightFit
from dano.vision.tracking._masking import Masking
from dano.vision.tracking._placement import Placement
from dano.vision.tracking._search import half_turns, told_apart, turn_evidence
from dano.vision.tracking._subject import Subject
from dano.vision.tracking._whole import LIGHT_FRAMES, relit

_COMPARED = 8
"""Frames, spread over the film, whose patterns say how the object is turned."""


class Turned(NamedTuple):
    """What patterns say of all poses.

    Attributes:
        places: Poses after a half turn; None: they stay.
        light: As these poses imply it: a light that was fitted to wrong ones is wrong.
        clear: As in `told_apart`.
    """

    places: dict[int, Placement] | None
    light: LightFit
    clear: float


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
