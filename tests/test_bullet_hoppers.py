"""PyBullet's Hoppers of the recovery table, side by side, against gymnasium's own one by one."""

import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

pytest.importorskip("pybullet_envs_gymnasium")
pytest.importorskip("pybullet")

from torchrl_bayessim.physics.conformance import PhysicsTests
from torchrl_bayessim.physics.pybullet import PyBulletPhysics
from torchrl_bayessim.transforms import ApplyPhysics

sys.path.insert(0, str(Path(__file__).parents[1] / "recipes"))
from bullet_hoppers import BulletHoppers


class TestBulletHoppers(PhysicsTests):
    physics = PyBulletPhysics("lateralFriction[floor]", "lateralFriction[foot]")
    low, high = (0.3, 0.3), (0.5, 1.0)

    def make_env(self):
        return BulletHoppers(3, seed=0)


def test_it_is_an_environment_of_torchrl():
    env = BulletHoppers(2, seed=0)
    check_env_specs(env, seed=0)
    env.close()


def test_each_moves_as_gymnasiums_with_its_friction_and_goes_on_where_it_has_fallen():
    friction = torch.tensor([[0.0], [0.3], [1.5]])
    actions = 2 * torch.rand(3, 60, 3, generator=torch.Generator().manual_seed(0)) - 1
    each, fallen = [], False
    for i, value in enumerate(friction.flatten().tolist()):
        one = gymnasium.make("HopperBulletEnv-v0").unwrapped
        observed, _ = one.reset(seed=5 + i)
        floor = one.parts["floor"]
        where = floor.bodies[floor.bodyIndex], floor.bodyPartIndex
        one._p.changeDynamics(*where, lateralFriction=value)
        for action in actions[i].numpy():
            observed, _, over, _, _ = one.step(action)
            fallen |= over
        each.append(observed)
        one.close()
    assert fallen
    physics = ApplyPhysics(PyBulletPhysics(friction="lateralFriction[floor]"))
    env = TransformedEnv(BulletHoppers(3, seed=5), physics)
    td = env.reset(TensorDict(theta=friction, batch_size=[3]))
    for action in actions.unbind(1):
        td = env.step(td.set("action", action))["next"]
    assert not td["done"].any()
    np.testing.assert_allclose(td["observation"].numpy(), np.stack(each), rtol=1e-5, atol=1e-6)
    assert np.abs(each[1] - each[2]).max() > 1e-3
    env.close()


def test_only_those_of_the_mask_are_reset():
    env = BulletHoppers(2, seed=0)
    td = env.rollout(5)[:, -1]["next"]
    before = td["observation"].clone()
    after = env.reset(td.set("_reset", torch.tensor([[True], [False]])))["observation"]
    assert (after[0] != before[0]).any()
    assert torch.equal(after[1], before[1])
    env.close()
