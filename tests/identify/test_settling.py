"""Fits where the loss is rough: planes through draws, and a throw whose derivatives lead nowhere."""

import dataclasses
import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import dano
from benchmarks.identify import _cases
from dano.identification._residuals import plane_through, Smoothing
from dano.identification._settling import _directions
from dano.maths import quat_exp, quat_from_axis_angle, quat_multiply

N = 4


def plane(residuals, at, scale, lower=(), upper=()):
    spread = np.diag(scale)
    parts = _directions(N, 3), spread, np.linalg.inv(spread), np.array(lower, float), np.array(upper, float)
    draws, spread, inverse, lower, upper = map(jnp.asarray, parts)
    smoothing = Smoothing(draws, spread[None], inverse[None], lower, upper)
    return plane_through(lambda u: (residuals(u), u), at, smoothing, spread, inverse)


def test_a_plane_through_a_parabola_has_its_slope_and_no_ripple():
    rng = np.random.default_rng(0)
    slope, bend = rng.standard_normal((6, N)), rng.standard_normal((6, N))
    at, scale = jnp.asarray(rng.standard_normal(N)), np.array([0.1, 0.2, 0.01, 1.0])

    def residuals(u):
        return jnp.asarray(slope) @ (u - at) + 0.5 * jnp.asarray(bend) @ (u - at) ** 2 + 7.0

    found, middle = plane(residuals, at, scale)
    np.testing.assert_allclose(found.slope, slope, atol=1e-9)
    np.testing.assert_allclose(found.ripple, 0, atol=1e-12)
    np.testing.assert_allclose(middle, at)
    # Draws have variance one along each unknown.
    np.testing.assert_allclose(found.value, 7 + 0.5 * bend @ scale**2, rtol=1e-9)


def test_a_ripple_is_measured_and_does_not_make_the_slope():
    slope = np.arange(1.0, 1.0 + N)

    def residuals(u):
        ripple = 1e-2 * jnp.sin(1e5 * (u @ jnp.array([1.0, 0.7, 0.3, 0.9])))
        return jnp.stack([jnp.asarray(slope) @ u + ripple])

    found, _ = plane(residuals, jnp.zeros(N), np.ones(N))
    # The derivative at the point is 1000 times as large.
    np.testing.assert_allclose(found.slope[0], slope, atol=0.02)
    assert float(jnp.sqrt(jnp.mean(found.ripple**2))) == pytest.approx(1e-2, rel=0.6)


@pytest.mark.parametrize(("at", "lower", "upper"), [(0.0, 0.0, np.inf), (0.9, 0.0, 1.0), (0.1, 0.0, 0.2)])
def test_draws_stay_within_the_bounds_and_the_plane_goes_on_to_them(at, lower, upper):
    slope, scale = np.arange(1.0, 1.0 + N), np.array([0.04, 1.0, 1.0, 1.0])
    point = jnp.zeros(N).at[0].set(at)

    def residuals(u):
        inside = (u[0] >= lower) & (u[0] <= upper)
        return jnp.where(inside, jnp.stack([jnp.asarray(slope) @ u + 7.0]), jnp.nan)

    found, _ = plane(residuals, point, scale, [lower], [upper])
    np.testing.assert_allclose(found.slope[0], slope, rtol=1e-9)
    np.testing.assert_allclose(found.value, slope[0] * at + 7.0, rtol=1e-9)


def on_floor(body, friction, restitution):
    params = dano.ContactParams(sliding_friction=friction, restitution=restitution)
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    return dano.Scene.create([body, floor], [dano.Contact(body.name, "floor", params)], timestep=0.005)


def thrown(friction, restitution):
    return on_floor(dano.Body("box", dano.Box((0.05, 0.04, 0.03)), mass=1.0), friction, restitution)


def watched(name, run, rng):
    """Every other pose of a body, with noise, and that noise."""
    noise = {"position": 1e-3, "orientation": 1e-2}
    seen = np.array(run.states.position)[::2, :1]
    turn = quat_exp(jnp.asarray(noise["orientation"] * rng.standard_normal(seen.shape)))
    motion = dano.Motion.create(
        np.array(run.times)[::2],
        name,
        position=seen + noise["position"] * rng.standard_normal(seen.shape),
        orientation=np.asarray(quat_multiply(run.states.orientation[::2, :1], turn)),
    )
    return motion, noise


