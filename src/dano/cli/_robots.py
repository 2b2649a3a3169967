"""`dano inspect` of a robot's file."""

from pathlib import Path

from dano.cli._console import put, put_json
from dano.robots import read_robot, robot_doubts, robot_tree

SUFFIXES = (".urdf", ".xml", ".mjcf")
"""Names of files that hold robots end so."""


def inspect_robot(path: Path, *, as_json: bool) -> None:
    """Print the tree of a robot's file, and what is odd about it.

    Raises:
        ValueError: If the file is missing or broken.
    """
    robot = read_robot(path)
    doubts, mass = robot_doubts(robot), sum(link.mass for link in robot.links)
    moving = [joint for joint in robot.joints if joint.kind != "weld"]
    if as_json:
        put_json(
            {
                "file": str(path),
                "name": robot.name,
                "mass": mass,
                "links": [link.name for link in robot.links],
                "joints": {joint.name: joint.kind for joint in robot.joints},
                "odd": doubts,
            }
        )
        return
    put(f"robot   {robot.name}, {len(robot.links)} links, {len(moving)} joints that move, {mass:.6g} kg")
    put()
    for line in robot_tree(robot):
        put(line)
    put()
    put("nothing odd" if not doubts else "odd:")
    for doubt in doubts:
        put(f"  {doubt}")
