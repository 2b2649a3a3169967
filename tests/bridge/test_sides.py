"""Contact from both sides and in time: what is small or fast does not pass; few contacts do what many do."""

import threading
from typing import Any

import mujoco
import numpy as np
import pytest
from bridge.kernels import merged
from bridge.supports import gripper, thing, TYPES, world

from dano.mujoco import Bridge


def attached(spec, name: str = "bunny", **options):
    bridge = Bridge(spec, **options)
    bridge.attach("toy", thing(name), look=False)
    model = bridge.compile()
    return bridge, model, mujoco.MjData(model)


@pytest.mark.parametrize(
    "speed, damping, timestep", [(7.7, 0.0, 0.001), (7.7, 0.0, 0.002), (7.7, 0.0, 0.005), (7.7, 40.0, 0.005)]
)
def test_fingers_hold_the_bunny(speed: float, damping: float, timestep: float):
    spec = gripper(timestep, speed, damping=damping)
    spec.body("toy").pos = [0, 0, 0.0]
    bridge, model, data = attached(spec)
    data.ctrl[:] = 1.0
    if damping == 0:
        data.qvel[-2:] = speed
    fastest, apart = 0.0, []
    points = np.asarray(thing("bunny").surface.points)
    level = np.abs(points[:, 2] - 0.05) < 0.03
    width = np.ptp(points[level & (np.abs(points[:, 0]) < 0.03), 1])
    with bridge:
        for _ in range(round(0.5 / timestep)):
            mujoco.mj_step(model, data)
            fastest = max(fastest, float(np.abs(data.qvel[-2:]).max()))
            apart.append(data.body("right").xpos[1] - data.body("left").xpos[1] - 0.01)
    assert fastest >= (speed if damping == 0 else 1.0)
    # Never have they come much closer than what is between them is thick, and there they stay.
    assert min(apart) > 0.5 * width
    assert np.abs(data.qvel).max() < 0.05
    assert data.body("left").xpos[1] < data.body("toy").xipos[1] < data.body("right").xpos[1]
    pushed = abs(float(data.qfrc_actuator[-1]))
    forces = np.zeros((data.ncon, 6))
    for i in range(data.ncon):
        mujoco.mj_contactForce(model, data, i, forces[i])
    assert forces[:, 0].sum() == pytest.approx(2 * pushed, rel=0.05)


@pytest.mark.parametrize("radius", [0.001, 0.002, 0.004])
@pytest.mark.parametrize("timestep", [0.001, 0.005])
def test_small_balls_rest_on_few_samples(radius: float, timestep: float):
    """On a bar of 500 samples that lie 5 mm apart."""
    spec = world("plane", timestep)
    spec.body("toy").pos = [0, 0, 0.02]
    places = [(x, y) for x in (-0.03, 0.001, 0.029) for y in (-0.011, 0.003)]
    for k, (x, y) in enumerate(places):
        ball = spec.worldbody.add_body(name=f"ball {k}", pos=[x, y, 0.09])
        ball.add_freejoint()
        ball.add_geom(
            type=TYPES.mjGEOM_SPHERE, size=[radius, 0, 0], density=2000, condim=6, friction=[0.5, 0.01, 0.001]
        )
    bridge, model, data = attached(spec, "bar")
    lowest = np.inf
    with bridge:
        for _ in range(round(0.6 / timestep)):
            mujoco.mj_step(model, data)
            lowest = min(lowest, *(data.body(f"ball {k}").xpos[2] for k in range(len(places))))
    # The bar's top is at 40 mm; balls may sink in by a quarter of their radius, and rounding by the grid.
    assert lowest > 0.04 + 0.5 * radius - 0.0005


@pytest.mark.parametrize("kind", ["capsule", "cylinder", "ellipsoid", "box", "mesh"])
def test_small_geoms_of_all_types_rest_on_few_samples(kind: str):
    spec = world("plane", 0.002)
    spec.body("toy").pos = [0, 0, 0.02]
    other = spec.worldbody.add_body(name="other", pos=[0.011, 0.003, 0.06])
    other.add_freejoint()
    size = {"capsule": [0.0015, 0.002, 0], "cylinder": [0.002, 0.0015, 0]}.get(kind, [0.0015, 0.002, 0.0018])
    if kind == "mesh":
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size
        spec.add_mesh(name="block", uservert=corners.ravel().tolist())
        other.add_geom(type=TYPES.mjGEOM_MESH, meshname="block", density=2000)
    else:
        other.add_geom(type=getattr(TYPES, f"mjGEOM_{kind.upper()}"), size=size, density=2000)
    bridge, model, data = attached(spec, "bar")
    with bridge:
        mujoco.mj_step(model, data, 400)
    assert 0.04 < data.body("other").xpos[2] < 0.045


