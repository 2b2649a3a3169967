"""Scenes as tables, and kernels over them as functions of JAX with derivatives."""

from dano.engine.launching._instances import Features as Features, instance as instance
from dano.engine.launching._leaves import kind_numbers as kind_numbers, lower_bounds as lower_bounds
from dano.engine.launching._stepping import listed_points as listed_points, rollout as rollout
from dano.engine.launching._tables import knows as knows, scene_tables as scene_tables, Tables as Tables
from dano.engine.launching._touch import overlaps as overlaps, wrenches as wrenches
from dano.engine.launching._warp import compiled_kernel as compiled_kernel
