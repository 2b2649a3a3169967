"""Distributed contact: every surface sample of one body presses on the solid of the other.

With H (3×4) the transform from the sampled frame into the queried one and V (3×4) the relative velocity
there, sample x̃ = (x, y, z, 1) sits at y = H x̃, moves with v = V x̃, and carries its area times the traction
t(y, v). All that a step needs of it are the sums

    S = Σ A t(y, v) x̃ᵀ   (3×4: force, and torque through the antisymmetric part),   ∂S/∂V, ∂S/∂H, ∂S/∂params,

which are taken in one pass over the samples near the other solid, so that the step's unknowns stay the six
velocities of a body and neither autodiff mode stores anything of the size of the sample set.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dano.contact._centroid import sticking
from dano.contact._colliders import BLOCK, SurfaceSet
from dano.contact._derivatives import by_autodiff, keep
from dano.contact._laws import HARD, Softening
from dano.contact._small import contract, matmul, matvec
from dano.fields import AbstractShape, HalfSpace
from dano.maths import column_norm

# Up to so many samples all are taken at once: finding the near ones would cost more, above all under `vmap`.
_FEW = 512
# Samples gathered and evaluated at once.
_CHUNK = 128
# Samples count as near within this share of the body's size, besides the way they go.
_MARGIN = 0.001


class Material(NamedTuple):
    """What the traction on a sample depends on besides geometry and velocity.

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
    """

    stiffness: Float[Array, ""]
    restitution: Float[Array, ""]
    restitution_velocity: Float[Array, ""]
    hysteresis: Float[Array, ""]
    friction: Float[Array, ""]
    friction_fading: Float[Array, ""]
    friction_pressure: Float[Array, ""]
    stiction: Float[Array, ""]
    ahead: Float[Array, ""]


class _Response(NamedTuple):
    """What samples feel, per area: scalars of shape (n,), and the slip.

    The traction is t = p n − g u and its derivative by the velocity −f (n − m u) nᵀ − g (1 − n nᵀ) − c u uᵀ.

    Attributes:
        pressure: p [Pa].
        fall: f, of the pressure with the separating speed [Pa s/m].
        grip: g [Pa s/m].
        marginal: m, friction that a pressure brings per slip [s/m].
        turn: c, by which the grip falls as the slip grows along itself [Pa s³/m³].
        slip: u [m/s], shape (3, n).
    """

    pressure: Float[Array, " n"]
    fall: Float[Array, " n"]
    grip: Float[Array, " n"]
    marginal: Float[Array, " n"]
    turn: Float[Array, " n"]
    slip: Float[Array, "3 n"]


def respond(
    material: Material,
    depth: Float[Array, " n"],
    normal: Float[Array, "3 n"],
    velocity: Float[Array, "3 n"],
    softening: Softening = HARD,
) -> _Response:
    """What samples feel at a depth [m] in a solid, moving at a velocity [m/s] relative to it.

    Pressure p = k max(0, d − D), friction −μ(p) p u / max(|u|, v_s) against the slip u with
    μ(p) = μ (1 − φ p/(p + p₀)). D is what the separating speed v_n takes off the depth d: the larger of

    - d ((ρ − σ) s(v_n / v_e) + σ c(v_n / v_s)) with s(x) = x / √(1 + x²), c(x) = x / max(|x|, 1) and
      ρ = (1 − e²)/(1 + e²): the force going in exceeds that going out by 1/e² whatever the path, so an impact
      returns e² of its energy. Slower than v_e all but the share σ ≤ ρ becomes a damper; σ is lost however
      slow the motion, which stops rolling and rocking;
    - θ h v_n: the depth at the end of the step, or in its middle, instead of its start, which makes the
      spring implicit.
    """
    rate = jnp.sum(normal * velocity, axis=0)
    slip = velocity - normal * rate[None]
    speed = column_norm(slip)
    scaled = rate / material.restitution_velocity
    inverse = jax.lax.rsqrt(1 + scaled * scaled)
    loss = (1 - material.restitution**2) / (1 + material.restitution**2)
    kept = jnp.minimum(material.hysteresis, loss)
    seized = jnp.abs(rate)
    grip, grip_slope = sticking(seized, material.stiction, softening)
    sunk = jnp.maximum(depth, 0)
    by_loss = sunk * ((loss - kept) * scaled * inverse + kept * rate * grip)
    by_time = material.ahead * rate
    lossy = jnp.abs(by_loss) > jnp.abs(by_time)
    left = depth - jnp.where(lossy, by_loss, by_time)
    slower = (loss - kept) / material.restitution_velocity * inverse**3 + kept * (grip + grip_slope * seized)
    delay = jnp.where(lossy, sunk * slower, material.ahead)
    pressure = material.stiffness * jnp.maximum(left, 0)
    fall = jnp.where(left > 0, material.stiffness * delay, 0)

    gain, gain_slope = sticking(speed, material.stiction, softening)
    lightness = material.friction_pressure / (material.friction_pressure + pressure)
    friction = material.friction * (1 - material.friction_fading * (1 - lightness))
    # d(μ p)/dp
    marginal = material.friction * (1 - material.friction_fading * (1 - lightness * lightness))
    force = friction * pressure
    # The turn multiplies u uᵀ, which vanishes with the slip, so any divisor will do there.
    turn = force * gain_slope / jnp.where(speed > 0, speed, 1)
    return _Response(pressure, fall, force * gain, marginal * gain, turn, slip)


def traction(response: _Response, normal: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
    """Force per area [Pa]."""
    return response.pressure[None] * normal - response.grip[None] * response.slip


class Near(eqx.Module):
    """The samples that may touch, with what does not change within a step.

    Attributes:
        rows: Arms, areas, depths, normals and vector areas, as the properties below have them, shape (12, m).
            One array: its parts would be copied in every step.
        count: How many columns are filled; the areas of others are zero.
    """

    rows: Float[Array, "12 m"]
    count: Int[Array, ""]

    @classmethod
    def of(cls, arms, vectors, solid: AbstractShape, offset, count) -> "Near":
        """Ask the solid about samples, given by arms and vector areas in its axes."""
        distance, gradient = solid.sdf_jet(arms + offset, 1)
        normal = _unit(gradient)
        scalars = jnp.stack([jnp.ones_like(distance), _facing(vectors, normal), -distance])
        return cls(jnp.concatenate([arms, scalars, normal, vectors]), jnp.asarray(count))

    @property
    def arms(self) -> Float[Array, "4 m"]:
        """From the origin of the sampled frame, in axes of the queried one [m], and a row of ones."""
        return self.rows[:4]

    @property
    def areas(self) -> Float[Array, " m"]:
        """Area of each that faces the solid [m²]."""
        return self.rows[4]

    @property
    def depth(self) -> Float[Array, " m"]:
        """Below the surface of the queried solid [m]."""
        return self.rows[5]

    @property
    def normal(self) -> Float[Array, "3 m"]:
        """Unit normal of that surface."""
        return self.rows[6:9]

    @property
    def vectors(self) -> Float[Array, "3 m"]:
        """Vector area of each [m²]."""
        return self.rows[9:]


def find_near(
    to_field: Float[Array, "3 4"],
    motion: Float[Array, "3 4"],
    solid: AbstractShape,
    samples: SurfaceSet,
    timestep: Float[Array, ""],
) -> Near:
    """Samples that may reach the solid within a step, judged block by block.

    Args:
        to_field: H.
        motion: V at the start of the step.
        solid: The queried shape.
        samples: Those of the other body.
        timestep: h [s].
    """
    n = samples.points.shape[1]
    if n <= _FEW:
        arms, vectors = (matmul(to_field[:, :3], x) for x in (samples.points[:3], samples.vectors))
        return Near.of(arms, vectors, solid, to_field[:, 3:], n)
    centers = jnp.concatenate([samples.centers.T, jnp.ones_like(samples.centers.T[:1])])
    # The spin of a block's points about its centre is at most |V₁₂₃| times their distance.
    speed = column_norm(matmul(motion, centers)) + jnp.sqrt(jnp.sum(motion[:, :3] ** 2)) * samples.radii
    size = jnp.max(jnp.max(samples.centers, axis=0) - jnp.min(samples.centers, axis=0))
    # Twice the way of a step, for what the step itself adds to the speed.
    reach = 2 * timestep * speed + _MARGIN * size
    if isinstance(solid, HalfSpace):
        # So cheap that every sample can be asked, which is sharper.
        normal = solid.normal_direction
        plane = jnp.append(matvec(to_field[:, :3].T, normal), jnp.sum(normal * to_field[:, 3]) - solid.offset)
        near = jnp.min((plane @ samples.points).reshape(-1, BLOCK), axis=1) <= reach
    else:
        near = solid.sdf_jet(matmul(to_field, centers), 0) <= reach + samples.radii
    together = _CHUNK // BLOCK
    (blocks,) = jnp.nonzero(near, size=near.shape[0] + -near.shape[0] % together, fill_value=0)
    count = BLOCK * jnp.sum(near)

    def gather(i, buffer):
        starts = [blocks[together * i + k] * BLOCK for k in range(together)]

        def rows(x):
            parts = [jax.lax.dynamic_slice_in_dim(x, start, BLOCK, axis=-1) for start in starts]
            return jnp.concatenate(parts, axis=-1)

        # What fills up the last pass has no area.
        areas = jnp.where(_CHUNK * i + np.arange(_CHUNK) < count, rows(samples.vectors), 0)
        arms, vectors = (matmul(to_field[:, :3], x) for x in (rows(samples.points)[:3], areas))
        found = Near.of(arms, vectors, solid, to_field[:, 3:], count).rows
        return jax.lax.dynamic_update_slice_in_dim(buffer, found, _CHUNK * i, axis=1)

    empty = jnp.zeros((12, n + -n % _CHUNK), to_field.dtype)
    return Near(jax.lax.fori_loop(0, -(-count // _CHUNK), gather, empty), count)


def _facing(vectors: Float[Array, "3 n"], normal: Float[Array, "3 n"]) -> Float[Array, " n"]:
    """Area that faces a solid: only the part of a sample's surface across the normal carries pressure."""
    return jnp.maximum(-jnp.sum(vectors * normal, axis=0), 0)


