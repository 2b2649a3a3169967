"""Identification of simulated motions: what went in comes out, with honest error bars."""

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from engine.trees import coordinates

import dano
from dano.identification._settings import space_of
from dano.identification._uncertainty import between_groups, Groups
from dano.identification._windows import draw_velocities, plan_windows
from dano.maths import quat_multiply

RADIUS, H = 0.05, 0.005


def ball_scene(mu=0.25, timestep=H):
    """Two balls on a floor: closed-form overlaps, so that everything here is quick."""
    params = dano.ContactParams(sliding_friction=mu, sliding_drag=0.0, spring=5e4, damper=1e5)
    law = dano.CentroidLaw(stiction_velocity=1e-4)
    ball = dano.Sphere(RADIUS)
    return dano.Scene.create(
        [
            dano.Body("ball", ball, mass=0.5),
            dano.Body("floor", dano.HalfSpace(), fixed=True),
        ],
        [dano.Contact("ball", "floor", params, law)],
        timestep=timestep,
    )


def sliding(scene, n=40, speed=(1.5, 0.3, 0.0), omega=(0.0, 0.0, 0.0)):
    start = scene.initial_state(ball={"position": (0, 0, RADIUS), "velocity": speed, "omega": omega})
    return dano.simulate(scene, start, n)


FRICTION = dano.Parameter("mu", lambda s: s.contact("ball", "floor").sliding_friction, 0.0, 1.0, start=0.6)


NOISE = {"position": 1e-4, "orientation": 2e-3}


def noisy(motion, rng, position=1e-4, orientation=2e-3):
    turn = rng.normal(size=(*motion.orientation.shape[:2], 3)) * orientation
    turn = np.concatenate([np.ones_like(turn[..., :1]), 0.5 * turn], axis=-1)
    turned = quat_multiply(jnp.asarray(motion.orientation), jnp.asarray(turn))
    turned = np.asarray(turned) / np.linalg.norm(turned, axis=-1, keepdims=True)
    return dano.Motion.create(
        motion.times,
        motion.names,
        position=motion.position + rng.normal(size=motion.position.shape) * position,
        orientation=turned,
    )


@pytest.fixture(scope="module")
def truth():
    return sliding(ball_scene())


@pytest.fixture(scope="module")
def observed(truth):
    return dano.Motion.from_trajectory(truth, bodies=["ball"], every=2)


def test_friction_of_a_simulated_slide(truth):
    fit = dano.identify(ball_scene(mu=0.6), truth, [FRICTION])
    assert fit.converged
    assert fit.values["mu"] == pytest.approx(0.25, abs=1e-6)
    assert fit.errors.mean_position < 1e-7
    assert fit.loss_history[-1] < 1e-6 * fit.loss_history[0]
    assert float(fit.scene.contact("ball", "floor").sliding_friction) == fit.values["mu"]
    assert fit.to_dict()["values"]["mu"] == fit.values["mu"]
    shown = fit._repr_html_()
    assert f"{fit.values['mu']:.4g} ± " in shown and "<polyline" in shown


def test_positions_alone_with_noise_of_positions_alone(truth):
    """Orientations of the start are estimated although nothing says how well: as well as usual."""
    seen = dano.Motion.create(
        truth.times[::2],
        ["ball"],
        position=np.asarray(truth.states.position)[::2, :1]
        + 1e-4 * np.random.default_rng(0).normal(size=(21, 1, 3)),
    )
    with pytest.warns(UserWarning, match="orientations of 'ball' were not observed"):
        fit = dano.identify(ball_scene(), seen, [FRICTION], initial="states", noise={"position": 1e-4})
    assert abs(fit.values["mu"] - 0.25) < 3 * fit.standard_errors["mu"] < 0.03


def test_several_motions_of_different_length_rate_and_gaps(truth, observed):
    gaps = observed.position.copy()
    gaps[5:9] = np.nan
    first = dataclasses.replace(observed, position=gaps)
    other = sliding(ball_scene(timestep=H / 2), n=70, speed=(-0.4, 1.0, 0.0), omega=(3.0, 0.0, 9.0))
    second = dano.Motion.from_trajectory(other, bodies=["ball"], every=3)
    fit = dano.identify(ball_scene(), [first, second], [FRICTION], held_out=[observed])
    # The second one was simulated at half the step.
    assert fit.values["mu"] == pytest.approx(0.25, rel=0.02)
    assert [len(m.times) for m in fit.fitted] == [len(first.times), len(second.times)]
    assert fit.held_out_errors is not None and fit.held_out_errors.mean_position < 2e-3


def test_both_jacobians_give_the_same_answer(observed):
    rng = np.random.default_rng(3)
    motion = noisy(observed.part(0, 8), rng)
    fits = [
        dano.identify(
            ball_scene(),
            motion,
            [FRICTION],
            initial=["velocity"],
            options=dano.IdentifyOptions(jacobian=mode, tolerance=1e-3),
        )
        for mode in ("forward", "reverse")
    ]
    assert fits[0].values["mu"] == pytest.approx(fits[1].values["mu"], abs=1e-6)
    assert fits[0].standard_errors["mu"] == pytest.approx(fits[1].standard_errors["mu"], rel=1e-4)


@pytest.mark.slow
def test_windows_may_be_simulated_at_once(observed):
    options = dano.IdentifyOptions(window=8, batch=3)
    fit = dano.identify(ball_scene(), observed, [FRICTION], initial="given", options=options)
    assert fit.values["mu"] == pytest.approx(0.25, abs=1e-3)


