"""Objects in worlds of MuJoCo Warp, on a CPU: as in MuJoCo."""

import mujoco
import numpy as np
import pytest
from bridge.supports import gripper, thing, TYPES, world

from dano.mujoco import Bridge

mjw = pytest.importorskip("mujoco_warp", reason="worlds of MuJoCo Warp need mujoco-warp")


def made(bridge, model, qpos, qvel=None):
    """Worlds with a start each."""
    m = bridge.put_model(model)
    d = mjw.make_data(model, nworld=len(qpos))
    d.qpos.assign(np.asarray(qpos, np.float32))
    if qvel is not None:
        d.qvel.assign(np.asarray(qvel, np.float32))
    return m, d


def played(bridge, model, qpos, qvel, steps: int):
    """The same in MuJoCo, world by world."""
    found = []
    for at, speed in zip(qpos, qvel, strict=True):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = at, speed
        with bridge:
            mujoco.mj_step(model, data, steps)
        found.append(data.qpos.copy())
    return np.array(found)


@pytest.mark.parametrize("support", ["plane", "sphere", "mesh", "height field"])
def test_objects_come_to_rest_where_they_do_in_mujoco(support: str):
    spec, obj = world(support), thing("bunny")
    bridge = Bridge(spec)
    bridge.attach("toy", obj, look=False)
    model = bridge.compile()
    start = np.array([[0.01 * k, 0.0, 0.08 + 0.01 * k, 1, 0, 0, 0] for k in range(3)])
    m, d = made(bridge, model, start)
    for _ in range(500):
        mjw.step(m, d)
    expected = played(bridge, model, start, np.zeros((3, 6)), 500)
    np.testing.assert_allclose(d.qpos.numpy(), expected, atol=0.01 * obj.size)
    assert 3 <= int(d.nacon.numpy()[0]) <= 8 * 3


@pytest.mark.parametrize("speed", [1.0, 8.0])
@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_what_comes_fast_is_stopped_as_in_mujoco(speed: float, cone: str):
    spec, obj = world("plane", 0.005), thing("bunny")
    spec.option.cone = getattr(mujoco.mjtCone, f"mjCONE_{cone.upper()}")
    bridge = Bridge(spec)
    bridge.attach("toy", obj, look=False)
    model = bridge.compile()
    start = np.array([[0.0, 0.0, 0.1 + 0.007 * k, 1, 0, 0, 0] for k in range(4)])
    fall = np.tile([0.3, 0, -speed, 0, 0, 0], (4, 1))
    m, d = made(bridge, model, start, fall)
    points, lowest = np.asarray(obj.surface.points), np.inf
    for step in range(1, 31):
        mjw.step(m, d)
        mjw.kinematics(m, d)
        heights = d.xpos.numpy()[:, 1, 2:] + d.xmat.numpy()[:, 1, 2] @ points.T
        lowest = min(lowest, heights.min())
        if step == 10:
            expected = played(bridge, model, start, fall, 10)
            np.testing.assert_allclose(d.qpos.numpy()[:, :3], expected[:, :3], atol=0.01 * obj.size)
    assert lowest > -0.1 * obj.size


@pytest.mark.parametrize("timestep", [0.001, 0.005])
def test_fast_fingers_hold_the_bunny(timestep: float):
    speed = 7.7
    spec = gripper(timestep, speed)
    spec.body("toy").pos = [0, 0, 0.0]
    bridge = Bridge(spec)
    bridge.attach("toy", thing("bunny"), look=False)
    model = bridge.compile()
    # One world begins a little later than the other.
    start = np.repeat(model.qpos0[None], 2, axis=0)
    start[1, -2:] -= 0.003
    m, d = made(bridge, model, start, np.tile([0, 0, 0, 0, 0, 0, speed, speed], (2, 1)))
    d.ctrl.fill_(1.0)
    apart, left, right = [], model.body("left").id, model.body("right").id
    for _ in range(round(0.5 / timestep)):
        mjw.step(m, d)
        at = d.xpos.numpy()[:, :, 1]
        apart.append(at[:, right] - at[:, left] - 0.01)
    points = np.asarray(thing("bunny").surface.points)
    near = (np.abs(points[:, 2] - 0.05) < 0.03) & (np.abs(points[:, 0]) < 0.03)
    assert np.min(apart) > 0.5 * np.ptp(points[near, 1])
    assert np.abs(d.qvel.numpy()).max() < 0.05


