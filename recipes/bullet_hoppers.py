"""PyBullet's Hoppers side by side, each in a world of its own: one step of TorchRL for all."""

from __future__ import annotations

from importlib import import_module

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase


class BulletHoppers(EnvBase):
    """``HopperBulletEnv-v0``, as many as asked, that go on where one has fallen.

    A wrapped environment of its own takes TorchRL three times as long as it takes PyBullet.

    Args:
        environments: How many.
        seed: Of the first; each further one has the next.
    """

    def __init__(self, environments: int, *, seed: int) -> None:
        super().__init__(batch_size=[environments])
        import_module("pybullet_envs_gymnasium")
        self.simulators = [
            gymnasium.make("HopperBulletEnv-v0").unwrapped for _ in range(environments)
        ]
        one, n = self.simulators[0], environments
        low, high = (torch.as_tensor(x) for x in (one.action_space.low, one.action_space.high))  # pyright: ignore[reportAttributeAccessIssue]
        width = one.observation_space.shape[0]  # pyright: ignore[reportOptionalSubscript]
        self.action_spec = Bounded(low.expand(n, -1), high.expand(n, -1), (n, *low.shape))
        self.observation_spec = Composite(observation=Unbounded((n, width)), shape=(n,))
        self.reward_spec = Unbounded((n, 1))
        self.set_seed(seed)

    def _set_seed(self, seed: int | None) -> None:
        self._seeds = [None if seed is None else seed + i for i in range(len(self.simulators))]

    def _reset(self, tensordict: TensorDictBase | None, **_: object) -> TensorDictBase:
        again = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones(self.batch_size) if again is None else again.reshape(-1)
        if tensordict is None or "observation" not in tensordict:
            observed = self.observation_spec.zero()["observation"]
        else:
            observed = tensordict["observation"].clone()
        for i in mask.nonzero().flatten().tolist():
            first, _ = self.simulators[i].reset(seed=self._seeds[i])
            self._seeds[i] = None
            observed[i] = torch.as_tensor(first)
        return TensorDict(observation=observed, batch_size=self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actions = tensordict["action"].numpy()
        steps = [one.step(action) for one, action in zip(self.simulators, actions, strict=True)]
        observed = torch.from_numpy(np.stack([step[0] for step in steps]).astype(np.float32))
        reward = torch.tensor([[float(step[1])] for step in steps])
        over: Tensor = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return TensorDict(
            observation=observed,
            reward=reward,
            done=over,
            terminated=over.clone(),
            batch_size=self.batch_size,
        )

    def close(self, *, raise_if_closed: bool = True) -> None:
        """End the worlds."""
        for one in self.simulators:
            one.close()
        super().close(raise_if_closed=raise_if_closed)
