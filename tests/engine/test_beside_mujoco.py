"""One body in free flight, on a floor and on a hinge, beside MuJoCo; two laws in one scene; single precision.

MuJoCo takes Runge–Kutta steps of 0.1 ms, or implicit ones where there is contact.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dano

G, H = 9.81, 1e-3
HALF = (0.06, 0.04, 0.02)


def mujoco_run(body: str, options: str, start: dict[str, list[float]], seconds: float, watch: int):
    """Positions `qpos` of one body each `watch` steps of 0.1 ms, the first one at the start."""
    mujoco = pytest.importorskip("mujoco")
    xml = f'<mujoco><option timestep="1e-4" {options}/><worldbody>{body}</worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = start["qpos"], start["qvel"]
    mujoco.mj_forward(model, data)
    rows = [data.qpos.copy()]
    for step in range(1, round(seconds / 1e-4) + 1):
        mujoco.mj_step(model, data)
        if step % watch == 0:
            rows.append(data.qpos.copy())
    return np.array(rows)


def box() -> dano.Body:
    return dano.Body("box", dano.Box(HALF), mass=0.5)


def half_a_step_later(run: dano.Trajectory, name: str) -> np.ndarray:
    """Velocity or spin of the first body at the first state: a trajectory has those of half a step before."""
    values = np.asarray(getattr(run.states, name))
    return 0.5 * (values[0, 0] + values[1, 0])


def test_free_flight():
    """A tumbling box: its spin about the middle axis turns over, which is chaotic for a wrong inertia."""
    scene = dano.Scene.create([box()], timestep=H)
    state = scene.initial_state(
        box=dict(position=(0, 0, 1), velocity=(1.0, 0.5, 2.0), omega=(0.1, 12.0, 0.2))
    )
    run = dano.simulate(scene, state, 1000)
    size = " ".join(map(str, HALF))
    theirs = mujoco_run(
        f'<body><freejoint/><geom type="box" size="{size}" mass="0.5"/></body>',
        f'gravity="0 0 {-G}" integrator="RK4"',
        {
            "qpos": [0, 0, 1, 1, 0, 0, 0],
            "qvel": [*half_a_step_later(run, "velocity"), *half_a_step_later(run, "omega")],
        },
        1.0,
        10,
    )
    np.testing.assert_allclose(run.states.position[:, 0], theirs[:, :3], atol=1e-5)
    ours = Rotation.from_quat(np.roll(np.asarray(run.states.orientation[:, 0]), -1, axis=1))
    other = Rotation.from_quat(np.roll(theirs[:, 3:], -1, axis=1))
    # Over twelve radians and a flip.
    assert (ours * other.inv()).magnitude().max() < 2e-3


def test_sliding():
    """A box that slides to rest on a floor: its way, and v²/(2 μ g)."""
    friction, speed = 0.3, 1.0
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    contact = dano.Contact("box", "floor", dano.ContactParams(sliding_friction=friction))
    scene = dano.Scene.create([box(), floor], [contact], timestep=H)
    run = dano.simulate(
        scene, scene.initial_state(box=dict(position=(0, 0, HALF[2]), velocity=(speed, 0, 0))), 500
    )
    assert bool(run.converged.all())
    size = " ".join(map(str, HALF))
    geometry = f'friction="{friction} 0 0" condim="3"'
    theirs = mujoco_run(
        f'<geom type="plane" size="5 5 1" {geometry}/>'
        f'<body><freejoint/><geom type="box" size="{size}" mass="0.5" {geometry}/></body>',
        f'gravity="0 0 {-G}" cone="elliptic" impratio="100" integrator="implicitfast"',
        {"qpos": [0, 0, HALF[2], 1, 0, 0, 0], "qvel": [speed, 0, 0, 0, 0, 0]},
        0.5,
        10,
    )
    way = speed**2 / (2 * friction * G)
    assert float(run.states.position[-1, 0, 0]) == pytest.approx(way, rel=0.01)
    np.testing.assert_allclose(run.states.position[:, 0, 0], theirs[:, 0], atol=0.02 * way)


def test_a_pendulum():
    """A box on a hinge beside its middle, from 1.5 rad: a second and a half of its swing."""
    arm = 0.3
    joint = dano.Joint(None, "box", axis=(0, 1, 0), anchor=(0, 0, arm), position=(0, 0, 0))
    scene = dano.Scene.create([box()], joints=[joint], timestep=H)
    run = dano.simulate(scene, scene.initial_state(box=dict(q=1.5)), 1500)
    q, v = run.states.q, run.states.v
    assert q is not None and v is not None
    size = " ".join(map(str, HALF))
    theirs = mujoco_run(
        f'<body><joint type="hinge" axis="0 1 0"/>'
        f'<geom type="box" size="{size}" pos="0 0 {-arm}" mass="0.5"/></body>',
        f'gravity="0 0 {-G}" integrator="RK4"',
        {"qpos": [1.5], "qvel": [float(0.5 * (v[0, 0] + v[1, 0]))]},
        1.5,
        10,
    )
    assert theirs[:, 0].min() < -1.4
    np.testing.assert_allclose(q[:, 0], theirs[:, 0], atol=2e-4)


@pytest.fixture(scope="module")
def two_laws():
    """Two boxes far from each other on one floor; each may have either law."""
    laws = {"distributed": dano.DistributedLaw(), "centroid": dano.CentroidLaw()}
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    friction = dano.ContactParams(sliding_friction=0.3)

    def scene(*names: str) -> dano.Scene:
        bodies = [dano.Body(name, dano.Box(HALF), mass=0.5) for name in names]
        contacts = [dano.Contact(name, "floor", friction, laws[name]) for name in names]
        return dano.Scene.create([*bodies, floor], contacts, timestep=0.005)

    return scene


def run_of(scene: dano.Scene, n_steps: int = 60) -> dano.Trajectory:
    places = {"distributed": (0.0, 0.0, 0.021), "centroid": (0.0, 1.0, 0.021)}
    start: dict[str, Any] = {
        name: dict(position=places[name], velocity=(0.8, 0, 0), omega=(0, 0, 2.0))
        for name in scene.names
        if name in places
    }
    return dano.simulate(scene, scene.initial_state(**start), n_steps)


def test_two_laws_in_one_solve(two_laws):
    """Bodies that do not touch each other move as they do alone, whatever the law of the other's contact."""
    both = run_of(two_laws("distributed", "centroid"))
    assert bool(both.converged.all())
    for i, name in enumerate(("distributed", "centroid")):
        alone = run_of(two_laws(name))
        assert float(jnp.abs(alone.states.position[-1, 0, 0])) > 0.05
        np.testing.assert_allclose(both.states.position[:, i], alone.states.position[:, 0], atol=1e-7)
        np.testing.assert_allclose(both.states.omega[:, i], alone.states.omega[:, 0], atol=1e-5)


def test_single_precision_with_the_distributed_law(two_laws):
    scene = two_laws("distributed")
    double = run_of(scene)
    single = run_of(jax.tree.map(lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, scene))
    assert single.states.position.dtype == jnp.float32
    assert bool(single.converged.all())
    np.testing.assert_allclose(single.states.position[:, 0], double.states.position[:, 0], atol=2e-5)
    np.testing.assert_allclose(single.states.orientation[:, 0], double.states.orientation[:, 0], atol=1e-4)
