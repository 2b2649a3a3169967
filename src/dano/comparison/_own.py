"""Our own side: the neural object itself."""

import time
import warnings

import jax
import numpy as np
from jaxtyping import Bool

from dano.comparison._bodies import Drop, FRICTION, GRAVITY, Path, Probes, rotation_of
from dano.contact import ContactParams
from dano.engine import simulate, VariationalEngine
from dano.exchange import signed_distances
from dano.fields import HalfSpace
from dano.maths import quat_to_matrix
from dano.objects import NeuralObject
from dano.scene import Body, Contact, Scene, State, Trajectory

_TOLERANCE = 1e-10
"""Of a step's equations [m/s, rad/s]: far below what is compared here, and above rounding."""

_CHUNK = 16
"""Samples that are found together, see `VariationalEngine.capacity`."""


class Own:
    """The object in dano, with the default contact law."""

    name = "dano"

    def __init__(self, thing: NeuralObject, timestep: float):
        """Make a scene; `timestep` [s]."""
        self._thing = thing
        # Room for every sample, should all of them touch.
        self._engine = VariationalEngine(
            tolerance=_TOLERANCE, capacity=-(-len(thing.surface.points) // _CHUNK)
        )
        self._scene = Scene.create(
            [Body("object", thing), Body("floor", HalfSpace(), fixed=True)],
            [Contact("object", "floor", ContactParams(sliding_friction=FRICTION))],
            timestep=timestep,
            gravity=(0.0, 0.0, -GRAVITY),
        )

    def drop(self, start: Drop, n_steps: int) -> Path:
        """Let the body fall on the plane z = 0."""
        com = np.asarray(self._thing.mass.com, np.float64)
        where = {
            "position": start.origin + rotation_of(start) @ com,
            "orientation": start.orientation,
            "omega": start.omega,
        }
        with warnings.catch_warnings():
            # Steps that were not solved are counted instead.
            warnings.simplefilter("ignore", RuntimeWarning)
            run = self._run(self._scene.initial_state(object=where), n_steps)
            states = run.states
            last = jax.tree.map(lambda x: x[-1], states)
            begin = time.perf_counter()
            jax.block_until_ready(self._run(last, n_steps).states.position)
        taken = (time.perf_counter() - begin) / n_steps
        turned = quat_to_matrix(np.asarray(states.orientation[:, 0], np.float64))
        origin = np.asarray(states.position[:, 0], np.float64) - turned @ com
        return Path(origin, turned, taken, int(np.sum(~np.asarray(run.converged))))

    def _run(self, state: State, n_steps: int) -> Trajectory:
        return simulate(self._scene, state, n_steps=n_steps, engine=self._engine)

    def touching(self, probes: Probes) -> Bool[np.ndarray, " n"]:
        """Whether each sphere reaches into the object's solid."""
        solid = self._thing.solid
        if solid is None:
            raise ValueError("the object must have a solid: one made of samples alone has none")
        return signed_distances(solid, probes.centres)[0] < probes.radius

    def close(self) -> None:
        """Nothing to be closed."""
