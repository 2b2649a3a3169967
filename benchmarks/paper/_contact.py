"""Distributed contact against closed forms: rest, stiction, sliding, spinning, bouncing, convergence."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import dano
from benchmarks import _subjects
from benchmarks._measure import NO_DATA, reference_folder, Row, skipped
from dano.maths import quat_from_axis_angle, quat_multiply, quat_to_matrix

REST, SLOPE, BOUNCE = "Distributed contact: rest", "Friction", "Bounce"
CONVERGENCE = "Convergence of a drop"
STEPS = (1 / 60, 0.01, 0.001)
DRAWS = 4  # of surface samples
DROP = 0.3
FRICTION = 0.5


def contact_rows(*, quick: bool) -> list[Row]:
    """All comparisons."""
    steps = STEPS[:2] if quick else STEPS
    rows = []
    for name, body, orientation in _dropped(quick=quick):
        for h in steps:
            rows += _rest_rows(name, body, orientation, h)
    if reference_folder() is None:
        rows.append(skipped(REST, "authors' bunny and soap", NO_DATA))
    rows += [row for h in steps for row in _stack_rows(h, 10 if quick or h < 0.005 else 60)]
    rows += [row for h in steps for row in _friction_rows(h)]
    rows += _bounce_rows(quick=quick)
    return rows + _convergence_rows(quick=quick)


def floor_scene(body: dano.Body, h: float, *, slope: float = 0.0, gravity: float = 9.81, law=None, **params):
    """A body on a floor that is tilted about y by an angle [rad], in axes of the floor."""
    down = gravity * np.array([np.sin(slope), 0, -np.cos(slope)])
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    given = dano.ContactParams(**{"sliding_friction": FRICTION, **params})
    contact = dano.Contact(body.name, "floor", given, law or dano.DistributedLaw())
    return dano.Scene.create([body, floor], [contact], timestep=h, gravity=down)


def _dropped(*, quick: bool):
    box = dano.Body("body", dano.Box((0.05, 0.05, 0.05)), mass=1.0)
    subjects = [("box", box, np.array([1, 0.3, 0.2, 0.1]))]
    folder, authors = reference_folder(), None if quick else _subjects.authors_bunny()
    if folder is not None and authors is not None:
        subjects.append(("authors' bunny", dano.Body("body", authors.bunny), np.array([1.0, 1, 0, 0])))
        data = np.load(folder / "bluesoap_density_grid_approx.npz")
        soap = dano.NeuralObject.from_field(
            dano.GridField(data["values"], data["origin"], data["spacing"]),
            mass_model="solid",
            mass_scale=0.1,
        )
        flat = np.load(folder / "soap_real_pose_traj.npz")["Q_data"][0]
        tilted = quat_multiply(quat_from_axis_angle((1, 0, 0), np.radians(15)), jnp.asarray(flat))
        subjects.append(("authors' soap", dano.Body("body", soap), np.asarray(tilted)))
    return subjects


def _rest_rows(name: str, body: dano.Body, orientation: np.ndarray, h: float) -> list[Row]:
    """Speeds from 3 s to 13 s after a drop from 0.3 m."""
    scene = floor_scene(body, h)
    turned = np.asarray(quat_to_matrix(jnp.asarray(orientation / np.linalg.norm(orientation))))
    assert scene.bodies[0].surface is not None
    points = np.asarray(scene.bodies[0].surface.points[:3]) - np.asarray(body.com)[:, None]
    height = DROP - (turned @ points)[2].min()
    state = scene.initial_state(body={"position": (0, 0, height), "orientation": orientation})
    fall = np.sqrt(2 * DROP / 9.81)
    run = dano.simulate(scene, state, int((fall + 13) / h))
    after = np.asarray(run.times) >= fall + 3
    v = float(np.linalg.norm(run.states.velocity[:, 0], axis=1)[after].max())
    w = float(np.linalg.norm(run.states.omega[:, 0], axis=1)[after].max())
    note = (
        f"{int(jnp.sum(~run.converged))} steps not converged, {float(run.iterations.mean()):.1f} iterations"
    )
    label = f"{name}, h = {h:.4g} s"
    return [
        Row(REST, f"{label}: speed 3–13 s later", v, "m/s", 1e-6, note=note),
        Row(REST, f"{label}: spin 3–13 s later", w, "rad/s", 1e-5),
    ]


def _stack_rows(h: float, seconds: float) -> list[Row]:
    """Three boxes, set down askew."""
    boxes = [dano.Body(f"box {i}", dano.Box((0.05, 0.05, 0.05)), mass=1.0) for i in range(3)]
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    names = ["floor", *(box.name for box in boxes)]
    params = dano.ContactParams(sliding_friction=FRICTION)
    contacts = [
        dano.Contact(upper, lower, params, dano.DistributedLaw())
        for lower, upper in zip(names[:-1], names[1:], strict=True)
    ]
    scene = dano.Scene.create([*boxes, floor], contacts, timestep=h)
    places = {
        box.name: {
            "position": (0.004 * i, -0.003 * i, 0.0502 + 0.1004 * i),
            "orientation": (1, 0, 0, 0.03 * i),
        }
        for i, box in enumerate(boxes)
    }
    run = dano.simulate(scene, scene.initial_state(**places), int(seconds / h))
    position = np.asarray(run.states.position[:, :3])
    later = int(3 / h)
    drift = float(np.abs(position[-1] - position[later]).max())
    return [Row(REST, f"stack of three boxes, h = {h:.4g} s: drift in {seconds} s", drift, "m", 1e-4)]


def _friction_rows(h: float) -> list[Row]:
    rows = []
    box = dano.Body("body", dano.Box((0.05, 0.05, 0.02)), mass=0.5)
    start: dict = {"position": (0, 0, 0.02)}
    mu = 0.4

    def on_slope(share: float) -> float:
        scene = floor_scene(box, h, slope=np.arctan(share * mu), sliding_friction=mu)
        run = dano.simulate(scene, scene.initial_state(body=start), int(1 / h))
        return float(run.states.velocity[-1, 0, 0])

    label = f"h = {h:.4g} s"
    rows.append(Row(SLOPE, f"creep at tan θ = 0.9 μ, {label}", on_slope(0.9), "m/s", 1e-6))
    rows.append(Row(SLOPE, f"creep at tan θ = 0.99 μ, {label}", on_slope(0.99), "m/s", 1e-6))
    slope = np.arctan(1.01 * mu)
    expected = 9.81 * (np.sin(slope) - mu * np.cos(slope))
    error = abs(on_slope(1.01) / (expected * h * int(1 / h)) - 1)
    rows.append(Row(SLOPE, f"acceleration at tan θ = 1.01 μ, {label}", 100 * error, "%", 1.0))

    scene = floor_scene(box, h, sliding_friction=0.3)
    run = dano.simulate(scene, scene.initial_state(body={**start, "velocity": (2, 1, 0)}), int(0.5 / h))
    speed = np.linalg.norm(run.states.velocity[:, 0, :2], axis=1)
    first = int(0.1 / h)
    slowing = (speed[first] - speed[-1]) / (h * (len(speed) - 1 - first)) / (0.3 * 9.81)
    rows.append(Row(SLOPE, f"sliding deceleration, {label}", 100 * abs(float(slowing) - 1), "%", 0.5))

    for name, shape, lever in (
        ("disc", dano.Cylinder(0.05, 0.01), 2 / 3 * 0.05),
        ("box", dano.Box((0.08, 0.04, 0.01)), _mean_distance(0.08, 0.04)),
    ):
        scene = floor_scene(dano.Body("body", shape, mass=0.5), h, sliding_friction=0.3)
        state = scene.initial_state(body={"position": (0, 0, 0.01), "omega": (0, 0, 15.0)})
        run = dano.simulate(scene, state, int(0.1 / h))
        spin, first = np.asarray(run.states.omega[:, 0, 2]), int(0.03 / h)
        slowing = (spin[first] - spin[-1]) / (h * (len(spin) - 1 - first))
        expected = 0.3 * 0.5 * 9.81 * lever / float(scene.bodies[0].inertia[2, 2])
        error = 100 * abs(float(slowing) / expected - 1)
        rows.append(Row(SLOPE, f"deceleration of a spinning {name}, {label}", error, "%", 2.0))
    return rows


def _mean_distance(a: float, b: float) -> float:
    """Mean distance [m] of a rectangle's points, with half sides a and b, from its middle."""
    u, w = (half * (np.arange(1000) + 0.5) / 1000 for half in (a, b))
    return float(np.hypot(u[:, None], w[None]).mean())


