"""The paper's push-and-slide: a ball pushes the bunny to a goal (Sec. V-C).

The authors' scene and units; starts and goals are random around theirs. As in their program a goal is where a
push by a spring and a damper brings the bunny, moved sideways, here by a random length up to theirs.
"""

import time
import warnings
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import dano
from benchmarks._subjects import authors_bunny
from dano.maths import quat_from_axis_angle, quat_multiply
from dano.planning import Actuator, follow, Goal, Plan, PlanOptions, SamplingOptions, Task

TIMESTEP, N_STEPS, PUSH_STEPS = 0.02, 60, 160
FRICTION, RADIUS, BALL_MASS = 0.05, 0.25, 10.0
BUNNY, TURN, BALL = (1.12, -0.47, 0.30), (0.72, 0.692, -0.023, 0.033), (2.0, -0.5, RADIUS)
TARGET = (0.0, -0.5, 0.5)
SPRING, DAMPER = 50.0, 15.0  # N/m, N s/m: 1 x and 0.3 v as impulses of a step
SIDEWAYS = 1.0  # m
SPREAD, YAW = 0.15, 0.5  # m, rad: half-widths of starts and targets
FORCE, TORQUE = 300.0, 50.0  # bounds
FIRST_PUSH = 50.0  # N
NEAR = 0.01  # m: 1 % of the bunny's size
WITHIN = 0.005  # m, of a component


class Push(eqx.Module):
    """Draws the ball to a target."""

    target: Float[Array, "3"]

    def __call__(self, state: dano.State, time: Float[Array, ""]) -> dano.Control:
        """Force on the ball [N]."""
        force = SPRING * (self.target - state.position[1]) - DAMPER * state.velocity[1]
        zero = jnp.zeros((3, 3))
        return dano.Control(zero.at[1].set(force), zero)


