# pyright: reportInvalidTypeForm=false, reportCallIssue=false, reportArgumentType=false
"""Formulas of `dano.physics`, each as a function of NumPy arrays."""

from typing import Any

import numpy as np
import warp as wp

from dano.native import Features, instance

_BUILD = Features(LANES=1)
momentum: Any = instance(_BUILD, "dano.physics.momentum")
point_law: Any = instance(_BUILD, "dano.physics.point_law")
rotations: Any = instance(_BUILD, "dano.physics.rotations")
friction: Any = instance(_BUILD, "dano.physics.friction")
vec3, vec4, mat33 = momentum.vec3, rotations.vec4, momentum.mat33


@wp.kernel(enable_backward=False, module="unique")
def press(
    materials: wp.array(dtype=point_law.Material),
    points: wp.array(dtype=point_law.Point),
    impacts: wp.array(dtype=point_law.Impact),
    damper: wp.float64,
    rates: wp.array(dtype=wp.float64),
    slips: wp.array(dtype=vec3),
    pressures: wp.array(dtype=wp.float64),
    frictions: wp.array(dtype=vec3),
):
    """Pressure and friction at points that separate and slip."""
    i = wp.tid()
    law = point_law.point_law(materials[i], points[i], impacts[i], damper)
    found = point_law.traction(law, rates[i], slips[i])
    pressures[i] = found.pressure
    frictions[i] = found.friction


@wp.kernel(enable_backward=False, module="unique")
def spin(
    omega: vec3,
    inertia: mat33,
    orientation: vec4,
    h: wp.float64,
    sign: wp.float64,
    momenta: wp.array(dtype=vec3),
    turned: wp.array(dtype=vec4),
    slopes: wp.array(dtype=mat33),
):
    """Angular momentum of a step, and the orientation at its end; derivatives of both: see below."""
    momenta[0] = momentum.angular_momentum(omega, inertia, h, sign)
    turned[0] = rotations.to_wxyz(rotations.turned(rotations.from_wxyz(orientation), omega, h))
    slopes[0] = momentum.angular_momentum_jacobian(omega, inertia, h, sign)
    slopes[1] = rotations.spin_by_end(omega, h)


def traction(material: dict[str, float], points, rate, slip):
    """Pressure [Pa] and friction [Pa] of points, see `reference_step.collision.Points`."""
    n = len(rate)
    rows = np.zeros(n, point_law.Point.numpy_dtype())
    for name in ("arm", "normal", "moment", "depth", "rate", "area"):
        rows[name] = getattr(points, name)
    rows["sunk"] = points.sunk
    of_impact = np.zeros(n, point_law.Impact.numpy_dtype())
    of_impact["share"], of_impact["stiffness"], of_impact["depth"] = points.beta, points.kappa, points.delta
    of_impact["factor"] = points.law.F
    of_impact["deepest"], of_impact["part"], of_impact["way"] = points.deepest, 1.0, points.way
    of_impact["delays"], of_impact["rest"] = points.delays, material["timestep"]
    of_impact["rest"] *= 1 - points.delays * points.share
    of_impact["after"], of_impact["rests"] = points.after, points.left_out
    of_impact["turns"]["by_arm"], of_impact["turns"]["offset"] = points.turns
    rows["approach"] = points.rate - np.sum(points.drift * points.normal, axis=1)
    rows["meets"], rows["gains_after"] = points.meets, points.gains
    of_material = np.zeros(n, point_law.Material.numpy_dtype())
    for name, value in material.items():
        of_material[name] = value
    pressures, frictions = wp.zeros(n, wp.float64, device="cpu"), wp.zeros(n, vec3, device="cpu")
    given = [
        wp.array(of_material, dtype=point_law.Material, device="cpu"),
        wp.array(rows, dtype=point_law.Point, device="cpu"),
        wp.array(of_impact, dtype=point_law.Impact, device="cpu"),
        points.law.damper,
        wp.array(rate, dtype=wp.float64, device="cpu"),
        wp.array(slip, dtype=vec3, device="cpu"),
    ]
    wp.launch(press, n, [*given, pressures, frictions], device="cpu")
    return pressures.numpy(), frictions.numpy()


def _spun(omega, inertia, orientation, h, sign):
    found = [wp.zeros(n, kind, device="cpu") for n, kind in ((1, vec3), (1, vec4), (2, mat33))]
    given = [vec3(*omega), mat33(*np.ravel(inertia)), vec4(*orientation), float(h), float(sign)]
    wp.launch(spin, 1, [*given, *found], device="cpu")
    return [x.numpy() for x in found]


def angular_momentum(omega, inertia, h, sign):
    """P(ω) or P⁻(ω), by the sign."""
    return _spun(omega, inertia, (1.0, 0.0, 0.0, 0.0), h, sign)[0][0]


def orientation_after(q, omega, h):
    """Orientation at the end of a step."""
    return _spun(omega, np.eye(3), q, h, 1.0)[1][0]


def spin_slopes(omega, inertia, h):
    """∂P/∂ω, and how the spin of a step changes where its end turns by a small angle, seen from the start."""
    return _spun(omega, inertia, (1.0, 0.0, 0.0, 0.0), h, 1.0)[2]
