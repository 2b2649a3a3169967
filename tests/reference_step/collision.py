"""Finding contact: docs/theory/contact.md, "Which side is sampled" and from "Finding contact" on."""

from typing import NamedTuple

import numpy as np
from reference_step.bodies import Bodies
from reference_step.distances import signed_distance
from reference_step.law import Law, laws_of, smooth_step
from reference_step.rotations import cross_matrix

import dano

POLE = np.array([0.36, -0.48, 0.8])
FROM_Z = np.array([[0.8, 0.48, -0.36], [0.6, -0.64, 0.48], [0.0, -0.6, -0.8]])
"""A direction in which upright bodies do not press, and a rotation that takes z to its opposite."""


class Side(NamedTuple):
    """Samples of body i that press on the solid of body j; `half` of each area counts, ½ or 1."""

    i: int
    j: int
    law: Law
    half: float


class Points(NamedTuple):
    """Listed samples of a side, n points; vectors in the world frame, see docs/conventions.md.

    Attributes:
        first: Index of the sampled body.
        second: Index of the body that it presses on.
        law: Parameters.
        share: τ.
        com_difference: From the second centre of mass to the first [m], each where it is when impulses on it
            take effect.
        arm: r [m], shape (n, 3).
        normal: n.
        moment: Of a unit pressure about the first centre of mass [m].
        depth: d of the law [m], shape (n,).
        rate: v_n⁻ [m/s].
        meets: v_n when bodies meet [m/s].
        gains: What gravity adds to the velocity from then to the middle of the step [m/s], shape (3,).
        after: How long that is [s], below zero where they meet later.
        turns: Q and q of how points at r accelerate by turning after an impact, Q r + q [m/s²].
        support: Impulse of what the side rests on in a step, on the first body [N s, N m s], shape (6,).
        area: A [m²].
        drift: ½ ω⁻ × (r₁ − r₀), its tangential part limited [m/s], shape (n, 3).
        impact: κ w [Pa s/m], zero where there is no impact, shape (n,).
        kappa: κ [Pa s/m].
        sunk: Depth where geometry is taken [m], shape (n,).
        delta: Depth of the impact [m].
        deepest: Depth that another part of the body may have, whose impact is left to the next step [m].
        beta: Share of the contact that is an impact.
        delays: Impulses take effect after this share of τ.
        way: Share of the step in which bodies go on as before.
        part: Share of an impact that the side carries.
        left_out: Share of a sample that rests which has no part in an impact.
        waits: Whether impulses on the first and on the second body take effect when the bodies meet.
        holds: Whether the bodies lie on each other there while they wait for an impact.
        seen: The bodies with what their velocities gain until then.
    """

    first: int
    second: int
    law: Law
    share: float
    com_difference: np.ndarray
    arm: np.ndarray
    normal: np.ndarray
    moment: np.ndarray
    depth: np.ndarray
    rate: np.ndarray
    meets: np.ndarray
    gains: np.ndarray
    after: float
    turns: tuple[np.ndarray, np.ndarray]
    support: np.ndarray
    area: np.ndarray
    drift: np.ndarray
    impact: np.ndarray
    kappa: float
    sunk: np.ndarray
    delta: float
    deepest: float
    beta: float
    delays: float
    way: float
    part: float
    left_out: float
    waits: tuple[bool, bool] = (False, False)
    holds: bool = False
    seen: Bodies | None = None


def sides_of(scene):
    """Which body's samples press on which other body."""
    found = []
    for (a, b), law in zip(scene.point_pairs, laws_of(scene), strict=True):
        both = [(i, j) for i, j in ((a, b), (b, a)) if presses(scene.bodies[i], scene.bodies[j])]
        found += [Side(i, j, law, 1 / len(both)) for i, j in both]
    return found


def presses(first, second):
    if first.surface is None or second.solid is None:
        return False
    ball = second.surface is not None and second.surface.turning == "ball"
    return first.object is not None or first.surface.turning == "ball" or not ball


