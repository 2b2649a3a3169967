"""Kernels of the centroid law, against its functions in JAX and the steps of the engine."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import warp as wp
from kernels.launching import Arguments, KERNELS, rollout, touch

import dano
from dano.contact import CentroidLaw, SampleSet, Support
from dano.engine.launching._patch_tables import patch_pairs, patch_tables, PatchPair
from dano.fields import CallableField, ScaledField
from dano.maths import quat_from_matrix

law = KERNELS.patch_law
PARAMS = dano.ContactParams(
    spring=3e3,
    damper=4e3,
    sliding_friction=0.4,
    sliding_drag=0.05,
    torsional_friction=0.02,
    torsional_drag=0.003,
    rolling_friction=0.03,
    rolling_drag=0.004,
)
LAWS = [
    CentroidLaw(smoothing=12.0, regularizer=2e-3),
    CentroidLaw(smoothing=12.0, regularizer=2e-3, adhesive=True),
    CentroidLaw(stiction_velocity=1e-4),
    CentroidLaw(stiction_velocity=1e-4, adhesive=True),
]
TWISTS = np.array(
    [
        [0.1, -0.2, 0.3, 1.0, -2.0, 0.5],
        [0.0, 0.0, -0.5, 0.0, 0.0, 0.0],
        [1e-5, 2e-5, 0.0, 0.0, 1e-6, 0.0],
        [3.0, 1.0, 2.0, 0.1, 0.1, 0.1],
    ]
)
NORMAL = np.array([0.36, 0.48, 0.8])


@wp.kernel(enable_backward=False)
def press(
    materials: wp.array(dtype=law.PatchMaterial),
    adhesive: wp.array(dtype=wp.int32),
    twists: wp.array2d(dtype=wp.float64),
    patch: KERNELS.overlap.Patch,
    wrenches: wp.array2d(dtype=law.PatchWrench),
    linear_wrenches: wp.array2d(dtype=law.PatchWrench),
    jacobians: wp.array2d(dtype=law.PatchJacobian),
):
    """Wrenches of each material at each twist: the law's, those of its linearisation, and the derivative."""
    i, j = wp.tid()
    material = materials[i]
    pulls = adhesive[i] > 0
    velocity = wp.vec3d(twists[j, 0], twists[j, 1], twists[j, 2])
    spin = wp.vec3d(twists[j, 3], twists[j, 4], twists[j, 5])
    wrenches[i, j] = law.patch_law(material, patch, pulls, velocity, spin)
    motion = law.patch_motion(patch.normal, velocity, spin)
    duals = law.fitting_patch_duals(material, patch.overlap, pulls, motion)
    zero = wp.float64(0.0)
    linear = law.linearized_patch(
        material, patch.overlap, pulls, motion, duals, wp.float64(1.0), False, zero, zero
    )
    linear_wrenches[i, j] = law.patch_wrench(material, patch.normal, motion, linear)
    jacobians[i, j] = law.patch_jacobian(material, patch.normal, motion, linear)


