"""Supports of every type of MuJoCo's, with their top at z = 0, and objects to lie on them."""

import functools
import importlib.resources

import jax
import mujoco
import numpy as np

from dano import load_field, NeuralObject, Sphere
from dano.scene_file import build_asset

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
    if name == "ball":
        return NeuralObject.from_field(Sphere(0.05), n_samples=2000, mass=0.5, key=jax.random.key(1))
    if name == "bunny":
        # Coarser than the shipped one is built, to be quick.
        field = load_field(str(importlib.resources.files("dano") / "assets" / "bunny.npz"))
        return NeuralObject.from_field(field, n_samples=2500, mass=1.0, resolution=48)
    return build_asset(name)


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
