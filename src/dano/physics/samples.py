"""What a sample of a surface is to the solid of another body (docs/theory/contact.md, "Finding contact")."""

import warp as wp

from dano.physics.features import WIDE
from dano.physics.impacts import smooth_step
from dano.physics.pairs import AXIS, BALL, FIXED, PairPose
from dano.physics.real import HALF, ONE, real, vec3, ZERO
from dano.physics.solids.leaves import Distance

_FIXED = wp.constant(FIXED)
_AXIS = wp.constant(AXIS)
_BALL = wp.constant(BALL)
# A sample faces the other way if its normal and that of the solid differ by less than 60°: the cosine.
_TURNED = wp.constant(real(0.5))
# Cosines of the angles between where a round body faces a solid and the solid's normal at a sample: up to 15°
# the sample is on a face, from 30° on it is at an edge.
_ON_FACE, _ON_EDGE = wp.constant(real(0.9659258262890683)), wp.constant(real(0.8660254037844387))
# Component of a normal along the axis below which it belongs to the side of a cylinder.
_ROUND = wp.constant(real(1e-6))
# A number whose inverse is finite.
_TINY = wp.constant(real(1e-300 if WIDE else 1e-36))


@wp.struct
class Sample:
    """A sample of a surface: where it is [m, F] and its vector area [m², F]."""

    point: vec3
    area: vec3


@wp.struct
class Point:
    """A point contact of the first body with the second, in world axes.

    Geometry is that of the predicted configuration, moved back along with the first body's centre of mass, so
    that forces act on one line for both bodies.
    """

    arm: vec3  # From the first body's centre of mass to the point [m]
    normal: vec3  # Unit normal out of the second body, toward the first
    # Moment of a unit pressure about the first body's centre of mass [m]: arm × normal, without what a body
    # that rolls on a smooth surface would feel of single samples.
    moment: vec3
    # What is added to the slip [m/s]: the part along the surface of half the change of the point's velocity
    # within the step, for samples that keep facing the second body.
    extra_slip: vec3
    depth: real  # Below the second body's surface at the end of the step if nothing moved in it [m]
    rate: real  # Separating speed at the old velocities [m/s]
    approach: real  # Separating speed with which the step begins [m/s]
    meets: real  # Separating speed in the predicted configuration [m/s]
    gains_after: vec3  # What its velocity at the end of the step gains from then on if it falls [m/s]
    area: real  # That faces the second body [m²]
    # Depth below the second body's surface in the predicted configuration [m], zero for a sample that faces
    # the other way.
    sunk: real


@wp.func
def solid_normal(gradient: vec3) -> vec3:
    """Unit normal; far below the surface of a sampled distance the gradient may vanish."""
    return gradient / wp.sqrt(wp.max(wp.dot(gradient, gradient), real(1e-12)))


@wp.func
def round_normal(pose: PairPose, sample: Sample, turning: int, normal: vec3) -> vec3:
    """Normal where a ball, or the side of what turns about an axis, presses on an edge.

    Inside a solid the nearest side changes from one face of an edge to the other, so a row of samples that
    faces the edge would be held in a notch. An edge has all normals between those of its faces: there the
    normal of the round surface counts. On a face the solid has that of where the round body faces it.

    Args:
        pose: The pair of bodies.
        sample: The sample.
        turning: How samples turn with their body.
        normal: Of the solid.
    """
    own = -(pose.vectors * sample.area)
    own = own / wp.sqrt(wp.max(wp.dot(own, own), _TINY))
    front = vec3(ZERO, ZERO, -ONE)
    if turning == _AXIS:
        if wp.abs(wp.dot(own, pose.axis)) > _ROUND:
            return normal
        front = vec3(ONE, ZERO, ZERO)
    front = pose.vectors * front
    cosine = -wp.dot(front, normal) / wp.length(front)
    share = smooth_step((_ON_FACE - cosine) / (_ON_FACE - _ON_EDGE))
    if share == ZERO:
        return normal
    mixed = normal + share * (own - normal)
    return mixed / wp.sqrt(wp.dot(mixed, mixed))


