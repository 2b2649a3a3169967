"""Engines: from a scene and a state to the next one, and everything built on that."""

from dano.engine._batches import (
    load_rollouts as load_rollouts,
    Rollouts as Rollouts,
    rollouts as rollouts,
    StoredRollouts as StoredRollouts,
)
from dano.engine._newton import Report as Report
from dano.engine._rollout import (
    AbstractEngine as AbstractEngine,
    contact_patches as contact_patches,
    contact_wrenches as contact_wrenches,
    linearize as linearize,
    simulate as simulate,
    step as step,
    VariationalEngine as VariationalEngine,
)
