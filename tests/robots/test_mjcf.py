"""What files of MuJoCo say, against MuJoCo itself; what dano has no counterpart of, by name."""

import jax.numpy as jnp
import numpy as np
import pytest
from engine.trees import coordinates

import dano
from dano.maths import quat_to_matrix
from dano.robots import read_robot, robot_doubts

mujoco = pytest.importorskip("mujoco")

BOX = '<geom type="box" size=".1 .05 .02" pos=".1 .02 0" mass="1"/>'
# Bodies stand in each other: only what MuJoCo says of joints is looked at.
APART = '<option><flag contact="disable"/></option>'


def written(tmp_path, world, rest=""):
    path = tmp_path / "robot.xml"
    path.write_text(
        f'<mujoco><compiler angle="radian"/><worldbody>{world}</worldbody>{rest}</mujoco>', encoding="utf-8"
    )
    return path


def body(name, inside, place="0 0 .5"):
    return f'<body name="{name}" pos="{place}" quat="1 .2 .1 0">{inside}{BOX}</body>'


def posed(robot, scene, model, joints):
    """A state of both, with numbers of joints by name."""
    data = mujoco.MjData(model)
    q, v = {}, {}
    rng = np.random.default_rng(0)
    for name in joints:
        width = np.size(data.joint(name).qvel)
        v[name], x = rng.normal(size=width), 0.4 * rng.normal(size=width)
        data.joint(name).qvel = v[name]
        if width == 3:
            angle = np.linalg.norm(x)
            data.joint(name).qpos = [np.cos(angle / 2), *(np.sin(angle / 2) * x / angle)]
        else:
            data.joint(name).qpos = x
        q[name] = x if width == 3 else float(x[0])
        v[name] = v[name] if width == 3 else float(v[name][0])
    mujoco.mj_forward(model, data)
    return robot.state(scene, q, v), data


MOON = '<option gravity="0.1 0 -1.62"/>'
SEVERAL = body(
    "a",
    '<joint name="up" type="slide" axis="0 .1 1" ref=".7"/>'
    '<joint name="turn" axis="0 1 0" pos=".1 0 .05" ref=".5" armature=".3"/>'
    '<joint name="roll" axis="1 0 .2" pos="0 .1 0"/>'
    + body("b", '<joint name="ball" type="ball" pos="0 0 .1" stiffness="2" damping=".1"/>', ".2 0 .1"),
)


