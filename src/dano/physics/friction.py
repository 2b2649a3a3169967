"""Friction as a set-valued map with a dual (docs/theory/integrator.md, "Contacts of the distributed law").

    max(|u|, v_s) λ + b u = 0,   |λ| ≤ b

u is a slip [m/s] or a relative spin [rad/s], λ the friction, b the largest there is and v_s a tiny stiction
velocity. Both contact laws use it, at a point and at a patch. The dual λ is an unknown of its own.
"""

import warp as wp

from dano.physics.real import ONE, real, vec3


@wp.struct
class Friction:
    """Friction at a velocity u, and its derivative at a given dual, the dual eliminated.

    The friction is value + change, whatever the dual, and its derivative

        by_rate dv_n − grip du − turning (direction · du),

    with v_n the separating speed, on which b depends. Units are those of λ: [Pa], [N] or [N m].
    """

    value: vec3  # λ, projected onto |λ| ≤ b
    change: vec3  # Change of λ that makes it fit the velocity
    by_rate: vec3  # Over [m/s]
    grip: real  # Over a unit of u
    turning: vec3  # Over a unit of u; zero where it sticks
    direction: vec3  # û, zero where it sticks


@wp.func
def friction_with_dual(
    u: vec3, dual: vec3, bound: real, bound_damping: real, stiction: real, gradual: real
) -> Friction:
    """Friction at a velocity, from its dual.

    Args:
        u: Slip or relative spin.
        dual: λ.
        bound: b.
        bound_damping: −∂b/∂v_n.
        stiction: v_s, softened or not.
        gradual: v_g: below it the derivative by the velocity is that of a damper −b/v_g.
    """
    found = Friction()
    speed = wp.length(u)
    inverse_slow = ONE / wp.max(speed, stiction)
    size = wp.length(dual)
    found.value = dual
    if size > bound:
        found.value = (bound / size) * dual
    gain = inverse_slow * u
    found.change = -found.value - bound * gain
    found.grip = bound / wp.max(wp.max(speed, stiction), gradual)
    if speed > wp.max(stiction, gradual):
        found.turning = inverse_slow * found.value
        found.direction = gain
    found.by_rate = bound_damping * gain
    return found


@wp.struct
class Slip:
    """A slip, and friction there as a derivative takes it."""

    slip: vec3  # u₀ [m/s]
    direction: vec3  # Of the friction, −u₀/max(|u₀|, v_s)
    grip: real  # b/v_g [Pa s/m]
    is_gradual: bool  # Whether friction is −b/v_g (u − u₀) more for other slips


@wp.func
def friction_near(u: vec3, bound: real, at: Slip) -> vec3:
    """Friction near a slip, whose derivative is that of `friction_with_dual` with v_g."""
    return bound * at.direction - at.grip * (u - at.slip)


@wp.func
def following_friction(found: Friction, rate: real, u: vec3) -> vec3:
    """The dual after v_n and u changed by so much."""
    return (
        found.value
        + found.change
        + rate * found.by_rate
        - found.grip * u
        - wp.dot(found.direction, u) * found.turning
    )


@wp.func
def friction(u: vec3, bound: real, stiction: real) -> vec3:
    """−b u / max(|u|, v_s): the friction, which a dual that fits is equal to."""
    return (-bound / wp.max(wp.length(u), stiction)) * u
