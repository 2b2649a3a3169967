"""MuJoCo's C engine on the same shape: the mesh from which the shipped bunny was made, 12 cm and 1 kg.

The hull is what MuJoCo makes of a mesh unless asked otherwise. With `type="sdf"` two meshes collide by their
signed distances, at MuJoCo's default options; a plane still meets the hull.

The models are written as a user of MuJoCo writes them: `MuJoCoEngine` lists the pairs of a scene one by one,
past MuJoCo's broad phase, and takes its state from dano before each step. That is not what a step costs.
"""

from collections.abc import Callable, Sequence

from benchmarks._measure import REPOSITORY
from benchmarks.speed._cases import Case
from benchmarks.speed._dano import FLOOR, FRICTION, GRAVITY, N_STEPS, PRESSED

SIZE = 0.12  # [m]
SETTLE = 2.0  # [s]


def mujoco_floor_cases() -> list[Case]:
    """Sphere and bunny hull on a plane, at MuJoCo's default timestep and at 10 ms."""
    sphere = '<geom type="sphere" size="0.05" mass="1"/>'
    cases = [_case(FLOOR, "MuJoCo: sphere rests", _model([sphere], 0.002))]
    for timestep in (0.002, 0.01):
        model = _model([_bunny("mesh")], timestep)
        for word, speed in (("slides", 0.6 * FRICTION * GRAVITY * N_STEPS * timestep), ("rests", 0.0)):
            name = f"MuJoCo: bunny's hull {word}, h = {1000 * timestep:g} ms"
            cases.append(_case(FLOOR, name, model, speed=speed))
    return cases


def mujoco_pressed_cases() -> list[Case]:
    """Two bunnies on a plane, drawn together by a spring between their centres."""
    cases = []
    for kind, words in (("mesh", "hulls"), ("sdf", "signed distances")):
        model = _model([_bunny(kind)] * 2, 0.002)
        cases.append(_case(PRESSED, f"MuJoCo: two bunny {words} on a plane", model))
    return cases


def _bunny(kind: str) -> str:
    return f'<geom type="{kind}" mesh="bunny" mass="1" friction="{FRICTION}"/>'


def _model(geoms: list[str], timestep: float):
    """Bodies over a plane; two are joined by a spring between their centres of mass, as in dano's scene."""
    if len(geoms) == 1:
        return _compiled(geoms, timestep, (0.0, 0.0, 0.0))
    return _compiled(geoms, timestep, _compiled(geoms[:1], timestep, (0.0, 0.0, 0.0)).body_ipos[1])


def _compiled(geoms: list[str], timestep: float, center: Sequence[float]):
    import mujoco

    words = " ".join(str(x) for x in center)
    turned = ("1 0 0 0", "0 0 0 1")
    bodies = "".join(
        f'<body pos="{1.2 * SIZE * i} {0.1 * SIZE * i} {0.5 * SIZE}" quat="{turned[i]}">'
        f'<freejoint/><site name="s{i}" pos="{words}"/>{geom}</body>'
        for i, geom in enumerate(geoms)
    )
    ends = '<site site="s0"/><site site="s1"/>'
    spring = f'<spatial stiffness="{GRAVITY / SIZE}" springlength="0 0">{ends}</spatial>'
    tendon = f"<tendon>{spring}</tendon>" if len(geoms) == 2 else ""
    mesh = f'<mesh name="bunny" file="bunny.obj" scale="{SIZE} {SIZE} {SIZE}"/>'
    xml = (
        f'<mujoco><option timestep="{timestep}"/><asset>{mesh}</asset>'
        f'<worldbody><geom type="plane" size="5 5 1" friction="{FRICTION}"/>{bodies}</worldbody>'
        f"{tendon}</mujoco>"
    )
    return mujoco.MjModel.from_xml_string(xml, {"bunny.obj": (REPOSITORY / "assets/bunny.obj").read_bytes()})


def _case(group: str, name: str, model, speed: float = 0.0) -> Case:
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, round(SETTLE / model.opt.timestep))
    data.qvel[0] = speed
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    start = _state(model, data, kind)

    def run():
        mujoco.mj_setState(model, data, start, kind)
        mujoco.mj_step(model, data, N_STEPS)

    note = _contact_note(model, data, run)
    return Case(group, name, run, N_STEPS, note=note)


def _state(model, data, kind):
    import mujoco
    import numpy as np

    state = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, state, kind)
    return state


def _contact_note(model, data, run: Callable[[], None]) -> str:
    """How many contact points there were, at the end of a run."""
    run()
    note = f"{data.ncon} contact points"
    if model.nbody == 3:
        between = sum(model.geom_bodyid[list(contact.geom)].min() > 0 for contact in data.contact)
        note += f", {between} of them between the two"
    # A blown-up simulation goes on from its initial state, which would pass for a fast one.
    return note + (", UNSTABLE" if any(warning.number for warning in data.warning) else "")
