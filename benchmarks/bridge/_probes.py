"""Small balls fall on objects: whether one gets through, and how deep they sink in."""

import mujoco
import numpy as np

import dano
from benchmarks._measure import Row
from benchmarks.bridge._toys import compiled, meshes, toy, TYPES, Way
from dano.exchange import signed_distances

PROBED = ("bar", "trained_bunny", "mug")
RADII = (0.0005, 0.001, 0.002, 0.004, 0.008)
TIMESTEPS = (0.001, 0.002, 0.005)
N_BALLS, SEED = 12, 3
DENSITY, FALL, SECONDS = 2000.0, 0.05, 0.6
"""Of the balls [kg/m³]; how far they fall on the top [m]; how long they are watched [s]."""
BETWEEN = 4
"""Places on the way of a step at which balls are looked for."""
MOST_SUNK = 2.0
"""That is asked for [% of size]."""


def probe_rows(*, quick: bool) -> list[Row]:
    """Twelve balls of each size, each at a place of its own, on a bar, a bunny and a mug."""
    rows = []
    for name in PROBED:
        obj = toy(name)
        for timestep in TIMESTEPS[1:2] if quick else TIMESTEPS:
            group = f"{N_BALLS} balls on the {name.removeprefix('trained_')}, {1000 * timestep:g} ms"
            for radius in RADII[1::2] if quick else RADII:
                sunk, through = _fall(obj, radius, timestep, "samples")
                label = f"{1000 * radius:g} mm in radius"
                share, note = 100 * sunk / obj.size, f"{100 * sunk / radius:.0f} % of radius"
                rows.append(Row(group, f"{label}, sunk in", share, "% of size", MOST_SUNK, note=note))
                rows.append(Row(group, f"{label}, fell through", through, "balls", 0.0))
                if name == "bar":
                    # It is its own hull.
                    theirs = 100 * _fall(obj, radius, timestep, "hull")[0] / obj.size
                    rows.append(Row(group, f"{label}, sunk into MuJoCo's hull", theirs, "% of size"))
    return rows


def _fall(obj: dano.NeuralObject, radius: float, timestep: float, way: Way) -> tuple[float, int]:
    """Largest depth [m], and how many balls were wholly inside of the object at some time."""
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep
    spec.worldbody.add_geom(type=TYPES.mjGEOM_PLANE, size=[1, 1, 0.1])
    points = np.asarray(obj.surface.points)
    spec.worldbody.add_body(name="toy", pos=[0, 0, -points[:, 2].min()]).add_freejoint()
    top = float(np.ptp(points[:, 2])) + FALL + radius
    for k, place in enumerate(_places(obj)):
        ball = spec.worldbody.add_body(name=f"ball {k}", pos=[*place, top])
        ball.add_freejoint()
        # Balls touch the object and the floor, not each other.
        ball.add_geom(type=TYPES.mjGEOM_SPHERE, size=[radius, 0, 0], density=DENSITY, contype=0)
    model, block = compiled(spec, "toy", obj, way, meshes(obj, way))
    data, centres = mujoco.MjData(model), []
    toy_id, balls = model.body("toy").id, [model.body(f"ball {k}").id for k in range(N_BALLS)]
    with block:
        for _ in range(round(SECONDS / timestep)):
            mujoco.mj_step(model, data)
            # As the object sees them.
            centres.append((data.xpos[balls] - data.xpos[toy_id]) @ data.xmat[toy_id].reshape(3, 3))
    shares = np.arange(BETWEEN) / BETWEEN
    ways = np.stack([(1 - t) * np.array(centres[:-1]) + t * np.array(centres[1:]) for t in shares], axis=1)
    assert obj.solid is not None
    depths = radius - signed_distances(obj.solid, ways.reshape(-1, 3))[0].reshape(-1, N_BALLS)
    return float(depths.max()), int((depths.max(axis=0) >= 2 * radius).sum())


def _places(obj: dano.NeuralObject) -> np.ndarray:
    """Where balls fall [m]: at samples that look upwards, drawn at random, shape (12, 2)."""
    points, vectors = np.asarray(obj.surface.points), np.asarray(obj.surface.vectors)
    upwards = points[vectors[:, 2] > 0.7 * np.linalg.norm(vectors, axis=1)]
    return np.random.default_rng(SEED).choice(upwards, N_BALLS, replace=False)[:, :2]
