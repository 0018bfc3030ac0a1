"""Does an environment of this process simulate what those on Ray do, to the last bit?

Names and shapes tell neither the settings of a transform nor the masses of a model: a batch of
random actions, which is simulated under the same key on either side, does.
"""

from __future__ import annotations

__all__ = ["difference", "probed", "probing"]

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from .ray_worker import Inference, randomizer_of
from .simulate import collect_summaries, make_collector
from .sources import draw
from .trajectories import first_trajectories


class _Nothing:
    """Summaries without a statistic."""

    in_keys = ()

    def together(self, trajectories: TensorDictBase) -> Tensor:
        return torch.empty(len(trajectories), 0)


def probing(env: EnvBase, steps: int) -> tuple[Inference, Tensor]:
    """Return what to simulate to tell an environment from another: a question, and θ."""
    count = max(1, env.batch_size.numel())
    theta = draw(randomizer_of(env).source, count, key=("probe",))  # pyright: ignore[reportArgumentType]
    nothing: Any = _Nothing()
    return Inference(None, nothing, 1, steps, ("probe",), first_trajectories), theta


def probed(env: EnvBase, question: Inference, theta: Tensor) -> TensorDictBase:
    """Return the batch of a question, simulated here; the randomizer counts no episode for it."""
    randomizer = randomizer_of(env)
    before = randomizer.get_extra_state()
    collector = make_collector(env, question.policy, steps=question.steps)
    try:
        asked = {"key": question.key, "prepare": question.prepare, "keep": 1, "progress": False}
        _, (batch,) = collect_summaries(collector, question.statistics, randomizer, theta, **asked)
    finally:
        collector.shutdown(close_env=False)
        randomizer.set_extra_state(before)
    return batch


def difference(here: TensorDictBase, there: TensorDictBase) -> str:
    """Return where two batches first differ in a bit, nothing where they do not."""
    for key, value in here.items(include_nested=True, leaves_only=True):
        name = key if isinstance(key, str) else key[0]
        if name == "collector" or not isinstance(value, Tensor):  # it counts what it ever collected
            continue
        other = there.get(key, None)
        if other is None or other.shape != value.shape:
            return f"another shape of {key!r}"
        same = torch.isclose(value.double(), other.double(), rtol=0.0, atol=0.0, equal_nan=True)
        if not same.all():
            row, step = (~same).reshape(*same.shape[:2], -1).any(-1).nonzero()[0].tolist()
            return f"another {key!r}, first in step {step} of environment {row}"
    return ""
