"""Where rays pass boxes."""

import jax.numpy as jnp
import numpy as np

from dano.vision.capture import box_interval


def test_rays_enter_and_leave_a_box():
    lower, upper = jnp.asarray([[-1.0], [-2.0], [0.0]]), jnp.asarray([[1.0], [2.0], [3.0]])
    rays = {
        "through": ((-3, 0, 1), (1, 0, 0), (2, 4)),
        "twice as long a direction": ((-3, 0, 1), (2, 0, 0), (1, 2)),
        "from inside": ((0, 0, 1), (0, 0, -1), (0, 1)),
        "oblique": ((-2, -2, 1), (1, 1, 0), (1, 3)),
    }
    origins, directions, expected = (np.array([r[i] for r in rays.values()], float).T for i in range(3))
    enter, leave = box_interval(lower, upper, jnp.asarray(origins), jnp.asarray(directions))
    np.testing.assert_allclose([enter, leave], expected, atol=1e-8)


def test_rays_that_miss_leave_before_they_enter():
    lower, upper = -jnp.ones((3, 1)), jnp.ones((3, 1))
    origins = jnp.asarray([[-3.0, -3.0, 3.0], [0.0, 1.5, 0.0], [2.0, 0.0, 0.0]])
    directions = jnp.asarray([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    enter, leave = box_interval(lower, upper, origins, directions)
    assert np.all(np.isfinite([enter, leave])) and np.all(enter > leave)
