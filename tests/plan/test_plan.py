"""Plans: closed forms of free motion, a joint, pushing through contact, files, messages."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano
from benchmarks.grasp._run import Hand
from dano.planning import load_controls, problem_of, softened

H, N_STEPS, MASS = 0.05, 20, 2.0


@pytest.fixture(scope="module")
def puck():
    """A body that floats without gravity."""
    body = dano.Body("puck", dano.Sphere(0.1), mass=MASS)
    return dano.Scene.create([body], timestep=H, gravity=(0, 0, 0))


def drive(position=(0.0, 0.0, 0.0), orientation=(1.0, 0.0, 0.0, 0.0)):
    """To a pose, at rest there."""
    return dano.Task(
        N_STEPS,
        [dano.Actuator("puck", limit=20.0, cost=1e-2), dano.Actuator("puck", "torque", limit=1.0, cost=1.0)],
        [
            dano.Goal("puck", position=position, within=1e-4),
            dano.Goal("puck", orientation=orientation, within=1e-4),
            dano.Goal("puck", velocity=(0, 0, 0), within=1e-4),
        ],
    )


@pytest.fixture(scope="module")
def driven(puck):
    task = drive(position=(1.0, -0.5, 0.2))
    return task, dano.plan(puck, puck.initial_state(), task)


def test_a_free_body_takes_the_least_effort_of_the_closed_form(driven):
    _, made = driven
    # x⁺ = x + h v⁺, v⁺ = v + h f/m: rest to rest with forces of least norm, a linear system.
    steps = np.arange(N_STEPS)
    reach = H * H / MASS * (N_STEPS - steps)
    both = np.stack([reach, np.full(N_STEPS, H / MASS)])
    for axis, distance in enumerate((1.0, -0.5, 0.2)):
        exact = both.T @ np.linalg.solve(both @ both.T, [distance, 0.0])
        np.testing.assert_allclose(made.values[:, axis], exact, atol=2e-3)
    assert made.reached and made.goals[0].error < 1e-4
    assert np.abs(made.values[:, 3:]).max() < 1e-6
    exact_cost = 0.5 * H * 1e-2 * float(np.sum(np.square(made.values[:, :3])))
    np.testing.assert_allclose(made.cost, exact_cost, rtol=1e-4)


def test_simulating_the_controls_gives_the_trajectory(puck, driven, tmp_path):
    _, made = driven
    made.save(tmp_path / "plan.npz")
    controls = load_controls(tmp_path / "plan.npz")
    run = dano.simulate(puck, puck.initial_state(), controls=controls)
    np.testing.assert_allclose(run.states.position, made.trajectory.states.position, atol=1e-12)
    (tmp_path / "other.npz").write_bytes(b"no plan")
    with pytest.raises(ValueError, match="other.npz"):
        load_controls(tmp_path / "other.npz")


def test_an_orientation_is_reached_on_the_manifold(puck):
    turn = (0.5, 0.5, 0.5, 0.5)
    made = dano.plan(puck, puck.initial_state(), drive(orientation=turn))
    assert made.reached, made.describe()
    last = np.asarray(made.trajectory.states.orientation[-1, 0])
    np.testing.assert_allclose(abs(last @ np.array(turn)), 1.0, atol=1e-6)
    # Of a ball the torque of least norm is that of the rotation vector, here along (1, 1, 1).
    torque = np.asarray(made.values[:, 3:])
    np.testing.assert_allclose(torque, torque.mean(axis=1, keepdims=True).repeat(3, axis=1), atol=2e-3)


def test_derivatives_are_those_of_linearize(puck):
    task = drive(position=(1.0, 0.0, 0.0))
    problem = problem_of(puck, task, dano.VariationalEngine())
    state = puck.initial_state(puck=dict(orientation=(1, 0.2, 0, 0.1), omega=(1, 2, 3), velocity=(1, 0, 0)))
    w = jnp.linspace(-0.5, 0.5, 6)
    nominal = problem.dynamics(state, w, jnp.asarray(0))

    @jax.jit
    def gone(change):
        return problem.difference(
            nominal, problem.dynamics(problem.retract(state, change), w, jnp.asarray(0))
        )

    control = task.control(puck, task.bounds()[1] * w)
    A, _ = dano.linearize(puck, state, control)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(gone))(jnp.zeros(12)), A, atol=1e-10)
    for step in (1e-2, 1e-6):
        column = np.asarray(gone(step * jnp.eye(12)[9])) / step
        np.testing.assert_allclose(column, A[:, 9], atol=10 * step)


def test_a_goal_out_of_reach_is_a_result_in_words(puck):
    made = dano.plan(puck, puck.initial_state(), drive(position=(100.0, 0.0, 0.0)))
    assert not made.reached
    assert not made.goals[0].reached and made.goals[0].error > 80
    text = made.describe()
    assert "does NOT reach" in text and "position of puck: missed by" in text
    assert "position of puck" in made.message
    lower, upper = (np.asarray(bound) for bound in drive().bounds())
    values = np.asarray(made.values)
    assert np.all((values >= lower) & (values <= upper))


@pytest.mark.slow
def test_a_drawer_is_opened_and_stays_within_its_travel():
    drawer = dano.Body("drawer", dano.Box((0.1, 0.1, 0.05)), mass=1.0)
    slide = dano.Joint(None, "drawer", "slide", axis=(1, 0, 0), damping=1.0)
    scene = dano.Scene.create([drawer], joints=[slide], timestep=H)
    task = dano.Task(
        N_STEPS,
        [dano.Actuator("drawer", "effort", limit=3.0, cost=1e-2)],
        [dano.Goal("drawer", q=0.18, within=1e-4), dano.Goal("drawer", v=0.0, within=1e-3)],
        [dano.Limit("drawer", "v", upper=0.25)],
    )
    made = dano.plan(scene, scene.initial_state(), task)
    assert made.reached, made.describe()
    states = made.trajectory.states
    assert states.q is not None and states.v is not None
    q, v = states.q[:, 0], states.v[:, 0]
    assert abs(q[-1] - 0.18) < 1e-4
    # Without the limit it would have to reach 1.5 times the mean speed.
    assert 0.2 < np.max(v) < 0.25 + 2e-3


def cloud(half=0.1, n=7):
    """A cube as a neural object of few samples on its surface."""
    axis = np.linspace(-half, half, n)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    points = grid[np.any(np.isclose(np.abs(grid), half), axis=1)]
    inertia = 2 / 3 * half**2 * np.eye(3)
    return dano.NeuralObject.from_samples(
        points=points, density=np.ones(len(points)), mass=1.0, com=(0, 0, 0), inertia=inertia
    )


@pytest.fixture(scope="module")
def pushing():
    """A hand that can push a cube, afloat; they do not touch yet."""
    bodies = [dano.Body("cube", cloud()), dano.Body("hand", dano.Sphere(0.1, edge=0.02), mass=1.0)]
    contact = dano.Contact("cube", "hand", dano.ContactParams(sliding_friction=0.2), dano.CentroidLaw())
    scene = dano.Scene.create(bodies, [contact], timestep=0.02, gravity=(0, 0, 0))
    state = scene.initial_state(hand=dict(position=(-0.25, 0.01, 0)))
    task = dano.Task(
        40,
        [dano.Actuator("hand", limit=20.0, cost=1e-2)],
        [dano.Goal("cube", position=(0.3, 0.05, 0.0), within=2e-3, running=0.1)],
    )
    return scene, state, task


@pytest.fixture(scope="module")
def pushed(pushing):
    scene, state, task = pushing
    guess = np.zeros((40, 3))
    guess[:, 0] = 3.0
    return dano.plan(scene, state, task, controls=guess)


def test_a_cube_is_pushed_to_its_goal_through_contact(pushing, pushed):
    assert pushed.reached, pushed.describe()
    assert np.abs(pushed.values).max() <= 20.0
    assert np.asarray(pushed.trajectory.converged).all()
    # It is pushed: it stood still until the hand came.
    way = np.linalg.norm(pushed.trajectory.states.position[:, 0], axis=1)
    assert way[2] < 1e-6
    assert np.linalg.norm(pushed.trajectory.states.position[-1, 0] - np.array([0.3, 0.05, 0])) < 3.5e-3
    # What carries it there is the hand's momentum, and theirs together is that of the forces.
    momentum = pushed.trajectory.states.velocity[-1].sum(axis=0)
    np.testing.assert_allclose(momentum, 0.02 * pushed.values.sum(axis=0), atol=1e-6)


def test_new_plans_on_the_way_make_up_for_another_mass(pushing, pushed):
    scene, state, task = pushing
    plant = scene.replace_body("cube", mass_scale=1.3)
    blind = dano.follow(plant, state, task, pushed, feedback=False)
    again = dano.follow(
        plant, state, task, pushed, replanning=dano.Replanning(scene, every=10), feedback=False
    )
    assert [replan.step for replan in again.replans] == [10, 20, 30]
    assert again.goals[0].error < 0.5 * blind.goals[0].error
    # Where new plans know the scene, they say that they reach what the first one did, and do.
    sure = dano.follow(
        scene, state, task, pushed, replanning=dano.Replanning(scene, every=20), feedback=False
    )
    assert all(replan.reached for replan in sure.replans)
    assert sure.goals[0].error <= 2 * pushed.goals[0].within
    assert again.values.shape == pushed.values.shape and again.converged
    same = dano.follow(scene, state, task, pushed)
    np.testing.assert_allclose(same.states.position[-1], pushed.trajectory.states.position[-1], atol=1e-6)
    with pytest.raises(ValueError, match="every must be ≥ 1, got 0"):
        dano.Replanning(scene, every=0)
    odd = dataclasses.replace(scene, timestep=jnp.asarray(0.015))
    with pytest.raises(
        ValueError, match="timestep of replanning.scene must be the plan's 0.02 s or that divided by"
    ):
        dano.follow(plant, state, task, pushed, replanning=dano.Replanning(odd, every=5))


def test_new_plans_may_take_the_steps_of_the_plant(pushing, pushed):
    """One new plan, midway in the push: it is enough only if it knows what the rest does at h/4."""
    scene, state, task = pushing
    plant = dataclasses.replace(scene, timestep=scene.timestep / 4)
    goal = dano.Goal("cube", position=(0.3, 0.05, 0.0), within=2e-4, running=0.1)
    exact = dano.Task(task.n_steps, task.actuators, [goal])
    missed = {}
    for name, believed in (("h", scene), ("h/4", plant)):
        run = dano.follow(
            plant, state, exact, pushed, replanning=dano.Replanning(believed, every=20), feedback=False
        )
        assert run.states.position.shape[0] == 4 * task.n_steps + 1 and run.converged
        missed[name] = run.goals[0].error
    assert missed["h/4"] < 0.5 * missed["h"], missed


def test_a_step_of_the_task_may_hold_several_of_the_scene(puck):
    task = drive(position=(1.0, 0.0, 0.0))
    fine = dataclasses.replace(puck, timestep=puck.timestep / 4)
    coarse, finer = (
        problem_of(s, task, dano.VariationalEngine(), substeps=n) for s, n in ((puck, 1), (fine, 4))
    )
    state, w, t = (
        puck.initial_state(puck=dict(velocity=(1, 0, 0))),
        jnp.linspace(-0.5, 0.5, 6),
        jnp.asarray(0),
    )
    control = task.control(fine, task.bounds()[1] * w)
    held = jax.tree.map(lambda x: jnp.repeat(x[None], 4, axis=0), control)
    run = dano.simulate(fine, state, controls=held)
    np.testing.assert_allclose(
        finer.dynamics(state, w, t).position, run.states.position[-1], rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(finer.stage_cost(state, w, t), coarse.stage_cost(state, w, t), rtol=1e-12)


def test_sampling_finds_contact_that_derivatives_do_not_show(pushing):
    scene, state, task = pushing
    few = dano.PlanOptions(sampling=dano.SamplingOptions(passes=6, samples=24), seed=1)
    for method in ("cem", "mppi"):
        made = dano.plan(scene, state, task, method=method, options=few)
        # From no control at all, where the cube would stay 0.304 m away.
        assert made.goals[0].error < 0.2, made.describe()
        assert made.solution is None and method in made.describe()
        assert np.abs(made.values).max() <= 20.0


def test_softened_contact_has_that_share_of_the_stiffness(pushing):
    scene, _, _ = pushing
    soft = softened(scene, 0.1)
    for before, after in zip(scene.contacts, soft.contacts, strict=True):
        np.testing.assert_allclose(after.params.spring, 0.1 * before.params.spring)
        np.testing.assert_allclose(after.params.damper, 0.1 * before.params.damper)
        assert after.params.sliding_friction == before.params.sliding_friction


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: dano.Actuator("a", "push", limit=1.0),
            "must be one of force, torque, effort, command, got 'push'",
        ),
        (lambda: dano.Actuator("a"), "bounds of the force of 'a' must be given"),
        (
            lambda: dano.Actuator("a", lower=2.0, upper=1.0),
            r"lower .* must be < upper, got \[2.0, 2.0, 2.0\]",
        ),
        (
            lambda: dano.Actuator("a", limit=1.0, axes="xw"),
            "axes of the force of 'a' must be different letters",
        ),
        (lambda: dano.Actuator("a", limit=1.0, cost=-1.0), "cost of the force of 'a' must be ≥ 0, got -1.0"),
        (lambda: dano.Goal("a"), "must have one of position, orientation, .*, got none"),
        (lambda: dano.Goal("a", positon=(0, 0, 0)), "did you mean 'position'"),
        (lambda: dano.Goal("a", q=0.0, within=0.0), "within of the goal of 'a' must be > 0, got 0.0"),
        (lambda: dano.Limit("a", "velocity", lower=1.0, upper=0.0), "must be ≤ upper, got 1.0 and 0.0"),
        (lambda: dano.Limit("a", "orientation"), "must be one of position, velocity"),
        (lambda: dano.Task(0, [], []), "n_steps must be ≥ 1, got 0"),
        (lambda: dano.Task(5, [], []), "at least one actuator and one goal"),
        (
            lambda: dano.Task(5, [dano.Actuator("a", limit=1.0)] * 2, [dano.Goal("a", q=0.0)]),
            "got the force of 'a' twice",
        ),
    ],
)
def test_bad_parts_of_a_task_are_said(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_task_of_another_scene_is_said(puck):
    state = puck.initial_state()
    strange = dano.Task(3, [dano.Actuator("pukc", limit=1.0)], [dano.Goal("puck", velocity=(0, 0, 0))])
    with pytest.raises(ValueError, match="did you mean 'puck'"):
        dano.plan(puck, state, strange)
    jointless = dano.Task(3, [dano.Actuator("puck", "effort", limit=1.0)], [dano.Goal("puck", q=0.0)])
    with pytest.raises(ValueError, match="effort of 'puck' must be that of a joint"):
        dano.plan(puck, state, jointless)
    with pytest.raises(ValueError, match="method must be one of ilqr, cem, mppi, got 'pso'"):
        dano.plan(puck, state, drive(position=(0, 0, 0)), method="pso")
    with pytest.raises(ValueError, match="controls must have shape"):
        dano.plan(puck, state, drive(position=(0, 0, 0)), controls=np.zeros((3, 1)))


def test_options_out_of_range():
    with pytest.raises(ValueError, match="softening must hold factors between 0 and 1, got 2"):
        dano.PlanOptions(softening=[2.0])
    with pytest.raises(ValueError, match="explore must be ≥ 0, got -1"):
        dano.PlanOptions(explore=-1)
    with pytest.raises(ValueError, match="seed must be ≥ 0"):
        dano.PlanOptions(seed=-1)
    with pytest.raises(ValueError, match="first must be one of normal, even, got 'sobol'"):
        dano.SamplingOptions(first="sobol")


@pytest.mark.slow
def test_grasp_lifts_the_bunny_and_holds_it():
    """Two fingers lift it by 10 cm and hold it 2 s with less than 1 mm of slip; a weak grip does not."""
    hand = Hand()
    for grip, holds in ((15.0, True), (1.0, False)):
        grasp = np.array([-0.02, 0.06, grip])
        held = hand.held(hand.state(grasp), jnp.asarray(hand.controls(grasp)))
        assert held.holds == holds, held
        # Friction carries no more than 2 μ times the grip: 1.6 N against a weight of 4.9 N.
        assert (held.lift > 0.1) == holds


def test_sampling_moves_the_first_guess(pushing):
    """With one knot controls are the guess, moved by as much at all times."""
    scene, state, task = pushing
    guess = np.zeros((40, 3))
    guess[:20, 0] = 5.0
    sampling = dano.SamplingOptions(passes=2, samples=6, knots=1, deviation=0.1)
    options = dano.PlanOptions(sampling=sampling)
    made = dano.plan(scene, state, task, method="cem", controls=guess, options=options)
    moved = np.asarray(made.values) - guess
    np.testing.assert_allclose(moved, np.broadcast_to(moved[:1], moved.shape), atol=1e-12)
    assert np.abs(moved).max() > 0


def test_a_first_pass_may_cover_all_that_bounds_allow(puck):
    """16 N for a second move 2 kg by 4 m; samples near the first guess of 0 N do not know of it."""
    task = dano.Task(
        N_STEPS,
        [dano.Actuator("puck", limit=20.0, axes="x", cost=0.0)],
        [dano.Goal("puck", position=(4.0, 0.0, 0.0), axes="x", within=1e-2)],
    )
    forces = {}
    for first in ("normal", "even"):
        sampling = dano.SamplingOptions(passes=1, samples=16, knots=1, deviation=1e-3, first=first)
        options = dano.PlanOptions(sampling=sampling)
        guess = np.zeros((N_STEPS, 1))
        made = dano.plan(puck, puck.initial_state(), task, method="cem", controls=guess, options=options)
        forces[first] = np.asarray(made.values)[:, 0]
    assert np.abs(forces["normal"]).max() < 1
    # A sample in every 2.5 N, but for the first two, which are the guess: no more than three of these away.
    assert np.all(np.abs(forces["even"] - 16) < 7.5)
    assert np.all(np.abs(forces["even"]) <= 20)


@pytest.mark.slow
def test_contact_is_looked_for_where_the_first_guess_makes_none(pushing):
    scene, state, task = pushing
    stages = []
    made = dano.plan(scene, state, task, callback=lambda stage, *_: stages.append(stage))
    assert made.reached, made.describe()
    assert "nothing that is driven touches 'cube'" in made.explored and made.explored in made.describe()
    assert stages[0] == "exploring" and "optimising" in stages
    # The hand begins on the wrong side: it must go around the cube.
    behind = scene.initial_state(hand=dict(position=(0.25, 0.01, 0)))
    around = dano.plan(scene, behind, task)
    assert around.reached, around.describe()


def test_what_does_not_need_to_be_touched_is_not_explored(pushing, pushed, driven):
    # A guess that makes contact, a body that is driven itself.
    assert pushed.explored == "" and driven[1].explored == ""
    scene, state, task = pushing
    never = dano.plan(scene, state, task, options=dano.PlanOptions(explore=0))
    assert never.explored == "" and not never.reached
    # The derivative is zero; a small force at all times would touch, and the end says what that is worth.
    assert "the derivative along" in never.message and "the force of hand along x it is 0" in never.message
    # Where no pair of the scene may touch, there is nothing to look for.
    apart = dano.Scene.create(list(scene.bodies), contacts=(), timestep=0.02, gravity=(0, 0, 0))
    made = dano.plan(apart, state, task)
    assert "no contact of the scene lets it" in made.explored and not made.reached


def test_a_body_that_sticks_is_pushed():
    """With no force it is held, and derivatives say that a little force moves nothing."""
    box = dano.Body("box", dano.Box((0.05, 0.05, 0.05)), mass=1.0)
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    params = dano.ContactParams(sliding_friction=0.5)
    scene = dano.Scene.create([box, floor], [dano.Contact("box", "floor", params)], timestep=0.02)
    goals = [
        dano.Goal("box", position=(0.1, 0, 0.05), within=2e-3),
        dano.Goal("box", velocity=(0, 0, 0), within=1e-2),
    ]
    task = dano.Task(16, [dano.Actuator("box", limit=15.0)], goals)
    made = dano.plan(scene, scene.initial_state(box=dict(position=(0, 0, 0.0499))), task)
    assert made.reached, made.describe()
    assert np.abs(made.values[:, 0]).max() > 0.5 * 9.81
