"""The law of a point: docs/theory/contact.md, from "Pressure and friction at a sample" on."""

from typing import NamedTuple

import numpy as np
from reference_step.rotations import cross_matrix


class Law(NamedTuple):
    """Parameters of a pair of bodies: symbols of docs/theory/contact.md.

    Attributes:
        k: Stiffness [Pa/m].
        e: Restitution, which a step with impacts may take less of.
        v_e: Restitution velocity [m/s].
        sigma: Hysteresis.
        mu: Sliding friction.
        phi: Friction fading.
        p_0: Friction pressure [Pa].
        v_s: Stiction velocity [m/s].
        theta: Implicitness.
        compliant: Whether impacts are left to the spring.
        h: Timestep [s].
        delta: Depth of an impact [m].
        F: Momentum that an impact passes on over that of the common mass, for each speed that is missing.
        slowest_rebound: v_e + g h or √(g δ), whichever is larger [m/s].
        gravity: g for samples that are deep [m/s²].
        damper: Hardest damper that a sample is in contact that lasts [N s/m].
    """

    k: float
    e: float
    v_e: float
    sigma: float
    mu: float
    phi: float
    p_0: float
    v_s: float
    theta: float
    compliant: bool
    h: float
    delta: float
    F: float
    slowest_rebound: float
    gravity: float
    damper: float


PARAMETERS = (
    "stiffness",
    "restitution",
    "restitution_velocity",
    "impact_depth",
    "hysteresis",
    "sliding_friction",
    "friction_fading",
    "friction_pressure",
)


def laws_of(scene):
    """The law of each of `scene.point_pairs`."""
    h, g = float(scene.timestep), float(np.linalg.norm(scene.gravity))
    groups = [(contact.law, contact.params, 1) for contact in scene.contacts if contact.law.presses]
    if scene.others is not None:
        groups.append((scene.others.law, scene.others.pair_params, len(scene.others.pairs)))
    found = []
    sizes = [min(float(scene.bodies[k].extent[4]) for k in pair) for pair in scene.point_pairs]
    inverse = [0.0 if body.fixed else 1 / float(body.mass * body.mass_scale) for body in scene.bodies]
    for law, params, count in groups:
        columns = [np.broadcast_to(getattr(params, name), count) for name in PARAMETERS]
        for numbers in np.array(columns).T:
            k, e, v_e, delta, sigma, mu, phi, p_0 = (float(x) for x in numbers)
            rest = float(law.stiction_velocity), float(law.implicitness), law.compliant
            F = np.clip(sizes[len(found)] / (2 * delta), 100.0, 1e4)
            rest = *rest, h, delta, F, max(v_e + g * h, (g * delta) ** 0.5), g if g > 0 else 9.81
            damper = 1e4 / (h * sum(inverse[body] for body in scene.point_pairs[len(found)]))
            found.append(Law(k, e, v_e, sigma, mu, phi, p_0, *rest, damper))
    return found


class Traction(NamedTuple):
    """Pressure p and friction f of n points, and their derivatives by v_n and u, for a Newton method.

    Attributes:
        p: [Pa].
        f: [Pa, W], shape (n, 3).
        p_slope: ∂p/∂v_n.
        f_slope: ∂f/∂v_n, shape (n, 3).
        f_matrix: ∂f/∂u, shape (n, 3, 3).
    """

    p: np.ndarray
    f: np.ndarray
    p_slope: np.ndarray
    f_slope: np.ndarray
    f_matrix: np.ndarray


