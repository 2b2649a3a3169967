"""Scenes for kernels, without an engine around them: structures filled with arrays of NumPy."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from dano.engine.launching._patch_tables import patch_pairs, patch_tables
from dano.native import Features, instance, leaf_tables

# What the tests need, so that each module is compiled once for all of them.
FEATURES = Features(
    KINDS=frozenset(range(8)),
    DEGREES=frozenset({2, 3}),
    UNIONS=True,
    TREES=False,
)
_MODULES = {"engine.kernels": ("tables", "rollout", "patches"), "physics": ("patch_law", "overlap", "real")}
KERNELS = SimpleNamespace(
    **{
        name: instance(FEATURES, f"dano.{package}.{name}")
        for package, names in _MODULES.items()
        for name in names
    }
)
_EPSILON = float(np.finfo(float).eps)


class Arguments:
    """A scene with contacts of patch laws, and room for it.

    Arrays that a test does not fill have no rows.
    """

    def __init__(self, pairs, bodies, moving=(), gravity=(0.0, 0.0, 0.0), timestep=0.01):
        """The arguments of kernels.

        Args:
            pairs: Of `patch_pairs`, or made of colliders.
            bodies: Mass [kg], inertia [kg m²] and centre of mass [m] of each, shape (n, 13).
            moving: Which of them move.
            gravity: [m/s²].
            timestep: [s].
        """
        tables, n, m = patch_tables(pairs, float), len(bodies), len(moving)
        leaves = leaf_tables(tables.leaves, float)
        self.scene, self.room = KERNELS.tables.Scene(), KERNELS.tables.Room()
        self.scene.n_blocks = m
        self.kept: list[np.ndarray] = []
        empty(self.scene)
        empty(self.room)
        index = np.zeros((n, 8))
        index[:, 0] = [moving.index(i) if i in moving else -1 for i in range(n)]
        filled = {
            "scene.bodies": np.concatenate([bodies, np.ones((n, 7))], axis=1),
            "scene.body_index": index,
            "scene.moving": moving,
            "scene.gravity": [gravity],
            "scene.timestep": [[timestep]],
            "scene.pair_index": tables.pair_index,
            "scene.solids.leaves": leaves.rows,
            "scene.solids.kinds": leaves.kinds,
            "scene.solids.coefficients": leaves.coefficients,
            **tables.rows,
            **tables.whole,
        }
        for place, rows in filled.items():
            self.put(place, rows)
        of_moving = "momentum inertia meetings velocity tried best step residual scale".split()
        of_rows = (
            "order counts neighbours degrees islands members of_islands begins ends rests asleep".split()
        )
        lengths = {
            **dict.fromkeys(("bodies", "partners", "sizes"), n),
            **dict.fromkeys(("found", "sorted_pairs"), len(pairs)),
            **dict.fromkeys((*of_moving, *of_rows), m),
            **dict.fromkeys(("used", "later", "beside", "listed"), m * m),
            **dict.fromkeys(("blocks", "spare"), m * m + 1),
            "lasting": 1,
        }
        give_room(self.room, lengths)
        of_contacts = dict.fromkeys(self.room.patches._cls.vars, len(pairs))
        give_room(self.room.patches, {**of_contacts, "count": 1, "sums": 0})

    @classmethod
    def of_scene(cls, scene):
        """Those of a scene."""
        rows = [
            np.concatenate(
                [[b.mass * b.mass_scale], np.ravel(b.inertia * b.mass_scale), b.com + b.com_offset]
            )
            for b in scene.bodies
        ]
        options = {"gravity": np.asarray(scene.gravity), "timestep": float(scene.timestep)}
        return cls(patch_pairs(scene), np.stack(rows), list(scene.layout.moving), **options)

    def put(self, place, rows):
        """Fill the array at a place such as "scene.bodies"."""
        *path, field = place.split(".")
        owner: Any = self
        for name in path:
            owner = getattr(owner, name)
        kind = owner._cls.vars[field].type
        rows = np.ascontiguousarray(rows, np.float64 if kind.ndim == 2 else np.int32)
        self.kept.append(rows)
        if len(rows):
            shape = (1, len(rows)) if kind.ndim == 2 else (len(rows),)
            setattr(owner, field, wp.array(ptr=rows.ctypes.data, dtype=kind.dtype, shape=shape, device="cpu"))


def empty(structure):
    """Arrays without rows, in all places of a structure."""
    for field, variable in structure._cls.vars.items():
        kind = variable.type
        if not hasattr(kind, "ndim"):
            if hasattr(kind, "vars"):
                empty(getattr(structure, field))
        else:
            setattr(structure, field, wp.zeros((1, 0)[-kind.ndim :], dtype=kind.dtype, device="cpu"))


def give_room(structure, lengths):
    """Give arrays of a structure room for one world, by their names."""
    for field, length in lengths.items():
        kind = structure._cls.vars[field].type
        setattr(structure, field, wp.zeros((1, length), dtype=kind.dtype, device="cpu"))


def touch(arguments, state):
    """Overlaps at a state, rows (position, orientation, velocity, omega)."""
    rows = np.ascontiguousarray(state, np.float64)
    array = wp.array(ptr=rows.ctypes.data, dtype=KERNELS.tables.StateRow, shape=(1, len(rows)), device="cpu")
    wp.launch(KERNELS.patches.touch, (1, 1), [arguments.scene, arguments.room, array, 0], device="cpu")
    return arguments.room.patches.patches.numpy()[0]


def rollout(arguments, state, n_steps):
    """States at the ends of steps, and their reports."""
    rows = np.ascontiguousarray(state, np.float64)
    tables, n = KERNELS.tables, len(rows)
    launch = KERNELS.rollout.Launch()
    launch.state = wp.array(ptr=rows.ctypes.data, dtype=tables.StateRow, shape=(1, n), device="cpu")
    launch.pushes = wp.zeros((1, 0), dtype=tables.Push, device="cpu")
    launch.states = wp.zeros((1, n_steps * n), dtype=tables.StateRow, device="cpu")
    launch.reports = wp.zeros((1, n_steps), dtype=tables.StepReport, device="cpu")
    launch.n_steps, launch.first_world = n_steps, 0
    options = launch.options
    options.tolerance, options.rounding, options.fit = _EPSILON**0.75, _EPSILON, _EPSILON**0.375
    options.max_passes = 500
    wp.launch(KERNELS.rollout.rollout, (1, 1), [arguments.scene, arguments.room, launch], device="cpu")
    return launch.states.numpy()[0].reshape(n_steps, n), launch.reports.numpy()[0]
