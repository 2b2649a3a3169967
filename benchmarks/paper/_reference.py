"""The authors' stored rollouts: their contact points and their constants, state by state and free-running.

Their constants are not dano's: the second-moment matrix in the place of the inertia tensor, friction without
the factor 2/π, contact that may pull, a hard indicator (docs/theory/paper.md).
"""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import dano
from benchmarks._measure import Row

OLD_FRICTION = np.pi / 2
LAW = dano.CentroidLaw(smoothing=30.0, regularizer=1e-3, adhesive=True)
# The reference stopped its Newton iterations at a residual of 1e-4 N s.
LOOSE = dano.VariationalEngine(tolerance=1e-5)
FIRST_CONTACT = 240  # step
FREE_RUNNING = 100  # steps of contact
FRICTIONS = (0.01, 0.1, 0.3, 0.7)
GROUP = "Stored rollouts of the authors"


def reference_rows(folder: Path, *, quick: bool) -> list[Row]:
    """Errors against the four slides of a bunny, and against the push of a bunny by a sphere."""
    collider = np.load(folder / "collider_bunny.npz")
    scene = _scene(_bunny(collider), "floor", _params(0.1, spring=1e5, damper=1e6), 0.002)
    flight, free, velocity = [], [], []
    for mu in FRICTIONS[:1] if quick else FRICTIONS:
        run = np.load(folder / f"bunny_trajectory_mu{mu}.npz")
        changed = scene.replace_contact("bunny", "floor", sliding_friction=mu * OLD_FRICTION)
        position_error = _free_running(changed, run)
        flight.append(position_error[:FIRST_CONTACT].max())
        free.append(position_error[-1])
        velocity.append(_teacher_forced(changed, run))
    wrench = _wrench_error(folder, collider)
    return [
        Row(GROUP, f"free flight, {FIRST_CONTACT} steps, largest error", max(flight), "m", 1e-9),
        Row(
            GROUP,
            "one step from each stored state in contact, median error",
            max(float(np.median(v)) for v in velocity),
            "m/s",
            2e-6,
            note="the worst of the slides' medians",
        ),
        Row(
            GROUP,
            "one step from each stored state in contact, largest error",
            max(float(v.max()) for v in velocity),
            "m/s",
            1e-4,
        ),
        Row(GROUP, f"free-running, after {FREE_RUNNING} steps of contact", max(free), "m", 1e-5),
        Row(GROUP, "contact force of floor and sphere, median error", float(np.median(wrench)), "N", 1e-5),
        Row(
            GROUP,
            "contact force of floor and sphere, largest error",
            float(wrench.max()),
            "N",
            note="the reference accepted residuals worth 0.03 N",
        ),
    ]


def _bunny(collider, com=None) -> dano.NeuralObject:
    bunny = dano.NeuralObject.from_samples(
        points=collider["particles"],
        density=collider["densities"],
        mass=collider["mass"],
        com=collider["center_of_mass"] if com is None else com,
        inertia=collider["inertia_tensor"],
    )
    # Past the check of inertias: no body has their matrix for its inertia.
    return eqx.tree_at(lambda body: body.mass.inertia, bunny, jnp.asarray(collider["inertia_stored"]))


def _params(sliding_friction: float, **changes: float) -> dano.ContactParams:
    return dano.ContactParams(
        sliding_friction=sliding_friction * OLD_FRICTION,
        torsional_friction=0.01 * OLD_FRICTION,
        rolling_friction=0.01 * OLD_FRICTION,
        sliding_drag=0.01,
        **changes,
    )


def _scene(bunny, other: str, params: dano.ContactParams, timestep: float) -> dano.Scene:
    others = {
        "floor": dano.Body("floor", dano.HalfSpace(edge=0.0), fixed=True),
        "sphere": dano.Body("sphere", dano.Sphere(0.25, edge=0.0), mass=10.0),
    }
    contacts = [dano.Contact("bunny", other, params, LAW)]
    return dano.Scene.create([dano.Body("bunny", bunny), others[other]], contacts, timestep=timestep)


def _with_floor(x, q, v, w) -> dano.State:
    """States of one body and a resting floor."""
    rest = jnp.zeros_like(x), jnp.zeros_like(q).at[:, 0].set(1), jnp.zeros_like(v), jnp.zeros_like(w)
    return dano.State(*(jnp.stack([a, b], axis=1) for a, b in zip((x, q, v, w), rest, strict=True)))


def _free_running(scene: dano.Scene, run) -> np.ndarray:
    """Position error [m] of each step of a rollout from the stored initial state."""
    start = {"position": (0, 0, 1.1), "orientation": (1, 0.6, 0, 0.5)}
    start |= {"velocity": (2, 2, 1), "omega": (0.5, 1, 1)}
    n_steps = FIRST_CONTACT + FREE_RUNNING
    rollout = dano.simulate(scene, scene.initial_state(bunny=start), n_steps, engine=LOOSE)
    return np.linalg.norm(np.asarray(rollout.states.position[:, 0]) - run["x"][: n_steps + 1], axis=1)


@jax.jit
def _following_velocities(scene: dano.Scene, states: dano.State):
    return jax.lax.map(lambda s: dano.step(scene, s).velocity[0], states, batch_size=32)


def _teacher_forced(scene: dano.Scene, run) -> np.ndarray:
    """Velocity error [m/s] one step after each stored state in contact."""
    x, q, v, w = (jnp.asarray(run[key]) for key in ("x", "q", "v15", "w15"))
    # v15[t] led to x[t + 1]: the state at t has velocity v15[t − 1] and leads to v15[t].
    t = np.arange(FIRST_CONTACT, len(v))
    following = _following_velocities(scene, _with_floor(x[t], q[t], v[t - 1], w[t - 1]))
    return np.linalg.norm(np.asarray(following - v[t]), axis=1)


def _wrench_error(folder: Path, collider) -> np.ndarray:
    """Change of momentum of the pushed bunny in each step, less what floor and sphere exert on it [N]."""
    run = np.load(folder / "nerf_sphere_bunny_N_1_friction_coefficient_0.1.npz")
    x, q, v, w = (jnp.asarray(run[key][0]) for key in "xqvw")
    h, mass = float(run["param_timestep"]), float(collider["mass"])
    params = _params(0.1, spring=3e4, damper=3e5)
    # In this scene the authors' floor saw the body as if its centre of mass were the origin of its field.
    on_floor = _scene(_bunny(collider, com=(0.0, 0.0, 0.0)), "floor", params, h)
    on_sphere = _scene(_bunny(collider), "sphere", params, h)
    floor = dano.contact_wrenches(on_floor, _with_floor(x[0], q[0], v[0], w[0]))[:, 0, :3]
    states = dano.State(*(jnp.swapaxes(a, 0, 1) for a in (x, q, v, w)))
    sphere = dano.contact_wrenches(on_sphere, states)[:, 0, :3]
    applied = jnp.asarray(run["u"][0][:-1, :3])
    force = mass * (v[0, 1:] - v[0, :-1]) / h + jnp.asarray([[0, 0, 9.81 * mass]]) - applied
    return np.linalg.norm(np.asarray(force - floor - sphere), axis=1)