def friction_and_restitution(name):
    return [
        dano.Parameter("friction", lambda s: s.contact(name, "floor").sliding_friction, 0.05, 0.8),
        dano.Parameter("restitution", lambda s: s.contact(name, "floor").restitution, 0.0, 0.8),
    ]


def test_a_throw_is_found_from_far_away_starts():
    scene, rng = thrown(0.3, 0.3), np.random.default_rng(2)
    start = scene.initial_state(
        box=dict(position=(0, 0, 0.1), orientation=(1, 0.3, 0.2, 0.1), velocity=(0.8, 0, 0), omega=(2, 4, 1))
    )
    motion, noise = watched("box", dano.simulate(scene, start, 60), rng)
    parameters = friction_and_restitution("box")
    fits = []
    for guess in ((0.6, 0.6), (0.1, 0.1)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            fits.append(dano.identify(thrown(*guess), motion, parameters, initial="states", noise=noise))
    for fit in fits:
        for name in ("friction", "restitution"):
            # Ripples add about as much as the noise, of which alone a standard error knows.
            error = np.sqrt(2) * fit.standard_errors[name]
            assert abs(fit.values[name] - 0.3) < max(4 * error, 0.01)
            assert fit.standard_errors[name] < 0.1
            apart = abs(fit.values[name] - fits[0].values[name])
            assert apart < 3 * fit.standard_errors[name] + 0.01
        # Where the minimum of the trend is, ripples add about as much as the noise.
        assert fit.errors.rms < 2
    rough = [fit for fit in fits if fit.smoothed]
    assert rough
    for fit in rough:
        assert fit.worth is not None and fit.to_dict()["worth"] == fit.worth.summary


@pytest.mark.slow
def test_a_walk_begins_again_where_residuals_are_not_those_of_the_noise():
    """A throw of which another motion fits the first impacts: with it χ² is three times what it should be."""
    case = _cases.CASES["throws"]()
    motion = _cases.observed(case, 12)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        options = dano.IdentifyOptions(starts=2)
        fit = dano.identify(
            case.scene, motion, case.parameters, initial="states", noise=case.noise, options=options
        )
    for end in fit.minima:
        assert 2 * end.loss < 1.5 * fit.freedom
        for name, truth in case.truth.items():
            assert abs(end.values[name] - truth) < 3 * fit.standard_errors[name]


def test_a_parameter_without_room_is_held():
    scene, rng = thrown(0.3, 0.3), np.random.default_rng(2)
    start = scene.initial_state(box=dict(position=(0, 0, 0.08), velocity=(0.8, 0, 0), omega=(1, 2, 1)))
    motion, noise = watched("box", dano.simulate(scene, start, 40), rng)
    friction, held = friction_and_restitution("box")
    held = dataclasses.replace(held, lower=0.3, upper=0.3)
    with warnings.catch_warnings():
        # That it lies on its bound is said where the data pull it further.
        warnings.simplefilter("ignore", RuntimeWarning)
        fit = dano.identify(thrown(0.5, 0.3), motion, [friction, held], initial="states", noise=noise)
    assert fit.values["restitution"] == pytest.approx(0.3)
    assert abs(fit.values["friction"] - 0.3) < 4 * fit.standard_errors["friction"]


@pytest.mark.slow
def test_a_tumbling_bunny_has_one_answer():
    """Searches by the beginnings of the motion alone ended at another bounce, with a restitution of .36."""
    bunny = dano.Body("bunny", dano.load_object("bunny"))
    true, rng = on_floor(bunny, 0.3, 0.3), np.random.default_rng(0)
    axis, around = rng.standard_normal(3), rng.uniform(0, 2 * np.pi)
    start = true.initial_state(
        bunny=dict(
            position=(0, 0, 0.12),
            orientation=quat_from_axis_angle(axis, rng.uniform(0, np.pi)),
            velocity=0.8 * np.array([np.cos(around), np.sin(around), 0]),
            omega=3.0 * rng.standard_normal(3),
        )
    )
    motion, noise = watched("bunny", dano.simulate(true, start, 80), rng)
    parameters = friction_and_restitution("bunny")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        fits = [
            dano.identify(on_floor(bunny, *guess), motion, parameters, initial="states", noise=noise)
            for guess in ((0.5, 0.5), (0.72, 0.04))
        ]
    for name in ("friction", "restitution"):
        error = fits[0].standard_errors[name]
        assert abs(fits[0].values[name] - 0.3) < 4 * error
        assert abs(fits[1].values[name] - fits[0].values[name]) < 0.5 * error
