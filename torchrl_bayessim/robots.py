"""The real side of the loop: one method, two implementations.

A *real system* answers ``rollouts(policy, episodes=, key=)`` with trajectories. A surrogate robot
is the same simulator with parameters that nobody else knows; recorded logs are what was measured
once, whatever the policy.
"""

from __future__ import annotations

__all__ = ["RealSystem", "RecordedLogs", "SurrogateRobot"]

from collections.abc import Sequence
from hashlib import blake2b
from typing import Any, Protocol

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from .counts import check_count
from .diverged import UndisturbedPolicy, check_policy
from .errors import SimulationError, message
from .kinds import check_key, check_keys, check_kind, real_numbers
from .randomness import check_draw_key, isolated, seed_from
from .real_trajectories import check_real, first_not_finite
from .sources import Grid
from .trajectories import concatenate, first_trajectories, next_key
from .transforms.domain_randomizer import DomainRandomizer, randomizers


class RealSystem(Protocol):
    """What the loop asks of a robot.

    If it has ``settings``, a dictionary of plain values, a checkpoint of others is refused.

    Attributes:
        recorded: Whether the answer is always the same log; the loop then replays its actions.
    """

    recorded: bool

    def rollouts(
        self, policy: TensorDictModuleBase, *, episodes: int, key: tuple[int | str, ...]
    ) -> TensorDictBase:
        """Return trajectories ``[episodes, T]`` with a ``"mask"``, made by ``policy``.

        They hold what the statistics read, and ``("next", "done")``; with ``("next", "reward")``
        what the robot earned is known, too. The policy explores, as it does in simulation:
        ``ExplorationType.RANDOM``.
        """
        ...


