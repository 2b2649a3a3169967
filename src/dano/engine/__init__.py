"""Engines: from a scene and a state to the next one, and everything built on that."""

from dano.compiling import compiled as compiled, compiler_options as compiler_options
from dano.engine._engines import (
    AbstractEngine as AbstractEngine,
    checked_engine as checked_engine,
    marked as marked,
    runs_on as runs_on,
    VariationalEngine as VariationalEngine,
)
from dano.engine._history import (
    contact_history as contact_history,
    contact_patches as contact_patches,
    contact_wrenches as contact_wrenches,
    ContactHistory as ContactHistory,
    Touch as Touch,
)
from dano.engine._rollout import (
    difference as difference,
    held as held,
    linearize as linearize,
    Policy as Policy,
    retract as retract,
    simulate as simulate,
    step as step,
)
from dano.engine.batches import (
    device_mesh as device_mesh,
    gather as gather,
    load_rollouts as load_rollouts,
    map_rows as map_rows,
    RolloutOptions as RolloutOptions,
    Rollouts as Rollouts,
    rollouts as rollouts,
    StoredRollouts as StoredRollouts,
)
from dano.engine.launching import Report as Report
