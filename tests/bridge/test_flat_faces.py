"""Flat faces of objects in MuJoCo: exact planes, stacks that stand, balls that leave straight."""

import mujoco
import numpy as np
import pytest

import dano
from dano.mujoco import Bridge
from dano.mujoco._things import faces_of

HALF = np.array([0.05, 0.02, 0.02])


@pytest.fixture(scope="module")
def bar():
    return dano.NeuralObject.from_field(
        dano.Box(tuple(HALF)), mass=0.16, mass_model="solid", n_samples=2000, resolution=64
    )


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
