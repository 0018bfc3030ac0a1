"""Where tensors lie: all of them where the weights of the posterior are that reads them."""

from __future__ import annotations

__all__ = ["check_one_device", "placed"]

from collections.abc import Iterable

import torch
from tensordict import TensorDictBase

from ..errors import message


def placed(pairs: TensorDictBase, device: torch.device) -> TensorDictBase:
    """Return pairs on a device: themselves, if all of them lie there.

    Example:
        >>> from tensordict import TensorDict
        >>> pairs = TensorDict({"theta": torch.zeros(2, 1)}, [2])
        >>> placed(pairs, torch.device("cpu")) is pairs
        True
    """
    leaves = pairs.values(include_nested=True, leaves_only=True)
    return pairs if all(value.device == device for value in leaves) else pairs.to(device)


def check_one_device(devices: Iterable[torch.device]) -> None:
    """Refuse networks on several devices.

    Raises:
        ValueError: They are.
    """
    found = sorted(set(map(str, devices)))
    if len(found) > 1:
        expected = "networks on one device, since they share pairs, or their answers"
        raise ValueError(message(expected, " and ".join(found), hint=f"network.to({found[0]!r})"))
