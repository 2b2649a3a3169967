"""Control of a robot's joints, and of a link in the space in which its task is told."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.checks import checked_kind, checked_number, shown
from dano.maths import checked_array, checked_floating, is_traced, Numbers
from dano.names import did_you_mean
from dano.robots._dynamics import (
    bias_forces,
    drifted,
    generalised_velocities,
    gravity_forces,
    joint_control,
    mass_matrix,
)
from dano.robots._robot import check_arguments, Robot
from dano.scene import Control, Scene, State

Goal = Mapping[str, Numbers] | Numbers

# Largest ω h of a controller that acts at the beginning of a step: beyond 2 it swings up by itself.
_FASTEST = 0.5


class JointPD(eqx.Module):
    """A controller of a robot's joints: see `pd`. For `dano.simulate(controls=…)`."""

    scene: Scene  # The scene that the controller takes the world to be
    # Coordinates [rad or m], shape (k,), or a function of time that gives them.
    goal: Float[Array, " k"] | Callable[[Float[Array, ""]], Goal]
    # k_p [N m/rad or N/m], shape (k,); None: in proportion to the mass matrix.
    stiffness: Float[Array, " k"] | None
    damping: Float[Array, " k"] | None  # k_d [N m s/rad or N s/m], shape (k,); None likewise
    rate: float = eqx.field(static=True)  # ω of gains in proportion to the mass matrix [rad/s]
    most: Float[Array, " k"]  # Largest effort of each joint [N m or N], shape (k,)
    gravity: bool = eqx.field(static=True)  # Whether gravity is compensated (static)
    # Of the joints among the coordinates q of the scene (static).
    places: tuple[int, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)  # Of the joints (static)

    def __call__(self, state: State, time: Float[Array, ""]) -> Control:
        """Efforts of the step that begins at `time` [s]."""
        if state.q is None or state.v is None:
            raise ValueError("state must be one of a scene with the robot's joints, got one without joints")
        places = np.array(self.places)
        goal = self.goal if isinstance(self.goal, Array) else self._numbers(self.goal(time))
        away, speed = goal - state.q[places], state.v[places]
        none = jnp.zeros_like(state.q)
        if self.stiffness is None or self.damping is None:
            wanted = none.at[places].set(self.rate**2 * away - 2 * self.rate * speed)
            effort = (mass_matrix(self.scene, state, joints=True) @ wanted)[places]
        else:
            effort = self.stiffness * away - self.damping * speed
        if self.gravity:
            effort = effort + gravity_forces(self.scene, state, joints=True)[places]
        effort = jnp.clip(effort, -self.most, self.most)
        return joint_control(self.scene, none.at[places].set(effort))

    def _numbers(self, goal: Goal) -> Float[Array, " k"]:
        """A goal as an array, in the order of the joints."""
        return _numbers("goal", goal, self.names, [0.0] * len(self.names)).astype(self.most.dtype)


def pd(
    robot: Robot,
    scene: Scene,
    goal: Goal | Callable[[Float[Array, ""]], Goal],
    *,
    frequency: float = 3.0,
    stiffness: Goal | None = None,
    damping: Goal | None = None,
    gravity: bool = True,
    limits: Mapping[str, float] | bool = True,
) -> JointPD:
    """A PD controller of a robot's joints, for `dano.simulate(controls=…)`.

        τ = clip(M(q) (ω² (q* − q) − 2 ω v) + g(q), ±τ_max),        ω = 2π · frequency,

    so that every joint moves to its goal as a critically damped spring would, whatever the arm weighs; or,
    with gains of your own, τ = clip(k_p (q* − q) − k_d v + g(q), ±τ_max). M and g are the robot's parts of
    `mass_matrix` and `gravity_forces`: other bodies may be in the scene, and what the arm carries or pushes
    is not known to it.

    Args:
        robot: The robot.
        scene: A scene with it.
        goal: q* [rad or m]: by names of joints in the file, where joints that are not named stay in the pose
            of the file; or in the order of `robot.joint_names`; or a function of the time [s] that gives one
            of them.
        frequency: Of that spring [Hz].
        stiffness: k_p [N m/rad or N/m], one number, or given as a goal is.
        damping: k_d [N m s/rad or N s/m], which goes with it.
        gravity: Whether gravity is compensated.
        limits: Largest efforts [N m or N] by names of joints, in place of those of the file; False: none.

    Raises:
        ValueError: If the robot has joints that are no hinges or slides, or motors of its own; a joint is
            unknown; a goal is beyond the limits of its joint; or `frequency` is too high for the timestep.
    """
    checked_kind("robot", robot, Robot)
    checked_kind("scene", scene, Scene)
    names, places = _places(robot, scene)
    dtype = scene.timestep.dtype
    rate = 2 * math.pi * checked_number("frequency", frequency, above=0, unit="Hz")
    if (stiffness is None) != (damping is None):
        raise ValueError("stiffness and damping must be given together, got one of them")
    if stiffness is None and not is_traced(scene.timestep) and rate * float(scene.timestep) > _FASTEST:
        most = _FASTEST / (2 * math.pi * float(scene.timestep))
        raise ValueError(f"frequency must be ≤ {most:.3g} Hz with this timestep, got {frequency}")
    pull = None if stiffness is None else _numbers("stiffness", stiffness, names, None).astype(dtype)
    brake = None if damping is None else _numbers("damping", damping, names, None).astype(dtype)
    if not callable(goal):
        goal = _numbers("goal", goal, names, [robot.home.get(name, 0.0) for name in names]).astype(dtype)
        _check_reach(scene, robot, names, goal)
    most = [math.inf] * len(names) if limits is False else [robot.efforts.get(n, math.inf) for n in names]
    if isinstance(limits, Mapping):
        most = _numbers("limits", limits, names, most)
    return JointPD(scene, goal, pull, brake, rate, jnp.asarray(most, dtype), bool(gravity), places, names)


