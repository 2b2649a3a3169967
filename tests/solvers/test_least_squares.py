"""Bounded least squares against SciPy, closed forms and brute force."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from dano.solvers import (
    bounded_least_squares,
    eliminated,
    Iterate,
    LeastSquaresOptions,
    NormalEquations,
    Stop,
)

ROSENBROCK = (
    lambda x: np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]),
    lambda x: np.array([[-20 * x[0], 10.0], [-1.0, 0.0]]),
)
T = np.linspace(0, 2, 15)
DECAY = (
    lambda x: x[0] * np.exp(-x[1] * T) - 2 * np.exp(-0.7 * T) - 0.05 * np.sin(9 * T),
    lambda x: np.stack([np.exp(-x[1] * T), -x[0] * T * np.exp(-x[1] * T)], axis=1),
)


def solve(problem, start, lower, upper, **options):
    residual, jacobian = problem
    p = 2

    def linearize(x, _):
        r, j = residual(x), jacobian(x)
        empty = np.zeros((0, 0)), np.zeros((0, 0, 0)), np.zeros((0, 0, p))
        return NormalEquations(0.5 * r @ r, j.T @ r, j.T @ j, *empty, np.zeros(0))

    return bounded_least_squares(
        linearize,
        start if isinstance(start, Iterate) else np.array(start, float),
        lower=np.array(lower, float),
        upper=np.array(upper, float),
        options=LeastSquaresOptions(max_iterations=200),
        **options,
    )


@pytest.mark.parametrize(
    ("problem", "start", "lower", "upper"),
    [
        (ROSENBROCK, (-1.2, 1.0), (-np.inf, -np.inf), (np.inf, np.inf)),
        (ROSENBROCK, (-1.2, 1.0), (-2, -2), (0.5, 2)),
        (ROSENBROCK, (-1.2, 1.5), (-2, 1.5), (2, 2)),
        (ROSENBROCK, (-2.0, 2.0), (-2, -2), (0.8, 2)),
        (DECAY, (0.0, 0.0), (0, 0), (5, 5)),
        (DECAY, (0.0, 3.0), (0, 0), (1.5, 5)),
        (DECAY, (1.0, 1.0), (0, 0.9), (5, 5)),
        (DECAY, (3.0, 5.0), (2.5, 0), (3, 5)),
    ],
)
def test_agrees_with_scipy(problem, start, lower, upper):
    inside = np.clip(start, np.array(lower) + 1e-3, np.array(upper) - 1e-3)
    reference = least_squares(
        problem[0], inside, problem[1], bounds=(lower, upper), xtol=1e-14, gtol=1e-14, ftol=1e-14
    )
    found = solve(problem, start, lower, upper)
    assert found.stop.converged
    assert found.normal.loss == pytest.approx(reference.cost, rel=1e-6, abs=1e-12)
    np.testing.assert_allclose(found.x, reference.x, atol=2e-5)
    assert np.all((lower <= found.x) & (found.x <= np.array(upper)))


def test_losses_never_grow_and_are_those_of_the_accepted_points():
    found = solve(ROSENBROCK, (-1.2, 1.0), (-2, -2), (2, 2))
    assert np.all(np.diff(found.losses) <= 0)
    assert found.losses[0] == pytest.approx(0.5 * np.sum(ROSENBROCK[0](np.array([-1.2, 1.0])) ** 2))
    assert found.losses[-1] == pytest.approx(found.normal.loss)


def blocks_problem(seed):
    """Lines y = a_i + s t with a common slope s and private offsets a_i, and its dense twin."""
    rng = np.random.default_rng(seed)
    t = rng.normal(size=(4, 7))
    y = 1.5 * t + rng.normal(size=(4, 1)) + 0.1 * rng.normal(size=(4, 7))

    def residual(x, z):
        return x[0] * t + z - y

    def linearize(x, z):
        r = residual(x, z)
        return NormalEquations(
            0.5 * np.sum(r**2),
            np.array([np.sum(r * t)]),
            np.array([[np.sum(t * t)]]),
            r.sum(axis=1, keepdims=True),
            np.full((4, 1, 1), 7.0),
            t.sum(axis=1)[:, None, None],
            0.5 * np.sum(r**2, axis=1),
        )

    dense = np.concatenate([t.reshape(-1, 1), np.kron(np.eye(4), np.ones((7, 1)))], axis=1)
    return residual, linearize, dense, y.ravel()


@pytest.mark.parametrize("bound", [np.inf, 1.2])
def test_blocks_are_eliminated_exactly(bound):
    residual, linearize, dense, y = blocks_problem(1)
    found = bounded_least_squares(
        linearize,
        np.zeros(1),
        lower=np.array([-np.inf]),
        upper=np.array([bound]),
        start_blocks=np.zeros((4, 1)),
        retract=lambda z, dz: z + dz,
    )
    if np.isinf(bound):
        expected = np.linalg.lstsq(dense, y)[0]
    else:
        offsets = np.linalg.lstsq(dense[:, 1:], y - bound * dense[:, 0])[0]
        expected = np.append(bound, offsets)
    np.testing.assert_allclose(np.append(found.x, found.blocks.ravel()), expected, rtol=1e-6)
    # The inverse of the eliminated Hessian is the corner of the inverse of the whole.
    _, hessian = eliminated(found.normal)
    np.testing.assert_allclose(1 / hessian, np.linalg.inv(dense.T @ dense)[:1, :1], rtol=1e-9)


def test_blocks_that_bend_hold_up_no_others():
    """Circles through points far around (x, z): each block bends, and each first step is too long."""
    rng = np.random.default_rng(4)
    turns = rng.uniform(-1.2, 1.2, 8)
    calls = []

    def linearize(x, z):
        # Residuals x cos z − c, x sin z − s.
        calls.append((x.copy(), z.copy()))
        r = np.stack([x[0] * np.cos(z[:, 0]) - 2 * np.cos(turns), x[0] * np.sin(z[:, 0]) - 2 * np.sin(turns)])
        by_x = np.stack([np.cos(z[:, 0]), np.sin(z[:, 0])])
        by_z = x[0] * np.stack([-np.sin(z[:, 0]), np.cos(z[:, 0])])
        return NormalEquations(
            0.5 * np.sum(r**2),
            np.array([np.sum(r * by_x)]),
            np.array([[np.sum(by_x**2)]]),
            np.sum(r * by_z, axis=0)[:, None],
            np.sum(by_z**2, axis=0)[:, None, None],
            np.sum(by_x * by_z, axis=0)[:, None, None],
            0.5 * np.sum(r**2, axis=0),
        )

    start = turns + np.where(np.arange(8) < 6, 0.1, 2.3)
    found = bounded_least_squares(
        linearize,
        np.ones(1),
        lower=np.array([0.1]),
        upper=np.array([10.0]),
        start_blocks=start[:, None],
        retract=lambda z, dz: z + dz,
    )
    assert found.x[0] == pytest.approx(2, abs=1e-6)
    np.testing.assert_allclose(found.blocks[:, 0], turns, atol=1e-5)
    assert np.all(np.diff(found.losses) <= 0)
    # Blocks tried again at the same x while others stayed where they were.
    pairs = [(a[1] != b[1]) for a, b in zip(calls[:-1], calls[1:], strict=True) if a[0] == b[0]]
    assert any(0 < changed.sum() < 8 for changed in pairs)


def test_a_block_that_hardly_answers_does_not_run_off():
    """As the speed of a joint that sticks: it changes next to nothing, until it breaks away."""
    t = np.array([1.0, 2.0, 3.0])
    truth, turns = 0.7, np.array([0.3, -0.2, 0.0])
    weak = np.array([0.0, 0.0, 1.0])

    def answer(z):
        away = np.maximum(np.abs(z) - 1, 0)
        stuck, slope = 1e-9 * z + 1e3 * np.sign(z) * away**2, 1e-9 + 2e3 * away
        return np.where(weak, stuck, z), np.where(weak, slope, 1.0)

    seen = truth * t + answer(turns)[0][:, None] + 1e-3 * np.sin(7 * np.arange(9)).reshape(3, 3)

    def linearize(x, z):
        moved, slope = answer(z)
        r = x[0] * t + moved[:, None] - seen
        return NormalEquations(
            0.5 * np.sum(r**2),
            np.array([np.sum(r * t)]),
            np.array([[3 * t @ t]]),
            np.sum(r, axis=1)[:, None] * slope[:, None],
            (3 * slope**2)[:, None, None],
            (t.sum() * slope)[:, None, None],
            0.5 * np.sum(r**2, axis=1),
        )

    found = bounded_least_squares(
        linearize,
        np.array([-4.0]),
        lower=np.array([-5.0]),
        upper=np.array([5.0]),
        start_blocks=np.zeros(3),
        retract=lambda blocks, change: blocks + change[:, 0],
        options=LeastSquaresOptions(max_iterations=100),
    )
    assert found.x[0] == pytest.approx(truth, abs=2e-3)
    np.testing.assert_allclose(found.blocks[:2], turns[:2], atol=5e-3)
    assert abs(found.blocks[2]) < 1.1


def test_a_direction_without_curvature_stays_where_it_is():
    flat = lambda x: np.array([x[0] - 1.0]), lambda x: np.array([[1.0, 0.0]])
    found = solve(flat, (0.0, 0.3), (-2, -2), (2, 2))
    np.testing.assert_allclose(found.x, [1.0, 0.3], atol=1e-6)


def test_says_why_it_stopped():
    assert solve(ROSENBROCK, (1.0, 1.0), (-2, -2), (2, 2)).stop in (Stop.LOSS, Stop.PERFECT)
    residual, jacobian = ROSENBROCK
    few = bounded_least_squares(
        lambda x, _: NormalEquations(
            0.5 * np.sum(residual(x) ** 2),
            jacobian(x).T @ residual(x),
            jacobian(x).T @ jacobian(x),
            np.zeros((0, 0)),
            np.zeros((0, 0, 0)),
            np.zeros((0, 0, 2)),
            np.zeros(0),
        ),
        np.array([-1.2, 1.0]),
        lower=np.full(2, -2.0),
        upper=np.full(2, 2.0),
        options=LeastSquaresOptions(max_iterations=2),
    )
    assert few.stop is Stop.ITERATIONS
    # A gradient of the wrong sign: nothing helps, and that is said.
    wrong = ROSENBROCK[0], lambda x: -ROSENBROCK[1](x)
    assert solve(wrong, (-1.2, 1.0), (-2, -2), (2, 2)).stop is Stop.STUCK
    assert not Stop.STUCK.converged


def test_an_interrupt_keeps_the_best_point():
    def stop_at_three(now):
        if len(now.losses) == 4:
            raise KeyboardInterrupt

    found = solve(ROSENBROCK, (-1.2, 1.0), (-2, -2), (2, 2), callback=stop_at_three)
    assert found.stop is Stop.INTERRUPTED
    assert len(found.losses) == 4
    assert found.normal.loss == found.losses[-1]


def test_goes_on_where_it_was():
    seen = []
    whole = solve(ROSENBROCK, (-1.2, 1.0), (-2, -2), (2, 2), callback=seen.append)
    rest = solve(ROSENBROCK, seen[5], (-2, -2), (2, 2))
    np.testing.assert_array_equal(rest.x, whole.x)
    np.testing.assert_array_equal(rest.losses, whole.losses)


@pytest.mark.parametrize(
    ("start", "lower", "upper", "match"),
    [
        ((0.0, 0.0), (1, 1), (0, 0), "lower must be ≤ upper"),
        ((3.0, 0.0), (-1, -1), (1, 1), "start must lie between"),
        ((0.0, 0.0), (-1,), (1, 1), "one length"),
        ((np.nan, 0.0), (-1, -1), (1, 1), "start must lie"),
    ],
)
def test_bad_input(start, lower, upper, match):
    with pytest.raises(ValueError, match=match):
        solve(ROSENBROCK, start, lower, upper)


def test_loss_that_is_not_finite_at_the_start():
    bad = lambda x: np.array([np.nan, 0.0]), lambda x: np.eye(2)
    with pytest.raises(ValueError, match="finite at the start"):
        solve(bad, (0.0, 0.0), (-1, -1), (1, 1))


def test_derivatives_that_are_not_finite():
    """At the start they are an error by name; further on, such a step is rejected."""
    bad = lambda x: x - 2.0, lambda x: np.full((2, 2), np.nan)
    with pytest.raises(ValueError, match="derivatives of the loss must be finite at the start"):
        solve(bad, (0.0, 0.0), (-9, -9), (9, 9))
    cliff = lambda x: x - 2.0, lambda x: np.eye(2) * (np.nan if x[0] > 1.0 else 1.0)
    found = solve(cliff, (0.0, 0.0), (-9, -9), (9, 9))
    assert found.x[0] <= 1.0 and np.isfinite(found.normal.gradient).all()
