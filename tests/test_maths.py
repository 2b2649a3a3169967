"""Rotations and norms: a group, its exponential map, matrices; with JAX and with NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from dano.maths import (
    checked_array,
    column_norm,
    Pose,
    quat_conjugate,
    quat_exp,
    quat_from_axis_angle,
    quat_from_matrix,
    quat_log,
    quat_multiply,
    quat_rotate,
    quat_slerp,
    quat_to_matrix,
    safe_norm,
    safe_normalize,
    skew,
)

N = 50
rng = np.random.default_rng(0)
P, Q, R = rng.normal(size=(3, N, 4)) / 1.0
P, Q, R = (q / np.linalg.norm(q, axis=1, keepdims=True) for q in (P, Q, R))
VECTORS = rng.normal(size=(N, 3))
DIRECTIONS = VECTORS / np.linalg.norm(VECTORS, axis=1, keepdims=True)
ANGLES = (0.0, 1e-200, 1e-12, 1e-6, 1e-3, 0.019, 0.021, 1.0, 3.0, np.pi - 1e-3, np.pi - 1e-9)

both = pytest.mark.parametrize("array", [np.asarray, jnp.asarray], ids=["numpy", "jax"])


def reference(q) -> Rotation:
    return Rotation.from_quat(np.asarray(q), scalar_first=True)


def assert_same_turn(p, q, atol=1e-12):
    np.testing.assert_allclose(reference(p).as_matrix(), reference(q).as_matrix(), atol=atol)


@both
def test_unit_quaternions_are_a_group(array):
    p, q, r = (array(x) for x in (P, Q, R))
    one = array(np.array([1.0, 0.0, 0.0, 0.0]))
    close = np.testing.assert_allclose
    close(quat_multiply(p, quat_multiply(q, r)), quat_multiply(quat_multiply(p, q), r), atol=1e-14)
    close(quat_multiply(one[None], q), q, atol=0)
    close(quat_multiply(q, one[None]), q, atol=0)
    close(quat_multiply(q, quat_conjugate(q)), np.broadcast_to(one, q.shape), atol=1e-14)
    close(np.linalg.norm(quat_multiply(p, q), axis=1), 1, atol=1e-14)


@both
def test_quaternions_act_on_vectors_as_their_matrices_do(array):
    p, q, v = array(P), array(Q), array(VECTORS)
    close = np.testing.assert_allclose
    close(quat_rotate(q, v), reference(Q).apply(VECTORS), atol=1e-14)
    close(quat_to_matrix(q), reference(Q).as_matrix(), atol=1e-14)
    close(quat_rotate(quat_multiply(p, q), v), quat_rotate(p, quat_rotate(q, v)), atol=1e-13)
    close(quat_to_matrix(quat_multiply(p, q)), np.asarray(quat_to_matrix(p) @ quat_to_matrix(q)), atol=1e-14)


@both
def test_matrices_and_quaternions_round_trip(array):
    # Half turns too, whose quaternions have w = 0, and those about axes, which have two zeros more.
    half = np.concatenate([0 * DIRECTIONS[:, :1], DIRECTIONS], axis=1)
    for q in (Q, half, np.eye(4), np.abs(half) * [1.0, -1, 1, 1]):
        found = quat_from_matrix(quat_to_matrix(array(q)))
        assert np.all(np.asarray(found)[:, 0] >= 0)
        np.testing.assert_allclose(np.abs(np.sum(np.asarray(found) * q, axis=1)), 1, atol=1e-14)
    assert quat_from_matrix(array(np.eye(3))).shape == (4,)


def test_a_nearly_orthogonal_matrix_gives_a_unit_quaternion_nearby():
    off = quat_to_matrix(Q) + 1e-4 * rng.normal(size=(N, 3, 3))
    found = quat_from_matrix(off)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-14)
    assert np.max((reference(found) * reference(Q).inv()).magnitude()) < 1e-3


@both
@pytest.mark.parametrize("angle", ANGLES)
def test_exp_and_log_undo_each_other(array, angle):
    vectors = angle * DIRECTIONS
    q = quat_exp(array(vectors))
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-15)
    np.testing.assert_allclose(quat_log(q), vectors, rtol=1e-7 if angle > 3.1 else 1e-13, atol=1e-300)
    np.testing.assert_allclose(quat_log(-q), vectors, rtol=1e-7 if angle > 3.1 else 1e-13, atol=1e-300)
    np.testing.assert_allclose(
        quat_to_matrix(q), np.stack([expm(np.asarray(skew(jnp.asarray(v)))) for v in vectors]), atol=1e-13
    )


@both
def test_log_is_the_shortest_rotation_vector(array):
    np.testing.assert_allclose(quat_log(array(Q)), reference(Q).as_rotvec(), atol=1e-13)
    half = np.concatenate([0 * DIRECTIONS[:, :1], DIRECTIONS], axis=1)
    np.testing.assert_allclose(np.linalg.norm(quat_log(array(half)), axis=1), np.pi, atol=1e-14)
    # A common factor, as rounding makes it, does not change the rotation.
    np.testing.assert_allclose(quat_log(array(0.9 * Q)), quat_log(array(Q)), atol=1e-13)
    unknown = np.where(np.arange(N)[:, None] == 3, np.nan, Q)
    assert np.argwhere(np.isnan(quat_log(array(unknown))).all(axis=1)).tolist() == [[3]]


@both
def test_exp_and_log_follow_their_dtype(array):
    for angle in ANGLES:
        vectors = array((angle * DIRECTIONS).astype(np.float32))
        q = quat_exp(vectors)
        assert q.dtype == quat_log(q).dtype == np.float32
        assert np.all(np.isfinite(quat_log(q)))
        assert_same_turn(q, quat_exp(np.asarray(vectors, float)), atol=1e-6)


@pytest.mark.parametrize("angle", ANGLES)
def test_derivatives_of_exp_and_log(angle):
    v = jnp.asarray(angle * DIRECTIONS[0])
    # d exp(v) ≈ ½ exp(v) ⊗ (0, J v̇) with the right Jacobian J of the rotation group.
    turn, size = np.asarray(skew(v)), max(angle, 1e-9)
    right = np.eye(3) - 0.5 * turn + turn @ turn / 6
    if angle > 1e-3:
        right = (
            np.eye(3) - (1 - np.cos(size)) / size**2 * turn + (size - np.sin(size)) / size**3 * turn @ turn
        )
    body = np.concatenate([np.zeros((1, 3)), 0.5 * right])
    expected = np.stack([quat_multiply(np.asarray(quat_exp(v)), column) for column in body.T], axis=1)
    found = jax.jacfwd(quat_exp)(v)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    # log undoes exp, also to first order.
    there_and_back = jax.jacrev(lambda x: quat_log(quat_exp(x)))(v)
    np.testing.assert_allclose(there_and_back, np.eye(3), atol=1e-5 if angle > 3.1 else 1e-10)


def test_second_derivatives_at_no_turn():
    # q(v) = (1 − |v|²/8, v/2) + O(|v|³).
    hessian = jax.hessian(quat_exp)(jnp.zeros(3))
    np.testing.assert_allclose(hessian[0], -0.25 * np.eye(3), atol=1e-15)
    np.testing.assert_allclose(hessian[1:], 0, atol=1e-15)


def test_derivatives_of_matrices():
    def turned(v):
        return quat_from_matrix(quat_to_matrix(quat_exp(v)))

    for v in (VECTORS[0], 3.1 * DIRECTIONS[1], 1e-3 * VECTORS[2]):
        check_grads(jax.jit(turned), (jnp.asarray(v),), 1, eps=1e-3)


@both
def test_slerp_turns_evenly_and_the_shorter_way(array):
    p, q = array(P), array(np.where(np.arange(N)[:, None] % 2, Q, -Q))
    shares = np.linspace(0, 1, 5)
    path = [np.asarray(quat_slerp(p, q, array(np.full(N, share)))) for share in shares]
    assert_same_turn(path[0], P)
    assert_same_turn(path[-1], Q)
    whole = (reference(P).inv() * reference(Q)).as_rotvec()
    for share, q in zip(shares, path, strict=True):
        np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-14)
        np.testing.assert_allclose((reference(P).inv() * reference(q)).as_rotvec(), share * whole, atol=1e-12)
    np.testing.assert_allclose(quat_slerp(p, p, array(np.full(N, 0.3))), P, atol=1e-14)


def test_axis_and_angle():
    for axis, angle in ((0.0, 0.0, 2.0), 0.5 * np.pi), ((1.0, -2.0, 0.5), 5.0), ((1, 0, 0), 0):
        unit = np.asarray(axis, float) / np.linalg.norm(axis)
        assert_same_turn(
            quat_from_axis_angle(axis, angle), Rotation.from_rotvec(angle * unit).as_quat(scalar_first=True)
        )
    slope = jax.jacfwd(lambda a: quat_from_axis_angle((0.0, 3.0, 0.0), a))(0.0)
    np.testing.assert_allclose(slope, [0, 0, 0.5, 0], atol=1e-15)


def test_poses_are_a_group():
    poses = [Pose(v, q) for v, q in zip(VECTORS[:3], Q[:3], strict=True)]
    a, b, c = poses
    x = jnp.asarray(VECTORS[3:10])
    np.testing.assert_allclose((a @ b).apply(x), a.apply(b.apply(x)), atol=1e-13)
    np.testing.assert_allclose(((a @ b) @ c).apply(x), (a @ (b @ c)).apply(x), atol=1e-13)
    np.testing.assert_allclose((a @ a.inverse()).apply(x), x, atol=1e-13)
    np.testing.assert_allclose((a.inverse() @ a).apply(x), x, atol=1e-13)


def test_norms_differentiate_at_zero():
    for norm in (safe_norm, column_norm):
        np.testing.assert_array_equal(jax.grad(norm)(jnp.zeros(3)), 0)
        np.testing.assert_allclose(norm(jnp.asarray([3.0, 4.0, 12.0])), 13)
        np.testing.assert_allclose(jax.grad(norm)(jnp.asarray([3.0, 4.0, 12.0])), np.array([3, 4, 12]) / 13)
    np.testing.assert_array_equal(safe_normalize(jnp.zeros(3)), 0)


def test_skew_is_the_cross_product():
    a, b = jnp.asarray(VECTORS[0]), jnp.asarray(VECTORS[1])
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-15)


def test_arguments_may_hold_traced_numbers():
    """A user's velocity=(v, 0, 0) under jax.grad."""

    def size(v):
        return jnp.sum(checked_array("velocity", (v, 0, 2), (3,)) ** 2)

    assert float(jax.grad(size)(3.0)) == 6.0
    with pytest.raises(ValueError, match="velocity must be a number or an array of real numbers"):
        checked_array("velocity", (1j, 0, 2), (3,))
