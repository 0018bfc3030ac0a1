"""Simulations that diverge: what is simulated beside them goes on, and they are left out.

Some parameters of a wide prior make a simulator diverge. One observation of NaN would end a
collector, because no policy has an action for it, and would spoil the learner that is given it.
"""

from __future__ import annotations

__all__ = ["UndisturbedPolicy", "check_policy", "finite_rows"]

import warnings
from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleWrapper

from .errors import SimulationError, message
from .kinds import check_function


class UndisturbedPolicy(TensorDictModuleWrapper):
    """A policy that acts on NaN as on 0, and on infinity as on the largest numbers.

    The entries themselves stay as they are, so that all that is computed from them shows it.

    Example:
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> policy = UndisturbedPolicy(TensorDictModule(torch.tanh, ["observation"], ["action"]))
        >>> step = policy(TensorDict({"observation": torch.tensor([[torch.nan], [0.0]])}, [2]))
        >>> step["action"].flatten(), step["observation"].flatten()
        (tensor([0., 0.]), tensor([nan, 0.]))
    """

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write what the policy writes."""
        given = {key: tensordict.get(key, None) for key in self.td_module.in_keys}
        disturbed = {
            key: value
            for key, value in given.items()
            if value is not None and value.is_floating_point() and not value.isfinite().all()
        }
        for key, value in disturbed.items():
            tensordict.set(key, value.nan_to_num())
        out = self.td_module(tensordict)
        for key, value in disturbed.items():
            out.set(key, value)
        return out


def check_policy(policy: object) -> None:
    """Refuse what cannot act; None stands for random actions.

    Raises:
        TypeError: It cannot.
    """
    if policy is not None:
        check_function("a policy, a TensorDictModule, or None for random actions", policy)


def finite_rows(batch: TensorDictBase, keys: Sequence[NestedKey]) -> tuple[TensorDictBase, int]:
    """Return the rows of a batch ``[N, T]`` in which the entries are finite throughout.

    Warns of the others, and returns how many they are.

    Raises:
        SimulationError: There is none.
    """
    good = torch.ones(len(batch), dtype=torch.bool)
    for key in keys:
        value = batch.get(key, None)
        if value is not None and value.is_floating_point():
            good &= value.isfinite().flatten(1).all(-1).cpu()
    bad = int((~good).sum())
    if not bad:
        return batch, 0
    if not good.any():
        raise SimulationError(
            message(
                "a batch with at least one simulation that stays finite",
                f"NaN or infinity in all {bad}",
                hint="a smaller prior or a smaller time step; or let the environment end such an "
                "episode with its last finite observation, as the batched environments do",
            )
        )
    text = f"{bad} of {len(batch)} rows of a training batch hold NaN or infinity: left out"
    warnings.warn(text, stacklevel=2)
    return batch[good], bad
