"""Overlap of two density fields: how much they share (ψ), where (χ), and along which normal (n).

Both sides contribute the same one-sided sum: the samples of one object weigh the density of the other,

    S = Σ w_i φ(y_i) x̃_i,      D = Σ w_i φ(y_i) d(y_i),      y_i = H x̃_i,

with x̃ = (x, y, z, 1) in the sampled object's frame, H (3×4) the transform into the queried field's frame and
d the field's outward direction (−∇φ for a learned field, the surface normal of a shape). S holds ψ and ψχ, D
the normal. Each kernel below evaluates S and D together with their exact derivative with respect to H in one
pass over the samples, so that neither autodiff mode ever stores anything of the size of the sample set.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dano.checks import checked_kind
from dano.contact._colliders import BLOCK, Collider, SampleSet, Support, SYMMETRIC
from dano.fields import AbstractField, AbstractShape, GridField, HalfSpace, PosedField, PosedShape, Sphere
from dano.maths import contract, einsum, matmul, matvec, product, safe_normalize


class Patch(eqx.Module):
    """Overlap of two colliders."""

    overlap: Float[Array, ""]  # ψ, the sampled mass inside the other body [kg], shape ()
    centroid: Float[Array, "3"]  # χ, its centroid [m, W], shape (3,)
    normal: Float[Array, "3"]  # n, unit vector from the second collider (B) to the first (A) [W], shape (3,)

    @property
    def point(self) -> Float[Array, "3"]:
        """What twists and wrenches refer to [m, W]: the centroid."""
        return self.centroid

    @property
    def touching(self) -> Bool[Array, ""]:
        """Whether the bodies overlap, so that there is a centroid."""
        return self.overlap > 0


class _Side(eqx.Module):
    """One-sided sums, in the frame of the sampled object (moments) and of the queried field (direction)."""

    moments: Float[Array, "4"]
    direction: Float[Array, "3"]


# Blocks of samples that one pass through a grid takes: enough to outweigh the cost of starting it.
_BLOCKS_AT_ONCE = 4

# Slope that no signed distance exceeds: 1 in theory, √2 beyond an edge of a grid's box.
_STEEPEST = 2**0.5

# Below this share of a body's mass an overlap counts as none: ψ² must not underflow where χ = S/ψ is
# differentiated.
_NEGLIGIBLE = 1e-12

# Edge width [m] that stands for zero: far below any distance, far above the smallest float32.
_HARD = 1e-30


@eqx.filter_jit
def overlap(a: Collider, b: Collider) -> Patch:
    """Expected interpenetration of two colliders.

    ψ = Σ w_i φ(x_i) over the samples of either side, χ the ψ-weighted centroid, n the weighted mean of the
    outward direction of the queried field (paper: eq:integral_volume, eq:integral_centroid; the union sum
    covers neural–primitive pairs, where one side has no samples, and neural–neural pairs alike).

    Args:
        a: Collider that the resulting force acts on.
        b: The other collider.

    Returns:
        The patch; with no overlap, ψ = 0, χ = 0 and n = 0.

    Raises:
        ValueError: If no side has samples to test against a field of the other.
    """
    checked_kind("a", a, Collider)
    checked_kind("b", b, Collider)
    if isinstance(a.field, Sphere) and isinstance(b.field, HalfSpace):
        return _cap(a, b)
    if isinstance(a.field, HalfSpace) and isinstance(b.field, Sphere):
        patch = _cap(b, a)
        return Patch(patch.overlap, patch.centroid, -patch.normal)
    sides = [
        (s, t, sign)
        for s, t, sign in ((a, b, 1), (b, a, -1))
        if s.samples is not None and t.field is not None
    ]
    if not sides:
        raise ValueError(
            "overlap needs contact samples on one side and a density field on the other, got "
            f"a: samples={a.samples is not None}, field={a.field is not None}; "
            f"b: samples={b.samples is not None}, field={b.field is not None}"
        )
    weighted, normal, mass = jnp.zeros(4), jnp.zeros(3), jnp.zeros(())
    weighted, normal, mass = (x.astype(a.origin.dtype) for x in (weighted, normal, mass))
    for sampled, queried, sign in sides:
        side = _one_sided(sampled, queried)
        scale = sampled.mass * queried.density_scale
        point = matvec(sampled.rotation, side.moments[:3]) + sampled.origin * side.moments[3]
        weighted = weighted + scale * jnp.concatenate([point, side.moments[3:]])
        normal = normal + sign * scale * matvec(queried.rotation, side.direction)
        mass = mass + sampled.mass
    psi = weighted[3]
    touching = psi > _NEGLIGIBLE * mass
    centroid = weighted[:3] / jnp.where(touching, psi, 1)
    return Patch(
        jnp.where(touching, psi, 0),
        jnp.where(touching, centroid, 0),
        safe_normalize(jnp.where(touching, normal, 0)),
    )


def _one_sided(sampled: Collider, queried: Collider) -> _Side:
    """Sums over the samples of one collider in the field of the other; ψ per unit mass and density scale."""
    samples, field = sampled.samples, queried.field
    assert samples is not None and field is not None
    inverse = queried.rotation.T
    to_field = jnp.concatenate(
        [matmul(inverse, sampled.rotation), matvec(inverse, sampled.origin - queried.origin)[:, None]], axis=1
    )
    return _dispatch(field, samples, to_field, queried.support)


def _dispatch(
    field: AbstractField, samples: SampleSet, to_field: Float[Array, "3 4"], support: Support | None
) -> _Side:
    """Choose the kernel by the kind of field: planar, culled grid, or every sample by autodiff."""
    if isinstance(field, PosedShape | PosedField):
        inner = field.shape if isinstance(field, PosedShape) else field.field
        shifted = to_field.at[:, 3].add(-field.pose.position)
        side = _dispatch(inner, samples, matmul(field.pose.matrix.T, shifted), support)
        return _Side(side.moments, matvec(field.pose.matrix, side.direction))
    if isinstance(field, HalfSpace):
        normal = field.normal_direction
        plane = matvec(to_field.T, normal).at[3].add(-field.offset)
        # In units of the edge width, which saves a division per sample; a vanishing width is the hard
        # indicator.
        scaled = plane / jnp.maximum(field.edge_width, _HARD)
        moments = _planar(scaled, samples)
        return _Side(moments, normal * moments[3])
    if isinstance(field, AbstractShape) or (isinstance(field, GridField) and support is not None):
        sums = _culled(to_field, field, samples, support)
    else:
        sums = _dense(to_field, field, samples)
    return _Side(sums[:4], sums[4:])


@eqx.filter_custom_jvp
def _planar(plane, samples):
    """Moments Σ w φ x̃ of the samples behind a plane; φ = occupancy(plane · x̃) with a unit edge."""
    return _planar_moments(plane, samples)


@_planar.def_jvp
def _planar_jvp(primals, tangents):
    plane, samples = primals
    d_plane, d_samples = tangents
    if jax.tree.leaves(d_samples):
        return _by_autodiff(_planar_moments, primals, tangents)
    # dS = M dplane with the symmetric 4×4 moment matrix of the samples in the smoothing band.
    t = _depth(plane, samples)
    slope = -6 * t * (1 - t)
    moments, matrix = _moments(t, samples), _symmetric(samples.weights * slope, samples.products)
    return moments, matvec(matrix, d_plane)


def _planar_moments(plane, samples: SampleSet):
    return _moments(_depth(plane, samples), samples)


def _moments(t: Float[Array, " n"], samples: SampleSet) -> Float[Array, "4"]:
    return contract(samples.weights * (t * t * (3 - 2 * t)), samples.points)


def _depth(plane, samples: SampleSet) -> Float[Array, " n"]:
    """The t of the smooth step (`dano.fields.occupancy`) of each sample, in a band of unit width."""
    return jnp.clip(0.5 - product(plane, samples.points), 0, 1)


def _symmetric(weights: Float[Array, " n"], products: Float[Array, "10 n"]) -> Float[Array, "4 4"]:
    """Σ w x̃ x̃ᵀ: one pass over the ten products is twice as fast as four passes over the points."""
    return contract(weights, products)[SYMMETRIC]


@eqx.filter_custom_jvp
def _dense(to_field, field, samples):
    """Sums (S, D) over every sample in any differentiable field."""
    return _dense_sums(to_field, field, samples)


@_dense.def_jvp
def _dense_jvp(primals, tangents):
    to_field, field, samples = primals
    if jax.tree.leaves(tangents[1:]):
        return _by_autodiff(_dense_sums, primals, tangents)
    value, jacobian = _features_and_jacobian(field, product(to_field, samples.points))
    sums, derivative = _accumulate(value, jacobian, samples.points, samples.products, samples.weights)
    return sums, einsum("kab,ab->k", derivative, tangents[0])


def _dense_sums(to_field, field, samples: SampleSet):
    value = _all_features(field, product(to_field, samples.points))
    return jnp.concatenate(
        [contract(samples.weights * value[0], samples.points), contract(value[1:], samples.weights)]
    )


def _features(field: AbstractField, x: Float[Array, "3"]) -> Float[Array, "4"]:
    """(φ, φ d) of a field at a point."""
    density = field.density(x)
    return jnp.concatenate([density[None], density * field.outward(x)])


def _all_features(field: AbstractField, x: Float[Array, "3 n"]) -> Float[Array, "4 n"]:
    return jax.vmap(_features, (None, 1), -1)(field, x)


def _features_and_jacobian(field: AbstractField, x: Float[Array, "3 n"]):
    def twice(point):
        value = _features(field, point)
        return value, value

    jacobian, value = jax.vmap(jax.jacfwd(twice, has_aux=True), 1, -1)(x)
    return value, jacobian


@eqx.filter_custom_jvp
def _culled(to_field, field, samples, support):
    """Sums (S, D) over the blocks of samples that can reach a grid's support, or a shape."""
    return _culled_sums(to_field, field, samples, support, derivative=False)[0]