def test_two_objects_collide_as_in_mujoco():
    spec = world(None)
    spec.option.gravity = [0, 0, 0]
    spec.worldbody.add_body(name="other", pos=[0.2, 0.01, 0]).add_freejoint()
    bridge = Bridge(spec)
    bridge.attach("toy", thing("bunny"), look=False)
    bridge.attach("other", thing("soap"), look=False)
    model = bridge.compile()
    start = np.tile(np.array([0, 0, 0, 1, 0, 0, 0, 0.14, 0.01, 0.02, 1, 0, 0, 0.0]), (2, 1))
    moving = np.array([[0.5, 0, 0, 0, 0, 0] + 6 * [0], [2.0, 0, 0, 0, 0, 0] + 6 * [0]])
    m, d = made(bridge, model, start, moving)
    for _ in range(100):
        mjw.step(m, d)
    expected = played(bridge, model, start, moving, 100)
    assert abs(expected[:, 7] - 0.14).min() > 0.01
    np.testing.assert_allclose(d.qpos.numpy(), expected, atol=0.002)


def test_each_world_has_its_own_friction():
    spec = world("plane")
    bridge = Bridge(spec)
    bridge.attach("toy", thing("soap"), look=False)
    model = bridge.compile()
    rest = played(bridge, model, model.qpos0[None], np.zeros((1, 6)), 500)
    m, d = made(bridge, model, np.repeat(rest, 2, axis=0))
    # The model is changed after a step, as in training.
    mjw.step(m, d)
    friction = np.repeat(m.geom_friction.numpy(), 2, axis=0)
    friction[0, :, 0], friction[1, :, 0] = 0.3, 0.6
    m.geom_friction = type(m.geom_friction)(friction, dtype=m.geom_friction.dtype)
    d.qvel.assign(np.tile(np.array([0.6, 0, 0, 0, 0, 0], np.float32), (2, 1)))
    for _ in range(250):
        mjw.step(m, d)
    way = d.qpos.numpy()[:, 0] - rest[0, 0]
    np.testing.assert_allclose(way, 0.6**2 / (2 * 9.81 * np.array([0.3, 0.6])), rtol=0.03)


def test_an_object_alone_falls():
    bridge = Bridge(world(None))
    bridge.attach("toy", thing("soap"), look=False)
    m, d = made(bridge, bridge.compile(), np.tile([0, 0, 1.0, 1, 0, 0, 0], (2, 1)))
    for _ in range(10):
        mjw.step(m, d)
    np.testing.assert_allclose(d.qpos.numpy()[:, 2], 1 - 9.81 * 0.002**2 * 55, rtol=1e-5)


def test_bad_input_is_named():
    spec = world("plane")
    bridge = Bridge(spec)
    bridge.attach("toy", thing("soap"), look=False)
    model = bridge.compile()
    model.opt.timestep = 0.1
    with pytest.raises(ValueError, match="timestep must be at most"):
        bridge.put_model(model)
    model.opt.timestep = 0.002
    other = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body name='a'/></worldbody></mujoco>")
    with pytest.raises(ValueError, match="body must be one of"):
        bridge.put_model(other)
    spec.worldbody.add_geom(type=TYPES.mjGEOM_MESH, meshname="dano:toy:hull", name="flat")
    spec.worldbody.geoms[-1].type = TYPES.mjGEOM_SDF
    with pytest.raises(ValueError, match="geom 'flat' must be a plane"):
        bridge.put_model(bridge.compile())


def test_outside_of_steps_the_stand_in_stays():
    spec = world("plane")
    bridge = Bridge(spec)
    bridge.attach("toy", thing("soap"), look=False)
    model = bridge.compile()
    before = model.geom_contype.copy()
    m = bridge.put_model(model)
    np.testing.assert_array_equal(model.geom_contype, before)
    hull = model.geom("dano:toy:hull").id
    assert before[hull] != 0 and m.geom_contype.numpy()[hull] == 0
