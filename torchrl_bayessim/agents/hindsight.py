"""Hindsight replay: what was reached is what was meant (Andrychowicz et al. 2017, sec. 3).

TorchRL's `HERReplayBuffer` relabels a share of every sample. It finds the ends of episodes by
searching the storage, which fails once the storage is full and mixes environments whose episodes
are unfinished (TorchRL 0.14.1). Here every transition knows how many follow it in its episode, and
goals are counted on from there: round the end of the storage, and never into another episode.
"""

from __future__ import annotations

__all__ = ["GoalReward", "HindsightReplayBuffer", "required"]

from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage
from torchrl.data.replay_buffers import Sampler, Storage
from torchrl.data.replay_buffers.her import HERReplayBuffer

from ..counts import check_count
from ..errors import message
from ..kinds import check_function
from ..scalars import check_number

GoalReward = Callable[[Tensor, Tensor], Tensor]
"""``(achieved (*, G), desired (*, G)) -> reward (*,)``, the environment's own."""

_FOLLOWING, _MOVES = "following", "moves"
_ROUNDING = 0.01  # share of the greatest reward
_OVER = 0.1  # share of the transitions that a sensor's noise or offset may carry over a threshold
_RARE = 50  # transitions of other than the commonest reward, of which half have to agree
_FAR = 1e3  # of any goal, in its unit


