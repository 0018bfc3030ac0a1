"""What the classic-control systems share: parameters per environment, resets, limits, checks.

A system is three functions on batched tensors (initial state, step, observation) over a state of
shape ``(N, S)`` and parameters of shape ``(N,)``. Everything else is here, once.

Reset noise is a hash of (seed, environment, episode), so it does not depend on which
environments happen to reset together, nor on ``N``.
"""

from __future__ import annotations

__all__ = ["ClassicControlEnv"]

import abc
from collections.abc import Mapping
from typing import ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, OneHot, Unbounded
from torchrl.data.tensor_specs import TensorSpec
from torchrl.envs import EnvBase

from ...errors import message
from ...randomness import seed_from


class ClassicControlEnv(EnvBase):
    """Base of the batched classic-control environments; a subclass fills in one system.

    An environment whose state is no longer finite terminates with the observation it had before, a
    reward of zero, and ``diverged`` set; the others do not notice.

    Args:
        num_envs: Number of environments ``N``; the batch size is ``[N]``.
        seed: Seed of the reset noise: same seed, same run.
        max_steps: Steps after which an episode is truncated, or None for no limit.
        dtype: Floating-point type of the state, the parameters and the observation.
        device: Where the tensors live.

    Attributes:
        defaults: Gymnasium's value of every parameter, by gymnasium's name.
        positive: The parameters that something is divided by.
    """

    defaults: ClassVar[dict[str, float]]
    positive: ClassVar[frozenset[str]]
    _state_size: ClassVar[int]
    _observation_size: ClassVar[int]

    def __init__(
        self,
        num_envs: int,
        *,
        seed: int = 0,
        max_steps: int | None = None,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        for name, value in {"num_envs": num_envs, "max_steps": max_steps}.items():
            if value is not None and (not isinstance(value, int) or value < 1):
                raise ValueError(message(f"{name} to be a positive integer", value))
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.max_steps = max_steps
        self._float = dtype
        self._make_specs()
        self._parameters_now = {
            name: torch.full((num_envs,), value, dtype=dtype, device=device)
            for name, value in self.defaults.items()
        }
        self._couple()
        self._environments = torch.arange(num_envs, device=device)
        self._state = torch.zeros(num_envs, self._state_size, dtype=dtype, device=device)
        self._elapsed = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self._never = torch.zeros(num_envs, 1, dtype=torch.bool, device=device)
        self._set_seed(seed)

    # What a subclass provides.

    @abc.abstractmethod
    def _action_spec(self) -> TensorSpec:
        """Return the spec of a batch of actions."""

    @abc.abstractmethod
    def _couple(self) -> None:
        """Recompute what follows from the parameters; called after every write."""

    @abc.abstractmethod
    def _initial_state(self, uniform: Tensor) -> Tensor:
        """Map draws from U[0, 1) of shape ``(n, S)`` to initial states ``(n, S)``."""

    @abc.abstractmethod
    def _advance(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return next state ``(N, S)``, reward ``(N,)`` and terminated ``(N,)``.

        ``action`` has shape ``(N,)``: the index of a discrete action or the continuous value.
        """

    @abc.abstractmethod
    def _observe(self, state: Tensor) -> Tensor:
        """Return the observation of ``state``; never ``state`` itself."""

    # Parameters and state.

    @property
    def parameters(self) -> dict[str, Tensor]:  # a tensor per name; the env has no weights
        """Copies of the parameters in force, name to tensor of shape ``(N,)``."""
        return {name: value.clone() for name, value in self._parameters_now.items()}

    def set_parameters(self, values: Mapping[str, Tensor], mask: Tensor) -> None:
        """Write ``values`` into the environments in ``mask`` and into no others.

        Args:
            values: Name to absolute values, each of shape ``(N,)``, in SI units.
            mask: Which environments to write, boolean, shape ``(N,)``.

        Raises:
            KeyError: A name that this system does not have.
            ValueError: A wrong shape, a value that is not finite, or zero or less where
                something is divided by it. Nothing is written then.
        """
        shape = self.batch_size
        if mask.shape != shape or mask.dtype != torch.bool:
            got = f"{mask.dtype} of shape {tuple(mask.shape)}"
            raise ValueError(message(f"mask to be torch.bool of shape {tuple(shape)}", got))
        mask, written = mask.to(self._state.device), {}
        for name, value in values.items():
            if name not in self._parameters_now:
                raise KeyError(
                    message(f"a parameter of {type(self).__name__}", name, available=self.defaults)
                )
            if value.shape != shape:
                raise ValueError(
                    message(f"{name} to have shape {tuple(shape)}", tuple(value.shape))
                )
            value = value.to(mask.device)  # noqa: PLW2901
            usable = value.isfinite() & ((value > 0) | (name not in self.positive))
            if not (usable | ~mask).all():
                kind = "finite and positive" if name in self.positive else "finite"
                wrong = value[mask & ~usable][:5].tolist()
                raise ValueError(message(f"{name} to be {kind} in every environment", wrong))
            written[name] = torch.where(mask, value.to(self._float), self._parameters_now[name])
        self._parameters_now.update(written)
        self._couple()

    @property
    def state(self) -> Tensor:
        """The state that the next step starts from, shape ``(N, S)``; assign to set it."""
        return self._state.clone()

    @state.setter
    def state(self, value: Tensor) -> None:
        if value.shape != self._state.shape or not value.isfinite().all():
            raise ValueError(
                message(f"a finite state of shape {tuple(self._state.shape)}", tuple(value.shape))
            )
        self._state = value.to(self._state).clone()

    # What TorchRL calls.

    def _make_specs(self) -> None:
        n, device = self.batch_size[0], self.device
        shape, column = torch.Size([n, self._observation_size]), torch.Size([n, 1])
        self.observation_spec = Composite(
            observation=Unbounded(shape, dtype=self._float, device=device),
            diverged=Categorical(2, shape=column, dtype=torch.bool, device=device),
            shape=(n,),
        )
        self.action_spec = self._action_spec()
        self.reward_spec = Unbounded(column, dtype=self._float, device=device)
        flag = Categorical(2, shape=column, dtype=torch.bool, device=device)
        self.done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=(n,)
        )

    def _set_seed(self, seed: int | None) -> None:
        self._seed = seed_from(0 if seed is None else seed, "classic control reset")
        self._episodes = torch.zeros_like(self._environments)

    def _reset(self, tensordict: TensorDictBase | None, **_: object) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        rows = self._environments if mask is None else mask.view(-1).nonzero().squeeze(-1)
        episodes = self._episodes[rows]
        uniform = _hashed_uniform(self._seed, rows, episodes, self._state_size)
        self._state = self._state.index_copy(
            0, rows, self._initial_state(uniform.to(self._float)).to(self._float)
        )
        self._episodes[rows] = episodes + 1
        self._elapsed[rows] = 0
        return self._output(self._never, self._never)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = self._decode(tensordict.get("action"))
        state, reward, terminated = self._advance(self._state, action)
        diverged = self._never
        if not torch.isfinite(state.sum()):
            diverged = ~state.isfinite().all(-1, keepdim=True)
            state = torch.where(diverged, self._state, state)
            reward = reward.masked_fill(diverged[:, 0], 0.0)
            terminated = terminated | diverged[:, 0]
        self._state = state
        self._elapsed += 1
        truncated = self._never
        if self.max_steps is not None:
            truncated = (self._elapsed >= self.max_steps)[:, None]
        output = self._output(terminated[:, None], truncated)
        return output.set("reward", reward[:, None]).set("diverged", diverged.clone())

    def _output(self, terminated: Tensor, truncated: Tensor) -> TensorDictBase:
        values = {
            "observation": self._observe(self._state),
            "terminated": terminated.clone(),
            "truncated": truncated.clone(),
            "done": terminated | truncated,
            "diverged": self._never.clone(),
        }
        return TensorDict(values, batch_size=self.batch_size, device=self.device)

    def _decode(self, action: Tensor) -> Tensor:
        """Return actions of shape ``(N,)``, or raise for those outside the action space."""
        spec = self.action_spec
        if action.shape != spec.shape:
            raise ValueError(message(f"actions of shape {tuple(spec.shape)}", tuple(action.shape)))
        value = action
        if isinstance(spec, OneHot):
            valid = (action.count_nonzero(-1) == 1) & (action.amax(-1) == 1)
            value, kind = action.to(torch.uint8).argmax(-1), "one-hot actions"
        elif isinstance(spec, Categorical):
            valid, kind = (action >= 0) & (action < spec.n), f"actions from 0 to {spec.n - 1}"
        else:
            # Beyond the bounds the actuator saturates, in `_advance`, as it does in gymnasium.
            valid, kind = action.isfinite(), "finite actions"
        if not valid.all():
            rows = (~valid.view(self.batch_size[0])).nonzero().squeeze(-1)[:5]
            got = f"{action[rows].tolist()} in environments {rows.tolist()}"
            raise ValueError(message(kind, got))
        return value.reshape(self.batch_size)


def discrete(
    n: int, num_envs: int, *, categorical: bool, device: torch.device | None
) -> OneHot | Categorical:
    """Return the spec of ``num_envs`` choices among ``n``: one-hot as in `GymEnv`, or indices."""
    if categorical:
        return Categorical(n, shape=torch.Size([num_envs]), dtype=torch.int64, device=device)
    return OneHot(n, shape=torch.Size([num_envs, n]), dtype=torch.int64, device=device)


def _hashed_uniform(seed: int, rows: Tensor, episodes: Tensor, columns: int) -> Tensor:
    """Return U[0, 1) of shape ``(n, columns)`` in float64: a function of its arguments alone.

    Each value is SplitMix64's finaliser (Steele, Lea & Flood, 2014) of an affine counter; int64
    multiplication wraps, which is what the hash wants.
    """
    counter = _mix(_mix(rows + seed) + episodes)[:, None]
    counter = counter + torch.arange(1, columns + 1, device=rows.device) * _GOLDEN
    return (_mix(counter) >> 11 & (1 << 53) - 1).to(torch.float64) * 2.0**-53


_GOLDEN = 0x9E3779B97F4A7C15 - 2**64


def _mix(x: Tensor) -> Tensor:
    for shift, factor in ((30, 0xBF58476D1CE4E5B9 - 2**64), (27, 0x94D049BB133111EB - 2**64)):
        x = (x ^ (x >> shift & (1 << 64 - shift) - 1)) * factor
    return x ^ (x >> 31 & (1 << 33) - 1)
