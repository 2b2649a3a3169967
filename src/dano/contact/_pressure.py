"""The distributed law at a point: pressure and friction, as a law and as a solver sees it.

Friction and hysteresis are set-valued maps u/max(|u|, v_s) of a tiny v_s. A solver that knows them by their
values only has to search for where bodies stick. So the law is also written without a quotient, with the
friction λ and the direction s of the hysteresis as unknowns of their own,

    max(|u|, v_s) λ + b(p) u = 0,  |λ| ≤ b(p)        max(|v_n|, v_s) s − v_n = 0,  |s| ≤ 1,

which is what `linearized` linearises (Chan, Golub, Mulet 1999; Andersen et al. 2000, for sums of norms).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dano.contact._points import dot, Motion, Points
from dano.maths import column_norm


class Material(NamedTuple):
    """What the traction at a point depends on besides geometry and velocity; arrays over contacts or chunks.

    Attributes:
        stiffness: k [Pa/m].
        restitution: e [1].
        restitution_velocity: v_e [m/s].
        hysteresis: σ [1].
        friction: μ [1].
        friction_fading: φ [1].
        friction_pressure: p₀ [Pa].
        stiction: v_s [m/s].
        ahead: θ h, how far ahead the depth is taken [s].
        timestep: h [s].
        instant: 1 where impacts end within the step, 0 where they are left to the spring.
        bounce: Slowest rebound of an impact [m/s].
        uplift: An overlap of depth d separates at most at √(uplift · d), if that exceeds v_e [m/s²].
    """

    stiffness: Float[Array, " *n"]
    restitution: Float[Array, " *n"]
    restitution_velocity: Float[Array, " *n"]
    hysteresis: Float[Array, " *n"]
    friction: Float[Array, " *n"]
    friction_fading: Float[Array, " *n"]
    friction_pressure: Float[Array, " *n"]
    stiction: Float[Array, " *n"]
    ahead: Float[Array, " *n"]
    timestep: Float[Array, " *n"]
    instant: Float[Array, " *n"]
    bounce: Float[Array, " *n"]
    uplift: Float[Array, " *n"]


class Constants(NamedTuple):
    """What of the law does not change within a step; arrays over points, shape (c, p) or (c, 1).

    Attributes:
        stiffness: k [Pa/m].
        depth: d [m].
        damped: (ρ − σ) d⁺ [m].
        lost: σ d⁺ [m].
        ahead: θ h [s].
        sharp: 1 where the damping has its full size from v_e on, so that bodies are pushed apart no faster.
        restitution_velocity: v_e, or the speed at which a deep overlap may separate, if larger [m/s].
        friction: μ [1].
        fading: φ [1].
        friction_pressure: p₀ [Pa].
        stiction: v_s [m/s].
    """

    stiffness: Float[Array, "c #p"]
    depth: Float[Array, "c p"]
    damped: Float[Array, "c p"]
    lost: Float[Array, "c p"]
    ahead: Float[Array, "c #p"]
    sharp: Float[Array, "c #p"]
    restitution_velocity: Float[Array, "c p"]
    friction: Float[Array, "c #p"]
    fading: Float[Array, "c #p"]
    friction_pressure: Float[Array, "c #p"]
    stiction: Float[Array, "c #p"]


def constants(material: Material, points: Points) -> Constants:
    """The constants of every point; `material` is one of chunks.

    In an impact that ends within the step, points are to rebound with e times their approaching speed; if
    that is too slow to matter, to touch the surface without going deeper, whatever is left of their way.
    """
    material = Material(*(x[:, None] for x in material))
    hit = points.stiffness[:, None] > 0
    rebound = -material.restitution * points.approach
    goal = jnp.where(rebound > material.bounce, material.timestep * rebound, jnp.minimum(points.depth, 0))
    # Impacts that end within the step have had their restitution: what presses on gives nothing back.
    loss = jnp.where(material.instant > 0, 1, (1 - material.restitution**2) / (1 + material.restitution**2))
    kept = jnp.minimum(material.hysteresis, loss)
    sunk = jnp.where(hit, 0, jnp.maximum(points.depth, 0))
    apart = jnp.sqrt(jnp.maximum(material.restitution_velocity**2, material.uplift * sunk))
    return Constants(
        stiffness=jnp.where(hit, points.stiffness[:, None], material.stiffness),
        depth=jnp.where(hit, goal, points.depth),
        damped=(loss - kept) * sunk,
        lost=kept * sunk,
        ahead=jnp.where(hit, material.timestep, material.ahead),
        sharp=material.instant,
        restitution_velocity=apart,
        friction=material.friction,
        fading=material.friction_fading,
        friction_pressure=material.friction_pressure,
        stiction=material.stiction,
    )


class Duals(NamedTuple):
    """Unknowns of the law besides the velocities.

    Attributes:
        friction: λ [Pa], shape (3, c, p).
        going: s, 1 where the surface comes out, −1 where it goes in, shape (c, p).
    """

    friction: Float[Array, "3 c p"]
    going: Float[Array, "c p"]


class Pressure(NamedTuple):
    """Pressure and its derivatives.

    Attributes:
        value: p [Pa].
        fall: −∂p/∂v_n, s eliminated [Pa s/m].
        slope: ∂s/∂v_n [s/m].
        miss: Change of s that makes it fit the velocity.
        shift: Change of the pressure that comes with it [Pa].
    """

    value: Float[Array, "c p"]
    fall: Float[Array, "c p"]
    slope: Float[Array, "c p"]
    miss: Float[Array, "c p"]
    shift: Float[Array, "c p"]


def pressure(
    fixed: Constants, rate: Float[Array, "c p"], going: Float[Array, "c p"] | None, softness
) -> Pressure:
    """Pressure p = k max(0, d − D) at a separating speed v_n.

    D is what the separating speed takes off the depth d, the larger of

    - d⁺ ((ρ − σ) s(v_n / v_e) + σ c(v_n / v_s)) with s(x) = x / √(1 + x²), c(x) = x / max(|x|, 1) and
      ρ = (1 − e²)/(1 + e²): the force going in exceeds that going out by 1/e² whatever the path, so an impact
      returns e² of its energy. Slower than v_e all but the share σ ≤ ρ becomes a damper; σ is lost however
      slow the motion, which stops rolling and rocking. Where impacts end within the step, ρ = 1 and s(x) is
      x up to its limits ±1, and v_e grows with the depth: nothing is pushed out faster;
    - θ h v_n: the depth at the end of the step, or in its middle, instead of its start, which makes the
      spring implicit.

    Args:
        fixed: From `constants`.
        rate: v_n [m/s].
        going: The dual s of c(v_n / v_s), which only the derivatives depend on; None takes c itself.
        softness: Multiplies the stiction velocity.
    """
    stiction = fixed.stiction * softness
    scaled = rate / fixed.restitution_velocity
    inverse = jax.lax.rsqrt(1 + scaled * scaled)
    sharp = fixed.sharp > 0
    saturation = jnp.where(sharp, jnp.clip(scaled, -1, 1), scaled * inverse)
    saturation_slope = jnp.where(sharp, jnp.where(jnp.abs(scaled) < 1, 1, 0), inverse**3)
    slow = jnp.maximum(jnp.abs(rate), stiction)
    direct = rate / slow
    moves = jnp.abs(rate) > stiction
    s = direct if going is None else going
    slope = (1 - jnp.where(moves, s * jnp.sign(rate), 0)) / slow
    by_loss = fixed.damped * saturation + fixed.lost * direct
    by_time = fixed.ahead * rate
    lossy = jnp.abs(by_loss) > jnp.abs(by_time)
    left = fixed.depth - jnp.where(lossy, by_loss, by_time)
    slower = fixed.damped / fixed.restitution_velocity * saturation_slope + fixed.lost * slope
    delay = jnp.where(lossy, slower, fixed.ahead)
    on = left > 0
    k = fixed.stiffness
    miss = direct - s
    shift = jnp.where(on & lossy, -k * fixed.lost * miss, 0)
    return Pressure(k * jnp.maximum(left, 0), jnp.where(on, k * delay, 0), slope, miss, shift)


def bound(fixed: Constants, p: Float[Array, "c p"]) -> tuple[Float[Array, "c p"], Float[Array, "c p"]]:
    """Largest friction b(p) = μ (1 − φ p/(p + p₀)) p [Pa], and its derivative."""
    lightness = fixed.friction_pressure / (fixed.friction_pressure + p)
    value = fixed.friction * (1 - fixed.fading * (1 - lightness)) * p
    return value, fixed.friction * (1 - fixed.fading * (1 - lightness * lightness))


def traction(
    material: Material, points: Points, motion: Motion
) -> tuple[Float[Array, "c p"], Float[Array, "3 c p"]]:
    """Pressure and friction [Pa] at points that move relative to the second body: the law."""
    rate, slip = motion
    fixed = constants(material, points)
    p = pressure(fixed, rate, None, jnp.ones((), rate.dtype)).value
    speed = column_norm(slip)
    friction, _ = bound(fixed, p)
    # The untaken branch must be safe too.
    slow = jnp.where(speed > fixed.stiction, speed, jnp.broadcast_to(fixed.stiction, speed.shape))
    return p, -(friction / slow)[None] * slip


class Linear(NamedTuple):
    """The law at given velocities, and its derivatives at given duals, duals eliminated.

    The traction is p n + λ + slack, whatever the duals, and its change

        −f n dv_n + (b′ f dv_n) c − g du − l (û · du),    c = u / max(|u|, v_s).

    Attributes:
        pressure: See `Pressure`.
        friction: λ, projected [Pa].
        slack: Change of λ that makes it fit the velocities [Pa].
        grip: g [Pa s/m].
        turn: l [Pa s/m], zero where points stick.
        along: û, unit slip, zero where points stick.
        lean: b′ f c [Pa s/m].
        held: Largest friction that is held [Pa].
    """

    pressure: Pressure
    friction: Float[Array, "3 c p"]
    slack: Float[Array, "3 c p"]
    grip: Float[Array, "c p"]
    turn: Float[Array, "3 c p"]
    along: Float[Array, "3 c p"]
    lean: Float[Array, "3 c p"]
    held: Float[Array, "c p"]


def linearized(
    fixed: Constants,
    motion: Motion,
    duals: Duals,
    softness: Float[Array, ""],
    holds: Bool[Array, ""],
    mix: Float[Array, ""],
    held: Float[Array, "c p"],
) -> Linear:
    """One linearisation of the law with its duals.

    Args:
        fixed: From `constants`.
        motion: Of the points.
        duals: The duals.
        softness: Multiplies the stiction velocity.
        holds: Whether the largest friction is the one that is held, whatever the pressure.
        mix: Share of that one which is renewed first, from the pressure as it is.
        held: That one [Pa].
    """
    slip = motion.slip
    speed = column_norm(slip)
    p = pressure(fixed, motion.rate, duals.going, softness)
    limit, marginal = bound(fixed, p.value)
    held = held + jnp.where(holds, mix, 0) * (limit - held)
    limit, marginal = jnp.where(holds, held, limit), jnp.where(holds, 0, marginal)
    stiction = fixed.stiction * softness
    slow = jnp.maximum(speed, stiction)
    size = column_norm(duals.friction)
    friction = duals.friction * jnp.where(size > limit, limit / jnp.where(size > 0, size, 1), 1)[None]
    slides = speed > stiction
    gain = slip / slow[None]
    return Linear(
        pressure=p,
        friction=friction,
        slack=-friction - limit[None] * gain,
        grip=limit / slow,
        turn=jnp.where(slides[None], friction / slow[None], 0),
        along=jnp.where(slides[None], gain, 0),
        lean=(marginal * p.fall)[None] * gain,
        held=held,
    )


def updated(linear: Linear, duals: Duals, change: Motion) -> Duals:
    """The duals after the motion changed."""
    rate, slip = change
    friction = (
        linear.friction
        + linear.slack
        + linear.lean * rate[None]
        - linear.grip[None] * slip
        - linear.turn * dot(linear.along, slip)[None]
    )
    going = jnp.clip(duals.going + linear.pressure.miss + linear.pressure.slope * rate, -1, 1)
    return Duals(friction, going)


def first_duals(fixed: Constants, motion: Motion, softness) -> Duals:
    """Duals that fit given velocities."""
    rate, slip = motion
    p = pressure(fixed, rate, None, softness).value
    stiction = fixed.stiction * softness
    friction, _ = bound(fixed, p)
    slow = jnp.maximum(column_norm(slip), stiction)
    return Duals(-(friction / slow)[None] * slip, rate / jnp.maximum(jnp.abs(rate), stiction))
