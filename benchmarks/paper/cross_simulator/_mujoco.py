"""MuJoCo's side: a body on a plane, slid and pushed, with elliptic friction cones and `impratio` 10."""

from typing import NamedTuple

import numpy as np

FRAME = 0.01  # s
DURATION = 0.6  # s
PUSHED = 0.3  # s
SUBSTEPS = 20
SETTLE = 1.0  # s
GRAVITY = 9.81  # m/s²


class Run(NamedTuple):
    """One motion.

    Attributes:
        position: Of the body's origin [m, W], frames of `FRAME`, shape (T, 3).
        orientation: Quaternions wxyz, shape (T, 4).
        force: At the centre of mass for the first `PUSHED` seconds [N, W], shape (3,).
    """

    position: np.ndarray
    orientation: np.ndarray
    force: np.ndarray


def box_geom(half_extents: np.ndarray) -> tuple[str, str]:
    """Assets and geom of a box."""
    return "", f'<geom type="box" size="{_words(half_extents)}"'


def hull_geom(vertices: np.ndarray) -> tuple[str, str]:
    """Assets and geom of the convex hull of points [m], shape (n, 3)."""
    mesh = f'<asset><mesh name="hull" inertia="convex" vertex="{_words(vertices.ravel())}"/></asset>'
    return mesh, '<geom type="mesh" mesh="hull"'


def simulate(
    geometry: tuple[str, str], mass: float, friction: float, height: float, directions: np.ndarray
) -> list[Run]:
    """For each direction along the plane [rad] a slide that begins at 1 m/s and a push from rest.

    Args:
        geometry: As `box_geom` and `hull_geom` make it.
        mass: [kg].
        friction: Of the contact.
        height: Of the body's origin where it is dropped from [m].
        directions: [rad].
    """
    import mujoco

    assets, geom = geometry
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{FRAME / SUBSTEPS}" gravity="0 0 {-GRAVITY}" cone="elliptic" '
        'impratio="10"/>'
        f"{assets}<worldbody>"
        f'<geom type="plane" size="5 5 1" condim="3" friction="{friction} 0 0"/>'
        f'<body pos="0 0 {height}"><freejoint/>{geom} mass="{mass}" condim="3" friction="{friction} 0 0"/>'
        "</body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    for _ in range(round(SETTLE / FRAME) * SUBSTEPS):
        mujoco.mj_step(model, data)
    rest = data.qpos.copy()
    runs = []
    for angle in directions:
        along = np.array([np.cos(angle), np.sin(angle), 0.0])
        push = 2.0 * friction * mass * GRAVITY * along
        for velocity, force in ((along, np.zeros(3)), (np.zeros(3), push)):
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:3] = rest, velocity
            runs.append(_run(mujoco, model, data, force))
    return runs


def _run(mujoco, model, data, force: np.ndarray) -> Run:
    poses = [data.qpos.copy()]
    for frame in range(round(DURATION / FRAME)):
        data.xfrc_applied[1, :3] = force if frame < round(PUSHED / FRAME) else 0.0
        for _ in range(SUBSTEPS):
            mujoco.mj_step(model, data)
        poses.append(data.qpos.copy())
    rows = np.array(poses)
    return Run(rows[:, :3], rows[:, 3:7], force)


def _words(numbers: np.ndarray) -> str:
    return " ".join(f"{x:.9g}" for x in numbers)