def _bounce_rows(*, quick: bool) -> list[Row]:
    """A ball thrown at the floor at 2 m/s without gravity: 3 % needs some 60 steps a contact."""
    rows = []
    ball = dano.Body("body", dano.Sphere(0.05), mass=0.5)
    for h in (1e-4,) if quick else (1e-3, 2e-4, 1e-4, 5e-5):
        for restitution in (0.2, 0.5, 0.8):
            scene = floor_scene(ball, h, gravity=0.0, restitution=restitution)
            state = scene.initial_state(body={"position": (0, 0, 0.051), "velocity": (0, 0, -2.0)})
            run = dano.simulate(scene, state, int(0.03 / h))
            bounced = float(run.states.velocity[-1, 0, 2]) / 2
            error = 100 * abs(bounced / restitution - 1)
            contact = float(jnp.sum(run.states.position[:, 0, 2] < 0.05))
            target = 3.0 if h <= 1e-4 else None
            note = f"e = {bounced:.3f}, {contact:.0f} steps in contact"
            rows.append(Row(BOUNCE, f"e = {restitution}, h = {h:.4g} s", error, "%", target, note=note))
    return rows


def _convergence_rows(*, quick: bool) -> list[Row]:
    """Where an egg-shaped body is after it bounced and rolled on, as samples and steps are refined."""
    rows = []
    *counts, most = (312, 1250, 5000) if quick else (1250, 2500, 5000, 20_000)
    # One draw of samples says little: errors are over several, against the mean of as many with most samples.
    limit = np.mean([_end(most, 5e-4, seed) for seed in range(DRAWS)], axis=0)
    for n in counts:
        errors = [np.linalg.norm(_end(n, 5e-4, seed) - limit) for seed in range(DRAWS)]
        error = 1e3 * float(np.sqrt(np.mean(np.square(errors))))
        name = f"position, {n} samples against {most}, {DRAWS} draws"
        rows.append(Row(CONVERGENCE, name, error, "mm", note="root mean square"))
    steps = (2e-3, 1e-3, 5e-4) if quick else (2e-3, 1e-3, 5e-4, 2.5e-4, 1.25e-4)
    ends = [_end(1250, h) for h in steps]
    for h, fine, coarse in zip(steps[:-1], ends[1:], ends[:-1], strict=True):
        difference = 1e3 * float(np.abs(fine - coarse).max())
        rows.append(Row(CONVERGENCE, f"position, h = {h:g} s against half of it", difference, "mm"))
    return rows


@functools.cache
def _egg(n: int, seed: int) -> dano.NeuralObject:
    """An ellipsoid as an object of n samples."""
    return dano.NeuralObject.from_field(
        dano.Ellipsoid((0.06, 0.05, 0.04)), n_samples=n, mass=0.5, resolution=64, key=jax.random.key(seed)
    )


def _end(n: int, h: float, seed: int = 0) -> np.ndarray:
    """Position 0.5 s after the drop of an ellipsoid that rolls on, with stiffness the same for all.

    Impacts are left to the spring: those that end within a step press fewer samples, the shorter the step.
    """
    law = dano.DistributedLaw(compliant=True)
    given = {"stiffness": 2e6, "restitution": 0.3, "sliding_friction": 0.3}
    scene = floor_scene(dano.Body("body", _egg(n, seed)), h, law=law, **given)
    state = scene.initial_state(
        body={"position": (0, 0, 0.12), "orientation": (1, 0.2, 0.1, 0), "velocity": (0.5, 0.2, 0)}
    )
    run = dano.simulate(scene, state, round(0.5 / h))
    return np.asarray(run.states.position[-1, 0])
