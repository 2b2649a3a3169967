"""Actuators of MuJoCo's files as drives of joints, where a motor of dano does the same."""

from typing import Any, NamedTuple

import numpy as np

from dano.robots.formats._description import Drive, Lacking
from dano.robots.formats._tendons import shares_of

ALL, OTHER = "actuators", "other actuators"
"""Names by which all of them are left out, or those that dano has no counterpart of."""


class Pull(NamedTuple):
    """A drive of several joints: its length is the sum of their coordinates by their shares."""

    drive: Drive  # The drive
    shares: dict[int, float]  # By the indices of the joints


def drives_of(model: Any, mujoco: Any) -> tuple[dict[int, Drive], list[Pull], list[Lacking]]:
    """The drives by the index of their joint, those of fixed tendons, and what no motor does.

    MuJoCo's force is gain · u + bias, with constant, place and speed in the bias (its documentation,
    "Force generation"); `dano.Motor` has those of a motor, and of servos that hold a place or a speed.
    """
    found: dict[int, Drive] = {}
    pulls: list[Pull] = []
    lacking: list[Lacking] = []
    if _disabled(model, mujoco, "mjDSBL_ACTUATION"):
        return found, pulls, lacking
    for i in range(model.nactuator if hasattr(model, "nactuator") else model.nu):
        name = model.actuator(i).name or f"actuator {i}"
        if int(model.opt.disableactuator) >> int(model.actuator_group[i]) & 1:
            continue
        joint = int(model.actuator_trnid[i][0])
        shares = _shares(model, mujoco, i)
        why = _unlike(model, mujoco, i)
        if why is None and shares is None and joint in found:
            why = f"drives joint {model.joint(joint).name!r}, which {found[joint].name!r} drives already"
        if why is not None:
            lacking.append(Lacking(OTHER, f"actuator {name!r} {why}, which dano has no motor for"))
            continue
        drive = _drive(model, mujoco, i, name)
        if isinstance(drive, str):
            lacking.append(Lacking(OTHER, f"actuator {name!r} {drive}, which dano has no motor for"))
        elif drive is not None and shares is not None:
            pulls.append(Pull(drive, shares))
        elif drive is not None:
            found[joint] = drive
    return found, pulls, lacking


def _shares(model: Any, mujoco: Any, i: int) -> dict[int, float] | None:
    """Shares of joints in the length of a fixed tendon that an actuator pulls; None for none."""
    if int(model.actuator_trntype[i]) != int(mujoco.mjtTrn.mjTRN_TENDON):
        return None
    return shares_of(model, mujoco, int(model.actuator_trnid[i][0]))


def _disabled(model: Any, mujoco: Any, flag: str) -> bool:
    return bool(int(model.opt.disableflags) & int(getattr(mujoco.mjtDisableBit, flag)))


def _unlike(model: Any, mujoco: Any, i: int) -> str | None:
    """Why an actuator is not a motor of one joint; None if it is."""
    joints = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT
    shares = _shares(model, mujoco, i)
    if shares is None and int(model.actuator_trntype[i]) not in map(int, joints):
        return "acts on no joint, but on a tendon of sites, a site or a body"
    kinds = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
    moved = [int(model.actuator_trnid[i][0])] if shares is None else list(shares)
    if any(int(model.jnt_type[j]) not in map(int, kinds) for j in moved):
        return "acts on a ball or a free joint"
    if int(model.actuator_dyntype[i]) != int(mujoco.mjtDyn.mjDYN_NONE):
        return "has a state of its own (a filter, an integrator, a muscle)"
    for name in ("actuator_armature", "actuator_damping", "actuator_delay"):
        if np.any(getattr(model, name, np.zeros((i + 1, 1)))[i]):
            return f"has {name.removeprefix('actuator_')}"
    if int(getattr(model, "actuator_plugin", np.full(i + 1, -1))[i]) >= 0:
        return "is a plugin"
    plain = int(model.actuator_gaintype[i]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    biases = mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE
    if not plain or int(model.actuator_biastype[i]) not in map(int, biases):
        return "has a gain or a bias that depends on more than place and speed"
    return None


def _drive(model: Any, mujoco: Any, i: int, name: str) -> Drive | str | None:
    """The drive, None for one without effect, or what is special about it."""
    gain, gear = float(model.actuator_gainprm[i][0]), float(model.actuator_gear[i][0])
    affine = int(model.actuator_biastype[i]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
    constant, place, speed = (float(x) for x in model.actuator_biasprm[i][:3]) if affine else (0.0,) * 3
    forces = _range(model.actuator_forcerange[i], model.actuator_forcelimited[i])
    clamped = not _disabled(model, mujoco, "mjDSBL_CLAMPCTRL")
    commands = _range(model.actuator_ctrlrange[i], clamped and model.actuator_ctrllimited[i])
    if gear == 0 or gain == constant == place == speed == 0:
        return None
    if constant == place == speed == 0:
        # f = gain · u within limits: that of a motor whose gear has the gain, within theirs by the gain.
        bounds = np.sort(np.array(forces) / gain)
        least, most = max(bounds[0], commands[0]), min(bounds[1], commands[1])
        if least > most:
            return "has limits of force and command that exclude each other"
        return Drive(name, "effort", gear=gear * gain, limits=(float(least), float(most)), commands=commands)
    if constant == 0 and gain > 0 and place == -gain and speed <= 0:
        return Drive(name, "position", gain, -speed, gear, forces, commands)
    if constant == place == 0 and gain > 0 and speed == -gain:
        return Drive(name, "velocity", 0.0, gain, gear, forces, commands)
    return f"has the force {gain:g} u + {constant:g} + {place:g} l + {speed:g} dl/dt"


def _range(values: np.ndarray, limited: Any) -> tuple[float, float]:
    return (float(values[0]), float(values[1])) if limited else (-np.inf, np.inf)
