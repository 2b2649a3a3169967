"""Functions of a file in place of those of a point: viscous friction in closed form, and its derivatives."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano

H, STEPS, DRAG, SPEED, G = 0.005, 40, 0.5, 0.3, 9.81
VISCOUS = '''
"""Friction as in oil: the slip times the pressure and a number [s/m]."""

import warp as wp

from dano.physics.friction import following_friction, Friction
from dano.physics.point_law import Duals, Linear, Motion, PointLaw, pressure, Traction
from dano.physics.real import real, vec3, ZERO


@wp.func
def traction(law: PointLaw, rate: real, slip: vec3) -> Traction:
    found = Traction()
    found.pressure = pressure(law, rate, ZERO, law.stiction).value
    found.friction = -(law.numbers[0] * found.pressure) * slip
    return found


@wp.func
def linearized(law: PointLaw, motion: Motion, duals: Duals, share: real) -> Linear:
    found = Linear()
    found.pressure = pressure(law, motion.rate, duals.direction, law.stiction)
    drag = share * law.numbers[0]
    found.grip = drag * found.pressure.value
    found.friction = -found.grip * motion.slip
    found.by_pressure = (drag * found.pressure.damping) * motion.slip
    return found
'''


def oiled(functions, numbers=(DRAG, 0.0, 0.0)):
    law = dano.DistributedLaw(functions=functions, numbers=numbers)
    bodies = [
        dano.Body("box", dano.Box((0.1, 0.1, 0.02)), mass=1.0),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    return dano.Scene.create(bodies, [dano.Contact("box", "floor", law=law)], timestep=H)


def write(folder: Path, text: str) -> Path:
    path = folder / "law.py"
    path.write_text(text)
    return path


@pytest.mark.parametrize("mode", ["reverse", pytest.param("forward", marks=pytest.mark.slow)])
def test_a_box_slows_down_as_in_oil(tmp_path, mode):
    """v = v₀/(1 + c g h)ⁿ, and its derivative by c."""
    scene = oiled(write(tmp_path, VISCOUS))
    rest = dano.simulate(scene, scene.initial_state(box=dict(position=(0, 0, 0.02))), 100).states
    state = scene.initial_state(box=dict(position=rest.position[-1, 0], velocity=(SPEED, 0, 0)))

    def speed(drag):
        changed = eqx.tree_at(lambda s: s.contacts[0].law.numbers, scene, jnp.array([1.0, 0.0, 0.0]) * drag)
        return dano.simulate(changed, state, STEPS).states.velocity[-1, 0, 0]

    v = speed(jnp.asarray(DRAG))
    slope = (jax.jacrev if mode == "reverse" else jax.jacfwd)(speed)(jnp.asarray(DRAG))
    expected = SPEED / (1 + DRAG * G * H) ** STEPS
    np.testing.assert_allclose(v, expected, rtol=1e-3)
    np.testing.assert_allclose(slope, -STEPS * G * H / (1 + DRAG * G * H) * expected, rtol=2e-3)


@pytest.mark.parametrize(
    "text, said",
    [
        ("x = 1", "at least one of .*traction"),
        ("def f(:", "that Python runs"),
        (
            "import warp as wp\nfrom dano.physics.real import real\n\n"
            "@wp.func\ndef pressure(rate: real) -> real:\n    return rate\n",
            r"must take \(law, rate, direction, stiction\), got \(rate\)",
        ),
    ],
)
def test_files_that_are_no_law(tmp_path, text, said):
    scene = oiled(write(tmp_path, text))
    with pytest.raises(ValueError, match=said):
        dano.step(scene, scene.initial_state(box=dict(position=(0, 0, 0.02))))


def test_one_law_a_scene(tmp_path):
    with pytest.raises(ValueError, match="functions must be a file, got"):
        dano.DistributedLaw(functions=tmp_path / "none.py")
    own = dano.DistributedLaw(functions=write(tmp_path, VISCOUS))
    boxes = [dano.Body(name, dano.Box((0.1, 0.1, 0.02)), mass=1.0) for name in "ab"]
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    contacts = [dano.Contact("a", "floor", law=own), dano.Contact("b", "floor")]
    scene = dano.Scene.create([*boxes, floor], contacts)
    with pytest.raises(ValueError, match="must be the same for all contacts of a scene"):
        dano.step(scene, scene.initial_state(b=dict(position=(1, 0, 0.02))))
