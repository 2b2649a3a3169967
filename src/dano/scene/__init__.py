"""Scenes: what exists, what may touch, and the states it moves through."""

from dano.scene._bodies import Body as Body
from dano.scene._contacts import (
    colliders as colliders,
    Contact as Contact,
    pressing_pairs as pressing_pairs,
)
from dano.scene._scene import Scene as Scene
from dano.scene._states import (
    Control as Control,
    State as State,
    STATE_SIZES as STATE_SIZES,
    Trajectory as Trajectory,
)
