# pyright: reportMissingImports=false
"""The trained bunny in worlds of MuJoCo Warp and Newton, beside MuJoCo with the bridge and beside hulls."""

import contextlib
import datetime
import importlib.metadata
import time

import mujoco
import numpy as np
import warp as wp

from benchmarks._measure import load_average, parse_arguments, report, Row, skipped
from dano.exchange import solid_triangles
from dano.extras import is_installed
from dano.mujoco import add_newton_body, Bridge, NewtonBridge
from dano.scene_file import load_asset

NAME = "trained_bunny"
TIMESTEP = 0.002
DROP, SETTLE = 0.07, 1000
"""Height [m] and steps until the bunny rests."""
TIMED, BATCHES = 200, 5
"""Steps whose time is taken, and in how many parts, of which the fastest counts."""
MOST_APART = 1.0
"""Distance that is asked for [% of size]."""
SPEED, FRICTION = 0.2, 0.3
"""Of a push [m/s], and on the plane then."""
GRIP, HALF = 3.0, 0.005
"""Force of a finger [N], half of its thickness [m]."""
TYPES = mujoco.mjtGeom


def run() -> None:
    arguments = parse_arguments("Measure neural objects in worlds of MuJoCo Warp and Newton.")
    load, rows = load_average(), []
    counts = (1, 8) if arguments.quick else (1, 8, 64)
    device = str(wp.get_device())
    if is_installed("mujoco_warp"):
        rows += _apart_rows()
        for n in counts if device == "cpu" else (*counts, 1024, 4096):
            rows += _warp_time_rows(n)
    else:
        rows.append(skipped("MuJoCo Warp", "all", "mujoco-warp is not installed"))
    if is_installed("newton"):
        for n in counts:
            rows += _newton_rows(n)
    else:
        rows.append(skipped("Newton", "all", "newton is not installed"))
    settings: dict[str, object] = {
        "date": datetime.datetime.now().isoformat(timespec="minutes"),
        **{name: _version(name) for name in ("mujoco", "mujoco-warp", "newton", "warp-lang")},
        "device": device,
        "clock": "CPU time of the process, divided by steps and worlds" if device == "cpu" else "time",
    }
    report("worlds", rows, settings, load, arguments.json)


def _worlds(n: int) -> str:
    return f"{n} world{'s' if n > 1 else ''}"


def _group(n: int) -> str:
    return f"Time of a step in {_worlds(n)}"


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "none"


def _spec(kind: str = "object"):
    """The bunny above a plane, as itself, its hull or MuJoCo's signed distance of its mesh; the bridge."""
    spec = mujoco.MjSpec()
    spec.option.timestep = TIMESTEP
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10.0
    spec.worldbody.add_geom(name="plane", type=TYPES.mjGEOM_PLANE, size=[5, 5, 1])
    body = spec.worldbody.add_body(name="toy", pos=[0, 0, DROP])
    body.add_freejoint()
    bridge = Bridge(spec)
    bridge.attach("toy", NAME, look=False)
    if kind == "signed distance":
        for geom in body.geoms:
            geom.contype = geom.conaffinity = 0
        obj = load_asset(NAME)
        assert obj.solid is not None
        mesh, _ = solid_triangles(obj.solid, 40)
        spec.add_mesh(
            name="sdf", uservert=mesh.vertices.ravel().tolist(), userface=mesh.faces.ravel().tolist()
        )
        body.add_geom(type=TYPES.mjGEOM_SDF, meshname="sdf", mass=0.0)
    return spec, bridge


