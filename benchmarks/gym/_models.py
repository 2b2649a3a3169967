"""Gymnasium's own models: free motion beside MuJoCo, and random actions on the floor."""

import importlib.util
import warnings
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import dano
from benchmarks._measure import Row, skipped
from dano.robots import Robot
from dano.scene import Control

FREE = "Gymnasium's models, the first 0.2 s beside MuJoCo"
RANDOM = "Gymnasium's models, random actions with limits and floor"
NAMES = (
    "ant",
    "half_cheetah",
    "hopper",
    "humanoid",
    "humanoidstandup",
    "inverted_double_pendulum",
    "inverted_pendulum",
    "pusher_v5",
    "reacher",
    "swimmer",
    "walker2d_v5",
)
STEP = 1e-4
"""Timestep of both in free motion [s]: what is compared is the model, not the method."""
HELD, HOLDS = 100, 20
"""Steps with one action, and how many of them: 0.2 s."""
CLOSE = 1e-3
"""By how much centres of mass may differ [m]."""
IGNORED = ("fluid", "tendons", "other actuators", "free joints")
"""What dano has not; MuJoCo is run without it, too."""


def rows(n_steps: int) -> Iterator[Row]:
    """Of all models that are there."""
    spec = importlib.util.find_spec("gymnasium")
    if spec is None or spec.origin is None:
        yield skipped(FREE, "all of it", "gymnasium, which ships the models, is not installed")
        return
    folder = Path(spec.origin).parent / "envs" / "mujoco" / "assets"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name in NAMES:
            yield _beside(name, folder / f"{name}.xml")
        for name in NAMES:
            yield _tried(name, folder / f"{name}.xml", n_steps)


def _commands(robot: Robot, scene: dano.Scene, names: list[str], u: np.ndarray, held: int) -> Control:
    """Commands of the actuators, each held for some steps."""
    made = [robot.control(scene, dict(zip(names, row.tolist(), strict=True))) for row in u]
    return jax.tree.map(lambda *x: jnp.repeat(jnp.stack(x), held, axis=0), *made)


def _drawn(model: mujoco.MjModel, count: int) -> np.ndarray:
    """Random actions within the ranges of the file."""
    low, high = model.actuator_ctrlrange.T
    return np.random.default_rng(0).uniform(low, high, (count, model.nu))


def _beside(name: str, path: Path) -> Row:
    """Without what dano makes hard and MuJoCo soft: limits and contact."""
    robot = dano.load_mjcf(path, collision=False, ignore=IGNORED)
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.density = model.opt.viscosity = 0
    model.opt.timestep, model.opt.integrator = STEP, mujoco.mjtIntegrator.mjINT_RK4
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(
        mujoco.mjtDisableBit.mjDSBL_LIMIT
    )
    scene = robot.scene(timestep=STEP)
    for joint in scene.joints:
        if joint.limits is not None:
            scene = scene.replace_joint(joint.child, limits=None)
    names = [model.actuator(k).name or f"actuator {k}" for k in range(model.nu)]
    u = _drawn(model, HOLDS)
    run = dano.simulate(scene, robot.state(scene), controls=_commands(robot, scene, names, u, HELD))
    known = [body.name for body in robot.bodies if _is_alone(robot, model, body.name)]
    ours = np.asarray(run.states.position)[HELD::HELD, [scene.index(each) for each in known]]
    data, theirs = mujoco.MjData(model), []
    for row in u:
        data.ctrl[:] = row
        mujoco.mj_step(model, data, HELD)
        # Positions of bodies are those of the beginning of a step.
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        theirs.append([data.body(each).xipos.copy() for each in known])
    apart = float(np.abs(ours - np.array(theirs)).max())
    moved = float(np.abs(ours - ours[0]).max())
    return Row(FREE, name, apart, "m", CLOSE, note=f"{len(known)} bodies, which moved by {moved:.2g} m")


def _is_alone(robot: Robot, model: mujoco.MjModel, name: str) -> bool:
    """Whether a body is one of MuJoCo's, and no others are welded to it."""
    which = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if which < 0:
        return False
    masses = {body.name: float(body.mass) for body in robot.bodies}
    return bool(np.isclose(masses[name], model.body_mass[which], rtol=1e-6))


def _tried(name: str, path: Path, n_steps: int) -> Row:
    """A new random action in each step of the file's timestep."""
    robot = dano.load_mjcf(path, ignore=IGNORED)
    model = mujoco.MjModel.from_xml_path(str(path))
    contacts = robot.contacts_with(*robot.surroundings) if robot.surroundings else []
    scene = robot.scene(timestep=float(model.opt.timestep), contacts=contacts)
    names = [model.actuator(k).name or f"actuator {k}" for k in range(model.nu)]
    controls = _commands(robot, scene, names, _drawn(model, n_steps), 1)
    run = dano.simulate(scene, robot.state(scene), controls=controls)
    finite = bool(np.all(np.isfinite(np.asarray(run.states.position))))
    failed = int(np.sum(~np.asarray(run.converged)))
    note = f"of {n_steps}; {len(contacts)} contacts; finite: {finite}"
    return Row(RANDOM, name, float(failed if finite else n_steps), "steps not converged", 0, note=note)
