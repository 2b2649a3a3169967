"""The objects that both benchmarks simulate: the shipped bunny, and the authors' if their data is there."""

from dataclasses import dataclass

import jax
import numpy as np

import dano
from benchmarks._measure import reference_folder
from dano.scene_file import load_asset


@dataclass(frozen=True)
class Subject:
    """A bunny and constants that suit its size.

    Lengths scale with L, times with √L, forces with the weight: the two bunnies then move alike.

    Attributes:
        name: For the tables.
        bunny: The object.
        length: L relative to the authors' bunny [m].
        timestep: Of the speed benchmark [s].
    """

    name: str
    bunny: dano.NeuralObject
    length: float
    timestep: float

    @property
    def mass(self) -> float:
        """[kg]."""
        return float(self.bunny.mass.mass)

    def params(self, **changes) -> dano.ContactParams:
        """Default contact parameters, scaled."""
        return dano.ContactParams(
            **{
                "damper": 3e5 / self.length**0.5,
                "sliding_drag": 0.1 / self.length**0.5,
                "torsional_friction": 0.01 * self.length,
                "rolling_friction": 0.01 * self.length,
                **changes,
            }
        )

    def law(self) -> dano.CentroidLaw:
        """The default law, scaled."""
        law = dano.CentroidLaw()
        root = self.length**0.5
        return dano.CentroidLaw(
            smoothing=float(law.smoothing) / root, regularizer=float(law.regularizer) * root
        )

    def settled(self, scene: dano.Scene, n_steps: int = 600, **others) -> dano.State:
        """The body "bunny" of a scene, dropped on its floor and left to come to rest."""
        drop = {"position": (0, 0, 0.6 * self.length), "orientation": (1, 1, 0, 0)}
        sticky = scene.replace_contact("bunny", "floor", sliding_friction=0.8)
        run = dano.simulate(sticky, sticky.initial_state(bunny=drop, **others), n_steps)
        return jax.tree.map(lambda x: x[-1], run.states)


def shipped_bunny() -> Subject:
    """The bunny that dano ships: 12 cm, 1 kg."""
    return Subject("bunny", load_asset("bunny"), 0.115, 0.002)


def authors_bunny() -> Subject | None:
    """The authors' bunny (1.04 m), or None without their data."""
    folder = reference_folder()
    if folder is None:
        return None
    data = np.load(folder / "bunny_density_grid.npz")
    field = dano.GridField(data["values"], data["origin"], data["spacing"])
    bunny = dano.NeuralObject.from_field(
        field, density_range=(1.0, 105.0), mass_model="density", mass_scale=0.1, key=jax.random.key(0)
    )
    return Subject("authors' bunny", bunny, 1.0, 0.01)
