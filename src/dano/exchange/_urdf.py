"""The format of ROS, read by PyBullet, Drake, Isaac and others."""

from pathlib import Path

import numpy as np

from dano.exchange._triangles import Contents, MESHES, PLAIN, VISUAL, words

NOTES = (
    "URDF has no friction of its own. What is in <contact> is read by PyBullet, which multiplies the friction"
    " of the two bodies: give the floor a friction of 1. Restitution it takes from"
    " changeDynamics(restitution=…) only. Load with flags=URDF_USE_INERTIA_FROM_FILE, or PyBullet takes the"
    " inertia of a box.",
    "PyBullet lays a margin of 1 mm around each convex piece: small objects float by as much.",
    "URDF: mesh paths are relative to the file; ROS wants package://NAME/meshes/… instead.",
)


def write_urdf(folder: Path, contents: Contents) -> list[str]:
    """Write `NAME.urdf`; names of the files."""
    name = contents.name
    (folder / f"{name}.urdf").write_text(_robot(contents), encoding="utf-8")
    return [f"{name}.urdf"]


def _robot(contents: Contents) -> str:
    # Principal axes: some readers leave out what is not on the diagonal.
    moments, axes = np.linalg.eigh(contents.inertia)
    if np.linalg.det(axes) < 0:
        axes = axes * np.array([1.0, 1.0, -1.0])
    xx, yy, zz = (repr(float(moment)) for moment in moments)
    pieces = [
        line
        for piece in contents.piece_names
        for line in (
            "    <collision>",
            f'      <geometry><mesh filename="{MESHES}/{piece}.obj"/></geometry>',
            "    </collision>",
        )
    ]
    return "\n".join(
        [
            '<?xml version="1.0"?>',
            f'<robot name="{contents.name}">',
            '  <mujoco><compiler discardvisual="false" fusestatic="false"/></mujoco>',
            f'  <link name="{contents.name}">',
            *_contact(contents),
            "    <inertial>",
            f'      <origin xyz="{words(contents.com)}" rpy="{words(roll_pitch_yaw(axes))}"/>',
            f'      <mass value="{contents.mass!r}"/>',
            f'      <inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/>',
            "    </inertial>",
            "    <visual>",
            f'      <geometry><mesh filename="{MESHES}/{VISUAL}.obj"/></geometry>',
            *_material(contents),
            "    </visual>",
            *pieces,
            "  </link>",
            "</robot>",
            "",
        ]
    )


def _contact(contents: Contents) -> list[str]:
    given = {
        "lateral_friction": contents.friction,
        "spinning_friction": contents.parameter("torsional_friction"),
        "rolling_friction": contents.parameter("rolling_friction"),
    }
    rows = [f'      <{tag} value="{value!r}"/>' for tag, value in given.items() if value is not None]
    return ["    <contact>", *rows, "    </contact>"]


def _material(contents: Contents) -> list[str]:
    # A colour here would be laid over the picture that the mesh names.
    if contents.texture is not None:
        return []
    return [
        f'      <material name="{contents.name}"><color rgba="{words(np.array([*PLAIN, 1.0]))}"/></material>'
    ]


def roll_pitch_yaw(rotation: np.ndarray) -> np.ndarray:
    """Angles [rad] with R = Rz(yaw) Ry(pitch) Rx(roll), as URDF has them, of a rotation matrix."""
    across = float(np.hypot(rotation[0, 0], rotation[1, 0]))
    pitch = np.arctan2(-rotation[2, 0], across)
    if across > 1e-9:
        roll = np.arctan2(rotation[2, 1], rotation[2, 2])
        return np.array([roll, pitch, np.arctan2(rotation[1, 0], rotation[0, 0])])
    # Upright: only the difference of the other two matters.
    return np.array([np.arctan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0])