@wp.func
def position_in_solid(pose: PairPose, point: vec3) -> vec3:
    """Where a sample is in the frame of the solid [m]."""
    return pose.points * point + pose.origin


@wp.func
def facing_area(pose: PairPose, sample: Sample, normal: vec3) -> real:
    """The part of a sample's area that faces the solid [m²]; negative if it faces the other way."""
    return -wp.dot(pose.vectors * sample.area, normal)


@wp.func
def is_turned(pose: PairPose, sample: Sample, d: Distance, facing: real) -> bool:
    """Whether a sample lies in the solid and faces the same way as its surface."""
    return d.value < ZERO and -facing > _TURNED * wp.length(pose.vectors * sample.area)


@wp.func
def drift(pose: PairPose, ahead: vec3, arm: vec3, normal: vec3) -> vec3:
    """Half of what the velocity of a point changes by within the step [m/s], in solid axes.

    What touches is another place each time. At most the slip at the predicted place, so that friction gives
    no energy.

    Args:
        pose: The pair.
        ahead: From the first body's centre of mass to the point in the predicted configuration [m].
        arm: The arm that forces have.
        normal: Unit normal.
    """
    change = wp.cross(pose.spin, HALF * (ahead - arm))
    nearing = wp.dot(normal, change) * normal
    across = change - nearing
    u = pose.velocity + wp.cross(pose.spin, ahead)
    slip = u - wp.dot(normal, u) * normal
    squared = wp.dot(across, across)
    most = wp.dot(slip, slip)
    if squared > most:
        across = wp.where(most > ZERO, wp.sqrt(wp.max(most, _TINY) / squared), ZERO) * across
    return nearing + across


@wp.func
def point_contact(
    pose: PairPose,
    sample: Sample,
    d: Distance,
    turning: int,
    presses_back: bool,
    stiffness_share: real,
    lead: real,
) -> Point:
    """The point contact of a sample.

    Args:
        pose: The pair of bodies.
        sample: The sample.
        d: Of the solid at the sample.
        turning: How samples turn with their body.
        presses_back: Whether the sample lies in the solid and faces the other way: then it presses along its
            own normal with all of its area, as a fluid would.
        stiffness_share: Share of the area that counts.
        lead: τ h [s].
    """
    point = Point()
    normal = solid_normal(d.gradient)
    area = facing_area(pose, sample, normal)
    if turning != _FIXED:
        normal = round_normal(pose, sample, turning, normal)
    if presses_back:
        vector = pose.vectors * sample.area
        area = wp.length(vector)
        normal = -vector / area
    arm = pose.arms * sample.point + pose.arm_offset
    moment = wp.cross(arm, normal)
    if turning == _BALL:
        # The surface of a ball that turns does not move: all samples feel what the lowest of them does.
        moment = wp.cross(pose.lowest, normal)
    if turning == _AXIS:
        # … and about an axis nothing of the spin about it.
        moment = moment - wp.dot(pose.axis, moment) * pose.axis
    rate = wp.dot(pose.velocity, normal) + wp.dot(pose.spin, moment)
    point.arm = pose.rotation * arm
    point.normal = pose.rotation * normal
    point.moment = pose.rotation * moment
    gained_on_way = wp.dot(pose.gained_on_way, normal) + wp.dot(pose.spin_gained_on_way, moment)
    point.depth = lead * (rate + gained_on_way) - d.value
    if not presses_back:
        point.sunk = -d.value
        if lead < ZERO:
            # What has separated since then was not deeper: it had its impact only after that.
            point.sunk = wp.min(point.sunk, point.depth)
    point.rate = rate
    point.approach = rate
    point.area = stiffness_share * area
    if turning != _FIXED:
        ahead = position_in_solid(pose, sample.point) - pose.com
        changed = drift(pose, ahead, arm, normal)
        nearing = wp.dot(normal, changed)
        point.approach = rate - nearing
        point.extra_slip = pose.rotation * (changed - nearing * normal)
    point.meets = point.approach + wp.dot(pose.gained, normal) + wp.dot(pose.spin_gained, moment)
    point.gains_after = pose.rotation * pose.gains_after
    return point
