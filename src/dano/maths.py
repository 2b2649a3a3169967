"""Quaternions (wxyz), rigid poses and norms that differentiate safely at zero.

A quaternion is an array whose last axis holds (w, x, y, z). It rotates body-frame vectors into the world
frame. Every function broadcasts over leading axes unless its signature says otherwise. Functions of
quaternions compute NumPy arrays with NumPy, on the host and in their own dtype, and all else with JAX.
"""

import functools
import operator
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any, TYPE_CHECKING, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from dano.checks import shown
from dano.keys import seed_key

Numbers = ArrayLike | Sequence[Any]
"""What constructors take for an array: an array, a number, or (nested) lists and tuples of numbers."""

Q = TypeVar("Q", Array, np.ndarray)
"""Arrays of JAX or of NumPy."""
if TYPE_CHECKING:
    # Which of the two it is depends on what a function is called with: checks of types cannot follow that.
    AnyArray: TypeAlias = Any
else:
    AnyArray = Array | np.ndarray | np.generic
    """An array of JAX or of NumPy."""
Function = TypeVar("Function", bound=Callable[..., Any])

_SERIES = 1e-4
"""Below this, of the square of half an angle [rad²], five terms of a series are exact in float64."""


def library(*arrays: AnyArray | float) -> ModuleType:
    """NumPy for its arrays and numbers, JAX's for others."""
    return np if all(isinstance(array, np.ndarray | np.generic | float | int) for array in arrays) else jnp


def by_numpy(function: Function) -> Function:
    """The function, computed by NumPy unless an argument is traced.

    Outside of `jax.jit`, JAX compiles a program for each operation on arrays of a new shape: 30 ms, for work
    of a microsecond.

    Args:
        function: Of trees of arrays, to a tree of arrays, written for both libraries (see `library`). What
            it makes of arrays of NumPy alone stays with NumPy.
    """

    @functools.wraps(function)
    def call(*args, **options):
        if is_traced(args) or not any(isinstance(x, jax.Array) for x in jax.tree.leaves(args)):
            return function(*args, **options)
        with np.errstate(all="ignore"):
            found = function(*on_host(args), **options)
        return jax.tree.map(lambda x: on_device(x) if isinstance(x, np.ndarray | np.generic) else x, found)

    return call  # pyright: ignore[reportReturnType]


def on_host(tree: Any) -> Any:
    """A tree with NumPy's arrays in place of those of JAX, which must not be traced."""
    return jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, tree)


def with_rows(x: AnyArray, rows: Any, values: AnyArray) -> Any:
    """An array with some rows, or other parts, replaced."""
    if library(x, values) is jnp:
        return jnp.asarray(x).at[rows].set(values)
    changed = np.array(x)
    changed[rows] = values
    return changed


@by_numpy
def stacked(rows: Sequence[Float[Q, "*shape"]]) -> Float[Q, "n *shape"]:
    """Arrays as the rows of one."""
    return library(*rows).stack(list(rows))


@by_numpy
def safe_norm(x: Float[Q, "..."], axis: int = -1) -> Float[Q, "..."]:
    """Euclidean norm whose derivative at zero is zero instead of NaN."""
    xp = library(x)
    squared = xp.sum(x * x, axis=axis)
    # The untaken branch must be safe too: 0 · ∞ in the chain rule would be NaN.
    positive = squared > 0
    return xp.where(positive, xp.sqrt(xp.where(positive, squared, 1)), 0)


def column_norm(x: Float[Q, "k *batch"]) -> Float[Q, "*batch"]:
    """Length of vectors stored as columns; its derivative at zero is zero instead of NaN.

    Faster than `safe_norm` over the first axis of many columns on a CPU.
    """
    xp = library(x)
    squared = functools.reduce(operator.add, [row * row for row in x])
    # The untaken branch must be safe too: 0 · ∞ in the chain rule would be NaN.
    positive = squared > 0
    return xp.where(positive, xp.sqrt(xp.where(positive, squared, 1)), 0)


