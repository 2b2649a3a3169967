"""Flat faces of objects in MuJoCo: exact planes, stacks that stand, balls that leave straight."""

import mujoco
import numpy as np
import pytest

import dano
from dano.mujoco import Bridge
from dano.mujoco._things import corners_of, faces_of
from dano.scene_file import load_asset

HALF = np.array([0.05, 0.02, 0.02])


@pytest.fixture(scope="module")
def bar():
    return dano.NeuralObject.from_field(
        dano.Box(tuple(HALF)), mass=0.16, mass_model="solid", n_samples=2000, resolution=64
    )


@pytest.fixture(scope="module")
def bunny_object():
    return load_asset("trained_bunny")


def model_of(bodies, timestep=0.002):
    """A plane, and objects at places above it."""
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(1, 1, 0.1))
    bridge = Bridge(spec)
    for k, (_, place) in enumerate(bodies):
        spec.worldbody.add_body(name=f"body {k}", pos=place).add_freejoint()
    for k, (obj, _) in enumerate(bodies):
        bridge.attach(f"body {k}", obj, look=False)
    return bridge, bridge.compile()


def test_faces_of_a_box_are_its_own(bar):
    faces = faces_of(bar).faces
    assert len(faces) == 6
    for face in faces:
        axis = int(np.argmax(np.abs(face.plane[:3])))
        exact = np.sign(face.plane[axis]) * np.eye(3)[axis]
        np.testing.assert_allclose(face.plane[:3], exact, atol=3e-4)
        assert -face.plane[3] == pytest.approx(HALF[axis], abs=1e-5)
        # Within the edges on all four sides, but for corners that are cut, and outside beyond them.
        for other in {0, 1, 2} - {axis}:
            for share, inside in ((0.99, True), (1.01, False)):
                place = HALF[axis] * exact + share * HALF[other] * np.eye(3)[other]
                beyond = (face.edges[:, :3] @ place + face.edges[:, 3]).max()
                assert (beyond < 0) == inside


def test_what_is_round_has_no_faces():
    ball = dano.NeuralObject.from_field(dano.Sphere(0.02), mass=0.1, n_samples=1000, resolution=32)
    found = faces_of(ball)
    assert not found.faces and found.slack == 0.0 and found.band(0.02) == 0.0


def test_a_face_is_exact_up_to_its_edges(bar):
    """Bars 50 µm in each other: so deep, and upright, at every contact."""
    depth = 5e-5
    bridge, model = model_of([(bar, (0, 0, 0.02)), (bar, (0.003, 0.002, 0.06 - depth))])
    data = mujoco.MjData(model)
    with bridge:
        mujoco.mj_forward(model, data)
    between = [c for c in data.contact if 0 not in model.geom_bodyid[[c.geom1, c.geom2]]]
    assert between
    for contact in between:
        assert contact.dist == pytest.approx(-depth, abs=1e-5)
        assert np.abs(contact.frame[:2]).max() < 1e-4


def test_stacked_bars_do_not_creep(bar):
    """After they have come to rest; MuJoCo's own boxes do not, either."""
    bridge, model = model_of([(bar, (0, 0, 0.02)), (bar, (0, 0, 0.0605))])
    data = mujoco.MjData(model)
    with bridge:
        mujoco.mj_step(model, data, 500)
        before = data.qpos.copy()
        mujoco.mj_step(model, data, 250)
    # 10 µm in 20 s.
    assert np.abs(data.qpos - before)[[0, 1, 7, 8]].max() < 0.5 * 5e-7


def test_a_ball_leaves_a_face_straight(bar):
    """As fast as MuJoCo's own ball leaves its own box, and without a speed sideways."""
    ball = dano.NeuralObject.from_field(dano.Sphere(0.005), mass=0.004, mass_model="solid", n_samples=2000)
    bridge, model = model_of([(bar, (0, 0, 0.02)), (ball, (0.0123, 0.0037, 0.1))], 0.001)
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.001
    body = spec.worldbody.add_body(name="ball", pos=(0.0123, 0.0037, 0.1))
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(0.005, 0, 0), mass=0.004)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=HALF, pos=(0, 0, 0.02))
    own = spec.compile()
    other = mujoco.MjData(own)
    data = mujoco.MjData(model)
    up = 0.0
    for _ in range(150):
        mujoco.mj_step(own, other)
        up = max(up, other.qvel[2])
    found = []
    with bridge:
        for _ in range(150):
            mujoco.mj_step(model, data)
            found.append(data.qvel[6:9].copy())
    velocity = np.array(found)
    down = -velocity[:, 2].min()
    assert down > 1.0
    assert np.linalg.norm(velocity[:, :2], axis=1).max() < 0.01 * down
    assert velocity[:, 2].max() == pytest.approx(up, abs=0.02 * down)


