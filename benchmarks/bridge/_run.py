"""The trained bunny and soap on MuJoCo's geoms through the bridge, beside MuJoCo's own hull of them."""

import resource
import time
from typing import NamedTuple

import mujoco
import numpy as np

from benchmarks._measure import load_average, parse_arguments, parts_option, report, Row, rows_of_parts
from benchmarks.bridge._agreement import agreement_row, HOLLOW, hollow, HOLLOW_NODES, with_article
from benchmarks.bridge._bars import bar_rows
from benchmarks.bridge._grip import finger_rows
from benchmarks.bridge._hold import hold_rows
from benchmarks.bridge._probes import probe_rows
from benchmarks.bridge._threads import thread_rows
from benchmarks.bridge._toys import compiled, meshes, TYPES, Way
from dano.scene_file import load_asset

SETTLE, WATCH = 4.0, 1.0
MOST_CREEP = 1e-4
"""Speed at rest that is asked for [m/s]."""
MOST_TIME = 60.0
"""CPU time of a step that is asked for [µs]."""
LONG_RUN = 600.0
LONG_TIMESTEP = 0.01
TIMESTEP = 0.002
NAMES = ("trained_bunny", "trained_soap")
LYING = (0.7071067811865476, 0.0, 0.7071067811865476, 0.0)
SUPPORTS = ("plane", "box", "sphere", "capsule", "cylinder", "ellipsoid", "mesh", "height field")


class Rest(NamedTuple):
    """Largest speed at rest [m/s], creep [m/s], contacts, CPU time of a step [µs], warnings."""

    speed: float
    creep: float
    contacts: int
    microseconds: float
    warnings: int


def run() -> None:
    arguments = parse_arguments("Measure neural objects on bodies of MuJoCo models.", parts_option(PARTS))
    load = load_average()
    parts, rows = rows_of_parts(PARTS, arguments)
    settings = {
        "parts": parts,
        "mujoco": mujoco.__version__,
        "settled": f"{SETTLE:g} s, then watched {WATCH:g} s",
        "clock": "CPU time of the process, one thread",
        "round supports": "sphere of 0.5 m, capsule and cylinder of 0.3 m, ellipsoid of 0.6, 0.5, 0.3 m",
    }
    report("bridge", rows, settings, load, arguments.json)


def _all_rest_rows(*, quick: bool) -> list[Row]:
    """How still objects lie on all geoms, and on a plane at other steps."""
    rows = []
    for name in NAMES:
        for support in SUPPORTS[:1] if quick else SUPPORTS:
            rows += _rest_rows(name, support, TIMESTEP)
    for name in () if quick else NAMES:
        for timestep in (0.001, 0.005, 0.01):
            rows += _rest_rows(name, "plane", timestep)
    return rows


def _agreement_rows(*, quick: bool) -> list[Row]:
    """How far objects are from those of our engine."""
    return [
        agreement_row(name, support, *_model(name, support, TIMESTEP, False))
        for name in NAMES
        for support in (SUPPORTS[:1] if quick else SUPPORTS)
    ]


def _rest_rows(name: str, support: str, timestep: float) -> list[Row]:
    group = f"{name} on {with_article(support)}, {1000 * timestep:g} ms"
    ours, theirs = (_rest(name, support, timestep, own) for own in (False, True))
    return [
        Row(group, "largest speed at rest", ours.speed, "m/s", MOST_CREEP, note=f"{ours.contacts} contacts"),
        Row(group, "speed of MuJoCo's hull", theirs.speed, "m/s", note=f"{theirs.contacts} contacts"),
        Row(group, "creep", ours.creep, "m/s", max(theirs.creep, 1e-9), note=f"{ours.warnings} warnings"),
        Row(group, "creep of MuJoCo's hull", theirs.creep, "m/s"),
        Row(group, "time of a step", ours.microseconds, "µs", MOST_TIME),
        Row(group, "time of MuJoCo's hull", theirs.microseconds, "µs"),
    ]


