"""What a run is asked by name: bodies, states, forces, contacts; how long it lasts and what drives it."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano

MASS, RADIUS, G, H = 0.2, 0.05, 9.81, 0.005


@pytest.fixture(scope="module")
def scene():
    bodies = [
        dano.Body("ball", dano.Sphere(RADIUS), mass=MASS, position=(0, 0, 0.2), velocity=(0.3, 0, 0)),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    params = dano.ContactParams(sliding_friction=0.3, restitution=0.5)
    return dano.Scene.create(bodies, [dano.Contact("ball", "floor", params)], timestep=H)


@pytest.fixture(scope="module")
def run(scene):
    return dano.simulate(scene, duration=1.0)


def test_bodies_start_where_they_say_unless_told_otherwise(scene):
    state = scene.initial_state()
    np.testing.assert_array_equal(state["ball"].position, (0, 0, 0.2))
    np.testing.assert_array_equal(state["ball"].velocity, (0.3, 0, 0))
    told = scene.initial_state(ball=dict(origin=(1, 0, 1)))
    np.testing.assert_array_equal(told["ball"].position, (1, 0, 1))
    np.testing.assert_array_equal(told["ball"].velocity, (0.3, 0, 0))


def test_a_run_is_asked_by_name_and_by_time(scene, run):
    assert run.times.shape == (201,)
    np.testing.assert_array_equal(run["ball"].position, run.states.position[:, 0])
    np.testing.assert_array_equal(run.final["floor"].omega, run.states.omega[-1, 1])
    np.testing.assert_array_equal(run[3].velocity, run.states.velocity[3])
    again = dano.simulate(scene, run[-1], 1)
    assert again.names == run.names


def test_forces_at_rest_are_the_weight(run):
    np.testing.assert_allclose(run.forces("ball", "floor")[-1, 2], MASS * G, rtol=1e-6)
    np.testing.assert_array_equal(run.forces("floor", "ball"), -run.forces("ball", "floor"))


def test_touches_hold_the_momentum_of_each_bounce(run):
    """With restitution ½ an impact from speed s gives m 1.5 s; the last contact lasts until the end."""
    touches = run.touches()
    assert len(touches) >= 4
    assert touches[-1].end == pytest.approx(1.0)
    first = touches[0]
    before = int(round(first.start / H))
    speed = -float(run["ball"].velocity[before, 2]) + G * H
    assert (first.a, first.b) == ("ball", "floor")
    assert first.impulse[2] == pytest.approx(1.5 * MASS * speed, rel=0.02)
    assert first.peak * H == pytest.approx(np.linalg.norm(first.impulse), rel=1e-9)
    np.testing.assert_array_equal(run.touches("floor")[0].impulse, -first.impulse)
    total = sum(touch.impulse[2] for touch in touches)
    change = MASS * float(run["ball"].velocity[-1, 2] - run["ball"].velocity[0, 2])
    assert total == pytest.approx(change + MASS * G * 1.0, rel=1e-6)


def test_a_constant_control_acts_in_all_steps(scene):
    once = scene.control(ball=dict(force=(1.0, 0, 0)))
    state = scene.initial_state()
    constant = dano.simulate(scene, state, 20, controls=once)
    rows = jax.tree.map(lambda x: jnp.repeat(x[None], 20, axis=0), once)
    np.testing.assert_array_equal(
        constant.states.position, dano.simulate(scene, state, controls=rows).states.position
    )
    assert float(constant["ball"].velocity[-1, 0]) == pytest.approx(0.3 + 20 * H / MASS, rel=1e-9)


@pytest.mark.parametrize(
    ("controls", "message"),
    [
        (lambda state: None, r"must be a function of \(state, time\), got one of \(state\)"),
        (lambda state, time: 3.0, r"must return a dano.Control.* got 3.0"),
        (lambda state, time: None if time < 0.5 else 1, r"jnp.where\(time < 0.5, a, b\) in place of `if`"),
        (lambda state, time: dano.Control(state.position[:1], state.omega[:1]), "control.force must have"),
    ],
)
def test_a_wrong_controller_is_told_what_is_right(scene, controls, message):
    with pytest.raises(ValueError, match=message):
        dano.simulate(scene, scene.initial_state(), 5, controls=controls)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda scene, run: run["bal"], "did you mean 'ball'"),
        (lambda scene, run: run[201], r"index must lie in \[-201, 201\)"),
        (lambda scene, run: run[True], "a body or an index, got True"),
        (lambda scene, run: run.final["x"], r"body must be one of \['ball', 'floor'\], got 'x'"),
        (lambda scene, run: run.forces("ball", "ball"), "must be one that may touch"),
        (lambda scene, run: dano.simulate(scene, None, 3, duration=1.0), "say the same"),
        (lambda scene, run: dano.simulate(scene, duration=-1.0), "duration must be"),
        (lambda scene, run: jax.tree.map(lambda x: x, run).scene, r"call run.of\(scene\) first"),
        (lambda scene, run: dano.Body("a", dano.Sphere(1.0), mass=1.0, pos=(0, 0, 0)), "mean 'position'"),
        (
            lambda scene, run: dano.Body("a", dano.Sphere(1.0), mass=1.0, position=(0,) * 3, origin=(0,) * 3),
            "by position .* or by origin, got both",
        ),
        (
            lambda scene, run: dano.simulate(
                dano.Scene.create(scene.bodies[::-1], scene.contacts), scene.initial_state(), 1
            ),
            r"bodies \['floor', 'ball'\] in this order",
        ),
        (lambda scene, run: run.of(dano.Scene.create(scene.bodies[::-1])), "scene must have the bodies"),
        (lambda scene, run: scene.replace_contact("ball", "floor", friction=1), "mean 'sliding_friction'"),
    ],
)
def test_what_is_asked_wrongly_is_said(scene, run, call, message):
    with pytest.raises(ValueError, match=message):
        call(scene, run)


def test_a_state_without_names_says_how_to_get_them(scene):
    state = scene.initial_state()
    bare = dano.State(state.position, state.orientation, state.velocity, state.omega)
    with pytest.raises(ValueError, match="names=scene.names"):
        bare["ball"]
    assert dano.simulate(scene, bare, 1).converged.all()


def test_names_stay_in_batches_and_derivatives(scene):
    def moved(speed):
        state = scene.initial_state(ball=dict(velocity=(speed, 0, 0)))
        return dano.simulate(scene, state, 20)["ball"].position[-1, 0]

    assert float(jax.grad(moved)(0.3)) == pytest.approx(20 * H, rel=1e-9)
    batch = jax.vmap(
        lambda speed: dano.simulate(scene, scene.initial_state(ball=dict(velocity=(speed, 0, 0))), 20)
    )(jnp.array([0.1, 0.2, 0.3]))
    assert batch["ball"].position.shape == (3, 21, 3)
    assert batch.final["ball"].position.shape == (3, 3)


def test_a_run_shows_itself_as_a_table(scene, run):
    assert str(scene).splitlines()[0].startswith("Scene: 2 bodies, 1 pair")
    assert any(line.split() == ["ball", "0.2", "kg", "0.1005", "m"] for line in str(scene).splitlines())
    assert "not converged" in str(run) and "ball at the end" in str(run)
    assert "0.3, 0, 0" in str(scene.initial_state())
    # Inside of jit there are no numbers to show.
    jax.jit(lambda state: print(state, scene) or state.position)(scene.initial_state())


def test_saved_runs_keep_their_names(scene, run, tmp_path):
    run.save(tmp_path / "run.npz")
    loaded = dano.Trajectory.load(tmp_path / "run.npz")
    np.testing.assert_array_equal(loaded.final["ball"].position, run.final["ball"].position)
    np.testing.assert_array_equal(loaded.of(scene).forces("ball", "floor"), run.forces("ball", "floor"))


def test_scene_files_simulate_themselves(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(
        """
timestep = 0.005
duration = 0.1
[[bodies]]
name = "ball"
shape = "sphere"
radius = 0.05
mass = 0.2
position = [0, 0, 1]
"""
    )
    loaded = dano.load_scene(path)
    run = loaded.simulate()
    assert run.times[-1] == pytest.approx(0.1)
    assert run.scene is loaded.scene and run.origin.looks is not None
    assert loaded.simulate(duration=0.05).times[-1] == pytest.approx(0.05)


def test_old_names_work_and_say_the_new_one():
    with pytest.warns(FutureWarning, match="write `from dano.identification import Motion`"):
        from dano.identify import Motion  # pyright: ignore[reportMissingImports]
    with pytest.warns(FutureWarning, match="write `from dano.planning import Task`"):
        from dano.plan import Task  # pyright: ignore[reportMissingImports]
    assert (Motion, Task) == (dano.Motion, dano.Task)
    assert callable(dano.identify) and callable(dano.plan)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert dano.report.VideoOptions is not None
    with pytest.raises(AttributeError, match="no attribute 'reports'"):
        _ = dano.reports
