"""A box and the hull of the bunny: MuJoCo moves them, dano says what they weigh and how they rub."""

import jax.numpy as jnp
import numpy as np

import dano
from benchmarks._measure import load_average, parse_arguments, report, REPOSITORY, Row, skipped
from benchmarks.paper.cross_simulator import _mujoco
from dano.fields import mesh_field

GROUP = "MuJoCo's {}: mass and friction from its poses"
HALF_EXTENTS = np.array([0.06, 0.05, 0.04])  # m
BUNNY_SIZE = 0.12  # m
MASS, FRICTIONS = 0.8, (0.1, 0.2, 0.3)
TIMESTEP = 0.002  # s
# The search begins far off.
START_MASS, START_FRICTION = 0.4, 0.02
# Directions [rad] in which the hull slides on this one of its stable faces instead of tipping over.
DIRECTIONS, FACE = np.array([1.4, 4.2, 4.9]), 1
# How far the simulators are from each other. Only positions count: a sliding body turns by a few degrees in
# MuJoCo, which presses on corners, and not in dano, which presses on areas.
POSITION_NOISE = 1e-3  # m
# Frames: in a whole push the hull rocks differently in the two simulators, which leaves wrong minima.
WINDOW = 20
TARGET = 3.0  # %


def run() -> None:
    """Measure, print and report."""
    arguments = parse_arguments("Identify mass and friction of bodies that MuJoCo simulates.")
    load = load_average()
    frictions = FRICTIONS[:1] if arguments.quick else FRICTIONS
    rows = []
    for name, subject in (("box", _box), ("bunny hull", _bunny_hull)):
        try:
            rows += _rows(name, *subject(), frictions)
        except ImportError as error:
            rows.append(skipped(GROUP.format(name), "all of it", str(error)))
    report(
        "paper.cross_simulator", rows, {"dtype": "float64", "quick": arguments.quick}, load, arguments.json
    )


def _box():
    body = dano.NeuralObject.from_field(dano.Box(tuple(HALF_EXTENTS), edge=1e-3), mass=MASS)
    return body, _mujoco.box_geom(HALF_EXTENTS), float(HALF_EXTENTS[2])


def _bunny_hull():
    import trimesh

    mesh = trimesh.load_mesh(REPOSITORY / "assets" / "bunny.obj")
    mesh.apply_scale(BUNNY_SIZE / mesh.extents.max())
    hull = mesh.convex_hull
    hull.apply_transform(hull.compute_stable_poses()[0][FACE])
    body = dano.NeuralObject.from_field(mesh_field(hull), mass=MASS)
    return body, _mujoco.hull_geom(np.asarray(hull.vertices)), float(-hull.bounds[0, 2])


def _rows(name: str, body: dano.NeuralObject, geometry, height: float, frictions) -> list[Row]:
    group = GROUP.format(name)
    rows = []
    for friction in frictions:
        runs = _mujoco.simulate(geometry, MASS, friction, height + 1e-3, DIRECTIONS)
        fit = _identified(body, runs)
        for key, truth in (("mass", MASS), ("friction", friction)):
            error = 100 * abs(fit.values[key] / truth - 1)
            note = f"{fit.values[key]:.4f} ± {fit.standard_errors[key]:.1g} for {truth}"
            rows.append(Row(group, f"error of the {key}, friction {friction}", error, "%", TARGET, note=note))
        far = 1e3 * fit.errors.mean_position
        note = f"{fit.evaluations} evaluations, {fit.stop.value}"
        rows.append(Row(group, f"mean position error, friction {friction}", far, "mm", note=note))
    return rows


def _identified(body: dano.NeuralObject, runs: list[_mujoco.Run]) -> dano.Identification:
    contact = dano.Contact("body", "floor", law=dano.DistributedLaw())
    scene = dano.Scene.create(
        # Of 1 kg, so that the scale, which inertia follows, is the mass.
        [dano.Body("body", body, mass=1.0), dano.Body("floor", dano.HalfSpace(), fixed=True)],
        [contact],
        timestep=TIMESTEP,
        gravity=(0.0, 0.0, -_mujoco.GRAVITY),
    )
    parameters = [
        dano.Parameter(
            "mass", lambda s: s.body("body").mass_scale, 0.05, 10.0, start=START_MASS, coordinates="log"
        ),
        dano.Parameter(
            "friction", lambda s: s.contact("body", "floor").sliding_friction, 0.0, 2.0, start=START_FRICTION
        ),
    ]
    motions = [
        dano.Motion.create(
            np.arange(len(run.position)) * _mujoco.FRAME,
            "body",
            position=run.position,
            orientation=run.orientation,
            point="origin",
        )
        for run in runs
    ]
    steps = round(_mujoco.DURATION / TIMESTEP)
    pushed = np.arange(steps) < round(_mujoco.PUSHED / TIMESTEP)
    controls = []
    for run in runs:
        force = np.zeros((steps, 2, 3))
        force[pushed, 0] = run.force
        controls.append(dano.Control(jnp.asarray(force), jnp.zeros((steps, 2, 3))))
    return dano.identify(
        scene,
        motions,
        parameters,
        controls=controls,
        initial=["velocity"],
        noise={"position": POSITION_NOISE},
        options=dano.IdentifyOptions(window=WINDOW, tolerance=1.0, max_iterations=60),
    )
