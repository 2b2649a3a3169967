"""What the tests of this folder judge. Another engine is another row of `ENGINES`, or one more."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import dano
from dano import contact
from dano.engine._problem import build_problem, links_of, prepare, structure_of
from dano.engine._rigid import angular_momentum, turned
from dano.engine.launching import listed_points, scene_tables

CHUNK = 16


class Engine(NamedTuple):
    """An engine as the tests call it; arrays in and out are NumPy's, points one a row.

    Attributes:
        name: Of the engine.
        step: From scene, state and control (or None) to the next state.
        find: From scene and state to the point contacts: by (sampled body, other body) a dict of `share` (τ)
            and the arrays `arm`, `normal`, `moment`, `depth`, `rate`, `area`, `drift`, `impact` of `Points`.
        traction: From a `Law`, `Points`, separating speeds (n,) and slips (n, 3) to pressure and friction.
        distance: From a solid and points (n, 3) to signed distances and gradients.
        momentum: From ω, J, h and a sign to P(ω) (+1) or P⁻(ω) (−1).
        turned: From q, ω and h to the orientation at the end of the step.
        meeting_error: By how much of a step τ may be too early.
        meeting_samples: Up to how many samples of a body count for τ; of more, only some do.
    """

    name: str
    step: Callable[..., dano.State]
    find: Callable[..., dict[tuple[int, int], dict[str, Any]]]
    traction: Callable[..., tuple[np.ndarray, np.ndarray]]
    distance: Callable[..., tuple[np.ndarray, np.ndarray]]
    momentum: Callable[..., np.ndarray]
    turned: Callable[..., np.ndarray]
    meeting_error: float
    meeting_samples: float


@eqx.filter_jit
def _found(scene, state):
    prepared, h = prepare(scene, None), scene.timestep
    if scene.joints:
        problem, where = build_problem(scene, prepared, state, None, structure_of(scene))
        return problem.points, where
    assert prepared.geometry is not None and prepared.impacts is not None
    return contact.find(prepared.geometry, links_of(scene, state, h), prepared.impacts, h, prepared.capacity)


def _find(scene, state):
    if not scene.point_pairs:
        return {}
    points, where = jax.tree.map(np.asarray, _found(scene, state))
    assert not where.overflow
    found = {}
    for side in sorted({(int(points.first[c]), int(points.second[c])) for c in range(int(where.count))}):
        chunks = [c for c in range(int(where.count)) if (int(points.first[c]), int(points.second[c])) == side]
        rows = points.rows[:, chunks].reshape(15, -1)
        rows = np.r_[rows, np.repeat(points.stiffness[chunks], CHUNK)[None]][:, rows[11] > 0]
        parts = np.split(rows.T, np.cumsum([3, 3, 3, 1, 1, 1, 3]), axis=1)
        names = ("arm", "normal", "moment", "depth", "rate", "area", "drift", "impact")
        found[side] = {name: x if x.shape[1] > 1 else x[:, 0] for name, x in zip(names, parts, strict=True)}
        found[side]["share"] = float(where.share[chunks[0]])
    return found


def _traction(law, points, rate, slip):
    n = len(rate)
    columns = (points.arm, points.normal, points.moment, points.depth[:, None], points.rate[:, None])
    rows = np.concatenate([*columns, points.area[:, None], points.drift], axis=1).T[:, None]
    none = jnp.zeros(n, int)
    # A chunk for each point, which may have a stiffness of its own.
    listed = contact.Points(
        jnp.asarray(rows.reshape(15, n, 1)), jnp.asarray(points.impact), jnp.zeros((3, n)), none, none, none
    )
    material = dict(
        stiffness=law.k,
        restitution=law.e,
        restitution_velocity=law.v_e,
        hysteresis=law.sigma,
        friction=law.mu,
        friction_fading=law.phi,
        friction_pressure=law.p_0,
        stiction=law.v_s,
        ahead=law.theta * law.h,
        timestep=law.h,
        instant=0.0 if law.compliant else 1.0,
        bounce=law.slowest_rebound,
        uplift=0.04 * law.gravity,
    )
    motion = contact.Motion(jnp.asarray(rate)[:, None], jnp.asarray(slip).T[:, :, None])
    same = contact.Material(**{name: jnp.full(n, x) for name, x in material.items()})
    pressure, friction = contact.traction(same, listed, motion)
    return np.asarray(pressure)[:, 0], np.asarray(friction)[:, :, 0].T


def _distance(solid, x):
    distance, gradient = solid.sdf_jet(jnp.asarray(x.T), 1)
    return np.asarray(distance), np.asarray(gradient).T


def _momentum(omega, inertia, h, sign):
    return np.asarray(angular_momentum(jnp.asarray(omega), jnp.asarray(inertia), jnp.asarray(h), sign))


def _turned(q, omega, h):
    return np.asarray(turned(jnp.asarray(q), jnp.asarray(omega), jnp.asarray(h)))


@eqx.filter_jit
def _listed(scene, state):
    return listed_points(scene_tables(scene), state, prepare(scene, None).capacity)


def _find_by_kernels(scene, state):
    """The search of the kernels, which make the steps of free bodies with the default law."""
    if not scene.point_pairs:
        return {}
    listed = {name: np.asarray(x) for name, x in _listed(scene, state).items()}
    assert not listed.pop("overflow")
    listed = {name: x[listed["area"] > 0] for name, x in listed.items()}
    nearing = (listed["rate"] - listed["approach"])[:, None] * listed["normal"]
    listed["drift"] = listed["extra_slip"] + nearing
    listed["impact"] = listed["impact_stiffness"]
    found = {}
    for side in sorted(set(zip(listed["first"].astype(int), listed["second"].astype(int), strict=True))):
        mine = (listed["first"] == side[0]) & (listed["second"] == side[1])
        names = ("arm", "normal", "moment", "depth", "rate", "area", "drift", "impact")
        found[side] = {name: listed[name][mine] for name in names}
        found[side]["share"] = float(listed["share"][mine][0])
    return found


def _find_as_stepped(scene, state):
    """The search that the step of a scene makes."""
    kernels = prepare(scene, None).tables is not None
    return (_find_by_kernels if kernels else _find)(scene, state)


TODAY = Engine(
    name="dano",
    step=dano.step,
    find=_find_as_stepped,
    traction=_traction,
    distance=_distance,
    momentum=_momentum,
    turned=_turned,
    # A root, and of bodies with many samples that of the centres of their blocks.
    meeting_error=1e-6,
    meeting_samples=256,
)
ENGINES = (TODAY,)
