"""The motion that the poses of single frames are of. Knows nothing of pictures."""

from dano.vision.trajectory._poses import Poses as Poses
from dano.vision.trajectory._smooth import (
    difference as difference,
    Scenery as Scenery,
    Smoothed as Smoothed,
    smoothed as smoothed,
)
from dano.vision.trajectory._support import (
    crossings as crossings,
    Face as Face,
    Solid as Solid,
    solid_of as solid_of,
)
