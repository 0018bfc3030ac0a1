"""DDPG with hindsight replay for goals: a deterministic policy, improved from what it reached.

DDPG (Lillicrap et al. 2016) or, by one option, TD3 (Fujimoto et al. 2018), with TorchRL's losses;
hindsight and the defaults follow Andrychowicz et al. (2017) and Plappert et al. (2018,
https://arxiv.org/abs/1802.09464) but for what is said at the arguments.
"""

from __future__ import annotations

__all__ = ["DDPG"]

import copy
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import EnvBase

from ..counts import check_count
from ..errors import SimulationError, message
from ..kinds import check_choice, check_keys, check_kind
from ..randomness import isolated
from ..scalars import check_number
from .actor_critic_losses import BoundedDDPGLoss, BoundedTD3Loss, SoftUpdateAtOnce
from .goal_networks import GOAL_KEYS, Actor, Critic, GoalState, action_bounds, goal_policy
from .hindsight import GoalReward, HindsightReplayBuffer, required
from .owed_updates import OwedUpdates
from .replayed_batches import ReplayedBatches

_LOSSES = {"ddpg": BoundedDDPGLoss, "td3": BoundedTD3Loss}
_SHAPING = ("algorithm", "hidden", "critic_keys", "capacity")  # what a state fits into
_BEYOND = 10.0  # times the range of its targets that a critic is off when it has blown up


