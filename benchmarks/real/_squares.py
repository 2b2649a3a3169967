"""500 drops of a square between two panes, whole: where it lies and how it is turned, .2 and .8 s later.

Recorded by Fazeli (MCube Lab, MIT), published with ImpactModeling (DAIR Lab). Here x and θ are right-handed:
θ turns x into z. The floor, and what the tracker's zero of θ is off by, are read off the half that is fitted;
both simulators get the same start, from the frames of the fall before anything touches.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

import dano
from benchmarks._measure import Row, skipped
from benchmarks.real._data import members, NO_DATA, Source, SQUARE

FRAME = 1 / 250  # s
HALF = SQUARE / 2
MASS = 0.05  # kg; nothing depends on it
GRAVITY = 9.81
MOMENTS = {".2 s": 50, ".8 s": 199}
"""Frames that are compared; the last frame is .796 s after the first."""

STEPS_A_FRAME = 2

# How far positions [m] and angles [rad] are off where they count half: a drop that ends elsewhere says little
# about constants and would drown the others.
_HALF_OFF = (0.03, 0.5)

# A square falls freely while no corner is nearer to the floor than this [m]; and frames of it that are
# enough.
_CLEAR, _ENOUGH = 0.006, 5

Simulator = Callable[[np.ndarray, Mapping[str, float]], np.ndarray]


@dataclass(frozen=True)
class Drops:
    """Drops with the floor at z = 0 and faces at θ = 0, π/2, ….

    Attributes:
        poses: x, z, θ of each frame [m, rad], shape (n, 200, 3).
        starts: The same and their rates at the first frame, shape (n, 6).
    """

    poses: np.ndarray
    starts: np.ndarray

    def __len__(self) -> int:
        return len(self.poses)


@dataclass(frozen=True)
class Floor:
    """Where the floor is in the camera's axes, and what θ is of a square that lies."""

    height: float
    slope: float
    angle: float

    @classmethod
    def of(cls, rows: np.ndarray) -> "Floor":
        """From the last frames of drops that have come to rest."""
        last = rows[:, -1]
        last = last[np.abs(last[:, 5]) < 0.3]
        table = np.column_stack([np.ones(len(last)), last[:, 0]])
        (height, slope), *_ = np.linalg.lstsq(table, last[:, 1] - HALF)
        quarter = np.pi / 2
        angle = np.median(np.mod(last[:, 2] + quarter / 2, quarter) - quarter / 2)
        return cls(float(height), float(slope), float(angle))

    def level(self, rows: np.ndarray) -> Drops:
        """Drops above a floor at 0, with velocities of their first frame from all frames of the fall."""
        shift = self.height + self.slope * rows[..., 0]
        poses = np.stack([rows[..., 0], rows[..., 1] - shift, rows[..., 2] - self.angle], axis=-1)
        starts = np.array([_start(one, row) for one, row in zip(poses, rows, strict=True)])
        return Drops(poses, starts)


def load(path: Path, rows: slice) -> np.ndarray:
    """x, z, θ and their rates of some drops, shape (n, 200, 6).

    Raises:
        ValueError: If the file has other members, or drops of different lengths.
    """
    found = members(path, ("rows", "lengths"))
    lengths = set(found["lengths"].tolist())
    if len(lengths) != 1 or found["rows"].shape != (int(found["lengths"].sum()), 6):
        raise ValueError(f"{path}: rows must be drops of one length, shape (n · length, 6), got {lengths}")
    return found["rows"].astype(float).reshape(-1, lengths.pop(), 6)[rows]


def rows(source: Source | None, *, quick: bool = False) -> list[Row]:
    """Tune dano and MuJoCo on one half, and predict the other."""
    if source is None:
        return [skipped("Drops of a square", "all of them", NO_DATA)]
    fitted, held = drops(source)
    found, off = [], {}
    for name, (simulate, start, steps) in SIMULATORS.items():
        values, tries = tuned(simulate, fitted, start, steps, tries=20 if quick else 160)
        off[name] = errors(simulate(held.starts, values), held)
        note = ", ".join(f"{key} {value:.3g}" for key, value in values.items())
        found += _rows(f"Drops of a square: {name}", off[name], f"{note}; {tries} tries; {source.words}")
    found += _rows("Drops of a square: no motion along the floor after .1 s", errors(_stays(held), held), "")
    return found + _beside(off)


def drops(source: Source) -> tuple[Drops, Drops]:
    """The two halves, levelled by what the first says."""
    one, two = source.split("square_drops.npz", load)
    floor = Floor.of(one)
    return floor.level(one), floor.level(two)


