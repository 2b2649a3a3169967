"""Overlaps in kernels against sums over all samples, and what kernels do not know."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kernels.overlaps import overlaps, pairs_of, Side, summed

import dano
from dano.contact import CentroidLaw
from dano.engine.launching._patch_tables import patch_pairs, patch_tables
from dano.fields import CallableField, ScaledField


def blob(interpolation="quadratic"):
    """A lumpy density on a grid, with samples."""
    axis = np.linspace(-0.5, 0.5, 24)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    centers = np.random.default_rng(0).uniform(-0.15, 0.15, (4, 3))
    values = sum(np.exp(-((x - c) ** 2).sum(-1) / 0.03) for c in centers)
    field = dano.GridField(np.maximum(values - 0.05, 0), (-0.5,) * 3, axis[1] - axis[0], interpolation)
    points = np.random.default_rng(1).uniform(-0.4, 0.4, (700, 3))
    density = np.asarray(jax.vmap(field.density)(jnp.asarray(points)))
    return field, (points[density > 0], density[density > 0])


def test_overlap():
    """Grids, shapes with directions of their own, unions, posed and scaled fields."""
    rng = np.random.default_rng(5)
    field, samples = blob()
    pose = dano.Pose((0.05, 0.1, -0.05), (0.9, 0.1, 0.3, 0.2))
    box, ball = dano.Box((0.2, 0.15, 0.1), 0.02, edge=0.05), dano.Sphere(0.2, edge=0.04)
    shapes = [
        dano.HalfSpace((0.3, 0.2, 1.0), 0.02, edge=0.05),
        dano.posed(dano.scaled(dano.HalfSpace((0.3, 0.2, 1.0), 0.02), 2.0), pose),
        box,
        dano.posed(dano.scaled(ball, 1.2), pose),
        dano.Capsule(0.1, 0.2),
        dano.Cylinder(0.2, 0.2, edge=0.0),
        dano.posed(dano.Ellipsoid((0.1, 0.2, 0.3)), pose),
        dano.union(box, dano.posed(ball, pose)),
        dano.posed(blob("cubic")[0], pose),
        ScaledField(dano.union(field, dano.posed(box, pose)), jnp.asarray(1.3)),
    ]
    pairs = []
    for k, shape in enumerate(shapes):
        placed = [dano.Pose(0.1 * rng.normal(size=3), rng.normal(size=4)) for _ in range(2)]
        own = Side(field, samples, placed[0], mass=0.5, density_scale=0.7)
        other = Side(shape, None, placed[1], mass=0.3, density_scale=1.5)
        pairs.append((own, other) if k % 2 else (other, own))
    for (a, b), found in zip(pairs, overlaps(*pairs), strict=True):
        expected = summed(a, b)
        assert expected.overlap > 0
        np.testing.assert_allclose(found.overlap, expected.overlap, rtol=1e-12)
        np.testing.assert_allclose(found.centroid, expected.centroid, atol=1e-12)
        np.testing.assert_allclose(found.normal, expected.normal, atol=1e-12)


def test_what_kernels_do_not_know():
    """Fields without a grid and laws of one's own are errors by name."""
    field, samples = blob()
    function = CallableField(lambda x: jnp.exp(-jnp.sum(x**2, axis=1)), ((-1,) * 3, (1,) * 3))
    (pair,) = pairs_of([(Side(field, samples), Side(function))])
    with pytest.raises(ValueError, match="got CallableField: dano.bake"):
        patch_tables([pair], float)

    class OwnLaw(CentroidLaw):
        """A law of one's own."""

    own_law: Any = OwnLaw

    with pytest.raises(ValueError, match="got OwnLaw"):
        patch_tables([pair._replace(b=Side(dano.Sphere(0.1)).collider, law=own_law())], float)
    bodies = [dano.Body("ball", dano.Sphere(0.1), mass=1.0), dano.Body("floor", dano.HalfSpace(), fixed=True)]
    assert patch_pairs(dano.Scene.create(bodies, [dano.Contact("ball", "floor")], timestep=0.01)) == []