def _rest(name: str, support: str, timestep: float, own: bool) -> Rest:
    model, bridge = _model(name, support, timestep, own)
    data = mujoco.MjData(model)
    body, speed = model.body("toy").id, np.zeros(6)
    with bridge:
        mujoco.mj_step(model, data, round(SETTLE / timestep))
        start, fastest, n = data.xipos[body].copy(), 0.0, round(WATCH / timestep)
        begin = time.process_time()
        mujoco.mj_step(model, data, n)
        taken = (time.process_time() - begin) / n
        creep = float(np.linalg.norm(data.xipos[body] - start)) / WATCH
        for _ in range(n):
            mujoco.mj_step(model, data)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, speed, 0)
            fastest = max(fastest, float(np.linalg.norm(speed[3:])))
    warnings = int(sum(warning.number for warning in data.warning))
    return Rest(fastest, creep, int(data.ncon), 1e6 * taken, warnings)


def _model(name: str, support: str, timestep: float, own: bool):
    obj = load_asset(name)
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep
    spec.worldbody.add_geom(**_support(spec, support))
    height = 0.065 if "bunny" in name else 0.02
    spec.worldbody.add_body(name="toy", pos=[0, 0, height]).add_freejoint()
    way: Way = "hull" if own else "samples"
    return compiled(spec, "toy", obj, way, meshes(obj, way))


def _support(spec, support: str) -> dict:
    """A geom with its top at z = 0."""
    match support:
        case "plane":
            return {"type": TYPES.mjGEOM_PLANE, "size": [5, 5, 1]}
        case "box":
            return {"type": TYPES.mjGEOM_BOX, "size": [0.2, 0.2, 0.1], "pos": [0, 0, -0.1]}
        case "sphere":
            return {"type": TYPES.mjGEOM_SPHERE, "size": [0.5, 0, 0], "pos": [0, 0, -0.5]}
        case "capsule" | "cylinder":
            kind = TYPES.mjGEOM_CAPSULE if support == "capsule" else TYPES.mjGEOM_CYLINDER
            return {"type": kind, "size": [0.3, 0.3, 0], "pos": [0, 0, -0.3], "quat": LYING}
        case "ellipsoid":
            return {"type": TYPES.mjGEOM_ELLIPSOID, "size": [0.6, 0.5, 0.3], "pos": [0, 0, -0.3]}
        case "mesh":
            corners = np.array([[x, y, z] for x in (-0.2, 0.2) for y in (-0.2, 0.2) for z in (-0.2, 0.0)])
            spec.add_mesh(name="block", uservert=corners.ravel().tolist())
            return {"type": TYPES.mjGEOM_MESH, "meshname": "block"}
    x = np.linspace(-1, 1, HOLLOW_NODES)
    heights = hollow(x[None], x[:, None]).ravel()
    half, top = HOLLOW
    spec.add_hfield(
        name="hollow", nrow=len(x), ncol=len(x), size=[half, half, top, top], userdata=heights.tolist()
    )
    return {"type": TYPES.mjGEOM_HFIELD, "hfieldname": "hollow"}


def _memory_rows(*, quick: bool) -> list[Row]:
    """What a long run adds to the process, with a reset every second of it."""
    seconds = 10.0 if quick else LONG_RUN
    model, bridge = _model("trained_bunny", "plane", LONG_TIMESTEP, False)
    data = mujoco.MjData(model)
    each = round(1 / LONG_TIMESTEP)
    with bridge:
        mujoco.mj_step(model, data, 5 * each)
        before = _resident()
        for _ in range(round(seconds)):
            mujoco.mj_resetData(model, data)
            mujoco.mj_step(model, data, each)
    name = f"growth of the process over {seconds:g} simulated seconds"
    return [Row("Memory", name, (_resident() - before) / 2**20, "MiB", 1.0)]


def _resident() -> int:
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * resource.getpagesize()


PARTS = {
    "rest": _all_rest_rows,
    "agreement": _agreement_rows,
    "bars": bar_rows,
    "fingers": finger_rows,
    "hold": hold_rows,
    "probes": probe_rows,
    "threads": thread_rows,
    "memory": _memory_rows,
}
"""What is measured, by name."""
