"""What the tests of this folder judge. Another engine is another row of `ENGINES`, or one more."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from reference_step import formulas

import dano
from dano.engine.launching import listed_points, scene_tables


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
    """

    name: str
    step: Callable[..., dano.State]
    find: Callable[..., dict[tuple[int, int], dict[str, Any]]]
    traction: Callable[..., tuple[np.ndarray, np.ndarray]]
    distance: Callable[..., tuple[np.ndarray, np.ndarray]]
    momentum: Callable[..., np.ndarray]
    turned: Callable[..., np.ndarray]
    meeting_error: float


def _traction(law, points, rate, slip):
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
    return formulas.traction(material, points, rate, slip)


def _distance(solid, x):
    distance, gradient = solid.sdf_jet(jnp.asarray(x.T), 1)
    return np.asarray(distance), np.asarray(gradient).T


@eqx.filter_jit
def _listed(scene, state):
    return listed_points(scene_tables(scene), state, dano.VariationalEngine().prepare(scene).capacity)


def _find(scene, state):
    """The search of the kernels."""
    if not len(scene.point_pairs):
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


TODAY = Engine(
    name="dano",
    step=dano.step,
    find=_find,
    traction=_traction,
    distance=_distance,
    momentum=formulas.angular_momentum,
    turned=formulas.orientation_after,
    # A root.
    meeting_error=1e-6,
)
ENGINES = (TODAY,)
