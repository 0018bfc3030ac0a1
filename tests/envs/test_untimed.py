import ctypes
import threading

import mujoco
import numpy as np
import pytest

from torchrl_bayessim.envs.libmujoco import address_of
from torchrl_bayessim.envs.stepper import Stepper
from torchrl_bayessim.envs.untimed import untimed

BALL = "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"


@pytest.fixture
def ball():
    model = mujoco.MjModel.from_xml_string(BALL)
    return model, mujoco.MjData(model)


def clock():
    return ctypes.c_void_p.from_address(address_of("mjcb_time")).value


def timed(model, data):
    """Whether a step adds to the data's timer."""
    timer = data.timer[mujoco.mjtTimer.mjTIMER_STEP]
    before = timer.duration
    for _ in range(100):
        mujoco.mj_step(model, data)
    return timer.duration > before


def test_no_step_is_timed_within_and_every_step_after(ball):
    assert timed(*ball)
    with untimed():
        assert not timed(*ball)
    assert timed(*ball)


def test_the_clock_comes_back_after_an_error(ball):
    with pytest.raises(RuntimeError, match="within"), untimed():
        raise RuntimeError("within")
    assert timed(*ball)


def test_whoever_took_the_clock_returns_it_however_two_overlap(ball):
    assert timed(*ball)
    before, first, second = clock(), untimed(), untimed()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert clock() == before
    second.__exit__(None, None, None)
    assert clock() == before


def test_a_clock_that_came_meanwhile_stays(ball):
    calls = []
    with untimed():
        mujoco.set_mjcb_time(lambda: calls.append(1) or 0.0)
    try:
        mujoco.mj_step(*ball)
    finally:
        mujoco.set_mjcb_time(None)
        mujoco.MjData(ball[0])  # which brings the bindings' own clock again
    assert calls
    assert timed(*ball)


def test_a_clock_of_a_users_own_stays_and_is_asked(ball):
    calls = []
    mujoco.set_mjcb_time(lambda: calls.append(1) or 0.0)
    try:
        with untimed():
            mujoco.mj_step(*ball)
            assert calls
            mujoco.set_mjcb_time(None)
        mujoco.mj_step(*ball)  # nothing that was taken comes back
    finally:
        mujoco.set_mjcb_time(None)
        mujoco.MjData(ball[0])
    assert timed(*ball)


def test_what_mujoco_does_not_have_is_an_error():
    with pytest.raises(ImportError, match=r"a symbol of MuJoCo .* got 'mjcb_tea'.*Try: a version"):
        address_of("mjcb_tea")


def test_an_error_meanwhile_waits_for_all_threads_and_brings_the_clock_back(ball):
    stepper = Stepper(ball[0], 64, threads=1)
    before = clock()

    def fail():
        raise RuntimeError("meanwhile")

    with pytest.raises(RuntimeError, match="meanwhile"):
        stepper.rollout(np.zeros((64, 50, 0)), substeps=20, meanwhile=fail)
    assert stepper._running
    assert all(future.done() for future in stepper._running)
    assert clock() == before
    assert np.ptp(stepper["time"]) == 0.0 < stepper["time"][0]


def test_simulations_are_stepped_without_a_clock_and_leave_it_in_its_place(ball):
    seen = []
    stepper = Stepper(ball[0], 2, threads=1)
    before = clock()
    stepper.begin()
    stepper.rollout(np.zeros((2, 1, 0)), substeps=1, meanwhile=lambda: seen.append(clock()))
    assert seen == [None]
    assert clock() == before is not None


def test_other_threads_may_step_meanwhile(ball):
    """The clock comes and goes while they do."""
    going = threading.Event()

    def step():
        while not going.is_set():
            mujoco.mj_step(*ball, 100)

    thread = threading.Thread(target=step)
    thread.start()
    stepper = Stepper(ball[0], 4, threads=1)
    for _ in range(2000):
        stepper.rollout(np.zeros((4, 1, 0)), substeps=1)
    going.set()
    thread.join()
    assert timed(*ball)
