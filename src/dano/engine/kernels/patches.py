"""Contacts with a patch law: the overlaps of a step, and what they add to its equations.

Overlaps are those of the configuration at the start of the step. Three filters, each finer than the one
before, leave out samples that cannot lie in the field: a ball around all of a body, balls around runs of
blocks, and balls around blocks. What touches is listed in `Room.found` behind the pairs with points.
"""

import warp as wp

from dano.engine.kernels.assembly import add_contact, Fit, pair_twist, Trial
from dano.engine.kernels.lanes import total, total3, wait
from dano.engine.kernels.patch_tables import PatchSide, PatchSideIndex
from dano.engine.kernels.tables import BLOCK, FoundPair, Room, RUN, Scene, StateRow
from dano.physics.features import KINDS, LANES, PATCHES
from dano.physics.overlap import (
    added,
    cap_patch,
    Field,
    field_of,
    Frame,
    Patch,
    patch_of,
    sample_sums,
    seen_clearance,
    seen_density,
    Sums,
    sums_in_world,
    View,
    view_of,
)
from dano.physics.pairs import BodyState
from dano.physics.patch_law import (
    fitting_patch_duals,
    following_patch_duals,
    linearized_patch,
    patch_jacobian,
    patch_misfit,
    patch_motion,
    patch_wrench,
    PatchDuals,
    PatchJacobian,
    PatchLinear,
    PatchMotion,
    PatchWrench,
)
from dano.physics.real import mat66, ONE, real, vec3, vec4, vec6, ZERO
from dano.physics.rotations import from_wxyz, matrix
from dano.physics.solids.kinds import HALF_SPACE, SPHERE
from dano.physics.twists import joined, joined_blocks, Twist

_LANES, _BLOCK, _RUN = wp.constant(LANES), wp.constant(BLOCK), wp.constant(RUN)


@wp.func
def frame_of(state: BodyState) -> Frame:
    """Where the frame of a body is at the start of the step."""
    frame = Frame()
    frame.rotation = matrix(state.orientation)
    frame.origin = state.position - frame.rotation * state.com
    return frame


@wp.func(inline=True)
def reaches(scene: Scene, world: int, field: Field, view: View, ball: vec4) -> bool:
    """Whether a ball in the samples' frame may reach to where the density is positive."""
    middle = vec3(ball[0], ball[1], ball[2])
    return seen_clearance(scene.solids, scene.patches.fields, world, field, view, middle) <= ball[3]


@wp.func
def next_block(
    scene: wp.ref[Scene], world: int, index: PatchSideIndex, field: Field, view: View, i: int
) -> int:
    """The first block of a side, from the i-th of a lane on, that may reach; their number where none does."""
    k = int(i)
    searches = bool(True)
    while searches and k < index.blocks:
        b = index.first_block + k
        skipped = bool(False)
        if wp.static(LANES == 1):
            # Where a run of blocks is out of reach, all of them are.
            skipped = k % _RUN == 0 and not reaches(scene, world, field, view, scene.patches.runs[world, b])
        if skipped:
            k += _RUN
        elif reaches(scene, world, field, view, scene.patches.balls[world, b]):
            searches = False
        else:
            k += _LANES
    return k


@wp.func(inline=True)
def sums_of_samples(
    scene: Scene, world: int, lane: int, index: PatchSideIndex, field: Field, view: View
) -> Sums:
    """Sums over the samples of a side, those of a lane only."""
    sums = Sums()
    i = next_block(scene, world, index, field, view, lane)
    while i < index.blocks:
        b = index.first_block + i
        for s in range(_BLOCK * b, _BLOCK * b + _BLOCK):
            sample = scene.patches.samples[world, s]
            found = seen_density(scene.solids, scene.patches.fields, world, field, view, sample.point)
            if found.value > ZERO:
                one = sample_sums(sample, found)
                sums.share += one.share
                sums.moment += one.moment
                sums.direction += one.direction
        i = next_block(scene, world, index, field, view, i + _LANES)
    return sums


@wp.func
def side_field(scene: wp.ref[Scene], world: int, index: PatchSideIndex) -> Field:
    """The field that the samples of a side query."""
    return field_of(scene.solids, scene.patches.fields, world, index.first_part, index.parts)


@wp.func(inline=True)
def reached_sums(
    scene: Scene,
    world: int,
    lane: int,
    side: PatchSide,
    index: PatchSideIndex,
    field: Field,
    sampled: Frame,
    queried: Frame,
) -> Sums:
    """Sums over all samples of a side, zero where the body is out of reach; all lanes know them."""
    own = Sums()
    view = view_of(field, sampled, queried)
    if reaches(scene, world, field, view, vec4(side.middle[0], side.middle[1], side.middle[2], side.radius)):
        own = sums_of_samples(scene, world, lane, index, field, view)
        own.share = total(own.share)
        own.moment = total3(own.moment)
        own.direction = total3(own.direction)
    return own


