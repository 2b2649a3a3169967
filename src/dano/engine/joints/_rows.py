"""Bodies on joints as rows of numbers, as kernels read them (`dano.engine.kernels.trees.tables`)."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Int

from dano.engine.joints._structure import tree_structure, TreeStructure
from dano.maths import AnyArray, library
from dano.scene import JointLaws, Scene

_SIX = 6


def structure_of_trees(scene: Scene, touching: Iterable[int]) -> TreeStructure:
    """Kinematic trees and loops of a scene.

    Args:
        scene: The scene.
        touching: Bodies that may touch something.
    """
    laws, closing = scene.chains.laws, scene.closing
    loops = ()
    if closing is not None:
        ends = zip(closing.first, closing.second, strict=True)
        loops = tuple((a, b, i in closing.welds) for i, (a, b) in enumerate(ends))
    return tree_structure(scene.layout, laws.constant, laws.rough, frozenset(touching), loops)


def tree_rows(
    scene: Scene, structure: TreeStructure
) -> tuple[dict[str, Float[AnyArray, "rows width"]], dict[str, Int[np.ndarray, "..."]]]:
    """Real and whole numbers by place in a kernel's parameters."""
    dtype, closing = scene.timestep.dtype, scene.closing
    loops = np.zeros((0, 10), dtype)
    if closing is not None:
        of_loops = (closing.position, closing.anchor, closing.orientation)
        loops = library(*of_loops).concatenate(of_loops, axis=1)
    rows = {
        "scene.trees.joints": scene.chains.table.astype(dtype),
        "scene.trees.laws": _law_rows(scene.chains.laws, dtype),
        "scene.trees.loops": loops.astype(dtype),
    }
    whole = {
        "nodes": structure.nodes,
        "coordinates": structure.coordinates,
        "unknowns": structure.unknowns,
        "order": structure.order,
        "columns": structure.columns,
        "blocks": structure.blocks,
        "closed": structure.closed,
        "loop_index": structure.loops,
    }
    return rows, {f"scene.trees.{name}": values for name, values in whole.items()}


def tree_lengths(structure: TreeStructure) -> dict[str, int]:
    """Lengths of the arrays in which a world works on its trees."""
    m, unknowns = len(structure.moving), _SIX * structure.n_blocks
    lengths = {
        **dict.fromkeys(
            ("frames", "displacements", "pivots", "twists", "offsets", "wrenches", "composites"), m
        ),
        **dict.fromkeys(("start", "end"), structure.motions),
        **dict.fromkeys(("diagonal", "column", "spread", "impulses"), unknowns),
        **dict.fromkeys(("lower", "upper"), structure.entries),
        "columns": len(structure.columns),
        **dict.fromkeys(("joints", "q", "v"), len(structure.coordinates)),
        "turned": m,
        "coupled": len(structure.closed),
        "sizes": 4,
    }
    return {f"room.trees.{name}": length for name, length in lengths.items()}


def _law_rows(laws: JointLaws, dtype) -> Float[AnyArray, "c 12"]:
    """What acts on each joint coordinate, see `JointLaws`.

    Damping, armature, stiffness, rest, friction, two limits and five numbers of a motor. What no joint has is
    0, or endless.
    """
    none = np.zeros(laws.damping.shape, laws.damping.dtype)

    def column(values: AnyArray | None) -> AnyArray:
        return (none if values is None else values)[:, None]

    endless = np.broadcast_to(np.array([-np.inf, np.inf]), (none.size, 2))
    endless = endless.astype(dtype)
    limits = endless if laws.limits is None else laws.limits
    motor = laws.motor
    if motor is None:
        motor = np.concatenate([np.zeros((none.size, 3), dtype), endless], axis=1)
    single = (laws.damping, laws.armature, laws.stiffness, laws.rest, laws.friction)
    columns = [*(column(x) for x in single), limits, motor]
    return library(*columns).concatenate(columns, axis=1)
