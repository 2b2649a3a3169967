"""Steps within a bridge do without Python, and are what they are with it."""

import contextlib
import gc
import threading
import time

import mujoco
import numpy as np
import pytest
from bridge.supports import thing, world
from mujoco import rollout

from dano.mujoco import Bridge


def attached(support: str = "plane", **options):
    spec = world(support)
    bridge = Bridge(spec, **options)
    bridge.attach("toy", thing("bar"), look=False)
    return bridge, bridge.compile()


@pytest.fixture
def entered(monkeypatch) -> list:
    """The data of each step that has called Python."""
    seen, append = [], Bridge._append

    def counted(self, model, data):
        seen.append(data)
        return append(self, model, data)

    monkeypatch.setattr(Bridge, "_append", counted)
    return seen


@contextlib.contextmanager
def in_python():
    """Where somebody else has a callback, all is Python's."""
    calls = []
    mujoco.set_mjcb_passive(lambda model, data: calls.append(data.time))
    try:
        yield calls
    finally:
        mujoco.set_mjcb_passive(None)


def dropped(model) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[2], data.qvel[:3] = 0.04, (0.5, 0.1, -0.5)
    return data


@pytest.mark.parametrize("support", ["plane", "box", "mesh"])
def test_steps_are_those_of_python_to_the_last_digit(entered, support):
    bridge, model = attached(support)
    with in_python() as calls:
        expected = dropped(model)
        with bridge:
            mujoco.mj_step(model, expected, 100)
    assert len(entered) == len(calls) == 100
    entered.clear()
    found = dropped(model)
    with bridge:
        mujoco.mj_step(model, found, 100)
        assert entered == [found]
        assert found.ncon > 0
    for name in ("qpos", "qvel", "qacc", "efc_force"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_threads_find_what_one_finds(entered):
    bridge, model = attached()
    state = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, dropped(model), state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    with bridge:
        data = [mujoco.MjData(model) for _ in range(4)]
        many = rollout.rollout(model, data, np.tile(state, (8, 1)), nstep=100)[0]
        one = rollout.rollout(model, data[:1], np.tile(state, (1, 1)), nstep=100)[0]
    assert 1 <= len(entered) <= 4
    for each in many:
        np.testing.assert_array_equal(each, one[0])


def test_python_is_asked_where_there_is_something_to_be_said(entered):
    bridge, model = attached("box")
    data = dropped(model)
    with bridge:
        mujoco.mj_step(model, data, 10)
        assert len(entered) == 1
        # The support sinks away.
        model.geom_size[0] *= 0.5
        mujoco.mj_step(model, data, 10)
        assert len(entered) == 2
        model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_OVERRIDE
        mujoco.mj_step(model, data, 10)
        assert len(entered) == 12
        model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_OVERRIDE)
        mujoco.mj_step(model, data, 10)
        assert len(entered) == 12
        model.opt.timestep = 1.0
        with pytest.raises(ValueError, match=r"timestep must be at most .*got 1"):
            mujoco.mj_step(model, data)


def test_contacts_that_are_off_are_off(entered):
    bridge, model = attached()
    data = dropped(model)
    with bridge:
        mujoco.mj_step(model, data, 200)
        assert data.ncon > 0
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        mujoco.mj_step(model, data, 200)
    assert data.ncon == 0 and data.qpos[2] < -0.1
    assert len(entered) == 1


def test_callbacks_that_are_set_within_are_called(entered):
    bridge, model = attached()
    data, times = dropped(model), []
    with bridge:
        mujoco.mj_step(model, data, 5)
        own = mujoco.get_mjcb_passive()

        def both(model, data):
            own(model, data)
            times.append(data.time)

        mujoco.set_mjcb_passive(both)
        mujoco.mj_step(model, data, 5)
        assert len(times) == 5 and len(entered) == 6
        mujoco.set_mjcb_passive(own)
        mujoco.mj_step(model, data, 5)
        assert len(times) == 5 and len(entered) == 7
    assert mujoco.get_mjcb_passive() is None


def test_a_bridge_within_another_leaves_it_as_it_was(entered):
    (outer, first), (inner, second) = attached(), attached()
    a, b = dropped(first), dropped(second)
    with outer:
        mujoco.mj_step(first, a, 5)
        with inner:
            mujoco.mj_step(second, b, 5)
        entered.clear()
        mujoco.mj_step(first, a, 5)
        assert entered == [a]
    assert mujoco.get_mjcb_passive() is None


def test_data_come_and_go(entered):
    bridge, model = attached()
    reference = dropped(model)
    with bridge:
        mujoco.mj_step(model, reference, 20)
        for _ in range(3):
            many = [dropped(model) for _ in range(100)]
            for each in many:
                mujoco.mj_step(model, each, 20)
                np.testing.assert_array_equal(each.qpos, reference.qpos)
            # Steps of those that stay do not call Python again.
            entered.clear()
            for each in [*many, reference]:
                mujoco.mj_step(model, each)
            assert entered == []
            mujoco.mj_resetData(model, reference)
            reference.qpos[2], reference.qvel[:3] = 0.04, (0.5, 0.1, -0.5)
            mujoco.mj_step(model, reference, 20)
            many.clear()
            gc.collect()


def test_blocks_may_end_while_threads_step():
    bridge, model = attached()
    data, ended = dropped(model), threading.Event()

    def step() -> None:
        while not ended.is_set():
            # A step that is about to ask Python does not find it any more.
            with contextlib.suppress(mujoco.UnexpectedError):
                mujoco.mj_step(model, data, 20)

    stepping = threading.Thread(target=step)
    stepping.start()
    try:
        for _ in range(300):
            with bridge:
                time.sleep(1e-3)
            # Memory that was freed would be these numbers.
            junk = [np.full(size, 0x4141414141, np.int64) for size in (14, 76, 129)]
            assert junk[0][0] > 0
    finally:
        ended.set()
        stepping.join()
    assert np.all(np.isfinite(data.qpos))


def test_another_model_with_the_same_data_is_looked_at(entered):
    bridge, model = attached()
    data = dropped(model)
    with bridge:
        mujoco.mj_step(model, data, 50)
        assert data.ncon > 0
        other = bridge.compile()
        mujoco.mj_step(other, data, 50)
        assert data.ncon > 0 and len(entered) == 2
        mujoco.mj_step(model, data, 50)
        assert data.ncon > 0 and len(entered) == 3
    assert data.qpos[2] > 0.015
