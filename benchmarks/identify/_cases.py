"""Synthetic motions with impacts, whose parameters are known: throws, pushes of the bunny, soap."""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

import dano
from dano.maths import quat_exp, quat_from_axis_angle, quat_multiply
from dano.scene_file import load_asset

TIMESTEP, EVERY = 0.005, 2  # s; steps from frame to frame
POSITION, ROTATION = 1e-3, 1e-2  # m, rad: noise
STILL = {"velocity": 1e-3, "omega": 1e-2}  # m/s, rad/s: what is known of a body that stands
BALL_MASS, BALL_RADIUS, BALL_SPEED = 0.5, 0.03, 0.8  # kg, m, m/s
FLOOR = "floor"


@dataclass(frozen=True)
class Case:
    """A scene with first values, what is not known, the truth, and how motions begin.

    Attributes:
        scene: With first values of the parameters.
        true: With the true ones.
        parameters: What is not known.
        truth: By name.
        n_steps: Of a motion.
        begin: A random initial state of the true scene.
        standing: Bodies that are known to stand in the first frame.
    """

    scene: dano.Scene
    true: dano.Scene
    parameters: tuple[dano.Parameter, ...]
    truth: dict[str, float]
    n_steps: int
    begin: Callable[[np.random.Generator], dano.State]
    standing: tuple[str, ...] = ()

    @property
    def noise(self) -> dict[str, float]:
        """Standard deviations of what is observed."""
        return {"position": POSITION, "orientation": ROTATION, **(STILL if self.standing else {})}


def throws() -> Case:
    """The bunny is thrown on a floor and tumbles; friction and restitution are not known."""
    bunny = dano.Body("bunny", load_asset("bunny"))

    def scene(friction: float, restitution: float) -> dano.Scene:
        params = dano.ContactParams(sliding_friction=friction, restitution=restitution)
        bodies = [bunny, dano.Body(FLOOR, dano.HalfSpace(), fixed=True)]
        return dano.Scene.create(bodies, [dano.Contact("bunny", FLOOR, params)], timestep=TIMESTEP)

    true = scene(0.3, 0.3)

    def begin(rng: np.random.Generator) -> dano.State:
        axis, around = rng.standard_normal(3), rng.uniform(0, 2 * np.pi)
        way = np.array([np.cos(around), np.sin(around), 0])
        return true.initial_state(
            bunny={
                "position": (0, 0, 0.12),
                "orientation": quat_from_axis_angle(axis, rng.uniform(0, np.pi)),
                "velocity": 0.8 * way,
                "omega": 3.0 * rng.standard_normal(3),
            }
        )

    parameters = (
        dano.Parameter("friction", lambda s: s.contact("bunny", FLOOR).sliding_friction, 0.05, 0.8),
        dano.Parameter("restitution", lambda s: s.contact("bunny", FLOOR).restitution, 0.0, 0.8),
    )
    return Case(scene(0.5, 0.5), true, parameters, {"friction": 0.3, "restitution": 0.3}, 80, begin)


