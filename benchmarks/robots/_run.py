"""The Panda: a step, and its mass matrix, beside MuJoCo and frax; energy and motion of free swinging."""

import argparse
import dataclasses
import time
import xml.etree.ElementTree as ET
from importlib.resources import files
from pathlib import Path

import jax
import mujoco
import numpy as np

import dano
from benchmarks._measure import (
    compiled,
    load_average,
    parse_arguments,
    report,
    Row,
    skipped,
    summary,
    time_in_turn,
    warm_up,
)
from benchmarks.robots import _chains, _identify, _standing
from benchmarks.robots.push import panda
from dano.robots import Robot

STEPS = 1000
TIMESTEP = 1e-3
START = np.array([0.1, 0.4, -0.3, -1.5, 0.2, 1.6, 0.5])
SPEED = "One step of 1 ms, without contact"
SWING = "Free swing without friction"
KEPT = "What chains keep"
SHARED = 1.5  # load average from which on other programs ran, too
FOUND = "Found from logs"


def run() -> None:
    arguments = parse_arguments("Measure a robot beside MuJoCo and frax.", _add)
    load = load_average()
    if arguments.standing:
        rows = list(_standing.rows(0.2 if arguments.quick else 2.0))
        report("robots-standing", rows, {"timestep": _standing.TIMESTEP}, load, arguments.json)
        return
    path = panda()
    if path is None:
        rows = [skipped(SPEED, "all of it", "the package frax, which ships the Panda, is not installed")]
    else:
        warm_up()
        robot = dano.load_urdf(path, collision=False)
        rows = _speed_rows(robot, path, 3 if arguments.quick else 15)
        rows += _swing_rows(robot, path, 2.0 if arguments.quick else 60.0)
        rows += _chains.rows(KEPT, 200 if arguments.quick else 10_000)
        arm = Path(str(files("dano") / "assets" / "arm.urdf"))
        rows += _identify.rows(FOUND, path, arm, 1 if arguments.quick else 8)
    # Other programs slow down what is timed, most of all what reads much memory.
    settings = {"steps": STEPS, "timestep": TIMESTEP, "shared": load_average() > SHARED}
    report("robots", rows, settings, load, arguments.json)


def _add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--standing", action="store_true", help="only robots of five families on a floor")


def _speed_rows(robot: Robot, path: Path, repeats: int) -> list[Row]:
    model, data = _theirs(path)
    calls, taken = {}, {}
    for name, free in (("dano, limits", False), ("dano, no limits", True)):
        scene = _scene(robot, free=free)
        state = robot.state(scene, dict(zip(robot.joint_names, START, strict=True)))

        def rollout(state, scene=scene):
            return _angles(dano.simulate(scene, state, STEPS).states)[-1]

        run, taken[name] = compiled(rollout, state)
        calls[name] = lambda run=run, state=state: run(state)

    def theirs():
        data.qpos[:], data.qvel[:] = START, 0
        for _ in range(STEPS):
            mujoco.mj_step(model, data)

    calls["MuJoCo"] = theirs
    times = time_in_turn(calls, repeats)
    rows = []
    for name, seconds in times.items():
        middle, quartiles = summary(1e6 * seconds / STEPS)
        target = 12 if name.startswith("dano") else None
        rows.append(Row(SPEED, name, middle, "µs", target, quartiles=quartiles))
    rows += [Row(SPEED, f"{name}, to compile", seconds, "s", 10) for name, seconds in taken.items()]
    return [*rows, *_matrix_rows(robot, repeats)]


def _matrix_rows(robot: Robot, repeats: int) -> list[Row]:
    """The mass matrix at a thousand configurations, here and by frax."""
    from frax import load_panda  # the package has it where it has the file

    scene = _scene(robot, free=True)
    state = robot.state(scene, dict(zip(robot.joint_names, START, strict=True)))
    rng = np.random.default_rng(0)
    many = START[None] + 0.1 * rng.normal(size=(STEPS, 7))

    def one(q):
        return dano.mass_matrix(scene, dataclasses.replace(state, q=q))

    panda = load_panda()
    calls = {}
    for name, function in (("mass matrix, dano", one), ("mass matrix, frax", panda.mass_matrix)):
        made, _ = compiled(lambda rows, f=function: jax.lax.map(f, rows), many)
        calls[name] = lambda made=made: made(many)
    times = time_in_turn(calls, repeats)
    return [Row(SPEED, name, summary(1e6 * s / STEPS)[0], "µs") for name, s in times.items()]


