"""Values at nodes: connected parts, signed distances of level sets."""

import numpy as np
import pytest

from dano.fields import large_parts, largest_part, redistanced


def test_parts_by_their_size():
    picture = np.array([list("aa....b"), list("aa..d.b"), list("..c..d.")])
    occupied = picture != "."
    np.testing.assert_array_equal(largest_part(occupied), picture == "a")
    np.testing.assert_array_equal(
        large_parts(occupied, 0.3), (picture == "a") | (np.arange(7) == 6) & occupied
    )
    # Over corners c joins a; the rest is one part too.
    np.testing.assert_array_equal(largest_part(occupied, corners=True), np.isin(picture, list("ac")))
    np.testing.assert_array_equal(large_parts(occupied, 0.7, corners=True), occupied)
    for nothing in (largest_part(~occupied & occupied), large_parts(~occupied & occupied, 0.5)):
        assert nothing.shape == occupied.shape and not nothing.any()


@pytest.mark.parametrize("spacing", [0.05, np.array([0.05, 0.04, 0.06])])
def test_a_level_set_becomes_a_distance(spacing):
    step = np.broadcast_to(spacing, 3)
    x = np.stack(np.meshgrid(*(h * np.arange(int(2.4 / h) + 1) - 1.2 for h in step), indexing="ij"), axis=-1)
    radius = np.linalg.norm(x, axis=-1)
    distance = redistanced(radius**3 - 0.8**3, spacing)
    exact = radius - 0.8
    near = np.abs(exact) < step.max()
    assert np.abs(distance - exact)[near].max() < 0.04 * step.max()
    # Further away that of a point of the surface within half a cell.
    assert np.abs(distance - exact).max() < 0.5 * step.max()
    np.testing.assert_array_equal(distance > 0, exact > 0)
