"""The centroid law: docs/theory/contact.md, "Overlap" and "The law"."""

from typing import NamedTuple

import numpy as np
from reference_step.distances import signed_distance, spline
from reference_step.rotations import cross_matrix, matrix

import dano

PAPER = {"spring": 3e4, "damper": 3e5, "sliding_drag": 0.1, "torsional_friction": 0.01, "torsional_drag": 0.0}
PAPER |= {"rolling_friction": 0.01, "rolling_drag": 0.0}


class Patch(NamedTuple):
    """The overlap of two bodies at the start of a step, and the contact that it belongs to.

    Attributes:
        first: Index of the body that the force acts on.
        second: Index of the other body.
        contact: The `dano.Contact`.
        overlap: ψ [kg].
        centroid: χ [m, W].
        normal: n, from the second to the first [W].
        arms: From both centres of mass to χ [m, W].
    """

    first: int
    second: int
    contact: dano.Contact
    overlap: float
    centroid: np.ndarray
    normal: np.ndarray
    arms: tuple


def patches_of(scene, bodies):
    """The overlaps of all contacts with the centroid law."""
    found = []
    for contact in scene.contacts:
        if not contact.law.presses:
            i, j = scene.index(contact.a), scene.index(contact.b)
            psi, chi, n = overlap(scene, bodies, contact, i, j)
            if psi > 0:
                found.append(
                    Patch(i, j, contact, psi, chi, n, (chi - bodies.position[i], chi - bodies.position[j]))
                )
    return found


def overlap(scene, bodies, contact, i, j):
    """ψ, χ and n of two bodies."""
    kinds = [type(scene.bodies[k].shape) for k in (i, j)]
    if kinds == [dano.Sphere, dano.HalfSpace]:
        return cap(scene, bodies, i, j)
    if kinds == [dano.HalfSpace, dano.Sphere]:
        psi, chi, n = cap(scene, bodies, j, i)
        return psi, chi, -n
    psi, moment, normal, mass = 0.0, np.zeros(3), np.zeros(3), 0.0
    for a, b, sign in ((i, j, 1), (j, i, -1)):
        sampled, queried = scene.bodies[a], scene.bodies[b]
        if sampled.samples is None or queried.field is None:
            continue
        if sampled.object is None and queried.object is not None:
            continue  # of a shape that meets an object, the object's samples count
        points, weights = np.asarray(sampled.samples.points)[:3].T, np.asarray(sampled.samples.weights)
        R, R_b = matrix(bodies.orientation[a]), matrix(bodies.orientation[b])
        places = bodies.position[a] + (points - bodies.com[a]) @ R.T
        density, outward = density_of(queried, contact, (places - bodies.position[b]) @ R_b + bodies.com[b])
        shares = bodies.mass[a] * weights * density
        psi, moment, mass = psi + shares.sum(), moment + shares @ places, mass + bodies.mass[a]
        normal = normal + sign * shares @ (outward @ R_b.T)
    if psi <= 1e-12 * mass:
        return 0.0, np.zeros(3), np.zeros(3)
    return psi, moment / psi, normal / np.linalg.norm(normal)


def density_of(body, contact, x):
    """Dimensionless density and outward direction of a body at points of its field frame."""
    if body.object is None:
        edge = float(contact.edge)
        distance, normal = signed_distance(body.shape, x)
        if edge == 0:
            return (distance <= 0).astype(float), outward(body.shape, x, normal)
        t = np.clip(0.5 - distance / edge, 0, 1)
        return t * t * (3 - 2 * t), outward(body.shape, x, normal)
    grid = body.object.grid
    degree = {"linear": 1, "quadratic": 2, "cubic": 3}[grid.interpolation]
    border = degree + 1
    coefficients = np.asarray(grid.coefficients)
    u = (x - np.asarray(grid.origin)) / np.asarray(grid.spacing) + border
    inside = np.all((u > 0.5 * border) & (u < np.array(coefficients.shape) - 1 - 0.5 * border), axis=1)
    value, gradient = spline(coefficients, np.where(inside[:, None], u, border), degree)
    scale = float(body.density_scale) * inside
    return scale * value, -gradient / np.asarray(grid.spacing)