class DDPG:
    """A policy for the goals of ``env`` and what improves it.

    Actions are ``π(observation, desired goal)`` in the bounds of the action spec. While exploring
    (`ExplorationType.RANDOM`), a share of actions is uniform and the others get Gaussian noise.

    Args:
        env: The environment (or one like it) that batches will come from; only its specs are read.
            It observes ``observation``, ``achieved_goal`` and ``desired_goal``.
        reward: Its reward, a function of the achieved and the desired goal; compared with the
            rewards of every batch.
        seed: Seed of the initial parameters and, with the key, of every update.
        algorithm: ``ddpg`` or ``td3`` (two critics, target noise, a delayed actor).
        actor_every: Updates of the critics per update of the actor; None for 1, or 2 of ``td3``.
            Target networks follow at every update.
        critic_keys: What the critic sees besides, such as the physics parameters ``theta``: it is
            needed in training only, so it may know what the robot cannot (Pinto et al., 2018).
        hidden: Width of each hidden layer of actor and critics.
        gamma: Discount per step, below 1: else returns have no bound.
        rewards: Least and greatest reward; targets are clamped to the returns that they allow.
        learning_rate: Of both Adams.
        final_learning_rate: At progress 1; linear from ``decay_from`` on.
        decay_from: Progress until which the learning rate is constant.
        tau: Share of the networks that flows into the target networks at each update.
        batch_size: Transitions per update.
        updates_per_frame: Updates per transition that comes in.
        capacity: Transitions in the replay buffer.
        relabelled: Share of relabelled transitions.
        moving: See `HindsightReplayBuffer`.
        action_l2: Weight of the mean squared action in the actor's loss.
        random_share: Share of uniformly random actions while exploring.
        noise: Standard deviation of the noise on the others, in units of half the action range.

    Attributes:
        policy: Reads observation and desired goal, writes ``action``; hand it to a collector. It
            explores unless `set_exploration_type` says otherwise.
        name: ``DDPG+HER`` or ``TD3+HER``, for tables, and what is unusual about its actor
            or critic.
        buffer: The replay buffer.
        settings: What updates depend on; a loop refuses the checkpoint of other ones.

    Raises:
        ValueError: A goal key is not observed, the replay buffer is smaller than one batch, the
            environment is on a GPU, or there is no such algorithm.
            A number is out of its bounds.
        TypeError: The actions are not bounded, or an argument is of another kind.

    Example:
        >>> from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
        >>> from torchrl_bayessim.envs.tasks.fetch import goal_reward
        >>> env = BatchedMujocoEnv("FetchReach-v4", 4, threads=1)
        >>> ddpg = DDPG(env, goal_reward, batch_size=32)
        >>> with torch.no_grad():
        ...     episodes = env.rollout(50, ddpg.policy)
        >>> sorted(ddpg.update(episodes, key=("round", 0)))
        ['learning_rate', 'loss_actor', 'loss_critic', 'updates']
    """

    def __init__(
        self,
        env: EnvBase,
        reward: GoalReward,
        *,
        seed: int = 0,
        algorithm: str = "ddpg",
        actor_every: int | None = None,
        critic_keys: Sequence[str] = (),
        hidden: Sequence[int] = (256, 256, 256),
        gamma: float = 0.98,
        rewards: tuple[float, float] = (-1.0, 0.0),
        learning_rate: float = 1e-3,
        final_learning_rate: float = 1e-4,
        decay_from: float = 0.6,
        tau: float = 0.005,
        batch_size: int = 256,
        updates_per_frame: float = 0.2,
        capacity: int = 1_000_000,
        relabelled: float = 0.8,
        moving: float | None = 1e-3,
        action_l2: float = 1.0,
        random_share: float = 0.3,
        noise: float = 0.2,
    ) -> None:
        self.settings: dict[str, Any] = {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in locals().items()
            if name not in ("self", "env", "reward")
        }
        _check_environment(env)
        check_choice("an algorithm", algorithm, _LOSSES)
        check_keys("critic_keys", critic_keys)
        check_kind("widths of hidden layers, a sequence", hidden, tuple, list)
        for width in hidden:
            check_count("units of a hidden layer", width)
        check_count("transitions per batch", batch_size)
        usual = 1 + (algorithm == "td3")
        every = usual if actor_every is None else actor_every
        check_count("updates per update of the actor", every)
        check_count("transitions of capacity", capacity)
        shares = {"tau": tau, "decay_from": decay_from, "random_share": random_share}
        for name, value in shares.items():
            check_number(name, value, least=0.0, most=1.0)
        check_number("gamma", gamma, least=0.0, below=1.0)
        _check_rewards(rewards)
        sizes = {"final_learning_rate": final_learning_rate, "action_l2": action_l2, "noise": noise}
        for name, value in {**sizes, "updates_per_frame": updates_per_frame}.items():
            check_number(name, value, least=0.0)
        check_number("learning_rate", learning_rate, above=0.0)
        if capacity < batch_size:
            raise ValueError(
                message(f"a replay buffer of at least one batch of {batch_size}", capacity)
            )
        self.name = _name(algorithm, None if every == usual else every, critic_keys)
        self.batch_size = batch_size
        self.updates_per_frame, self._actor_every = updates_per_frame, every
        self._rates = learning_rate, final_learning_rate, decay_from
        self.state = GoalState(env, critic_keys)
        self._bounds = action_bounds(env)
        size, wide = len(self._bounds[0]), self.state.seen + self.state.hidden_width
        with isolated(seed, "ddpg parameters"):
            actor = Actor(self.state.seen, hidden, size)
            critic = Critic(wide + size, hidden)
            self._loss = _LOSSES[algorithm](
                TensorDictModule(actor, ["state"], ["action"]),
                TensorDictModule(critic, ["state", "action"], ["state_action_value"]),
                gamma=gamma,
                rewards=rewards,
                action_l2=action_l2,
            )
        self.policy = goal_policy(env, self.state, actor, noise=noise, random_share=random_share)
        self.buffer = HindsightReplayBuffer(
            reward, capacity=capacity, share=relabelled, moving=moving
        )
        self._replayed = ReplayedBatches(
            self.buffer, self.state, self._bounds, batch_size=batch_size, seed=seed
        )
        low, high = self._loss.bounds
        self._most = (_BEYOND * (high - low)) ** 2
        self._targets = SoftUpdateAtOnce(self._loss, tau=tau)
        self._owed: tuple[OwedUpdates, dict[str, Any]] | None = None
        self._report: dict[str, float] = {}
        self._optimizers = {
            part: torch.optim.Adam(self._parameters(part), lr=learning_rate, fused=True)
            for part in ("actor", "critic")
        }

    def update(
        self, batch: TensorDictBase, *, key: Sequence[int | str], progress: float = 0.0
    ) -> dict[str, float]:
        """Take in ``batch``, improve actor and critics from the replay buffer, report.

        Args:
            batch: What a collector brings: batch size ``[N, T]``, rows of whole episodes.
            key: What this update is, such as ``(round, iteration)``: what is replayed depends on
                it and on the seed alone.
            progress: Share of the training that is over, for the learning rate.

        Returns:
            Means over the updates of the losses; their number; the learning rate.

        Raises:
            ValueError: The batch lacks an entry, its rows are no whole episodes, its rewards are
                not those of ``reward`` or beyond ``rewards``, the replay buffer would hold less
                than one batch, or no update is due for so few transitions.
            SimulationError: A value in the batch, a loss or a parameter is not finite, or the
                critic is off by ten times the range of its targets. The networks are then as they
                were before.
        """
        self.begin(batch, key=key, progress=progress)
        return self.finish()

    def begin(
        self, batch: TensorDictBase, *, key: Sequence[int | str], progress: float = 0.0
    ) -> None:
        """Take in ``batch`` as `update` does; `work` and `finish` make the updates.

        Updates that are still owed are made before.
        """
        self.finish()
        self._check(batch)
        updates = self._due(batch.numel())
        kept = batch.select(*self.kept_keys).detach()  # actions may come with the policy's graph
        before = copy.deepcopy(self._learned())
        self.buffer.extend(kept)
        self.state.observe(kept)
        self._report = {"loss_actor": 0.0, "loss_critic": 0.0, "updates": float(updates)}
        self._report["learning_rate"] = self._set_learning_rate(progress)
        self._owed = OwedUpdates(self._updates(updates, tuple(key)), updates), before

    def work(self, share: float) -> None:
        """Make updates until this share of those that `begin` owed is made.

        They draw nothing from global generators, so this may happen in the midst of what does.
        """
        if self._owed is not None:
            self._owed[0].work(share)

    def finish(self) -> dict[str, float]:
        """Make the updates that are left, and return what `update` does; empty if none was owed.

        Raises:
            SimulationError: As `update`.
        """
        if self._owed is None:
            return {}
        (owed, before), self._owed = self._owed, None
        try:
            owed.finish()
            self._check_learned()
        except SimulationError:
            self._learn(before)
            raise
        return self._report

    def _due(self, frames: int) -> int:
        """Return the updates for so many new transitions."""
        held = min(len(self.buffer) + frames, self.buffer.capacity)
        if held < self.batch_size:
            expected = f"a replay buffer that holds at least one batch of {self.batch_size}"
            hint = "more environments, or a smaller batch_size"
            raise ValueError(message(expected, held, hint=hint))
        updates = self.updates_per_frame * frames
        if 0 < updates <= 0.5:
            expected = f"at least one update per batch of {frames} transitions"
            hint = "more transitions per batch, or larger updates_per_frame"
            raise ValueError(message(expected, updates, hint=hint))
        return round(updates)

    def _check(self, batch: TensorDictBase) -> None:
        for key in self.kept_keys:
            value = required(batch, key, of="a batch of a goal environment")
            if value.is_floating_point() and not value.isfinite().all():
                raise SimulationError(
                    message(f"finite {key!r} in the batch", "NaN or infinity in some frames")
                )
        low, high = self.settings["rewards"]
        given = batch["next", "reward"]
        if given.min() < low or given.max() > high:
            span = given.min().item(), given.max().item()
            expected = f"rewards within the given {low, high}, by which targets are bounded"
            hint = "rewards=(least, greatest) of all that the reward function can give"
            raise ValueError(message(expected, span, hint=hint))

    def _check_learned(self) -> None:
        """Refuse what no loss has seen: the gradient of a part's last update may not be finite."""
        moments = [
            tensor
            for optimizer in self._optimizers.values()
            for state in optimizer.state.values()
            for tensor in state.values()
        ]  # infinite ones leave parameters finite, and never again move them
        if not all(tensor.isfinite().all() for tensor in [*self._tensors().values(), *moments]):
            raise SimulationError(
                message(
                    "finite parameters after the updates",
                    "NaN or infinity",
                    hint="a smaller learning rate, or rewards within the given range",
                )
            )

    @property
    def kept_keys(self) -> list[Any]:
        """The entries of a batch that go into the replay buffer."""
        states = [*GOAL_KEYS, *self.state.critic_keys]
        following = [("next", key) for key in (*states, "reward", "done", "terminated")]
        return [*states, "action", *following]

    def _updates(self, count: int, key: tuple[int | str, ...]) -> Iterator[None]:
        """Make an update at each turn; the report has the means of their losses."""
        sums = {"actor": 0.0, "critic": 0.0}
        for index, steps in enumerate(self._replayed(count, key=key)):
            with torch.enable_grad():  # which collectors switch off
                sums["critic"] += self._step("critic", self._loss.critic_loss(steps))
                if (index + 1) % self._actor_every == 0:
                    sums["actor"] += self._step("actor", self._loss.policy_loss(steps))
            self._targets.step()
            made = {"actor": (index + 1) // self._actor_every, "critic": index + 1}
            self._report |= {f"loss_{part}": sums[part] / max(1, made[part]) for part in sums}
            yield

    def _step(self, part: str, loss: Tensor) -> float:
        value = loss.item()
        finite = math.isfinite(value)
        if not finite or (part == "critic" and value > self._most):
            kind = f"a loss below {self._most:.3g}" if finite else "a finite loss"
            hint = "a smaller learning rate, or rewards within the given range"
            raise SimulationError(message(f"{kind} of the {part}", value, hint=hint))
        self._optimizers[part].zero_grad()
        loss.backward()
        self._optimizers[part].step()
        return value

    def _set_learning_rate(self, progress: float) -> float:
        first, last, start = self._rates
        over = min(max((progress - start) / max(1 - start, 1e-9), 0.0), 1.0)
        rate = first + over * (last - first)
        for optimizer in self._optimizers.values():
            for group in optimizer.param_groups:
                group["lr"] = rate
        return rate

    def _parameters(self, part: str) -> list[nn.Parameter]:
        own = {"actor": "actor_network_params", "critic": "value_network_params"}[part]
        return [p for name, p in self._loss.named_parameters() if own in name and p.requires_grad]

    def state_dict(self) -> dict[str, Any]:
        """Return networks, statistics, optimisers and replay buffer, for `load_state_dict`.

        Updates that are still owed are made before.
        """
        self.finish()
        made_by = {"settings": {name: self.settings[name] for name in _SHAPING}}
        return self._learned() | {"buffer": self.buffer.contents()} | made_by

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from ``state``.

        Raises:
            ValueError: It is of a learner with other networks, or another replay buffer.
        """
        made_by = state.get("settings", {})  # which older states do not say
        for name in _SHAPING:
            own = self.settings[name]
            if made_by.get(name, own) != own:
                raise ValueError(message(f"a state of DDPG with {name}={own!r}", made_by[name]))
        self._owed = None
        self._learn(state)
        self.buffer.restore(state["buffer"])

    def _learned(self) -> dict[str, Any]:
        return {
            "networks": self._tensors(),
            "state": dict(self.state.state_dict()),
            "optimizers": {part: o.state_dict() for part, o in self._optimizers.items()},
        }

    def _learn(self, state: Mapping[str, Any]) -> None:
        with torch.no_grad():
            for name, tensor in self._tensors().items():
                tensor.copy_(state["networks"][name])
        self.state.load_state_dict(state["state"])
        for part, optimizer in self._optimizers.items():
            optimizer.load_state_dict(state["optimizers"][part])

    def _tensors(self) -> dict[str, Tensor]:
        """Return the parameters of networks and target networks, in place."""
        sources = dict(self._loss.named_parameters()) | dict(self._loss.named_buffers())
        return {name: value.data for name, value in sources.items() if "network_params" in name}


def _name(algorithm: str, actor_every: int | None, critic_keys: Sequence[str]) -> str:
    """Return what tables call it, with an actor's delay that is not the algorithm's own."""
    parts = [f"{algorithm.upper()}+HER"]
    if actor_every is not None:
        often = f"once in {actor_every} updates" if actor_every > 1 else "at every update"
        parts.append(f"actor {often}")
    if critic_keys:
        parts.append(f"critic sees {' and '.join(map(str, critic_keys))}")
    return ", ".join(parts)


def _check_environment(env: object) -> None:
    check_kind("a TorchRL environment", env, EnvBase)
    assert isinstance(env, EnvBase)
    if env.device is not None and env.device.type != "cpu":
        expected = "an environment on the CPU, where transitions are kept, relabelled and learned"
        raise ValueError(
            message(expected, f"one on {env.device}", hint='make it with device="cpu", or PPO')
        )


def _check_rewards(rewards: Any) -> None:
    expected = "rewards=(least, greatest), two numbers"
    check_kind(expected, rewards, tuple, list)
    if len(rewards) != 2:
        raise ValueError(message(expected, rewards))
    for name, value in zip(("least reward", "greatest reward"), rewards, strict=True):
        check_number(name, value)
    low, high = rewards
    if low > high:
        raise ValueError(message(expected, rewards, hint=f"rewards={high, low}"))
    if low == high:
        raise ValueError(message(f"{expected} of which one is greater", rewards))