def _gripper():
    """The bunny in the air between two fingers that close; it has no weight."""
    spec, bridge = _spec()
    spec.option.gravity = [0, 0, 0]
    points = np.asarray(load_asset(NAME).surface.points)
    lower, upper = points.min(axis=0), points.max(axis=0)
    middle, reach = 0.5 * (lower + upper) + [0, 0, DROP], 0.5 * (upper - lower)[1]
    for finger, side in (("left", -1), ("right", 1)):
        body = spec.worldbody.add_body(name=finger, pos=middle + [0, side * (reach + 0.01 + HALF), 0])
        body.add_joint(name=finger, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, -side, 0], damping=10.0)
        body.add_geom(type=TYPES.mjGEOM_BOX, size=[0.03, HALF, 0.03], mass=0.1)
        motor = spec.add_actuator(name=finger, target=finger, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.gainprm[0] = GRIP
    return spec, bridge


def _apart_rows() -> list[Row]:
    """How far the bunny is from where MuJoCo has it: dropped, pushed and gripped, in the worst of worlds."""
    import mujoco_warp as mjw

    rows, size = [], load_asset(NAME).size
    for case in ("dropped", "pushed", "gripped"):
        bridge = _gripper()[1] if case == "gripped" else _spec()[1]
        model = bridge.compile()
        starts = np.repeat(model.qpos0[None], 4, axis=0)
        starts[:, 2] += 0.002 * np.arange(4) if case != "gripped" else 0.0
        speeds, steps = np.zeros((4, model.nv)), SETTLE
        if case == "pushed":
            model.geom_friction[:, 0] = FRICTION
            starts, speeds[:, 0], steps = _played(bridge, model, starts, speeds, SETTLE), SPEED, SETTLE // 2
        m, d = bridge.put_model(model), mjw.make_data(model, nworld=4)
        d.qpos.assign(starts.astype(np.float32))
        d.qvel.assign(speeds.astype(np.float32))
        d.ctrl.fill_(1.0)
        for _ in range(steps):
            mjw.step(m, d)
        expected = _played(bridge, model, starts, speeds, steps)
        apart = np.linalg.norm(d.qpos.numpy()[:, :3] - expected[:, :3], axis=1).max()
        way = np.linalg.norm(expected[:, :3] - starts[:, :3], axis=1).max()
        note = f"{1000 * way:.0f} mm way, {steps * TIMESTEP:g} s, 4 worlds"
        rows.append(
            Row(
                "Beside MuJoCo",
                f"{case} in MuJoCo Warp, apart",
                100 * apart / size,
                "% of size",
                MOST_APART,
                note=note,
            )
        )
    return rows


def _played(bridge, model, starts, speeds, steps: int) -> np.ndarray:
    ends = []
    for start, speed in zip(starts, speeds, strict=True):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = start, speed, 1.0
        with bridge:
            mujoco.mj_step(model, data, steps)
        ends.append(data.qpos.copy())
    return np.array(ends)


def _clock() -> float:
    if wp.get_device().is_cuda:
        wp.synchronize()
        return time.perf_counter()
    return time.process_time()


def _warp_time_rows(n: int) -> list[Row]:
    import mujoco_warp as mjw

    rows = []
    for kind in ("object", "hull", "signed distance"):
        name = f"MuJoCo Warp, {kind}"
        bridge = _spec(kind)[1]
        try:
            model = bridge.compile()
            m = bridge.put_model(model) if kind == "object" else mjw.put_model(model)
        except (NotImplementedError, ValueError) as error:
            rows.append(skipped(_group(n), name, str(error)))
            continue
        d = mjw.make_data(model, nworld=n)
        for _ in range(SETTLE // 2):
            mjw.step(m, d)
        rows.append(_timed(n, name, lambda m=m, d=d: mjw.step(m, d), d.nacon))
    return rows


def _timed(n: int, name: str, step, count) -> Row:
    fastest = np.inf
    for _ in range(BATCHES):
        begin = _clock()
        for _ in range(TIMED // BATCHES):
            step()
        fastest = min(fastest, _clock() - begin)
    taken = 1e6 * fastest / (TIMED // BATCHES) / n
    note = f"{int(count.numpy()[0]) // n} contacts"
    return Row(_group(n), name, taken, "µs a world", note=note)


def _newton_rows(n: int) -> list[Row]:
    """Beside MuJoCo, and the time of a step, as itself and as the hull of its mesh."""
    import newton

    rows, obj = [], load_asset(NAME)
    assert obj.solid is not None
    mesh, _ = solid_triangles(obj.solid, 40)
    for kind in ("object", "hull"):
        one, every = newton.ModelBuilder(), newton.ModelBuilder()
        body = add_newton_body(one, obj, label="toy", xform=wp.transform((0, 0, DROP), wp.quat_identity()))
        if kind == "hull":
            cfg = newton.ModelBuilder.ShapeConfig(density=0.0)
            solid = newton.Mesh(mesh.vertices, mesh.faces.ravel(), compute_inertia=False)
            one.add_shape_convex_hull(body, mesh=solid, cfg=cfg)
        every.replicate(one, n)
        every.add_ground_plane()
        model = every.finalize()
        with contextlib.redirect_stderr(None):
            solver = newton.solvers.SolverMuJoCo(model, cone="elliptic", impratio=10.0)
        if kind == "object":
            NewtonBridge(solver).attach("toy", obj)
        states, control = [model.state(), model.state()], model.control()
        newton.eval_fk(model, model.joint_q, model.joint_qd, states[0])

        def step(solver=solver, states=states, control=control):
            solver.step(states[0], states[1], control, None, TIMESTEP)
            states.reverse()

        for _ in range(SETTLE):
            step()
        if kind == "object":
            bridge = _spec()[1]
            bridge.target.option.integrator = int(solver.mj_model.opt.integrator)
            expected = bridge.compile()
            at = _played(bridge, expected, expected.qpos0[None], np.zeros((1, 6)), SETTLE)[0]
            apart = np.linalg.norm(states[0].joint_q.numpy().reshape(n, 7)[:, :3] - at[:3], axis=1).max()
            rows.append(
                Row(
                    "Beside MuJoCo",
                    f"dropped in {_worlds(n)} of Newton, apart",
                    100 * apart / obj.size,
                    "% of size",
                    MOST_APART,
                )
            )
        rows.append(_timed(n, f"Newton, {kind}", step, solver.mjw_data.nacon))
    return rows
