"""Contacts, bodies, scenes, states, simulations."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dano
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
    OPTIONAL_NON_NEGATIVE,
    OPTIONAL_POSITIVE,
    POSITIVE,
)
from tests.fuzz.world import World


def _contact(w: World) -> Iterator[Call]:
    non_negative = (
        "sliding_friction restitution restitution_velocity hysteresis friction_fading friction_pressure"
        " stiffness spring damper rolling_friction torsional_friction"
    ).split()
    known = set(dano.ContactParams.__dataclass_fields__)
    yield Call(
        "ContactParams",
        dano.ContactParams,
        {},
        {name: OPTIONAL_NON_NEGATIVE for name in non_negative if name in known},
    )
    laws = {"CentroidLaw": dano.CentroidLaw, "DistributedLaw": dano.DistributedLaw}
    for name, law in laws.items():
        numbers = [
            key
            for key in ("smoothing", "regularizer", "stiction_velocity", "implicitness")
            if key in law.__dataclass_fields__
        ]
        bad = dict.fromkeys(numbers, NON_NEGATIVE)
        if law is dano.CentroidLaw:
            bad["stiction_velocity"] = OPTIONAL_NON_NEGATIVE
        yield Call(name, law, {}, bad)


def _scenes(w: World) -> Iterator[Call]:
    yield Call(
        "Body",
        dano.Body,
        {"name": "ball", "geometry": dano.Sphere(0.1), "mass": 1.0},
        {
            "name": {**NAME, "empty": ""},
            "geometry": instance(),
            "mass": POSITIVE,
            "inertia": array(3, 3, optional=True),
            "com": array(3, optional=True),
            "mass_scale": POSITIVE,
            "com_offset": array(3),
            "material": instance(optional=True),
        },
    )
    yield Call(
        "Contact",
        dano.Contact,
        {"a": "ball", "b": "floor"},
        {
            "a": NAME,
            "b": {**NAME, "the same": "ball"},
            "params": instance(optional=True),
            "law": instance(optional=True),
            "edge": OPTIONAL_NON_NEGATIVE,
        },
    )
    limits = {"crossed": (1.0, -1.0), "nan": (kinds.NAN, 1.0), "one": (1.0,), "number": 1.0, "text": "all"}
    yield Call(
        "Joint",
        dano.Joint,
        {"parent": None, "child": "ball", "kind": "hinge"},
        {
            "parent": {"number": 3, "thing": kinds.Thing()},
            "child": NAME,
            "kind": CHOICE,
            "axis": {**array(3), "zero": np.zeros(3)},
            "anchor": array(3),
            "position": array(3),
            "orientation": {**array(4), "zero": np.zeros(4)},
            "damping": NON_NEGATIVE,
            "limits": limits,
            "friction": OPTIONAL_NON_NEGATIVE,
            "armature": OPTIONAL_NON_NEGATIVE,
            "stiffness": OPTIONAL_NON_NEGATIVE,
            "rest": NUMBER,
            "mimics": {"number": 3, "thing": kinds.Thing()},
            "ratio": NUMBER,
            "shift": NUMBER,
            "motor": instance(optional=True),
        },
    )
    yield Call(
        "Loop",
        dano.Loop,
        {"first": None, "second": "ball"},
        {
            "first": {"number": 3, "the same": "ball"},
            "second": NAME,
            "kind": CHOICE,
            "position": array(3),
            "anchor": array(3),
            "orientation": {**array(4), "zero": np.zeros(4)},
        },
        {"first": ""},
    )
    yield Call(
        "Motor",
        dano.Motor,
        {},
        {"kind": CHOICE, "stiffness": NON_NEGATIVE, "damping": NON_NEGATIVE, "gear": NUMBER},
    )
    twice = {"twice": [w.ball, w.ball], "none": []}
    pairs = {"unknown": [("ball", "wall")], "number": 3, "names": ["ball"], "numbers": [(1, 2)]}
    yield Call(
        "Scene.create",
        dano.Scene.create,
        {"bodies": [w.ball, w.floor], "contacts": [w.contact]},
        {
            "bodies": {**LIST, **twice, "nothing": None},
            "contacts": {**LIST, "twice": [w.contact, w.contact], "unknown": [dano.Contact("ball", "wall")]},
            "joints": {**LIST, "unknown": [dano.Joint(None, "wall")]},
            "loops": {**LIST, "unknown": [dano.Loop(None, "wall")]},
            "others": instance(optional=True),
            "timestep": POSITIVE,
            "gravity": array(3),
        },
        {"bodies": "", "contacts": "", "joints": "", "loops": ""},
    )
    yield Call(
        "Scene.create (others)",
        dano.Scene.create,
        {"bodies": [w.ball, w.floor], "others": dano.ContactParams()},
        {"apart": pairs},
    )
    name = {**NAME, "unknown": "wall"}
    for verb in ("index", "body"):
        yield Call(
            f"Scene.{verb}", getattr(w.scene, verb), {"name": "ball"}, {"name": name}, {"name": "body"}
        )
    for verb in ("contact_index", "contact"):
        yield Call(
            f"Scene.{verb}",
            getattr(w.scene, verb),
            {"a": "ball", "b": "floor"},
            {"a": name, "b": name},
            {"a": "", "b": ""},
        )
    yield Call(
        "Scene.replace_contact",
        w.scene.replace_contact,
        {"a": "ball", "b": "floor"},
        {"a": name, "b": name, "sliding_friction": NON_NEGATIVE, "nonsense": {"unknown": 1.0}},
        {"a": "", "b": ""},
    )
    yield Call(
        "Scene.replace_body",
        w.scene.replace_body,
        {"name": "ball"},
        {
            "name": name,
            "mass": POSITIVE,
            "com": array(3),
            "inertia": array(3, 3),
            "nonsense": {"unknown": 1.0},
        },
        {"name": "body"},
    )
    common = dano.Scene.create(
        [dano.Body("ball", dano.Sphere(0.1), mass=1.0, material=dano.ContactParams()), w.floor],
        others=dano.ContactParams(),
    )
    yield Call(
        "Scene.replace_material",
        common.replace_material,
        {"name": "ball"},
        {"name": name, "sliding_friction": NON_NEGATIVE, "nonsense": {"unknown": 1.0}},
        {"name": "body"},
    )
    yield Call(
        "Scene.replace_joint",
        w.door.replace_joint,
        {"child": "ball"},
        {"child": name, "damping": NON_NEGATIVE, "rest": NUMBER, "nonsense": {"unknown": 1.0}},
        {"child": ""},
    )


def _states(w: World) -> Iterator[Call]:
    def ball(**given: Any) -> dano.State:
        return w.scene.initial_state(ball=given)

    vectors = {name: array(3) for name in ("position", "velocity", "omega")}
    yield Call(
        "Scene.initial_state",
        ball,
        {},
        {**vectors, "orientation": {**array(4), "zero": np.zeros(4)}, "speed": {"unknown": 1.0}},
    )
    yield Call(
        "Scene.initial_state (bodies)",
        w.scene.initial_state,
        {},
        {"wall": {"unknown": {}}, "ball": {"number": 3, "text": "up", "list": [1, 2, 3], "nothing": None}},
    )

    def door(**given: Any) -> dano.State:
        return w.door.initial_state(ball=given)

    yield Call("Scene.initial_state (joints)", door, {}, {"q": NUMBER, "v": NUMBER})

    def push(**given: Any) -> dano.Control:
        return w.scene.control(ball=given)

    yield Call("Scene.control", push, {}, {"force": array(3), "torque": array(3), "speed": {"unknown": 1.0}})
    yield Call(
        "Scene.control (bodies)",
        w.scene.control,
        {},
        {"wall": {"unknown": {}}, "ball": {"number": 3, "text": "up", "nothing": None}},
    )
    foreign = {**instance(), "of another scene": w.open_door}
    for verb in ("filled", "check_state", "frames", "joint_values"):
        yield Call(f"Scene.{verb}", getattr(w.scene, verb), {"state": w.state}, {"state": foreign})


def _rollouts(w: World) -> Iterator[Call]:
    foreign = {**instance(), "of another scene": w.open_door}
    both = {"scene": instance(), "state": foreign}
    engine = {"engine": instance(optional=True)}
    control = {
        "number": 3,
        "text": "push",
        "array": np.zeros((2, 3)),
        "of another scene": dano.Control(jnp.zeros((3, 3)), jnp.zeros((3, 3))),
    }
    good = {"scene": w.scene, "state": w.state}
    yield Call("step", dano.step, good, {**both, "control": control, **engine})
    yield Call("linearize", dano.linearize, good, {**both, "control": control, **engine})
    yield Call(
        "simulate",
        dano.simulate,
        {**good, "n_steps": 4},
        {**both, "n_steps": COUNT, "controls": control, **engine, "checkpoint_every": OPTIONAL_COUNT},
        {"controls": "control"},
    )
    states = {"scene": instance(), "states": {**instance(), "one state": w.state}}
    history = {"scene": w.scene, "states": w.trajectory.states}
    for name, verb in (
        ("contact_history", dano.contact_history),
        ("contact_wrenches", dano.contact_wrenches),
        ("contact_patches", dano.contact_patches),
    ):
        bad = states if name != "contact_patches" else {"scene": instance(), "states": instance()}
        yield Call(name, verb, history, {**bad, **engine}, {"states": "state"})
    yield Call(
        "rollouts",
        dano.rollouts,
        {"scene": w.scene, "states": jax.tree.map(lambda x: x[None], w.state), "n_steps": 4},
        {
            "scene": instance(),
            "states": instance(),
            "n_steps": COUNT,
            "controls": control,
            **engine,
            "keep": {"unknown": "nonsense", "zero": 0, "negative": -1, "share": 2.5, "nothing": None},
            "batch_size": OPTIONAL_COUNT,
            "path": {"number": 3, "thing": kinds.Thing(), "file": w.saved("field.npz")},
            "progress": FUNCTION,
        },
        {"controls": "control"},
    )
    yield Call(
        "load_rollouts",
        dano.load_rollouts,
        {"path": w.folder},
        {
            "path": {
                "missing": w.folder / "nowhere",
                "empty": w.folder,
                "file": w.saved("field.npz"),
                "number": 3,
                "nothing": None,
            }
        },
    )
    yield Call(
        "StoredRollouts",
        dano.StoredRollouts,
        {"path": w.folder},
        {"path": {"missing": w.folder / "nowhere", "number": 3, "nothing": None}},
    )
    yield Call(
        "VariationalEngine",
        dano.VariationalEngine,
        {},
        {"tolerance": OPTIONAL_POSITIVE, "max_iterations": COUNT, "capacity": OPTIONAL_COUNT},
    )


PARTS = (_contact, _scenes, _states, _rollouts)
