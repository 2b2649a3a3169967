"""The centroid law: numbers of the reference, limits, and its closed-form Jacobian."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano

H = jnp.asarray(0.01)
NORMAL = np.array([0.36, 0.48, 0.8])
PATCH = dano.Patch(jnp.asarray(0.02), jnp.zeros(3), jnp.asarray(NORMAL))
PARAMS = dano.ContactParams(
    spring=3e3,
    damper=4e3,
    sliding_friction=0.4,
    sliding_drag=0.05,
    torsional_friction=0.02,
    torsional_drag=0.003,
    rolling_friction=0.03,
    rolling_drag=0.004,
)
TWISTS = [
    np.array([0.1, -0.2, 0.3, 1.0, -2.0, 0.5]),
    np.array([0.0, 0.0, -0.5, 0.0, 0.0, 0.0]),
    np.array([1e-5, 2e-5, 0.0, 0.0, 1e-6, 0.0]),
    np.array([3.0, 1.0, 2.0, 0.1, 0.1, 0.1]),
]


def expected(twist, params, law, psi=0.02, n=NORMAL):
    """The equations of the law written out with NumPy."""

    def coulomb(u):
        speed = np.linalg.norm(u)
        return -(2 / np.pi) * np.arctan(law.smoothing * speed) * u / (law.regularizer + speed)

    v, w = twist[:3], twist[3:]
    v_n, w_n = n @ v, n @ w
    v_t, w_t = v - n * v_n, w - n * w_n
    normal = psi * (params.spring - params.damper * v_n)
    normal = normal if law.adhesive else max(normal, 0.0)
    size = abs(normal)
    force = normal * n + size * (params.sliding_friction * coulomb(v_t) - params.sliding_drag * v_t)
    torque = size * (params.torsional_friction * coulomb(n * w_n) - params.torsional_drag * n * w_n)
    torque = torque + size * (params.rolling_friction * coulomb(w_t) - params.rolling_drag * w_t)
    return np.concatenate([force, torque])


@pytest.mark.parametrize("adhesive", [False, True])
@pytest.mark.parametrize("twist", TWISTS)
def test_wrench_and_jacobian(twist, adhesive):
    law = dano.CentroidLaw(smoothing=12.0, regularizer=2e-3, adhesive=adhesive)
    wrench, jacobian = law.wrench(PATCH, PARAMS, jnp.asarray(twist), H)
    np.testing.assert_allclose(wrench, expected(twist, PARAMS, law), rtol=1e-12, atol=1e-12)
    by_autodiff = jax.jacfwd(lambda t: law.wrench(PATCH, PARAMS, t, H)[0])(jnp.asarray(twist))
    np.testing.assert_allclose(jacobian, by_autodiff, rtol=1e-9, atol=1e-9)
    step = 1e-7 * np.eye(6)
    by_difference = [
        (
            law.wrench(PATCH, PARAMS, jnp.asarray(twist + e), H)[0]
            - law.wrench(PATCH, PARAMS, jnp.asarray(twist - e), H)[0]
        )
        / 2e-7
        for e in step
    ]
    np.testing.assert_allclose(jacobian, np.stack(by_difference, axis=1), rtol=1e-3, atol=2e-3)


@pytest.mark.parametrize(
    ("smoothing", "speed", "factor"),
    [
        (30, 0.01, 0.169),
        (30, 0.1, 0.787),
        (30, 1, 0.978),
        (8, 0.03, 0.145),
        (100, 0.003, 0.139),
        (10, 3, 0.978),
    ],
)
def test_friction_saturation(smoothing, speed, factor):
    """Share of Coulomb's friction reached at a sliding speed, tabulated for the reference implementation."""
    params = dano.ContactParams(spring=1.0, damper=0.0, sliding_friction=1.0, sliding_drag=0.0)
    patch = dano.Patch(jnp.asarray(1.0), jnp.zeros(3), jnp.array([0.0, 0.0, 1.0]))
    wrench, _ = dano.CentroidLaw(smoothing=smoothing).wrench(
        patch, params, jnp.array([speed, 0, 0, 0, 0, 0.0]), H
    )
    assert -wrench[0] == pytest.approx(factor, abs=6e-4)


def test_contact_never_pulls_unless_adhesive():
    leaving = jnp.asarray(np.concatenate([2.0 * NORMAL, np.zeros(3)]))
    assert not np.any(dano.CentroidLaw().wrench(PATCH, PARAMS, leaving, H)[0])
    pulled, _ = dano.CentroidLaw(adhesive=True).wrench(PATCH, PARAMS, leaving, H)
    assert pulled[:3] @ NORMAL < 0


def test_rest_has_a_finite_jacobian():
    wrench, jacobian = dano.CentroidLaw().wrench(PATCH, PARAMS, jnp.zeros(6), H)
    np.testing.assert_allclose(wrench, np.concatenate([60.0 * NORMAL, np.zeros(3)]), atol=1e-12)
    assert np.all(np.isfinite(jacobian))
    assert np.all(
        np.isfinite(jax.jacrev(lambda t: dano.CentroidLaw().wrench(PATCH, PARAMS, t, H)[0])(jnp.zeros(6)))
    )


@pytest.mark.parametrize("name", dano.ContactParams.__dataclass_fields__)
@pytest.mark.parametrize("value", [-0.2, np.nan, np.inf])
def test_parameters_must_be_finite_and_not_negative(name, value):
    with pytest.raises(ValueError, match=name):
        dano.ContactParams(**{name: value})
