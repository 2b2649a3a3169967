"""Robots of five families on a floor, held by servos, with their own collision meshes; beside MuJoCo."""

import dataclasses
import importlib.util
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import mujoco
import numpy as np

import dano
from benchmarks._measure import Row, skipped
from dano.maths import Numbers, quat_to_matrix
from dano.robots import mesh_of, Robot

TIMESTEP = 2e-3
DEEPEST = 1.0
"""How deep a foot may stand in the floor [mm]."""
_FAST = 50.0
"""Stiffness over damping of the servos [1/s]."""
_ABOVE = 1e-3
"""Height from which robots that float are set down [m]."""
_LIGHT = 1e-6
"""Mass of links that are only there to have a name [kg]."""
_EXAMPLES = "cmeel.prefix/share/example-robot-data/robots"
_LEGS = ("FL", "FR", "RL", "RR")


class _Case(NamedTuple):
    """A robot: package, file, whether it floats, and the joints that are not at zero."""

    family: str
    package: str
    file: str
    floats: bool
    pose: dict[str, float]


_CASES = (
    _Case("arm (Panda), hand on the floor", "cmeel", "panda_description/urdf/panda.urdf", False, {}),
    _Case("hand (Allegro)", "cmeel", "allegro_hand_description/urdf/allegro_left_hand.urdf", True, {}),
    _Case(
        "quadruped (A1)",
        "pybullet_data",
        "a1/a1.urdf",
        True,
        {f"{leg}_{part}_joint": q for leg in _LEGS for part, q in (("upper", 0.8), ("lower", -1.6))},
    ),
    _Case(
        "quadruped (Go1)",
        "cmeel",
        "go1_description/urdf/go1.urdf",
        True,
        {f"{leg}_{part}_joint": q for leg in _LEGS for part, q in (("thigh", 0.8), ("calf", -1.6))},
    ),
    _Case("humanoid (G1)", "cmeel", "g1_description/urdf/g1_29dof_rev_1_0.urdf", True, {}),
    _Case("mobile base (Husky)", "pybullet_data", "husky/husky.urdf", True, {}),
)
# Of the arm: the hand just above the floor, and what the servos want, a little below it.
_REACH = {"panda_joint2": 1.2, "panda_joint4": -1.9, "panda_joint6": 2.6}
_DOWN = 0.02


def rows(seconds: float) -> Iterator[Row]:
    """Time of a step, what converged, and how deep the lowest point stands, of each family."""
    for case in _CASES:
        path = _file(case)
        if path is None:
            yield skipped(case.family, "all of it", f"{case.file} is not installed")
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            yield from _measured(case, path, seconds)


def _file(case: _Case) -> Path | None:
    spec = importlib.util.find_spec(case.package)
    if spec is None or not spec.submodule_search_locations:
        return None
    root = Path(next(iter(spec.submodule_search_locations)))
    path = (root.parent / _EXAMPLES if case.package == "cmeel" else root) / case.file
    return path if path.is_file() else None