@by_numpy
def safe_normalize(x: Float[Q, "*shape"], axis: int = -1) -> Float[Q, "*shape"]:
    """Unit vector along `x`; the zero vector where `x` is zero."""
    xp = library(x)
    norm = xp.expand_dims(safe_norm(x, axis), axis)
    return x / xp.where(norm > 0, norm, 1)


def skew(v: Float[Q, "*batch 3"]) -> Float[Q, "*batch 3 3"]:
    """Cross-product matrix: ``skew(v) @ w == v × w``."""
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    xp = library(v)
    zero = xp.zeros_like(x)
    return xp.stack(
        [
            xp.stack([zero, -z, y], -1),
            xp.stack([z, zero, -x], -1),
            xp.stack([-y, x, zero], -1),
        ],
        -2,
    )


def quat_multiply(p: Float[Q, "*#batch 4"], q: Float[Q, "*#batch 4"]) -> Float[Q, "*batch 4"]:
    """Hamilton product p ⊗ q: the rotation q followed by p."""
    pw, px, py, pz = p[..., 0], p[..., 1], p[..., 2], p[..., 3]
    qw, qx, qy, qz = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return library(p, q).stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        -1,
    )


def quat_conjugate(q: Float[Q, "*batch 4"]) -> Float[Q, "*batch 4"]:
    """Inverse rotation of a unit quaternion."""
    return library(q).concatenate([q[..., :1], -q[..., 1:]], axis=-1)


def quat_to_matrix(q: Float[Q, "*batch 4"]) -> Float[Q, "*batch 3 3"]:
    """Rotation matrix of a unit quaternion (body → world)."""
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    stack = library(q).stack
    return stack(
        [
            stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )


def quat_from_matrix(matrix: Float[Q, "*batch 3 3"]) -> Float[Q, "*batch 4"]:
    """Unit quaternion (w ≥ 0) of a rotation matrix.

    The matrix gives 4 q qᵀ without a root. Its row with the largest diagonal entry, which is at least 1, is
    normalised (after Shepperd 1978, who divides by a root instead).
    """
    xp = library(matrix)
    m = [[matrix[..., i, j] for j in range(3)] for i in range(3)]
    x, y, z = m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]
    xy, xz, yz = m[0][1] + m[1][0], m[0][2] + m[2][0], m[1][2] + m[2][1]
    diagonal = xp.stack(
        [
            1 + m[0][0] + m[1][1] + m[2][2],
            1 + m[0][0] - m[1][1] - m[2][2],
            1 - m[0][0] + m[1][1] - m[2][2],
            1 - m[0][0] - m[1][1] + m[2][2],
        ],
        -1,
    )
    products = xp.stack(
        [
            xp.stack([diagonal[..., 0], x, y, z], -1),
            xp.stack([x, diagonal[..., 1], xy, xz], -1),
            xp.stack([y, xy, diagonal[..., 2], yz], -1),
            xp.stack([z, xz, yz, diagonal[..., 3]], -1),
        ],
        -2,
    )
    largest = xp.argmax(diagonal, axis=-1)[..., None, None]
    row = xp.take_along_axis(products, largest, axis=-2)[..., 0, :]
    row = xp.where(row[..., :1] < 0, -row, row)
    return row / xp.sqrt(xp.sum(row * row, axis=-1, keepdims=True))


def quat_rotate(q: Float[Q, "*#batch 4"], v: Float[Q, "*#batch 3"]) -> Float[Q, "*batch 3"]:
    """Rotate vector(s) `v` by unit quaternion(s) `q`."""
    cross = library(q, v).cross
    w, u = q[..., :1], q[..., 1:]
    t = 2 * cross(u, v)
    return v + w * t + cross(u, t)


def quat_normalize(q: Float[Q, "*batch 4"]) -> Float[Q, "*batch 4"]:
    """Unit quaternion along `q` (a zero quaternion stays zero: callers check)."""
    return safe_normalize(q)


