"""A drawer that is a neural object: pulled open by a planned force, and by its joint's effort."""

import dano
from benchmarks._measure import Row
from dano.planning import Actuator, Goal, Limit, Plan, Task
from dano.scene_file import load_asset

TRAVEL = 0.2  # m
N_STEPS, TIMESTEP = 50, 0.02
FORCE = 4.0  # N


def scene() -> dano.Scene:
    """The shipped soap on a slide along x, with damping."""
    drawer = dano.Body("drawer", load_asset("soap"))
    slide = dano.Joint(None, "drawer", "slide", axis=(1, 0, 0), position=(0, 0, 0.1), damping=2.0)
    return dano.Scene.create([drawer], joints=[slide], timestep=TIMESTEP)


def task(kind: str, share: float = 0.9) -> Task:
    """Open a share of the travel, not more on the way, and come to rest."""
    axes = {} if kind == "effort" else {"axes": "x"}
    return Task(
        N_STEPS,
        [Actuator("drawer", kind, limit=FORCE, cost=1e-2, **axes)],
        [Goal("drawer", q=share * TRAVEL, within=1e-4), Goal("drawer", v=0.0, within=1e-3)],
        [Limit("drawer", "q", lower=-1e-3, upper=TRAVEL)],
    )


def solved(kind: str) -> Plan:
    """The plan."""
    given = scene()
    return dano.plan(given, given.initial_state(), task(kind))


def rows(group: str) -> list[Row]:
    """Share of the travel at the end, by force and by effort."""
    found = []
    for kind in ("force", "effort"):
        made = solved(kind)
        q = made.trajectory.states.q
        assert q is not None
        opened = 100 * float(q[-1, 0]) / TRAVEL
        word = "by a force" if kind == "force" else "by the joint's effort"
        note = f"{made.seconds:.1f} s with compilation"
        found.append(Row(group, f"opened {word}", opened, "%", 80.0, True, note=note))
    return found
