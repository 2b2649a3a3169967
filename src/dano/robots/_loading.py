"""Robots from files."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from dano.archive import checked_input
from dano.maths import Pose
from dano.robots._build import build_robot
from dano.robots._robot import Robot
from dano.robots.formats import Description, read_mjcf, read_urdf


def load_urdf(
    path: str | Path,
    *,
    base: Pose | str | None = None,
    prefix: str = "",
    collision: bool | str | Mapping[str, str] = True,
    ignore: str | Sequence[str] = (),
    balance_inertia: bool = False,
) -> Robot:
    """A robot from a URDF file.

    Links that fixed joints hold together become one body. A floating joint leaves its child free.

    Args:
        path: The file. Meshes are looked for beside it; those of `package://` in the folders above it.
        base: Where the root link stands in the world; "floating" lets it move freely. Default: the origin.
        prefix: Before the names of bodies, so that two of a kind fit into one scene.
        collision: What links touch with in place of meshes: "hull", the convex hull of each (as True);
            "distance", the signed distance of the mesh itself; "pieces", convex pieces of it (extra
            `export`); "none" (as False), no shape at all. Or such a word by the names of links; the others
            have hulls. What was computed is kept in the user's cache folder.
        ignore: What to leave out by name, such as "weightless joints": joints that move nothing with mass,
            which then stay where they are; or "masses", all of them: the robot then serves kinematics.
        balance_inertia: Whether a link with an impossible inertia gets the mean of its three principal
            moments for each, as MuJoCo's `balanceinertia` does it. Otherwise it is an error.

    Raises:
        ImportError: If a mesh needs packages that are missing.
        ValueError: If the file is missing or broken, its joints make no tree, a joint moves nothing with
            mass, an inertia is impossible, a mesh is missing, or an argument is not one of those above.
    """
    source = checked_input(path)
    return build_robot(
        read_urdf(source),
        base=base,
        prefix=prefix,
        collision=collision,
        ignore=ignore,
        balance_inertia=balance_inertia,
    )


def load_mjcf(
    path: str | Path,
    *,
    base: Pose | str | None = None,
    prefix: str = "",
    collision: bool | str | Mapping[str, str] = True,
    ignore: str | Sequence[str] = (),
    balance_inertia: bool = False,
) -> Robot:
    """A robot from a file of MuJoCo, read by MuJoCo's own compiler; arguments are those of `load_urdf`.

    Coordinates, limits, springs and commands are MuJoCo's own; `robot.home` has the coordinates of the pose
    in the file. Gravity is that of the file. Motors and servos of joints become `dano.Motor`, `connect` and
    `weld` close loops, and linear equalities make joints follow others. A body with several joints becomes
    a chain of bodies, of which the last has its shapes. Each geom of the world is a fixed body with its name.

    What dano has no counterpart of is an error that names it; `ignore` leaves it out: "actuators" (all),
    "other actuators", "ball limits", "equalities", "fluid", "free joints", "gravcomp", "height fields",
    "nonlinear springs", "soft bodies", "tendons", "weightless joints".

    Raises:
        ImportError: If mujoco is missing.
        ValueError: As `load_urdf`; or if the file holds what dano cannot simulate.
    """
    source = checked_input(path)
    return build_robot(
        read_mjcf(source, balance_inertia=balance_inertia),
        base=base,
        prefix=prefix,
        collision=collision,
        ignore=ignore,
        balance_inertia=balance_inertia,
    )


def read_robot(path: str | Path) -> Description:
    """What a robot's file says: URDF, or MuJoCo's format, by what is in it.

    Raises:
        ImportError: If it is MuJoCo's, and mujoco is missing.
        ValueError: If the file is missing or broken.
    """
    source = checked_input(path)
    mjcf = b"<mujoco" in source.read_bytes()[:4096] and source.suffix != ".urdf"
    return read_mjcf(source) if mjcf else read_urdf(source)