def quat_exp(vector: Float[Q, "*batch 3"]) -> Float[Q, "*batch 4"]:
    """Unit quaternion of a rotation vector [rad]: (cos |v|/2, sin |v|/2 · v/|v|), smooth at zero."""
    xp = library(vector)
    half = 0.5 * vector
    squared = xp.sum(half * half, axis=-1, keepdims=True)
    small = squared < _SERIES
    # The untaken branch must be safe too: 0 · ∞ in the chain rule would be NaN.
    angle = xp.sqrt(xp.where(small, 1, squared))
    s = xp.where(small, squared, 0)
    cosine = 1 - s / 2 * (1 - s / 12 * (1 - s / 30 * (1 - s / 56)))
    sinc = 1 - s / 6 * (1 - s / 20 * (1 - s / 42 * (1 - s / 72)))
    return xp.concatenate(
        [
            xp.where(small, cosine, xp.cos(angle)),
            half * xp.where(small, sinc, xp.sin(angle) / angle),
        ],
        axis=-1,
    )


def quat_log(q: Float[Q, "*batch 4"]) -> Float[Q, "*batch 3"]:
    """Rotation vector [rad] of a unit quaternion, the shortest: at most π long, the same for q and −q.

    Smooth where the angle is below π. The direction does not change with the length of `q`. NaN stays NaN.
    """
    xp = library(q)
    q = xp.where(q[..., :1] < 0, -q, q)
    w, u = q[..., :1], q[..., 1:]
    squared = xp.sum(u * u, axis=-1, keepdims=True)
    small = squared < _SERIES * w * w
    # The untaken branch must be safe too: 0 · ∞ in the chain rule would be NaN.
    sine = xp.sqrt(xp.where(small, 1, squared))
    cosine = xp.where(small, w, 1)
    s = xp.where(small, squared, 0) / (cosine * cosine)
    series = (1 - s * (1 / 3 - s * (1 / 5 - s * (1 / 7 - s / 9)))) / cosine
    return 2 * u * xp.where(small, series, xp.arctan2(sine, w) / sine)


def quat_slerp(
    p: Float[Q, "*#batch 4"], q: Float[Q, "*#batch 4"], share: Float[Q, "*#batch"]
) -> Float[Q, "*batch 4"]:
    """Orientation after a share of the shortest turn from p (0) to q (1), at constant angular velocity."""
    return quat_multiply(p, quat_exp(share[..., None] * quat_log(quat_multiply(quat_conjugate(p), q))))


def quat_from_axis_angle(axis: Numbers, angle: Numbers) -> Float[Array, "4"]:
    """Quaternion of a rotation by `angle` [rad] about `axis` (3,), which need not be normalised."""
    axis = safe_normalize(jnp.asarray(axis, dtype=jnp.result_type(float)))
    return quat_exp(jnp.asarray(angle, dtype=axis.dtype) * axis)


# Small matrices as sums of outer products: XLA's CPU backend spends 0.2–2 µs on a dot of a few numbers, and a
# reduction over a middle axis does not vectorise when batched. Written out over the short contracted axis,
# the same products fuse with what surrounds them: 2–10 times faster at these sizes, with and without `vmap`.


def even_directions(count: int, lowest: float = -1.0) -> Float[np.ndarray, "n 3"]:
    """Unit vectors spread evenly over the part of the sphere above a height z (a Fibonacci lattice)."""
    z = 1 - (1 - lowest) * (np.arange(count) + 0.5) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)