def test_equal_leaves_need_no_new_program():
    def picked():
        where = lambda s: s.contact("ball", "floor").sliding_friction  # noqa: E731
        return space_of(ball_scene(), None, [dano.Parameter("mu", where)]).selections

    assert picked() == picked()
    assert hash(picked()) == hash(picked())


# Of 95 % intervals, 15 to 20 of 20 hold the truth with a probability of 0.9997; all 20 may.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("n_fits", "least", "most", "rel"),
    [(20, 15, 20, 0.5), pytest.param(100, 90, 99, 0.3, marks=pytest.mark.slow)],
)
def test_standard_errors_cover_the_truth(observed, n_fits, least, most, rel):
    inside, fits = 0, []
    for seed in range(n_fits):
        motion = noisy(observed, np.random.default_rng(seed))
        with warnings.catch_warnings():
            # Balls that begin a little above the floor hop: for a few the loss is rough, and said to be.
            warnings.filterwarnings("ignore", "the search did not end", RuntimeWarning)
            fit = dano.identify(ball_scene(), motion, [FRICTION], initial="states", noise=NOISE)
        low, high = fit.interval("mu")
        inside += low <= 0.25 <= high
        fits.append(fit)
    assert least <= inside <= most
    assert sum(fit.converged for fit in fits) >= 0.9 * n_fits
    spread = np.std([fit.values["mu"] for fit in fits])
    assert np.mean([fit.standard_errors["mu"] for fit in fits]) == pytest.approx(spread, rel=rel)
    # The residuals are as large as the noise that was stated.
    assert np.mean([fit.errors.rms for fit in fits]) == pytest.approx(1.0, rel=0.1)


def test_covariance_between_groups_is_that_of_leaving_each_out():
    random = np.random.default_rng(0)
    table, target = random.normal(size=(60, 3)), random.normal(size=60)
    groups = np.repeat(np.arange(6), 10)
    best = np.linalg.lstsq(table, target)[0]
    without = np.array([np.linalg.lstsq(table[groups != k], target[groups != k])[0] - best for k in range(6)])
    gradients = np.array(
        [table[groups == k].T @ (table[groups == k] @ best - target[groups == k]) for k in range(6)]
    )
    hessians = np.array([table[groups == k].T @ table[groups == k] for k in range(6)])
    found = between_groups(hessians.sum(axis=0), Groups(gradients, hessians))
    np.testing.assert_allclose(found, without.T @ without * 5 / 6, rtol=1e-9)


