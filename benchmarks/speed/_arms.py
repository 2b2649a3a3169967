"""The Panda alone, striking a box, and holding one, in dano and, as the same scene, in MuJoCo."""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

import dano
from benchmarks._measure import compiled
from benchmarks.robots.push import panda
from benchmarks.speed._cases import Case
from dano.maths import Numbers

TIMESTEP, N_STEPS, SETTLE = 0.002, 250, 250
"""Of a call [s], its number, and steps before it where a box is held."""
STIFFNESS, DAMPING = 600.0, 40.0
"""Of the servos of the joints [N m/rad, N m s/rad]."""
READY = (0.0, 0.3, 0.0, -2.2, 0.0, 2.5, 0.8)
"""From where inverse kinematics begins [rad]."""
DOWN = (0.0, 1.0, 0.0, 0.0)
"""Orientation of the last link."""
REACH = 0.2
"""From the last link to the tool [m]."""
TOOL, HALF, HELD = 0.04, 0.05, 0.02
"""Radius of the tool, half the sides of the box that is struck and of the one that is held [m]."""
FINGER, FORCE, FRICTION = (0.012, 0.005, 0.02), 20.0, 0.8
"""Half the sides of a finger [m], its force [N], and the friction of all there is."""


class Arm(NamedTuple):
    """A scene with the arm.

    Attributes:
        name: For the table.
        scene: The scene.
        state: Where it begins.
        control: What its motors are told in all steps.
    """

    name: str
    scene: dano.Scene
    state: dano.State
    control: dano.Control


def _robot() -> dano.Robot:
    path = panda()
    assert path is not None
    robot = dano.load_urdf(path, collision=False)
    motor = dano.Motor("position", stiffness=STIFFNESS, damping=DAMPING)
    return dataclasses.replace(
        robot, joints=tuple(dataclasses.replace(joint, motor=motor) for joint in robot.joints)
    )


def _reaching(robot: dano.Robot, scene: dano.Scene, place: Numbers, **others: dict[str, Numbers]):
    """A state in which the tool is at a place [m], and the angles of the joints [rad]."""
    links = [body.name for body in robot.bodies]
    given = {name: {"q": q} for name, q in zip(links, READY, strict=True)}
    begun = scene.initial_state(**given, **others)  # pyright: ignore[reportArgumentType]
    hand = np.asarray(place) + [0, 0, REACH]
    found = dano.inverse_kinematics(
        robot, scene, begun, [dano.Target(links[-1], position=hand, orientation=DOWN)]
    )
    assert found.reached, found.reason
    assert found.state.q is not None
    return found.state, dict(zip(links, np.asarray(found.state.q)[: len(links)].tolist(), strict=True))


def _told(scene: dano.Scene, commands: dict[str, float], **others: dict[str, Numbers]) -> dano.Control:
    return scene.control(**{name: {"command": q} for name, q in commands.items()}, **others)


def alone() -> Arm:
    """The arm turns about its base."""
    robot = _robot()
    scene = dano.Scene.create(list(robot.bodies), [], joints=list(robot.joints), timestep=TIMESTEP)
    state, q = _reaching(robot, scene, (0.5, 0.0, 0.3))
    q[robot.bodies[0].name] += 0.4
    return Arm("Panda alone", scene, state, _told(scene, q))


def strikes() -> Arm:
    """The arm turns about its base, and the ball at its end strikes a box on a floor."""
    robot = _robot()
    tool, box = (
        dano.Body("tool", dano.Sphere(TOOL), mass=0.2),
        dano.Body("box", dano.Box((HALF,) * 3), mass=0.5),
    )
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    weld = dano.Joint(robot.bodies[-1].name, "tool", "weld", position=(0, 0, REACH))
    params = dano.ContactParams(sliding_friction=FRICTION)
    scene = dano.Scene.create(
        [box, *robot.bodies, tool, floor],
        [dano.Contact("box", "floor", params), dano.Contact("tool", "box", params)],
        joints=[*robot.joints, weld],
        timestep=TIMESTEP,
    )
    beside: dict[str, Numbers] = {"position": (0.5, TOOL + HALF + 0.02, HALF)}
    state, q = _reaching(robot, scene, (0.5, 0.0, HALF), box=beside)
    q[robot.bodies[0].name] += 0.4
    return Arm("Panda strikes a box", scene, state, _told(scene, q))


