"""Does the derivative with respect to friction say what happens when friction changes visibly?"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import dano
from benchmarks._measure import Row
from benchmarks._subjects import Subject
from dano.maths import quat_from_axis_angle, quat_multiply

N_SCENES = 40
N_STEPS = 100
STEP = 1e-2  # of the friction coefficient
TINY_STEP = 1e-5
FRICTION = (0.15, 0.5)
SLIDE_SPEED = (1.5, 3.0)  # [m/s], on the authors' scale
PUSH_SPEED = 2.0  # [m/s], of the ball


class _Draw(NamedTuple):
    """A random scene: the bunny slides, or a ball pushes it."""

    friction: float
    velocity: np.ndarray
    yaw: float
    pushed: bool


def gradient_rows(
    subject: Subject, *, quick: bool, law: dano.AbstractContactLaw | None = None, name: str = ""
) -> list[Row]:
    """Autodiff of the distance travelled with respect to friction, against central differences.

    Args:
        subject: What slides and is pushed.
        quick: Whether a few scenes are enough.
        law: Contact law, with its default parameters; default: the paper's, scaled to the subject.
        name: Of the law, for the heading.
    """
    place = _Place(subject, law)
    draws = _draws(4 if quick else N_SCENES)
    group = f"Derivative of a distance with respect to friction, {subject.name}, {len(draws)} scenes"
    group = f"{group}, {name}" if name else group
    derivative, large, tiny = np.array([place.compare(draw) for draw in draws]).T
    relative = np.abs(derivative - large) / np.abs(large)
    agree = int(np.sum(np.sign(derivative) == np.sign(large)))
    kinds = np.array([draw.pushed for draw in draws])
    note = f"slides {np.median(relative[~kinds]):.2g}, pushes {np.median(relative[kinds]):.2g}"
    return [
        Row(group, f"same sign as a difference of step {STEP:g}", agree, "scenes", 0.95 * len(draws), True),
        Row(group, "median relative error", float(np.median(relative)), "", 0.1, note=note),
        Row(
            group,
            f"largest relative error, step {TINY_STEP:g}",
            float(np.max(np.abs(derivative - tiny) / np.abs(tiny))),
            "",
        ),
        Row(group, "steps that did not converge", place.unconverged, "", 0),
    ]


def _draws(n: int) -> list[_Draw]:
    random = np.random.default_rng(0)
    draws = []
    for k in range(n):
        heading, speed = random.uniform(0, 2 * np.pi), random.uniform(*SLIDE_SPEED)
        friction, yaw = random.uniform(*FRICTION), random.uniform(0, 2 * np.pi)
        velocity = np.array([np.cos(heading), np.sin(heading)]) * speed
        draws.append(_Draw(friction, velocity, yaw, pushed=bool(k % 2)))
    return draws


class _Place:
    """A floor with a bunny at rest and a ball; compiles one rollout and its derivative."""

    def __init__(self, subject: Subject, law: dano.AbstractContactLaw | None = None):
        self.length = subject.length
        h = 0.01 * self.length**0.5
        bodies = [
            dano.Body("bunny", subject.bunny),
            dano.Body("ball", dano.Sphere(0.25 * self.length), mass=3.0 * subject.mass),
            dano.Body("floor", dano.HalfSpace(), fixed=True),
        ]
        if law is None:
            params, law = subject.params(), subject.law()
        else:
            params = dano.ContactParams()
        pairs = (("bunny", "floor"), ("bunny", "ball"), ("ball", "floor"))
        contacts = [dano.Contact(a, b, params, law) for a, b in pairs]
        self.scene = dano.Scene.create(bodies, contacts, timestep=h)
        self.away = jnp.array([5.0, 5.0, 0.245]) * self.length
        self.rest = subject.settled(self.scene, ball={"position": self.away})
        self.unconverged = 0
        self.final = jax.jit(self._final)
        self.derivative = jax.jit(jax.jacrev(lambda *draw: self._final(*draw)[0]))

    def _final(self, friction, velocity, yaw, pushed):
        """Where the bunny is after the rollout [m], and how many steps did not converge."""
        scene = self.scene.replace_contact("bunny", "floor", sliding_friction=friction)
        turned = quat_multiply(
            quat_from_axis_angle(jnp.array([0.0, 0.0, 1.0]), yaw), self.rest.orientation[0]
        )
        near = jnp.array([-0.9, 0.1, 0.245]) * self.length
        root = self.length**0.5
        still = jnp.zeros_like(self.rest.velocity)
        ball = jnp.array([PUSH_SPEED, 0.0, 0.0]) * root
        state = dano.State(
            self.rest.position.at[1].set(jnp.where(pushed, near, self.away)).at[0, :2].set(0.0),
            self.rest.orientation.at[0].set(turned),
            still.at[0, :2]
            .set(jnp.where(pushed, 0.0, velocity * root))
            .at[1]
            .set(jnp.where(pushed, ball, 0.0)),
            still,
        )
        run = dano.simulate(scene, state, N_STEPS)
        return run.states.position[-1, 0, :2], jnp.sum(~run.converged)

    def compare(self, draw: _Draw) -> tuple[float, float, float]:
        """Derivative of the distance by autodiff, by a large and by a tiny difference [m]."""
        others = draw.velocity, draw.yaw, draw.pushed
        end, failed = self.final(draw.friction, *others)
        self.unconverged += int(failed)
        direction = np.asarray(end) / np.linalg.norm(end)

        def difference(step):
            ends = [np.asarray(self.final(draw.friction + s, *others)[0]) for s in (step, -step)]
            return float(direction @ (ends[0] - ends[1])) / (2 * step)

        derivative = float(direction @ np.asarray(self.derivative(draw.friction, *others)))
        return derivative, difference(STEP), difference(TINY_STEP)
