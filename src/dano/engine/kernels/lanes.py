"""A world is a block of lanes: one on a CPU, `LANES` on a GPU. Lanes share the samples of their world.

On a CPU sums are plain. Operations on tiles there share one static buffer, and two launches from two threads
would write over each other.

All lanes have to come to each of these functions: conditions around them are those that all lanes find alike.
What a lane writes others may read only after `wait`, and what others may still read it may write only then.
Numbers that lanes sum up are the same in all of them, so that they go the same way.
"""

from typing import Any

import warp as wp

from dano.physics.features import LANES
from dano.physics.real import INFINITY, mat33, mat66, quat, real, vec3, vec4, vec6
from dano.physics.structures import leaf_fields, written

# Beyond all indices.
_NONE = wp.constant(2**31 - 1)


# Sums of a warp are shuffles, which say nothing of memory; and a tile's place may be written again by the
# lane that is through first, while others still read.
@wp.func_native("WP_TILE_SYNC();")
def _barrier(): ...


@wp.func
def total(x: real) -> real:
    """Sum over the lanes of a world."""
    if wp.static(LANES > 1):
        x = wp.tile_sum(wp.tile(x))[0]
        _barrier()
    return x


@wp.func
def total3(x: vec3) -> vec3:
    """Sum over the lanes of a world."""
    if wp.static(LANES > 1):
        x = wp.tile_sum(wp.tile(x, preserve_type=True))[0]
        _barrier()
    return x


@wp.func
def total4(x: vec4) -> vec4:
    """Sum over the lanes of a world."""
    if wp.static(LANES > 1):
        x = wp.tile_sum(wp.tile(x, preserve_type=True))[0]
        _barrier()
    return x


@wp.func
def total33(x: mat33) -> mat33:
    """Sum over the lanes of a world."""
    if wp.static(LANES > 1):
        x = wp.tile_sum(wp.tile(x, preserve_type=True))[0]
        _barrier()
    return x


@wp.func
def total6(x: vec6) -> vec6:
    """Sum over the lanes of a world."""
    if wp.static(LANES > 1):
        x = wp.tile_sum(wp.tile(x, preserve_type=True))[0]
        _barrier()
    return x


@wp.func
def total66(x: mat66) -> mat66:
    """Sum over the lanes of a world."""
    if wp.static(LANES > 1):
        x = wp.tile_sum(wp.tile(x, preserve_type=True))[0]
        _barrier()
    return x


@wp.func
def total_quat(x: quat) -> quat:
    """Sum over the lanes of a world."""
    sums = total4(vec4(x[0], x[1], x[2], x[3]))
    return quat(sums[0], sums[1], sums[2], sums[3])


_TOTALS = {
    real: "total",
    vec3: "total3",
    vec4: "total4",
    quat: "total_quat",
    mat33: "total33",
    vec6: "total6",
    mat66: "total66",
}


def total_of(structure: Any) -> Any:
    """Sum of a structure over the lanes of a world."""
    lines = ["def whole(a: S) -> S:"]
    if LANES > 1:
        lines += [
            f"    a.{name} = {_TOTALS[kind]}(a.{name})" for name, kind in leaf_fields(structure).items()
        ]
    sums = {name: globals()[name] for name in _TOTALS.values()}
    return written(structure, "whole", [*lines, "    return a"], sums)


@wp.func
def least(x: real) -> real:
    """Least of the lanes of a world."""
    if wp.static(LANES > 1):
        x = wp.tile_min(wp.tile(x))[0]
        _barrier()
    return x


@wp.func
def greatest(x: real) -> real:
    """Greatest of the lanes of a world; what is not a number counts as infinite."""
    if wp.static(LANES > 1):
        if wp.isnan(x):
            x = real(INFINITY)
        x = wp.tile_max(wp.tile(x))[0]
        _barrier()
    return x


@wp.func
def first_of(index: int) -> int:
    """Least index that a lane of a world has; −1, which is none, where no lane has one."""
    if wp.static(LANES > 1):
        if index < 0:
            index = _NONE
        index = wp.tile_min(wp.tile(index))[0]
        _barrier()
        if index == _NONE:
            index = -1
    return index


@wp.func
def lanes_where(lane: int, holds: bool) -> wp.uint32:
    """A bit for each lane of a world for which something holds, the lowest for the first."""
    bit = wp.uint32(0)
    if holds:
        bit = wp.uint32(1)
    if wp.static(LANES > 1):
        bit = wp.tile_sum(wp.tile(bit << wp.uint32(lane)))[0]
        _barrier()
    return bit


@wp.func
def wait() -> int:
    """Until all lanes of a world are here, and see what the others wrote."""
    if wp.static(LANES > 1):
        _barrier()
    return 1
