"""Scenes with joints shared by tests, and the same in MuJoCo."""

import jax
import numpy as np

import dano


def value_and_forward(function):
    """A function's value and its derivative in forward mode as one program, compiled in half the time."""

    def twice(at):
        value = function(at)
        return value, value

    derivative = jax.jit(jax.jacfwd(twice, has_aux=True))
    return lambda at: derivative(at)[::-1]


def robot(timestep=1e-3, gravity=(0.0, 0.0, 0.0)):
    """A floating base with an arm on a hinge, a rod that slides on the arm, and a piece welded to it."""
    bodies = [
        dano.Body("base", dano.Box((0.2, 0.1, 0.05)), mass=2.0),
        dano.Body("arm", dano.Box((0.05, 0.05, 0.2)), mass=1.0),
        dano.Body("rod", dano.Capsule(0.03, 0.1), mass=0.5),
        dano.Body("piece", dano.Box((0.03, 0.06, 0.02)), mass=0.3, com=(0.01, 0.02, 0.0)),
    ]
    joints = [
        dano.Joint("base", "arm", axis=(0, 1, 0.2), anchor=(0, 0, 0.2), position=(0.2, 0, 0)),
        dano.Joint(
            "arm", "rod", "slide", axis=(1, 0, 0.3), position=(0, 0, -0.3), orientation=(1, 0.2, 0.1, 0)
        ),
        dano.Joint("arm", "piece", "weld", position=(0.1, 0, 0)),
    ]
    scene = dano.Scene.create(bodies, contacts=(), joints=joints, timestep=timestep, gravity=gravity)
    state = scene.initial_state(
        base=dict(position=(0, 0, 1), velocity=(0.1, 0.2, 0), omega=(1, 2, -1)),
        arm=dict(q=0.3, v=2.0),
        rod=dict(q=0.05, v=0.3),
    )
    return scene, state


def mujoco_chain(mujoco, scene, state):
    """MuJoCo's model and data of a tree whose first body floats; joints are read from the scene."""
    gravity = " ".join(str(float(g)) for g in scene.gravity)
    hanging = {joint.child: joint for joint in scene.joints}

    def text(values):
        return " ".join(repr(float(x)) for x in np.asarray(values))

    def body(name):
        mine, joint = scene.body(name), hanging.get(name)
        where, moves = "", "<freejoint/>"
        if joint is not None:
            where = f'pos="{text(joint.position)}" quat="{text(joint.orientation)}"'
            moves = (
                ""
                if joint.kind == "weld"
                else f'<joint type="{joint.kind}" axis="{text(joint.axis)}" pos="{text(joint.anchor)}"/>'
            )
        children = "".join(body(j.child) for j in scene.joints if j.parent == name)
        inertia = np.asarray(mine.inertia)
        assert np.allclose(inertia, np.diag(np.diag(inertia)))
        return (
            f'<body name="{name}" {where}>{moves}<inertial pos="{text(mine.com)}" mass="{float(mine.mass)}" '
            f'diaginertia="{text(np.diag(inertia))}"/>{children}</body>'
        )

    xml = (
        f'<mujoco><option gravity="{gravity}" timestep="1e-4" integrator="RK4"/><worldbody>'
        f"{body(scene.names[0])}</worldbody></mujoco>"
    )
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    k = len(state.q)
    data.qpos[:] = np.concatenate([state.position[0], state.orientation[0], state.q])
    data.qvel[: 6 + k] = np.concatenate([state.velocity[0], state.omega[0], state.v])
    mujoco.mj_forward(model, data)
    return model, data


def coordinates(states):
    """q and v of states, on the host."""
    assert states.q is not None
    return np.asarray(states.q), np.asarray(states.v)
