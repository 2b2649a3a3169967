"""Neural objects in a user's MuJoCo model."""

import os
import resource

import mujoco
import numpy as np
import pytest
from bridge.kernels import mixed
from bridge.supports import SUPPORTS, thing, TYPES, world

from dano.mujoco import Bridge

GRAVITY = 9.81


def compiled(support: str | None, name: str = "ball", timestep: float = 0.002):
    spec = world(support, timestep)
    bridge = Bridge(spec)
    bridge.attach("toy", thing(name), look=False)
    model = bridge.compile()
    return bridge, model, mujoco.MjData(model)


def settled(support: str, name: str, timestep: float, seconds: float = 4.0):
    """Largest speed and creep of the centre of mass over half a second after a while [m/s]; the data."""
    bridge, model, data = compiled(support, name, timestep)
    body = model.body("toy").id
    speeds = np.zeros(6)
    with bridge:
        mujoco.mj_step(model, data, round(seconds / timestep))
        start, fastest = data.xipos[body].copy(), 0.0
        for _ in range(round(0.5 / timestep)):
            mujoco.mj_step(model, data)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, speeds, 0)
            fastest = max(fastest, float(np.linalg.norm(speeds[3:])))
    return fastest, np.linalg.norm(data.xipos[body] - start) / 0.5, model, data


CASES = [("bunny", support) for support in SUPPORTS] + [("soap", "plane")]
SLOW = [pytest.param("soap", support, marks=pytest.mark.slow) for support in SUPPORTS if support != "plane"]


@pytest.mark.parametrize("name, support", CASES + SLOW)
def test_objects_rest_on_every_geom(name: str, support: str):
    speed, creep, model, data = settled(support, name, 0.01, 3.0)
    assert speed < 1e-4
    assert creep < 1e-4
    assert not any(warning.number for warning in data.warning)
    assert data.body("toy").xpos[2] > -0.03


@pytest.mark.parametrize("timestep", [0.001, 0.002, 0.005])
def test_rest_is_quiet_at_every_timestep(timestep: float):
    speed, creep, model, data = settled("plane", "bunny", timestep, 1.5)
    assert speed < 1e-6
    assert creep < 1e-6
    forces = np.zeros((data.ncon, 6))
    for i in range(data.ncon):
        mujoco.mj_contactForce(model, data, i, forces[i])
    assert forces[:, 0].sum() == pytest.approx(GRAVITY * model.body("toy").mass[0], rel=1e-4)


def test_a_ball_slides_as_coulomb_says_and_stops():
    bridge, model, data = compiled("plane", "soap")
    model.geom_friction[:, 0] = 0.3
    with bridge:
        mujoco.mj_step(model, data, 500)
        start, speed = data.body("toy").xipos[0], 0.6
        data.qvel[0] = speed
        mujoco.mj_step(model, data, 250)
    assert data.body("toy").xipos[0] - start == pytest.approx(speed**2 / (2 * 0.3 * GRAVITY), rel=0.02)


def test_parameters_are_mixed_as_by_mujoco():
    random = np.random.default_rng(0)
    for priorities in ((0, 0), (1, 0), (0, 2)):
        spec = mujoco.MjSpec()
        for k in range(2):
            body = spec.worldbody.add_body(pos=[0, 0, 0.15 * k])
            body.add_freejoint()
            body.add_geom(
                type=TYPES.mjGEOM_SPHERE,
                size=[0.1, 0, 0],
                friction=random.uniform(0.1, 1, 3),
                solref=[random.uniform(0.01, 0.05), random.uniform(0.5, 1.5)],
                solimp=[0.5 + 0.1 * k, 0.95, 0.001 * (1 + k), 0.5, 2],
                solmix=random.uniform(0.2, 3),
                condim=(3, 4)[k],
                priority=priorities[k],
            )
        model = spec.compile()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        contact, ours = data.contact[0], mixed(model)
        assert ours["dim"] == contact.dim
        for name in ("friction", "solref", "solimp"):
            np.testing.assert_allclose(ours[name], getattr(contact, name), rtol=1e-12)


def test_margins_and_gaps_are_those_of_mujocos_own_contacts():
    spec = world("plane")
    spec.geom("support").margin, spec.geom("support").gap = 0.01, 0.004
    toy = next(body for body in spec.bodies if body.name == "toy")
    toy.add_geom(type=TYPES.mjGEOM_SPHERE, size=[0.05, 0, 0], margin=0.002, gap=0.001, mass=0)
    own = spec.worldbody.add_body(name="own", pos=[1, 0, 0])
    own.add_freejoint()
    own.add_geom(type=TYPES.mjGEOM_SPHERE, size=[0.05, 0, 0], margin=0.002, gap=0.001)
    bridge = Bridge(spec)
    bridge.attach("toy", thing("ball"), look=False)
    model = bridge.compile()
    data = mujoco.MjData(model)
    seen = set()
    for height in (0.005, 0.009, 0.011, 0.0135, 0.016):
        data.qpos[2] = data.qpos[9] = 0.05 + height
        data.qpos[7], data.qvel[:] = 1.0, 0
        with bridge:
            mujoco.mj_forward(model, data)
        listed = [contact for contact in data.contact if contact.geom[1] == model.body("own").geomadr[0]]
        ours = [contact for contact in data.contact if contact.geom[1] == model.body("toy").geomadr[0]]
        assert bool(listed) == bool(ours)
        for contact in listed:
            nearest = min(ours, key=lambda each: each.dist)
            assert nearest.includemargin == pytest.approx(contact.includemargin)
            assert nearest.exclude == contact.exclude
        seen.add(listed[0].exclude if listed else None)
    assert {0, 1} <= seen


