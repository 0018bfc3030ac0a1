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


def test_in_other_environments_all_is_done_before_the_first_step():
    shares = []
    env = SerialEnv(2, lambda: GymEnv("Pendulum-v1"))
    collected(env, meanwhile=shares.append)
    assert shares == [1.0]


def test_a_step_with_additions_is_one_step():
    shares = []
    env = BatchedMujocoEnv("Hopper-v5", 2, threads=1)
    env.add("push", lambda now: {})
    collected(env, meanwhile=shares.append)
    assert shares == pytest.approx(np.arange(1, STEPS + 1) / STEPS)


def test_an_environment_steps_for_itself_again_after_an_error():
    env = reach()
    env.reset()
    td = env.rand_action(env.reset())

    def fail():
        raise OSError("no more")

    with pytest.raises(OSError, match="no more"), env.meanwhile(fail):
        env.step(td)
    assert env._work is None
    assert env.step(td)["next", "observation"].isfinite().all()


def overlapping(batches):
    """Return what a learner learned, and the reports on each batch."""
    env = reach()
    learner = DDPG(env, goal_reward, **SMALL)
    learning = Overlapped(learner)
    collector = make_collector(env, learner.policy, steps=STEPS)
    reports = [{} for _ in range(batches)]
    for index, report in enumerate(reports):
        with isolated(index):
            batch = next_batch(collector, meanwhile=learning.meanwhile)
        learning.update(batch, into=report, key=(index,))
        assert not report
    learning.finish()
    return learner._tensors(), reports


def test_no_clock_decides_what_is_learned():
    (tensors, reports), (twins, others) = overlapping(3), overlapping(3)
    assert reports == others
    assert [report["updates"] for report in reports] == [20.0] * 3
    assert all(torch.equal(tensors[name], twins[name]) for name in tensors)


def test_a_learner_that_cannot_learns_at_once():
    class Learner:
        def update(self, batch, *, key):
            return {"loss": float(batch + key)}

    learning = Overlapped(Learner())
    assert learning.meanwhile is None
    report = {"frames": 8.0}
    learning.update(1, into=report, key=1)
    learning.finish()
    assert report == {"frames": 8.0, "loss": 2.0}