def samples_of(body):
    """Points [m, F] and vector areas [m², F] of a body's surface, (n, 3), without what fills up blocks."""
    points, vectors = np.asarray(body.surface.points)[:3].T, np.asarray(body.surface.vectors).T
    real = np.any(vectors != 0, axis=1)
    return points[real], vectors[real]


class Pair:
    """Two bodies of a side after a share of the step."""

    def __init__(self, scene, bodies, side, share):
        i, j = side.i, side.j
        self.body, self.solid, self.turning = (
            scene.bodies[i],
            scene.bodies[j].solid,
            scene.bodies[i].surface.turning,
        )
        self.com, self.other_com = bodies.com[i], bodies.com[j]
        self.x, self.R = bodies.pose(i, share)
        self.other_x, self.other_R = bodies.pose(j, share)
        self.toward = None if self.turning == "fixed" else self.facing()
        points, vectors = self.turned(self.toward)
        self.places = self.world(points)
        self.vectors = vectors @ self.R.T
        if self.turning == "axis":
            self.front = self.R @ about_z(self.toward) @ np.array([1, 0, 0])
        if self.turning == "ball":
            S = semi_axes(self.body.shape)
            self.front = unit(self.R @ (from_z(-unit(S * self.toward)) @ np.array([0, 0, -1]) / S))

    def world(self, points):
        """Points of the first body's field frame in the world."""
        return self.x + (points - self.com) @ self.R.T

    def distance(self, places):
        """Distance to the solid and its normal [W] at places [m, W]."""
        distance, normal = signed_distance(
            self.solid, (places - self.other_x) @ self.other_R + self.other_com
        )
        return distance, normal @ self.other_R.T

    def facing(self):
        """Direction [F] in which a ball, ellipsoid, cylinder or capsule faces the solid."""

        def look(point):
            distance, normal = self.distance(self.world(point[None]))
            return distance[0], -normal[0] @ self.R

        if self.turning == "axis":
            return look(np.zeros(3))[1]
        S = semi_axes(self.body.shape)
        return first_touch(look, S)

    def turned(self, toward):
        """Samples [m, F] and vector areas [m², F] that face a direction [F]."""
        points, vectors = samples_of(self.body)
        if self.turning == "fixed":
            return points, vectors
        if self.turning == "axis":
            Q = about_z(toward)
            return points @ Q.T, vectors @ Q.T
        S = semi_axes(self.body.shape)
        Q = from_z(-unit(S * toward))
        return S * (points @ Q.T), np.prod(S) / S * (vectors @ Q.T)

    def lowest(self, toward):
        """The point [m, F] of a ball or an ellipsoid that comes closest."""
        S = semi_axes(self.body.shape)
        return S * (from_z(-unit(S * toward)) @ np.array([0, 0, -1]))


def semi_axes(shape):
    """Of a ball or an ellipsoid [m]."""
    return np.full(3, shape.radius) if isinstance(shape, dano.Sphere) else np.asarray(shape.semi_axes)


def first_touch(look, S):
    """Direction to the point x of a solid with the least |S⁻¹ x|, by projected gradients with momentum.

    Args:
        look: From a point [F] to its distance from the solid and the direction there.
        S: Semi-axes [m].
    """
    least, root = S.min(), np.sqrt(0.7) * S.min() / S.max()
    x = last = direction = np.zeros(3)
    for k in range(12):
        start = x - 0.7 * (least / S) ** 2 * x
        distance, direction = look(start)
        touched = start + max(distance, 0) * direction
        x = touched + (k > 0) * (1 - root) / (1 + root) * (touched - last)
        if np.linalg.norm(touched - last) < 1e-6 * least:
            break
        last = touched
    return direction