def test_merged_contacts_have_the_wrench_of_all():
    """Forces as areas times depths; of a cell's moment only the part along its force is left out."""
    spec = world("sphere")
    bridge, model, data = attached(spec)
    data.qpos[:] = [0, 0, -0.002, 1, 0.02, 0.01, 0]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_comVel(model, data)
    table = bridge._table(model)
    assert table is not None
    n, search = table.find(model, data)
    room = search.arguments[-1].touches
    touches = room.numpy()
    touches = touches[touches["weight"] > 0]
    assert len(touches) > 50
    ends = _cells(touches, 8)
    assert n == len(ends) - 1
    assert n >= 5
    few: Any = merged(room, ends)
    np.testing.assert_allclose(few["position"], search.rows[:n, 1:4], atol=1e-12)
    every, some = (_wrench(each) for each in (touches, few))
    np.testing.assert_allclose(some[0], every[0], rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose(some[1], every[1], atol=1e-4 * float(np.linalg.norm(every[0])))
    for first, end, one in zip(ends, ends[1:], few, strict=False):
        own, single = _wrench(touches[first:end]), _wrench(one[None])
        left = own[1] - single[1]
        assert np.linalg.norm(np.cross(left, one["normal"])) < 1e-12 * np.linalg.norm(own[0])


def _cells(touches, most):
    """Where the samples of contacts end: heavy cells at the finest level before there are too many."""
    light = 0.16 * touches["weight"].sum() / most

    def heavy(level):
        _, first, cell = np.unique(touches["code"] >> level, return_index=True, return_inverse=True)
        return first[np.bincount(cell.ravel(), touches["weight"]) >= light]

    level = 24
    while level > 0 and len(heavy(level - 1)) <= most:
        level -= 1
    return np.array([0, *heavy(level)[1:], len(touches)], np.int32)


def _wrench(touches):
    forces = touches["weight"][:, None] * touches["normal"]
    return forces.sum(axis=0), np.cross(touches["position"], forces).sum(axis=0)


def test_few_contacts_carry_what_many_do():
    """A bunny slides and turns on the plane until it stops."""
    ends = []
    for most in (8, 64):
        spec = world("plane")
        spec.body("toy").pos = [0, 0, 0.0]
        bridge, model, data = attached(spec, most=most)
        model.geom_friction[:, 0] = 0.3
        with bridge:
            mujoco.mj_step(model, data, 300)
            begin = data.qpos.copy()
            data.qvel[:] = [0.4, 0.1, 0, 0, 0, 4.0]
            mujoco.mj_step(model, data, 200)
        ends.append((begin, data.qpos.copy(), data.ncon))
    (_, few, n_few), (begin, many, n_many) = ends
    assert n_few <= 8 < n_many
    way, turn = (float(np.linalg.norm((many - begin)[part])) for part in (slice(0, 3), slice(3, 7)))
    assert way > 0.01
    assert turn > 0.05
    np.testing.assert_allclose(few[:3], many[:3], atol=0.05 * way)
    np.testing.assert_allclose(few[3:], many[3:], atol=0.05 * turn)


def test_rollouts_in_threads_are_those_of_one():
    spec = world("plane", 0.005)
    spec.body("toy").pos = [0, 0, 0.03]
    bridge, model, _ = attached(spec)
    starts = [np.array([0, 0, 0.03 + 0.01 * k, 1, 0.1 * k, 0, 0]) for k in range(4)]

    def run(start, into):
        data = mujoco.MjData(model)
        data.qpos[:] = start
        mujoco.mj_step(model, data, 60)
        into.append((tuple(start), data.qpos.copy()))

    with bridge:
        alone, together = [], []
        for start in starts:
            run(start, alone)
        threads = [threading.Thread(target=run, args=(start, together)) for start in starts]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    together = dict(together)
    for start, end in alone:
        np.testing.assert_array_equal(end, together[start])


def test_outside_of_the_block_the_hull_stands_in(tmp_path):
    thing("bar").save(tmp_path / "bar.dano")
    for compiled_by_the_bridge in (True, False):
        spec = world("plane")
        bridge = Bridge(spec)
        bridge.attach("toy", tmp_path / "bar.dano", look=False)
        model = bridge.compile() if compiled_by_the_bridge else spec.compile()
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, 600)
        assert data.body("toy").xpos[2] == pytest.approx(0.02, abs=1e-3)
        with bridge:
            mujoco.mj_step(model, data)
            inside = data.ncon
            assert all(int(data.contact[k].geom[0]) == 0 for k in range(inside))
            assert 4 <= inside <= 8
            mujoco.mj_step(model, data, 400)
            assert data.body("toy").xpos[2] == pytest.approx(0.02, abs=1e-3)
        mujoco.mj_step(model, data, 400)
        assert data.body("toy").xpos[2] == pytest.approx(0.02, abs=1e-3)


def test_a_size_that_changes_is_followed():
    spec = world("box")
    spec.body("toy").pos = [0, 0, 0.021]
    bridge, model, data = attached(spec, "bar")
    with bridge:
        mujoco.mj_step(model, data, 200)
        before = data.body("toy").xpos[2]
        model.geom_size[0, 2] = 0.09
        mujoco.mj_step(model, data, 400)
    assert data.body("toy").xpos[2] - before == pytest.approx(-0.01, abs=1e-4)


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="most must be"):
        Bridge(world("plane"), most=1)
    bridge = Bridge(world("plane"))
    with pytest.raises((ValueError, FileNotFoundError), match=r"nowhere\.dano"):
        bridge.attach("toy", "nowhere.dano")
