"""Searches that are killed, again and again, end where one ends that was left alone, to the last bit."""

import dataclasses
import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.archive import Pace
from dano.identification._checkpoint import SearchCheckpoint

NOISE = {"position": 1e-4, "orientation": 2e-3}


def spring_case() -> "Case":
    """The force of a spring, searched from six starts that end in several minima."""

    class Spring(eqx.Module):
        stiffness: jnp.ndarray

        def __call__(self, state, time):
            force = -self.stiffness * state.position
            return dano.Control(force, jnp.zeros_like(force))

    scene = dano.Scene.create(
        [dano.Body("ball", dano.Sphere(0.05), mass=1.0)], timestep=0.01, gravity=(0, 0, 0)
    )
    start = scene.initial_state(ball={"position": (1, 0, 0)})
    run = dano.simulate(scene, start, 200, controls=Spring(jnp.asarray(60.0)))
    stiffness = dano.Parameter("k", lambda c: c.stiffness, 1.0, 200.0, start=150.0, of="controls")
    given = {"controls": Spring(jnp.asarray(1.0)), "noise": {"position": 1e-3}}
    options = dano.IdentifyOptions(starts=6)
    return scene, dano.Motion.from_trajectory(run, every=10), [stiffness], given, options


def basin_case() -> "Case":
    """Tied windows that begin in a wrong basin: minimisations with others in between."""
    scene = dano.Scene.create([dano.Body("ball", dano.Sphere(0.05), mass=0.5)], [], timestep=0.01)
    start = scene.initial_state(ball={"velocity": (1.0, 0.0, 0.0), "omega": (0.0, 0.0, 40.0)})
    seen = dano.Motion.from_trajectory(dano.simulate(scene, start, 110), every=10)
    omega = np.where(np.arange(12)[:, None, None] == 0, seen.omega, np.nan)
    motion = dataclasses.replace(seen, omega=omega, velocity=np.full_like(omega, np.nan))
    gravity = dano.Parameter("g", lambda s: s.gravity, -20.0, 20.0, start=[0.0, 0.0, -5.0])
    options = dano.IdentifyOptions(window=4, continuity=(1e3, 1.0))
    return scene, motion, [gravity], dict(initial="states", noise=NOISE), options


Case = tuple[dano.Scene, dano.Motion, list[dano.Parameter], dict[str, Any], dano.IdentifyOptions]


def same(one: dano.Identification, other: dano.Identification) -> None:
    leaves = [
        jax.tree.leaves(
            (fit.values, fit.covariance, fit.loss_history, fit.initial_states, [m.values for m in fit.minima])
        )
        for fit in (one, other)
    ]
    for a, b in zip(*leaves, strict=True):
        np.testing.assert_array_equal(a, b)
    assert [m.stop for m in one.minima] == [m.stop for m in other.minima]


@pytest.mark.parametrize("case", [spring_case, basin_case])
def test_a_search_that_is_killed_again_and_again(case, tmp_path, monkeypatch):
    scene, motion, parameters, given, options = case()
    resumed = dataclasses.replace(options, checkpoint=tmp_path / "search.npz", resume=True)
    whole = dano.identify(scene, motion, parameters, options=options, **given)
    monkeypatch.setattr(Pace, "every", 0.0)
    monkeypatch.setattr(Pace, "share", 0)
    write, written = SearchCheckpoint._write, []

    def killed(self, *, now):
        write(self, now=now)
        written.append(now)
        if len(written) % 4 == 0:
            raise MemoryError  # stands for an end without any clearing up

    monkeypatch.setattr(SearchCheckpoint, "_write", killed)
    ends, fit = 0, None
    while fit is None:
        try:
            fit = dano.identify(scene, motion, parameters, options=resumed, **given)
        except MemoryError:
            ends += 1
    assert ends >= 3
    same(whole, fit)
    # What was simulated twice counts once, but for windows that need not be simulated again.
    assert fit.evaluations == pytest.approx(whole.evaluations, abs=2)


def test_a_search_that_is_interrupted_is_kept_and_goes_on(tmp_path):
    scene, motion, parameters, given, options = spring_case()
    kept = dataclasses.replace(options, checkpoint=tmp_path / "search.npz")

    def stop(description, share):
        if description.startswith("fitting") and share > 0.5:
            raise KeyboardInterrupt

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        part = dano.identify(scene, motion, parameters, options=kept, progress=stop, **given)
    assert not part.converged or len(part.minima) < 6
    told = []
    fit = dano.identify(
        scene,
        motion,
        parameters,
        options=dataclasses.replace(kept, resume=True),
        progress=lambda *said: told.append(said),
        **given,
    )
    same(dano.identify(scene, motion, parameters, options=options, **given), fit)
    assert min(share for what, share in told if what.startswith("fitting")) > 0.5


def test_a_checkpoint_of_another_search_is_refused(tmp_path):
    scene, motion, parameters, given, options = spring_case()
    path = tmp_path / "search.npz"
    kept = dataclasses.replace(options, checkpoint=path)

    def stop(description, share):
        if description.startswith("fitting"):
            raise KeyboardInterrupt

    def search(options: dano.IdentifyOptions, **other):
        usual: dict[str, Any] = {"scene": scene, "observed": motion, "parameters": parameters}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            keywords: Any = usual | given | {"progress": stop} | other
            return dano.identify(options=options, **keywords)

    search(kept)
    before, resumed = path.read_bytes(), dataclasses.replace(kept, resume=True)
    wider = [dataclasses.replace(parameters[0], upper=300.0)]
    moved = dataclasses.replace(motion, position=motion.position + 1e-12)
    for other in (
        {"scene": scene.replace_body("ball", mass_scale=2.0)},
        {"observed": moved},
        {"parameters": wider},
        {"options": dataclasses.replace(resumed, starts=5)},
        {"options": dataclasses.replace(resumed, huber=2.0)},
    ):
        with pytest.raises(
            ValueError,
            match="checkpoint .*search.npz must be of this search, with the same scene, motion",
        ):
            search(**{"options": resumed, **other})
    assert path.read_bytes() == before
    path.write_bytes(before[:100])
    with pytest.raises(ValueError, match="search.npz is not a readable dano-search file"):
        search(resumed)
    with pytest.raises(ValueError, match="existing directory"):
        search(dataclasses.replace(options, checkpoint=tmp_path / "missing" / "search.npz"))
