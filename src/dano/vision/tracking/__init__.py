"""From a film to the motion of a known object."""

from dano.vision.tracking._film import Film as Film, read_film as read_film
from dano.vision.tracking._options import TrackOptions as TrackOptions
from dano.vision.tracking._track import Overlay as Overlay, track as track, Tracked as Tracked
