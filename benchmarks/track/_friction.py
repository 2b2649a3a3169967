"""Friction of a slide from tracked poses."""

import warnings

import dano
from dano.identify import identify, Motion
from dano.scene_file import build_asset
from dano.vision import Tracked


def friction_of(name: str, found: Tracked) -> tuple[float, float]:
    """Friction and its standard error, from the poses of a film and their covariances."""
    scene = dano.Scene.create(
        bodies=[
            dano.Body(name, build_asset(f"trained_{name}")),
            dano.Body("table", dano.HalfSpace(), fixed=True),
        ],
        contacts=[dano.Contact(name, "table", dano.ContactParams(sliding_friction=0.5))],
        timestep=1 / 120,
    )
    motion = Motion.from_tracked(found, name)
    friction = dano.Parameter("mu", lambda s: s.contact(name, "table").sliding_friction, 0.02, 1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        fit = identify(scene, motion, [friction], initial="velocities")
    return float(fit.values["mu"]), float(fit.standard_errors["mu"])