def holds() -> Arm:
    """Two fingers on slides at the end of the arm hold a box."""
    robot = _robot()
    last = robot.bodies[-1].name
    box = dano.Body("box", dano.Box((HELD,) * 3), mass=0.2)
    fingers = [dano.Body(name, dano.Box(FINGER), mass=0.05) for name in ("left", "right")]
    slides = [
        dano.Joint(
            last,
            body.name,
            "slide",
            axis=(0, -side, 0),
            position=(0, side * (HELD + FINGER[1] + 0.001), REACH),
            damping=1.0,
        )
        for side, body in zip((1, -1), fingers, strict=True)
    ]
    params = dano.ContactParams(sliding_friction=FRICTION)
    scene = dano.Scene.create(
        [*robot.bodies, *fingers, box],
        [dano.Contact(body.name, "box", params) for body in fingers],
        joints=[*robot.joints, *slides],
        timestep=TIMESTEP,
    )
    place: dict[str, Numbers] = {"position": (0.5, 0.0, 0.3)}
    state, q = _reaching(robot, scene, (0.5, 0.0, 0.3), box=place)
    control = _told(scene, q, left={"effort": FORCE}, right={"effort": FORCE})
    settled = dano.simulate(scene, state, controls=_repeated(control, SETTLE)).states
    return Arm("Panda holds a box", scene, jax.tree.map(lambda x: x[-1], settled), control)


ARMS: dict[str, Callable[[], Arm]] = {"arm-alone": alone, "arm-strikes": strikes, "arm-holds": holds}
"""Parts of the benchmark."""


def _repeated(control: dano.Control, n_steps: int) -> dano.Control:
    return jax.tree.map(lambda x: x[None].repeat(n_steps, axis=0), control)


def _group(arm: Arm) -> str:
    return f"{arm.name}, {N_STEPS} steps of {1000 * TIMESTEP:g} ms, per step"


@functools.cache
def arm_of(part: str) -> Arm:
    """The arm of a part of the benchmark; its start is looked for once."""
    return ARMS[part]()


def arm_case(arm: Arm) -> Case:
    """A rollout in dano."""
    arrays, static = eqx.partition(arm.scene, eqx.is_array)
    controls = _repeated(arm.control, N_STEPS)

    def rollout(arrays, state):
        return dano.simulate(eqx.combine(arrays, static), state, controls=controls)

    run, seconds = compiled(rollout, arrays, arm.state)
    done = jax.block_until_ready(run(arrays, arm.state))
    failed = int(np.sum(~np.asarray(done.converged)))
    ends = np.asarray(done.states.position)[-1]
    note = f"{float(np.mean(np.asarray(done.iterations))):.1f} iterations"
    note += _box_note(arm, lambda name: ends[arm.scene.index(name)])
    note += f", {failed} steps NOT converged" if failed else ""
    return Case(
        _group(arm), arm.name, lambda: run(arrays, arm.state), N_STEPS, compile_seconds=seconds, note=note
    )


def _box_note(arm: Arm, end_of: Callable[[str], np.ndarray]) -> str:
    """How far the box has gone to where it ends [m]: whether it was struck, and is still held."""
    if "box" not in arm.scene.names:
        return ""
    way = np.linalg.norm(end_of("box") - np.asarray(arm.state.position[arm.scene.index("box")]))
    return f", the box moves by {1000 * way:.1f} mm"


def mujoco_arm_case(arm: Arm) -> Case:
    """The same bodies, joints, motors and pairs in MuJoCo."""
    import mujoco

    from dano.mujoco import MuJoCoEngine

    engine = MuJoCoEngine(arm.scene)
    model, data = engine.model, engine.data(arm.scene, arm.state, arm.control)
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    start = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, start, kind)

    def run() -> None:
        mujoco.mj_setState(model, data, start, kind)
        mujoco.mj_step(model, data, N_STEPS)

    run()
    note = f"{data.ncon} contact points at the end" + _box_note(arm, lambda name: data.body(name).xipos)
    note += ", UNSTABLE" if any(warning.number for warning in data.warning) else ""
    return Case(_group(arm), f"MuJoCo: {arm.name}", run, N_STEPS, note=note)
