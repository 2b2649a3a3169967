"""Supports of every type of MuJoCo's, with their top at z = 0, and objects to lie on them."""

import functools
import importlib.resources

import jax
import mujoco
import numpy as np

from dano import Box, load_field, NeuralObject, Sphere
from dano.scene_file import load_asset

TYPES = mujoco.mjtGeom
LYING = (0.7071067811865476, 0.0, 0.7071067811865476, 0.0)


def _block(spec) -> dict:
    corners = np.array([[x, y, z] for x in (-0.2, 0.2) for y in (-0.2, 0.2) for z in (-0.2, 0.0)])
    spec.add_mesh(name="block", uservert=corners.ravel().tolist())
    return {"type": TYPES.mjGEOM_MESH, "meshname": "block"}


def _hollow(spec) -> dict:
    x = np.linspace(-1, 1, 41)
    heights = 1 - np.exp(-4 * (x[None] ** 2 + x[:, None] ** 2))
    spec.add_hfield(name="hollow", nrow=41, ncol=41, size=[0.3, 0.3, 0.05, 0.05], userdata=heights.ravel())
    return {"type": TYPES.mjGEOM_HFIELD, "hfieldname": "hollow"}


SUPPORTS = {
    "plane": lambda spec: {"type": TYPES.mjGEOM_PLANE, "size": [5, 5, 1]},
    "box": lambda spec: {"type": TYPES.mjGEOM_BOX, "size": [0.2, 0.2, 0.1], "pos": [0, 0, -0.1]},
    "sphere": lambda spec: {"type": TYPES.mjGEOM_SPHERE, "size": [0.5, 0, 0], "pos": [0, 0, -0.5]},
    "capsule": lambda spec: {
        "type": TYPES.mjGEOM_CAPSULE,
        "size": [0.3, 0.3, 0],
        "pos": [0, 0, -0.3],
        "quat": LYING,
    },
    "cylinder": lambda spec: {
        "type": TYPES.mjGEOM_CYLINDER,
        "size": [0.3, 0.3, 0],
        "pos": [0, 0, -0.3],
        "quat": LYING,
    },
    "ellipsoid": lambda spec: {
        "type": TYPES.mjGEOM_ELLIPSOID,
        "size": [0.6, 0.5, 0.3],
        "pos": [0, 0, -0.3],
    },
    "mesh": _block,
    "height field": _hollow,
}


@functools.cache
def thing(name: str) -> NeuralObject:
    """A shipped object, or a ball of samples."""
    if name == "bar":
        return NeuralObject.from_field(Box((0.05, 0.02, 0.02)), mass=0.2, n_samples=500, resolution=32)
    if name == "ball":
        return NeuralObject.from_field(Sphere(0.05), n_samples=2000, mass=0.5, key=jax.random.key(1))
    if name == "bunny":
        # Coarser than the shipped one is built, to be quick.
        field = load_field(str(importlib.resources.files("dano") / "assets" / "bunny.npz"))
        return NeuralObject.from_field(field, n_samples=2500, mass=1.0, resolution=48)
    return load_asset(name)


def world(support: str | None, timestep: float = 0.002):
    """A spec with a support and a free body "toy" without geoms.

    With MuJoCo's advice against creeping: on a slope its friction gives way, ours or not.
    """
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10.0
    if support is not None:
        spec.worldbody.add_geom(name="support", **SUPPORTS[support](spec))
    spec.worldbody.add_body(name="toy", pos=[0, 0, 0.07]).add_freejoint()
    return spec


def gripper(timestep: float, speed: float, *, damping: float = 0.0, half: float = 0.005):
    """Two fingers that meet at the toy from both sides, at this speed if undamped; the toy hangs in the air.

    The fingers are boxes of 100 g, pushed by a constant force; `half` of their thickness [m].
    """
    spec = world(None, timestep)
    spec.option.gravity = [0, 0, 0]
    way = 0.05
    for name, side in (("left", -1), ("right", 1)):
        finger = spec.worldbody.add_body(name=name, pos=[0, side * (0.045 + way + half), 0.05])
        finger.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, -side, 0], damping=damping)
        finger.add_geom(type=TYPES.mjGEOM_BOX, size=[0.03, half, 0.03], mass=0.1)
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.gainprm[0] = 0.1 * speed**2 / (2 * way)
    return spec
