"""Products of 32-bit matrices ask for all digits, which GPUs otherwise do not give (TF32: a thousandth)."""

from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import dano
from dano.fields import posed, union

SHORT = jnp.float32


def short(tree):
    """The same in 32 bits."""
    return jax.tree.map(lambda x: x.astype(SHORT) if eqx.is_inexact_array(x) else x, tree)


def products(jaxpr) -> Iterator:
    """All products of matrices in a program and in those that it calls."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation
        for inner in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")
        ):
            if hasattr(inner, "eqns") or hasattr(inner, "jaxpr"):
                yield from products(getattr(inner, "jaxpr", inner))


def scene_of(law) -> dano.Scene:
    """A body of two boxes over a floor, on a hinge to a rod that a loop holds."""
    other = posed(dano.Box((0.05, 0.1, 0.1)), dano.Pose((0.12, 0, 0), (1, 0, 0.1, 0)))
    pair = union(dano.Box((0.1, 0.1, 0.1)), other)
    bodies = [
        dano.Body("pair", pair, mass=1.0),
        dano.Body("rod", dano.Box((0.2, 0.01, 0.01)), mass=0.1),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    return dano.Scene.create(
        bodies,
        [dano.Contact("pair", "floor", law=law)],
        joints=[dano.Joint("pair", "rod", anchor=(-0.2, 0, 0), position=(0.2, 0, 0))],
        loops=[dano.Loop(None, "rod", position=(0.2, 0, 0.09))],
        timestep=1e-3,
    )


@pytest.mark.parametrize("law", [dano.DistributedLaw(), dano.CentroidLaw()], ids=["points", "patch"])
def test_products_of_a_step_have_all_digits(law):
    scene = scene_of(law)
    state = scene.initial_state(pair={"position": (0, 0, 0.09)})
    numbers, rest = eqx.partition(short((scene, state)), eqx.is_inexact_array)

    def step(numbers):
        return dano.step(*eqx.combine(numbers, rest))

    program = jax.make_jaxpr(lambda numbers, way: jax.jvp(step, (numbers,), (way,)))(numbers, numbers)
    found = list(products(program.jaxpr))
    for equation in found:
        asked = equation.params["precision"]
        assert asked is not None and set(jax.tree.leaves(asked)) == {jax.lax.Precision.HIGHEST}, equation
