"""Scenes as tables, and kernels over them as functions of JAX with derivatives."""

from dano.engine.launching._stepping import (
    listed_points as listed_points,
    overlaps as overlaps,
    Report as Report,
    rollout as rollout,
    SolverOptions as SolverOptions,
    wrenches as wrenches,
)
from dano.engine.launching._tables import (
    kernel_builds as kernel_builds,
    knows as knows,
    scene_tables as scene_tables,
    Tables as Tables,
)