def test_several_joints_references_and_gravity(tmp_path):
    """Frames, mass and bias in MuJoCo's coordinates; by default the pose of the file."""
    path = written(tmp_path, SEVERAL, MOON)
    robot, model = dano.load_mjcf(path, collision=False), mujoco.MjModel.from_xml_path(str(path))
    joints = ["up", "turn", "roll", "ball"]
    assert list(robot.joint_names) == joints
    scene = robot.scene()
    state, data = posed(robot, scene, model, joints)
    for name in "ab":
        position, orientation, _ = robot.place(scene, state, name)
        np.testing.assert_allclose(position, data.body(name).xpos, atol=1e-12)
        np.testing.assert_allclose(quat_to_matrix(orientation).ravel(), data.body(name).xmat, atol=1e-12)
    mass = np.zeros((model.nv, model.nv))
    for row, unit in zip(mass, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    # Links between the joints of a body have a billionth of what they carry.
    np.testing.assert_allclose(dano.mass_matrix(scene, state), mass, atol=1e-8)
    np.testing.assert_allclose(dano.bias_forces(scene, state), data.qfrc_bias, atol=1e-7)
    at_home, still = robot.state(scene), mujoco.MjData(model)
    mujoco.mj_forward(model, still)
    np.testing.assert_allclose(robot.place(scene, at_home, "b")[0], still.body("b").xpos, atol=1e-12)
    assert robot.home["turn"] == 0.5
    # The file's spring of a ball is that of the rotation vector.
    np.testing.assert_allclose(-2 * coordinates(state)[0][3:], data.qfrc_spring[3:], atol=1e-12)
    assert scene.joint("b").stiffness == 2.0


EQUAL = (
    body("a", '<joint name="a" axis="0 1 0" ref=".2"/>')
    + body("b", '<joint name="b" axis="0 1 0" ref=".5"/>')
    + body("c", '<joint name="c" axis="0 1 0"/>')
)


@pytest.mark.parametrize(
    ("equality", "free", "q"),
    [
        ('<joint joint1="b" joint2="a" active="false"/>', ["a", "b", "c"], {}),
        # Both are measured from the pose of the file: b = .5 + .1 + 2 (a − .2).
        ('<joint joint1="b" joint2="a" polycoef=".1 2 0 0 0"/>', ["a", "c"], {"b": 1.0}),
        ('<joint joint1="b" polycoef=".3 0 0 0 0"/>', ["a", "c"], {"b": 0.8}),
        (
            '<joint joint1="b" polycoef=".3 0 0 0 0"/><joint joint1="c" joint2="b" polycoef="0 1 0 0 0"/>',
            ["a"],
            {"b": 0.8, "c": 0.3},
        ),
    ],
)
def test_equalities_of_joints(equality, free, q, tmp_path):
    path = written(tmp_path, EQUAL, f"<equality>{equality}</equality>{APART}")
    robot, model = dano.load_mjcf(path, collision=False), mujoco.MjModel.from_xml_path(str(path))
    assert list(robot.joint_names) == free
    scene, data = robot.scene(), mujoco.MjData(model)
    data.joint("a").qpos = 0.4
    for name, value in q.items():
        data.joint(name).qpos = value
    mujoco.mj_forward(model, data)
    # MuJoCo says itself that its equalities are met there.
    np.testing.assert_allclose(data.efc_pos, 0, atol=1e-12)
    state = robot.state(scene, dict(a=0.4))
    for name in "abc":
        np.testing.assert_allclose(robot.place(scene, state, name)[0], data.body(name).xpos, atol=1e-12)
        turn = quat_to_matrix(robot.place(scene, state, name)[1])
        np.testing.assert_allclose(turn.ravel(), data.body(name).xmat, atol=1e-12)


def test_things_of_the_world(tmp_path):
    """A floor, a table and a stand: bodies of their own where MuJoCo has them, that the robot can touch."""
    world = (
        '<geom name="floor" type="plane" size="1 1 1" pos="0 0 -.1" quat="1 .1 0 0"/>'
        '<geom name="table" type="box" size=".5 .5 .1" pos="1 0 0"/>'
        f'<body name="stand" pos="0 0 .2"><geom size=".1"/>{body("arm", "<joint/>")}</body>'
        f'<body name="cube" pos="0 1 .5"><freejoint/>{BOX}</body>'
    )
    path = written(tmp_path, world)
    robot = dano.load_mjcf(path)
    assert [body.name for body in robot.bodies] == ["floor", "table", "stand", "cube", "arm"]
    assert robot.surroundings == ("floor", "table")
    pairs = [(c.a, c.b) for c in robot.contacts_with("floor", "table")]
    assert pairs == [("cube", "floor"), ("arm", "floor"), ("cube", "table"), ("arm", "table")]
    # As in MuJoCo, the cube and the arm touch each other, too.
    assert {(b, a) for a, b in pairs} | {("cube", "arm")} <= set(robot.scene().pairs)
    assert robot.scene(contacts=()).pairs == ()
    scene = robot.scene(contacts=robot.contacts_with("floor"))
    state = robot.state(scene)
    data = mujoco.MjData(model := mujoco.MjModel.from_xml_path(str(path)))
    mujoco.mj_forward(model, data)
    for name in ("stand", "cube"):
        np.testing.assert_allclose(robot.place(scene, state, name)[0], data.body(name).xpos, atol=1e-12)
    shape = robot.bodies[0].shape
    assert shape is not None
    np.testing.assert_allclose(shape.sdf(jnp.array(data.geom("floor").xpos)), 0, atol=1e-12)
    up = jnp.array(data.geom("floor").xpos + 0.3 * data.geom("floor").xmat.reshape(3, 3)[:, 2])
    np.testing.assert_allclose(shape.sdf(up), 0.3, atol=1e-12)


def test_motors_do_what_those_of_mujoco_do(tmp_path):
    """Motor, servos, gears and ranges: the same motion in 0.1 s, to the first order of the step."""
    names = ["place", "speed", "force", "strong"]
    world = "".join(body(name, f'<joint name="{name}" axis="0 1 0"/>') for name in names)
    rest = """<option gravity="0 0 0" timestep="1e-4"><flag contact="disable"/></option><actuator>
        <position name="place" joint="place" kp="20" kv="1" gear="2" ctrlrange="-1 1"/>
        <velocity name="speed" joint="speed" kv="3"/>
        <general name="force" joint="force" gainprm="5" gear="-.5" ctrlrange="-1 .3"/>
        <position name="strong" joint="strong" kp="500" forcerange="-.4 .4"/></actuator>"""
    path = written(tmp_path, world, rest)
    robot, model = dano.load_mjcf(path, collision=False), mujoco.MjModel.from_xml_path(str(path))
    assert robot.drives["place"][0] == "place"
    scene = robot.scene(timestep=1e-4)
    commands = dict(place=0.7, speed=1.5, force=0.3, strong=1.0)
    control = robot.control(scene, commands)
    run = dano.simulate(scene, robot.state(scene), 1000, controls=lambda state, time: control)
    data = mujoco.MjData(model)
    data.ctrl[:] = list(commands.values())
    for _ in range(1000):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(coordinates(run.states)[0][-1], data.qpos, atol=2e-4)
    assert np.abs(data.qpos).min() > 0.01
    assert robot.efforts["strong"] == 0.4
    with pytest.raises(ValueError, match=r"command of 'place' must be in \[-1.0, 1.0\], got 2"):
        robot.control(scene, dict(place=2.0))
    with pytest.raises(ValueError, match="did you mean 'place'"):
        robot.control(scene, dict(plce=0.1))
    assert not dano.load_mjcf(path, collision=False, ignore="actuators").scene().driven


def test_written_again(tmp_path):
    """What is exported is read as the same: chains, references, motors, equalities, the world."""
    world = (
        '<geom name="floor" type="plane" size="1 1 1" pos="0 0 -.1"/>' + SEVERAL + EQUAL.replace('"a"', '"e"')
    )
    equality = '<equality><joint joint1="b" joint2="turn" polycoef=".1 2 0 0 0"/></equality>'
    motor = '<actuator><position name="m" joint="roll" kp="20" kv="1" gear="2" ctrlrange="-1 1"/></actuator>'
    path = written(tmp_path, world.replace('body name="b"', 'body name="d"', 1), MOON + equality + motor)
    robot = dano.load_mjcf(path)
    dano.export_robot(robot, tmp_path / "again.xml")
    again = dano.load_mjcf(tmp_path / "again.xml")
    assert again.joint_names.keys() == robot.joint_names.keys()
    assert (again.drives, again.home, again.gravity) == (robot.drives, robot.home, robot.gravity)
    assert again.surroundings == ("floor",)
    scene, other = robot.scene(), again.scene()
    q = dict(up=0.1, turn=0.3, roll=-0.4, ball=(0.1, 0.2, 0.3), e=0.5, c=0.6)
    masses = [dano.mass_matrix(s, r.state(s, q)) for s, r in ((scene, robot), (other, again))]
    np.testing.assert_allclose(masses[1], masses[0], atol=1e-9)
    for name in ("a", "b", "c", "d", "e"):
        places = [r.place(s, r.state(s, q), name)[0] for s, r in ((scene, robot), (other, again))]
        np.testing.assert_allclose(places[1], places[0], atol=1e-12)


HINGE = body("a", '<joint name="a" axis="0 1 0"/>')
TENDON = '<tendon><fixed name="t"{0}><joint joint="a" coef="1"/></fixed></tendon>'
LACKING = {
    "fluid": (
        HINGE,
        '<option density="1000" viscosity=".1"/>',
        "<option> has density 1000 kg/m³ and viscosity 0.1 Pa s",
    ),
    "tendons": (
        EQUAL,
        '<tendon><fixed name="t" stiffness="1"><joint joint="a" coef="1"/><joint joint="b" coef="2"/></fixed>'
        "</tendon>",
        "'t': of tendons dano has only fixed ones",
    ),
    "ball limits": (
        body("a", '<joint name="a" type="ball" range="0 1" limited="true"/>'),
        "",
        "the ball joint 'a' has a range",
    ),
    "equalities": (
        EQUAL,
        '<equality><joint joint1="b" joint2="a" polycoef="0 0 1 0 0"/></equality>',
        r"joint 'b' follows the polynomial \[0.0, 0.0, 1.0, 0.0, 0.0\]",
    ),
    "other actuators": (
        HINGE,
        '<actuator><general name="m" joint="a" dyntype="integrator"/></actuator>',
        "actuator 'm' has a state of its own",
    ),
    "height fields": (
        HINGE + '<geom type="hfield" hfield="h"/>',
        '<asset><hfield name="h" nrow="2" ncol="2" size="1 1 1 1" elevation="0 1 0 1"/></asset>',
        "is a height field",
    ),
}


@pytest.mark.parametrize("feature", LACKING)
def test_what_dano_has_not_is_refused_by_name(feature, tmp_path):
    """One line names it and how to leave it out; `dano inspect` lists it."""
    world, rest, message = LACKING[feature]
    path = written(tmp_path, world, rest)
    with pytest.raises(ValueError, match=rf"{message}.*ignore=\['{feature}'\] leaves it out"):
        dano.load_mjcf(path, collision=False).scene()
    assert dano.load_mjcf(path, collision=False, ignore=feature).scene().names
    assert any(feature in doubt for doubt in robot_doubts(read_robot(path)))
    with pytest.raises(ValueError, match="ignore must hold some of"):
        dano.load_mjcf(path, ignore="everything")


def test_tendons_that_do_nothing_are_no_matter(tmp_path):
    assert dano.load_mjcf(written(tmp_path, HINGE, TENDON.format("")), collision=False).joints


def test_what_the_file_switches_off(tmp_path):
    """Flags of <option>: gravity, limits, equalities, actuators and contact."""
    off = " ".join(f'{k}="disable"' for k in ("gravity", "limit", "equality", "actuation", "contact"))
    rest = (
        f'<option><flag {off}/></option><equality><joint joint1="b" joint2="a"/></equality>'
        '<actuator><motor joint="a"/></actuator>'
    )
    world = EQUAL.replace('joint name="c"', 'joint name="c" range="0 1"')
    robot = dano.load_mjcf(written(tmp_path, world, rest))
    assert (robot.gravity, robot.drives, robot.touching) == ((0.0, 0.0, 0.0), {}, ())
    assert [joint.limits for joint in robot.joints] == [None] * 3


def test_meshes_of_mujoco(tmp_path):
    """A mesh that MuJoCo centres and scales lies where it has it; its hull is what touches."""
    pytest.importorskip("igl")
    corners = "0 0 0  2 0 0  0 3 0  0 0 4  .1 .1 .1"
    rest = f'<asset><mesh name="m" vertex="{corners}" scale=".1 .1 -.1"/></asset>'
    world = '<body name="a" pos="0 0 1"><joint/><geom name="g" type="mesh" mesh="m" pos=".1 0 0"/></body>'
    path = written(tmp_path, world, rest)
    shape = dano.load_mjcf(path).bodies[0].shape
    assert shape is not None
    # Inside the tetrahedron the distance is that to the nearest of its planes.
    for x, y, z in ((0.05, 0.1, -0.05), (0.02, 0.1, -0.2), (-0.05, 0.1, -0.1), (0.05, 0.05, -0.02)):
        slant = (1 - x / 0.2 - y / 0.3 + z / 0.4) / np.linalg.norm([1 / 0.2, 1 / 0.3, 1 / 0.4])
        found = -shape.sdf(jnp.array([x + 0.1, y, z]))
        np.testing.assert_allclose(found, min(x, y, -z, slant), atol=2e-3)
