"""Gradients of the final pose: forward = reverse = differences, on slide, bounce, tumble and a hit."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from engine.scenes import last, on_floor, point_cloud_box

import dano

PARAMETERS = [
    "friction",
    "spring",
    "damper",
    "mass scale",
    "velocity",
    "com offset",
    "control",
    "other position",
]


def perturbed(scene, start, theta):
    """The scene, state and control with a relative or absolute change of each parameter of PARAMETERS."""
    a, b = scene.contacts[0].a, scene.contacts[0].b
    params = scene.contact(a, b)
    scene = scene.replace_contact(
        a,
        b,
        sliding_friction=params.sliding_friction + theta[0],
        spring=params.spring * (1 + theta[1]),
        damper=params.damper * (1 + theta[2]),
    )
    scene = scene.replace_body(
        a, mass_scale=1 + theta[3], com_offset=theta[5] * jnp.array([0.01, 0.02, -0.01])
    )
    i, j = scene.index(a), scene.index(b)
    start = dano.State(
        start.position.at[j].add(theta[7] * jnp.array([0.01, -0.02, 0.01])),
        start.orientation,
        start.velocity.at[i, 0].add(theta[4]),
        start.omega,
    )
    force = jnp.zeros_like(start.position).at[i].set((0.3 + theta[6]) * jnp.array([1.0, 2.0, 3.0]))
    return scene, start, dano.Control(force, 0.1 * force)


def slide():
    scene = on_floor(dano.Body("box", point_cloud_box()), sliding_friction=0.3)
    return (
        scene,
        scene.initial_state(box={"position": (0, 0, 0.0495), "velocity": (2, 0.3, 0), "omega": (0, 0, 1)}),
        60,
    )


def bounce():
    scene = on_floor(dano.Body("box", point_cloud_box()), damper=1e4)
    tilted = {"position": (0, 0, 0.12), "velocity": (1, 0, -1.5), "orientation": (1, 0.12, 0.05, 0)}
    return scene, scene.initial_state(box=tilted), 30


def tumble():
    scene = on_floor(dano.Body("box", point_cloud_box()), sliding_friction=0.5)
    rolling = {
        "position": (0, 0, 0.13),
        "velocity": (1, 0, 0),
        "omega": (0, 6, 1),
        "orientation": (1, 0, 0.4, 0),
    }
    return scene, scene.initial_state(box=rolling), 40


def hit():
    box, ball = dano.Body("box", point_cloud_box()), dano.Body("ball", dano.Sphere(0.12, edge=0.03), mass=3.0)
    contact = dano.Contact("box", "ball", dano.ContactParams(damper=3e4), dano.CentroidLaw())
    scene = dano.Scene.create([box, ball], [contact], timestep=0.01, gravity=(0.0, 0.0, 0.0))
    coming = {"position": (0.32, 0.03, 0.02), "velocity": (-2, 0.1, 0), "orientation": (1, 0.2, 0.1, 0.5)}
    return scene, scene.initial_state(box=coming), 40


@pytest.mark.parametrize(
    "case",
    [
        slide,
        pytest.param(hit, marks=pytest.mark.slow),
        pytest.param(bounce, marks=pytest.mark.slow),
        pytest.param(tumble, marks=pytest.mark.slow),
    ],
    ids=lambda case: case.__name__,
)
def test_rollout_gradients(case):
    scene, start, n_steps = case()

    def final(theta):
        changed, state, control = perturbed(scene, start, theta)
        controls = jax.tree.map(lambda x: jnp.broadcast_to(x, (n_steps, *x.shape)), control)
        run = dano.simulate(changed, state, controls=controls)
        end = last(run.states)
        return jnp.concatenate([end.position[0], end.orientation[0]]), run.converged.all()

    zero = jnp.zeros(len(PARAMETERS))
    value = jax.jit(final)
    (_, converged), forward = value(zero), jax.jit(jax.jacfwd(lambda t: final(t)[0]))(zero)
    assert bool(converged)
    # One row for position and one for orientation keeps the reverse pass to two sweeps.
    weights = np.zeros((2, 7))
    weights[0, :3], weights[1, 3:] = (1.0, 0.5, -0.7), (0.3, -0.8, 0.5, 1.0)
    reverse = jax.jit(jax.vmap(lambda w: jax.grad(lambda t: jnp.dot(w, final(t)[0]))(zero)))(
        jnp.asarray(weights)
    )
    np.testing.assert_allclose(reverse, weights @ np.asarray(forward), rtol=1e-8, atol=1e-8)

    step = 2e-7
    differences = np.stack(
        [
            (value(zero + step * e)[0] - value(zero - step * e)[0]) / (2 * step)
            for e in np.eye(len(PARAMETERS))
        ],
        axis=1,
    )
    scale = np.abs(forward).max(axis=0, keepdims=True)
    np.testing.assert_allclose(np.asarray(forward) / (scale + 1e-3), differences / (scale + 1e-3), atol=1e-5)
    assert np.all(scale[0, :4] > 1e-7), "each parameter must matter in this scene"


def lumpy_pair():
    """Two bodies of small grids that meet: contact through both densities and their continuous normals."""
    axis = np.linspace(-0.2, 0.2, 14)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    values = np.exp(-(x**2 / np.array([0.01, 0.006, 0.004])).sum(-1)) - 0.05
    field = dano.GridField(np.maximum(values, 0), (-0.2,) * 3, axis[1] - axis[0])
    lump = dano.NeuralObject.from_field(field, n_samples=300, mass=1.0, resolution=20, key=jax.random.key(0))
    scene = dano.Scene.create(
        [dano.Body("a", lump), dano.Body("b", lump)],
        [dano.Contact("a", "b", dano.ContactParams(damper=1e4, spring=3e3), dano.CentroidLaw())],
        timestep=0.01,
        gravity=(0.0, 0.0, 0.0),
    )
    approaching = {"position": (0.3, 0.02, 0.01), "velocity": (-1, 0, 0), "orientation": (1, 0.2, 0.1, 0.3)}
    return scene, scene.initial_state(a=approaching)


@pytest.mark.slow
def test_neural_pair_gradients():
    """Through a neural–neural hit, with respect to either body's pose: forward = reverse = differences."""
    scene, start = lumpy_pair()

    def final(theta):
        moved = dano.State(
            start.position.at[0].add(theta[:3]).at[1].add(theta[3:]),
            start.orientation,
            start.velocity,
            start.omega,
        )
        run = dano.simulate(scene, moved, 25)
        return jnp.sum(last(run.states).position * jnp.array([[1.0, -0.5, 0.3], [0.2, 0.7, -1.0]]))

    zero = jnp.zeros(6)
    value = jax.jit(final)
    forward, reverse = jax.jit(jax.jacfwd(final))(zero), jax.jit(jax.grad(final))(zero)
    np.testing.assert_allclose(forward, reverse, rtol=1e-8, atol=1e-8)
    for step, tolerance in ((1e-6, 1e-5), (1e-3, 0.1)):
        differences = [(value(zero + step * e) - value(zero - step * e)) / (2 * step) for e in np.eye(6)]
        np.testing.assert_allclose(forward, differences, atol=tolerance * np.abs(forward).max())
    assert np.abs(np.asarray(forward[:3] - jnp.array([1.0, -0.5, 0.3]))).max() > 0.05, "they must have met"


