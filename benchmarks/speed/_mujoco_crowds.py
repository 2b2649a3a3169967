"""The same crowds in MuJoCo at its default options: a bunny is the hull of the mesh that it was made from."""

from collections.abc import Sequence

import numpy as np

import dano
from benchmarks._measure import REPOSITORY
from benchmarks.speed._cases import Case
from benchmarks.speed._crowds import Crowd, DEMO, HALF, MASS, Member, REPEATS, TIMESTEP
from benchmarks.speed._dano import FRICTION
from dano.scene_file import load_asset

BUNNY_SIZE = 0.12  # [m]
SOAP_HALF_EXTENTS = (0.045, 0.03, 0.015)  # [m], as assets/solids.py has it
DEMO_STEPS = 320


def mujoco_crowd_case(crowd: Crowd) -> Case:
    """A crowd from the same start, for as many steps."""
    center = _bunny_center() if any(member.kind == "bunny" for member in crowd.members) else np.zeros(3)
    bodies = "".join(_body(member, _geom(member.kind, center)) for member in crowd.members)
    name = f"MuJoCo: {crowd.name}"
    return _case(crowd.group, name, bodies, crowd.n_steps, count=crowd.count)


def mujoco_demo_case() -> Case:
    """The demo's drop, as `drop.toml` beside this file has it: a hull, a box for the soap, a ball."""
    box = " ".join(str(x) for x in SOAP_HALF_EXTENTS)
    bodies = _body(
        Member("bunny", np.array([0.0, 0.0, 0.25]), np.array([0.924, 0.32, 0.2, 0.0])),
        _geom("bunny", _bunny_center()),
    )
    bodies += _body(
        Member("soap", np.array([0.02, 0.01, 0.40]), np.array([0.87, 0.25, 0.1, 0.41])),
        f'<geom type="box" size="{box}" mass="0.15" friction="{FRICTION}"/>',
    )
    bodies += _body(
        Member("ball", np.array([0.3, 0.03, 0.1]), np.array([1.0, 0.0, 0.0, 0.0])),
        f'<geom type="sphere" size="0.035" mass="0.2" friction="{FRICTION}"/>',
    )
    return _case(DEMO, "MuJoCo: drop of the demo", bodies, DEMO_STEPS, speeds={12: -0.6})


def _bunny_center() -> np.ndarray:
    """Centre of mass of dano's bunny in the frame of the mesh [m]."""
    bunny = load_asset("trained_bunny")
    assert isinstance(bunny, dano.NeuralObject)
    return np.asarray(bunny.mass.com)


def _geom(kind: str, center: np.ndarray) -> str:
    shape = {
        "box": f'type="box" size="{HALF} {HALF} {HALF}"',
        "sphere": f'type="sphere" size="{HALF}"',
        "bunny": f'type="mesh" mesh="bunny" pos="{_words(-center)}"',
    }[kind]
    return f'<geom {shape} mass="{MASS[kind]}" friction="{FRICTION}"/>'


def _body(member: Member, geom: str) -> str:
    return (
        f'<body pos="{_words(member.position)}" quat="{_words(member.orientation)}"><freejoint/>{geom}</body>'
    )


def _case(
    group: str,
    name: str,
    bodies: str,
    n_steps: int,
    speeds: dict[int, float] | None = None,
    count: int | None = None,
) -> Case:
    import mujoco

    scale = _words([BUNNY_SIZE] * 3)
    xml = (
        f'<mujoco><option timestep="{TIMESTEP}"/>'
        f'<asset><mesh name="bunny" file="bunny.obj" scale="{scale}"/></asset>'
        f'<worldbody><geom type="plane" size="5 5 1" friction="{FRICTION}"/>{bodies}</worldbody></mujoco>'
    )
    mesh = (REPOSITORY / "assets/bunny.obj").read_bytes()
    model = mujoco.MjModel.from_xml_string(xml, {"bunny.obj": mesh})
    data = mujoco.MjData(model)

    def run():
        mujoco.mj_resetData(model, data)
        for index, speed in (speeds or {}).items():
            data.qvel[index] = speed
        mujoco.mj_step(model, data, n_steps)

    run()
    note = f"{data.ncon} contact points at the end"
    # A blown-up simulation goes on from its initial state, which would pass for a fast one.
    note += ", UNSTABLE" if any(warning.number for warning in data.warning) else ""
    return Case(group, name, run, count or n_steps, note=note, repeats=REPEATS)


def _words(numbers: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{x:.9g}" for x in numbers)
