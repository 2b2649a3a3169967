"""A world is a block of lanes: one on a CPU, `LANES` on a GPU. Lanes share the samples of their world.

On a CPU sums are plain. Operations on tiles there share one static buffer, and two launches from two threads
would write over each other.
"""

import warp as wp

from dano.physics.features import LANES
from dano.physics.real import mat33, mat66, real, vec3, vec4, vec6


@wp.func
def total(x: real) -> real:
    """Sum over the lanes of a world."""
    if wp.static(LANES > 1):
        x = wp.tile_sum(wp.tile(x))[0]
    return x


@wp.func
def total3(x: vec3) -> vec3:
    """Sum over the lanes of a world."""
    if wp.static(LANES > 1):
        x = wp.tile_sum(wp.tile(x, preserve_type=True))[0]
    return x


@wp.func
def total4(x: vec4) -> vec4:
    """Sum over the lanes of a world."""
    if wp.static(LANES > 1):
        x = wp.tile_sum(wp.tile(x, preserve_type=True))[0]
    return x


@wp.func
def total33(x: mat33) -> mat33:
    """Sum over the lanes of a world."""
    if wp.static(LANES > 1):
        x = wp.tile_sum(wp.tile(x, preserve_type=True))[0]
    return x


@wp.func
def total6(x: vec6) -> vec6:
    """Sum over the lanes of a world."""
    if wp.static(LANES > 1):
        x = wp.tile_sum(wp.tile(x, preserve_type=True))[0]
    return x


@wp.func
def total66(x: mat66) -> mat66:
    """Sum over the lanes of a world."""
    if wp.static(LANES > 1):
        x = wp.tile_sum(wp.tile(x, preserve_type=True))[0]
    return x


@wp.func
def least(x: real) -> real:
    """Least of the lanes of a world."""
    if wp.static(LANES > 1):
        x = wp.tile_min(wp.tile(x))[0]
    return x


@wp.func
def wait() -> int:
    """Until all lanes of a world are here, and see what the others wrote."""
    if wp.static(LANES > 1):
        return wp.tile_sum(wp.tile(1))[0]
    return 1
