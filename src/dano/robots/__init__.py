"""Robots: files of links and joints in, bodies and joints of a scene out; kinematics and dynamics."""

from dano.robots._build import build_robot as build_robot
from dano.robots._control import (
    JointPD as JointPD,
    operational_space_torque as operational_space_torque,
    pd as pd,
)
from dano.robots._dynamics import (
    bias_forces as bias_forces,
    computed_torque as computed_torque,
    drifted as drifted,
    generalised_velocities as generalised_velocities,
    gravity_forces as gravity_forces,
    joint_control as joint_control,
    joint_reactions as joint_reactions,
    mass_matrix as mass_matrix,
)
from dano.robots._geometry import mesh_of as mesh_of
from dano.robots._inspect import (
    load_mjcf as load_mjcf,
    load_urdf as load_urdf,
    read_robot as read_robot,
    robot_doubts as robot_doubts,
    robot_tree as robot_tree,
)
from dano.robots._inverse import (
    close_loops as close_loops,
    inverse_kinematics as inverse_kinematics,
    InverseKinematics as InverseKinematics,
    loop_gaps as loop_gaps,
    Target as Target,
)
from dano.robots._robot import Robot as Robot
from dano.robots.formats import (
    at_home as at_home,
    Connection as Connection,
    Description as Description,
    Drive as Drive,
    Link as Link,
    Placed as Placed,
    Solid as Solid,
    Tie as Tie,
)