def test_corners_of_a_box_are_its_own(bar):
    corners = corners_of(bar, faces_of(bar))
    assert corners is not None
    there = np.linalg.norm(corners.vectors, axis=1) > 0
    points, vectors = corners.points[there], corners.vectors[there]
    assert len(points) == 8
    np.testing.assert_allclose(np.abs(points), np.tile(HALF, (8, 1)), atol=2e-5)
    assert len({tuple(signs) for signs in np.sign(points).tolist()}) == 8
    # Each has a quarter of its three faces, which look along the axes.
    quarters = HALF[[1, 2, 0]] * HALF[[2, 0, 1]]
    np.testing.assert_allclose(vectors * np.sign(points), np.tile(quarters, (8, 1)), rtol=0.1)


@pytest.mark.parametrize(
    "shape",
    [dano.Sphere(0.02), dano.Cylinder(0.02, 0.03), dano.Capsule(0.02, 0.03)],
    ids=lambda x: type(x).__name__,
)
def test_what_is_round_has_no_corners(shape):
    obj = dano.NeuralObject.from_field(shape, mass=0.1, n_samples=1000, resolution=48)
    assert corners_of(obj, faces_of(obj)) is None


def test_a_bar_touches_a_plane_as_a_box_of_mujoco_does(bar):
    """With its four corners; on end it stands on a slope until its weight is above an edge."""
    bridge, model = model_of([(bar, (0, 0, 0.0501))])
    model.geom_friction[:, 0] = 2.0
    model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    for share, stands in ((0.95, True), (1.03, False)):
        data = mujoco.MjData(model)
        data.qpos[3:7] = (0.5**0.5, 0, 0.5**0.5, 0)
        slope = share * HALF[2] / HALF[0]
        model.opt.gravity = (9.81 * slope, 0, -9.81)
        with bridge:
            mujoco.mj_step(model, data, 1)
            assert data.ncon in (0, 4)
            mujoco.mj_step(model, data, 1500)
        upright = abs(data.body("body 0").xmat.reshape(3, 3)[2, 0])
        assert (upright > 0.99) == stands


def test_boxes_around_parts_hide_no_contact(bar):
    """Two bars at random: contacts where one reaches into the other, by the exact distance of a box."""
    bridge, model = model_of([(bar, (0, 0, 1)), (bar, (0, 0, 2))])
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    axis = [np.linspace(-x, x, 21) for x in HALF]
    grid = np.stack(np.meshgrid(*axis, indexing="ij"), axis=-1).reshape(-1, 3)
    points = grid[np.isclose(np.abs(grid), HALF).any(axis=1)]
    found = {True: 0, False: 0}
    with bridge:
        for _ in range(150):
            data.qpos[7:10] = data.qpos[:3] + rng.uniform(-0.09, 0.09, 3)
            data.qpos[[*range(3, 7), *range(10, 14)]] = rng.normal(size=8)
            mujoco.mj_forward(model, data)
            rotations, places = data.xmat[1:].reshape(2, 3, 3), data.xpos[1:]
            depths = []
            for k in (0, 1):
                x = (points @ rotations[k].T + places[k] - places[1 - k]) @ rotations[1 - k]
                depths.append(-(np.abs(x) - HALF).max(axis=1).min())
            if max(depths) > 1e-3:
                assert data.ncon > 0
                found[True] += 1
            elif max(depths) < -5e-3:
                # Edges may cross between points, which are 5 mm apart.
                assert data.ncon == 0
                found[False] += 1
    assert min(found.values()) > 20


@pytest.mark.parametrize("most", [4, 8, 9, 20])
def test_heads_in_several_groups_hold_what_lies_on_them(bunny_object, most):
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(1, 1, 0.1))
    spec.worldbody.add_body(name="toy", pos=(0, 0, 0.065)).add_freejoint()
    bridge = Bridge(spec, most=most)
    bridge.attach("toy", bunny_object, look=False)
    model = bridge.compile()
    data = mujoco.MjData(model)
    with bridge:
        mujoco.mj_step(model, data, 2000)
        before = data.qpos.copy()
        mujoco.mj_step(model, data, 500)
    assert 3 <= data.ncon <= most
    np.testing.assert_allclose(data.qpos, before, atol=1e-6)
    force, middle = np.zeros(6), np.zeros(3)
    total = 0.0
    for k in range(data.ncon):
        mujoco.mj_contactForce(model, data, k, force)
        total += force[0]
        middle += force[0] * data.contact[k].pos
    weight = float(bunny_object.mass.mass) * 9.81
    assert total == pytest.approx(weight, rel=1e-3)
    np.testing.assert_allclose((middle / total)[:2], data.body("toy").xipos[:2], atol=2e-5)