def from_z(direction):
    """A rotation that takes z to a unit vector: `FROM_Z`, then the shortest turn from the pole's opposite."""
    axis = np.cross(-POLE, direction)
    K = cross_matrix(axis)
    return (np.eye(3) + K + K @ K / (1 - POLE @ direction)) @ FROM_Z


def about_z(toward):
    """The rotation about z that takes x to where a direction points; none if that is along z."""
    size = np.hypot(toward[0], toward[1])
    if size <= 1e-6:
        return np.eye(3)
    x, y = toward[:2] / size
    return np.array([[x, -y, 0], [y, x, 0], [0, 0, 1]])


def unit(v):
    return v / np.linalg.norm(v)


def depths_of(scene, side):
    """Depths [m]: of an impact; predicted in contact that lasts; of parts whose impact is the next step's."""
    (_, size, thickness) = np.minimum(*(np.asarray(scene.bodies[k].extent)[3:] for k in (side.i, side.j)))
    thin = 0.25 * thickness
    delta = min(side.law.delta, thin)
    return delta, max(delta, min(0.01 * size, thin)), max(delta, min(0.04 * size, thin))


class Meeting(NamedTuple):
    """When geometry of a side is taken: a share of the step, and of what depth it tells."""

    share: float
    hits: bool = False
    lasts: bool = False
    falls: bool = False
    support: np.ndarray = np.zeros(6)
    left_out: float = 0.0
    waits: bool = True


def meetings(scene, bodies, side):
    """That of an impact, and that of contact that lasts."""
    delta, sink, _ = depths_of(scene, side)
    lasting = Meeting(share_at(scene, bodies.held(), side, sink, sink, 0.0), lasts=True)
    if side.law.compliant:
        return lasting, lasting
    slow = side.law.slowest_rebound
    raw, bodies = bodies, bodies.falling()
    since = -1.0 if is_alone(scene, bodies, side) else 0.0
    share = share_at(scene, bodies, side, delta, bodies.h * slow, slow, since)
    falls = nears(scene, bodies, side, delta, slow)
    support, left_out = np.zeros(6), 0.0
    if is_alone(scene, bodies, side) and share < 1 and falls:
        rest = rest_of(scene, raw, side, delta)
        if rest is not None:
            near, depth, arm, normal = rest
            support = smooth_step(near) * support_of(scene, bodies, side, arm, normal)
            left_out = smooth_step(near) * min(side.law.F / 1e4, 1.0) * bool(np.any(support))
            held = bodies.supported(on_bodies(bodies, side.i, side.j, support))
            share = share_at(scene, held, side, delta + 2 * depth, bodies.h * slow, slow, since)
            falls = nears(scene, held, side, delta, slow)
    hitting = Meeting(
        share, bool(share < 1), falls=falls, support=support, left_out=left_out, waits=since < 0
    )
    return hitting, lasting


def on_bodies(bodies, i, j, impulse):
    """An impulse on body i at its centre of mass, and back on body j, shape (n, 6)."""
    found = np.zeros((len(bodies.mass), 6))
    away = bodies.position[i] - bodies.position[j]
    found[i] = impulse
    found[j] = -np.r_[impulse[:3], impulse[3:] + np.cross(away, impulse[:3])]
    return found


def rest_of(scene, bodies, side, delta):
    """What a side rests on at the start of the step: its nearness, depth, arm and normal; None if nothing.

    Samples count by the cube of how near they are over δ and what bodies fall by in a step, slow ones alone.
    """
    pair = Pair(scene, bodies, side, 0.0)
    distance, normal = pair.distance(pair.places)
    facing = -np.sum(pair.vectors * normal, axis=1)
    if pair.turning != "fixed":
        normal = rounded(pair, normal)
    u, w = bodies.relative(side.i, side.j)
    after, arm, moment = levers(scene, bodies, side, 0.0, pair, normal)
    approach = normal @ u + moment @ w
    if pair.turning != "fixed":
        approach = approach - np.sum(normal * drifts(u, w, after, arm, normal), axis=1)
    fall = delta + 0.5 * bodies.h * np.linalg.norm(bodies.falls[side.i] - bodies.falls[side.j])
    speed = approach / side.law.slowest_rebound
    slow = (1 - smooth_step(-speed - 1)) * (1 - smooth_step(speed))
    near = np.clip(1 - distance / fall, 0, 2)
    weights = near**3 * slow * (facing > 0) * (distance < fall)
    if weights.sum() == 0:
        return None
    weights = weights / weights.sum()
    return weights @ near, weights @ np.maximum(-distance, 0), weights @ arm, weights @ normal