def _places(robot: Robot, scene: Scene) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Names of the robot's joints with a coordinate, and their places among q.

    Raises:
        ValueError: If one has several coordinates, or a motor.
    """
    places = []
    for name, body in robot.joint_names.items():
        joint = scene.layout.joint_of(scene.index(body))
        assert joint is not None
        if scene.layout.width(joint) != 1:
            raise ValueError(f"robot must have hinges and slides, got joint {name!r} of several coordinates")
        if scene.joints[joint].motor is not None:
            raise ValueError(
                f"robot must have no motors of its own, got one on joint {name!r}, which would pull, too:"
                " give it commands by robot.control, or load the file with ignore='actuators'"
            )
        places.append(scene.layout.coordinates[joint])
    if not places:
        raise ValueError(f"robot must have joints with coordinates, got {robot.name!r}, which has none")
    return tuple(robot.joint_names), tuple(places)


def _numbers(label: str, given: Goal, names: tuple[str, ...], usual: Any) -> Float[Array, " k"]:
    """Numbers of joints in order; `usual` stands for those that a mapping does not name, None for none.

    Raises:
        ValueError: If a joint is unknown or missing, or there are fewer or more numbers.
    """
    if isinstance(given, Mapping):
        for name in given:
            if name not in names:
                hint = did_you_mean(name, names)
                raise ValueError(f"{label} must be of joints {list(names)}, got {shown(name)}{hint}")
        missing = [name for name in names if name not in given]
        if missing and usual is None:
            raise ValueError(f"{label} must name every joint, and {missing[0]!r} is missing")
        values = [given.get(name, usual[k] if usual is not None else None) for k, name in enumerate(names)]
        return jnp.stack([jnp.asarray(value, float) for value in values])
    if usual is None and np.ndim(given) == 0:
        return jnp.full(len(names), checked_array(label, given, (), least=0))
    return checked_array(label, given, (len(names),))


def _check_reach(scene: Scene, robot: Robot, names: tuple[str, ...], goal: Float[Array, " k"]) -> None:
    """Check that joints can be where they shall go.

    Raises:
        ValueError: If one cannot.
    """
    for name, value in zip(names, goal, strict=True):
        limits = scene.joint(robot.joint_names[name]).limits
        if limits is None or is_traced(limits, value):
            continue
        low, high = (float(x) for x in limits)
        if not low - 1e-6 <= float(value) <= high + 1e-6:
            raise ValueError(
                f"goal of joint {name!r} must lie in its limits [{low:.4g}, {high:.4g}],"
                f" got {float(value):.4g}"
            )


def operational_space_torque(
    robot: Robot,
    scene: Scene,
    state: State,
    link: str,
    acceleration: Numbers,
    *,
    posture: Numbers | None = None,
    softness: float = 1e-9,
) -> Float[Array, " k"]:
    """Generalised forces that give a link an acceleration (Khatib 1987, A unified approach …, eq. 51).

    With J of the link and M(q) v̇ + b(q, v) = τ,

        τ = Jᵀ Λ (a − J̇ v) + b + (1 − Jᵀ Λ J M⁻¹) τ₀,        Λ = (J M⁻¹ Jᵀ)⁻¹,

    so that what the task leaves free follows τ₀, which does not disturb it.

    Args:
        robot: The robot.
        scene: A scene with it.
        state: Where it is and how it moves.
        link: Name in the file.
        acceleration: a of the link's frame: linear [m/s², W], shape (3,), or linear and angular [rad/s², W],
            shape (6,).
        posture: τ₀ [N, N m], shape (k,). Default: none.
        softness: Share of the mean of J M⁻¹ Jᵀ that is added to it, so that torques stay finite where the
            link cannot move in some direction.

    Raises:
        ValueError: If the link is unknown, a shape is wrong, or `softness` < 0.
    """
    check_arguments(robot, scene, state)
    dtype, k = scene.timestep.dtype, scene.layout.n_velocities
    wanted = checked_floating("acceleration", acceleration)
    if wanted.shape not in ((3,), (6,)):
        raise ValueError(f"acceleration must have shape (3,) or (6,), got {wanted.shape}")
    wanted = checked_array("acceleration", wanted, wanted.shape).astype(dtype)
    free = jnp.zeros(k) if posture is None else checked_array("posture", posture, (k,))
    free = free.astype(dtype)
    checked_number("softness", softness, least=0)
    n, speeds = wanted.shape[0], generalised_velocities(scene, state)
    jacobian = robot.place(scene, state, link)[2][:n]

    def moved(share: Float[Array, ""]) -> Float[Array, " n"]:
        return robot.place(scene, drifted(scene, state, share), link)[2][:n] @ speeds

    zero, one = jnp.zeros((), dtype), jnp.ones((), dtype)
    _, drift = jax.jvp(moved, (zero,), (one,))
    follows = jnp.linalg.solve(mass_matrix(scene, state), jacobian.T)
    mobility = jacobian @ follows
    softer = mobility + softness * jnp.trace(mobility) / n * jnp.eye(n, dtype=dtype)
    force = jnp.linalg.solve(softer, wanted - drift - follows.T @ free)
    return jacobian.T @ force + bias_forces(scene, state) + free
