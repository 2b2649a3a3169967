"""Mass matrices and frames of URDF files against Pinocchio, where it is installed."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest
from robots.files import ARM, panda, shipped

import dano
from dano.maths import quat_to_matrix

pinocchio = pytest.importorskip("pinocchio")

FILES = {
    "arm": lambda: ARM,
    "panda": panda,
    "kuka": lambda: shipped("pybullet_data", "kuka_iiwa/model.urdf"),
    # Links without inertia between its joints, and a floating base made of them.
    "laikago": lambda: shipped("pybullet_data", "laikago/laikago.urdf"),
    "g1": lambda: shipped("frax", "assets/unitree_g1/floating_g1_29dof_rev_1_0.urdf"),
}


def weighed(path):
    """A file without inertia of links without mass, which dano leaves out as MuJoCo does."""
    root = ET.parse(path).getroot()
    for row in root.findall("link"):
        mass = row.find("inertial/mass")
        inertial = row.find("inertial")
        if inertial is not None and mass is not None and float(mass.get("value", "0")) == 0:
            row.remove(inertial)
    return ET.tostring(root).decode()


@pytest.mark.parametrize("name", FILES)
@pytest.mark.filterwarnings("ignore:joint .* starts at:RuntimeWarning")
def test_mass_matrix_and_frames_equal_those_of_pinocchio(name):
    path = FILES[name]()
    robot = dano.load_urdf(path, collision=False)
    scene = robot.scene()
    model = pinocchio.buildModelFromXML(weighed(path), mimic=True)
    data = model.createData()
    moving = [each for each in list(model.names)[1:] if each in robot.joint_names]
    angles = np.linspace(-0.4, 0.5, len(moving))
    q = pinocchio.neutral(model)
    for joint, angle in zip(moving, angles, strict=True):
        k = model.getJointId(joint)
        # A joint that turns without end has cosine and sine.
        q[model.idx_qs[k] :][: model.nqs[k]] = angle if model.nqs[k] == 1 else [np.cos(angle), np.sin(angle)]
    pinocchio.forwardKinematics(model, data, q)
    pinocchio.updateFramePlacements(model, data)
    mass = pinocchio.crba(model, data, q)
    mass = np.triu(mass) + np.triu(mass, 1).T
    state = robot.state(scene, dict(zip(moving, angles, strict=True)))
    for link in robot.frames:
        placement = data.oMf[model.getFrameId(link)]
        position, orientation, _ = robot.place(scene, state, link)
        np.testing.assert_allclose(position, placement.translation, atol=1e-11)
        np.testing.assert_allclose(quat_to_matrix(orientation), placement.rotation, atol=1e-11)
    children = [joint.child for joint in scene.joints]
    order = [scene.layout.coordinates[children.index(robot.joint_names[each])] for each in moving]
    rows = [model.idx_vs[model.getJointId(each)] for each in moving]
    found, expected = (
        np.asarray(dano.mass_matrix(scene, state))[np.ix_(order, order)],
        mass[np.ix_(rows, rows)],
    )
    exact = all(link.mass > 0 and np.any(link.inertia) for link in robot.description.links[1:])
    # A link without mass that carries others gets a billionth of what it carries.
    np.testing.assert_allclose(found, expected, atol=(1e-12 if exact else 1e-8) * np.abs(expected).max())
