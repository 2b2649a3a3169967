"""The law of a point: the engine against the reference, its derivatives against differences."""

import numpy as np
import pytest
from reference_step.collision import Points
from reference_step.law import Law, pressure, smooth_step, traction, wrench

HARD = Law(
    k=2e6, e=0.4, v_e=0.05, sigma=0.2, mu=0.5, phi=0.3, p_0=2e3, v_s=1e-7, theta=1.0, compliant=False, h=0.01,
    delta=1e-3, F=100.0, slowest_rebound=0.15, gravity=9.81, damper=300.0,
)  # fmt: skip
LAWS = {
    "default": HARD,
    "Coulomb": HARD._replace(phi=0.0, sigma=0.35, e=0.0),
    "compliant": HARD._replace(compliant=True, sigma=0.9, theta=0.5),
}
N = 400


def random_points(law, impact):
    """Points at depths around zero, that touch, sink in and rise, with or without an impact."""
    rng = np.random.default_rng(3)
    normal = rng.normal(size=(N, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    x = rng.normal(size=N)
    arm, drift = rng.normal(size=(2, N, 3)) * [[[0.1]], [[0.02]]]
    rate, depth = rng.normal(size=N), rng.normal(size=N) * 10 ** rng.uniform(-6, -1, N)
    # Slow samples of a pair that rests on something have less part in its impact.
    left_out = 0.4
    approach = rate - np.sum(normal * drift, axis=1)
    counts = 1 - (1 - smooth_step(-approach / law.slowest_rebound - 1)) * left_out
    return Points(
        first=0,
        second=1,
        law=law,
        share=0.6,
        com_difference=np.array([0.1, -0.2, 0.3]),
        arm=arm,
        normal=normal,
        moment=np.cross(arm, normal),
        depth=depth,
        rate=rate,
        meets=rng.normal(size=N),
        gains=0.1 * rng.normal(size=3),
        after=-0.1 * law.h,
        turns=(np.diag([-40.0, -30.0, -50.0]), np.array([2.0, 3.0, -4.0])),
        support=np.zeros(6),
        area=10 ** rng.uniform(-6, -3, N),
        drift=drift,
        impact=impact * np.where(x < 1, np.maximum(x, 0) ** 2, 2 * x - 1) * counts,
        kappa=impact,
        sunk=law.delta * x,
        delta=law.delta,
        deepest=5 * law.delta,
        beta=0.7 if impact > 0 else 0.0,
        delays=0.4 if impact > 0 else 0.0,
        way=0.36 if impact > 0 else 0.6,
        part=1.0,
        left_out=left_out,
    )


def random_motion(points, seed=4):
    """Separating speeds and slips from far below the stiction velocity to far above."""
    rng = np.random.default_rng(seed)
    slip = rng.normal(size=(N, 3)) * 10 ** rng.uniform(-9, 1, (N, 1))
    slip -= np.sum(slip * points.normal, axis=1, keepdims=True) * points.normal
    return rng.normal(size=N) * 10 ** rng.uniform(-9, 0, N), slip


@pytest.mark.parametrize("impact", [0.0, 1e4], ids=["spring", "impact"])
@pytest.mark.parametrize("name", LAWS)
def test_pressure_and_friction(engine, name, impact):
    """The engine's are the reference's to rounding."""
    points = random_points(LAWS[name], impact)
    rate, slip = random_motion(points)
    expected = traction(LAWS[name], points, rate, slip)
    assert np.sum(expected.p > 0) > 50
    p, f = engine.traction(LAWS[name], points, rate, slip)
    np.testing.assert_allclose(p, expected.p, rtol=1e-12)
    np.testing.assert_allclose(f, expected.f, rtol=1e-12, atol=1e-13 * expected.p.max())


@pytest.mark.parametrize("impact", [0.0, 1e4], ids=["spring", "impact"])
@pytest.mark.parametrize("name", LAWS)
def test_derivatives_are_those_of_differences(name, impact):
    """With a stiction velocity that differences resolve; next to kinks they differ."""
    law = LAWS[name]._replace(v_s=1e-2)
    points = random_points(law, impact)
    rng = np.random.default_rng(5)
    V = rng.normal(size=(2, 6)) * 0.2

    def force(change):
        return wrench(points, V + np.array([change, np.zeros(6)])).first

    step = 1e-7
    slopes = np.array([(force(step * e) - force(-step * e)) / (2 * step) for e in np.eye(6)]).T
    found = wrench(points, V).slope
    np.testing.assert_allclose(found, slopes, atol=1e-5 * np.abs(slopes).max())


def test_the_law_in_closed_form():
    """Points at rest, sliding, and too fast to be pressed, by hand."""
    law = HARD._replace(phi=0.0)
    points = random_points(law, 0.0)
    at = np.full(N, 0.002)
    deep = points._replace(depth=at)
    p, _ = pressure(law, deep, np.zeros(N), law.v_s)
    np.testing.assert_allclose(p, law.k * 0.002)
    # Slowly going in: all of the hysteresis, none of the damper.
    p, _ = pressure(law, deep, np.full(N, -1e-6), law.v_s)
    np.testing.assert_allclose(p, law.k * 0.002 * (1 + law.sigma), rtol=1e-4)
    # At v_e nothing presses; in as fast, twice the pressure of the depth at the end of the step.
    assert np.all(pressure(law, deep, np.full(N, law.v_e), law.v_s)[0] == 0)
    p, _ = pressure(law, deep, np.full(N, -3.0), law.v_s)
    np.testing.assert_allclose(p, 2 * law.k * (0.002 + law.h * 3.0))
    slip = np.cross(points.normal, np.array([0.0, 0.0, 1.0]))
    found = traction(law, deep, np.zeros(N), slip)
    np.testing.assert_allclose(np.linalg.norm(found.f, axis=1), law.mu * found.p)
    assert np.all(np.sum(found.f * slip, axis=1) < 0)


def test_compliant_impacts_return_restitution_squared():
    """The work of the spring out over the work in is e², whatever the way, for speeds far above v_e."""
    law = HARD._replace(compliant=True, sigma=0.0, v_e=1e-4, e=0.6, gravity=0.0, theta=0.5, h=1e-9)
    points = random_points(law, 0.0)
    depths = np.linspace(0, 0.01, N)
    into, out = (pressure(law, points._replace(depth=depths), np.full(N, v), 1e-7)[0] for v in (-2.0, 1.0))
    assert np.trapezoid(out, depths) / np.trapezoid(into, depths) == pytest.approx(0.6**2, rel=1e-6)
