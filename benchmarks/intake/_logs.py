"""One motion in closed form, written as logs are written, and read back."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import dano
from benchmarks.intake._verdict import Case, Outcome, verdict
from dano.maths import quat_from_axis_angle

_EPOCH = 1_700_000_000
_TIMES = np.arange(80) / 125
_PLACES = np.stack([0.9 * _TIMES - 0.5 * _TIMES**2, 0.1 * np.sin(3 * _TIMES), 0.02 + 0 * _TIMES], axis=1)
_TURNS = np.array([quat_from_axis_angle((0, 0.6, 0.8), 0.2 + 4.0 * t) for t in _TIMES])
_XYZW = _TURNS[:, [1, 2, 3, 0]]
_PLAIN = "x,y,z,qw,qx,qy,qz"
_ROS = "field.pose.position.{},field.pose.orientation.{}"


def cases() -> list[Case]:
    """All of them, by name."""
    found: list[Case] = []
    for name, (header, columns, separator) in _tables().items():
        found.append((name, lambda h=header, c=columns, s=separator: _read(h, c, s)))
    found += [
        ("rows twice, late and empty", _dirty),
        (
            "quaternions that change their sign",
            lambda: _read(f"time,{_PLAIN}", [_TIMES, _PLACES, _signs()], ","),
        ),
        ("arrays xyzw, told", lambda: _arrays(order="xyzw")),
        ("positions alone", lambda: _read("time,x,y,z", [_TIMES, _PLACES], ",", turns=False)),
        ("two logs in one file", _twice),
        ("no time", lambda: _refused("x,y,z\n0,0,0\n1,0,0\n")),
        ("no known column", lambda: _refused("time,height\n0,1\n1,2\n")),
        ("words", lambda: _refused("time,x,y,z\n0,a,b,c\n1,2,3,4\n")),
        ("half a position", lambda: _refused("time,x,y\n0,1,2\n1,2,3\n")),
    ]
    found += [(f"joint angles that wrap from {low:.3g}", lambda a=low: _wrapped(a)) for low in (-np.pi, 0.0)]
    return found


def _tables() -> dict[str, tuple[str, list[np.ndarray], str]]:
    made: dict[str, tuple[str, list[np.ndarray], str]] = {}
    for unit, factor in (("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)):
        made[f"times in {unit}"] = (f"time,{_PLAIN}", [factor * _TIMES, _PLACES, _TURNS], ",")
        made[f"times since 1970 in {unit}"] = (
            f"time,{_PLAIN}",
            [np.rint(factor * (_EPOCH + _TIMES)) if unit != "s" else _EPOCH + _TIMES, _PLACES, _TURNS],
            ",",
        )
        made[f"time_{unit}"] = (f"time_{unit},{_PLAIN}", [factor * _TIMES, _PLACES, _TURNS], ",")
    for unit, factor in (("mm", 1e3), ("cm", 1e2), ("m", 1.0)):
        header = ",".join(f"{axis} [{unit}]" for axis in "xyz")
        made[f"positions in {unit}, told"] = (
            f"time,{header},qw,qx,qy,qz",
            [_TIMES, factor * _PLACES, _TURNS],
            ",",
        )
    made["positions in mm, not told"] = (f"time,{_PLAIN}", [_TIMES, 1e3 * _PLACES, _TURNS], ",")
    made["columns xyzw"] = ("time,x,y,z,qx,qy,qz,qw", [_TIMES, _PLACES, _XYZW], ",")
    made["tum"] = ("", [_TIMES, _PLACES, _XYZW], " ")
    euroc = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
    made["euroc"] = (euroc, [1e9 * _TIMES, _PLACES, _TURNS], ",")
    ros = ",".join(["%time", *(_ROS.split(",")[0].format(a) for a in "xyz")])
    ros += "," + ",".join(_ROS.split(",")[1].format(a) for a in "xyzw")
    made["rostopic"] = (ros, [1e9 * _TIMES, _PLACES, _XYZW], ",")
    plot = ",".join(["__time", *(f"/soap/pose/position/{a}" for a in "xyz")])
    plot += "," + ",".join(f"/soap/pose/orientation/{a}" for a in "xyzw")
    made["plotjuggler"] = (plot, [_TIMES, _PLACES, _XYZW], ",")
    made["tabs"] = (f"time,{_PLAIN}".replace(",", "\t"), [_TIMES, _PLACES, _TURNS], "\t")
    made["decimal commas"] = (f"time,{_PLAIN}".replace(",", ";"), [_TIMES, _PLACES, _TURNS], ";")
    return made


def _text(header: str, columns: Sequence[np.ndarray], separator: str) -> list[str]:
    def cell(value: float) -> str:
        text = (
            f"{value:.0f}" if abs(value) > 1e12 else f"{value:.12g}" if abs(value) < 1e6 else f"{value:.17g}"
        )
        return text.replace(".", ",") if separator == ";" else text

    rows = [separator.join(map(cell, row)) for row in np.column_stack(columns)]
    return ([header] if header else []) + rows


def _tried(lines: Sequence[str], is_right: Callable[[Any], bool] | None, **options: Any) -> Outcome:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return verdict(lambda: dano.load_motion(path, names="soap", **options), is_right)


def _is_right(motion: Any, *, turns: bool = True) -> bool:
    seen = np.isfinite(motion.position[:, 0, 0])
    close = np.abs(np.diff(motion.times) - np.diff(_TIMES)).max() < 2e-5
    close &= np.abs(motion.position[seen, 0] - _PLACES[seen]).max() < 1e-6
    if turns:
        same = np.abs(np.sum(motion.orientation[seen, 0] * _TURNS[seen], axis=1))
        close &= same.min() > 1 - 1e-6
    return bool(close)


def _read(header: str, columns: Sequence[np.ndarray], separator: str, *, turns: bool = True) -> Outcome:
    return _tried(_text(header, columns, separator), lambda motion: _is_right(motion, turns=turns))


def _signs() -> np.ndarray:
    return np.where(np.arange(len(_TIMES)) % 5 < 2, 1.0, -1.0)[:, None] * _TURNS


def _dirty() -> Outcome:
    lines = _text(f"time,{_PLAIN}", [_TIMES, _PLACES, _TURNS], ",")
    lines[10], lines[11] = lines[11], lines[10]
    lines.insert(31, lines[30])
    lines[50] = lines[50].split(",")[0] + ",NaN,,null,,,,"
    return _tried(lines, _is_right)


def _twice() -> Outcome:
    lines = _text(f"time,{_PLAIN}", [_TIMES, _PLACES, _TURNS], ",")
    return _tried([*lines, *lines[1:]], None)


def _refused(text: str) -> Outcome:
    return _tried(text.splitlines(), None)


def _arrays(**options: Any) -> Outcome:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.npz"
        np.savez(path, times=_TIMES, position=_PLACES, quat=_XYZW)
        return verdict(lambda: dano.load_motion(path, names="soap", **options), _is_right)


def _wrapped(low: float) -> Outcome:
    base = dano.Body("base", dano.Box((0.1, 0.1, 0.1)), fixed=True)
    arm = dano.Body("arm", dano.Box((0.1, 0.1, 0.4)), mass=1.0)
    joint = dano.Joint("base", "arm", "hinge", axis=(0, 1, 0))
    scene = dano.Scene.create([base, arm], [], joints=[joint], timestep=0.01)
    truth = 1.0 + 14.0 * _TIMES
    logged = (truth - low) % (2 * np.pi) + low

    def is_right(motion: Any) -> bool:
        off = motion.q[:, 0, 0] - truth
        return bool(np.ptp(off) < 1e-9)

    return verdict(lambda: dano.motion_of_joints(scene, _TIMES, logged[:, None]), is_right)
