"""Learning from one batch while the next one is collected."""

import numpy as np
import pytest
import torch
from torchrl.envs import GymEnv, SerialEnv, TransformedEnv

from torchrl_bayessim.agents.ddpg import DDPG
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.tasks.fetch import goal_reward
from torchrl_bayessim.overlapped import Overlapped
from torchrl_bayessim.randomness import isolated
from torchrl_bayessim.simulate import make_collector, next_batch

SMALL = {"hidden": (32, 32), "batch_size": 64, "updates_per_frame": 0.1, "capacity": 1000}
STEPS = 50


def reach(threads=1):
    return BatchedMujocoEnv("FetchReach-v4", 4, threads=threads)


def collected(env, *, meanwhile=None, policy=None):
    collector = make_collector(env, policy, steps=STEPS)
    try:
        with isolated("batch"):
            return next_batch(collector, meanwhile=meanwhile)
    finally:
        collector.shutdown(close_env=False)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("wrap", [lambda env: env, TransformedEnv])
def test_work_is_done_at_every_step_and_changes_no_batch(wrap, threads):
    shares = []
    batch = collected(wrap(reach(threads)), meanwhile=shares.append)
    assert shares == pytest.approx(np.arange(1, STEPS + 1) / STEPS)
    assert torch.equal(batch["observation"], collected(reach())["observation"])


def test_other_environments_leave_no_time():
    shares = []
    env = SerialEnv(2, lambda: GymEnv("Pendulum-v1"))
    collected(env, meanwhile=shares.append)
    assert not shares


def test_an_environment_steps_for_itself_again_after_an_error():
    env = reach()
    env.reset()
    td = env.rand_action(env.reset())

    def fail():
        raise OSError("no more")

    with pytest.raises(OSError, match="no more"), env.meanwhile(fail):
        env.step(td)
    assert env.stepper.meanwhile is None
    assert env.step(td)["next", "observation"].isfinite().all()


def overlapping(batches):
    """Return what a learner learned, and the reports on each batch."""
    env = reach()
    learner = DDPG(env, goal_reward, **SMALL)
    learning = Overlapped(learner)
    collector = make_collector(env, learner.policy, steps=STEPS)
    reports = []
    for index in range(batches):
        with isolated(index):
            batch = next_batch(collector, meanwhile=learning.meanwhile)
        reports.append(learning.update(batch, key=(index,)))
    reports.append(learning.finish())
    return learner._tensors(), reports


def test_no_clock_decides_what_is_learned():
    (tensors, reports), (twins, others) = overlapping(3), overlapping(3)
    assert reports == others
    assert reports[0] == {}
    assert [report["updates"] for report in reports[1:]] == [20.0] * 3
    assert all(torch.equal(tensors[name], twins[name]) for name in tensors)


def test_a_learner_that_cannot_learns_at_once_and_is_reported_late():
    class Learner:
        def update(self, batch, *, key):
            return {"loss": float(batch + key)}

    learning = Overlapped(Learner())
    assert learning.meanwhile is None
    assert learning.update(1, key=1) == {}
    assert learning.update(2, key=2) == {"loss": 2.0}
    assert learning.finish() == {"loss": 4.0}
    assert learning.finish() == {}
