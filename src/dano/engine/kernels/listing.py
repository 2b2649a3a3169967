"""The point contacts of a step as rows of numbers: for those who look at contact (docs/theory/contact.md)."""

import warp as wp

from dano.engine.kernels.lanes import wait
from dano.engine.kernels.rollout import begin_again, Launch
from dano.engine.kernels.search import find_contacts
from dano.engine.kernels.tables import Room, Scene
from dano.physics.features import LANES
from dano.physics.impacts import fading_in, is_hit
from dano.physics.real import real
from dano.physics.samples import Point

_LANES = wp.constant(LANES)


@wp.struct
class ListedPoint:
    """A point contact, see `dano.physics.samples.Point`, and where it was found; no area where there is none.

    Attributes:
        first: Index of the body that the point lies on.
        second: Index of the body that it presses on.
        contact: Index of the contact.
        sample: Index of the sample.
        share: Share of the step after which geometry was taken.
        impact_share: β of an impact.
        impact_stiffness: κ w of an impact [Pa s/m].
        point: The point.
    """

    first: real
    second: real
    contact: real
    sample: real
    share: real
    impact_share: real
    impact_stiffness: real
    point: Point


@wp.struct
class Listing:
    """What is written: points, shape (worlds, capacity), and whether there were more, shape (worlds, 1)."""

    points: wp.array2d(dtype=ListedPoint)
    overflow: wp.array2d(dtype=real)


@wp.kernel(enable_backward=False)
def listing(scene: Scene, room: Room, launch: Launch, listing: Listing):
    """The points that may press within a step from `launch.state`."""
    block, lane = wp.tid()
    world = launch.first_world + block
    begin_again(scene, room, world, lane, launch, 0)
    n_found, overflow = find_contacts(scene, room, world, lane)
    wait()
    # Lists of lanes stand one after the other in the room, and without gaps among the rows.
    per_lane = room.points.shape[1] // _LANES
    shift = int(0)
    count = int(0)
    if n_found > 0:
        for l in range(_LANES):
            used = room.found[world, (n_found - 1) * _LANES + l].end - l * per_lane
            count += used
            if l < lane:
                shift += used
    overflow = overflow or count > listing.points.shape[1]
    if lane == 0:
        listing.overflow[world, 0] = wp.where(overflow, real(1.0), real(0.0))
    for k in range(lane, listing.points.shape[1], _LANES):
        listing.points[world, k] = ListedPoint()
    wait()
    for f in range(n_found):
        found = room.found[world, f * _LANES + lane]
        index = scene.pair_index[found.pair]
        for k in range(found.first, found.end):
            row = ListedPoint()
            row.first = real(index.first)
            row.second = real(index.second)
            row.contact = real(index.number)
            row.sample = real(room.where[world, k].sample)
            row.share = found.share
            row.impact_share = found.impact.share
            row.point = room.points[world, k]
            bounce = scene.materials[world, index.contact].bounce
            weight = fading_in(row.point.sunk / found.impact.depth)
            weight *= is_hit(row.point.approach, bounce, found.impact.rests)
            row.impact_stiffness = weight * found.impact.part * found.impact.stiffness
            at = shift + k - lane * per_lane
            if at < listing.points.shape[1]:
                listing.points[world, at] = row
