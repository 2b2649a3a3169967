"""Contact of bodies on joints: it sees them move by J y + c, and pushes what moves them by Jᵀ."""

import warp as wp

from dano.engine.kernels.tables import Room, Scene
from dano.engine.kernels.trees.factor import add_to_block
from dano.engine.kernels.trees.kinematics import chain_twist
from dano.engine.kernels.trees.pattern import block_at
from dano.physics.real import mat66, real, vec3, vec6
from dano.physics.trees.joints import ROOT
from dano.physics.twists import shift

_ROOT = wp.constant(ROOT)


@wp.func
def free_block(scene: wp.ref[Scene], row: int) -> int:
    """Block of a body that moves freely and carries nothing; −1 for others."""
    node = scene.trees.nodes[row]
    if node.alone == 0:
        return -1
    return node.place // 6


@wp.func
def body_twist(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    row: int,
    velocities: wp.array2d(dtype=vec6),
    offset: real,
) -> vec6:
    """How contact sees a body move: J y + c, or without c.

    Args:
        scene: The scene.
        room: Room.
        world: Which world.
        row: Of the body, −1 for one that does not move.
        velocities: Unknowns of the step.
        offset: 1 with c, 0 without.
    """
    if row < 0:
        return vec6()
    node = scene.trees.nodes[row]
    if node.kind == _ROOT:
        return velocities[world, node.place // 6]
    return offset * room.trees.offsets[world, row] + chain_twist(scene, room, world, node, velocities)


@wp.func
def push_body(scene: wp.ref[Scene], room: wp.ref[Room], world: int, row: int, wrench: vec6):
    """Add Jᵀ of a wrench to the residual."""
    if row >= 0:
        node = scene.trees.nodes[row]
        if node.kind == _ROOT:
            room.residual[world, node.place // 6] += wrench
        else:
            for k in range(node.first_column, node.first_column + node.columns):
                u = scene.trees.columns[k]
                room.residual[world, u // 6][u % 6] += wp.dot(room.trees.columns[world, k], wrench)


@wp.func
def add_slopes(scene: wp.ref[Scene], room: wp.ref[Room], world: int, row: int, other: int, slopes: mat66):
    """Add Jᵀ K J, of two bodies, to the Jacobian; rows may be −1."""
    if row < 0 or other < 0:
        return
    m = scene.n_blocks
    a = scene.trees.nodes[row]
    b = scene.trees.nodes[other]
    if a.kind == _ROOT and b.kind == _ROOT:
        room.blocks[world, block_at(room, world, m, a.place // 6, b.place // 6)] += slopes
    elif a.kind == _ROOT:
        for k in range(b.first_column, b.first_column + b.columns):
            pushed = slopes * room.trees.columns[world, k]
            for c in range(6):
                add_to_block(room, world, m, a.place + c, scene.trees.columns[k], pushed[c])
    else:
        back = wp.transpose(slopes)
        for k in range(a.first_column, a.first_column + a.columns):
            u = scene.trees.columns[k]
            pushed = back * room.trees.columns[world, k]
            if b.kind == _ROOT:
                for c in range(6):
                    add_to_block(room, world, m, u, b.place + c, pushed[c])
            else:
                for j in range(b.first_column, b.first_column + b.columns):
                    own = wp.dot(pushed, room.trees.columns[world, j])
                    add_to_block(room, world, m, u, scene.trees.columns[j], own)


@wp.func
def add_pulled(
    scene: wp.ref[Scene],
    room: wp.ref[Room],
    world: int,
    a: int,
    b: int,
    com_difference: vec3,
    wrench: vec6,
    jacobian: mat66,
):
    """Take a pair's wrench on the first body, and its derivative, from the balance of both bodies.

    Args:
        scene: The scene.
        room: Room.
        world: Which world.
        a: Row of the first body, −1 if it does not move.
        b: Of the second.
        com_difference: From the second body's centre of mass to the first's [m, W].
        wrench: At the first body's centre of mass.
        jacobian: Its derivative by the relative twist there.
    """
    push_body(scene, room, world, a, -wrench)
    add_slopes(scene, room, world, a, a, -jacobian)
    if b >= 0:
        t = shift(com_difference)
        back = wp.transpose(t)
        by_second = jacobian * t
        push_body(scene, room, world, b, back * wrench)
        add_slopes(scene, room, world, b, b, -(back * by_second))
        add_slopes(scene, room, world, a, b, by_second)
        add_slopes(scene, room, world, b, a, back * jacobian)
