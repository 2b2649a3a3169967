"""What files of MuJoCo say that dano has no counterpart of: each by a name, to be left out or refused."""

from typing import Any

import numpy as np
from jaxtyping import Bool

from dano.robots.formats._description import Lacking

GRAVCOMP = "gravcomp"
"""Name of compensated weight."""

EQUALITIES = "equalities"
"""Name of equalities that are neither loops of joints nor linear."""

WEIGHTLESS = "weightless joints"
"""Name of joints that move nothing with mass."""

MASSES = "masses"
"""Name of all masses: what is left of a robot serves kinematics."""

IGNORABLE = {
    "adhesion": "surfaces that stick",
    "surface velocity": "surfaces that move, such as belts",
    "actuators": "all actuators",
    "other actuators": "actuators that are no motor or servo of one joint",
    "crossed limits": "limits whose lower exceeds the upper: Bullet takes that as none",
    "ball limits": "ranges of ball joints",
    EQUALITIES: "equalities that are neither loops of joints nor linear",
    "fluid": "drag by density and viscosity",
    "free joints": "damping, friction, armature and springs of free joints",
    GRAVCOMP: "compensated weight of bodies",
    MASSES: "all masses and inertias: the robot serves kinematics alone",
    "height fields": "shapes that are height fields or signed distances",
    "mimics of nothing": "joints that mimic one which does not exist",
    "nonlinear springs": "springs and dampers that are not linear",
    "soft bodies": "flexes and deformable bodies",
    "tendons": "tendons, and what hangs on them",
    WEIGHTLESS: "joints that move nothing with mass: they stay where they are",
}
"""What may be left out of a robot's file by `ignore`."""


def checked_ignore(ignore: Any) -> tuple[str, ...]:
    """Names of what is to be left out.

    Raises:
        ValueError: If one is unknown.
    """
    names = (ignore,) if isinstance(ignore, str) else tuple(ignore)
    for name in names:
        if name not in IGNORABLE:
            raise ValueError(f"ignore must hold some of {list(IGNORABLE)}, got {name!r}")
    return names


def lacking_of(model: Any, mujoco: Any) -> list[Lacking]:
    """What a model has that dano has not, besides actuators."""
    found = []

    def say(feature: str, text: str) -> None:
        found.append(Lacking(feature, text))

    density, viscosity = float(model.opt.density), float(model.opt.viscosity)
    if density > 0 or viscosity > 0:
        say(
            "fluid",
            f"<option> has density {density:g} kg/m³ and viscosity {viscosity:g} Pa s: dano has no drag",
        )
    for head in np.unique(model.body_weldid)[1:]:
        welded = np.flatnonzero((model.body_weldid == head) & (model.body_mass > 0))
        if np.ptp(model.body_gravcomp[welded]) > 0 if welded.size else False:
            names = _listed([model.body(i).name or f"body {i}" for i in welded])
            say(GRAVCOMP, f"gravcomp of {names} differs: to dano what is welded together is one body")
    if model.nflex:
        say("soft bodies", f"{model.nflex} flexes: dano has rigid bodies only")
    found += _of_joints(model, mujoco) + _of_geoms(model, mujoco) + _of_surfaces(model)
    return found


