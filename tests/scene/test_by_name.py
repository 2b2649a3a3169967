"""States and controls by the names of bodies."""

import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.maths import quat_rotate


def scene():
    heavy = dano.Body(
        "left arm", dano.Box((0.1, 0.02, 0.02)), mass=0.6, com=(0.03, 0, 0), com_offset=(0, 0.01, 0)
    )
    return dano.Scene.create([heavy, dano.Body("ball", dano.Sphere(0.1), mass=1.0)], [])


def test_origin_is_that_of_the_field():
    """The pose of docs/conventions.md: x = p + R (y − c) of the field's point y."""
    made, turn = scene(), (1, 0.2, -0.4, 0.3)
    state = made.initial_state({"left arm": dict(origin=(1, 2, 3), orientation=turn)})
    com = jnp.array([0.03, 0.01, 0.0])
    at = state.position[0] + quat_rotate(state.orientation[0], -com)
    np.testing.assert_allclose(at, (1, 2, 3), atol=1e-14)
    np.testing.assert_array_equal(made.initial_state(ball=dict(origin=(0, 1, 0))).position[1], (0, 1, 0))


def test_a_dict_is_as_good_as_keywords():
    made, at = scene(), dict(position=(0, 0, 1), omega=(1, 0, 0))
    one, other = made.initial_state({"ball": at}), made.initial_state(ball=at)
    np.testing.assert_array_equal(one.position, other.position)
    np.testing.assert_array_equal(one.omega, other.omega)
    both = made.initial_state({"left arm": dict(velocity=(1, 0, 0))}, ball=at)
    assert both.velocity[0, 0] == 1 and both.omega[1, 0] == 1
    pushes = made.control({"left arm": dict(force=(0, 0, 2))}, ball=dict(torque=(1, 0, 0)))
    assert pushes.force[0, 2] == 2 and pushes.torque[1, 0] == 1


def test_what_is_wrong_is_named():
    made = scene()
    with pytest.raises(
        ValueError, match="state of 'ball' must be given by position .* or by origin, got both"
    ):
        made.initial_state(ball=dict(position=(0, 0, 1), origin=(0, 0, 1)))
    with pytest.raises(ValueError, match="states of 'ball' is given twice"):
        made.initial_state({"ball": {}}, ball={})
    with pytest.raises(ValueError, match="origin of 'ball'"):
        made.initial_state(ball=dict(origin=(0, 1)))
    with pytest.raises(ValueError, match="'right arm'"):
        made.initial_state({"right arm": {}})


def test_spins_in_world_axes():
    """Turned by 90° about z, the world's y is the body's x."""
    half = np.sqrt(0.5)
    ball = dano.Body("ball", dano.Sphere(0.1), mass=1.0)
    scene = dano.Scene.create([ball], timestep=0.01)
    turned = dict(orientation=(half, 0, 0, half), spin_world=(0, 3, 0))
    np.testing.assert_allclose(scene.initial_state(ball=turned)["ball"].omega, (3, 0, 0), atol=1e-12)
    own = dano.Body("ball", dano.Sphere(0.1), mass=1.0, orientation=(half, 0, 0, half), spin_world=(0, 3, 0))
    scene = dano.Scene.create([own], timestep=0.01)
    np.testing.assert_allclose(scene.initial_state()["ball"].omega, (3, 0, 0), atol=1e-12)
    # What a state says takes the place of what the body says.
    np.testing.assert_allclose(scene.initial_state(ball=dict(omega=(0, 0, 1)))["ball"].omega, (0, 0, 1))
    with pytest.raises(ValueError, match=r"omega \(axes of the body\) or by spin_world, got both"):
        scene.initial_state(ball=dict(omega=(0, 0, 1), spin_world=(0, 0, 1)))


def test_words_of_other_programs_get_a_hint():
    with pytest.raises(ValueError, match=r"got 'friction'; did you mean 'sliding_friction'\?"):
        dano.ContactParams(friction=0.5)
