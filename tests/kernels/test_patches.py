"""Overlaps in kernels against those of `dano.overlap`, and what kernels do not know."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kernels.launching import Arguments, touch

import dano
from dano.contact import CentroidLaw, SampleSet, Support
from dano.engine.launching._patch_tables import patch_pairs, patch_tables, PatchPair
from dano.fields import CallableField, ScaledField
from dano.maths import quat_from_matrix


def blob(interpolation="quadratic"):
    """A lumpy density on a grid, with samples, and what skips them."""
    axis = np.linspace(-0.5, 0.5, 24)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    centers = np.random.default_rng(0).uniform(-0.15, 0.15, (4, 3))
    values = sum(np.exp(-((x - c) ** 2).sum(-1) / 0.03) for c in centers)
    field = dano.GridField(np.maximum(values - 0.05, 0), (-0.5,) * 3, axis[1] - axis[0], interpolation)
    points = np.random.default_rng(1).uniform(-0.4, 0.4, (700, 3))
    density = np.asarray(jax.vmap(field.density)(jnp.asarray(points)))
    return field, SampleSet.create(points[density > 0], density[density > 0]), Support.create(field)


def test_overlap():
    """Grids, shapes with directions of their own, unions, posed and scaled fields, and the spherical cap."""
    rng = np.random.default_rng(5)
    field, samples, support = blob()
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
        own = dano.Collider(field, samples, support=support, density_scale=0.7, mass=0.5, pose=placed[0])
        other = dano.Collider(shape, mass=0.3, density_scale=1.5, pose=placed[1])
        pairs.append((own, other) if k % 2 else (other, own))
    for normal in ((0.1, 0.2, 1.0), (0.0, 0.0, -1.0)):
        ball_collider = dano.Collider(dano.Sphere(0.1), mass=0.4, pose=dano.Pose((0.01, 0.0, 0.02)))
        plane = dano.Collider(dano.HalfSpace(normal), pose=dano.Pose((0.0, 0.0, -0.03), (1.0, 0.1, 0.0, 0.0)))
        pairs.append((ball_collider, plane) if normal[2] > 0 else (plane, ball_collider))
    listed = [
        PatchPair(2 * i, 2 * i + 1, a, b, dano.ContactParams(), CentroidLaw())
        for i, (a, b) in enumerate(pairs)
    ]
    colliders = [each for pair in pairs for each in pair]
    bodies, states = np.zeros((len(colliders), 13)), np.zeros((len(colliders), 13))
    bodies[:, 0] = [each.mass for each in colliders]
    states[:, :3] = [each.origin for each in colliders]
    states[:, 3:7] = [quat_from_matrix(each.rotation) for each in colliders]
    found = touch(Arguments(listed, bodies), states)
    for each, (a, b) in zip(found, pairs, strict=True):
        expected = dano.overlap(a, b)
        assert expected.overlap > 0
        np.testing.assert_allclose(each["overlap"], expected.overlap, rtol=1e-12)
        np.testing.assert_allclose(each["centroid"], expected.centroid, atol=1e-12)
        np.testing.assert_allclose(each["normal"], expected.normal, atol=1e-12)


def test_what_kernels_do_not_know():
    """Fields without a grid and laws of one's own are errors by name."""
    field, samples, _ = blob()
    function = CallableField(lambda x: jnp.exp(-jnp.sum(x**2, axis=1)), ((-1,) * 3, (1,) * 3))
    pair = PatchPair(
        0, 1, dano.Collider(field, samples), dano.Collider(function), dano.ContactParams(), CentroidLaw()
    )
    with pytest.raises(ValueError, match="got CallableField: dano.bake"):
        patch_tables([pair], float)

    class OwnLaw(CentroidLaw):
        """A law of one's own."""

    own_law: Any = OwnLaw

    with pytest.raises(ValueError, match="got OwnLaw"):
        patch_tables([pair._replace(b=dano.Collider(dano.Sphere(0.1)), law=own_law())], float)
    bodies = [dano.Body("ball", dano.Sphere(0.1), mass=1.0), dano.Body("floor", dano.HalfSpace(), fixed=True)]
    assert patch_pairs(dano.Scene.create(bodies, [dano.Contact("ball", "floor")], timestep=0.01)) == []