def _unit(gradient: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
    # Far below the surface of a sampled distance the gradient may vanish.
    return gradient / jnp.sqrt(jnp.maximum(jnp.sum(gradient * gradient, axis=0), 1e-12))[None]


def _chunks(near: Near, function, zero):
    """Sum of a function over chunks of the near samples."""
    if near.rows.shape[1] <= _FEW:
        return function(near)

    def add(i, total):
        part = jax.lax.dynamic_slice_in_dim(near.rows, _CHUNK * i, _CHUNK, axis=1)
        return total + function(Near(part, near.count))

    return jax.lax.fori_loop(0, -(-near.count // _CHUNK), add, zero)


def _products(full: Float[Array, "4 n"]) -> Float[Array, "16 n"]:
    return (full[:, None] * full[None]).reshape(16, -1)


# Velocities of samples from the twist (u, w) of their frame: u + w × r = Σ_a LEVER[:, :, a] r̃_a (u, w).
_LEVER = np.zeros((3, 6, 4))
_LEVER[np.arange(3), np.arange(3), 3] = 1
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _LEVER[_i, 3 + _j, _k] = 1
    _LEVER[_i, 3 + _k, _j] = -1
_LEVERS = _LEVER.transpose(1, 0, 2).reshape(6, 12)


@eqx.filter_custom_jvp
def sums(to_field, motion, material, solid, samples, near, softening):
    """Sums over the samples of one body in the solid of the other.

    Args:
        to_field: H.
        motion: V.
        material: The material.
        solid: The queried shape.
        samples: Surface samples of the other body.
        near: Those to sum over, from `find_near`; held constant by derivatives.
        softening: Of the friction.

    Returns:
        S = Σ A t x̃ᵀ, shape (3, 4), and the derivative (6, 6) of the wrench about the origin of the sampled
        frame by the twist there, both in queried axes. Only S can be differentiated further.
    """

    def moments(part: Near, found: _Response):
        slip, normal = found.slip, part.normal
        across = found.grip[None] * normal - found.fall[None] * (normal - found.marginal[None] * slip)
        slope = across[:, None] * normal[None] - (found.turn[None] * slip)[:, None] * slip[None]
        slope = slope - found.grip[None, None] * jnp.eye(3, dtype=slip.dtype)[:, :, None]
        of_traction = contract(part.areas[None] * traction(found, normal), part.arms)
        of_slope = contract(part.areas[None] * slope.reshape(9, -1), _products(part.arms))
        return jnp.concatenate([of_traction.ravel(), of_slope.ravel()])

    def add(part: Near):
        found = respond(material, part.depth, part.normal, matmul(motion_of_arms, part.arms), softening)
        # Skips what does not press. It also makes XLA write the response down, which it would else compute
        # again for each of the nine components of the slope.
        return jax.lax.cond(jnp.any(found.pressure > 0), moments, lambda *_: zero, part, found)

    zero = jnp.zeros(12 + 144, to_field.dtype)
    motion_of_arms = _turned(motion, to_field)
    total = _chunks(near, add, zero)
    # Σ A Jᵀ K J from Σ A K_cd r̃_a r̃_b, with J = Σ_a LEVER_a r̃_a.
    levers = jnp.asarray(_LEVERS, total.dtype)
    slope = levers @ total[12:].reshape(3, 3, 4, 4).transpose(0, 2, 1, 3).reshape(12, 12) @ levers.T
    return _turned_back(total[:12].reshape(3, 4), to_field), slope


def _turned(rows: Float[Array, "3 4"], to_field: Float[Array, "3 4"]) -> Float[Array, "3 4"]:
    """A map of sampled coordinates x̃ as a map of arms r̃ = (R x, 1)."""
    return jnp.concatenate([matmul(rows[:, :3], to_field[:, :3].T), rows[:, 3:]], axis=1)


def _turned_back(rows: Float[Array, "3 4"], to_field: Float[Array, "3 4"]) -> Float[Array, "3 4"]:
    """Moments over arms r̃ as moments over sampled coordinates x̃."""
    return jnp.concatenate([matmul(rows[:, :3], to_field[:, :3]), rows[:, 3:]], axis=1)


@sums.def_jvp
def _sums_jvp(primals, tangents):
    to_field, motion, material, solid, samples, near, _ = primals
    d_to_field, d_motion, d_material, d_solid, d_samples = tangents[:5]
    value = sums(*primals)
    if jax.tree.leaves((d_solid, d_samples)):
        _, tangent = by_autodiff(_all_sums, primals[:5], tangents[:5])
        return value, (tangent, None)
    offset = to_field[:, 3:]
    motion_of_arms = _turned(motion, to_field)
    n_material = len(material)

    def add(part: Near):
        distance, gradient, hessian = solid.sdf_jet(part.arms[:3] + offset, 2)
        velocity = matmul(motion_of_arms, part.arms)

        def of(distance, gradient, velocity, material):
            normal = _unit(gradient)
            areas = _facing(part.vectors, normal)
            return areas[None] * traction(respond(material, -distance, normal, velocity), normal)

        def along(tangent):
            return jax.jvp(of, (distance, gradient, velocity, material), tangent)[1]

        n, dtype = distance.shape[0], distance.dtype
        still = Material(*(jnp.zeros(3, dtype) for _ in material))
        zero, flat = jnp.zeros((3, 3, n), dtype), jnp.zeros((3, n), dtype)
        basis = jnp.broadcast_to(jnp.eye(3, dtype=dtype)[:, :, None], (3, 3, n))
        by_place = jax.vmap(along)((gradient, hessian, zero, still))
        by_velocity = jax.vmap(along)((flat, zero, basis, still))
        units = Material(*jnp.eye(n_material, dtype=dtype))
        none = jnp.zeros((n_material, 3, n), dtype)
        by_material = jax.vmap(along)((none[:, 0], none, none, units))
        of_motion = contract(jnp.concatenate([by_place, by_velocity]).reshape(18, n), _products(part.arms))
        of_material = contract(by_material.reshape(-1, n), part.arms)
        # Turning the sampled body turns its vector areas: dA = −n·(dR Rᵀ a).
        force = jnp.where(part.areas > 0, 1, 0)[None] * traction(
            respond(material, -distance, part.normal, velocity), part.normal
        )
        moment = (force[:, None] * part.arms[None]).reshape(12, n)
        of_turning = -contract(moment, (part.normal[:, None] * part.vectors[None]).reshape(9, n))
        return jnp.concatenate([of_motion.ravel(), of_turning.ravel(), of_material.ravel()])

    total = _chunks(near, add, jnp.zeros(288 + 108 + 12 * n_material, to_field.dtype))
    moments, slope, total = keep(*value, total)
    change = jnp.zeros((3, 4), to_field.dtype)
    # dS_ca = Σ D_dcab (dH T)_db, T the turn from x̃ to arms.
    by_motion, by_turning = total[:288].reshape(2, 3, 3, 4, 4), total[288:396].reshape(3, 4, 3, 3)
    by_material = total[396:].reshape(n_material, 3, 4)
    for derivative, tangent in zip(by_motion, (d_to_field, d_motion), strict=True):
        if tangent is not None:
            change = change + jnp.einsum("dcab,db->ca", derivative, _turned(tangent, to_field))
    if d_to_field is not None:
        turn = matmul(d_to_field[:, :3], to_field[:, :3].T)
        change = change + jnp.einsum("cade,de->ca", by_turning, turn)
    for rows, tangent in zip(by_material, d_material, strict=True):
        if tangent is not None:
            change = change + rows * tangent
    return (moments, slope), (_turned_back(change, to_field), None)


def _all_sums(to_field, motion, material, solid, samples: SurfaceSet):
    """S over all samples, as plain code that can be differentiated by everything."""
    distance, gradient = solid.sdf_jet(to_field @ samples.points, 1)
    normal = _unit(gradient)
    areas = _facing(to_field[:, :3] @ samples.vectors, normal)
    found = respond(material, -distance, normal, motion @ samples.points)
    return contract(areas[None] * traction(found, normal), samples.points)
