"""What acts on free joints, on lengths of fixed tendons and on joints that follow, against MuJoCo itself."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.maths import quat_to_matrix
from dano.robots import read_robot, robot_doubts

mujoco = pytest.importorskip("mujoco")

FREE = """<mujoco><compiler angle="radian"/><option timestep="1e-4" gravity="0 0 -2"/><worldbody>
<body name="a" pos=".1 .2 .3" quat=".9 .1 -.3 .2"><joint name="root" type="free" {laws}/>
<geom type="box" size=".1 .05 .02" pos=".04 .02 0" mass="1"/>
<body name="b" pos=".2 0 0"><joint name="b" axis="0 1 .2"/><geom size=".05" pos=".1 0 0" mass=".3"/></body>
</body></worldbody>
<keyframe><key name="up" qpos=".3 -.1 .5 .8 .3 .2 -.4 .5" qvel=".3 -.2 .4 1 -2 .5 .7"/></keyframe></mujoco>"""


def written(tmp_path, text: str):
    path = tmp_path / "file.xml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("laws", ['damping=".4" armature=".3"', 'stiffness="3" damping=".1"'])
def test_free_joints_with_laws_move_as_in_mujoco(tmp_path, laws: str):
    path = written(tmp_path, FREE.format(laws=laws))
    with pytest.warns(UserWarning, match="the free joint 'root' has .* hangs on the joints 'root x'"):
        robot = dano.load_mjcf(path, collision=False)
    model = mujoco.MjModel.from_xml_path(str(path))
    scene, data = robot.scene(timestep=1e-4), mujoco.MjData(model)
    state = robot.state(scene, "up")
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    for name in "ab":
        position, orientation, _ = robot.place(scene, state, name)
        np.testing.assert_allclose(position, data.body(name).xpos, atol=1e-12)
        np.testing.assert_allclose(quat_to_matrix(orientation).ravel(), data.body(name).xmat, atol=1e-12)
    mass = np.zeros((model.nv, model.nv))
    for row, unit in zip(mass, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    # The links between slides and ball weigh a billionth.
    np.testing.assert_allclose(dano.mass_matrix(scene, state), mass, atol=1e-8)
    np.testing.assert_allclose(dano.bias_forces(scene, state), data.qfrc_bias, atol=1e-7)
    run = dano.simulate(scene, state, 2000)
    assert bool(run.converged.all())
    mujoco.mj_step(model, data, 2000)
    end = jax.tree.map(lambda x: x[-1], run.states)
    for name in "ab":
        position, orientation, _ = robot.place(scene, end, name)
        # Both are of first order: half the step's share of 0.2 s.
        np.testing.assert_allclose(position, data.body(name).xpos, atol=3e-4)
        np.testing.assert_allclose(quat_to_matrix(orientation).ravel(), data.body(name).xmat, atol=1e-3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loose = dano.load_mjcf(path, collision=False, ignore="free joints")
    moved = dano.simulate(loose.scene(timestep=1e-4), loose.state(loose.scene(), "up"), 2000)
    assert np.abs(np.asarray(moved.states.position[-1, 0]) - np.asarray(end.position[-2])).max() > 3e-3
    assert any("'root': is free and has" in doubt for doubt in robot_doubts(read_robot(path)))


def test_friction_of_free_joints_holds_and_slips(tmp_path):
    """A body of 1 kg is pushed by 3 N against 1 N of friction; another of 0.5 N does not move."""
    text = FREE.format(laws='frictionloss="1"').replace('gravity="0 0 -2"', 'gravity="0 0 0"')
    with pytest.warns(UserWarning, match="has friction"):
        robot = dano.load_mjcf(written(tmp_path, text), collision=False)
    scene = robot.scene(timestep=1e-3)
    whole = 1.3  # [kg]
    for force, way in ((0.5, 0.0), (3.0, 0.5 * 2.0 / whole * 0.1**2)):
        control = robot.control(scene, efforts={"root x": force})
        repeated = jax.tree.map(lambda x: jnp.repeat(x[None], 100, axis=0), control)
        end = dano.simulate(scene, robot.state(scene), controls=repeated).states
        # The arm swings back a little: it pulls less than its whole mass.
        assert end.q is not None
        moved = float(end.q[-1, 0] - end.q[0, 0])
        assert moved == pytest.approx(way, rel=0.15, abs=1e-6)


COUPLED = """<mujoco><compiler angle="radian"/><option timestep="2e-4" gravity="0 0 -3"/><worldbody>
<body name="a" pos="0 0 1"><joint name="a" axis="0 1 0" ref=".1" damping=".2" {a}/>
<geom type="box" size=".1 .02 .02" pos=".1 0 0" mass="1"/>
<body name="b" pos=".2 0 0"><joint name="b" axis="0 1 .3" {b}/><geom size=".05" pos=".1 0 0" mass=".4"/>
<body name="c" pos=".2 0 0"><joint name="c" axis="0 1 0" damping=".02"/>
<geom size=".04" pos=".1 0 0" mass=".2"/></body></body></body></worldbody>
<tendon><fixed name="t" {t}><joint joint="a" coef=".5"/><joint joint="b" coef="-.25"/></fixed>
<fixed name="u" {u}><joint joint="c" coef=".7"/></fixed></tendon>
<equality>{equality}</equality></mujoco>"""
HARD = 'solref=".001 1" solimp=".9999 .99999"'


@pytest.mark.parametrize(
    "parts",
    [
        # The length of a tendon: b follows a.
        dict(equality=f'<tendon tendon1="t" {HARD}/>'),
        # Two lengths: three joints are too many, so the first tendon is of two, of which one is held.
        dict(equality=f'<tendon tendon1="u" {HARD}/><tendon tendon1="t" {HARD}/>'),
        dict(u='stiffness="9" springlength=".2" damping=".3" armature=".1" frictionloss=".02"'),
        dict(u='limited="true" range="-.02 .06"'),
        # A joint that follows has a limit and a spring of its own.
        dict(
            equality=f'<joint joint1="b" joint2="a" polycoef="0 2" {HARD}/>', b='range="-.2 .1" stiffness="2"'
        ),
        dict(
            equality=f'<joint joint1="b" joint2="a" polycoef="0 2" {HARD}/>',
            # By a and b together: the length is not constant.
            t='stiffness="40" damping="1" springlength=".3"'.replace("40", "400"),
        ),
    ],
)
def test_lengths_and_followers_move_as_in_mujoco(tmp_path, parts: dict[str, str]):
    keys = dict.fromkeys(("a", "b", "t", "u", "equality"), "") | parts
    path = written(tmp_path, COUPLED.format(**keys))
    robot, model = dano.load_mjcf(path, collision=False), mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    scene = robot.scene(timestep=2e-4)
    state = robot.state(scene)
    run = dano.simulate(scene, state, 1500)
    assert bool(run.converged.all())
    end = jax.tree.map(lambda x: x[-1], run.states)
    mujoco.mj_step(model, data, 1500)
    plain = dano.load_mjcf(written(tmp_path, COUPLED.format(**dict.fromkeys(keys, ""))), collision=False)
    other = dano.simulate(plain.scene(timestep=2e-4), plain.state(plain.scene()), 1500)
    untied = jax.tree.map(lambda x: x[-1], other.states)
    apart = []
    for name in "abc":
        position, _, _ = robot.place(scene, end, name)
        np.testing.assert_allclose(position, data.body(name).xpos, atol=2e-3)
        apart.append(np.abs(plain.place(plain.scene(), untied, name)[0] - data.body(name).xpos).max())
    centre = robot.place(scene, end, "c")[1]
    np.testing.assert_allclose(quat_to_matrix(centre).ravel(), data.body("c").xmat, atol=2e-2)
    turned = plain.place(plain.scene(), untied, "c")[1]
    # What the file says does something.
    assert max(*apart, np.abs(quat_to_matrix(turned).ravel() - data.body("c").xmat).max()) > 5e-2


def test_what_lengths_say_of_joints(tmp_path):
    """With a constant, MuJoCo starts with a jolt: .5 (a − .1) − .25 b = .05."""
    keys = dict.fromkeys(("a", "b", "t", "u", "equality"), "")
    keys["equality"] = '<tendon tendon1="t" polycoef=".05"/>'
    described = read_robot(written(tmp_path, COUPLED.format(**keys)))
    follows = next(joint.mimics for joint in described.joints if joint.name == "b")
    assert follows == ("a", pytest.approx(2), pytest.approx(-0.4))


def test_limits_of_a_length_that_joints_keep_are_no_matter(tmp_path):
    keys = dict.fromkeys(("a", "b", "t", "u", "equality"), "")
    keys |= dict(a='range="-.5 .5"', b='range="-.4 .4"', t='limited="true" range="-.36 .36"')
    assert dano.load_mjcf(written(tmp_path, COUPLED.format(**keys)), collision=False).joints
    keys["t"] = 'limited="true" range="-.3 .3"'
    with pytest.raises(ValueError, match=r"'t': of tendons dano has only fixed ones.*ignore=\['tendons'\]"):
        dano.load_mjcf(written(tmp_path, COUPLED.format(**keys)), collision=False)


def test_limits_that_exclude_each_other_are_refused(tmp_path):
    """Of a joint, and of the one that follows it the other way: together they leave nothing but zero."""
    keys = dict.fromkeys(("a", "b", "t", "u", "equality"), "")
    keys |= dict(a='range="0 1"', b='range="0 1"', equality='<joint joint1="b" joint2="a" polycoef=".2 -2"/>')
    path = written(tmp_path, COUPLED.format(**keys).replace('ref=".1"', 'ref="0"'))
    np.testing.assert_allclose(np.asarray(dano.load_mjcf(path, collision=False).joints[0].limits), [0, 0.1])
    path.write_text(path.read_text().replace('".2 -2"', '"0 -2"'))
    with pytest.raises(ValueError, match=r"limits of joint 'b' leave no way to 'a'.*ignore=\['equalities'\]"):
        dano.load_mjcf(path, collision=False)


def test_lengths_of_three_joints_are_refused(tmp_path):
    keys = dict.fromkeys(("a", "b", "t", "u", "equality"), "")
    keys["equality"] = '<tendon tendon1="t" tendon2="u"/>'
    with pytest.raises(ValueError, match=r"tendon 't' couples more than two .*ignore=\['equalities'\]"):
        dano.load_mjcf(written(tmp_path, COUPLED.format(**keys)), collision=False)
