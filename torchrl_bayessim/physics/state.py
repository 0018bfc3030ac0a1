"""Parameters that travel in the tensordict, as in TorchRL's stateless environments.

``PendulumEnv`` takes its physics from the entries ``("params", name)`` of the tensordict that it
resets and steps: many pendulums of different masses are one tensordict with a batch size.
"""

from __future__ import annotations

__all__ = ["StatePhysics"]

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ..errors import PhysicsError, message
from ..kinds import check_key, check_names


class StatePhysics:
    """Sets entries ``(group, name)`` of the reset's tensordict.

    Args:
        *names: The entries' names, in the order of the columns of θ.
        group: Where they are.

    Raises:
        TypeError: A name is no string.
        ValueError: There is no name, or one twice.
        PhysicsError: The environment's reset gives no such entry.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl.envs import PendulumEnv, TransformedEnv
        >>> from torchrl_bayessim.transforms import ApplyPhysics
        >>> env = TransformedEnv(PendulumEnv(), ApplyPhysics(StatePhysics("m", "l")))
        >>> theta = torch.tensor([[0.5, 1.0], [2.0, 1.5]])
        >>> td = env.reset(TensorDict(theta=theta, batch_size=2), set_state=False)
        >>> td["params", "m"]
        tensor([0.5000, 2.0000])
    """

    def __init__(self, *names: str, group: str = "params") -> None:
        check_names("names, each once", names)
        check_key("group", group)
        self.names, self.group = names, group

    def write(
        self, env: EnvBase, theta: Tensor, *, mask: Tensor, tensordict: TensorDictBase
    ) -> None:
        """Set the entries in the rows of ``mask``; entries without a name here stay."""
        held = tensordict.get(self.group, None)
        if held is None:
            held = self._nominal(env).expand(tensordict.batch_size)
        new = held.clone()
        for name, value in zip(self.names, theta.unbind(-1), strict=True):
            old = held[name]
            new[name] = torch.where(mask.to(old.device), value.to(old), old)
        tensordict.set(self.group, new)

    def read(self, env: EnvBase, *, tensordict: TensorDictBase) -> Tensor:
        """Return the entries of ``tensordict``, or nominal values if it has none."""
        held = tensordict.get(self.group, None)
        if held is None:
            held = self._nominal(env).expand(tensordict.batch_size)
        return torch.stack([held[name] for name in self.names], -1)

    def _nominal(self, env: EnvBase) -> TensorDictBase:
        """Return what a plain reset of the environment gives, asked once."""
        noted = env.__dict__.setdefault("_nominal_groups", {})
        if self.group not in noted:
            noted[self.group] = env.reset().get(self.group, None)
        group = noted[self.group]
        for name in self.names:
            if group is None or name not in group:
                names = [] if group is None else list(group.keys())
                what = f"an entry of {self.group!r} after a reset of {type(env).__name__}"
                raise PhysicsError(message(what, name, available=names))
        return group
