"""A scene in which the Panda pushes the shipped bunny, and tasks with random starts and goals."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import dano
from benchmarks._subjects import shipped_bunny
from dano.maths import quat_conjugate, quat_from_axis_angle, quat_log, quat_multiply
from dano.planning import Actuator, Goal, Task

TIMESTEP, N_STEPS = 0.02, 50
RADIUS, FRICTION = 0.04, 0.3  # of the tool [m], of bunny and floor
READY = np.array([0.0, 0.3, 0.0, -2.2, 0.0, 2.5, 0.8])  # from where inverse kinematics begins [rad]
DOWN = (0.0, 1.0, 0.0, 0.0)  # orientation of the hand
HEIGHT, BEHIND = 0.05, 0.105  # of the tool, and its distance from the bunny [m]
BUNNY = np.array([0.55, 0.0])  # m
AHEAD, ASIDE, SPREAD = 0.12, 0.04, 0.03  # m: how far the tool pushes, goals lie aside, starts differ
STIFFNESS, DAMPING = 120.0, 20.0  # 1/s², 1/s
NEAR, WITHIN = 0.02, 0.01  # m
"""Errors that count as reached, and of a component that plans are asked for."""


def scene(
    path: Path, timestep: float = TIMESTEP, friction: float = FRICTION
) -> tuple[dano.Robot, dano.Scene]:
    """The arm with a ball for a tool, the bunny and a floor, with the paper's law."""
    robot, bunny = dano.load_urdf(path, collision=False), shipped_bunny()
    tool = dano.Body("tool", dano.Sphere(RADIUS), mass=0.2)
    weld = dano.Joint(robot.bodies[-1].name, "tool", "weld", position=(0, 0, 0.2))
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    params = bunny.params(sliding_friction=friction)
    pairs = [("bunny", "floor"), ("tool", "bunny")]
    made = dano.Scene.create(
        [*robot.bodies, tool, dano.Body("bunny", bunny.bunny), floor],
        [dano.Contact(a, b, params, bunny.law()) for a, b in pairs],
        joints=[*robot.joints, weld],
        timestep=timestep,
    )
    return robot, made


@dataclasses.dataclass(frozen=True)
class Case:
    """A start, a task and a first guess."""

    state: dano.State
    task: Task
    guess: np.ndarray


def rested() -> tuple[np.ndarray, np.ndarray]:
    """Position and orientation of the bunny at rest."""
    bunny = shipped_bunny()
    bodies = [dano.Body("bunny", bunny.bunny), dano.Body("floor", dano.HalfSpace(), fixed=True)]
    contact = dano.Contact("bunny", "floor", bunny.params(), bunny.law())
    state = bunny.settled(dano.Scene.create(bodies, [contact], timestep=0.005))
    return np.asarray(state.position[0]), np.asarray(state.orientation[0])


def pusher(robot: dano.Robot, given: dano.Scene) -> Callable[[Array, dano.State, Array], dano.Control]:
    """Torques that draw the hand along places, one for each step, and do not turn it."""
    last, joints = robot.bodies[-1].name, len(robot.bodies)

    def push(ways: Float[Array, "T 3"], state: dano.State, time: Float[Array, ""]) -> dano.Control:
        assert state.v is not None
        goal = ways[jnp.round(time / TIMESTEP).astype(int)]
        position, orientation, jacobian = robot.place(given, state, last)
        turned = quat_log(quat_multiply(jnp.array(DOWN), quat_conjugate(orientation)))
        speed = jnp.array([AHEAD / (N_STEPS * TIMESTEP), 0.0, 0.0, 0.0, 0.0, 0.0])
        missing = jnp.concatenate([goal - position, turned])
        wanted = STIFFNESS * missing + DAMPING * (speed - jacobian[:, -joints:] @ state.v)
        torque = dano.operational_space_torque(robot, given, state, last, wanted)
        return dano.joint_control(given, torque)

    return push


def case(robot: dano.Robot, given: dano.Scene, push, rest: tuple[np.ndarray, np.ndarray], seed: int) -> Case:
    """A random start, and a goal to the side of where a straight push brings the bunny.

    Args:
        robot: The arm.
        given: The scene.
        push: From `pusher`.
        rest: From `rested`.
        seed: Of the numbers drawn.
    """
    draw = np.random.default_rng(seed).uniform(-1, 1, 4)
    turn = quat_from_axis_angle((0.0, 0.0, 1.0), np.pi * draw[0])
    place = np.append(BUNNY + SPREAD * draw[1:3], rest[0][2])
    bunny = {"position": place, "orientation": quat_multiply(turn, jnp.asarray(rest[1]))}
    hand = np.array([place[0] - BEHIND, place[1], HEIGHT + 0.2])
    names = [body.name for body in robot.bodies]
    first = given.initial_state(bunny=bunny, **{n: {"q": q} for n, q in zip(names, READY, strict=True)})
    target = dano.Target(names[-1], position=hand, orientation=DOWN)
    found = dano.inverse_kinematics(robot, given, first, [target])
    assert found.reached, found.reason
    ways = jnp.asarray(hand + np.linspace(0, 1, N_STEPS)[:, None] * [AHEAD, 0.0, 0.0])
    pushed = jax.tree_util.Partial(push, ways)
    states = dano.simulate(given, found.state, N_STEPS, controls=pushed).states
    times = TIMESTEP * jnp.arange(N_STEPS)
    guess = jax.vmap(pushed)(jax.tree.map(lambda x: x[:-1], states), times).effort
    index = {body.name: i for i, body in enumerate(given.bodies)}
    ends = {name: np.asarray(states.position)[-1, index[name]] for name in ("bunny", "tool")}
    ends["bunny"] = ends["bunny"] + (0.0, ASIDE * draw[3], 0.0)
    efforts = dict(zip(names, robot.efforts.values(), strict=True))
    task = Task(
        N_STEPS,
        [Actuator(name, "effort", limit=limit, cost=1e-7) for name, limit in efforts.items()],
        [Goal(name, position=at, running=10.0, final=10.0, within=WITHIN) for name, at in ends.items()],
    )
    return Case(found.state, task, np.asarray(guess))
