"""Plans: controls that bring bodies to goals, through contact."""

from dano.planning._execution import (
    Execution as Execution,
    follow as follow,
    NEW_PLANS as NEW_PLANS,
    Replan as Replan,
    Replanning as Replanning,
)
from dano.planning._plan import (
    GoalError as GoalError,
    load_controls as load_controls,
    Method as Method,
    METHODS as METHODS,
    Plan as Plan,
    plan as plan,
    PlanOptions as PlanOptions,
)
from dano.planning._problem import gradual as gradual, problem_of as problem_of, softened as softened
from dano.planning._sampling import FIRST_DRAWS as FIRST_DRAWS, SamplingOptions as SamplingOptions
from dano.planning._task import (
    Actuator as Actuator,
    Goal as Goal,
    KINDS as KINDS,
    Limit as Limit,
    QUANTITIES as QUANTITIES,
    Task as Task,
)