def rigidly_joined(
    masses: Float[np.ndarray, " n"], centres: Float[np.ndarray, "n 3"], inertias: Float[np.ndarray, "n 3 3"]
) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Mass, centre of mass and inertia about it of bodies that are one (parallel-axis theorem).

    Args:
        masses: Theirs [kg].
        centres: Their centres of mass [m], in one frame.
        inertias: Their inertias about these [kg m²], in the same axes.
    """
    mass = float(np.sum(masses))
    com = masses @ centres / mass
    arms = centres - com
    away = np.sum(arms**2, axis=1)[:, None, None] * np.eye(3) - arms[:, :, None] * arms[:, None, :]
    return mass, com, np.sum(inertias + masses[:, None, None] * away, axis=0)


# GPUs multiply matrices of 32-bit numbers with three digits (TF32) where nothing else is asked for: good for
# networks, but points would be off by a thousandth of their coordinates. Elsewhere it changes nothing.
_ALL_DIGITS = jax.lax.Precision.HIGHEST


def product(a: Float[AnyArray, "..."], b: Float[AnyArray, "..."]) -> Any:
    """``a @ b`` with all digits of their numbers on every device: for places, forces and masses."""
    return np.matmul(a, b) if library(a, b) is np else jnp.matmul(a, b, precision=_ALL_DIGITS)


def einsum(subscripts: str, *arrays: AnyArray) -> Any:
    """`jnp.einsum`, as `product`."""
    if library(*arrays) is np:
        return np.einsum(subscripts, *arrays)
    return jnp.einsum(subscripts, *arrays, precision=_ALL_DIGITS)


def matvec(a: Float[AnyArray, "m n"], x: Float[AnyArray, " n"]) -> Float[AnyArray, " m"]:
    """``a @ x`` for a small matrix."""
    return matmul(a, x[:, None])[:, 0]


def matmul(a: Float[AnyArray, "m k"], b: Float[AnyArray, "k n"]) -> Float[AnyArray, "m n"]:
    """``a @ b`` for small matrices; rounded in one way by NumPy and JAX."""
    return _written_out(a, b) if library(a, b) is np else _matmul(jnp.asarray(a), jnp.asarray(b))


def _written_out(a: AnyArray, b: AnyArray) -> AnyArray:
    return sum((a[:, i, None] * b[None, i] for i in range(1, a.shape[1])), a[:, 0, None] * b[None, 0])


_matmul = jax.custom_jvp(_written_out)


@functools.partial(_matmul.defjvp, symbolic_zeros=True)
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
    return _matmul(a, b), tangent


def _zero(tangent) -> bool:
    return isinstance(tangent, jax.custom_derivatives.SymbolicZero)


def contract(a: Float[Array, "*m n"], b: Float[Array, "*k n"]) -> Float[Array, "..."]:
    """Sum over the last axes of two arrays, ``a @ b.T`` for matrices.

    Written as one contraction because ``@`` with a transposed operand copies it in every step of a scan
    (three times slower), and because this order stays fast when `a` gains a batch axis.
    """
    return jax.lax.dot_general(a, b, (((a.ndim - 1,), (b.ndim - 1,)), ((), ())), precision=_ALL_DIGITS)


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
        turned = product(x, self.matrix.T.astype(x.dtype))
        return turned + jnp.broadcast_to(self.position.astype(x.dtype), x.shape)

    @property
    def matrix(self) -> Float[AnyArray, "3 3"]:
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


def checked_array(
    name: str,
    value: Numbers,
    shape: tuple[int, ...],
    *,
    least: int | float | None = None,
    above: int | float | None = None,
) -> Array:
    """`value` as a floating array of `shape`; NumPy rules for the dtype, finite unless traced.

    Args:
        name: Of the argument.
        value: What was given.
        shape: What it must have.
        least: What no entry may be below; default: none.
        above: What every entry must exceed.

    Raises:
        ValueError: If the shape differs, or an entry is not a number, not finite or out of range.
    """
    array = checked_floating(name, value)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
    if is_traced(array):
        return array
    host = np.asarray(array)
    if not np.all(np.isfinite(host)):
        raise ValueError(f"{name} must be finite, got {shown(host.tolist())}")
    if least is not None and not np.all(host >= least):
        raise ValueError(f"{name} must be ≥ {least:g}, got {shown(host.tolist())}")
    if above is not None and not np.all(host > above):
        raise ValueError(f"{name} must be > {above:g}, got {shown(host.tolist())}")
    return array


def checked_points(name: str, value: Numbers) -> Float[Array, "n 3"]:
    """`value` as at least one point, shape (n, 3).

    Raises:
        ValueError: If the shape is another, or a number is not finite.
    """
    array = checked_floating(name, value)
    if array.ndim != 2 or array.shape[1] != 3 or array.shape[0] == 0:
        raise ValueError(f"{name} must have shape (n, 3) with n ≥ 1, got {array.shape}")
    return checked_array(name, array, array.shape)


_LONGEST_QUATERNION = 10.0
"""Norm beyond which four numbers are rather an axis and an angle in degrees."""


def checked_quaternion(name: str, value: Numbers) -> Array:
    """`value` as a unit quaternion wxyz.

    Raises:
        ValueError: If the shape differs, an entry is not finite, the norm is zero, or so large that it is no
            quaternion.
    """
    array = checked_array(name, value, (4,))
    norm = 1.0 if is_traced(array) else float(np.linalg.norm(np.asarray(array)))
    if norm < 1e-12:
        raise ValueError(
            f"{name} must be a non-zero quaternion (w, x, y, z), got {np.asarray(array).tolist()}"
        )
    if norm > _LONGEST_QUATERNION:
        raise ValueError(
            f"{name} must be a quaternion (w, x, y, z), which is normalised, got {np.asarray(array).tolist()}"
            f" of length {norm:.3g}: an axis and an angle in degrees?"
        )
    return quat_normalize(array)


def floating(value: Numbers) -> Array:
    """`value` as a floating JAX array: floating arrays keep their dtype, the rest takes JAX's default."""
    dtype = getattr(value, "dtype", None)
    if dtype is not None and jnp.issubdtype(dtype, jnp.floating):
        return value if isinstance(value, jax.Array) else on_device(np.asarray(value))
    usual = jnp.result_type(float)
    if is_traced(value) or isinstance(value, jax.Array):
        return jnp.asarray(value, usual)
    return on_device(np.asarray(value, usual))


