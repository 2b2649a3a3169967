"""Derivatives through impacts: a bunny thrown on a floor, its end as a function of friction.

The end is computed at 61 frictions close together. Its trend is the cubic through them; how far the ends are
from it, and slopes between neighbours from its slope, says how rough the motion is. A derivative is worth
something where it agrees with the slope over a visible step.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import dano
from benchmarks._measure import Row
from dano.scene_file import build_asset

FRICTION = np.linspace(0.29, 0.31, 61)
SECONDS = 0.5
STEPS = (5.0, 1.0)
"""[ms]."""
SPEED, SPIN, HEIGHT = 0.8, 6.0, 0.12
"""[m/s], [rad/s], [m]."""
N_THROWS = 6


class Throw(NamedTuple):
    """A random throw: state of the bunny as it starts."""

    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    omega: np.ndarray


class Study(NamedTuple):
    """What a throw shows.

    Attributes:
        spread: Of the ends over the range of friction [m].
        roughness: Root mean square of the ends about the cubic [m].
        right: Share of slopes between neighbours that have the sign of the cubic's slope.
        trend: Slope of the cubic in the middle [m].
        derivatives: At eleven frictions [m].
        slopes: Over a visible step at the same [m].
    """

    spread: float
    roughness: float
    right: float
    trend: float
    derivatives: np.ndarray
    slopes: np.ndarray


def throws(count: int) -> list[Throw]:
    """Random throws at the same speed."""
    rng = np.random.default_rng(7)
    found = []
    for _ in range(count):
        yaw = rng.uniform(0, 2 * np.pi)
        turn, spin = rng.normal(size=4), rng.normal(size=3)
        forward = SPEED * np.array([np.cos(yaw), np.sin(yaw), 0.0])
        found.append(
            Throw(
                np.array([0.0, 0.0, HEIGHT]),
                turn / np.linalg.norm(turn),
                forward,
                SPIN * spin / np.linalg.norm(spin),
            )
        )
    return found


def study(law: dano.AbstractContactLaw, throw: Throw, timestep: float, *, derivatives: bool) -> Study:
    """The end of a throw along its direction, by friction."""
    bunny = build_asset("bunny")
    scene = dano.Scene.create(
        bodies=[dano.Body("bunny", bunny), dano.Body("floor", dano.HalfSpace(), fixed=True)],
        contacts=[dano.Contact("bunny", "floor", dano.ContactParams(sliding_friction=0.3), law=law)],
        timestep=timestep,
    )
    state = scene.initial_state(bunny=throw._asdict())
    along = jnp.asarray(throw.velocity / np.linalg.norm(throw.velocity))
    n_steps = round(SECONDS / timestep)

    def end(friction):
        changed = scene.replace_contact("bunny", "floor", sliding_friction=friction)
        return dano.simulate(changed, state, n_steps=n_steps).states.position[-1, 0] @ along

    mu = jnp.asarray(FRICTION)
    ends = np.asarray(jax.vmap(end)(mu))
    x = (FRICTION - FRICTION.mean()) / np.ptp(FRICTION)
    cubic = np.polynomial.Polynomial.fit(x, ends, 3)
    trend = cubic.deriv()(x) / np.ptp(FRICTION)
    local = np.diff(ends) / np.diff(FRICTION)
    middle = 0.5 * (trend[1:] + trend[:-1])
    some = FRICTION[::6]
    slopes = derived = np.zeros(len(some))
    if derivatives:
        both = jnp.asarray(np.concatenate([some + 0.5e-2, some - 0.5e-2]))
        up, down = np.split(np.asarray(jax.vmap(end)(both)), 2)
        slopes = (up - down) / 1e-2
        derived = np.asarray(jax.vmap(jax.grad(end))(jnp.asarray(some)))
    return Study(
        float(np.ptp(ends)),
        float(np.sqrt(np.mean((ends - cubic(x)) ** 2))),
        float(np.mean(np.sign(local) == np.sign(middle))),
        float(np.mean(trend)),
        derived,
        slopes,
    )


def rows(*, quick: bool) -> list[Row]:
    """Both laws, at steps of 5 and 1 ms."""
    found = []
    laws = {"default law": dano.DistributedLaw(), "paper's law": dano.CentroidLaw()}
    for name, law in laws.items():
        for h in STEPS[:1] if quick else STEPS:
            found += _rows_of(law, h, f"Bunny thrown on a floor, {name}, steps of {h:g} ms")
    return found


def _rows_of(law: dano.AbstractContactLaw, h: float, group: str) -> list[Row]:
    studies = [study(law, throw, 1e-3 * h, derivatives=True) for throw in throws(N_THROWS)]
    derived = np.concatenate([s.derivatives for s in studies])
    slopes = np.concatenate([s.slopes for s in studies])
    missed = np.abs(derived - slopes)
    relative = 100 * missed / np.abs(slopes)
    rough = [1000 * s.roughness for s in studies]
    right = 100 * np.mean([s.right for s in studies])
    signs = 100 * np.mean(np.sign(derived) == np.sign(slopes))
    shares = [100 * s.roughness / s.spread for s in studies]
    each = ", ".join(f"{x:.3g}" for x in rough)
    trends = ", ".join(f"{s.trend:.2g}" for s in studies)
    gradients = ", ".join(f"{np.median(s.derivatives):.2g}" for s in studies)
    return [
        Row(group, "roughness of the end by friction, median", float(np.median(rough)), "mm", note=each),
        Row(group, "roughness over its range, median", float(np.median(shares)), "%", 1.0),
        Row(group, "slopes between neighbours with the trend's sign", float(right), "%", note=trends),
        Row(group, "derivatives with the sign of a visible slope", float(signs), "%", 95.0, True),
        Row(group, "derivative less visible slope, median", float(np.median(missed)), "m", note=gradients),
        Row(group, "… relative", float(np.median(relative)), "%", 10.0),
        Row(group, "derivative: largest size", float(np.max(np.abs(derived))), "m"),
    ]