class HindsightReplayBuffer(HERReplayBuffer):
    """Replays transitions, a share of them with a goal that their episode reached later.

    A relabelled transition ``t`` of an episode of length ``T`` gets as desired goal what was
    achieved after step ``t' ~ U{t, …, T - 1}``, and the reward for it. All else is as it was: the
    state, the action, and the physics that the episode ran under.

    With ``moving``, relabelled transitions come only from where the achieved goal is yet to change:
    ``‖achieved_t - achieved_T‖ > moving``. An object that is never touched again has reached every
    goal that hindsight could give it, whatever the action was (Manela & Biess 2019,
    https://arxiv.org/abs/1905.05498).

    Draws come from torch's global generator; see :func:`.randomness.isolated`.

    Args:
        reward: The environment's reward as a function of the achieved and the desired goal.
        capacity: Transitions held; the oldest make room.
        share: Of the transitions of a sample that are relabelled, the first ones of it.
        moving: Least distance to the episode's end at which a transition is relabelled, in the
            goal's unit; None to relabel any.

    Raises:
        TypeError: ``capacity`` is no whole number, another argument no number or function.
        ValueError: ``share`` is no probability, ``capacity`` not positive, or ``moving`` negative.

    Example:
        >>> reached = lambda achieved, desired: -((achieved - desired).norm(dim=-1) > 0.1).float()
        >>> buffer = HindsightReplayBuffer(reached, capacity=1000, share=1.0)
        >>> place = torch.arange(4.0).expand(2, 4).unsqueeze(-1)  # two episodes, one step a second
        >>> entries = {"achieved_goal": place, "desired_goal": torch.full((2, 4, 1), 9.0)}
        >>> following = {k: v + (k == "achieved_goal") for k, v in entries.items()}
        >>> following |= {"reward": -torch.ones(2, 4, 1), "done": place == 3}
        >>> buffer.extend(TensorDict(entries | {"next": following}, [2, 4])).shape
        torch.Size([8])
        >>> sample = buffer.sample(100)
        >>> bool((sample["desired_goal"] > sample["achieved_goal"]).all())
        True
    """

    def __init__(
        self, reward: GoalReward, *, capacity: int, share: float = 0.8, moving: float | None = 1e-3
    ) -> None:
        check_number("share of relabelled transitions", share, least=0.0, most=1.0)
        check_count("transitions of capacity", capacity)
        check_function("a reward, a function of the achieved and the desired goal", reward)
        if moving is not None:
            check_number("distance moved", moving, least=0.0)
        self.capacity, self.moving, self._reward = capacity, moving, reward

        def relabelled(sample: TensorDictBase) -> Tensor:
            own = sample["next", "reward"]
            return _rewards(reward, sample).reshape(own.shape).to(own.dtype)

        super().__init__(
            relabelled,
            her_ratio=share,
            strategy="future",
            achieved_goal_key=("next", "achieved_goal"),
            sampler=_MovingFirst(share, moving is not None),
            storage=LazyTensorStorage(capacity),
        )

    def extend(self, episodes: TensorDictBase) -> Tensor:
        """Take in whole episodes and return where they are.

        Args:
            episodes: Batch size ``[N, T]``; each row one or several episodes, the last one ended.

        Raises:
            ValueError: An entry is missing, or goals or rewards are not finite. A row ends within
                an episode, or holds more than fits. The function of the reward gives another one
                than the environment in a tenth of the transitions or in half of those that are not
                rewarded like most, none for some, or no more for a goal that is reached than for
                one far away.
        """
        _check_entries(episodes)
        done = episodes["next", "done"].reshape(episodes.batch_size)
        if not done[:, -1].all():
            rows = (~done[:, -1]).nonzero().flatten().tolist()
            raise ValueError(
                message(
                    "episodes [N, T] that end with their row",
                    f"unfinished ones in rows {rows}",
                    hint="batches that begin with a reset, of as many steps as an episode has",
                )
            )
        if done.numel() > self.capacity:
            raise ValueError(message(f"at most {self.capacity} transitions at once", done.numel()))
        _check_reward(self._reward, episodes)
        _check_goals(self._reward, episodes["next", "achieved_goal"])
        end = _end_of_episode(done)
        time = torch.arange(done.shape[1])
        final = episodes["next", "achieved_goal"].gather(
            1, end.unsqueeze(-1).expand_as(episodes["achieved_goal"])
        )
        distance = torch.linalg.vector_norm(episodes["achieved_goal"] - final, dim=-1)
        marks = {_FOLLOWING: end - time, _MOVES: distance > (self.moving or 0.0)}
        return super().extend(episodes.copy().update(marks).reshape(-1))

    # What TorchRL searches the storage for, each transition knows.

    def _get_episode_ends(self, storage: Storage) -> Tensor:  # noqa: ARG002
        return torch.zeros(1, dtype=torch.long)

    def _get_episode_range(self, idx: Tensor, episode_ends: Tensor) -> tuple[Tensor, Tensor]:  # noqa: ARG002
        return idx, idx + self._storage[:][_FOLLOWING][idx]

    def _sample_goal_indices(self, *args: Any) -> Tensor:
        return super()._sample_goal_indices(*args) % self.capacity

    def contents(self) -> dict[str, Any]:
        """Return what it holds as plain values and tensors, for `restore`."""
        if not len(self):
            return {}
        entries = self._storage[:].flatten_keys(".")
        return {"entries": dict(entries.items()), "cursor": int(self._writer._cursor)}

    def restore(self, contents: Mapping[str, Any]) -> None:
        """Hold what `contents` returned, in the same places.

        Raises:
            ValueError: They are of a full buffer of another capacity, or more than fit.
        """
        entries = contents.get("entries", {})
        count = len(entries[_FOLLOWING]) if entries else 0
        full = count and contents["cursor"] < count  # where it is cut, episodes go round the end
        if count > self.capacity or (full and count != self.capacity):
            expected = f"the transitions of a buffer with capacity={self.capacity}"
            raise ValueError(
                message(expected, f"{count} of {'a full' if full else 'a larger'} one")
            )
        self.empty()
        if entries:
            held = TensorDict(dict(entries), [len(entries[_FOLLOWING])]).unflatten_keys(".")
            super().extend(held)
            self._writer._cursor = contents["cursor"]