def traction(law, points, rate, slip, softness=1.0):
    """What points feel that separate at `rate` and slip at `slip` [m/s].

    Args:
        law: Parameters.
        points: The points.
        rate: v_n, shape (n,).
        slip: u [W], shape (n, 3).
        softness: Multiplies v_s, for a solver on its way.
    """
    v_s = law.v_s * softness
    p, p_slope = pressure(law, points, rate, v_s)
    light = law.p_0 / (p + law.p_0)
    bound, bound_slope = law.mu * (1 - law.phi * (1 - light)) * p, law.mu * (1 - law.phi * (1 - light**2))
    speed = np.linalg.norm(slip, axis=1)
    slow = np.maximum(speed, v_s)
    c = slip / slow[:, None]
    along = np.where(speed > v_s, 1, 0)[:, None, None] * c[:, :, None] * c[:, None]
    return Traction(
        p=p,
        f=-bound[:, None] * c,
        p_slope=p_slope,
        f_slope=-(bound_slope * p_slope)[:, None] * c,
        f_matrix=-(bound / slow)[:, None, None] * (np.eye(3) - along),
    )


def pressure(law, points, rate, v_s):
    """p [Pa] at separating speeds v_n, and ∂p/∂v_n."""
    rho = (1 - law.e**2) / (1 + law.e**2) if law.compliant else 1.0
    sigma = min(law.sigma, rho)
    deep = np.maximum(points.depth, 0)
    v_e = np.maximum(law.v_e, np.sqrt(law.gravity * deep) / 5)
    x = rate / v_e
    saturation = x / np.sqrt(1 + x**2) if law.compliant else np.clip(x, -1, 1)
    saturation_slope = (1 + x**2) ** -1.5 if law.compliant else np.where(np.abs(x) < 1, 1, 0)
    c, c_slope = rate / np.maximum(np.abs(rate), v_s), np.where(np.abs(rate) < v_s, 1 / v_s, 0)
    lost = (rho - sigma) * saturation + sigma * c
    lost_slope = (rho - sigma) * saturation_slope / v_e + sigma * c_slope
    if law.compliant:
        D, D_slope = deep * lost, deep * lost_slope
        implicit = np.abs(D) <= np.abs(law.theta * law.h * rate)
        left = points.depth - np.where(implicit, law.theta * law.h * rate, D)
        p = law.k * np.maximum(left, 0)
        slope = -law.k * (left > 0) * np.where(implicit, law.theta * law.h, D_slope)
    else:
        left = np.maximum(points.depth - law.theta * law.h * rate, 0)
        k = np.minimum(law.k, law.damper * v_e / np.maximum(points.area * deep, 1e-300))
        p = k * left * (1 - lost)
        slope = -k * (left > 0) * (law.theta * law.h * (1 - lost) + left * lost_slope)

    missing = np.maximum(goals(law, points) - rate, 0)
    # Samples that are less deep than the impact get no deeper, or, where bodies wait until they meet, by so
    # much that there is a next impact.
    rest = law.h * max(1 - points.delays * points.share, 1e-6)
    before = points.delays * points.sunk + (1 - points.delays) * points.depth
    most = points.delta + points.delays * (points.deepest - points.delta)
    limit = np.minimum(before - most, 0) / rest
    below = np.maximum(limit - rate, 0)
    approach = points.rate - np.sum(points.normal * points.drift, axis=1)
    rested = 1 - points.delays * (1 - smooth_step(1 + points.sunk / points.delta))
    rests = (1 - smooth_step(-approach / law.slowest_rebound - 1)) * rested
    lasting = 1 - points.beta * (1 - rests)
    blow = points.impact * missing + points.kappa * below
    return lasting * p + blow, lasting * slope - points.impact * (missing > 0) - points.kappa * (below > 0)


def gained(law, points):
    """What velocities gain from an impact to the middle of the step: of points that leave, and what differs.

    The latter is that of points that stay: they accelerate along the normal no more, and across it no more
    than friction lets them, which turning does to what is fixed to a body. What turning takes away leaves.
    """
    Q, q = points.turns
    leaves = np.broadcast_to(points.gains, points.arm.shape)
    differs = -points.after * (points.arm @ Q.T + q) - leaves
    along = np.sum(points.normal * differs, axis=1)
    across = differs - along[:, None] * points.normal
    size = np.linalg.norm(across, axis=1)
    share = np.minimum(1, law.mu * np.abs(along) / np.where(size > 0, size, 1))
    stays = (along * points.after > 0)[:, None] * (along[:, None] * points.normal + share[:, None] * across)
    return leaves, stays


