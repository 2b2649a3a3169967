"""Each engine drops the same box in the same way."""

import numpy as np
import pytest

import dano
from dano.comparison import compare
from dano.comparison._bodies import Drop, GRAVITY, Probes, Rigid
from dano.comparison._engines import MuJoCo, Own, PyBullet
from dano.exchange import convex_hull
from dano.maths import Pose
from dano.report import verdict

HALF, CENTRE, MASS = np.array([0.06, 0.05, 0.03]), np.array([0.02, -0.01, 0.04]), 0.7
TIMESTEP = 0.002
INERTIA = MASS / 3 * np.diag((HALF**2).sum() - HALF**2)
MARGIN = 1.5e-3  # of PyBullet, and a bit


@pytest.fixture(scope="module")
def thing() -> dano.NeuralObject:
    shape = dano.posed(dano.Box(tuple(HALF), edge=1e-3), Pose(tuple(CENTRE)))
    return dano.NeuralObject.from_field(shape, mass=MASS, n_samples=300, resolution=40)


@pytest.fixture(params=["dano", "mujoco", "pybullet"])
def engine(request, thing):
    if request.param == "dano":
        made = Own(thing, TIMESTEP)
    else:
        pytest.importorskip(request.param)
        corners = CENTRE + (2 * np.array(list(np.ndindex(2, 2, 2))) - 1) * HALF
        rigid = Rigid([convex_hull(corners)], MASS, CENTRE, INERTIA)
        made = (MuJoCo if request.param == "mujoco" else PyBullet)(rigid, TIMESTEP)
    yield made
    made.close()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_box_falls_freely_and_comes_to_rest(engine):
    q = np.array([0.9, 0.3, -0.2, 0.1])
    start = Drop(np.array([0.0, 0.0, 0.2]), q / np.linalg.norm(q), np.array([1.0, 2.0, -0.5]))
    path = engine.drop(start, 1000)
    com = path.of(CENTRE[None])[:, 0]
    t = TIMESTEP * np.arange(40)
    # Without contact the centre of mass falls straight down, however the body turns.
    np.testing.assert_allclose(com[:40, :2], com[:1, :2].repeat(40, 0), atol=1e-4)
    np.testing.assert_allclose(com[:40, 2], com[0, 2] - 0.5 * GRAVITY * t**2, atol=GRAVITY * TIMESTEP * t[-1])
    # The way a body that turns by ω does after a moment.
    turned = path.rotation[0].T @ path.rotation[5]
    spin = np.array([turned[2, 1], turned[0, 2], turned[1, 0]]) / (5 * TIMESTEP)
    np.testing.assert_allclose(spin, start.omega, atol=0.03)
    # On one of its faces.
    up = np.abs(path.rotation[-1][2])
    assert up.max() > np.cos(np.radians(1))
    assert com[-1, 2] == pytest.approx(HALF[np.argmax(up)], abs=MARGIN)
    assert 0 < path.step_time < 0.1


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_spheres_touch_where_they_reach_in(engine):
    radius = 0.01
    clearance = np.array([0.02, 0.004, -0.004])
    heights = CENTRE[2] + HALF[2] + radius + clearance
    centres = np.stack([np.full(3, CENTRE[0]), np.full(3, CENTRE[1]), heights], axis=1)
    found = engine.touching(Probes(centres, radius, clearance))
    np.testing.assert_array_equal(found, [False, False, True])


@pytest.fixture(scope="module")
def comparison(thing):
    pytest.importorskip("mujoco")
    truth = dano.posed(dano.Box(tuple(HALF), edge=1e-3), Pose(tuple(CENTRE)))
    return compare(thing, truth=truth, levels=[0.5, 0.9], drops=1)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_box_compared_with_itself(comparison):
    own, *meshes = comparison.rows
    assert (own.route, own.engine) == ("neural object", "dano")
    assert own.tilt < 1 and abs(own.gap) < 0.01 and own.phantom == 0 and own.motion_error < 0.2
    assert abs(own.volume_error) < 0.02
    assert [row.level for row in meshes[:4]] == [0.5, 0.5, 0.9, 0.9]
    for row in meshes:
        # Its hull is the box: nothing to be wrong about but the cells of the grid.
        assert row.open_edges == 0 and row.parts == 1
        assert row.tilt < 2 and abs(row.gap) < 0.03 and row.inertia_error < 0.1
        assert verdict(row)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"levels": [0.5, 7.0]}, "levels must lie between 0 and the largest density .*, got 7.0"),
        ({"levels": []}, "levels must name at least one"),
        ({"drops": 0}, "drops must lie between 1 and 100, got 0"),
    ],
)
def test_bad_options_are_named(thing, options, message):
    with pytest.raises(ValueError, match=message):
        compare(thing, **options)


def test_samples_alone_cannot_be_meshed():
    points = np.random.default_rng(0).normal(size=(20, 3))
    made = dano.NeuralObject.from_samples(
        points=points, density=np.ones(20), mass=1.0, com=np.zeros(3), inertia=np.eye(3)
    )
    with pytest.raises(ValueError, match="must have a density grid"):
        compare(made)