@wp.func
def side_sign(scene: wp.ref[Scene], c: int, index: PatchSideIndex) -> real:
    """1 where the sampled body is the first of a contact, else −1."""
    return wp.where(index.sampled == scene.patches.contacts[c].first, ONE, -ONE)


@wp.func
def contact_patch(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, c: int) -> Patch:
    """Overlap of the bodies of a contact; all lanes know it."""
    contact = scene.patches.contacts[c]
    patch = Patch()
    sums = Sums()
    weighed = real(0.0)
    for s in range(contact.first_side, contact.first_side + contact.sides):
        side = scene.patches.sides[world, s]
        index = scene.patches.side_index[s]
        field = side_field(scene, world, index)
        sampled = frame_of(room.bodies[world, index.sampled])
        queried = frame_of(room.bodies[world, index.queried])
        mass = scene.bodies[world, index.sampled].mass
        sign = side_sign(scene, c, index)
        weighed += mass
        if index.ball >= 0:
            if wp.static(SPHERE in KINDS and HALF_SPACE in KINDS):
                ball = scene.solids.leaves[world, index.ball]
                patch = cap_patch(ball, field.solid.leaf, sampled, queried, mass)
                patch.normal = sign * patch.normal
        else:
            own = reached_sums(scene, world, lane, side, index, field, sampled, queried)
            if lane == 0 and room.patches.sums.shape[1] > 0:
                room.patches.sums[world, s] = own
            if own.share > ZERO:
                sums = added(sums, sums_in_world(own, sampled, queried, mass * side.density_scale, sign))
    if sums.share > ZERO:
        patch = patch_of(sums, weighed)
    return patch


@wp.func
def find_patches(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, n_found: int) -> int:
    """Overlaps of all contacts with a patch law, in `room.patches`.

    What touches is listed behind `n_found` pairs.

    Returns:
        Number of pairs that are listed now.
    """
    n_near = n_found
    for c in range(scene.patches.contacts.shape[0]):
        patch = contact_patch(scene, room, world, lane, c)
        if lane == 0:
            room.patches.patches[world, c] = patch
        if patch.overlap > ZERO:
            contact = scene.patches.contacts[c]
            first = room.bodies[world, contact.first]
            second = room.bodies[world, contact.second]
            found = FoundPair()
            found.pair = contact.pair
            found.critical = -1
            found.com_difference = first.position - second.position
            room.found[world, n_near * _LANES + lane] = found
            if lane == 0:
                room.patches.arms[world, c] = patch.centroid - first.position
            n_near += 1
    if lane == 0:
        room.patches.count[world, 0] = n_near - n_found
    return n_near


@wp.func
def n_patches(room: wp.ref[Room], world: int) -> int:
    """How many patches touch."""
    n = int(0)
    if wp.static(PATCHES):
        n = room.patches.count[world, 0]
    return n


@wp.func
def contact_of(scene: wp.ref[Scene], found: FoundPair) -> int:
    """Index of the contact of a pair that touches."""
    return scene.pair_index[found.pair].contact


@wp.func
def motion_at_patch(room: wp.ref[Room], world: int, c: int, twist: Twist) -> PatchMotion:
    """Motion at a patch, from the relative twist at the first body's centre of mass."""
    velocity = twist.velocity + wp.cross(twist.spin, room.patches.arms[world, c])
    return patch_motion(room.patches.patches[world, c].normal, velocity, twist.spin)


@wp.func
def fit_patch_duals(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, n_found: int):
    """Duals that fit the accepted velocities."""
    for k in range(lane, room.patches.count[world, 0], _LANES):
        found = room.found[world, (n_found + k) * _LANES + lane]
        c = contact_of(scene, found)
        motion = motion_at_patch(room, world, c, pair_twist(scene, room, world, found, room.velocity, ONE))
        overlap = room.patches.patches[world, c].overlap
        adhesive = scene.patches.contacts[c].adhesive > 0
        material = scene.patches.materials[world, c]
        room.patches.duals[world, c] = fitting_patch_duals(material, overlap, adhesive, motion)
        room.patches.changes[world, c] = PatchDuals()
        room.patches.linear[world, c] = PatchLinear()


@wp.func
def any_sticks(scene: wp.ref[Scene], room: wp.ref[Room], world: int, n_found: int) -> bool:
    """Whether a patch that touches has friction that sticks."""
    found = bool(False)
    for k in range(room.patches.count[world, 0]):
        c = contact_of(scene, room.found[world, (n_found + k) * _LANES])
        found = found or scene.patches.materials[world, c].stiction > ZERO
    return found


