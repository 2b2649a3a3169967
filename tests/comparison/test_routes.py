"""Level surfaces, raw and cleaned, and the poses in which a solid can lie."""

import numpy as np
import pytest

from dano.comparison._bodies import (
    best_level,
    components,
    Grid,
    largest_component,
    level_mesh,
    nearest_rest,
    Probes,
    stable_directions,
    together,
)
from dano.exchange import convex_hull, enclosed, Triangles

RADIUS = 0.3


def ball_grid(n: int = 40) -> Grid:
    """A wall of density around the middle of a unit cube: 100 inside, 50 at the radius."""
    axis = np.linspace(0, 1, n)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    distance = np.linalg.norm(x - 0.5, axis=-1) - RADIUS
    return Grid(100 / (1 + np.exp(distance / 0.02)), np.zeros(3), np.full(3, axis[1]))


def dirty_grid() -> Grid:
    """The same, hollow, with a floater in a corner."""
    grid = ball_grid()
    values = grid.values.copy()
    values[16:24, 16:24, 16:24] = 0.0
    values[1:4, 1:4, 1:4] = 90.0
    return grid._replace(values=values)


def test_the_best_level_has_the_volume_of_the_reference():
    # φ = 50 at the radius; 12 % more density a step of the search.
    assert best_level(ball_grid(80), 4 / 3 * np.pi * RADIUS**3) == pytest.approx(50, rel=0.12)
    assert best_level(dirty_grid(), 4 / 3 * np.pi * RADIUS**3) == pytest.approx(50, rel=0.12)


def test_the_largest_component_is_the_one_that_encloses_most():
    two = [box((0.1, 0.1, 0.1)), box((0.2, 0.2, 0.2), (1.0, 0, 0))]
    faces = np.concatenate([two[0].faces, two[1].faces + len(two[0].vertices)])
    mesh = Triangles(np.concatenate([part.vertices for part in two]), faces)
    assert len(np.unique(components(mesh))) == 2
    assert enclosed(largest_component(mesh)).volume == pytest.approx(8e-3)


def test_cleaning_drops_floaters_and_fills_cavities():
    true = level_mesh(ball_grid(), 50.0, cleaned=False).moments
    assert true.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)
    raw = level_mesh(dirty_grid(), 50.0, cleaned=False)
    assert raw.parts == 3 and raw.triangles.open_edges == 0
    assert raw.moments.volume < 0.95 * true.volume
    cleaned = level_mesh(dirty_grid(), 50.0, cleaned=True)
    assert cleaned.parts == 1
    assert cleaned.moments.volume == pytest.approx(true.volume, rel=1e-12)


def test_cleaning_closes_what_the_grid_cuts():
    grid = ball_grid()
    half = grid._replace(values=grid.values[20:])
    assert level_mesh(half, 50.0, cleaned=False).triangles.open_edges > 0
    assert level_mesh(half, 50.0, cleaned=True).triangles.open_edges == 0


def test_a_level_above_all_gives_no_mesh():
    empty = level_mesh(ball_grid(), 101.0, cleaned=True)
    assert (empty.parts, len(empty.triangles.faces), empty.moments.volume) == (0, 0, 0.0)


def box(sides, centre=(0.0, 0.0, 0.0)):
    return convex_hull(np.array(centre) + (np.array(list(np.ndindex(2, 2, 2))) - 0.5) * sides)


def test_pieces_weigh_what_the_whole_does():
    whole = enclosed(box((0.4, 0.2, 0.1)))
    halves = together([box((0.2, 0.2, 0.1), (-0.1, 0, 0)), box((0.2, 0.2, 0.1), (0.1, 0, 0))])
    assert halves.volume == pytest.approx(whole.volume)
    np.testing.assert_allclose(halves.com, 0, atol=1e-15)
    np.testing.assert_allclose(halves.inertia, whole.inertia, rtol=1e-12, atol=1e-18)


def test_a_box_stands_on_each_face_and_a_thin_one_not_on_its_edge():
    stable = stable_directions(box((0.3, 0.2, 0.1)), np.zeros(3))
    np.testing.assert_allclose(sorted(map(tuple, stable)), sorted(map(tuple, AXES)), atol=1e-6)
    # Tipped by 4° its centre of mass is past the edge of 5 mm.
    thin = stable_directions(box((0.3, 0.2, 0.005)), np.zeros(3))
    np.testing.assert_allclose(np.abs(thin), [[0, 0, 1], [0, 0, 1]], atol=1e-6)


AXES = [*np.eye(3), *-np.eye(3)]


def test_a_box_that_is_heavy_on_top_falls_over():
    stable = stable_directions(box((0.1, 0.1, 0.3)), np.array([0.06, 0.0, 0.0]))
    assert nearest_rest(np.array([0.0, 0.0, 1.0]), stable) == pytest.approx(90)
    assert nearest_rest(np.array([-1.0, 0.0, 0.0]), stable) == pytest.approx(0, abs=1e-3)


def test_probes_count_what_is_clear_and_what_is_deep():
    probes = Probes(np.zeros((5, 3)), 0.1, np.array([0.05, 0.02, 0.001, -0.001, -0.04]))
    touching = np.array([False, True, True, False, False])
    assert probes.judged(touching, 0.01) == (0.5, 0.02, 1.0)
    assert probes.judged(~touching, 0.01) == (0.5, 0.05, 0.0)
