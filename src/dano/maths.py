"""Quaternions (wxyz), rigid poses and norms that differentiate safely at zero.

A quaternion is an array whose last axis holds (w, x, y, z). It rotates body-frame vectors into the world
frame. Every function broadcasts over leading axes unless its signature says otherwise.
"""

import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

Numbers = ArrayLike | Sequence[Any]
"""What constructors take for an array: an array, a number, or (nested) lists and tuples of numbers."""


def safe_norm(x: Float[Array, "..."], axis: int = -1) -> Float[Array, "..."]:
    """Euclidean norm whose derivative at zero is zero instead of NaN."""
    squared = jnp.sum(x * x, axis=axis)
    # The untaken branch must be safe too: 0 · ∞ in the chain rule would be NaN.
    positive = squared > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1)), 0)


def column_norm(x: Float[Array, "k *batch"]) -> Float[Array, "*batch"]:
    """Length of vectors stored as columns; its derivative at zero is zero instead of NaN.

    Faster than `safe_norm` over the first axis of many columns on a CPU.
    """
    squared = functools.reduce(jnp.add, [row * row for row in x])
    # The untaken branch must be safe too: 0 · ∞ in the chain rule would be NaN.
    positive = squared > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1)), 0)


def safe_normalize(x: Float[Array, "*shape"], axis: int = -1) -> Float[Array, "*shape"]:
    """Unit vector along `x`; the zero vector where `x` is zero."""
    norm = jnp.expand_dims(safe_norm(x, axis), axis)
    return x / jnp.where(norm > 0, norm, 1)


def skew(v: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Cross-product matrix: ``skew(v) @ w == v × w``."""
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    zero = jnp.zeros_like(x)
    return jnp.stack(
        [
            jnp.stack([zero, -z, y], -1),
            jnp.stack([z, zero, -x], -1),
            jnp.stack([-y, x, zero], -1),
        ],
        -2,
    )


def quat_multiply(p: Float[Array, "*#batch 4"], q: Float[Array, "*#batch 4"]) -> Float[Array, "*batch 4"]:
    """Hamilton product p ⊗ q: the rotation q followed by p."""
    pw, px, py, pz = p[..., 0], p[..., 1], p[..., 2], p[..., 3]
    qw, qx, qy, qz = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return jnp.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        -1,
    )


def quat_conjugate(q: Float[Array, "*batch 4"]) -> Float[Array, "*batch 4"]:
    """Inverse rotation of a unit quaternion."""
    return jnp.concatenate([q[..., :1], -q[..., 1:]], axis=-1)


def quat_to_matrix(q: Float[Array, "*batch 4"]) -> Float[Array, "*batch 3 3"]:
    """Rotation matrix of a unit quaternion (body → world)."""
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )


def quat_from_matrix(matrix: Float[Array, "3 3"]) -> Float[Array, "4"]:
    """Unit quaternion (w ≥ 0) of a rotation matrix, on the host (Shepperd's method)."""
    m = np.asarray(matrix)
    # The eigenvector of the largest eigenvalue is stable for every rotation and projects a nearly-orthogonal
    # input.
    k = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], 0, 0, 0],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], 0, 0],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    _, vectors = np.linalg.eigh(k, UPLO="L")
    q = vectors[:, -1]
    return jnp.asarray(q if q[0] >= 0 else -q, dtype=jnp.result_type(float))


def quat_rotate(q: Float[Array, "*#batch 4"], v: Float[Array, "*#batch 3"]) -> Float[Array, "*batch 3"]:
    """Rotate vector(s) `v` by unit quaternion(s) `q`."""
    w, u = q[..., :1], q[..., 1:]
    t = 2 * jnp.cross(u, v)
    return v + w * t + jnp.cross(u, t)


def quat_normalize(q: Float[Array, "*batch 4"]) -> Float[Array, "*batch 4"]:
    """Unit quaternion along `q` (a zero quaternion stays zero: callers check)."""
    return safe_normalize(q)


def quat_from_axis_angle(axis: Numbers, angle: Numbers) -> Float[Array, "4"]:
    """Quaternion of a rotation by `angle` [rad] about `axis` (3,), which need not be normalised."""
    axis = safe_normalize(jnp.asarray(axis, dtype=jnp.result_type(float)))
    half = 0.5 * jnp.asarray(angle, dtype=axis.dtype)
    return jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * axis])


def rotation_angle(p: Float[Array, "*#batch 4"], q: Float[Array, "*#batch 4"]) -> Float[Array, "*batch"]:
    """Geodesic angle [rad] between two orientations, in [0, π]; accurate for tiny angles."""
    relative = quat_multiply(quat_conjugate(p), q)
    return 2 * jnp.arctan2(safe_norm(relative[..., 1:]), jnp.abs(relative[..., 0]))


# Small matrices as sums of outer products: XLA's CPU backend spends 0.2–2 µs on a dot of a few numbers, and a
# reduction over a middle axis does not vectorise when batched. Written out over the short contracted axis,
# the same products fuse with what surrounds them: 2–10 times faster at these sizes, with and without `vmap`.


