"""The cube as a neural object on a half-space, with dano's distributed contact."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import dano
from benchmarks.paper.tosses._data import FRAME, Motions, product, rotations, turn
from dano.contact import SurfaceSet
from dano.objects import draw_surface

# Motions that advance together, and how many of them in the same vector operations: a batch goes on until
# the slowest solve in it is done, so few are better than all.
_BLOCK, _VECTOR = 64, 8
# Frames simulated per call. One compiled function serves motions of any length.
_CHUNK = 16

BODY = ("com_z", "com", "inertia", "inertia_ratio", "corners")
"""Parameters of the body; the others are those of contact."""


class Dano:
    """Simulates motions of the cube.

    Attributes:
        name: For tables.
        gravity: [m/s²].
        mass: [kg].
        cube: The cube.
        unconverged: Steps of the last run that did not converge, as a share of all.
    """

    name = "dano"

    def __init__(self, world: Mapping[str, float], cube: Mapping[str, float]):
        """See the class.

        Args:
            world: `gravity` [m/s²], `half_side` [m], `mass` [kg].
            cube: `edge`, over which the density falls [m]; `resolution` of the object; `n_samples` on its
                surface, and the `skin` [m] that they are drawn with.
        """
        self.gravity, self.mass = world["gravity"], world["mass"]
        n = int(cube["n_samples"])
        soft = dano.NeuralObject.from_field(
            dano.Box((world["half_side"],) * 3, edge=cube["edge"]),
            n_samples=n,
            resolution=int(cube["resolution"]),
            mass=self.mass,
        )
        # The object's grid rounds its corners by about a cell. They are found, and sampled first, when the
        # surface is drawn with a skin that is thicker than that.
        assert soft.solid is not None
        surface = draw_surface(soft.solid, n, skin=cube["skin"])
        self.cube = eqx.tree_at(lambda o: o.surface, soft, surface)
        placed = SurfaceSet.create(surface.points, surface.vectors)
        self._places = placed.points
        self._octant = (np.asarray(placed.points)[:3] > 0).T @ np.array([4, 2, 1])
        self.unconverged = 0.0

    def scene(self, values: Mapping[str, Any], timestep: float) -> dano.Scene:
        """The scene for some parameters: those of `dano.ContactParams`, and those of the body.

        These are the centre of mass `com` [m], or `com_z` alone; the tensor `inertia` [kg m²], or its value
        about x and y, and `inertia_ratio` times that about z; and, if given, `corners` as in `moved`.
        """
        contact = {name: value for name, value in values.items() if name not in BODY}
        inertia = np.asarray(values["inertia"])
        if inertia.ndim == 0:
            inertia = inertia * np.diag([1.0, 1.0, values["inertia_ratio"]])
        cube = dano.Body("cube", self.cube, com=_com(values), inertia=inertia)
        floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
        params = dano.ContactParams(**contact)
        # A frame is longer than an impact: with the depth at the end of a step all would be plastic.
        law = dano.DistributedLaw(implicitness=0.5, compliant=True)
        contacts = [dano.Contact("cube", "floor", params, law)]
        gravity = (0.0, 0.0, -self.gravity)
        scene = dano.Scene.create([cube, floor], contacts, timestep=timestep, gravity=gravity)
        return self.moved(scene, jnp.asarray(values["corners"])) if "corners" in values else scene

    def moved(self, scene: dano.Scene, corners: Float[Array, "8 3"]) -> dano.Scene:
        """The scene with each corner moved from where it is on a box [m], in order of (x, y, z) signs."""
        moves = corners[self._octant].T.astype(self._places.dtype)
        points = self._places.at[:3].add(moves)
        return eqx.tree_at(lambda s: s.body("cube").surface.points, scene, points)

    def simulate(
        self, values: Mapping[str, Any], motions: Motions, substeps: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Poses of the geometric centre at every frame, rows as in `motions`."""
        timestep = FRAME / substeps
        scene = self.scene(values, timestep)
        com = _com(values)
        states = _starts(motions, com, timestep)
        position, orientation = np.empty_like(motions.position), np.empty_like(motions.orientation)
        failed = steps = 0
        # Motions of like length advance together.
        order = np.argsort(motions.lengths, kind="stable")
        for start in range(0, len(order), _BLOCK):
            members = order[start : start + _BLOCK]
            filled = np.resize(members, _BLOCK)
            state = dano.State(*(jnp.asarray(x[filled]) for x in states))
            longest = int(motions.lengths[members].max())
            parts = [(states[0][filled, None, 0], states[1][filled, None, 0])]
            for _ in range(-(-(longest - 1) // _CHUNK)):
                state, poses, unconverged = _advance(scene, state, substeps)
                parts.append((np.asarray(poses[0]), np.asarray(poses[1])))
                failed += int(np.asarray(unconverged)[: len(members)].sum())
                steps += len(members) * _CHUNK * substeps
            found = [np.concatenate(part, axis=1) for part in zip(*parts, strict=True)]
            for k, i in enumerate(members):
                rows = motions.rows(int(i))
                position[rows], orientation[rows] = (x[k, : rows.stop - rows.start] for x in found)
        self.unconverged = failed / max(steps, 1)
        return position - rotations(orientation) @ com, orientation


def _com(values: Mapping[str, Any]) -> np.ndarray:
    return np.asarray(values["com"]) if "com" in values else np.array([0.0, 0.0, values["com_z"]])


def _starts(motions: Motions, com: np.ndarray, timestep: float) -> tuple[np.ndarray, ...]:
    """Position, orientation, velocity and spin of cube and floor at the start of each motion.

    Velocities in dano are those of the step that led to a state, so they belong to half a step before it; the
    measured ones to half a frame before.
    """
    first = motions.offsets[:-1]
    orientation = motions.orientation[first]
    position = motions.position[first] + rotations(orientation) @ com
    measured_at = rotations(product(orientation, turn(-0.5 * FRAME * motions.omega)))
    velocity = motions.velocity + np.einsum("kij,kj->ki", measured_at, np.cross(motions.omega, com))
    velocity = velocity + 0.5 * (FRAME - timestep) * motions.acceleration
    still, level = np.zeros_like(position), np.tile([1.0, 0.0, 0.0, 0.0], (len(position), 1))
    pairs = ((position, still), (orientation, level), (velocity, still), (motions.omega, still))
    return tuple(np.stack(pair, axis=1) for pair in pairs)


@eqx.filter_jit
def _advance(scene: dano.Scene, states: dano.State, substeps: int):
    """States `_CHUNK` frames later, poses at each of those frames, and how many steps did not converge."""

    def one(state):
        run = dano.simulate(scene, state, _CHUNK * substeps)
        frames = jax.tree.map(lambda x: x[substeps::substeps], run.states)
        last = jax.tree.map(lambda x: x[-1], run.states)
        return last, (frames.position[:, 0], frames.orientation[:, 0]), jnp.sum(~run.converged)

    return jax.lax.map(one, states, batch_size=_VECTOR)