def test_linearize_matches_differences():
    scene, start, _ = slide()
    start = last(dano.simulate(scene, start, 10).states)
    a, b = dano.linearize(scene, start)
    assert a.shape == (12, 12)
    assert b.shape == (12, 6)
    velocity_step = 1e-6 * np.eye(3)
    for k in range(3):
        states = [
            dano.step(
                scene,
                dano.State(
                    start.position,
                    start.orientation,
                    start.velocity.at[0].add(sign * velocity_step[k]),
                    start.omega,
                ),
            )
            for sign in (1, -1)
        ]
        change = (states[0].velocity[0] - states[1].velocity[0]) / 2e-6
        np.testing.assert_allclose(a[6:9, 6 + k], change, rtol=1e-5, atol=1e-6)
    pushes = [dano.step(scene, start, scene.control(box={"force": (sign * 1e-4, 0, 0)})) for sign in (1, -1)]
    by_force = (pushes[0].velocity[0] - pushes[1].velocity[0]) / 2e-4
    np.testing.assert_allclose(b[6:9, 0], by_force, rtol=1e-5, atol=1e-7)


def test_batches_equal_loops():
    """vmap over states, parameters and controls gives what a loop gives."""
    scene, start, _ = slide()

    @jax.jit
    def distance(mu, speed, push):
        changed = scene.replace_contact("box", "floor", sliding_friction=mu)
        state = dano.State(start.position, start.orientation, start.velocity.at[0, 0].set(speed), start.omega)
        force = jnp.zeros((20, 2, 3)).at[:, 0, 1].set(push)
        return dano.simulate(
            changed, state, controls=dano.Control(force, jnp.zeros_like(force))
        ).states.position[-1, 0]

    mus, speeds, pushes = jnp.array([0.1, 0.3, 0.6]), jnp.array([1.0, 2.0, 0.5]), jnp.array([0.0, 5.0, -3.0])
    batched = jax.jit(jax.vmap(distance))(mus, speeds, pushes)
    looped = jnp.stack([distance(*args) for args in zip(mus, speeds, pushes, strict=True)])
    np.testing.assert_allclose(batched, looped, atol=1e-9)


def test_single_precision():
    """The same code runs in float32, with tolerances that fit it."""
    scene, start, _ = slide()
    half = lambda tree: jax.tree.map(lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, tree)  # noqa: E731
    run, reference = dano.simulate(half(scene), half(start), 60), dano.simulate(scene, start, 60)
    assert run.states.position.dtype == jnp.float32
    assert bool(run.converged.all())
    np.testing.assert_allclose(run.states.position, reference.states.position, atol=2e-3)


def test_compiler_options_do_not_stand_in_the_way():
    """A step gives the same alone, in a user's compilation, in a derivative, and with the options outside."""
    scene = dano.Scene.create([dano.Body("ball", dano.Sphere(0.1), mass=1.0)], timestep=0.01)
    state = scene.initial_state(ball=dict(velocity=(1.0, 2.0, 3.0)))

    def fallen(height):
        start = dataclasses.replace(state, position=state.position.at[0, 2].set(height))
        return dano.step(scene, start).position[0, 2]

    at = jnp.asarray(2.0)
    alone = float(fallen(at))
    assert alone == pytest.approx(2.03 - 9.81e-4)
    for run in (jax.jit(fallen), jax.jit(fallen, compiler_options=dano.compiler_options())):
        assert float(run(at)) == alone
    assert float(jax.vmap(fallen)(at[None])[0]) == alone
    assert float(jax.grad(fallen)(at)) == 1.0