def mover(bodies, side, arm, normal):
    """The body of a side that moves, the other being fixed: sign, index, arm, unit normal, mobility there."""
    sign, k = (1, side.i) if bodies.moves[side.i] else (-1, side.j)
    r = arm if sign == 1 else arm + bodies.position[side.i] - bodies.position[side.j]
    K = cross_matrix(r)
    return (
        sign,
        k,
        r,
        sign * unit(normal),
        bodies.inverse_mass[k] * np.eye(3) - K @ bodies.inverse_inertia[k] @ K,
    )


def stopping(velocity, mobility, normal, mu):
    """Impulse that stops a point, or, where that is beyond friction, its motion along the normal [N s]."""
    impulse = np.linalg.solve(mobility, -velocity)
    presses = normal @ impulse
    across = impulse - presses * normal
    size = np.linalg.norm(across)
    if size <= mu * presses:
        return impulse
    along = normal + mu * across / size
    slows = max(normal @ mobility @ along, 0.05 * normal @ mobility @ normal)
    return max(-normal @ velocity, 0) / slows * along


def turning_of(scene, bodies, side, k, velocity, spin):
    """Q and q: how points at r from the first centre of mass accelerate because body k turns, Q r + q [m/s²].

    Of what is fixed to the first body: ω × (ω × r) + γ × r. Where the second moves, its surface passes a
    point at rest, so that the arm from its centre changes by −v.
    """
    inverse = bodies.inverse_inertia[k]
    gyroscopic = cross_matrix(-inverse @ np.cross(spin, np.linalg.solve(inverse, spin)))
    if k == side.i:
        turning = scene.bodies[k].surface.turning
        axis = bodies.pose(k, 0)[1][:, 2]
        follows = {"fixed": spin, "axis": spin - (spin @ axis) * axis, "ball": 0 * spin}[turning]
        return cross_matrix(follows) @ cross_matrix(follows) + gyroscopic * (turning == "fixed"), np.zeros(3)
    Q = cross_matrix(spin) @ cross_matrix(spin) - gyroscopic
    return Q, Q @ (bodies.position[side.i] - bodies.position[side.j]) + 2 * np.cross(spin, velocity)


def support_of(scene, bodies, side, arm, normal):
    """Impulse of a point that a side rests on in a step, on the first body [N s, N m s]."""
    sign, k, r, n, mobility = mover(bodies, side, arm, normal)
    Q, q = turning_of(scene, bodies, side, k, bodies.velocity[k], bodies.spin[k])
    bends = sign * (Q @ arm + q)
    moves = bodies.velocity[k] + np.cross(bodies.spin[k], r) - 0.5 * bodies.h * bends
    moves = moves - min(n @ moves, 0) * n
    impulse = sign * stopping(bodies.gain[k] + bodies.h * bends + moves, mobility, n, side.law.mu)
    return np.r_[impulse, np.cross(arm, impulse)]


def turns_after(scene, bodies, side, share, arm, normal):
    """Q and q after an impact at an arm, of a body with one that is fixed."""
    _, k, r, n, mobility = mover(bodies, side, arm, normal)
    v = bodies.velocity[k] + (0.5 + share) * bodies.gain[k]
    w = bodies.spin[k] + (0.5 + share) * bodies.spin_gain[k]
    impulse = stopping(v + np.cross(w, r), mobility, n, side.law.mu)
    w = w + bodies.inverse_inertia[k] @ np.cross(r, impulse)
    return turning_of(scene, bodies, side, k, v + bodies.inverse_mass[k] * impulse, w)