def test_two_objects_collide_and_keep_their_momentum():
    spec = world(None)
    spec.option.gravity = [0, 0, 0]
    other = spec.worldbody.add_body(name="other", pos=[0.25, 0.01, 0.07])
    other.add_freejoint()
    bridge = Bridge(spec)
    bridge.attach("toy", thing("bunny"), look=False)
    bridge.attach("other", thing("ball"), look=False)
    model = bridge.compile()
    data = mujoco.MjData(model)
    data.qvel[6] = -1.0
    masses = model.body_mass[1:]

    def momentum():
        speeds = []
        for body in (1, 2):
            six = np.zeros(6)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, six, 0)
            speeds.append(six[3:].copy())
        return masses @ np.array(speeds)

    with bridge:
        mujoco.mj_forward(model, data)
        before, touched = momentum(), 0
        for _ in range(250):
            mujoco.mj_step(model, data)
            touched = max(touched, data.ncon)
        mujoco.mj_forward(model, data)
    assert touched > 0
    assert data.qvel[0] < -0.1
    np.testing.assert_allclose(momentum(), before, atol=2e-3 * masses[1])


def test_an_object_in_a_turned_frame_is_the_same_object():
    ends = []
    for position, orientation in (((0, 0, 0), (1, 0, 0, 0)), ((0.1, 0.2, 0.3), (0.5, 0.5, -0.5, 0.5))):
        spec = world("plane")
        bridge = Bridge(spec)
        bridge.attach("toy", thing("bunny"), position=position, orientation=orientation, look=False)
        model = bridge.compile()
        data = mujoco.MjData(model)
        # Undo the pose of the object in its body.
        back, turn = np.zeros(3), np.zeros(4)
        mujoco.mju_negPose(back, turn, np.array(position, float), np.array(orientation, float))
        data.qpos[:3], data.qpos[3:] = back + [0, 0, 0.05], turn
        with bridge:
            mujoco.mj_step(model, data, 60)
        assert data.ncon > 0
        ends.append(data.xipos[1].copy())
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-4)


def test_a_compiled_model_gets_the_same_contacts():
    spec = world("plane")
    spec.bodies[1].add_geom(
        type=TYPES.mjGEOM_BOX, size=[0.02, 0.01, 0.03], pos=[0.01, 0, 0.02], quat=[1, 0.3, 0, 0]
    )
    model = spec.compile()
    bridge = Bridge(model)
    bridge.attach("toy", thing("bunny"))
    data = mujoco.MjData(model)
    reference, other, same = compiled("plane", "bunny")
    with bridge, reference:
        mujoco.mj_step(model, data, 200)
        mujoco.mj_step(other, same, 200)
    assert data.ncon == same.ncon
    np.testing.assert_allclose(data.qpos, same.qpos, atol=1e-9)


def test_a_reset_and_a_second_data_start_afresh():
    bridge, model, data = compiled("plane", "soap")
    ends = []
    with bridge:
        for fresh in (False, False, True):
            if fresh:
                data = mujoco.MjData(model)
            mujoco.mj_resetData(model, data)
            mujoco.mj_step(model, data, 150)
            ends.append(data.qpos.copy())
    np.testing.assert_array_equal(ends[0], ends[1])
    np.testing.assert_array_equal(ends[0], ends[2])


def test_a_recompiled_spec_is_followed():
    spec = world("plane")
    bridge = Bridge(spec)
    bridge.attach("toy", thing("ball"), look=False)
    first = bridge.compile()
    data = mujoco.MjData(first)
    with bridge:
        mujoco.mj_step(first, data, 400)
        on_plane = data.body("toy").xpos[2]
        # A table below it and another body before it: all indices change.
        spec.worldbody.add_geom(type=TYPES.mjGEOM_BOX, size=[0.3, 0.3, 0.1])
        spec.worldbody.add_body(name="more", pos=[1, 0, 0.3]).add_geom(
            type=TYPES.mjGEOM_SPHERE, size=[0.1, 0, 0]
        )
        spec.bodies[1].pos = [0, 0, 0.2]
        second = bridge.compile()
        data = mujoco.MjData(second)
        mujoco.mj_step(second, data, 400)
    assert data.body("toy").xpos[2] - on_plane == pytest.approx(0.1, abs=1e-4)
    spec.delete(spec.body("toy"))
    with pytest.raises(ValueError, match="body must be one of .*got 'toy'"):
        bridge.compile()
    third = spec.compile()
    with bridge, pytest.raises(ValueError, match="got 'toy'"):
        mujoco.mj_step(third, mujoco.MjData(third))


