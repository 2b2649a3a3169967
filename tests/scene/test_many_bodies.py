"""Scenes of many bodies: no program of their own, pairs in arrays, geometries measured once."""

import logging

import jax
import numpy as np

import dano
from dano.scene import pressing_pairs


def pile(n: int) -> dano.Scene:
    side = int(np.ceil(n ** (1 / 3)))
    places = [(0.05 * (i % side), 0.05 * (i // side % side), 0.03 + 0.05 * (i // side**2)) for i in range(n)]
    boxes = [
        dano.Body(f"box {i}", dano.Box((0.02, 0.02, 0.02)), mass=0.1, position=place)
        for i, place in enumerate(places)
    ]
    return dano.Scene.create([*boxes, dano.Body("floor", dano.HalfSpace(), fixed=True)], timestep=0.005)


def test_another_number_of_bodies_compiles_nothing(caplog):
    scene = pile(24)
    dano.simulate(scene, n_steps=2)
    another = pile(31)
    with caplog.at_level(logging.DEBUG), jax.log_compiles():
        run = dano.simulate(another, n_steps=2)
    assert bool(np.all(run.converged))
    # Nothing but operations on the numbers of a state.
    assert not [r for r in caplog.records if "Compiling" in r.getMessage() and "prepared" in r.getMessage()]
    many = [r for r in caplog.records if r.getMessage().startswith("Compiling")]
    assert len(many) <= 2


def test_tables_by_numpy_are_those_that_jax_makes():
    scene = pile(24)
    engine = dano.VariationalEngine()
    assert engine.prepares_by_numpy(scene)
    found, whole = engine.prepare(scene), []

    def rows_of(scene):
        tables = engine.prepare(scene).tables
        whole.append(tables.whole)
        return tables.rows

    made = jax.jit(rows_of)(scene)
    assert bool(found.sound)
    # Pairs of equal bodies share their numbers where these are known.
    of_pairs = {"scene.materials": 2, "scene.pairs": 3}
    for place, rows in made.items():
        mine = found.tables.rows[place]
        if place in of_pairs:
            mine, rows = (
                np.asarray(x)[w.arrays["scene.pair_index"][:, of_pairs[place]]]
                for x, w in ((mine, found.tables.whole), (rows, whole[0]))
            )
        np.testing.assert_allclose(mine, rows, rtol=1e-14, atol=1e-15, err_msg=place)


def test_shapes_with_the_same_numbers_share_their_samples():
    scene = pile(24)
    assert set(scene.sampled[:24]) == {0}
    rows = dano.VariationalEngine().prepare(scene).tables.rows["scene.samples"]
    surface = scene.bodies[0].surface
    assert surface is not None and len(rows) == surface.points.shape[1]


def test_pairs_are_those_of_a_loop():
    scene = pile(24)
    assert scene.others is not None
    pairs = scene.others.pairs
    assert list(pairs) == [(i, j) for i in range(25) for j in range(i + 1, 25)]
    assert pairs[3] == (0, 4) and list(pairs[1:3]) == [(0, 2), (0, 3)]
    assert pairs == pile(24).others.pairs and hash(pairs) == hash(pile(24).others.pairs)  # pyright: ignore
    pressing = pressing_pairs(scene.bodies, scene.point_pairs)
    # Boxes press on each other both ways, the floor has no samples.
    expected = []
    for k, (i, j) in enumerate(pairs):
        expected += [(i, j, k)] if j == 24 else [(i, j, k), (j, i, k)]
    np.testing.assert_array_equal(pressing, expected)