def _measured(case: _Case, path: Path, seconds: float) -> Iterator[Row]:
    start = time.perf_counter()
    robot = dano.load_urdf(path, base="floating" if case.floats else None)
    loaded = time.perf_counter() - start
    robot = _with_servos(robot)
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    scene = robot.scene(bodies=[floor], contacts=robot.contacts_with(floor), timestep=TIMESTEP)
    pose = _pose(case, robot, scene)
    state, shift = _set_down(case, robot, scene, pose)
    commands = {name: q - shift.get(name, 0.0) for name, q in pose.items()}
    told: dict[str, dict[str, Numbers]] = {
        robot.joint_names[name]: {"command": q} for name, q in commands.items()
    }
    once = scene.control(**told)
    steps = round(seconds / TIMESTEP)
    controls = jax.tree.map(lambda x: x[None].repeat(steps, axis=0), once)
    run = jax.block_until_ready(dano.simulate(scene, state, controls=controls))
    begin = time.process_time()
    jax.block_until_ready(dano.simulate(scene, state, controls=controls))
    taken = time.process_time() - begin
    low = _lowest(scene, run.states)
    unsolved = int(np.sum(~np.asarray(run.converged)))
    finite = bool(np.isfinite(np.asarray(run.states.position)).all())
    late = slice(len(low) // 2, None)
    theirs, deep = _in_mujoco(robot, scene, state, commands, steps)
    name = case.family
    yield Row(name, "step", 1e6 * taken / steps, "µs", note=f"{scene.layout.n_velocities} velocities")
    yield Row(name, "MuJoCo: step", theirs, "µs", note="the same hulls, servos and timestep; implicitfast")
    yield Row(name, "steps not converged", float(unsolved), "", 0, note=f"of {steps}; finite: {finite}")
    yield Row(name, "deepest point at rest", -1e3 * float(low[late].min()), "mm", DEEPEST)
    yield Row(name, "MuJoCo: deepest contact", deep, "mm")
    speed = float(np.abs(np.asarray(run.states.velocity[-1])).max())
    yield Row(name, "fastest link at the end", speed, "m/s")
    yield Row(name, "to load", loaded, "s", note="with hulls of earlier runs, if there are")


def _with_servos(robot: Robot) -> Robot:
    """Servos at all joints, so stiff that the weight of the robot at a lever of 1 m bends one by 1/3 rad."""
    stiffness = 3 * 9.81 * sum(float(body.mass) for body in robot.bodies if not body.fixed)
    motor = dano.Motor("position", stiffness=stiffness, damping=stiffness / _FAST)
    joints = [
        dataclasses.replace(joint, motor=motor)
        if joint.kind in ("hinge", "slide") and joint.mimics is None
        else joint
        for joint in robot.joints
    ]
    return dataclasses.replace(robot, joints=tuple(joints))


def _pose(case: _Case, robot: Robot, scene: dano.Scene) -> dict[str, float]:
    given = case.pose if case.floats else _REACH
    found = {}
    for name, body in robot.joint_names.items():
        limits = scene.joint(body).limits
        q = given.get(name, 0.0)
        found[name] = q if limits is None else float(np.clip(q, *np.asarray(limits)))
    return found


def _set_down(
    case: _Case, robot: Robot, scene: dano.Scene, pose: dict[str, float]
) -> tuple[dano.State, dict[str, float]]:
    """A state with the lowest point just above the floor, and by how much commands lie beside it [rad]."""
    if case.floats:
        state = robot.state(scene, pose)
        root = next(body.name for body in robot.bodies if body.name in robot.places)
        height = _ABOVE - float(_lowest(scene, jax.tree.map(lambda x: x[None], state))[0])
        place = np.asarray(state.position[scene.index(root)]) + [0, 0, height]
        others: dict[str, dict[str, Numbers]] = {root: {"position": place}}
        return robot.state(scene, pose, **others), {}
    # The shoulder is turned until the hand is there.
    low, high = 0.0, pose["panda_joint2"]
    for _ in range(12):
        pose["panda_joint2"] = 0.5 * (low + high)
        state = robot.state(scene, pose)
        above = float(_lowest(scene, jax.tree.map(lambda x: x[None], state))[0]) > _ABOVE
        low, high = (pose["panda_joint2"], high) if above else (low, pose["panda_joint2"])
    pose["panda_joint2"] = low
    return robot.state(scene, pose), {"panda_joint2": -_DOWN}


def _lowest(scene: dano.Scene, states: dano.State) -> np.ndarray:
    """Height of the lowest sample of the surfaces of all bodies that move [m]."""
    heights = []
    for i, body in enumerate(scene.bodies):
        if body.surface is None or body.fixed:
            continue
        up = np.asarray(jax.vmap(quat_to_matrix)(states.orientation[:, i]))[:, 2]
        points = np.asarray(body.surface.points[:3]) * np.asarray(body.scale)[:, None]
        if body.surface.turning == "ball":
            below = -np.sqrt(np.sum((up * np.asarray(body.scale)) ** 2, axis=1))
        else:
            below = (up @ (points - np.asarray(body.com)[:, None])).min(axis=1)
        heights.append(np.asarray(states.position[:, i, 2]) + below)
    return np.min(heights, axis=0)


def _in_mujoco(
    robot: Robot, scene: dano.Scene, state: dano.State, commands: dict[str, float], steps: int
) -> tuple[float, float]:
    """Time of a step [µs] and depth of the deepest contact at the end [mm]."""
    with tempfile.TemporaryDirectory() as folder:
        path = dano.export_robot(robot, Path(folder) / "robot.xml")
        spec = mujoco.MjSpec.from_file(str(path))
    # Some moments exceed the sum of the others by a rounding of the file.
    spec.compiler.balanceinertia = True
    # The root of Go1, of 1 mg, has moments that no body can have, which MuJoCo refuses.
    for body in spec.bodies[1:]:
        if body.mass <= _LIGHT:
            body.fullinertia = [1e-3 * _LIGHT] * 3 + [0.0] * 3
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    floor = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [1, 1, 1], "contype": 2, "conaffinity": 1}
    spec.worldbody.add_geom(name="the floor", **floor)
    _add_meshes(spec, robot)
    # Links do not touch each other here, as in the scene; nor does what stands still.
    moving = {link for link, (body, *_) in robot.frames.items() if body and not scene.body(body).fixed}
    for body in spec.bodies:
        for geom in body.geoms:
            if geom.name != "the floor":
                touches = body.name in moving and (geom.contype or geom.conaffinity)
                geom.contype, geom.conaffinity = (1 if touches else 0), (2 if touches else 0)
    roots = [spec.body(name) for name in robot.places if name in moving]
    for root in roots:
        root.add_freejoint()
    motor = next(joint.motor for joint in scene.joints if joint.motor is not None)
    gain, damping = float(motor.stiffness), float(motor.damping)
    for name in commands:
        made = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        made.set_to_position(kp=gain, kv=damping)
    model = spec.compile()
    data = mujoco.MjData(model)
    assert state.q is not None
    for name, command in commands.items():
        j = [joint.child for joint in scene.joints].index(robot.joint_names[name])
        data.joint(name).qpos = float(state.q[scene.layout.coordinates[j]])
        data.actuator(name).ctrl = command
    for root in roots:
        i = scene.index(root.name)
        arm = np.asarray(quat_to_matrix(state.orientation[i])) @ np.asarray(scene.bodies[i].com)
        data.qpos[:7] = [*(np.asarray(state.position[i]) - arm), *np.asarray(state.orientation[i])]
    begin = time.process_time()
    for _ in range(steps):
        mujoco.mj_step(model, data)
    taken = time.process_time() - begin
    depth = max((-float(contact.dist) for contact in data.contact), default=0.0)
    return 1e6 * taken / steps, 1e3 * depth


def _add_meshes(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Meshes, which exported files do not have; MuJoCo takes their hulls itself."""
    for link in robot.description.links:
        for k, solid in enumerate(each for each in link.solids if each.kind == "mesh"):
            vertices, faces = mesh_of(solid)
            name = f"{link.name} mesh {k}"
            spec.add_mesh(
                name=name,
                uservert=vertices.ravel(),
                userface=faces.ravel(),
                inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
            )
            spec.body(link.name).add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=name,
                pos=solid.place.position,
                quat=solid.place.orientation,
                mass=0,
            )