def tuned(
    simulate: Simulator, fitted: Drops, start: Mapping[str, float], steps: Mapping[str, float], tries: int
) -> tuple[dict[str, float], int]:
    """Constants with the least misfit: Nelder and Mead's simplex, begun anew where it ended.

    Derivatives would not help: through several impacts they grow without bound.
    """
    names, count = list(start), 0

    def values(x: np.ndarray) -> dict[str, float]:
        return {n: float(start[n] * np.exp(steps[n] * each)) for n, each in zip(names, x, strict=True)}

    def misfit(x: np.ndarray) -> float:
        nonlocal count
        count += 1
        if values(x).get("restitution", 0.0) > 0.95:
            return 2.0
        return float(misfits(errors(simulate(fitted.starts, values(x)), fitted)).mean())

    best = np.zeros(len(names))
    for _ in range(2):
        simplex = best + np.concatenate([np.zeros((1, len(names))), np.eye(len(names))])
        options = {"initial_simplex": simplex, "maxfev": tries // 2, "xatol": 0.02, "fatol": 1e-4}
        best = minimize(misfit, best, method="Nelder-Mead", options=options).x
    return values(best), count


def errors(predicted: np.ndarray, seen: Drops) -> np.ndarray:
    """How far positions [m] and angles [rad] are off at each of `MOMENTS`, shape (n, moments, 2)."""
    off = predicted - seen.poses[:, list(MOMENTS.values())]
    pairs = np.stack([np.hypot(off[..., 0], off[..., 1]), np.abs(off[..., 2])], axis=-1)
    return np.nan_to_num(pairs, nan=10.0)


def misfits(off: np.ndarray) -> np.ndarray:
    """How wrong each drop is, from 0 to 1, shape (n,)."""
    return np.mean(off / (off + np.array(_HALF_OFF)), axis=(1, 2))


# --- dano ---------------------------------------------------------------------------------------------------


def scene(
    timestep: float,
    friction: float,
    restitution: float,
    hysteresis: float,
    gyration: float,
    radius: float = 0.0,
    *,
    stiffness: float | None = None,
    gravity: float = GRAVITY,
) -> dano.Scene:
    """The square between its panes: a planar joint about −y, whose angle turns x into z.

    Its corners are round with a radius [m]. With a stiffness [Pa/m] impacts take the time that a spring of it
    needs; else they end within a step.
    """
    inertia = MASS * gyration**2 * np.eye(3)
    square = dano.Body("square", dano.Box((HALF,) * 3, radius), mass=MASS, inertia=inertia)
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    panes = dano.Joint(None, "square", "planar", axis=(0, -1, 0))
    params = dano.ContactParams(
        sliding_friction=friction,
        restitution=restitution,
        hysteresis=min(hysteresis, 1.0),
        stiffness=stiffness,
    )
    in_time = dano.DistributedLaw(compliant=True, implicitness=0.5)
    law = dano.DistributedLaw() if stiffness is None else in_time
    return dano.Scene.create(
        [square, floor],
        [dano.Contact("square", "floor", params, law=law)],
        joints=[panes],
        timestep=timestep,
        gravity=(0, 0, -gravity),
    )


def begun(made: dano.Scene, q: np.ndarray, v: np.ndarray) -> dano.State:
    """States with the joint at q (x, z, θ) and as fast as v, both of shape (n, 3)."""
    one = made.initial_state(square={"q": (0.0, 1.0, 0.0)})
    many = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(q), *x.shape)), one)
    states = eqx.tree_at(lambda s: (s.q, s.v), many, (jnp.asarray(q), jnp.asarray(v)))
    return jax.vmap(made.filled)(states)


def simulated(starts: np.ndarray, values: Mapping[str, float]) -> np.ndarray:
    """Poses at `MOMENTS` by dano, shape (n, moments, 3)."""
    timestep = FRAME / STEPS_A_FRAME
    made = scene(timestep, **values)
    # Velocities of a state belong to half a step before it.
    early = starts[:, 3:] + np.array([0.0, GRAVITY * timestep / 2, 0.0])
    last = max(MOMENTS.values())
    runs = dano.rollouts(
        made,
        begun(made, starts[:, :3], early),
        last * STEPS_A_FRAME,
        keep=STEPS_A_FRAME * min(MOMENTS.values()),
    )
    kept = np.asarray(runs.steps).tolist()
    wanted = [kept.index(frame * STEPS_A_FRAME) for frame in MOMENTS.values()]
    return np.asarray(runs.states.q)[:, wanted]


# --- MuJoCo -------------------------------------------------------------------------------------------------


def of_mujoco(starts: np.ndarray, values: Mapping[str, float]) -> np.ndarray:
    """Poses at `MOMENTS` by MuJoCo, with its friction and direct `solref`."""
    import mujoco
    from mujoco import rollout

    inertia = MASS * values["gyration"] ** 2
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{FRAME / MUJOCO_STEPS}" gravity="0 0 {-GRAVITY}" cone="elliptic"/>'
        f'<default><geom condim="3" friction="{values["friction"]} 0 0" '
        f'solref="{-values["stiffness"]} {-values["damping"]}"/></default>'
        '<worldbody><geom type="plane" size="5 5 1"/><body>'
        '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint type="hinge" axis="0'
        ' -1 0"/>'
        f'<inertial mass="{MASS}" pos="0 0 0" diaginertia="{inertia} {inertia} {inertia}"/>'
        f"{_square_of_mujoco(values.get('radius', 0.0))}"
        "</body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    begun = np.zeros((len(starts), mujoco.mj_stateSize(model, kind)))
    begun[:, 1:7] = starts
    states, _ = rollout.rollout(model, data, begun, nstep=max(MOMENTS.values()) * MUJOCO_STEPS)
    wanted = [frame * MUJOCO_STEPS - 1 for frame in MOMENTS.values()]
    return states[:, wanted, 1:4]


