"""The centroid law: whole steps against the reference, and the reference's own derivatives."""

from typing import Any

import numpy as np
import pytest
from reference_step import scenes
from reference_step.kinematics import Kinematics
from reference_step.patches import patch_map, patch_wrench, patches_of
from reference_step.step import step

import dano

BOX = dano.Box((0.05, 0.04, 0.03))
CASES: dict[str, Any] = {
    "ball on floor": (dano.Sphere(0.05), scenes.FLOOR, dano.CentroidLaw(), 0.0495),
    "ball at rest": (dano.Sphere(0.05), scenes.FLOOR, dano.CentroidLaw(stiction_velocity=1e-7), 0.0495),
    "box on box": (BOX, scenes.TABLE, dano.CentroidLaw(smoothing=1000.0), 0.07),
    "box on capsule": (BOX, dano.Capsule(0.2, 0.1), dano.CentroidLaw(), 0.328),
    "object on floor": (scenes.lump, scenes.FLOOR, dano.CentroidLaw(), 0.034),
    "object on object": (scenes.lump, scenes.lump, dano.CentroidLaw(adhesive=True), 0.06),
}


def case(name):
    """A scene of two bodies, and a state in which they overlap."""
    shape, other, law, z = CASES[name]
    first = dano.Body("a", scenes.lump()) if shape is scenes.lump else dano.Body("a", shape, mass=1.0)
    if not isinstance(other, dano.Body):
        lump = other is scenes.lump
        other = dano.Body("b", scenes.lump()) if lump else dano.Body("b", other, fixed=True)
    scene = dano.Scene.create([first, other], [dano.Contact("a", other.name, law=law)], timestep=scenes.H)
    moves = dict(velocity=(0.3, 0.1, -0.02), omega=(1.0, 2.0, 3.0))
    still = dict(velocity=(0, 0, 0), omega=(0, 0, 0))
    motion = still if name == "ball at rest" else moves
    return scene, scene.initial_state(a=dict(position=(0.01, 0.002, z), orientation=scenes.TILTED, **motion))


@pytest.mark.parametrize("name", CASES)
def test_steps(engine, name):
    scene, state = case(name)
    expected, equations = step(scene, state)
    assert len(equations.patches) == 1
    following = engine.step(scene, state, None)
    for quantity in ("position", "orientation", "velocity", "omega"):
        np.testing.assert_allclose(
            getattr(following, quantity), expected[quantity], atol=1e-11, err_msg=quantity
        )


@pytest.mark.parametrize("law", [dano.CentroidLaw(), dano.CentroidLaw(stiction_velocity=1e-2, adhesive=True)])
@pytest.mark.parametrize("separating", [-0.05, 0.05, 0.2])
def test_derivatives_of_the_wrench_are_those_of_differences(law, separating):
    scene, state = case("ball on floor")
    kinematics = Kinematics(scene, state)
    patch = patches_of(kinematics.scene, kinematics.bodies)[0]
    params = patch.contact.params.filled(torsional_drag=0.02, rolling_drag=0.03)
    patch = patch._replace(contact=dano.Contact("a", "floor", params, law))
    rng = np.random.default_rng(0)
    T = patch_map(patch)
    V = rng.normal(size=(2, 6)) * 0.1
    V[0, :3] += (separating - (T @ V.ravel())[:3] @ patch.normal) * patch.normal

    def wrench(twist):
        change = np.linalg.lstsq(T, twist, rcond=None)[0].reshape(2, 6)
        return patch_wrench(patch, V + change)[0]

    size = 1e-7
    slopes = np.array([(wrench(size * e) - wrench(-size * e)) / (2 * size) for e in np.eye(6)]).T
    scale = max(np.abs(slopes).max(), 1e-9)
    np.testing.assert_allclose(patch_wrench(patch, V)[1], slopes, atol=1e-6 * scale)
