"""Objects of parts, and what a wrist holds."""

from collections.abc import Iterator

import numpy as np

import dano
from dano.building import BuildOptions
from tests.fuzz import kinds
from tests.fuzz.calls.call import Call
from tests.fuzz.kinds import array, CHOICE, instance, LIST, NAME, OPTIONAL_POSITIVE
from tests.fuzz.world import World


def _rows(n: int, width: int) -> kinds.Bad:
    """Values that are no table of this shape; NaN stands for what was not measured."""
    return {
        "short": np.zeros((n - 1, width)),
        "wide": np.zeros((n, width + 1)),
        "text": "table",
        "number": 1.0,
        "nothing": None,
    }


def _parts(w: World) -> Iterator[Call]:
    box = dano.Box((0.1, 0.1, 0.1))
    yield Call(
        "Part",
        dano.Part,
        {"source": box, "density": 1000.0},
        {"source": {"number": 3, "nothing": None}, "density": OPTIONAL_POSITIVE},
    )
    yield Call(
        "build_parts",
        dano.build_parts,
        {"parts": [dano.Part(box, mass=1.0)], "options": BuildOptions(samples=50, resolution=8)},
        {"parts": {**LIST, "none": [], "nothing": None}, "options": instance(optional=True)},
    )


def _wrist(w: World) -> Iterator[Call]:
    n = 80
    times = 0.01 * np.arange(n)
    good = {
        "times": times,
        "orientation": np.tile([1.0, 0, 0, 0], (n, 1)),
        "force": np.zeros((n, 3)),
        "torque": np.zeros((n, 3)),
    }
    bad = {key: _rows(n, np.shape(value)[1]) for key, value in good.items() if key != "times"}
    bad["times"] = {"falling": times[::-1], "few": times[:3], "text": "t", "nothing": None}
    bad["orientation"] = {**bad["orientation"], "no rotation": np.full((n, 4), 3.0)}
    bad["position"] = {k: v for k, v in _rows(n, 3).items() if k != "nothing"}
    yield Call("WristLog.create", dano.WristLog.create, good, {**bad, "frame": CHOICE})
    log = dano.WristLog.create(**good)
    shapes = {k: v for k, v in _rows(20, 3).items() if k != "nothing"}
    yield Call(
        "identify_load",
        dano.identify_load,
        {"log": log},
        {"log": instance(), "gravity": array(3), "shape": {**shapes, "short": np.zeros((2, 3))}},
    )
    names = "time,qw,qx,qy,qz,fx,fy,fz,mx,my,mz"
    table = np.column_stack([np.reshape(value, (n, -1)) for value in good.values()])
    path = w.folder / "wrist.csv"
    path.write_text(names + "\n" + "\n".join(",".join(map(str, row)) for row in table))
    yield Call(
        "load_wrist_log",
        dano.load_wrist_log,
        {"path": path},
        {"path": kinds.source(w.folder), "frame": CHOICE},
        {"path": ""},
    )


def _arm(w: World) -> Iterator[Call]:
    n = 80
    good = {"times": 0.01 * np.arange(n), "q": np.zeros((n, 1)), "torque": np.zeros((n, 1))}
    bad = {key: _rows(n, 1) for key in ("q", "torque")}
    bad["times"] = {"falling": good["times"][::-1], "few": good["times"][:3], "text": "t", "nothing": None}
    yield Call("JointLog.create", dano.JointLog.create, good, bad)
    arm = dano.Scene.create(
        [dano.Body("link", dano.Capsule(0.03, 0.2), mass=1.0)],
        joints=[dano.Joint(None, "link", "hinge", axis=(0, 1, 0))],
    )
    yield Call(
        "identify_load_on_arm",
        dano.identify_load_on_arm,
        {"log": dano.JointLog.create(**good), "scene": arm, "body": "link"},
        {
            "log": instance(),
            "scene": instance(),
            "body": NAME,
            "shape": {"text": "s", "short": np.zeros((2, 3))},
        },
    )


PARTS = (_parts, _wrist, _arm)