def _square_of_mujoco(radius: float) -> str:
    """A box; with round corners two boxes and a rod in each corner."""
    less = HALF - radius
    boxes = [(HALF, HALF, less), (less, HALF, HALF)] if radius else [(HALF, HALF, HALF)]
    geoms = [f'<geom type="box" size="{x} {y} {z}"/>' for x, y, z in boxes]
    if radius:
        geoms += [
            f'<geom type="capsule" size="{radius}" fromto="{x} {-HALF} {z} {x} {HALF} {z}"/>'
            for x in (-less, less)
            for z in (-less, less)
        ]
    return "".join(geoms)


MUJOCO_STEPS = 4
"""Steps a frame: its impacts are springs, and a millisecond resolves them."""

SIMULATORS: dict[str, tuple[Simulator, dict[str, float], dict[str, float]]] = {
    "dano": (
        simulated,
        {"friction": 0.15, "restitution": 0.4, "hysteresis": 0.35, "gyration": 0.021},
        {"friction": 0.3, "restitution": 0.2, "hysteresis": 0.5, "gyration": 0.05},
    ),
    "MuJoCo": (
        of_mujoco,
        {"friction": 0.15, "stiffness": 5e4, "damping": 100.0, "gyration": 0.021},
        {"friction": 0.3, "stiffness": 0.7, "damping": 0.5, "gyration": 0.05},
    ),
}


# --- rows ---------------------------------------------------------------------------------------------------


def _rows(group: str, off: np.ndarray, note: str) -> list[Row]:
    found = []
    for k, moment in enumerate(MOMENTS):
        for column, (words, scale, unit) in enumerate((("position", 1e3, "mm"), ("angle", 180 / np.pi, "°"))):
            values = scale * off[:, k, column]
            low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
            name = f"{words} after {moment}, median error"
            found.append(Row(group, name, middle, unit, quartiles=(low, high), note=note))
        faces = 100 * float(np.mean(off[:, k, 1] < np.pi / 4))
        found.append(Row(group, f"on the right face after {moment}", faces, "%"))
    return found


def _stays(held: Drops) -> np.ndarray:
    """What one would say without a simulator: it lies where it was after .1 s, on its lowest face."""
    early = held.poses[:, 25]
    flat = np.stack(
        [early[:, 0], np.full(len(early), HALF), np.round(early[:, 2] * 2 / np.pi) * np.pi / 2], -1
    )
    return np.repeat(flat[:, None], len(MOMENTS), axis=1)


def _beside(off: Mapping[str, np.ndarray]) -> list[Row]:
    """Dano's medians over MuJoCo's, and how sure that is."""
    found = []
    for k, moment in enumerate(MOMENTS):
        for column, words in enumerate(("position", "angle")):
            ours, theirs = off["dano"][:, k, column], off["MuJoCo"][:, k, column]
            drawn = np.random.default_rng(0).integers(0, len(ours), (1000, len(ours)))
            ratios = np.median(ours[drawn], axis=1) / np.median(theirs[drawn], axis=1)
            value = 100 * (float(np.median(ours) / np.median(theirs)) - 1)
            target = -10.0 if moment == ".8 s" else None
            found.append(
                Row(
                    "Drops of a square: dano less MuJoCo",
                    f"{words} after {moment}, median error",
                    value,
                    "%",
                    target,
                    note=f"± {100 * float(np.std(ratios)):.2g} over resampled drops",
                )
            )
    return found


def _start(poses: np.ndarray, row: np.ndarray) -> np.ndarray:
    """x, z, θ and rates at the first frame: of a fall through the frames before anything touches."""
    free = int(np.argmax(lowest(poses) < _CLEAR))
    if free < _ENOUGH:
        return np.concatenate([poses[0], row[0, 3:]])
    times = FRAME * np.arange(free)
    # Degree by degree what acts: gravity and what air takes of the speeds; nothing of the spin.
    fits = [np.polynomial.polynomial.polyfit(times, poses[:free, k], d) for k, d in enumerate((1, 2, 1))]
    return np.array([fit[0] for fit in fits] + [fit[1] for fit in fits])


def lowest(poses: np.ndarray) -> np.ndarray:
    """Heights of the lowest corners [m]."""
    turned = np.abs(np.sin(poses[..., 2])) + np.abs(np.cos(poses[..., 2]))
    return poses[..., 1] - HALF * turned


def picture(source: Source, folder: Path) -> Path:
    """Paths of four held drops, recorded and predicted, with the squares where they lie."""
    from benchmarks.real._pictures import squares

    fitted, held = drops(source)
    found = {}
    for name, (simulate, start, steps) in SIMULATORS.items():
        values, _ = tuned(simulate, fitted, start, steps, tries=20)
        found[name] = simulate(held.starts, values)
    return squares(
        folder / "real_squares.png", held.poses, found["dano"], found["MuJoCo"], HALF, list(MOMENTS.values())
    )
