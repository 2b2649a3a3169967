"""Fixed tendons of MuJoCo's files: sums of joint coordinates, as what they do to the joints.

A fixed tendon has the length L = Σ cᵢ qᵢ. An equality of its length makes one joint follow another. Where all
its joints follow one, L = ratio · q + shift, and a spring, a damper, friction, armature and limits of L are
some of q: the virtual work of a force f on L is f ratio dq.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from dano.robots.formats._description import Connection, held_at, Lacking, led_by, without_followers
from dano.robots.formats._lacking import EQUALITIES

_LAWS = ("stiffness", "damping", "frictionloss", "armature")
_FLAGS = dict(stiffness="SPRING", damping="DAMPER", frictionloss="FRICTIONLOSS", limited="LIMIT")
_STRAIGHT = 1e-12
"""Share of its largest coefficient below which a joint does not count, and of a range without width."""


class Length(NamedTuple):
    """A length Σ ratioⱼ qⱼ + shift, of joints that follow none [m or rad]."""

    ratios: dict[str, float]  # By the names of the joints; those that cancel out are left out
    shift: float  # What joints that stay where they are add, and shifts of those that follow


def length_of(shares: Mapping[str, float], joints: list[Connection], held: Mapping[str, float]) -> Length:
    """The length Σ share · q of joints, in terms of those that lead them.

    Args:
        shares: By the names of joints.
        joints: All joints.
        held: Coordinates of those that stay where they are.
    """
    ratios: dict[str, float] = {}
    shift = 0.0
    for name, share in shares.items():
        if name in held:
            shift += share * held[name]
            continue
        leader, ratio, plus = led_by(joints, name)
        ratios[leader] = ratios.get(leader, 0.0) + share * ratio
        shift += share * plus
    least = _STRAIGHT * max(map(abs, shares.values()), default=0.0)
    return Length({name: ratio for name, ratio in ratios.items() if abs(ratio) > least}, shift)


def shares_of(model: Any, mujoco: Any, tendon: int) -> dict[int, float] | None:
    """Coefficients of a fixed tendon by the indices of its joints; None for one of sites."""
    first, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
    rows = range(first, first + count)
    if any(int(model.wrap_type[k]) != int(mujoco.mjtWrap.mjWRAP_JOINT) for k in rows):
        return None
    found: dict[int, float] = {}
    for k in rows:
        j = int(model.wrap_objid[k])
        found[j] = found.get(j, 0.0) + float(model.wrap_prm[k])
    return found


def within(limits: tuple[float, float] | None, others: tuple[float, float]) -> tuple[float, float] | None:
    """The range that two have in common; None if there is none. The first may be missing."""
    low, high = others if limits is None else (max(limits[0], others[0]), min(limits[1], others[1]))
    return (low, high) if low <= high else None


def loaded(
    joint: Connection,
    ratio: float,
    shift: float,
    *,
    limits: tuple[float, float] | None = None,
    stiffness: float = 0.0,
    rest: float = 0.0,
) -> Connection | None:
    """The joint with limits and a spring of ratio · q + shift besides its own; None if nothing is left.

    Args:
        joint: A hinge or a slide.
        ratio: Not zero.
        shift: As above.
        limits: Of the sum, or None.
        stiffness: Of the spring.
        rest: Of the sum, where the spring exerts no force.
    """
    if stiffness:
        both = joint.stiffness + ratio**2 * stiffness
        middle = (joint.stiffness * joint.rest + ratio * stiffness * (rest - shift)) / both
        joint = dataclasses.replace(joint, stiffness=both, rest=middle)
    if limits is None:
        return joint
    low, high = sorted((end - shift) / ratio for end in limits)
    common = within(joint.limits, (low, high))
    if common is None or common[1] - common[0] <= _STRAIGHT * (high - low):
        return None
    return dataclasses.replace(joint, limits=common)


def with_loads_of_followers(joints: list[Connection]) -> tuple[list[Connection], list[Lacking]]:
    """The joints, with limits and springs of those that follow on the one that leads; and what cannot be."""
    joints, lacking = list(joints), []
    rows = {joint.name: row for row, joint in enumerate(joints)}
    for row, joint in enumerate(joints):
        if joint.mimics is None or (joint.limits is None and not joint.stiffness):
            continue
        leader, ratio, shift = led_by(joints, joint.name)
        found = None
        if ratio:
            found = loaded(
                joints[rows[leader]],
                ratio,
                shift,
                limits=joint.limits,
                stiffness=joint.stiffness,
                rest=joint.rest,
            )
        elif joint.limits is None or joint.limits[0] <= shift <= joint.limits[1]:
            found = joints[rows[leader]]
        if found is None:
            text = f"limits of joint {joint.name!r} leave no way to {leader!r}, which it follows"
            lacking.append(Lacking(EQUALITIES, text))
            continue
        joints[rows[leader]] = found
        joints[row] = dataclasses.replace(joints[row], limits=None, stiffness=0.0, rest=0.0)
    return joints, lacking


class Tendons:
    """What the fixed tendons of a model do to its joints; what they cannot do is in `lacking`."""

    def __init__(self, model: Any, mujoco: Any, names: list[str], off: Callable[[str], bool]):
        self.model, self.mujoco, self.off = model, mujoco, off
        self.lacking: list[Lacking] = []
        self.homes = {name: float(model.qpos0[model.jnt_qposadr[j]]) for j, name in enumerate(names)}
        found = [shares_of(model, mujoco, t) for t in range(model.ntendon)]
        self.shares = [x if x is None else {names[j]: share for j, share in x.items()} for x in found]

    def name(self, t: int) -> str:
        return self.model.tendon(t).name or f"tendon {t}"

    def coupled(self, joints: list[Connection], held: dict[str, float]) -> list[Connection]:
        """The joints, those that equalities of lengths couple made to follow; `held` gets those that stay.

        MuJoCo's equality is L₁ − L₁⁰ = a₀ + a₁ (L₂ − L₂⁰), the second tendon may be missing.
        """
        if self.off("EQUALITY"):
            return joints
        model, kind = self.model, int(self.mujoco.mjtEq.mjEQ_TENDON)
        for e in np.flatnonzero((model.eq_type == kind) & (model.eq_active0 > 0)).tolist():
            first, second = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
            constant, ratio, *rest = (float(x) for x in model.eq_data[e][:5])
            if second < 0:
                ratio, rest = 0.0, []
            joints = self._coupled(joints, held, (first, second), constant, ratio, rest)
        return joints

    def _coupled(
        self,
        joints: list[Connection],
        held: dict[str, float],
        ends: tuple[int, int],
        constant: float,
        ratio: float,
        rest: list[float],
    ) -> list[Connection]:
        """The joints with one equality of lengths."""
        first, second = ends
        parts = [(self.shares[first], 1.0)] + [(self.shares[second], -ratio)] * (second >= 0)
        shares: dict[str, float] = {}
        total = constant
        for given, factor in parts:
            for name, share in (given or {}).items():
                shares[name] = shares.get(name, 0.0) + factor * share
                total += factor * share * self.homes[name]
        length = length_of(shares, joints, held)
        if any(given is None for given, _ in parts) or any(rest) or len(length.ratios) > 2:
            text = (
                f"an equality of tendon {self.name(first)!r} couples more than two joints, sites, or not"
                " linearly: dano lets one joint follow one other"
            )
            self.lacking.append(Lacking(EQUALITIES, text))
            return joints
        rows = {joint.name: row for row, joint in enumerate(joints)}
        # The one that stands later in the file follows.
        moving = sorted(length.ratios, key=rows.__getitem__)
        if not moving:
            return joints
        *leaders, name = moving
        factor, shift = length.ratios[name], total - length.shift
        joints = list(joints)
        if leaders:
            follows = leaders[0], -length.ratios[leaders[0]] / factor, shift / factor
            joints[rows[name]] = dataclasses.replace(joints[rows[name]], mimics=follows)
            return joints
        held[name] = shift / factor
        joints[rows[name]] = held_at(joints[rows[name]], held[name])
        return without_followers(joints, held)

    def acting(self, joints: list[Connection], held: Mapping[str, float]) -> list[Connection]:
        """The joints with what springs, dampers, friction, armature and limits of lengths do to them."""
        joints = list(joints)
        named = []
        for t in range(self.model.ntendon):
            laws = {law: self._number(law, t) for law in (*_LAWS, "limited")}
            if not any(laws.values()) and not self._special(t):
                continue
            shares = self.shares[t]
            length = None if shares is None else length_of(shares, joints, held)
            if length is None or self._special(t) or not self._folded(joints, t, laws, length):
                named.append(self.name(t))
        if named:
            shown = ", ".join(map(repr, named[:4])) + (f" and {len(named) - 4} more" if named[4:] else "")
            text = f"{shown}: of tendons dano has only fixed ones of joints that follow one"
            self.lacking.append(Lacking("tendons", text))
        return joints

    def _number(self, law: str, t: int) -> float:
        if law in _FLAGS and self.off(_FLAGS[law]):
            return 0.0
        rows = getattr(self.model, f"tendon_{law}", None)
        return 0.0 if rows is None else float(np.ravel(rows[t])[0])

    def _special(self, t: int) -> bool:
        """Whether a tendon has what no joint has."""
        names = ("actfrclimited", "stiffnesspoly", "dampingpoly", "springyield")
        if any(np.any(getattr(self.model, f"tendon_{name}", np.zeros((t + 1, 1)))[t]) for name in names):
            return True
        low, high = map(float, self.model.tendon_lengthspring[t])
        return self._number("stiffness", t) > 0 and low != high

    def _folded(self, joints: list[Connection], t: int, laws: Mapping[str, float], length: Length) -> bool:
        """Give a joint what a tendon does; False if no joint has it."""
        low, high = map(float, self.model.tendon_range[t])
        rows = {joint.name: row for row, joint in enumerate(joints)}
        if not length.ratios:
            # What does not change its length does nothing, nor do limits that it keeps.
            return not laws["limited"] or low <= length.shift <= high
        if len(length.ratios) > 1:
            alone = not any(laws[law] for law in _LAWS)
            return alone and self._kept(length, [joints[rows[name]] for name in length.ratios], low, high)
        ((name, ratio),) = length.ratios.items()
        joint = joints[rows[name]]
        if joint.kind not in ("hinge", "slide"):
            return False
        found = loaded(
            joint,
            ratio,
            length.shift,
            limits=(low, high) if laws["limited"] else None,
            stiffness=laws["stiffness"],
            rest=float(self.model.tendon_lengthspring[t][0]),
        )
        if found is None:
            return False
        joints[rows[name]] = dataclasses.replace(
            found,
            damping=joint.damping + ratio**2 * laws["damping"],
            friction=joint.friction + abs(ratio) * laws["frictionloss"],
            armature=joint.armature + ratio**2 * laws["armature"],
        )
        return True

    @staticmethod
    def _kept(length: Length, joints: list[Connection], low: float, high: float) -> bool:
        """Whether the limits of the joints keep a length within a range by themselves."""
        ends = [
            sorted(length.ratios[joint.name] * x for x in joint.limits or (-math.inf, math.inf))
            for joint in joints
        ]
        least, most = (length.shift + sum(end[i] for end in ends) for i in range(2))
        return low <= least and most <= high