def silent_of(model: Any, mujoco: Any, touching: Bool[np.ndarray, " g"]) -> list[str]:
    """What is not read although it changes how MuJoCo simulates, one line each.

    Args:
        model: MuJoCo's model.
        mujoco: The library.
        touching: Which geoms can touch something.
    """
    soft = np.array([0.02, 1.0]), np.array([0.9, 0.95, 0.001, 0.5, 2.0])
    geoms = np.flatnonzero(touching).tolist()
    told = [
        g
        for g in geoms
        if not (np.allclose(model.geom_solref[g], soft[0]) and np.allclose(model.geom_solimp[g], soft[1]))
    ]
    found = []
    if any(
        not (np.allclose(model.pair_solref[k], soft[0]) and np.allclose(model.pair_solimp[k], soft[1]))
        for k in range(model.npair)
    ):
        found.append("solref or solimp of pairs: contacts are as soft as dano.ContactParams says")
    if told:
        names = _listed([model.geom(g).name or f"geom {g}" for g in told])
        found.append(f"solref or solimp of {names}: contacts are as soft as dano.ContactParams says")
    rolling = [g for g in geoms if model.geom_condim[g] > 3]
    if rolling:
        names = _listed([model.geom(g).name or f"geom {g}" for g in rolling])
        found.append(f"torsional and rolling friction of {names}: in dano they come out of the geometry")
    wide = [g for g in geoms if model.geom_margin[g] or model.geom_gap[g]]
    if wide or np.any(model.pair_margin) or np.any(model.pair_gap):
        names = _listed([model.geom(g).name or f"geom {g}" for g in wide] or ["pairs"])
        found.append(f"margin and gap of {names}: dano touches at the surface")
    uneven = [k for k in range(model.npair) if model.pair_friction[k][0] != model.pair_friction[k][1]]
    if uneven:
        found.append("friction of pairs that differs along two directions: the first counts")
    if int(model.opt.enableflags) & int(mujoco.mjtEnableBit.mjENBL_OVERRIDE):
        found.append("o_margin, o_solref and o_solimp: contacts are as soft as dano.ContactParams says")
    if np.any(getattr(model, "jnt_margin", 0.0)):
        found.append("margin of joints: limits act where they are")
    if np.any(getattr(model, "jnt_actgravcomp", False)):
        found.append("actuatorgravcomp: what holds the weight is no part of the effort of a motor")
    return found


def notes_of(model: Any) -> list[str]:
    """What is read in another way than it is written, one line each."""
    moved = [model.body(i).name or f"body {i}" for i in np.flatnonzero(model.body_mocapid >= 0)]
    return [f"{_listed(moved)} is moved by mocap in MuJoCo: here it stands still"] if moved else []


def _of_joints(model: Any, mujoco: Any) -> list[Lacking]:
    found, types = [], mujoco.mjtJoint
    free, ball = int(types.mjJNT_FREE), int(types.mjJNT_BALL)
    for j in range(model.njnt):
        kind, name = int(model.jnt_type[j]), model.joint(j).name or f"joint {j}"
        first = int(model.jnt_dofadr[j])
        dofs = slice(first, first + {free: 6, ball: 3}.get(kind, 1))
        if kind == ball and model.jnt_limited[j]:
            text = f"the ball joint {name!r} has a range: dano's ball joints have none"
            found.append(Lacking("ball limits", text))
        poly = [
            getattr(model, key, np.zeros((model.nv, 1)))[rows]
            for key, rows in (("jnt_stiffnesspoly", j), ("dof_dampingpoly", dofs), ("jnt_springyield", j))
        ]
        if any(np.any(x) for x in poly):
            text = f"joint {name!r} has a spring or a damper that is not linear"
            found.append(Lacking("nonlinear springs", text))
    return found


def _of_surfaces(model: Any) -> list[Lacking]:
    """Belts and glue of geoms and pairs."""
    found = []
    kinds = (
        ("surface velocity", "surfacevel", "a surface that moves"),
        ("adhesion", "adhesion", "a surface that sticks"),
    )
    for feature, key, what in kinds:
        rows = np.asarray(getattr(model, f"geom_{key}", np.zeros(model.ngeom)))
        acts = [g for g in range(model.ngeom) if np.any(rows[g])]
        if acts:
            names = _listed([model.geom(g).name or f"geom {g}" for g in acts])
            found.append(Lacking(feature, f"{names} has {what}: dano has none"))
    if np.any(getattr(model, "pair_adhesion", 0.0)) and not any(x.feature == "adhesion" for x in found):
        found.append(Lacking("adhesion", "a pair has adhesion: dano has none"))
    if getattr(model, "nplastic", 0):
        found.append(Lacking("nonlinear springs", "joints or tendons that yield: dano has none"))
    return found


def _of_geoms(model: Any, mujoco: Any) -> list[Lacking]:
    types = mujoco.mjtGeom
    strange = {int(types.mjGEOM_HFIELD): "a height field", int(types.mjGEOM_SDF): "a signed distance"}
    found = []
    for g in range(model.ngeom):
        what = strange.get(int(model.geom_type[g]))
        if what and (model.geom_contype[g] or model.geom_conaffinity[g]):
            text = f"geom {model.geom(g).name or g!r} is {what}, which is not read"
            found.append(Lacking("height fields", text))
    return found


def _listed(names: list[str]) -> str:
    shown = ", ".join(map(repr, names[:4]))
    return shown if len(names) <= 4 else f"{shown} and {len(names) - 4} more"
