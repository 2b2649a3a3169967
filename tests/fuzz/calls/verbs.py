"""Robots, identification, planning."""

from collections.abc import Iterator

import numpy as np

import dano
from dano import robots
from dano.planning import load_controls
from tests.fuzz import kinds
from tests.fuzz.calls.call import Call
from tests.fuzz.kinds import (
    array,
    CHOICE,
    COUNT,
    FUNCTION,
    instance,
    LIST,
    NAME,
    NON_NEGATIVE,
    NUMBER,
    OPTIONAL_COUNT,
    OPTIONAL_POSITIVE,
    POSITIVE,
)
from tests.fuzz.world import World


def _robots(w: World) -> Iterator[Call]:
    robot = {"scene": w.arm_scene, "state": w.arm_state}
    bad = {"scene": instance(), "state": {**instance(), "of another scene": w.state}}
    k = w.arm_scene.layout.n_joints
    for name, verb in (
        ("bias_forces", dano.bias_forces),
        ("gravity_forces", dano.gravity_forces),
        ("mass_matrix", dano.mass_matrix),
    ):
        yield Call(name, verb, robot, bad)
    acceleration = {"acceleration": array(k)}
    yield Call(
        "computed_torque",
        dano.computed_torque,
        {**robot, "acceleration": np.zeros(k)},
        {**bad, **acceleration},
    )
    yield Call(
        "joint_reactions",
        dano.joint_reactions,
        {**robot, "acceleration": np.zeros(k)},
        {**bad, **acceleration},
    )
    yield Call(
        "joint_control",
        dano.joint_control,
        {"scene": w.arm_scene, "effort": np.zeros(k)},
        {"scene": instance(), "effort": array(k)},
    )
    loops = {"scene": instance(), "state": {**instance(), "without loops": w.arm_state}}
    for name, verb in (("robots.loop_gaps", robots.loop_gaps), ("close_loops", dano.close_loops)):
        yield Call(name, verb, robot, loops, {"state": ""})
    link = {**NAME, "unknown": "tail"}
    yield Call(
        "Target",
        dano.Target,
        {"link": w.link, "position": (0, 0, 0)},
        {
            "link": NAME,
            "position": array(3),
            "orientation": array(4, optional=True),
            "weight": NON_NEGATIVE,
            "length": POSITIVE,
        },
    )
    target = dano.Target(w.link, (0.1, 0.0, 0.2))
    yield Call(
        "inverse_kinematics",
        dano.inverse_kinematics,
        {"robot": w.arm, **robot, "targets": [target]},
        {
            "robot": instance(),
            **bad,
            "targets": {**LIST, "none": [], "unknown": [dano.Target("tail", (0, 0, 0))], "nothing": None},
            "posture": array(k, optional=True),
            "posture_weight": NON_NEGATIVE,
            "max_iterations": COUNT,
        },
        {"targets": "target"},
    )
    yield Call(
        "operational_space_torque",
        dano.operational_space_torque,
        {"robot": w.arm, **robot, "link": w.link, "acceleration": np.zeros(6)},
        {"robot": instance(), **bad, "link": link, "acceleration": array(6)},
    )
    yield Call("Robot.place", w.arm.place, {**robot, "link": w.link}, {**bad, "link": link})
    values = {"number": 3, "text": "up", "unknown": {"tail": 1.0}, "nan": {w.joint: kinds.NAN}}
    yield Call(
        "Robot.state",
        w.arm.state,
        {"scene": w.arm_scene},
        {"scene": instance(), "q": values, "v": values},
        {"q": "", "v": ""},
    )
    yield Call("Robot.start", w.arm.start, {}, {"q": values, "v": values}, {"q": "", "v": ""})
    yield Call(
        "Robot.scene",
        w.arm.scene,
        {},
        {"bodies": LIST, "contacts": LIST, "joints": LIST, "timestep": POSITIVE},
    )
    yield Call("Robot.body_of", w.arm.body_of, {"joint": w.joint}, {"joint": link}, {"joint": ""})
    files = kinds.source(w.folder)
    for name, load in (("load_urdf", dano.load_urdf), ("load_mjcf", dano.load_mjcf)):
        broken = w.folder / f"{name}.xml"
        broken.write_text("<robot name='x'><link", encoding="utf-8")
        foreign = {**files, "cut off": broken, "foreign": w.saved("field.npz")}
        yield Call(
            name,
            load,
            {"path": w.arm_file},
            {
                "path": foreign,
                "base": {"number": 3, "unknown": "tail"},
                "prefix": {"number": 3, "nothing": None},
            },
            {"path": ""},
        )
    yield Call(
        "export_robot",
        dano.export_robot,
        {"robot": w.arm, "path": w.folder / "arm_out.urdf"},
        {"robot": instance(), "path": kinds.target(w.folder, ".urdf"), "scene": instance(optional=True)},
        {"path": ""},
    )