def is_alone(scene, bodies, side):
    """Whether one of the bodies is fixed, and the other moves freely."""
    return not scene.joints and not (bodies.moves[side.i] and bodies.moves[side.j])


def nears(scene, bodies, side, limit, slow):
    """Whether a sample that may get as deep as a limit [m] goes in faster than `slow` [m/s]."""
    if nearing(scene, bodies, side) <= slow:
        return False
    _, goes_in, near = seen(scene, bodies, side, limit, slow, 0.0)
    return bool(np.any(goes_in & near))


def share_at(scene, bodies, side, limit, least_way, slow, since=0.0):
    """τ: share of the step at which the first sample that goes in is as deep as a limit [m]; else 1.

    Bodies that near each other by less than `least_way` [m] are looked at at the end, and samples no faster
    than `slow` [m/s] do not count. Where one is deeper at the start, bodies are followed back until `since`.
    """
    if bodies.h * nearing(scene, bodies, side) <= least_way:
        return 1.0

    def look(share):
        """Whether a sample is too deep and goes in, and the share within which none can get there."""
        (distance, speed), goes_in, _ = seen(scene, bodies, side, limit, slow, share)
        deep = distance <= -limit
        safe = np.where(deep, np.inf, (distance + limit) / (1.5 * bodies.h * speed))
        return np.any(deep & goes_in), safe.min()

    share = 0.0
    too_deep, safe = look(share)
    if too_deep:
        earlier = np.linspace(0.0, since, 201)[1:]
        free = next((s for s in earlier if not look(s)[0]), None)
        return since if free is None else bisected(lambda s: look(s)[0], free, free - since / 200)
    while share < 1:
        before, share = share, min(share + max(safe, 1e-4), 1.0)
        too_deep, safe = look(share)
        if too_deep:
            return bisected(lambda s: look(s)[0], before, share)
    return 1.0


def fastest(scene, bodies, side):
    """More than any point of one body moves relative to the other [m/s]."""
    i, j = side.i, side.j
    radius = float(scene.bodies[i].extent[3])
    apart = np.linalg.norm(bodies.position[i] - bodies.position[j])
    spins = np.linalg.norm(bodies.spin[[i, j]], axis=1)
    return np.linalg.norm(bodies.velocity[i] - bodies.velocity[j]) + spins @ [radius, radius + apart]


def nearing(scene, bodies, side):
    """More than any point of one body nears the other [m/s]: a plane at rest only along its normal."""
    j = side.j
    still = not (np.any(bodies.velocity[j]) or np.any(bodies.spin[j]))
    most = fastest(scene, bodies, side)
    if still and isinstance(scene.bodies[j].shape, dano.HalfSpace):
        normal, radius = bodies.pose(j, 0)[1][:, 2], float(scene.bodies[side.i].extent[3])
        speed = np.abs(normal @ bodies.velocity[side.i])
        most = min(most, speed + np.linalg.norm(bodies.spin[side.i]) * radius)
    return most


