"""Proximal policy optimisation: a stochastic policy, and one update of it from a batch.

The clipped surrogate of Schulman et al. (2017, eq. 7) with generalised advantage estimation
(Schulman et al., 2016), both from TorchRL. The value is bootstrapped where an episode was cut
off (truncated) and not where it ended (terminated).

Observations are normalised by running statistics inside the networks. They change only at the end
of `PPO.update`, so that a batch is optimised under the statistics that it was collected with.
"""

from __future__ import annotations

__all__ = ["PPO"]

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from ..errors import SimulationError, message
from ..randomness import isolated
from .networks import MLP, actor, width


class PPO:
    """A policy for ``env`` and what improves it.

    The distribution follows the action spec: one-hot or plain categorical for discrete actions, a
    tanh-squashed Gaussian for bounded ones, a Gaussian for unbounded ones, the last two with a
    standard deviation that does not depend on the observation.

    Args:
        env: The environment (or one like it) that batches will come from; only its specs are read.
            Networks are made on its device.
        seed: Seed of the initial parameters and, with the key, of every update.
        observation_keys: What the policy sees; flat vectors, concatenated.
        critic_keys: What the critic sees besides, such as the physics parameters: it is needed in
            training only, so it may know what the robot cannot (Pinto et al., 2018).
        hidden: Width of each hidden layer of policy and critic.
        gamma: Discount per step.
        gae_lambda: Decay of the advantage estimator.
        clip: Largest relative change of a probability that is still rewarded.
        entropy_coeff: Weight of the entropy bonus.
        critic_coeff: Weight of the critic's loss.
        learning_rate: Of Adam, at progress 0.
        final_learning_rate: Of Adam, at progress 1; linear in between.
        epochs: Passes over a batch.
        minibatch_size: Frames per gradient step.
        max_grad_norm: Gradients are scaled down to this norm.
        initial_std: Standard deviation of a continuous policy at the start, in units of half the
            action range for bounded actions.
        reward_scale: Rewards are multiplied by it, for the critic's sake: returns of the order
            of 10 are learned fastest.

    Attributes:
        policy: Reads the observation keys, writes ``action`` and ``action_log_prob``; hand it to a
            collector. It samples unless `set_exploration_type` says otherwise.
        critic: Reads observation and critic keys, writes ``state_value``.
        settings: What updates depend on; a loop refuses the checkpoint of other ones.

    Example:
        >>> from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
        >>> env = CartPoleEnv(8, max_steps=500)
        >>> ppo = PPO(env, seed=0, minibatch_size=64)
        >>> with torch.no_grad():
        ...     batch = env.rollout(32, ppo.policy, break_when_any_done=False)
        >>> sorted(ppo.update(batch, key=("round", 0)))[-3:]
        ['loss_critic', 'loss_entropy', 'loss_objective']
    """

    def __init__(
        self,
        env: EnvBase,
        *,
        seed: int = 0,
        observation_keys: Sequence[str] = ("observation",),
        critic_keys: Sequence[str] = (),
        hidden: Sequence[int] = (64, 64),
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip: float = 0.2,
        entropy_coeff: float = 0.0,
        critic_coeff: float = 0.5,
        learning_rate: float = 1e-3,
        final_learning_rate: float = 1e-4,
        epochs: int = 10,
        minibatch_size: int = 512,
        max_grad_norm: float = 0.5,
        initial_std: float = 0.6,
        reward_scale: float = 1.0,
    ) -> None:
        self.seed, self.reward_scale = seed, reward_scale
        self.learning_rate, self.final_learning_rate = learning_rate, final_learning_rate
        self.epochs, self.minibatch_size = epochs, minibatch_size
        self.max_grad_norm = max_grad_norm
        self.settings: dict[str, Any] = {
            "seed": seed,
            "observation_keys": list(observation_keys),
            "critic_keys": list(critic_keys),
            "hidden": list(hidden),
            "gamma": gamma,
            "gae_lambda": gae_lambda,
            "clip": clip,
            "entropy_coeff": entropy_coeff,
            "critic_coeff": critic_coeff,
            "learning_rate": learning_rate,
            "final_learning_rate": final_learning_rate,
            "epochs": epochs,
            "minibatch_size": minibatch_size,
            "max_grad_norm": max_grad_norm,
            "reward_scale": reward_scale,
        }
        seen: list[Any] = list(observation_keys)
        known: list[Any] = [*seen, *critic_keys]
        with isolated(seed, "ppo parameters"):
            self.policy = actor(env, seen, hidden=hidden, initial_std=initial_std)
            value = MLP(width(env, known), hidden, 1, gain=1.0)
            self.critic = TensorDictModule(value, in_keys=known, out_keys=["state_value"])
        self._networks = nn.ModuleDict({"policy": self.policy, "critic": self.critic})
        self._networks.to(env.device)
        self._loss = ClipPPOLoss(
            self.policy,
            self.critic,
            clip_epsilon=clip,
            entropy_coeff=entropy_coeff,
            critic_coeff=critic_coeff,
            normalize_advantage=True,
            functional=False,
        )
        self._advantage = GAE(gamma=gamma, lmbda=gae_lambda, value_network=self.critic)
        self._optimizer = torch.optim.Adam(
            self._networks.parameters(), lr=learning_rate, eps=1e-5, fused=True
        )
        self._batch_keys = [
            *known,
            "action",
            "action_log_prob",
            *(("next", key) for key in (*known, "reward", "done", "terminated")),
        ]

    def update(
        self, batch: TensorDictBase, *, key: Sequence[int | str], progress: float = 0.0
    ) -> dict[str, float]:
        """Improve policy and critic from ``batch`` and return diagnostics.

        Args:
            batch: What a collector brings: batch size ``[N, T]``, time last, collected with
                `policy`. A row may hold several episodes. It is not changed.
            key: What this update is, such as ``(round, iteration)``: the order of the minibatches
                depends on it and on the seed alone.
            progress: Share of the training that is over, for the learning rate.

        Returns:
            Means over all gradient steps of the losses, the entropy, the clipped share, the
            approximate KL divergence and the gradient's norm; the learning rate.

        Raises:
            ValueError: The batch lacks an entry or has no time dimension.
            SimulationError: A value in the batch, the loss or its gradient is not finite. Policy,
                critic and optimiser are then as they were before the update.
        """
        self._check(batch)
        before = copy.deepcopy(self.state_dict())
        try:
            with isolated(self.seed, "ppo update", *key):
                return self._optimise(batch.select(*self._batch_keys), progress)
        except SimulationError:
            self.load_state_dict(before)
            raise

    def state_dict(self) -> dict[str, Any]:
        """Return parameters, running statistics and optimiser state, for `load_state_dict`."""
        return {
            "networks": dict(self._networks.state_dict()),
            "optimizer": self._optimizer.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from ``state``."""
        self._networks.load_state_dict(state["networks"])
        self._optimizer.load_state_dict(state["optimizer"])

    def _check(self, batch: TensorDictBase) -> None:
        if batch.ndim < 2:
            raise ValueError(message("a batch of size [N, T]", tuple(batch.batch_size)))
        for key in self._batch_keys:
            value = batch.get(key, None)
            if value is None:
                raise ValueError(
                    message(
                        "a batch collected with this policy",
                        f"no entry {key!r}",
                        available=sorted(map(str, batch.keys(include_nested=True))),
                    )
                )
            if value.is_floating_point() and not value.isfinite().all():
                count = int((~value.isfinite()).reshape(batch.numel(), -1).any(-1).sum())
                raise SimulationError(
                    message(f"finite {key!r} in the batch", f"{count} frames that are not")
                )

    def _optimise(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        rate = self.learning_rate
        rate += min(max(progress, 0.0), 1.0) * (self.final_learning_rate - rate)
        for group in self._optimizer.param_groups:
            group["lr"] = rate
        reward = batch["next", "reward"] * self.reward_scale
        with torch.no_grad():
            self._advantage(batch.set(("next", "reward"), reward))
        frames = batch.exclude("next").reshape(-1)
        sums: dict[str, Tensor] = {}
        # As many minibatches of one size as fit; what is left over waits for the next epoch.
        size = min(self.minibatch_size, len(frames))
        steps = self.epochs * (len(frames) // size)
        for _ in range(self.epochs):
            for rows in torch.randperm(len(frames)).split(size):
                if len(rows) == size:
                    for name, value in self._gradient_step(frames[rows]).items():
                        sums[name] = sums.get(name, 0.0) + value
        for network in (self.policy, self.critic):
            for module in network.modules():
                if isinstance(module, MLP):
                    module.normalizer.observe(
                        torch.cat([frames.get(key) for key in network.in_keys], -1)
                    )
        means = {name: float(value) / steps for name, value in sums.items()}
        return means | {"learning_rate": rate}

    def _gradient_step(self, frames: TensorDictBase) -> dict[str, Tensor]:
        losses = self._loss(frames)
        loss = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
        self._optimizer.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self._networks.parameters(), self.max_grad_norm)
        if not (loss.isfinite() & norm.isfinite()):
            raise SimulationError(
                message(
                    "a finite PPO loss and gradient",
                    f"loss {loss.item()}, gradient norm {norm.item()}",
                    hint="a smaller learning rate, or rewards and observations of a smaller scale",
                )
            )
        self._optimizer.step()
        return {name: losses[name].detach() for name in _REPORTED} | {"gradient_norm": norm}


_REPORTED = (
    "loss_objective",
    "loss_critic",
    "loss_entropy",
    "entropy",
    "kl_approx",
    "clip_fraction",
)