@wp.func
def follow_patch_duals(scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, n_found: int):
    """Accept the duals at a share of the last step; find their change along the new one, in `room.step`."""
    for k in range(lane, room.patches.count[world, 0], _LANES):
        found = room.found[world, (n_found + k) * _LANES + lane]
        c = contact_of(scene, found)
        if scene.patches.materials[world, c].stiction > ZERO:
            linear = room.patches.linear[world, c]
            change = motion_at_patch(room, world, c, pair_twist(scene, room, world, found, room.step, ZERO))
            after = following_patch_duals(linear, change)
            duals = PatchDuals()
            duals.slide = linear.slide.value
            duals.drill = linear.drill.value
            duals.roll = linear.roll.value
            changes = PatchDuals()
            changes.slide = after.slide - duals.slide
            changes.drill = after.drill - duals.drill
            changes.roll = after.roll - duals.roll
            room.patches.duals[world, c] = duals
            room.patches.changes[world, c] = changes


@wp.func
def tried_duals(room: wp.ref[Room], world: int, c: int, length: real) -> PatchDuals:
    """Duals of a patch at a share of the step."""
    duals = room.patches.duals[world, c]
    changes = room.patches.changes[world, c]
    duals.slide = duals.slide + length * changes.slide
    duals.drill = duals.drill + length * changes.drill
    duals.roll = duals.roll + length * changes.roll
    return duals


@wp.func
def wrench_about_com(found: PatchWrench, arm: vec3) -> vec6:
    """A wrench at a patch, about the first body's centre of mass."""
    return joined(found.force, found.moment + wp.cross(arm, found.force))


@wp.func
def jacobian_about_com(found: PatchJacobian, arm: vec3) -> mat66:
    """Its derivative by the relative twist there."""
    x = wp.skew(arm)
    moment = found.moment + x * found.force
    return joined_blocks(found.force, -(found.force * x), moment, found.turning - moment * x)


@wp.func
def add_patches(
    scene: wp.ref[Scene], room: wp.ref[Room], world: int, lane: int, n_found: int, trial: Trial, fit: Fit
) -> Fit:
    """Take what patches give from the balance of their bodies, at the velocities that are tried.

    Args:
        scene: The scene.
        room: Where the equations are.
        world: Which world.
        lane: Which lane of it.
        n_found: Number of pairs with points.
        trial: What is tried.
        fit: How well the duals of points fit.

    Returns:
        How well those of points and patches do.
    """
    h = scene.timestep[world, 0]
    m = scene.n_blocks
    n = room.patches.count[world, 0]
    unfit = real(0.0)
    push = real(0.0)
    for k in range(lane, n, _LANES):
        found = room.found[world, (n_found + k) * _LANES + lane]
        c = contact_of(scene, found)
        arm = room.patches.arms[world, c]
        patch = room.patches.patches[world, c]
        material = scene.patches.materials[world, c]
        motion = motion_at_patch(room, world, c, pair_twist(scene, room, world, found, room.tried, ONE))
        duals = tried_duals(room, world, c, trial.length)
        adhesive = scene.patches.contacts[c].adhesive > 0
        linear = linearized_patch(material, patch.overlap, adhesive, motion, duals, trial.friction)
        room.patches.linear[world, c] = linear
        room.patches.wrenches[world, c] = h * wrench_about_com(
            patch_wrench(material, patch.normal, motion, linear), arm
        )
        room.patches.jacobians[world, c] = h * jacobian_about_com(
            patch_jacobian(material, patch.normal, motion, linear), arm
        )
        unfit += h * patch_misfit(material, linear)
        push += h * linear.normal.size
    wait()
    if lane == 0:
        for k in range(n):
            found = room.found[world, (n_found + k) * _LANES]
            c = contact_of(scene, found)
            wrench = room.patches.wrenches[world, c]
            if room.wrenches.shape[1] > 0:
                room.wrenches[world, n_found + k] = wrench
            add_contact(scene, room, world, found, m, wrench, room.patches.jacobians[world, c])
    fit.unfit += total(unfit)
    fit.push += total(push)
    return fit


@wp.kernel(enable_backward=False)
def touch(scene: Scene, room: Room, state: wp.array2d(dtype=StateRow), first_world: int):
    """Overlaps of all contacts with a patch law at a state, in `room.patches.patches`."""
    block, lane = wp.tid()
    world = first_world + block
    if lane == 0:
        for i in range(scene.body_index.shape[0]):
            row = state[world, i]
            body = BodyState()
            body.position = row.position
            body.orientation = from_wxyz(row.orientation)
            body.com = scene.bodies[world, i].com
            room.bodies[world, i] = body
    wait()
    for c in range(scene.patches.contacts.shape[0]):
        patch = contact_patch(scene, room, world, lane, c)
        if lane == 0:
            room.patches.patches[world, c] = patch
