"""What impacts depend on, as numbers whose gradients are derivatives; see `derivatives.adjoint`."""

import warp as wp

from dano.engine.kernels.derivatives.adjoint import need_adjoints
from dano.engine.kernels.tables import Body, StateRow
from dano.physics.impacts import Impact, Patch, share_of_impact, stiffness_of_impact, with_sample
from dano.physics.momentum import turned_inertia
from dano.physics.pairs import BodyState, PairPose
from dano.physics.real import real, vec6
from dano.physics.rotations import from_wxyz, matrix
from dano.physics.samples import point_contact, Sample
from dano.physics.solids.leaves import Distance
from dano.physics.twists import angular_part, linear_part


@wp.func
def patch_work(
    pose: PairPose,
    sample: Sample,
    d: Distance,
    turning: int,
    stiffness_share: real,
    lead: real,
    depth: real,
    layer: real,
    bar: Patch,
) -> real:
    """⟨bar, what a sample adds to the patch of an impact⟩."""
    point = point_contact(pose, sample, d, turning, False, stiffness_share, lead)
    own = Patch()
    own = with_sample(own, point.area, point.sunk, depth, layer, point.approach, point.arm, point.normal)
    return (
        bar.load * own.load
        + wp.dot(bar.arm, own.arm)
        + wp.dot(bar.normal, own.normal)
        + bar.near_load * own.near_load
        + bar.near_rate * own.near_rate
    )


@wp.func
def impact_work(
    first: BodyState, second: BodyState, patch: Patch, bounce: real, h: real, hits: bool, bar: Impact
) -> real:
    """⟨bar, share and stiffness of an impact⟩."""
    work = bar.share * share_of_impact(patch, bounce)
    if hits:
        work += bar.stiffness * stiffness_of_impact(first, second, patch, bounce, h)
    return work


@wp.func
def late_work(body: Body, row: StateRow, delayed: vec6, late: vec6) -> real:
    """Work of the momentum of a twist along another: μᵀ M D."""
    inertia = turned_inertia(matrix(from_wxyz(row.orientation)), body.inertia)
    along = wp.dot(linear_part(late), linear_part(delayed))
    return body.mass * along + wp.dot(angular_part(late), inertia * angular_part(delayed))


for _function in (patch_work, impact_work, late_work):
    need_adjoints(_function)