def rebounds(law, points):
    """Speeds of rebounds [m/s], and the share of each that counts."""
    rebound = -law.e * points.meets
    return rebound, smooth_step(2 * rebound / law.slowest_rebound - 1)


def goals(law, points):
    """v*: separating speeds that points aim at in an impact [m/s]."""
    approach = points.rate - np.sum(points.normal * points.drift, axis=1)
    rebound, fast = rebounds(law, points)
    leaves, stays = (np.sum(points.normal * x, axis=1) for x in gained(law, points))
    lasts = points.delays * (leaves + stays) + points.way * np.minimum(approach, 0)
    after = fast * (rebound + leaves) + (1 - fast) * lasts
    return after + np.maximum(after - approach, 0) / law.F


def extra_slip(law, points):
    """What is added to velocities before the slip is taken of them [m/s, W]."""
    if not np.any(points.impact > 0):
        return points.drift
    leaves, stays = gained(law, points)
    return points.drift - points.delays * (leaves + (1 - rebounds(law, points)[1])[:, None] * stays)


def smooth_step(x):
    """3 x² − 2 x³ between 0 and 1."""
    y = np.clip(x, 0, 1)
    return y * y * (3 - 2 * y)


class Wrench(NamedTuple):
    """What the points of a side do; `twist` is (u, w): see `relative`.

    Attributes:
        first: Force [N] and moment about its centre of mass [N m] on the first body [W], shape (6,).
        second: On the second body.
        slope: ∂(first)/∂(twist), shape (6, 6).
    """

    first: np.ndarray
    second: np.ndarray
    slope: np.ndarray


def wrench(points, velocities, softness=1.0):
    """What points do at velocities and spins of all bodies [m/s, rad/s; W], shape (n, 6)."""
    away, n, A = points.com_difference, points.normal, points.area[:, None]
    u, w = np.split(relative(points) @ velocities[[points.first, points.second]].ravel(), 2)
    rate = n @ u + points.moment @ w
    full = u + extra_slip(points.law, points) - points.arm @ cross_matrix(w)  # u + w × r
    slip = full - np.sum(full * n, axis=1, keepdims=True) * n
    found = traction(points.law, points, rate, slip, softness)
    press = np.concatenate([n, points.moment], axis=1)  # what a unit pressure does, and ∂v_n/∂(twist)
    # What friction does: force and moment of each direction, (n, 6, 3). Its transpose is ∂(full)/∂(twist).
    arms = np.array([cross_matrix(r) for r in points.arm]).reshape(-1, 3, 3)
    rub = np.concatenate([np.broadcast_to(np.eye(3), arms.shape), arms], axis=1)
    first = press.T @ (A[:, 0] * found.p) + np.sum(rub @ (A * found.f)[:, :, None], axis=0)[:, 0]
    slope = press.T @ (A * press * found.p_slope[:, None])
    slope += np.sum(rub @ (A * found.f_slope)[:, :, None] * press[:, None], axis=0)
    grips = rub @ (A[:, :, None] * found.f_matrix) @ (np.eye(3) - n[:, :, None] * n[:, None])
    slope += np.sum(grips @ rub.transpose(0, 2, 1), axis=0)
    return Wrench(first, -np.r_[first[:3], first[3:] + np.cross(away, first[:3])], slope)


def relative(points):
    """From velocities and spins of both bodies, (12,), to those of the first relative to the second, (6,).

    u is the velocity of the first centre of mass against the second body as a rigid frame, w the spin.
    """
    eye, zero = np.eye(3), np.zeros((3, 3))
    return np.block([[eye, zero, -eye, cross_matrix(points.com_difference)], [zero, eye, zero, -eye]])