def test_motions_whose_friction_differs_say_how_sure_a_friction_is():
    """Frames do not know that the next slide has another friction; slides do."""
    random = np.random.default_rng(1)
    frictions = 0.25 + 0.02 * random.standard_normal(10)
    slides = [
        noisy(dano.Motion.from_trajectory(sliding(ball_scene(mu)), bodies=["ball"], every=2), random)
        for mu in frictions
    ]
    with pytest.warns(RuntimeWarning, match="mu: motions pull it apart by .* times its standard error"):
        alone = dano.identify(ball_scene(), slides, [FRICTION], noise=NOISE, initial="given")
    options = dano.IdentifyOptions(independent="motions")
    fit = dano.identify(ball_scene(), slides, [FRICTION], noise=NOISE, initial="given", options=options)
    assert fit.values["mu"] == alone.values["mu"] and fit.freedom == 9
    expected = np.std(frictions, ddof=1) / np.sqrt(10)
    assert fit.standard_errors["mu"] == pytest.approx(expected, rel=0.3)
    assert alone.standard_errors["mu"] < 0.5 * expected
    low, high = fit.interval("mu")
    assert low < 0.25 < high
    # Five recordings of two slides each: the mean of a pair scatters by less, and there are fewer of them.
    pairs = dano.IdentifyOptions(independent=[str(k // 2) for k in range(10)])
    fit = dano.identify(ball_scene(), slides, [FRICTION], noise=NOISE, initial="given", options=pairs)
    expected = np.std(frictions.reshape(5, 2).mean(axis=1), ddof=1) / np.sqrt(5)
    assert fit.freedom == 4 and fit.standard_errors["mu"] == pytest.approx(expected, rel=0.4)


def test_outliers_pull_less_with_hubers_loss(observed):
    motion = noisy(observed, np.random.default_rng(5))
    wrong = motion.position.copy()
    wrong[[5, 11, 16], 0, 0] += (0.01, 0.02, -0.01)
    motion = dataclasses.replace(motion, position=wrong)
    plain = dano.identify(ball_scene(), motion, [FRICTION], initial="states", noise=NOISE)
    options = dano.IdentifyOptions(huber=2.0)
    robust = dano.identify(ball_scene(), motion, [FRICTION], initial="states", noise=NOISE, options=options)
    assert abs(robust.values["mu"] - 0.25) < 0.02
    assert abs(robust.values["mu"] - 0.25) < 0.3 * abs(plain.values["mu"] - 0.25)
    assert robust.standard_errors["mu"] < plain.standard_errors["mu"]


@pytest.mark.parametrize("continuity", [pytest.param(None, marks=pytest.mark.slow), 0.3])
def test_multiple_shooting(observed, continuity):
    motion = noisy(observed, np.random.default_rng(7))
    fit = dano.identify(
        ball_scene(),
        motion,
        [FRICTION],
        initial="states",
        noise=NOISE,
        options=dano.IdentifyOptions(window=8, continuity=continuity),
    )
    assert fit.initial_states.position.shape[0] == 3
    assert abs(fit.values["mu"] - 0.25) < 4 * fit.standard_errors["mu"]
    # Windows that must meet know the velocity better, and so the friction.
    assert fit.standard_errors["mu"] < (0.05 if continuity is None else 0.01)


def test_windows_that_are_tied_more_and_more_tightly(observed):
    motion = noisy(observed, np.random.default_rng(7))

    def fitted(options=None):
        return dano.identify(ball_scene(), motion, [FRICTION], initial="states", noise=NOISE, options=options)

    loose = fitted(dano.IdentifyOptions(window=8, continuity=3.0))
    tied = fitted(dano.IdentifyOptions(window=8, continuity=(3.0, 0.1, 0.01)))
    whole = fitted()
    assert tied.standard_errors["mu"] < loose.standard_errors["mu"]
    # Windows that meet are one window.
    assert tied.values["mu"] == pytest.approx(whole.values["mu"], abs=0.1 * whole.standard_errors["mu"])
    assert tied.standard_errors["mu"] == pytest.approx(whole.standard_errors["mu"], rel=0.2)


def test_a_fit_may_go_on_from_an_earlier_one(observed):
    motion = noisy(observed, np.random.default_rng(7))

    def fitted(continuity, after=None, window=8, initial="states", smooth=True):
        options = dano.IdentifyOptions(window=window, continuity=continuity, smooth=smooth)
        return dano.identify(
            ball_scene(), motion, [FRICTION], initial=initial, noise=NOISE, after=after, options=options
        )

    loose = fitted(3.0)
    sequence = fitted((3.0, 0.1))
    fit = fitted(0.1, loose)
    assert fit.loss_history[-1] == pytest.approx(sequence.loss_history[-1], rel=1e-3)
    # At its own minimum there is nothing left to do, but to look at how rough the loss is.
    again = fitted(0.1, fit)
    assert len(again.loss_history) == 1 and not again.smoothed
    blind = fitted(0.1, fit, smooth=False)
    assert blind.evaluations == 1
    assert again.values["mu"] == pytest.approx(fit.values["mu"], abs=1e-12)
    # What was not estimated before begins as measured.
    given = fitted(None, initial="given")
    states = fitted(0.1, given)
    assert states.loss_history[-1] == pytest.approx(sequence.loss_history[-1], rel=1e-3)
    with pytest.raises(ValueError, match="after must be a fit of the same motions in the same windows: 5 "):
        fitted(None, loose, window=4)


def test_windows_leave_a_wrong_basin_by_where_the_ones_before_end():
    # 229° from frame to frame look like −131°; only at the first frame the spin was observed.
    scene = dano.Scene.create([dano.Body("ball", dano.Sphere(RADIUS), mass=0.5)], [], timestep=0.01)
    start = scene.initial_state(ball={"velocity": (1.0, 0.0, 0.0), "omega": (0.0, 0.0, 40.0)})
    seen = dano.Motion.from_trajectory(dano.simulate(scene, start, 110), every=10)
    omega = np.where(np.arange(12)[:, None, None] == 0, seen.omega, np.nan)
    fit = dano.identify(
        scene,
        dataclasses.replace(seen, omega=omega, velocity=np.full_like(omega, np.nan)),
        [dano.Parameter("gravity", lambda s: s.gravity, -20.0, 20.0, start=[0.0, 0.0, -5.0])],
        initial="states",
        noise=NOISE,
        options=dano.IdentifyOptions(window=4, continuity=(1e3, 1.0)),
    )
    np.testing.assert_allclose(fit.initial_states.omega[:, 0], [[0, 0, 40.0]] * 3, atol=1e-3)
    np.testing.assert_allclose(fit.values["gravity"], [0, 0, -9.81], atol=1e-3)
    assert fit.errors.rms < 1e-3


def test_a_motion_in_a_wrong_basin_among_motions_that_fit():
    # As above, in one of three motions: the others say what gravity is, so that it can be held.
    scene = dano.Scene.create([dano.Body("ball", dano.Sphere(RADIUS), mass=0.5)], [], timestep=0.01)
    seen = []
    for spin in (3.0, 40.0, -5.0):
        start = scene.initial_state(ball={"velocity": (1.0, 0.0, 0.0), "omega": (0.0, 0.0, spin)})
        motion = dano.Motion.from_trajectory(dano.simulate(scene, start, 110), every=10)
        omega = np.where(np.arange(12)[:, None, None] == 0, motion.omega, np.nan)
        seen.append(dataclasses.replace(motion, omega=omega, velocity=np.full_like(omega, np.nan)))
    fit = dano.identify(
        scene,
        seen,
        [dano.Parameter("gravity", lambda s: s.gravity, -20.0, 20.0, start=[0.0, 0.0, -5.0])],
        initial="states",
        noise=NOISE,
        options=dano.IdentifyOptions(window=4, continuity=(1e3, 1.0)),
    )
    spins = np.repeat([3.0, 40.0, -5.0], 3)
    np.testing.assert_allclose(fit.initial_states.omega[:, 0, 2], spins, atol=1e-3)
    np.testing.assert_allclose(fit.values["gravity"], [0, 0, -9.81], atol=1e-3)


def test_beginnings_are_drawn_within_the_noise_of_three_frames():
    scene = dano.Scene.create([dano.Body("ball", dano.Sphere(RADIUS), mass=0.5)], [], timestep=0.01)
    run = dano.simulate(scene, scene.initial_state(ball={"velocity": (1.0, 0.0, 0.0)}), 4)
    still = dano.Motion.from_trajectory(run)
    nothing = np.full(still.velocity.shape, np.nan)
    rng = np.random.default_rng(0)
    noisy = [
        dataclasses.replace(
            still,
            position=still.position + NOISE["position"] * rng.standard_normal(still.position.shape),
            velocity=nothing,
            omega=nothing,
        )
        for _ in range(400)
    ]
    measured = np.array([motion.with_velocities(3).velocity[2, 0] for motion in noisy])
    zero = jnp.zeros((400, 2, 3))
    start = dano.State(zero, jnp.zeros((400, 2, 4)), zero, zero)
    drawn = draw_velocities(start, (0,), {"position": NOISE["position"]}, 0.01, rng)
    spread = np.std(drawn.velocity, axis=0)
    np.testing.assert_allclose(spread[0], np.std(measured, axis=0), rtol=0.15)
    assert np.all(spread[1] == 0) and np.all(np.asarray(drawn.omega) == 0)


def test_an_impact_soon_after_the_first_frame():
    # Seven frames are smoothed, and the spin begins at the fourth: there it looks like a spin before.
    scene = dano.Scene.create([dano.Body("ball", dano.Sphere(RADIUS), mass=0.5)], [], timestep=0.01)
    kick = np.zeros((40, 1, 3))
    kick[3, 0, 2] = 0.5
    control = dano.Control(jnp.zeros((40, 1, 3)), jnp.asarray(kick))
    start = scene.initial_state(ball={"velocity": (1.0, 0.0, 0.0)})
    run = dano.simulate(scene, start, 40, controls=control)
    seen = dano.Motion.from_trajectory(run)
    nothing = np.full(seen.velocity.shape, np.nan)
    poses = dataclasses.replace(seen, velocity=nothing, omega=nothing)
    windows = dano.IdentifyOptions(window=10, continuity=1.0)
    options = {"states": [None], "controls": [control], "noise": NOISE, "options": windows}
    initial = ("position", "orientation", "velocity", "omega")
    start = plan_windows(scene, [poses], initial=initial, **options).start
    narrow = plan_windows(scene, [poses], initial=initial, smoothing=3, **options).start
    assert abs(start.omega[0, 0, 2]) > 1.0
    np.testing.assert_allclose(narrow.omega[0, 0], 0, atol=1e-6)
    np.testing.assert_allclose(narrow.velocity[0, 0], run.states.velocity[0, 0], atol=0.2)


def test_a_first_velocity_is_not_moved_across_an_impact():
    """Half a step before its frame the ball still falls: the bounce after it says nothing of that."""
    scene = ball_scene()

    def begun(speeds, **options):
        speeds = np.array(speeds, float)
        heights = RADIUS + 0.02 + np.cumsum(np.append(0.0, speeds[:-1] * H))
        motion = dano.Motion.create(
            H * np.arange(len(speeds)),
            "ball",
            position=np.column_stack([0 * speeds, 0 * speeds, heights]),
            orientation=np.tile([1.0, 0, 0, 0], (len(speeds), 1)),
            velocity=np.column_stack([0 * speeds, 0 * speeds, speeds]),
            omega=np.zeros((len(speeds), 3)),
            **options,
        )
        plan = plan_windows(
            scene,
            [motion],
            states=[None],
            controls=[None],
            noise=NOISE,
            initial=(),
            options=dano.IdentifyOptions(window=2),
        )
        return np.asarray(plan.start.velocity[:, 0, 2])

    fall = -9.81 * H
    np.testing.assert_allclose(begun([-1.0, -1.0 + fall])[0], -1.0 - fall / 2)
    with pytest.warns(UserWarning, match="velocity of 'ball' changes .* as by an impact, in the motion"):
        np.testing.assert_allclose(begun([-1.0, 0.8]), [-1.0])
    # Velocities that are known where the simulation has them need no move.
    np.testing.assert_allclose(begun([-1.0, 0.8], lag=H / 2), [-1.0])
    # The bounce is after the third frame, with which the second window begins: before it, it fell.
    third = [-1.0, -1.0 + fall, -1.0 + 2 * fall, 0.9]
    np.testing.assert_allclose(begun(third)[1], third[2] - fall / 2)


def test_velocities_are_compared_at_their_own_times():
    # In free fall steps of any size give the same velocities, half a step before each state.
    fall = lambda h: dano.Scene.create([dano.Body("ball", dano.Sphere(RADIUS), mass=0.5)], [], timestep=h)  # noqa: E731
    scene = fall(0.001)
    start = scene.initial_state(ball={"velocity": (1.0, 0.0, 0.0), "omega": (0.0, 0.0, 2.0)})
    fine = dano.Motion.from_trajectory(dano.simulate(scene, start, 200), every=20)
    sampled = dataclasses.replace(fine, velocity=fine.velocity - 0.0005 * 9.81 * np.array([0, 0, 1]), lag=0.0)
    gravity = dano.Parameter("gravity", lambda s: s.gravity, -20.0, 20.0)
    for motion in (fine, sampled):
        fit = dano.identify(
            fall(0.004),
            motion,
            [gravity],
            initial="given",
            noise={"velocity": 0.01},
            options=dano.IdentifyOptions(window=3),
        )
        np.testing.assert_allclose(fit.values["gravity"], [0, 0, -9.81], atol=1e-6)
        np.testing.assert_allclose(fit.guessed[0].velocity, motion.velocity, atol=1e-9)


def test_a_parameter_that_is_no_leaf():
    # Downhill by an angle: gravity is turned, friction is known.
    def tilted(scene, angle):
        along = jnp.stack([jnp.sin(angle), 0 * angle, -jnp.cos(angle)])
        return eqx.tree_at(lambda s: s.gravity, scene, 9.81 * along)

    angle = dano.Parameter("angle", lower=-1.0, upper=1.0, start=0.0, apply=tilted)
    motion = sliding(tilted(ball_scene(), jnp.asarray(0.1)))
    fit = dano.identify(ball_scene(), motion, [angle])
    assert fit.values["angle"] == pytest.approx(0.1, abs=1e-6)
    assert float(fit.scene.gravity[0]) == pytest.approx(9.81 * np.sin(0.1), abs=1e-5)
    with pytest.raises(ValueError, match="either where or apply, got both"):
        dataclasses.replace(angle, where=FRICTION.where)
    with pytest.raises(ValueError, match="either where or apply"):
        dano.Parameter("nothing")
    refuse("give its start", parameters=[dataclasses.replace(angle, start=None)])
    refuse("must return the scene", parameters=[dataclasses.replace(angle, apply=lambda s, value: value)])


class Push(eqx.Module):
    """A constant force along x."""

    force: jnp.ndarray

    def __call__(self, state, time):
        none = jnp.zeros_like(state.position)
        return dano.Control(none.at[0, 0].set(self.force), none)


MASS = dano.Parameter("alpha", lambda s: s.body("ball").mass_scale, 0.1, 4.0, start=2.0)


def pushed(scene, policy):
    start = scene.initial_state(ball={"position": (0, 0, RADIUS)})
    return dano.simulate(scene, start, 50, controls=policy)


@pytest.mark.slow
def test_a_known_force_shows_the_mass_and_a_known_mass_the_force():
    scene, policy = ball_scene(), Push(jnp.asarray(3.0))
    motion = pushed(scene, policy)
    fit = dano.identify(scene, motion, [MASS, FRICTION], controls=policy)
    assert fit.values["alpha"] == pytest.approx(1.0, abs=1e-5)
    assert fit.values["mu"] == pytest.approx(0.25, abs=1e-5)
    force = dano.Parameter("force", lambda c: c.force, 0.0, 10.0, start=1.0, of="controls")
    fit = dano.identify(scene, motion, [force], controls=policy)
    assert fit.values["force"] == pytest.approx(3.0, abs=1e-5)
    assert float(fit.controls.force) == fit.values["force"]


def test_recorded_forces_do_as_well_as_the_policy():
    scene, policy = ball_scene(), Push(jnp.asarray(3.0))
    motion = dano.Motion.from_trajectory(pushed(scene, policy), bodies=["ball"])
    rows = np.zeros((50, 2, 3))
    rows[:, 0, 0] = 3.0
    control = dano.Control(jnp.asarray(rows), jnp.zeros((50, 2, 3)))
    # Cut, so that windows must find their own rows.
    rows[25:, 0, 0] = 3.0
    options = dano.IdentifyOptions(window=17)
    fit = dano.identify(scene, motion, [MASS], controls=[control], initial="given", options=options)
    assert fit.values["alpha"] == pytest.approx(1.0, abs=1e-4)


def test_mass_without_a_known_force_is_said_to_be_open(truth):
    with pytest.warns(RuntimeWarning, match="alpha does not affect what was observed.*force that is known"):
        fit = dano.identify(ball_scene(), truth, [MASS, FRICTION])
    assert np.isinf(fit.standard_errors["alpha"])
    assert fit.values["mu"] == pytest.approx(0.25, abs=1e-5)
    assert np.isfinite(fit.standard_errors["mu"])


def tumbling(com_offset=(0.0, 0.0, 0.0), inertia=None):
    body = dano.Body("box", dano.Box((0.05, 0.04, 0.03)), mass=0.5, com_offset=com_offset, inertia=inertia)
    return dano.Scene.create([body], timestep=0.002)


def test_centre_of_mass_and_inertia_from_free_flight():
    offset = np.array([0.004, -0.003, 0.002])
    usual = np.asarray(tumbling().body("box").inertia)
    inertia = usual @ np.diag([1.0, 1.1, 0.8])
    inertia[0, 1] = inertia[1, 0] = 0.05 * usual[0, 0]
    scene = tumbling(offset, inertia)
    start = scene.initial_state(box={"velocity": (1, 0, 2), "omega": (8, 5, -6)})
    run = dano.simulate(scene, start, 200)
    # A tracker sees the body's own frame, not its centre of mass.
    matrices = np.array([np.asarray(dano.Pose(orientation=q).matrix) for q in run.states.orientation[:, 0]])
    position = np.asarray(run.states.position[:, 0]) - matrices @ offset
    every = slice(None, None, 5)
    motion = dano.Motion.create(
        np.asarray(run.times)[every],
        "box",
        position=position[every],
        orientation=np.asarray(run.states.orientation[every, 0]),
        point="origin",
    )
    parameters = [
        dano.Parameter("com", lambda s: s.body("box").com_offset, -0.02, 0.02),
        dano.Parameter("inertia", lambda s: s.body("box").inertia),
    ]
    with pytest.warns(RuntimeWarning, match="cannot be told apart"):
        fit = dano.identify(tumbling(), motion, parameters, initial="velocities")
    np.testing.assert_allclose(fit.values["com"], offset, atol=1e-6)
    # Without a known torque only ratios of the inertia show.
    found = fit.values["inertia"]
    np.testing.assert_allclose(found / np.trace(found), inertia / np.trace(inertia), atol=1e-5)
    # What it begins with is a state as simulations take it, whatever point was tracked.
    begun = jax.tree.map(lambda x: x[0], fit.initial_states)
    again = dano.simulate(fit.scene, begun, 200)
    np.testing.assert_allclose(again.states.position, run.states.position, atol=1e-5)
    with pytest.warns(RuntimeWarning, match="cannot be told apart"):
        further = dano.identify(tumbling(), motion, parameters, initial="velocities", after=fit)
    assert further.loss_history[0] <= fit.loss_history[-1] * 1.01 + 1e-9


@pytest.mark.slow
def test_unobserved_body_of_unknown_mass_in_a_collision():
    params = dano.ContactParams(sliding_friction=0.0, spring=5e4, damper=1e4)
    bodies = [dano.Body(name, dano.Sphere(RADIUS), mass=0.5) for name in ("a", "b")]
    contact = dano.Contact("a", "b", params, dano.CentroidLaw())
    scene = dano.Scene.create(bodies, [contact], timestep=0.002, gravity=(0, 0, 0))
    heavy = scene.replace_body("b", mass_scale=1.7)
    start = {"a": {"velocity": (1, 0, 0)}, "b": {"position": (0.12, 0.01, 0)}}
    run = dano.simulate(heavy, heavy.initial_state(**start), 60)
    motion = dano.Motion.from_trajectory(run, bodies=["a"], every=2)
    mass = dano.Parameter("b", lambda s: s.body("b").mass_scale, 0.2, 5.0, coordinates="log")
    fit = dano.identify(scene, motion, [mass], state=scene.initial_state(**start))
    assert fit.values["b"] == pytest.approx(1.7, rel=1e-4)


def test_many_starts_find_the_lower_minimum():
    # A pendulum of a force: the end of a push over many periods repeats itself.
    scene = dano.Scene.create(
        [dano.Body("ball", dano.Sphere(RADIUS), mass=1.0)], timestep=0.01, gravity=(0, 0, 0)
    )

    class Spring(eqx.Module):
        stiffness: jnp.ndarray

        def __call__(self, state, time):
            force = -self.stiffness * state.position
            return dano.Control(force, jnp.zeros_like(force))

    start = scene.initial_state(ball={"position": (1, 0, 0)})
    run = dano.simulate(scene, start, 200, controls=Spring(jnp.asarray(60.0)))
    motion = dano.Motion.from_trajectory(run, every=10)
    stiffness = dano.Parameter("k", lambda c: c.stiffness, 1.0, 200.0, start=150.0, of="controls")
    options = {"controls": Spring(jnp.asarray(1.0)), "noise": {"position": 1e-3}}
    with pytest.warns(RuntimeWarning, match="misses the observed positions by .* try more starts"):
        alone = dano.identify(scene, motion, [stiffness], options=dano.IdentifyOptions(starts=1), **options)
    by_default = dano.identify(scene, motion, [stiffness], **options)
    search = dano.IdentifyOptions(starts=6)
    many = dano.identify(scene, motion, [stiffness], options=search, **options)
    assert abs(alone.values["k"] - 60) > 1
    assert by_default.values["k"] == pytest.approx(60, abs=1e-3)
    assert many.values["k"] == pytest.approx(60, abs=1e-3)
    assert many.minima[0].loss <= many.minima[-1].loss and len(many.minima) == 6


def test_a_value_on_its_bound_is_said_to_be_there(truth):
    low = dataclasses.replace(FRICTION, upper=0.2, start=0.1)
    with pytest.warns(RuntimeWarning, match="upper bound"):
        fit = dano.identify(ball_scene(), truth, [low])
    assert fit.values["mu"] == 0.2
    assert np.isnan(fit.standard_errors["mu"])


def test_single_precision():
    import jax

    with jax.enable_x64(False):
        run = sliding(ball_scene())
        assert run.states.position.dtype == jnp.float32
        fit = dano.identify(ball_scene(mu=0.5), run, [FRICTION], noise={"position": 1e-3})
    assert fit.values["mu"] == pytest.approx(0.25, abs=2e-3)


Parameters = Sequence[dano.Parameter]


def refuse(match, observed=None, parameters: Parameters | Callable[[], Parameters] = (FRICTION,), **options):
    scene = ball_scene()
    if observed is None:
        observed = sliding_motion()
    with pytest.raises(ValueError, match=match):
        # What is wrong with a parameter by itself is said when it is made.
        dano.identify(scene, observed, list(parameters() if callable(parameters) else parameters), **options)


def sliding_motion(n=10):
    times = np.arange(n) * 0.01
    position = np.stack([times, 0 * times, RADIUS + 0 * times], axis=1)
    return dano.Motion.create(times, "ball", position=position, orientation=np.tile([1.0, 0, 0, 0], (n, 1)))


def changed(**options):
    return lambda: [dataclasses.replace(FRICTION, **options)]


def test_bad_input():
    at = lambda path: changed(where=path)  # noqa: E731
    refuse("at least one motion", observed=[])
    refuse("observed must hold dano.Motion or dano.Trajectory or str or pathlib.Path objects", observed=[3])
    refuse("at least one Parameter", parameters=[])
    refuse("different names", parameters=[FRICTION, FRICTION])
    refuse("lower of parameter 'mu' must be ≤ upper", parameters=changed(lower=2.0))
    refuse("start of parameter 'mu' must lie between", parameters=changed(start=3.0))
    refuse("must pick leaves", parameters=at(lambda s: s.contact("ball", "floor").slipperiness))
    refuse("contact must be one of", parameters=at(lambda s: s.contact("ball", "wall").sliding_friction))
    refuse("its law does not use it", parameters=at(lambda s: s.contact("ball", "floor").stiffness))
    refuse("not parts or copies", parameters=at(lambda s: s.gravity[2]))
    refuse("not parts or copies", parameters=at(lambda s: 2 * s.gravity))
    refuse("each leaf once", parameters=at(lambda s: [s.gravity, s.gravity]))
    refuse("no controls are given", parameters=changed(of="controls"))
    refuse("coordinates must be one of value, log, inertia", parameters=changed(coordinates="cubic"))
    refuse("must be > 0 to have a logarithm", parameters=changed(coordinates="log", start=0.0))
    refuse("noise of position", noise={"position": 0.0})
    refuse("noise must be given for some", noise={"place": 1.0})
    refuse("initial must be one of", initial="everything")
    refuse("initial must list", initial=["speed"])
    tied = dano.IdentifyOptions(window=4, continuity=0.1)
    refuse(
        "options.continuity needs initial='states', got initial \\['velocity",
        initial="velocities",
        options=tied,
    )
    refuse("state must be one for all", state=[None, None])
    refuse("more numbers than there are unknowns", observed=sliding_motion(2), initial="states")
    many = dano.IdentifyOptions(starts=3)
    refuse("options.starts > 1 needs finite bounds", parameters=changed(upper=np.inf), options=many)
    nobody = dataclasses.replace(sliding_motion(), names=("cube",))
    refuse("bodies of the scene", observed=nobody)
    refuse(
        "options.independent needs at least 3 motions, two more than there are parameters, got 1",
        options=dano.IdentifyOptions(independent="motions"),
    )
    labelled = dano.IdentifyOptions(independent=["a", "b"])
    refuse("must be one label for each of 1 motions, got 2", options=labelled)
    only_turns = dataclasses.replace(sliding_motion(), position=np.full((10, 1, 3), np.nan))
    refuse("must have a frame with positions", observed=only_turns)
    only_floor = dataclasses.replace(sliding_motion(), names=("floor",))
    refuse("not observed: give the state", observed=only_floor)


@pytest.mark.parametrize(
    ("match", "wrong"),
    [
        ("window must be ≥ 2, got 1", {"window": 1}),
        ("continuity needs window, got continuity 0.1 and window None", {"continuity": 0.1}),
        ("a sequence of it must fall", {"continuity": (0.1, 0.3), "window": 4}),
        ("continuity must be finite and > 0", {"continuity": np.nan, "window": 4}),
        ("huber must be", {"huber": -1.0}),
        ("independent must be one of numbers, windows, motions, got 'runs'", {"independent": "runs"}),
        (
            "independent='windows' excludes continuity",
            {"independent": "windows", "continuity": 0.1, "window": 4},
        ),
        ("starts must lie between", {"starts": 0}),
        ("seed must be ≥ 0", {"seed": -1}),
        ("jacobian must be one of auto, forward, reverse, got 'sideways'", {"jacobian": "sideways"}),
        ("max_iterations must be", {"max_iterations": 0}),
        ("tolerance must be", {"tolerance": 0.0}),
        ("batch must be ≥ 1", {"batch": 0}),
        ("resume needs a checkpoint", {"resume": True}),
        ("checkpoint must end in .npz, got search.json", {"checkpoint": "search.json"}),
    ],
)
def test_options_out_of_range(match, wrong):
    with pytest.raises(ValueError, match=match):
        dano.IdentifyOptions(**wrong)


def test_an_interrupt_returns_the_best_so_far(truth):
    def stop(description, share):
        if description.startswith("fitting") and share > 0:
            raise KeyboardInterrupt

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        fit = dano.identify(ball_scene(), truth, [FRICTION], progress=stop)
    assert not fit.converged and "interrupted" in fit.stop.value
    assert fit.loss_history[-1] < fit.loss_history[0]


@pytest.mark.slow
def test_joint_from_the_motion_of_its_body():
    """Damping of a hinge, and how the body began to swing, from noisy poses of the body."""
    lid = dano.Body("lid", dano.Box((0.1, 0.08, 0.01)), mass=0.4)
    hinge = dano.Joint(None, "lid", axis=(1, 0, 0), anchor=(0, -0.08, 0), damping=0.004)
    scene = dano.Scene.create([lid], joints=[hinge], timestep=0.01)
    truth = dano.simulate(scene, scene.initial_state(lid=dict(q=1.2, v=-2.0)), 80)
    random = np.random.default_rng(0)
    position = np.asarray(truth.states.position) + 1e-3 * random.standard_normal((81, 1, 3))
    turned = truth.states.orientation
    observed = dano.Motion.create(truth.times, ["lid"], position=position, orientation=turned)
    found = dano.identify(
        scene.replace_joint("lid", damping=0.02),
        observed,
        [dano.Parameter("damping", lambda s: s.joints[0].damping, 0.0, 0.1)],
        initial="states",
        noise={"position": 1e-3, "orientation": 0.01},
    )
    np.testing.assert_allclose(found.values["damping"], 0.004, rtol=0.02)
    assert abs(found.values["damping"] - 0.004) <= 4 * found.standard_errors["damping"]
    q, v = coordinates(found.initial_states)
    np.testing.assert_allclose((q[0, 0], v[0, 0]), (1.2, -2.0), atol=0.02)


@pytest.mark.slow
def test_covariances_equal_to_the_noise_change_nothing(observed):
    rng = np.random.default_rng(3)
    seen = noisy(observed, rng)
    covariance = np.tile(np.diag(np.repeat([1e-4, 2e-3], 3) ** 2), (len(seen.times), 1, 1))
    known = dataclasses.replace(seen, covariance=covariance[:, None])
    plain, weighed = (
        dano.identify(ball_scene(), motion, [FRICTION], noise=NOISE, initial="velocities")
        for motion in (seen, known)
    )
    assert weighed.values["mu"] == pytest.approx(plain.values["mu"], rel=1e-6)
    assert weighed.standard_errors["mu"] == pytest.approx(plain.standard_errors["mu"], rel=1e-5)
    assert weighed.errors == pytest.approx(plain.errors, rel=1e-4)


def test_covariances_weigh_as_generalised_least_squares_does():
    """Noise along an oblique line, much of it in some frames: gravity of a flight has a closed form."""
    rng = np.random.default_rng(5)
    scene = ball_scene()
    start = scene.initial_state(ball={"position": (0, 0, 3), "velocity": (0.5, 0.2, 1.0)})
    flight = dano.Motion.from_trajectory(dano.simulate(scene, start, 30), bodies=["ball"], every=2)
    times, n = flight.times, len(flight.times)
    line = np.array([0.8, 0.0, 0.6])
    sizes = np.where(np.arange(n) % 3 == 1, 5e-3, 5e-4)
    covariance = np.array([s**2 * np.outer(line, line) + 1e-8 * np.eye(3) for s in sizes])
    noise = np.array([rng.multivariate_normal(np.zeros(3), c) for c in covariance])
    noise[0] = 0
    whole = np.tile(1e-6 * np.eye(6), (n, 1, 1, 1))
    whole[:, 0, :3, :3] = covariance
    position = flight.position[:, 0] + noise
    seen = dano.Motion.create(times, "ball", position=position, covariance=whole)
    gravity = dano.Parameter("g", lambda s: s.gravity, np.full(3, -20.0), np.full(3, 20.0))
    given: dict[str, Any] = {
        "state": start,
        "noise": {"position": 1e-3},
        "initial": ["velocity"],
        "options": dano.IdentifyOptions(tolerance=1e-4),
    }
    fit = dano.identify(scene, seen, [gravity], **given)
    # x = v t + ½ g t (t + h): the integrator's own sum.
    factors = np.stack([times, 0.5 * times * (times + H)], axis=1)[1:]
    design = np.einsum("tk,ij->tikj", factors, np.eye(3)).reshape(n - 1, 3, 6)
    inverse = np.linalg.inv(covariance[1:])
    normal = np.einsum("tki,tkl,tlj->ij", design, inverse, design)
    right = np.einsum("tki,tkl,tl->i", design, inverse, position[1:] - position[0])
    expected, errors = np.linalg.solve(normal, right)[3:], np.sqrt(np.diag(np.linalg.inv(normal)))[3:]
    assert np.all(np.abs(np.asarray(fit.values["g"]) - expected) < 0.02 * errors)
    # Without the covariances it comes out elsewhere, so that the comparison says something.
    plain = dataclasses.replace(seen, covariance=None)
    other = dano.identify(scene, plain, [gravity], **given)
    assert np.any(np.abs(np.asarray(other.values["g"]) - expected) > 0.3 * errors)


def test_parameters_are_text_as_on_the_command_line_and_masses_are_kilograms():
    """A constant force on a free ball: x = f t²/2m, so the scale follows from the way."""
    ball = dano.Body("ball", dano.Sphere(0.1), mass=0.5)
    scene = dano.Scene.create([ball], timestep=0.01, gravity=(0, 0, 0))
    push = scene.control(ball=dict(force=(1.0, 0, 0)))
    heavier = scene.replace_body("ball", mass_scale=1.6)
    seen = dano.simulate(heavier, n_steps=20, controls=push)
    fit = dano.identify(scene, seen, ["ball.mass_scale:0.5:5"], controls=push, noise=dict(position=1e-4))
    assert fit.values["ball.mass_scale"] == pytest.approx(1.6, rel=1e-6)
    mass, error = fit.masses["ball"]
    assert mass == pytest.approx(0.8, rel=1e-6)
    assert error == pytest.approx(0.5 * fit.standard_errors["ball.mass_scale"])
    assert "mass of ball [kg]" in str(fit) and fit.to_dict()["masses"]["ball"] == [mass, error]
    for text, message in (("ball.mas:0:1", "did you mean 'mass'"), ("bal.mass:0:1", "did you mean 'ball'")):
        with pytest.raises(ValueError, match=message):
            dano.identify(scene, seen, [text], controls=push)
