"""From a film to the motion of a known object."""

from dano.vision.tracking._adjust import adjust_poses as adjust_poses
from dano.vision.tracking._film import Film as Film, read_film as read_film
from dano.vision.tracking._options import TrackOptions as TrackOptions
from dano.vision.tracking._result import Overlay as Overlay, Tracked as Tracked
from dano.vision.tracking._steady import steady_film as steady_film
from dano.vision.tracking._track import track as track
