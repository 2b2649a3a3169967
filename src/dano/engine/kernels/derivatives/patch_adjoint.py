"""What the wrench of a patch depends on, as numbers whose gradients are derivatives (docs/gradients.md).

As in `adjoint`: the work of the wrench along virtual velocities; then, one after the other, what it asks of a
patch, of sums over samples, of each sample's density, and of the poses of both bodies.
"""

import warp as wp

from dano.engine.kernels.derivatives.adjoint import need_adjoints, Virtual
from dano.engine.kernels.patches import frame_of
from dano.physics.overlap import (
    cap_patch,
    Density,
    Field,
    grid_density,
    in_leaf,
    Part,
    PartKind,
    Patch,
    patch_of,
    plane_density,
    sample_sums,
    shell_density,
    Sums,
    sums_in_world,
    View,
    view_of,
    WeightedSample,
)
from dano.physics.pairs import BodyState
from dano.physics.patch_law import patch_law, PatchMaterial
from dano.physics.real import real, vec3
from dano.physics.solids.distances import Solid
from dano.physics.solids.leaves import Distance, Leaf, Solids
from dano.physics.structures import product_of
from dano.physics.twists import relative_twist


@wp.func
def patch_work(
    material: PatchMaterial, patch: Patch, adhesive: bool, first: vec3, second: vec3, h: real, twists: Virtual
) -> real:
    """Work of a patch's impulse along the virtual velocities of its bodies.

    Args:
        material: Of the contact.
        patch: The patch.
        adhesive: Whether the normal force may pull.
        first: Centre of mass of the first body [m, W].
        second: Of the second.
        h: Timestep [s].
        twists: Of both bodies.
    """
    arm = patch.centroid - first
    twist = relative_twist(twists.first, twists.second, first - second)
    virtual = relative_twist(twists.first_virtual, twists.second_virtual, first - second)
    found = patch_law(material, patch, adhesive, twist.velocity + wp.cross(twist.spin, arm), twist.spin)
    moved = virtual.velocity + wp.cross(virtual.spin, arm)
    return h * (wp.dot(found.force, moved) + wp.dot(found.moment, virtual.spin))


patch_product, sums_product = product_of(Patch), product_of(Sums)


@wp.func
def gathered_work(sums: Sums, mass: real, bar: Patch) -> real:
    """⟨bar, patch of sums over both sides⟩."""
    return patch_product(bar, patch_of(sums, mass))


@wp.func
def cap_work(
    ball: Leaf, plane: Leaf, sampled: BodyState, queried: BodyState, mass: real, sign: real, bar: Patch
) -> real:
    """⟨bar, patch of a ball on a half-space⟩."""
    patch = cap_patch(ball, plane, frame_of(sampled), frame_of(queried), mass)
    patch.normal = sign * patch.normal
    return patch_product(bar, patch)


@wp.func
def side_work(
    own: Sums, sampled: BodyState, queried: BodyState, mass: real, density_scale: real, sign: real, bar: Sums
) -> real:
    """⟨bar, sums over one side in the world⟩."""
    found = sums_in_world(own, frame_of(sampled), frame_of(queried), mass * density_scale, sign)
    return sums_product(bar, found)


@wp.func
def sample_work(sample: WeightedSample, found: Density, bar: Sums) -> real:
    """⟨bar, what one sample adds⟩."""
    return sums_product(bar, sample_sums(sample, found))


@wp.func
def plane_work(view: View, edge: real, point: vec3, bar: Density) -> real:
    """⟨bar, density of a half-space at a sample⟩."""
    found = plane_density(view, edge, point)
    return bar.value * found.value + wp.dot(bar.direction, found.direction)


@wp.func
def shell_work(part: Part, kind: PartKind, solid: Solid, x: vec3, d: Distance, bar: Density) -> real:
    """⟨bar, density of a solid at a distance⟩."""
    found = shell_density(part, kind, solid, x, d)
    return bar.value * found.value + wp.dot(bar.direction, found.direction)


@wp.func
def grid_work(solids: Solids, world: int, solid: Solid, x: vec3, bar: Density) -> real:
    """⟨bar, density of a grid at a point⟩."""
    found = grid_density(solids, world, solid.kind, solid.leaf, in_leaf(solid.leaf, x))
    return bar.value * found.value + wp.dot(bar.direction, found.direction)


@wp.func
def view_work(field: Field, sampled: BodyState, queried: BodyState, bar: View) -> real:
    """⟨bar, a field as the samples of another body see it⟩."""
    view = view_of(field, frame_of(sampled), frame_of(queried))
    return (
        wp.ddot(bar.rotation, view.rotation)
        + wp.dot(bar.origin, view.origin)
        + wp.dot(bar.plane, view.plane)
        + wp.dot(bar.normal, view.normal)
    )


for _function in (
    patch_work, gathered_work, cap_work, side_work, sample_work, plane_work, shell_work, grid_work, view_work
):  # fmt: skip
    need_adjoints(_function)