def seen(scene, bodies, side, limit, slow, share):
    """Distances of samples after a share of the step and how fast they move [m/s], and what moves in.

    Returns:
        Distances and speeds; which go in faster than `slow` [m/s], gravity aside or not; which may get as
        deep as a limit [m] within a step.
    """
    (u, w), h = bodies.relative(side.i, side.j), bodies.h
    pair = Pair(scene, bodies, side, share)
    distance, normal = pair.distance(pair.places)
    # What faces the other body does not turn with its own, a cylinder's samples not about its axis.
    axis, turning = pair.R[:, 2], scene.bodies[side.i].surface.turning
    turns = {"fixed": w, "axis": w - (w @ axis) * axis, "ball": 0 * w}[turning]
    velocity = u + np.cross(turns, pair.places - pair.x)
    gain, spin_gain = bodies.gains(side.i, side.j)
    gain = gain + np.cross(spin_gain * (turning == "fixed"), pair.places - pair.x)
    rate = np.sum(normal * velocity, axis=1)
    goes_in = np.maximum(rate, rate + (0.5 + share) * np.sum(normal * gain, axis=1)) < -slow
    most = 1.5 * np.linalg.norm(gain, axis=1)
    speed = np.maximum(np.linalg.norm(velocity, axis=1) + most, 1e-12)
    way = 1.5 * h * (fastest(scene, bodies, side) + most.max())
    return (distance, speed), goes_in, (distance <= way - limit) | (turning != "fixed")


def bisected(true_from, low, high):
    """The largest share before something becomes true."""
    for _ in range(45):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if true_from(middle) else (middle, high)
    return low


def find(scene, bodies, shares=None):
    """The listed points of every side; `shares` are given τ by (i, j), of those that are not to be exact."""
    shares = shares or {}
    found = []
    for side in sides_of(scene):
        hitting, lasting = meetings(scene, bodies, side)
        given = shares.get((side.i, side.j))
        met = hitting if listed(scene, bodies, side, hitting).beta > 0 else lasting
        found.append(listed(scene, bodies, side, met if given is None else met._replace(share=given)))
    return together(bodies, halved([points for points in found if len(points.area)]))


def rounded(pair, normal):
    """Normals with those of a round surface where the solid's are not those of a face: at its edges."""
    own = -unit_rows(pair.vectors)
    if pair.turning == "axis":
        own = np.where(np.abs(own @ pair.R[:, 2:]) > 1e-6, normal, own)
    cosine = -normal @ pair.front
    share = smooth_step((np.cos(np.pi / 12) - cosine) / (np.cos(np.pi / 12) - np.cos(np.pi / 6)))[:, None]
    return unit_rows(normal + share * (own - normal))


