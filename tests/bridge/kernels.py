# pyright: reportInvalidTypeForm=false
"""The functions of the bridge's kernels, one at a time."""

import functools

import mujoco
import numpy as np
import warp as wp

from dano.mujoco._search import BridgeModel, filled, part_of_geom
from dano.mujoco._things import geom_of
from dano.native import Features, instance

FEATURES = Features(KINDS=frozenset(range(7)), DEGREES=frozenset({2}), UNIONS=False)


@functools.cache
def _kernels():
    tables = instance(FEATURES, "dano.mujoco.kernels.tables")
    solids = instance(FEATURES, "dano.mujoco.kernels.solids")
    mixing = instance(FEATURES, "dano.mujoco.kernels.mixing")
    part_distance, part_clearance, of_two = solids.part_distance, solids.part_clearance, mixing.mixed
    vec3, vec4, real = tables.vec3, tables.vec4, tables.real
    known_type, model_type, settings_type = tables.Known, tables.Model, tables.Settings
    options_type = tables.Options

    @wp.kernel(enable_backward=False, module="unique")
    def ask(
        known: known_type,
        model: model_type,
        points: wp.array(dtype=vec3),
        found: wp.array(dtype=vec4),
        bounds: wp.array(dtype=real),
    ):
        i = wp.tid()
        d = part_distance(known, model, known.index[0], points[i])
        found[i] = vec4(d.gradient[0], d.gradient[1], d.gradient[2], d.value)
        bounds[i] = part_clearance(known, model, known.index[0], points[i], real(1e9))

    @wp.kernel(enable_backward=False, module="unique")
    def mix(model: model_type, options: options_type, found: wp.array(dtype=settings_type)):
        found[0] = of_two(model, options, 0, 0, 1)

    return tables, ask, mix


def mixed(model) -> dict[str, np.ndarray]:
    """Parameters of contacts of the first two geoms."""
    tables, _, mix = _kernels()
    found = wp.zeros(1, dtype=tables.Settings, device="cpu")
    wp.launch(mix, 1, [_shown(tables, model), tables.Options(), found], device="cpu")
    row = found.numpy()[0]
    return {name: row[name] for name in row.dtype.names}


def _shown(tables, model):
    """Arrays of a model as kernels read them."""
    arrays = {f"model.{name}": getattr(model, name) for name in tables.Model.vars}
    return filled(tables.Model(), arrays, "model", "cpu")


def distances(model, part, points):
    """Signed distances [m] of a part, their gradients, and lower bounds, at points of its frame (n, 3)."""
    known = BridgeModel([part], np.zeros((0, 2), np.int32), model.geom_size)
    tables, ask, _ = _kernels()
    x = wp.array(np.ascontiguousarray(points, np.float64), dtype=tables.vec3, device="cpu")
    found = wp.zeros(len(points), dtype=tables.vec4, device="cpu")
    bounds = wp.zeros(len(points), dtype=tables.real, device="cpu")
    wp.launch(ask, len(points), [known.structure(), _shown(tables, model), x, found, bounds], device="cpu")
    rows = found.numpy()
    return rows[:, 3], rows[:, :3], bounds.numpy()


def geom_part(model, geom: int = 0):
    """A geom as the search has it."""
    return part_of_geom(0, geom, geom_of(mujoco, model, geom))
