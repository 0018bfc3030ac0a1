"""Where the parameters go: the protocol that every simulator adapter obeys.

A parameter vector ``theta`` has shape ``(*batch, D)`` where ``batch`` is the environment's batch
size, and is named only here and in the prior. Writes are absolute: writing the same ``theta``
twice is writing it once, and nothing is ever scaled in place.
"""

from __future__ import annotations

__all__ = ["Physics", "simulator_of"]

from typing import Any, Protocol, runtime_checkable

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase


@runtime_checkable
class Physics(Protocol):
    """Writes exact parameter values into a simulator and reads them back.

    An adapter for a simulator with one instance per environment needs two short methods::

        class ArmPhysics:
            names = ("mass", "friction")

            def write(self, env, theta, **_):
                env.arm.mass, env.arm.friction = theta.tolist()

            def read(self, env, **_):
                return torch.tensor([env.arm.mass, env.arm.friction])

    The two keyword arguments matter only to simulators that step many environments at once
    (``mask``) and to those that carry their physics in the tensordict (``tensordict``).

    Attributes:
        names: The parameters' names, in the order of the columns of ``theta``.
    """

    names: tuple[str, ...]

    def write(
        self, env: EnvBase, theta: Tensor, *, mask: Tensor, tensordict: TensorDictBase
    ) -> None:
        """Set the parameters of the environments in ``mask`` to exactly ``theta``.

        Args:
            env: The base environment, without transforms.
            theta: Values in the parameters' own units, shape ``(*batch, D)``.
            mask: Which environments to write, boolean, shape ``batch``.
            tensordict: The tensordict that the base environment's reset will receive.
        """
        ...

    def read(self, env: EnvBase, *, tensordict: TensorDictBase) -> Tensor:
        """Return the values in force now, shape ``(*batch, D)``."""
        ...


def simulator_of(env: Any) -> Any:
    """Return the simulator inside ``GymEnv`` or ``DMControlEnv``, or the environment itself.

    Example:
        >>> from torchrl.envs import GymEnv
        >>> type(simulator_of(GymEnv("CartPole-v1"))).__name__
        'CartPoleEnv'
    """
    inner = env.__dict__.get("_env", env)  # not getattr: TorchRL's looks through every wrapper
    return getattr(inner, "unwrapped", inner)
