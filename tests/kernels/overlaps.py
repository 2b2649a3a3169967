"""Overlaps of pairs of solids: by kernels, and by sums over all samples."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from kernels.launching import Arguments, touch

import dano
from dano.contact import CentroidLaw, Collider, SampleSet, Support
from dano.engine.launching._patch_tables import PatchPair
from dano.fields import AbstractField


class Side(NamedTuple):
    """A body of a pair: a density, weighted samples, or both, at a pose."""

    field: AbstractField | None = None
    samples: tuple[np.ndarray, np.ndarray] | None = None  # Points [m, F] and their densities
    pose: dano.Pose | None = None
    mass: float = 1.0
    density_scale: float = 1.0

    @property
    def collider(self) -> Collider:
        """What kernels are told of it."""
        samples = None if self.samples is None else SampleSet.create(*self.samples)
        culling = Support.create(self.field) if isinstance(self.field, dano.GridField) else None
        return Collider(self.field, samples, culling, jnp.asarray(self.density_scale))

    @property
    def place(self) -> dano.Pose:
        """Where it is."""
        return self.pose or dano.Pose()


def pairs_of(pairs: Any) -> list[PatchPair]:
    """Pairs of sides as contacts of bodies 0 and 1, 2 and 3, …"""
    law = dano.ContactParams(), CentroidLaw()
    return [PatchPair(2 * i, 2 * i + 1, a.collider, b.collider, *law) for i, (a, b) in enumerate(pairs)]


def overlaps(*pairs: tuple[Side, Side]) -> list[dano.Patch]:
    """Overlaps of pairs, by kernels."""
    sides = [side for pair in pairs for side in pair]
    bodies, states = np.zeros((len(sides), 13)), np.zeros((len(sides), 13))
    bodies[:, 0] = [side.mass for side in sides]
    states[:, :3] = [side.place.position for side in sides]
    states[:, 3:7] = [side.place.orientation for side in sides]
    found = touch(Arguments(pairs_of(pairs), bodies), states)
    return [_patch(*(each[name] for name in ("overlap", "centroid", "normal"))) for each in found]


def summed(a: Side, b: Side) -> dano.Patch:
    """The overlap of a pair, written out over all samples of both sides."""
    psi, first, normal = 0.0, np.zeros(3), np.zeros(3)
    for own, other, sign in ((a, b, 1), (b, a, -1)):
        if own.samples is None or other.field is None:
            continue
        x, phi = own.samples
        world = np.asarray(own.place.apply(jnp.asarray(x)))
        local = other.place.inverse().apply(jnp.asarray(world))
        density = np.asarray(jax.vmap(other.field.density)(local))
        weight = own.mass * other.density_scale * phi / phi.sum() * density
        outward = np.asarray(jax.vmap(other.field.outward)(local))
        psi += weight.sum()
        first += weight @ world
        normal += sign * np.asarray(other.place.matrix) @ (weight @ outward)
    return _patch(psi, first / psi, normal / np.linalg.norm(normal))


def _patch(*parts: Any) -> dano.Patch:
    return dano.Patch(*map(jnp.asarray, parts))
