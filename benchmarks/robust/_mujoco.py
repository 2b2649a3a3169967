"""The same scenes in MuJoCo, at its default options but for the integrator.

That is "implicit", for with the default one bodies that tumble fast in free flight gain energy without limit.

Shapes are MuJoCo's own, without rounding; the bunny is the mesh that it was made from (its convex hull, as
MuJoCo takes meshes), the soap a box of the same extents. Masses and inertias are dano's. MuJoCo takes the
larger friction coefficient of a pair, as the drawn scenes do; it has no coefficient of restitution.
"""

import time
from dataclasses import dataclass

import numpy as np

from benchmarks._measure import REPOSITORY
from benchmarks.robust._draw import Material, Piece, Start, Structure
from benchmarks.robust._judge import Motion

BUNNY_SIZE = 0.12  # [m], as assets/make_objects.py makes it
SOAP_HALF_EXTENTS = (0.045, 0.03, 0.015)  # [m], as assets/solids.py has it


@dataclass(frozen=True)
class Played:
    """A motion, the warnings that MuJoCo counted, and the CPU time [s]."""

    motion: Motion
    warnings: int
    seconds: float


def model_of(structure: Structure, material: Material, inertia: np.ndarray, com: np.ndarray):
    """The scene as a compiled model.

    Args:
        structure: Its shapes.
        material: Masses, friction, timestep.
        inertia: About the centres of mass [kg m², B], shape (n, 3, 3).
        com: Centres of mass in the frames of the shapes [m], shape (n, 3).
    """
    import mujoco

    bodies = "".join(
        f'<body name="{piece.name}"><freejoint/>'
        f'<inertial pos="0 0 0" mass="{material.masses[i]}" fullinertia="{_six(inertia[i])}"/>'
        f'<geom {_geom(piece)} pos="{_words(-com[i])}" friction="{material.frictions[i]}"/></body>'
        for i, piece in enumerate(structure.pieces)
    )
    walls = "".join(
        f'<geom type="box" size="{_words(wall.half_extents)}" pos="{_words(wall.centre)}" friction="0"/>'
        for wall in structure.walls
    )
    scale = _words([BUNNY_SIZE] * 3)
    xml = (
        f'<mujoco><option timestep="{material.timestep}" integrator="implicit"/>'
        '<compiler balanceinertia="true"/>'
        f'<asset><mesh name="bunny" file="bunny.obj" scale="{scale}"/></asset>'
        f'<worldbody><geom type="plane" size="50 50 1" friction="0"/>{walls}{bodies}</worldbody></mujoco>'
    )
    return mujoco.MjModel.from_xml_string(xml, {"bunny.obj": (REPOSITORY / "assets/bunny.obj").read_bytes()})


def play(model, start: Start, inertia: np.ndarray, n_steps: int) -> Played:
    """Simulate and keep all states."""
    import mujoco

    # They are counted below; MuJoCo would also write each to the terminal and to a file.
    mujoco.set_mju_user_warning(lambda _: None)
    data = mujoco.MjData(model)
    n = len(start.position)
    data.qpos[:] = np.concatenate([start.position, start.orientation], axis=1).ravel()
    data.qvel[:] = np.concatenate([start.velocity, start.omega], axis=1).ravel()
    places, speeds = [data.qpos.copy()], [data.qvel.copy()]
    seconds = 0.0
    for _ in range(n_steps):
        before = time.process_time()
        mujoco.mj_step(model, data)
        seconds += time.process_time() - before
        places.append(data.qpos.copy())
        speeds.append(data.qvel.copy())
    pose, twist = np.array(places).reshape(-1, n, 7), np.array(speeds).reshape(-1, n, 6)
    motion = Motion(pose[..., :3], pose[..., 3:], twist[..., :3], twist[..., 3:], inertia)
    return Played(motion, int(sum(warning.number for warning in data.warning)), seconds)


def _geom(piece: Piece) -> str:
    lengths = _words(piece.lengths)
    match piece.kind:
        case "box" | "plate" | "rounded box":
            return f'type="box" size="{lengths}"'
        case "sphere" | "capsule" | "cylinder" | "ellipsoid":
            return f'type="{piece.kind}" size="{lengths}"'
        case "bunny" | "trained_bunny":
            return 'type="mesh" mesh="bunny"'
    return f'type="box" size="{_words(SOAP_HALF_EXTENTS)}"'


def _six(I: np.ndarray) -> str:
    return _words([I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]])


def _words(numbers) -> str:
    return " ".join(f"{x:.9g}" for x in numbers)
