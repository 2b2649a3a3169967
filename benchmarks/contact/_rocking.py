"""A block that rocks without rebound, against Housner (1963), The behavior of inverted pendulum structures.

Each time its other edge lands, its spin falls to 1 − 3/2 sin²α of what it was, tan α = width/height. The
factor is read from the heights of successive swings, so no velocity is looked at. The same landing is begun
at several moments of a step.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import dano
from benchmarks._measure import Row
from benchmarks.contact._scenes import Geometry, GRAVITY, milliseconds, on_floor

GROUP = "A block that rocks: error of what a landing leaves of the spin (Housner 1963), from half the balance"
PHASES = "The same landing begun at forty moments of a step: spread of what it leaves of the spin"
TIMESTEPS = (0.005, 0.001, 0.0003)  # [s]
RATIOS = (1, 2, 3, 4, 5)
"""Height over width."""
WIDTHS = (0.02, 0.1, 0.5)  # [m]
TILTS = (0.5, 0.1, 0.02)
"""Where landings begin, over the angle of balance: the smaller, the softer."""
WIDTH = 0.1
"""Of blocks whose landings are begun at several moments [m]."""
TARGET, SPREAD = 4.0, 3.0  # [%]


class Block(NamedTuple):
    """A block on its edge: half its width and height [m]."""

    b: float
    h: float

    @property
    def balance(self) -> float:
        """α, from the edge to the centre of mass against the vertical [rad]."""
        return float(np.arctan2(self.b, self.h))

    @property
    def factor(self) -> float:
        """By which a landing multiplies the spin."""
        return float(abs(1 - 1.5 * np.sin(self.balance) ** 2))

    def energy(self, angle: Array | np.ndarray) -> np.ndarray:
        """Over m g and the length from the edge to the centre, standing on the edge at rest."""
        return np.cos(self.balance - np.abs(angle)) - np.cos(self.balance)


def rows(*, quick: bool) -> list[Row]:
    """Errors of the factor, and how much it depends on the moment of the step."""
    steps, ratios, widths = (TIMESTEPS[1:2], (2,), (WIDTH,)) if quick else (TIMESTEPS, RATIOS, WIDTHS)
    tilts, phases = (TILTS[:1], 4) if quick else (TILTS, 40)
    found = []
    for h in steps:
        for ratio in ratios:
            errors = [_error(Block(width / 2, ratio * width / 2), h) for width in widths]
            name = f"height/width {ratio}, {len(widths)} sizes, {milliseconds(h)}"
            note = ", ".join(f"{e:.2g}" for e in errors)
            found.append(Row(GROUP, name, max(errors), "%", TARGET, note=note))
    for ratio in ratios:
        block = Block(WIDTH / 2, ratio * WIDTH / 2)
        geometry = _learned(block)
        for h in steps:
            name = f"neural object, height/width {ratio}, {milliseconds(h)}"
            found.append(Row(GROUP, name, _error(block, h, geometry), "%", TARGET))
    for h in steps:
        for ratio in ratios[:4]:
            block = Block(WIDTH / 2, ratio * WIDTH / 2)
            for tilt in tilts:
                # These shift the landing by about a step.
                begins = tilt * block.balance * (1 + np.linspace(0, 20 * h, phases))
                kept = factors(block, h, begins)
                spread = 100 * np.ptp(kept) / block.factor
                name = f"height/width {ratio}, from {tilt:g} of the balance, {milliseconds(h)}"
                note = f"{kept.min():.3f} to {kept.max():.3f}, right {block.factor:.3f}"
                found.append(Row(PHASES, name, float(spread), "%", SPREAD, note=note))
    return found


def _learned(block: Block) -> dano.NeuralObject:
    """A neural object of a block."""
    box = dano.Box((block.b, block.b, block.h))
    return dano.NeuralObject.from_field(box, mass=1.0, n_samples=2000, resolution=64, mass_model="solid")


def _error(block: Block, timestep: float, geometry: Geometry | None = None) -> float:
    """Of the factor of a landing that begins at half the angle of balance [%]."""
    kept = factors(block, timestep, np.array([0.5 * block.balance]), geometry)
    return float(100 * abs(kept[0] / block.factor - 1))


def factors(
    block: Block, timestep: float, begins: np.ndarray, geometry: Geometry | None = None
) -> np.ndarray:
    """By what the first landing multiplies the spin, from angles at which a block is let go [rad].

    Args:
        block: The block.
        timestep: h [s].
        begins: The angles.
        geometry: Of the block; a box if not given.
    """
    b, h = block
    depth = b
    mass = 1000 * 8 * b * h * depth
    inertia = np.diag([b * b + h * h, depth * depth + h * h, depth * depth + b * b]) * mass / 3
    scene = on_floor(
        geometry or dano.Box((depth, b, h)), timestep, mass=mass,
        properties={"inertia": inertia, "com": np.zeros(3)}, sliding_friction=1.0, restitution=0.0,
    )  # fmt: skip
    # From half the angle of balance it lands after arcosh(2) = 1.3 times this.
    seconds = 4.0 * np.sqrt(4 / 3 * np.hypot(b, h) / GRAVITY)

    def angles(begin: Float[Array, ""]) -> Float[Array, " t"]:
        q = jnp.stack([jnp.cos(begin / 2), jnp.sin(begin / 2), 0.0 * begin, 0.0 * begin])
        height = np.hypot(b, h) * jnp.cos(block.balance - begin) - 1e-5 * b
        start = dict(position=jnp.stack([0.0 * begin, 0.0 * begin, height]), orientation=q)
        states = dano.simulate(scene, scene.initial_state(body=start), int(seconds / timestep)).states
        return 2 * jnp.arctan2(states.orientation[:, 0, 1], states.orientation[:, 0, 0])

    turned = np.asarray(jax.jit(jax.vmap(angles))(jnp.asarray(begins)))
    return np.array([_kept(block, begin, angle) for begin, angle in zip(begins, turned, strict=True)])


def _kept(block: Block, begin: float, angle: np.ndarray) -> float:
    """Root of the energy of the swing after the first landing over that of the first swing."""
    lands = np.flatnonzero(np.diff(np.sign(angle)) != 0)
    if len(lands) == 0:
        return 0.0
    swing = angle[lands[0] + 1 : lands[1] if len(lands) > 1 else len(angle)]
    return float(
        np.sqrt(np.maximum(block.energy(swing).max(initial=0.0), 0.0) / block.energy(np.array(begin)))
    )
