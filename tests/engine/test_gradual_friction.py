"""Friction that is gradual in derivatives: a box that is held, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano

H, N_STEPS, MASS, FRICTION, SLIP = 0.005, 20, 1.0, 0.5, 0.01
BOUND = FRICTION * MASS * 9.81


def box_on_floor(slip):
    box = dano.Body("box", dano.Box((0.05, 0.05, 0.05)), mass=MASS)
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    law = dano.DistributedLaw(gradual_stiction=slip)
    contact = dano.Contact("box", "floor", dano.ContactParams(sliding_friction=FRICTION), law=law)
    return dano.Scene.create([box, floor], [contact], timestep=H)


@pytest.fixture(scope="module")
def pushed():
    """How far a box goes by a force on it [N], with derivatives as they are and gradual ones."""
    start = box_on_floor(0.0).initial_state(box=dict(position=(0, 0, 0.05)))
    rest = jax.tree.map(lambda x: x[-1], dano.simulate(box_on_floor(0.0), start, 200).states)

    def way(slip):
        scene = box_on_floor(slip)

        def end(force):
            push = jnp.zeros((N_STEPS, 2, 3)).at[:, 0, 0].set(force)
            controls = dano.Control(push, jnp.zeros_like(push))
            return dano.simulate(scene, rest, controls=controls).states.position[-1, 0, 0]

        return end

    return way(0.0), way(SLIP)


@pytest.mark.parametrize("force", [1.0, 8.0])
def test_the_motion_is_the_same(pushed, force):
    as_it_is, gradual = pushed
    assert as_it_is(force) == gradual(force)


def test_what_is_held_moves_as_on_a_damper(pushed):
    as_it_is, gradual = pushed
    # m (v⁺ − v) = h (f − b/v_g v⁺) for each N of force.
    speed = way = 0.0
    for _ in range(N_STEPS):
        speed = (speed + H / MASS) / (1 + H * BOUND / (MASS * SLIP))
        way += H * speed
    assert jax.grad(gradual)(1.0) == pytest.approx(way, rel=1e-3)
    assert jax.jvp(gradual, (1.0,), (1.0,))[1] == pytest.approx(way, rel=1e-3)
    assert abs(jax.grad(as_it_is)(1.0)) < 1e-4 * way


def test_what_slides_fast_has_the_derivative_of_its_motion(pushed):
    _, gradual = pushed
    # After a step it slides faster than v_g: x = h²/m n (n + 1)/2 (f − μ m g).
    visible = (float(gradual(8.05)) - float(gradual(7.95))) / 0.1
    np.testing.assert_allclose(visible, H**2 / MASS * N_STEPS * (N_STEPS + 1) / 2, rtol=1e-3)
    np.testing.assert_allclose(jax.grad(gradual)(8.0), visible, rtol=1e-3)


def test_a_slip_that_is_no_speed_is_refused():
    with pytest.raises(ValueError, match="gradual_stiction"):
        dano.DistributedLaw(gradual_stiction=-1.0)