class SurrogateRobot:
    """A simulator with hidden parameters that stands for the robot.

    Args:
        env: With :class:`.transforms.ApplyPhysics`, and no randomizer.
        theta: The hidden parameters, shape ``(D,)``.
        max_steps: Steps after which an episode is cut.
        measured: Entries of the observation that the robot measures; the policy can read no
            other, and nothing else is reported.

    Raises:
        SimulationError: In a call: what was measured is not finite.
        TypeError: ``env`` is no environment, θ is not made of numbers, ``measured`` is one name and
            no sequence, or a count is no whole number; in a call, for what is no policy.
        ValueError: For θ of another shape or not finite, a measured entry that is not observed, no
            steps, or an environment that draws its own parameters; in a call, for no episodes, or a
            policy that reads what is not measured.

    Example:
        >>> from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
        >>> from torchrl_bayessim.physics.attributes import AttributePhysics
        >>> from torchrl_bayessim.transforms import ApplyPhysics
        >>> env = TransformedEnv(CartPoleEnv(4), ApplyPhysics(AttributePhysics("length")))
        >>> robot = SurrogateRobot(env, [0.7], max_steps=20)
        >>> real = robot.rollouts(None, episodes=6, key=(0,))
        >>> real.batch_size, "theta" in real.keys()
        (torch.Size([6, 20]), False)
    """

    recorded = False

    def __init__(
        self,
        env: EnvBase,
        theta: Any,
        *,
        max_steps: int,
        measured: Sequence[NestedKey] = ("observation",),
    ) -> None:
        check_count("max_steps", max_steps)
        check_kind("a TorchRL environment", env, EnvBase)
        _check_not_randomized(env)
        check_keys("measured", measured)
        self.max_steps, self.measured = max_steps, list(measured)
        expected = "numbers, the parameters θ of shape (D,)"
        theta = real_numbers(expected, theta, torch.float32)
        if theta.ndim != 1 or not len(theta) or not theta.isfinite().all():
            raise ValueError(message(f"finite {expected}", theta.tolist()))
        self._theta = theta
        self._randomizer = DomainRandomizer(Grid(theta[None]))
        self._env = TransformedEnv(env, self._randomizer, auto_unwrap=False)
        self._observed = list(self._env.observation_spec.keys(include_nested=True))
        for entry in self.measured:
            if entry not in self._observed:
                raise ValueError(
                    message("an observation to measure", entry, available=self._observed)
                )

    @property
    def settings(self) -> dict[str, Any]:
        """What tells this robot from others, without giving its parameters away."""
        return {
            "parameters": _digest(self._theta),
            "max_steps": self.max_steps,
            "measured": [repr(entry) for entry in self.measured],
        }

    @torch.no_grad()
    def rollouts(
        self,
        policy: TensorDictModuleBase | None,
        *,
        episodes: int,
        key: tuple[int | str, ...],
    ) -> TensorDictBase:
        """Return trajectories ``[episodes, T]`` with a ``"mask"``, made by ``policy``."""
        check_count("episodes", episodes)
        check_draw_key(key)
        check_policy(policy)
        for entry in getattr(policy, "in_keys", ()):
            if entry in self._observed and entry not in self.measured:
                raise ValueError(
                    message("a policy that reads what is measured", entry, available=self.measured)
                )
        if isinstance(policy, TensorDictModuleBase):
            policy = UndisturbedPolicy(policy)
        width = max(1, self._env.batch_size.numel())
        rows: list[TensorDictBase] = []
        for index in range(-(-episodes // width)):
            explore = set_exploration_type(ExplorationType.RANDOM)  # as collectors do
            with isolated(*key, "robot", index), explore:
                self._env.set_seed(seed_from(*key, "robot", index) % 2**31)
                batch = self._env.rollout(
                    self.max_steps, policy, break_when_any_done=False, set_truncated=False
                )
            rows.append(batch.reshape(-1, batch.shape[-1]))
        real = first_trajectories(concatenate(rows)[:episodes])
        following = [next_key(entry) for entry in self.measured]
        lost = first_not_finite(real, [*self.measured, *following])
        if lost is not None:
            entry, row, step = lost
            expected = f"a robot that measures finite values of {entry!r}"
            got = f"NaN or infinity in episode {row} at step {step}"
            hint = "does its simulation diverge at these parameters? Let it end the episode"
            raise SimulationError(message(expected, got, hint=hint))
        following = [*self.measured, "reward", "done", "terminated", "truncated"]
        reported = [*self.measured, "action", "mask", *(next_key(entry) for entry in following)]
        return real.select(*reported, strict=False)


def _check_not_randomized(env: EnvBase) -> None:
    if next(randomizers(env), None) is not None:
        raise ValueError(
            message(
                "an environment whose parameters the robot alone sets",
                "a DomainRandomizer among its transforms",
                hint="TransformedEnv(simulator, ApplyPhysics(physics))",
            )
        )


def _digest(*tensors: Tensor) -> str:
    content = [(str(t.dtype), t.detach().cpu().tolist()) for t in tensors]
    return blake2b(repr(content).encode(), digest_size=8).hexdigest()


class RecordedLogs:
    """Logs of a real robot.

    They are handed on under their own names, which must be the simulator's where statistics read
    them: the loop refuses others when it is made. A TensorDict renames its entries already:
    ``trajectories.rename_key_("cmd", "action")``.

    Args:
        trajectories: Batch size ``[n, T]`` with a ``"mask"``: see :func:`.trajectories.pad`.
        measured: Entries of the observation that were logged, each with its value a step later
            under ``"next"``.
        action_key: Entry of the action.

    Raises:
        TypeError: For what is not a TensorDict, a mask that is not of booleans, or ``measured``
            or ``action_key`` that are no keys.
        ValueError: For no trajectory, missing entries, or measurements that are not finite.
    """

    recorded = True

    def __init__(
        self,
        trajectories: TensorDictBase,
        *,
        measured: Sequence[NestedKey] = ("observation",),
        action_key: NestedKey = "action",
    ) -> None:
        check_keys("measured", measured)
        check_key("action_key", action_key)
        values = [*measured, action_key, *(next_key(entry) for entry in measured)]
        check_real(trajectories, values)
        self.trajectories, self._entries = trajectories, (*values, "mask")

    @property
    def settings(self) -> dict[str, Any]:
        """What tells these logs from others."""
        return {"logs": _digest(*(self.trajectories.get(entry) for entry in self._entries))}

    def rollouts(
        self,
        policy: TensorDictModuleBase | None,
        *,
        episodes: int,
        key: tuple[int | str, ...],
    ) -> TensorDictBase:
        """Return all the logs, whatever the policy, the number of episodes and the key."""
        del policy, episodes, key
        return self.trajectories
