"""Arguments that hypothesis draws: whatever is handed over, it is taken, or refused in one clear line."""

from collections.abc import Iterator

from hypothesis import given, HealthCheck, settings

from tests.fuzz.calls import fields, scenes, verbs
from tests.fuzz.calls.call import Call
from tests.fuzz.judging import judge, Outcome
from tests.fuzz.kinds import SHAPELESS
from tests.fuzz.world import World

EXAMPLES = 12
CHEAP = (
    "Sphere Box Capsule Cylinder Ellipsoid HalfSpace Pose ContactParams CentroidLaw DistributedLaw Contact"
    " Joint Loop Motor MassProperties ContactSamples SurfaceSamples Target Actuator Goal Limit Task"
    " SamplingOptions PlanOptions IdentifyOptions VariationalEngine Parameter Motion.create"
    " Scene.initial_state Scene.control Scene.index posed scaled"
).split()
"""Functions that only check and keep what they are given."""


def tried_drawn(world: World) -> Iterator[Outcome]:
    """Every argument of the cheap functions with values of any kind."""
    parts = (
        fields.PARTS[0],
        fields.PARTS[1],
        fields.PARTS[2],
        *scenes.PARTS[:3],
        verbs.PARTS[1],
        verbs.PARTS[2],
    )
    calls = [call for part in parts for call in part(world) if call.name in CHEAP]
    for call in calls:
        for argument in call.bad:
            yield from _drawn(call, argument)


def _drawn(call: Call, argument: str) -> list[Outcome]:
    found: list[Outcome] = []

    @settings(
        max_examples=EXAMPLES,
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=(HealthCheck.too_slow, HealthCheck.filter_too_much),
    )
    @given(value=SHAPELESS)
    def draw(value: object) -> None:
        case = f"{call.name}({argument}={value!r})"
        arguments = {**call.good, argument: value}
        outcome = judge(case, call.function, arguments, "")
        # What is taken is not a fault: a number drawn by chance may be one that is valid.
        found.append(outcome._replace(verdict="clear") if outcome.verdict == "silently wrong" else outcome)

    draw()
    return found
