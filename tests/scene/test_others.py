"""Pairs of bodies that no contact names."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.scene_file import parse_scene

SIDE = 0.1  # [m]


def bodies(**materials: dano.ContactParams) -> list[dano.Body]:
    cube = dano.Box((SIDE / 2,) * 3)
    return [
        dano.Body("cube", cube, mass=1.0, material=materials.get("cube")),
        dano.Body("ball", dano.Sphere(0.04), mass=0.5, material=materials.get("ball")),
        dano.Body("floor", dano.HalfSpace(), fixed=True, material=materials.get("floor")),
    ]


def sliding(scene: dano.Scene, speed: float = 1.0) -> dano.State:
    start: dict[str, Any] = {"position": (0, 0, SIDE / 2), "velocity": (speed, 0, 0)}
    return scene.initial_state(cube=start, ball={"position": (0.16, 0, 0.04)})


PARAMS = dano.ContactParams(sliding_friction=0.3, restitution=0.4)


def test_one_material_is_the_same_as_naming_all_pairs():
    named = [dano.Contact(a, b, PARAMS) for a, b in (("cube", "ball"), ("cube", "floor"), ("ball", "floor"))]
    listed = dano.Scene.create(bodies(), named, timestep=0.005)
    scene = dano.Scene.create(bodies(), others=PARAMS, timestep=0.005)
    assert scene.pairs == listed.pairs == (("cube", "ball"), ("cube", "floor"), ("ball", "floor"))
    # Stiffness is that of the body that presses most, so the two agree where both bodies' own are used.
    runs = [dano.simulate(each, sliding(each), 60) for each in (listed, scene)]
    np.testing.assert_allclose(runs[0].states.position, runs[1].states.position, atol=1e-12)
    forces = [dano.contact_wrenches(s, run.states) for s, run in zip((listed, scene), runs, strict=True)]
    np.testing.assert_allclose(forces[0], forces[1], atol=1e-8)
    assert np.abs(np.asarray(forces[0])).max(axis=(0, 2)).min() > 0.1


def test_friction_is_the_geometric_mean():
    rubber, ice = dano.ContactParams(sliding_friction=0.9), dano.ContactParams(sliding_friction=0.1)
    scene = dano.Scene.create(
        bodies(cube=rubber, floor=ice), others=PARAMS, apart=[("cube", "ball")], timestep=0.005
    )
    n = 40
    run = dano.simulate(scene, sliding(scene), n)
    # √(0.9 · 0.1) = 0.3, and Coulomb's law from the step after the one that lands.
    speed = np.asarray(run.states.velocity[:, 0, 0])
    np.testing.assert_allclose(speed[n // 2] - speed[-1], 0.3 * 9.81 * 0.005 * (n - n // 2), rtol=1e-4)


def test_rules_of_the_other_parameters():
    a = dano.ContactParams(restitution=0.2, hysteresis=0.1, stiffness=1e5, friction_pressure=10.0)
    b = dano.ContactParams(restitution=0.6, hysteresis=0.0, stiffness=3e5, friction_pressure=30.0)
    scene = dano.Scene.create(bodies(cube=a, ball=b), others=PARAMS)
    assert scene.others is not None
    pair = scene.others.pair_params
    found = [float(getattr(pair, name)[0]) for name in ("restitution", "hysteresis", "stiffness")]
    np.testing.assert_allclose(found, [0.6, 0.1, 3e5])
    np.testing.assert_allclose(pair.friction_pressure[0], 10.0)


def test_named_pairs_go_before_and_apart_pairs_pass_through():
    named = dano.Contact("floor", "cube", dano.ContactParams(sliding_friction=0.0))
    scene = dano.Scene.create(bodies(), [named], others=PARAMS, apart=[("ball", "floor")], timestep=0.005)
    assert scene.pairs == (("floor", "cube"), ("cube", "ball"))
    run = dano.simulate(scene, sliding(scene, speed=0.0), 100)
    assert run.states.position[-1, 1, 2] < -0.3
    np.testing.assert_allclose(run.states.position[-1, 0], (0, 0, SIDE / 2), atol=1e-3)


def test_what_a_joint_joins_does_not_touch():
    lid = dano.Joint("cube", "ball", anchor=(0.0, 0.0, -0.1), position=(0.05, 0.0, 0.0))
    scene = dano.Scene.create(bodies(), joints=[lid], others=PARAMS)
    assert scene.pairs == (("cube", "floor"), ("ball", "floor"))


def test_derivative_of_a_mean_by_a_material():
    """√(μ_a μ_b) changes by half as much as μ_a where both are equal, and not with a third body's."""
    scene = dano.Scene.create(bodies(), others=PARAMS)

    def frictions(friction):
        others = scene.replace_material("cube", sliding_friction=friction).others
        assert others is not None
        return others.pair_params.sliding_friction

    slopes = dict(zip(scene.pairs, np.asarray(jax.jacfwd(frictions)(0.3)), strict=True))
    assert slopes == pytest.approx({("cube", "ball"): 0.5, ("cube", "floor"): 0.5, ("ball", "floor"): 0.0})


