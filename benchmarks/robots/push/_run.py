"""Step, derivatives and plans of the Panda that pushes the bunny."""

import jax
import jax.numpy as jnp
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
)
from benchmarks.robots.push import _case, panda
from dano.planning import follow

SPEED = "The Panda pushes the bunny, paper's law"
PLANS = "Plans with the torques of its joints, random starts and goals"
CASES = 20
EXECUTED = "These plans carried out in other scenes"
PLANTS = "a quarter of the step", "the same and 10 % more friction"
EVERY = 5  # steps between new plans


def run() -> None:
    """Measure, print and report."""
    arguments = parse_arguments("The Panda pushes the bunny with torques of its joints.")
    load, path = load_average(), panda()
    if path is None:
        rows = [skipped(SPEED, "all of it", "the package frax, which ships the Panda, is not installed")]
    else:
        robot, scene = _case.scene(path)
        rest, push = _case.rested(), _case.pusher(robot, scene)
        cases = [
            _case.case(robot, scene, push, rest, seed) for seed in range(1 if arguments.quick else CASES)
        ]
        rows = _speed_rows(scene, cases[0], 3 if arguments.quick else 15)
        if not arguments.quick:
            plants = [
                _case.scene(path, _case.TIMESTEP / 4, friction)[1]
                for friction in (_case.FRICTION, 1.1 * _case.FRICTION)
            ]
            rows += _plan_rows(scene, plants, cases)
    settings = {"timestep": _case.TIMESTEP, "steps": _case.N_STEPS, "quick": arguments.quick}
    report("robots-push", rows, settings, load, arguments.json)


def _speed_rows(scene: dano.Scene, given: _case.Case, repeats: int) -> list[Row]:
    """A step of the push, and its derivatives by state and controls where the tool touches."""
    controls = jax.vmap(lambda effort: dano.joint_control(scene, effort))(jnp.asarray(given.guess))

    def rollout(state):
        return dano.simulate(scene, state, controls=controls).states

    run, to_compile = compiled(rollout, given.state)
    states = jax.tree.map(lambda x: x[:-1], run(given.state))

    def derivatives(states):
        return jax.lax.map(lambda each: dano.linearize(scene, *each), (states, controls))

    slopes, to_differentiate = compiled(derivatives, states)
    calls = {"step": lambda: run(given.state), "A and B": lambda: slopes(states)}
    times = time_in_turn(calls, repeats)
    step, both = (summary(1e6 * times[name] / _case.N_STEPS)[0] for name in calls)
    return [
        Row(SPEED, "a step", step, "µs", 150),
        Row(SPEED, "A and B", both, "µs", 300),
        Row(SPEED, "a rollout, to compile", to_compile, "s", 10),
        Row(SPEED, "A and B, to compile", to_differentiate, "s", 10),
    ]


def _plan_rows(scene: dano.Scene, plants: list[dano.Scene], cases: list[_case.Case]) -> list[Row]:
    """Errors and times of plans; the first one is made twice, because compilation is in its time.

    They are carried out in other scenes, with and without new plans on the way. These know the step of the
    scene, which the first of `plants` has, but not its friction.
    """
    warm = dano.plan(scene, cases[0].state, cases[0].task, controls=cases[0].guess)
    made, executed, renewed, waited = [], [], [], []
    for case in cases:
        plan = dano.plan(scene, case.state, case.task, controls=case.guess)
        made.append(plan)
        given = case.state, case.task, plan
        runs = [follow(plant, *given, feedback=False) for plant in plants]
        executed.append([run.goals[0].error for run in runs])
        runs = [
            follow(plant, *given, replanning=dano.Replanning(plants[0], EVERY), feedback=False)
            for plant in plants
        ]
        renewed.append([max(goal.error for goal in run.goals) for run in runs])
        waited += [replan.seconds for run in runs for replan in run.replans]
        print(round(plan.seconds, 1), plan.message, executed[-1], renewed[-1], flush=True)
    errors = np.array([[goal.error for goal in plan.goals] for plan in made])
    seconds = np.array([plan.seconds for plan in made])
    n, near = len(errors), float((errors.max(axis=1) <= _case.NEAR).sum())
    rows = [
        Row(PLANS, "bunny and tool within 2 cm", near, f"of {n}", 0.9 * n, at_least=True),
        Row(PLANS, "bunny's error, median", 1e3 * float(np.median(errors[:, 0])), "mm"),
        Row(PLANS, "bunny's error, largest", 1e3 * float(errors[:, 0].max()), "mm"),
        Row(PLANS, "tool's error, largest", 1e3 * float(errors[:, 1].max()), "mm"),
        Row(PLANS, "time of a plan, median", float(np.median(seconds)), "s"),
        Row(PLANS, "time of a plan, longest", float(seconds.max()), "s", 300),
        Row(PLANS, "the first plan, with compilation", warm.seconds, "s"),
    ]
    for words, open_loop, new in zip(PLANTS, np.array(executed).T, np.array(renewed).T, strict=True):
        within = float((new <= _case.NEAR).sum())
        rows += [
            Row(EXECUTED, f"{words}: bunny's error, median", 1e3 * float(np.median(open_loop)), "mm"),
            Row(EXECUTED, f"{words}, with new plans: within 2 cm", within, f"of {n}", n, at_least=True),
            Row(EXECUTED, f"{words}, with new plans: largest error", 1e3 * float(new.max()), "mm"),
        ]
    return [*rows, Row(EXECUTED, "time of a new plan, median", float(np.median(waited)), "s")]
