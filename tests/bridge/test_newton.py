"""Objects on bodies of Newton's worlds, on a CPU: as in MuJoCo."""

import mujoco
import numpy as np
import pytest
import warp as wp
from bridge.supports import thing, world

from dano.mujoco import add_newton_body, Bridge, NewtonBridge

newton = pytest.importorskip("newton", reason="worlds of Newton need newton")
# Newton asks for one version of MuJoCo, others are said to be untested.
pytestmark = [
    pytest.mark.filterwarnings("ignore::newton.NewtonWarning"),
    pytest.mark.filterwarnings("ignore:set_const_:DeprecationWarning"),
]


def solved(names: dict[str, tuple], n_worlds: int, **options):
    """A solver of worlds with objects above a plane, before anything is attached, and its model."""
    one, every = newton.ModelBuilder(), newton.ModelBuilder()
    for name, place in names.items():
        cfg = newton.ModelBuilder.ShapeConfig(mu=0.5)
        xform = wp.transform(place, wp.quat_identity())
        add_newton_body(one, thing(name), label=name, xform=xform, cfg=cfg)
    every.replicate(one, n_worlds)
    every.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(mu=0.5))
    model = every.finalize(device="cpu")
    return newton.solvers.SolverMuJoCo(model, cone="elliptic", impratio=10.0, **options), model


def stepped(solver, model, steps: int, speeds=None):
    before, after, control = model.state(), model.state(), model.control()
    if speeds is not None:
        before.joint_qd.assign(np.asarray(speeds, np.float32).ravel())
    newton.eval_fk(model, model.joint_q, before.joint_qd, before)
    for _ in range(steps):
        solver.step(before, after, control, None, 0.002)
        before, after = after, before
    return before.joint_q.numpy().reshape(solver.mjw_data.nworld, -1)


def test_the_bunny_comes_to_rest_where_it_does_in_mujoco():
    solver, model = solved({"bunny": (0, 0, 0.08)}, 3)
    NewtonBridge(solver).attach("bunny", thing("bunny"))
    found = stepped(solver, model, 500)
    spec = world("plane")
    spec.body("toy").pos = [0, 0, 0.08]
    spec.option.integrator = int(solver.mj_model.opt.integrator)
    bridge = Bridge(spec)
    bridge.attach("toy", thing("bunny"), look=False)
    expected = bridge.compile()
    data = mujoco.MjData(expected)
    with bridge:
        mujoco.mj_step(expected, data, 500)
    for each in found:
        np.testing.assert_allclose(each[:3], data.qpos[:3], atol=0.01 * thing("bunny").size)
        np.testing.assert_allclose(np.roll(each[3:], 1), data.qpos[3:], atol=0.01)


def test_a_stack_slides_as_in_mujoco():
    solver, model = solved({"soap": (0, 0, 0.02), "bar": (0, 0, 0.06)}, 2)
    bridge = NewtonBridge(solver)
    bridge.attach("soap", thing("soap"))
    bridge.attach("bar", thing("bar"))
    rest = stepped(solver, model, 300)
    # The bar is 4 cm high and lies on the soap, not in it.
    assert np.all(rest[:, 9] - rest[:, 2] > 0.03)
    spec = world("plane")
    spec.option.integrator = int(solver.mj_model.opt.integrator)
    spec.worldbody.add_body(name="bar").add_freejoint()
    own = Bridge(spec)
    own.attach("toy", thing("soap"), look=False)
    own.attach("bar", thing("bar"), look=False)
    expected = own.compile()
    expected.geom_friction[:, 0] = 0.5
    data = mujoco.MjData(expected)
    # Newton has quaternions as (x, y, z, w).
    data.qpos[:] = rest[0, [0, 1, 2, 6, 3, 4, 5, 7, 8, 9, 13, 10, 11, 12]]
    data.qvel[[0, 6]] = 0.6
    with own:
        mujoco.mj_step(expected, data, 100)
    model.joint_q.assign(rest.ravel())
    slid = stepped(solver, model, 100, np.tile([0.6, 0, 0, 0, 0, 0], (2, 2)))
    assert data.qpos[0] - rest[0, 0] > 0.02
    for each in slid:
        np.testing.assert_allclose(each[:3], data.qpos[:3], atol=0.01 * thing("soap").size)
        np.testing.assert_allclose(each[7:10], data.qpos[7:10], atol=0.01 * thing("bar").size)


def test_bad_input_is_named():
    solver, model = solved({"soap": (0, 0, 0.02)}, 1)
    bridge = NewtonBridge(solver)
    with pytest.raises(ValueError, match="body must be one of .*'soap'.* did you mean"):
        bridge.attach("soup", thing("soap"))
    with pytest.raises(ValueError, match="orientation must not be zero"):
        bridge.attach("soap", thing("soap"), orientation=(0, 0, 0, 0))
    bridge.attach("soap", thing("soap"))
    with pytest.raises(ValueError, match="twice"):
        bridge.attach("soap", thing("soap"))
    with pytest.raises(ValueError, match="use_mujoco_contacts=True"):
        NewtonBridge(newton.solvers.SolverMuJoCo(model, use_mujoco_contacts=False))
    with pytest.raises(ValueError, match="solver must be a SolverMuJoCo"):
        NewtonBridge(newton.solvers.SolverXPBD(model))