@pytest.mark.slow
def test_derivative_by_a_material():
    scene = dano.Scene.create(bodies(), others=PARAMS, apart=[("cube", "ball")], timestep=0.005)
    state = sliding(scene)

    @jax.jit
    @jax.value_and_grad
    def way(friction):
        rubbed = scene.replace_material("cube", sliding_friction=friction)
        return dano.simulate(rubbed, state, 40).states.position[-1, 0, 0]

    slope = float(way(0.3)[1])
    for step, tolerance in ((1e-2, 2e-3), (1e-5, 1e-5)):
        difference = float(way(0.3 + step)[0] - way(0.3 - step)[0]) / (2 * step)
        assert slope == pytest.approx(difference, rel=tolerance)
    # x = v t − √(μ_c μ_f) g t²/2, so that the slope is −g t²/4 where both are equal.
    assert slope == pytest.approx(-9.81 * 0.2**2 / 4, rel=0.03)


def test_no_friction_has_a_derivative():
    scene = dano.Scene.create(bodies(), others=dano.ContactParams(sliding_friction=0.0))

    def total(friction):
        others = scene.replace_material("cube", sliding_friction=friction).others
        assert others is not None
        return jnp.sum(others.pair_params.sliding_friction)

    assert float(jax.grad(total)(0.0)) == 0.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"apart": [("cube", "ball")], "contacts": ()}, "apart must be empty"),
        ({"others": PARAMS, "apart": [("cube", "bowl")]}, "apart must name bodies of the scene"),
        ({"others": dano.ContactParams(spring=1.0)}, "does not read spring"),
    ],
)
def test_wrong_arguments(arguments: dict[str, Any], message: str):
    with pytest.raises(ValueError, match=message):
        dano.Scene.create(bodies(), **arguments)


def test_a_material_that_nothing_reads():
    with pytest.raises(ValueError, match="material of body 'cube'"):
        dano.Scene.create(bodies(cube=PARAMS), contacts=())
    with pytest.raises(ValueError, match="does not read spring"):
        dano.Scene.create(bodies(cube=dano.ContactParams(spring=1.0)), others=PARAMS)
    scene = dano.Scene.create(bodies(), others=PARAMS)
    with pytest.raises(ValueError, match="material must be changed in"):
        scene.replace_material("cube", damper=1.0)
    with pytest.raises(ValueError, match="others=…"):
        dano.Scene.create(bodies(), contacts=()).replace_material("cube", restitution=1.0)


def test_without_contacts_all_that_may_touch_touches():
    scene = dano.Scene.create(bodies(), timestep=0.005)
    assert set(scene.pairs) == {("cube", "ball"), ("cube", "floor"), ("ball", "floor")}
    assert scene.others is None
    named = dano.Scene.create(bodies(), [dano.Contact(*pair) for pair in scene.pairs], timestep=0.005)
    for ours, theirs in zip(jax.tree.leaves(scene), jax.tree.leaves(named), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert dano.Scene.create(bodies(), contacts=()).pairs == ()
    assert set(dano.Scene.create(bodies(), apart=[("ball", "cube")]).pairs) == {
        ("cube", "floor"),
        ("ball", "floor"),
    }
    lid = dano.Joint("cube", "ball")
    assert ("cube", "ball") not in dano.Scene.create(bodies(), joints=[lid]).pairs
    with pytest.raises(ValueError, match="apart must name bodies"):
        dano.Scene.create(bodies(), apart=[("cube", "bowl")])
    made_of = dano.Scene.create(bodies(cube=dano.ContactParams(sliding_friction=0.9)))
    assert made_of.others is not None and set(made_of.pairs) == set(scene.pairs)


def test_many_pairs_are_held_in_arrays():
    many = [dano.Body(f"ball {i}", dano.Sphere(0.1), mass=1.0) for i in range(25)]
    scene = dano.Scene.create(many)
    assert not scene.contacts and len(scene.pairs) == 25 * 24 // 2


def test_a_scene_file_and_python_have_one_default():
    shapes = '[[bodies]]\nname = "{0}"\nshape = "box"\nhalf_extents = [0.1, 0.1, 0.1]\nmass = 1.0\n'
    text = "timestep = 0.01\nn_steps = 1\n" + shapes.format("a") + shapes.format("b")
    text += '[[bodies]]\nname = "floor"\nshape = "half_space"\nfixed = true\n'
    read = parse_scene(text, Path("pile.toml")).scene
    assert read.pairs == dano.Scene.create(read.bodies).pairs
