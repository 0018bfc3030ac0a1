"""A new source for environments in other processes, along the one way that always works.

TorchRL's collectors keep copies of the environment, and of the policy, in worker processes. Only
the policy's weights reach all of them: `Collector`, `MultiSyncCollector`, `MultiAsyncCollector`
and `RayCollector`. So the policy carries a table of draws as a buffer, and the randomizer in the
worker looks there at every reset::

    policy = PolicyWithSource(policy, prior)
    collector = MultiSyncCollector([make_env] * 4, policy, ...)
    ...
    push_source(collector, posterior, key=(seed, round))
"""

from __future__ import annotations

__all__ = ["PolicyWithSource", "push_source"]

from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase, TensorDictModuleWrapper
from torch import Tensor
from torchrl.collectors import BaseCollector

from .errors import message
from .randomness import check_draw_key
from .sources import Source, check_source, draw, names_of


class PolicyWithSource(TensorDictModuleWrapper):
    """A policy that also carries draws of the parameters to the collector's workers.

    It acts as ``policy`` does. Until the first `push_source` the table is NaN, and environments
    keep the source that they were built with. Each push takes effect, also of the same table: the
    later of an assignment to a randomizer and of a push holds.

    Args:
        policy: The policy.
        source: Any source over the same parameters; only its dimension and names are used.
        draws: Rows of the table ``M``; the pushed distribution is the empirical one over them.
    """

    draws: Tensor
    pushes: Tensor

    def __init__(self, policy: TensorDictModuleBase, source: Source, *, draws: int = 4096) -> None:
        super().__init__(policy)
        dim = draw(source, 1, key=("dimension",)).shape[1]
        self.names = names_of(source)
        self.register_buffer("draws", torch.full((draws, dim), torch.nan, dtype=torch.float32))
        self.register_buffer("pushes", torch.zeros((), dtype=torch.int64))

    @staticmethod
    def inside(policy: Any) -> PolicyWithSource | None:
        """Return the one within ``policy``, or None."""
        modules = policy.modules() if isinstance(policy, torch.nn.Module) else ()
        return next((m for m in modules if isinstance(m, PolicyWithSource)), None)


def push_source(collector: BaseCollector, source: Source, *, key: tuple[int | str, ...]) -> None:
    """Let every environment of ``collector`` draw from ``source`` from its next reset on.

    Running episodes keep their θ. The policy's current weights are pushed too.

    Args:
        collector: One whose policy is, or contains, a `PolicyWithSource`.
        source: Where the table is drawn from.
        key: What the draws are for, e.g. ``(seed, round)``: same key, same table.

    Raises:
        TypeError: The policy carries no table, or the source cannot be sampled.
        ValueError: ``source`` has other parameters than the policy was made for.
    """
    policy: Any = getattr(collector, "policy", None)
    carrier = PolicyWithSource.inside(policy)
    if carrier is None:
        raise TypeError(
            message(
                "a collector whose policy is a PolicyWithSource",
                type(policy).__name__,
                hint="build the collector with PolicyWithSource(policy, prior)",
            )
        )
    check_source(source)
    check_draw_key(key)
    names = names_of(source)
    if None not in (names, carrier.names) and names != carrier.names:
        raise ValueError(message(f"a source over {carrier.names}", names))
    table = draw(source, len(carrier.draws), key=(*key, "pushed"))
    if table.shape != carrier.draws.shape:
        raise ValueError(message(f"draws of shape {(*carrier.draws.shape,)}", (*table.shape,)))
    carrier.draws.copy_(table)
    carrier.pushes.add_(1)
    collector.update_policy_weights_(TensorDict.from_module(policy).data)