@_culled.def_jvp
def _culled_jvp(primals, tangents):
    if jax.tree.leaves(tangents[1:]):
        # The map of the support only says what may be skipped: without it the sums are the same.
        return _by_autodiff(_dense_sums, primals[:3], tangents[:3])
    sums, derivative = _culled_sums(*primals, derivative=True)
    return sums, einsum("kab,ab->k", derivative, tangents[0])


def _culled_sums(to_field, field, samples: SampleSet, support: Support | None, *, derivative: bool):
    centers = product(to_field, jnp.concatenate([samples.centers.T, jnp.ones_like(samples.centers.T[:1])]))
    if support is not None:
        clearance = support.lower_bound(centers)
    else:
        clearance = field.sdf_jet(centers, 0) / _STEEPEST - 0.5 * field.edge_width.astype(centers.dtype)
    near = clearance <= samples.radii
    padded = near.shape[0] + -near.shape[0] % _BLOCKS_AT_ONCE
    (blocks,) = jnp.nonzero(near, size=padded, fill_value=0)
    count = jnp.sum(near)
    zero = jnp.zeros(7, to_field.dtype), jnp.zeros((7, 3, 4) if derivative else (0,), to_field.dtype)

    def add_blocks(i, total):
        numbers = [i * _BLOCKS_AT_ONCE + k for k in range(_BLOCKS_AT_ONCE)]

        def gather(x):
            return [jax.lax.dynamic_slice_in_dim(x, blocks[n] * BLOCK, BLOCK, axis=-1) for n in numbers]

        points, products = (jnp.concatenate(gather(x), axis=1) for x in (samples.points, samples.products))
        # The last pass may be short: what fills it up weighs nothing.
        weights = jnp.concatenate(
            [jnp.where(n < count, w, 0) for n, w in zip(numbers, gather(samples.weights), strict=True)]
        )
        sums, matrix = _block_sums(to_field, field, points, products, weights, derivative=derivative)
        return total[0] + sums, total[1] + matrix

    return jax.lax.fori_loop(0, -(-count // _BLOCKS_AT_ONCE), add_blocks, zero)


def _block_sums(to_field, field, points, products, weights, *, derivative: bool):
    """Sums and, if asked, their derivative (7, 3, 4) over some samples."""
    x = product(to_field, points)
    if not derivative:
        value = _grid_features(field, x) if isinstance(field, GridField) else _all_features(field, x)
        sums = [contract(weights * value[0], points), contract(value[1:], weights)]
        return jnp.concatenate(sums), jnp.zeros((0,), x.dtype)
    of = _grid_features_and_jacobian if isinstance(field, GridField) else _features_and_jacobian
    return _accumulate(*of(field, x), points, products, weights)


def _grid_features(field: GridField, x: Float[Array, "3 n"]) -> Float[Array, "4 n"]:
    """`_features` of a grid, whose direction is −∇φ, from its closed forms."""
    density, gradient = field.jet(x, 1)
    return jnp.concatenate([density[None], -density[None] * gradient])


def _grid_features_and_jacobian(field: GridField, x: Float[Array, "3 n"]):
    density, gradient, hessian = field.jet(x, 2)
    value = jnp.concatenate([density[None], -density[None] * gradient])
    jacobian = jnp.concatenate(
        [gradient[None], -(gradient[:, None] * gradient[None] + density[None, None] * hessian)]
    )
    return value, jacobian


def _accumulate(value, jacobian, points, products, weights):
    """Sums (7,) and their derivative by the 3×4 transform, from (φ, φd) and its Jacobian per sample."""
    sums = jnp.concatenate([contract(weights * value[0], points), contract(value[1:], weights)])
    weighted = jacobian * weights[None, None]
    # dS_k = Σ w ∂_aφ x̃_k x̃_b dH_ab,   dD_c = Σ w ∂_a(φ d_c) x̃_b dH_ab
    of_moments = jnp.stack([_symmetric(weighted[0, a], products) for a in range(3)], axis=1)
    of_direction = jnp.stack([jnp.stack([contract(row, points) for row in rows]) for rows in weighted[1:]])
    return sums, jnp.concatenate([of_moments, of_direction])


def _cap(ball: Collider, plane: Collider) -> Patch:
    """Overlap of a homogeneous ball with a half-space in closed form: the spherical cap below the plane.

    With depth h of the lowest point, V = π h² (3r − h) / 3 and the cap's centroid lies
    3 (2r − h)² / (4 (3r − h)) from the ball's centre. Exact and smooth where sampling would make a ball
    rattle as it rolls.
    """
    sphere, half_space = ball.field, plane.field
    assert isinstance(sphere, Sphere) and isinstance(half_space, HalfSpace)
    normal = matvec(plane.rotation, half_space.normal_direction)
    radius = sphere.radius
    height = jnp.sum(normal * (ball.origin - plane.origin)) - half_space.offset
    depth = jnp.clip(radius - height, 0, 2 * radius)
    share = depth**2 * (3 * radius - depth) / (4 * radius**3)
    offset = 3 * (2 * radius - depth) ** 2 / (4 * (3 * radius - depth))
    touching = share > _NEGLIGIBLE
    return Patch(
        ball.mass * jnp.where(touching, share, 0),
        jnp.where(touching, ball.origin - offset * normal, 0),
        jnp.where(touching, normal, 0),
    )


def _by_autodiff(function, primals, tangents):
    """Plain forward derivative, for arguments that few ever perturb (a grid's values, samples, a radius)."""
    perturbed = jax.tree.map(lambda t: t is not None, tangents, is_leaf=lambda t: t is None)
    dynamic, static = eqx.partition(primals, perturbed)
    return jax.jvp(lambda d: function(*eqx.combine(d, static)), (dynamic,), (tangents,))