def _identify(w: World) -> Iterator[Call]:
    good = {"scene": w.scene, "observed": w.motion, "parameters": [w.parameter], "state": w.state}
    stranger = dano.Motion.create([0.0, 0.1, 0.2], "wall", position=np.zeros((3, 3)))
    yield Call(
        "identify",
        dano.identify,
        good,
        {
            "scene": instance(),
            "observed": {**instance(), "none": [], "of another body": stranger},
            "parameters": {**LIST, "none": [], "twice": [w.parameter, w.parameter], "nothing": None},
            "held_out": {"number": 3, "text": "text"},
            "state": {"number": 3, "text": "text", "of another scene": w.open_door},
            "controls": {"number": 3, "text": "push"},
            "noise": {
                "number": 0.1,
                "unknown": {"speed": 1.0},
                "negative": {"position": -1.0},
                "nan": {"position": kinds.NAN},
            },
            "initial": CHOICE,
            "options": instance(optional=True),
        },
        {
            "controls": "control",
            "observed": "",
            "parameters": "parameter",
            "state": "state",
        },
    )
    yield Call(
        "IdentifyOptions",
        dano.IdentifyOptions,
        {"window": 5},
        {
            "window": {**OPTIONAL_COUNT, "one frame": 1},
            "continuity": {
                **OPTIONAL_POSITIVE,
                "rising": (0.1, 0.3),
                "equal": (0.3, 0.3),
                "deep": [[0.3, 0.1]],
            },
            "huber": OPTIONAL_POSITIVE,
            "independent": {**CHOICE, "numbers": [1, 2]},
            "starts": {**COUNT, "too many": 10**6},
            "seed": {"share": 2.5, "text": "a", "negative": -1},
            "max_iterations": COUNT,
            "tolerance": POSITIVE,
            "jacobian": CHOICE,
            "batch": OPTIONAL_COUNT,
            "checkpoint": {
                "number": 3,
                "thing": kinds.Thing(),
                "null": "a\0.npz",
                "another ending": w.folder / "out.txt",
            },
            "resume": {"of nothing": True},
        },
    )
    times = {
        "backwards": [0.2, 0.1, 0.0],
        "nan": [0.0, kinds.NAN, 1.0],
        "text": "now",
        "short": [0.0],
        "flat": [[0.0, 1.0, 2.0]],
        "nothing": None,
    }
    yield Call(
        "Motion.create",
        dano.Motion.create,
        {"times": [0.0, 0.1, 0.2], "names": "ball", "position": np.zeros((3, 3))},
        {
            "times": times,
            "names": {"number": 3, "nothing": None, "two": ["a", "b"], "twice": ["a", "a"]},
            "position": {
                "short": np.zeros((2, 3)),
                "flat": np.zeros(3),
                "text": "here",
                "infinite": np.full((3, 3), kinds.INF),
            },
            "orientation": {"short": np.ones((2, 4)), "zero": np.zeros((3, 4)), "text": "up"},
            "velocity": {"short": np.ones((2, 3)), "text": "fast"},
            "point": CHOICE,
            "lag": NUMBER,
            "covariance": {
                "short": np.ones((3, 6)),
                "negative": -np.tile(np.eye(6), (3, 1, 1)),
                "text": "all",
            },
        },
        {"names": ""},
    )
    yield Call(
        "Motion.from_trajectory",
        dano.Motion.from_trajectory,
        {"trajectory": w.trajectory},
        {
            "trajectory": instance(),
            "bodies": {"unknown": ["wall"], "number": 3, "numbers": [3]},
            "every": COUNT,
        },
        {"bodies": ""},
    )
    yield Call(
        "motion_of_joints",
        dano.motion_of_joints,
        {"scene": w.door, "times": [0.0, 0.1, 0.2], "q": np.zeros((3, 1))},
        {
            "scene": instance(),
            "times": times,
            "q": {"short": np.zeros((2, 1)), "nan": np.full((3, 1), kinds.NAN), "text": "q", "nothing": None},
            "state": instance(optional=True),
        },
    )
    yield Call(
        "Parameter",
        dano.Parameter,
        {"name": "mu", "where": lambda s: s.timestep, "lower": 0.0, "upper": 1.0},
        {
            "name": NAME,
            "where": {**FUNCTION, "nothing": None},
            "lower": {"above": 2.0, "nan": kinds.NAN, "text": "a", "thing": kinds.Thing()},
            "upper": {"nan": kinds.NAN, "text": "a"},
            "start": {"outside": 3.0, "nan": kinds.NAN, "text": "a"},
            "of": CHOICE,
        },
    )
    files = kinds.source(w.folder)
    yield Call(
        "load_motion",
        dano.load_motion,
        {"path": w.saved("motion.npz")},
        {
            "path": {**files, "foreign": w.saved("field.npz")},
            "order": CHOICE,
            "point": CHOICE,
            "rate": OPTIONAL_POSITIVE,
        },
        {"path": ""},
    )
    yield Call(
        "save_motion",
        dano.save_motion,
        {"path": w.folder / "m.npz", "motion": w.motion},
        {"path": kinds.target(w.folder, ".npz"), "motion": instance()},
        {"path": ""},
    )