def matvec(a: Float[Array, "m n"], x: Float[Array, " n"]) -> Float[Array, " m"]:
    """``a @ x`` for a small matrix."""
    return matmul(a, x[:, None])[:, 0]


@jax.custom_jvp
def matmul(a: Float[Array, "m k"], b: Float[Array, "k n"]) -> Float[Array, "m n"]:
    """``a @ b`` for small matrices."""
    return sum((a[:, i, None] * b[None, i] for i in range(1, a.shape[1])), a[:, 0, None] * b[None, 0])


@functools.partial(matmul.defjvp, symbolic_zeros=True)
def _matmul_jvp(primals, tangents):
    # Tangents as one product and one reduction: their transposes are as short, those of the written-out sum
    # are not.
    (a, b), (da, db) = primals, tangents
    terms = [
        d
        for d in (
            None if _zero(da) else da[:, :, None] * b[None],
            None if _zero(db) else a[:, :, None] * db[None],
        )
        if d is not None
    ]
    tangent = jnp.sum(sum(terms[1:], terms[0]), axis=1) if terms else jnp.zeros_like(a[:, :1] * b[:1])
    return matmul(a, b), tangent


def _zero(tangent) -> bool:
    return isinstance(tangent, jax.custom_derivatives.SymbolicZero)


def contract(a: Float[Array, "*m n"], b: Float[Array, "*k n"]) -> Float[Array, "..."]:
    """Sum over the last axes of two arrays, ``a @ b.T`` for matrices.

    Written as one contraction because ``@`` with a transposed operand copies it in every step of a scan
    (three times slower), and because this order stays fast when `a` gains a batch axis.
    """
    return jax.lax.dot_general(a, b, (((a.ndim - 1,), (b.ndim - 1,)), ((), ())))


class Pose(eqx.Module):
    """Rigid transform x ↦ R(orientation) x + position.

    Attributes:
        position: Translation [m], shape (3,).
        orientation: Unit quaternion wxyz, shape (4,).
    """

    position: Float[Array, "3"]
    orientation: Float[Array, "4"]

    def __init__(self, position: Numbers = (0.0, 0.0, 0.0), orientation: Numbers = (1.0, 0.0, 0.0, 0.0)):
        """Build a pose; the orientation is normalised.

        Raises:
            ValueError: If a shape is wrong, an entry is not finite, or the quaternion is zero.
        """
        self.position = checked_array("position", position, (3,))
        self.orientation = checked_quaternion("orientation", orientation)

    def apply(self, x: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Map points [m] from the local into the parent frame."""
        return x @ self.matrix.T.astype(x.dtype) + jnp.broadcast_to(self.position.astype(x.dtype), x.shape)

    @property
    def matrix(self) -> Float[Array, "3 3"]:
        """Rotation matrix."""
        return quat_to_matrix(self.orientation)

    def inverse(self) -> "Pose":
        """The transform that undoes this one."""
        conjugate = quat_conjugate(self.orientation)
        return Pose(-quat_rotate(conjugate, self.position), conjugate)

    def compose(self, other: "Pose") -> "Pose":
        """The transform that applies `other` first, then this one."""
        return Pose(self.apply(other.position), quat_multiply(self.orientation, other.orientation))

    def __matmul__(self, other: "Pose") -> "Pose":
        """See `compose`."""
        return self.compose(other)


def is_traced(*values: object) -> bool:
    """Whether any leaf is a JAX tracer, on which host-side checks are impossible."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values))


def checked_array(name: str, value: Numbers, shape: tuple[int, ...]) -> Array:
    """`value` as a floating array of `shape`; NumPy rules for the dtype, finite unless traced.

    Raises:
        ValueError: If the shape differs or an entry is not finite.
    """
    array = floating(value)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
    if not is_traced(array) and not np.all(np.isfinite(np.asarray(array))):
        raise ValueError(f"{name} must be finite, got {np.asarray(array).tolist()}")
    return array


def checked_quaternion(name: str, value: Numbers) -> Array:
    """`value` as a unit quaternion wxyz.

    Raises:
        ValueError: If the shape differs, an entry is not finite, or the norm is zero.
    """
    array = checked_array(name, value, (4,))
    if not is_traced(array) and float(np.linalg.norm(np.asarray(array))) < 1e-12:
        raise ValueError(
            f"{name} must be a non-zero quaternion (w, x, y, z), got {np.asarray(array).tolist()}"
        )
    return quat_normalize(array)


def floating(value: Numbers) -> Array:
    """`value` as a floating JAX array: floating arrays keep their dtype, the rest takes JAX's default."""
    dtype = getattr(value, "dtype", None)
    if dtype is not None and jnp.issubdtype(dtype, jnp.floating):
        return jnp.asarray(value)
    return jnp.asarray(value, dtype=jnp.result_type(float))
