"""Chains without friction: momentum of one that floats, and a four-bar that falls."""

import jax
import jax.numpy as jnp
import numpy as np

import dano
from benchmarks._measure import Row
from dano.maths import quat_rotate

LINKS = 7
BARS = {"crank": 0.2, "coupler": 0.5, "rocker": 0.4}  # m
GROUND = 0.45  # m


def rows(group: str, n_steps: int) -> list[Row]:
    """What a floating chain loses of its momenta, and what a four-bar's loop opens by."""
    return [*_floating(group, n_steps), *_four_bar(group, n_steps)]


def _floating(group: str, n_steps: int) -> list[Row]:
    bodies = [dano.Body(f"link {i}", dano.Capsule(0.03, 0.1), mass=0.5 + 0.1 * i) for i in range(LINKS + 1)]
    axes = np.random.default_rng(0).normal(size=(LINKS, 3))
    joints = [
        dano.Joint(f"link {i}", f"link {i + 1}", axis=axis, anchor=(0, 0, -0.13), position=(0, 0, 0.26))
        for i, axis in enumerate(axes)
    ]
    scene = dano.Scene.create(bodies, contacts=(), joints=joints, timestep=1e-3, gravity=(0, 0, 0))
    given: dict[str, dict] = {f"link {i + 1}": dict(q=0.2, v=(-1) ** i * 1.5) for i in range(LINKS)}
    given["link 0"] = dict(velocity=(0.2, 0, 0.1), omega=(1, 0.5, -1))
    states, h = dano.simulate(scene, scene.initial_state(**given), n_steps).states, float(scene.timestep)
    mass = np.array([float(body.mass) for body in scene.bodies])[:, None]
    inertia = jnp.stack([body.inertia for body in scene.bodies])
    linear = mass * np.asarray(states.velocity)
    # What the integrator keeps: the discrete momentum of a step in its end frame.
    s = jnp.sqrt(4 / h**2 - jnp.sum(states.omega**2, axis=-1, keepdims=True))
    spin = jnp.einsum("nij,tnj->tni", inertia, states.omega)
    own = quat_rotate(states.orientation, 0.5 * h * (s * spin - jnp.cross(states.omega, spin)))
    angular = np.sum(np.cross(states.position, linear) + np.asarray(own), axis=1)
    lost = [np.abs(total[1:] - total[1]).max() for total in (np.sum(linear, axis=1), angular)]
    note = f"{LINKS} hinges, {n_steps * h:g} s in steps of 1 ms"
    return [
        Row(group, "floating chain: change of momentum", float(lost[0]), "kg m/s", 1e-9, note=note),
        Row(group, "floating chain: change of angular momentum", float(lost[1]), "kg m²/s", 1e-9, note=note),
    ]


def _four_bar(group: str, n_steps: int) -> list[Row]:
    bodies = [dano.Body(k, dano.Box((x / 2, 0.01, 0.01)), mass=2 * x) for k, x in BARS.items()]
    crank, coupler, rocker = BARS.values()
    places = {"crank": (None, crank / 2), "coupler": ("crank", (crank + coupler) / 2)}
    places["rocker"] = (None, GROUND + rocker / 2)
    joints = [
        dano.Joint(on, k, axis=(0, 1, 0), anchor=(-BARS[k] / 2, 0, 0), position=(x, 0, 0))
        for k, (on, x) in places.items()
    ]
    loop = dano.Loop("coupler", "rocker", position=(coupler / 2, 0, 0), anchor=(rocker / 2, 0, 0))
    scene = dano.Scene.create(bodies, contacts=(), joints=joints, loops=[loop], timestep=1e-3)
    open_ = scene.initial_state(crank=dict(q=-0.9), coupler=dict(q=-0.5), rocker=dict(q=-2))
    states = dano.simulate(scene, dano.close_loops(scene, open_, ["crank"]), n_steps).states
    loops = scene.closing
    assert loops is not None
    gap = float(np.abs(jax.vmap(loops.gaps)(states.position, states.orientation)).max())
    note = f"{n_steps * 1e-3:g} s in steps of 1 ms"
    return [Row(group, "four-bar: largest gap of its loop", gap, "m", 1e-9, note=note)]
