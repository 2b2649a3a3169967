"""What the bridge writes into a user's spec or compiled model."""

from contextlib import contextmanager
from typing import Any

import numpy as np

from dano.exchange import solid_triangles
from dano.extras import optional
from dano.fields import convex_hull
from dano.mujoco._things import AttachedObject
from dano.objects import NeuralObject

_MARK = "dano:"
"""A text element of that name and the body's says that a model was compiled from a spec with the object."""
_LOOK_GROUP = 2
"""MuJoCo's custom: what is only seen."""
_LOOK_NODES = 48
"""Along the longest side of the mesh that is drawn (chosen: fine enough to be looked at)."""
_HULL_GROUP = 3
"""MuJoCo's custom: what only collides."""
_HULL_CORNERS = 64
"""Most corners of the hull that stands in for an object (chosen: its edges look round)."""
_PLAIN = (0.85, 0.73, 0.61, 1.0)
"""Colour of objects without a look (chosen by eye)."""


def library() -> Any:
    """The module mujoco.

    Raises:
        ImportError: If it is missing.
    """
    return optional("mujoco", "dano.mujoco needs mujoco", "mujoco")


def names_of(target: Any, spec: bool) -> list[str]:
    """Names of the bodies of a spec or compiled model."""
    if spec:
        return [body.name for body in target.bodies]
    return [target.body(i).name for i in range(target.nbody)]


def carry(mujoco: Any, spec: Any, name: str, thing: AttachedObject, look: NeuralObject | None) -> None:
    """Give a body of a spec an object's mass and a stand-in, take its geoms out of contact, show it."""
    body = next(body for body in spec.bodies if body.name == name)
    mesh, hull = None, convex_hull(thing.surface.points)[0]
    if look is not None and look.solid is not None:
        mesh, _ = solid_triangles(look.solid, _LOOK_NODES)
    for geom in body.geoms:
        geom.contype = geom.conaffinity = 0
    body.mass, body.ipos, body.iquat = thing.mass, thing.com, [1, 0, 0, 0]
    body.inertia = [0, 0, 0]
    body.fullinertia = thing.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    body.explicitinertial = True
    # Robot files ask for it; the geom that stands for the object would go.
    spec.compiler.discardvisual = False
    spec.add_text(name=f"{_MARK}{name}", data="neural object")
    seen = {"contype": 0, "conaffinity": 0, "group": _LOOK_GROUP, "mass": 0.0, "rgba": _PLAIN}
    if mesh is not None:
        vertices = mesh.vertices @ thing.rotation.T + thing.origin
        spec.add_mesh(
            name=f"{_MARK}{name}",
            uservert=vertices.ravel().tolist(),
            userface=mesh.faces.ravel().tolist(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"{_MARK}{name}", **seen)
    # Collides where the bridge does not.
    spec.add_mesh(name=standin_name(name), uservert=hull.ravel().tolist(), maxhullvert=_HULL_CORNERS)
    contype, conaffinity = thing.bits
    seen |= {"contype": contype, "conaffinity": conaffinity, "group": _HULL_GROUP, "name": standin_name(name)}
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=standin_name(name), **seen)


def standin_name(body: str) -> str:
    """Name of the geom that collides for the object on a body where the bridge does not: its convex hull."""
    return f"{_MARK}{body}:hull"


def carry_compiled(mujoco: Any, model: Any, body: int, name: str, thing: AttachedObject) -> None:
    """Give a body of a compiled model an object's mass, and take its geoms out of contact.

    Raises:
        ValueError: If it has no geom, or was compiled for a symmetric mass.
    """
    first, count = model.body_geomadr[body], model.body_geomnum[body]
    if count < 1:
        raise ValueError(
            f"body {name!r} of a compiled model must have a geom, which stands for the object in contacts; "
            "it has none: attach to its MjSpec instead"
        )
    if model.body_simple[body]:
        raise ValueError(
            f"body {name!r} of a compiled model has its mass centred at its origin, along its axes: "
            "MuJoCo simplifies such bodies when it compiles, so attach to its MjSpec instead"
        )
    model.geom_contype[first : first + count] = 0
    model.geom_conaffinity[first : first + count] = 0
    model.body_contype[body] = model.body_conaffinity[body] = 0
    moments, axes = np.linalg.eigh(thing.inertia)
    axes = axes * np.sign(np.linalg.det(axes))
    turn = np.zeros(4)
    mujoco.mju_mat2Quat(turn, axes.ravel())
    model.body_mass[body], model.body_ipos[body] = thing.mass, thing.com
    model.body_inertia[body], model.body_iquat[body] = moments, turn
    # Not the data of a user: only what follows from masses in the model.
    mujoco.mj_setConst(model, mujoco.MjData(model))


def concerns(model: Any, name: str) -> bool:
    """Whether a model has a body, or was compiled from a spec whose body of that name has an object."""
    try:
        return model.body(name) is not None
    except KeyError:
        texts = [model.names[start:].split(b"\0", 1)[0] for start in model.name_textadr]
        return f"{_MARK}{name}".encode() in texts


@contextmanager
def without_callback(mujoco: Any):
    """Take the passive callback away: MuJoCo's compiler, which runs a step, cannot call one of Python.

    It is what the block is given.
    """
    before = mujoco.get_mjcb_passive()
    mujoco.set_mjcb_passive(None)
    try:
        yield before
    finally:
        mujoco.set_mjcb_passive(before)
