"""Launches on GPUs, as far as a CPU can tell: lanes that take turns, programs, and compiling for a GPU."""

import ctypes
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import warp as wp

import dano
from dano.engine.launching import _cuda, _launch, _tables, listed_points, rollout, scene_tables, SolverOptions
from dano.native import begin, Features, instance

N_STEPS, ROOM = 4, 16
KERNELS = {
    "rollout": "rollout",
    "listing": "listing",
    "pullback": "derivatives.pullback",
    "pushforward": "derivatives.pushforward",
}


@pytest.fixture(scope="module")
def stack():
    """A box that slides on a floor and one that lands on it askew, and their state."""
    boxes = [dano.Body(name, dano.Box((0.05, 0.04, 0.03)), mass=1.0) for name in "ab"]
    scene = dano.Scene.create(
        [*boxes, dano.Body("floor", dano.HalfSpace(), fixed=True)],
        others=dano.ContactParams(sliding_friction=0.4),
        timestep=0.01,
    )
    state = scene.initial_state(
        a=dict(position=(0, 0, 0.031), velocity=(0.5, 0, 0)),
        b=dict(position=(0.01, 0.005, 0.095), orientation=(1, 0.1, 0.05, 0)),
    )
    return scene, state


@pytest.fixture
def in_lanes(monkeypatch):
    """Runs a function with the launches of a GPU, whose lanes take turns on a CPU, in a room full of NaN."""
    launch = _cuda._Blocks.launch

    def launched(blocks, inputs, outputs, stream):
        ctypes.memset(outputs[-1], 0xFF, blocks.room_bytes)
        launch(blocks, inputs, outputs, stream)

    def run(function, *args):
        begin()
        with monkeypatch.context() as patch:
            patch.setattr(wp.config, "enable_cpu_blocks", True)
            patch.setattr(_cuda._Blocks, "launch", launched)
            patch.setattr(_launch, "call", lambda *given: _cuda.call(*given, platform="cpu"))
            jax.clear_caches()
            found = jax.block_until_ready(function(*args))
        jax.clear_caches()
        return found

    return run


def narrowed(tree, dtype):
    """Real numbers of another type."""
    return jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, tree)


def rolled(scene, velocity, state):
    """Positions, and whether all steps were solved."""
    begun = eqx.tree_at(lambda s: s.velocity, state, velocity)
    states, report = rollout(scene_tables(scene), begun, None, N_STEPS, ROOM, SolverOptions())
    return states.position, report.converged


def height(velocity, scene, state):
    """A number of a rollout's end."""
    return jnp.sum(rolled(scene, velocity, state)[0][-1] ** 2)


@pytest.mark.slow
def test_lanes_list_the_same_points(stack, in_lanes):
    """Every point, once, and nothing else, whatever lane found it."""
    scene, state = stack

    def listed():
        return listed_points(scene_tables(scene), state, ROOM)

    def sorted_rows(points):
        rows = np.column_stack([np.asarray(points[name]) for name in points if name != "overflow"])
        rows = rows[np.asarray(points["area"]) > 0]
        return rows[np.lexsort(rows.T[:4])]

    one, many = sorted_rows(listed()), sorted_rows(in_lanes(listed))
    assert len(one) > 20
    np.testing.assert_allclose(many, one, atol=1e-13)


@pytest.mark.parametrize("swept", [False, True], ids=["all pairs", "sweep"])
def test_lanes_take_the_same_steps(swept, stack, in_lanes, monkeypatch):
    """A rollout of worlds that differ."""
    scene, state = stack
    monkeypatch.setattr(_tables, "SWEPT", 0 if swept else 100)
    velocities = state.velocity[None] * jnp.linspace(0.9, 1.1, 3)[:, None, None]

    def worlds():
        return jax.vmap(lambda v: rolled(scene, v, state))(velocities)

    (one, solved), (many, solved_in_lanes) = worlds(), in_lanes(worlds)
    assert np.all(solved) and np.all(solved_in_lanes)
    np.testing.assert_allclose(many, one, atol=1e-10)


@pytest.mark.slow
def test_lanes_take_steps_in_32_bits(stack, in_lanes):
    """Numbers of 32 bits in the kernel itself: the same motion, to what they can tell."""
    scene, state = narrowed(stack, jnp.float32)
    position, solved = in_lanes(rolled, scene, state.velocity, state)
    assert position.dtype == jnp.float32 and np.all(solved)
    np.testing.assert_allclose(position, rolled(stack[0], stack[1].velocity, stack[1])[0], atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["reverse", "forward"])
def test_lanes_find_the_same_derivatives(mode, stack, in_lanes):
    """By the velocities at the start."""
    scene, state = stack
    derivative = {"reverse": jax.grad, "forward": jax.jacfwd}[mode](height)
    one, many = (run(derivative, state.velocity, scene, state) for run in (lambda f, *x: f(*x), in_lanes))
    assert np.abs(one).max() > 1e-4
    np.testing.assert_allclose(many, one, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_programs_for_a_gpu(dtype, stack):
    """A program for a GPU is made where there is none; launches have room, and reverse mode adds in place."""
    scene, state = narrowed(stack, dtype)
    program = jax.jit(jax.grad(lambda v: height(v, scene, state)))
    text = program.trace(state.velocity).lower(lowering_platforms=("cuda",)).as_text()
    calls = [line for line in text.splitlines() if "custom_call @dano_" in line]
    assert [line.split("@dano_")[1].split("_")[0] for line in calls] == ["rollout", "pullback"]
    assert all("_CUDA(" in line and "xui8>" in line for line in calls)
    assert "output_operand_alias" in calls[1] and "output_operand_alias" not in calls[0]
    width = {jnp.float32: "f32", jnp.float64: "f64"}[dtype]
    assert f"x13x{width}>" in calls[0]


@pytest.mark.slow
@pytest.mark.parametrize("wide", [True, False], ids=["float64", "float32"])
@pytest.mark.parametrize("kernel", KERNELS)
def test_kernels_compile_for_gpus(kernel, wide, tmp_path: Path):
    """Into machine code, as on a machine with a GPU."""
    features = Features(
        KINDS=frozenset({0, 6}), DEGREES=frozenset({2}), UNIONS=False, PATCHES=False, TREES=False,
        LANES=_cuda.LANES, WIDE=wide,
    )  # fmt: skip
    module = getattr(instance(features, f"dano.engine.kernels.{KERNELS[kernel]}"), kernel).module
    module.options["block_dim"] = _cuda.LANES
    made = wp.compile_aot_module(module, arch=[90], module_dir=tmp_path, use_ptx=False)
    assert [path.stat().st_size > 1e4 for path in made] == [True]
