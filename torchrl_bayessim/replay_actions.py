"""A policy that plays recorded actions."""

from __future__ import annotations

__all__ = ["ReplayActions"]

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from .errors import message


class ReplayActions(TensorDictModuleBase):
    """A policy that plays recorded actions: environment i plays row ``i mod n`` at every step.

    Args:
        actions: Recorded actions, shape ``(n, T, A)``; after the last step the last one is held.
        step_key: Entry that counts the steps of the episode (``StepCounter``'s).
        action_key: Entry that is written.

    Raises:
        ValueError: For actions of another shape, or that are not finite; in a call, if nothing
            counts the steps.

    Example:
        >>> from tensordict import TensorDict
        >>> replay = ReplayActions(torch.tensor([[[0.1], [0.2]]]))
        >>> replay(TensorDict({"step_count": torch.tensor([[1], [0]])}, [2]))["action"].flatten()
        tensor([0.2000, 0.1000])
    """

    actions: Tensor

    def __init__(
        self,
        actions: Tensor,
        *,
        step_key: NestedKey = "step_count",
        action_key: NestedKey = "action",
    ) -> None:
        super().__init__()
        if actions.ndim != 3 or not actions.numel():
            raise ValueError(message("actions of shape (n, T, A)", tuple(actions.shape)))
        if not actions.isfinite().all():
            raise ValueError(message("finite recorded actions", "NaN or infinity"))
        self.register_buffer("actions", actions)
        self.in_keys, self.out_keys = [step_key], [action_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of each environment's current step."""
        step = tensordict.get(self.in_keys[0], None)
        if step is None:
            raise ValueError(
                message(
                    f"steps of the episode counted in {self.in_keys[0]!r}",
                    "no such entry",
                    hint="a StepCounter among the environment's transforms",
                )
            )
        step = step.reshape(tensordict.batch_size)
        rows = torch.arange(step.numel(), device=step.device).reshape(step.shape)
        step = step.clamp(max=self.actions.shape[1] - 1)
        return tensordict.set(self.out_keys[0], self.actions[rows % len(self.actions), step])