def scene(bunny: dano.NeuralObject, timestep: float = TIMESTEP, friction: float = FRICTION) -> dano.Scene:
    """Bunny, ball and floor with the authors' constants."""
    params = dano.ContactParams(sliding_friction=friction, spring=3e4, damper=3e5, sliding_drag=0.1)
    bodies = [
        dano.Body("bunny", bunny),
        dano.Body("ball", dano.Sphere(RADIUS), mass=BALL_MASS),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    pairs = [("bunny", "floor"), ("bunny", "ball"), ("ball", "floor")]
    contacts = [dano.Contact(a, b, params, dano.CentroidLaw()) for a, b in pairs]
    return dano.Scene.create(bodies, contacts, timestep=timestep)


@dataclass(frozen=True)
class Case:
    """A start, a task and a first guess."""

    state: dano.State
    task: Task
    guess: Float[np.ndarray, "T m"]


def case(planned: dano.Scene, seed: int) -> Case:
    """A random start and goal; seed 0 is the authors'."""
    rng = np.random.default_rng(seed)
    spread = SPREAD if seed else 0.0
    draw = rng.uniform(-1, 1, (3, 2))
    yaw = (YAW if seed else 0.0) * rng.uniform(-1, 1)
    aside = SIDEWAYS * (rng.uniform() if seed else 1.0)
    turn = quat_multiply(quat_from_axis_angle((0.0, 0.0, 1.0), yaw), jnp.array(TURN))
    bunny, ball, target = (np.array(x) for x in (BUNNY, BALL, TARGET))
    for place, shift in zip((bunny, ball, target), spread * draw, strict=True):
        place[:2] += shift
    state = planned.initial_state(bunny={"position": bunny, "orientation": turn}, ball={"position": ball})
    pushed = dano.simulate(planned, state, PUSH_STEPS, controls=Push(jnp.asarray(target))).states.position[-1]
    goals = {"bunny": np.asarray(pushed[0]) + (0, aside, 0), "ball": np.asarray(pushed[1])}
    task = Task(
        N_STEPS,
        [
            Actuator("ball", "force", limit=FORCE, cost=4e-5),
            Actuator("ball", "torque", limit=TORQUE, cost=1e-3),
        ],
        [Goal(name, position=at, running=1.0, final=0.2, within=WITHIN) for name, at in goals.items()],
    )
    guess = np.zeros((N_STEPS, 6))
    away = bunny[:2] - ball[:2]
    guess[:, :2] = FIRST_PUSH * away / np.linalg.norm(away)
    return Case(state, task, guess)


@dataclass(frozen=True)
class Outcome:
    """What came of one case; errors in metres.

    Attributes:
        seed: Of the case.
        reached: Whether bunny and ball come within 1 cm, with controls in bounds.
        bunny: Distance of the bunny from its goal in the plan.
        ball: Of the ball.
        seconds: Time of the plan.
        iterations: Of iLQR.
        message: Why it ended.
        finer: The bunny's error when the plan is executed at h/4, without feedback.
        rougher: At h/4 with 10 % more friction, without feedback.
        held: As `rougher`, with the plan's feedback.
        mpc: As `rougher`, with new plans on the way. They know the plant's step, not its friction.
        mpc_seconds: Time of one of these, the median.
        mpc_longest: The longest.
        sampled: The bunny's and the ball's larger error from CEM in the same time; None if not tried.
    """

    seed: int
    reached: bool
    bunny: float
    ball: float
    seconds: float
    iterations: int
    message: str
    finer: float
    rougher: float
    held: float
    mpc: float
    mpc_seconds: float
    mpc_longest: float
    sampled: float | None


EVERY = 6  # steps between new plans


def outcome(
    seed: int, planned: dano.Scene, plants: tuple[dano.Scene, dano.Scene], *, baseline: bool
) -> Outcome:
    """Plan one case, and execute the plan in two other scenes: finer, and finer with more friction."""
    given = case(planned, seed)
    made = dano.plan(planned, given.state, given.task, controls=given.guess)
    finer, rougher = plants
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        runs = [
            follow(plant, given.state, given.task, made, feedback=feedback).goals[0].error
            for plant, feedback in ((finer, False), (rougher, False), (rougher, True))
        ]
        mpc = follow(
            rougher, given.state, given.task, made, replanning=dano.Replanning(finer, EVERY), feedback=False
        )
    replans = sorted(replan.seconds for replan in mpc.replans)
    return Outcome(
        seed,
        reached=bool(max(goal.error for goal in made.goals) <= NEAR and _in_bounds(made, given.task)),
        bunny=made.goals[0].error,
        ball=made.goals[1].error,
        seconds=made.seconds,
        iterations=made.solution.iterations if made.solution is not None else 0,
        message=made.message,
        finer=runs[0],
        rougher=runs[1],
        held=runs[2],
        mpc=mpc.goals[0].error,
        mpc_seconds=replans[len(replans) // 2],
        mpc_longest=replans[-1],
        sampled=_sampled(planned, given, made.seconds) if baseline else None,
    )


def _sampled(planned: dano.Scene, given: Case, seconds: float) -> float:
    """The larger error that CEM leaves in the same time."""
    sampling = SamplingOptions(passes=200, max_seconds=seconds, price=1e2, last_price=1e5)
    options = PlanOptions(sampling=sampling)
    found = dano.plan(planned, given.state, given.task, method="cem", controls=given.guess, options=options)
    return max(goal.error for goal in found.goals)


def _in_bounds(made: Plan, task: Task) -> bool:
    lower, upper = task.bounds()
    return bool(np.all((made.values >= lower) & (made.values <= upper)))


def outcomes(seeds: range, *, baseline: bool, say) -> list[Outcome]:
    """All cases; the first is run twice, so that none of the times has compilation in it."""
    subject = authors_bunny()
    assert subject is not None
    planned = scene(subject.bunny)
    plants = scene(subject.bunny, TIMESTEP / 4), scene(subject.bunny, TIMESTEP / 4, 1.1 * FRICTION)
    began = time.perf_counter()
    outcome(seeds[0], planned, plants, baseline=baseline)
    say(f"compiled and ran once in {time.perf_counter() - began:.0f} s")
    found = []
    for seed in seeds:
        found.append(outcome(seed, planned, plants, baseline=baseline))
        say(found[-1])
    return found
