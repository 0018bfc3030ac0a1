"""Arms whose hand is dragged by a mocap body: actions are converted, and replayed all the same."""

import gymnasium
import gymnasium_robotics
import numpy as np
import pytest
import torch

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.objective import units_of
from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.diagnosis.segments import cut
from torchrl_bayessim.diagnosis.tangent import Tangent
from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.tasks.catalogue import known_task
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System

gymnasium.register_envs(gymnasium_robotics)
STILL = ("slide0", "slide1", "slide2", "torso_lift_joint")  # stand still, and their encoders too


def recorded(name, *, runs, steps, gain=1.0, noise=0.0):
    """Return logs of gymnasium's own simulator, whose actions arrive ``gain`` times as large."""
    env, rng, found = gymnasium.make(name).unwrapped, np.random.default_rng(0), []
    model = env.model
    tangent = Tangent(model)
    fixed = np.array([any(part in model.joint(model.dof_jntid[d]).name for part in STILL)
                      for d in range(model.nv)])  # fmt: skip
    spread = np.where(fixed, 0.0, 1.0)
    for i in range(runs):
        env.reset(seed=i)
        rows = []
        for t in range(steps):
            hand = env.data.site("robot0:grip").xpos
            if t == 0:
                middle = hand.copy()
            if t % 6 == 0:  # within reach
                goal = middle + rng.uniform(-0.12, 0.12, 3)
            action = np.r_[np.clip(6 * (goal - hand), -1, 1), rng.uniform(-1, 1)]
            qpos, qvel = env.data.qpos.copy(), env.data.qvel.copy()
            qpos = tangent.displace(qpos, noise * spread * rng.standard_normal(model.nv))
            qvel = qvel + 10 * noise * spread * rng.standard_normal(model.nv)
            rows.append((qpos, qvel, action))
            env.step((gain * action).astype(np.float32))
        qpos, qvel, ctrl = (torch.from_numpy(np.array(part)) for part in zip(*rows, strict=True))
        found.append(
            Log(
                name=f"run{i}",
                time=0.04 * torch.arange(steps, dtype=torch.float64),
                qpos=qpos,
                qvel=qvel,
                ctrl=ctrl,
                velocity_gain=torch.zeros(model.nv, dtype=torch.float64),
                measured=torch.ones(2 * model.nv, dtype=torch.bool),
            )
        )
    return found


@pytest.mark.parametrize("name", ["FetchReach-v4", "FetchPush-v4", "FetchPickAndPlace-v4"])
@pytest.mark.parametrize("forced", [False, True], ids=["natively", "step by step"])
def test_segments_go_as_in_gymnasium_s_own_simulator(name, forced):
    system = System(task=known_task(name))
    predictor = Predictor(system, threads=1)
    predictor.exactly()
    segments = cut(recorded(name, runs=1, steps=14, gain=0.8), 4, history=2)
    short = {effect("action_gain"): np.array([[-0.2] * 4])}
    if forced:  # a force that is next to nothing, which is asked for before every time step
        unit = next(u for u in units_of([effect("constant_force")], system.robot))
        short[unit.effect] = np.array([[1e-9, *[0.0] * (len(unit.direction) - 1)]])
    nominal = predictor.residuals(segments, np.zeros((1, 0)))
    right = predictor.residuals(segments, np.zeros((1, 0)), short)
    assert np.sqrt((nominal**2).mean()) > 1e-3
    # MuJoCo's solver begins elsewhere, and ends within its tolerance
    assert np.abs(right).max() < 1e-4


@pytest.mark.slow
def test_a_hand_that_goes_less_far_than_told_is_named():
    system = System(task=known_task("FetchReach-v4"))
    logs = recorded("FetchReach-v4", runs=6, steps=40, gain=0.9, noise=3e-4)
    report = diagnose(
        system, None, logs, effects=["action_gain", "action_bias", "dead_band", "action_delay"]
    )
    assert [found.name for found in report.effects] == ["action_gain"]
    assert report.effects[0].strength == pytest.approx(-0.1, abs=0.02)
    mended = report.apply(BatchedMujocoEnv("FetchReach-v4", 2, threads=1))
    assert mended.rollout(3).batch_size == (2, 3)
