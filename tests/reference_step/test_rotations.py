"""The turn of a step and the momenta of a spin, slow and fast."""

import numpy as np
import pytest
from reference_step import formulas, rotations
from reference_step.rotations import momentum, spin_between, turn

H = 1e-3
INERTIA = np.array([[2.0, 0.3, -0.2], [0.3, 1.5, 0.1], [-0.2, 0.1, 1.0]])
AXIS = np.array([0.48, -0.6, 0.64])
SPINS = (0.0, 1.0, 10.0, 200.0, 999.0, 1001.0, 1500.0, 2000.0, 3000.0)


@pytest.mark.parametrize("spin", SPINS)
def test_turns_and_momenta(engine, spin):
    """The engine's are the reference's to rounding."""
    omega, q = spin * AXIS, np.array([0.5, -0.1, 0.7, 0.5])
    expected = rotations.multiply(q / np.linalg.norm(q), turn(omega, H))
    np.testing.assert_allclose(engine.turned(q / np.linalg.norm(q), omega, H), expected, atol=1e-14)
    for sign in (1, -1):
        np.testing.assert_allclose(
            engine.momentum(omega, INERTIA, H, sign),
            momentum(omega, INERTIA, H, sign),
            atol=1e-13 * (1 + spin),
        )


@pytest.mark.parametrize("size", [0.2, 0.9, 0.999, 1.001, 1.3, 3.0])
def test_derivatives_of_momentum_and_turn(size):
    """Closed forms of kernels against differences of the reference, on both sides of 60° a step."""
    h, omega = 0.01, size / 0.01 * np.array([0.48, -0.6, 0.64])
    by_omega, by_end = formulas.spin_slopes(omega, INERTIA, h)
    for k, unit in enumerate(np.eye(3)):
        step = 1e-4 * unit
        change = momentum(omega + step, INERTIA, h, 1) - momentum(omega - step, INERTIA, h, 1)
        np.testing.assert_allclose(by_omega[:, k], change / 2e-4, rtol=1e-6, atol=1e-6)
    start = np.array([0.5, -0.5, 0.5, 0.5])
    end = rotations.multiply(start, turn(omega, h))
    for k, small in enumerate(1e-6 * np.eye(3)):
        # Turned at the end by a small angle seen from the start.
        turned = rotations.multiply(
            start, rotations.multiply(rotations.exponential(small), rotations.conjugate(start))
        )
        ends = [rotations.multiply(x, end) for x in (turned, rotations.conjugate(turned))]
        change = (spin_between(start, ends[0], h) - spin_between(start, ends[1], h)) / 2e-6
        np.testing.assert_allclose(by_end[:, k], change, atol=1e-3 * (1 + size / 0.01))


def test_slow_spins_conserve_momentum():
    """P⁻ of a step is P of the same, seen from its end: free motion keeps its angular momentum."""
    omega = 800 * AXIS
    R = rotations.matrix(turn(omega, H))
    np.testing.assert_allclose(
        R @ momentum(omega, INERTIA, H, -1), momentum(omega, INERTIA, H, 1), rtol=1e-12
    )


def test_fast_spins_go_on_where_slow_ones_end():
    """At x = ½ the turn goes on, and the momentum with its slope."""
    below, at, above = (1000 - 1e-3, 1000.0, 1000 + 1e-3)
    np.testing.assert_allclose(turn(above * AXIS, H), turn(below * AXIS, H), atol=1e-6)
    P = [momentum(w * AXIS, INERTIA, H, 1) for w in (below, at, above)]
    np.testing.assert_allclose(P[2] - P[1], P[1] - P[0], atol=1e-4 * np.abs(P[1] - P[0]).max())


def test_momentum_of_very_fast_spins_is_that_of_continuous_time():
    """The relative distance of P and J ω falls like 1/ω, and nothing gyroscopic is left."""
    far = [momentum(w * AXIS, INERTIA, H, 1) / w - INERTIA @ AXIS for w in (1e5, 1e6)]
    np.testing.assert_allclose(far[0], 10 * far[1], rtol=1e-6)
    assert np.linalg.norm(far[1]) < 0.15 / (1e6 * H / 2) * np.linalg.norm(INERTIA @ AXIS)


@pytest.mark.parametrize("spin", [1e-9, 1.0, 999.0, 1001.0, 2000.0, 3000.0])
def test_spin_between_inverts_the_turn(spin):
    q = np.array([0.8, 0.0, 0.6, 0.0])
    omega = spin * AXIS
    found = spin_between(q, rotations.multiply(q, turn(omega, H)), H)
    np.testing.assert_allclose(found, omega, rtol=1e-11, atol=1e-12)
