"""Many rollouts at once: what they start from, how they are compiled, and where they are kept."""

from dano.compiling import device_mesh as device_mesh, gather as gather, map_rows as map_rows
from dano.engine.batches._rollouts import (
    load_rollouts as load_rollouts,
    RolloutOptions as RolloutOptions,
    Rollouts as Rollouts,
    rollouts as rollouts,
    StoredRollouts as StoredRollouts,
)
