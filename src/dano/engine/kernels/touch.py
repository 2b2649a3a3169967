"""Where the bodies of a scene touch, and how hard they press on each other in a step that was made."""

import warp as wp

from dano.engine.kernels.impacts import any_hits
from dano.engine.kernels.lanes import total, total3, wait
from dano.engine.kernels.linear_solve import EVERYWHERE
from dano.engine.kernels.patches import contact_of
from dano.engine.kernels.rollout import begin_again, find_touching, Launch, REBOUNDS
from dano.engine.kernels.settled import settle
from dano.engine.kernels.solve import newton_step
from dano.engine.kernels.tables import Room, Scene
from dano.engine.kernels.trees.kinematics import unknown_of
from dano.physics.features import LANES, PATCHES, TREES
from dano.physics.overlap import Patch
from dano.physics.real import ONE, real, vec3, vec6, ZERO
from dano.physics.twists import angular_part, linear_part

_LANES, _REBOUNDS = wp.constant(LANES), wp.constant(REBOUNDS)


@wp.struct
class Overlap:
    """How a pair of `Scene.pair_index` overlaps, as sums over points at depths d, with areas A."""

    volume: real  # Σ A d [m³]
    moment: vec3  # Σ A d x [m⁴, W]
    direction: vec3  # Σ A d n [m³, W]: the direction in which the first body is pushed


@wp.struct
class Wrench:
    """What pushes the first body of a pair of `Scene.pair_index`."""

    force: vec3  # [N, W]
    torque: vec3  # About its centre of mass [N m, W]


@wp.struct
class Seen:
    """What is written, shape (worlds, rows of `Scene.pair_index`)."""

    overlaps: wp.array2d(dtype=Overlap)
    wrenches: wp.array2d(dtype=Wrench)


@wp.func
def overlap_of(room: wp.ref[Room], world: int, first: int, end: int, place: vec3) -> Overlap:
    """Sums over points of a lane, whose arms begin at `place`."""
    found = Overlap()
    for k in range(first, end):
        point = room.points[world, k]
        weight = point.area * wp.max(point.depth, ZERO)
        found.volume += weight
        found.moment += weight * (place + point.arm)
        found.direction += weight * point.normal
    return found


@wp.func
def overlap_of_patch(patch: Patch) -> Overlap:
    """The same of a patch, whose shared mass ψ [kg] stands for the volume."""
    found = Overlap()
    found.volume = patch.overlap
    found.moment = patch.overlap * patch.centroid
    found.direction = patch.overlap * patch.normal
    return found


@wp.func
def wrench_of(impulse: vec6, h: real) -> Wrench:
    """Of an impulse in a step of length h."""
    wrench = Wrench()
    wrench.force = linear_part(impulse) / h
    wrench.torque = angular_part(impulse) / h
    return wrench


@wp.kernel(enable_backward=False)
def touch(scene: Scene, room: Room, launch: Launch, seen: Seen):
    """Overlaps at `launch.state`, in which nothing moves."""
    block, lane = wp.tid()
    world = launch.first_world + block
    begin_again(scene, room, world, lane, launch, 0)
    for p in range(lane, seen.overlaps.shape[1], _LANES):
        seen.overlaps[world, p] = Overlap()
    wait()
    n_found, _n_near, _overflow = find_touching(scene, room, world, lane)
    for f in range(n_found):
        found = room.found[world, f * _LANES + lane]
        place = room.bodies[world, scene.pair_index[found.pair].first].position
        own = overlap_of(room, world, found.first, found.end, place)
        own.volume = total(own.volume)
        own.moment = total3(own.moment)
        own.direction = total3(own.direction)
        if lane == 0:
            seen.overlaps[world, found.pair] = own
    if wp.static(PATCHES):
        for p in range(room.patches.count[world, 0]):
            touching = room.found[world, (n_found + p) * _LANES]
            if lane == 0:
                patch = room.patches.patches[world, contact_of(scene, touching)]
                seen.overlaps[world, touching.pair] = overlap_of_patch(patch)


@wp.func
def misses(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int) -> real:
    """How far Newton's step from the velocities at the end would lead, forces in loops aside [m/s, rad/s]."""
    newton_step(scene, room, world, lane, ONE, False, EVERYWHERE)
    wait()
    found = real(0.0)
    if wp.static(TREES):
        for u in range(scene.trees.unknowns.shape[0]):
            if scene.trees.blocks[u // 6].is_loop == 0:
                found = wp.max(found, wp.abs(unknown_of(room.step, world, u)))
    else:
        for b in range(scene.n_blocks):
            for k in range(6):
                found = wp.max(found, wp.abs(room.step[world, b][k]))
    return found


@wp.func
def settle_with(
    scene: wp.ref[Scene], room: wp.ref[Room], launch: wp.ref[Launch], world: int, lane: int, rebound: real
) -> int:
    """The step at its end, with a share of the restitution; returns the number of pairs that are near."""
    if lane == 0:
        launch.reports[world, 0].rebound = rebound
        for k in range(launch.forces.shape[1]):
            launch.forces[world, k] = vec6()
    wait()
    n_found = settle(scene, room, launch, world, lane, 0)
    wait()
    return n_found


@wp.kernel(enable_backward=False)
def press(scene: Scene, room: Room, launch: Launch, seen: Seen):
    """Wrenches in the step from `launch.state` to `launch.states`.

    With what share of the restitution it was made is not known, nor are its controls and forces in loops: the
    share that fits best is taken.
    """
    block, lane = wp.tid()
    world = launch.first_world + block
    h = scene.timestep[world, 0]
    for p in range(lane, seen.wrenches.shape[1], _LANES):
        seen.wrenches[world, p] = Wrench()
    n_found = settle_with(scene, room, launch, world, lane, ONE)
    if any_hits(room, world, lane, n_found):
        best = misses(scene, room, world, lane)
        chosen = real(1.0)
        attempt = int(1)
        while attempt <= _REBOUNDS:
            rebound = ONE - real(attempt) / real(_REBOUNDS)
            settle_with(scene, room, launch, world, lane, rebound)
            missed = misses(scene, room, world, lane)
            if missed < best:
                best = missed
                chosen = rebound
            attempt += 1
        n_found = settle_with(scene, room, launch, world, lane, chosen)
    if lane == 0:
        for f in range(n_found):
            seen.wrenches[world, room.found[world, f * _LANES].pair] = wrench_of(room.wrenches[world, f], h)
        if wp.static(PATCHES):
            for p in range(room.patches.count[world, 0]):
                touching = room.found[world, (n_found + p) * _LANES]
                impulse = room.patches.wrenches[world, contact_of(scene, touching)]
                seen.wrenches[world, touching.pair] = wrench_of(impulse, h)
