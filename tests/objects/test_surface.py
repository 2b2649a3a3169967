"""Surface samples against closed forms: areas, moments, corners, evenness, thin walls, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree, ConvexHull, Voronoi

import dano
from dano.objects import draw_surface, SurfaceSamples

SKIN = 0.01
# Mean of s² over the bell of mean 1 on 0 < s < 2: ∫ s² (1 − cos π s)/2 ds.
SECOND = 4 / 3 - 2 / np.pi**2
HALF = np.array([0.5, 0.3, 0.2])


def host(samples):
    return (np.asarray(a) for a in (samples.points, samples.normals, samples.areas))


def steiner(area, mean_curvature, corners=1.0):
    """Area + skin ∫(κ₁ + κ₂) dA + skin² ∫κ₁κ₂ dA, the last 4π for one convex body."""
    return area + SKIN * mean_curvature + 4 * np.pi * corners * SECOND * SKIN**2


def box_area(half):
    a, b, c = 2 * np.asarray(half)
    return steiner(2 * (a * b + b * c + c * a), 2 * np.pi * (a + b + c))


AREAS = {
    "ball": (dano.Sphere(0.5), steiner(np.pi, 4 * np.pi)),
    "box": (dano.Box(HALF), box_area(HALF)),
    "cube": (dano.Box((0.5, 0.5, 0.5)), box_area((0.5, 0.5, 0.5))),
    "plate": (dano.Box((0.5, 0.4, 0.015)), box_area((0.5, 0.4, 0.015))),
    "turned box": (dano.posed(dano.Box(HALF), dano.Pose((1, 2, 3), (0.9, 0.1, 0.2, 0.3))), box_area(HALF)),
    # Rounding by r: the parallel body at r of the core.
    "capsule": (
        dano.Capsule(0.2, 0.3),
        steiner(4 * np.pi * 0.2 * 0.3 + 4 * np.pi * 0.2**2, 2 * np.pi * 0.6 + 8 * np.pi * 0.2),
    ),
    # Two rims of angle π/2 and length 2πr, and a wall of curvature 1/r.
    "cylinder": (
        dano.Cylinder(0.3, 0.5),
        steiner(2 * np.pi * 0.3 * 1.0 + 2 * np.pi * 0.3**2, 2 * np.pi * 1.0 + 2 * np.pi**2 * 0.3),
    ),
}


@pytest.fixture(scope="module")
def box_samples():
    return draw_surface(dano.Box(HALF), 3000, skin=SKIN)


@pytest.mark.parametrize("n", [200, 3000])
@pytest.mark.parametrize("name", AREAS)
def test_total_area_is_that_of_the_inflated_surface(name, n):
    shape, area = AREAS[name]
    samples = draw_surface(shape, n, skin=SKIN)
    points, normals, areas = host(samples)
    assert len(points) == len(normals) == len(areas) == n
    np.testing.assert_allclose(areas.sum(), area, rtol=4e-3)
    np.testing.assert_allclose(shape.sdf_jet(jnp.asarray(points.T), 0), 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-12)
    assert areas.min() > 0.2 * areas.mean()
    # A closed surface: ∫ n dA = 0.
    assert np.linalg.norm(areas @ normals) < 4e-3 * areas.sum()


def test_default_skin_is_a_quarter_percent_of_the_size():
    given, default = draw_surface(dano.Box(HALF), 100, skin=0.0025), draw_surface(dano.Box(HALF), 100)
    np.testing.assert_array_equal(given.areas, default.areas)


@pytest.mark.parametrize("shape", [dano.Sphere(0.5), dano.Ellipsoid((0.5, 0.3, 0.2))])
def test_divergence_theorem_gives_volume_and_centroid(shape):
    """∫ x·n dA = 3 V, ∫ x xᵀ n dA = 2 V c = 0 where nothing is sharp and the skin is thin."""
    moments = shape.solid_moments()
    points, normals, areas = host(draw_surface(shape, 4000, skin=2e-3))
    outward = np.einsum("ij,ij->i", points, normals)
    np.testing.assert_allclose(areas @ outward / 3, moments.volume, rtol=0.025)
    np.testing.assert_allclose((areas * outward) @ points, 0, atol=5e-3 * moments.volume)


def test_corners_and_edges_of_a_box_are_exact(box_samples):
    points, normals, areas = host(box_samples)
    faces = (np.abs(np.abs(points) - HALF) < 1e-12).sum(axis=1)
    assert faces.min() == 1
    corner = faces == 3
    assert corner.sum() == 8
    assert len(np.unique(np.sign(points[corner]), axis=0)) == 8
    diagonal = np.sign(points[corner]) / np.sqrt(3)
    assert np.min(np.sum(normals[corner] * diagonal, axis=1)) > 0.9
    pitch = np.sqrt(areas.sum() / len(points))
    for axis in range(3):
        across = [i for i in range(3) if i != axis]
        for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            on_edge = np.all(np.abs(points[:, across] - signs * HALF[across]) < 1e-12, axis=1)
            gaps = np.diff(np.sort(points[on_edge][:, axis]))
            assert gaps.max() < 1.6 * pitch
            assert gaps.min() > 0.3 * pitch
            # Half of the pitch on each face, and the quarter cylinder.
            share = areas[on_edge].sum() / (2 * HALF[axis])
            assert 0.4 * pitch < share < 1.4 * pitch + SKIN * np.pi / 2


def test_moments_of_a_box(box_samples):
    """Second moment ∫ x xᵀ dA of six faces, twelve edges and eight corners in closed form."""
    points, _, areas = host(box_samples)
    want = np.zeros(3)
    for axis in range(3):
        a, b = (HALF[i] for i in range(3) if i != axis)
        c, face = HALF[axis], 4 * a * b
        want[axis] += 2 * face * c**2
        for other, half in zip([i for i in range(3) if i != axis], (a, b), strict=True):
            want[other] += 2 * face * half**2 / 3
        edge = SKIN * np.pi / 2 * 2 * c
        want[axis] += 4 * edge * c**2 / 3
        for other, half in zip([i for i in range(3) if i != axis], (a, b), strict=True):
            want[other] += 4 * edge * half**2
    want += 4 * np.pi * SECOND * SKIN**2 * HALF**2
    got = np.einsum("i,ij,ik->jk", areas, points, points)
    np.testing.assert_allclose(got, np.diag(want), atol=2e-3 * want.max())
    np.testing.assert_allclose(areas @ points, 0, atol=1e-3 * areas.sum() * HALF.max())


def test_areas_on_a_face_are_those_of_its_voronoi_cells(box_samples):
    points, _, areas = host(box_samples)
    top = np.abs(points[:, 2] - HALF[2]) < 1e-12
    flat = points[top][:, :2]
    diagram = Voronoi(flat)
    inner = np.all(np.abs(flat) < HALF[:2] - 2.5 * np.sqrt(areas.mean()), axis=1)
    cells = [diagram.vertices[diagram.regions[r]] for r in diagram.point_region[inner]]
    exact = np.array([ConvexHull(cell).volume for cell in cells])
    assert len(exact) > 400
    assert np.std(areas[top][inner] / exact) < 0.06
    np.testing.assert_allclose(areas[top][inner].sum(), exact.sum(), rtol=0.01)


@pytest.mark.parametrize("n", [500, 4000])
def test_samples_cover_evenly(n):
    points, _, areas = host(draw_surface(dano.Sphere(0.5), n))
    pitch = np.sqrt(np.pi / n)
    nearest = cKDTree(points).query(points, k=2)[0][:, 1]
    assert nearest.min() > 0.6 * pitch
    assert nearest.std() < 0.15 * nearest.mean()
    way = np.random.default_rng(0).normal(size=(20_000, 3))
    hole = cKDTree(points).query(0.5 * way / np.linalg.norm(way, axis=1, keepdims=True))[0].max()
    assert hole < 1.2 * pitch
    assert areas.std() < 0.25 * areas.mean()


def test_both_sides_of_a_thin_wall_are_covered():
    """Thinner than the distance between samples: each side has its half, and normals of its own."""
    half = np.array([0.5, 0.5, 0.004])
    points, normals, areas = host(draw_surface(dano.Box(half), 500))
    inner = np.all(np.abs(points[:, :2]) < 0.45, axis=1)
    assert np.all(normals[inner][:, 2] * np.sign(points[inner][:, 2]) > 0.99)
    for sign in (1, -1):
        side = inner & (np.sign(points[:, 2]) == sign)
        np.testing.assert_allclose(areas[side].sum(), 0.9**2, rtol=0.05)


def test_finer_samples_approach_the_integral():
    """∫ cos(7x) e^y dA over a cube, which the moment balance knows nothing of: the error falls with n."""
    inner = [2 / 7 * np.sin(3.5), 2 * np.sinh(0.5), 1.0]
    ends = [2 * np.cos(3.5), 2 * np.cosh(0.5), 2.0]
    faces = sum(ends[i] * np.prod(inner) / inner[i] for i in range(3))
    edges = sum(inner[i] * np.prod(ends) / ends[i] for i in range(3))
    want = faces + np.pi / 2 * (SKIN * edges + SECOND * SKIN**2 * np.prod(ends))
    errors = []
    for n in (60, 600, 6000):
        points, _, areas = host(draw_surface(dano.Box((0.5, 0.5, 0.5)), n, skin=SKIN))
        errors.append(abs(areas @ (np.cos(7 * points[:, 0]) * np.exp(points[:, 1])) / want - 1))
    assert errors[1] < 0.5 * errors[0]
    assert errors[2] < 0.5 * errors[1]
    assert errors[2] < 5e-3


def test_same_key_same_samples():
    draw = lambda seed: draw_surface(dano.Sphere(0.5), 50, key=jax.random.key(seed))  # noqa: E731
    np.testing.assert_array_equal(draw(1).points, draw(1).points)
    assert np.any(np.asarray(draw(1).points) != np.asarray(draw(2).points))


@pytest.mark.parametrize("n", [1, 2, 8])
def test_few_samples_carry_the_whole_area(n):
    points, normals, areas = host(draw_surface(dano.Box(HALF), n, skin=SKIN))
    np.testing.assert_allclose(areas.sum(), box_area(HALF), rtol=4e-3)
    np.testing.assert_allclose(np.abs(points), np.broadcast_to(HALF, (n, 3)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-12)


def test_vector_areas_of_a_box(box_samples):
    """What faces a direction is the face's area and the skin around it; all directions sum to zero."""
    vectors, points = np.asarray(box_samples.vectors), np.asarray(box_samples.points)
    for axis in range(3):
        others = [2 * HALF[k] for k in range(3) if k != axis]
        for side in (-1, 1):
            facing = np.maximum(side * vectors[:, axis], 0)
            inflated = np.prod([length + 2 * SKIN for length in others])
            np.testing.assert_allclose(facing.sum(), inflated, rtol=0.01)
            # On the face itself, none of it from the sides.
            on_face = np.isclose(points[:, axis], side * HALF[axis])
            assert facing[~on_face].sum() < 3e-3 * inflated
    np.testing.assert_allclose(vectors.sum(axis=0), 0, atol=5e-3 * float(box_samples.areas.sum()))
    assert np.all(np.linalg.norm(vectors, axis=1) <= np.asarray(box_samples.areas) * (1 + 1e-6))


def test_vector_areas_default_to_flat_pieces():
    one = SurfaceSamples(jnp.zeros((1, 3)), jnp.array([[0.0, 0.0, 1.0]]), jnp.array([2.0]))
    np.testing.assert_array_equal(one.vectors, [[0.0, 0.0, 2.0]])


BAD = {
    "half-space": (lambda: draw_surface(dano.HalfSpace(), 10), "finite bounds"),
    "n": (lambda: draw_surface(dano.Sphere(1.0), 0), "n must be ≥ 1"),
    "skin": (lambda: draw_surface(dano.Sphere(1.0), 10, skin=0.0), "skin must be"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_options(case):
    act, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        act()
