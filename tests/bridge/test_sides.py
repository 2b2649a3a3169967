"""Contact from both sides and in time: what is small or fast does not pass; few contacts do what many do."""

import threading

import mujoco
import numpy as np
import pytest
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
    """Forces as areas times depths; of a share's moment only the part along its force is left out."""
    rows, touches = _touching(*attached(world("sphere")), [0, 0, -0.002, 1, 0.02, 0.01, 0])
    assert len(touches) > 50
    heads, shares = _shares(touches, 8)
    assert len(rows) == len(heads) == 8
    np.testing.assert_allclose(shares.sum(axis=0), touches["weight"], rtol=1e-12)
    for row, share in zip(rows, shares, strict=True):
        force, moment = _wrench(touches, share)
        size = float(np.linalg.norm(force))
        np.testing.assert_allclose(row[4:7], force / size, atol=1e-12)
        left = moment - np.cross(row[1:4], force)
        assert np.linalg.norm(np.cross(left, row[4:7])) < 1e-12 * size
        assert abs(left @ row[4:7]) < 1e-4 * size
        np.testing.assert_allclose(row[0], share @ touches["gap"] / share.sum(), rtol=1e-12)


@pytest.mark.parametrize("support", ["plane", "sphere", "box"])
def test_merged_contacts_do_not_jump(support: str):
    """A bunny sinks in: the shorter its way, the less changes what contacts do, stiffness times depth."""
    bridge, model, data = attached(world(support))
    top = model.geom_solimp[0, 1]
    changes = []
    for steps in (300, 1200, 4800):
        wrenches = []
        for z in np.linspace(0.0, -0.001, steps + 1):
            rows, _ = _touching(bridge, model, data, [0, 0, z, 1, 0.02, 0.01, 0])
            stiff = rows[:, 24] / (1 - rows[:, 24]) * (1 - top) / top
            forces = (-stiff * rows[:, 0])[:, None] * rows[:, 4:7]
            moments = np.cross(rows[:, 1:4], forces)
            wrenches.append([forces.sum(axis=0), moments.sum(axis=0)])
        changes.append(np.linalg.norm(np.diff(wrenches, axis=0), axis=2).max(axis=0))
    # Steps are a quarter as long each time; a jump would stay as it is.
    assert np.all(changes[1] < 0.6 * changes[0])
    assert np.all(changes[2] < 0.6 * changes[1])


def _touching(bridge, model, data, pose):
    """The contacts at a pose, and the samples that touch."""
    data.qpos[:] = pose
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_comVel(model, data)
    n, search = bridge._table(model).find(model, data)
    touches = search.touches
    touches[...] = 0
    search.launch()
    return search.rows[:n], touches[touches["weight"] > 0]


def _shares(touches, most):
    """Heads, and the part of the load of each sample that each of them has, by the rule of the docs."""
    loads, scores = touches["weight"], touches["weight"] * touches["precedence"]
    if len(scores) <= most:
        return np.arange(len(scores)), np.diag(loads)
    kept = np.maximum(0, 1 - np.sort(scores)[-most - 1] / scores)
    heads = np.flatnonzero(kept)
    x, n = touches["position"], touches["normal"]
    arms = x - loads @ x / loads.sum()
    near = 1.5 * (loads @ (arms**2).sum(axis=1) / loads.sum()) / most
    squares = ((x[heads][:, None] - x) ** 2).sum(axis=2)
    drawn = kept[heads][:, None] * (np.maximum(1 + n[heads] @ n.T, 1e-3) / (near + squares)) ** 2
    shares = (1 - kept) * drawn / drawn.sum(axis=0)
    shares[np.arange(len(heads)), heads] += kept[heads]
    return heads, shares * loads


def _wrench(touches, loads):
    forces = loads[:, None] * touches["normal"]
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
            n_contacts = 0
            for _ in range(200):
                mujoco.mj_step(model, data)
                n_contacts = max(n_contacts, data.ncon)
        ends.append((begin, data.qpos.copy(), n_contacts))
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


@pytest.mark.slow
def test_shipped_objects_go_by_their_names():
    bridge = Bridge(world("plane"))
    bridge.attach("toy", "soap", look=False)
    assert bridge.compile().body("toy").mass[0] == pytest.approx(0.15)


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
    with pytest.raises(ValueError, match="got 'trained_bunn'; did you mean 'trained_bunny'"):
        bridge.attach("toy", "trained_bunn")