def unit_rows(vectors):
    """Vectors of unit length."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def listed(scene, bodies, side, met):
    """The listed points of a side whose geometry is taken when its bodies meet."""
    start = bodies
    bodies = bodies.falling() if met.falls else bodies.held()
    if met.falls:
        bodies = bodies.supported(on_bodies(bodies, side.i, side.j, met.support))
    i, j, h, share = side.i, side.j, bodies.h, met.share
    pair = Pair(scene, bodies, side, share)
    distance, normal = pair.distance(pair.places)
    facing = -np.sum(pair.vectors * normal, axis=1)
    size = np.linalg.norm(pair.vectors, axis=1)
    other = (distance < 0) & (facing < -0.5 * size)  # in the solid, and turned away from its nearest side
    if pair.turning != "fixed":
        normal = rounded(pair, normal)
    normal = np.where(other[:, None], -pair.vectors / size[:, None], normal)
    area = side.half * np.where(other, size, np.maximum(facing, 0))

    u, w = bodies.relative(i, j)
    after, arm, moment = levers(scene, bodies, side, share, pair, normal)
    rate = normal @ u + moment @ w
    drift = drifts(u, w, after, arm, normal) if pair.turning != "fixed" else np.zeros_like(arm)
    gains, spin_gains = bodies.gains(i, j)
    gain, spin_gain = normal @ gains, moment @ spin_gains
    depth = -distance + share * h * (rate + 0.5 * (1 + share) * gain + spin_gain)

    smaller = min(float(scene.bodies[k].extent[4]) for k in (i, j))
    margin = 0.001 * smaller + 2 * np.linalg.norm(bodies.gravity) * h * h
    delta, _, deepest = depths_of(scene, side)
    # What has separated since a moment before the step was not deeper then.
    before = np.minimum(-distance, depth) if share < 0 else -distance
    in_patch = ~other & (before > -delta) & (share < 1)
    near = (area > 0) & ((depth - h * rate > -margin) | in_patch)
    usual = near & ~other
    sunk = np.maximum(before, 0)
    inside_out = np.sum((area * sunk)[other]) > np.sum((area * sunk)[usual])
    kept = np.concatenate([np.flatnonzero(usual), np.flatnonzero(near & other & inside_out)])
    hit = usual & (sunk > 0)
    approach = rate - np.sum(normal * drift, axis=1)
    x = sunk / delta
    left_out = met.left_out * met.falls
    counts = 1 - (1 - smooth_step(-approach / side.law.slowest_rebound - 1)) * left_out
    weight = fading_in(x) * hit * counts
    near_load = area * usual * fading_in(1 + before / delta) * counts
    beta, stiffness = 0.0, 0.0
    if not met.lasts:
        beta, stiffness = impact(bodies, side, arm, normal, area * weight, near_load, approach)
    delays, turns = beta * (met.hits and met.waits and not scene.joints), (np.zeros((3, 3)), np.zeros(3))
    if delays > 0 and is_alone(scene, bodies, side):
        load = area * weight / (area * weight).sum()
        turns = turns_after(scene, bodies, side, share, load @ arm, load @ normal)
    return Points(
        first=i,
        second=j,
        law=side.law,
        share=share,
        com_difference=start.position[i] - start.position[j],
        arm=arm[kept],
        normal=normal[kept],
        moment=moment[kept],
        depth=depth[kept],
        rate=rate[kept],
        meets=(approach + (0.5 + share) * (gain + spin_gain))[kept],
        gains=(0.5 - share) * (bodies.falls[i] - bodies.falls[j]),
        after=(0.5 - share) * h * met.hits,
        turns=turns,
        support=met.support * met.falls,
        area=area[kept],
        drift=drift[kept],
        impact=(stiffness * met.hits * weight)[kept],
        kappa=stiffness * met.hits,
        sunk=np.where(other, 0, before)[kept],
        delta=delta,
        deepest=deepest,
        beta=beta,
        delays=delays,
        way=(1 - delays) * max(share, 0) * met.hits,
        part=1.0,
        left_out=left_out,
        seen=bodies,
    )


def levers(scene, bodies, side, share, pair, normal):
    """Arms r₁ of the predicted places and r₀ of the law, and moments of a unit pressure [m, W]."""
    i, j, h = side.i, side.j, bodies.h
    after = pair.places - pair.x
    if pair.turning == "fixed":
        second = scene.bodies[j].surface
        follows = second is not None and second.turning != "fixed"
        arm = after + follows * share * h * (bodies.velocity[i] - bodies.velocity[j])
        return after, arm, np.cross(arm, normal)
    angle = h * np.linalg.norm(bodies.spin[i])
    _, before = bodies.pose(i, share * min(1, (angle / 0.5) ** 2))
    toward = before.T @ pair.R @ pair.toward
    arm = (pair.turned(toward)[0] - pair.com) @ before.T
    if pair.turning == "axis":
        axis, moment = before[:, 2], np.cross(arm, normal)
        return after, arm, moment - np.outer(moment @ axis, axis)
    lowest = before @ (pair.lowest(toward) - pair.com) / max(1, angle)
    return after, arm, np.cross(lowest, normal)


def drifts(u, w, after, arm, normal):
    """½ ω⁻ × (r₁ − r₀), of which the tangential part is at most the slip at r₁ [m/s, W]."""

    def across(v):
        return v - np.sum(v * normal, axis=1, keepdims=True) * normal

    change = 0.5 * np.cross(w, after - arm)
    size = np.linalg.norm(across(change), axis=1)
    slip = np.linalg.norm(across(u + np.cross(w, after)), axis=1)
    excess = np.where(size > slip, 1 - slip / np.where(size > 0, size, 1), 0)
    return change - excess[:, None] * across(change)


def fading_in(x):
    """w of samples at x times the depth of an impact."""
    y = np.maximum(x, 0)
    return np.where(y < 1, y**2, 2 * y - 1)


def impact(bodies, side, arm, normal, load, near_load, approach):
    """β, and κ [Pa s/m] of a side; A w of samples that have sunk in, and of those that nearly have."""
    if side.law.compliant or load.sum() == 0:
        return 0.0, 0.0
    weights = load / load.sum()
    nearing = -(near_load @ approach) / near_load.sum()
    beta = float(smooth_step(nearing / side.law.slowest_rebound - 1))
    r, n = weights @ arm, weights @ normal
    mobility = bodies.inverse_mass[side.i] + bodies.inverse_mass[side.j]
    for k, lever in ((side.i, r), (side.j, r + bodies.position[side.i] - bodies.position[side.j])):
        turning = np.cross(lever, n)
        mobility += turning @ bodies.inverse_inertia[k] @ turning
    factor = beta * side.law.F / (1 + (1 - beta) * side.law.F)
    return beta, factor / (bodies.h * mobility * load.sum())


def halved(found):
    """Sides of pairs as they take part in one impact, with half of it each if both do."""
    hits = {points[:2] for points in found if np.any(points.impact > 0)}
    return [
        points._replace(impact=points.impact / 2, kappa=points.kappa / 2, part=0.5)
        if points[:2] in hits and points[1::-1] in hits
        else points
        for points in found
    ]


def together(bodies, found):
    """Sides with impacts: impulses wait where bodies have one with one other, and else lie on fixed ones."""
    if not any(points.kappa > 0 for points in found):
        return found
    partners = [set() for _ in bodies.mass]
    found = [points._replace(holds=holds(bodies, points)) for points in found]
    for points in found:
        on_moving = points.holds and all(bodies.moves[list(points[:2])])
        if points.kappa > 0 or not is_quiet(bodies, points) or on_moving:
            # Who lies on one that moves has no partner.
            partners[points.first] |= {points.second, -1} if on_moving else {points.second}
            partners[points.second] |= {points.first, -1} if on_moving else {points.first}
    held = {k for points in found if points.holds for k in points[:2]}

    def waiting(points):
        if not points.delays:
            return points
        carried = held if np.any(points.support) else set()
        waits = all(
            not bodies.moves[k] or (partners[k] == {other} and k not in carried)
            for k, other in (points[:2], points[1::-1])
        )
        if not waits:
            return points._replace(delays=0.0, way=max(points.share, 0.0))
        return points._replace(waits=tuple(bool(bodies.moves[k]) for k in points[:2]))

    found = [waiting(points) for points in found]
    until = {k: when_met(found, k)[0] for points in found for k in points[:2]}

    def apart(points):
        x, other = (points.seen.pose(k, until[k])[0] for k in points[:2])
        return points._replace(com_difference=x - other)

    return [apart(points) for points in found]


def is_quiet(bodies, points):
    """Whether no part of a side gets in that nears the other body by more than it falls in half a step."""
    slow = 0.5 * bodies.h * np.linalg.norm(bodies.gravity)
    return not np.any((points.depth - bodies.h * points.rate > 0) & (points.rate < -slow))


def holds(bodies, points):
    """Whether a side holds its bodies while they wait for an impact: it touches, and has none."""
    return points.kappa == 0 and bool(np.any(points.depth > 0)) and is_quiet(bodies, points)


def when_met(found, k):
    """Share of the step after which impulses on a body take effect, and β; the mean of several."""
    waiting = [
        (points.delays * points.share, points.delays)
        for points in found
        for i, waits in zip(points[:2], points.waits, strict=True)
        if waits and i == k
    ]
    return np.mean(waiting, axis=0) if waiting else np.zeros(2)
