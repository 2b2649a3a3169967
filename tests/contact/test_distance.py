"""Signed distances of solids against closed forms; their derivatives against differences, both modes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.contact._distance import _solid
from dano.maths import quat_from_axis_angle

R2, R3 = np.sqrt(2), np.sqrt(3)
BALL, BOX, CUBE = dano.Sphere(0.1), dano.Box((0.2, 0.3, 0.1)), dano.Box((0.1, 0.1, 0.1))
FLOOR = dano.HalfSpace()


def turned(axis, angle):
    return quat_from_axis_angle(axis, angle)


def at(position, *turn):
    return dano.Pose(position, turned(*turn)) if turn else dano.Pose(position)


ON_CORNER = ((1.0, -1.0, 0.0), np.arccos(1 / R3))
ON_EDGE, ACROSS = ((1, 0, 0), np.pi / 4), ((0, 1, 0), np.pi / 4)
CASES = {
    "balls apart": (
        BALL,
        dano.Sphere(0.2),
        at((0.5, 0.1, 0)),
        np.hypot(0.5, 0.1) - 0.3,
        (0.98058, 0.19612, 0),
    ),
    "balls overlap": (
        BALL,
        dano.Sphere(0.2),
        at((0.2, 0.1, 0)),
        np.hypot(0.2, 0.1) - 0.3,
        (2 / 5**0.5, 0.44721, 0),
    ),
    "ball over a face": (BALL, BOX, at((0.05, 0.1, 0.35)), 0.15, (0, 0, 1)),
    "ball in a face": (BALL, BOX, at((0.05, 0.1, 0.15)), -0.05, (0, 0, 1)),
    "ball at an edge": (BALL, BOX, at((0.3, 0.1, 0.3)), np.hypot(0.1, 0.2) - 0.1, (0.44721, 0, 0.89443)),
    "ball at a corner": (BALL, BOX, at((0.3, 0.5, 0.3)), 0.2, (1 / 3, 2 / 3, 2 / 3)),
    "faces apart": (CUBE, BOX, at((0.05, 0.1, 0.35)), 0.15, (0, 0, 1)),
    "faces overlap": (CUBE, BOX, at((0.05, 0.1, 0.18)), -0.02, (0, 0, 1)),
    "edge over a face": (CUBE, BOX, at((0, 0, 0.3), *ON_EDGE), 0.2 - 0.1 * R2, (0, 0, 1)),
    "edge in a face": (CUBE, BOX, at((0, 0, 0.22), *ON_EDGE), 0.12 - 0.1 * R2, (0, 0, 1)),
    "corner in a plane": (CUBE, FLOOR, at((0, 0, 0.17), *ON_CORNER), 0.17 - 0.1 * R3, (0, 0, 1)),
    "capsule over a capsule": (
        dano.Capsule(0.05, 0.2),
        dano.Capsule(0.04, 0.3),
        at((0.03, 0.3, 0.05), (0, 1, 0), np.pi / 2),
        0.21,
        (0, 1, 0),
    ),
    "capsules overlap": (
        dano.Capsule(0.05, 0.2),
        dano.Capsule(0.04, 0.3),
        at((0.03, 0.06, 0.05), (0, 1, 0), np.pi / 2),
        -0.03,
        (0, 1, 0),
    ),
    "rim of a cylinder over a plane": (
        dano.Cylinder(0.1, 0.2),
        FLOOR,
        at((0, 0, 0.5), (1, 0, 0), 0.3),
        0.5 - 0.2 * np.cos(0.3) - 0.1 * np.sin(0.3),
        (0, 0, 1),
    ),
    "ellipsoid over a plane": (
        dano.Ellipsoid((0.1, 0.2, 0.3)),
        FLOOR,
        at((0, 0, 0.5), (1, 0, 0), 0.3),
        0.5 - np.hypot(0.3 * np.cos(0.3), 0.2 * np.sin(0.3)),
        (0, 0, 1),
    ),
}
"""Two solids, the pose of the first, their distance and the normal from the second to the first."""


SWAPPED = {"balls apart", "ball in a face", "corner in a plane"}


@pytest.mark.parametrize("case", CASES)
def test_distances_are_those_of_closed_forms(case):
    a, b, pose, wanted, normal = CASES[case]
    found = dano.distance(a, b, pose_a=pose)
    assert float(found.value) == pytest.approx(wanted, abs=1e-12)
    np.testing.assert_allclose(found.normal, normal, atol=1e-5)
    # The points lie on the surfaces, and the distance along the normal between them.
    local = pose.inverse().apply(found.point_a)
    assert abs(float(a.sdf(local))) < 1e-9 and abs(float(b.sdf(found.point_b))) < 1e-9
    np.testing.assert_allclose(found.point_a - found.point_b, wanted * np.asarray(found.normal), atol=1e-7)
    if case not in SWAPPED:
        return
    swapped = dano.distance(b, a, pose_b=pose)
    assert float(swapped.value) == pytest.approx(wanted, abs=1e-12)
    np.testing.assert_allclose(swapped.normal, -np.asarray(normal), atol=1e-5)


@pytest.mark.parametrize("height", [0.4, 0.27])
def test_edges_that_cross(height):
    """Two cubes stand on edges at right angles: edges at heights ±0.1 √2 about the centres."""
    found = dano.distance(CUBE, CUBE, pose_a=at((0, 0, height), *ON_EDGE), pose_b=at((0, 0, 0), *ACROSS))
    assert float(found.value) == pytest.approx(height - 0.2 * R2, abs=1e-7)
    np.testing.assert_allclose(found.normal, (0, 0, 1), atol=1e-5)
    np.testing.assert_allclose(found.point_a, (0, 0, height - 0.1 * R2), atol=1e-6)


def parameters_and_result(a_of, b_of, position):
    """Everything that `distance` says as one array, of eight numbers: pose, turn, two sizes."""

    def result(numbers):
        axis = jnp.array([0.6, 0.0, 0.8])
        pose = dano.Pose(numbers[:3], turned(axis, numbers[3]))
        other = dano.Pose(numbers[4:7], turned(axis, 0.2))
        found = dano.distance(a_of(numbers[7]), b_of(numbers[8]), pose_a=pose, pose_b=other)
        return jnp.concatenate([found.value[None], found.point_a, found.point_b, found.normal])

    return result, jnp.array([*position, 0.3, 0.01, -0.02, 0.03, 0.1, 0.12])


SMOOTH = {
    "ball at a corner": (
        dano.Sphere,
        lambda h: dano.Box(jnp.stack([0.2 + 0 * h, 0.3 + 0 * h, h])),
        (0.35, 0.5, 0.4),
    ),
    "ball in a face": (
        dano.Sphere,
        lambda h: dano.Box(jnp.stack([0.2 + 0 * h, 0.3 + 0 * h, h])),
        (0.03, 0.05, 0.2),
    ),
    "capsules": (lambda r: dano.Capsule(r, 0.2), lambda r: dano.Capsule(r, 0.25), (0.02, 0.4, 0.05)),
    "corner in a ball": (
        lambda h: dano.Box(jnp.stack([h, h, h])),
        lambda r: dano.Sphere(2 * r),
        (0.21, 0.2, 0.22),
    ),
}


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=() if case == "ball at a corner" else pytest.mark.slow) for case in SMOOTH],
)
def test_derivatives_are_those_of_differences_in_both_modes(case):
    result, x = parameters_and_result(*SMOOTH[case])
    result = jax.jit(result)
    forward, reverse = jax.jacfwd(result)(x), jax.jacrev(result)(x)
    # Each finds the points anew, to 1e-8.
    np.testing.assert_allclose(forward, reverse, atol=1e-6)
    # Of a step of 1e-2 the distance itself; of a small one all, to what its points are found to.
    for step, most, rows in ((1e-2, 5e-3, slice(0, 1)), (1e-4, 2e-4, slice(None))):
        for k in range(len(x)):
            change = jnp.zeros(len(x)).at[k].set(step)
            difference = (result(x + change) - result(x - change)) / (2 * step)
            np.testing.assert_allclose(forward[rows, k], difference[rows], atol=most)


@pytest.mark.parametrize("case", ["faces apart", "edge in a face", "corner in a plane", "edge over a face"])
def test_the_distance_has_its_derivative_where_nearest_points_have_none(case):
    """Moving along the normal raises it by as much; along the face it stays."""
    a, b, pose, *_ = CASES[case]

    def value(position):
        return dano.distance(a, b, pose_a=dano.Pose(position, pose.orientation)).value

    slope = jax.jit(jax.grad(value))(pose.position)
    np.testing.assert_allclose(slope, (0, 0, 1), atol=1e-7)


def test_many_at_once_are_as_one_by_one():
    heights = jnp.array([0.15, 0.3, 0.5])

    def value(height):
        return dano.distance(BALL, BOX, pose_a=dano.Pose(jnp.stack([0.05, 0.1, height]))).value

    np.testing.assert_allclose(jax.vmap(value)(heights), heights - 0.2, atol=1e-12)


def test_meshes_and_objects_are_as_exact_as_their_grids():
    trimesh = pytest.importorskip("trimesh")
    solid = dano.mesh_field(trimesh.creation.box((0.2, 0.2, 0.2)), resolution=40)
    cell = float(np.max(np.asarray(solid.spacing)))
    for height in (0.17, 0.25, 0.6):
        found = dano.distance(solid, dano.Sphere(0.1), pose_b=at((0.02, 0.01, height)))
        assert float(found.value) == pytest.approx(height - 0.2, abs=0.1 * cell)
        np.testing.assert_allclose(found.normal, (0, 0, -1), atol=0.05)
    made = dano.NeuralObject.from_field(solid, mass=1.0, n_samples=200, resolution=40)
    found = dano.distance(made, FLOOR, pose_a=at((0, 0, 0.3)))
    assert float(found.value) == pytest.approx(0.2, abs=0.2 * cell)


def test_a_hole_is_found_and_not_the_hull():
    """A ball inside a ring of four boxes: the way to the nearest side, which a convex hull would not have."""
    sides = [dano.fields.posed(dano.Box((0.05, 0.3, 0.1)), dano.Pose((x, 0, 0))) for x in (-0.25, 0.25)] + [
        dano.fields.posed(dano.Box((0.3, 0.05, 0.1)), dano.Pose((0, y, 0))) for y in (-0.25, 0.25)
    ]
    ring = dano.union(*sides)
    assert isinstance(ring, dano.AbstractShape)
    found = dano.distance(dano.Sphere(0.05), ring, pose_a=at((0.06, 0.0, 0.0)))
    assert float(found.value) == pytest.approx(0.2 - 0.06 - 0.05, abs=1e-9)
    np.testing.assert_allclose(found.normal, (-1, 0, 0), atol=1e-6)


def test_bodies_of_a_scene_by_name_and_by_state():
    bodies = [
        dano.Body("ball", BALL, mass=1.0, position=(0.05, 0.1, 0.35)),
        dano.Body("box", BOX, mass=1.0, com=(0.02, 0, 0), origin=(0, 0, 0)),
        dano.Body("arm", dano.Capsule(0.05, 0.2), mass=1.0, com=(0, 0, 0)),
    ]
    hinge = dano.Joint(None, "arm", axis=(0, 1, 0), anchor=(0, 0, -0.2), position=(1.0, 0.1, 0))
    scene = dano.Scene.create(bodies, joints=[hinge])
    state = scene.initial_state(arm=dict(q=-np.pi / 2))
    assert float(scene.distance(state, "ball", "box").value) == pytest.approx(0.15, abs=1e-12)
    # Its axis lies from x = 1 to 0.6 at the height of its anchor, −0.2.
    seen = scene.distance(state, "arm", "box")
    assert float(seen.value) == pytest.approx(np.hypot(0.6 - 0.2, 0.2 - 0.1) - 0.05, abs=1e-9)
    with pytest.raises(ValueError, match="did you mean 'ball'"):
        scene.distance(state, "bal", "box")


def test_what_has_no_distance_is_refused():
    with pytest.raises(ValueError, match="two half-spaces"):
        dano.distance(FLOOR, dano.HalfSpace((0, 1, 0)))
    with pytest.raises(ValueError, match="starts must lie between"):
        dano.distance(BALL, BOX, starts=65)
    # Where types are not checked, as in programs of users.
    for given, message in (
        (3.0, "b must be .*AbstractShape.* or NeuralObject"),
        (dano.GridField(np.ones((4, 4, 4)), (0, 0, 0), 0.1), "b must be a shape .* has no surface"),
    ):
        with pytest.raises(ValueError, match=message):
            _solid("b", given, None)