def test_other_models_and_callbacks_are_left_alone():
    bridge, model, data = compiled("plane", "ball")
    stranger = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
    )
    seen = []

    def users(model, data):
        seen.append(model)

    mujoco.set_mjcb_passive(users)
    try:
        with bridge, bridge:
            mujoco.mj_step(model, data)
            mujoco.mj_step(stranger, mujoco.MjData(stranger))
        assert mujoco.get_mjcb_passive() is users
        assert len(seen) == 2
    finally:
        mujoco.set_mjcb_passive(None)


def test_differences_of_mujoco_see_each_contact_once():
    bridge, model, data = compiled("plane", "bunny")
    with bridge:
        mujoco.mj_step(model, data, 500)
        n = data.ncon
        A = np.zeros((2 * model.nv, 2 * model.nv))
        mujoco.mjd_transitionFD(model, data, 1e-7, True, A, None, None, None)
        assert data.ncon == n
        # The body is held: what it is given across the floor or down is gone within the step.
    assert n > 2
    assert np.abs(A[6:9, 6:9]).max() < 0.9


def test_bad_input_is_named():
    spec = world("plane")
    bridge = Bridge(spec)
    with pytest.raises(ValueError, match=r"body must be one of \['toy'\], got 'toyy'; did you mean 'toy'"):
        bridge.attach("toyy", thing("ball"))
    with pytest.raises(ValueError, match="attach one before"):
        bridge.__enter__()
    with pytest.raises(ValueError, match="orientation must not be zero"):
        bridge.attach("toy", thing("ball"), orientation=(0, 0, 0, 0))
    bridge.attach("toy", thing("ball"), look=False)
    with pytest.raises(ValueError, match="'toy' twice"):
        bridge.attach("toy", thing("ball"))
    with pytest.raises(ValueError, match=r"target must be an mujoco.MjSpec"):
        Bridge("scene.xml")
    bare = world(None)
    body = bare.bodies[1]
    body.mass, body.inertia, body.explicitinertial = 1.0, [1, 1, 1], True
    with pytest.raises(ValueError, match="must have a geom"):
        Bridge(bare.compile()).attach("toy", thing("ball"))
    symmetric = "<body name='toy'><freejoint/><geom type='box' size='.1 .2 .3'/></body>"
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{symmetric}</worldbody></mujoco>")
    with pytest.raises(ValueError, match="attach to its MjSpec instead"):
        Bridge(model).attach("toy", thing("bunny"))


def test_robot_files_keep_what_stands_for_an_object():
    """MuJoCo discards what is only seen when it compiles them."""
    link = "<inertial><mass value='1'/><inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'/></inertial>"
    spec = mujoco.MjSpec.from_string(f"<robot name='r'><link name='base'>{link}</link></robot>")
    spec.worldbody.add_geom(**SUPPORTS["plane"](spec))
    spec.worldbody.add_body(name="toy", pos=[0, 0, 0.05]).add_freejoint()
    bridge = Bridge(spec)
    bridge.attach("toy", thing("ball"), look=False)
    model = bridge.compile()
    data = mujoco.MjData(model)
    with bridge:
        mujoco.mj_step(model, data, 100)
    assert data.ncon > 0


def test_what_cannot_work_is_said_in_the_first_step():
    bridge, model, data = compiled("plane", "ball")
    with bridge:
        model.opt.timestep = 0.05
        with pytest.raises(ValueError, match=r"timestep must be at most 0.032 s.*got 0.05"):
            mujoco.mj_step(model, data)
        model.opt.timestep = 0.002
        mujoco.mj_step(model, data)
    bits = mujoco.mjtDisableBit
    for name, bit, message in (
        ("disableflags", int(bits.mjDSBL_SPRING) | int(bits.mjDSBL_DAMPER), "springs and dampers"),
        ("enableflags", int(mujoco.mjtEnableBit.mjENBL_SLEEP), "mjENBL_SLEEP"),
    ):
        spec = world("plane")
        setattr(spec.option, name, bit)
        bridge = Bridge(spec)
        bridge.attach("toy", thing("ball"), look=False)
        with pytest.raises(ValueError, match=message):
            bridge.compile()


def test_steps_leak_nothing():
    bridge, model, data = compiled("plane", "bunny", 0.01)
    with bridge:
        mujoco.mj_step(model, data, 300)
        before = _resident()
        mujoco.mj_step(model, data, 1500)
        grown = _resident() - before
    assert grown < 1 << 20, f"grew by {grown} bytes in 1500 steps"


def _resident() -> int:
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * resource.getpagesize()


if not os.path.exists("/proc/self/statm"):
    test_steps_leak_nothing = pytest.mark.skip("needs /proc to measure memory")(test_steps_leak_nothing)