class _MovingFirst(Sampler):
    """Uniform indices with replacement, the first ``share`` of them where the goal yet moves."""

    def __init__(self, share: float, moving: bool) -> None:  # noqa: FBT001
        super().__init__()
        self.share, self.moving = share, moving

    def sample(self, storage: Any, batch_size: int) -> tuple[Tensor, dict]:
        if not len(storage):
            hint = "extend it by whole episodes first"
            raise ValueError(
                message("episodes to sample from", "an empty replay buffer", hint=hint)
            )
        held = storage[:]
        index = torch.randint(len(held), (batch_size,))
        first = int(batch_size * self.share)
        if self.moving and first:
            moving = held[_MOVES].nonzero().flatten()
            if len(moving):
                index[:first] = moving[torch.randint(len(moving), (first,))]
        return index, {}

    # without state, but abstract in TorchRL
    def _empty(self) -> None: ...
    def dumps(self, path: Any) -> None: ...
    def loads(self, path: Any) -> None: ...
    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None: ...


def _rewards(reward: GoalReward, steps: TensorDictBase) -> Tensor:
    with torch.no_grad():
        return reward(steps["next", "achieved_goal"], steps["desired_goal"])


def required(steps: TensorDictBase, key: Any, *, of: str) -> Tensor:
    """Return an entry.

    Raises:
        ValueError: There is none: these are not the steps ``of`` what was expected.
    """
    value = steps.get(key, None)
    if value is None:
        available = sorted(map(str, steps.keys(include_nested=True)))
        raise ValueError(message(of, f"no {key!r}", available=available))
    return value


def _check_entries(episodes: TensorDictBase) -> None:
    """Refuse what is no batch of a goal environment's episodes, or holds no numbers."""
    if episodes.ndim != 2:
        raise ValueError(message("episodes of batch size [N, T]", list(episodes.batch_size)))
    goals = "achieved_goal", "desired_goal", ("next", "achieved_goal")
    for key in (*goals, ("next", "reward"), ("next", "done")):
        value = required(episodes, key, of="a goal environment's episodes")
        if not value.isfinite().all():
            raise ValueError(message(f"finite {key!r}", "NaN or infinity in some transitions"))


def _check_reward(reward: GoalReward, episodes: TensorDictBase) -> None:
    """Refuse a reward that is not the environment's: relabelled transitions would not fit others.

    It may differ in some, where rounding or a sensor carries a goal over a threshold.
    """
    own = episodes["next", "reward"]
    found, shape = _rewards(reward, episodes), tuple(episodes.batch_size)
    sizes = shape, (*shape, 1)
    if not isinstance(found, Tensor) or found.shape not in sizes:
        got = tuple(found.shape) if isinstance(found, Tensor) else type(found).__name__
        raise ValueError(message(f"a reward for each transition, a tensor of shape {shape}", got))
    own, found = own.reshape(-1).double(), found.reshape(-1).double()
    tolerance = _ROUNDING * own.abs().max().item() + 1e-6
    usual = own.median()
    rare = ((own - usual).abs() > tolerance) | ((found - usual).abs() > tolerance)
    far = (~((own - found).abs() <= tolerance)).nonzero().flatten()  # not a number is far, too
    if len(far) > _OVER * len(own) or (rare.sum() >= _RARE and len(far) > rare.sum() / 2):
        first = far[0]
        raise ValueError(
            message(
                f"the environment's own reward, {own[first]:g} for a transition",
                f"{found[first]:g}; {len(far)} of {len(own)} differ",
                hint="a reward(achieved_goal, desired_goal) with the environment's sign and "
                "threshold, sparse where the environment's is sparse",
            )
        )


def _check_goals(reward: GoalReward, achieved: Tensor) -> None:
    """Refuse a reward that hindsight could not learn from: what was reached has to be worth more.

    Before a goal is reached the environment's own rewards would not tell.
    """
    with torch.no_grad():
        there, far = (
            reward(achieved, goal).double().mean() for goal in (achieved, achieved + _FAR)
        )
    if not there > far:
        raise ValueError(
            message(
                "a reward that is greater where the goal is reached",
                f"{there:g} there, {far:g} far from it",
                hint="a reward(achieved_goal, desired_goal) with the environment's threshold",
            )
        )


def _end_of_episode(done: Tensor) -> Tensor:
    """Return the step at which the episode of each step ends, ``(N, T) -> (N, T)``."""
    steps = torch.arange(done.shape[1]).expand(done.shape)
    ends = torch.where(done, steps, done.shape[1])
    return ends.flip(1).cummin(1).values.flip(1)
