"""Derivatives where a distance has none: centres, axes, edges and corners of all shapes, in both modes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano

RADIUS, DEEP, H = 0.05, 1e-4, 5e-3
SHAPES = {
    "ball": dano.Sphere(0.1),
    "box": dano.Box((0.1, 0.08, 0.06)),
    "rounded box": dano.Box((0.1, 0.08, 0.06), rounding=0.02),
    "capsule": dano.Capsule(0.05, 0.05),
    "cylinder": dano.Cylinder(0.06, 0.08),
    "flat cylinder": dano.Cylinder(0.08, 0.02),
    "ellipsoid": dano.Ellipsoid((0.1, 0.08, 0.06)),
    "round ellipsoid": dano.Ellipsoid((0.1, 0.1, 0.06)),
    "half-space": dano.HalfSpace(),
    "two shapes": dano.union(
        dano.posed(dano.Sphere(0.05), dano.Pose((0.02, 0.0, 0.0))),
        dano.posed(dano.Cylinder(0.04, 0.05), dano.Pose((-0.02, 0.0, 0.0))),
    ),
}
WAYS = [
    (0.0, 0, 0),
    (1.0, 0, 0),
    (0.0, 1, 0),
    (0.0, 0, 1),
    (0.0, 0, -1),
    (1.0, 1, 0),
    (1.0, 0, 1),
    (1.0, 1, 1),
]


def places(shape: dano.Sphere) -> np.ndarray:
    """Centres of a small ball: within the shape, and where it just touches from singular directions."""
    bounds = np.asarray(shape.bounds)
    bounds = np.where(np.isfinite(bounds), bounds, 0.0)
    half = 0.5 * np.ptp(bounds, axis=0)
    inner = [bounds.mean(axis=0) + share * half * np.array(way) for way in WAYS for share in (0.5, 1.0)]
    outer = []
    for way in WAYS[1:]:
        # From outside, to where the ball is DEEP in.
        direction = np.array(way) / np.linalg.norm(way)
        low, high = 0.0, 1.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            gone = float(shape.sdf(jnp.asarray(bounds.mean(axis=0) + middle * direction)))
            low, high = (middle, high) if gone < RADIUS - DEEP else (low, middle)
        outer.append(bounds.mean(axis=0) + low * direction)
    return np.array(inner + outer)


def scene_of(shape, law: dano.DistributedLaw | dano.CentroidLaw) -> dano.Scene:
    ball = dano.Body("ball", dano.Sphere(RADIUS), mass=1.0)
    contact = dano.Contact("ball", "thing", law=law)
    return dano.Scene.create([ball, dano.Body("thing", shape, fixed=True)], [contact], timestep=H)


@pytest.mark.parametrize("name", SHAPES)
def test_derivatives_are_finite_in_both_modes(name: str):
    scene = scene_of(SHAPES[name], dano.DistributedLaw())

    def final(position):
        start = scene.initial_state(ball=dict(position=position))
        states = dano.simulate(scene, start, 2).states
        return jnp.concatenate([states.position[-1, 0], states.velocity[-1, 0], states.omega[-1, 0]])

    at = jnp.asarray(places(SHAPES[name]))
    values = jax.jit(jax.vmap(final))(at)
    assert np.all(np.isfinite(values))
    outer = len(WAYS) - 1
    reverse = np.asarray(jax.jit(jax.vmap(jax.jacrev(final)))(at))
    forward = np.asarray(jax.jit(jax.vmap(jax.jacfwd(final)))(at))
    for place, a, b in zip(np.asarray(at), reverse, forward, strict=True):
        assert np.all(np.isfinite(a)) and np.all(np.isfinite(b)), f"at {place}"
    # Within a shape faces tie, and each mode has the derivative of one side.
    for place, a, b in zip(np.asarray(at)[-outer:], reverse[-outer:], forward[-outer:], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6 * np.abs(b).max(), err_msg=f"at {place}")


@pytest.mark.parametrize("name", ["cylinder", "box", "ball", "capsule"])
def test_above_the_middle_the_derivative_is_the_slope(name: str):
    scene = scene_of(SHAPES[name], dano.DistributedLaw())
    top = float(SHAPES[name].bounds[1, 2])

    @jax.jit
    def final(position):
        start = scene.initial_state(ball=dict(position=position))
        return dano.simulate(scene, start, 1).states.position[-1, 0].sum()

    place = jnp.array((0.0, 0.0, top + RADIUS - DEEP))
    slopes = [(final(place + e) - final(place - e)) / 2e-6 for e in 1e-6 * jnp.eye(3)]
    np.testing.assert_allclose(jax.grad(final)(place), slopes, atol=2e-4)


def test_two_balls_with_one_centre():
    balls = [dano.Body("a", dano.Sphere(0.05), mass=1.0), dano.Body("b", dano.Sphere(0.1), mass=1.0)]
    scene = dano.Scene.create(balls, timestep=H, gravity=(0, 0, 0))

    def moved(x):
        start = scene.initial_state(a=dict(position=(x, 0, 0)))
        return dano.simulate(scene, start, 5).states.position[-1, 0, 0]

    assert np.isfinite(jax.grad(moved)(0.0))
    assert np.isfinite(jax.jacfwd(moved)(0.0))
