"""The motions that are identified: a ball on springs runs into a falling bunny.

The authors' scene (their `sphere_bunny`), whose lengths and masses are the field's units: a ball of 10 kg and
0.25 m is pulled to the origin by a spring and a damper and hits the bunny, which falls on the floor.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import dano
from dano.maths import quat_multiply

FRICTION = 0.1
MOTIONS = 10
FRAME = 0.01  # s
DURATION = 0.75  # s
TIMESTEP_OF_DATA = 5e-5  # s
SPRING, DAMPER = 200.0, 30.0  # N/m, N s/m: 2 x and 0.3 v as impulses of steps of 0.01 s
SPIN_SPRING, SPIN_DAMPER = 200.0, 30.0  # N m, N m s
RADIUS, BALL_MASS, BALL_START, BALL_SPEED = 0.25, 10.0, 1.0, 2.0


class Pull(eqx.Module):
    """Draws the ball to the origin, and its orientation to the world's axes."""

    def __call__(self, state: dano.State, time: Float[Array, ""]) -> dano.Control:
        """Forces [N] and torques [N m] on bunny, ball and floor."""
        q = state.orientation[1]
        force = -SPRING * state.position[1] - DAMPER * state.velocity[1]
        torque = -2 * SPIN_SPRING * jnp.sign(q[0]) * q[1:] - SPIN_DAMPER * state.omega[1]
        zero = jnp.zeros(3)
        return dano.Control(jnp.stack([zero, force, zero]), jnp.stack([zero, torque, zero]))


def scene(bunny: dano.NeuralObject, timestep: float) -> dano.Scene:
    """Bunny, ball and floor with the authors' constants."""
    params = dano.ContactParams(
        sliding_friction=FRICTION,
        spring=3e4,
        damper=3e5,
        sliding_drag=0.01,
        torsional_friction=0.01,
        rolling_friction=0.01,
        torsional_drag=0.0,
        rolling_drag=0.0,
    )
    bodies = [
        dano.Body("bunny", bunny),
        dano.Body("ball", dano.Sphere(RADIUS), mass=BALL_MASS),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    pairs = [("bunny", "floor"), ("ball", "floor"), ("bunny", "ball")]
    contacts = [dano.Contact(a, b, params, dano.CentroidLaw()) for a, b in pairs]
    return dano.Scene.create(bodies, contacts, timestep=timestep)


def parameters() -> list[dano.Parameter]:
    """Mass scale and friction of the bunny, and where the paper begins."""
    return [
        dano.Parameter("mass scale", lambda s: s.body("bunny").mass_scale, 0.1, 10.0, start=0.25),
        dano.Parameter(
            "friction",
            lambda s: [s.contact("bunny", other).sliding_friction for other in ("floor", "ball")],
            0.0,
            0.5,
            start=0.01,
        ),
    ]


@eqx.filter_jit
def _frames(found: dano.Scene, turns: Float[Array, "m 4"]) -> tuple[dano.State, Array]:
    """States of all motions at frames, and how many steps did not converge."""
    every = round(FRAME / TIMESTEP_OF_DATA)

    def one(turn):
        start = found.initial_state(
            bunny={"position": (0.0, 0.2, 0.6), "orientation": turn},
            ball={"position": (BALL_START, 0.0, RADIUS), "velocity": (-BALL_SPEED, 0.0, 0.0)},
        )
        run = dano.simulate(found, start, round(DURATION / TIMESTEP_OF_DATA), controls=Pull())
        return jax.tree.map(lambda leaf: leaf[::every], run.states), jnp.sum(~run.converged)

    return jax.lax.map(one, turns)


def simulate(bunny: dano.NeuralObject, seed: int) -> tuple[dano.State, int]:
    """Ten motions from random orientations; leaves (motion, frame, body, ·), and steps not converged."""
    turns = np.random.default_rng(seed).random((MOTIONS, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    states, failed = _frames(scene(bunny, TIMESTEP_OF_DATA), jnp.asarray(turns))
    return jax.tree.map(np.asarray, states), int(failed.sum())


def observed(
    states: dano.State, frames: slice, noise: tuple[float, float] | None = None, seed: int = 0
) -> list[dano.Motion]:
    """Motions of bunny and ball in some frames.

    Args:
        states: As `simulate` returns them.
        frames: Which.
        noise: None: poses and velocities as they are. Else standard deviations of noise on positions [m] and
            orientations [rad], and velocities are not observed.
        seed: Of the noise.
    """
    draw = np.random.default_rng(seed).standard_normal
    motions = []
    for i in range(MOTIONS):
        position, orientation = states.position[i, frames, :2], states.orientation[i, frames, :2]
        velocities: dict[str, Any] = {
            "velocity": states.velocity[i, frames, :2],
            "omega": states.omega[i, frames, :2],
        }
        if noise is not None:
            velocities = {}
            position = position + noise[0] * draw(position.shape)
            half = 0.5 * noise[1] * draw((*orientation.shape[:-1], 3))
            turn = np.concatenate([np.ones((*half.shape[:-1], 1)), half], axis=-1)
            turn /= np.linalg.norm(turn, axis=-1, keepdims=True)
            orientation = np.asarray(quat_multiply(jnp.asarray(orientation), jnp.asarray(turn)))
        motions.append(
            dano.Motion.create(
                np.arange(states.position.shape[1])[frames] * FRAME,
                ("bunny", "ball"),
                position=position,
                orientation=orientation,
                lag=0.0 if noise is not None else 0.5 * TIMESTEP_OF_DATA,
                **velocities,
            )
        )
    return motions