def pushes() -> Case:
    """A ball of known mass runs into the bunny that stands; friction and the bunny's mass are not known."""
    made = load_asset("bunny")

    def scene(friction: float, scale: float) -> dano.Scene:
        params = dano.ContactParams(sliding_friction=friction)
        other = dano.ContactParams(sliding_friction=0.2)
        bodies = [
            dano.Body("bunny", made, mass_scale=scale),
            dano.Body("ball", dano.Sphere(BALL_RADIUS), mass=BALL_MASS),
            dano.Body(FLOOR, dano.HalfSpace(), fixed=True),
        ]
        contacts = [
            dano.Contact("bunny", FLOOR, params),
            dano.Contact("bunny", "ball", other),
            dano.Contact("ball", FLOOR, other),
        ]
        return dano.Scene.create(bodies, contacts, timestep=TIMESTEP)

    true = scene(0.25, 1.0)
    standing = _standing(true, 0.09, (1.0, 1.0, 0.0, 0.0))

    def begin(rng: np.random.Generator) -> dano.State:
        around = rng.uniform(0, 2 * np.pi)
        way = np.array([np.cos(around), np.sin(around), 0.0])
        ball = standing[0] - 0.11 * way + 0.01 * rng.standard_normal() * np.array([-way[1], way[0], 0])
        ball[2] = BALL_RADIUS
        return true.initial_state(
            bunny={"position": standing[0], "orientation": standing[1]},
            ball={"position": ball, "velocity": BALL_SPEED * rng.uniform(0.8, 1.5) * way},
        )

    parameters = (
        dano.Parameter("friction", lambda s: s.contact("bunny", FLOOR).sliding_friction, 0.05, 0.8),
        dano.Parameter("mass", lambda s: s.body("bunny").mass_scale, 0.3, 3.0),
    )
    truth = {"friction": 0.25, "mass": 1.0}
    return Case(scene(0.5, 2.0), true, parameters, truth, 60, begin, ("bunny",))


def soap() -> Case:
    """The soap is thrown flat, turning; friction is not known."""
    made = load_asset("soap")

    def scene(friction: float) -> dano.Scene:
        params = dano.ContactParams(sliding_friction=friction)
        bodies = [dano.Body("soap", made), dano.Body(FLOOR, dano.HalfSpace(), fixed=True)]
        return dano.Scene.create(bodies, [dano.Contact("soap", FLOOR, params)], timestep=TIMESTEP)

    true = scene(0.2)

    def begin(rng: np.random.Generator) -> dano.State:
        around = rng.uniform(0, 2 * np.pi)
        return true.initial_state(
            soap={
                "position": (0, 0, 0.03),
                "orientation": quat_from_axis_angle(rng.standard_normal(3), 0.1),
                "velocity": 0.6 * np.array([np.cos(around), np.sin(around), 0]),
                "omega": (*rng.standard_normal(2), 5.0 * rng.standard_normal()),
            }
        )

    parameters = (dano.Parameter("friction", lambda s: s.contact("soap", FLOOR).sliding_friction, 0.02, 0.8),)
    return Case(scene(0.5), true, parameters, {"friction": 0.2}, 80, begin)


CASES = {"throws": throws, "pushes": pushes, "soap": soap}


def _standing(scene: dano.Scene, height: float, turn: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Place and orientation of the bunny after it was set down, the ball far away."""
    start = scene.initial_state(
        bunny={"position": (0, 0, height), "orientation": turn}, ball={"position": (1, 0, BALL_RADIUS)}
    )
    last = dano.simulate(scene, start, 200).states
    return np.array(last.position[-1, 0]), np.array(last.orientation[-1, 0])


def observed(case: Case, seed: int) -> dano.Motion:
    """What a camera sees of a random motion: poses of all bodies that move, with noise, and what stands."""
    rng = np.random.default_rng(seed)
    run = dano.simulate(case.true, case.begin(rng), case.n_steps)
    names = [body.name for body in case.true.bodies if not body.fixed]
    rows = [case.true.index(name) for name in names]
    position = np.array(run.states.position)[::EVERY, rows]
    orientation = run.states.orientation[::EVERY, np.array(rows)]
    turn = ROTATION * rng.standard_normal(position.shape)
    turned = quat_multiply(orientation, quat_exp(jnp.asarray(turn)))
    seen = position + POSITION * rng.standard_normal(position.shape)
    times = np.array(run.times)[::EVERY]
    turned = np.asarray(turned)
    if not case.standing:
        return dano.Motion.create(times, names, position=seen, orientation=turned)
    still = np.full(seen.shape, np.nan)
    still[0, [names.index(name) for name in case.standing]] = 0
    return dano.Motion.create(times, names, position=seen, orientation=turned, velocity=still, omega=still)
