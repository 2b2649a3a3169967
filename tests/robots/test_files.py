"""Robot files: what is read, what is refused and how it is said."""

import jax.numpy as jnp
import numpy as np
import pytest
from engine.trees import coordinates
from robots.files import ARM

import dano
from dano.cli import main
from dano.robots import read_robot, robot_doubts, robot_tree
from dano.scene_file import parse_scene

BODY = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'


def link(name, inside=BODY):
    return f'<link name="{name}">{inside}</link>'


def joint(name, parent, child, inside="", kind="revolute"):
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{inside}</joint>'


MISSING = '<collision><geometry><mesh filename="no.stl"/></geometry></collision>'
BROKEN = {
    "no XML": ("<robot", "must be a URDF file, got broken XML"),
    "no robot": ("<mujoco/>", "with a <robot>, got <mujoco>"),
    "missing mesh": (
        link("a", "") + link("b", BODY + MISSING) + joint("j", "a", "b"),
        "mesh must be a file, got .*no.stl, which does not exist",
    ),
    "no mass": (
        link("a", "") + link("b", "") + joint("j", "a", "b"),
        "mass must be > 0 kg.* got none for 'j'",
    ),
    "zero inertia": (
        link("a", "") + link("b", BODY.replace('ixx="1"', 'ixx="0"')) + joint("j", "a", "b"),
        "the inertia about its axis, of what each joint moves by itself, got none for 'j'",
    ),
    "inertia of no body": (
        link("a", "") + link("b", BODY.replace('ixx="1"', 'ixx="5"')) + joint("j", "a", "b"),
        "link 'b'.* must be possible",
    ),
    "unknown type": (
        link("a") + link("b") + joint("j", "a", "b", kind="screw"),
        "one of .*'screw'",
    ),
    "unknown link": (link("a") + joint("j", "a", "b"), "child of joint 'j' must be a link, got 'b'"),
    "cycle": (
        link("a") + link("b") + joint("j", "a", "b") + joint("k", "b", "a"),
        "joints must make a tree, got a circle",
    ),
    "two parents": (
        link("a") + link("b") + link("c") + joint("j", "a", "b") + joint("k", "c", "b"),
        "link 'b' must hang on one joint",
    ),
    "two roots": (link("a") + link("b"), "must have one root link, got 2: a, b"),
    "two of a name": (link("a") + link("a"), "different names, got 'a' twice"),
    "mimic of nothing": (
        link("a") + link("b") + joint("j", "a", "b", '<mimic joint="no"/>'),
        "joint 'j' must mimic a joint, got 'no'",
    ),
    "no number": (
        link("a") + link("b") + joint("j", "a", "b", '<axis xyz="0 0 x"/>'),
        "xyz of <axis> must be 3 finite numbers, got '0 0 x'",
    ),
    "no axis": (link("a") + link("b") + joint("j", "a", "b", '<axis xyz="0 0 0"/>'), "axis must not be zero"),
    "crossed limits": (
        link("a") + link("b") + joint("j", "a", "b", '<limit lower="1" upper="0"/>'),
        "lower limit must not exceed the upper",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_files_give_one_plain_line(case, tmp_path):
    text, message = BROKEN[case]
    path = tmp_path / "robot.urdf"
    path.write_text(text if text.startswith(("<robot", "<mujoco")) else f'<robot name="r">{text}</robot>')
    with pytest.raises(ValueError, match=message) as error:
        dano.load_urdf(path)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


def test_arm_of_our_own():
    """Groups, coordinates, limits and the finger that follows."""
    robot = dano.load_urdf(ARM)
    assert [body.name for body in robot.bodies] == [
        "base", "shoulder", "upper", "lower", "left_finger", "right_finger",
    ]  # fmt: skip
    assert list(robot.joint_names) == ["turn", "lift", "bend", "grip"]
    assert robot.frames["tool"][0] == "lower"
    assert robot.efforts["bend"] == 12
    assert robot_doubts(robot.description) == []
    np.testing.assert_allclose(robot.bodies[3].mass, 0.55)
    scene = robot.scene()
    state = robot.state(scene, dict(lift=np.pi / 2, grip=0.03))
    tool, _, jacobian = robot.place(scene, state, "tool")
    np.testing.assert_allclose(tool, [0.51, 0.0, 0.11], atol=1e-12)
    assert jacobian.shape == (6, 4)
    ends = [robot.place(scene, state, side)[0] for side in ("left_finger", "right_finger")]
    np.testing.assert_allclose(ends[0] - ends[1], [0, 0.06, 0], atol=1e-12)
    with pytest.raises(ValueError, match="did you mean 'bend'"):
        robot.state(scene, dict(bnd=1.0))


def test_base_and_prefix():
    """A robot elsewhere, and one that floats."""
    place = dano.Pose((1.0, 2.0, 0.0), (np.sqrt(0.5), 0, 0, np.sqrt(0.5)))
    robot = dano.load_urdf(ARM, base=place, prefix="left ")
    scene = robot.scene()
    state = robot.state(scene, dict(lift=np.pi / 2))
    np.testing.assert_allclose(robot.place(scene, state, "tool")[0], [1.0, 2.51, 0.11], atol=1e-12)
    np.testing.assert_allclose(state.position[scene.index("left base")], [1.0, 2.0, 0.0], atol=1e-12)
    with pytest.raises(ValueError, match="base must be"):
        dano.load_urdf(ARM, base="flying")
    with pytest.raises(ValueError, match="link 'base': mass must be > 0"):
        dano.load_urdf(ARM, base="floating")


def test_mjcf(tmp_path):
    """Joints, springs and what follows what, as MuJoCo's compiler has them."""
    pytest.importorskip("mujoco")
    path = tmp_path / "arm.xml"
    path.write_text(
        """<mujoco><worldbody><body name="a" pos="0 0 1"><joint name="h" axis="0 1 0" range="-90 90"
        damping="0.3" armature="0.1" frictionloss="0.2" stiffness="3" springref="10"/>
        <geom type="capsule" size="0.05 0.2"/>
        <body name="b" pos="0 0 -0.3"><joint name="s" type="slide" axis="0 0 1"/><geom size="0.05"/></body>
        <body name="c" pos="0 0.2 0"><joint name="t" type="slide" axis="1 0 0"/><geom size="0.05"/></body>
        </body></worldbody>
        <equality><joint joint1="t" joint2="s" polycoef="0.1 2 0 0 0"/></equality></mujoco>"""
    )
    robot = dano.load_mjcf(path)
    assert list(robot.joint_names) == ["h", "s"]
    first, _, third = robot.joints
    assert first.limits is not None
    np.testing.assert_allclose(first.limits, [-np.pi / 2, np.pi / 2])
    names = ("damping", "armature", "friction", "stiffness", "rest")
    numbers = [float(getattr(first, name)) for name in names]
    np.testing.assert_allclose(numbers, [0.3, 0.1, 0.2, 3.0, np.deg2rad(10)])
    assert (third.mimics, float(third.ratio), float(third.shift)) == ("b", 2.0, 0.1)
    assert robot.touching == ("a", "b", "c")
    path.write_text("<mujoco><nothing/></mujoco>")
    with pytest.raises(ValueError, match="must be a file that MuJoCo reads"):
        dano.load_mjcf(path)


FOUR_BAR = """<mujoco><compiler angle="radian"/><worldbody>
    <body name="crank"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.01"/>
    <body name="coupler" pos="0.2 0 0"><joint axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.01"/>{sites[0]}</body></body>
    <body name="rocker" pos="0.45 0 0"><joint axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 -0.25 0 0" size="0.01"/>{sites[1]}</body>
    </worldbody><equality>{tie}</equality></mujoco>"""
SITES = ('<site name="a" pos="0.4 0 0"/>', '<site name="b" pos="-0.25 0 0" quat="0.5 0.5 0.5 0.5"/>')
TIES = {
    # The bars lie on one line: the rocker's end is 0.2 m from the origin, where the coupler begins.
    "connect": ("", ""),
    "connect of sites": SITES,
    "weld of sites": SITES,
}


@pytest.mark.parametrize("kind", TIES)
def test_loops_of_mjcf(kind, tmp_path):
    """What MuJoCo holds together is held; what is written again is read as the same."""
    mujoco = pytest.importorskip("mujoco")
    tie = {
        "connect": '<connect body1="coupler" body2="rocker" anchor="0 0.1 0"/>',
        "connect of sites": '<connect site1="a" site2="b"/>',
        "weld of sites": '<weld site1="a" site2="b"/>',
    }[kind]
    path = tmp_path / "four.xml"
    path.write_text(FOUR_BAR.format(sites=TIES[kind], tie=tie))
    robot = dano.load_mjcf(path)
    dano.export_robot(robot, tmp_path / "again.xml")
    for again in (robot, dano.load_mjcf(tmp_path / "again.xml")):
        scene = again.scene()
        state = scene.initial_state(crank=dict(q=0.3), coupler=dict(q=-0.4), rocker=dict(q=0.2))
        assert scene.closing is not None
        gaps = np.asarray(scene.closing.gaps(state.position, state.orientation))
        model = mujoco.MjModel.from_xml_path(str(path))
        data = mujoco.MjData(model)
        data.qpos[:] = state.q
        mujoco.mj_forward(model, data)
        theirs = data.efc_pos[: gaps.size]
        # MuJoCo's gap is that of the first against the second; its turn is half of that in other axes.
        np.testing.assert_allclose(-gaps[:3], theirs[:3], atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(gaps[3:]), 2 * np.linalg.norm(theirs[3:]), atol=1e-9)
    assert any("loop: coupler and rocker" in line for line in robot_tree(robot.description))
    with pytest.raises(ValueError, match="URDF has no loops, got one of 'coupler' and 'rocker'"):
        dano.export_robot(robot, tmp_path / "again.urdf")


def test_loops_in_scene_files(tmp_path):
    """`[[loops]]` close from the coordinates that are given; the others follow."""
    rod = """
    [[bodies]]
    name = "{0}"
    shape = "box"
    half_extents = [{1}, 0.01, 0.01]
    mass = 0.5
    {3}
    [[joints]]
    child = "{0}"
    axis = [0.0, 1.0, 0.0]
    anchor = [-{1}, 0.0, 0.0]
    position = [{2}, 0.0, 0.0]
    """
    text = (
        "n_steps = 2\n"
        + rod.format("crank", 0.1, 0.1, "q = -0.9")
        + rod.format("rocker", 0.2, 0.65, "")
        + rod.format("coupler", 0.25, 0.35, "")
        + 'parent = "crank"\n[[loops]]\nfirst = "coupler"\nsecond = "rocker"\n'
        + "position = [0.25, 0.0, 0.0]\nanchor = [0.2, 0.0, 0.0]\n"
    )
    file = parse_scene(text, tmp_path / "scene.toml")
    assert file.scene.closing is not None
    np.testing.assert_allclose(coordinates(file.state)[0][0], -0.9)
    np.testing.assert_allclose(
        file.scene.closing.gaps(file.state.position, file.state.orientation), 0, atol=1e-11
    )
    with pytest.raises(ValueError, match=r"\[\[loops\]\] 1.*unknown key 'frst'.*did you mean 'first'"):
        parse_scene(text.replace("first =", "frst ="), tmp_path / "scene.toml")


def test_meshes_are_kept_by_their_content(tmp_path, monkeypatch):
    """A mesh becomes a signed distance once, and is read from the cache afterwards."""
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("igl")
    monkeypatch.setenv("DANO_CACHE_DIR", str(tmp_path / "cache"))
    trimesh.creation.box((0.2, 0.1, 0.1)).export(tmp_path / "box.stl")
    mesh = '<collision><geometry><mesh filename="package://p/box.stl"/></geometry></collision>'
    path = tmp_path / "robot.urdf"
    path.write_text(f'<robot name="r">{link("a", "")}{link("b", BODY + mesh)}{joint("j", "a", "b")}</robot>')
    first = dano.load_urdf(path).bodies[0]
    kept = list((tmp_path / "cache" / "meshes").iterdir())
    assert len(kept) == 1
    assert first.shape is not None
    np.testing.assert_allclose(first.shape.sdf(jnp.array([0.15, 0.0, 0.0])), 0.05, atol=2e-3)
    stamp = kept[0].stat().st_mtime_ns
    again = dano.load_urdf(path).bodies[0]
    assert again.shape is not None
    assert kept[0].stat().st_mtime_ns == stamp
    np.testing.assert_allclose(again.shape.sdf(jnp.zeros(3)), first.shape.sdf(jnp.zeros(3)), atol=1e-6)


def test_tree_and_doubts(tmp_path, capsys):
    """`dano inspect` prints the tree and what is odd."""
    lines = robot_tree(read_robot(ARM))
    assert lines[0] == "base"
    assert any("follows 'grip'" in line for line in lines)
    path = tmp_path / "odd.urdf"
    odd = link("b", BODY.replace('ixx="1"', 'ixx="5"'))
    path.write_text(
        f'<robot name="odd">{link("a", "")}{odd}{link("c", "")}'
        f"{joint('j', 'a', 'b')}{joint('k', 'b', 'c')}</robot>"
    )
    main(["inspect", str(path)])
    printed = capsys.readouterr().out
    assert "inertia is impossible" in printed
    assert "link 'c': no mass" in printed
    main(["inspect", str(ARM)])
    assert "nothing odd" in capsys.readouterr().out


def test_robots_in_scene_files(tmp_path):
    """`[[robots]]` with a file, a base and joints, beside a ball and a floor."""
    (tmp_path / "arm.urdf").write_bytes(ARM.read_bytes())
    text = """
    n_steps = 2
    [[robots]]
    urdf = "arm.urdf"
    base = { position = [0.0, 0.0, 0.5] }
    joints = { lift = 0.5, grip = 0.01 }
    [[bodies]]
    name = "ball"
    shape = "sphere"
    radius = 0.05
    mass = 0.1
    position = [2.0, 0.0, 1.0]
    """
    file = parse_scene(text, tmp_path / "scene.toml")
    assert file.scene.names[0] == "ball"
    np.testing.assert_allclose(coordinates(file.state)[0], [0.0, 0.5, 0.0, 0.01])
    np.testing.assert_allclose(file.state.position[1], [0.0, 0.0, 0.5])
    assert all("ball" in pair for pair in file.scene.pairs)
    assert tmp_path / "arm.urdf" in file.inputs()
    with pytest.raises(ValueError, match=r"\[\[robots\]\] 1.*unknown key 'lft'.*did you mean 'lift'"):
        parse_scene(text.replace("lift =", "lft ="), tmp_path / "scene.toml")
    with pytest.raises(ValueError, match="needs exactly one of urdf, mjcf"):
        parse_scene(text.replace("urdf =", "prefix ="), tmp_path / "scene.toml")
