"""dano's side: rollouts, their gradients and batches, field queries."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import dano
from benchmarks._measure import compiled
from benchmarks._subjects import Subject
from benchmarks.speed._cases import Case

N_STEPS = 200
N_ROLLOUTS = 64
N_QUERIES = 10_000
FRICTION = 0.3
GRAVITY = 9.81

FLOOR = "One body on a floor, per step"
PRESSED = "Two bodies in contact in every step, per step"
GRADIENTS = f"Derivatives of a rollout of {N_STEPS} steps, per step"
BATCH = f"{N_ROLLOUTS} rollouts at once by vmap, per step and rollout"
QUERIES = "Field queries"
DISTRIBUTED = ", distributed"
SLOW_REPEATS = 5
"""Of cases whose call takes seconds."""


def _contact_of(subject: Subject, *, distributed: bool) -> tuple[dano.ContactParams, dano.AbstractContactLaw]:
    """Parameters and law: the paper's, scaled to the subject, or the distributed law's defaults."""
    if distributed:
        return dano.ContactParams(sliding_friction=FRICTION), dano.DistributedLaw()
    return subject.params(sliding_friction=FRICTION), subject.law()


def floor_scene(subject: Subject, *, distributed: bool = False) -> tuple[dano.Scene, dano.State]:
    """A bunny at rest on a floor."""
    scene = dano.Scene.create(
        [dano.Body("bunny", subject.bunny), dano.Body("floor", dano.HalfSpace(), fixed=True)],
        [dano.Contact("bunny", "floor", *_contact_of(subject, distributed=distributed))],
        timestep=subject.timestep,
    )
    return scene, subject.settled(scene)


def sliding(subject: Subject, state: dano.State) -> dano.State:
    """The same, sliding for most of the rollout."""
    speed = 0.6 * FRICTION * GRAVITY * N_STEPS * subject.timestep
    return eqx.tree_at(lambda s: s.velocity, state, state.velocity.at[0, 0].set(speed))


def floor_cases(subject: Subject, *, distributed: bool = False) -> list[Case]:
    """Forward rollouts: sliding, then at rest."""
    scene, rest = floor_scene(subject, distributed=distributed)
    arrays, static = eqx.partition(scene, eqx.is_array)
    run, seconds = compiled(_rollout(static), arrays, rest)
    cases = []
    for word, state in (("slides", sliding(subject, rest)), ("rests", rest)):
        note = _solver_note(run(arrays, state))
        cases.append(
            Case(
                FLOOR,
                f"{subject.name} {word}{DISTRIBUTED if distributed else ''}",
                lambda state=state: run(arrays, state),
                N_STEPS,
                60.0 if distributed else 15.0,
                compile_seconds=seconds if word == "slides" else None,
                note=note,
            )
        )
    return cases


def sphere_cases() -> list[Case]:
    """A shape without samples, for comparison."""
    scene = dano.Scene.create(
        [dano.Body("ball", dano.Sphere(0.05), mass=1.0), dano.Body("floor", dano.HalfSpace(), fixed=True)],
        [dano.Contact("ball", "floor", law=dano.CentroidLaw())],
        timestep=0.002,
    )
    state = scene.initial_state(ball={"position": (0, 0, 0.05), "velocity": (0.2, 0, 0)})
    arrays, static = eqx.partition(scene, eqx.is_array)
    run, seconds = compiled(_rollout(static), arrays, state)
    note = _solver_note(run(arrays, state))
    return [
        Case(
            FLOOR,
            "sphere rolls",
            lambda: run(arrays, state),
            N_STEPS,
            compile_seconds=seconds,
            note=note,
        )
    ]


def pressed_cases(subject: Subject, *, floor: bool, distributed: bool = False) -> list[Case]:
    """Two bunnies drawn together by a spring between their centres of mass, on a floor or without gravity."""
    bodies = [dano.Body("a", subject.bunny), dano.Body("b", subject.bunny)]
    params, law = _contact_of(subject, distributed=distributed)
    contacts = [dano.Contact("a", "b", params, law)]
    if floor:
        bodies.append(dano.Body("floor", dano.HalfSpace(), fixed=True))
        contacts += [dano.Contact(name, "floor", params, law) for name in "ab"]
    gravity = (0.0, 0.0, -GRAVITY if floor else 0.0)
    scene = dano.Scene.create(bodies, contacts, timestep=subject.timestep, gravity=gravity)
    size = subject.bunny.size
    start = scene.initial_state(
        a={"position": (0, 0, 0.5 * size)},
        b={"position": (1.2 * size, 0.1 * size, 0.5 * size), "orientation": (0, 0, 0, 1)},
    )
    stiffness = subject.mass * GRAVITY / size
    arrays, static = eqx.partition(scene, eqx.is_array)
    run, seconds = compiled(_rollout(static, _attraction(stiffness, len(bodies))), arrays, start)
    state = start
    for _ in range(3):  # fall, meet, come to rest
        state = jax.tree.map(lambda x: x[-1], run(arrays, state).states)
    rollout = run(arrays, state)
    overlap = np.asarray(dano.contact_patches(scene, rollout.states)[0].overlap)
    note = f"touching in {np.mean(overlap > 0):.0%} of the steps; {_solver_note(rollout)}"
    name = f"two of {subject.name}, {'on a floor' if floor else 'in the air'}"
    name += DISTRIBUTED if distributed else ""
    return [
        Case(
            PRESSED,
            name,
            lambda: run(arrays, state),
            N_STEPS,
            500.0 if distributed else 200.0,
            compile_seconds=seconds,
            note=note,
        )
    ]


def gradient_cases(subject: Subject, *, distributed: bool = False) -> list[Case]:
    """Reverse and forward mode, as multiples of the plain rollout from the same state."""
    scene, rest = floor_scene(subject, distributed=distributed)
    state = sliding(subject, rest)
    arrays, static = eqx.partition(scene, eqx.is_array)
    three = jnp.array([FRICTION, float(state.velocity[0, 0]), 1.0])
    law = DISTRIBUTED if distributed else ""
    base = f"{subject.name} slides{law}"

    def case(label, function, *args):
        run, seconds = compiled(function, *args)
        name = f"{subject.name}: {label}{law}"
        return Case(
            GRADIENTS,
            name,
            lambda: run(*args),
            N_STEPS,
            compile_seconds=seconds,
            base=base,
            ratio_target=4.0,
            repeats=SLOW_REPEATS if distributed else None,
        )

    few = _distance_of_three(static, distributed=distributed)
    cases = [
        case("reverse, 3 parameters", jax.grad(few), three, arrays, state),
        case("forward mode, 3 parameters", jax.jacfwd(few), three, arrays, state),
    ]
    if distributed:
        return cases
    many = _distance_of_all(static)
    inputs = (scene.contacts[0].params, _mass_leaves(scene), state)
    return [*cases, case("reverse, 38 parameters", jax.grad(many), inputs, arrays)]


def batch_cases(subject: Subject, *, distributed: bool = False) -> list[Case]:
    """Sliding rollouts that differ in friction only, and in friction, speed and spring."""
    scene, rest = floor_scene(subject, distributed=distributed)
    state = sliding(subject, rest)
    arrays, static = eqx.partition(scene, eqx.is_array)
    share = jnp.linspace(0.7, 1.3, N_ROLLOUTS)[:, None]
    middle = jnp.array([[FRICTION, float(state.velocity[0, 0]), 1.0]])
    varied = {
        "friction varies": middle * jnp.concatenate([share, jnp.ones((N_ROLLOUTS, 2))], axis=1),
        "all vary": middle * share,
    }
    batched = jax.vmap(_distance_of_three(static, distributed=distributed), (0, None, None))
    run, seconds = compiled(batched, middle * share, arrays, state)
    return [
        Case(
            BATCH,
            f"{N_ROLLOUTS} of {subject.name}, {words}{DISTRIBUTED if distributed else ''}",
            lambda parameters=parameters: run(parameters, arrays, state),
            N_STEPS * N_ROLLOUTS,
            None if distributed else 6.0,
            compile_seconds=seconds if words == "all vary" else None,
            repeats=SLOW_REPEATS if distributed else None,
        )
        for words, parameters in varied.items()
    ]


def query_cases() -> list[Case]:
    """Values and gradients of a 64³ grid at points all over it."""
    random = np.random.default_rng(0)
    cases = []
    for interpolation in ("linear", "quadratic", "cubic"):
        field = dano.GridField(random.random((64, 64, 64)), (0.0,) * 3, 1 / 63, interpolation)
        points = jnp.asarray(random.random((3, N_QUERIES)))
        run, seconds = compiled(lambda field, x: field.jet(x, 1), field, points)
        quadratic = interpolation == "quadratic"
        cases.append(
            Case(
                QUERIES,
                f"{N_QUERIES} values and gradients, {interpolation} 64³",
                lambda run=run, field=field, points=points: run(field, points),
                target=1.5 if quadratic else None,
                unit="ms",
                compile_seconds=seconds if quadratic else None,
            )
        )
    return cases


def memory_case(n_samples: int = 5000) -> Case:
    """What reading the samples once costs: a lower limit for any program that sums over all of them."""
    samples = np.random.default_rng(0).random(4 * n_samples)
    repeats = 500

    def read():
        for _ in range(repeats):
            samples.dot(samples)

    return Case(FLOOR, "floor: numpy.dot over 4 × 5000 numbers", read, repeats, note="160 kB, read once")


def _rollout(static: dano.Scene, controls: Callable | None = None) -> Callable:
    def run(arrays, state):
        return dano.simulate(eqx.combine(arrays, static), state, N_STEPS, controls=controls)

    return run


def _attraction(stiffness: float, n_bodies: int) -> Callable:
    def control(state, time):
        pull = stiffness * (state.position[1] - state.position[0])
        still = jnp.zeros((n_bodies, 3), pull.dtype)
        return dano.Control(still.at[0].set(pull).at[1].set(-pull), still)

    return control


def _distance_of_three(static: dano.Scene, *, distributed: bool = False) -> Callable:
    """Where the bunny ends up, as a function of friction, initial speed and spring (a factor)."""
    spring = "stiffness" if distributed else "spring"

    def distance(parameters, arrays, state):
        scene = eqx.combine(arrays, static)
        changes = {spring: getattr(scene.contact("bunny", "floor"), spring) * parameters[2]}
        scene = scene.replace_contact("bunny", "floor", sliding_friction=parameters[0], **changes)
        start = eqx.tree_at(lambda s: s.velocity, state, state.velocity.at[0, 0].set(parameters[1]))
        return dano.simulate(scene, start, N_STEPS).states.position[-1, 0, 0]

    return distance


def _distance_of_all(static: dano.Scene) -> Callable:
    """The same, as a function of all contact parameters, all mass properties and the initial state."""

    def distance(inputs, arrays):
        params, masses, state = inputs
        scene = eqx.combine(arrays, static)
        scene = eqx.tree_at(lambda s: (s.contacts[0].params, *_mass_leaves(s)), scene, (params, *masses))
        return dano.simulate(scene, state, N_STEPS).states.position[-1, 0, 0]

    return distance


def _mass_leaves(scene: dano.Scene):
    body = scene.bodies[0]
    return body.mass, body.inertia, body.com, body.mass_scale, body.com_offset


def _solver_note(run: dano.Trajectory) -> str:
    failed = int(jnp.sum(~run.converged))
    words = f"{float(jnp.mean(run.iterations)):.1f} Newton iterations"
    return words + (f", {failed} steps NOT converged" if failed else "")
