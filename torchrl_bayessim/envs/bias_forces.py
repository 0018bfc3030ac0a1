"""Gravity, Coriolis and centrifugal forces of the states that simulations are in.

After a time step MuJoCo's ``qfrc_bias`` is that of its beginning. What depends on the load of a
joint wants that of the coming one, under the physics of its own simulation.
"""

from __future__ import annotations

__all__ = ["BeforeStep", "BiasForces", "bias_force"]

from collections.abc import Callable
from functools import cached_property

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .stepper import Stepper
from .task import Readings

Array = NDArray[np.float64]


class BeforeStep(Readings):
    """What may be looked at before a time step: arrays by name, and ``qfrc_bias``.

    Args:
        bias: Returns ``qfrc_bias``, shape ``(*batch, nv)``, or that of some of a batch ``(N,)`` by
            their numbers, ``(R, nv)``; asked where something looks at it.
        arrays: ``qpos``, ``qvel``, ``time`` and ``ctrl``, shape ``(*batch, size)``.
    """

    def __init__(self, bias: Callable[..., Tensor], **arrays: Tensor) -> None:
        super().__init__(**arrays)
        self._bias = bias

    @cached_property
    def qfrc_bias(self) -> Tensor:
        """Gravity, Coriolis and centrifugal forces, N m or N."""
        return self._bias()

    def bias_of(self, some: Tensor) -> Tensor:
        """Return ``qfrc_bias`` of some simulations, and of others the same or 0.

        Of all it takes nearly as long as a time step.

        Args:
            some: Which are asked for, booleans of shape ``(*batch,)``.
        """
        one_batch = self.qpos.ndim == 2 and some.shape == self.qpos.shape[:1]
        if "qfrc_bias" in vars(self) or not one_batch or bool(some.all()):
            return self.qfrc_bias
        some = some.bool()
        found = self._bias(some.nonzero()[:, 0].numpy())
        forces = found.new_zeros(len(some), found.shape[1])
        forces[some] = found
        return forces


class BiasForces:
    """Evaluates the states of a `Stepper`, which stay as they are.

    Args:
        stepper: The simulations.
    """

    def __init__(self, stepper: Stepper) -> None:
        self._stepper = stepper
        self._evaluated: Stepper | None = None

    def __call__(self, rows: NDArray[np.int64] | None = None) -> Tensor:
        """Return ``qfrc_bias`` of the simulations ``rows``, default all, shape ``(R, nv)``."""
        stepper, other = self._stepper, self._evaluated
        if other is None or other.num_envs != stepper.num_envs:  # most never ask
            other = self._evaluated = Stepper(
                stepper.models.model,
                stepper.num_envs,
                outputs=("qfrc_bias",),
                sharing=stepper.sharing,
                threads=stepper.threads,
            )
        if other.models is not stepper.models:
            other.use(stepper.models)
        asked = slice(None) if rows is None else rows
        other.state[asked] = stepper.state[asked, : other.state.shape[1]]
        other.begin(rows)
        bias = other.outputs[:, 0]
        return torch.from_numpy(bias.copy() if rows is None else bias[rows])


def bias_force(model: mujoco.MjModel, data: mujoco.MjData) -> Tensor:
    """Return ``qfrc_bias`` of the state that one simulation is in, shape ``(nv,)``."""
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    return torch.from_numpy(data.qfrc_bias.copy())