def _plan(w: World) -> Iterator[Call]:
    bound = {"nan": kinds.NAN, "text": "a", "many": np.ones(7), "thing": kinds.Thing()}
    yield Call(
        "Actuator",
        dano.Actuator,
        {"body": "ball", "limit": 1.0},
        {
            "body": NAME,
            "kind": CHOICE,
            "limit": {**bound, "negative": -1.0},
            "axes": {**CHOICE, "empty": ""},
            "cost": NON_NEGATIVE,
        },
    )
    yield Call(
        "Actuator (bounds)",
        dano.Actuator,
        {"body": "ball", "lower": -1.0, "upper": 1.0},
        {"lower": {**bound, "crossed": 2.0}, "upper": bound},
    )
    yield Call(
        "Goal",
        dano.Goal,
        {"body": "ball", "position": (0, 0, 0)},
        {
            "body": NAME,
            "position": array(3),
            "running": NON_NEGATIVE,
            "final": NON_NEGATIVE,
            "within": POSITIVE,
            "axes": CHOICE,
            "speed": {"unknown": 1.0},
        },
    )
    yield Call(
        "Limit",
        dano.Limit,
        {"body": "ball", "quantity": "position", "lower": -1.0, "upper": 1.0},
        {
            "body": NAME,
            "quantity": CHOICE,
            "lower": {**bound, "crossed": 2.0},
            "upper": bound,
            "axes": CHOICE,
        },
    )
    yield Call(
        "Task",
        dano.Task,
        {"n_steps": 4, "actuators": [w.actuator], "goals": [w.goal]},
        {
            "n_steps": COUNT,
            "actuators": {**LIST, "none": [], "twice": [w.actuator, w.actuator]},
            "goals": {**LIST, "none": []},
            "limits": LIST,
        },
        {"goals": "goal", "actuators": "actuator"},
    )
    yield Call(
        "SamplingOptions",
        dano.SamplingOptions,
        {},
        {
            "passes": COUNT,
            "samples": COUNT,
            "knots": COUNT,
            "best": POSITIVE,
            "deviation": POSITIVE,
            "first": {"unknown": "sobol", "nothing": None, "number": 3},
            "temperature": POSITIVE,
            "max_seconds": OPTIONAL_POSITIVE,
        },
    )
    yield Call(
        "PlanOptions",
        dano.PlanOptions,
        {},
        {
            "explore": {"share": 2.5, "negative": -1, "text": "a"},
            "softening": {"number": 3.0, "negative": [-1.0], "text": "soft"},
            "ilqr": {**instance(), "other options": dano.SamplingOptions()},
            "sampling": instance(),
            "seed": {"share": 2.5, "text": "a", "negative": -1},
        },
    )
    good = {"scene": w.scene, "state": w.state, "task": w.task}
    yield Call(
        "plan",
        dano.plan,
        good,
        {
            "scene": instance(),
            "state": {**instance(), "of another scene": w.open_door},
            "task": instance(),
            "method": CHOICE,
            "controls": {"short": np.zeros((2, 3)), "nan": np.full((4, 3), kinds.NAN), "text": "push"},
            "options": instance(optional=True),
            "engine": instance(optional=True),
            "callback": FUNCTION,
        },
    )
    yield Call(
        "follow",
        dano.follow,
        {"plant": w.scene, "state": w.state, "task": w.task, "plan": None},
        {
            "plant": instance(),
            "task": instance(),
            "plan": instance(),
            "replanning": instance(optional=True),
        },
    )
    yield Call(
        "Replanning",
        dano.Replanning,
        {"scene": w.scene, "every": 2},
        {"scene": instance(), "every": COUNT, "ilqr": instance()},
    )
    yield Call(
        "plan.load_controls",
        load_controls,
        {"path": w.folder},
        {"path": {**kinds.source(w.folder), "foreign": w.saved("field.npz")}},
        {"path": ""},
    )


PARTS = (_robots, _identify, _plan)
