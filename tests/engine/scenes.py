"""Small scenes shared by the engine's tests: cheap to compile, with closed forms."""

import jax
import jax.numpy as jnp
import numpy as np

import dano
from dano.maths import quat_rotate


def point_cloud_box(half=(0.1, 0.07, 0.05), mass=1.3, n=8, com=(0.0, 0.0, 0.0)):
    """A box as a neural object of few samples on its surface, without a field."""
    axes = [np.linspace(-h, h, n) for h in half]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    on_surface = np.any(np.isclose(np.abs(grid), np.asarray(half)), axis=1)
    squares = np.square(half)
    inertia = np.diag(mass / 3 * (squares.sum() - squares))
    points = grid[on_surface]
    return dano.NeuralObject.from_samples(
        points=points, density=np.ones(len(points)), mass=mass, com=com, inertia=inertia
    )


def on_floor(body, **params):
    """A body on a floor by the centroid law, at 10 ms, with a wide edge so that few samples carry it."""
    floor = dano.Body("floor", dano.HalfSpace(edge=0.02), fixed=True)
    contact = dano.Contact(body.name, "floor", dano.ContactParams(**params), dano.CentroidLaw())
    return dano.Scene.create([body, floor], [contact], timestep=0.01)


def last(states: dano.State) -> dano.State:
    return jax.tree.map(lambda x: x[-1], states)


def angular_momentum(states: dano.State, inertia, h):
    """Discrete angular momentum R P⁻(ω) of each state [W]: what free motion of this integrator conserves."""
    omega = states.omega
    s = jnp.sqrt(4 / h**2 - jnp.sum(omega**2, axis=-1, keepdims=True))
    spin = jnp.einsum("ij,...j->...i", inertia, omega)
    body = 0.5 * h * (s * spin - jnp.cross(omega, spin))
    return quat_rotate(states.orientation, body)