def test_wrench_and_jacobian():
    """Smooth friction, friction that sticks, and contacts that pull, from rest to fast motion."""
    rows = np.ascontiguousarray([one.numbers(PARAMS) for one in LAWS])
    patch = KERNELS.overlap.Patch()
    patch.overlap, patch.normal = 0.02, NORMAL
    shape = (len(LAWS), len(TWISTS))
    found = [
        wp.zeros(shape, dtype=kind, device="cpu")
        for kind in (law.PatchWrench, law.PatchWrench, law.PatchJacobian)
    ]
    given = [
        wp.array(ptr=rows.ctypes.data, dtype=law.PatchMaterial, shape=(len(LAWS),), device="cpu"),
        wp.array([one.adhesive for one in LAWS], dtype=wp.int32, device="cpu"),
        wp.array(TWISTS, dtype=wp.float64, device="cpu"),
    ]
    wp.launch(press, shape, [*given, patch, *found], device="cpu")
    wrench, linear, jacobian = (x.numpy() for x in found)
    of_law = dano.Patch(jnp.asarray(0.02), jnp.zeros(3), jnp.asarray(NORMAL))
    for i, one in enumerate(LAWS):
        for j, twist in enumerate(TWISTS):
            expected, slope = one.wrench(of_law, PARAMS, jnp.asarray(twist), jnp.asarray(0.01))
            for each in (wrench[i, j], linear[i, j]):
                np.testing.assert_allclose(each["force"], expected[:3], rtol=1e-12, atol=1e-12)
                np.testing.assert_allclose(each["moment"], expected[3:], rtol=1e-12, atol=1e-12)
            own = jacobian[i, j]
            upper = np.concatenate([own["force"], np.zeros((3, 3))], axis=1)
            whole = np.concatenate([upper, np.concatenate([own["moment"], own["turning"]], axis=1)])
            np.testing.assert_allclose(whole, slope, rtol=1e-11, atol=1e-11)


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


def test_steps():
    """A ball that rolls, a box that sticks, and two objects on each other, beside steps of the engine."""
    field, samples, _ = blob()
    made = dano.NeuralObject.from_samples(
        points=0.1 * np.asarray(samples.points[:3].T)[:640],
        density=np.asarray(samples.weights)[:640],
        mass=0.4,
        com=(0.0, 0.0, 0.0),
        inertia=4e-4 * np.eye(3),
        field=dano.scaled(field, 0.1),
    )
    bodies = [
        dano.Body("ball", dano.Sphere(0.05), mass=1.0),
        dano.Body("box", dano.Box((0.05, 0.04, 0.03)), mass=0.5),
        dano.Body("a", made),
        dano.Body("b", made),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    small = dano.ContactParams(damper=1e6, torsional_friction=1e-3, rolling_friction=1e-3)
    sticks = CentroidLaw(stiction_velocity=1e-7)
    contacts = [
        dano.Contact("floor", "ball", small, CentroidLaw()),
        dano.Contact("box", "floor", law=sticks),
        dano.Contact("a", "floor", small, CentroidLaw(adhesive=True)),
        dano.Contact("a", "b", law=sticks),
    ]
    scene = dano.Scene.create(bodies, contacts, timestep=0.002)
    state = scene.initial_state(
        ball={"position": (0, 1, 0.05), "velocity": (0.3, 0, 0), "omega": (1, 2, 3)},
        box={"position": (1, 0, 0.05), "velocity": (0.3, 0.1, 0), "omega": (1, 0, 1)},
        a={"position": (0, 0, 0.032), "omega": (0, 1, 0)},
        b={"position": (0.01, 0, 0.09), "velocity": (0, 0, -0.2)},
    )
    expected = dano.simulate(scene, state, 40)
    rows = np.concatenate([state.position, state.orientation, state.velocity, state.omega], axis=1)
    states, reports = rollout(Arguments.of_scene(scene), rows, 40)
    assert np.all(reports["solved"] == 1) and np.all(expected.converged)
    patches = dano.contact_patches(scene, expected.states)
    assert all(np.any(np.asarray(patch.overlap) > 0) for patch in patches)
    np.testing.assert_allclose(states["position"], expected.states.position[1:], atol=1e-10)
    np.testing.assert_allclose(states["orientation"], expected.states.orientation[1:], atol=1e-8)


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

    with pytest.raises(ValueError, match="got OwnLaw"):
        patch_tables([pair._replace(b=dano.Collider(dano.Sphere(0.1)), law=OwnLaw())], float)
    bodies = [dano.Body("ball", dano.Sphere(0.1), mass=1.0), dano.Body("floor", dano.HalfSpace(), fixed=True)]
    assert patch_pairs(dano.Scene.create(bodies, [dano.Contact("ball", "floor")], timestep=0.01)) == []
