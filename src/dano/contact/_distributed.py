"""The distributed law: pressure and friction at every surface sample."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from dano.contact._colliders import Collider, SurfaceSet
from dano.contact._laws import (
    AbstractContactLaw,
    ContactParams,
    HARD,
    non_negative,
    positive,
    Setting,
    Softening,
)
from dano.contact._overlap import Patch
from dano.contact._pressure import find_near, Material, Near, sums
from dano.contact._small import matmul, matvec
from dano.fields import AbstractShape, HalfSpace, Sphere
from dano.maths import is_traced, Numbers, safe_normalize, skew

# Share of its size by which a body sinks under its weight in a typical orientation, at default stiffness.
SINKING = 0.005


class _Side(eqx.Module):
    """Samples of one body in the solid of the other.

    Attributes:
        to_field: Sampled frame → queried frame, shape (3, 4).
        rotation: Queried frame → world, shape (3, 3).
        lever: From the patch's reference point to the origin of the sampled frame [m, W].
        solid: The queried shape.
        samples: Surface samples of the other body.
        near: Those that may touch.
        flipped: Whether the sampled body is the contact's second.
    """

    to_field: Float[Array, "3 4"]
    rotation: Float[Array, "3 3"]
    lever: Float[Array, "3"]
    solid: AbstractShape
    samples: SurfaceSet
    near: Near
    flipped: bool = eqx.field(static=True)


class SurfacePatch(eqx.Module):
    """Where two bodies may press on each other.

    Attributes:
        point: What twists and wrenches refer to [m, W]: the origin of a sampled body's frame.
        sides: Samples of the first body in the second, and the reverse; one or both.
    """

    point: Float[Array, "3"]
    sides: tuple[_Side, ...]

    @property
    def touching(self) -> Bool[Array, ""]:
        """True: the reference point always exists."""
        return jnp.asarray(True)


class DistributedLaw(AbstractContactLaw):
    """Every surface sample is a compliant contact with its own depth, velocity and friction.

    A sample of area A at depth d below the other body's surface, with outward normal n there, separating at
    v_n and slipping at u, feels

        F = A p (n − μ(p) c(u/v_s)),   p = k max(0, d − D),
        D = d ((ρ − σ) s(v_n/v_e) + σ c(v_n/v_s))  or  θ h v_n,  whichever is larger,

    with ρ = (1 − e²)/(1 + e²), s(x) = x/√(1 + x²), c(x) = x/max(|x|, 1) and μ(p) = μ (1 − φ p/(p + p₀)); A is
    the part of the sample's area that faces the other body (see `ContactParams` for the parameters).
    Velocities are those at the end of the step. Torsional and rolling resistance come out of the geometry.
    Where both bodies have samples, each set carries half.

    Default stiffness: set down on a rigid floor in a typical (the median) orientation, so on a corner, an
    edge or a bulge, a body sinks by 0.5 % of its size; on a flat side by much less. Default restitution
    velocity: √(g · 0.5 % size)/5, small against impacts, large against what is left of motion at rest.

    Attributes:
        stiction_velocity: v_s, slip up to which friction counts as sticking [m/s].
        implicitness: θ from 1/2 to 1: where in a step the depth is taken. 1, its end, is quietest, and
            perfectly plastic where a step is longer than an impact; with 1/2 such impacts still bounce.
    """

    stiction_velocity: Float[Array, ""]
    implicitness: Float[Array, ""]

    def __init__(self, *, stiction_velocity: Numbers = 1e-7, implicitness: Numbers = 1.0):
        """See the class.

        Raises:
            ValueError: If `stiction_velocity` is not a positive number or `implicitness` not in [1/2, 1].
        """
        self.stiction_velocity = positive("stiction_velocity", stiction_velocity)
        self.implicitness = non_negative("implicitness", implicitness)
        if not is_traced(self.implicitness) and not 0.5 <= float(self.implicitness) <= 1:
            raise ValueError(f"implicitness must lie in [1/2, 1], got {float(self.implicitness)}")

    @property
    def presses(self) -> bool:
        """See `AbstractContactLaw.presses`."""
        return True

    @property
    def stiction(self) -> bool:
        """See `AbstractContactLaw.stiction`."""
        return True

    def complete(self, params: ContactParams, setting: Setting) -> ContactParams:
        """See `AbstractContactLaw.complete`."""
        if params.stiffness is None:
            params = params.filled(stiffness=setting.stiffness(SINKING))
        return params.filled(restitution_velocity=0.2 * (setting.gravity * SINKING * setting.size) ** 0.5)

    def patch(self, a: Collider, b: Collider, timestep: Float[Array, ""]) -> SurfacePatch:
        """See `AbstractContactLaw.patch`.

        Raises:
            ValueError: If no side has surface samples to press on a solid of the other.
        """
        pairs = [
            (sampled, queried, flipped)
            for sampled, queried, flipped in ((a, b, False), (b, a, True))
            if sampled.surface is not None and queried.solid is not None
        ]
        if not pairs:
            raise ValueError(
                "a distributed contact needs surface samples on one side and a solid on the other, got "
                f"a: surface={a.surface is not None}, solid={a.solid is not None}; "
                f"b: surface={b.surface is not None}, solid={b.solid is not None}"
            )
        point = pairs[0][0].origin
        return SurfacePatch(point, tuple(_side(*pair, point, timestep) for pair in pairs))

    def wrench(
        self, patch: SurfacePatch, params: ContactParams, twist, timestep, softening: Softening = HARD
    ):
        """See `AbstractContactLaw.wrench`."""
        material = Material(
            params.stiffness / len(patch.sides),
            params.restitution,
            params.restitution_velocity,
            params.hysteresis,
            params.sliding_friction,
            params.friction_fading,
            params.friction_pressure,
            self.stiction_velocity,
            self.implicitness * timestep,
        )
        wrenches, slopes = zip(
            *(_wrench(side, material, twist, softening) for side in patch.sides), strict=True
        )
        return functools.reduce(jnp.add, wrenches), functools.reduce(jnp.add, slopes)

    def summary(self, patch: SurfacePatch) -> Patch:
        """Overlap here is the volume Σ A d [m³], averaged over the sides; centroid and normal are its means.

        A contact that is felt before bodies overlap, at the end of the step, has its centroid at the sample
        that is deepest.
        """
        total, normal = jnp.zeros(4, patch.point.dtype), jnp.zeros(3, patch.point.dtype)
        foremost, height = patch.point, -jnp.inf
        for side in patch.sides:
            near = side.near
            share = near.areas * jnp.maximum(near.depth, 0) / len(patch.sides)
            volume = jnp.sum(share)
            middle = patch.point + side.lever
            depth = jnp.where(near.areas > 0, near.depth, -jnp.inf)
            deepest = jnp.argmax(depth)
            place = middle + matvec(side.rotation, near.arms[:3, deepest])
            foremost = jnp.where(depth[deepest] > height, place, foremost)
            height = jnp.maximum(depth[deepest], height)
            moment = matvec(side.rotation, near.arms[:3] @ share) + middle * volume
            total = total + jnp.concatenate([moment, volume[None]])
            outward = matvec(side.rotation, near.normal @ share)
            normal = normal + (-outward if side.flipped else outward)
        touching = total[3] > 0
        centroid = jnp.where(touching, total[:3] / jnp.where(touching, total[3], 1), foremost)
        return Patch(total[3], centroid, safe_normalize(normal))


def _side(sampled: Collider, queried: Collider, flipped: bool, point, timestep) -> _Side:
    assert sampled.surface is not None and queried.solid is not None
    inverse = queried.rotation.T
    apart = sampled.origin - queried.origin
    samples, turned = sampled.surface, matmul(inverse, sampled.rotation)
    if isinstance(sampled.solid, Sphere) and isinstance(queried.solid, HalfSpace):
        # A ball looks the same from all sides: samples that stay below its middle instead of turning with it
        # let it roll smoothly.
        turned = _towards(queried.solid.normal_direction)
        samples = _cap(sampled.solid.radius)
    to_field = jnp.concatenate([turned, matvec(inverse, apart)[:, None]], axis=1)
    velocity = sampled.velocity - queried.velocity - jnp.cross(queried.omega, apart)
    motion = _motion(to_field, matvec(inverse, velocity), matvec(inverse, sampled.omega - queried.omega))
    near = find_near(*jax.lax.stop_gradient((to_field, motion, queried.solid, samples, timestep)))
    return _Side(to_field, queried.rotation, sampled.origin - point, queried.solid, samples, near, flipped)


# Rings of the samples of a ball on a plane, samples a ring, and how far up they reach: to a depth of half the
# radius.
_RINGS, _SPOKES, _REACH = 16, 12, np.pi / 3


def _cap(radius: Float[Array, ""]) -> SurfaceSet:
    """Samples on the lower side of a ball, denser towards its lowest point."""
    edges = _REACH * np.linspace(0, 1, _RINGS + 1) ** 2
    angle = np.repeat(0.5 * (edges[1:] + edges[:-1]), _SPOKES)
    turn = np.tile(np.arange(_SPOKES) * 2 * np.pi / _SPOKES, _RINGS)
    direction = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), -np.cos(angle)])
    share = np.repeat(2 * np.pi * (np.cos(edges[:-1]) - np.cos(edges[1:])) / _SPOKES, _SPOKES)
    points = radius * jnp.asarray(direction, radius.dtype)
    vectors = radius**2 * jnp.asarray(share * direction, radius.dtype)
    # Few enough never to be sorted out by blocks.
    none = jnp.zeros((0, 3), radius.dtype), jnp.zeros((0,), radius.dtype)
    return SurfaceSet(jnp.concatenate([points, jnp.ones_like(points[:1])]), vectors, *none)


def _towards(normal: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """A rotation that takes z to a unit vector (Duff et al., Building an orthonormal basis, revisited)."""
    x, y, z = normal
    sign = jnp.where(z < 0, -1, 1).astype(normal.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first = jnp.stack([1 + sign * x * x * a, sign * b, -sign * x])
    second = jnp.stack([b, sign + y * y * a, -y])
    return jnp.stack([first, second, normal], axis=1)


def _motion(to_field, velocity, spin) -> Float[Array, "3 4"]:
    """V of a sampled body whose origin moves at a velocity and that spins, both in queried axes."""
    return jnp.concatenate([matmul(skew(spin), to_field[:, :3]), velocity[:, None]], axis=1)


def _wrench(side: _Side, material: Material, twist: Float[Array, "6"], softening: Softening):
    sign = -1 if side.flipped else 1
    inverse = side.rotation.T
    upper = jnp.concatenate([inverse, -matmul(inverse, skew(side.lever))], axis=1)
    lower = jnp.concatenate([jnp.zeros_like(inverse), inverse], axis=1)
    # From the twist at the patch's point to that at the sampled origin; its transpose takes wrenches back.
    to_side = jnp.concatenate([upper, lower])
    local = sign * matvec(to_side, twist)
    motion = _motion(side.to_field, local[:3], local[3:])
    moments, slope = sums(side.to_field, motion, material, side.solid, side.samples, side.near, softening)
    torque = sum(jnp.cross(side.to_field[:, j], moments[:, j]) for j in range(3))
    wrench = sign * matvec(to_side.T, jnp.concatenate([moments[:, 3], torque]))
    return wrench, matmul(matmul(to_side.T, slope), to_side)
