"""Many rollouts: equal to one at a time, on devices, in processes, in memory, on disk, after a kill."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from engine import batch_cases
from engine.batch_cases import arrays, case, fit, N, N_STEPS, SIZES

import dano
from dano.engine.batches._input import checked_job

SOURCES = Path(dano.__file__).parents[1]
SECONDS = 240


@pytest.fixture(scope="module")
def runs() -> dano.Rollouts:
    rubbed, states, frictions = case()
    return dano.rollouts(rubbed, states, N_STEPS, parameters=frictions, **SIZES)


@pytest.fixture(scope="module")
def single() -> list[dano.Trajectory]:
    rubbed, states, frictions = case()
    return [
        dano.simulate(rubbed(frictions[i]), jax.tree.map(lambda leaf, i=i: leaf[i], states), N_STEPS)
        for i in range(N)
    ]


@pytest.fixture(scope="module")
def two_devices(tmp_path_factory) -> tuple[dict, Path, int]:
    """Numbers of a process with two devices, and the folder in which it was killed."""
    folder = tmp_path_factory.mktemp("devices")
    process = start(folder, 2)
    said = finish([process])[0]
    if not (folder / "0.npz").exists():
        pytest.fail(f"the program on two devices failed: {said[-2000:]}")
    return dict(np.load(folder / "0.npz")), folder / "killed", process.returncode


def start(folder: Path, *numbers: int) -> subprocess.Popen:
    command = [sys.executable, batch_cases.__file__, str(folder), *map(str, numbers)]
    environment = {**os.environ, "PYTHONPATH": str(SOURCES)}
    return subprocess.Popen(
        command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )


def finish(processes: list[subprocess.Popen]) -> list[str]:
    try:
        return [process.communicate(timeout=SECONDS)[0] for process in processes]
    finally:
        for process in processes:
            process.kill()
            process.wait()


def same(found: dict, expected: dict) -> None:
    for name, value in expected.items():
        # What is left of a solved step is rounding, and another program rounds otherwise.
        atol = 1e-7 if name == "residual" else 1e-12
        np.testing.assert_allclose(found[name], value, rtol=1e-12, atol=atol, err_msg=name)


def test_equals_single_rollouts(runs: dano.Rollouts, single: list[dano.Trajectory]):
    for i, run in enumerate(single):
        np.testing.assert_allclose(runs.states.position[i], run.states.position, rtol=0, atol=1e-10)
        np.testing.assert_allclose(runs.states.velocity[i], run.states.velocity, rtol=0, atol=1e-10)
        np.testing.assert_allclose(runs.times[i], run.times)
        assert bool(runs.converged[i]) == bool(run.converged.all())
        assert runs.residual[i] <= 2 * run.residuals.max() + 1e-11
    assert runs.names == ("ball", "floor")


def test_keep(runs: dano.Rollouts):
    rubbed, states, frictions = case()
    some = dano.rollouts(rubbed, states, N_STEPS, parameters=frictions, keep=15, **SIZES)
    assert some.steps.tolist() == [0, 15, 30, N_STEPS]
    np.testing.assert_allclose(some.states.position, runs.states.position[:, some.steps], atol=1e-12)
    # A scene with a leading axis everywhere is the same as a function of parameters.
    scenes = jax.vmap(rubbed)(frictions)
    last = dano.rollouts(scenes, states, N_STEPS, keep="last", **SIZES)
    assert last.steps.tolist() == [N_STEPS]
    np.testing.assert_allclose(last.states.position[:, 0], runs.states.position[:, -1], atol=1e-12)
    np.testing.assert_allclose(last.times[:, 0], N_STEPS * 0.01)


def test_controls_and_unconverged_steps():
    """Each rollout has its forces; a solver that may hardly iterate says where it failed."""
    rubbed, states, _ = case()
    scene = rubbed(jnp.asarray(0.3))
    one = jax.tree.map(lambda leaf: leaf[0], states)
    force = jnp.zeros((N, N_STEPS, 2, 3)).at[:, :, 0, 1].set(jnp.linspace(0.0, 1.0, N)[:, None])
    torque = jnp.zeros_like(force)
    lazy = dano.VariationalEngine(max_iterations=1)
    with pytest.warns(RuntimeWarning, match=f"{N} of {N} rollouts have steps that did not converge"):
        pushed = dano.rollouts(scene, one, controls=dano.Control(force, torque), keep="last", engine=lazy)
    with pytest.warns(RuntimeWarning, match="did not converge"):
        run = dano.simulate(scene, one, controls=dano.Control(force[7], torque[7]), engine=lazy)
    np.testing.assert_allclose(pushed.states.position[7, 0], run.states.position[-1], atol=1e-10)
    wrong = np.flatnonzero(~np.asarray(run.converged))
    assert not pushed.converged.any()
    assert int(pushed.first_unconverged[7]) == wrong[0]
    assert int(pushed.unconverged[7]) == len(wrong)
    assert float(pushed.residual[7]) == pytest.approx(float(run.residuals.max()), rel=1e-6)


def test_two_devices(runs: dano.Rollouts, two_devices):
    found, _, _ = two_devices
    assert found["counts"].tolist() == [1, 2]
    same(found, arrays(runs))


@pytest.mark.slow
def test_identification_on_two_devices(two_devices):
    found, expected = two_devices[0], fit()
    assert expected.values["mu"] == pytest.approx(0.2, rel=1e-6)
    assert float(found["mu"]) == pytest.approx(expected.values["mu"], rel=1e-10)
    assert float(found["error"]) == pytest.approx(expected.standard_errors["mu"], rel=1e-3)


@pytest.mark.slow
def test_two_processes(runs: dano.Rollouts, tmp_path: Path):
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
    processes = [start(tmp_path, 1, 2, rank, port) for rank in (0, 1)]
    try:
        said = finish(processes)
    except subprocess.TimeoutExpired:
        pytest.skip(f"two processes did not find each other on loopback within {SECONDS} s")
    if any("UNIMPLEMENTED" in text or "DEADLINE_EXCEEDED" in text for text in said):
        pytest.skip(f"this machine runs no collectives between processes: {said[0][-300:]}")
    assert [process.returncode for process in processes] == [0, 0], "\n".join(text[-2000:] for text in said)
    mu = fit().values["mu"]
    for rank in (0, 1):
        found = dict(np.load(tmp_path / f"{rank}.npz"))
        assert found["counts"].tolist() == [2, 1]
        same(found, arrays(runs))
        assert float(found["mu"]) == pytest.approx(mu, rel=1e-10)
    if (tmp_path / "shared").exists():
        stored = dano.load_rollouts(tmp_path / "shared")
        assert stored.complete
        same(arrays(stored.read()), arrays(runs))


def test_goes_on_after_a_kill(runs: dano.Rollouts, two_devices):
    pytest.importorskip("zarr")
    _, folder, code = two_devices
    assert code == -signal.SIGKILL
    killed = dano.load_rollouts(folder)
    assert not killed.complete
    with pytest.raises(ValueError, match="rows must be complete: rollout"):
        killed.read()
    np.testing.assert_allclose(killed.read(slice(0, 2)).states.position, runs.states.position[:2], atol=1e-12)
    # A chunk that was being written: without its mark it does not count.
    before = {
        path: path.stat().st_mtime_ns for path in (folder / "position" / "c").rglob("*") if path.is_file()
    }
    assert 0 < len(before) < N // 2
    (folder / "velocity" / "c" / "4" / "0" / "0").mkdir(parents=True, exist_ok=True)
    (folder / "velocity" / "c" / "4" / "0" / "0" / "0").write_bytes(b"cut off")

    rubbed, states, frictions = case()
    said = []
    stored = dano.rollouts(
        rubbed,
        states,
        N_STEPS,
        parameters=frictions,
        path=folder,
        progress=lambda *what: said.append(what),
        batch_size=SIZES["batch_size"],
    )
    assert stored.complete and stored.converged.all()
    same(arrays(stored.read()), arrays(runs))
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert said[1][1] > len(before) / (N // 2) and said[-1] == ("simulating", 1.0)


def test_another_scene_is_refused(tmp_path: Path):
    pytest.importorskip("zarr")
    rubbed, states, frictions = case()
    folder = tmp_path / "runs"

    def run(**changes: Any) -> dano.StoredRollouts:
        given: dict[str, Any] = dict(
            scene=rubbed, states=states, n_steps=N_STEPS, parameters=frictions, path=folder
        )
        given = {**given, **SIZES, **changes}
        return dano.rollouts(**given)

    before = run().read()
    changed = rubbed(frictions[0]).replace_body("ball", mass=2.0)
    changes: dict[str, dict[str, Any]] = {
        "parameters": dict(parameters=frictions.at[3].add(1e-9)),
        "scene": dict(scene=lambda mu: changed.replace_contact("ball", "floor", sliding_friction=mu)),
        "states": dict(states=eqx.tree_at(lambda s: s.position, states, states.position + 1e-9)),
        "n_steps": dict(n_steps=N_STEPS + 1),
        "keep": dict(keep="last"),
        "engine": dict(engine=dano.VariationalEngine(tolerance=1e-9)),
    }
    for name, change in changes.items():
        with pytest.raises(ValueError, match=f"path must be new or hold rollouts .* other {name}: "):
            run(**change)
    # Nothing was lost, and the same call has nothing left to do.
    same(arrays(run().read()), arrays(before))
    (tmp_path / "file").write_text("")
    (tmp_path / "empty").mkdir()
    for path in (tmp_path / "file", tmp_path / "empty"):
        with pytest.raises(ValueError, match="path must be a folder that rollouts wrote"):
            run(path=path)
    with pytest.raises(ValueError, match="existing directory"):
        run(path=tmp_path / "missing" / "runs")


def test_fingerprint_of_functions():
    """What a function closes over counts, wherever it is; where it lies in memory does not."""

    def pushed(by: np.ndarray, late: float):
        forces = jnp.asarray(by)

        def policy(state, time):
            push = jax.jit(lambda t: jnp.where(t > late, t * forces, jnp.zeros_like(forces)))(time)
            return dano.Control(push, jnp.zeros_like(push))

        return policy

    rubbed, states, frictions = case()

    def digests(policy) -> dict[str, Any]:
        return checked_job(
            rubbed, states, 4, frictions, policy, dano.VariationalEngine(), "all"
        ).fingerprint()

    one = np.ones((2, 3))
    assert digests(pushed(one, 0.1)) == digests(pushed(one.copy(), 0.1))
    for other in (pushed(2 * one, 0.1), pushed(one, 0.2)):
        assert digests(other)["controls"] != digests(pushed(one, 0.1))["controls"]


def test_bad_input():
    rubbed, states, frictions = case()
    scene = rubbed(frictions[0])
    one = jax.tree.map(lambda leaf: leaf[0], states)
    force = jnp.zeros((N - 1, N_STEPS, 2, 3))
    broken = eqx.tree_at(lambda s: s.omega, states, states.omega.at[6, 0, 0].set(jnp.nan))
    bad: dict[str, dict[str, Any]] = {
        "states must have a leading axis": dict(scene=scene, states=one),
        "rollout 6: state.omega must be finite": dict(scene=scene, states=broken),
        "parameters must be arrays": dict(scene=rubbed, states=states),
        "parameters must have a leading axis": dict(scene=rubbed, states=states, parameters=frictions[0]),
        "parameters must be finite, got nan in row 2": dict(
            scene=rubbed, states=states, parameters=frictions.at[2].set(jnp.nan)
        ),
        r"row 4: sliding_friction must be .*got -0.1": dict(
            scene=rubbed, states=states, parameters=frictions.at[4].set(-0.1)
        ),
        "scene must be a function": dict(scene=scene, states=states, parameters=frictions),
        "scene must return a dano.Scene": dict(scene=lambda x: x, states=states, parameters=frictions),
        r"agree, got \{'parameters': \[3\], 'states': \[10\]\}": dict(
            scene=rubbed, states=states, parameters=frictions[:3]
        ),
        r"agree, got \{'states': \[10\], 'controls': \[9\]\}": dict(
            scene=scene, states=states, controls=dano.Control(force, force)
        ),
        'keep must be "all", "last" or': dict(scene=scene, states=states, keep="some"),
        "n_steps must be ≥ 1, got 0": dict(scene=scene, states=states, n_steps=0),
        "batch_size must be ≥ 1, got 0": dict(scene=scene, states=states, batch_size=0),
        "chunk_size must be a multiple": dict(scene=scene, states=states, batch_size=4, chunk_size=6),
        "devices must hold at least one": dict(scene=scene, states=states, devices=[]),
    }
    for message, arguments in bad.items():
        given: dict[str, Any] = {"n_steps": N_STEPS, **arguments}
        with pytest.raises(ValueError, match=message):
            dano.rollouts(**given)
