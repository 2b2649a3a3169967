"""Robots' files as people have them: what is read all the same, what is refused and which option helps."""

import re

import numpy as np
import pytest
from robots.test_files import BODY, joint, link

import dano
from dano.robots import read_robot, robot_doubts


def collision(more="", origin=""):
    return f'<collision>{origin}<geometry><box size="1 1 1"/>{more}</geometry></collision>'


EMPTY = BODY.replace('value="1"', 'value="0"')


def urdf(tmp_path, text):
    path = tmp_path / "robot.urdf"
    path.write_text(text if "<robot" in text else f'<robot name="r">{text}</robot>')
    return path


FIXED = joint("f", "a", "b", '<mimic joint="j"/>', kind="fixed")
READ = {
    "blank before the declaration": (
        f'\n <?xml version="1.0"?><robot name="r">{link("a")}</robot>',
        "",
    ),
    "mimic on a fixed joint": (
        link("a") + link("b") + link("c") + FIXED + joint("j", "b", "c"),
        "joint 'f': is fixed, so its <mimic> is left out",
    ),
    "mimic of a fixed joint": (
        link("a") + link("b") + link("c") + joint("f", "a", "b", kind="fixed")
        + joint("j", "b", "c", '<mimic joint="f" offset="0.2"/>'),
        "joint 'j' follows 'f', which is fixed",
    ),
    "two shapes": (
        link("a", BODY + collision('<sphere radius="1"/>')),
        "link 'a': of the shapes of one <geometry> the first counts, <box>, not <sphere>",
    ),
    "left-over optenv": (
        link("a", BODY + collision(origin='<origin xyz="$(optenv SOME_XYZ 1 0 0.5)"/>')),
        r"\$\(optenv SOME_XYZ …\) is read as '1 0 0.5'",
    ),
    "definitions of xacro": (
        '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:property name="x" value="${1}"/>'
        f'<xacro:macro name="m"><link name="${{x}}"/></xacro:macro>{link("a")}</robot>',
        "",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", READ)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_files_that_are_read_all_the_same(case, tmp_path):
    """What was taken in another way than written is said, once by loading and by `dano inspect`."""
    text, note = READ[case]
    path = urdf(tmp_path, text)
    if note:
        with pytest.warns(UserWarning, match=note):
            dano.load_urdf(path)
        assert any(re.search(note, doubt) for doubt in robot_doubts(read_robot(path)))
    assert dano.load_urdf(path).description.links[0].name == "a"


def test_a_follower_of_a_fixed_joint_stands_at_its_shift(tmp_path):
    path = urdf(tmp_path, READ["mimic of a fixed joint"][0])
    with pytest.warns(UserWarning, match="fixed, too"):
        robot = dano.load_urdf(path)
    turn = robot.frames["c"][2]
    np.testing.assert_allclose(turn, [np.cos(0.1), np.sin(0.1), 0, 0], atol=1e-12)


XACRO = '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">{0}</robot>'
REFUSED = {
    "xacro": (XACRO.format(link("a") + '<xacro:leg n="1"/>'), "xacro macros are expanded, got <xacro:leg>"),
    "xacro in a link": (
        XACRO.format('<link name="a"><xacro:box/></link>'),
        "xacro macros are expanded, got <xacro:box>",
    ),
    "substitution": (link("a${n}"), r"xacro macros are expanded, got name='a\${n}'"),
    "no mass at the end": (
        link("a") + link("b", EMPTY) + joint("j", "a", "b"),
        r"got none for 'j'.*ignore=\['weightless joints'\]",
    ),
    "two joints that move alike": (
        link("a") + link("b", EMPTY) + link("c") + joint("j", "a", "b") + joint("k", "b", "c"),
        "got none for 'j', 'k'",
    ),
    "crossed limits": (
        link("a") + link("b") + joint("j", "a", "b", '<limit lower="1" upper="0"/>'),
        r"lower limit must not exceed the upper.*ignore=\['crossed limits'\]",
    ),
    "mimic of nothing": (
        link("a") + link("b") + joint("j", "a", "b", '<mimic joint="no"/>'),
        r"joint 'j' must mimic a joint, got 'no'.*ignore=\['mimics of nothing'\]",
    ),
    "impossible inertia": (
        link("a") + link("b", BODY.replace('ixx="1"', 'ixx="2.1"')) + joint("j", "a", "b"),
        r"5 % too much; balance_inertia=True",
    ),
    "a soft body alone": (
        '<deformable name="torus"/>',
        "must hold a link, got the soft body 'torus' alone: dano has rigid bodies only",
    ),
    "a soft body": (link("a") + '<deformable name="d"/>', r"'d' is a soft body.*ignore=\['soft bodies'\]"),
    "a signed distance": (
        f'<link name="a">{BODY}<collision><geometry><cdf filename="a.cdf"/></geometry></collision></link>',
        r"link 'a': <cdf> is a signed distance of Bullet.*ignore=\['height fields'\]",
    ),
    "negative friction": (
        link("a") + link("b") + joint("j", "a", "b", '<dynamics friction="-1"/>'),
        "joint 'j': friction must be ≥ 0, got -1",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_files_say_which_option_helps(case, tmp_path):
    text, message = REFUSED[case]
    path = urdf(tmp_path, text)
    with pytest.raises(ValueError, match=message) as error:
        dano.load_urdf(path)
    assert "\n" not in str(error.value)
    for name in re.findall(r"ignore=\['(.*?)'\]", str(error.value)):
        assert dano.load_urdf(path, ignore=name).description.links
    if "balance_inertia" in str(error.value):
        assert dano.load_urdf(path, balance_inertia=True).bodies


def test_balanced_inertia_is_that_of_mujoco(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    text = REFUSED["impossible inertia"][0]
    path = urdf(tmp_path, f'<robot name="r"><mujoco><compiler balanceinertia="true"/></mujoco>{text}</robot>')
    model = mujoco.MjModel.from_xml_path(str(path))
    inertia = np.asarray(dano.load_urdf(path, balance_inertia=True).bodies[-1].inertia)
    np.testing.assert_allclose(np.diag(inertia), model.body("b").inertia, rtol=1e-12)


def test_links_without_mass_between_joints(tmp_path):
    """As MuJoCo has the same two joints in one body; links without inertia on the way are no matter."""
    mujoco = pytest.importorskip("mujoco")
    along = '<axis xyz="{0}"/>'
    parts = link("a") + link("b", "") + link("c", EMPTY) + link("d")
    for name, (above, below), axis, kind in (
        ("x", "ab", "1 0 0", "prismatic"),
        ("y", "bc", "0 1 0", "prismatic"),
        ("z", "cd", "0 0 1", "continuous"),
    ):
        limit = '<limit lower="-1" upper="1"/>'
        parts += joint(name, above, below, along.format(axis) + limit, kind=kind)
    robot = dano.load_urdf(urdf(tmp_path, parts))
    scene = robot.scene()
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><joint axis="0 0 1"/>'
        "</body></worldbody></mujoco>"
    )
    mass, data = np.zeros((3, 3)), mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for row, unit in zip(mass, np.eye(3), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    np.testing.assert_allclose(dano.mass_matrix(scene, robot.state(scene)), mass, atol=1e-8)


def test_odd_numbers_are_named(tmp_path):
    """`dano inspect` on limits in degrees, negative numbers, and mass that does not count."""
    inside = '<limit lower="-170" upper="170"/><dynamics damping="-1"/>'
    path = urdf(tmp_path, link("a") + link("b") + joint("j", "a", "b", inside))
    said = "; ".join(robot_doubts(read_robot(path)))
    assert "limits -170 to 170 rad are 27.1 turns: degrees?" in said
    assert "joint 'j': damping is negative, -1" in said
    assert "link 'a': its mass of 1 kg counts only where the robot floats" in said


def test_contacts_of_a_robot_that_stands(tmp_path):
    """Its base touches what moves, not the floor."""
    shape = collision()
    path = urdf(tmp_path, link("base", BODY + shape) + link("arm", BODY + shape) + joint("j", "base", "arm"))
    robot = dano.load_urdf(path)
    assert [(c.a, c.b) for c in robot.contacts_with("floor")] == [("arm", "floor")]
    ball = dano.Body("ball", dano.Sphere(0.1), mass=1.0)
    assert [(c.a, c.b) for c in robot.contacts_with(ball)] == [("base", "ball"), ("arm", "ball")]
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    contacts = robot.contacts_with(floor, ball)
    assert robot.scene(bodies=[floor, ball], contacts=contacts).pairs


def test_starts_beyond_limits_and_efforts_are_said(tmp_path):
    limit = '<limit lower="0.5" upper="1" effort="9"/>'
    path = urdf(tmp_path, link("base") + link("arm") + joint("j", "base", "arm", limit))
    robot = dano.load_urdf(path)
    scene = robot.scene(timestep=2e-3)
    with pytest.warns(
        RuntimeWarning, match=r"joint 'j' starts at 0 rad, beyond its limits 0.5 to 1.* at 1 rad/s"
    ):
        robot.state(scene)
    with pytest.warns(RuntimeWarning, match="joint 'arm' starts at 2 rad, beyond its limits"):
        scene.initial_state(arm=dict(q=2.0))
    robot.state(scene, dict(j=0.5))
    with pytest.warns(RuntimeWarning, match="effort of joint 'j' is 20, and the file says at most 9"):
        control = robot.control(scene, efforts=dict(j=20.0))
    assert control.effort is not None
    assert float(control.effort[0]) == 20.0
    assert scene.joint("arm").child == "arm"
    with pytest.raises(ValueError, match="body must be one of"):
        scene.joint("base")


def test_robots_without_mass_serve_kinematics(tmp_path):
    """Two links of 0.3 m, of which nobody knows what they weigh."""
    path = tmp_path / "bare.urdf"
    path.write_text(
        '<robot name="bare"><link name="base"/><link name="upper"/><link name="lower"/><link name="tip"/>'
        '<joint name="a" type="continuous"><parent link="base"/><child link="upper"/>'
        '<axis xyz="0 1 0"/></joint>'
        '<joint name="b" type="continuous"><parent link="upper"/><child link="lower"/>'
        '<origin xyz="0.3 0 0"/><axis xyz="0 1 0"/></joint>'
        '<joint name="c" type="fixed"><parent link="lower"/><child link="tip"/>'
        '<origin xyz="0.3 0 0"/></joint>'
        "</robot>"
    )
    with pytest.raises(ValueError, match=r"kinematics alone needs no mass, with ignore=\['masses'\]"):
        dano.load_urdf(path)
    robot = dano.load_urdf(path, ignore="masses")
    scene = robot.scene()
    state = robot.state(scene, dict(a=0.3, b=-1.0))
    expected = 0.3 * np.array([np.cos(0.3) + np.cos(0.7), 0, np.sin(0.7) - np.sin(0.3)])
    np.testing.assert_allclose(robot.place(scene, state, "tip")[0], expected, atol=1e-12)
    target = dano.Target("tip", position=(0.4, 0.0, 0.1))
    found = dano.inverse_kinematics(robot, scene, state, [target])
    assert found.reached
    calls = [
        lambda: dano.simulate(scene, state, 2),
        lambda: dano.step(scene, state),
        lambda: dano.mass_matrix(scene, state),
        lambda: dano.bias_forces(scene, state),
        lambda: dano.gravity_forces(scene, state),
        lambda: dano.export_robot(robot, tmp_path / "again.urdf", scene=scene),
    ]
    for call in calls:
        with pytest.raises(ValueError, match="bodies of known mass, got none for 'upper', 'lower'"):
            call()
