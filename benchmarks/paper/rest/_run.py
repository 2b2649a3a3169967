"""Objects learned from photographs, dropped beside the true solids that were photographed.

A trained soap must lie flat, a trained bunny come to rest as the true mesh can, and both move as the true
solids do: thrown up and tumbling without contact, and dropped until after their first bounce.
"""

import argparse
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import dano
from assets import solids
from benchmarks._measure import load_average, parse_arguments, report, REPOSITORY, Row
from dano.fields import mesh_field, SignedDistanceGrid
from dano.maths import quat_to_matrix
from dano.vision import LearnedField

REST, BUNNY_REST = "The trained soap at rest", "The trained bunny at rest"
BESIDE = "The trained object beside the true solid, thrown alike"
_TIMESTEP, _REST_SECONDS, _SECONDS = 0.002, 4.0, 1.0
_NODES = 128
_FRICTION, _RESTITUTION = 0.3, 0.3
_N_DROPS = 10
_LIKELY = 0.01
"""Share of random drops from which a stable pose counts: others are facets of a few triangles."""


class Pair(NamedTuple):
    """A trained object and the solid that was photographed, in one frame."""

    trained: dano.NeuralObject
    true: dano.NeuralObject
    path: Path


class Motion(NamedTuple):
    """Where an object was: its field frame.

    Attributes:
        rotation: Field frame → world, (steps + 1, 3, 3).
        origin: Origin of the field frame [m, W], (steps + 1, 3).
    """

    rotation: np.ndarray
    origin: np.ndarray

    def of(self, points: np.ndarray) -> np.ndarray:
        """Points of the object [m, F] over time, (steps + 1, n, 3)."""
        return np.einsum("tij,nj->tni", self.rotation, points) + self.origin[:, None]


def run() -> None:
    """Measure, print and report."""
    arguments = parse_arguments("Drop objects learned from photographs.", _options)
    load = load_average()
    with tempfile.TemporaryDirectory() as folder:
        objects = arguments.objects
        if objects is None:
            objects = Path(folder)
            for name in TRUE:
                _train(name, objects)
        pairs = {name: _pair(name, objects / f"{name}.dano") for name in TRUE}
        n_drops = 2 if arguments.quick else _N_DROPS
        rows = [*_soap_rows(pairs["soap"], n_drops), *_bunny_rows(pairs["bunny"], n_drops)]
        for name, pair in pairs.items():
            rows += _beside_rows(name, pair)
        if arguments.film is not None:
            _film(pairs["bunny"], arguments.film)
    settings: dict[str, object] = {
        "timestep": _TIMESTEP,
        "law": "distributed",
        "sliding_friction": _FRICTION,
        "restitution beside the true solid": _RESTITUTION,
        "drops": n_drops,
    }
    report("paper.rest", rows, settings, load, arguments.json)


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--objects", type=Path, metavar="DIR", help="bunny.dano and soap.dano; default: trained now"
    )
    parser.add_argument("--film", type=Path, metavar="FILE.mp4", help="film the bunny beside the true one")


def _train(name: str, folder: Path) -> None:
    """`dano train` with its defaults on the shipped photographs."""
    from dano.cli import main

    photographs = REPOSITORY / "assets" / "images" / name
    main(["train", str(photographs), "-o", str(folder / f"{name}.dano"), "--no-report"])


def _pair(name: str, path: Path) -> Pair:
    trained = dano.NeuralObject.load(path)
    true = dano.NeuralObject.from_field(TRUE[name](), mass=float(trained.mass.mass))
    return Pair(trained, true, path)


def _true_bunny() -> SignedDistanceGrid:
    import trimesh

    return mesh_field(trimesh.Trimesh(*solids.bunny_mesh(), process=True), _NODES)


