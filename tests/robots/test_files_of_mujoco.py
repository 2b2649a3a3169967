"""What files of MuJoCo say beyond joints: compensated weight, key frames, friction, against MuJoCo itself."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.maths import quat_to_matrix
from dano.robots import read_robot, robot_doubts

mujoco = pytest.importorskip("mujoco")

ARM = """<mujoco><compiler angle="radian"/><option timestep="1e-4" integrator="RK4"/>
<worldbody><body name="a" pos="0 0 1" gravcomp="{a}"><joint name="a" axis="0 1 0"/>
<geom type="box" size=".1 .02 .02" pos=".1 0 0" mass="1"/>
<body name="b" pos=".2 0 0" gravcomp="{b}"><joint name="b" axis="0 1 .3"/>
<geom type="box" size=".1 .02 .03" pos=".1 0 0" mass=".7"/>{more}</body></body></worldbody></mujoco>"""


def arm(tmp_path, a=0.0, b=0.0, more=""):
    path = tmp_path / "arm.xml"
    path.write_text(ARM.format(a=a, b=b, more=more), encoding="utf-8")
    return path


def test_compensated_weight_moves_as_in_mujoco(tmp_path):
    path = arm(tmp_path, a=0.3, b=1.2)
    robot, model = dano.load_mjcf(path, collision=False), mujoco.MjModel.from_xml_path(str(path))
    scene = robot.scene(timestep=2e-4)
    state, data = robot.state(scene, dict(a=0.2, b=-0.4)), mujoco.MjData(model)
    data.qpos[:] = 0.2, -0.4
    mujoco.mj_forward(model, data)
    needed = data.qfrc_bias - data.qfrc_passive
    np.testing.assert_allclose(dano.gravity_forces(scene, state), needed, atol=1e-12)
    np.testing.assert_allclose(dano.bias_forces(scene, state), needed, atol=1e-9)
    for _ in range(2000):
        mujoco.mj_step(model, data)
    # Velocities are those of the middle of the step that ends at the start.
    before = 1e-4 * np.linalg.solve(dano.mass_matrix(scene, state), needed)
    start = robot.state(scene, dict(a=0.2, b=-0.4), dict(a=before[0], b=before[1]))
    run = dano.simulate(scene, start, 1000)
    assert run.states.q is not None
    np.testing.assert_allclose(run.states.q[-1], data.qpos, atol=2e-5)
    # Without it both fall by half a radian and more.
    plain = dano.load_mjcf(path, collision=False, ignore="gravcomp")
    fallen = dano.simulate(plain.scene(timestep=2e-4), state, 1000).states.q
    assert fallen is not None
    assert np.abs(np.asarray(fallen[-1]) - data.qpos).max() > 0.1


def test_compensated_weight_of_a_body_has_derivatives_and_goes_into_files(tmp_path):
    ball = dano.Body("ball", dano.Sphere(0.1), mass=2.0, gravcomp=0.25)
    scene = dano.Scene.create([ball], timestep=0.01)
    state = scene.initial_state(ball=dict(position=(0, 0, 1)))

    def height(share):
        moved = eqx.tree_at(lambda s: s.bodies[0].gravcomp, scene, share)
        return dano.simulate(moved, state, 10).states.position[-1, 0, 2]

    share = np.array(0.25)
    fall = 9.81 * 0.01**2 * 55
    np.testing.assert_allclose(height(share), 1 - 0.75 * fall, atol=1e-9)
    np.testing.assert_allclose(jax.grad(height)(share), fall, rtol=1e-9)
    robot = dano.load_mjcf(arm(tmp_path, b=1.0), collision=False)
    written = dano.export_robot(robot, tmp_path / "again.xml")
    model = mujoco.MjModel.from_xml_path(str(written))
    np.testing.assert_array_equal(model.body_gravcomp, [0, 0, 1])


def test_compensated_weight_of_a_part_of_a_body_is_refused(tmp_path):
    more = '<body name="c" gravcomp="0"><geom type="sphere" size=".02" mass=".1"/></body>'
    path = arm(tmp_path, b=1.0, more=more)
    robot = dano.load_mjcf(path)
    with pytest.raises(ValueError, match=r"gravcomp of 'b', 'c' differs.*ignore=\['gravcomp'\]"):
        robot.scene()
    dano.load_mjcf(path, ignore="gravcomp").scene()


FRAMES = """<mujoco><compiler angle="radian"/><worldbody>
<geom name="floor" type="plane" size="1 1 1" friction=".9"/>
<geom name="ice" type="box" size=".1 .1 .1" friction=".05"/>
<body name="a" pos="0 0 .5"><freejoint name="free"/>
<geom type="box" size=".1 .05 .02" pos=".1 .02 0" mass="1" friction=".4" solref=".01 1"/>
<body name="b" pos=".2 0 0"><joint name="b" axis="0 1 0" ref=".5"/>
<geom type="sphere" size=".05" mass=".3" friction=".2" condim="6"/>
<body name="c" pos=".1 0 0"><joint name="c" type="ball"/>
<geom type="sphere" size=".04" pos=".1 0 0" mass=".2"
 friction=".3" priority="1"/></body></body></body></worldbody><keyframe>
