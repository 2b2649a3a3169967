"""Which numbers of the state in which a window begins are estimated, and how they move it."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.engine import difference, retract
from dano.identify._motion import QUANTITIES
from dano.scene import State


class Start(NamedTuple):
    """What is estimated of the state in which a window begins (static).

    Unknowns are, body by body, three numbers of each quantity, then coordinates of the joints, then their
    velocities.

    Attributes:
        free: Bodies that were observed and move freely.
        turning: Of each joint coordinate whether it is an angle; none if no body on a joint was observed.
        initial: Quantities that are estimated. Coordinates of joints are with positions or orientations,
            their velocities with velocities or spins.
    """

    free: tuple[int, ...]
    turning: tuple[bool, ...]
    initial: tuple[str, ...]

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return 3 * len(self.free) * len(self.initial) + len(self.turning) * (self.poses + self.speeds)

    @property
    def poses(self) -> bool:
        """Whether coordinates of joints are estimated."""
        return "position" in self.initial or "orientation" in self.initial

    @property
    def speeds(self) -> bool:
        """Whether velocities of joints are estimated."""
        return "velocity" in self.initial or "omega" in self.initial

    def moved(self, state: State, change: Float[Array, " k"]) -> State:
        """A state moved by a change of the unknowns."""
        if not self.size:
            return state
        n, joints = 3 * len(self.free) * len(self.initial), len(self.turning)
        if self.free:
            given = iter(jnp.split(change[:n].reshape(len(self.free), -1), len(self.initial), axis=1))
            zero = jnp.zeros((len(self.free), 3), change.dtype)
            rows = [next(given) if key in self.initial else zero for key in QUANTITIES]
            state = retract(state, np.array(self.free), jnp.concatenate(rows, axis=1))
        if state.q is None or state.v is None or not joints:
            return state
        none = jnp.zeros(joints, change.dtype)
        q = change[n : n + joints] if self.poses else none
        v = change[len(change) - joints :] if self.speeds else none
        return dataclasses.replace(state, q=state.q + q, v=state.v + v)

    def jump(self, nominal: State, state: State) -> Float[Array, " c"]:
        """What leads from one state to another, as a change of all that could be estimated."""
        gone = difference(nominal, state, np.array(self.free, int)).ravel()
        if not self.turning:
            return gone
        assert nominal.q is not None and nominal.v is not None and state.q is not None and state.v is not None
        return jnp.concatenate([gone, state.q - nominal.q, state.v - nominal.v])

    def widths(self, usual: Sequence[float]) -> np.ndarray:
        """Standard deviations of the numbers of a jump from those of the four quantities."""
        position, orientation, velocity, omega = usual
        of_bodies = np.tile(np.repeat(usual, 3), len(self.free))
        q = [orientation if turns else position for turns in self.turning]
        v = [omega if turns else velocity for turns in self.turning]
        return np.concatenate([of_bodies, q, v])

    def deviations(self, usual: Sequence[float]) -> np.ndarray:
        """Standard deviations of the unknowns from those of the four quantities."""
        position, orientation, velocity, omega = usual
        each = dict(zip(QUANTITIES, usual, strict=True))
        of_bodies = np.tile(
            np.repeat([each[key] for key in QUANTITIES if key in self.initial], 3), len(self.free)
        )
        q = [orientation if turns else position for turns in self.turning if self.poses]
        v = [omega if turns else velocity for turns in self.turning if self.speeds]
        return np.concatenate([of_bodies, q, v])