def outward(shape, x, normal):
    """The direction of a shape in the sum of normals; that of round ones grows away from the middle."""
    if isinstance(shape, dano.Sphere):
        return x
    if isinstance(shape, dano.Ellipsoid):
        return x / np.asarray(shape.semi_axes) ** 2
    if isinstance(shape, dano.Capsule):
        end = float(shape.half_length)
        return x - np.clip(x[:, 2:], -end, end) * np.array([0, 0, 1])
    return normal


def cap(scene, bodies, i, j):
    """A ball i on a half-space j: mass and centroid of the cap, by Simpson's rule over its discs."""
    ball, plane = scene.bodies[i].shape, scene.bodies[j].shape
    R = matrix(bodies.orientation[j])
    n = R @ np.asarray(plane.normal_direction)
    middle = bodies.position[i] - matrix(bodies.orientation[i]) @ bodies.com[i]
    origin = bodies.position[j] - R @ bodies.com[j]
    radius, height = float(ball.radius), n @ (middle - origin) - float(plane.offset)
    top = np.clip(-height, -radius, radius)  # of the cap, from the middle of the ball
    z = np.linspace(-radius, top, 3)
    disc = (radius**2 - z**2) / (4 / 3 * radius**3)
    # Simpson's rule is exact for the discs and for z times them, polynomials to third degree.
    weights = (top + radius) / 6 * np.array([1, 4, 1])
    share = weights @ disc
    if share <= 1e-12:
        return 0.0, np.zeros(3), np.zeros(3)
    return bodies.mass[i] * share, middle + (weights @ (disc * z)) / share * n, n


def patch_wrench(patch, velocities, softness=1.0):
    """Force [N] and moment about χ [N m, W] on the first body, its derivative by its relative twist there."""
    law, n = patch.contact.law, patch.normal
    given = {name: getattr(patch.contact.params, name) for name in ("sliding_friction", *PAPER)}
    params = {name: PAPER[name] if value is None else float(value) for name, value in given.items()}
    v, w = np.split(patch_map(patch) @ velocities[[patch.first, patch.second]].ravel(), 2)
    along, across = np.outer(n, n), np.eye(3) - np.outer(n, n)
    push = params["spring"] - params["damper"] * (n @ v)
    sign = np.sign(push) if law.adhesive else 1.0
    size, slope = (patch.overlap * abs(push), -patch.overlap * params["damper"] * sign)
    if push < 0 and not law.adhesive:
        size, slope = 0.0, 0.0
    slide, slide_slope = resistance(law, across, v, params, "sliding", softness)
    drill, drill_slope = resistance(law, along, w, params, "torsional", softness)
    roll, roll_slope = resistance(law, across, w, params, "rolling", softness)
    per_force = np.r_[sign * n + slide, drill + roll]
    matrix_of = np.block([[slide_slope, np.zeros((3, 3))], [np.zeros((3, 3)), drill_slope + roll_slope]])
    return size * per_force, np.outer(slope * per_force, np.r_[n, np.zeros(3)]) + size * matrix_of


def resistance(law, projection, velocity, params, kind, softness):
    """μ c(u) − δ u for u = projection · velocity, and its derivative by the velocity."""
    mu, drag = params[f"{kind}_friction"], params[f"{kind}_drag"]
    u = projection @ velocity
    speed = np.linalg.norm(u)
    if law.stiction_velocity is None:
        s, reach = float(law.smoothing), float(law.regularizer) + speed
        gain = 2 / np.pi * np.arctan(s * speed) / reach
        gain_slope = (2 / np.pi * s / (1 + (s * speed) ** 2) - gain) / reach
    else:
        v_s = float(law.stiction_velocity) * softness
        gain, gain_slope = 1 / max(speed, v_s), -1 / speed**2 if speed > v_s else 0.0
    direction = u / speed if speed > 0 else u
    return -(mu * gain + drag) * u, -(mu * gain + drag) * projection - mu * gain_slope * np.outer(
        u, direction
    )


def patch_map(patch):
    """From velocities and spins of both bodies, (12,), to those of the first relative to the second at χ."""
    eye, zero = np.eye(3), np.zeros((3, 3))
    first, second = (np.block([[eye, -cross_matrix(arm)], [zero, eye]]) for arm in patch.arms)
    return np.c_[first, -second]
