"""Functions that are one program: compiled once for each kind of arguments, themselves where traced."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import monitoring

from dano.compiling import one_program
from dano.fields import GridField

COMPILED = "/jax/core/compile/backend_compile_duration"


def test_many_operations_are_one_program():
    values = np.random.default_rng(0).random((7, 6, 5)) + 0.1
    density = GridField(values, (0.0, 0.0, 0.0), 0.1)
    seen = []
    monitoring.register_event_duration_secs_listener(lambda event, duration_secs, **_: seen.append(event))

    def programs(function, x):
        seen.clear()
        return function(x), seen.count(COMPILED)

    x = jnp.asarray(np.linspace(0, 1, 3 * 61).reshape(3, 61))
    jet = one_program(lambda x: density.jet(x, 1))
    found, of_all = programs(jet, x)
    assert of_all <= 2
    assert programs(jet, x)[1] == 0
    wanted, of_each = programs(lambda x: density.jet(x, 1), x)
    assert of_each > 10
    for mine, theirs in zip(found, wanted, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-12, atol=1e-13)


def test_traces_once_for_each_kind_of_arguments():
    calls = []

    @one_program
    def double(x, factor):
        calls.append(x)
        return factor * x

    for _ in range(3):
        assert double(jnp.ones(3), 2)[0] == 2
    assert len(calls) == 1
    assert double(jnp.ones(3), 2.0)[0] == 2
    assert double(jnp.ones(4), 2)[0] == 2
    assert double(jnp.ones(3, np.float32), 2).dtype == np.float32
    assert len(calls) == 4


def test_is_the_function_itself_where_it_is_traced():
    @one_program
    def square(x):
        return jnp.sum(x * x)

    x = jnp.arange(3.0)
    np.testing.assert_allclose(jax.grad(square)(x), 2 * x)
    np.testing.assert_allclose(jax.jit(square)(x), 5)
    np.testing.assert_allclose(jax.vmap(square)(x[:, None]), x**2)


def test_results_are_arrays_of_their_own():
    x = np.zeros(3)
    same = one_program(lambda x: x)(x)
    x[0] = 1
    assert same[0] == 0


def test_is_the_function_itself_where_arguments_have_no_hash():
    class Odd:
        __hash__ = None  # pyright: ignore[reportAssignmentType]

    assert one_program(lambda x, odd: (x + 1, odd))(jnp.ones(2), odd := Odd())[1] is odd
