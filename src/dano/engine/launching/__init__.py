"""Scenes as tables, and kernels over them as functions of JAX with derivatives."""

from dano.engine.launching._builds import kernel_builds as kernel_builds
from dano.engine.launching._stepping import listed_points as listed_points, rollout as rollout
from dano.engine.launching._tables import knows as knows, scene_tables as scene_tables, Tables as Tables
from dano.engine.launching._touch import overlaps as overlaps, wrenches as wrenches
