"""Robots written to files are the same when they are read again, changed values included."""

import dataclasses

import numpy as np
import pytest
from robots.files import ARM, panda

import dano
from dano.robots import Robot


def numbers(robot: Robot):
    """All numbers of bodies, joints and frames that count, by name."""
    found = {}
    for body in robot.bodies:
        com = np.asarray(body.com + body.com_offset)
        found[body.name] = [
            float(body.mass * body.mass_scale),
            *com,
            *np.ravel(body.inertia * body.mass_scale),
        ]
    for joint in robot.joints:
        row = [joint.position, joint.orientation * np.sign(joint.orientation[0]), joint.axis, joint.anchor]
        row += [np.atleast_1d(getattr(joint, key)) for key in ("damping", "ratio", "shift", "rest")]
        optional = [getattr(joint, key) for key in ("friction", "armature", "stiffness")]
        row += [np.array([0.0 if x is None else float(x) for x in optional])]
        row += [np.array([-np.inf, np.inf]) if joint.limits is None else joint.limits]
        found[f"{joint.parent} {joint.child} {joint.kind} {joint.mimics}"] = np.concatenate(row)
    for link, (body, position, orientation) in robot.frames.items():
        found[f"{link} on {body}"] = [*position, *(orientation * np.sign(orientation[0]))]
    return found


def check(found: Robot, expected: Robot):
    here, there = numbers(found), numbers(expected)
    assert set(here) == set(there)
    for name, row in there.items():
        np.testing.assert_allclose(here[name], row, atol=1e-12, err_msg=name)


def test_panda_with_identified_values(tmp_path):
    """Load, change, export, load: the Panda with a payload's worth of mass and with friction."""
    robot = dano.load_urdf(panda(), collision=False)
    scene = robot.scene()
    hand, first = scene.names[-1], scene.names[0]
    changed = scene.replace_body(hand, mass_scale=1.3, com_offset=(0.01, 0.0, 0.02))
    changed = changed.replace_joint(first, friction=0.25, damping=0.5)
    path = dano.export_robot(robot, tmp_path / "panda.urdf", scene=changed)
    again = dano.load_urdf(path, collision=False)
    new = dataclasses.replace(robot, bodies=changed.bodies, joints=changed.joints)
    check(again, new)
    assert again.efforts == robot.efforts
    assert list(again.joint_names) == list(robot.joint_names)


@pytest.mark.parametrize("suffix", [".urdf", ".xml"])
def test_arm_as_it_was_loaded(tmp_path, suffix):
    """Shapes, mimicking fingers and limits, in both formats."""
    robot = dano.load_urdf(ARM)
    path = dano.export_robot(robot, tmp_path / f"arm{suffix}")
    if suffix == ".urdf":
        again = dano.load_urdf(path)
        check(again, robot)
        assert again.touching == robot.touching
    else:
        pytest.importorskip("mujoco")
        again = dano.load_mjcf(path)
        # In MuJoCo the base is a part of the world.
        assert [body.name for body in again.bodies[1:]] == [body.name for body in robot.bodies[1:]]
        scenes = [(r.scene(), r) for r in (robot, again)]
        masses = [np.asarray(dano.mass_matrix(s, r.state(s, dict(bend=0.8)))) for s, r in scenes]
        np.testing.assert_allclose(masses[0], masses[1], atol=1e-12)
        ends = [np.stack([j.limits for j in r.joints if j.limits is not None]) for r in (robot, again)]
        np.testing.assert_allclose(ends[0], ends[1], atol=1e-12)
    q = dict(lift=0.6, bend=0.8, grip=0.02)
    places = [np.asarray(r.place(s := r.scene(), r.state(s, q), "tool")[0]) for r in (robot, again)]
    np.testing.assert_allclose(places[0], places[1], atol=1e-12)


def test_springs_and_armature(tmp_path):
    """MuJoCo's format keeps them; URDF has no place for them, which is said."""
    pytest.importorskip("mujoco")
    source = tmp_path / "in.xml"
    source.write_text(
        """<mujoco><worldbody><body name="a" pos="0 0 1"><joint name="h" axis="0 1 0" range="-90 90"
        damping="0.3" armature="0.1" frictionloss="0.2" stiffness="3" springref="10"/>
        <inertial pos="0 0 0.1" mass="2" fullinertia="0.02 0.03 0.04 0.001 0.002 0.003"/>
        <body name="b" pos="0 0 -0.3"><joint name="s" type="ball" pos="0 0.1 0"/><geom size="0.05"/></body>
        </body></worldbody></mujoco>"""
    )
    robot = dano.load_mjcf(source)
    scene = robot.scene().replace_joint("a", armature=0.15)
    again = dano.load_mjcf(dano.export_robot(robot, tmp_path / "out.xml", scene=scene))
    check(again, dataclasses.replace(robot, joints=scene.joints))
    with (
        pytest.raises(ValueError, match="beside its link's origin"),
        pytest.warns(UserWarning, match="springs"),
    ):
        dano.export_robot(robot, tmp_path / "out.urdf")
    assert not (tmp_path / "out.urdf").exists()


def test_wrong_requests_are_errors(tmp_path):
    robot = dano.load_urdf(ARM, collision=False)
    with pytest.raises(ValueError, match=r"must end in one of .urdf, .xml"):
        dano.export_robot(robot, tmp_path / "arm.step")
    other = dano.Scene.create([dano.Body("ball", dano.Sphere(0.1), mass=1.0)])
    with pytest.raises(ValueError, match="scene must hold the robot's bodies"):
        dano.export_robot(robot, tmp_path / "arm.urdf", scene=other)