def _true_soap() -> SignedDistanceGrid:
    lower, upper = -1.08 * solids.SOAP_HALF_EXTENTS, 1.08 * solids.SOAP_HALF_EXTENTS
    spacing = float((upper - lower).max()) / (_NODES - 1)
    axes = [a + spacing * np.arange(round((b - a) / spacing) + 1) for a, b in zip(lower, upper, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return SignedDistanceGrid(solids.soap_distance(nodes), lower, spacing)


TRUE = {"bunny": _true_bunny, "soap": _true_soap}


def _scene(thing: dano.NeuralObject, restitution: float = 0.0) -> dano.Scene:
    params = dano.ContactParams(sliding_friction=_FRICTION, restitution=restitution)
    contact = dano.Contact("object", "floor", params, dano.DistributedLaw())
    bodies = [dano.Body("object", thing), dano.Body("floor", dano.HalfSpace(), fixed=True)]
    return dano.Scene.create(bodies, [contact], timestep=_TIMESTEP)


def _moved(scene: dano.Scene, start: dict[str, Any], seconds: float) -> Motion:
    """Simulate from a place of the field frame's origin, an orientation and velocities."""
    body = scene.bodies[0]
    com = np.asarray(body.com)
    rotation = np.asarray(quat_to_matrix(jnp.asarray(start["orientation"])))
    position = start["origin"] + rotation @ com
    state = scene.initial_state(
        object={**start["motion"], "position": position, "orientation": start["orientation"]}
    )
    states = dano.simulate(scene, state, n_steps=round(seconds / _TIMESTEP)).states
    turned = np.asarray(jax.vmap(quat_to_matrix)(states.orientation[:, 0]))
    return Motion(turned, np.asarray(states.position[:, 0]) - turned @ com)


def _dropped(points: np.ndarray, seed: int, *, above: float = 0.5) -> dict[str, Any]:
    """A random orientation, the lowest point `above` sizes over the floor, turning slowly."""
    rng = np.random.default_rng(seed)
    orientation = rng.normal(size=4)
    orientation /= np.linalg.norm(orientation)
    rotation = np.asarray(quat_to_matrix(jnp.asarray(orientation)))
    size = float(np.ptp(points, axis=0).max())
    origin = np.array([0.0, 0.0, above * size - (points @ rotation[2]).min()])
    return {"origin": origin, "orientation": orientation, "motion": {"omega": rng.normal(size=3)}}


def _points(thing: dano.NeuralObject) -> np.ndarray:
    return np.asarray(thing.surface.points)


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    """Between unit vectors [°]."""
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


def _soap_rows(pair: Pair, n_drops: int) -> list[Row]:
    """Tilt of the face that it lies on: one of the two large ones, or a narrow side that it stands on."""
    scene, flat, standing = _scene(pair.trained), [], []
    for seed in range(n_drops):
        up = _moved(scene, _dropped(_points(pair.trained), seed), _REST_SECONDS).rotation[-1][2]
        axis = int(np.argmax(np.abs(up)))
        (flat if axis == 2 else standing).append(_angle(np.sign(up[axis]) * np.eye(3)[axis], up))
    note = f"{len(flat)} of {n_drops} random drops"
    rows = [Row(REST, "lying flat, largest tilt", max(flat), "°", 1.0, note=note)] if flat else []
    if standing:
        note = f"{len(standing)} drops"
        rows.append(Row(REST, "standing on a narrow side, largest tilt", max(standing), "°", note=note))
    return rows


def _bunny_rows(pair: Pair, n_drops: int) -> list[Row]:
    poses, shares = stable_directions(solids.bunny_mesh())
    scene, misses, true_misses = _scene(pair.trained), [], []
    true_scene = _scene(pair.true)
    for seed in range(n_drops):
        start = _dropped(_points(pair.true), seed)
        for found, one in ((misses, scene), (true_misses, true_scene)):
            up = _moved(one, start, _REST_SECONDS).rotation[-1][2]
            found.append(min(_angle(pose, up) for pose in poses))
    good = sum(miss <= 3.0 for miss in misses)
    likely = ", ".join(f"{share:.0%}" for share in shares[:5])
    return [
        Row(
            BUNNY_REST,
            f"of {n_drops} drops within 3° of a stable pose of the true mesh",
            float(good),
            "",
            0.9 * n_drops,
            at_least=True,
            note=f"{len(poses)} stable poses: {likely}, …",
        ),
        Row(BUNNY_REST, "median angle to that pose", float(np.median(misses)), "°"),
        Row(BUNNY_REST, "largest angle", max(misses), "°"),
        Row(
            BUNNY_REST,
            "the same of the true mesh's own field, largest",
            max(true_misses),
            "°",
            note="what sampling and contact cost",
        ),
    ]


def stable_directions(mesh: solids.Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Directions of the body frame that point up when a homogeneous mesh rests on a plane.

    Returns:
        Unit vectors (n, 3) and the probability of each, most likely first (trimesh, Goldberg et al. 1999).
    """
    import trimesh

    solid = trimesh.Trimesh(*mesh, process=True)
    transforms, shares = trimesh.poses.compute_stable_poses(solid, n_samples=1, sigma=0.0, threshold=_LIKELY)
    return np.asarray(transforms)[:, 2, :3], np.asarray(shares)


def _beside_rows(name: str, pair: Pair) -> list[Row]:
    """Largest distance between the same point of both, over the size."""
    points = _points(pair.true)[::10]
    size = pair.true.size
    scenes = [_scene(thing, _RESTITUTION) for thing in (pair.trained, pair.true)]
    thrown = _dropped(points, 100, above=0.0)
    thrown["motion"] = {"velocity": (0.3, 0.2, 0.5 * 9.81 * _SECONDS + 0.1), "omega": (6.0, 4.0, -5.0)}
    thrown["origin"] = thrown["origin"] + np.array([0.0, 0.0, size])
    bounced = _dropped(points, 101, above=2.0)
    bounced["motion"] = {"velocity": (0.2, 0.0, 0.0), "omega": (2.0, 3.0, 1.0)}
    off = np.linalg.norm(np.asarray(pair.trained.mass.com - pair.true.mass.com)) / size
    moments = [np.linalg.eigvalsh(np.asarray(thing.mass.inertia)) for thing in (pair.trained, pair.true)]
    rows = [
        Row(BESIDE, f"{name}, centre of mass", 100 * float(off), "% of size"),
        Row(
            BESIDE, f"{name}, principal inertias", 100 * float(np.abs(moments[0] / moments[1] - 1).max()), "%"
        ),
    ]
    for what, start in (("free tumbling", thrown), ("drop", bounced)):
        a, b = (_moved(scene, start, _SECONDS) for scene in scenes)
        apart = np.linalg.norm(a.of(points) - b.of(points), axis=-1).max(axis=1) / size
        com = np.asarray(pair.true.mass.com)[None]
        middle = np.linalg.norm(a.of(com) - b.of(com), axis=-1)[:, 0] / size
        end, note = len(apart), f"{_SECONDS:g} s"
        if what == "drop":
            end = _after_bounce(b.of(points)[..., 2].min(axis=1), b.of(com)[:, 0, 2])
            note = f"to the top of the first bounce, {end * _TIMESTEP:.2f} s"
            rows.append(
                Row(BESIDE, f"{name}, drop, centre, {_SECONDS:g} s", 100 * float(middle.max()), "% of size")
            )
        rows += [
            Row(
                BESIDE,
                f"{name}, {what}, centre",
                100 * float(middle[:end].max()),
                "% of size",
                3.0,
                note=note,
            ),
            Row(
                BESIDE,
                f"{name}, {what}, any point",
                100 * float(apart[:end].max()),
                "% of size",
                3.0,
                note=note,
            ),
        ]
    return rows


def _after_bounce(lowest: np.ndarray, height: np.ndarray) -> int:
    """Steps from the start until the centre of mass is highest after the first touch, or to the end.

    Args:
        lowest: Height of the lowest point over time [m].
        height: That of the centre of mass [m].
    """
    touching = np.flatnonzero(lowest <= 0)
    if len(touching) == 0:
        return len(lowest)
    climb = np.diff(height[touching[0] :])
    rising = np.flatnonzero(climb > 0)
    falling = np.flatnonzero(climb[rising[0] :] < 0) if len(rising) else []
    return int(touching[0] + rising[0] + falling[0]) if len(falling) else len(lowest)


def _film(pair: Pair, path: Path) -> None:
    """Both, side by side, dropped alike."""
    from dano.report import render_trajectory, VideoOptions

    contacts = [
        dano.Contact(name, "floor", dano.ContactParams(sliding_friction=_FRICTION), dano.DistributedLaw())
        for name in ("trained", "true")
    ]
    bodies = [
        dano.Body("trained", pair.trained),
        dano.Body("true", pair.true),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    scene = dano.Scene.create(bodies, contacts, timestep=_TIMESTEP)
    start = _dropped(_points(pair.true), 101, above=2.0)
    rotation = np.asarray(quat_to_matrix(jnp.asarray(start["orientation"])))
    states = {}
    for i, body in enumerate(bodies[:2]):
        place = start["origin"] + rotation @ np.asarray(body.com) + [0.0, 1.5 * pair.true.size * i, 0.0]
        states[body.name] = {**start["motion"], "position": place, "orientation": start["orientation"]}
    run = dano.simulate(scene, scene.initial_state(**states), n_steps=round(2.0 / _TIMESTEP))
    look = LearnedField.of_object(pair.path)
    looks = {} if look is None else {"trained": look}
    strip, options = path.with_suffix(".png"), VideoOptions(slow_motion=2.0)
    render_trajectory(scene, run, path, strip=strip, looks=looks, options=options)
