"""What a derivative is worth, on functions whose answer is known, and on throws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.gradients import check, Verdict


def test_a_smooth_function_is_true_to_its_derivative():
    found = check(lambda x: jnp.sum(jnp.sin(x)), jnp.array([0.3, 1.0, 2.0]))
    assert found.trusted and found.verdict is Verdict.TRUE
    np.testing.assert_allclose([line.derivative for line in found.lines], np.cos([0.3, 1.0, 2.0]), rtol=1e-9)
    np.testing.assert_allclose([line.slopes[-1] for line in found.lines], np.cos([0.3, 1, 2]), rtol=1e-5)
    assert found.value == pytest.approx(float(np.sum(np.sin([0.3, 1.0, 2.0]))))


def rippled(amplitude):
    """A slope of one with a ripple of 1e-4 in length."""
    return lambda x: x + amplitude * jnp.sin(1e4 * x)


@pytest.mark.parametrize(
    ("function", "x", "verdict"),
    [
        (rippled(1e-3), 1.0, Verdict.ROUGH),
        (rippled(1e-7), 1.0, Verdict.TRUE),
        (lambda x: 0.0 * x + 3.0, 1.0, Verdict.FLAT),
        (lambda x: jnp.abs(x), 0.0, Verdict.KINK),
        (lambda x: jax.lax.stop_gradient(x) ** 2, 1.0, Verdict.WRONG),
        (lambda x: jax.lax.stop_gradient(x) ** 2 + x**2, 1.0, Verdict.WRONG),
        # A ripple whose slope adds half of that of the trend.
        (lambda x: x + 5e-4 * jnp.sin(1e3 * x), float(2 * np.pi * 160 / 1e3), Verdict.COARSE),
        (lambda x: jnp.sqrt(x), 0.0, Verdict.LOST),
        (lambda x: x**2, 0.0, Verdict.TRUE),
        # Over ±1e-2 a wave of 1e-1 in length bends.
        (lambda x: jnp.sin(130 * x), 0.1, Verdict.CURVED),
        (lambda x: jnp.where(x > 1.0, 1.0, 0.0) + 0.1 * x, 1.0, Verdict.ROUGH),
    ],
)
def test_verdicts(function, x, verdict):
    found = check(function, x, scale=1.0)
    assert found.verdict is verdict, str(found)
    assert found.trusted is verdict.trusted
    assert found.verdict.value in str(found)


def test_roughness_is_the_ripple_and_slopes_are_the_trend():
    (line,) = check(rippled(1e-3), 1.0, points=201).lines
    # The mean square of a sine is one half.
    assert line.roughness == pytest.approx(1e-3 / np.sqrt(2), rel=0.15)
    assert line.slopes[0] == pytest.approx(1.0, abs=0.1)
    assert abs(line.derivative - 1.0) > 5


def test_trees_are_named_by_their_paths_and_other_leaves_stay():
    x = {"friction": jnp.asarray(0.3), "name": "floor", "place": jnp.array([1.0, 2.0])}
    found = check(lambda t: t["friction"] * jnp.sum(t["place"] ** 2) * len(t["name"]), x)
    assert [line.label for line in found.lines] == ["['friction']", "['place'][0]", "['place'][1]"]
    np.testing.assert_allclose([line.derivative for line in found.lines], [25, 3, 6])
    many = check(lambda v: jnp.sum(v**2), jnp.arange(1.0, 40.0), directions=5)
    assert len(many.lines) == 5 and many.trusted


def test_functions_that_look_at_values_are_called_one_by_one():
    calls = []

    def looked(x):
        calls.append(float(x[0]))
        return float(x[0]) ** 2

    found = check(looked, np.array([2.0]), gradient=np.array([4.0]))
    assert found.trusted and found.lines[0].derivative == pytest.approx(4.0)
    assert len(calls) == 23
    assert check(looked, np.array([2.0]), gradient=np.array([-4.0])).verdict is Verdict.WRONG


def test_functions_that_look_at_what_they_hold_are_not_compiled():
    weights = jnp.array([1.0, 2.0])
    found = check(lambda x: float(jnp.sum(weights)) * x**2, 2.0)
    assert found.trusted and found.lines[0].derivative == pytest.approx(12.0)


def test_forward_mode_and_single_precision():
    forward = check(lambda x: jnp.sum(x**3), jnp.array([1.0, 2.0]), gradient="forward")
    np.testing.assert_allclose([line.derivative for line in forward.lines], [3, 12])
    single = check(lambda x: 1000 + jnp.sin(x), np.float32(0.5), steps=(1e-2, 1e-4))
    # A step of 5e-5 changes 1000 by less than single precision shows.
    assert single.trusted, str(single)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": (0.0,)}, "each of steps must be finite and > 0, got 0"),
        ({"steps": ()}, "steps must be a list"),
        ({"points": 8}, "points must be odd"),
        ({"gradient": "both"}, "gradient must be one of reverse, forward"),
        ({"scale": -1.0}, "scale must be finite and > 0"),
        ({"labels": ["a", "b"]}, "labels must be 1"),
        ({"gradient": (1.0, 2.0)}, "gradient must be of the structure of x"),
    ],
)
def test_bad_arguments(options, message):
    with pytest.raises(ValueError, match=message):
        check(lambda x: x**2, 1.0, **options)
    with pytest.raises(ValueError, match="x must hold real numbers"):
        check(lambda x: x, 1)
    with pytest.raises(ValueError, match="function must return one number"):
        check(lambda x: jnp.stack([x, x]), 1.0)


def test_a_slide_is_true_and_so_is_what_is_said_of_it():
    bodies = [
        dano.Body("ball", dano.Sphere(0.05), mass=1.0),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    params = dano.ContactParams(sliding_friction=0.25)
    scene = dano.Scene.create(bodies, [dano.Contact("ball", "floor", params)], timestep=0.01)
    state = scene.initial_state(ball=dict(position=(0, 0, 0.05), velocity=(1, 0, 0)))

    def gone(friction):
        slid = scene.replace_contact("ball", "floor", sliding_friction=friction)
        return dano.simulate(slid, state, 20).states.position[-1, 0, 0]

    found = check(gone, 0.25, labels=["friction"])
    assert found.trusted, str(found)
    assert "friction" in str(found) and found.lines[0].derivative < 0