<key name="up" qpos=".1 .2 .7 1 .2 -.1 .3 .9 1 .1 .2 .3"
 qvel="1 2 3 .1 .2 .3 .5 .1 -.2 .3"/><key/></keyframe></mujoco>"""


@pytest.fixture
def framed(tmp_path):
    path = tmp_path / "framed.xml"
    path.write_text(FRAMES, encoding="utf-8")
    return path


def test_key_frames_are_states_of_mujoco(framed):
    robot, model = dano.load_mjcf(framed, prefix="my "), mujoco.MjModel.from_xml_path(str(framed))
    assert robot.keyframes == ("up", "key 1")
    scene, data = robot.scene(timestep=1e-6), mujoco.MjData(model)
    state = robot.state(scene, "up")
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    frames = scene.frames(state)
    for name in "abc":
        i = scene.index(f"my {name}")
        position, orientation, _ = robot.place(scene, state, name)
        np.testing.assert_allclose(position, data.body(name).xpos, atol=1e-12)
        np.testing.assert_allclose(quat_to_matrix(orientation).ravel(), data.body(name).xmat, atol=1e-12)
        speed = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, model.body(name).id, speed, 0)
        # Of the centre of mass, in axes of the world.
        np.testing.assert_allclose(frames.velocity[i], speed[3:], atol=1e-9)
    # Its place may be told by its origin, too, in place of the file's.
    moved = robot.state(scene, **{"my a": dict(origin=(1.0, 2.0, 3.0))})
    np.testing.assert_allclose(robot.place(scene, moved, "a")[0], (1, 2, 3), atol=1e-12)
    with pytest.raises(ValueError, match=r"key frame must be one of \['up', 'key 1'\], got 'upp'"):
        robot.state(scene, "upp")


def test_friction_between_bodies_of_the_file(framed):
    """That of the higher priority, else the larger, as MuJoCo's own contacts have it."""
    robot = dano.load_mjcf(framed)
    found = {(c.a, c.b): float(c.params.sliding_friction) for c in robot.contacts_with(*robot.surroundings)}
    assert found == {
        ("a", "floor"): 0.9,
        ("b", "floor"): 0.9,
        ("c", "floor"): 0.3,
        ("a", "ice"): 0.4,
        ("b", "ice"): 0.2,
        ("c", "ice"): 0.3,
    }
    told = dano.ContactParams(sliding_friction=0.7)
    assert float(robot.contacts_with("floor", params=told)[0].params.sliding_friction) == 0.7
    table = dano.Body("table", dano.Box((1, 1, 0.1)), fixed=True)
    assert float(robot.contacts_with(table)[0].params.sliding_friction) == 0.2
    doubts = "\n".join(robot_doubts(read_robot(framed)))
    assert "not read: solref or solimp of 'geom 2'" in doubts
    assert "not read: torsional and rolling friction of 'geom 3'" in doubts


GRIPPER = """<mujoco><compiler angle="radian"/><worldbody><body name="hand" pos="0 0 1">
<geom type="box" size=".05 .05 .02" mass="1"/>
<body name="left" pos="0 .02 .05"><joint name="l" type="slide" axis="0 1 0" damping="2"/>
 <geom type="box" size=".01 .01 .04" mass=".1"/></body>
<body name="right" pos="0 -.02 .05"><joint name="r" type="slide" axis="0 -1 0" damping="1"/>
 <geom type="box" size=".01 .01 .04" mass=".2"/></body></body></worldbody>
<tendon><fixed name="split"><joint joint="l" coef=".5"/><joint joint="r" coef=".5"/></fixed></tendon>
<equality><joint joint1="r" joint2="l" polycoef="0 {ratio}" solref=".002 1" solimp=".999 .9999"/></equality>
<actuator>{actuator}</actuator></mujoco>"""


@pytest.mark.parametrize("ratio", [1.0, 0.5])
@pytest.mark.parametrize(
    "actuator",
    [
        '<motor name="m" tendon="split" gear="3"/>',
        '<position name="m" tendon="split" kp="50" kv="4"/>',
        '<motor name="m" joint="r" gear="2"/>',
    ],
)
def test_drives_of_tendons_and_of_joints_that_follow(tmp_path, actuator: str, ratio: float):
    """A gripper, beside MuJoCo, whose equality is nearly hard."""
    path = tmp_path / "gripper.xml"
    path.write_text(GRIPPER.format(actuator=actuator, ratio=ratio), encoding="utf-8")
    robot, model = dano.load_mjcf(path, collision=False), mujoco.MjModel.from_xml_path(str(path))
    model.opt.timestep = 2e-4
    # The fingers would rub on the hand, which MuJoCo does not take for a neighbour where it stands still.
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data = mujoco.MjData(model)
    data.ctrl[0] = 0.02
    mujoco.mj_step(model, data, 500)
    scene = robot.scene(timestep=2e-4)
    control = robot.control(scene, dict(m=0.02))
    repeated = jax.tree.map(lambda x: jnp.repeat(x[None], 500, axis=0), control)
    moved = dano.simulate(scene, robot.state(scene), controls=repeated).states.q
    assert moved is not None
    q = float(moved[-1, 0])
    assert q == pytest.approx(float(data.joint("l").qpos[0]), rel=0.02)
    assert abs(q) > 1e-4


def test_a_tendon_of_free_joints_is_refused(tmp_path):
    path = tmp_path / "gripper.xml"
    text = GRIPPER.format(actuator='<motor name="m" tendon="split"/>', ratio=1.0)
    path.write_text(text.replace("<equality>", "<!--").replace("</equality>", "-->"), encoding="utf-8")
    with pytest.raises(
        ValueError, match=r"several joints, of which none leads .* ignore=\['other actuators'\]"
    ):
        dano.load_mjcf(path, collision=False)