def _swing_rows(robot: Robot, path: Path, duration: float) -> list[Row]:
    """Angles after a second beside MuJoCo with fourth-order steps, and the trend of the energy."""
    h = 2e-4
    model, data = _theirs(path)
    model.opt.timestep, model.opt.integrator = 1e-4, mujoco.mjtIntegrator.mjINT_RK4
    model.jnt_limited[:] = 0
    data.qpos[:] = START
    mujoco.mj_forward(model, data)
    mass = np.zeros((7, 7))
    for row, unit in zip(mass, np.eye(7), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    before = 0.5 * h * np.linalg.solve(mass, data.qfrc_bias)
    for _ in range(10_000):
        mujoco.mj_step(model, data)
    scene = _scene(robot, free=True, timestep=h)
    names = list(robot.joint_names)
    state = robot.state(scene, dict(zip(names, START, strict=True)), dict(zip(names, before, strict=True)))
    begin = time.process_time()
    states = dano.simulate(scene, state, round(duration / h)).states
    jax.block_until_ready(states)
    taken = time.process_time() - begin
    off = float(np.abs(np.asarray(_angles(states)[round(1 / h)]) - data.qpos).max())
    energy = _energies(scene, states)
    t = np.arange(len(energy)) / len(energy)
    trend = float(np.polyfit(t, energy, 1)[0])
    size = float(np.ptp(_potentials(scene, states)))
    note = f"{duration:g} s in steps of {1000 * h:g} ms, {taken:.3g} s of CPU with compiling"
    return [
        Row(SWING, "angles after 1 s beside MuJoCo", off, "rad", 1e-3),
        Row(SWING, "trend of the energy over all", abs(trend) / size, "", 1e-3, note=note),
        Row(SWING, "swing of the energy", float(np.ptp(energy)) / size, "", note="shares of the potential's"),
    ]


def _angles(states: dano.State) -> jax.Array:
    assert states.q is not None
    return states.q


def _energies(scene: dano.Scene, states: dano.State) -> np.ndarray:
    """Kinetic energy of half a step before and after, and potential energy [J]."""
    mass = np.array([float(body.mass) for body in scene.bodies])
    inertia = np.stack([np.asarray(body.inertia) for body in scene.bodies])
    linear, spin = np.asarray(states.velocity), np.asarray(states.omega)
    kinetic = 0.5 * np.einsum("n,tna,tna->t", mass, linear, linear)
    kinetic += 0.5 * np.einsum("tna,nab,tnb->t", spin, inertia, spin)
    return 0.5 * (kinetic[:-1] + kinetic[1:]) + _potentials(scene, states)[:-1]


def _potentials(scene: dano.Scene, states: dano.State) -> np.ndarray:
    mass = np.array([float(body.mass) for body in scene.bodies])
    return 9.81 * np.asarray(states.position)[:, :, 2] @ mass


def _scene(robot: Robot, *, free: bool, timestep: float = TIMESTEP) -> dano.Scene:
    joints = [dataclasses.replace(joint, limits=None) if free else joint for joint in robot.joints]
    return dano.Scene.create(robot.bodies, contacts=(), joints=joints, timestep=timestep)


def _theirs(path: Path):
    root = ET.parse(path).getroot()
    for link in root.findall("link"):
        for role in ("visual", "collision"):
            for part in link.findall(role):
                link.remove(part)
    model = mujoco.MjModel.from_xml_string(ET.tostring(root).decode())
    model.opt.timestep = TIMESTEP
    return model, mujoco.MjData(model)