def on_device(value: np.ndarray | np.generic) -> Array:
    """`jnp.asarray` of an array of NumPy, for which that would compile a program."""
    return jax.device_put(np.array(value, jax.dtypes.canonicalize_dtype(value.dtype)))


def checked_numbers(name: str, value: Numbers) -> np.ndarray:
    """`value` as a floating array on the host, with NaN and infinities left in it.

    Raises:
        ValueError: If it holds something else than real numbers, or its rows differ in length.
    """
    try:
        if value is not None and not np.iscomplexobj(value):
            return np.array(value, float)
    except (TypeError, ValueError, OverflowError):
        pass
    raise ValueError(f"{name} must be a number or an array of real numbers, got {shown(value)}")


def _is_text(value: Any) -> bool:
    """Whether a value is a word, or a list with one: NumPy would read "0.3" as a number."""
    words = value if isinstance(value, (list, tuple)) else (value,)
    return any(isinstance(word, (str, bytes)) for word in words)


def checked_floating(name: str, value: Numbers) -> Array:
    """`floating` of what a user gave.

    Raises:
        ValueError: If it holds something else than real numbers, or its rows differ in length.
    """
    try:
        # NumPy would drop an imaginary part with a warning, and reads no tracers, alone or in a tuple.
        real = is_traced(value) or not (isinstance(value, bool) or _is_text(value) or np.iscomplexobj(value))
        array = floating(value) if real else None
    except (TypeError, ValueError, OverflowError):
        array = None
    if array is None:
        raise ValueError(f"{name} must be a number or an array of real numbers, got {shown(value)}")
    return array


def checked_key(key: PRNGKeyArray | None) -> PRNGKeyArray:
    """A random key; None stands for `jax.random.key(0)`.

    Raises:
        ValueError: If it is not a single key of JAX.
    """
    if key is None:
        return seed_key(0)
    dtype, shape = getattr(key, "dtype", None), getattr(key, "shape", None)
    typed = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key) and shape == ()
    # What `jax.random.PRNGKey` makes.
    old = dtype == np.uint32 and shape == (2,)
    if not (typed or old):
        raise ValueError(f"key must be one random key such as jax.random.key(0), got {shown(key)}")
    return key
