"""Payload, friction and armature from noisy logs of joint coordinates."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2

import dano
from benchmarks._measure import Row
from dano.robots import Robot

NOISE = 1e-3  # rad
PAYLOAD: dict[str, float | np.ndarray] = {"mass": 1.35, "centre": np.array([0.01, -0.015, 0.03])}
JOINT: dict[str, float | np.ndarray] = {"friction": 0.4, "armature": 0.05}

Log = tuple[np.ndarray, np.ndarray, dano.Control]


@dataclasses.dataclass(frozen=True)
class Case:
    """A scene with numbers that are not known, the true ones, and a log of what happens with these."""

    scene: dano.Scene
    parameters: tuple[dano.Parameter, ...]
    truth: dict[str, float | np.ndarray]
    log: Log
    window: int


def payload(path: Path) -> Case:
    """The Panda swings a load for 5 s; its mass and its centre are not known."""
    robot = dano.load_urdf(path, collision=False)
    timestep = 5e-3
    load = dano.Body("load", dano.Sphere(0.04), mass=1.0, inertia=np.diag([6.4e-4] * 3))
    hold = dano.Joint(robot.bodies[-1].name, "load", "weld", position=(0, 0, 0.2))
    joints = [dataclasses.replace(joint, limits=None) for joint in robot.joints]
    scene = dano.Scene.create([*robot.bodies, load], contacts=(), joints=[*joints, hold], timestep=timestep)
    true = scene.replace_body("load", mass_scale=PAYLOAD["mass"], com_offset=PAYLOAD["centre"])
    wanted = _swinging(np.array([0.1, 0.4, -0.3, -1.5, 0.2, 1.6, 0.5]), (0.2, 0.4, 0.6), 0.25)
    parameters = (
        dano.Parameter("mass", lambda s: s.body("load").mass_scale, 0.2, 3.0),
        dano.Parameter("centre", lambda s: s.body("load").com_offset, -0.1, 0.1),
    )
    log = _logged(scene, true, _started(robot, scene, wanted), wanted, 1000)
    return Case(scene, parameters, PAYLOAD, log, 100)


def shoulder(path: Path) -> Case:
    """The first three joints of the shipped arm; friction and armature of the second are not known."""
    robot = dano.load_urdf(path, collision=False)
    joints = [dataclasses.replace(joint, limits=None, armature=0.01) for joint in robot.joints[:3]]
    scene = dano.Scene.create(robot.bodies[:3], contacts=(), joints=joints, timestep=5e-3)
    true = scene.replace_joint("upper", **JOINT)
    wanted = _swinging(np.array([0.0, 0.5, 0.6]), (0.5, 1.1), 0.4)
    parameters = (
        dano.Parameter("friction", lambda s: s.joints[1].friction, 0.0, 2.0),
        dano.Parameter("armature", lambda s: s.joints[1].armature, 0.0, 1.0),
    )
    log = _logged(scene, true, _started(robot, scene, wanted), wanted, 800)
    return Case(scene, parameters, JOINT, log, 80)


def fits(case: Case, seeds: int) -> Iterator[dano.Identification]:
    """Fits to the log with different noise."""
    times, q, controls = case.log
    for seed in range(seeds):
        noisy = q + NOISE * np.random.default_rng(seed).normal(size=q.shape)
        motion = dano.motion_of_joints(case.scene, times, noisy)
        yield dano.identify(
            case.scene,
            motion,
            list(case.parameters),
            controls=controls,
            noise=dict(q=NOISE),
            options=dano.IdentifyOptions(window=case.window),
        )


def distance(fit: dano.Identification, case: Case) -> float:
    """Squared length of the error of all numbers, in standard errors: χ² with as many degrees of freedom.

    Errors of single numbers hang together: of the four of a payload one combination has most of the variance,
    so that either all of their intervals hold the truth or none.
    """
    off = [np.ravel(np.subtract(fit.values[p.name], case.truth[p.name])) for p in case.parameters]
    error = np.concatenate(off)
    return float(error @ np.linalg.solve(fit.covariance, error))


def rows(group: str, panda: Path, arm: Path, seeds: int) -> list[Row]:
    """Largest errors over logs with different noise, and how many intervals hold the truth."""
    found, logs = [], f"of {seeds} logs of 5 s, 1 mrad noise"
    case = payload(panda)
    made = list(fits(case, seeds))
    mass = max(abs(float(fit.values["mass"]) / float(PAYLOAD["mass"]) - 1) for fit in made)
    centre = max(float(np.linalg.norm(fit.values["centre"] - PAYLOAD["centre"])) for fit in made)
    found.append(Row(group, "payload of the Panda: mass, largest error", 100 * mass, "%", 1.0, note=logs))
    found.append(
        Row(group, "payload of the Panda: centre, largest error", 1e3 * centre, "mm", 2.0, note=logs)
    )
    found.append(_regions(group, "payload of the Panda", case, made))
    case = shoulder(arm)
    made = list(fits(case, seeds))
    for name, true in JOINT.items():
        off = max(abs(float(fit.values[name]) / float(true) - 1) for fit in made)
        note = f"of {seeds} logs of 4 s, 1 mrad noise"
        found.append(Row(group, f"{name} of a joint: largest error", 100 * off, "%", 5.0, note=note))
    return [*found, _regions(group, "friction and armature", case, made)]


def _regions(group: str, name: str, case: Case, made: Sequence[dano.Identification]) -> Row:
    size = len(made[0].labels)
    found = [distance(fit, case) for fit in made]
    inside = float(np.sum(np.array(found) < chi2.ppf(0.95, size)))
    note = f"squared errors over their covariance: {np.mean(found):.1f} in the mean, expected {size}"
    return Row(group, f"{name}: 95 % regions that hold the truth", inside, f"of {len(made)}", note=note)


def _started(robot: Robot, scene: dano.Scene, wanted: Callable) -> dano.State:
    names = [name for name, body in robot.joint_names.items() if body in scene.names]
    speeds = np.asarray(jax.jacfwd(wanted)(0.0))
    q, v = (dict(zip(names, row, strict=True)) for row in (wanted(0.0), speeds))
    return robot.state(scene, q, v)


def _logged(scene, true, state, wanted, n_steps: int) -> Log:
    """Coordinates and efforts of the true robot while a computed torque without the load leads it."""
    speed = jax.jacfwd(wanted)
    gain = jax.jacfwd(speed)

    def policy(state, t):
        pull = gain(t) + 100 * (wanted(t) - state.q) + 20 * (speed(t) - state.v)
        return dano.joint_control(scene, dano.computed_torque(scene, state, pull))

    run = dano.simulate(true, state, n_steps, controls=policy)
    before = jax.tree.map(lambda x: x[:-1], run.states)
    effort = jax.vmap(lambda s, t: policy(s, t).effort)(before, run.times[:-1])
    still = jnp.zeros((n_steps, len(scene.bodies), 3))
    return np.asarray(run.times), np.asarray(run.states.q), dano.Control(still, still, effort)


def _swinging(start: np.ndarray, frequencies: Sequence[float], size: float, seed: int = 3) -> Callable:
    """Sums of sines of all joints from a start."""
    rng = np.random.default_rng(seed)
    shape = (len(frequencies), len(start))
    sizes, phases = rng.uniform(-size, size, shape), rng.uniform(0, 2 * np.pi, shape)
    turning = 2 * np.pi * np.array(frequencies)[:, None]
    return lambda t: start + jnp.sum(sizes * (jnp.sin(turning * t + phases) - np.sin(phases)), axis=0)
