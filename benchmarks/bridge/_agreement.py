"""The same object on the same support in our engine: how far apart it is after sliding for a second."""

import mujoco
import numpy as np

import dano
from benchmarks._measure import Row
from dano.fields import SignedDistanceGrid
from dano.scene_file import load_asset

SETTLE, WATCH = 3.0, 1.0
SPEED, FRICTION = 0.2, 0.3
MOST = 2.0
"""Distance that is asked for [% of size]."""
HOLLOW, HOLLOW_NODES = (0.3, 0.05), 41
"""Half width, and height as depth of the base [m]; nodes of the height field on a side."""
_LAYERS = np.linspace(-0.05, 0.08, 53)
"""Heights at which distances to it are kept [m]."""
_LYING = (0.5**0.5, 0.0, 0.5**0.5, 0.0)


def hollow(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Height of the height field from 0 to 1 at places from −1 to 1."""
    return 1 - np.exp(-4 * (x**2 + y**2))


def with_article(support: str) -> str:
    """A support in a sentence."""
    return f"{'an' if support[0] in 'aeiou' else 'a'} {support}"


def agreement_row(name: str, support: str, model, bridge) -> Row:
    """From rest in MuJoCo, both engines let the object slide.

    Args:
        name: Of the object.
        support: What it lies on.
        model: MuJoCo's, with the object on body "toy".
        bridge: Its bridge.
    """
    # Without this advice of MuJoCo's its friction gives way on slopes, for its own geoms, too.
    model.opt.cone, model.opt.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10.0
    model.geom_friction[:, 0] = FRICTION
    data, obj = mujoco.MjData(model), load_asset(name)
    com, n = np.asarray(obj.mass.com), round(WATCH / model.opt.timestep)
    with bridge:
        mujoco.mj_step(model, data, round(SETTLE / model.opt.timestep))
        data.qvel[:] = (SPEED, 0, 0, 0, 0, 0)
        mujoco.mj_forward(model, data)
        start = {
            "position": data.body("toy").xipos.copy(),
            "orientation": data.body("toy").xquat.copy(),
            "velocity": (SPEED, 0, 0),
        }
        theirs = []
        for _ in range(n):
            mujoco.mj_step(model, data)
            turn = np.zeros(9)
            mujoco.mju_quat2Mat(turn, data.qpos[3:7])
            theirs.append(data.qpos[:3] + turn.reshape(3, 3) @ com)
    shape, place = _support(support)
    scene = dano.Scene.create(
        [dano.Body("toy", obj), dano.Body("support", shape, fixed=True)],
        [dano.Contact("toy", "support", dano.ContactParams(sliding_friction=FRICTION))],
        timestep=float(model.opt.timestep),
    )
    run = dano.simulate(scene, scene.initial_state(toy=start, support=place), n)
    ours = np.asarray(run.states.position)[1:, 0]
    apart = np.linalg.norm(ours - np.array(theirs), axis=1)
    way = np.linalg.norm(ours - start["position"], axis=1).max()
    failed = int(np.sum(~np.asarray(run.converged)))
    note = f"{1000 * way:.0f} mm way" + (f", {failed} steps NOT converged" if failed else "")
    group = f"Beside our engine, over {WATCH:g} s"
    return Row(
        group,
        f"{name} slides on {with_article(support)}, apart",
        100 * apart.max() / obj.size,
        "% of size",
        MOST,
        note=note,
    )


def _support(support: str) -> tuple[dano.AbstractShape, dict]:
    """Our shape for a support, and its place."""
    match support:
        case "plane":
            return dano.HalfSpace(), {}
        case "box" | "mesh":
            return dano.Box((0.2, 0.2, 0.1)), {"position": (0, 0, -0.1)}
        case "sphere":
            return dano.Sphere(0.5), {"position": (0, 0, -0.5)}
        case "capsule":
            return dano.Capsule(0.3, 0.3), {"position": (0, 0, -0.3), "orientation": _LYING}
        case "cylinder":
            return dano.Cylinder(0.3, 0.3), {"position": (0, 0, -0.3), "orientation": _LYING}
        case "ellipsoid":
            return dano.Ellipsoid((0.6, 0.5, 0.3)), {"position": (0, 0, -0.3)}
    half, top = HOLLOW
    x = np.linspace(-half, half, 2 * HOLLOW_NODES - 1)
    heights = top * hollow(x[:, None] / half, x[None] / half)
    slopes = np.gradient(heights, x, x)
    steep = np.sqrt(1 + slopes[0] ** 2 + slopes[1] ** 2)[..., None]
    # Near the surface, where contact is, the height over it along its normal.
    over = (_LAYERS - heights[..., None]) / steep
    # The sides and the base, a cell within the grid.
    inner = x[-2]
    aside = np.maximum(np.abs(x[:, None, None]), np.abs(x[None, :, None])) - inner
    distances = np.maximum(np.maximum(over, aside), _LAYERS[1] - _LAYERS)
    spacing = (x[1] - x[0], x[1] - x[0], _LAYERS[1] - _LAYERS[0])
    return SignedDistanceGrid(distances, (-half, -half, _LAYERS[0]), spacing), {}
